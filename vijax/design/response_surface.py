"""Response surfaces: what an ensemble of balls, spread over a neighbourhood, says of averages and of extremes there.

Averages are fitted by least squares; they scatter about their surface on either side. Extremes are not: each ball has
met at most the largest of its attractor, so their surface is the highest plane of room that lies on or below the room
of all of them. In chaos the logarithm of the largest depth is such a plane to 1e-6 .. 1e-5 over 1 to 2 % of kappa.
"""

from typing import NamedTuple

import numpy as np

_BALLS_A_TERM = 6  # terms of second order are fitted where there are so many balls for every coefficient
_STEEP = 1e6  # no slope over the whole ensemble is steeper, as a logarithm


class Surface(NamedTuple):
    """Logarithms of averages and of margins about a centre, as polynomials of the offset in the variables.

    Attributes:
        value, gradient, curvature: Of the objective: its logarithm at the centre, its slopes and second derivatives.
        value_error, gradient_error: Their standard errors.
        margins, slopes: Of what must not be negative, [constraint] and [constraint, variable].
    """

    value: np.ndarray | np.float64
    gradient: np.ndarray
    curvature: np.ndarray
    value_error: np.ndarray | np.float64
    gradient_error: np.ndarray
    margins: np.ndarray
    slopes: np.ndarray

    def worth(self, step: np.ndarray, price: float) -> float:
        """Compute the logarithm of the objective at an offset, less by a price for each unit that limits lack there."""
        rise = self.gradient @ step + 0.5 * step @ self.curvature @ step
        return float(self.value + rise + price * min((self.margins + self.slopes @ step).min(), 0.0))


def unknown(size: int, constraints: int = 2) -> Surface:
    """Make a surface of so many variables below any other."""
    nothing, level, flat = np.float64(-np.inf), np.zeros(size), np.zeros((size, size))
    return Surface(
        nothing, level, flat, np.float64(0), level, np.full(constraints, -np.inf), np.zeros((constraints, size))
    )


def fit(offsets: np.ndarray, values: np.ndarray, margins: np.ndarray, *, share: float = 1.0) -> Surface:
    """Fit the surfaces of one ensemble.

    Args:
        offsets: Of every ball from the centre, [ball, variable], in pairs of opposite ones or nearly so.
        values: The objective that each ball gave [ball], of which at least one is positive.
        margins: What each ball left of every constraint [ball, constraint], as a logarithm.
        share: Part of the balls that a constraint's plane has to lie below.
    """
    count, size = offsets.shape
    scale = np.maximum(np.abs(offsets).max(axis=0), np.finfo(float).tiny)
    x = offsets / scale
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    terms = np.column_stack([np.ones(count), x, *(x[:, i] * x[:, j] for i, j in pairs)])
    if count < _BALLS_A_TERM * terms.shape[1]:
        terms = terms[:, : 1 + size]
    # Of the values themselves, as averages add up; logarithms follow from what was fitted.
    mean = values.mean()
    found, *_ = np.linalg.lstsq(terms, values / mean, rcond=None)
    rest = values / mean - terms @ found
    variance = (rest @ rest) / max(count - terms.shape[1], 1)
    error = np.sqrt(np.maximum(np.diag(np.linalg.pinv(terms.T @ terms)), 0.0) * variance)
    height, rise = found[0], found[1 : 1 + size]
    bend = np.zeros((size, size))
    for (i, j), c in zip(pairs, found[1 + size :], strict=False):
        bend[i, j] += c
        bend[j, i] += c
    slope = rise / height
    planes = np.array([_below(x, column, share) for column in margins.T])
    return Surface(
        value=np.log(mean * height),
        gradient=slope / scale,
        curvature=(bend / height - np.outer(slope, slope)) / np.outer(scale, scale),
        value_error=error[0] / height,
        gradient_error=error[1 : 1 + size] / height / scale,
        margins=planes[:, 0],
        slopes=planes[:, 1:] / scale,
    )


def _below(x: np.ndarray, y: np.ndarray, share: float) -> np.ndarray:
    """Fit the highest plane that lies on or below so many of the points.

    All of them: its mean over the points is largest. A share: quantile regression, in which room above the plane costs
    1 - share and room below it costs share.
    """
    if share >= 1 and x.shape[1] == 1:
        return _line_below(x[:, 0], y)
    from scipy.optimize import linprog  # here, as importing vijax must not load it

    count, terms = len(y), np.column_stack([np.ones(len(y)), x])
    steep = [(None, None), *[(-_STEEP, _STEEP)] * x.shape[1]]
    if share >= 1:
        found = linprog(-terms.mean(axis=0), A_ub=terms, b_ub=y, bounds=steep, method="highs")
    else:
        # y = plane + above - below, with above and below not negative.
        parts = np.column_stack([terms, np.eye(count), -np.eye(count)])
        price = np.concatenate([np.zeros(terms.shape[1]), np.full(count, 1 - share), np.full(count, share)])
        found = linprog(price, A_eq=parts, b_eq=y, bounds=steep + [(0, None)] * (2 * count), method="highs")
    # Where too few balls fix no slope the plane is level.
    return found.x[: terms.shape[1]] if found.success else np.append(np.quantile(y, 1 - share), np.zeros(x.shape[1]))


def _line_below(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit the highest line on or below all points, by the edge of their lower hull at the mean of x.

    Of all lines through a point on either side of the mean that edge is the lowest there. A linear program gives the
    same and takes fifty times as long.
    """
    middle = x.mean()
    left, right = np.flatnonzero(x <= middle), np.flatnonzero(x > middle)
    if not right.size:
        return np.array([y.min(), 0.0])
    before, after = middle - x[left][:, None], x[right] - middle
    height = (y[left][:, None] * after + y[right] * before) / (before + after)
    i, j = np.unravel_index(height.argmin(), height.shape)
    slope = np.clip((y[right[j]] - y[left[i]]) / (x[right[j]] - x[left[i]]), -_STEEP, _STEEP)
    return np.array([(y - slope * x).min(), slope])
