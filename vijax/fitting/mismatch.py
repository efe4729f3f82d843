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
from vijax.fitting.interval import Ends, Interval, Motion, Restitution, interval, motions
from vijax.fitting.series import Series
from vijax.fitting.shaking import Shaking
from vijax.fitting.unknowns import DELAY, made
from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_TILES = (64, 1024)  # intervals of one compiled call
# An interval without a motion costs a chain as much as motions that differ by so much, in units of A pi/omega.
_NO_MOTION = 10.0


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
    motions: Motion


class _Row(NamedTuple):
    """Two impacts in a row: times [s] and sides, of one interval or of many."""

    time: Any
    next_time: Any
    side: Any
    next_side: Any


class _InUnits(NamedTuple):
    """An interval in the units of the device that some unknowns make."""

    device: Harvester
    pair: ImpactPair
    ends: Ends


def _in_units(device: Harvester, names: tuple[str, ...], wall: Walls, z: Array, row: _Row) -> _InUnits:
    own = made(device, names, z)
    delay = z[-1] * jnp.pi / device.omega if DELAY in names else 0.0
    t, next_t = ((when - delay) * own.omega / jnp.pi for when in (row.time, row.next_time))
    return _InUnits(own, own.pair(wall), Ends(row.side, row.next_side, t, next_t))


@partial(jitted, static=("names", "wall"))
def _possible(
    device: Harvester, shaking: Shaking, z: Float[Array, "unknown"], rows: _Row, *, names: tuple[str, ...], wall: Walls
) -> Interval:
    """List the motions of every interval [interval, motion]."""

    def each(row: _Row) -> Interval:
        scene = _in_units(device, names, wall, z, row)
        return motions(scene.pair, shaking, scene.ends)

    return jax.vmap(each)(rows)


@partial(jitted, static=("names", "wall"))
def _said(
    device: Harvester,
    shaking: Shaking,
    z: Float[Array, "unknown"],
    rows: tuple[_Row, Motion],
    *,
    names: tuple[str, ...],
    wall: Walls,
) -> tuple[Array, Array, Interval]:
    """Tell of every interval its two speeds and the first in m/s; their derivatives; and all that it says."""

    def numbers(x: Array, row: _Row, near: Motion) -> tuple[Array, tuple[Array, Interval]]:
        own, (offset, slope, time, next_time) = x[: len(names)], x[len(names) :]
        scene = _in_units(device, names, wall, own, row._replace(time=time, next_time=next_time))
        found = interval(scene.pair, shaking, Restitution(offset, slope), scene.ends, near)
        values = jnp.stack([found.speed, found.arrival, found.speed * scene.device.speed_unit])
        return values, (values, found)

    def told(row: _Row, near: Motion):
        zero = jnp.zeros_like(row.time)
        x = jnp.concatenate([z, jnp.stack([zero, zero, row.time, row.next_time])])
        slopes, (values, found) = jax.jacfwd(numbers, has_aux=True)(x, row, near)
        return values, slopes, found

    return jax.vmap(told)(*rows)


def _rows(series: Series, times: np.ndarray) -> _Row:
    return _Row(times[:-1], times[1:], series.sides[:-1], series.sides[1:])


def likely_motions(model: FitModel, series: Series, z: np.ndarray, times: np.ndarray) -> Motion:
    """Find the motions from impact to impact that hang together best: speeds where two of them meet differ least."""
    asked: Any = (model.device, model.shaking, z)
    named = partial(_possible, *asked, names=model.names, wall=model.wall)
    found = jax.tree.map(np.asarray, tiles.map_tiles(named, _rows(series, times), _TILES))
    speeds, own = found.speed, np.where(np.isnan(found.speed), _NO_MOTION, 0.0)
    if series.speeds is not None:
        own += np.nan_to_num(np.abs(speeds - series.speeds[:-1, None] / float(model.device.speed_unit)))
    which = least_chain(speeds, series.sides[1:, None] * found.arrival, own)
    rows: Any = np.arange(len(which))
    return Motion(speeds[rows, which], found.stay[rows, which])


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
        total = cost[:, None] + np.nan_to_num(np.abs(arrivals[k - 1][:, None] - speeds[k]))
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
    near = likely_motions(model, series, z, times) if near is None else near
    asked: Any = (model.device, model.shaking, z)
    named = partial(_said, *asked, names=model.names, wall=model.wall)
    told = tiles.map_tiles(named, (_rows(series, times), near), _TILES)
    values, slopes, found = jax.tree.map(np.asarray, told)
    speed, arrival, metres = values.T
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
    order = _in_order(len(times), len(off))
    return Equations(
        off=off[order],
        impact=np.append(np.arange(1, len(times) - 1), np.arange(len(off) - len(times) + 2))[order],
        by_unknown=by_x[order, : len(z)],
        by_restitution=by_x[order, len(z) :],
        by_time=by_time.tocsr()[order],
        own_variance=own_variance[order],
        answered=answered[order],
        outside=found.outside,
        speeds=np.append(speed, series.sides[-1] * arrival[-1]),
        motions=Motion(found.speed, found.stay),
    )


def _banded(impacts: int, *bands: np.ndarray) -> Any:
    """Make the derivatives of equations by the times they read: the first at their own place, the others after it."""
    rows = len(bands[0])
    return scipy.sparse.diags_array(bands, offsets=range(len(bands)), shape=(rows, impacts), format="csr")


def _in_order(impacts: int, equations: int) -> np.ndarray:
    """Sort equations by the times they read, so that those of a covariance that are not 0 lie near its diagonal."""
    # The speed before the impact between two intervals, then their agreement on it.
    place = np.concatenate([np.arange(impacts - 2) + 0.5, np.arange(equations - impacts + 2)])
    return np.argsort(place, kind="stable")
