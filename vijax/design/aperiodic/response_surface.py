"""Response surfaces: averages and extremes in a neighbourhood of a design, fitted to an ensemble of samples.

Averages are fitted by least squares, since they scatter about their surface on either side. Extremes lie on one side
only: the largest depth of a sample is at most the largest depth of its attractor, so its margin is at least the margin
of the attractor. The surface of a margin is therefore the highest plane on or below the margins of all samples. In
chaos the logarithm of the largest depth deviates from a plane by 1e-6 to 1e-5 over 1 to 2 % of kappa.
"""

from typing import NamedTuple

import numpy as np

_SAMPLES_PER_TERM = 6  # terms of second order need this many samples per coefficient
_LARGEST_SLOPE = 1e6  # bound on the change of a margin from the centre to the edge of an ensemble


class Surface(NamedTuple):
    """Quadratic fit of the log-objective and linear fits of the margins about a centre, in the offset of the variables.

    Attributes:
        value, gradient, curvature: Logarithm of the objective at the centre, its slopes and its second derivatives.
        value_error, gradient_error: Standard errors of `value` and `gradient`.
        margins, slopes: Margins at the centre [constraint], negative if a limit is broken, and their slopes
            [constraint, variable].
    """

    value: np.ndarray | np.float64
    gradient: np.ndarray
    curvature: np.ndarray
    value_error: np.ndarray | np.float64
    gradient_error: np.ndarray
    margins: np.ndarray
    slopes: np.ndarray

    def penalised_value(self, step: np.ndarray, price: float) -> float:
        """Return the log-objective at the offset `step`, less `price` times the largest violation at this offset."""
        rise = self.gradient @ step + 0.5 * step @ self.curvature @ step
        return float(self.value + rise + price * min((self.margins + self.slopes @ step).min(), 0.0))


def lowest_surface(size: int, constraints: int = 2) -> Surface:
    """Return a surface of `size` variables with value and margins -inf."""
    lowest, zero_slopes, zero_curvature = np.float64(-np.inf), np.zeros(size), np.zeros((size, size))
    return Surface(
        lowest,
        zero_slopes,
        zero_curvature,
        np.float64(0),
        zero_slopes,
        np.full(constraints, -np.inf),
        np.zeros((constraints, size)),
    )


def fit_surface(offsets: np.ndarray, values: np.ndarray, margins: np.ndarray, *, share: float = 1.0) -> Surface:
    """Fit the surfaces of one ensemble.

    Args:
        offsets: Offset of every sample from the centre, [sample, variable], in pairs of opposite or nearly opposite
            offsets.
        values: The objective of each sample [sample]; at least one is positive.
        margins: Margins of each sample to every constraint [sample, constraint], as logarithms.
        share: Share of the samples with margins on or above the fitted plane; 1 for all samples.
    """
    count, size = offsets.shape
    # Offsets are scaled to [-1, 1], which keeps the normal equations well-conditioned.
    scale = np.maximum(np.abs(offsets).max(axis=0), np.finfo(float).tiny)
    x = offsets / scale
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    terms = np.column_stack([np.ones(count), x, *(x[:, i] * x[:, j] for i, j in pairs)])
    if count < _SAMPLES_PER_TERM * terms.shape[1]:
        terms = terms[:, : 1 + size]
    # The values are fitted, not their logarithms, so that the fit estimates a mean; its logarithm is taken below.
    mean = values.mean()
    coefficients, *_ = np.linalg.lstsq(terms, values / mean, rcond=None)
    residuals = values / mean - terms @ coefficients
    variance = (residuals @ residuals) / max(count - terms.shape[1], 1)
    # Standard errors of ordinary least squares: diag((X^T X)^-1) times the residual variance.
    error = np.sqrt(np.maximum(np.diag(np.linalg.pinv(terms.T @ terms)), 0.0) * variance)
    centre_value, slopes = coefficients[0], coefficients[1 : 1 + size]
    hessian = np.zeros((size, size))
    for (i, j), c in zip(pairs, coefficients[1 + size :], strict=False):
        hessian[i, j] += c
        hessian[j, i] += c
    log_slope = slopes / centre_value
    planes = np.array([_plane_below(x, column, share) for column in margins.T])
    return Surface(
        value=np.log(mean * centre_value),
        gradient=log_slope / scale,
        # Second derivative of log f: f''/f - (f'/f)^2.
        curvature=(hessian / centre_value - np.outer(log_slope, log_slope)) / np.outer(scale, scale),
        value_error=error[0] / centre_value,
        gradient_error=error[1 : 1 + size] / centre_value / scale,
        margins=planes[:, 0],
        slopes=planes[:, 1:] / scale,
    )


def _plane_below(x: np.ndarray, y: np.ndarray, share: float) -> np.ndarray:
    """Return the coefficients (constant, slopes) of the highest plane with a share of the points on or above it.

    "Highest" means the largest mean over the points. For share < 1 this is a quantile regression: each point costs its
    distance from the plane, times 1 - share above the plane and times share below it.
    """
    if share >= 1 and x.shape[1] == 1:
        return _line_below(x[:, 0], y)
    from scipy.optimize import linprog  # imported here: importing vijax must not load SciPy's optimisers

    count, terms = len(y), np.column_stack([np.ones(len(y)), x])
    slope_bounds = [(None, None), *[(-_LARGEST_SLOPE, _LARGEST_SLOPE)] * x.shape[1]]
    if share >= 1:
        # Maximise the mean of the plane subject to plane <= y at every point.
        result = linprog(-terms.mean(axis=0), A_ub=terms, b_ub=y, bounds=slope_bounds, method="highs")
    else:
        # y = plane + above - below, with above >= 0 and below >= 0
        matrix = np.column_stack([terms, np.eye(count), -np.eye(count)])
        cost = np.concatenate([np.zeros(terms.shape[1]), np.full(count, 1 - share), np.full(count, share)])
        result = linprog(cost, A_eq=matrix, b_eq=y, bounds=slope_bounds + [(0, None)] * (2 * count), method="highs")
    # If the program fails, for example with too few samples for a slope, the plane is level.
    return result.x[: terms.shape[1]] if result.success else np.append(np.quantile(y, 1 - share), np.zeros(x.shape[1]))


def _line_below(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return (constant, slope) of the line on or below all points that is highest at the mean of x.

    This line is an edge of the lower hull of the points. It connects one point at or left of the mean with one point
    right of it, and of all such connections it is the lowest at the mean. A linear program returns the same line and
    takes fifty times as long.
    """
    middle = x.mean()
    lower, upper = np.flatnonzero(x <= middle), np.flatnonzero(x > middle)
    if not upper.size:
        return np.array([y.min(), 0.0])
    to_lower, to_upper = middle - x[lower][:, None], x[upper] - middle
    # Height, at the mean of x, of the line through each pair of a left and a right point.
    height_at_mean = (y[lower][:, None] * to_upper + y[upper] * to_lower) / (to_lower + to_upper)
    i, j = np.unravel_index(height_at_mean.argmin(), height_at_mean.shape)
    slope = np.clip((y[upper[j]] - y[lower[i]]) / (x[upper[j]] - x[lower[i]]), -_LARGEST_SLOPE, _LARGEST_SLOPE)
    # The constant is the largest one that keeps the line on or below all points, also with a clipped or rounded slope.
    return np.array([(y - slope * x).min(), slope])
