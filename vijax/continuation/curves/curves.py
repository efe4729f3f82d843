"""Curves of bifurcations in a plane of two parameters, by pseudo-arclength continuation, many at once.

Curves start from events on branches (`curve_starts`) or on other curves (`curve_switching`). The starts are corrected
onto their curves (`curve_preparation`), which are then followed together (`path_following`). Points of codimension 2 on
them are located afterwards (`curve_events`).
Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10.
"""

import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from vijax.continuation.branch_continuation import MOST_POINTS
from vijax.continuation.branch_events import Point
from vijax.continuation.branch_switching import MOST_SWITCHES
from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS
from vijax.continuation.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.continuation.curves.curve_equations import CONDITIONS, FIRST_CURVE_END_TEST, CurvePath
from vijax.continuation.curves.curve_events import CurveEvent, CurvePoint, curve_events
from vijax.continuation.curves.curve_grazing_switch import curve_grazing_switch
from vijax.continuation.curves.curve_plane import Plane, check_plane, point_parameters, to_unit_square
from vijax.continuation.curves.curve_preparation import (
    PreparedStart,
    curve_signatures,
    prepare_starts,
    prepare_switch_starts,
)
from vijax.continuation.curves.curve_starts import CurveStart, check_points, curve_start, with_grazing_impact
from vijax.continuation.curves.curve_switching import switch_starts
from vijax.continuation.limits import LIMITS, limit_start
from vijax.continuation.path_following import PathRecord
from vijax.continuation.path_segments import PathSegment, follow_segments, join_directions
from vijax.model.device import Harvester, scalar_device
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.periodic import Orbit
from vijax.runtime import tiles, validation
from vijax.runtime.public_api import pool, public_api

# Distance below which a start lies on a curve. The chord of a step is nearer to the curve than this; other curves with
# the same label are farther away.
_ON_CURVE = 5e-4


class BifurcationCurve(NamedTuple):
    """A curve of one bifurcation in a plane, in the order of its computation.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing" (the ball touches a wall in flight), "grazing contact" (it touches
            one from inside, where a contact splits in two), "penetration limit" (an impact has the largest admissible
            depth) or "energy limit" (an impact harvests the largest admissible fraction of the energy that it gives to
            the membrane).
        along: Names of both parameters of the plane.
        values: Values of both parameters, one row per orbit.
        orbit: The orbits, with multipliers. On curves of grazing they do not include the impact that begins at the
            graze.
        points: Points of codimension 2 on the curve, in order.
        ends: Reasons for which the curve ends at its first and at its last orbit: a bound ("d low"), the kind of a
            `CurvePoint` where the curve does not continue, "closed", "points" (largest number of points), "lost" (no
            step was short enough).
    """

    kind: str
    along: tuple[str, str]
    values: np.ndarray
    orbit: Orbit
    points: list[CurvePoint]
    ends: tuple[str, str]

    @property
    def stable(self) -> np.ndarray:
        """Return for each point of the curve whether stable orbits exist next to it.

        Always True at folds, flips and pitchforks: one multiplier has modulus 1 and the product of both is below 1, so
        that the other one is inside the unit circle. At grazes and limits, True if the orbit itself is stable.
        """
        largest = np.abs(np.asarray(self.orbit.multipliers)).max(axis=1)
        # CONDITIONS holds the kinds without a critical multiplier: grazings and limits.
        return largest < 1 if self.kind in CONDITIONS else np.full(len(largest), True)


@public_api
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
    """Follow bifurcations of branches in a plane of two parameters.

    Args:
        points: Events on branches. Curves are followed from folds, flips, pitchforks and grazings of flights, contacts
            and impacts, and from limits (`limit_points`); other events are left out with a warning.
        along: The parameter of these branches.
        within: The two parameters of the plane with their bounds, as in {"d": (0.05, 0.3), "kappa": (3, 400)}. Along a
            parameter with bounds more than a decade apart, steps are in its logarithm.
        device: The device of the branches; needed for parameters that are quantities of the device, and for its limits.
        max_switches: Number of successive switches from a curve to others, which begin at its points of codimension 2;
            0 follows the given points alone.
        max_points: Largest number of points of a curve in each direction.
        settings: Settings of steps and events; arclengths are in units of the plane's sides and of impact unknowns.

    Returns:
        Every curve once, however many of the points lie on it; mirror images are one curve.

    Raises:
        ValueError: A number of parameters other than two, two names of one parameter, bounds in the wrong order, or a
            point outside of the bounds.
    """
    point_list = check_points(points)
    max_switches = validation.validate_integer("max_switches", max_switches, 0, MOST_SWITCHES)
    max_points, settings = (
        validation.validate_integer("max_points", max_points, 2, MOST_POINTS),
        check_settings(settings),
    )
    device = scalar_device(device)
    plane = check_plane(point_list[0].orbit.pair, within)
    validation.validate_choice("along", along, AFFECTED_CONSTANTS)
    starts: list[CurveStart] = []
    # Reasons for which points begin no curve; the warning quotes the first one.
    refused: list[str] = []
    for point in point_list:
        parameters = point_parameters(point, along, plane, device)
        if point.kind in LIMITS:
            start = limit_start(point, parameters, tuple(plane), device, settings.asymmetry)
        else:
            start = curve_start(point, parameters, settings.asymmetry, plane)
        if isinstance(start, str):
            refused.append(start)
        else:
            starts.append(start)
    if refused:
        warnings.warn(f"{len(refused)} of {len(point_list)} points begin no curve: {refused[0]}", stacklevel=2)
    all_curves = newest = [
        curve for batch in curves_from(starts, plane, device, max_points, settings) for curve in batch
    ]
    for _ in range(max_switches):
        batches = follow_switches(newest, all_curves, plane, device, max_points, settings)
        newest = [curve for batch in batches for curve in batch]
        all_curves = all_curves + newest
    return all_curves


def curves_from(
    starts: list[CurveStart],
    plane: Plane,
    device: Harvester,
    max_points: int,
    settings: ContinuationSettings,
    existing: list[BifurcationCurve] | None = None,
) -> Iterator[list[BifurcationCurve]]:
    """Follow every start that lies on no curve yet, one start of each family (kind, period, impacts) at a time.

    The curves of a batch are yielded when they are complete, so that a caller that stops has the earlier batches.

    Args:
        starts: Starts with one kind of wall, in the plane.
        plane, device, max_points, settings: See `follow_curves`.
        existing: Curves that exist already.
    """
    yield from _follow_prepared(
        prepare_starts(starts, plane, device, settings), plane, max_points, settings, existing or []
    )


def _follow_prepared(
    prepared: list[PreparedStart],
    plane: Plane,
    max_points: int,
    settings: ContinuationSettings,
    existing: list[BifurcationCurve],
) -> Iterator[list[BifurcationCurve]]:
    traces = [_trace(curve, plane) for curve in existing]
    remaining = _not_on_curves(prepared, traces, plane)
    while remaining:
        # About half of the starts of one family lie on one curve, so that one start per family is followed at a time.
        chosen = {_family_key(start.start): start for start in reversed(remaining)}
        batches: dict[tuple, list[PreparedStart]] = {}
        for start in chosen.values():
            # One batch per condition and number of unknowns: its paths have arrays of equal shape.
            batches.setdefault((start.path.condition, start.first.y.size), []).append(start)
        # The widest batch first: it may take as long as all others.
        batch_list = sorted(batches.values(), key=lambda batch: -batch[0].first.y.size)
        before = len(traces)
        follow = partial(_follow_batch, max_points=max_points, settings=settings)
        with pool(tiles.workers()) as threads:
            for batch, batch_curves in zip(batch_list, threads.map(follow, batch_list), strict=True):
                new_curves: list[BifurcationCurve] = []
                for start, curve in zip(batch, batch_curves, strict=True):
                    # A curve that continues through grazes belongs to several families, and is retained once.
                    if _not_on_curves([start], traces[before:], plane):
                        new_curves.append(curve)
                        traces.append(_trace(curve, plane))
                yield new_curves
        followed_ids = {id(start) for start in chosen.values()}
        remaining = _not_on_curves(
            [start for start in remaining if id(start) not in followed_ids], traces[before:], plane
        )


def follow_switches(
    curves: list[BifurcationCurve],
    existing: list[BifurcationCurve],
    plane: Plane,
    device: Harvester,
    max_points: int,
    settings: ContinuationSettings,
) -> Iterator[list[BifurcationCurve]]:
    """Follow the curves that begin at points of codimension 2 of other curves, and that do not exist yet.

    Args:
        curves: Curves with these points.
        existing: Curves that exist already, `curves` included.
        plane, device, max_points, settings: See `follow_curves`.
    """
    starts = [
        start
        for curve in curves
        for point in curve.points
        for start in switch_starts(curve.kind, point, settings.asymmetry)
    ]
    yield from _follow_prepared(
        prepare_switch_starts(starts, plane, device, settings), plane, max_points, settings, existing
    )


class _Trace(NamedTuple):
    """The points of a curve for comparison with others, one row each: signature of the orbit, place in the plane."""

    kind: str
    rows: np.ndarray


def _trace(curve: BifurcationCurve, plane: Plane) -> _Trace:
    return _Trace(curve.kind, np.column_stack([curve_signatures(curve.orbit), to_unit_square(curve.values, plane)]))


def _not_on_curves(prepared: list[PreparedStart], traces: list[_Trace], plane: Plane) -> list[PreparedStart]:
    """Return the starts that lie on none of the curves, neither by their orbits nor by the mirror images."""

    def lies_on_curve(start: PreparedStart) -> bool:
        unit_parameters = to_unit_square(np.array(start.start.parameters), plane)
        return any(
            trace.kind == start.start.kind and _distance(trace.rows, np.append(signature, unit_parameters)) < _ON_CURVE
            for trace in traces
            for signature in start.signatures
        )

    return [start for start in prepared if not lies_on_curve(start)]


def _family_key(start: CurveStart) -> tuple:
    """Return the family of a start, which is the same along a curve between grazes: kind, span, numbers of impacts."""
    sequence, sides = start.orbit.sequence, np.asarray(start.orbit.sequence.side)[0]
    # Sorted, because mirror images are one curve.
    walls = sorted(int((sides == side).sum()) for side in (-1, 1))
    return start.kind, float(sequence.span[0]), bool(sequence.mirrored[0]), *walls


def _distance(chain: np.ndarray, point: np.ndarray) -> float:
    """Return the distance of a point from a polygonal chain: the largest coordinate of the difference."""
    if len(chain) == 1:
        return float(np.abs(chain[0] - point).max())
    begin, step = chain[:-1], np.diff(chain, axis=0)
    # Avoids a division by zero where two points of the chain coincide.
    square = np.maximum((step * step).sum(axis=1), np.finfo(float).tiny)
    share = np.clip(((point - begin) * step).sum(axis=1) / square, 0.0, 1.0)
    return float(np.abs(begin + share[:, None] * step - point).max(axis=1).min())


def _follow_batch(
    batch: list[PreparedStart], max_points: int, settings: ContinuationSettings
) -> list[BifurcationCurve]:
    """Follow starts with equal numbers of unknowns in both directions, all at once."""
    both_directions = [*batch, *batch]
    paths = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.path for lane in both_directions))
    first = jax.tree.map(lambda *leaves: np.stack(leaves), *(lane.first for lane in both_directions))
    # Every start is followed backwards (first half of the rows) and forwards.
    sign = np.repeat([-1.0, 1.0], len(batch))[:, None]
    first = first._replace(tangent=sign * first.tangent)

    def build_segments(
        lane_numbers: list[int], paths: CurvePath, records: list[PathRecord], is_first: list[bool]
    ) -> list[PathSegment]:
        events = curve_events(paths, records, [both_directions[lane].start.kind for lane in lane_numbers], settings)
        lane_paths = [jax.tree.map(lambda leaf, i=row: leaf[i], paths) for row in range(len(lane_numbers))]
        ys = [_with_events(*item) for item in zip(records, events, strict=True)]
        ends = [item.end for item in records]
        return [
            _segment(*item)
            for item in zip(lane_paths, ys, _verified_orbits(lane_paths, ys), events, is_first, ends, strict=True)
        ]

    results = follow_segments(paths, first, build_segments, max_points, settings)
    new_curves: list[BifurcationCurve] = []
    for number, lane in enumerate(batch):
        # Backward and forward parts become one curve.
        both = join_directions(results[number], results[number + len(batch)])
        ends = ("closed", "closed") if both.ends[1] == "closed" else both.ends
        new_curves.append(BifurcationCurve(lane.start.kind, lane.path.along, *both._replace(ends=ends)))
    return new_curves


def _with_events(record: PathRecord, events: list[CurveEvent]) -> np.ndarray:
    """Return the points of a path with the events inserted, up to the end of the real orbits."""
    rows, begin, last = [], 0, len(record.y)
    for event in events:
        rows += [record.y[begin : event.point_index + 1], event.y[None]]
        begin = event.point_index + 1
        last = begin if event.ends else last
    # If no event ends the path, its last point may still lie beyond the end of the real orbits. Drop it then.
    drop_last = last == len(record.y) and not (record.tests[-1, FIRST_CURVE_END_TEST:] > 0).all()
    return np.concatenate([*rows, record.y[begin : last - drop_last]])


def _segment(
    path: CurvePath, y: np.ndarray, orbit: Orbit, events: list[CurveEvent], is_first: bool, end: str
) -> PathSegment:
    """Build a path segment from the points of a path and the events among them; see `SegmentBuilder`."""
    points, switch = [], None
    for number, event in enumerate(events):
        # The events before this one have been inserted among the points, so that its row is shifted by their number.
        row, test = event.point_index + 1 + number, event.test
        event_orbit = orbit[row : row + 1]
        if event.ends:
            end = event.kind
            switch = curve_grazing_switch(path, event.y, test) if test else None
            test, event_orbit = (test, event_orbit) if switch is None else (switch.grazing_part, switch.orbit)
        if not event.kind.endswith((" low", " high")):
            values = path.parameters(event.y)
            points.append(CurvePoint(event.kind, test, (float(values[0]), float(values[1])), event_orbit))
    # At a graze through which the curve continues, the orbit with fewer impacts replaces the last orbit.
    segment_orbits = orbit[slice(not is_first, len(y) - (switch is not None))]
    orbits = ([segment_orbits] if len(segment_orbits) else []) + ([] if switch is None else [switch.orbit])
    return PathSegment(path.parameters(y[not is_first :]), orbits, points, end, switch)


def _verified_orbits(paths: list[CurvePath], ys: list[np.ndarray]) -> list[Orbit]:
    """Return the verified orbits at points of curves, of all curves at once."""
    sizes = [len(y) for y in ys]
    wide = jax.tree.map(lambda *leaves: np.repeat(np.stack(leaves), sizes, axis=0), *paths)
    pair, impact_unknowns = wide.pair_and_unknowns(np.concatenate(ys))
    orbits = periodic.verify_solutions(pair, wide.sequence, impact_unknowns)
    ends = np.cumsum(sizes)
    orbits_by_curve = [orbits[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    # All paths of a batch have one condition.
    is_grazing = paths[0].condition in ("flight_graze", "contact_graze")
    return (
        [_verify_grazing(*item) for item in zip(paths, ys, orbits_by_curve, strict=True)]
        if is_grazing
        else orbits_by_curve
    )


def _verify_grazing(path: CurvePath, ys: np.ndarray, orbit: Orbit) -> Orbit:
    """Verify orbits that graze a wall.

    Rounding decides whether the impact map has an impact at the graze. The orbit is real if it is verified as it is, or
    with an impact of speed 0.
    """
    # Only orbits that are not verified without the impact are verified again, with the impact.
    previous_status = np.asarray(orbit.status)
    unverified = np.flatnonzero(previous_status != Status.OK)
    if not unverified.size:
        return orbit
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (unverified.size, *leaf.shape)), path)
    pair, impact_unknowns = wide.pair_and_unknowns(ys[unverified])
    in_contact = path.condition == "contact_graze"
    with_impact = with_grazing_impact(
        pair, impact_unknowns, wide.sequence, path.location, ys[unverified, -3], in_contact=in_contact
    )
    status = np.where(np.asarray(with_impact.status) == Status.OK, Status.OK, previous_status[unverified]).astype(
        np.int32
    )
    return eqx.tree_at(
        lambda item: item.status, orbit, tiles.arrays(tiles.with_replaced_rows(unverified, previous_status, status))
    )
