"""The least sum of squares over the unknowns: Levenberg and Marquardt's method about adjusted times.

Far from the right device no times make all equations hold: they are kept loosely first, and ever more strictly. Some
never hold, as the bench missed an impact, or took something else for one: those go aside.
"""

from dataclasses import replace

import numpy as np
import scipy.optimize

from vijax.fitting.adjustment import Adjustment, Settled, adjusted, finite, settle
from vijax.fitting.fit_model import FitModel
from vijax.fitting.mismatch import linearised
from vijax.fitting.series import Series
from vijax.fitting.unknowns import half_period

# Equations are kept to within this at first, in units of A pi/omega.
_SOFT = (0.1, 0.02, 0.005, 0.001)
# An equation that is missed by so many standard errors while others hold is of an impact that was missed, or of two
# that were taken for one. It goes aside, in a few trials; but never more than half of all.
_ASTRAY = 6.0
_MOST_TRIALS, _MOST_ASTRAY = 5, 0.5
# One that is missed by less beside the others is taken back, unless the mean square grows by more than this.
_TAKEN_BACK, _WORSE = 3.0, 1.2
_MOST_EVALUATIONS = 60
# A mean square residual of more than this is looked for elsewhere, too.
_POOR = 2.0
# Where a smaller part of the equations has a motion, the search does not begin.
_ANSWERS = 0.9


def least_squares(model: FitModel, series: Series, begin: np.ndarray) -> list[Settled]:
    """Find the least sums of squares, the least first.

    One search keeps the equations loosely first and ever more strictly, which leads there from far away, but sometimes
    past what is near. Another is strict from the beginning on, where times can be adjusted to that.

    Args:
        model: What is fitted.
        series: What it is fitted to.
        begin: Variables of the unknowns to begin with.
    """
    z, times, task = begin, series.times, Adjustment(model, series)
    for soft in _SOFT:
        loose = replace(task, soft=soft)
        found = _minimise(loose, z, times)
        z, times = found.z, found.times
    near = _without(task, found, _astray(loose, found))
    ends, strict = [near], replace(task, aside=~near.counts)
    poor = not near.held or near.chi2 > _POOR * near.used.sum()
    if poor or settle(strict, begin, series.times).held:
        ends.append(_minimise(strict, begin, series.times))
    return sorted(ends, key=lambda end: (end.restless.sum(), end.chi2))


def _without(task: Adjustment, found: Settled, aside: np.ndarray) -> Settled:
    """Adjust unknowns and times near where they were found, without the equations that cannot hold there.

    What would hold beside the others after all, once they do, is taken back.
    """
    end = _shed(task, found, aside)
    for _ in range(_MOST_TRIALS):
        fewer = ~end.counts & _wrong(adjusted(task, end.z, end.times), _TAKEN_BACK)
        if not end.held or (fewer == ~end.counts).all():
            break
        again = _shed(task, end, fewer)
        worse = again.chi2 / again.used.sum() > _WORSE * end.chi2 / end.used.sum()
        if worse or again.counts.sum() <= end.counts.sum():
            break
        end = again
    return end


def _shed(task: Adjustment, found: Settled, aside: np.ndarray) -> Settled:
    """Put equations aside until the others hold: no times satisfy an impact that hardly is one."""
    end, z, times = found, found.z, found.times
    for _ in range(_MOST_TRIALS):
        end = settle(replace(task, aside=aside), z, times, free=True)
        aside, z, times = aside | end.restless, end.z, end.times
        if end.held or aside.mean() > _MOST_ASTRAY:
            break
    return end


def _wrong(found: Settled, limit: float) -> np.ndarray:
    """Find the equations that are missed by more than some standard errors, or that no motion answers."""
    return ~found.linear.answered | (np.abs(found.off) > limit * np.sqrt(found.variances))


def answers(model: FitModel, series: Series, z: np.ndarray) -> bool:
    """Say whether nearly all impacts have a motion to the next one with some unknowns."""
    return bool(linearised(model, series, z, series.times).answered.mean() > _ANSWERS)


def best_begin(model: FitModel, series: Series, places: list[np.ndarray]) -> np.ndarray:
    """Choose where to begin: where the equations, kept loosely, are missed least at the measured times."""
    task = Adjustment(model, series, _SOFT[0])
    return min(places, key=lambda z: float((adjusted(task, z, series.times).penalised ** 2).sum()))


def rises(model: FitModel, series: Series, end: Settled, way: np.ndarray) -> float:
    """Say by how much the sum of squares rises to either side of where it is least, on average; infinite if it is lost.

    Args:
        model: What was fitted.
        series: What it was fitted to.
        end: Where it is least.
        way: By how much variables change.
    """
    task = Adjustment(model, series, aside=~end.counts)
    return float(np.mean([settle(task, end.z + sign * way, end.times).chi2 for sign in (-1, 1)]) - end.chi2)


def _minimise(task: Adjustment, z: np.ndarray, times: np.ndarray) -> Settled:
    """Make the sum of squares small from some unknowns and times on."""
    seen: dict[bytes, Settled] = {}
    nearest = [times]

    def at(z: np.ndarray) -> Settled:
        key = z.tobytes()
        if key not in seen:
            seen[key] = settle(task, z, nearest[0])
        return seen[key]

    def residuals(z: np.ndarray) -> np.ndarray:
        return at(z).penalised

    def slopes(z: np.ndarray) -> np.ndarray:
        # These are asked for where a step was taken: times are adjusted from there on.
        nearest[0] = at(z).times
        return np.vstack([at(z).slopes, np.zeros(len(z))])

    fine = 1e-3 if task.soft else 1e-8
    found = scipy.optimize.least_squares(
        residuals, z, slopes, bounds=task.model.limits, xtol=fine, ftol=fine, max_nfev=_MOST_EVALUATIONS
    )
    return at(found.x)


def _astray(task: Adjustment, found: Settled) -> np.ndarray:
    """Find the equations that cannot be meant to hold: of impacts that were missed, or are none."""
    linear, wrong = found.linear, _wrong(found, _ASTRAY)
    # A flight through a wall would have met it. Times and unknowns are not yet right, and let it pass a little.
    fastest = float(np.nanmax(linear.speeds, initial=0.0))
    slack = _ASTRAY * task.series.timing_error / half_period(task.model.device) * fastest + _SOFT[-1]
    reads = abs(finite(linear.by_time)) > 0
    wrong |= (reads[:, :-1].multiply(reads[:, 1:]) @ (linear.outside > slack)) > 0
    return wrong if wrong.mean() <= _MOST_ASTRAY else np.zeros_like(wrong)
