"""Small systems are solved, also with zero pivots, with derivatives of every order."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax.runtime.numerics import linear_solve


@pytest.mark.parametrize("size", [1, 3, 7])
def test_systems_are_solved(size):
    draw = np.random.default_rng(size)
    matrix, x = draw.normal(size=(64, size, size)), draw.normal(size=(64, size))
    if size > 1:
        matrix[:32, 0, 0] = 0.0  # no pivot where elimination begins
    right = np.einsum("bij,bj->bi", matrix, x)
    solution = jax.jit(jax.vmap(linear_solve.solve))(matrix, right)
    backward = np.abs(np.einsum("bij,bj->bi", matrix, solution) - right).max(axis=1)
    scale = np.abs(matrix).sum(axis=(1, 2)) * np.abs(solution).max(axis=1)
    assert (backward < 1e-14 * scale).all()


def test_several_right_sides_are_solved_as_single_right_sides():
    draw = np.random.default_rng(2)
    matrix, right = draw.normal(size=(5, 5)), draw.normal(size=(5, 3))
    by_column = np.stack([linear_solve.solve(matrix, right[:, k]) for k in range(3)], axis=1)
    np.testing.assert_allclose(linear_solve.solve(matrix, right), by_column, rtol=1e-14)
    slope = jax.jacfwd(lambda b: linear_solve.solve(matrix, b))(right)
    np.testing.assert_allclose(slope, np.einsum("ij,kl->ikjl", np.linalg.inv(matrix), np.eye(3)), rtol=0, atol=1e-12)


def test_derivatives_equal_derivatives_by_lapack():
    draw = np.random.default_rng(0)
    matrix, right = jnp.asarray(draw.normal(size=(5, 5))), jnp.asarray(draw.normal(size=5))

    def norm(solve, right):
        return (solve(matrix * (1 + right[0]), right) ** 2).sum()

    for order in (jax.grad, jax.jacfwd, jax.hessian):
        mine, theirs = (jax.jit(order(partial(norm, solve)))(right) for solve in (linear_solve.solve, jnp.linalg.solve))
        np.testing.assert_allclose(mine, theirs, rtol=1e-10)


def test_a_singular_system_has_no_finite_solution():
    assert not np.isfinite(linear_solve.solve(jnp.ones((2, 2)), jnp.array([1.0, 2.0]))).any()
