"""Least periods: an orbit of equal turns is reduced to one turn, and a doubled orbit near its flip keeps two turns."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

import vijax
from benchmarks.malformed import an_optimum
from vijax.continuation import branch_continuation, branch_switching
from vijax.continuation.curves import curves
from vijax.design.robustness import surroundings
from vijax.model.device import with_pair
from vijax.model.records import Status
from vijax.orbits import orbit_properties, periodic, symmetry
from vijax.orbits.shooting import Sequence

# A design with a flip of its orbit 0.0276 % above its omega0.
DESIGN = vijax.impact_pair(0.15732421504313743, 20.013249789049155, 0.653, 0.0391)
STATE = -0.00152826, 0.26755233
DISTANCES = 10.0 ** -np.arange(3.0, 9.0)


def label(orbit):
    return [tuple(map(int, counts)) for counts in np.transpose(orbit_properties.counts(orbit))]


@pytest.fixture(scope="module")
def single_turn():
    return vijax.orbits_from_states(DESIGN, *STATE)


@pytest.mark.parametrize("period", [2, pytest.param(4, marks=pytest.mark.long)])
def test_orbit_with_a_multiple_of_its_period_is_reduced(single_turn, period):
    orbit = vijax.orbits_from_states(DESIGN, *STATE, period=period)
    assert (float(orbit.sequence.span[0]), int(orbit.count[0]), int(orbit.status[0])) == (2.0, 2, Status.OK)
    np.testing.assert_allclose(orbit.impact_unknowns[0, :2], single_turn.impact_unknowns[0], rtol=0, atol=1e-12)
    assert np.isnan(orbit.impact_unknowns[0, 2:]).all()
    np.testing.assert_allclose(orbit.depth[0, :2], single_turn.depth[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(orbit.multipliers, single_turn.multipliers, rtol=0, atol=1e-9)


def test_branch_from_two_turns_of_an_orbit_locates_the_flip(single_turn):
    two_turns = symmetry.double(single_turn)
    assert float(two_turns.sequence.span[0]) == 4.0
    (branch,) = branch_continuation.follow_orbits(two_turns, "kappa", (19.9, 20.1), direction="up", points=40)
    (flip,) = branch.points
    assert flip.kind == "flip"
    assert flip.value == pytest.approx(1.0002761314384 * float(DESIGN.kappa), rel=1e-11)
    assert float(branch.orbit.sequence.span[0]) == 2.0


@functools.cache
def flip_along(along):
    """Return a flip, a doubled orbit and its parameter, along "kappa" of soft walls or "d" of rigid walls."""
    if along == "kappa":
        single_turn = vijax.orbits_from_states(DESIGN, *STATE)
        (branch,) = branch_continuation.follow_orbits(single_turn, "kappa", (19.9, 20.1), direction="up", points=40)
    else:
        (branch,) = branch_continuation.follow_orbits(rigid_orbit(), "d", (0.18, 0.19), direction="down")
    (flip,) = branch.points
    doubled = branch_switching.switch_branch(flip, along, (0.9 * flip.value, 1.1 * flip.value), points=8)[0]
    return flip, doubled.orbit[-1:], float(doubled.values[-1])


def rigid_orbit():
    return vijax.find_orbits(vijax.impact_pair(0.19, None, 0.5), "RLL", guesses=32)[:1]


def guess_doubled_orbits(flip, doubled, share):
    """Guess doubled orbits near a flip.

    The part that is odd from turn to turn scales with the root of the distance, the even part with the distance.
    """
    two_turns = symmetry.double(flip.orbit)
    deviation = np.nan_to_num(np.asarray(doubled.impact_unknowns) - np.asarray(two_turns.impact_unknowns))
    deviation[..., 0] -= np.round(
        deviation[..., 0]
    )  # The first turn of either orbit may be the second turn of the other.
    swapped = np.roll(deviation, deviation.shape[1] // 2, axis=1)
    wide = share[:, None, None]
    guess = (
        np.nan_to_num(np.asarray(two_turns.impact_unknowns))
        + wide * (deviation - swapped) / 2
        + wide**2 * (deviation + swapped) / 2
    )
    rows = jax.tree.map(
        lambda leaf: np.repeat(np.asarray(leaf), len(share), axis=0), (two_turns.pair, two_turns.sequence)
    )
    return *rows, guess


@pytest.mark.long
@pytest.mark.parametrize("along", ["kappa", "d"])
def test_doubled_orbits_and_two_equal_turns_are_distinguished_near_a_flip(along):
    """Relative distances from the flip are 1e-3 to 1e-8; turns of the doubled orbit differ by 1e-2 to 4e-5 there."""
    flip, doubled, place = flip_along(along)
    distance, scale = (x.ravel() for x in np.meshgrid(DISTANCES, (0.8, 1.0, 1.2), indexing="ij"))
    share = np.sqrt(distance * flip.value / abs(place - flip.value))
    pair, walls, guess = guess_doubled_orbits(flip, doubled, scale * share)
    for on_doubled_side in (True, False):
        sign = np.sign(place - flip.value) * (1 if on_doubled_side else -1)
        values = flip.value * (1 + sign * distance)
        orbits = periodic.solve(dataclasses.replace(pair, **{along: values}), walls, guess)
        converged = np.asarray(orbits.status) == Status.OK
        period, largest = 0.5 * np.asarray(orbits.sequence.span), np.asarray(orbits.multipliers)[:, 0].real
        # On the doubled side Newton converges to either orbit; the orbit of one turn has a multiplier below -1 there.
        is_doubled = converged & (period == 2)
        assert is_doubled.reshape(len(DISTANCES), -1).any(axis=1).all() if on_doubled_side else not is_doubled.any()
        assert converged.reshape(len(DISTANCES), -1).any(axis=1).all()
        assert ((largest[is_doubled] > 0) & (largest[is_doubled] < 1)).all()
        assert (largest[converged & ~is_doubled] < -1 if on_doubled_side else largest[converged] > -1).all()
        assert (largest[converged & ~is_doubled] < 0).all()
        for selected in (is_doubled, converged & ~is_doubled):
            ratio = np.abs(np.abs(largest[selected]) - 1) / distance[selected]
            assert not selected.any() or ratio.max() / ratio.min() < 1.5


def test_orbit_of_three_half_turns_is_reduced_to_a_half_turn():
    half = Sequence(np.array([[1]], np.int32), np.array([1.0]), np.array([True]))
    single_turn = periodic.solve(vijax.impact_pair([0.28], None, 0.5), half, np.array([[[0.15, 0.5, 0.0]]]))
    walls = Sequence(np.array([[1, -1, 1]], np.int32), np.array([3.0]), np.array([True]))
    later = np.arange(3.0)[:, None] * np.array([1.0, 0.0, 0.0])
    orbit = periodic.solve(single_turn.pair, walls, np.asarray(single_turn.impact_unknowns) + later)
    assert (float(orbit.sequence.span[0]), int(orbit.count[0])) == (1.0, 1)
    np.testing.assert_allclose(orbit.impact_unknowns[0, 0], single_turn.impact_unknowns[0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(orbit.multipliers, single_turn.multipliers, rtol=0, atol=1e-12)


@pytest.mark.long
def test_search_returns_distinct_orbits_with_their_least_periods():
    """At this gap both orbits of a mirror pair have just doubled; the symmetric orbit between them never doubles."""
    orbits = vijax.find_orbits(vijax.impact_pair(0.1868, None, 0.5), "RLRL", 2, guesses=1024)
    spans = np.asarray(orbits.sequence.span)
    assert sorted(spans) == [2.0, 2.0, 2.0, 4.0, 4.0]
    assert symmetry.is_symmetric(orbits).tolist() == (np.asarray(orbits.multipliers)[:, 0].real > 1).tolist()
    assert sorted(label(orbits)) == [(1, 1, 1)] * 3 + [(2, 2, 2)] * 2
    assert np.abs(orbits.multipliers[:, 0])[spans == 4].max() < 1


@pytest.fixture(scope="module")
def doubled_branch():
    _, doubled, place = flip_along("d")
    return branch_continuation.follow_orbits(doubled, "d", (place - 2e-4, 0.2), direction="both")[0]


def test_branch_of_doubled_orbits_locates_its_flip_to_rounding(doubled_branch):
    """Both turns are equal at the flip and Newton is singular. The search uses one turn; two turns reach only 1e-11."""
    flip = flip_along("d")[0]
    (point,) = doubled_branch.points
    assert point.kind == "flip"
    assert point.value == pytest.approx(flip.value, abs=1e-14)
    assert float(point.orbit.sequence.span[0]) == 2.0
    assert complex(point.orbit.multipliers[0, 0]) == pytest.approx(-1, abs=1e-9)
    # The dataset marks the flip at the point of the branch where both turns are equal.
    table = vijax.branch_dataset([doubled_branch])
    place = int(table["event_point"][0, 0])
    assert abs(doubled_branch.values[place] - flip.value) == np.abs(doubled_branch.values - flip.value).min()


@pytest.mark.long
def test_curve_starts_at_the_flip_of_a_doubled_branch(doubled_branch):
    """No curve can be followed from two equal turns of an orbit."""
    (curve,) = curves.follow_curves(doubled_branch.points, "d", {"d": (0.18, 0.19), "r": (0.49, 0.51)})
    assert (curve.kind, float(curve.orbit.sequence.span[0])) == ("flip", 2.0)


@pytest.mark.long
def test_family_does_not_switch_back_at_the_flip_of_its_branch():
    _, doubled, place = flip_along("d")
    branches = branch_switching.follow_families(doubled, "d", (place - 2e-4, 0.2))
    assert len(branches) == 1
    assert [point.kind for point in branches[0].points] == ["flip"]


@pytest.mark.long
def test_the_first_bifurcation_above_a_design_is_its_flip(single_turn):
    device = with_pair(vijax.Harvester(A=3.82897, omega=11.33991), DESIGN)
    design = dataclasses.replace(an_optimum(), orbit=symmetry.double(single_turn), device=device)
    edge = surroundings._find_bifurcation(design, "up", 0.01)
    assert (edge.kind, round(edge.percent, 4)) == ("flip", 0.0276)
