"""Linear systems whose blocks form a ring: each involves its own unknowns and those of the next, the last the first's.

An orbit of many impacts is such a system, with a border of few unknowns and equations that involve all. Dense
elimination would take the cube of the number of impacts; block by block it takes their number.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from vijax.runtime import linear_solve


class Ring(NamedTuple):
    """A system: here_k x_k + there_k x_(k+1) + beside_k z = right_k, below x + corner z = bottom.

    Attributes:
        here: Of each block in its own unknowns; the identity in blocks after the one that closes.
        there: Of each block in the unknowns of the next one; nothing after the one that closes.
        closes: Which block is followed by the first one.
        beside: Of each block in the unknowns of the border.
        below: Of the border's equations in the unknowns of the blocks.
        corner: Of these in those of the border.
    """

    here: Float[Array, "block row row"]
    there: Float[Array, "block row row"]
    closes: Bool[Array, " block"]
    beside: Float[Array, "block row border"]
    below: Float[Array, "equation block row"]
    corner: Float[Array, "equation border"]

    def bordered(self, rows: Float[Array, "more unknown"]) -> "Ring":
        """Give it more equations of the border, in all unknowns: those of the blocks first."""
        size = self.here[..., 0].size
        below = jnp.concatenate([self.below, rows[:, :size].reshape(-1, *self.here.shape[:2])])
        return self._replace(below=below, corner=jnp.concatenate([self.corner, rows[:, size:]]))

    @property
    def dense(self) -> Float[Array, "row unknown"]:
        """Give the matrix of the system."""
        blocks, n = self.here.shape[:2]
        index = jnp.arange(blocks, dtype=jnp.int32)
        own, after = (
            jax.nn.one_hot(place, blocks, dtype=self.here.dtype)[:, None, :, None]
            for place in (index, jnp.where(self.closes, 0, index + 1))
        )
        ring = own * self.here[:, :, None] + after * self.there[:, :, None]
        upper = jnp.concatenate([ring.reshape(blocks * n, -1), self.beside.reshape(blocks * n, -1)], axis=1)
        return jnp.concatenate([upper, jnp.concatenate([self.below.reshape(-1, blocks * n), self.corner], axis=1)])


def solve(
    ring: Ring, right: Float[Array, "block row side"], bottom: Float[Array, "border side"]
) -> tuple[Float[Array, "block row side"], Float[Array, "border side"]]:
    """Solve a system for several right sides at once: the unknowns of the blocks, and those of the border.

    The equations that are left of all blocks so far and those of the next are put below each other; pivots among both
    clear the unknowns that they share, so that none need be regular alone: on a fold the ring without its border is
    singular, at a graze one block. What is left at last is a small system in the first block's unknowns and the
    border's. Not finite where the whole is singular.
    """
    n, border = ring.here.shape[1], ring.corner.shape[0]
    closing = ring.closes[:, None, None]
    first, onward = jnp.where(closing, ring.there, 0.0), jnp.where(closing, 0.0, ring.there)
    told = jnp.concatenate([ring.beside, right], axis=2)
    known = jnp.concatenate([ring.corner, bottom], axis=1)
    below = jnp.moveaxis(ring.below, 1, 0)
    after = jnp.concatenate([below[1:], jnp.zeros_like(below[:1])])

    def clear(carry, block):
        """Clear the unknowns of a block from what is left of those before, its own equations and the border's."""
        left, rest = carry  # columns: this block's unknowns, the first block's, the border's, the right sides
        here, first, onward, told, after = block
        none = jnp.zeros_like(onward)
        upper = jnp.concatenate([left[:, : 2 * n], none, left[:, 2 * n :]], axis=1)
        middle = jnp.concatenate([here, first, onward, told], axis=1)
        lower = jnp.concatenate([rest[:, : 2 * n], after, rest[:, 2 * n :]], axis=1)
        pivots, others, rest = _cleared(jnp.concatenate([upper, middle]), lower, n)

        def ordered(rows):
            return jnp.concatenate([rows[:, n : 2 * n], rows[:, :n], rows[:, 2 * n :]], axis=1)

        return (ordered(others), ordered(rest)), pivots

    # Columns as of `clear` before the second block: the second's unknowns, the first's, the border's and right sides.
    left = jnp.concatenate([onward[0], ring.here[0] + first[0], told[0]], axis=1)
    rest = jnp.concatenate([after[0], below[0], known], axis=1)
    several = tuple(rows[1:] for rows in (ring.here, first, onward, told, after))
    (left, rest), pivots = lax.scan(clear, (left, rest), several)
    small = jnp.concatenate([left, rest])[:, n:]
    ends = linear_solve.solve(small[:, : n + border], small[:, n + border :])
    begin, z = ends[:n], ends[n:]

    def back(later, pivots):
        known = jnp.concatenate([begin, later, z])
        found = pivots[:, 2 * n + border :] - pivots[:, : 2 * n + border] @ known
        return found, found

    _, x = lax.scan(back, jnp.zeros_like(begin), pivots, reverse=True)
    return jnp.concatenate([begin[None], x]), z


def _cleared(wide: Float[Array, "row column"], lower: Float[Array, "border column"], n: int):
    """Clear the first columns by partial pivoting: the pivots' rows, those left of both, without these columns."""
    free = jnp.full(2 * n, True)
    index = jnp.arange(2 * n, dtype=jnp.int32)
    chosen = []
    for k in range(n):
        column = wide[:, k]
        pick = index == jnp.where(free, jnp.abs(column), -1.0).argmax().astype(jnp.int32)
        top = jnp.where(pick[:, None], wide, 0.0).sum(axis=0)
        top = top / top[k]
        wide = jnp.where(pick[:, None], top, wide - column[:, None] * top)
        lower = lower - lower[:, k : k + 1] * top
        free = free & ~pick
        chosen.append(pick)
    order = jnp.cumsum(free.astype(jnp.int32))
    others = [free & (order == k + 1) for k in range(n)]

    def rows(picks):
        return jnp.stack([jnp.where(pick[:, None], wide, 0.0).sum(axis=0) for pick in picks])[:, n:]

    return rows(chosen), rows(others), lower[:, n:]
