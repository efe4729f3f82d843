"""A polynomial fitted to what balls of neighbouring devices gave, with the errors that the scatter of pairs shows."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class LocalFit(NamedTuple):
    """A least-squares fit.

    Attributes:
        found: Coefficients.
        added: What the scatter of each pair of balls has added to them, one degree of freedom less for each term.
        rest: The scatter.
        left: Degrees of freedom that are left.
    """

    found: Float[Array, "term column"]
    added: Float[Array, "pair term column"]
    rest: Float[Array, "ball column"]
    left: Float[Array, ""]

    def errors(self) -> Float[Array, "term column"]:
        """Compute standard errors, with the scatter as it is, pair by pair."""
        return jnp.sqrt((self.added**2).sum(axis=0))


def local_fit(
    x: Float[Array, "ball variable"], y: Float[Array, "ball column"], some: Bool[Array, " ball"], second: bool
) -> LocalFit:
    """Fit columns by polynomials of the offsets, over some of the balls."""
    terms = [jnp.ones_like(x[:, 0]), *x.T]
    if second:
        terms += [x[:, i] * x[:, j] for i in range(x.shape[1]) for j in range(i, x.shape[1])]
    matrix = jnp.where(some[:, None], jnp.stack(terms, axis=1), 0.0)
    # What does not vary (gamma on level ground) has coefficients of 0, without rounding.
    varies = (matrix != 0).any(axis=0)
    solve = jnp.linalg.pinv(matrix.T @ matrix, rtol=1e-12, hermitian=True) @ matrix.T
    solve = jnp.where(varies[:, None], solve, 0.0)
    count = some.sum(dtype=x.dtype)
    left = jnp.where(count > len(terms), count - len(terms), jnp.nan)
    # Too few balls fix nothing.
    found = solve @ y + 0 * left
    rest = jnp.where(some[:, None], y - matrix @ found, 0.0)
    added = (solve.T[:, :, None] * rest[:, None, :]).reshape(-1, 2, *found.shape).sum(axis=1)
    return LocalFit(found, added * jnp.sqrt(count / left), rest, left)
