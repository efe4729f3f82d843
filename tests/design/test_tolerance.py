"""Quadrature nodes of tolerances integrate accurately, and invalid tolerances raise."""

import numpy as np
import pytest

from vijax.design.robustness.tolerance import Tolerance, nodes, validate_tolerances
from vijax.model.device import Harvester
from vijax.model.tuned_quantities import with_factors


def mean(cloud, function):
    return float((cloud.weights * function(cloud.factors)).sum())


def test_the_nominal_device_comes_first():
    alone = nodes(())
    assert alone.factors.shape == (1, 0)
    np.testing.assert_array_equal(alone.weights, [1.0])
    cloud = nodes((Tolerance("omega0", 0.05),))
    np.testing.assert_array_equal(cloud.factors[0], [1.0])
    assert cloud.weights[0] == 0
    assert cloud.weights.sum() == pytest.approx(1, abs=1e-14)


def test_a_uniform_constant_is_integrated_to_its_ends():
    cloud = nodes((Tolerance("omega0", 0.05),))
    assert cloud.factors.min() == pytest.approx(0.95, abs=1e-15)
    assert cloud.factors.max() == pytest.approx(1.05, abs=1e-15)
    exact = (np.exp(1.05) - np.exp(0.95)) / 0.1
    assert mean(cloud, lambda x: np.exp(x[:, 0])) == pytest.approx(exact, rel=1e-14)


def test_a_log_normal_constant_is_integrated():
    cloud = nodes((Tolerance("omega0", 0.1, "lognormal"),))
    for power in (1, 3):
        expected = np.exp(0.5 * (power * 0.1) ** 2)
        assert mean(cloud, lambda x, power=power: x[:, 0] ** power) == pytest.approx(expected, rel=1e-13)


def test_two_constants_are_independent():
    cloud = nodes((Tolerance("omega0", 0.05), Tolerance("r", 0.1, "lognormal")))
    expected = (1 + 0.05**2 / 3) * np.exp(0.5 * 0.1**2)
    assert mean(cloud, lambda x: x[:, 0] ** 2 * x[:, 1]) == pytest.approx(expected, rel=1e-13)


def test_samples_are_reproducible():
    tolerances = (Tolerance("omega0", 0.05), Tolerance("r", 0.1, "lognormal"))
    first, again, other = (
        nodes(tolerances, 4000, seed=1),
        nodes(tolerances, 4000, seed=1),
        nodes(tolerances, 4000, seed=2),
    )
    np.testing.assert_array_equal(first.factors, again.factors)
    assert (first.factors[1:] != other.factors[1:]).any()
    spread = first.factors[1:].std(axis=0)
    np.testing.assert_allclose(spread, [0.05 / np.sqrt(3), 0.1], rtol=0.05)


@pytest.mark.parametrize(
    ("tolerance", "words"),
    [
        (("omega_0", 0.05), "name must be among"),
        (("omega0", 0.0), "spread must be a number between 0 and 1, a part of omega0; got 0.0"),
        (("omega0", np.nan), "spread must be"),
        (("omega0", np.inf), "spread must be"),
        (("omega0", [0.05]), "spread must be"),
        (("omega0", 0.05, "normal"), 'kind must be "uniform" or "lognormal"'),
    ],
)
def test_invalid_tolerances_raise(tolerance, words):
    with pytest.raises(ValueError, match=words):
        Tolerance(*tolerance)


def test_worst_case_requires_bounded_distributions():
    with pytest.raises(ValueError, match="worst case must be uniform"):
        validate_tolerances((Tolerance("omega0", 0.05, "lognormal"),), True)


def test_repeated_constant_raises():
    with pytest.raises(ValueError, match="name a constant once"):
        validate_tolerances((Tolerance("r", 0.05), Tolerance("r", 0.1)), False)
    with pytest.raises(ValueError, match="name a constant once; got k, omega0"):
        validate_tolerances((Tolerance("k", 0.05), Tolerance("omega0", 0.1)), False)


def test_factors_of_derived_names_scale_their_constants():
    device = Harvester(omega0=300.0)
    scaled = with_factors(device, ("k", "d"), (1.21, 0.9))
    assert float(scaled.omega0) == pytest.approx(330.0, rel=1e-14)
    assert float(scaled.k) == pytest.approx(1.21 * float(device.k), rel=1e-14)
    assert float(scaled.pair().d) == pytest.approx(0.9 * float(device.pair().d), rel=1e-14)
