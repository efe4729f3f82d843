"""Tuned quantities reach the device by whatever name; names and bounds that cannot be are refused."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from vijax.design.averages import averages
from vijax.model import quantities, variables
from vijax.model.device import Harvester
from vijax.model.sides import Sides

DEVICE = Harvester(A=3.0, omega=10 * math.pi, s=0.006)


@pytest.mark.parametrize("name", [name for name in variables.NAMES if name not in ("beta", "gamma")])
def test_a_device_has_what_was_tuned(name):
    wanted = 1.1 * float(variables.value_of(DEVICE, name))
    device = variables.tuned(DEVICE, (name,), np.array([math.log(wanted)]))
    assert float(variables.value_of(device, name)) == pytest.approx(wanted, rel=1e-14)
    changed = [
        float(a) != float(b)
        for side in ((-1, 1) if quantities.of_both_walls(name) else (1,))
        for a, b in zip(jax.tree.leaves(device.at(side)), jax.tree.leaves(DEVICE), strict=True)
    ]
    assert sum(changed) == 1


@pytest.mark.parametrize("name", ["beta", "gamma"])
def test_inclinations_may_be_negative(name):
    device = variables.tuned(DEVICE, (name,), np.array([-0.02]))
    assert float(variables.value_of(device, name)) == pytest.approx(-0.02, rel=1e-13)


def test_a_dimensionless_name_follows_what_is_tuned_beside_it():
    names = ("kappa", "omega")
    device = variables.tuned(DEVICE, names, np.log([5.0, 20.0]))
    assert float(device.omega0) == pytest.approx(5 * 20 / math.pi, rel=1e-14)


def test_values_and_variables_are_inverse():
    names, x = ("omega0", "beta", "r"), np.array([[30.0, -0.05, 0.5], [40.0, 0.0, 0.9]])
    np.testing.assert_allclose(variables.values(names, variables.variables(names, x)), x, rtol=1e-14)


def test_bounds_stand_unless_given():
    low, high = variables.limits(("omega0", "r", "V"), {"r": (0.2, 0.4)}, DEVICE)
    np.testing.assert_allclose([low, high], [[20.0, 0.2, 1000.0], [4000.0, 0.4, 4000.0]])


@pytest.mark.parametrize(
    ("names", "words"),
    [((), "at least one"), (("mass",), "must be among"), (("omega0", "kappa"), "once; got omega0 and kappa")],
)
def test_names_that_cannot_be_are_told(names, words):
    with pytest.raises(ValueError, match=words):
        variables.check_names(names)


@pytest.mark.parametrize(
    ("names", "bounds", "words"),
    [
        (("omega0",), {"r": (0.1, 0.2)}, "not among omega0"),
        (("omega0",), {"omega0": (40.0, 20.0)}, "the lower first"),
        (("r",), {"r": (0.5, 1.2)}, "r must lie in"),
        (("gamma",), {"gamma": (-1.0, 9.0)}, r"g/A, g/A\], here \+-3.26"),
    ],
)
def test_bounds_that_cannot_be_are_told(names, bounds, words):
    with pytest.raises(ValueError, match=words):
        variables.limits(names, bounds, DEVICE)


def test_constants_of_one_wall_or_of_both_scatter():
    device = dataclasses.replace(DEVICE, omega0=Sides(50.0, 70.0))
    off = variables.scattered(device, ("omega0", "V_left", "A"), (1.1, 0.9, 1.2))
    assert (off.omega0.left, off.omega0.right) == (pytest.approx(55.0), pytest.approx(77.0))
    assert (off.V.left, off.V.right, off.A) == (pytest.approx(1800.0), 2000.0, pytest.approx(3.6))


def test_the_room_that_balls_leave_is_that_of_the_nearer_limit():
    device = Harvester(R0=Sides(np.full(2, 0.006), np.full(2, 0.008)), A=np.full(2, 1.0), omega=np.full(2, np.pi))
    blank = np.zeros(2)
    ended = SimpleNamespace(
        P=np.ones((2, 1)),
        energy_ratio=np.full((2, 1), 0.1),
        deepest=np.array([0.004, 0.006]),
        deepest_left=np.array([0.004, 0.001]),
        deepest_right=np.array([0.002, 0.006]),
        handover=SimpleNamespace(u=blank, v=blank, t=blank),
        **dict.fromkeys(("fastest", "lyapunov", "period", "impacts_left", "impacts_right", "status"), blank),
        periods_run=blank,
    )
    found = averages(device, ended)
    np.testing.assert_allclose(found.room, [6 / 4, 8 / 6], rtol=1e-12)
    np.testing.assert_allclose(found.margins()[:, 0], np.log([6 / 4, 8 / 6]), rtol=1e-12)
