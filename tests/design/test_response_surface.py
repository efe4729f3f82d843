"""Fits recover known surfaces: polynomials with noise, and planes below all samples or below a share of them."""

import numpy as np
import pytest
from scipy.optimize import linprog

from vijax.design.aperiodic.ensemble import draw_opposite_offsets
from vijax.design.aperiodic.response_surface import fit_surface, lowest_surface

SLOPE, BEND = np.array([-2.5, 0.7]), np.array([[3.0, -1.0], [-1.0, 2.0]])


def ensemble(noise, samples=512, radius=0.02):
    """Return samples about a point where the logarithm of P is a polynomial of second order."""
    x = radius * draw_opposite_offsets(samples, 2)
    rise = x @ SLOPE + 0.5 * ((x @ BEND) * x).sum(axis=1)
    return x, 1e-5 * np.exp(rise + noise * np.random.default_rng(3).standard_normal(samples))


def test_sample_offsets_are_opposite_pairs_with_even_spacing():
    offsets = draw_opposite_offsets(64, 3)
    np.testing.assert_array_equal(offsets[:32], -offsets[32:])
    for column in offsets.T:
        np.testing.assert_allclose(np.sort(column), (2 * np.arange(64) + 1) / 64 - 1)


def test_a_smooth_average_is_recovered_with_its_slopes():
    x, P = ensemble(0.0)
    surface = fit_surface(x, P, np.ones((len(x), 2)))
    assert surface.value == pytest.approx(np.log(1e-5), abs=1e-6)
    np.testing.assert_allclose(surface.gradient, SLOPE, rtol=2e-3)
    # The error of the curvature comes from terms of P of third order in the radius.
    np.testing.assert_allclose(surface.curvature, BEND, atol=0.02)


def test_standard_errors_agree_with_repeated_fits():
    rng, x = np.random.default_rng(1), ensemble(0.0)[0]
    slopes, errors = [], []
    for _ in range(200):
        surface = fit_surface(x, 1 + x @ SLOPE + 0.01 * rng.standard_normal(len(x)), np.ones((len(x), 1)))
        slopes.append(surface.gradient)
        errors.append(surface.gradient_error)
    np.testing.assert_allclose(np.mean(errors, axis=0), np.std(slopes, axis=0), rtol=0.2)
    np.testing.assert_allclose(np.mean(slopes, axis=0), SLOPE, atol=4 * np.mean(errors) / np.sqrt(200))


def test_plane_lies_below_all_margins_or_below_a_share_of_them():
    x, P = ensemble(0.0, samples=400)
    bound = 0.1 + x @ np.array([1.6, -0.4])
    margin = bound + 0.01 * np.random.default_rng(2).exponential(size=len(x))
    full_fit = fit_surface(x, P, margin[:, None])
    plane = full_fit.margins[0] + x @ full_fit.slopes[0]
    assert (plane <= margin + 1e-9).all()
    assert (plane >= bound - 2e-3).all()
    np.testing.assert_allclose(full_fit.slopes[0], [1.6, -0.4], atol=0.02)
    share_fit = fit_surface(x, P, margin[:, None], share=0.9)
    below = margin < share_fit.margins[0] + x @ share_fit.slopes[0] - 1e-12
    assert below.mean() == pytest.approx(0.1, abs=0.02)


def test_line_below_all_margins_agrees_with_a_linear_program():
    rng = np.random.default_rng(7)
    for count in (9, 64):
        x, margin = rng.uniform(-0.02, 0.02, (count, 1)), rng.uniform(0, 1, count)
        terms = np.column_stack([np.ones(count), x])
        best = linprog(-terms.mean(axis=0), A_ub=terms, b_ub=margin, bounds=[(None, None)] * 2, method="highs").x
        surface = fit_surface(x, np.ones(count), margin[:, None])
        np.testing.assert_allclose([surface.margins[0], surface.slopes[0, 0]], best, rtol=1e-6, atol=1e-6)
    level = fit_surface(np.full((9, 1), 0.01), np.ones(9), np.arange(1.0, 10.0)[:, None])
    assert (level.margins[0], level.slopes[0, 0]) == (1, 0)


def test_unknown_surface_has_the_lowest_value():
    assert lowest_surface(2).penalised_value(np.zeros(2), 2.5) == -np.inf
    x, P = ensemble(0.0)
    broken = fit_surface(x, P, np.full((len(x), 1), -0.1))
    assert broken.penalised_value(np.zeros(2), 2.5) == pytest.approx(np.log(1e-5) - 0.25, abs=1e-6)
