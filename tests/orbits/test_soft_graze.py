"""Through grazes at soft walls: what is beyond is a real orbit, and the same that is found there without the branch."""

from dataclasses import replace

import numpy as np
import pytest

import vijax
from vijax.model.records import Status
from vijax.orbits import symmetry

SPAN = (0.04, 0.3)
PLAIN = vijax.ContinuationSettings()


@pytest.fixture(scope="module")
def orbits():
    """The 1:1 orbits of a soft wall: a symmetric one and two that are mirror images of each other."""
    found = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5), "1:1", guesses=512)
    alike = np.asarray(symmetry.symmetric(found))
    return found[np.flatnonzero(alike)[:1]], found[np.flatnonzero(~alike)[:1]]


def followed(orbit, direction="down", **settings):
    (one,) = vijax.follow_orbits(orbit, "d", SPAN, direction=direction, settings=replace(PLAIN, **settings))
    return one


@pytest.fixture(scope="module")
def loop(orbits):
    return followed(orbits[1])


def grazes(branch):
    return [point for point in branch.points if point.kind.startswith("grazing")]


def test_every_orbit_on_both_sides_of_a_graze_is_one(loop):
    count = np.asarray(loop.orbit.count)
    assert set(count) == {2, 3, 4}
    assert (np.asarray(loop.orbit.status) == Status.OK).all()
    assert np.asarray(loop.orbit.residual).max() < 1e-13
    # One impact at a time, at most as far from the graze as a step is long.
    changes = np.flatnonzero(np.diff(count))
    assert np.abs(np.diff(count)).max() == 1
    assert [point.gained for point in grazes(loop)][: len(changes)] == list(np.diff(count)[changes])
    for place, point in zip(changes, grazes(loop), strict=False):
        assert abs(loop.values[place + 1] - point.value) < 1e-5


@pytest.mark.long
def test_the_next_bifurcation_beyond_is_that_of_the_orbit_found_there(orbits, loop):
    (graze, *_) = grazes(branch := followed(orbits[1], max_grazings=1))
    assert (graze.kind, graze.onward) == ("grazing flight", f"one impact more at the {side_of(graze)} wall")
    beyond = [point for point in branch.points[branch.points.index(graze) + 1 :] if point.kind == "fold"]
    walls = {"left": "LLR", "right": "RRL"}[side_of(graze)]
    other = vijax.find_orbits(vijax.impact_pair(0.165, 40.0, 0.5), walls, guesses=256)
    alone = vijax.follow_orbits(other, "d", SPAN, settings=replace(PLAIN, max_grazings=0))
    met = [point for one in alone for point in one.points]
    for point in beyond[:2]:
        assert min(abs(one.value - point.value) for one in met if one.kind == "fold") < 1e-12
    # From the other side the same graze is met, an impact fades there, and it has the same name.
    assert min(abs(one.value - graze.value) for one in met if one.kind == graze.kind) < 1e-12


def side_of(point):
    return {-1: "left", 1: "right"}[point.wall]


def test_the_new_impact_begins_as_the_root_of_the_distance(orbits):
    # From there on, steps begin so short that the next fold, 3e-7 away, plays no part yet.
    branch = followed(orbits[1], max_grazings=1, first_step=1e-6, closing_steps=60)
    (graze,) = [point for point in grazes(branch) if point.gained]
    beyond = np.flatnonzero(np.asarray(branch.orbit.count) == 3)[:40]
    speed = np.nanmin(np.asarray(branch.orbit.knots)[beyond, :, 1], axis=1)
    distance = np.abs(branch.values[beyond] - graze.value)
    near = (speed > 2e-6) & (speed < 2e-5)
    assert near.sum() > 4
    assert np.polyfit(np.log(distance[near]), np.log(speed[near]), 1)[0] == pytest.approx(0.5, abs=0.05)


def test_a_branch_of_mirror_images_comes_round(loop):
    assert loop.ends == ("closed", "closed")
    # Four grazes: an impact more and fewer, of each of the two images.
    assert sorted(point.gained for point in grazes(loop)) == [-1, -1, 1, 1]
    assert {side_of(point) for point in grazes(loop)} == {"left", "right"}
    values = sorted(round(point.value, 9) for point in grazes(loop))
    assert values[0] == values[1]
    assert values[2] == values[3]


def test_both_ways_are_told_in_one_order(orbits):
    branch = followed(orbits[1], "both", max_grazings=1)
    changes = np.diff(np.asarray(branch.orbit.count))
    assert [point.gained for point in grazes(branch) if point.gained] == list(changes[changes != 0]) == [-1, 1]


def test_no_graze_is_gone_through_where_none_is_asked_for(orbits):
    branch = followed(orbits[1], max_grazings=0)
    assert branch.ends == ("start", "grazing flight")
    assert [point.onward for point in grazes(branch)] == [""]
    assert set(np.asarray(branch.orbit.count)) == {2}


@pytest.mark.long
def test_a_symmetric_orbit_gains_an_impact_at_both_walls_at_once(orbits):
    full, half = followed(orbits[0], max_grazings=1), followed(symmetry.halved(orbits[0]), max_grazings=1)
    (whole,), (one,) = ([point for point in grazes(branch) if point.gained] for branch in (full, half))
    assert whole.value == pytest.approx(one.value, abs=1e-12)
    assert (whole.gained, one.gained) == (2, 1)
    assert whole.onward == one.onward == "one impact more at each wall"
    assert vijax.orbit_labels(full.orbit[-1:]) == ["2:2"]


@pytest.mark.long
def test_contacts_join_and_part_again(orbits):
    half, low = symmetry.halved(orbits[0]), (0.02, 0.3)
    (down,) = vijax.follow_orbits(half, "d", low, direction="down")
    joins = [point for point in down.points if point.kind == "grazing contact" and point.gained == -1]
    assert joins
    # Back up from the lower end.
    (up,) = vijax.follow_orbits(down.orbit[-1:], "d", low, direction="up", points=len(down.values))
    parts = [point for point in up.points if point.kind == "grazing contact" and point.gained == 1]
    for point in joins:
        assert min(abs(other.value - point.value) for other in parts) < 1e-11
    assert (np.asarray(up.orbit.status) == Status.OK).all()


def test_the_dataset_says_how_a_branch_goes_on(loop, tmp_path):
    table = vijax.branch_dataset([loop])
    assert list(table["event_onward"].values[0]) == [point.onward for point in loop.points]
    assert set(table["label"].values[0]) == {"1:1", "1:2", "2:1", "2:2"}
    vijax.save(table, tmp_path / "loop.zarr")
    assert list(vijax.load(tmp_path / "loop.zarr")["event_onward"].values[0]) == list(table["event_onward"].values[0])
    for axes in vijax.plots.branches(table).axes:
        # Between grazes lines do not jump from one impact to another.
        steps = [np.abs(np.diff(line.get_ydata())) for line in axes.lines if line.get_linestyle() != "None"]
        assert np.nanmax(np.concatenate(steps)) < 0.05


@pytest.mark.long
def test_a_fold_goes_on_through_its_graze():
    found = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5, 0.01), "RL", guesses=256)
    plain = replace(PLAIN, max_grazings=0)
    branches = vijax.follow_orbits(found, "d", (0.19, 0.25), settings=plain)
    folds = [point for branch in branches for point in branch.points if point.kind == "fold"]
    (curve,) = vijax.follow_curves(folds, "d", {"d": (0.14, 0.25), "gamma": (0.0, 0.2)})
    (graze,) = [point for point in curve.points if point.gained]
    assert (graze.kind, graze.test, abs(graze.gained)) == ("fold-graze", "flight", 1)
    count = np.asarray(curve.orbit.count)
    assert set(count) == {2, 3}
    assert (np.asarray(curve.orbit.status) == Status.OK).all()
    assert np.asarray(curve.orbit.residual).max() < 1e-13
    assert np.abs(np.asarray(curve.orbit.multipliers) - 1).min(axis=1).max() < 1e-11
    # An orbit found by itself with one impact more folds there too.
    place = np.flatnonzero(count == 3)[len(count[count == 3]) // 2]
    d, gamma = curve.values[place]
    side = np.asarray(curve.orbit.sequence.side)[place]
    walls = "".join("R" if wall > 0 else "L" for wall in side if wall)
    met = []
    for shift in (-0.002, 0.002):
        other = vijax.find_orbits(vijax.impact_pair(d + shift, 40.0, 0.5, gamma), walls, guesses=256)
        if len(other):
            near = vijax.follow_orbits(other, "d", (d - 0.01, d + 0.01), settings=plain)
            met += [point.value for one in near for point in one.points if point.kind == "fold"]
    assert np.abs(np.array(met) - d).min() < 1e-10


@pytest.mark.long
def test_a_curve_of_parting_contacts_is_where_branches_meet_them(orbits):
    half, low = symmetry.halved(orbits[0]), (0.02, 0.3)
    (down,) = vijax.follow_orbits(half, "d", low, direction="down")
    (graze, *_) = [point for point in down.points if point.kind == "grazing contact"]
    (curve,) = vijax.follow_curves([graze], "d", {"d": low, "kappa": (38.0, 42.0)})
    assert (curve.kind, curve.ends) == ("grazing contact", ("kappa low", "kappa high"))
    assert np.asarray(curve.orbit.residual).max() < 1e-13
    # Rounding decides whether a contact that just touches its wall from inside has ended: either orbit is flown.
    assert (np.asarray(curve.orbit.status) == Status.OK).mean() > 0.8
    # A branch at the end of the curve meets the graze there.
    (other,) = vijax.follow_orbits(curve.orbit[-2:-1], "d", low, points=40)
    d = [point.value for point in other.points if point.kind == "grazing contact"]
    assert min(abs(value - curve.values[-2, 0]) for value in d) < 1e-11
