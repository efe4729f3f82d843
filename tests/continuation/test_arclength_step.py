"""Single predictor-corrector steps along paths of orbits."""

import numpy as np
import pytest

import vijax
from vijax.continuation.arclength_step import PathPoints, place_before_end, predict_and_correct
from vijax.continuation.branch_continuation import make_branch_paths
from vijax.continuation.branch_equations import start_points


@pytest.fixture(scope="module")
def branch_start():
    """Return the paths of a branch of one orbit along kappa, and its start point."""
    orbit = vijax.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5), "1:1", guesses=64)[:1]
    value, none = np.array([40.0]), np.zeros(1)
    paths, y = make_branch_paths(orbit, "kappa", value, none, (value - 37, value + 360), vijax.ContinuationSettings())
    return paths, start_points(paths, y)


@pytest.mark.parametrize("length", [0.5, 1.0])
def test_events_are_not_searched_where_newton_diverges(branch_start, length):
    # At the longer step the impact unknowns are 10^8 half periods apart; a search between them would take minutes.
    paths, first = branch_start
    step = predict_and_correct(paths, first.y, first.tangent, np.full(1, length))
    assert not step.converged[0]
    assert np.abs(step.y).max() > 10
    assert np.isnan(step.tests).all()


def test_start_at_an_end_is_placed_just_before_the_end():
    """Rounding puts the second start past its graze and gives its multipliers a sign; the third start is at a fold."""
    clear, graze = [0.5, 0.5, 2.0, 0.3], [0.5, -1e-12, 2.0, -1e-17]
    fold, past = [0.5, 1e-13, 2.0, 0.3], [0.5, 0.5, 1e-3, -1e-3]
    tests = np.array([clear, graze, fold, past])
    zero = np.zeros((4, 1))
    placed = place_before_end(PathPoints(zero, zero, tests, zero, zero), 2).tests
    assert np.isnan(placed[1, 1])
    assert 0 < placed[1, 3] < 1e-300
    same = np.ones((4, 4), bool)
    same[1, [1, 3]] = False
    np.testing.assert_array_equal(placed[same], tests[same])
