"""Linear systems of blocks in a ring: each block involves its own unknowns and the next block's, cyclically.

The Newton system of an orbit with many impacts has this form, bordered by a few unknowns and equations that involve all
blocks. Dense elimination costs the cube of the number of impacts; block elimination is linear in it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from vijax.runtime.numerics import linear_solve


class BlockRing(NamedTuple):
    """A bordered system: D_k x_k + N_k x_(k+1) + C_k z = right_k, R x + S z = bottom.

    Attributes:
        diagonal: D_k: matrix of each block for its own unknowns; the identity in blocks after the closing one.
        next_block: N_k: matrix of each block for the unknowns of the next one; zero after the closing one.
        is_closing: True for the block followed by the first one.
        border_columns: C_k: matrix of each block for the unknowns of the border.
        border_rows: R: matrix of the border's equations for the unknowns of the blocks.
        border_corner: S: matrix of the border's equations for the unknowns of the border.
    """

    diagonal: Float[Array, "block row row"]
    next_block: Float[Array, "block row row"]
    is_closing: Bool[Array, " block"]
    border_columns: Float[Array, "block row border"]
    border_rows: Float[Array, "equation block row"]
    border_corner: Float[Array, "equation border"]

    def bordered(self, rows: Float[Array, "more unknown"]) -> "BlockRing":
        """Return the system with more border equations; columns: the blocks' unknowns, then the border's unknowns."""
        size = self.diagonal[..., 0].size
        below = jnp.concatenate([self.border_rows, rows[:, :size].reshape(-1, *self.diagonal.shape[:2])])
        return self._replace(border_rows=below, border_corner=jnp.concatenate([self.border_corner, rows[:, size:]]))

    @property
    def dense(self) -> Float[Array, "row unknown"]:
        """Return the matrix of the system."""
        blocks, n = self.diagonal.shape[:2]
        index = jnp.arange(blocks, dtype=jnp.int32)
        same_block, next_block = (
            jax.nn.one_hot(place, blocks, dtype=self.diagonal.dtype)[:, None, :, None]
            for place in (index, jnp.where(self.is_closing, 0, index + 1))
        )
        ring = same_block * self.diagonal[:, :, None] + next_block * self.next_block[:, :, None]
        upper = jnp.concatenate([ring.reshape(blocks * n, -1), self.border_columns.reshape(blocks * n, -1)], axis=1)
        return jnp.concatenate(
            [upper, jnp.concatenate([self.border_rows.reshape(-1, blocks * n), self.border_corner], axis=1)]
        )


def solve(
    ring: BlockRing, right: Float[Array, "block row side"], bottom: Float[Array, "border side"]
) -> tuple[Float[Array, "block row side"], Float[Array, "border side"]]:
    """Solve a system for several right-hand sides; return the unknowns of the blocks and of the border.

    The equations that remain from all previous blocks are stacked on the equations of the next block. Pivots are chosen
    among all of these to eliminate the shared unknowns, so that neither the ring alone (singular at a fold) nor each
    block alone (one is singular at a grazing) needs to be regular. A small system in the unknowns of the first block
    and of the border remains. The result is not finite if the whole system is singular.
    """
    n, border = ring.diagonal.shape[1], ring.border_corner.shape[0]
    closing = ring.is_closing[:, None, None]
    # The closing block couples to the first block, every other one to its successor.
    first, to_next = jnp.where(closing, ring.next_block, 0.0), jnp.where(closing, 0.0, ring.next_block)
    border_and_right = jnp.concatenate([ring.border_columns, right], axis=2)
    border_rows = jnp.concatenate([ring.border_corner, bottom], axis=1)
    below = jnp.moveaxis(ring.border_rows, 1, 0)
    after = jnp.concatenate([below[1:], jnp.zeros_like(below[:1])])

    def clear(carry, block):
        """Eliminate the unknowns of a block from the remaining equations, its own equations and the border's."""
        # Columns: this block's unknowns, the first block's, the border's, the right-hand sides.
        remaining, border_equations = carry
        here, first, to_next, border_and_right, after = block
        none = jnp.zeros_like(to_next)
        # Columns of `upper`, `middle` and `lower`: this block's unknowns, the first block's, the next block's, the
        # border's, the right-hand sides.
        upper = jnp.concatenate([remaining[:, : 2 * n], none, remaining[:, 2 * n :]], axis=1)
        middle = jnp.concatenate([here, first, to_next, border_and_right], axis=1)
        lower = jnp.concatenate([border_equations[:, : 2 * n], after, border_equations[:, 2 * n :]], axis=1)
        pivots, others, border_equations = _cleared(jnp.concatenate([upper, middle]), lower, n)

        def ordered(rows):
            # Reorder the columns: the next block's unknowns first, as in the carry.
            return jnp.concatenate([rows[:, n : 2 * n], rows[:, :n], rows[:, 2 * n :]], axis=1)

        return (ordered(others), ordered(border_equations)), pivots

    # Columns as in `clear` before the second block: its unknowns, the first block's, the border's and the right-hand
    # sides.
    remaining = jnp.concatenate([to_next[0], ring.diagonal[0] + first[0], border_and_right[0]], axis=1)
    border_equations = jnp.concatenate([after[0], below[0], border_rows], axis=1)
    scanned = tuple(rows[1:] for rows in (ring.diagonal, first, to_next, border_and_right, after))
    (remaining, border_equations), pivots = lax.scan(clear, (remaining, border_equations), scanned)
    # After the last block the columns of a next block are zero.
    small = jnp.concatenate([remaining, border_equations])[:, n:]
    end_unknowns = linear_solve.solve(small[:, : n + border], small[:, n + border :])
    first_block, z = end_unknowns[:n], end_unknowns[n:]

    def back(later, pivots):
        solved = jnp.concatenate([first_block, later, z])
        unknowns = pivots[:, 2 * n + border :] - pivots[:, : 2 * n + border] @ solved
        return unknowns, unknowns

    _, x = lax.scan(back, jnp.zeros_like(first_block), pivots, reverse=True)
    return jnp.concatenate([first_block[None], x]), z


def _cleared(wide: Float[Array, "row column"], lower: Float[Array, "border column"], n: int):
    """Eliminate the first n columns by partial pivoting.

    Returns:
        The pivot rows, the other rows, and the border's rows, without the first n columns.
    """
    free = jnp.full(2 * n, True)
    index = jnp.arange(2 * n, dtype=jnp.int32)
    pivot_masks = []
    for k in range(n):
        column = wide[:, k]
        is_pivot = index == jnp.where(free, jnp.abs(column), -1.0).argmax().astype(jnp.int32)
        pivot_row = jnp.where(is_pivot[:, None], wide, 0.0).sum(axis=0)
        pivot_row = pivot_row / pivot_row[k]
        wide = jnp.where(is_pivot[:, None], pivot_row, wide - column[:, None] * pivot_row)
        lower = lower - lower[:, k : k + 1] * pivot_row
        free = free & ~is_pivot
        pivot_masks.append(is_pivot)
    # The other rows keep their order: row k is the one with k + 1 free rows up to it.
    order = jnp.cumsum(free.astype(jnp.int32))
    others = [free & (order == k + 1) for k in range(n)]

    def rows(masks):
        return jnp.stack([jnp.where(is_pivot[:, None], wide, 0.0).sum(axis=0) for is_pivot in masks])[:, n:]

    return rows(pivot_masks), rows(others), lower[:, n:]
