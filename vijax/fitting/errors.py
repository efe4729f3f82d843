"""Standard errors of unknowns, and the combinations of unknowns that the data do not determine.

Derivatives of the equations alone do not suffice. A periodic motion repeats the same equations, and errors of the times
make these differ: the derivatives then seem to determine combinations on which the sum of squares does not depend.
Where a combination is hardly known, others change nonlinearly with it. The sum of squares is therefore evaluated two
standard errors to either side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vijax.fitting.adjustment import Adjustment, Prior, Settled, settle, without
from vijax.fitting.fit_model import FitModel
from vijax.fitting.reliability import reading
from vijax.fitting.series import Series

# If the standard error of a combination of variables (logarithms, mostly) is larger than this, the data do not
# determine it, as the model is not linear that far.
_UNTOLD = 0.25
# If it is larger than this, the data do not depend on the combination at all, and the errors of the others hold.
_NOT_THERE = 1e3
# Unknowns with at least this component in such a combination are named.
_PART = 0.1
# Two standard errors off, the sum of squares rises by 4 if it is quadratic. If it rises by less than `_FLATTER`, the
# standard error is larger; a rise below `_FLAT` is rounding. If it rises by more than `_STEEPER`, its valley is curved,
# and the other directions are minimised over.
_FLATTER, _STEEPER, _FLAT = 2.0, 4.5, 1e-4
# A variable this close to its limit has reached it.
_AT_LIMIT = 1e-3


class Errors(NamedTuple):
    """The covariance of variables, infinite where they are not determined, and the combinations not determined."""

    covariance: np.ndarray
    untold: tuple[tuple[str, ...], ...]


class _Direction(NamedTuple):
    """How well a combination of unknowns is known.

    Attributes:
        spread: Its standard error.
        along: By how much variables change with it, over one standard error [unknown].
        bend: By how much they change besides, on both sides alike, over two standard errors [unknown].
    """

    spread: float
    along: np.ndarray
    bend: np.ndarray


def errors(model: FitModel, series: Series, end: Settled, decisive: np.ndarray) -> Errors:
    """Compute the covariance of the variables, and find the combinations that the data do not determine.

    Args:
        model: The model of the device.
        series: The real impacts.
        end: Where the search ended.
        decisive: Impacts on which the fit rests; errors are those without them.
    """
    names, sure = model.names, end
    for impact in decisive:
        sure = without(series, sure, reading(end, impact))
    task = Adjustment(model, series, aside=~sure.counts)
    _, sizes, ways = np.linalg.svd(sure.slopes, full_matrices=False)
    spreads = 1 / np.maximum(sizes, np.finfo(float).tiny)
    found = [_direction(task, sure, float(spread), k, ways) for k, spread in enumerate(spreads)]
    spreads = np.array([one.spread for one in found])
    vague, absent = spreads > _UNTOLD, spreads > _NOT_THERE
    parts = [tuple(name for name, part in zip(names, way, strict=True) if abs(part) > _PART) for way in ways]
    # A value at its limit is not determined.
    stuck = np.abs(model.limits - end.z).min(axis=0) < _AT_LIMIT
    untold = tuple(dict.fromkeys(part for part, one in zip(parts, vague, strict=True) if one))
    untold += tuple((name,) for name, one in zip(names, stuck, strict=True) if one)
    covariance = np.zeros((len(names), len(names)))
    for one, is_vague in zip(found, vague, strict=True):
        if not is_vague:
            # The bend grows with the square of the error, and is given at two standard errors: 3 / 4^2, as the fourth
            # moment of a standard normal variable is 3.
            covariance += np.outer(one.along, one.along) + 3 / 16 * np.outer(one.bend, one.bend)
    # Every variable may change with a vague combination. With an absent one only its own unknowns change.
    lost = set(names) if (vague & ~absent).any() or stuck.any() else {name for part in untold for name in part}
    return Errors(_lost(covariance, [name in lost for name in names]), untold)


def widened(model: FitModel, known: Errors, ways: np.ndarray, weights: np.ndarray) -> Errors:
    """Widen errors by the distances to other devices that fit as well.

    Args:
        model: The model of the device.
        known: Errors about one device.
        ways: Differences of the variables of other devices from those of that one [device, unknown].
        weights: How probable the others are [device].
    """
    covariance = known.covariance + (ways.T * weights) @ ways
    vague = np.sqrt(np.diag(covariance)) > _UNTOLD
    names = tuple(name for name, one in zip(model.names, vague, strict=True) if one)
    covered = {name for part in known.untold for name in part}
    more = (names,) if not set(names) <= covered else ()
    return Errors(_lost(covariance, vague), known.untold + more)


def _lost(covariance: np.ndarray, lost: Sequence[bool] | np.ndarray) -> np.ndarray:
    """Return a covariance in which some variables have infinite variances."""
    covariance = covariance.copy()
    for k in np.flatnonzero(lost):
        covariance[k, :] = covariance[:, k] = np.nan
        covariance[k, k] = np.inf
    return covariance


def _direction(task: Adjustment, sure: Settled, spread: float, which: int, ways: np.ndarray) -> _Direction:
    """Compute the error of a combination from the least sums of squares two standard errors to either side."""
    way, others = ways[which], np.delete(ways, which, axis=0)
    if not sure.held or spread > _UNTOLD:
        return _Direction(spread, spread * way, np.zeros_like(way))
    (fall, before), (climb, after) = (beside(task, sure, sign * spread * way, others) for sign in (-2, 2))
    rise = (fall + climb) / 2
    if rise < _FLATTER:
        spread *= float(np.sqrt(4 / max(rise, _FLAT)))
        return _Direction(spread, spread * way, np.zeros_like(way))
    return _Direction(spread, spread * way + (after - before) / 4, (after + before) / 2)


def beside(task: Adjustment, sure: Settled, shift: np.ndarray, others: np.ndarray) -> tuple[float, np.ndarray]:
    """Compute the least sum of squares at some distance from where the search ended.

    Args:
        task: The model, the impacts and the equations left out.
        sure: Where the search ended.
        shift: By how much variables change.
        others: Orthonormal directions among which they change besides, so that the sum is least [direction, unknown].

    Returns:
        By how much the sum rises, infinite if equations have no motion there; and by how much variables change besides.
    """
    end = settle(task, sure.z + shift, sure.times)
    if end.held and len(others) and end.chi2 > sure.chi2 + _STEEPER:
        bend = np.clip(end.step(Prior(end.z, _UNTOLD), others), -_UNTOLD, _UNTOLD)
        lower = settle(task, end.z + bend, end.times)
        end = lower if lower.chi2 < end.chi2 else end
    return end.chi2 - sure.chi2, end.z - sure.z - shift
