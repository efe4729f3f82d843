"""Least periods: an orbit that consists of equal turns is one turn, and a doubled orbit beside its flip is two."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

import vijax
from benchmarks.malformed import an_optimum
from vijax.design import robustness
from vijax.model.device import with_pair
from vijax.model.records import Status
from vijax.orbits import continuation, curves, orbit_properties, periodic, switching, symmetry
from vijax.orbits.shooting import Sequence

# A design whose orbit flips 0.0276 % above its omega0.
DESIGN = vijax.impact_pair(0.15732421504313743, 20.013249789049155, 0.653, 0.0391)
STATE = -0.00152826, 0.26755233
DISTANCES = 10.0 ** -np.arange(3.0, 9.0)


def label(orbit):
    return [tuple(map(int, one)) for one in np.transpose(orbit_properties.counts(orbit))]


@pytest.fixture(scope="module")
def once():
    return vijax.orbits_from_states(DESIGN, *STATE)


@pytest.mark.parametrize("period", [2, pytest.param(4, marks=pytest.mark.long)])
def test_an_orbit_found_with_a_multiple_of_its_period_is_reduced(once, period):
    found = vijax.orbits_from_states(DESIGN, *STATE, period=period)
    assert (float(found.sequence.span[0]), int(found.count[0]), int(found.status[0])) == (2.0, 2, Status.OK)
    np.testing.assert_allclose(found.knots[0, :2], once.knots[0], rtol=0, atol=1e-12)
    assert np.isnan(found.knots[0, 2:]).all()
    np.testing.assert_allclose(found.depth[0, :2], once.depth[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.multipliers, once.multipliers, rtol=0, atol=1e-9)


def test_a_branch_of_an_orbit_that_was_run_through_twice_meets_the_flip(once):
    twice = symmetry.doubled(once)
    assert float(twice.sequence.span[0]) == 4.0
    (branch,) = continuation.follow(twice, "kappa", (19.9, 20.1), direction="up", points=40)
    (flip,) = branch.points
    assert flip.kind == "flip"
    assert flip.value == pytest.approx(1.0002761314384 * float(DESIGN.kappa), rel=1e-11)
    assert float(branch.orbit.sequence.span[0]) == 2.0


@functools.cache
def flip_along(along):
    """Return a flip, an orbit of the doubled branch and the parameter of this orbit: "kappa" soft, "d" rigid walls."""
    if along == "kappa":
        once = vijax.orbits_from_states(DESIGN, *STATE)
        (branch,) = continuation.follow(once, "kappa", (19.9, 20.1), direction="up", points=40)
    else:
        (branch,) = continuation.follow(rigid_orbit(), "d", (0.18, 0.19), direction="down")
    (flip,) = branch.points
    doubled = switching.switch(flip, along, (0.9 * flip.value, 1.1 * flip.value), points=8)[0]
    return flip, doubled.orbit[-1:], float(doubled.values[-1])


def rigid_orbit():
    return vijax.find_orbits(vijax.impact_pair(0.19, None, 0.5), "RLL", guesses=32)[:1]


def beside(flip, doubled, share):
    """Guess doubled orbits: what is odd from turn to turn goes as the root of the distance, what is even as that."""
    twice = symmetry.doubled(flip.orbit)
    away = np.nan_to_num(np.asarray(doubled.knots) - np.asarray(twice.knots))
    away[..., 0] -= np.round(away[..., 0])  # Either may begin with the other's second turn.
    swapped = np.roll(away, away.shape[1] // 2, axis=1)
    wide = share[:, None, None]
    guess = np.nan_to_num(np.asarray(twice.knots)) + wide * (away - swapped) / 2 + wide**2 * (away + swapped) / 2
    rows = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), len(share), axis=0), (twice.pair, twice.sequence))
    return *rows, guess


@pytest.mark.long
@pytest.mark.parametrize("along", ["kappa", "d"])
def test_doubled_orbits_and_two_turns_of_one_orbit_are_distinguished_on_both_sides_of_a_flip(along):
    """At relative distances of 1e-3 to 1e-8 from the flip, where turns of the doubled orbit differ by 1e-2 to 4e-5."""
    flip, doubled, place = flip_along(along)
    distance, scale = (x.ravel() for x in np.meshgrid(DISTANCES, (0.8, 1.0, 1.2), indexing="ij"))
    share = np.sqrt(distance * flip.value / abs(place - flip.value))
    pair, walls, guess = beside(flip, doubled, scale * share)
    for beyond in (True, False):
        sign = np.sign(place - flip.value) * (1 if beyond else -1)
        values = flip.value * (1 + sign * distance)
        found = periodic.solve(dataclasses.replace(pair, **{along: values}), walls, guess)
        known = np.asarray(found.status) == Status.OK
        period, largest = 0.5 * np.asarray(found.sequence.span), np.asarray(found.multipliers)[:, 0].real
        # Beyond the flip Newton may come to either orbit; that of one turn has a multiplier below -1 there.
        two = known & (period == 2)
        assert two.reshape(len(DISTANCES), -1).any(axis=1).all() if beyond else not two.any()
        assert known.reshape(len(DISTANCES), -1).any(axis=1).all()
        assert ((largest[two] > 0) & (largest[two] < 1)).all()
        assert (largest[known & ~two] < -1 if beyond else largest[known] > -1).all()
        assert (largest[known & ~two] < 0).all()
        for some in (two, known & ~two):
            away = np.abs(np.abs(largest[some]) - 1) / distance[some]
            assert not some.any() or away.max() / away.min() < 1.5


def test_an_orbit_closed_half_way_after_three_half_turns_is_closed_after_one():
    half = Sequence(np.array([[1]], np.int32), np.array([1.0]), np.array([True]))
    once = periodic.solve(vijax.impact_pair([0.28], None, 0.5), half, np.array([[[0.15, 0.5, 0.0]]]))
    walls = Sequence(np.array([[1, -1, 1]], np.int32), np.array([3.0]), np.array([True]))
    later = np.arange(3.0)[:, None] * np.array([1.0, 0.0, 0.0])
    found = periodic.solve(once.pair, walls, np.asarray(once.knots) + later)
    assert (float(found.sequence.span[0]), int(found.count[0])) == (1.0, 1)
    np.testing.assert_allclose(found.knots[0, 0], once.knots[0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.multipliers, once.multipliers, rtol=0, atol=1e-12)


@pytest.mark.long
def test_a_search_finds_orbits_of_a_lesser_period_at_that_period_and_each_once():
    """At this gap both orbits of a mirror pair have just doubled; the symmetric one between them never does."""
    found = vijax.find_orbits(vijax.impact_pair(0.1868, None, 0.5), "RLRL", 2, guesses=1024)
    spans = np.asarray(found.sequence.span)
    assert sorted(spans) == [2.0, 2.0, 2.0, 4.0, 4.0]
    assert symmetry.symmetric(found).tolist() == (np.asarray(found.multipliers)[:, 0].real > 1).tolist()
    assert sorted(label(found)) == [(1, 1, 1)] * 3 + [(2, 2, 2)] * 2
    assert np.abs(found.multipliers[:, 0])[spans == 4].max() < 1


@pytest.fixture(scope="module")
def doubled_branch():
    _, doubled, place = flip_along("d")
    return continuation.follow(doubled, "d", (place - 2e-4, 0.2), direction="both")[0]


def test_a_branch_of_doubled_orbits_knows_its_flip_as_well_as_that_of_the_simple_one(doubled_branch):
    """Both turns become one there: Newton is singular, and came to 1e-11 before the place was sought on one turn."""
    flip = flip_along("d")[0]
    (met,) = doubled_branch.points
    assert met.kind == "flip"
    assert met.value == pytest.approx(flip.value, abs=1e-14)
    assert float(met.orbit.sequence.span[0]) == 2.0
    assert complex(met.orbit.multipliers[0, 0]) == pytest.approx(-1, abs=1e-9)
    # The mark of the flip lies on the branch where both turns are one.
    table = vijax.branch_dataset([doubled_branch])
    place = int(table["event_point"][0, 0])
    assert abs(doubled_branch.values[place] - flip.value) == np.abs(doubled_branch.values - flip.value).min()


@pytest.mark.long
def test_a_curve_begins_at_the_flip_that_doubled_orbits_meet(doubled_branch):
    """Of two turns that are one no curve could be followed."""
    (curve,) = curves.follow_curves(doubled_branch.points, "d", {"d": (0.18, 0.19), "r": (0.49, 0.51)})
    assert (curve.kind, float(curve.orbit.sequence.span[0])) == ("flip", 2.0)


@pytest.mark.long
def test_a_family_does_not_switch_back_to_the_branch_that_has_met_the_flip():
    _, doubled, place = flip_along("d")
    branches = switching.family(doubled, "d", (place - 2e-4, 0.2))
    assert len(branches) == 1
    assert [point.kind for point in branches[0].points] == ["flip"]


@pytest.mark.long
def test_the_first_bifurcation_above_a_design_is_its_flip(once):
    device = with_pair(vijax.Harvester(A=3.82897, omega=11.33991), DESIGN)
    design = dataclasses.replace(an_optimum(), orbit=symmetry.doubled(once), device=device)
    edge = robustness._edge(design, "up", 0.01)
    assert (edge.kind, round(edge.percent, 4)) == ("flip", 0.0276)
