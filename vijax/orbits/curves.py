"""Curves of bifurcations in a plane of two parameters, by pseudo-arclength continuation, many at once.

They begin where branches met something (`curve_starts`); all lanes step together (`arclength_walk`); what they meet is
located afterwards (`curve_events`).
"""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.model.records import Status
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.arclength_step import BranchPlace, advance
from vijax.orbits.arclength_walk import Walked, WalkRules
from vijax.orbits.continuation import MOST_POINTS
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.orbits.curve_equations import (
    CONDITIONS,
    FIRST_CURVE_END,
    Condition,
    CurvePath,
    Touch,
    happenings_on_curves,
)
from vijax.orbits.curve_events import CurveEvent, CurvePoint, curve_events
from vijax.orbits.curve_graze import curve_passage
from vijax.orbits.curve_plane import Plane, check_plane, logarithmic, place_of, units
from vijax.orbits.curve_starts import CurveStart, check_points, curve_start, with_touch
from vijax.orbits.events import Point, orbits_at
from vijax.orbits.limits import LIMITS, alike, limit_start
from vijax.orbits.parameter import MOVED
from vijax.orbits.periodic import Orbit
from vijax.orbits.pieces import Piece, follow_pieces, joined
from vijax.runtime import checks, context, tiles
from vijax.runtime.context import door

_AT_ONCE = 4  # starts of one family that are followed at once, though they may turn out to lie on one curve
# Two starts on one curve differ from it by less than a step's bend; other curves of the same label are farther apart.
_ON_CURVE = 5e-4
# How far from a limit an orbit may be from which Newton is to find it: a cell of a map with few of them.
_BESIDE = 0.2


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
        max_points: Most points of a curve each way.
        settings: Of steps and events; arclengths are in units of the plane's sides and of knots.

    Returns:
        Every curve once, however many of the points lie on it; mirror images are one.

    Raises:
        ValueError: Not two parameters, two names of one, bounds in the wrong order, or a point outside.
    """
    listed = check_points(points)
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
            start = curve_start(point, place, settings.asymmetry)
        if isinstance(start, str):
            refused.append(start)
        else:
            starts.append(start)
    if refused:
        warnings.warn(f"{len(refused)} of {len(listed)} points begin no curve: {refused[0]}", stacklevel=2)
    return [one for some in curves_from(starts, plane, device, max_points, settings) for one in some]


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
    left = unmet(_lanes(starts, plane, device, settings), known or [], plane)
    while left:
        chosen: dict[tuple, list[_Lane]] = {}
        for lane in left:
            family = chosen.setdefault(_family(lane.start), [])
            if len(family) < _AT_ONCE:
                family.append(lane)
        batches: dict[tuple, list[_Lane]] = {}
        for lane in (lane for family in chosen.values() for lane in family):
            batches.setdefault((lane.path.condition, lane.first.y.size), []).append(lane)
        new: list[BifurcationCurve] = []
        # The widest first, for it may take as long as all others.
        listed = sorted(batches.values(), key=lambda batch: -batch[0].first.y.size)
        follow = partial(_followed, max_points=max_points, settings=settings)
        with context.pool(tiles.workers()) as pool:
            for batch, paths in zip(listed, pool.map(follow, listed), strict=True):
                some: list[BifurcationCurve] = []
                for lane, curve in zip(batch, paths, strict=True):
                    # Of several starts on one curve, or on one that is known, one is kept.
                    some += [curve] if unmet([lane], [*new, *some], plane) else []
                new += some
                yield some
        taken = {id(lane) for batch in batches.values() for lane in batch}
        left = unmet([lane for lane in left if id(lane) not in taken], new, plane)


Traits = np.ndarray
"""What tells an orbit from others, and its mirror image, a row each."""


class _Lane(NamedTuple):
    """A start on its curve, ready to be followed: what it is told apart by, the path, the first point."""

    start: CurveStart
    traits: Traits
    path: CurvePath
    first: BranchPlace


def _lanes(starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings) -> list[_Lane]:
    """Bring starts onto their curves; those are left out, with a warning, at which no real orbit is."""
    batches: dict[tuple, list[CurveStart]] = {}
    for start in starts:
        batches.setdefault((CONDITIONS.get(start.kind), start.orbit.knots.shape[1]), []).append(start)
    lanes, lost = [], []
    for batch in batches.values():
        paths, y = _set_out(batch, plane, device, settings)
        limit = paths.device is not None
        first = _beside(paths, y) if limit else _on(paths, y)
        near = np.abs(first.y - y).max(axis=1) < (_BESIDE if limit else settings.max_step)
        real = (first.tests[:, FIRST_CURVE_END:] > 0).all(axis=1) & near
        for index, good in enumerate(real & (first.size <= settings.newton_tolerance)):
            path, place = jax.tree.map(lambda leaf, i=index: leaf[i], (paths, first))
            if good:
                start = _moved(batch[index], path, place.y) if limit else batch[index]
                lanes.append(_Lane(start, traits(start.orbit, images=True), path, place))
            else:
                lost.append(batch[index])
    if lost:
        told = ", ".join(f"{start.kind} at ({start.place[0]:.6g}, {start.place[1]:.6g})" for start in lost[:3])
        warnings.warn(
            f"{len(lost)} of {len(starts)} points begin no curve, as no ball flies the orbits around: {told}",
            stacklevel=2,
        )
    return lanes


def _on(paths: CurvePath, y: np.ndarray) -> BranchPlace:
    """Correct points that lie on their curves already, to find the tangents there."""
    # Any direction that is not orthogonal to the curve does for the first correction, and none is likely to be.
    across = np.cos(np.arange(y.shape[1])) * (np.abs(y) > 0).any(axis=0)
    return advance(paths, y, np.broadcast_to(across / np.linalg.norm(across), y.shape), np.zeros(len(y)))


def _beside(paths: CurvePath, y: np.ndarray) -> BranchPlace:
    """Bring orbits that are near a limit onto its curve: by either parameter alone, whichever has less to move."""
    still = np.eye(y.shape[1])[[-2, -1]]
    tries = [advance(paths, y, np.broadcast_to(one, y.shape), np.zeros(len(y))) for one in still]
    far = [np.where(one.size <= paths.newton_tolerance, np.abs(one.y - y).max(axis=1), np.inf) for one in tries]
    first = far[0] <= far[1]

    def chosen(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.where(first.reshape(-1, *(1,) * (one.ndim - 1)), one, other)

    return jax.tree.map(chosen, *tries)


def _moved(start: CurveStart, path: CurvePath, y: np.ndarray) -> CurveStart:
    """Move a start that lay beside its curve onto it."""
    x, other = map(float, path.places(y))
    return start._replace(place=(x, other), orbit=orbits_at(path, y[None]))


def unmet(lanes: list[_Lane], curves: list[BifurcationCurve], plane: Plane) -> list[_Lane]:
    """Keep the starts that lie on none of the curves, nor do their mirror images."""
    paths = [(one.kind, np.column_stack([traits(one.orbit), units(one.values, plane)])) for one in curves]

    def lies(lane: _Lane) -> bool:
        place = units(np.array(lane.start.place), plane)
        return any(
            kind == lane.start.kind and _distance(path, np.append(one, place)) < _ON_CURVE
            for kind, path in paths
            for one in lane.traits
        )

    return [lane for lane in lanes if not lies(lane)]


def _family(start: CurveStart) -> tuple:
    """Tell starts apart of which no two lie on one curve: by kind, walls met and time."""
    sequence, sides = start.orbit.sequence, np.asarray(start.orbit.sequence.side)[0]
    walls = sorted(int((sides == side).sum()) for side in (-1, 1))
    return start.kind, float(sequence.span[0]), bool(sequence.mirrored[0]), *walls


def traits(orbit: Orbit, images: bool = False) -> Traits:
    """Give numbers that tell orbits apart, whichever impact they begin with; those of their mirror images, too."""
    host = jax.tree.map(np.asarray, orbit)
    side, knots = host.sequence.side, host.knots
    half = orbit_properties.marks_of_knots(side, knots)

    def later(wait: Any) -> np.ndarray:
        return knots + np.array([1.0, 0.0, 0.0]) * np.broadcast_to(wait, host.sequence.span.shape)[:, None, None]

    # An orbit closed half way goes on as its own mirror image.
    again = orbit_properties.marks_of_knots(-side, later(host.sequence.span))
    own = half + np.where(host.sequence.mirrored[:, None], again, 0.0)
    if not images or np.any(host.pair.gamma) or host.sequence.mirrored.any():
        return own
    return np.concatenate([own, orbit_properties.marks_of_knots(-side, later(1.0))])


def _distance(path: np.ndarray, point: np.ndarray) -> float:
    """Find how far a point is from a chain of points, in the largest of its coordinates."""
    if len(path) == 1:
        return float(np.abs(path[0] - point).max())
    begin, step = path[:-1], np.diff(path, axis=0)
    square = np.maximum((step * step).sum(axis=1), np.finfo(float).tiny)
    share = np.clip(((point - begin) * step).sum(axis=1) / square, 0.0, 1.0)
    return float(np.abs(begin + share[:, None] * step - point).max(axis=1).min())


def _set_out(starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings):
    """Make paths and unknowns of starts with as many impacts."""
    orbit = periodic.concatenate([start.orbit for start in starts])
    size, (one, other), logarithms = len(starts), plane, logarithmic(plane)
    place = np.array([start.place for start in starts], float)
    condition: Condition = CONDITIONS.get(starts[0].kind, "multiplier")
    rows = tiles.arrays(
        {
            "start": place,
            "steepest": np.full(size, float(device.g / device.A)),
            "low": np.tile(np.array([low for low, _ in plane.values()]), (size, 1)),
            "high": np.tile(np.array([high for _, high in plane.values()]), (size, 1)),
            "multiplier": np.array([1.0 if start.kind == "fold" else -1.0 for start in starts]),
        }
    )
    limit = condition in ("depth", "energy")
    impact, wall = np.array([start.impact for start in starts], np.int32), np.array([start.wall for start in starts])
    same = alike(starts, orbit, (one, other), device) if limit else None
    paths = CurvePath(
        pair=orbit.pair,
        sequence=orbit.sequence,
        touch=Touch(*tiles.arrays((impact, wall, same))),
        device=_broadcast(device, size) if limit else None,
        along=(one, other),
        logarithmic=(logarithms[0], logarithms[1]),
        condition=condition,
        newton_tolerance=settings.newton_tolerance,
        max_corrections=settings.max_corrections,
        **rows,
    )
    paths = jax.tree.map(np.asarray, paths)
    knots = np.where(paths.sequence.real[..., None], orbit.knots, 0.0).reshape(size, -1)
    waits = np.array([[start.wait] for start in starts])[:, : int(condition in ("touch", "split"))]
    return paths, np.concatenate([knots, waits, units(place, plane)], axis=1)


def _broadcast(device: Harvester, size: int) -> Harvester:
    """Give every lane the constants of the device, its penetration limit among them."""
    whole = dataclasses.replace(device, penetration_limit=device.depth_limit)
    return jax.tree.map(lambda x: np.full(size, float(x)), whole)


def _followed(batch: list[_Lane], max_points: int, settings: ContinuationSettings) -> list[BifurcationCurve]:
    """Follow some starts both ways, all at once."""
    twice = [*batch, *batch]
    paths = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.path for lane in twice))
    first = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.first for lane in twice))
    sign = np.repeat([-1.0, 1.0], len(batch))[:, None]
    first = first._replace(tangent=sign * first.tangent)

    def making(lanes: list[int], paths: CurvePath, walked: list[Walked], begun: list[bool]) -> list[Piece]:
        events = curve_events(paths, walked, [twice[lane].start.kind for lane in lanes], settings)
        each = [jax.tree.map(lambda leaf, i=row: leaf[i], paths) for row in range(len(lanes))]
        return [_piece(*one) for one in zip(each, walked, events, begun, strict=True)]

    rules = WalkRules(settings, happenings_on_curves, FIRST_CURVE_END)
    ways = follow_pieces(paths, first, making, max_points, rules)
    found: list[BifurcationCurve] = []
    for number, lane in enumerate(batch):
        both = joined(ways[number], ways[number + len(batch)])
        ends = ("closed", "closed") if both.ends[1] == "closed" else both.ends
        found.append(BifurcationCurve(lane.start.kind, lane.path.along, *both._replace(ends=ends)))
    return found


def _piece(path: CurvePath, walked: Walked, events: list[CurveEvent], begun: bool) -> Piece:
    """Put what happened between the points of a path among them, and end it where it ends; see `pieces.Making`."""
    rows, points, end, begin = [], [], walked.end, 0
    last, beyond = len(walked.y), None
    for event in events:
        rows += [walked.y[begin : event.place + 1], event.y[None]]
        begin = event.place + 1
        test, orbit = event.test, orbits_of(path, event.y[None])
        if event.ends:
            end, last = event.kind, begin
            beyond = curve_passage(path, event.y, test) if test else None
            test, orbit = (test, orbit) if beyond is None else (beyond.touches, beyond.orbit)
        if not event.kind.endswith((" low", " high")):
            values = path.places(event.y)
            points.append(CurvePoint(event.kind, test, (float(values[0]), float(values[1])), orbit))
    unreal = last == len(walked.y) and not (walked.tests[-1, FIRST_CURVE_END:] > 0).all()
    y = np.concatenate([*rows, walked.y[begin : last - unreal]])[not begun :]
    # At a graze the orbit with fewer impacts is there in either case.
    own = y if beyond is None else y[:-1]
    orbits = ([orbits_of(path, own)] if len(own) else []) + ([] if beyond is None else [beyond.orbit])
    return Piece(path.places(y), orbits, points, end, beyond)


def orbits_of(path: CurvePath, ys: np.ndarray) -> Orbit:
    """Make orbits of points of a curve, verified.

    Where a ball just touches a wall rounding decides whether the impact map meets it. Either will do: the orbit is
    real as it is, or with an impact of speed 0 there.
    """
    found = orbits_at(path, ys)
    if path.condition not in ("touch", "split") or (np.asarray(found.status) == Status.OK).all():
        return found
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(ys), *leaf.shape)), path)
    pair, knots = wide.pair_and_knots(ys)
    touching = with_touch(pair, knots, wide.sequence, path.touch, ys[:, -3], inside=path.condition == "split")
    real = np.asarray(touching.status) == Status.OK
    status = np.where(real, Status.OK, found.status).astype(np.int32)
    return eqx.tree_at(lambda orbit: orbit.status, found, tiles.arrays(status))
