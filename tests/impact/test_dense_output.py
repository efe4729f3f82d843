"""Dense output of a step: derivatives are consistent with the position, and both ends of the step are interpolated."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

import vijax  # noqa: F401, for 64 bits
from vijax.impact.ode.dense_output import SolverState, dense_output

STEP = 0.3


def made():
    x0, z0, a0, x1, z1, a1 = jnp.asarray(np.random.default_rng(0).normal(size=6))
    ends = (SolverState(x0, z0), SolverState(z0, a0), SolverState(x1, z1), SolverState(z1, a1))
    return dense_output(jnp.asarray(STEP), *ends), (x0, z0, a0), (x1, z1, a1)


def test_derivatives_equal_those_of_the_position():
    dense, _, _ = made()
    of = [dense.position, dense.slope, dense.curvature, dense.third_derivative]
    s = jnp.linspace(0, 1, 5)
    for function, derivative in pairwise(of):
        np.testing.assert_allclose(jax.vmap(jax.grad(function))(s), derivative(s), rtol=1e-13, atol=1e-13)


def test_dense_output_interpolates_state_and_acceleration_at_both_ends():
    dense, *ends = made()
    for s, (x, z, a) in zip((0.0, 1.0), ends, strict=True):
        at = jnp.asarray(s)
        actual = dense.position(at), dense.slope(at) / STEP, dense.curvature(at) / STEP**2
        np.testing.assert_allclose(actual, (x, z, a), rtol=1e-12)
