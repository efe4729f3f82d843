"""Small dense linear systems by elimination in plain arithmetic.

LAPACK is what one would call. But XLA on CPU runs a batch of it on the thread pool that runs the programs themselves,
and waits there: two programs called from two threads, a tile each, have stopped each other for ever.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def solve(matrix: Float[Array, "row row"], right: Float[Array, " row *side"]) -> Float[Array, " row *side"]:
    """Solve matrix x = right for one right side, or a column each; differentiable in both, every order, both ways.

    Gauss and Jordan's elimination with partial pivoting; not finite where the matrix is singular.
    """
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
        """Clear column k from all rows but the one that becomes its pivot; rows stay where they are."""
        wide, pivots = carry
        column = lax.dynamic_index_in_dim(wide, k, axis=1, keepdims=False)
        chosen = index == jnp.where(pivots < 0, jnp.abs(column), -1.0).argmax().astype(jnp.int32)
        top = jnp.where(chosen[:, None], wide, 0.0).sum(axis=0)
        top = top / lax.dynamic_index_in_dim(top, k, keepdims=False)
        wide = jnp.where(chosen[:, None], top, wide - column[:, None] * top)
        return wide, jnp.where(chosen, k, pivots)

    wide, pivots = lax.fori_loop(0, size, clear, (wide, jnp.full(size, -1, jnp.int32)))
    mine = (pivots == index[:, None])[..., None]
    return jnp.where(mine, wide[:, size:], 0.0).sum(axis=1).reshape(right.shape)
