"""Dense output of a step: its derivatives are those of its position, and it meets both ends of the step."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

import vijax  # noqa: F401, for 64 bits
from vijax.engine.dense_output import SolverState, dense_output

STEP = 0.3


def made():
    x0, z0, a0, x1, z1, a1 = jnp.asarray(np.random.default_rng(0).normal(size=6))
    ends = (SolverState(x0, z0), SolverState(z0, a0), SolverState(x1, z1), SolverState(z1, a1))
    return dense_output(jnp.asarray(STEP), *ends), (x0, z0, a0), (x1, z1, a1)


def test_rate_bend_and_jerk_are_derivatives_of_the_position():
    dense, _, _ = made()
    of = [dense.place, dense.rate, dense.bend, dense.jerk]
    s = jnp.linspace(0, 1, 5)
    for function, derivative in pairwise(of):
        np.testing.assert_allclose(jax.vmap(jax.grad(function))(s), derivative(s), rtol=1e-13, atol=1e-13)


def test_it_has_position_velocity_and_acceleration_at_both_ends():
    dense, *ends = made()
    for s, (x, z, a) in zip((0.0, 1.0), ends, strict=True):
        at = jnp.asarray(s)
        found = dense.place(at), dense.rate(at) / STEP, dense.bend(at) / STEP**2
        np.testing.assert_allclose(found, (x, z, a), rtol=1e-12)
