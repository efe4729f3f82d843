"""Derivatives of impacts against 50-digit differences, stroboscopic states, and errors at the door."""

import math
from functools import cache

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import DIGITS, mp_march

import vijax
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.runtime.xla import compiler_options

IMPACTS, PERIODS = 3, 4
H = "1e-9"
NAMES = ("t", "v_in", "v_out", "depth", "duration")
# d, kappa, r, gamma, u0, v0
SOFT = [(0.2, 4.0, 0.5, 0.0, 0.02, 0.3), (0.2, 40.0, 0.5, 0.05, 0.02, 0.3), (0.15, 12.0, 0.1, 0.1, 0.02, 0.3)]
RIGID = [(0.12, None, 0.5, 0.0, 0.02, 0.3), (0.25, None, 0.8, 0.1, 0.02, 0.3)]


def events(rigid: bool):
    """Impacts as one array [impact, name] of the parameters as one vector."""

    def run(x):
        pair = ImpactPair(x[0], None if rigid else x[1], x[2], x[3])
        hits = vijax.trajectory(pair, x[4], x[5], PERIODS, max_impacts=IMPACTS).impacts
        time = 2.0 * hits.n.astype(x.dtype) + hits.t
        zero = jnp.zeros_like(time)
        return jnp.stack([time, hits.v_in, hits.v_out, zero if rigid else hits.depth, hits.duration], axis=-1)

    return run


@cache
def marched(case):
    """The impacts of a case in as many digits as are in force, and guesses for its neighbours."""
    return mp_march(case, IMPACTS)


def differences(case, direction) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative along a direction by central differences in 50 digits, [impact, name]."""
    with mp.workdps(DIGITS):
        h = mp.mpf(H)
        middle, guesses = marched(case)

        def at(factor):
            moved = [
                None if x is None else mp.mpf(x) + factor * h * mp.mpf(w) for x, w in zip(case, direction, strict=True)
            ]
            return mp_march(moved, IMPACTS, guesses)[0]

        ahead, behind = at(1), at(-1)
        table = [[[getattr(row, name) for name in NAMES] for row in rows] for rows in (behind, middle, ahead)]
        first, second = np.empty((2, IMPACTS, len(NAMES)))
        for i in range(IMPACTS):
            for j in range(len(NAMES)):
                low, here, high = (rows[i][j] for rows in table)
                first[i, j], second[i, j] = (high - low) / (2 * h), (high - 2 * here + low) / h**2
        return first, second


def derivatives(rigid: bool):
    """Cases, directions, first and second derivatives along them by forward mode, and the parameters' points."""
    cases = RIGID if rigid else SOFT
    directions = np.delete(np.eye(6), 1, axis=0) if rigid else np.eye(6)
    mixed = np.random.default_rng(0).uniform(-1, 1, 6)
    mixed[1] *= not rigid
    directions = np.vstack([directions, mixed])
    run = events(rigid)

    def jet(x, w):
        def slope(y):
            return jax.jvp(run, (y,), (w,))[1]

        return jax.jvp(slope, (x,), (w,))

    points = jnp.asarray([[0.0 if x is None else x for x in case] for case in cases])
    every = jax.vmap(jax.vmap(jet, (None, 0)), (0, None))
    first, second = jax.jit(every, compiler_options=compiler_options())(points, jnp.asarray(directions))
    return cases, directions, np.asarray(first), np.asarray(second), points


def relative(got, want) -> tuple[float, float]:
    """Largest errors of first and second derivatives, over the larger ones where one vanishes."""
    worst = []
    for value, true in zip(got, want, strict=True):
        size = np.maximum(np.abs(true), 1e-3 * np.abs(true).max(axis=0, keepdims=True) + 1e-6)
        worst.append(float(np.max(np.abs(value - true) / size)))
    return tuple(worst)


@pytest.fixture(scope="module", params=["soft", "rigid"])
def jets(request):
    rigid = request.param == "rigid"
    return rigid, *derivatives(rigid)


def test_first_and_second_derivatives(jets):
    _, cases, directions, first, second, _ = jets
    for i, case in enumerate(cases):
        for j, direction in enumerate(directions):
            errors = relative((first[i, j], second[i, j]), differences(case, direction))
            assert errors[0] < 1e-9, (case, direction)
            assert errors[1] < 1e-6, (case, direction)


def test_reverse_is_forward(jets):
    rigid, _, directions, first, _, points = jets
    reverse = jax.jit(jax.vmap(jax.jacrev(events(rigid))))(points)
    pushed = np.einsum("cinp,wp->cwin", reverse, directions)
    assert np.allclose(pushed, first, rtol=1e-11, atol=1e-11)


def test_restarting_from_a_stroboscopic_state_goes_on_the_same():
    pair = impact_pair([0.2, 0.2, 0.15], [4.0, 40.0, 12.0], [0.5, 0.5, 0.1], [0.0, 0.05, 0.1])
    whole = vijax.trajectory(pair, 0.02, 0.3, 6)
    flying = np.asarray(whole.states.mode[:, 2] == 0)
    # Of as many periods, so that one program is compiled.
    again = vijax.trajectory(pair, whole.states.u[:, 2], whole.states.v[:, 2], 6)
    assert np.allclose(again.states.u[flying, :3], whole.states.u[flying, 3:], rtol=0, atol=1e-11)
    assert np.allclose(again.states.v[flying, :3], whole.states.v[flying, 3:], rtol=0, atol=1e-10)
    # In a contact the position and the velocity are the state as well.
    assert np.allclose(again.states.u[:, :3], whole.states.u[:, 3:], rtol=0, atol=1e-10)
    assert np.all(np.asarray(whole.status) == Status.OK)


def test_too_few_impacts_are_said():
    pair = impact_pair(0.2, 40.0, 0.5)
    short = vijax.trajectory(pair, 0.02, 0.3, 4, max_impacts=2)
    assert int(short.status) == Status.EVENT_BUDGET
    assert int(short.filled) == 2
    assert np.isnan(np.asarray(short.states.u))[-1]


def test_a_ball_that_touches_nothing():
    quiet = vijax.trajectory(impact_pair(1.0, 40.0, 0.5), -1 / np.pi**2, 0.0, 4, max_impacts=2)
    assert int(quiet.status) == Status.NO_IMPACT
    assert int(quiet.filled) == 0
    assert np.allclose(quiet.states.u, -1 / np.pi**2, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"periods": 0}, "periods"),
        ({"max_impacts": 0}, "max_impacts"),
        ({"pair": ImpactPair(0.2, 40.0, 1.2, 0.0)}, "r must"),
        ({"pair": ImpactPair(-0.2, 40.0, 0.5, 0.0)}, "d must"),
        ({"pair": ImpactPair(0.2, np.inf, 0.5, 0.0)}, "kappa must"),
        ({"u0": np.nan}, "u0"),
        ({"pair": ImpactPair(0.2, None, 0.5, 0.0), "u0": 0.3}, "u0"),
    ],
)
def test_bad_input_is_named(arguments, says):
    given = {"pair": ImpactPair(0.2, 40.0, 0.5, 0.0), "u0": 0.0, "v0": 0.3, "periods": 4} | arguments
    with pytest.raises(ValueError, match=says):
        vijax.trajectory(**given)


RELEASED = math.acos(0.196) / math.pi  # where gravity of 0.196 is all that acts


@pytest.mark.parametrize("kappa", [None, 3.0, math.pi * (1 - 1e-9), 40.0])
def test_a_start_at_rest_on_a_wall_is_no_impact(kappa):
    # Where the force is zero at the start, what it is about to do decides: 1e-16 of a period of flight is none.
    phases = [0.0, 0.5, 1.0, 1.5, RELEASED, 2 - RELEASED]
    gamma, t0, r, side = (x.ravel() for x in np.meshgrid([-1.0, -0.196, 0.0, 0.196, 1.0], phases, [0.5, 1.0], [-1, 1]))
    some = (np.abs(gamma) < 1) | (r < 1)  # an elastic wall that holds the ball for ever is never left
    gamma, t0, r, side = (x[some] for x in (gamma, t0, r, side))
    pair = impact_pair(0.3, kappa, r, gamma)
    hits = vijax.trajectory(pair, 0.15 * side, 0.0, periods=1, t0=t0, max_impacts=2).impacts
    speed = np.abs(hits.v_in)
    assert np.isfinite(speed).any()
    assert not (speed < 1e-6).any()
