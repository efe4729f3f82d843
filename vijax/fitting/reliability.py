"""Decisive impacts: if one of them is false, no other impact contradicts the fit.

Geodesy calls this external reliability: the change of the unknowns by an error that no test detects. An impact is
decisive if the standard error of an unknown more than doubles without the equations that contain its time. The unknowns
may then have adapted to a false impact, so that its equations hold.
"""

import numpy as np

from vijax.fitting.adjustment import Settled, without
from vijax.fitting.series import Series

# An impact is decisive where the variance of an unknown grows by this factor without it.
_GROWS = 4.0
# Only impacts with at least this leverage can be decisive.
_LEVERAGE = 0.3
_MOST = 5
# Standard error of a variable before anything is measured.
_VAGUE = 0.25


def decisive_impacts(series: Series, end: Settled) -> np.ndarray:
    """Find the decisive impacts, the most decisive first, each without the impacts found before it.

    Args:
        series: The real impacts.
        end: Where the search ended.
    """
    found: list[int] = []
    while len(found) < _MOST:
        growth = {k: _growth(series, end, k) for k in _likely(end, series.times.size)}
        most = max(growth, key=lambda k: growth[k], default=-1)
        if most < 0 or growth[most] < _GROWS:
            break
        found.append(most)
        end = without(series, end, reading(end, most))
    return np.array(found, int)


def reading(end: Settled, impact: int) -> np.ndarray:
    """Return which equations contain the time of an impact [equation]."""
    return np.abs(end.linear.impact - impact) <= 1


def _likely(end: Settled, count: int) -> np.ndarray:
    """List the impacts with a large leverage: the sum over the equations that contain their time."""
    share = np.sum(end.slopes * np.linalg.solve(_information(end), end.slopes.T).T, axis=1)
    leverage = np.bincount(end.linear.impact, share, count)
    return np.flatnonzero(np.convolve(leverage, np.ones(3), mode="same") > _LEVERAGE)


def _growth(series: Series, end: Settled, impact: int) -> float:
    """Compute the largest factor by which the variance of an unknown grows without an impact."""
    rest = without(series, end, reading(end, impact))
    before, after = (np.diag(np.linalg.inv(_information(one))) for one in (end, rest))
    return float((after / before).max())


def _information(end: Settled) -> np.ndarray:
    """Compute the inverse of the covariance of the variables, each of which is known vaguely beforehand."""
    return end.slopes.T @ end.slopes + np.eye(end.slopes.shape[1]) / _VAGUE**2
