"""Simulate many cells until each attractor is identified, and record the periodic ones impact by impact."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import USABLE_STATUSES, State, Status
from vijax.orbits.shooting import Sequence
from vijax.runtime import public_api
from vijax.runtime.tiles import padded, workers
from vijax.simulation import simulate
from vijax.simulation.impact_log import record_impacts
from vijax.simulation.simulate import Starts

_SMALLEST_TILE, _LARGEST_TILE = 1024, 8192  # smallest and largest number of cells of a compiled call
_CELLS_PER_CORE = 512  # smallest number of cells per core that saves time
_SAME_ATTRACTOR = 1e-6  # relative difference below which attractors of one pair are the same
_REFERENCE_GAP = 0.6  # gap that a ball of typical speed 0.3 crosses in one forcing period, 2


class RecordedOrbits(NamedTuple):
    """Recorded orbits, one row per orbit.

    Attributes:
        pair: Parameters of each orbit [orbit].
        side, impact_unknowns: Wall (-1 or 1) and impact unknowns of each impact, [orbit, impact, ...], padded with
            zeros; see `Orbit`.
        span: Duration of one period of the orbit, in units of time.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each impact; NaN beyond the
            last impact.
        cell: Lowest index of a cell that reached the orbit.
    """

    pair: ImpactPair
    side: np.ndarray
    impact_unknowns: np.ndarray
    span: np.ndarray
    depth: np.ndarray
    work: np.ndarray
    cell: np.ndarray

    def sequence(self, width: int) -> Sequence:
        """Return the first `width` walls, and the spans, of all orbits, as an argument of `periodic.solve`."""
        return Sequence(jnp.asarray(self.side[:, :width]), jnp.asarray(self.span), jnp.zeros(self.span.size, bool))


class Survey(NamedTuple):
    """Results of a survey: one simulated motion per cell.

    Attributes:
        pair: Parameters of the cells.
        summary: A `Summary` of each cell.
        max_period: Longest orbit of each cell that counts as periodic, in forcing periods.
    """

    pair: ImpactPair
    summary: Any
    max_period: np.ndarray

    def orbits(self, impacts: int) -> RecordedOrbits:
        """Record the periodic attractors with at most `impacts` impacts.

        If several cells with the same pair end on one attractor, it is recorded once. At level ground only one of two
        mirror images is recorded.
        """
        cells = self.orbit_cells(impacts)
        pair, summary = jax.tree.map(lambda x: x[cells], (self.pair, self.summary))
        return record_orbits(pair, summary, impacts)._replace(cell=cells)

    def orbit_cells(self, impacts: int, device_index: np.ndarray | int = 0) -> np.ndarray:
        """Return, for each periodic attractor, the lowest index of a cell that reached it.

        Args:
            impacts: Largest number of impacts of an attractor.
            device_index: Index of the device of every cell. Devices with equal pairs may differ in limits or energies,
                so attractors are distinguished by device, too.
        """
        cells = np.flatnonzero(self._ends_on_orbit(impacts))
        device_indices = np.broadcast_to(device_index, self.max_period.shape)
        return cells[_first_cells(*jax.tree.map(lambda x: x[cells], (device_indices, self.pair, self.summary)))]

    def non_orbit_cells(self, impacts: int) -> np.ndarray:
        """Return the cells with motion other than these orbits: aperiodic, undecided, or an orbit that is too long.

        Cells in permanent contact are excluded. Cells without an impact are included, because in a wide gap a ball may
        move for a long time before its next impact.
        """
        is_moving = np.isfinite(self.summary.P[:, 0]) & (self.summary.status != Status.PERMANENT_CONTACT)
        return np.flatnonzero(is_moving & ~self._ends_on_orbit(impacts))

    def resume(self, cells: np.ndarray, device: Harvester, periods: int | np.ndarray) -> "Survey":
        """Return the survey with some cells continued from their last states.

        Args:
            cells: Indices of these cells.
            device: Devices of all cells.
            periods: Forcing periods of the continuation, for all cells or for each.
        """
        per_cell = self.max_period, np.broadcast_to(periods, self.max_period.shape)
        pair, devices, summary, max_period, max_periods = jax.tree.map(
            lambda x: x[cells], (self.pair, device, self.summary, *per_cell)
        )
        state = summary.handover
        continued = simulate_survey(
            pair, devices, Starts(state.u, state.v, state.t), max_period=max_period, periods=max_periods
        ).summary

        # Only the continued cells are replaced in the summary.
        def merge(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            merged = np.array(old)
            merged[cells] = new
            return merged

        return self._replace(summary=jax.tree.map(merge, self.summary, continued))

    def _ends_on_orbit(self, impacts: int) -> np.ndarray:
        """Return a mask of the cells on orbits with at most `max_period` forcing periods and `impacts` impacts."""
        summary, count = self.summary, self.summary.impacts_left + self.summary.impacts_right
        is_requested = (summary.period > 0) & (summary.period <= self.max_period) & (count > 0) & (count <= impacts)
        return np.isin(summary.status, USABLE_STATUSES) & is_requested


def gap_time_factor(d: Any) -> np.ndarray:
    """Return the factor on simulated periods in gaps d: 1 for d < 1.2, 2 for d < 2.4, 4 for d < 4.8, and so on.

    A ball needs longer to cross a wide gap, so its impacts, its transient and its orbit take longer in proportion.
    """
    return np.exp2(np.floor(np.log2(np.maximum(np.asarray(d) / _REFERENCE_GAP, 1.0)))).astype(int)


def simulate_survey(
    pair: ImpactPair, device: Harvester, starts: Starts, *, max_period: int | np.ndarray, periods: int | np.ndarray
) -> Survey:
    """Simulate cells with soft walls until their attractors are identified or the periods are used up.

    Args:
        pair: Parameters of the cells [cell].
        device: Device of each cell; `pair` is its nondimensional form.
        starts: Start of each cell.
        max_period: Longest orbit that counts as periodic, in forcing periods; one value, or one per cell.
        periods: Largest number of simulated forcing periods; one value, or one per cell.
    """
    pair, device, starts = jax.tree.map(np.asarray, (pair, device, starts))
    max_period, periods = (np.broadcast_to(x, np.shape(pair.d)) for x in (max_period, periods))
    parts, order = [], []
    # A compiled call has one number of periods for all its cells.
    for max_periods in np.unique(periods):
        rows = np.flatnonzero(periods == max_periods)
        group = jax.tree.map(lambda x, rows=rows: x[rows], (pair, device, starts))
        parts.append(_simulate_cells(group[0], group[1], group[2], int(max_period[rows].max()), int(max_periods)))
        order.append(rows)
    # Inverse permutation, from the groups back to the order of the cells.
    inverse = np.argsort(np.concatenate(order))
    return Survey(pair, jax.tree.map(lambda *x: np.concatenate(x)[inverse], *parts), max_period)


def record_orbits(pair: ImpactPair, summary: Any, impacts: int) -> RecordedOrbits:
    """Simulate the orbits of cells that ended on orbits of at most `impacts` impacts again, and record each impact."""
    # One forcing period more is simulated, because rounding may move an impact at phase 0 past the end of the orbit.
    table = _record_impacts(pair, summary.handover, summary.period + 1, impacts)
    count = summary.impacts_left + summary.impacts_right
    return _make_orbits(pair, 2.0 * summary.period, table, np.arange(impacts) < count[:, None], np.arange(count.size))


def _simulate_cells(pair: ImpactPair, device: Harvester, starts: Starts, max_period: int, periods: int) -> Any:
    """Simulate all cells in tiles on every core, and return the `Summary` of the cells."""
    cells = pair.d.size
    share = math.ceil(cells / workers())
    size = min(max(padded(share), _SMALLEST_TILE), _LARGEST_TILE)
    # Padding costs nothing because it is not simulated. All tiles therefore have one padded size and one compiled
    # program.
    number = max(math.ceil(cells / size), min(workers(), math.ceil(cells / _CELLS_PER_CORE)))
    # Neighbouring cells take about the same time, so tiles of every `number`-th cell take the same time.
    tiles = [np.arange(first, cells, number) for first in range(number)]

    def simulate_tile(rows: np.ndarray) -> Any:
        """Simulate one tile."""
        rows_of_tile = jax.tree.map(lambda x: x[rows], (pair, device, starts))
        return simulate.run_devices(*rows_of_tile, periods=periods, recorded_periods=max_period, padded=size)

    with public_api.pool(workers()) as pool:
        parts = list(pool.map(simulate_tile, tiles))
    order = np.argsort(np.concatenate(tiles))
    return jax.tree.map(lambda *x: np.concatenate(x)[order], *parts)


def _first_cells(device_index: np.ndarray, pair: ImpactPair, summary: Any) -> np.ndarray:
    """Return one cell, the first, for each distinct attractor of a device and pair.

    Attractors are equal if period, numbers of impacts, largest speed and largest depth are equal.
    """
    left, right = summary.impacts_left, summary.impacts_right
    # At level ground a mirror image exchanges the walls; the larger count comes first.
    swap = pair.symmetric & (right > left)
    # Logarithms are rounded, so that values with a relative difference below about 1e-6 are equal.
    measures = [np.round(np.log(x) / _SAME_ATTRACTOR) for x in (summary.fastest, summary.deepest)]
    counts = summary.period, np.where(swap, right, left), np.where(swap, left, right)
    keys = np.column_stack([device_index, *jax.tree.leaves(pair), *counts, *measures])
    _, first = np.unique(keys, axis=0, return_index=True)
    return np.sort(first)


_COLUMNS = "n", "t", "side", "v_in", "duration", "depth", "work"


def _record_impacts(pair: ImpactPair, handover: Any, periods: np.ndarray, impacts: int) -> dict[str, np.ndarray]:
    """Return columns [cell, impact] of the first `impacts` impacts of the last periods; NaN where there are fewer."""
    u, v, t, n, mode = jax.tree.leaves((handover.mark, handover.mode))
    mark = State(u, v, t, n.astype(np.int32), mode.astype(np.int32))

    def record_part(rows: np.ndarray) -> dict[str, np.ndarray]:
        """Record the cells of one part."""
        pairs, states = jax.tree.map(lambda x: x[rows], (pair, mark))
        return record_impacts(pairs, states, int(periods[rows[0]]), np.ones(rows.size, bool)).impacts

    # All cells of one call of `record_impacts` have the same number of periods.
    groups = [np.flatnonzero(periods == number) for number in np.unique(periods)]
    parts = [rows for block in groups for rows in np.array_split(block, min(workers(), block.size))]
    with public_api.pool(workers()) as pool:
        recorded = list(pool.map(record_part, parts))
    table = {name: np.full((u.size, impacts), np.nan) for name in _COLUMNS}
    for rows, impacts_of_part in zip(parts, recorded, strict=True):
        for name, column in table.items():
            block = impacts_of_part[name][:, :impacts]
            column[rows, : block.shape[1]] = block
    return table


def _make_orbits(
    pair: ImpactPair, span: np.ndarray, table: dict[str, np.ndarray], real: np.ndarray, cell: np.ndarray
) -> RecordedOrbits:
    """Return the orbits of a table of impacts; impacts with `real` False are padding."""
    # Unknowns of an impact: time since the start of the orbit (forcing period 2), speed into the wall, contact
    # duration.
    impact_unknowns = np.stack([2 * table["n"] + table["t"], np.abs(table["v_in"]), table["duration"]], axis=-1)
    return RecordedOrbits(
        pair=pair,
        side=np.where(real, table["side"], 0).astype(np.int32),
        impact_unknowns=np.where(real[..., None], impact_unknowns, 0.0),
        span=span,
        depth=np.where(real, table["depth"], np.nan),
        work=np.where(real, table["work"], np.nan),
        cell=cell,
    )
