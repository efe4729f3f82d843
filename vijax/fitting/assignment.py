"""Assignment of measured impacts to a motion: false impacts, and gaps where the bench missed an impact.

A chain of intervals connects the real impacts. Consecutive intervals agree on the speed of the impact between them, or
one of them is a gap: the bench missed an impact within the interval, or the contact was too long for the search of
motions. Dynamic programming finds the chain of least cost. The cost is half the sum of the squared residuals, plus a
cost of each gap and of each false impact.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from vijax.fitting.fit_model import FitModel
from vijax.fitting.series import Series
from vijax.fitting.time_equations import Intervals, linearise, solve_all, speed_equations
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
# A motion may pass through a wall by this much, because unknowns and times are not exact: a distance in units of A
# pi^2/omega^2, and a number of standard errors of a time at the largest speed.
_SLACK, _SLACK_ERRORS, _FASTEST = 1e-3, 6.0, 1.0


@dataclass(frozen=True)
class Assignment:
    """The real impacts, and the gaps of the motion.

    Attributes:
        real: Whether an impact is real [impact].
        gaps: Real impacts without a motion to the next real impact [impact].
        long: Gaps that begin with a contact that may be longer than the search covers [impact].
        outlying: Real impacts with a measured speed that differs from the speed in the motion [impact].
        cost: Negative logarithm of the probability, up to a constant.
    """

    real: np.ndarray
    gaps: np.ndarray
    long: np.ndarray
    outlying: np.ndarray
    cost: float

    def same(self, other: "Assignment") -> bool:
        """Return True if another assignment is equal; costs may differ."""
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
        """Return the mask of the real impacts before or after a gap that have an equation [real impact]."""
        gaps = self.gaps[self.real]
        return (gaps | np.append(False, gaps[:-1])) & (np.arange(gaps.size) % (gaps.size - 1) > 0)

    def series(self, series: Series) -> Series:
        """Return the real impacts."""
        speeds = None if series.speeds is None else series.speeds[self.real]
        return replace(series, times=series.times[self.real], sides=series.sides[self.real], speeds=speeds)

    def excluded(self, real: Series) -> np.ndarray:
        """Return the mask of the equations next to gaps and of outlying speeds, which do not hold [equation]."""
        impact, about_speed = speed_equations(real)
        return np.where(about_speed, (self.gaps | self.outlying)[self.real][impact], self._ends[impact])


@dataclass(frozen=True)
class _Candidates:
    """Possible motions from an impact to a later impact, and gaps in place of motions.

    Attributes:
        start, stop: Indices of the impacts at both ends [motion].
        speed: Speed at the start; NaN for a gap [motion].
        arrival: Speed at the end, towards the wall [motion].
        speed_by, arrival_by: Derivatives of `speed` and `arrival` by the times of start and end, multiplied by the
            standard error of a time [motion, 2].
        motion_cost: Cost of a motion, without the equations between it and other motions [motion].
        long: Whether there is no motion since the contact may have been longer than the search covers [motion].
        soft: Standard error of an equation, not counting the error from its times.
        scale: Ratio of actual to stated errors.
    """

    start: np.ndarray
    stop: np.ndarray
    speed: np.ndarray
    arrival: np.ndarray
    speed_by: np.ndarray
    arrival_by: np.ndarray
    motion_cost: np.ndarray
    long: np.ndarray
    soft: float
    scale: float = 1.0

    def costs(self, into: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Compute the cost of the equation between each motion into an impact and each motion out of it [into, out]."""
        disagreement = self.arrival[into][:, None] - self.speed[out]
        # Derivatives of the equation by the three times: the end of the motion out, the impact itself, and the start of
        # the motion into it.
        parts = (
            self.speed_by[out, 1] + np.zeros_like(disagreement),
            self.arrival_by[into, 1][:, None] - self.speed_by[out, 0],
            self.arrival_by[into, 0][:, None] + np.zeros_like(disagreement),
        )
        variance = sum(part**2 for part in parts) + self.soft**2
        # A gap has no speed (NaN), so that an equation at its end does not hold and costs `BROKEN`.
        return np.nan_to_num(disagreement * disagreement / (2 * variance * self.scale**2), nan=BROKEN)

    def joined(self, other: "_Candidates") -> "_Candidates":
        """Return these motions and others."""
        names = [field.name for field in fields(self) if field.name not in ("soft", "scale")]
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return replace(self, **both)


def _candidates(
    model: FitModel, series: Series, z: np.ndarray, pairs: tuple[np.ndarray, np.ndarray], soft: float
) -> _Candidates:
    """Compute the motions between pairs of impacts, and one gap for each pair."""
    start, stop = pairs
    rows = Intervals(series.times[start], series.times[stop], series.sides[start], series.sides[stop])
    all_motions, all_tried = solve_all(model, z, rows)
    # Largest permitted distance of a motion beyond a wall.
    slack = _SLACK + soft + _SLACK_ERRORS * _FASTEST * series.timing_error / half_period(model.device)
    chosen, values, slopes, _ = all_motions.chosen(~(np.asarray(all_motions.motion.outside) > slack))
    wall, nothing = rows.next_side[chosen], np.full(start.size, np.nan)
    motion_cost = np.zeros(chosen.size)
    if series.speeds is not None:
        motion_cost = np.minimum(
            ((values[:, 2] - series.speeds[start[chosen]]) / series.speed_error) ** 2 / 2, _WRONG_SPEED
        )
    return _Candidates(
        start=np.append(start[chosen], start),
        stop=np.append(stop[chosen], stop),
        speed=np.append(values[:, 0], nothing),
        arrival=np.append(wall * values[:, 1], nothing),
        speed_by=series.timing_error * np.vstack([slopes[:, 0, -2:], np.zeros((start.size, 2))]),
        arrival_by=series.timing_error * np.vstack([wall[:, None] * slopes[:, 1, -2:], np.zeros((start.size, 2))]),
        motion_cost=np.append(motion_cost, np.full(start.size, _GAP)),
        long=np.append(np.zeros(chosen.size, bool), ~all_tried),
        soft=soft,
    )


def assign(model: FitModel, series: Series, z: np.ndarray, soft: float = 0.0) -> Assignment:
    """Return the assignment of least cost for given unknowns.

    Args:
        model: The model of the device.
        series: The measured impacts.
        z: Variables of the unknowns.
        soft: Standard error of an equation, not counting the error from its times, in units of A pi/omega.
    """
    count = series.times.size
    plain = _candidates(model, series, z, (np.arange(count - 1), np.arange(1, count)), soft)
    plain = replace(plain, scale=_scale(model, series, z, soft))
    best = _best_chain(plain, count)
    # A false impact spoils the intervals before and after it, so that intervals that skip suspect impacts are added.
    starts, stops = _skips(best.gaps | np.append(False, best.gaps[:-1]))
    if not starts.size:
        return best
    return _best_chain(plain.joined(_candidates(model, series, z, (starts, stops), soft)), count)


def _scale(model: FitModel, series: Series, z: np.ndarray, soft: float) -> float:
    """Estimate the ratio of residuals to stated errors, at least 1, from the median; false impacts hardly change it."""
    linear = linearise(model, series, z, series.times)
    residuals = np.abs(linear.equation_residuals / linear.errors(series, soft))[linear.has_motion]
    return max(float(np.median(residuals)) / _MEDIAN, 1.0) if residuals.size else 1.0


def _skips(suspect: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List first and last impacts of the intervals that skip suspect impacts only."""
    count = suspect.size
    pairs = [
        (start, start + skipped + 1)
        for skipped in range(1, _MOST_FALSE + 1)
        for start in range(count - 1 - skipped)
        if suspect[start + 1 : start + 1 + skipped].all()
    ]
    starts, stops = np.array(pairs, int).reshape(-1, 2).T
    return starts, stops


def _best_chain(motions: _Candidates, count: int) -> Assignment:
    """Find the chain of least cost by dynamic programming: for each motion, the best chain that ends with it."""
    cost, before = np.full(motions.start.size, np.inf), np.full(motions.start.size, -1)
    total_cost = motions.motion_cost + _FALSE * (motions.stop - motions.start - 1)
    # A motion leads from an impact to a later one. `motions_out` and `motions_in` list the motions that start and stop
    # at each impact. `before` holds, for each motion, the previous motion in the chain of least cost that ends with it.
    motions_out, motions_in = _grouped(motions.start, count), _grouped(motions.stop, count)
    for impact in range(count - 1):
        out, into = motions_out[impact], motions_in[impact]
        # A chain that begins here implies that all impacts before are false.
        least_cost, previous = np.full(out.size, _FALSE * impact), np.full(out.size, -1)
        if into.size:
            total = cost[into][:, None] + motions.costs(into, out)
            least = total.argmin(axis=0)
            joined = total[least, np.arange(out.size)]
            least_cost, previous = np.minimum(least_cost, joined), np.where(joined <= least_cost, into[least], previous)
        cost[out], before[out] = least_cost + total_cost[out], previous
    # A chain that ends here implies that all impacts after are false.
    ends = cost + _FALSE * (count - 1 - motions.stop)
    chosen = [int(ends.argmin())]
    while before[chosen[-1]] >= 0:
        chosen.append(int(before[chosen[-1]]))
    start, (real, gaps, long, outlying) = motions.start[chosen], np.zeros((4, count), bool)
    real[start] = real[motions.stop[chosen]] = True
    gaps[start] = np.isnan(motions.speed[chosen])
    long[start] = motions.long[chosen]
    outlying[start] = motions.motion_cost[chosen] == _WRONG_SPEED
    return Assignment(real, gaps, long, outlying, float(ends.min()))


def _grouped(impacts: np.ndarray, count: int) -> list[np.ndarray]:
    """Return, for each impact, the indices of the elements with that impact."""
    order = np.argsort(impacts, kind="stable")
    return np.split(order, np.searchsorted(impacts[order], np.arange(1, count)))
