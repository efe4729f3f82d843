"""Harvested energy and membrane work, against geometry, quadrature and 50-digit orbits."""

import dataclasses
import functools
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from vijax.model.device import Harvester
from vijax.model.energy import (
    admissible,
    capacitance,
    energy_ratio,
    harvested_energy,
    membrane_work,
    membrane_work_rigid,
    rigid_penetration,
    stretch,
)
from vijax.model.pair import impact_pair

DATA = Path(__file__).parents[1] / "data"
DEVICE = Harvester()  # one unit of u is a metre, one unit of u' a metre per second
ORBITS = json.loads((DATA / "gradients.json").read_text())["orbits"]


# --- the membrane's area and capacitance -----------------------------------------------------------------------------


def test_area_is_a_cap_and_a_tangent_cone():
    """The shape by tangency in 40 digits: the generating line from the rim touches the ball at angle alpha."""
    rim, ball = mp.mpf(DEVICE.R0), mp.mpf(DEVICE.r_b)
    for depth in (1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 3e-3, 0.005, 0.0063, 0.02, 0.3):
        with mp.workdps(60):
            height = ball - mp.mpf(depth)

            def off_tangent(alpha, height=height):
                return (rim - ball * mp.sin(alpha)) * mp.sin(alpha) - (ball * mp.cos(alpha) - height) * mp.cos(alpha)

            alpha = mp.findroot(off_tangent, (mp.mpf(0), mp.pi / 2), solver="anderson", tol=1e-100)
            contact_radius = ball * mp.sin(alpha)
            cone = mp.pi * (rim + contact_radius) * mp.hypot(rim - contact_radius, ball * mp.cos(alpha) - height)
            cap = 2 * mp.pi * ball**2 * (1 - mp.cos(alpha))
            expected = (cap + cone) / (mp.pi * rim**2) - 1
        assert float(stretch(DEVICE, depth)) == pytest.approx(float(expected), rel=5e-15, abs=0), depth


@pytest.mark.parametrize(
    ("depth", "area"),
    [
        (0.0001, 1.0001275702654955),
        (0.001, 1.014241435721792),
        (0.003, 1.1571961468172076),
        (0.006, 1.7055805890166469),
        (0.02, 5.5532271965657225),
    ],
)
def test_corrected_area_of_the_misprint_study(depth, area):
    assert 1 + float(stretch(DEVICE, depth)) == pytest.approx(area, rel=1e-14, abs=0)
    rest = 4.15e-11 * math.pi * 0.0063**2 / 0.00025
    assert float(capacitance(DEVICE, depth)) == pytest.approx(rest * area**2, rel=1e-14, abs=0)


def test_area_is_continuous_at_no_depth():
    assert float(stretch(DEVICE, 0.0)) == 0 == float(stretch(DEVICE, -1.0))
    # Near depth 0 the area is quadratic, x^2/2 in units of R0, without the step of the printed r_b cos(alpha).
    x = 1e-9
    assert float(stretch(DEVICE, x * DEVICE.R0)) == pytest.approx(x * x / 2, rel=1e-8, abs=0)
    assert math.isnan(float(harvested_energy(DEVICE, math.nan)))


# --- harvested energy ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orbit", ORBITS, ids=[f"d{o['d']}-kappa{o['kappa']}" for o in ORBITS])
def test_energy_of_fifty_digit_orbits(orbit):
    """P of a 1:1 orbit is the mean of its two E_j."""
    energies = harvested_energy(DEVICE, jnp.array([float(x) for x in orbit["dmax"]]))
    assert float(energies.mean()) == pytest.approx(float(orbit["P_J"]), rel=3e-15, abs=0)


@pytest.mark.parametrize(("d", "microjoule"), [(0.187, 1.12), (0.2, 1.18), (0.3, 1.68)])
def test_rigid_orbit_yields_microjoules(d, microjoule):
    """The 1:1 orbit of the rigid wall from its four equations has the energy for kappa = 400 and r = 0.5 of Table II.

    Below d = 0.2634 the stable orbit is asymmetric in phase, but its two speeds are equal.
    """
    r = 0.5

    def orbit(phase_right, ahead, speed_right, speed_left):
        """Return residuals of two flights: right wall at phase `phase_right`, left wall a time `ahead` later."""
        phase_left = phase_right + ahead
        slope, bend = (
            mp.sinpi(phase_left) - mp.sinpi(phase_right),
            (mp.cospi(phase_left) - mp.cospi(phase_right)) / mp.pi**2,
        )
        return (
            speed_left - r * speed_right + slope / mp.pi,
            speed_right - r * speed_left + slope / mp.pi,
            d - (r * speed_right + mp.sinpi(phase_right) / mp.pi) * ahead - bend,
            d - (r * speed_left - mp.sinpi(phase_left) / mp.pi) * (2 - ahead) - bend,
        )

    _, _, *speeds = mp.findroot(orbit, (0.3, 0.7, 0.52, 0.49))
    depths = jnp.array([float(v) for v in speeds]) * DEVICE.speed_unit * rigid_penetration(r) / DEVICE.omega0
    assert float(harvested_energy(DEVICE, depths).mean()) * 1e6 == pytest.approx(microjoule, abs=0.005)


def test_energy_of_shallow_impacts_is_exact_to_rounding():
    for depth in 10.0 ** np.arange(-15, -3):
        with mp.workdps(80):
            x, ball, rim = mp.mpf(depth), mp.mpf(DEVICE.r_b), mp.mpf(DEVICE.R0)
            tangent = mp.sqrt(rim**2 + x**2 - 2 * x * ball)
            cos = (ball * (ball - x) + rim * tangent) / (rim**2 + (ball - x) ** 2)  # Eq. (31)
            growth = (2 * ball**2 * (1 - cos) + (rim**2 - ball**2 * (1 - cos**2)) / cos) / rim**2
            least = mp.mpf(DEVICE.eps_M) * mp.pi * rim**2 / mp.mpf(DEVICE.w0)
            most, transfer = least * growth**2, mp.mpf(DEVICE.C_T)
            expected = (most + transfer) / (least + transfer) * (most - least) * mp.mpf(DEVICE.V) ** 2 / 2
        assert float(harvested_energy(DEVICE, depth)) == pytest.approx(float(expected), rel=5e-15, abs=0)


def test_energy_gradients():
    slope = jax.grad(harvested_energy, argnums=1)
    assert float(slope(DEVICE, 0.0)) == 0
    assert float(jax.hessian(harvested_energy, argnums=1)(DEVICE, 0.0)) > 0
    for depth in (1e-9, 1e-5, 1e-3, 0.006, 0.02):
        step = 1e-4 * depth
        central = (harvested_energy(DEVICE, depth + step) - harvested_energy(DEVICE, depth - step)) / (2 * step)
        assert float(slope(DEVICE, depth)) == pytest.approx(float(central), rel=2e-7, abs=0)
    for name, change in jax.tree.map(float, vars(jax.grad(harvested_energy)(DEVICE, 0.004))).items():
        if name in ("w0", "R0", "eps_M", "C_T", "V", "r_b"):
            value = getattr(DEVICE, name)
            above, below = (dataclasses.replace(DEVICE, **{name: value * (1 + sign * 1e-5)}) for sign in (1, -1))
            central = (harvested_energy(above, 0.004) - harvested_energy(below, 0.004)) / (2e-5 * value)
            assert change == pytest.approx(float(central), rel=1e-7, abs=0), name


def test_rigid_penetration_is_the_depth_of_a_free_contact():
    for r in (1e-12, 0.1, 0.5, 0.95, 1 - 2**-30):
        pair = impact_pair(0.2, 1.0, r)
        with mp.workdps(40):
            decrement = -mp.log(mp.mpf(r))
            zeta = decrement / mp.sqrt(mp.pi**2 + decrement**2)
            omega1 = mp.sqrt(1 - zeta**2)
            deepest = mp.atan2(omega1, zeta) / omega1
            expected = mp.exp(-zeta * deepest) * mp.sin(omega1 * deepest) / omega1
        assert float(rigid_penetration(pair.r)) == pytest.approx(float(expected), rel=1e-14, abs=0)
    assert float(rigid_penetration(1.0)) == 1
    # d chi/dr at r = 1, derived by hand: chi = exp(-D atan2(pi, D)/pi) with D = -ln r, so chi' = 1/2.
    assert float(jax.grad(rigid_penetration)(1.0)) == pytest.approx(0.5, rel=1e-15, abs=0)


# --- work on the membrane --------------------------------------------------------------------------------------------


def contact(kappa, mu, gamma, side, t_in, v_in):
    """Return penetration and rate as functions of elapsed time in mpmath's digits, by the closed form of physics.md."""
    kappa, mu, gamma, t_in, v_in = (mp.mpf(x) for x in (kappa, mu, gamma, t_in, v_in))
    side, zeta = int(side), mu / 2
    omega1 = mp.sqrt(kappa**2 - zeta**2)
    response = side / mp.mpc(kappa**2 - mp.pi**2, mu * mp.pi) * mp.expjpi(t_in)
    offset = side * gamma / kappa**2
    a = offset - response.real
    b = (side * v_in + mp.pi * response.imag + zeta * a) / omega1

    def depth(s):
        free = mp.exp(-zeta * s) * (a * mp.cos(omega1 * s) + b * mp.sin(omega1 * s))
        return free + (response * mp.expjpi(s)).real - offset

    def rate(s):
        cos, sin = mp.cos(omega1 * s), mp.sin(omega1 * s)
        free = mp.exp(-zeta * s) * ((b * omega1 - zeta * a) * cos - (a * omega1 + zeta * b) * sin)
        return free - mp.pi * (response * mp.expjpi(s)).imag

    return depth, rate


def exit_time(depth, first, step):
    """Return a zero of the depth after onset; any zero is valid, because W is defined between two zeros."""
    low, high = first / 2, first
    while depth(high) > 0:
        low, high = high, high + step
        if high > 8:
            return None
    return mp.findroot(depth, (mp.mpf(low), mp.mpf(high)), solver="anderson", tol=1e-70, maxsteps=100)


def cases(regime, count):
    """Return random (kappa, r, gamma, side, t_in, v_in) of a regime of contacts."""
    rng = np.random.default_rng(sum(map(ord, regime)))
    for _ in range(count):
        kappa, r = 10 ** rng.uniform(-0.3, 1.5), rng.uniform(0.02, 0.98)
        side, t_in, gamma, speed = rng.choice([-1, 1]), rng.uniform(0, 2), rng.uniform(-1.5, 1.5), rng.uniform(0.05, 1)
        if regime == "stiff":
            kappa = 10 ** rng.uniform(2, 5)
        if regime == "slow":  # the forcing repels the ball long before the spring acts
            speed, gamma = 10 ** rng.uniform(-9, -2), side * rng.uniform(1.2, 2)
        if regime in ("resonant", "resonant elastic"):
            kappa = math.pi * (1 + rng.choice([-1, 1]) * 10 ** rng.uniform(-9, -2))
        if regime in ("elastic", "resonant elastic"):
            r = 1 - 10 ** rng.uniform(-4, -1)
        yield kappa, r, gamma, int(side), t_in, side * speed


@functools.cache
def measured(regime, count):
    """Return arguments of `membrane_work` and W by quadrature, for the contacts of a regime."""
    rows, works = [], []
    with mp.workdps(40):
        for kappa, r, gamma, side, t_in, v_in in cases(regime, count):
            mu = float(impact_pair(0.2, kappa, r).mu)
            depth, rate = contact(kappa, mu, gamma, side, t_in, v_in)
            speed = abs(v_in)
            slow = regime == "slow"
            duration = exit_time(depth, speed / 10 if slow else 0.2 / kappa, speed / 5 if slow else 0.4 / max(kappa, 3))
            if duration is None:
                continue
            ends = mp.linspace(0, duration, 2 + int(kappa * duration / 4))
            works.append(float(mp.mpf(mu) * mp.quad(lambda s, rate=rate: rate(s) ** 2, ends)))
            rows.append((kappa, mu, gamma, side, t_in, float(duration), v_in, float(side * rate(duration))))
    arguments, expected = np.array(rows).T, np.array(works)
    arguments.flags.writeable = expected.flags.writeable = False  # shared by all tests through the cache
    return arguments, expected


# Largest errors of 150 contacts of each regime: 1.5e-13, 1.8e-15, 1.9e-14, 2.0e-11, 6.9e-12, 1.8e-7. The last two
# regimes lose digits: eps (kappa/mu)^2 near kappa = pi, and eps kappa/mu for "elastic", at most at r = 1 - 1e-4.
@pytest.mark.parametrize(
    ("regime", "tolerance"),
    [
        ("ordinary", 1e-12),
        ("stiff", 1e-13),
        ("slow", 1e-12),
        ("elastic", 1e-10),
        ("resonant", 1e-11),
        ("resonant elastic", 1e-6),
    ],
)
def test_membrane_work_against_quadrature(regime, tolerance):
    arguments, expected = measured(regime, 12)
    assert len(expected) > 8
    work = jax.jit(membrane_work)(*map(jnp.asarray, arguments))
    np.testing.assert_allclose(work, expected, rtol=tolerance)
    assert np.all(np.asarray(work) > 0)


def test_membrane_work_of_reference_trajectories():
    """Exact contacts, soft to stiff, also inclined: W and the energy balance agree with quadrature."""
    for entry in json.loads((DATA / "trajectories.json").read_text())["cases"]:
        case = entry["case"]
        if case.get("hard"):
            continue
        mu = float(impact_pair(case["d"], case["kappa"], case["r"]).mu)
        for impact in entry["impacts"][:3]:
            t, v_in, v_out, duration = (float(impact[key]) for key in ("t", "vin", "vout", "tc"))
            with mp.workdps(30):
                _, rate = contact(case["kappa"], mu, case["gamma"], impact["side"], t, v_in)
                expected = mu * mp.quad(lambda s, rate=rate: rate(s) ** 2, [0, duration / 2, duration])
            arguments = (case["kappa"], mu, case["gamma"], impact["side"], t, duration, v_in, v_out)
            assert float(membrane_work(*map(jnp.asarray, arguments))) == pytest.approx(
                float(expected), rel=1e-12, abs=0
            )


def test_forcing_changes_the_restitution():
    """Calibrated without forcing, a stiff membrane has a restitution of nearly r, a soft membrane of up to twice r."""
    departures = {}
    for entry in json.loads((DATA / "trajectories.json").read_text())["cases"]:
        case, differences = entry["case"], []
        if case.get("hard") or case["r"] != 0.5:
            continue
        mu = float(impact_pair(case["d"], case["kappa"], case["r"]).mu)
        for impact in entry["impacts"]:
            _, rate = contact(
                case["kappa"], mu, case["gamma"], impact["side"], mp.mpf(impact["t"]), mp.mpf(impact["vin"])
            )
            v_out = impact["side"] * rate(mp.mpf(impact["tc"]))
            assert float(v_out) == pytest.approx(float(impact["vout"]), rel=1e-12, abs=0)
            differences.append(abs(-v_out / mp.mpf(impact["vin"]) - case["r"]))
        departures[case["kappa"]] = max(differences)
    assert departures[4] > 0.4
    assert 0.05 > departures[40] > departures[400] > 1e-3


def test_membrane_work_tends_to_the_rigid_wall():
    """The wall has the calibrated r, not -v_out/v_in of the contact: the difference is of order 1/(kappa v)."""
    (kappa, mu, *_, v_in, _), soft = measured("stiff", 12)
    decrement = math.pi * mu / np.sqrt(4 * kappa**2 - mu**2)
    rigid = membrane_work_rigid(v_in, np.exp(-decrement))
    assert np.all(np.abs(rigid / soft - 1) * kappa * np.abs(v_in) < 20)
    assert float(membrane_work_rigid(-2.0, 0.5)) == 1.5


def test_membrane_work_of_mirror_images_is_equal():
    arguments, _ = measured("ordinary", 12)
    kappa, mu, gamma, side, t_in, duration, v_in, v_out = map(jnp.asarray, arguments)
    mirrored = membrane_work(kappa, mu, -gamma, -side, t_in + 1, duration, -v_in, -v_out)
    np.testing.assert_allclose(mirrored, membrane_work(*map(jnp.asarray, arguments)), rtol=1e-12)


def test_an_elastic_membrane_receives_no_work():
    kappa, _, gamma, side, t_in, _, v_in, _ = measured("ordinary", 12)[0].copy()
    kappa[0] = math.pi  # the undamped resonance, where the closed form is undefined
    arguments = [
        jnp.asarray(x) for x in (kappa, 0 * kappa, gamma, side, t_in, np.full_like(kappa, 0.7), v_in, -0.9 * v_in)
    ]
    np.testing.assert_array_equal(membrane_work(*arguments), 0)
    assert np.all(np.isfinite(jax.vmap(jax.grad(membrane_work, argnums=(0, 1, 2, 4, 5, 6, 7)))(*arguments)))
    assert float(membrane_work_rigid(0.8, 1.0)) == 0
    energy = harvested_energy(DEVICE, jnp.array([1e-12, 1e-6, 1e-3]))
    assert not np.any(admissible(DEVICE, energy, jnp.zeros(3), 1e-6))
    np.testing.assert_array_equal(energy_ratio(energy, jnp.zeros(3)), np.inf)


@pytest.mark.parametrize("regime", ["ordinary", "slow", "elastic"])
def test_membrane_work_gradients(regime):
    """Derivatives by each parameter of exact contacts: partial derivatives, chained through duration and exit speed."""

    def outcome(arguments, near):
        depth, rate = contact(*arguments)
        duration = mp.findroot(depth, (near, near * (1 + 1e-9)))
        ends = mp.linspace(0, duration, 2 + int(arguments[0] * duration / 4))
        return duration, arguments[3] * rate(duration), arguments[1] * mp.quad(lambda s: rate(s) ** 2, ends)

    gradient = jax.jit(jax.grad(membrane_work, argnums=(0, 1, 2, 4, 5, 6, 7)))
    rows, _ = measured(regime, 12)
    for kappa, mu, gamma, side, t_in, duration, v_in, v_out in rows.T[:3]:
        partial = gradient(*map(jnp.asarray, (kappa, mu, gamma, side, t_in, duration, v_in, v_out)))
        by_duration, by_v_out = float(partial[4]), float(partial[6])
        with mp.workdps(40):
            for place, slope in zip((0, 1, 2, 4, 5), (*partial[:4], partial[5]), strict=True):
                arguments = [kappa, mu, gamma, side, t_in, v_in]
                step = mp.mpf("1e-10") * abs(arguments[place])
                above, below = (
                    outcome([x + sign * step if i == place else mp.mpf(x) for i, x in enumerate(arguments)], duration)
                    for sign in (1, -1)
                )
                longer, faster, work = ((a - b) / (2 * step) for a, b in zip(above, below, strict=True))
                parts = [float(slope), by_duration * float(longer), by_v_out * float(faster)]
                # The terms may cancel: the sum has the error of the largest term.
                assert sum(parts) == pytest.approx(float(work), abs=1e-9 * max(map(abs, parts))), (regime, place)


# --- admissibility ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orbit", ORBITS, ids=[f"d{o['d']}-kappa{o['kappa']}" for o in ORBITS])
def test_the_formula_exceeds_the_work_on_soft_walls(orbit):
    """At kappa below about 35 the formula's energy exceeds the work on the membrane; the depth has a separate limit."""
    kappa, mu, gamma = (jnp.full(2, float(orbit[key])) for key in ("kappa", "mu", "gamma"))
    v_in, v_out, t_in, duration, depth = (
        jnp.array([float(x) for x in orbit[key]]) for key in ("v_in", "v_out", "t_in", "contact", "dmax")
    )
    work = membrane_work(kappa, mu, gamma, jnp.sign(v_in), t_in, duration, v_in, v_out)
    work = DEVICE.m_b * DEVICE.speed_unit**2 * work
    energy = harvested_energy(DEVICE, depth)
    stiff_enough = orbit["kappa"] > 35
    np.testing.assert_array_equal(energy_ratio(energy, work) <= 1, stiff_enough)
    # All four penetrate deeper than R0 = 6.3 mm: rejected by the depth limit, admissible by energy alone.
    assert not np.any(admissible(DEVICE, energy, work, depth))
    unlimited = dataclasses.replace(DEVICE, penetration_limit=math.inf)
    np.testing.assert_array_equal(admissible(unlimited, energy, work, depth), stiff_enough)


def test_admissibility_requires_both_limits():
    energy, work, depth = jnp.array([1.0, 1.0, 1.1, 0.0, 1.0, jnp.nan]), jnp.ones(6).at[3].set(0.0), DEVICE.R0
    expected = [True, True, False, True, True, False]
    np.testing.assert_array_equal(admissible(DEVICE, energy, work, depth), expected)
    assert not np.any(admissible(DEVICE, energy, work, depth * (1 + 1e-15)))
    np.testing.assert_array_equal(energy_ratio(energy, work), [1.0, 1.0, 1.1, 0.0, 1.0, jnp.nan])
    assert float(energy_ratio(1.0, -1.0)) == math.inf  # a W rounded below zero is never admissible
    halved = dataclasses.replace(DEVICE, energy_ratio_limit=0.5)
    np.testing.assert_array_equal(admissible(halved, jnp.array([0.5, 0.51]), jnp.ones(2), depth), [True, False])


def test_single_precision_is_preserved():
    def cast(values):
        return jnp.asarray(values, "float32")

    arguments, expected = measured("ordinary", 12)
    work = membrane_work(*map(cast, arguments))
    assert work.dtype == jnp.dtype("float32")
    np.testing.assert_allclose(work, expected, rtol=1e-3)
    energy = harvested_energy(DEVICE, cast([1e-9, 1e-3]))
    assert energy.dtype == jnp.dtype("float32")
    np.testing.assert_allclose(energy, harvested_energy(DEVICE, jnp.array([1e-9, 1e-3])), rtol=1e-5)
