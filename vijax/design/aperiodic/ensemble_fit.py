"""Fit polynomials to the results of samples in neighbouring devices, with errors from the scatter of sample pairs.

With the design matrix X of the samples' offsets, the coefficients are c = (X^T X)^+ X^T y. ^+ is the pseudo-inverse.
Standard errors are sandwich estimates with pairs as clusters: the contributions of the residuals of a pair are summed
before they are squared, because the two samples of a pair share their start.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class LocalFit(NamedTuple):
    """A least-squares fit.

    Attributes:
        coefficients: Coefficients of the polynomial of each column: constant, linear and, if fitted, quadratic terms.
        contributions: Contribution of the residuals of each pair of samples to the coefficients, scaled by the square
            root of count / degrees of freedom.
        residuals: Residuals of the samples; 0 for samples that are left out.
        degrees_of_freedom: Number of included samples less number of terms; NaN if this is not positive.
    """

    coefficients: Float[Array, "term column"]
    contributions: Float[Array, "pair term column"]
    residuals: Float[Array, "sample column"]
    degrees_of_freedom: Float[Array, ""]

    def errors(self) -> Float[Array, "term column"]:
        """Return standard errors from the scatter of the samples, summed pair by pair."""
        return jnp.sqrt((self.contributions**2).sum(axis=0))


def local_fit(
    x: Float[Array, "sample variable"], y: Float[Array, "sample column"], included: Bool[Array, " sample"], second: bool
) -> LocalFit:
    """Fit each column of y by a polynomial of the offsets x.

    Args:
        x: Offsets of the samples; rows 2i and 2i + 1 are a pair.
        y: Columns to fit.
        included: Mask of the samples that are fitted.
        second: True if terms of second order are fitted, too.
    """
    terms = [jnp.ones_like(x[:, 0]), *x.T]
    if second:
        terms += [x[:, i] * x[:, j] for i in range(x.shape[1]) for j in range(i, x.shape[1])]
    # Rows of samples that are left out are zero, which keeps the shapes static under jit.
    matrix = jnp.where(included[:, None], jnp.stack(terms, axis=1), 0.0)
    # If an offset is 0 in all samples (gamma at level ground), its coefficient is set to exactly 0.
    varies = (matrix != 0).any(axis=0)
    # The pseudo-inverse also handles the zero columns.
    solve = jnp.linalg.pinv(matrix.T @ matrix, rtol=1e-12, hermitian=True) @ matrix.T
    solve = jnp.where(varies[:, None], solve, 0.0)
    count = included.sum(dtype=x.dtype)
    degrees_of_freedom = jnp.where(count > len(terms), count - len(terms), jnp.nan)
    # With too few samples `degrees_of_freedom` is NaN, and so are all coefficients.
    coefficients = solve @ y + 0 * degrees_of_freedom
    residuals = jnp.where(included[:, None], y - matrix @ coefficients, 0.0)
    # Rows 2i and 2i + 1 are a pair: their contributions are summed before they are squared.
    contributions = (solve.T[:, :, None] * residuals[:, None, :]).reshape(-1, 2, *coefficients.shape).sum(axis=1)
    return LocalFit(coefficients, contributions * jnp.sqrt(count / degrees_of_freedom), residuals, degrees_of_freedom)
