"""The least sum of squares over the unknowns: trust regions about adjusted times, and an assignment of impacts.

Far from the right device no times make all equations hold. A tolerance is therefore added to the errors of the
equations first, and reduced in steps; bounded squares keep false and missed impacts from attracting the unknowns. Then
assignment of impacts and adjustment of times alternate. Equations that no times satisfy are put aside.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from vijax.fitting.adjustment import Adjustment, Prior, Settled, settle
from vijax.fitting.assignment import BROKEN, Assignment, assign
from vijax.fitting.fit_model import FitModel
from vijax.fitting.mismatch import Equations, linearised
from vijax.fitting.series import Series
from vijax.fitting.unknowns import DELAY

# Equations are kept to within a tolerance, in units of A pi/omega, which falls by a factor to the strictest. The first
# one is so many times their median absolute residual, and at most `_LOOSEST`.
_SCALE, _LOOSEST, _LOOSE, _STRICTEST, _TIGHTER = 2.0, 1.0, 0.1, 0.001, 5.0
# Assignment and adjustment are repeated so often; never more than half of all equations are put aside.
_MOST_TRIALS, _MOST_SHED, _MOST_ASTRAY = 8, 4, 0.5
# The square at which an equation costs half of the bound, and what an equation without a motion counts as.
_BOUND, _LOST = 9.0, 1e3
_MOST_EVALUATIONS, _FINE, _SOFT_FINE = 60, 1e-8, 1e-3
# Standard error with which variables are known where a search begins. It keeps combinations that the data do not tell
# near there, and hardly moves those that they tell.
_VAGUE, _ANYWHERE = 0.5, 1e3
# If the mean square residual is larger than this, or the bench has more faults than these, the search begins at
# another place, too.
_POOR, _FEW_FAULTS, _MANY_FAULTS = 1.5, 6, 0.05
_MOST_PLACES = 5
# Ends whose costs differ by less are the same: there is nothing better near by.
_ALIKE = 1.0
# Where a smaller part of the equations has a motion, the search does not begin.
_ANSWERS = 0.9


@dataclass(frozen=True)
class SearchEnd:
    """The end of a search.

    Attributes:
        assignment: Which impacts are real.
        series: These impacts.
        end: Unknowns and times adjusted to them.
    """

    assignment: Assignment
    series: Series
    end: Settled

    @property
    def cost(self) -> float:
        """Compute the negative logarithm of the probability; infinite where the equations do not hold."""
        shed = int((~self.end.counts & ~self.assignment.aside(self.series)).sum())
        used = int(self.end.used.sum())
        if not self.end.held:
            return math.inf
        # Errors may be larger than was stated, which is less probable.
        scale = max(self.end.chi2 / used, 1.0) if used else 1.0
        return (self.end.chi2 / scale + used * math.log(scale)) / 2 + self.assignment.price + BROKEN * shed

    @property
    def faulty(self) -> float:
        """Compute the faults of the bench, as a part of those that are probable at most."""
        return self.assignment.faults / max(_FEW_FAULTS, _MANY_FAULTS * self.assignment.real.size)

    @property
    def poor(self) -> bool:
        """Return True if chance hardly explains what is left, or the bench would have made too many errors."""
        return not self.end.chi2 < _POOR * self.end.used.sum() or self.faulty > 1


def least_squares(model: FitModel, series: Series, places: list[np.ndarray]) -> list[SearchEnd]:
    """Find the least sums of squares, the least first.

    Args:
        model: What is fitted.
        series: What it is fitted to.
        places: Variables of the unknowns to begin with; those after the first are tried while what is found is poor.
    """
    ends, tried = [], []
    for place in _beginnings(model, series, places):
        tried.append(place)
        prior = Prior(place, _VAGUE)
        ends.append(_assigned(model, series, _annealed(model, series, prior, _scale(model, series, place)), prior))
        alike = any(abs(ends[-1].cost - found.cost) < _ALIKE for found in ends[:-1])
        if alike or not ends[-1].poor:
            break
    best, begin = min(ends, key=lambda found: found.cost), tried[0]
    # Others may fit as well: past what is near by, and near the beginning.
    anywhere = Prior(begin, _ANYWHERE)
    ends.append(_assigned(model, series, _annealed(model, series, anywhere, _LOOSE), anywhere))
    strict = Adjustment(model, best.series, aside=~best.end.counts)
    if settle(strict, begin, best.series.times).held:
        ends.append(replace(best, end=_minimise(strict, begin, best.series.times, Prior(begin, _VAGUE))))
    return sorted(ends, key=lambda found: found.cost)


def _beginnings(model: FitModel, series: Series, places: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Sort places by how much the equations are missed there; the first one stays if nearly all have a motion there."""
    first, *others = places
    if DELAY not in model.names and linearised(model, series, first, series.times).answered.mean() > _ANSWERS:
        yield first
    else:
        others = places
    yield from sorted(others, key=lambda z: _loose_sum(model, series, z))[:_MOST_PLACES]


def _scale(model: FitModel, series: Series, z: np.ndarray) -> float:
    """Compute a tolerance within which most equations hold."""
    linear = linearised(model, series, z, series.times)
    off = np.where(linear.answered, np.abs(linear.off), np.inf)
    return float(np.clip(_SCALE * np.median(off), _STRICTEST, _LOOSEST))


def _annealed(model: FitModel, series: Series, prior: Prior, soft: float) -> np.ndarray:
    """Minimise bounded squares within ever smaller tolerances."""
    z = prior.z
    while True:
        z = _loosely(model, series, z, soft, prior)
        if soft <= _STRICTEST:
            return z
        soft = max(soft / _TIGHTER, _STRICTEST)


def _loosely(model: FitModel, series: Series, z: np.ndarray, soft: float, prior: Prior) -> np.ndarray:
    """Minimise a sum of bounded squares: equations are kept to within a tolerance, at the measured times.

    False and missed impacts leave equations that never hold. As no equation costs more than a bound, these do not
    attract the unknowns.
    """
    errors = linearised(model, series, z, series.times).errors(series, soft)
    last: list[tuple[bytes, Equations]] = []

    def at(z: np.ndarray) -> Equations:
        if not last or last[0][0] != z.tobytes():
            last[:] = [(z.tobytes(), linearised(model, series, z, series.times))]
        return last[0][1]

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.append(_residuals(at(z), errors), (z - prior.z) / prior.error)

    def slopes(z: np.ndarray) -> np.ndarray:
        linear = at(z)
        own = np.where(linear.answered[:, None], linear.by_unknown / errors[:, None], 0.0)
        return np.vstack([own, np.eye(len(z)) / prior.error])

    found = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=model.limits, loss=_bounded, xtol=1e-3, ftol=1e-3, max_nfev=_MOST_EVALUATIONS
    )
    return found.x


def _bounded(squares: np.ndarray) -> np.ndarray:
    """Bound squares by Geman and McClure's function: its value and first two derivatives."""
    part = 1 / (1 + squares / _BOUND)
    return np.stack([squares * part, part**2, -2 / _BOUND * part**3])


def _loose_sum(model: FitModel, series: Series, z: np.ndarray) -> float:
    """Compute how much the equations are missed, kept loosely; a few that are missed by much count little."""
    linear = linearised(model, series, z, series.times)
    return float(np.log1p(_residuals(linear, linear.errors(series, _LOOSE)) ** 2).sum())


def _residuals(linear: Equations, errors: np.ndarray) -> np.ndarray:
    return np.where(linear.answered, np.clip(linear.off / errors, -_LOST, _LOST), _LOST)


def _assigned(model: FitModel, series: Series, z: np.ndarray, prior: Prior) -> SearchEnd:
    """Assign impacts, and adjust unknowns and times to that, in turn, until the assignment stays.

    Returns:
        The end of least cost.
    """
    assignment, ends = assign(model, series, z, _STRICTEST), []
    for _ in range(_MOST_TRIALS):
        own = assignment.series(series)
        ends.append(SearchEnd(assignment, own, _shed(Adjustment(model, own, aside=assignment.aside(own)), z, prior)))
        z = ends[-1].end.z
        again = assign(model, series, z)
        if again.same(assignment):
            break
        assignment = again
    return min(ends, key=lambda found: found.cost)


def _shed(task: Adjustment, z: np.ndarray, prior: Prior) -> Settled:
    """Adjust unknowns and times, and put equations aside that no times satisfy: of impacts that hardly are any."""
    end = settle(task, z, task.series.times, prior)
    if not end.held:
        # Times come to rest from where they satisfy the equations loosely.
        loose = _minimise(replace(task, soft=_STRICTEST), z, task.series.times, prior)
        end = settle(task, loose.z, loose.times, prior)
        end = end if end.held else _minimise(task, loose.z, loose.times, prior)
    for _ in range(_MOST_SHED):
        aside = ~end.counts | end.restless
        if end.held or aside.mean() > _MOST_ASTRAY:
            break
        end = _minimise(replace(task, aside=aside), end.z, end.times, prior)
    return end


def _minimise(task: Adjustment, z: np.ndarray, times: np.ndarray, prior: Prior) -> Settled:
    """Minimise the sum of squares over unknowns, and over times at each step."""
    seen: dict[bytes, Settled] = {}
    nearest = [times]

    def at(z: np.ndarray) -> Settled:
        key = z.tobytes()
        if key not in seen:
            seen[key] = settle(task, z, nearest[0])
        return seen[key]

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.append(at(z).penalised, (z - prior.z) / prior.error)

    def slopes(z: np.ndarray) -> np.ndarray:
        # These are asked for where a step was taken: times are adjusted from there on.
        nearest[0] = at(z).times
        return np.vstack([at(z).slopes, np.zeros(len(z)), np.eye(len(z)) / prior.error])

    fine = _SOFT_FINE if task.soft else _FINE
    found = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=task.model.limits, xtol=fine, ftol=fine, max_nfev=_MOST_EVALUATIONS
    )
    return at(found.x)
