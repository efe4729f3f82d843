"""Physical membranes: the parameters of a law with a device are in SI and describe one membrane at all frequencies."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vijax
from vijax.maps.sweep import plan
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.walls.membrane import nondimensional

DEVICE = vijax.Harvester(s=0.01, omega0=300.0, A=5.0, omega=60.0, beta=0.02)
RUBBER = vijax.Hyperelastic(1.3, radius=0.004)
HERTZ = vijax.HuntCrossley(chi=1.2, exponent=1.5, depth=2e-4)
FINE = {"method": "ode", "solver": "Dopri8", "rtol": 1e-11, "atol": 1e-13}


def force(law, device, W, rate):
    """Return the acceleration [m/s^2] of a ball at penetration W [m] in SI, by the formula of the law's docstring."""
    if isinstance(law, vijax.HuntCrossley):
        return -(device.omega0**2) * W * (W / law.depth) ** (law.exponent - 1) * (1 + law.chi * rate)
    loss = -math.log(device.r) / math.hypot(math.pi, math.log(device.r))
    stretch = 1 + (W / law.radius) ** 2
    tension = (1 - law.prestretch**-6 / stretch**2) / (1 - law.prestretch**-6)
    return -(device.omega0**2) * W * tension - 2 * loss * device.omega0 * rate


def simulate_in_si(law, device, u0, v0, periods):
    """Return displacement [m] and velocity [m/s] after a number of periods, by SciPy with located wall crossings."""

    def flow(tau, y):
        drive = device.A * math.cos(device.omega * tau) - device.g * math.sin(device.beta)
        W, side = abs(y[0]) - device.s / 2, math.copysign(1.0, y[0])
        return y[1], drive + (side * force(law, device, W, side * y[1]) if W > 0 else 0.0)

    def wall(tau, y):
        return abs(y[0]) - device.s / 2

    wall.terminal = True
    tau, y, end = 0.0, [u0, v0], 2 * math.pi * periods / device.omega
    while tau < end:
        part = solve_ivp(flow, (tau, end), y, "DOP853", events=wall, rtol=1e-12, atol=1e-15)
        tau, y = part.t[-1], part.y[:, -1]
        if tau < end:  # slightly inside the wall, so that the same crossing is not located again
            rate = flow(tau + 1e-13, y)
            tau, y = tau + 1e-12, [y[0] + 1e-12 * rate[0], y[1] + 1e-12 * rate[1]]
    return y


@pytest.mark.parametrize("omega", [40.0, pytest.param(60.0, marks=pytest.mark.long)])
@pytest.mark.parametrize("law", [RUBBER, HERTZ], ids=["rubber", "hertz"])
def test_the_motion_agrees_with_the_equation_in_si(law, omega):
    device = replace(DEVICE, omega=omega)
    u0, v0, pair = 1e-3, 0.2, device.pair()
    if not law.restitution:
        pair = vijax.impact_pair(pair.d, pair.kappa, None, pair.gamma)
    nondimensional = law.nondimensional(device)
    run = vijax.trajectory(pair, u0 / device.length_unit, v0 / device.speed_unit, 2, membrane=nondimensional, **FINE)
    assert int(run.filled) >= 3
    actual = float(run.states.u[-1]) * device.length_unit, float(run.states.v[-1]) * device.speed_unit
    np.testing.assert_allclose(actual, simulate_in_si(law, device, u0, v0, 2), rtol=0, atol=2e-8)


def test_a_membrane_is_the_same_over_axes_of_frequency_and_amplitude():
    """Each cell equals the cell of its device; in units of the pair the membrane would differ between cells."""
    axes, settings = {"omega": [40.0, 60.0], "A": [4.0, 6.0]}, {"periods": 12, "until": "window", "method": "ode"}
    plane = vijax.sweep(**axes, device=DEVICE, membrane=RUBBER, outputs=["P", "max_penetration"], **settings)
    assert plane.P.dims == ("omega", "A")
    for omega in axes["omega"]:
        for A in axes["A"]:
            device = replace(DEVICE, omega=omega, A=A)
            cell, pair, law = plane.sel(omega=omega, A=A), device.pair(), RUBBER.nondimensional(device)
            start = min(0.05853, 0.49 * float(pair.d)), -0.47898
            run = vijax.trajectory(pair, *start, 12, method="ode", membrane=law)
            deepest = float(np.nanmax(run.impacts.depth)) * device.length_unit
            assert float(cell.max_penetration) == pytest.approx(deepest, rel=1e-4)


def test_the_default_radius_is_the_radius_of_the_device():
    walls = replace(DEVICE, R0=vijax.Sides(0.007, 0.009))
    law = nondimensional(vijax.Hyperelastic(1.3), walls)
    unit = float(DEVICE.length_unit)
    assert (law.left.radius, law.right.radius) == (pytest.approx(0.007 / unit), pytest.approx(0.009 / unit))
    for radius in (None, 0.006):
        settings = SweepSettings(method="ode", membrane=vijax.Hyperelastic(1.3, radius))
        planned = plan({"omega": [50.0, 60.0]}, ["P"], vijax.Harvester(R0=0.009), settings)
        assert planned.method.law.radius == (radius or 0.009)
        assert planned.cells.dynamic == ("omega",)


def test_a_number_with_a_unit_is_not_accepted_in_units_of_a_pair():
    import pint

    units = pint.UnitRegistry()
    for law in (vijax.Hyperelastic(1.2), vijax.Hyperelastic(1.2, units("20 mm")), vijax.HuntCrossley(units("3 s/m"))):
        for call in (
            lambda law=law: vijax.trajectory(DEVICE.pair(), 0.0, 0.1, 2, method="ode", membrane=law),
            lambda law=law: vijax.find_orbits(DEVICE.pair(), "1:1", membrane=law),
        ):
            with pytest.raises(ValueError, match=r"membrane must be in the units of the pair; .* law.nondimensional"):
                call()
    assert vijax.Hyperelastic(1.2, units("20 mm")).radius == pytest.approx(0.02, rel=1e-15)
    with pytest.raises(ValueError, match="a number of Stiff must be a number without a unit; got one in kilogram"):
        vijax.sweep(d=0.2, kappa=40.0, method="ode", membrane=Stiff(units("3 kg")))


class Stiff(vijax.MembraneLaw):
    """A custom law with a parameter that has a dimension: a cubic term [1/m^2]."""

    cubic: float

    def acceleration(self, pair, w, z):
        """Return the acceleration by a stiffening spring and a damper."""
        return -(pair.kappa**2 * (w + self.cubic * w**3) + pair.mu * z)

    def in_units(self, length, speed):
        """Return the law with the cubic term in another unit of length."""
        return Stiff(self.cubic * length**2)


def test_a_custom_law_may_be_in_si():
    nondimensional = Stiff(1e5).nondimensional(DEVICE)
    assert float(nondimensional.cubic) == pytest.approx(1e5 * float(DEVICE.length_unit) ** 2, rel=1e-15)


@pytest.fixture(scope="module")
def orbits():
    """The 1:1 orbits of the device with its membrane."""
    return vijax.find_orbits(DEVICE.pair(), "LR", guesses=32, membrane=RUBBER.nondimensional(DEVICE))


@pytest.mark.long
def test_a_branch_along_the_frequency_has_a_single_membrane(orbits):
    (branch,) = vijax.follow_orbits(orbits[:1], "omega", (59.0, 61.0), direction="up", device=DEVICE)
    end = replace(DEVICE, omega=float(branch.values[-1]))
    pair, law = branch.orbit[-1].pair, RUBBER.nondimensional(end)
    assert float(pair.law.radius) == pytest.approx(float(law.radius), rel=1e-12)
    assert branch.values[-1] > 60.5


@pytest.mark.long
def test_derivatives_of_a_steady_state_move_the_membrane_in_si(orbits):
    def power(omega, law):
        return vijax.steady(replace(DEVICE, omega=omega), orbits[0], membrane=law).power

    by_omega = float(jax.jacfwd(power)(60.0, RUBBER))
    h = 1e-3
    quotient = (float(power(60.0 + h, RUBBER)) - float(power(60.0 - h, RUBBER))) / (2 * h)
    assert by_omega == pytest.approx(quotient, rel=1e-5)
    by_radius = jax.jacfwd(lambda radius: power(60.0, vijax.Hyperelastic(1.3, radius)))(0.004)
    assert float(by_radius) != 0
    with pytest.raises(ValueError, match="membrane must be given, in SI units, where device moves"):
        vijax.steady(DEVICE, orbits[0])
