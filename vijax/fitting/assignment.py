"""The assignment of measured impacts to a motion: the false impacts, and the gaps where the bench missed an impact.

A chain of intervals connects the real impacts. Consecutive intervals agree on the speed of the impact between them, or
one of them is a gap: the bench missed an impact there, or the contact was too long to have a motion. The best chain
has the least cost: the sum of the squared residuals, of the gaps and of the false impacts. It is found by dynamic
programming.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from vijax.fitting.fit_model import FitModel
from vijax.fitting.mismatch import Intervals, linearised, solved, speed_equations
from vijax.fitting.series import Series
from vijax.fitting.unknowns import half_period

# Costs are negative logarithms of probabilities, relative to a chain in which all equations hold exactly. An equation
# that holds costs half of its squared residual. An equation that does not hold costs `BROKEN`: the logarithm of its
# range over its standard error. A gap breaks the equations at both of its ends, and a false impact removes one
# equation; `_GAP` and `_FALSE` include how rare they are.
BROKEN, _GAP, _FALSE, _WRONG_SPEED = 6.5, 3.5, 10.5, 10.0
"""The cost of an equation that does not hold."""
# At most this many consecutive false impacts are considered.
_MOST_FALSE = 3
# The median of the absolute value of a normal variable.
_MEDIAN = 0.6745
# A motion may pass through a wall by this much, as unknowns and times are not exact: a distance in units of
# A pi^2/omega^2, and a number of standard errors of a time at the largest speed.
_SLACK, _SLACK_ERRORS, _FASTEST = 1e-3, 6.0, 1.0


@dataclass(frozen=True)
class Assignment:
    """The real impacts, and the gaps of the motion.

    Attributes:
        real: Whether an impact is real [impact].
        gaps: Real impacts from which no motion leads to the next real one [impact].
        long: Those of them after which the contact may have lasted longer than is tried [impact].
        outlying: Real impacts whose measured speed is not that of the motion [impact].
        cost: Negative logarithm of the probability, to a constant.
    """

    real: np.ndarray
    gaps: np.ndarray
    long: np.ndarray
    outlying: np.ndarray
    cost: float

    def same(self, other: "Assignment") -> bool:
        """Return True if another assignment is equal, whatever its cost."""
        names = "real", "gaps", "outlying"
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    @property
    def faults(self) -> int:
        """Count the faults of the bench: false impacts, and gaps that no long contact explains."""
        return int((~self.real).sum() + (self.gaps & ~self.long).sum())

    @property
    def price(self) -> float:
        """Compute the cost of false impacts, gaps and wrong speeds."""
        false, gaps, wrong = (~self.real).sum(), self.gaps.sum(), self.outlying.sum()
        return float(_FALSE * false + _GAP * gaps + BROKEN * self._ends.sum() + _WRONG_SPEED * wrong)

    @property
    def _ends(self) -> np.ndarray:
        """Return the real impacts before or after a gap that have an equation [real impact]."""
        gaps = self.gaps[self.real]
        return (gaps | np.append(False, gaps[:-1])) & (np.arange(gaps.size) % (gaps.size - 1) > 0)

    def series(self, series: Series) -> Series:
        """Return the real impacts."""
        speeds = None if series.speeds is None else series.speeds[self.real]
        return replace(series, times=series.times[self.real], sides=series.sides[self.real], speeds=speeds)

    def aside(self, real: Series) -> np.ndarray:
        """Return which equations of the real impacts do not hold [equation]."""
        impact, about_speed = speed_equations(real)
        return np.where(about_speed, (self.gaps | self.outlying)[self.real][impact], self._ends[impact])


@dataclass(frozen=True)
class _Candidates:
    """Motions between impacts that may follow each other.

    Attributes:
        start, stop: The impacts between which they lie [motion].
        speed: At the start; NaN if the bench missed an impact in between [motion].
        arrival: At the end, towards the wall [motion].
        speed_by, arrival_by: Their derivatives by the times of start and end, times the errors of these [motion, 2].
        own: The cost of a motion by itself [motion].
        long: Whether there is no motion as the contact may have lasted longer than is tried [motion].
        soft: Standard error of an equation besides that of its times.
        scale: How many times as large as stated errors are.
    """

    start: np.ndarray
    stop: np.ndarray
    speed: np.ndarray
    arrival: np.ndarray
    speed_by: np.ndarray
    arrival_by: np.ndarray
    own: np.ndarray
    long: np.ndarray
    soft: float
    scale: float = 1.0

    def costs(self, into: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Compute the cost of the equation between each motion into an impact and each motion out of it [into, out]."""
        off = self.arrival[into][:, None] - self.speed[out]
        parts = (
            self.speed_by[out, 1] + np.zeros_like(off),
            self.arrival_by[into, 1][:, None] - self.speed_by[out, 0],
            self.arrival_by[into, 0][:, None] + np.zeros_like(off),
        )
        variance = sum(part**2 for part in parts) + self.soft**2
        # No equation connects a gap.
        return np.nan_to_num(off * off / (2 * variance * self.scale**2), nan=BROKEN)

    def joined(self, other: "_Candidates") -> "_Candidates":
        """Return these motions and others."""
        names = [field.name for field in fields(self) if field.name not in ("soft", "scale")]
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return replace(self, **both)


def _candidates(
    model: FitModel, series: Series, z: np.ndarray, pairs: tuple[np.ndarray, np.ndarray], soft: float
) -> _Candidates:
    """List the motions between impacts, and for each pair of impacts that the bench may have missed one."""
    start, stop = pairs
    rows = Intervals(series.times[start], series.times[stop], series.sides[start], series.sides[stop])
    every, tried = solved(model, z, rows)
    slack = _SLACK + soft + _SLACK_ERRORS * _FASTEST * series.timing_error / half_period(model.device)
    which, values, slopes, _ = every.chosen(~(np.asarray(every.motion.outside) > slack))
    wall, nothing = rows.next_side[which], np.full(start.size, np.nan)
    own = np.zeros(which.size)
    if series.speeds is not None:
        own = np.minimum(((values[:, 2] - series.speeds[start[which]]) / series.speed_error) ** 2 / 2, _WRONG_SPEED)
    return _Candidates(
        start=np.append(start[which], start),
        stop=np.append(stop[which], stop),
        speed=np.append(values[:, 0], nothing),
        arrival=np.append(wall * values[:, 1], nothing),
        speed_by=series.timing_error * np.vstack([slopes[:, 0, -2:], np.zeros((start.size, 2))]),
        arrival_by=series.timing_error * np.vstack([wall[:, None] * slopes[:, 1, -2:], np.zeros((start.size, 2))]),
        own=np.append(own, np.full(start.size, _GAP)),
        long=np.append(np.zeros(which.size, bool), ~tried),
        soft=soft,
    )


def assign(model: FitModel, series: Series, z: np.ndarray, soft: float = 0.0) -> Assignment:
    """Return the assignment of least cost for given unknowns.

    Args:
        model: The model of the device.
        series: The measured impacts.
        z: Variables of the unknowns.
        soft: Standard error of an equation besides that of its times, in units of A pi/omega.
    """
    count = series.times.size
    plain = _candidates(model, series, z, (np.arange(count - 1), np.arange(1, count)), soft)
    plain = replace(plain, scale=_scale(model, series, z, soft))
    found = _best_chain(plain, count)
    # A false impact spoils the intervals on both sides of it.
    starts, stops = _skips(found.gaps | np.append(False, found.gaps[:-1]))
    if not starts.size:
        return found
    return _best_chain(plain.joined(_candidates(model, series, z, (starts, stops), soft)), count)


def _scale(model: FitModel, series: Series, z: np.ndarray, soft: float) -> float:
    """Estimate the ratio of residuals to stated errors, at least 1, from the median, which few false impacts change."""
    linear = linearised(model, series, z, series.times)
    residuals = np.abs(linear.off / linear.errors(series, soft))[linear.answered]
    return max(float(np.median(residuals)) / _MEDIAN, 1.0) if residuals.size else 1.0


def _skips(doubtful: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the intervals that skip doubtful impacts alone: their first and last impacts."""
    count = doubtful.size
    pairs = [
        (start, start + skipped + 1)
        for skipped in range(1, _MOST_FALSE + 1)
        for start in range(count - 1 - skipped)
        if doubtful[start + 1 : start + 1 + skipped].all()
    ]
    starts, stops = np.array(pairs, int).reshape(-1, 2).T
    return starts, stops


def _best_chain(found: _Candidates, count: int) -> Assignment:
    """Find the chain of least cost by dynamic programming: the best chain that ends with each motion."""
    cost, before = np.full(found.start.size, np.inf), np.full(found.start.size, -1)
    own = found.own + _FALSE * (found.stop - found.start - 1)
    leaves, enters = _grouped(found.start, count), _grouped(found.stop, count)
    for impact in range(count - 1):
        out, into = leaves[impact], enters[impact]
        # The chain begins here if all impacts before are false.
        best, came = np.full(out.size, _FALSE * impact), np.full(out.size, -1)
        if into.size:
            total = cost[into][:, None] + found.costs(into, out)
            least = total.argmin(axis=0)
            joined = total[least, np.arange(out.size)]
            best, came = np.minimum(best, joined), np.where(joined <= best, into[least], came)
        cost[out], before[out] = best + own[out], came
    ends = cost + _FALSE * (count - 1 - found.stop)
    chosen = [int(ends.argmin())]
    while before[chosen[-1]] >= 0:
        chosen.append(int(before[chosen[-1]]))
    start, (real, gaps, long, outlying) = found.start[chosen], np.zeros((4, count), bool)
    real[start] = real[found.stop[chosen]] = True
    gaps[start] = np.isnan(found.speed[chosen])
    long[start] = found.long[chosen]
    outlying[start] = found.own[chosen] == _WRONG_SPEED
    return Assignment(real, gaps, long, outlying, float(ends.min()))


def _grouped(impacts: np.ndarray, count: int) -> list[np.ndarray]:
    """List which elements are about each impact."""
    order = np.argsort(impacts, kind="stable")
    return np.split(order, np.searchsorted(impacts[order], np.arange(1, count)))
