"""Starts of curves over a map: the bifurcations of orbits of some cells along one of the map's axes."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future

import jax
import numpy as np

from vijax.continuation.branch_continuation import make_branch_paths
from vijax.continuation.branch_equations import BranchPath, BranchTests, orient, start_points
from vijax.continuation.branch_events import Point, locate, sign_changed
from vijax.continuation.continuation_parameter import breaks_mirror_symmetry
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.curves.curve_starts import CurveStart, curve_start
from vijax.continuation.from_map.map_attractors import attractor_states
from vijax.continuation.from_map.map_borders import LabelledPlane
from vijax.continuation.limits import starts_near_limits
from vijax.continuation.path_following import PathRecord, follow_paths
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.orbits import orbit_search, periodic, repetition, symmetry
from vijax.orbits.periodic import Orbit
from vijax.runtime import public_api, tiles

_MAX_PERIOD, _MAX_IMPACTS = 12, 24  # of orbits that start curves; longer ones are rare, and each width needs a program
_NEAR_LIMIT = 0.3  # largest relative distance from a limit of an orbit that starts a curve
_KINDS = {
    "speed": "grazing impact",
    "flight": "grazing flight",
    "contact": "grazing contact",
    "fold": "fold",
    "minus": "flip",
}


def seeds(
    plane: LabelledPlane,
    cells: np.ndarray,
    axis: np.ndarray,
    reach: float,
    vertical_gamma: float,
    max_points: int,
    settings: ContinuationSettings,
) -> Iterator[list[CurveStart]]:
    """Yield starts at the bifurcations of the orbits of some cells, each followed along an axis of the map.

    Args:
        plane: The map.
        cells: Row and column of each cell.
        axis: Axis of the map along which each orbit is followed.
        reach: Largest distance, in cells, over which an orbit is followed.
        vertical_gamma: g/A of the device.
        max_points, settings: Largest number of points of each branch, and the settings of its steps.
    """
    groups: dict[tuple, list[tuple[Orbit, np.ndarray]]] = {}
    for orbit, rows in _orbits(plane, cells):
        for axis_index in (0, 1):
            selected = axis[rows] == axis_index
            if selected.any():
                # Orbits with the same axis and width are followed by one program.
                key = axis_index, orbit.impact_unknowns.shape[1]
                groups.setdefault(key, []).append((orbit[np.flatnonzero(selected)], rows[selected]))
    yield []  # the caller may stop here when its time is used up
    under_way: deque[Future[list[CurveStart]]] = deque()
    # Use threads, because every group has a program of its own and its compilation uses a single core.
    with public_api.pool(tiles.workers()) as pool:
        for (axis_index, _), parts in groups.items():
            orbit = periodic.concatenate([part for part, _ in parts])
            group_cells = cells[np.concatenate([rows for _, rows in parts])]
            arguments = plane, orbit, group_cells, axis_index, reach, vertical_gamma, max_points, settings
            under_way.append(pool.submit(_bifurcation_starts, *arguments))
            # At most one job per worker is pending, so that a caller that stops discards little work.
            if len(under_way) == tiles.workers():
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()


def limit_seeds(plane: LabelledPlane, cells: np.ndarray, device: Harvester) -> list[CurveStart]:
    """Return starts at the orbits of some cells that are near a limit of the device."""
    starts = []
    for orbit, rows in _orbits(plane, cells):
        parameters = np.stack([plane.axes[i][cells[rows, i]] for i in (0, 1)], axis=1)
        starts += starts_near_limits(orbit, device, plane.along, parameters, _NEAR_LIMIT)
    return starts


def _orbits(plane: LabelledPlane, cells: np.ndarray) -> list[tuple[Orbit, np.ndarray]]:
    """Return the attracting orbits of some cells, in batches of one width, with the rows of their cells."""
    states, impacts = attractor_states(plane, cells)
    period = plane.period[tuple(cells.T)]
    width = np.array([tiles.padded(max(int(count), 1)) for count in impacts])
    # Long orbits and motions without impacts start no curve.
    usable = (period <= _MAX_PERIOD) & (impacts > 0) & (impacts <= _MAX_IMPACTS)
    by_width: dict[int, list[tuple[Orbit, np.ndarray]]] = {}
    for number, wide in sorted(set(zip(period[usable], width[usable], strict=True))):
        rows = np.flatnonzero(usable & (period == number) & (width == wide))
        # The number of rows is padded to a power of two, so that few programs are compiled.
        padded_rows = np.resize(rows, tiles.padded(rows.size))
        pair = tiles.arrays(plane.pairs(cells[padded_rows]))
        orbit = orbit_search.orbits_from_states(pair, *states[padded_rows].T, period=int(number))[: rows.size]
        for part, part_rows in _by_symmetry(plane, orbit):
            size = tiles.padded(int(np.asarray(part.count).max()))
            by_width.setdefault(size, []).append((_padded_orbits(part, size), rows[part_rows]))
    return [
        (periodic.concatenate([orbit for orbit, _ in several]), np.concatenate([rows for _, rows in several]))
        for several in by_width.values()
    ]


def _by_symmetry(plane: LabelledPlane, orbit: Orbit) -> list[tuple[Orbit, np.ndarray]]:
    """Split attracting orbits, with their rows, into symmetric orbits, reduced to half a period, and other orbits."""
    # Although the cell reaches an attractor, Newton's method may have converged to an unstable orbit near the
    # attractor.
    attracts = np.abs(np.asarray(orbit.multipliers)).max(axis=1) < 1
    attracting = np.flatnonzero((np.asarray(orbit.status) == Status.OK) & attracts)
    is_symmetric = np.asarray(symmetry.is_symmetric(orbit))[attracting] & (
        not any(map(breaks_mirror_symmetry, plane.along))
    )
    parts = [(attracting[is_symmetric], True), (attracting[~is_symmetric], False)]
    return [
        (symmetry.close_half_way(orbit[rows]) if close else orbit[rows], rows) for rows, close in parts if rows.size
    ]


def _padded_orbits(orbit: Orbit, width: int) -> Orbit:
    """Return orbits padded to a width; orbits of one width are followed by one program."""
    orbit_host = jax.tree.map(np.asarray, orbit)
    present_width = orbit_host.impact_unknowns.shape[1]
    padding = ((0, 0), (0, max(width - present_width, 0)))
    side = np.pad(orbit_host.sequence.side[:, :width], padding)
    impact_unknowns = np.pad(orbit_host.impact_unknowns[:, :width], (*padding, (0, 0)), constant_values=np.nan)
    return periodic.verify_solutions(
        orbit_host.pair,
        *periodic.make_guess(side, orbit_host.sequence.span, orbit_host.sequence.mirrored, impact_unknowns),
    )


def _bifurcation_starts(
    plane: LabelledPlane,
    orbit: Orbit,
    cells: np.ndarray,
    axis: int,
    reach: float,
    vertical_gamma: float,
    max_points: int,
    settings: ContinuationSettings,
) -> list[CurveStart]:
    """Follow orbits of one width along one axis in both directions, and return starts at their bifurcations."""
    values, size = plane.axes[axis], len(orbit)
    index = cells[:, axis]
    # Bounds of each branch: `reach` cells on either side, within the map.
    low, high = (np.interp(index + shift, np.arange(len(values)), values) for shift in (-reach, reach))
    vertical_gammas = np.full(size, vertical_gamma)
    orbit_paths, y = make_branch_paths(orbit, plane.along[axis], values[index], vertical_gammas, (low, high), settings)
    first = start_points(orbit_paths, y)
    lanes = np.tile(np.arange(size), 2)
    both_ways = jax.tree.map(lambda *leaves: np.concatenate(leaves), orient(first, -1.0), orient(first, 1.0))
    paths = jax.tree.map(lambda leaf: leaf[lanes], orbit_paths)
    records = follow_paths(paths, both_ways, max_points, settings)
    fixed = plane.axes[1 - axis][cells[lanes, 1 - axis]]
    return _located_starts(paths, records, fixed, axis, plane.along, settings)


def _located_starts(
    paths: BranchPath,
    records: list[PathRecord],
    fixed: np.ndarray,
    axis: int,
    plane: tuple[str, str],
    settings: ContinuationSettings,
) -> list[CurveStart]:
    """Locate events on paths, and return starts at them.

    Args:
        paths: The paths, one lane per row.
        records: Points of each path.
        fixed: Value of the plane's other parameter on each path.
        axis: Index of the parameter along which they were followed.
        plane: Both parameters.
        settings: Settings of events.
    """
    lane = np.repeat(np.arange(len(records)), [len(record.y) - 1 for record in records])
    before, after = (np.concatenate([record.tests[part] for record in records]) for part in (slice(-1), slice(1, None)))
    step, test = np.nonzero(sign_changed(before, after) & np.isin(BranchTests._fields, list(_KINDS)))
    if not step.size:
        return []
    y = np.concatenate([record.y[:-1] for record in records])[step]
    tangent = np.concatenate([record.tangent[:-1] for record in records])[step]
    length = np.concatenate([record.lengths[1:] for record in records])[step]
    event_paths = jax.tree.map(lambda leaf: leaf[lane[step]], paths)
    _, located, is_zero = locate(event_paths, y, tangent, length, test, before[step, test], settings)
    pair, impact_unknowns = event_paths.pair_and_unknowns(located)
    orbit = periodic.verify_solutions(pair, event_paths.sequence, impact_unknowns)
    x, other = located[:, -1] * (event_paths.high - event_paths.low), fixed[lane[step]]
    mirrored = np.asarray(orbit.sequence.mirrored)
    # A branch of mirror pairs turns back where the pair merges, and a branch of doubled orbits where both periods
    # become equal.
    is_symmetric = np.asarray(symmetry.is_symmetric(orbit, settings.asymmetry)) & ~mirrored
    repetitions = repetition.count_repetitions(orbit.sequence, orbit.impact_unknowns, settings.asymmetry)
    starts = []
    for row in np.flatnonzero(is_zero):
        kind, event_orbit = _KINDS[BranchTests._fields[test[row]]], orbit[row : row + 1]
        if (kind == "flip" and mirrored[row]) or (kind == "fold" and is_symmetric[row]):
            kind = "pitchfork"
        elif kind == "fold" and repetitions[row] > 1:
            kind, event_orbit = "flip", periodic.solve_mean_repetition(event_orbit, repetitions[row : row + 1])
        value = float(x[row])
        parameters = (value, float(other[row])) if axis == 0 else (float(other[row]), value)
        start = curve_start(Point(kind, value, event_orbit), parameters, settings.asymmetry, plane)
        if not isinstance(start, str):
            starts.append(start)
    return starts
