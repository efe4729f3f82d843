"""Quadrature nodes of tolerances integrate what they must; what cannot be a tolerance is refused."""

import numpy as np
import pytest

from vijax.design.tolerance import Tolerance, check_tolerances, nodes
from vijax.model.device import Harvester
from vijax.model.variables import scattered


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


def test_samples_are_drawn_alike_every_time():
    one = (Tolerance("omega0", 0.05), Tolerance("r", 0.1, "lognormal"))
    first, again, other = nodes(one, 4000, seed=1), nodes(one, 4000, seed=1), nodes(one, 4000, seed=2)
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
def test_what_cannot_be_is_refused_when_it_is_made(tolerance, words):
    with pytest.raises(ValueError, match=words):
        Tolerance(*tolerance)


def test_a_worst_case_wants_distributions_that_end():
    with pytest.raises(ValueError, match="worst case must be uniform"):
        check_tolerances((Tolerance("omega0", 0.05, "lognormal"),), True)


def test_a_constant_scatters_once():
    with pytest.raises(ValueError, match="name a constant once"):
        check_tolerances((Tolerance("r", 0.05), Tolerance("r", 0.1)), False)
    with pytest.raises(ValueError, match="name a constant once; got k, omega0"):
        check_tolerances((Tolerance("k", 0.05), Tolerance("omega0", 0.1)), False)


def test_another_name_of_a_constant_scatters_as_it_does():
    device = Harvester(omega0=300.0)
    made = scattered(device, ("k", "d"), (1.21, 0.9))
    assert float(made.omega0) == pytest.approx(330.0, rel=1e-14)
    assert float(made.k) == pytest.approx(1.21 * float(device.k), rel=1e-14)
    assert float(made.pair().d) == pytest.approx(0.9 * float(device.pair().d), rel=1e-14)
