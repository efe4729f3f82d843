"""Standard errors of unknowns, and combinations of unknowns that the data do not determine.

The derivatives of the equations alone do not suffice. A periodic motion repeats the same equations, and errors of the
times make these differ: the derivatives then seem to determine combinations that the sum of squares does not depend on.
If a combination is poorly determined, others change nonlinearly with it. The sum of squares is therefore evaluated two
standard errors to either side, along the singular vectors of the derivatives.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vijax.fitting.adjustment import AdjustedTimes, Adjustment, Prior, adjust_times, without_equations
from vijax.fitting.fit_model import FitModel
from vijax.fitting.reliability import equations_with
from vijax.fitting.series import Series

# If the standard error of a combination of variables (logarithms, mostly) is larger than this, the data do not
# determine it, because the model is not linear over such a distance.
_UNDETERMINED = 0.25
# If it is larger than this, the data do not depend on the combination at all, and the errors of other combinations
# remain valid.
_NOT_THERE = 1e3
# Unknowns with at least this component in such a combination are named.
_PART = 0.1
# Two standard errors away from the result, the sum of squares rises by 4 if it is quadratic. If it rises by less than
# `_FLATTER`, the standard error is larger; a rise below `_FLAT` is rounding. If it rises by more than `_STEEPER`, its
# valley is curved, and the sum is minimised over the other directions.
_FLATTER, _STEEPER, _FLAT = 2.0, 4.5, 1e-4
# A variable this close to its limit has reached it.
_AT_LIMIT = 1e-3


class Errors(NamedTuple):
    """Errors of the variables.

    Attributes:
        covariance: Covariance of the variables, infinite where they are not determined.
        undetermined: Combinations that are not determined, as tuples of names.
    """

    covariance: np.ndarray
    undetermined: tuple[tuple[str, ...], ...]


class _Direction(NamedTuple):
    """Accuracy of a combination of unknowns.

    Attributes:
        spread: Standard error of the combination.
        along: Change of the variables if the combination changes by one standard error [unknown].
        bend: Change of the variables perpendicular to the combination at two standard errors to either side, equal on
            both sides [unknown].
    """

    spread: float
    along: np.ndarray
    bend: np.ndarray


def errors(model: FitModel, series: Series, end: AdjustedTimes, decisive: np.ndarray) -> Errors:
    """Compute the covariance of the variables, and the combinations that the data do not determine.

    Args:
        model: The model of the device.
        series: The real impacts.
        end: The result of the search.
        decisive: Impacts that determine the fit; errors are computed without them.
    """
    names, reliable = model.names, end
    for impact in decisive:
        reliable = without_equations(series, reliable, equations_with(end, impact))
    task = Adjustment(model, series, excluded=~reliable.counts)
    # The rows of `singular_vectors` are orthonormal combinations of variables; 1/size is the standard error of each.
    _, sizes, singular_vectors = np.linalg.svd(reliable.slopes, full_matrices=False)
    spreads = 1 / np.maximum(sizes, np.finfo(float).tiny)
    directions = [_direction(task, reliable, float(spread), k, singular_vectors) for k, spread in enumerate(spreads)]
    spreads = np.array([entry.spread for entry in directions])
    # An absent combination has no effect on the data; a vague combination has an effect, but is determined too poorly.
    vague, absent = spreads > _UNDETERMINED, spreads > _NOT_THERE
    parts = [
        tuple(name for name, part in zip(names, vector, strict=True) if abs(part) > _PART)
        for vector in singular_vectors
    ]
    # A value at its limit is not determined.
    at_limit = np.abs(model.limits - end.z).min(axis=0) < _AT_LIMIT
    undetermined = tuple(dict.fromkeys(part for part, entry in zip(parts, vague, strict=True) if entry))
    undetermined += tuple((name,) for name, entry in zip(names, at_limit, strict=True) if entry)
    covariance = np.zeros((len(names), len(names)))
    for entry, is_vague in zip(directions, vague, strict=True):
        if not is_vague:
            # The bend grows with the square of the error, and is given at two standard errors. The factor is 3 / 4^2,
            # because the fourth moment of a standard normal variable is 3.
            covariance += np.outer(entry.along, entry.along) + 3 / 16 * np.outer(entry.bend, entry.bend)
    # Every variable may change with a vague combination. With an absent combination only its own unknowns change.
    undetermined_names = (
        set(names) if (vague & ~absent).any() or at_limit.any() else {name for part in undetermined for name in part}
    )
    return Errors(_with_infinite_variances(covariance, [name in undetermined_names for name in names]), undetermined)


def widen(model: FitModel, device_errors: Errors, differences: np.ndarray, weights: np.ndarray) -> Errors:
    """Increase errors by the distances to other devices that fit equally well.

    Args:
        model: The model of the device.
        device_errors: Errors of one device.
        differences: Differences of the variables of other devices from this device [device, unknown].
        weights: Probabilities of the other devices [device].
    """
    covariance = device_errors.covariance + (differences.T * weights) @ differences
    vague = np.sqrt(np.diag(covariance)) > _UNDETERMINED
    names = tuple(name for name, is_vague in zip(model.names, vague, strict=True) if is_vague)
    covered = {name for part in device_errors.undetermined for name in part}
    more = (names,) if not set(names) <= covered else ()
    return Errors(_with_infinite_variances(covariance, vague), device_errors.undetermined + more)


def _with_infinite_variances(covariance: np.ndarray, is_infinite: Sequence[bool] | np.ndarray) -> np.ndarray:
    """Return a covariance with infinite variances of some variables, and NaN covariances with them."""
    covariance = covariance.copy()
    for k in np.flatnonzero(is_infinite):
        covariance[k, :] = covariance[:, k] = np.nan
        covariance[k, k] = np.inf
    return covariance


def _direction(
    task: Adjustment, reliable: AdjustedTimes, spread: float, index: int, directions: np.ndarray
) -> _Direction:
    """Compute the error of a combination from the least sums of squares two standard errors to either side."""
    direction, others = directions[index], np.delete(directions, index, axis=0)
    if not reliable.is_consistent or spread > _UNDETERMINED:
        return _Direction(spread, spread * direction, np.zeros_like(direction))
    (fall, before), (climb, after) = (
        least_sum_at(task, reliable, sign * spread * direction, others) for sign in (-2, 2)
    )
    rise = (fall + climb) / 2
    if rise < _FLATTER:
        spread *= float(np.sqrt(4 / max(rise, _FLAT)))
        return _Direction(spread, spread * direction, np.zeros_like(direction))
    return _Direction(spread, spread * direction + (after - before) / 4, (after + before) / 2)


def least_sum_at(
    task: Adjustment, reliable: AdjustedTimes, shift: np.ndarray, others: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compute the least sum of squares at a distance from the result of the search.

    Args:
        task: The model, the impacts and the equations excluded.
        reliable: The result of the search.
        shift: Change of the variables.
        others: Orthonormal directions for a further change that minimises the sum [direction, unknown].

    Returns:
        The increase of the sum, infinite if equations have no motion there; and the further change of the variables.
    """
    end = adjust_times(task, reliable.z + shift, reliable.times)
    if end.is_consistent and len(others) and end.chi2 > reliable.chi2 + _STEEPER:
        bend = np.clip(end.step(Prior(end.z, _UNDETERMINED), others), -_UNDETERMINED, _UNDETERMINED)
        lower = adjust_times(task, end.z + bend, end.times)
        end = lower if lower.chi2 < end.chi2 else end
    return end.chi2 - reliable.chi2, end.z - reliable.z - shift
