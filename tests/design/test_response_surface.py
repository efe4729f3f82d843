"""Surfaces recover what made them: polynomials with noise, and planes below or beneath a share of points."""

import numpy as np
import pytest
from scipy.optimize import linprog

from vijax.design.ensemble import pairs
from vijax.design.response_surface import fit, unknown

SLOPE, BEND = np.array([-2.5, 0.7]), np.array([[3.0, -1.0], [-1.0, 2.0]])


def ensemble(noise, balls=512, radius=0.02):
    """Balls about a point where the logarithm of P is a polynomial of second order."""
    x = radius * pairs(balls, 2)
    rise = x @ SLOPE + 0.5 * ((x @ BEND) * x).sum(axis=1)
    return x, 1e-5 * np.exp(rise + noise * np.random.default_rng(3).standard_normal(balls))


def test_pairs_are_opposite_and_even_and_no_two_balls_are_in_one_place():
    some = pairs(64, 3)
    np.testing.assert_array_equal(some[:32], -some[32:])
    for column in some.T:
        np.testing.assert_allclose(np.sort(column), (2 * np.arange(64) + 1) / 64 - 1)


def test_a_smooth_average_is_recovered_with_its_slopes():
    x, P = ensemble(0.0)
    found = fit(x, P, np.ones((len(x), 2)))
    assert found.value == pytest.approx(np.log(1e-5), abs=1e-6)
    np.testing.assert_allclose(found.gradient, SLOPE, rtol=2e-3)
    # Of third order in the radius is what P has beyond a polynomial of second order.
    np.testing.assert_allclose(found.curvature, BEND, atol=0.02)


def test_standard_errors_are_those_of_repeated_fits():
    rng, x = np.random.default_rng(1), ensemble(0.0)[0]
    slopes, errors = [], []
    for _ in range(200):
        found = fit(x, 1 + x @ SLOPE + 0.01 * rng.standard_normal(len(x)), np.ones((len(x), 1)))
        slopes.append(found.gradient)
        errors.append(found.gradient_error)
    np.testing.assert_allclose(np.mean(errors, axis=0), np.std(slopes, axis=0), rtol=0.2)
    np.testing.assert_allclose(np.mean(slopes, axis=0), SLOPE, atol=4 * np.mean(errors) / np.sqrt(200))


def test_no_ball_has_less_room_than_the_plane_says_and_a_share_of_them_has():
    x, P = ensemble(0.0, balls=400)
    bound = 0.1 + x @ np.array([1.6, -0.4])
    room = bound + 0.01 * np.random.default_rng(2).exponential(size=len(x))
    whole = fit(x, P, room[:, None])
    plane = whole.margins[0] + x @ whole.slopes[0]
    assert (plane <= room + 1e-9).all()
    assert (plane >= bound - 2e-3).all()
    np.testing.assert_allclose(whole.slopes[0], [1.6, -0.4], atol=0.02)
    most = fit(x, P, room[:, None], share=0.9)
    below = room < most.margins[0] + x @ most.slopes[0] - 1e-12
    assert below.mean() == pytest.approx(0.1, abs=0.02)


def test_a_line_below_all_balls_is_that_of_a_linear_program():
    rng = np.random.default_rng(7)
    for count in (9, 64):
        x, room = rng.uniform(-0.02, 0.02, (count, 1)), rng.uniform(0, 1, count)
        terms = np.column_stack([np.ones(count), x])
        best = linprog(-terms.mean(axis=0), A_ub=terms, b_ub=room, bounds=[(None, None)] * 2, method="highs").x
        found = fit(x, np.ones(count), room[:, None])
        np.testing.assert_allclose([found.margins[0], found.slopes[0, 0]], best, rtol=1e-6, atol=1e-6)
    level = fit(np.full((9, 1), 0.01), np.ones(9), np.arange(1.0, 10.0)[:, None])
    assert (level.margins[0], level.slopes[0, 0]) == (1, 0)


def test_what_is_unknown_is_worth_less_than_anything():
    assert unknown(2).worth(np.zeros(2), 2.5) == -np.inf
    x, P = ensemble(0.0)
    broken = fit(x, P, np.full((len(x), 1), -0.1))
    assert broken.worth(np.zeros(2), 2.5) == pytest.approx(np.log(1e-5) - 0.25, abs=1e-6)
