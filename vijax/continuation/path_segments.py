"""Paths from graze to graze: at soft walls a path continues with orbits that have an impact more or fewer.

A path segment is the part of a branch, or of a curve of bifurcations, between two grazes: its orbits all have the same
sequence of impacts. At the graze that ends a segment, `grazing_switch` computes the first point of the next segment, if
there is one. All paths are followed together, segment after segment.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.continuation.arclength_step import Path, PathPoints
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.grazing_switch import GrazingSwitch
from vijax.continuation.path_following import PathRecord, follow_paths
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.orbit_properties import orbit_signature
from vijax.orbits.periodic import Orbit

_SAME_VALUE = 1e-12  # relative and absolute difference below which two values of the parameters are equal


class PathSegment(NamedTuple):
    """A path segment from graze to graze.

    Attributes:
        values: Values of the parameters, one number or one row per orbit.
        orbits: The orbits in order, in batches that may have different numbers of impacts.
        points: Events on the segment (`Point` or `CurvePoint`); if the segment ends at a graze, this is the last event.
        end: Reason for which the segment ends.
        grazing_switch: The grazing switch at its end; None where the path does not continue.
    """

    values: np.ndarray
    orbits: list[Orbit]
    points: list[Any]
    end: str
    grazing_switch: GrazingSwitch | None


class PathResult(NamedTuple):
    """A whole path.

    Attributes:
        values: Values of the parameters, one number or one row per orbit.
        orbit: The orbits in one batch.
        points: Events on the path, in order.
        ends: Reasons for which the path ends at its first and at its last orbit.
    """

    values: np.ndarray
    orbit: Orbit
    points: list[Any]
    ends: tuple[str, str]


SegmentBuilder = Callable[[list[int], Any, list[PathRecord], list[bool]], list[PathSegment]]
"""Builds path segments from lane numbers, their paths, the records of their points, and whether each is the first.

The first segment of a path begins at its start; the first point of a later one is the graze between both.
"""


def follow_segments(
    paths: Path, first: PathPoints, build_segments: SegmentBuilder, points: int, settings: ContinuationSettings
) -> list[PathResult]:
    """Follow each path in one direction from its start, through grazes at soft walls.

    Args:
        paths, first: The paths, one lane per row, and their first points.
        build_segments: Function that builds the segments; see `SegmentBuilder`.
        points: Largest number of points of a path.
        settings: Settings of the steps, and the largest number of grazes.
    """
    # segments[lane] holds the finished segments of each path; `active` holds (lane, path, first point) of the segments
    # to be followed next.
    segments: list[list[PathSegment]] = [[] for _ in first.y]
    active = [(lane, *jax.tree.map(lambda leaf, i=lane: leaf[i], (paths, first))) for lane in range(len(segments))]
    while active:
        # Paths with the same number of unknowns are followed in one batch.
        for width in sorted({point.y.size for _, _, point in active}):
            lane_numbers, *rows = zip(*(item for item in active if item[2].y.size == width), strict=True)
            lanes = list(lane_numbers)
            batch_paths, batch_points = (jax.tree.map(lambda *leaves: np.stack(leaves), *row) for row in rows)
            # A path ends at its largest number of points over all its segments.
            remaining = np.array([points - _point_count(segments[lane]) for lane in lanes])
            records = follow_paths(batch_paths, batch_points, remaining, settings)
            for lane, segment in zip(
                lanes, build_segments(lanes, batch_paths, records, [not segments[i] for i in lanes]), strict=True
            ):
                segments[lane].append(segment if segments[lane] else _without_duplicate(segment))
        next_segments = [
            (lane, segments[lane][-1].grazing_switch)
            for lane, _, _ in active
            if _continues(segments[lane], points, settings)
        ]
        active = [(lane, switch.path, switch.first) for lane, switch in next_segments if switch is not None]
    return [_join_segments(path, settings) for path in segments]


def _without_duplicate(segment: PathSegment) -> PathSegment:
    """Drop the second orbit of a segment that ends at its own start, because the start is at a graze or a bound."""
    if len(segment.values) != 2:
        return segment
    begin, end = segment.values
    if not np.allclose(begin, end, rtol=_SAME_VALUE, atol=_SAME_VALUE):
        return segment
    return segment._replace(values=segment.values[:1], orbits=[_concatenate_orbits(segment.orbits)[:1]])


def _point_count(segments: list[PathSegment]) -> int:
    return sum(len(segment.values) for segment in segments)


def _continues(segments: list[PathSegment], points: int, settings: ContinuationSettings) -> bool:
    """Return True if a path is to be followed beyond the end of its last segment."""
    # A path has at most max_grazings + 1 segments. The limit `points` must allow the graze and one more point.
    within_limits = len(segments) <= settings.max_grazings and _point_count(segments) + 1 < points
    return within_limits and not _is_closed(segments, settings)


def _is_closed(segments: list[PathSegment], settings: ContinuationSettings) -> bool:
    """Return True if a path has reached its first graze again, in the same direction."""
    first, last = segments[0].grazing_switch, segments[-1].grazing_switch
    if (
        len(segments) == 1
        or first is None
        or last is None
        or (first.grazing_part, first.impact_change) != (last.grazing_part, last.impact_change)
    ):
        return False
    signatures = [
        np.append(orbit_signature(graze.orbit)[0], jax.tree.leaves(graze.orbit.pair)) for graze in (first, last)
    ]
    return bool(np.allclose(signatures[0], signatures[1], rtol=settings.asymmetry, atol=settings.asymmetry))


def _join_segments(segments: list[PathSegment], settings: ContinuationSettings) -> PathResult:
    """Join the segments of a path; a closed path is returned from its first graze to the same graze again."""
    # A last segment without orbits means that no step beyond the graze was accepted; it is dropped.
    segments = segments if len(segments) == 1 or len(segments[-1].values) else segments[:-1]
    ends = "start", segments[-1].end
    if closed := _is_closed(segments, settings):
        segments, ends = segments[1:], ("closed", "closed")
    points: list[Any] = []
    parts = []
    for number, segment in enumerate(segments):
        parts.append(_verified_part(segment, number == 0, number == len(segments) - 1))
        points += segment.points
        # The last event of a segment is its graze; it receives the change in the number of impacts.
        if segment.grazing_switch is not None and (closed or number < len(segments) - 1):
            points[-1] = points[-1]._replace(
                impact_change=segment.grazing_switch.impact_change, wall=segment.grazing_switch.wall
            )
    values, orbits = zip(*parts, strict=True)
    return PathResult(np.concatenate(values), _concatenate_orbits(list(orbits)), points, ends)


def _verified_part(segment: PathSegment, first: bool, last: bool) -> tuple[np.ndarray, Orbit]:
    """Drop unverified orbits at those ends of a segment where another segment follows.

    Verification may fail near such a graze, because rounding hides an impact of small speed from the impact map.
    """
    orbit = _concatenate_orbits(segment.orbits)
    verified = np.flatnonzero(np.asarray(orbit.status) == Status.OK)
    begin = 0 if first else int(verified.min(initial=len(orbit)))
    end = len(orbit) if last else int(verified.max(initial=-1)) + 1
    rows = slice(begin, max(begin, end))
    return segment.values[rows], orbit[rows]


def join_directions(backward: PathResult, forward: PathResult) -> PathResult:
    """Join the two directions from one start to one path; return only one if the path is closed."""
    if backward.ends[1] == "closed":
        return backward
    values = np.concatenate([backward.values[::-1], forward.values[1:]])
    # In the reverse direction, a graze that adds impacts removes them.
    points = [point._replace(impact_change=-point.impact_change) for point in backward.points[::-1]]
    return PathResult(
        values,
        _concatenate_orbits([backward.orbit[::-1], forward.orbit[1:]]),
        points + forward.points,
        (backward.ends[1], forward.ends[1]),
    )


def _concatenate_orbits(orbits: list[Orbit]) -> Orbit:
    """Concatenate orbits of several widths to one batch."""
    width = max(orbit.impact_unknowns.shape[1] for orbit in orbits)
    return periodic.concatenate([periodic.pad_orbits(orbit, width) for orbit in orbits])
