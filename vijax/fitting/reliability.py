"""Decisive impacts: if one of them is false, no other impact contradicts the fit.

Geodesy calls this external reliability: the change of the unknowns by an error that no test detects. An impact is
decisive if the standard error of an unknown more than doubles without the equations that contain its time. The unknowns
may then have adapted to a false impact, so that its equations hold.
"""

import numpy as np

from vijax.fitting.adjustment import AdjustedTimes, without_equations
from vijax.fitting.series import Series

# An impact is decisive if the variance of an unknown grows by this factor without it (the standard error doubles).
_GROWS = 4.0
# Only impacts with at least this leverage can be decisive.
_LEVERAGE = 0.3
# Largest number of decisive impacts that are searched.
_MOST_DECISIVE = 5
# Prior standard error of a variable, which keeps the information matrix regular.
_PRIOR_ERROR = 0.25


def decisive_impacts(series: Series, end: AdjustedTimes) -> np.ndarray:
    """Find the decisive impacts, the most decisive first, each without the impacts found before it.

    Args:
        series: The real impacts.
        end: The result of the search: unknowns, and times adjusted to them.
    """
    decisive: list[int] = []
    while len(decisive) < _MOST_DECISIVE:
        growth = {k: _growth(series, end, k) for k in _likely(end, series.times.size)}
        most = max(growth, key=lambda k: growth[k], default=-1)
        if most < 0 or growth[most] < _GROWS:
            break
        decisive.append(most)
        end = without_equations(series, end, equations_with(end, most))
    return np.array(decisive, int)


def equations_with(end: AdjustedTimes, impact: int) -> np.ndarray:
    """Return the mask of the equations that contain the time of an impact [equation]."""
    return np.abs(end.linear.impact - impact) <= 1


def _likely(end: AdjustedTimes, count: int) -> np.ndarray:
    """Return the impacts with a large leverage, summed over the equations that contain the time of the impact."""
    # Diagonal of the hat matrix: the leverage of each equation. The convolution sums an impact and its two neighbours.
    share = np.sum(end.slopes * np.linalg.solve(_information(end), end.slopes.T).T, axis=1)
    leverage = np.bincount(end.linear.impact, share, count)
    return np.flatnonzero(np.convolve(leverage, np.ones(3), mode="same") > _LEVERAGE)


def _growth(series: Series, end: AdjustedTimes, impact: int) -> float:
    """Return the largest growth factor of the variance of an unknown without an impact."""
    rest = without_equations(series, end, equations_with(end, impact))
    before, after = (np.diag(np.linalg.inv(_information(settled))) for settled in (end, rest))
    return float((after / before).max())


def _information(end: AdjustedTimes) -> np.ndarray:
    """Compute the inverse of the covariance of the variables, with the prior error `_PRIOR_ERROR` of each."""
    return end.slopes.T @ end.slopes + np.eye(end.slopes.shape[1]) / _PRIOR_ERROR**2
