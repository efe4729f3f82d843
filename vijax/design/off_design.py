"""What a design does when it is a little off: how far its motion lasts, what comes after it, how balls arrive at it."""

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import Averages
from vijax.design.design_settings import DEFAULT
from vijax.design.ensemble import AVERAGED, Task, fly
from vijax.design.optimum import AnyOptimum, AperiodicOptimum, Optimum
from vijax.design.tolerance import Spread, Tolerance
from vijax.design.variables import LINEAR, variables
from vijax.model.label import label
from vijax.runtime import checks
from vijax.runtime.context import door

_FARTHEST = 0.1  # a quantity is looked at as far as this part of it; an inclination as far as this angle [rad]
_RUNGS = 13  # values on either side, from a thousandth of that on, evenly spaced as logarithms
_PERIODS = 400  # forcing periods that a ball is given to show what becomes of it
_ARRIVING = 256, 2000  # balls that start anywhere, and the periods in which they may arrive
_DEVICES = 256  # random devices that tolerances make
# The logarithm of P changes by at most so many times the quantity's part, and by this; more is a jump.
_STEEPEST, _LEAST_JUMP = 10.0, 0.02
_SAME = 1e-6  # relative difference of P within which a motion is the design's own orbit


class Side(NamedTuple):
    """What is on one side of a design.

    Attributes:
        percent: How far off its motion is still there, in percent of the quantity (of 1 rad of an inclination).
        lasts: Whether it is there as far as was looked, 10 %.
        label, P, admissible: What a ball of that motion does just beyond, or there.
    """

    percent: float
    lasts: bool
    label: str
    P: float
    admissible: bool


class Extent(NamedTuple):
    """How far off one tuned quantity may be: the sides where it is smaller and where it is larger."""

    name: str
    below: Side
    above: Side

    @property
    def percent(self) -> float:
        """The nearer end."""
        return min(self.below.percent, self.above.percent)


class Arrival(NamedTuple):
    """How balls that start anywhere arrive at the motion: the share that do, and after how many forcing periods.

    Attributes:
        share: Of all of them.
        median, most: Half and nine tenths of those that arrive have done so by then; NaN for what is no orbit.
        periods: How many they were given.
    """

    share: float
    median: float
    most: float
    periods: int


@door
def extents(optimum: Optimum | AperiodicOptimum) -> tuple[Extent, ...]:
    """Find how far off each tuned quantity may be before the motion of a design is another one, and which then.

    A ball on the motion is put into devices that are more and more off, all else as it is.
    """
    checks.instance("optimum", optimum, AnyOptimum, "vijax.optimise(...).best")
    names = tuple(optimum.values)
    rungs = np.geomspace(1e-3 * _FARTHEST, _FARTHEST, _RUNGS)
    ways = [(index, sign) for index in range(len(names)) for sign in (-1, 1)]
    found = _flown_off(optimum, names, ways, np.tile(rungs, (len(ways), 1)))
    last = [_lasts(optimum, one, np.append(0.0, rungs), optimum.P) for one in found]
    # Once more between the last value that is fine and the first that is not.
    edges = np.concatenate([[0.0], rungs, [_FARTHEST]])
    finer = np.array([np.linspace(edges[k], edges[k + 1], _RUNGS + 2)[1:-1] for k in last])
    closer = _flown_off(optimum, names, ways, finer)
    sides = []
    for one, near, k, some in zip(found, closer, last, finer, strict=True):
        if k == _RUNGS:
            sides.append(_side(one, _RUNGS - 1, _FARTHEST, True))
            continue
        before = optimum.P if k == 0 else float(one[0].P[k - 1])
        j = _lasts(optimum, near, np.append(edges[k], some), before)
        far = edges[k] if j == 0 else some[j - 1]
        sides.append(_side(one, k, far, False) if j == _RUNGS else _side(near, j, far, False))
    return tuple(Extent(name, *sides[2 * i : 2 * i + 2]) for i, name in enumerate(names))


@door
def arrival(optimum: Optimum | AperiodicOptimum) -> Arrival:
    """Find how many of the balls that start anywhere arrive at the motion of a design, and when."""
    checks.instance("optimum", optimum, AnyOptimum, "vijax.optimise(...).best")
    balls, periods = _ARRIVING
    names, task = tuple(optimum.values), _task(optimum, "expected")
    (one,) = fly(task, np.array([0]), _z(optimum, names)[None], np.zeros(1), [], periods, balls)
    there = _own(optimum, one.found)
    if optimum.label != "aperiodic":
        there &= np.abs(one.found.P / optimum.P - 1) < _SAME
        ran = one.found.periods_run[there]
        when = (float(np.median(ran)), float(np.quantile(ran, 0.9))) if ran.size else (math.nan, math.nan)
    else:
        when = (math.nan, math.nan)
    return Arrival(float(there.mean()), *when, periods)


def scattered(optimum: AperiodicOptimum, tolerances: tuple[Tolerance, ...], samples: int | None) -> Spread:
    """What becomes of a motion that is no orbit when constants scatter; see `optimise.under`."""
    balls = _DEVICES if samples is None else samples
    task = _task(optimum, "P")._replace(tolerances=tolerances)
    z, some = _z(optimum, task.tune)[None], [optimum.starts]
    (one,) = fly(task, np.array([0]), z, np.zeros(1), some, _PERIODS, balls)
    alive = np.isin(one.found.status, AVERAGED) & (one.found.P > 0)
    kept = alive & (one.found.margins(one.device).min(axis=1) >= 0)
    P = np.where(alive, np.nan_to_num(one.found.P), 0.0)
    return Spread(
        mean=float(np.where(kept, P, 0.0).mean()),
        worst=float(P.min()),
        lost=float(1 - alive.mean()),
        inadmissible=float((alive & ~kept).mean()),
    )


def _task(optimum: Optimum | AperiodicOptimum, objective: str) -> Task:
    wide = np.full((1, 2, len(optimum.values)), [[[-np.inf], [np.inf]]])
    return Task([optimum.device], tuple(optimum.values), wide, objective, (), 1.0, DEFAULT)


def _z(optimum: Optimum | AperiodicOptimum, names: tuple[str, ...]) -> np.ndarray:
    return variables(names, [optimum.values[name] for name in names])


def _flown_off(
    optimum: Optimum | AperiodicOptimum, names: tuple[str, ...], ways: list[tuple[int, int]], off: np.ndarray
) -> list[tuple[Averages, np.ndarray]]:
    """What balls of the motion do at values [way, rung] that are off, and whether each keeps the limits."""
    z = np.repeat(_z(optimum, names)[None], off.size, axis=0)
    for way, (index, sign) in enumerate(ways):
        some = slice(way * off.shape[1], (way + 1) * off.shape[1])
        z[some, index] += sign * off[way] if names[index] in LINEAR else np.log1p(sign * off[way])
    count, start = off.size, _start(optimum)
    flown = fly(_task(optimum, "P"), np.zeros(count, int), z, np.zeros(count), [start] * count, _PERIODS, 1)
    found = jax.tree.map(lambda *x: np.concatenate(x), *(one.found for one in flown))
    good = np.array([x.found.margins(x.device).min() >= 0 for x in flown])
    parts = [np.arange(way * off.shape[1], (way + 1) * off.shape[1]) for way in range(len(ways))]
    return [(found.some(part), good[part]) for part in parts]


def _start(optimum: Optimum | AperiodicOptimum) -> Starts:
    """A ball on the motion: at an impact of an orbit; where the long flight left one."""
    if isinstance(optimum, AperiodicOptimum):
        return jax.tree.map(lambda x: x[:1], optimum.starts)
    orbit = optimum.orbit
    t, speed, _ = np.asarray(orbit.knots)[0, 0]
    side = float(np.asarray(orbit.sequence.side)[0, 0])
    half = 0.5 * float(np.asarray(orbit.pair.d)[0])
    begun: Any = (np.array([x]) for x in (side * half, side * speed, t % 2.0))
    return Starts(*begun)


def _own(optimum: Optimum | AperiodicOptimum, found: Averages) -> np.ndarray:
    """Which balls are on a motion of the design's label, mirror images alike."""
    names = label(found.period, found.left, found.right, found.status)
    turned = label(found.period, found.right, found.left, found.status)
    names = np.where(names == "undecided", "aperiodic", names)
    return (names == optimum.label) | (turned == optimum.label)


def _lasts(
    optimum: Optimum | AperiodicOptimum, one: tuple[Averages, np.ndarray], off: np.ndarray, before: float
) -> int:
    """How many values in a row still have the motion.

    Beyond a fold another orbit may have the label; its P is another one.

    Args:
        optimum: The design.
        one: What balls did.
        off: How far off the value before the first is, and each of theirs.
        before: P at the value before the first.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        jump = np.abs(np.diff(np.log(np.append(before, one[0].P))))
    own = _own(optimum, one[0]) & (jump < _STEEPEST * np.diff(off) + _LEAST_JUMP)
    return int(np.argmin(own)) if not own.all() else own.size


def _side(one: tuple[Averages, np.ndarray], index: int, far: float, lasts: bool) -> Side:
    found, good = one
    names = label(found.period, found.left, found.right, found.status)
    return Side(100 * far, lasts, str(names[index]), float(found.P[index]), bool(good[index]))
