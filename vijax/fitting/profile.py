"""Least squares over the unknowns, the times of all impacts being free within their errors.

For given unknowns the times are moved as little as makes all equations hold: Gauss and Helmert's adjustment. What that
takes, in standard errors, is what Levenberg and Marquardt's method makes small. An error of a time that two equations
share is counted once, so that the standard errors of the unknowns are right.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.sparse

from vijax.fitting.fitted import delay_unit
from vijax.fitting.interval import Motion
from vijax.fitting.mismatch import Equations, FitModel, linearised
from vijax.fitting.series import Series

# Equations are kept to within this, in units of A pi/omega, at first: far from the right device none can hold.
_SOFT = (0.1, 0.02, 0.005, 0.001)
# The adjustment of times ends when none moves by this part of its error any more, or after so many steps.
_SETTLED = 1e-4
_MOST_STEPS, _MOST_FREE_STEPS = 12, 40
# Steps that shrink by less are swinging.
_SHRINKS, _HALF = 0.5, 0.5
# No time moves by more than this part of the way to the next one.
_FARTHEST = 0.3
# An equation that is missed by so many standard errors while others hold is of an impact that was missed, or of two
# that were taken for one. It goes aside, in a few trials; but never more than half of all.
_ASTRAY = 6.0
# One that is missed by less beside the others is taken back, unless the mean square grows by more than this.
_TAKEN_BACK, _WORSE = 3.0, 1.2
_MOST_TRIALS = 5
_MOST_ASTRAY = 0.5
# An equation without a motion counts as one that is missed by so many standard errors.
_UNANSWERED = 10.0
_MOST_EVALUATIONS = 60
# A mean square residual of more than this is looked for elsewhere, too.
_POOR = 2.0
# Where a smaller part of the equations has a motion, the search does not begin.
_ANSWERS = 0.9
# By what part the variance of an equation is its own at least; by more where no factor is found.
_INDEPENDENT = 1e-9, 1e-6, 1e-3
# No variable of an unknown changes by more in one step.
_LONGEST = 0.3


@dataclass(frozen=True)
class Settled:
    """Times adjusted to some unknowns.

    Attributes:
        z: Variables of the unknowns.
        times: As adjusted [s] [impact].
        linear: The equations there.
        factor: Cholesky factor of their covariance, banded.
        off: What the measured times miss them by, to first order [equation].
        kept: Derivatives of those that are used by the times, sparse [equation, impact].
        counts: Which of them were not put aside before.
        used: Which of those have a motion.
        restless: Which of them read times that the adjustment did not bring to rest.
    """

    z: np.ndarray
    times: np.ndarray
    linear: Equations
    factor: np.ndarray
    off: np.ndarray
    kept: Any
    counts: np.ndarray
    used: np.ndarray
    restless: np.ndarray

    @property
    def held(self) -> bool:
        """Say whether all equations hold that count."""
        return not self.restless.any()

    def white(self, values: np.ndarray) -> np.ndarray:
        """Bring values of the equations [equation, ...] to independent errors of 1."""
        used = self.used if values.ndim == 1 else self.used[:, None]
        return scipy.linalg.solve_banded((len(self.factor) - 1, 0), self.factor, np.where(used, values, 0.0))

    @property
    def residuals(self) -> np.ndarray:
        """Compute what the equations are missed by, with independent errors of 1 [equation]."""
        return self.white(self.off)

    @property
    def slopes(self) -> np.ndarray:
        """Compute the derivatives of the residuals by the variables [equation, unknown]."""
        return self.white(self.linear.by_unknown)

    @property
    def chi2(self) -> float:
        """Sum the squares of the residuals; infinite where the equations do not hold."""
        return float(np.sum(self.residuals**2)) if self.held else np.inf


@dataclass(frozen=True)
class _Adjustment:
    """What is fitted to what, how strictly, and without which equations."""

    model: FitModel
    series: Series
    limits: np.ndarray
    soft: float = 0.0
    aside: np.ndarray | None = None


def settle(task: _Adjustment, z: np.ndarray, times: np.ndarray, *, free: bool = False) -> Settled:
    """Adjust times to unknowns, from times to begin with.

    Args:
        task: What is fitted to what.
        z: Variables of the unknowns.
        times: Onsets to begin with [s].
        free: Whether to adjust the unknowns as well, in the same steps, which is quick near the right ones.
    """
    series = task.series
    gaps = np.diff(series.times)
    most = _FARTHEST * np.minimum(np.append(gaps, np.inf), np.insert(gaps, 0, np.inf))
    enough = _SETTLED * series.timing_error
    part, last, lost, near = 1.0, np.inf, False, None
    for _ in range(_MOST_FREE_STEPS if free else _MOST_STEPS):
        # An equation that once had no motion stays away: it would come and go, and no time would come to rest.
        now = _settled(task, z, times, lost, near)
        near = now.linear.motions
        lost = now.counts & ~now.used
        off, farther = now.off, np.zeros_like(z)
        if free:
            farther = np.clip(z + np.linalg.lstsq(now.slopes, -now.residuals)[0], *task.limits) - z
            farther = np.clip(farther, -_LONGEST, _LONGEST)
            off = off + np.where(now.used, now.linear.by_unknown @ farther, 0.0)
        moved = series.timing_error**2 * (now.kept.T @ scipy.linalg.cho_solve_banded((now.factor, True), off))
        step = series.times - np.clip(moved, -most, most) - times
        # Steps that swing to and fro are halved: their mean lies nearer.
        size = np.abs(step).max()
        part, last = (part if size < _SHRINKS * last else _HALF), size
        times, z = times + part * step, z + part * farther
        if size < enough:
            break
    resting = now.kept.astype(bool) @ (np.abs(step) >= enough)
    return replace(now, restless=lost | (now.counts & resting))


def _settled(task: _Adjustment, z: np.ndarray, times: np.ndarray, lost: Any, near: Motion | None) -> Settled:
    """Linearise about unknowns and times, which are not yet at rest, without what was lost."""
    series = task.series
    linear = linearised(task.model, series, z, times, near)
    counts = np.ones(linear.off.size, bool) if task.aside is None else ~task.aside
    used = linear.answered & counts & ~np.bool_(lost)
    kept = scipy.sparse.diags_array(used.astype(float)) @ _finite(linear.by_time)
    off = np.where(used, linear.off + kept @ (series.times - times), 0.0)
    factor = _factor(series.timing_error**2 * (kept @ kept.T), linear.own_variance + task.soft**2, used)
    return Settled(z, times, linear, factor, off, kept, counts, used, counts)


def _finite(matrix: Any) -> Any:
    matrix = matrix.copy()
    matrix.data = np.nan_to_num(matrix.data, nan=0.0, posinf=0.0, neginf=0.0)
    return matrix


def _factor(shared: Any, own: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Factorise a covariance, of which a few diagonals are not 0; equations that do not count are on their own."""
    count = shared.shape[0]
    width = min(5, count)
    bands = np.zeros((width, count))
    for k in range(width):
        bands[k, : count - k] = shared.diagonal(-k)
    bands[0] = np.where(used, bands[0] + own, 1.0)
    # Equations that read nearly the same are told apart by rounding alone, and of some rounding makes no covariance.
    for more in _INDEPENDENT:
        try:
            return scipy.linalg.cholesky_banded(np.vstack([bands[0] * (1 + more), bands[1:]]), lower=True)
        except scipy.linalg.LinAlgError:
            continue
    return np.vstack([np.sqrt(bands[0]), 0 * bands[1:]])


def least_squares(model: FitModel, series: Series, begin: np.ndarray, limits: np.ndarray) -> list[Settled]:
    """Find the least sums of squares, the least first.

    One search keeps the equations loosely first and ever more strictly, which leads there from far away, but sometimes
    past what is near. Another is strict from the beginning on, where times can be adjusted to that.

    Args:
        model: What is fitted.
        series: What it is fitted to.
        begin: Variables of the unknowns to begin with.
        limits: Least and largest ones [2, unknown].
    """
    begin = np.clip(begin, *limits)
    z, times = begin, series.times
    for soft in _SOFT:
        loose = _Adjustment(model, series, limits, soft)
        found = _minimise(loose, z, times)
        z, times = found.z, found.times
    near = _without(model, series, limits, found, _astray(loose, found))
    ends, strict = [near], _Adjustment(model, series, limits, aside=~near.counts)
    poor = not near.held or near.chi2 > _POOR * near.used.sum()
    if poor or settle(strict, begin, series.times).held:
        ends.append(_minimise(strict, begin, series.times))
    return sorted(ends, key=lambda end: (end.restless.sum(), end.chi2))


def _without(model: FitModel, series: Series, limits: np.ndarray, found: Settled, aside: np.ndarray) -> Settled:
    """Adjust unknowns and times near where they were found, without the equations that cannot hold there.

    What would hold beside the others after all, once they do, is taken back.
    """
    end = _shed(model, series, limits, found, aside)
    for _ in range(_MOST_TRIALS):
        every = _settled(_Adjustment(model, series, limits), end.z, end.times, False, None)
        fewer = ~end.counts & _wrong(every, _TAKEN_BACK)
        if not end.held or (fewer == ~end.counts).all():
            break
        again = _shed(model, series, limits, end, fewer)
        worse = again.chi2 / again.used.sum() > _WORSE * end.chi2 / end.used.sum()
        if worse or again.counts.sum() <= end.counts.sum():
            break
        end = again
    # Where a motion is false, one of the two equations that read it may hold by chance: it would pull the others along.
    beside = _beside(end.linear, ~end.counts)
    if end.held and beside.mean() <= _MOST_ASTRAY:
        end = _shed(model, series, limits, end, beside)
    return end


def _beside(linear: Equations, aside: np.ndarray) -> np.ndarray:
    """Find equations that are about an impact next to one of some others, those included."""
    impacts = np.append(linear.impact[aside], [-2])
    return np.abs(linear.impact[:, None] - impacts).min(axis=1) <= 1


def _shed(model: FitModel, series: Series, limits: np.ndarray, found: Settled, aside: np.ndarray) -> Settled:
    """Put equations aside until the others hold: no times satisfy an impact that hardly is one."""
    end, z, times = found, found.z, found.times
    for _ in range(_MOST_TRIALS):
        end = settle(_Adjustment(model, series, limits, aside=aside), z, times, free=True)
        aside, z, times = aside | end.restless, end.z, end.times
        if end.held or aside.mean() > _MOST_ASTRAY:
            break
    return end


def _wrong(found: Settled, limit: float) -> np.ndarray:
    """Find the equations that are missed by more than some standard errors, or that no motion answers."""
    return ~found.linear.answered | (np.abs(found.off) > limit * np.sqrt(_variances(found.factor)))


def answers(model: FitModel, series: Series, z: np.ndarray) -> bool:
    """Say whether nearly all impacts have a motion to the next one with some unknowns."""
    return bool(linearised(model, series, z, series.times).answered.mean() > _ANSWERS)


def best_begin(model: FitModel, series: Series, places: list[np.ndarray]) -> np.ndarray:
    """Choose where to begin: where the equations, kept loosely, are missed least at the measured times."""
    task = _Adjustment(model, series, np.zeros((2, 0)), _SOFT[0])

    def doubt(z: np.ndarray) -> float:
        return float((_penalised(_settled(task, z, series.times, False, None)) ** 2).sum())

    return min(places, key=doubt)


def rises(model: FitModel, series: Series, end: Settled, way: np.ndarray) -> float:
    """Say by how much the sum of squares rises to either side of where it is least, on average; infinite if it is lost.

    Args:
        model: What was fitted.
        series: What it was fitted to.
        end: Where it is least.
        way: By how much variables change.
    """
    task = _Adjustment(model, series, np.array([end.z, end.z]), aside=~end.counts)
    return float(np.mean([settle(task, end.z + sign * way, end.times).chi2 for sign in (-1, 1)]) - end.chi2)


def _penalised(end: Settled) -> np.ndarray:
    """Give the residuals, and one more of the equations that no motion answers."""
    return np.append(end.residuals, _UNANSWERED * np.sqrt((end.counts & ~end.used).sum()))


def _minimise(task: _Adjustment, z: np.ndarray, times: np.ndarray) -> Settled:
    """Make the sum of squares small from some unknowns and times on."""
    seen: dict[bytes, Settled] = {}
    nearest = [times]

    def at(z: np.ndarray) -> Settled:
        key = z.tobytes()
        if key not in seen:
            seen[key] = settle(task, z, nearest[0])
        return seen[key]

    def residuals(z: np.ndarray) -> np.ndarray:
        return _penalised(at(z))

    def slopes(z: np.ndarray) -> np.ndarray:
        # These are asked for where a step was taken: times are adjusted from there on.
        nearest[0] = at(z).times
        return np.vstack([at(z).slopes, np.zeros(len(z))])

    fine = 1e-3 if task.soft else 1e-8
    found = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=task.limits, xtol=fine, ftol=fine, max_nfev=_MOST_EVALUATIONS
    )
    return at(found.x)


def _astray(task: _Adjustment, found: Settled) -> np.ndarray:
    """Find the equations that cannot be meant to hold: of impacts that were missed, or are none."""
    linear, wrong = found.linear, _wrong(found, _ASTRAY)
    # A flight through a wall would have met it. Times and unknowns are not yet right, and let it pass a little.
    fastest = float(np.nanmax(linear.speeds, initial=0.0))
    slack = _ASTRAY * task.series.timing_error / delay_unit(task.model.device) * fastest + _SOFT[-1]
    reads = abs(_finite(linear.by_time)) > 0
    wrong |= (reads[:, :-1].multiply(reads[:, 1:]) @ (linear.outside > slack)) > 0
    return wrong if wrong.mean() <= _MOST_ASTRAY else np.zeros_like(wrong)


def _variances(factor: np.ndarray) -> np.ndarray:
    """Compute the diagonal of a covariance from its Cholesky factor."""
    count = factor.shape[1]
    squares = (np.append(np.zeros(k), row[: count - k] ** 2) for k, row in enumerate(factor))
    return np.sum(list(squares), axis=0)
