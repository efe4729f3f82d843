"""What the orbits of some cells of a map meet along one of its axes: where curves over the map begin."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future

import jax
import numpy as np

from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.orbits import orbit_search, periodic, repetition, symmetry
from vijax.orbits.arclength_walk import Walked, walk
from vijax.orbits.branch_path import Arc, Tests, heading, upwards
from vijax.orbits.continuation import arcs_from
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.curve_starts import CurveStart, curve_start
from vijax.orbits.events import Point, changed, locate
from vijax.orbits.limits import near_limits
from vijax.orbits.map_borders import LabelledPlane
from vijax.orbits.map_motions import settled
from vijax.orbits.parameter import skews
from vijax.orbits.periodic import Orbit
from vijax.runtime import context, tiles

_MOST_PERIOD, _MOST_IMPACTS = 12, 24  # of the orbits that seed curves; others are rare, and each width is a program
_NEAR_LIMIT = 0.3  # parts of a limit within which an orbit of a cell beside it is looked at
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
    steepest: float,
    max_points: int,
    settings: ContinuationSettings,
) -> Iterator[list[CurveStart]]:
    """Find the bifurcations that the orbits of some cells meet, each along an axis of the map, in several parts.

    Args:
        plane: The map.
        cells: Row and column of each.
        axis: Along which of the map's parameters each orbit is followed.
        reach: How many cells, at most.
        steepest: g/A of the device.
        max_points, settings: As in `follow`.
    """
    groups: dict[tuple, list[tuple[Orbit, np.ndarray]]] = {}
    for orbit, rows in _orbits(plane, cells):
        for way in (0, 1):
            some = axis[rows] == way
            if some.any():
                key = way, orbit.knots.shape[1]
                groups.setdefault(key, []).append((orbit[np.flatnonzero(some)], rows[some]))
    yield []  # Whoever counts the seconds may stop here.
    under_way: deque[Future[list[CurveStart]]] = deque()
    # Every group has a program of its own, and what compiles one keeps a single core busy.
    with context.pool(tiles.workers()) as pool:
        for (way, _), parts in groups.items():
            orbit = periodic.concatenate([part for part, _ in parts])
            where = cells[np.concatenate([rows for _, rows in parts])]
            asked = plane, orbit, where, way, reach, steepest, max_points, settings
            under_way.append(pool.submit(_met, *asked))
            if len(under_way) == tiles.workers():
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()


def limit_seeds(plane: LabelledPlane, cells: np.ndarray, device: Harvester) -> list[CurveStart]:
    """Find the orbits of some cells that are near a limit of the device."""
    found = []
    for orbit, rows in _orbits(plane, cells):
        places = np.stack([plane.axes[i][cells[rows, i]] for i in (0, 1)], axis=1)
        found += near_limits(orbit, device, plane.along, places, _NEAR_LIMIT)
    return found


def _orbits(plane: LabelledPlane, cells: np.ndarray) -> list[tuple[Orbit, np.ndarray]]:
    """Find the orbits that attract the balls of some cells, by width, with the rows of their cells."""
    states, impacts = settled(plane, cells)
    period = plane.period[tuple(cells.T)]
    width = np.array([tiles.padded(max(int(count), 1)) for count in impacts])
    kept = (period <= _MOST_PERIOD) & (impacts > 0) & (impacts <= _MOST_IMPACTS)
    found: dict[int, list[tuple[Orbit, np.ndarray]]] = {}
    for number, wide in sorted(set(zip(period[kept], width[kept], strict=True))):
        rows = np.flatnonzero(kept & (period == number) & (width == wide))
        # As often as a power of two, so that few programs are compiled.
        more = np.resize(rows, tiles.padded(rows.size))
        pair = tiles.arrays(plane.pairs(cells[more]))
        orbit = orbit_search.from_state(pair, *states[more].T, period=int(number))[: rows.size]
        for some, good in _by_symmetry(plane, orbit):
            size = tiles.padded(int(np.asarray(some.count).max()))
            found.setdefault(size, []).append((_trimmed(some, size), rows[good]))
    return [
        (periodic.concatenate([orbit for orbit, _ in several]), np.concatenate([rows for _, rows in several]))
        for several in found.values()
    ]


def _by_symmetry(plane: LabelledPlane, orbit: Orbit) -> list[tuple[Orbit, np.ndarray]]:
    """Part attracting orbits into symmetric ones, closed half way, and others; with their rows."""
    attracts = np.abs(np.asarray(orbit.multipliers)).max(axis=1) < 1
    good = np.flatnonzero((np.asarray(orbit.status) == Status.OK) & attracts)
    closes = np.asarray(symmetry.symmetric(orbit))[good] & (not any(map(skews, plane.along)))
    parts = [(good[closes], True), (good[~closes], False)]
    return [(symmetry.halved(orbit[rows]) if half else orbit[rows], rows) for rows, half in parts if rows.size]


def _trimmed(orbit: Orbit, width: int) -> Orbit:
    """Leave out what pads orbits beyond a width; orbits of one width are followed by one program."""
    host = jax.tree.map(np.asarray, orbit)
    have = host.knots.shape[1]
    more = ((0, 0), (0, max(width - have, 0)))
    side = np.pad(host.sequence.side[:, :width], more)
    knots = np.pad(host.knots[:, :width], (*more, (0, 0)), constant_values=np.nan)
    return periodic.proven(host.pair, *periodic.guessed(side, host.sequence.span, host.sequence.mirrored, knots))


def _met(
    plane: LabelledPlane,
    orbit: Orbit,
    cells: np.ndarray,
    way: int,
    reach: float,
    steepest: float,
    max_points: int,
    settings: ContinuationSettings,
) -> list[CurveStart]:
    """Follow orbits of one width both ways along one axis, and locate what they meet, all at once."""
    values, size = plane.axes[way], len(orbit)
    place = cells[:, way]
    low, high = (np.interp(place + shift, np.arange(len(values)), values) for shift in (-reach, reach))
    gravity = np.full(size, steepest)
    arcs, y = arcs_from(orbit, plane.along[way], values[place], gravity, (low, high), settings)
    first = upwards(arcs, y)
    twice = np.tile(np.arange(size), 2)
    both = jax.tree.map(lambda *leaves: np.concatenate(leaves), heading(first, -1.0), heading(first, 1.0))
    paths = jax.tree.map(lambda leaf: leaf[twice], arcs)
    walked = walk(paths, both, max_points, settings)
    still = plane.axes[1 - way][cells[twice, 1 - way]]
    return _starts(paths, walked, still, way, plane.along, settings)


def _starts(
    paths: Arc,
    walked: list[Walked],
    still: np.ndarray,
    way: int,
    plane: tuple[str, str],
    settings: ContinuationSettings,
) -> list[CurveStart]:
    """Locate what paths met, and make starts of it.

    Args:
        paths: A lane a row.
        walked: What each passed.
        still: The plane's other parameter of each.
        way: Which of the two they were followed along.
        plane: Both parameters.
        settings: Of events.
    """
    lane = np.repeat(np.arange(len(walked)), [len(one.y) - 1 for one in walked])
    before, after = (np.concatenate([one.tests[part] for one in walked]) for part in (slice(-1), slice(1, None)))
    met, test = np.nonzero(changed(before, after) & np.isin(Tests._fields, list(_KINDS)))
    if not met.size:
        return []
    y = np.concatenate([one.y[:-1] for one in walked])[met]
    tangent = np.concatenate([one.tangent[:-1] for one in walked])[met]
    length = np.concatenate([one.lengths[1:] for one in walked])[met]
    own = jax.tree.map(lambda leaf: leaf[lane[met]], paths)
    _, there, zero = locate(own, y, tangent, length, test, before[met, test], settings)
    pair, knots = own.pair_and_knots(there)
    orbit = periodic.proven(pair, own.sequence, knots)
    x, other = there[:, -1] * (own.high - own.low), still[lane[met]]
    mirrored = np.asarray(orbit.sequence.mirrored)
    # A branch of mirror pairs turns where the two of a pair meet, and one of doubled orbits where both turns do.
    alike = np.asarray(symmetry.symmetric(orbit, settings.asymmetry)) & ~mirrored
    number = repetition.turns(orbit.sequence, orbit.knots, settings.asymmetry)
    found = []
    for row in np.flatnonzero(zero):
        kind, here = _KINDS[Tests._fields[test[row]]], orbit[row : row + 1]
        if (kind == "flip" and mirrored[row]) or (kind == "fold" and alike[row]):
            kind = "pitchfork"
        elif kind == "fold" and number[row] > 1:
            kind, here = "flip", periodic.mean_turn(here, number[row : row + 1])
        value = float(x[row])
        place = (value, float(other[row])) if way == 0 else (float(other[row]), value)
        begun = curve_start(Point(kind, value, here), place, settings.asymmetry, plane)
        if not isinstance(begun, str):
            found.append(begun)
    return found
