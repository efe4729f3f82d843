"""Branches: the bifurcations of the rigid wall at their known places, each with the multiplier that makes it one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax import plots
from vijax.model.device import Harvester, with_constants
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import (
    branch_dataset,
    continuation,
    curves,
    events,
    orbit_properties,
    orbit_search,
    parameter,
    periodic,
    switching,
    symmetry,
)
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.shooting import Sequence

SPAN = (0.1, 0.3)
# Of the reference: where the symmetric orbit breaks, and where two left and one right impact fold.
PITCHFORK, FOLD = 0.2634316, 0.20158
Q = 1.5 / (0.5 * np.pi)  # (1 + r)/(pi (1 - r)) at r = 0.5: the pitchfork is known in closed form


@pytest.fixture(scope="module")
def family():
    """The symmetric period-1 orbits of rigid walls, closed half way, and what bifurcates from them."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    return switching.family(start, "d", SPAN)


def largest(point):
    return complex(point.orbit.multipliers[0, 0])


def points(branches, kind):
    return [point for one in branches for point in one.points if point.kind == kind]


def test_symmetry_breaks_where_it_is_known_to(family):
    broken = points(family, "pitchfork")
    assert len(broken) == 1
    for point in broken:
        assert point.value == pytest.approx(PITCHFORK, abs=5e-8)
        assert abs(largest(point) - 1) < 1e-6


def test_a_branch_of_mirror_images_knows_the_pitchfork_as_well_as_the_symmetric_one(family):
    """Newton is singular there, and came to 1e-8 before the place was sought on orbits closed half way."""
    pair = family[1].orbit
    index = int(np.abs(family[1].values - 0.2).argmin())
    (branch,) = continuation.follow(pair[index : index + 1], "d", SPAN)
    for one in (branch, family[0]):
        (point,) = points([one], "pitchfork")
        assert point.value == pytest.approx((1 - 4 / np.pi**2) * Q / np.sqrt(1 + 4 * Q**2), abs=1e-13)
        assert point.orbit.status[0] == Status.OK
        assert abs(largest(point) - 1) < 1e-9


def test_the_branch_of_mirror_images_flips_alike(family):
    flips = points(family, "flip")
    assert len(flips) == 2
    # 40 digits of the orbit and det(M + 1) = 0 solved together give this value.
    for point in flips:
        assert point.value == pytest.approx(0.18705323128468188, abs=1e-12)
        assert abs(largest(point) + 1) < 1e-7
    # Both leave the pitchfork, where they begin.
    assert [one.values[0] for one in family[1:]] == pytest.approx([PITCHFORK] * 2, abs=5e-8)
    # It is followed from where it begins: half the impacts there are all of them elsewhere.
    assert [int(x[0]) for x in orbit_properties.counts(family[0].orbit[:1])] == [1, 1, 1]
    assert [int(x[0]) for x in orbit_properties.counts(family[1].orbit[-1:])] == [1, 1, 1]


def test_every_orbit_is_one_and_the_multiplier_decides_between_stable_and_not(family):
    for one in family:
        assert (np.asarray(one.orbit.status) == Status.OK).all()
        assert (np.asarray(one.orbit.residual) < 1e-13).all()
        assert np.abs(np.diff(one.values)).max() < 0.01 * (SPAN[1] - SPAN[0])
    symmetric = family[0]
    # To the very ends, and each end once.
    np.testing.assert_allclose(symmetric.values[[0, -1]], SPAN, rtol=1e-12)
    np.testing.assert_array_equal(symmetric.stable, symmetric.values > PITCHFORK)
    assert symmetric.ends == ("low", "high")


def test_grazing_ends_a_branch_where_the_ball_just_touches(family):
    ends = points(family, "grazing flight")
    assert {one.ends[1] for one in family[1:]} == {"grazing flight"}
    for point in ends[:2]:
        _, u, _ = orbit_properties.path(point.orbit, samples=2001)
        turning = np.sort(np.abs(u[0][1:-1][(np.diff(u[0])[1:] * np.diff(u[0])[:-1]) <= 0]))
        # A third turning point at the wall, besides the two impacts.
        assert np.abs(turning - 0.5 * point.value).min() < 1e-6


def test_a_branch_goes_through_its_fold():
    found = orbit_search.search(impact_pair(0.19, None, 0.5), "RLL", guesses=32)
    (one,) = continuation.follow(found[:1], "d", SPAN, direction="up")
    (fold,) = (point for point in one.points if point.kind == "fold")
    assert fold.value == pytest.approx(FOLD, abs=5e-6)
    assert abs(largest(fold) - 1) < 1e-5
    assert one.values.max() <= fold.value
    assert one.values[-1] < one.values.max() - 0.001


def test_the_dataset_and_its_picture(family, tmp_path):
    found = branch_dataset.dataset(family, Harvester())
    assert found.sizes["branch"] == len(family)
    assert found["d"].attrs["units"] == "1"
    first = family[0]
    np.testing.assert_allclose(found["P"][0, : len(first.values)], orbit_properties.power(first.orbit, Harvester()))
    assert sorted(k for k in found["event"].values.flat if k) == sorted(p.kind for b in family for p in b.points)
    # Marks lie on the sheet of the branch that met them.
    for index, one in enumerate(family):
        for number, point in enumerate(one.points):
            place = int(found["event_point"][index, number])
            assert np.nanmax(np.abs(one.orbit.knots[place, :, 1] - point.orbit.knots[0, :, 1])) < 0.02
    plots.save(plots.branches(found), tmp_path / "branches.png")
    assert (tmp_path / "branches.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"along": "omega0"}, "a rigid wall has no kappa or omega0 or k"),
        ({"along": "u0"}, "along must be among d, r, gamma"),
        ({"along": "kappa"}, "a rigid wall has no kappa"),
        ({"within": (0.3, 0.1)}, "within must be two finite bounds"),
        ({"within": (0.1,)}, "within must be two finite bounds"),
        ({"points": 1}, "points must be a whole number"),
        ({"within": (0.25, 0.3)}, "within must hold the start"),
        ({"direction": "sideways"}, "direction must be"),
        ({"along": "gamma", "within": (-0.1, 0.1)}, "orbit must be closed in full"),
    ],
)
def test_bad_input_is_told(family, change, message):
    start = family[0].orbit[len(family[0].values) // 2 :][:1]
    with pytest.raises(ValueError, match=message):
        continuation.follow(start, **{"along": "d", "within": SPAN} | change)


def test_nothing_begins_at_a_grazing(family):
    with pytest.raises(ValueError, match="point must be a flip"):
        switching.switch(points(family, "grazing flight")[0], "d", SPAN)


DEVICE = Harvester(s=0.2, omega0=60.0, beta=0.01)
OTHER = {"omega": 3.3, "omega0": 70.0, "k": 10.0, "s": 0.21, "A": 1.2, "beta": -0.02}


@pytest.mark.parametrize("along", OTHER)
@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_a_quantity_of_the_device_moves_the_pair_as_it_does_the_device(along, wall):
    pair = DEVICE.pair(wall)
    assert float(parameter.value_at(DEVICE.pair(), along, DEVICE)) == pytest.approx(getattr(DEVICE, along), rel=1e-14)
    if wall == "rigid" and along in ("omega0", "k"):
        return
    there = parameter.pair_at(pair, along, OTHER[along], DEVICE)
    for own, expected in zip(
        jax.tree.leaves(there), jax.tree.leaves(with_constants(DEVICE, **{along: OTHER[along]}).pair(wall)), strict=True
    ):
        assert float(own) == pytest.approx(float(expected), rel=1e-14, abs=1e-17)


@pytest.mark.long
def test_a_branch_along_the_forcing_moves_gap_and_gravity_together():
    found = orbit_search.search(DEVICE.pair("rigid"), "RL", guesses=32)
    (one,) = continuation.follow(found[:1], "A", (1, 2), device=DEVICE, direction="up", points=8)
    assert one.values[0] == pytest.approx(1.0, abs=1e-14)
    assert one.values[-1] > 1.004
    assert (np.asarray(one.orbit.status) == Status.OK).all()
    shaken = with_constants(DEVICE, A=jnp.asarray(one.values)).pair("rigid")
    np.testing.assert_allclose(one.orbit.pair.d, shaken.d, rtol=1e-14)
    np.testing.assert_allclose(one.orbit.pair.gamma, shaken.gamma, rtol=1e-14)
    table = branch_dataset.dataset([one], DEVICE)
    assert table["A"].attrs["units"] == "m s-2"
    last = with_constants(DEVICE, A=float(one.values[-1]))
    assert float(table["P"][0, -1]) == pytest.approx(float(orbit_properties.power(one.orbit[-1:], last)[0]), rel=1e-12)


@pytest.mark.long
def test_branches_can_be_followed_from_their_folds():
    """No orbit beside a fold has its parameter. Newton found nearly none of these, on which 1:1 orbits almost fade."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    folds = points(continuation.follow(lower, "d", (0.2, 0.3)), "fold")
    (curve,) = curves.follow_curves(folds, "d", {"d": (0.15, 0.3), "kappa": (20.0, 400.0)})
    begun = curve.orbit[::10]
    for branch, d in zip(continuation.follow(begun, "d", (0.15, 0.3)), begun.pair.d, strict=True):
        assert set(branch.ends) == {"grazing impact", "high"}
        assert np.abs(branch.values - d).min() < 1e-14


@pytest.mark.parametrize("kappa", [None, pytest.param(40.0, marks=pytest.mark.long)])
def test_a_branch_that_starts_at_a_bound_stays_within(kappa):
    """It used to set out across the bound, where rounding had the start beyond it already."""
    start = orbit_search.search(impact_pair(0.2, kappa, 0.5), "RL", guesses=32)[:1]
    for within, end in (((0.2, 0.25), "low"), ((0.15, 0.2), "high")):
        (branch,) = continuation.follow(start, "d", within)
        at_start = [why for why, d in zip(branch.ends, branch.values[[0, -1]], strict=True) if d == pytest.approx(0.2)]
        assert end in at_start
        assert within[0] <= branch.values.min() < branch.values.max() <= within[1]
        assert np.abs(np.diff(branch.values)).min() > 0


def test_a_pitchfork_is_told_from_a_fold_however_roughly_it_is_met():
    """At this gap Newton leaves the mirror pairs 1.07e-4 apart where they meet. The symmetric branch is told, too."""
    start = orbit_search.search(impact_pair(0.23572947460946414, None, 0.5), "RL", guesses=64)
    branches = switching.family(start, "r", (0.15, 0.9))
    assert {"fold"}.isdisjoint(point.kind for one in branches for point in one.points)
    (pairs,) = (one for one in branches if not bool(one.orbit.sequence.mirrored[0]))
    (simple,) = (one for one in branches if bool(one.orbit.sequence.mirrored[0]) and one.points)
    (of_pairs,), (of_simple,) = points([pairs], "pitchfork"), points([simple], "pitchfork")
    assert of_pairs.value == pytest.approx(of_simple.value, abs=1e-14)
    # Orbits closed half way are as wide as those in full, to be followed by the same programs.
    assert {one.orbit.knots.shape[1] for one in branches} == {2}
    assert {int(one.orbit.count[0]) for one in branches} == {1, 2}


def test_an_orbit_closed_half_way_folds_where_a_multiplier_passes_one():
    """In a step from where it fades its turn is not seen, and it was called a pitchfork, at which -1 is passed."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    arcs, y = continuation.set_out(lower, "d", SPAN, None, ContinuationSettings())
    arc = jax.tree.map(lambda leaf: leaf[0], arcs)
    for test, kind in (("plus", "fold"), ("fold", "fold"), ("minus", "pitchfork")):
        event = events.BranchEvent(0, 0.0, test, y[0])
        assert events.kind_of(arc, event, np.repeat(y, 2, axis=0), ContinuationSettings()) == kind


@pytest.mark.parametrize("r", [pytest.param(0.479, marks=pytest.mark.long), 0.48])
def test_two_events_within_one_arclength_step_are_located_apart(r):
    """The flip and the graze are closer than a step (2e-3). Unstable orbits lie between them."""
    found = orbit_search.search(impact_pair(0.2, None, r), "RL", guesses=256)
    start = found[np.flatnonzero(~symmetry.symmetric(found))][:1]
    (branch,) = continuation.follow(start, "d", SPAN, direction="down")
    flip, graze = branch.points
    assert (flip.kind, graze.kind) == ("flip", "grazing flight")
    assert 0 < flip.value - graze.value < 1e-3
    between = (branch.values > graze.value) & (branch.values < flip.value)
    assert between.any()
    assert not branch.stable[between].any()
    fine = ContinuationSettings(max_step=1e-4, first_step=1e-5)
    (apart,) = continuation.follow(branch.orbit[np.flatnonzero(between)[:1]], "d", SPAN, settings=fine, points=300)
    known = {point.kind: point.value for point in apart.points}
    for point in (flip, graze):
        assert point.value == pytest.approx(known[point.kind], abs=1e-12)


def test_a_family_ends_where_its_orbit_fades():
    """The branch of the lower 1:1 orbit ends in impacts of speed zero, where both multipliers are 1: no pitchfork."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    (branch,) = switching.family(lower, "d", (0.2, 0.3))
    faded, fold = branch.points
    assert (faded.kind, fold.kind) == ("grazing impact", "fold")
    assert float(np.abs(faded.orbit.knots[0, 0, 1])) < 1e-15
    assert fold.value < faded.value
    assert faded.value == pytest.approx(2 / np.pi**2, rel=1e-12, abs=0)
