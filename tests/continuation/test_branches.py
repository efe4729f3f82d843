"""Branches: bifurcations between rigid walls are at the reference places and have the multiplier of their kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax import plots
from vijax.continuation import (
    branch_continuation,
    branch_dataset,
    branch_events,
    branch_switching,
    continuation_parameter,
)
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.curves import curves
from vijax.model.device import Harvester, with_constants
from vijax.model.pair import impact_pair
from vijax.model.records import Status
from vijax.orbits import orbit_properties, orbit_search, periodic, symmetry
from vijax.orbits.shooting import Sequence

SPAN = (0.1, 0.3)
# References: the pitchfork of the symmetric orbit, and the fold of the orbit with two left impacts and one right.
PITCHFORK, FOLD = 0.2634316, 0.20158
Q = 1.5 / (0.5 * np.pi)  # (1 + r)/(pi (1 - r)) at r = 0.5, in the closed form of the pitchfork


@pytest.fixture(scope="module")
def family():
    """Return the branch of symmetric period-1 orbits of rigid walls, closed half way, and all bifurcating branches."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    start = periodic.solve(impact_pair([0.2], None, 0.5), half, jnp.array([[[0.15, 0.5, 0.0]]]))
    return branch_switching.follow_families(start, "d", SPAN)


def largest(point):
    return complex(point.orbit.multipliers[0, 0])


def points(branches, kind):
    return [point for branch in branches for point in branch.points if point.kind == kind]


def test_pitchfork_is_at_the_reference_value(family):
    pitchforks = points(family, "pitchfork")
    assert len(pitchforks) == 1
    for point in pitchforks:
        assert point.value == pytest.approx(PITCHFORK, abs=5e-8)
        assert abs(largest(point) - 1) < 1e-6


def test_branch_of_mirror_images_locates_the_pitchfork_to_rounding(family):
    """Newton is singular at the pitchfork. The search uses orbits closed half way; full orbits reach only 1e-8."""
    pair = family[1].orbit
    index = int(np.abs(family[1].values - 0.2).argmin())
    (branch,) = branch_continuation.follow_orbits(pair[index : index + 1], "d", SPAN)
    for path in (branch, family[0]):
        (point,) = points([path], "pitchfork")
        assert point.value == pytest.approx((1 - 4 / np.pi**2) * Q / np.sqrt(1 + 4 * Q**2), abs=1e-13)
        assert point.orbit.status[0] == Status.OK
        assert abs(largest(point) - 1) < 1e-9


def test_both_branches_of_mirror_images_flip_at_the_reference_value(family):
    flips = points(family, "flip")
    assert len(flips) == 2
    # The joint solution of the orbit and det(M + 1) = 0 in 40 digits has this value.
    for point in flips:
        assert point.value == pytest.approx(0.18705323128468188, abs=1e-12)
        assert abs(largest(point) + 1) < 1e-7
    # Both branches start at the pitchfork.
    assert [branch.values[0] for branch in family[1:]] == pytest.approx([PITCHFORK] * 2, abs=5e-8)
    # Counts of the symmetric branch, closed half way, include both halves of the orbit.
    assert [int(x[0]) for x in orbit_properties.counts(family[0].orbit[:1])] == [1, 1, 1]
    assert [int(x[0]) for x in orbit_properties.counts(family[1].orbit[-1:])] == [1, 1, 1]


def test_orbits_of_branches_are_verified_and_stable_by_their_multiplier(family):
    for branch in family:
        assert (np.asarray(branch.orbit.status) == Status.OK).all()
        assert (np.asarray(branch.orbit.residual) < 1e-13).all()
        assert np.abs(np.diff(branch.values)).max() < 0.01 * (SPAN[1] - SPAN[0])
    symmetric = family[0]
    # The branch reaches both bounds exactly.
    np.testing.assert_allclose(symmetric.values[[0, -1]], SPAN, rtol=1e-12)
    np.testing.assert_array_equal(symmetric.stable, symmetric.values > PITCHFORK)
    assert symmetric.ends == ("low", "high")


def test_branch_ends_at_a_grazing_flight(family):
    ends = points(family, "grazing flight")
    assert {branch.ends[1] for branch in family[1:]} == {"grazing flight"}
    for point in ends[:2]:
        _, u, _ = orbit_properties.orbit_path(point.orbit, samples=2001)
        turning = np.sort(np.abs(u[0][1:-1][(np.diff(u[0])[1:] * np.diff(u[0])[:-1]) <= 0]))
        # A third turning point at the wall, besides the two impacts.
        assert np.abs(turning - 0.5 * point.value).min() < 1e-6


def test_branch_passes_its_fold():
    orbits = orbit_search.find_orbits(impact_pair(0.19, None, 0.5), "RLL", guesses=32)
    (branch,) = branch_continuation.follow_orbits(orbits[:1], "d", SPAN, direction="up")
    (fold,) = (point for point in branch.points if point.kind == "fold")
    assert fold.value == pytest.approx(FOLD, abs=5e-6)
    assert abs(largest(fold) - 1) < 1e-5
    assert branch.values.max() <= fold.value
    assert branch.values[-1] < branch.values.max() - 0.001


def test_dataset_and_picture_of_a_family(family, tmp_path):
    dataset = branch_dataset.branch_dataset(family, Harvester())
    assert dataset.sizes["branch"] == len(family)
    assert dataset["d"].attrs["units"] == "1"
    first = family[0]
    np.testing.assert_allclose(
        dataset["P"][0, : len(first.values)], orbit_properties.orbit_power(first.orbit, Harvester())
    )
    assert sorted(k for k in dataset["event"].values.flat if k) == sorted(p.kind for b in family for p in b.points)
    # Marked events lie on the sheet of their branch.
    for index, branch in enumerate(family):
        for number, point in enumerate(branch.points):
            place = int(dataset["event_point"][index, number])
            assert (
                np.nanmax(np.abs(branch.orbit.impact_unknowns[place, :, 1] - point.orbit.impact_unknowns[0, :, 1]))
                < 0.02
            )
    plots.save(plots.branches(dataset), tmp_path / "branches.png")
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
def test_bad_input_raises(family, change, message):
    start = family[0].orbit[len(family[0].values) // 2 :][:1]
    with pytest.raises(ValueError, match=message):
        branch_continuation.follow_orbits(start, **{"along": "d", "within": SPAN} | change)


def test_switching_at_a_grazing_raises(family):
    with pytest.raises(ValueError, match="point must be a flip"):
        branch_switching.switch_branch(points(family, "grazing flight")[0], "d", SPAN)


DEVICE = Harvester(s=0.2, omega0=60.0, beta=0.01)
OTHER = {"omega": 3.3, "omega0": 70.0, "k": 10.0, "s": 0.21, "A": 1.2, "beta": -0.02}


@pytest.mark.parametrize("along", OTHER)
@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_device_parameter_changes_the_pair_as_it_changes_the_device(along, wall):
    pair = DEVICE.pair(wall)
    assert float(continuation_parameter.value_at(DEVICE.pair(), along, DEVICE)) == pytest.approx(
        getattr(DEVICE, along), rel=1e-14
    )
    if wall == "rigid" and along in ("omega0", "k"):
        return
    moved = continuation_parameter.pair_at(pair, along, OTHER[along], DEVICE)
    for actual, expected in zip(
        jax.tree.leaves(moved), jax.tree.leaves(with_constants(DEVICE, **{along: OTHER[along]}).pair(wall)), strict=True
    ):
        assert float(actual) == pytest.approx(float(expected), rel=1e-14, abs=1e-17)


@pytest.mark.long
def test_branch_along_the_forcing_changes_gap_and_gravity():
    orbits = orbit_search.find_orbits(DEVICE.pair("rigid"), "RL", guesses=32)
    (branch,) = branch_continuation.follow_orbits(orbits[:1], "A", (1, 2), device=DEVICE, direction="up", points=8)
    assert branch.values[0] == pytest.approx(1.0, abs=1e-14)
    assert branch.values[-1] > 1.004
    assert (np.asarray(branch.orbit.status) == Status.OK).all()
    shaken = with_constants(DEVICE, A=jnp.asarray(branch.values)).pair("rigid")
    np.testing.assert_allclose(branch.orbit.pair.d, shaken.d, rtol=1e-14)
    np.testing.assert_allclose(branch.orbit.pair.gamma, shaken.gamma, rtol=1e-14)
    table = branch_dataset.branch_dataset([branch], DEVICE)
    assert table["A"].attrs["units"] == "m s-2"
    last = with_constants(DEVICE, A=float(branch.values[-1]))
    assert float(table["P"][0, -1]) == pytest.approx(
        float(orbit_properties.orbit_power(branch.orbit[-1:], last)[0]), rel=1e-12
    )


@pytest.mark.long
def test_branches_can_be_followed_from_their_folds():
    """Orbits near a fold do not have its parameter. Newton alone fails at most of these folds of slow impacts."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    folds = points(branch_continuation.follow_orbits(lower, "d", (0.2, 0.3)), "fold")
    (curve,) = curves.follow_curves(folds, "d", {"d": (0.15, 0.3), "kappa": (20.0, 400.0)})
    starts = curve.orbit[::10]
    for branch, d in zip(branch_continuation.follow_orbits(starts, "d", (0.15, 0.3)), starts.pair.d, strict=True):
        assert set(branch.ends) == {"grazing impact", "high"}
        assert np.abs(branch.values - d).min() < 1e-14


@pytest.mark.parametrize("kappa", [None, pytest.param(40.0, marks=pytest.mark.long)])
def test_branch_from_a_bound_remains_within_the_bounds(kappa):
    """Regression: rounding put the start outside of the bound, and the branch continued outside."""
    start = orbit_search.find_orbits(impact_pair(0.2, kappa, 0.5), "RL", guesses=32)[:1]
    for within, end in (((0.2, 0.25), "low"), ((0.15, 0.2), "high")):
        (branch,) = branch_continuation.follow_orbits(start, "d", within)
        at_start = [
            reason for reason, d in zip(branch.ends, branch.values[[0, -1]], strict=True) if d == pytest.approx(0.2)
        ]
        assert end in at_start
        assert within[0] <= branch.values.min() < branch.values.max() <= within[1]
        assert np.abs(np.diff(branch.values)).min() > 0


def test_pitchfork_is_distinguished_from_a_fold_at_low_accuracy():
    """At this gap Newton leaves the mirror images 1.07e-4 apart at the pitchfork. Both branches classify it alike."""
    start = orbit_search.find_orbits(impact_pair(0.23572947460946414, None, 0.5), "RL", guesses=64)
    branches = branch_switching.follow_families(start, "r", (0.15, 0.9))
    assert {"fold"}.isdisjoint(point.kind for branch in branches for point in branch.points)
    (pairs,) = (branch for branch in branches if not bool(branch.orbit.sequence.mirrored[0]))
    (simple,) = (branch for branch in branches if bool(branch.orbit.sequence.mirrored[0]) and branch.points)
    (of_pairs,), (of_simple,) = points([pairs], "pitchfork"), points([simple], "pitchfork")
    assert of_pairs.value == pytest.approx(of_simple.value, abs=1e-14)
    # Orbits closed half way have the width of full orbits, so that both use the same programs.
    assert {branch.orbit.impact_unknowns.shape[1] for branch in branches} == {2}
    assert {int(branch.orbit.count[0]) for branch in branches} == {1, 2}


def test_orbit_closed_half_way_folds_where_a_multiplier_passes_1():
    """Regression: a step from speed zero hid the turn of the branch; the fold was classified as a pitchfork (at -1)."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    paths, y = branch_continuation.validated_branch_paths(lower, "d", SPAN, None, ContinuationSettings())
    path = jax.tree.map(lambda leaf: leaf[0], paths)
    for test, kind in (("plus", "fold"), ("fold", "fold"), ("minus", "pitchfork")):
        event = branch_events.BranchEvent(0, 0.0, test, y[0])
        assert branch_events.classify_event(path, event, np.repeat(y, 2, axis=0), ContinuationSettings()) == kind


@pytest.mark.parametrize("r", [pytest.param(0.479, marks=pytest.mark.long), 0.48])
def test_two_events_within_a_single_arclength_step_are_both_located(r):
    """The flip and the graze are closer than a step (2e-3). Unstable orbits lie between them."""
    orbits = orbit_search.find_orbits(impact_pair(0.2, None, r), "RL", guesses=256)
    start = orbits[np.flatnonzero(~symmetry.is_symmetric(orbits))][:1]
    (branch,) = branch_continuation.follow_orbits(start, "d", SPAN, direction="down")
    flip, graze = branch.points
    assert (flip.kind, graze.kind) == ("flip", "grazing flight")
    assert 0 < flip.value - graze.value < 1e-3
    between = (branch.values > graze.value) & (branch.values < flip.value)
    assert between.any()
    assert not branch.stable[between].any()
    fine = ContinuationSettings(max_step=1e-4, first_step=1e-5)
    (refined,) = branch_continuation.follow_orbits(
        branch.orbit[np.flatnonzero(between)[:1]], "d", SPAN, settings=fine, points=300
    )
    expected = {point.kind: point.value for point in refined.points}
    for point in (flip, graze):
        assert point.value == pytest.approx(expected[point.kind], abs=1e-12)


def test_family_ends_where_an_impact_speed_is_zero():
    """The branch of the lower 1:1 orbit ends in impacts of speed zero, where both multipliers are 1: no pitchfork."""
    half = Sequence(jnp.array([[1]], jnp.int32), jnp.array([1.0]), jnp.array([True]))
    lower = periodic.solve(impact_pair([0.28], 120.0, 0.6), half, jnp.array([[[0.96, 0.13, 0.03]]]))
    (branch,) = branch_switching.follow_families(lower, "d", (0.2, 0.3))
    graze, fold = branch.points
    assert (graze.kind, fold.kind) == ("grazing impact", "fold")
    assert float(np.abs(graze.orbit.impact_unknowns[0, 0, 1])) < 1e-15
    assert fold.value < graze.value
    assert graze.value == pytest.approx(2 / np.pi**2, rel=1e-12, abs=0)
