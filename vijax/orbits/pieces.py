"""Paths from graze to graze: at soft walls they go on with orbits that have an impact more or fewer.

Branches and curves of bifurcations are made of such pieces, all of which are followed together, piece after piece.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.arclength_step import BranchPlace, Path
from vijax.orbits.arclength_walk import Walked, walk
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.orbit_properties import marks
from vijax.orbits.periodic import Orbit
from vijax.orbits.soft_graze import Passage

_SAME_PLACE = 1e-12  # So little apart are values of the parameters at which a path begins and ends.


class Piece(NamedTuple):
    """A path from graze to graze.

    Attributes:
        values: Of the parameters, one or a row an orbit.
        orbits: In order, in batches of several widths.
        points: What was met, records with fields `gained` and `wall`; at last the graze.
        end: Why it ends.
        beyond: What is beyond the graze at which it ends, if it does and something is.
    """

    values: np.ndarray
    orbits: list[Orbit]
    points: list[Any]
    end: str
    beyond: Passage | None


class Followed(NamedTuple):
    """A whole path: values, orbits, what was met on it, and why it ends at its first and at its last orbit."""

    values: np.ndarray
    orbit: Orbit
    points: list[Any]
    ends: tuple[str, str]


Making = Callable[[list[int], Any, list[Walked], list[bool]], list[Piece]]
"""Makes pieces of what was walked: which starts, their paths, the records, and whether each path begins with its own.

Of one that does not, the first point is the graze at which the piece before it ended.
"""


def follow_pieces(
    paths: Path, first: BranchPlace, making: Making, points: int, settings: ContinuationSettings
) -> list[Followed]:
    """Follow one way from every start, through grazes at soft walls.

    Args:
        paths, first: What is followed, a lane a row, and where from.
        making: See `Making`.
        points: Most points of a path.
        settings: Of the steps, and of how many grazes are gone through.
    """
    ways: list[list[Piece]] = [[] for _ in first.y]
    going = [(lane, *jax.tree.map(lambda leaf, i=lane: leaf[i], (paths, first))) for lane in range(len(ways))]
    while going:
        # Orbits of as many impacts are followed together.
        for width in sorted({place.y.size for _, _, place in going}):
            chosen, *rows = zip(*(one for one in going if one[2].y.size == width), strict=True)
            lanes = list(chosen)
            some, places = (jax.tree.map(lambda *leaves: np.stack(leaves), *row) for row in rows)
            left = np.array([points - _size(ways[lane]) for lane in lanes])
            walked = walk(some, places, left, settings)
            for lane, piece in zip(lanes, making(lanes, some, walked, [not ways[i] for i in lanes]), strict=True):
                ways[lane].append(piece if ways[lane] else _once(piece))
        on = [(lane, ways[lane][-1].beyond) for lane, _, _ in going if _goes_on(ways[lane], points, settings)]
        going = [(lane, to.path, to.place) for lane, to in on if to is not None]
    return [_whole(way, settings) for way in ways]


def _once(piece: Piece) -> Piece:
    """Keep the orbit once of a path that ends where it begins: at a graze, or at a bound."""
    if len(piece.values) != 2:
        return piece
    begin, end = piece.values
    if not np.allclose(begin, end, rtol=_SAME_PLACE, atol=_SAME_PLACE):
        return piece
    return piece._replace(values=piece.values[:1], orbits=[_in_one(piece.orbits)[:1]])


def _size(way: list[Piece]) -> int:
    return sum(len(piece.values) for piece in way)


def _goes_on(way: list[Piece], points: int, settings: ContinuationSettings) -> bool:
    """Say whether a path is to be followed beyond the end of its last piece."""
    some = len(way) <= settings.max_grazings and _size(way) + 1 < points
    return some and not _came_round(way, settings)


def _came_round(way: list[Piece], settings: ContinuationSettings) -> bool:
    """Say whether a path has come by its first graze again, in the same direction."""
    one, other = way[0].beyond, way[-1].beyond
    if len(way) == 1 or one is None or other is None or (one.touches, one.gained) != (other.touches, other.gained):
        return False
    traits = [np.append(marks(graze.orbit)[0], jax.tree.leaves(graze.orbit.pair)) for graze in (one, other)]
    return bool(np.allclose(traits[0], traits[1], rtol=settings.asymmetry, atol=settings.asymmetry))


def _whole(way: list[Piece], settings: ContinuationSettings) -> Followed:
    """Join the pieces of a path. One that has come round is told from its first graze to the same again."""
    # From a graze that was not got past no step led on.
    way = way if len(way) == 1 or len(way[-1].values) else way[:-1]
    ends = "start", way[-1].end
    if closed := _came_round(way, settings):
        way, ends = way[1:], ("closed", "closed")
    points: list[Any] = []
    parts = []
    for number, piece in enumerate(way):
        parts.append(_trimmed(piece, number == 0, number == len(way) - 1))
        points += piece.points
        if piece.beyond is not None and (closed or number < len(way) - 1):
            points[-1] = points[-1]._replace(gained=piece.beyond.gained, wall=piece.beyond.wall)
    values, orbits = zip(*parts, strict=True)
    return Followed(np.concatenate(values), _in_one(list(orbits)), points, ends)


def _trimmed(piece: Piece, first: bool, last: bool) -> tuple[np.ndarray, Orbit]:
    """Leave out orbits next to a graze between pieces of which rounding hides an impact from the impact map."""
    orbit = _in_one(piece.orbits)
    good = np.flatnonzero(np.asarray(orbit.status) == Status.OK)
    begin = 0 if first else int(good.min(initial=len(orbit)))
    end = len(orbit) if last else int(good.max(initial=-1)) + 1
    rows = slice(begin, max(begin, end))
    return piece.values[rows], orbit[rows]


def joined(back: Followed, on: Followed) -> Followed:
    """Join two ways from one start to one path, from end to end; where it closes one way is all of it."""
    if back.ends[1] == "closed":
        return back
    values = np.concatenate([back.values[::-1], on.values[1:]])
    points = [point._replace(gained=-point.gained) for point in back.points[::-1]]
    return Followed(values, _in_one([back.orbit[::-1], on.orbit[1:]]), points + on.points, (back.ends[1], on.ends[1]))


def _in_one(orbits: list[Orbit]) -> Orbit:
    """Make one batch of orbits of several widths."""
    width = max(orbit.knots.shape[1] for orbit in orbits)
    return periodic.concatenate([periodic.widened(orbit, width) for orbit in orbits])
