"""The device, its two scalings, the calibration of the membrane, and the validation of arguments."""

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from vijax.model.device import LIMITS, Harvester, with_constants, with_pair
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.walls.restitution import damping_ratio
from vijax.model.walls.sides import Sides

# Round trips have a few roundings.
ROUND_TRIP = 1e-14


def drawn_device(count: int = 200) -> Harvester:
    """Return devices over the ranges of the field, with an array for each constant that affects the dynamics."""
    rng = np.random.default_rng(1)
    return Harvester(
        m_b=rng.uniform(1e-3, 1e-2, count),
        s=rng.uniform(0.05, 0.5, count),
        omega0=10 ** rng.uniform(0, 5, count),
        r=rng.uniform(0.01, 1, count),
        A=rng.uniform(1, 5, count),
        omega=rng.uniform(math.pi, 12 * math.pi, count),
        beta=rng.uniform(-0.9, 0.9, count) * math.pi / 2,
    )


def drawn_pair(count: int = 200) -> ImpactPair:
    """Return pairs over the full range of the simulation."""
    rng = np.random.default_rng(2)
    return impact_pair(
        10 ** rng.uniform(-2.3, 0.3, count),
        10 ** rng.uniform(-0.3, 5, count),
        rng.uniform(0.01, 1, count),
        rng.uniform(-1.5, 1.5, count),
    )


# --- the device and its scalings -------------------------------------------------------------------------------------


def test_defaults_are_the_values_of_tables_i_and_ii():
    device = Harvester()
    pair = device.pair()
    assert float(pair.mu) == pytest.approx(172.36301, abs=5e-6)
    assert (float(pair.d), float(pair.kappa), float(pair.gamma)) == (0.3, 400.0, 0.0)
    assert device.k == pytest.approx(560.0, rel=1e-15, abs=0)
    assert (device.length_unit, device.speed_unit, device.depth_limit) == (1.0, 1.0, 0.0063)


def test_pair_of_device_and_back():
    device = drawn_device()
    electrical = dataclasses.replace(device, s=1.0, omega0=1.0, r=0.3, beta=0.0)
    back = with_pair(electrical, device.pair())
    for field in dataclasses.fields(device):
        if field.name not in LIMITS:
            np.testing.assert_allclose(getattr(back, field.name), getattr(device, field.name), rtol=ROUND_TRIP)


def test_device_of_pair_and_back():
    pair = drawn_pair()
    device = Harvester(A=2.5, omega=20.0)
    for wall in ("soft", "rigid"):
        walled = dataclasses.replace(pair, kappa=None) if wall == "rigid" else pair
        built = with_pair(device, walled)
        again = built.pair(wall)
        assert wall == "soft" or (again.kappa is None and built.omega0 == device.omega0)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=ROUND_TRIP), again, walled)


def test_units_transform_the_si_equation_to_the_nondimensional_equation():
    """The acceleration of one state, from m_b U'' = ... of the device and from Eq. (38)."""
    device, t, u, v = drawn_device(), 0.3, 0.7, -0.4
    pair = device.pair()
    depth, speed = (u - pair.d / 2) * device.length_unit, v * device.speed_unit
    tau = t * math.pi / device.omega
    damping = 2 * damping_ratio(device.r) * jnp.sqrt(device.k * device.m_b)  # c of Eq. (19)
    forcing = device.A * jnp.cos(device.omega * tau) - device.g * jnp.sin(device.beta)
    si = forcing - (device.k * depth + damping * speed) / device.m_b
    scaled = jnp.cos(jnp.pi * t) - pair.gamma - pair.kappa**2 * (u - pair.d / 2) - pair.mu * v
    np.testing.assert_allclose(si / device.A, scaled, rtol=1e-12)  # one unit of acceleration is A


def test_stiffness_sets_the_natural_frequency():
    assert float(with_constants(Harvester(), k=56.0).omega0) == pytest.approx(
        math.sqrt(56.0 / 0.0035), rel=1e-15, abs=0
    )
    heavier = with_constants(Harvester(), k=560.0, m_b=0.007)
    assert float(heavier.k) == pytest.approx(560.0, rel=1e-14, abs=0)


def test_constants_are_traced():
    traces = []

    @jax.jit
    def kappa(device):
        traces.append(device)
        return device.pair().kappa

    assert float(kappa(Harvester())) == 400.0
    assert float(kappa(Harvester(omega0=40.0, R0=0.01))) == 40.0
    assert len(traces) == 1
    numbers = [field for field in dataclasses.fields(Harvester) if field.default is not None]
    assert len(jax.tree.leaves(Harvester())) == len(numbers)  # no field is static


# --- calibration -----------------------------------------------------------------------------------------------------


def test_damping_against_fifty_digits():
    for r in (1e-300, 1e-9, 0.1, 0.5, 0.95, 1 - 2**-40, 1.0):
        with mp.workdps(50):
            decrement = -mp.log(mp.mpf(r))
            ratio = decrement / mp.sqrt(mp.pi**2 + decrement**2)
            damped = mp.sqrt(1 - ratio**2)
        pair = impact_pair(0.2, 7.0, r)
        expected = [float(7 * x) for x in (2 * ratio, ratio, damped)]
        np.testing.assert_allclose([pair.mu, pair.zeta, pair.omega1], expected, rtol=1e-15)


def test_elastic_wall_has_no_damping():
    mu = float(impact_pair(0.2, 7.0, 1.0).mu)
    assert mu == 0
    assert math.copysign(1, mu) == 1
    slope = jax.grad(lambda r: ImpactPair(0.2, 7.0, r, 0.0).mu)(1.0)
    assert float(slope) == pytest.approx(-2 * 7 / math.pi, rel=1e-15, abs=0)


@pytest.mark.parametrize("kappa", [0.5, math.pi, 40.0, 400.0, 1e5])
@pytest.mark.parametrize("r", [1e-3, 0.1, 0.5, 0.95, 0.999, 1.0])
def test_a_free_contact_has_the_restitution_r(kappa, r):
    """Eqs. (14)-(18) without forcing: w'' + mu w' + kappa^2 w = 0 from w = 0 exits at -r times the entry speed."""
    pair = impact_pair(0.2, kappa, r)
    with mp.workdps(40):
        zeta, k = mp.mpf(float(pair.mu)) / 2, mp.mpf(kappa)
        omega1 = mp.sqrt(k**2 - zeta**2)
        duration = mp.pi / omega1

        def depth(s):
            return mp.exp(-zeta * s) * mp.sin(omega1 * s) / omega1

        assert abs(depth(duration)) < 1e-30
        assert depth(0.999 * duration) > 0
        restitution = -mp.diff(depth, duration)
    # An error of eps in mu causes an error of about (1 + ln^2 r/pi^2) |ln r| eps in r.
    assert float(restitution) == pytest.approx(r, rel=1e-13, abs=0)
    assert float(pair.omega1) == pytest.approx(float(omega1), rel=1e-12, abs=0)


# --- validation ------------------------------------------------------------------------------------------------------

GRID = np.full((4, 8), 0.5)
GRID[3, 7] = -0.2

REFUSED = [
    (lambda: impact_pair(0.2, 4.0, GRID), "r must lie in (0, 1]; got -0.2 at index (3, 7); an elastic wall is r = 1"),
    (lambda: impact_pair(0.2, 4.0, 0.0), "r must lie in (0, 1]; got 0.0; an elastic wall is r = 1"),
    (lambda: impact_pair(0.2, 4.0, [0.5, 1.5]), "r must lie in (0, 1]; got 1.5 at index 1; an elastic wall is r = 1"),
    (lambda: impact_pair(0.2, 4.0, math.nan), "r must lie in (0, 1]; got nan; "),
    (lambda: impact_pair(0.2, 4.0, "half"), "r must be a real number or an array of them; got 'half'; "),
    (lambda: impact_pair(0.2, 4.0, True), "r must be a real number or an array of them; got True; "),
    (lambda: impact_pair(0.0, 4.0, 0.5), "d must be positive and finite; got 0.0; "),
    (lambda: impact_pair(-1, 4.0, 0.5), "d must be positive and finite; got -1; "),
    (lambda: impact_pair(math.inf, 4.0, 0.5), "d must be positive and finite; got inf; "),
    (
        lambda: impact_pair(0.2, math.inf, 0.5),
        'kappa must be positive and finite; got inf; a rigid wall is wall="rigid"',
    ),
    (lambda: impact_pair(0.2, 0.0, 0.5), "kappa must be positive and finite; got 0.0; "),
    (lambda: impact_pair(0.2, 4.0, 0.5, math.inf), "gamma must be finite; got inf; "),
    (
        lambda: impact_pair([0.1, 0.2], [3.0, 4.0, 5.0], 0.5),
        "d, kappa, r and gamma must broadcast to one shape; got d (2,), kappa (3,), r (), gamma ()",
    ),
    (lambda: impact_pair(0.2, None, 0.5).mu, "kappa must be a number for a membrane's damping"),
    (lambda: Harvester().pair("hard"), "wall must be among soft, rigid, rigid_left, rigid_right; got 'hard'"),
    (lambda: Harvester(omega=0.0), "omega must be positive and finite; got 0.0; it is the forcing frequency in rad/s"),
    (lambda: Harvester(A=-1.0), "A must be positive and finite; got -1.0; "),
    (lambda: Harvester(C_T=-1.0), "C_T must be finite and not negative; got -1.0; "),
    (
        lambda: Harvester(r_b=0.007),
        "r_b must be smaller than R0, the radius of the membrane that the ball sinks into; got",
    ),
    (lambda: Harvester(penetration_limit=0.0), "penetration_limit must be positive; got 0.0; "),
    (
        lambda: with_constants(Harvester(), mass=1.0),
        "mass must be a constant of the device; got 'mass'; known are k, distance, m_b, ",
    ),
    (lambda: with_constants(Harvester(), k=1.0, omega0=2.0), "k and omega0 must not both be given"),
    (lambda: with_constants(Harvester(), k=-1.0), "k must be positive and finite; got -1.0; "),
    (lambda: with_constants(Harvester(), r=2.0), "r must lie in (0, 1]; got 2.0; "),
    (
        lambda: with_pair(Harvester(A=20.0), impact_pair(0.2, 4.0, 0.5, [0.1, 0.6])),
        "gamma must lie in [-g/A, g/A] for an inclination to give it; got 1.22448979591836",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message[:30] for _, message in REFUSED])
def test_arguments_are_validated(call, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_traced_values_are_not_validated():
    assert jax.jit(lambda r: impact_pair(0.2, 4.0, r).r)(-1.0) == -1.0
    assert float(jax.grad(lambda s: Harvester(s=s).pair().d)(-0.3)) == 1.0


def test_impact_pair_broadcasts_and_preserves_single_precision():
    pair = impact_pair(np.ones((3, 1)), np.ones(4), 1)
    assert {field.shape for field in jax.tree.leaves(pair)} == {(3, 4)}
    single = impact_pair(jnp.ones(2, "float32"), 4.0, 1, 0)
    assert {field.dtype for field in jax.tree.leaves(single)} == {jnp.dtype("float32")}
    assert impact_pair(1, 4, 1).d.dtype == jnp.dtype("float64")


def test_a_pair_with_a_membrane_without_restitution_has_r_none():
    assert impact_pair([0.2, 0.3], 40.0, None).r is None
    with pytest.raises(ValueError, match="r_right must"):
        impact_pair(0.2, 40.0, Sides(0.5, None))
