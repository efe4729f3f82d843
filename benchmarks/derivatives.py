"""Derivatives of impacts by automatic differentiation, and by differences in 50 digits."""

from functools import cache

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vijax
from benchmarks.yardstick import DIGITS, mp_march
from vijax.model.pair import ImpactPair
from vijax.runtime.compilation.xla import compiler_options

IMPACTS, PERIODS = 3, 4
H = "1e-9"
NAMES = ("t", "v_in", "v_out", "depth", "duration")
# d, kappa, r, gamma, u0, v0
SOFT = [(0.2, 4.0, 0.5, 0.0, 0.02, 0.3), (0.2, 40.0, 0.5, 0.05, 0.02, 0.3), (0.15, 12.0, 0.1, 0.1, 0.02, 0.3)]
RIGID = [(0.12, None, 0.5, 0.0, 0.02, 0.3), (0.25, None, 0.8, 0.1, 0.02, 0.3)]


def events(rigid: bool):
    """Return a function from the vector of parameters to the impacts, [impact, name]."""

    def run(x):
        pair = ImpactPair(x[0], None if rigid else x[1], x[2], x[3])
        impacts = vijax.trajectory(pair, x[4], x[5], PERIODS, max_impacts=IMPACTS).impacts
        time = 2.0 * impacts.n.astype(x.dtype) + impacts.t
        zero = jnp.zeros_like(time)
        return jnp.stack(
            [time, impacts.v_in, impacts.v_out, zero if rigid else impacts.depth, impacts.duration], axis=-1
        )

    return run


@cache
def marched(case):
    """Return the impacts of a case in the current number of digits, and guesses for neighbouring cases."""
    return mp_march(case, IMPACTS)


def differences(case, direction) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second derivatives along a direction by central differences in 50 digits, [impact, name]."""
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
    """Return cases, directions, the first and second derivatives along them by forward mode, and the points."""
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
    batched = jax.vmap(jax.vmap(jet, (None, 0)), (0, None))
    first, second = jax.jit(batched, compiler_options=compiler_options())(points, jnp.asarray(directions))
    return cases, directions, np.asarray(first), np.asarray(second), points


def relative(computed, exact) -> tuple[float, float]:
    """Return the largest errors of first and second derivatives, relative to a floor if a derivative vanishes."""

    def worst(value, exact_value):
        size = np.maximum(np.abs(exact_value), 1e-3 * np.abs(exact_value).max(axis=0, keepdims=True) + 1e-6)
        return float(np.max(np.abs(value - exact_value) / size))

    return worst(computed[0], exact[0]), worst(computed[1], exact[1])
