"""The closed-form flow against 50 digits, in all regimes and at the transitions between them."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from benchmarks.yardstick import DIGITS, EPS, mp_flight, mp_oscillate
from vijax.model import flow
from vijax.model.pair import ImpactPair

NEAR_PI = np.pi * (1 + 1e-9)


def contact_cases(rng: np.random.Generator) -> np.ndarray:
    """Return rows kappa, r, c, q, g, w0, z0, s: random cases and extreme cases."""
    count = 600
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e5), count))
    r = np.where(rng.random(count) < 0.2, 10.0 ** rng.uniform(-8, -1, count), rng.uniform(0.02, 1, count))
    corners = [(0.5, 0.5), (0.5, 1.0), (1e5, 0.5), (1e5, 1.0), (np.pi, 1.0), (np.pi, 0.999), (np.pi, 0.5)]
    corners += [(NEAR_PI, 1.0), (3.0, 1.0), (3.3, 0.999), (np.pi, 1e-8), (400.0, 1e-8), (0.5, 1e-8)]
    extra = np.array(corners * 30)
    kappa, r = np.append(kappa, extra[:, 0]), np.append(r, extra[:, 1])
    count = len(kappa)
    # From far below a free half cycle, over the transition max(kappa, pi) s = 1 to the series, to twenty half cycles.
    turns = np.where(rng.random(count) < 0.3, rng.uniform(0.9, 1.1, count), 10.0 ** rng.uniform(-9, 1.8, count))
    s = turns / np.maximum(kappa, np.pi)
    phase, g = rng.uniform(0, 2, count), rng.choice([0.0, 1.0, 3.0], count) * rng.uniform(-1, 1, count)
    z0 = rng.choice([-1.0, 1.0], count) * 10.0 ** rng.uniform(-8, 0, count)
    w0 = rng.choice([0.0, 1.0], count) * rng.uniform(-1, 1, count) / kappa
    return np.stack([kappa, r, np.cos(np.pi * phase), np.sin(np.pi * phase), g, w0, z0, s], axis=1)


@pytest.fixture(scope="module")
def contacts():
    """Cases; (w, w') of the closed form and of its form with rolled loops; contact matrix."""
    cases = contact_cases(np.random.default_rng(1))

    def evaluate(kappa, r, c, q, g, w0, z0, s):
        pair = ImpactPair(jnp.ones_like(r), kappa, r, g)
        wall = flow.membrane(pair)
        force = flow.Force(c, q, g)
        rolled = flow.oscillate(flow.membrane(pair, rolled=True), force, w0, z0, s)
        return flow.oscillate(wall, force, w0, z0, s), rolled, flow.contact_matrix(wall, s), wall.zeta

    return cases, jax.tree.map(np.asarray, jax.jit(jax.vmap(evaluate))(*cases.T))


def test_oscillate_against_fifty_digits(contacts):
    """Errors relative to the free response plus the largest possible effect of the forcing."""
    cases, (direct, rolled, _, _) = contacts
    worst = {"w": 0.0, "z": 0.0}
    with mp.workdps(DIGITS):
        for k, (kappa, r, c, q, g, w0, z0, s) in enumerate(cases):
            w, z = mp_oscillate(*map(mp.mpf, (kappa, r)), tuple(map(mp.mpf, (c, q, g))), *map(mp.mpf, (w0, z0, s)))
            arm = min(s, 1 / kappa)
            size_w = abs(w0) + abs(z0) * arm + (1 + abs(g)) * arm * min(s, max(1 / kappa, arm))
            size_z = kappa * abs(w0) * min(1, kappa * s) + abs(z0) + (1 + abs(g)) * arm
            phases = 1 + kappa * s + np.pi * s  # an angle of that size has lost as many roundings
            for values in (direct, rolled):
                worst["w"] = max(worst["w"], float(abs(values[0][k] - w)) / (size_w * phases))
                worst["z"] = max(worst["z"], float(abs(values[1][k] - z)) / (size_z * phases))
    assert max(worst.values()) < 40 * EPS, worst


def test_a_contact_from_rest_has_relative_precision():
    """Relative errors of w by the forcing alone, for times down to 1e-12, where a difference would lose all digits."""
    s = 10.0 ** np.linspace(-12, 0, 60)
    kappa, r = np.tile([0.5, np.pi, 400.0, 1e5], 15), np.tile([1.0, 0.999, 1e-8], 20)
    s = s / np.maximum(kappa, np.pi)

    def evaluate(kappa, r, s):
        evaluate, zero = jnp.ones_like(s), jnp.zeros_like(s)
        return flow.oscillate(
            flow.membrane(ImpactPair(evaluate, kappa, r, zero)), flow.Force(evaluate, zero, zero), zero, zero, s
        )

    w, z = jax.vmap(evaluate)(kappa, r, s)
    with mp.workdps(DIGITS):
        for k in range(len(s)):
            true = mp_oscillate(mp.mpf(kappa[k]), mp.mpf(r[k]), (mp.mpf(1), 0, 0), 0, 0, mp.mpf(s[k]))
            assert abs(float(float(w[k]) / true[0]) - 1) < 20 * EPS, (kappa[k], r[k], s[k])
            assert abs(float(float(z[k]) / true[1]) - 1) < 20 * EPS, (kappa[k], r[k], s[k])


def test_contact_matrix_has_the_determinant_of_the_damping(contacts):
    cases, (_, _, matrix, zeta) = contacts
    expected = np.exp(-2 * zeta * cases[:, 7])
    size = np.maximum(1, np.abs(matrix[:, 0, 1] * matrix[:, 1, 0]) + np.abs(matrix[:, 0, 0] * matrix[:, 1, 1]))
    assert np.max(np.abs(np.linalg.det(matrix) - expected) / size) < 1e-13


def test_flight_against_fifty_digits():
    rng = np.random.default_rng(2)
    count = 400
    gamma = rng.choice([0.0, 0.3, 2.0], count) * rng.uniform(-1, 1, count)
    t0, s = rng.uniform(0, 2, count), 10.0 ** rng.uniform(-12, 1, count)
    v0 = rng.choice([0.0, 1.0], count) * rng.uniform(-1, 1, count)
    rise, v = jax.jit(jax.vmap(flow.flight))(flow.flight_force(gamma, t0), v0, s)
    with mp.workdps(DIGITS):
        for k in range(count):
            u_true, v_true = mp_flight(*(mp.mpf(x[k]) for x in (gamma, t0, v0, s)))
            arm = min(s[k], 1.0)
            size = abs(v0[k]) * s[k] + abs(gamma[k]) * s[k] ** 2 + arm * s[k]
            assert abs(float(float(rise[k]) - u_true)) < 4 * EPS * size, k
            # The phase t0 is exact, but its sine has a rounding.
            assert abs(float(float(v[k]) - v_true)) < 4 * EPS * (abs(v0[k]) + (1 + abs(gamma[k])) * s[k]), k


def test_half_turn_is_relative_near_zero_and_exact_at_quadrants():
    rng = np.random.default_rng(3)
    s = np.concatenate([10.0 ** rng.uniform(-15, 0, 300), rng.uniform(-6, 6, 300), [0.25, -0.25, 0.75, 1.75]])
    values = np.stack([np.asarray(x) for x in jax.vmap(flow.sin_cos_versine_lag)(s)])
    with mp.workdps(DIGITS):
        for k, x in enumerate(map(mp.mpf, s)):
            truth = (mp.sinpi(x), mp.cospi(x), 2 * mp.sinpi(x / 2) ** 2, mp.pi * x - mp.sinpi(x))
            near = abs(s[k]) < 0.25
            sizes = (
                abs(truth[0]) if near else 1,
                1,
                truth[2] if near else 1,
                abs(truth[3]) if near else 1 + abs(x) * 4,
            )
            for value, true, size in zip(values[:, k], truth, sizes, strict=True):
                assert abs(value - true) <= 3 * EPS * size, (s[k], value)
    sine, cosine = flow.phasor(jnp.arange(-8, 9) / 2)
    assert np.all(np.asarray(sine)[::2] == 0)
    assert np.all(np.asarray(cosine)[1::2] == 0)
    assert np.all(np.abs(np.asarray(sine)[1::2]) == 1)


def test_a_phasor_moves_as_sine_and_cosine_do():
    s = jnp.concatenate([jnp.linspace(-3.0, 3.0, 61), jnp.asarray([1e-9, 0.25, 1.75])])
    sine, cosine = flow.phasor(s)
    moved = jax.jvp(flow.phasor, (s,), (jnp.ones_like(s),))[1]
    np.testing.assert_array_equal(moved, (np.pi * cosine, -np.pi * sine))
    bent = jax.vmap(jax.grad(jax.grad(lambda s: flow.phasor(s)[0])))(s)
    np.testing.assert_allclose(bent, -(np.pi**2) * sine, rtol=0, atol=4 * EPS * np.pi**2)


def test_steady_response_solves_the_equation(contacts):
    cases, _ = contacts
    cases = cases[(cases[:, 0] < 3) | (cases[:, 0] > 3.3)]

    def residual(kappa, r, c, q, g):
        wall = flow.membrane(ImpactPair(kappa, kappa, r, g))
        w = flow.steady_response(wall, flow.Force(c, q, g))
        rate, bend = w.slope(), w.slope().slope()
        s = jnp.asarray(0.37)
        return bend.at(s) + wall.mu * rate.at(s) + kappa**2 * w.at(s) - flow.Force(c, q, g).at(s)

    assert np.max(np.abs(jax.vmap(residual)(*cases[:, :5].T))) < 1e-13


def test_flight_and_rigid_matrices():
    assert np.linalg.det(flow.flight_matrix(jnp.asarray(0.3))) == 1
    matrix = flow.rigid_matrix(jnp.asarray(0.4), jnp.asarray(0.7), jnp.asarray(-1e-6))
    assert np.linalg.det(matrix) == pytest.approx(0.16, rel=1e-12)


def test_a_short_contact_with_balanced_forces_has_relative_precision():
    c, less, s = 0.7, 2.0**-40, 3.7e-8
    wall = flow.membrane(ImpactPair(*(jnp.asarray(x) for x in (0.3, 2.0, 1.0, 0.0))))
    force = flow.Force(*(jnp.asarray(x) for x in (c, 0.0, c - less)))
    w, _ = flow.oscillate(wall, force, jnp.zeros(()), jnp.zeros(()), jnp.asarray(s))
    # Undamped from rest: the Taylor polynomial up to s^4; its next term is smaller than its rounding.
    assert float(w) == pytest.approx(0.5 * less * s**2 - (np.pi**2 * c + 4.0 * less) * s**4 / 24, rel=1e-14, abs=0.0)
