"""Curves of bifurcations in a plane of two parameters, by pseudo-arclength continuation, many at once.

They begin where branches met something (`curve_starts`), or other curves (`curve_switching`), on lanes (`curve_lanes`)
that step together (`arclength_walk`); what they meet is located afterwards (`curve_events`).
"""

import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.arclength_walk import Walked
from vijax.orbits.continuation import MOST_POINTS
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.orbits.curve_equations import CONDITIONS, FIRST_CURVE_END, CurvePath
from vijax.orbits.curve_events import CurveEvent, CurvePoint, curve_events
from vijax.orbits.curve_graze import curve_passage
from vijax.orbits.curve_lanes import Lane, lanes, lanes_aside, traits
from vijax.orbits.curve_plane import Plane, check_plane, place_of, units
from vijax.orbits.curve_starts import CurveStart, check_points, curve_start, with_touch
from vijax.orbits.curve_switching import offshoots
from vijax.orbits.events import Point
from vijax.orbits.limits import LIMITS, limit_start
from vijax.orbits.parameter import MOVED
from vijax.orbits.periodic import Orbit
from vijax.orbits.pieces import Piece, follow_pieces, joined
from vijax.orbits.switching import MOST_SWITCHES
from vijax.runtime import checks, context, tiles
from vijax.runtime.context import door

# Two starts on one curve differ from it by less than a step's bend; other curves of the same label are farther apart.
_ON_CURVE = 5e-4


class BifurcationCurve(NamedTuple):
    """A curve of one bifurcation in a plane, in the order in which it was followed.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing" (the ball touches a wall in flight), "grazing contact" (it touches
            one from inside, where a contact parts in two), "penetration limit" or "energy limit" (an impact is as deep,
            or harvests as much of what it gives to the membrane, as is admissible).
        along: Both parameters of the plane.
        values: Of both, a row an orbit.
        orbit: The orbits, with multipliers; those of a graze without the impact that begins there.
        points: What of codimension 2 was met on the way, in order.
        ends: Why it stops at its first and at its last orbit: the bound ("d low"), a kind of `CurvePoint` that it did
            not get past, "closed", "points" (as many as asked for), "lost" (no step was short enough).
    """

    kind: str
    along: tuple[str, str]
    values: np.ndarray
    orbit: Orbit
    points: list[CurvePoint]
    ends: tuple[str, str]

    @property
    def stable(self) -> np.ndarray:
        """Say whether stable orbits border on each point.

        Always at folds, flips and pitchforks: the other multiplier is smaller than 1, as the product of both is. A
        graze or a limit may be one of an unstable orbit.
        """
        largest = np.abs(np.asarray(self.orbit.multipliers)).max(axis=1)
        return largest < 1 if self.kind in CONDITIONS else np.full(len(largest), True)


@door
def follow_curves(
    points: list[Point],
    along: str,
    within: Mapping[str, tuple[float, float]],
    *,
    device: Harvester | None = None,
    max_switches: int = 0,
    max_points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[BifurcationCurve]:
    """Follow bifurcations, as branches met them, in a plane of two parameters.

    Args:
        points: What branches met. From folds, flips, pitchforks and grazings of flights, contacts and impacts curves
            are followed, and from where limits are met (`limit_points`); of others a warning says so.
        along: The parameter of these branches.
        within: The two parameters of the plane with their bounds, as in {"d": (0.05, 0.3), "kappa": (3, 400)}. Bounds
            more than a decade apart are gone through in logarithms.
        device: For quantities of the device: its other constants, as branches were told; for limits, whose they are.
        max_switches: How often a curve may lead to others, which begin at the points of codimension 2 that it meets; 0
            follows the given points alone.
        max_points: Most points of a curve each way.
        settings: Of steps and events; arclengths are in units of the plane's sides and of knots.

    Returns:
        Every curve once, however many of the points lie on it; mirror images are one.

    Raises:
        ValueError: Not two parameters, two names of one, bounds in the wrong order, or a point outside.
    """
    listed = check_points(points)
    max_switches = checks.whole("max_switches", max_switches, 0, MOST_SWITCHES)
    max_points, settings = checks.whole("max_points", max_points, 2, MOST_POINTS), check_settings(settings)
    device = one_device(device)
    plane = check_plane(listed[0].orbit.pair, within)
    checks.choice("along", along, MOVED)
    starts: list[CurveStart] = []
    refused: list[str] = []
    for point in listed:
        place = place_of(point, along, plane, device)
        if point.kind in LIMITS:
            start = limit_start(point, place, tuple(plane), device, settings.asymmetry)
        else:
            start = curve_start(point, place, settings.asymmetry, plane)
        if isinstance(start, str):
            refused.append(start)
        else:
            starts.append(start)
    if refused:
        warnings.warn(f"{len(refused)} of {len(listed)} points begin no curve: {refused[0]}", stacklevel=2)
    grown = youngest = [one for some in curves_from(starts, plane, device, max_points, settings) for one in some]
    for _ in range(max_switches):
        begun = switched(youngest, grown, plane, device, max_points, settings)
        youngest = [one for some in begun for one in some]
        grown = grown + youngest
    return grown


def curves_from(
    starts: list[CurveStart],
    plane: Plane,
    device: Harvester,
    max_points: int,
    settings: ContinuationSettings,
    known: list[BifurcationCurve] | None = None,
) -> Iterator[list[BifurcationCurve]]:
    """Follow every start that lies on no curve yet: one of each family at a time, all these together.

    They come batch by batch, so that whoever stops in between has those before.

    Args:
        starts: All of one kind of wall, in the plane.
        plane, device, max_points, settings: See `follow_curves`.
        known: Curves that are there already.
    """
    yield from _followed_lanes(lanes(starts, plane, device, settings), plane, max_points, settings, known or [])


def _followed_lanes(
    begun: list[Lane], plane: Plane, max_points: int, settings: ContinuationSettings, known: list[BifurcationCurve]
) -> Iterator[list[BifurcationCurve]]:
    traces = [_trace(curve, plane) for curve in known]
    left = _unmet(begun, traces, plane)
    while left:
        # Half of those of one family would turn out to lie on one curve, so that one of each is followed at a time.
        chosen = {_family(lane.start): lane for lane in reversed(left)}
        batches: dict[tuple, list[Lane]] = {}
        for lane in chosen.values():
            batches.setdefault((lane.path.condition, lane.first.y.size), []).append(lane)
        # The widest first, for it may take as long as all others.
        listed = sorted(batches.values(), key=lambda batch: -batch[0].first.y.size)
        before = len(traces)
        follow = partial(_followed, max_points=max_points, settings=settings)
        with context.pool(tiles.workers()) as pool:
            for batch, paths in zip(listed, pool.map(follow, listed), strict=True):
                some: list[BifurcationCurve] = []
                for lane, curve in zip(batch, paths, strict=True):
                    # A curve that goes on through grazes is in several families, and is kept once.
                    if _unmet([lane], traces[before:], plane):
                        some.append(curve)
                        traces.append(_trace(curve, plane))
                yield some
        taken = {id(lane) for lane in chosen.values()}
        left = _unmet([lane for lane in left if id(lane) not in taken], traces[before:], plane)


def switched(
    curves: list[BifurcationCurve],
    known: list[BifurcationCurve],
    plane: Plane,
    device: Harvester,
    max_points: int,
    settings: ContinuationSettings,
) -> Iterator[list[BifurcationCurve]]:
    """Follow the curves that begin where some curves met points of codimension 2, and that are not known.

    Args:
        curves: Whose points they are.
        known: Curves that are there already, those among them.
        plane, device, max_points, settings: See `follow_curves`.
    """
    begun = [
        one for curve in curves for point in curve.points for one in offshoots(curve.kind, point, settings.asymmetry)
    ]
    yield from _followed_lanes(lanes_aside(begun, plane, device, settings), plane, max_points, settings, known)


class _Trace(NamedTuple):
    """What tells the points of a curve from those of others, a row each: traits of the orbit, place in the plane."""

    kind: str
    rows: np.ndarray


def _trace(curve: BifurcationCurve, plane: Plane) -> _Trace:
    return _Trace(curve.kind, np.column_stack([traits(curve.orbit), units(curve.values, plane)]))


def _unmet(lanes: list[Lane], traces: list[_Trace], plane: Plane) -> list[Lane]:
    """Keep the starts that lie on none of the curves, nor do their mirror images."""

    def lies(lane: Lane) -> bool:
        place = units(np.array(lane.start.place), plane)
        return any(
            trace.kind == lane.start.kind and _distance(trace.rows, np.append(one, place)) < _ON_CURVE
            for trace in traces
            for one in lane.traits
        )

    return [lane for lane in lanes if not lies(lane)]


def _family(start: CurveStart) -> tuple:
    """Tell starts apart of which no two lie on one curve: by kind, walls met and time."""
    sequence, sides = start.orbit.sequence, np.asarray(start.orbit.sequence.side)[0]
    walls = sorted(int((sides == side).sum()) for side in (-1, 1))
    return start.kind, float(sequence.span[0]), bool(sequence.mirrored[0]), *walls


def _distance(path: np.ndarray, point: np.ndarray) -> float:
    """Find how far a point is from a chain of points, in the largest of its coordinates."""
    if len(path) == 1:
        return float(np.abs(path[0] - point).max())
    begin, step = path[:-1], np.diff(path, axis=0)
    square = np.maximum((step * step).sum(axis=1), np.finfo(float).tiny)
    share = np.clip(((point - begin) * step).sum(axis=1) / square, 0.0, 1.0)
    return float(np.abs(begin + share[:, None] * step - point).max(axis=1).min())


def _followed(batch: list[Lane], max_points: int, settings: ContinuationSettings) -> list[BifurcationCurve]:
    """Follow some starts both ways, all at once."""
    twice = [*batch, *batch]
    paths = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.path for lane in twice))
    first = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.first for lane in twice))
    sign = np.repeat([-1.0, 1.0], len(batch))[:, None]
    first = first._replace(tangent=sign * first.tangent)

    def making(lanes: list[int], paths: CurvePath, walked: list[Walked], begun: list[bool]) -> list[Piece]:
        events = curve_events(paths, walked, [twice[lane].start.kind for lane in lanes], settings)
        each = [jax.tree.map(lambda leaf, i=row: leaf[i], paths) for row in range(len(lanes))]
        ys = [_with_events(*one) for one in zip(walked, events, strict=True)]
        ends = [one.end for one in walked]
        return [_piece(*one) for one in zip(each, ys, _orbits_of(each, ys), events, begun, ends, strict=True)]

    ways = follow_pieces(paths, first, making, max_points, settings)
    found: list[BifurcationCurve] = []
    for number, lane in enumerate(batch):
        both = joined(ways[number], ways[number + len(batch)])
        ends = ("closed", "closed") if both.ends[1] == "closed" else both.ends
        found.append(BifurcationCurve(lane.start.kind, lane.path.along, *both._replace(ends=ends)))
    return found


def _with_events(walked: Walked, events: list[CurveEvent]) -> np.ndarray:
    """Put what happened between the points of a path among them, and leave out what is beyond its end."""
    rows, begin, last = [], 0, len(walked.y)
    for event in events:
        rows += [walked.y[begin : event.place + 1], event.y[None]]
        begin = event.place + 1
        last = begin if event.ends else last
    unreal = last == len(walked.y) and not (walked.tests[-1, FIRST_CURVE_END:] > 0).all()
    return np.concatenate([*rows, walked.y[begin : last - unreal]])


def _piece(path: CurvePath, y: np.ndarray, orbit: Orbit, events: list[CurveEvent], begun: bool, end: str) -> Piece:
    """Make a piece of the points of a path and what happened among them; see `pieces.Making`."""
    points, beyond = [], None
    for number, event in enumerate(events):
        place, test = event.place + 1 + number, event.test
        here = orbit[place : place + 1]
        if event.ends:
            end = event.kind
            beyond = curve_passage(path, event.y, test) if test else None
            test, here = (test, here) if beyond is None else (beyond.touches, beyond.orbit)
        if not event.kind.endswith((" low", " high")):
            values = path.places(event.y)
            points.append(CurvePoint(event.kind, test, (float(values[0]), float(values[1])), here))
    # At a graze the orbit with fewer impacts is there in either case.
    own = orbit[slice(not begun, len(y) - (beyond is not None))]
    orbits = ([own] if len(own) else []) + ([] if beyond is None else [beyond.orbit])
    return Piece(path.places(y[not begun :]), orbits, points, end, beyond)


def _orbits_of(paths: list[CurvePath], ys: list[np.ndarray]) -> list[Orbit]:
    """Make orbits of points of curves, verified: of all curves at once."""
    sizes = [len(y) for y in ys]
    wide = jax.tree.map(lambda *leaves: np.repeat(np.stack(leaves), sizes, axis=0), *paths)
    pair, knots = wide.pair_and_knots(np.concatenate(ys))
    found = periodic.proven(pair, wide.sequence, knots)
    ends = np.cumsum(sizes)
    each = [found[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    touch = paths[0].condition in ("touch", "split")
    return [_touching(*one) for one in zip(paths, ys, each, strict=True)] if touch else each


def _touching(path: CurvePath, ys: np.ndarray, orbit: Orbit) -> Orbit:
    """Verify orbits that touch a wall.

    Rounding decides whether the impact map meets it there. Either will do: the orbit is real as it is, or with an
    impact of speed 0.
    """
    known = np.asarray(orbit.status)
    doubtful = np.flatnonzero(known != Status.OK)
    if not doubtful.size:
        return orbit
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (doubtful.size, *leaf.shape)), path)
    pair, knots = wide.pair_and_knots(ys[doubtful])
    inside = path.condition == "split"
    hit = with_touch(pair, knots, wide.sequence, path.touch, ys[doubtful, -3], inside=inside)
    status = np.where(np.asarray(hit.status) == Status.OK, Status.OK, known[doubtful]).astype(np.int32)
    return eqx.tree_at(lambda one: one.status, orbit, tiles.arrays(tiles.replaced(doubtful, known, status)))
