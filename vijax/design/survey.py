"""Which attractors many cells meet, impact by impact."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.batch import simulate
from vijax.batch.impact_log import record
from vijax.batch.simulate import Starts
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import SETTLED, State, Status
from vijax.orbits.shooting import Sequence
from vijax.runtime import context
from vijax.runtime.tiles import padded, workers

_SMALLEST_TILE, _LARGEST_TILE = 1024, 8192  # cells of a compiled call
_SHARE = 512  # cells for which a core is worth it
_SAME = 1e-6  # relative difference within which attractors of one pair are the same; see `basins`
_CROSSED = 0.6  # width of a gap that a ball of a typical speed, 0.3, crosses in one forcing period


class Flown(NamedTuple):
    """Orbits as they were flown, in the order of the cells that met them first.

    Attributes:
        pair: Parameters of each [motion].
        side, knots: Its impacts, [motion, impact], padded with side 0 and zeros; see `Orbit`.
        span: Time after which an orbit closes.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each impact; NaN beyond.
        cell: Which one met it first.
    """

    pair: ImpactPair
    side: np.ndarray
    knots: np.ndarray
    span: np.ndarray
    depth: np.ndarray
    work: np.ndarray
    cell: np.ndarray

    def sequence(self, width: int) -> Sequence:
        """Give walls and closing of all orbits, of so many impacts: with the knots what `periodic.solve` takes."""
        return Sequence(jnp.asarray(self.side[:, :width]), jnp.asarray(self.span), jnp.zeros(self.span.size, bool))


class Survey(NamedTuple):
    """How cells ended.

    Attributes:
        pair: The cells.
        ended: A `Summary` of each.
        longest: Most forcing periods of an orbit that is wanted, of every cell.
    """

    pair: ImpactPair
    ended: Any
    longest: np.ndarray

    def orbits(self, impacts: int) -> Flown:
        """Fly the periodic attractors of at most so many impacts, of mirror images on level ground one.

        Of cells that differ in their starts alone each one once.
        """
        some = self.closing(impacts)
        pair, ended = jax.tree.map(lambda x: x[some], (self.pair, self.ended))
        return flown(pair, ended, impacts)._replace(cell=some)

    def closing(self, impacts: int, owner: np.ndarray | int = 0) -> np.ndarray:
        """Find the cells that met such an attractor first.

        Args:
            impacts: The most impacts of an attractor.
            owner: Index of the device of every cell. Devices of equal pairs differ in their limits or their energies,
                so each of them has its own attractors.
        """
        some = np.flatnonzero(self._closing(impacts))
        owners = np.broadcast_to(owner, self.longest.shape)
        return some[_distinct(*jax.tree.map(lambda x: x[some], (owners, self.pair, self.ended)))]

    def restless(self, impacts: int) -> np.ndarray:
        """Find cells whose motion is no such orbit: chaos, not settled, or of too many periods or impacts.

        A cell without an impact counts too: in a wide gap the ball may fly for long before its next impact.
        """
        going = np.isfinite(self.ended.P[:, 0]) & (self.ended.status != Status.PERMANENT_CONTACT)
        return np.flatnonzero(going & ~self._closing(impacts))

    def onward(self, cells: np.ndarray, device: Harvester, periods: int | np.ndarray) -> "Survey":
        """Run some cells on from where they were left.

        Args:
            cells: Which cells.
            device: Devices of all cells.
            periods: Forcing periods of all cells.
        """
        some = self.longest, np.broadcast_to(periods, self.longest.shape)
        pair, own, ended, longest, most = jax.tree.map(lambda x: x[cells], (self.pair, device, self.ended, *some))
        left = ended.handover
        again = survey(pair, own, Starts(left.u, left.v, left.t), longest=longest, periods=most).ended

        def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            whole = np.array(old)
            whole[cells] = new
            return whole

        return self._replace(ended=jax.tree.map(put, self.ended, again))

    def _closing(self, impacts: int) -> np.ndarray:
        """Say which cells ended on an orbit that is wanted."""
        ended, count = self.ended, self.ended.impacts_left + self.ended.impacts_right
        some = (ended.period > 0) & (ended.period <= self.longest) & (count > 0) & (count <= impacts)
        return np.isin(ended.status, SETTLED) & some


def stretch(d: Any) -> np.ndarray:
    """Return how many times as many forcing periods a flight takes in gaps d: 1, and from 1.2 on 2, 4, 8 ...

    A ball needs longer to cross a wide gap, and so do its impacts to come, its attractor to be met, its orbit to close.
    """
    return np.exp2(np.floor(np.log2(np.maximum(np.asarray(d) / _CROSSED, 1.0)))).astype(int)


def survey(
    pair: ImpactPair, device: Harvester, starts: Starts, *, longest: int | np.ndarray, periods: int | np.ndarray
) -> Survey:
    """Run soft cells until their attractors are certain.

    Args:
        pair: Cells [cell].
        device: Those that they are the nondimensional form of.
        starts: Where each starts.
        longest: Most forcing periods of an orbit that will be wanted, of all cells or of each.
        periods: Forcing periods that the search for an attractor may take, likewise.
    """
    pair, device, starts = jax.tree.map(np.asarray, (pair, device, starts))
    longest, periods = (np.broadcast_to(x, np.shape(pair.d)) for x in (longest, periods))
    parts, order = [], []
    # A compiled call takes one number of periods.
    for most in np.unique(periods):
        rows = np.flatnonzero(periods == most)
        own = jax.tree.map(lambda x, rows=rows: x[rows], (pair, device, starts))
        parts.append(_ended(own[0], own[1], own[2], int(longest[rows].max()), int(most)))
        order.append(rows)
    back = np.argsort(np.concatenate(order))
    return Survey(pair, jax.tree.map(lambda *x: np.concatenate(x)[back], *parts), longest)


def flown(pair: ImpactPair, ended: Any, impacts: int) -> Flown:
    """Fly the orbits of cells that ended on some, of at most so many impacts, once more impact by impact."""
    # A period more, lest rounding moves an impact at phase 0 out of it.
    table = _recorded(pair, ended.handover, ended.period + 1, impacts)
    count = ended.impacts_left + ended.impacts_right
    return _flown(pair, 2.0 * ended.period, table, np.arange(impacts) < count[:, None], np.arange(count.size))


def _ended(pair: ImpactPair, device: Harvester, starts: Starts, longest: int, periods: int) -> Any:
    """Run every cell to its end, a `Summary`, in tiles on every core."""
    cells = pair.d.size
    share = math.ceil(cells / workers())
    size = min(max(padded(share), _SMALLEST_TILE), _LARGEST_TILE)
    # Padding costs nothing, as it is not run: one program serves a default survey and smaller ones.
    number = max(math.ceil(cells / size), min(workers(), math.ceil(cells / _SHARE)))
    # Strided tiles cost the same.
    tiles = [np.arange(first, cells, number) for first in range(number)]

    def part(rows: np.ndarray) -> Any:
        own = jax.tree.map(lambda x: x[rows], (pair, device, starts))
        return simulate.attractors(*own, periods=periods, recorded_periods=longest, padded=size)

    with context.pool(workers()) as pool:
        parts = list(pool.map(part, tiles))
    order = np.argsort(np.concatenate(tiles))
    return jax.tree.map(lambda *x: np.concatenate(x)[order], *parts)


def _distinct(owner: np.ndarray, pair: ImpactPair, ended: Any) -> np.ndarray:
    """Find the cells that met an attractor of their device and pair first; by impacts, greatest speed and depth."""
    left, right = ended.impacts_left, ended.impacts_right
    swap = pair.symmetric & (right > left)
    measures = [np.round(np.log(x) / _SAME) for x in (ended.fastest, ended.deepest)]
    counts = ended.period, np.where(swap, right, left), np.where(swap, left, right)
    marks = np.column_stack([owner, *jax.tree.leaves(pair), *counts, *measures])
    _, first = np.unique(marks, axis=0, return_index=True)
    return np.sort(first)


_COLUMNS = "n", "t", "side", "v_in", "duration", "depth", "work"


def _recorded(pair: ImpactPair, handover: Any, periods: np.ndarray, impacts: int) -> dict[str, np.ndarray]:
    """Record so many first impacts of the last periods of cells by name, [cell, impact], NaN beyond."""
    u, v, t, n, held = jax.tree.leaves((handover.mark, handover.held))
    mark = State(u, v, t, n.astype(np.int32), held.astype(np.int32))

    def part(rows: np.ndarray) -> dict[str, np.ndarray]:
        own, at = jax.tree.map(lambda x: x[rows], (pair, mark))
        return record(own, at, int(periods[rows[0]]), np.ones(rows.size, bool)).impacts

    alike = [np.flatnonzero(periods == number) for number in np.unique(periods)]
    parts = [rows for some in alike for rows in np.array_split(some, min(workers(), some.size))]
    with context.pool(workers()) as pool:
        found = list(pool.map(part, parts))
    table = {name: np.full((u.size, impacts), np.nan) for name in _COLUMNS}
    for rows, one in zip(parts, found, strict=True):
        for name, column in table.items():
            some = one[name][:, :impacts]
            column[rows, : some.shape[1]] = some
    return table


def _flown(
    pair: ImpactPair, span: np.ndarray, table: dict[str, np.ndarray], real: np.ndarray, cell: np.ndarray
) -> Flown:
    """Make motions of the table of their impacts, of which some are meant."""
    knots = np.stack([2 * table["n"] + table["t"], np.abs(table["v_in"]), table["duration"]], axis=-1)
    return Flown(
        pair=pair,
        side=np.where(real, table["side"], 0).astype(np.int32),
        knots=np.where(real[..., None], knots, 0.0),
        span=span,
        depth=np.where(real, table["depth"], np.nan),
        work=np.where(real, table["work"], np.nan),
        cell=cell,
    )
