"""Tuned quantities change the device under any of their names; invalid names and bounds are rejected."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from vijax.design.aperiodic.motion_averages import summary_averages
from vijax.model import quantities, tuned_quantities
from vijax.model.device import Harvester
from vijax.model.walls.sides import Sides

DEVICE = Harvester(A=3.0, omega=10 * math.pi, s=0.006)


@pytest.mark.parametrize("name", [name for name in tuned_quantities.NAMES if name not in ("beta", "gamma")])
def test_a_device_has_the_tuned_value(name):
    expected = 1.1 * float(tuned_quantities.value_of(DEVICE, name))
    device = tuned_quantities.tune_device(DEVICE, (name,), np.array([math.log(expected)]))
    assert float(tuned_quantities.value_of(device, name)) == pytest.approx(expected, rel=1e-14)
    changed = [
        float(a) != float(b)
        for side in ((-1, 1) if quantities.both_walls_name(name) else (1,))
        for a, b in zip(jax.tree.leaves(device.at(side)), jax.tree.leaves(DEVICE), strict=True)
    ]
    assert sum(changed) == 1


@pytest.mark.parametrize("name", ["beta", "gamma"])
def test_inclinations_may_be_negative(name):
    device = tuned_quantities.tune_device(DEVICE, (name,), np.array([-0.02]))
    assert float(tuned_quantities.value_of(device, name)) == pytest.approx(-0.02, rel=1e-13)


def test_dimensionless_constants_use_other_tuned_constants():
    names = ("kappa", "omega")
    device = tuned_quantities.tune_device(DEVICE, names, np.log([5.0, 20.0]))
    assert float(device.omega0) == pytest.approx(5 * 20 / math.pi, rel=1e-14)


def test_values_and_variables_are_inverse():
    names, x = ("omega0", "beta", "r"), np.array([[30.0, -0.05, 0.5], [40.0, 0.0, 0.9]])
    np.testing.assert_allclose(
        tuned_quantities.to_values(names, tuned_quantities.to_variables(names, x)), x, rtol=1e-14
    )


def test_default_bounds():
    low, high = tuned_quantities.bounds_of(("omega0", "r", "V"), {"r": (0.2, 0.4)}, DEVICE)
    np.testing.assert_allclose([low, high], [[20.0, 0.2, 1000.0], [4000.0, 0.4, 4000.0]])


@pytest.mark.parametrize(
    ("names", "words"),
    [((), "at least one"), (("mass",), "must be among"), (("omega0", "kappa"), "once; got omega0 and kappa")],
)
def test_invalid_names_are_rejected(names, words):
    with pytest.raises(ValueError, match=words):
        tuned_quantities.check_names(names)


@pytest.mark.parametrize(
    ("names", "bounds", "words"),
    [
        (("omega0",), {"r": (0.1, 0.2)}, "not among omega0"),
        (("omega0",), {"omega0": (40.0, 20.0)}, "the lower first"),
        (("r",), {"r": (0.5, 1.2)}, "r must lie in"),
        (("gamma",), {"gamma": (-1.0, 9.0)}, r"g/A, g/A\], here \+-3.26"),
    ],
)
def test_invalid_bounds_are_rejected(names, bounds, words):
    with pytest.raises(ValueError, match=words):
        tuned_quantities.bounds_of(names, bounds, DEVICE)


def test_factors_on_constants_per_wall_and_of_both_walls():
    device = dataclasses.replace(DEVICE, omega0=Sides(50.0, 70.0))
    off = tuned_quantities.with_factors(device, ("omega0", "V_left", "A"), (1.1, 0.9, 1.2))
    assert (off.omega0.left, off.omega0.right) == (pytest.approx(55.0), pytest.approx(77.0))
    assert (off.V.left, off.V.right, off.A) == (pytest.approx(1800.0), 2000.0, pytest.approx(3.6))


def test_the_safety_factor_is_the_factor_to_the_nearer_limit():
    device = Harvester(R0=Sides(np.full(2, 0.006), np.full(2, 0.008)), A=np.full(2, 1.0), omega=np.full(2, np.pi))
    blank = np.zeros(2)
    summary = SimpleNamespace(
        P=np.ones((2, 1)),
        energy_ratio=np.full((2, 1), 0.1),
        deepest=np.array([0.004, 0.006]),
        deepest_left=np.array([0.004, 0.001]),
        deepest_right=np.array([0.002, 0.006]),
        handover=SimpleNamespace(u=blank, v=blank, t=blank),
        **dict.fromkeys(("fastest", "lyapunov", "period", "impacts_left", "impacts_right", "status"), blank),
        periods_run=blank,
    )
    averages = summary_averages(device, summary)
    np.testing.assert_allclose(averages.depth_safety_factor, [6 / 4, 8 / 6], rtol=1e-12)
    np.testing.assert_allclose(averages.margins()[:, 0], np.log([6 / 4, 8 / 6]), rtol=1e-12)
