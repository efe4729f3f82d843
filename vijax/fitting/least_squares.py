"""Least squares over the unknowns: trust regions over adjusted times, with assignment of the impacts.

Far from the solution no times fulfil all equations. A tolerance is therefore added to the errors of the equations
first, and reduced in steps; bounded squares keep false and missed impacts from attracting the unknowns. Then assignment
of impacts and adjustment of times alternate. Equations that no times fulfil are excluded.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from vijax.fitting.adjustment import AdjustedTimes, Adjustment, Prior, adjust_times
from vijax.fitting.assignment import BROKEN, Assignment, assign
from vijax.fitting.fit_model import FitModel
from vijax.fitting.series import Series
from vijax.fitting.time_equations import Equations, linearise
from vijax.fitting.unknowns import DELAY

# Tolerances of the equations, in units of A pi/omega. The first is `_SCALE` times the median absolute residual, at most
# `_LOOSEST`; it is divided by `_TIGHTER` down to `_STRICTEST`. `_LOOSE` is the tolerance for comparing starts.
_SCALE, _LOOSEST, _LOOSE, _STRICTEST, _TIGHTER = 2.0, 1.0, 0.1, 0.001, 5.0
# Limits: alternations of assignment and adjustment, exclusions of equations, and the fraction of excluded equations.
_MOST_TRIALS, _MOST_EXCLUSIONS, _MOST_EXCLUDED = 8, 4, 0.5
# The squared residual where the bounded cost has half of its largest value, and the residual, in standard errors, of an
# equation without a motion.
_BOUND, _LOST = 9.0, 1e3
_MOST_EVALUATIONS, _FINE, _SOFT_FINE = 60, 1e-8, 1e-3
# Prior standard error of variables at the start of a search. It keeps combinations that the data do not determine near
# the start, and hardly moves the others. `_ANYWHERE` is effectively no prior.
_VAGUE, _ANYWHERE = 0.5, 1e3
# The search continues from another start if the mean square residual is above `_POOR`, or the bench has more than
# `_FEW_FAULTS` faults and `_MANY_FAULTS` of all impacts.
_POOR, _FEW_FAULTS, _MANY_FAULTS = 1.5, 6, 0.05
_MOST_PLACES = 5
# Two searches with costs that differ by less have the same result, and no further start is tried.
_ALIKE = 1.0
# Least fraction of equations with a motion at the specified device for a search to start from it.
_ANSWERS = 0.9


@dataclass(frozen=True)
class SearchEnd:
    """The result of a search.

    Attributes:
        assignment: The real impacts and the gaps.
        series: The real impacts.
        end: Unknowns, and times adjusted to them.
    """

    assignment: Assignment
    series: Series
    end: AdjustedTimes

    @property
    def cost(self) -> float:
        """Return the negative logarithm of the probability; infinite if the equations do not hold."""
        excluded = int((~self.end.counts & ~self.assignment.excluded(self.series)).sum())
        used = int(self.end.used.sum())
        if not self.end.is_consistent:
            return math.inf
        # Errors may be larger than stated, by a factor that maximises the probability; that is less probable.
        scale = max(self.end.chi2 / used, 1.0) if used else 1.0
        return (self.end.chi2 / scale + used * math.log(scale)) / 2 + self.assignment.price + BROKEN * excluded

    @property
    def faulty(self) -> float:
        """Return the number of faults of the bench, relative to the largest probable number."""
        return self.assignment.faults / max(_FEW_FAULTS, _MANY_FAULTS * self.assignment.real.size)

    @property
    def poor(self) -> bool:
        """Return True if chance hardly explains the residuals, or the bench would have made too many errors."""
        return not self.end.chi2 < _POOR * self.end.used.sum() or self.faulty > 1


def least_squares(model: FitModel, series: Series, places: list[np.ndarray]) -> list[SearchEnd]:
    """Compute the least sums of squares, the smallest first.

    Args:
        model: The model of the device.
        series: The measured impacts.
        places: Starts of the search, each with the search variable of every unknown (mostly the logarithm of the
            unknown). Further starts are tried while the result is poor.
    """
    ends, tried = [], []
    for place in _sorted_starts(model, series, places):
        tried.append(place)
        prior = Prior(place, _VAGUE)
        ends.append(
            _assign_and_adjust(
                model, series, _reduce_tolerance(model, series, prior, _scale(model, series, place)), prior
            )
        )
        is_repeated = any(abs(ends[-1].cost - result.cost) < _ALIKE for result in ends[:-1])
        if is_repeated or not ends[-1].poor:
            break
    best, first = min(ends, key=lambda result: result.cost), tried[0]
    # Other devices may fit equally well. They are searched for without a prior, and near the first start.
    anywhere = Prior(first, _ANYWHERE)
    ends.append(_assign_and_adjust(model, series, _reduce_tolerance(model, series, anywhere, _LOOSE), anywhere))
    strict = Adjustment(model, best.series, excluded=~best.end.counts)
    if adjust_times(strict, first, best.series.times).is_consistent:
        ends.append(replace(best, end=_minimise(strict, first, best.series.times, Prior(first, _VAGUE))))
    return sorted(ends, key=lambda result: result.cost)


def _sorted_starts(model: FitModel, series: Series, places: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Sort starts by the residuals there; the first one stays first if nearly all its equations have a motion."""
    first, *others = places
    if DELAY not in model.names and linearise(model, series, first, series.times).has_motion.mean() > _ANSWERS:
        yield first
    else:
        others = places
    yield from sorted(others, key=lambda z: _loose_sum(model, series, z))[:_MOST_PLACES]


def _scale(model: FitModel, series: Series, z: np.ndarray) -> float:
    """Compute a tolerance that includes most equations."""
    linear = linearise(model, series, z, series.times)
    equation_residuals = np.where(linear.has_motion, np.abs(linear.equation_residuals), np.inf)
    return float(np.clip(_SCALE * np.median(equation_residuals), _STRICTEST, _LOOSEST))


def _reduce_tolerance(model: FitModel, series: Series, prior: Prior, soft: float) -> np.ndarray:
    """Minimise bounded squares with decreasing tolerances."""
    z = prior.z
    while True:
        z = _minimise_bounded(model, series, z, soft, prior)
        if soft <= _STRICTEST:
            return z
        soft = max(soft / _TIGHTER, _STRICTEST)


def _minimise_bounded(model: FitModel, series: Series, z: np.ndarray, soft: float, prior: Prior) -> np.ndarray:
    """Minimise a sum of bounded squares: equations with a tolerance, at the measured times.

    False and missed impacts leave equations that never hold. As no equation costs more than a bound, these do not
    attract the unknowns.
    """
    errors = linearise(model, series, z, series.times).errors(series, soft)
    last: list[tuple[bytes, Equations]] = []

    def at(z: np.ndarray) -> Equations:
        # SciPy evaluates residuals and slopes at the same point in turn, so that the last linearisation is stored.
        if not last or last[0][0] != z.tobytes():
            last[:] = [(z.tobytes(), linearise(model, series, z, series.times))]
        return last[0][1]

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.append(_residuals(at(z), errors), (z - prior.z) / prior.error)

    def slopes(z: np.ndarray) -> np.ndarray:
        linear = at(z)
        scaled = np.where(linear.has_motion[:, None], linear.by_unknown / errors[:, None], 0.0)
        return np.vstack([scaled, np.eye(len(z)) / prior.error])

    result = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=model.limits, loss=_bounded, xtol=1e-3, ftol=1e-3, max_nfev=_MOST_EVALUATIONS
    )
    return result.x


def _bounded(squares: np.ndarray) -> np.ndarray:
    """Bound squares by the function of Geman and McClure, s / (1 + s/9): its value and first two derivatives."""
    part = 1 / (1 + squares / _BOUND)
    return np.stack([squares * part, part**2, -2 / _BOUND * part**3])


def _loose_sum(model: FitModel, series: Series, z: np.ndarray) -> float:
    """Compute a sum of residuals with a loose tolerance; a logarithm reduces the weight of large ones."""
    linear = linearise(model, series, z, series.times)
    return float(np.log1p(_residuals(linear, linear.errors(series, _LOOSE)) ** 2).sum())


def _residuals(linear: Equations, errors: np.ndarray) -> np.ndarray:
    return np.where(linear.has_motion, np.clip(linear.equation_residuals / errors, -_LOST, _LOST), _LOST)


def _assign_and_adjust(model: FitModel, series: Series, z: np.ndarray, prior: Prior) -> SearchEnd:
    """Alternate assignment of impacts and adjustment of unknowns and times until the assignment does not change.

    Returns:
        The result of least cost.
    """
    assignment, ends = assign(model, series, z, _STRICTEST), []
    for _ in range(_MOST_TRIALS):
        real_impacts = assignment.series(series)
        ends.append(
            SearchEnd(
                assignment,
                real_impacts,
                _adjust_excluding(
                    Adjustment(model, real_impacts, excluded=assignment.excluded(real_impacts)), z, prior
                ),
            )
        )
        z = ends[-1].end.z
        next_assignment = assign(model, series, z)
        if next_assignment.same(assignment):
            break
        assignment = next_assignment
    return min(ends, key=lambda result: result.cost)


def _adjust_excluding(task: Adjustment, z: np.ndarray, prior: Prior) -> AdjustedTimes:
    """Adjust unknowns and times, and exclude equations that no times fulfil, which belong to very slow impacts."""
    end = adjust_times(task, z, task.series.times, prior)
    if not end.is_consistent:
        # Start again from times that fulfil the equations within a tolerance, where the adjustment converges.
        loose = _minimise(replace(task, soft=_STRICTEST), z, task.series.times, prior)
        end = adjust_times(task, loose.z, loose.times, prior)
        end = end if end.is_consistent else _minimise(task, loose.z, loose.times, prior)
    for _ in range(_MOST_EXCLUSIONS):
        excluded = ~end.counts | end.unsettled
        if end.is_consistent or excluded.mean() > _MOST_EXCLUDED:
            break
        end = _minimise(replace(task, excluded=excluded), end.z, end.times, prior)
    return end


def _minimise(task: Adjustment, z: np.ndarray, times: np.ndarray, prior: Prior) -> AdjustedTimes:
    """Minimise the sum of squares over unknowns, and over times at each step."""
    cache: dict[bytes, AdjustedTimes] = {}
    nearest = [times]

    def at(z: np.ndarray) -> AdjustedTimes:
        key = z.tobytes()
        if key not in cache:
            cache[key] = adjust_times(task, z, nearest[0])
        return cache[key]

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.append(at(z).penalised, (z - prior.z) / prior.error)

    def slopes(z: np.ndarray) -> np.ndarray:
        # SciPy evaluates slopes only after an accepted step. Later adjustments start from the times of this step.
        nearest[0] = at(z).times
        return np.vstack([at(z).slopes, np.zeros(len(z)), np.eye(len(z)) / prior.error])

    tolerance = _SOFT_FINE if task.soft else _FINE
    result = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=task.model.limits, xtol=tolerance, ftol=tolerance, max_nfev=_MOST_EVALUATIONS
    )
    return at(result.x)
