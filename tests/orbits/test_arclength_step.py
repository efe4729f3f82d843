"""Steps along paths of orbits, one at a time."""

import numpy as np
import pytest

import vijax
from vijax.orbits.arclength_step import BranchPlace, advance, settled
from vijax.orbits.branch_path import upwards
from vijax.orbits.continuation import arcs_from


@pytest.fixture(scope="module")
def begun():
    """A branch along kappa, of one orbit, and the place on it where it begins."""
    orbit = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5), "1:1", guesses=64)[:1]
    value, none = np.array([40.0]), np.zeros(1)
    arcs, y = arcs_from(orbit, "kappa", value, none, (value - 37, value + 360), vijax.ContinuationSettings())
    return arcs, upwards(arcs, y)


@pytest.mark.parametrize("length", [0.5, 1.0])
def test_nothing_is_searched_where_newton_goes_astray(begun, length):
    # Of the longer step knots are 10^8 half periods apart: a search between these would take minutes.
    arcs, first = begun
    there = advance(arcs, first.y, first.tangent, np.full(1, length))
    assert not there.arrived[0]
    assert np.abs(there.y).max() > 10
    assert np.isnan(there.tests).all()


def test_a_start_at_an_end_is_just_before_it_and_knows_of_nothing_else_that_vanishes():
    """Rounding has the second start beyond its graze, and gives its multipliers signs; the third is at a fold."""
    clear, graze = [0.5, 0.5, 2.0, 0.3], [0.5, -1e-12, 2.0, -1e-17]
    fold, beyond = [0.5, 1e-13, 2.0, 0.3], [0.5, 0.5, 1e-3, -1e-3]
    tests = np.array([clear, graze, fold, beyond])
    zero = np.zeros((4, 1))
    found = settled(BranchPlace(zero, zero, tests, zero, zero), 2).tests
    assert np.isnan(found[1, 1])
    assert 0 < found[1, 3] < 1e-300
    same = np.ones((4, 4), bool)
    same[1, [1, 3]] = False
    np.testing.assert_array_equal(found[same], tests[same])
