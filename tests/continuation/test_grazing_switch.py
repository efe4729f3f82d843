"""Grazing switches at soft walls: the branch continues on verified orbits, and a direct search returns the same."""

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
    """Return two 1:1 orbits between soft walls: the symmetric orbit, and an orbit of the mirror pair."""
    candidates = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5), "1:1", guesses=512)
    symmetric = np.asarray(symmetry.is_symmetric(candidates))
    return candidates[np.flatnonzero(symmetric)[:1]], candidates[np.flatnonzero(~symmetric)[:1]]


def follow_over_d(orbit, direction="down", **settings):
    (branch,) = vijax.follow_orbits(orbit, "d", SPAN, direction=direction, settings=replace(PLAIN, **settings))
    return branch


@pytest.fixture(scope="module")
def loop(orbits):
    return follow_over_d(orbits[1])


def grazes(branch):
    return [point for point in branch.points if point.kind.startswith("grazing")]


def test_orbits_on_both_sides_of_a_graze_are_verified(loop):
    count = np.asarray(loop.orbit.count)
    assert set(count) == {2, 3, 4}
    assert (np.asarray(loop.orbit.status) == Status.OK).all()
    assert np.asarray(loop.orbit.residual).max() < 1e-13
    # The count changes by one impact, within one step of the graze.
    changes = np.flatnonzero(np.diff(count))
    assert np.abs(np.diff(count)).max() == 1
    assert [point.impact_change for point in grazes(loop)][: len(changes)] == list(np.diff(count)[changes])
    for place, point in zip(changes, grazes(loop), strict=False):
        assert abs(loop.values[place + 1] - point.value) < 1e-5


@pytest.mark.long
def test_next_bifurcation_after_a_graze_matches_a_direct_search(orbits, loop):
    (graze, *_) = grazes(branch := follow_over_d(orbits[1], max_grazings=1))
    assert (graze.kind, graze.impact_change_text) == ("grazing flight", f"one impact more at the {side_of(graze)} wall")
    later_folds = [point for point in branch.points[branch.points.index(graze) + 1 :] if point.kind == "fold"]
    walls = {"left": "LLR", "right": "RRL"}[side_of(graze)]
    other = vijax.find_orbits(vijax.impact_pair(0.165, 40.0, 0.5), walls, guesses=256)
    direct = vijax.follow_orbits(other, "d", SPAN, settings=replace(PLAIN, max_grazings=0))
    events = [point for item in direct for point in item.points]
    for point in later_folds[:2]:
        assert min(abs(item.value - point.value) for item in events if item.kind == "fold") < 1e-12
    # The direct branch reaches the same graze, of the same kind, as the speed of an impact goes to zero.
    assert min(abs(item.value - graze.value) for item in events if item.kind == graze.kind) < 1e-12


def side_of(point):
    return {-1: "left", 1: "right"}[point.wall]


def test_speed_of_the_new_impact_grows_as_the_root_of_the_distance(orbits):
    # Steps after the graze start so short that the next fold, 3e-7 away, has no effect yet.
    branch = follow_over_d(orbits[1], max_grazings=1, first_step=1e-6, closing_steps=60)
    (graze,) = [point for point in grazes(branch) if point.impact_change]
    switched = np.flatnonzero(np.asarray(branch.orbit.count) == 3)[:40]
    speed = np.nanmin(np.asarray(branch.orbit.impact_unknowns)[switched, :, 1], axis=1)
    distance = np.abs(branch.values[switched] - graze.value)
    near = (speed > 2e-6) & (speed < 2e-5)
    assert near.sum() > 4
    assert np.polyfit(np.log(distance[near]), np.log(speed[near]), 1)[0] == pytest.approx(0.5, abs=0.05)


def test_branch_of_mirror_images_closes(loop):
    assert loop.ends == ("closed", "closed")
    # Four grazes: one impact more and one fewer, for both images.
    assert sorted(point.impact_change for point in grazes(loop)) == [-1, -1, 1, 1]
    assert {side_of(point) for point in grazes(loop)} == {"left", "right"}
    values = sorted(round(point.value, 9) for point in grazes(loop))
    assert values[0] == values[1]
    assert values[2] == values[3]


def test_points_of_both_directions_are_in_the_order_of_the_branch(orbits):
    branch = follow_over_d(orbits[1], "both", max_grazings=1)
    changes = np.diff(np.asarray(branch.orbit.count))
    assert (
        [point.impact_change for point in grazes(branch) if point.impact_change]
        == list(changes[changes != 0])
        == [-1, 1]
    )


def test_branch_without_grazing_switches_ends_at_its_graze(orbits):
    branch = follow_over_d(orbits[1], max_grazings=0)
    assert branch.ends == ("start", "grazing flight")
    assert [point.impact_change_text for point in grazes(branch)] == [""]
    assert set(np.asarray(branch.orbit.count)) == {2}


@pytest.mark.long
def test_symmetric_orbit_has_a_new_impact_at_both_walls_at_once(orbits):
    full, half = (
        follow_over_d(orbits[0], max_grazings=1),
        follow_over_d(symmetry.close_half_way(orbits[0]), max_grazings=1),
    )
    (full_graze,), (half_graze,) = (
        [point for point in grazes(branch) if point.impact_change] for branch in (full, half)
    )
    assert full_graze.value == pytest.approx(half_graze.value, abs=1e-12)
    assert (full_graze.impact_change, half_graze.impact_change) == (2, 1)
    assert full_graze.impact_change_text == half_graze.impact_change_text == "one impact more at each wall"
    assert vijax.orbit_labels(full.orbit[-1:]) == ["2:2"]


@pytest.mark.long
def test_contacts_merge_and_separate_again(orbits):
    half, span = symmetry.close_half_way(orbits[0]), (0.02, 0.3)
    (down,) = vijax.follow_orbits(half, "d", span, direction="down")
    mergers = [point for point in down.points if point.kind == "grazing contact" and point.impact_change == -1]
    assert mergers
    # Back up from the lower end.
    (up,) = vijax.follow_orbits(down.orbit[-1:], "d", span, direction="up", points=len(down.values))
    separations = [point for point in up.points if point.kind == "grazing contact" and point.impact_change == 1]
    for point in mergers:
        assert min(abs(other.value - point.value) for other in separations) < 1e-11
    assert (np.asarray(up.orbit.status) == Status.OK).all()


def test_dataset_describes_the_grazing_switches(loop, tmp_path):
    table = vijax.branch_dataset([loop])
    assert list(table["event_onward"].values[0]) == [point.impact_change_text for point in loop.points]
    assert set(table["label"].values[0]) == {"1:1", "1:2", "2:1", "2:2"}
    vijax.save(table, tmp_path / "loop.zarr")
    assert list(vijax.load(tmp_path / "loop.zarr")["event_onward"].values[0]) == list(table["event_onward"].values[0])
    for axes in vijax.plots.branches(table).axes:
        # Between grazes lines do not jump from one impact to another.
        steps = [np.abs(np.diff(line.get_ydata())) for line in axes.lines if line.get_linestyle() != "None"]
        assert np.nanmax(np.concatenate(steps)) < 0.05


@pytest.mark.long
def test_curve_of_folds_continues_through_its_graze():
    orbits = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5, 0.01), "RL", guesses=256)
    plain = replace(PLAIN, max_grazings=0)
    branches = vijax.follow_orbits(orbits, "d", (0.19, 0.25), settings=plain)
    folds = [point for branch in branches for point in branch.points if point.kind == "fold"]
    (curve,) = vijax.follow_curves(folds, "d", {"d": (0.14, 0.25), "gamma": (0.0, 0.2)})
    (graze,) = [point for point in curve.points if point.impact_change]
    assert (graze.kind, graze.test, abs(graze.impact_change)) == ("fold-graze", "flight", 1)
    count = np.asarray(curve.orbit.count)
    assert set(count) == {2, 3}
    assert (np.asarray(curve.orbit.status) == Status.OK).all()
    assert np.asarray(curve.orbit.residual).max() < 1e-13
    assert np.abs(np.asarray(curve.orbit.multipliers) - 1).min(axis=1).max() < 1e-11
    # The orbit of a direct search with one impact more folds at the same place.
    place = np.flatnonzero(count == 3)[len(count[count == 3]) // 2]
    d, gamma = curve.values[place]
    side = np.asarray(curve.orbit.sequence.side)[place]
    walls = "".join("R" if wall > 0 else "L" for wall in side if wall)
    values = []
    for shift in (-0.002, 0.002):
        other = vijax.find_orbits(vijax.impact_pair(d + shift, 40.0, 0.5, gamma), walls, guesses=256)
        if len(other):
            segments = vijax.follow_orbits(other, "d", (d - 0.01, d + 0.01), settings=plain)
            values += [point.value for segment in segments for point in segment.points if point.kind == "fold"]
    assert np.abs(np.array(values) - d).min() < 1e-10


@pytest.mark.long
def test_curve_of_grazing_contacts_matches_the_events_of_branches(orbits):
    half, span = symmetry.close_half_way(orbits[0]), (0.02, 0.3)
    (down,) = vijax.follow_orbits(half, "d", span, direction="down")
    (graze, *_) = [point for point in down.points if point.kind == "grazing contact"]
    (curve,) = vijax.follow_curves([graze], "d", {"d": span, "kappa": (38.0, 42.0)})
    assert (curve.kind, curve.ends) == ("grazing contact", ("kappa low", "kappa high"))
    assert np.asarray(curve.orbit.residual).max() < 1e-13
    # Rounding decides whether a contact with an interior minimum at depth zero ends there: either orbit may result.
    assert (np.asarray(curve.orbit.status) == Status.OK).mean() > 0.8
    # A branch from the end of the curve has its graze there.
    (other,) = vijax.follow_orbits(curve.orbit[-2:-1], "d", span, points=40)
    d = [point.value for point in other.points if point.kind == "grazing contact"]
    assert min(abs(value - curve.values[-2, 0]) for value in d) < 1e-11
