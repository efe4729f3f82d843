"""How well a series of impacts hangs together: the equations between its times, linearised.

Every interval says how fast the ball enters its first wall and how fast it arrives at the next one. Two intervals in a
row must agree on the impact between them: one equation for three times. A measured speed is one for two times.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Ends, Interval, Motion, Restitution, guessed_motions, interval
from vijax.fitting.series import Series
from vijax.fitting.shaking import Shaking
from vijax.fitting.unknowns import DELAY, made
from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_TILES = (64, 1024)  # intervals of one compiled call
# An interval without a motion costs a chain as much as motions that differ by so much, in units of A pi/omega. A
# disagreement costs no more than this, so that a false impact does not change the motions about it.
_NO_MOTION, _DISAGREEMENT = 10.0, 1.0


@dataclass(frozen=True)
class Equations:
    """The equations, linearised about some unknowns and times: of every impact but the ends one, and one a speed.

    Attributes:
        off: By how much each is missed [equation].
        impact: Which impact it is about [equation].
        by_unknown: Derivatives by the variables of the unknowns [equation, unknown].
        by_restitution: By offset and slope of what is added to r [equation, 2].
        by_time: By the times, sparse [equation, impact].
        own_variance: Variance of each besides that of the times [equation].
        answered: Whether there is a motion from impact to impact [equation].
        outside: How far the flight after an impact would pass through a wall [interval].
        speeds: Impact speeds in units of A pi/omega [impact].
        speed_unit: A pi/omega of the device as it is known [m/s].
        motions: From impact to impact [interval].
    """

    off: np.ndarray
    impact: np.ndarray
    by_unknown: np.ndarray
    by_restitution: np.ndarray
    by_time: Any
    own_variance: np.ndarray
    answered: np.ndarray
    outside: np.ndarray
    speeds: np.ndarray
    speed_unit: float
    motions: Motion

    def errors(self, series: Series, soft: float) -> np.ndarray:
        """Compute the standard error of each equation: of its times, of its speed, and a tolerance besides [equation].

        Args:
            series: Impacts with their errors.
            soft: The tolerance, in units of A pi/omega.
        """
        shared = finite(self.by_time).power(2).sum(axis=1)
        tolerance = soft * np.where(self.own_variance > 0, self.speed_unit, 1.0)
        variance = self.own_variance + tolerance**2 + series.timing_error**2 * shared
        # An equation without a motion has no derivatives yet.
        return np.sqrt(np.where(self.answered, variance, np.median(variance)))


class Intervals(NamedTuple):
    """The times [s] and sides of the impacts at both ends, of one interval or of many."""

    time: Any
    next_time: Any
    side: Any
    next_side: Any


class Solved(NamedTuple):
    """Motions of intervals.

    Attributes:
        interval: Of which interval each is [motion].
        values: Speed at the start, velocity at the end, and speed at the start in m/s [motion, 3].
        slopes: Their derivatives by the unknowns, by offset and slope of r, and by the times of start and end
            [motion, 3, variable].
        motion: All that is known of it [motion].
    """

    interval: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    motion: Interval

    def chosen(self, rows: np.ndarray) -> "Solved":
        """Return some motions; one after the last is none, all of whose numbers are NaN."""

        def of(leaf: np.ndarray) -> np.ndarray:
            if rows.dtype == bool:
                return leaf[rows]
            none = np.full((1, *leaf.shape[1:]), -1 if leaf.dtype.kind == "i" else np.nan, leaf.dtype)
            return np.concatenate([leaf, none])[rows]

        return jax.tree.map(of, self)


class _InUnits(NamedTuple):
    """An interval in the units of the device that some unknowns make."""

    device: Harvester
    pair: ImpactPair
    ends: Ends


def _in_units(device: Harvester, names: tuple[str, ...], wall: Walls, z: Array, row: Intervals) -> _InUnits:
    own = made(device, names, z)
    delay = z[-1] * jnp.pi / device.omega if DELAY in names else 0.0
    t, next_t = ((when - delay) * own.omega / jnp.pi for when in (row.time, row.next_time))
    return _InUnits(own, own.pair(wall), Ends(row.side, row.next_side, t, next_t))


@partial(jitted, static=("names", "wall"))
def _guessed(
    device: Harvester,
    shaking: Shaking,
    z: Float[Array, " unknown"],
    rows: Intervals,
    *,
    names: tuple[str, ...],
    wall: Walls,
) -> tuple[Motion, Array]:
    """Guess the motions of every interval [interval, motion], and say whether all durations were tried [interval]."""

    def each(row: Intervals) -> tuple[Motion, Array]:
        scene = _in_units(device, names, wall, z, row)
        return guessed_motions(scene.pair, shaking, scene.ends)

    return jax.vmap(each)(rows)


@partial(jitted, static=("names", "wall"))
def _said(
    device: Harvester,
    shaking: Shaking,
    z: Float[Array, " unknown"],
    rows: tuple[Intervals, Motion],
    *,
    names: tuple[str, ...],
    wall: Walls,
) -> tuple[Array, Array, Interval]:
    """Tell of every interval its two speeds and the first in m/s; their derivatives; and all that it says."""

    def numbers(x: Array, row: Intervals, near: Motion) -> tuple[Array, tuple[Array, Interval]]:
        own, (offset, slope, time, next_time) = x[: len(names)], x[len(names) :]
        scene = _in_units(device, names, wall, own, row._replace(time=time, next_time=next_time))
        found = interval(scene.pair, shaking, Restitution(offset, slope), scene.ends, near)
        values = jnp.stack([found.speed, found.arrival, found.speed * scene.device.speed_unit])
        return values, (values, found)

    def told(row: Intervals, near: Motion):
        zero = jnp.zeros_like(row.time)
        x = jnp.concatenate([z, jnp.stack([zero, zero, row.time, row.next_time])])
        slopes, (values, found) = jax.jacfwd(numbers, has_aux=True)(x, row, near)
        return values, slopes, found

    return jax.vmap(told)(*rows)


def consecutive(series: Series, times: np.ndarray) -> Intervals:
    """Return the intervals between consecutive impacts."""
    return Intervals(times[:-1], times[1:], series.sides[:-1], series.sides[1:])


def solved_near(model: FitModel, z: np.ndarray, intervals: Intervals, near: Motion) -> Solved:
    """Compute the motions of intervals near given ones."""
    known: Any = (model.device, model.shaking, z)
    named = partial(_said, *known, names=model.names, wall=model.wall)
    values, slopes, found = jax.tree.map(np.asarray, tiles.map_tiles(named, (intervals, near), _TILES))
    return Solved(np.arange(len(values)), values, slopes, found)


def solved(model: FitModel, z: np.ndarray, intervals: Intervals) -> tuple[Solved, np.ndarray]:
    """Compute all motions of intervals, and whether contacts of all durations were tried [interval]."""
    known: Any = (model.device, model.shaking, z)
    named = partial(_guessed, *known, names=model.names, wall=model.wall)
    guess, tried = jax.tree.map(np.asarray, tiles.map_tiles(named, intervals, _TILES))
    valid = np.isfinite(guess.speed)
    valid[0, 0] = True  # a call has a row at least, if only one of NaN
    interval, _ = np.nonzero(valid)
    near = Motion(guess.speed[valid], guess.stay[valid])
    found = solved_near(model, z, Intervals(*(row[interval] for row in intervals)), near)
    return found._replace(interval=interval).chosen(np.isfinite(found.motion.speed)), tried


def _likely(model: FitModel, series: Series, every: Solved) -> Solved:
    """Choose the motions from impact to impact that hang together best: speeds where two of them meet differ least."""
    count, (place, most) = series.times.size - 1, _places(every.interval)
    # The last motion of every interval is none.
    speeds, arrivals = np.full((2, count, most + 1), np.nan)
    speeds[every.interval, place], arrivals[every.interval, place] = every.values[:, 0], every.values[:, 1]
    own = np.where(np.isnan(speeds), _NO_MOTION, 0.0)
    if series.speeds is not None:
        own += np.nan_to_num(np.abs(speeds - series.speeds[:-1, None] / float(model.device.speed_unit)))
    which = least_chain(speeds, series.sides[1:, None] * arrivals, own)
    rows = np.full((count, most + 1), len(place))
    rows[every.interval, place] = np.arange(len(place))
    return every.chosen(rows[np.arange(count), which])


def _places(interval: np.ndarray) -> tuple[np.ndarray, int]:
    """Return which motion of its interval each is, and how many there are at most."""
    first = np.searchsorted(interval, interval)
    place = np.arange(interval.size) - first
    return place, int(place.max(initial=-1)) + 1


def least_chain(speeds: np.ndarray, arrivals: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Choose a motion of every interval, so that a sum is least: their own costs, and how little neighbours agree.

    By dynamic programming, Viterbi's way: of every motion of an interval the best chain that ends with it is known
    from those of the interval before.

    Args:
        speeds: At the first impact of an interval [interval, motion]; NaN for no motion.
        arrivals: At the next one, towards its wall [interval, motion].
        own: What a motion costs by itself [interval, motion].
    """
    cost, came_from = own[0], []
    for k in range(1, len(speeds)):
        apart = np.nan_to_num(np.abs(arrivals[k - 1][:, None] - speeds[k]))
        total = cost[:, None] + np.minimum(apart, _DISAGREEMENT)
        came_from.append(total.argmin(axis=0))
        cost = total.min(axis=0) + own[k]
    chosen = [int(cost.argmin())]
    for before in reversed(came_from):
        chosen.append(int(before[chosen[-1]]))
    return np.array(chosen[::-1])


def linearised(
    model: FitModel, series: Series, z: np.ndarray, times: np.ndarray, near: Motion | None = None
) -> Equations:
    """Linearise the equations of a series about variables of the unknowns and about times [s].

    Args:
        model: What is fitted.
        series: What it is fitted to.
        z: Variables of the unknowns.
        times: Onsets of the impacts [s].
        near: Motions from impact to impact, near which to look; the likely ones unless given.
    """
    rows = consecutive(series, times)
    chain = _likely(model, series, solved(model, z, rows)[0]) if near is None else solved_near(model, z, rows, near)
    slopes, found = chain.slopes, chain.motion
    speed, arrival, metres = chain.values.T
    # The ball arrives at a wall with a velocity towards it.
    off = series.sides[1:-1] * arrival[:-1] - speed[1:]
    by = series.sides[1:-1, None] * slopes[:-1, 1]
    after = slopes[1:, 0]
    known = len(z) + 2
    first, second = by[:, known], by[:, known + 1]
    by_time = _banded(len(times), first, second - after[:, known], -after[:, known + 1])
    by_x = by[:, :known] - after[:, :known]
    own_variance = np.zeros_like(off)
    if series.speeds is not None:
        off = np.append(off, metres - series.speeds[:-1])
        by_x = np.vstack([by_x, slopes[:, 2, :known]])
        by_time = scipy.sparse.vstack([by_time, _banded(len(times), slopes[:, 2, known], slopes[:, 2, known + 1])])
        own_variance = np.append(own_variance, np.full(len(metres), series.speed_error**2))
    answered = np.isfinite(off) & np.isfinite(by_x).all(axis=1) & np.isfinite(by_time @ np.ones(len(times)))
    order, impact, _ = _in_order(series)
    return Equations(
        off=off[order],
        impact=impact,
        by_unknown=by_x[order, : len(z)],
        by_restitution=by_x[order, len(z) :],
        by_time=by_time.tocsr()[order],
        own_variance=own_variance[order],
        answered=answered[order],
        outside=np.asarray(found.outside),
        speeds=np.append(speed, series.sides[-1] * arrival[-1]),
        speed_unit=float(model.device.speed_unit),
        motions=Motion(found.speed, found.stay),
    )


def finite(matrix: Any) -> Any:
    """Copy a sparse matrix with 0 in place of what is not finite."""
    matrix = matrix.copy()
    matrix.data = np.nan_to_num(matrix.data, nan=0.0, posinf=0.0, neginf=0.0)
    return matrix


def _banded(impacts: int, *bands: np.ndarray) -> Any:
    """Make the derivatives of equations by the times they read: the first at their own place, the others after it."""
    rows = len(bands[0])
    return scipy.sparse.diags_array(bands, offsets=range(len(bands)), shape=(rows, impacts), format="csr")


def speed_equations(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """Return which impact each equation is about, and whether it is about a measured speed [equation]."""
    _, impact, about_speed = _in_order(series)
    return impact, about_speed


def _in_order(series: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort equations by the times they read, so that those of a covariance that are not 0 lie near its diagonal.

    Returns:
        The order, and in that order which impact each equation is about and whether it is about a measured speed.
    """
    inner, speeds = np.arange(1, series.times.size - 1), np.arange(series.equations - series.times.size + 2)
    impact = np.append(inner, speeds)
    about_speed = np.arange(impact.size) >= inner.size
    # The speed before the impact between two intervals, then their agreement on it.
    order = np.argsort(impact - np.where(about_speed, 0.0, 0.5), kind="stable")
    return order, impact[order], about_speed[order]
