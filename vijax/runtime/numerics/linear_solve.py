"""Small dense linear systems by Gauss-Jordan elimination in plain arithmetic.

LAPACK is the usual choice. But XLA on CPU runs a batch of LAPACK calls on the thread pool that also runs the programs,
and waits for it: two programs called from two threads, a tile each, have deadlocked.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def solve(matrix: Float[Array, "row row"], right: Float[Array, " row *side"]) -> Float[Array, " row *side"]:
    """Solve matrix x = right for one or several right-hand sides; differentiable to any order, in every mode.

    Gauss-Jordan elimination with partial pivoting; the result is not finite if the matrix is singular.
    """
    # `custom_linear_solve` derives the derivatives from the solution: no derivative passes through the elimination.
    return lax.custom_linear_solve(
        lambda x: (matrix[..., None] * x.reshape(x.shape[0], -1)).sum(axis=1).reshape(x.shape),
        right,
        lambda _, b: _eliminated(matrix, b),
        lambda _, b: _eliminated(matrix.T, b),
    )


def _eliminated(matrix: Float[Array, "row row"], right: Float[Array, " row *side"]) -> Float[Array, " row *side"]:
    size = right.shape[0]
    index = jnp.arange(size, dtype=jnp.int32)
    wide = jnp.concatenate([matrix, right.reshape(size, -1)], axis=1)

    def clear(k, carry):
        """Clear column k from all rows except its pivot row; rows are not swapped."""
        wide, pivots = carry
        column = lax.dynamic_index_in_dim(wide, k, axis=1, keepdims=False)
        # The pivot is the largest entry among rows that are not yet pivots.
        is_pivot = index == jnp.where(pivots < 0, jnp.abs(column), -1.0).argmax().astype(jnp.int32)
        pivot_row = jnp.where(is_pivot[:, None], wide, 0.0).sum(axis=0)
        pivot_row = pivot_row / lax.dynamic_index_in_dim(pivot_row, k, keepdims=False)
        wide = jnp.where(is_pivot[:, None], pivot_row, wide - column[:, None] * pivot_row)
        return wide, jnp.where(is_pivot, k, pivots)

    wide, pivots = lax.fori_loop(0, size, clear, (wide, jnp.full(size, -1, jnp.int32)))
    # Row of each unknown: pivots[row] is the column that the row was the pivot of.
    row_of_unknown = (pivots == index[:, None])[..., None]
    return jnp.where(row_of_unknown, wide[:, size:], 0.0).sum(axis=1).reshape(right.shape)
