"""What a design does when it is a little off: how far its motion lasts, what comes after it, how balls arrive at it."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.averages import Averages
from vijax.design.design_settings import DEFAULT
from vijax.design.ensemble import Ensemble, Task, fly, moving, silent
from vijax.design.optimum import AnyOptimum, AperiodicOptimum, Optimum
from vijax.design.tolerance import Spread, Tolerance, check_samples, check_tolerances
from vijax.model.variables import LINEAR, variables
from vijax.runtime import checks
from vijax.runtime.context import door

_FARTHEST = 0.1  # a quantity is looked at as far as this part of it; an inclination as far as this angle [rad]
_FINEST = 1e-4 * _FARTHEST  # the first step, and how closely an end is found that is nearer than a hundredth
_LONGER = 2.0  # a step that was fine is followed by one so much longer
_BALLS = 8  # balls that follow an aperiodic motion: what one of them gives is a matter of chance
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


_NOWHERE = Side(0.0, False, "", 0.0, False)


class Extent(NamedTuple):
    """How far off one tuned quantity may be: the sides where it is smaller and where it is larger."""

    name: str
    below: Side
    above: Side

    @property
    def percent(self) -> float:
        """Give the nearer end."""
        return min(self.below.percent, self.above.percent)


class ArrivalStatistics(NamedTuple):
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

    A ball on the motion follows it through devices that are more and more off, all else as it is.
    """
    checks.instance("optimum", optimum, AnyOptimum, "vijax.optimise(...).best")
    names = tuple(optimum.values)
    balls = _BALLS if optimum.label == "aperiodic" else 1
    first = jax.tree.map(lambda x: x[:balls], _starts(optimum))
    ways = [_Way(index, sign, first, optimum.P) for index in range(len(names)) for sign in (-1, 1)]
    while going := [way for way in ways if way.going]:
        _go_on(optimum, names, going)
    sides = [way.side for way in ways]
    return tuple(Extent(name, *sides[2 * i : 2 * i + 2]) for i, name in enumerate(names))


@dataclasses.dataclass
class _Way:
    """Balls that follow the motion of a design to one side: one of them on an orbit.

    Attributes:
        index, sign: Which tuned quantity, and whether it falls or rises.
        starts: Where the balls are.
        P: What they give there on average [J].
        off: How far it has come, in parts of the quantity.
        step: How much further it goes.
        side: What is there, or just beyond.
    """

    index: int
    sign: int
    starts: Starts
    P: float
    off: float = 0.0
    step: float = _FINEST
    side: Side = _NOWHERE

    @property
    def going(self) -> bool:
        """Say whether its end is not known yet to a thousandth of it."""
        return self.off < _FARTHEST and self.step > max(0.1 * _FINEST, 1e-3 * self.off)


def _go_on(optimum: Optimum | AperiodicOptimum, names: tuple[str, ...], going: list[_Way]) -> None:
    """Take every ball a step further; a shorter one next time where its motion was not there any more."""
    z = np.repeat(_z(optimum, names)[None], len(going), axis=0)
    ahead = [min(way.off + way.step, _FARTHEST) for way in going]
    for row, (way, off) in enumerate(zip(going, ahead, strict=True)):
        z[row, way.index] += way.sign * off if names[way.index] in LINEAR else np.log1p(way.sign * off)
    none = np.zeros(len(going))
    starts = [way.starts for way in going]
    flown = fly(_task(optimum, "P"), none.astype(int), z, none, starts, _PERIODS, len(starts[0].v))
    for way, off, one in zip(going, ahead, flown, strict=True):
        P, kept = float(np.nan_to_num(one.found.P).mean()), bool(one.found.margins().min() >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Beyond a fold another orbit may have the label; its P is another one.
            smooth = abs(np.log(P / way.P)) < _STEEPEST * (off - way.off) + _LEAST_JUMP
        own = _own(optimum, one.found)
        # If most balls are not on the motion any more, one that has left it says where it went.
        name = str(one.found.labels()[int(own.argmin())])
        if own.mean() >= 0.5 and smooth:
            way.off, way.P, way.starts, way.step = off, P, one.found.end, _LONGER * way.step
            way.side = Side(100 * off, off >= _FARTHEST, name, P, kept)
        else:
            way.step = 0.25 * way.step
            way.side = Side(100 * way.off, False, name, P, kept)


@door
def arrival(optimum: Optimum | AperiodicOptimum) -> ArrivalStatistics:
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
    return ArrivalStatistics(float(there.mean()), *when, one.periods)


@door
def ranked(
    optima: Iterable[Optimum | AperiodicOptimum], tolerances: Iterable[Tolerance], samples: int | None = None
) -> tuple[tuple[Optimum | AperiodicOptimum, Spread], ...]:
    """Rank optima by the mean P of devices that are off by tolerances, the best first.

    Balls on a design's motion go on in random devices, and what they give there counts, whatever their motion. Of an
    optimum in a narrow window most are beyond it; `optimise.under`, which follows an orbit, counts nothing of these.

    Args:
        optima: Those of one `Design`.
        tolerances: How constants scatter.
        samples: Random devices, 256 unless given.

    Raises:
        ValueError: A tolerance that cannot be.
    """
    some: Any = tuple(checks.sequence("optima", optima, AnyOptimum, "the optima of vijax.optimise(...)"))
    spreads = scattered(some, check_tolerances(tolerances), None if samples is None else check_samples(samples))
    return tuple(sorted(zip(some, spreads, strict=True), key=lambda one: -one[1].mean))


def scattered(
    optima: Sequence[Optimum | AperiodicOptimum], tolerances: tuple[Tolerance, ...], samples: int | None
) -> list[Spread]:
    """Find what becomes of the motions of optima when constants scatter; see `ranked`."""
    if not optima:
        return []
    balls = _DEVICES if samples is None else samples
    tune = tuple(optima[0].values)
    wide = np.full((len(optima), 2, len(tune)), [[[-np.inf], [np.inf]]])
    task = Task([one.device for one in optima], tune, wide, "P", tolerances, 1.0, DEFAULT)
    z, owner = np.array([_z(one, tune) for one in optima]), np.arange(len(optima))
    flown = fly(task, owner, z, np.zeros(len(optima)), [_starts(one) for one in optima], _PERIODS, balls)
    return [_spread(one) for one in flown]


def _spread(one: Ensemble) -> Spread:
    """Sum up what the devices of an ensemble give."""
    alive = moving(one.found)
    kept = alive & (one.found.margins().min(axis=1) >= 0)
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


def _starts(optimum: Optimum | AperiodicOptimum) -> Starts:
    """Put balls on the motion: one at an impact of an orbit; those of the long flight where it left them."""
    if isinstance(optimum, AperiodicOptimum):
        return optimum.starts
    orbit = optimum.orbit
    t, speed, _ = np.asarray(orbit.knots)[0, 0]
    side = float(np.asarray(orbit.sequence.side)[0, 0])
    half = 0.5 * float(np.asarray(orbit.pair.d)[0])
    begun: Any = (np.array([x]) for x in (side * half, side * speed, t % 2.0))
    return Starts(*begun)


def _own(optimum: Optimum | AperiodicOptimum, found: Averages) -> np.ndarray:
    """Say which balls are on a motion of the design's label, mirror images alike."""
    turned = found._replace(left=found.right, right=found.left)
    own = (found.labels() == optimum.label) | (turned.labels() == optimum.label)
    # A ball may be without an impact for long on aperiodic motion in a wide gap.
    return own | (silent(found) & (optimum.label == "aperiodic"))
