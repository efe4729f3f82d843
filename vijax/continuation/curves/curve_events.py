"""Points of codimension 2 on curves of bifurcations: their exact place, their kind, and whether the curve ends there.

The product of the two multipliers of an orbit is exp(-mu * contact duration) at soft walls or r^(2 impacts) at rigid
ones, between 0 and 1. So only one multiplier at a time can be 1 or -1, and a pair is never on the unit circle. There is
no Neimark-Sacker bifurcation, no fold-flip point and no resonance 1:1 or 1:2 to be located.
Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapters 8 to 10.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from vijax.continuation.arclength_step import PathPoints, predict_and_correct
from vijax.continuation.branch_events import impact_change_text, locate, orbits_at
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.criticality import cubic_coefficient
from vijax.continuation.curves.curve_equations import CUBIC, CUSP, CurvePath, CurveTests, curve_sign_changed
from vijax.continuation.curves.curve_merging_points import locate_on_simpler_curve
from vijax.continuation.path_following import PathRecord
from vijax.model.pair import ImpactPair
from vijax.orbits import orbit_properties, symmetry
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted

# A curve stands still in the plane if the two plane components of its unit tangent have a norm below this value. Near a
# cusp this norm is the distance from the cusp along the curve; at an ordinary bend it does not become small.
_CUSP_TANGENT = 1e-4
# Cubic coefficients are computed in batches of one size: a program of third derivatives takes seconds to compile, for
# few orbits as for many.
_CUBIC_BATCHES = (64,)
_MERGING_KINDS = {"flip-graze": "flip", "pitchfork-graze": "pitchfork"}
_GRAZING_TESTS = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


class CurvePoint(NamedTuple):
    """A point of codimension 2 on a curve.

    Attributes:
        kind: "cusp", "generalised flip", "degenerate pitchfork", "fold-graze", "flip-graze", "pitchfork-graze", "double
            graze", "degenerate graze" (no acceleration at the graze), "resonant graze" (at a rigid wall: the orbits
            with an impact there depart without a square root of the change in the parameters, and their folds and flips
            begin); on curves of limits "fold at a limit", "flip at a limit", "pitchfork at a limit", "graze at a
            limit", "double limit" (another impact is at its limit, too).
        test: At a graze where the real orbits end, its test function: flight, impact, contact or exit; otherwise "". At
            soft walls it is the one of the orbit with fewer impacts, as in `Point.kind`.
        values: Values of both parameters.
        orbit: The orbit at the point, along a leading axis of one.
        impact_change: Number of impacts after a graze minus the number before it, in the order of the curve; 0 at other
            points, and where the curve does not continue.
        wall: Wall of these impacts: -1 (left), +1 (right) or 0 (both).
    """

    kind: str
    test: str
    values: tuple[float, float]
    orbit: Orbit
    impact_change: int = 0
    wall: int = 0

    @property
    def impact_change_text(self) -> str:
        """Return how the curve continues through a graze, in words; empty at other points."""
        return impact_change_text(self.impact_change, self.wall)


class CurveEvent(NamedTuple):
    """A change of sign between two points of a curve.

    Attributes:
        point_index: Index of the point before the event.
        s: Arclength from that point.
        kind: Kind of the event.
        test: Test function of a graze, or "".
        y: Unknowns at the event.
        ends: Whether the curve ends there.
    """

    point_index: int
    s: float
    kind: str
    test: str
    y: np.ndarray
    ends: bool


def curve_events(
    paths: CurvePath, records: list[PathRecord], kinds: list[str], settings: ContinuationSettings
) -> list[list[CurveEvent]]:
    """Locate the events on curves, in order, up to the first event that ends each curve; all curves at once."""
    tests = _tests_with_cubics(paths, records)
    steps = [curve_sign_changed(item[:-1], item[1:]) for item in tests]
    lane = np.repeat(np.arange(len(records)), [len(item) for item in steps])
    place = np.concatenate([np.arange(len(item)) for item in steps])
    step, test = np.nonzero(np.concatenate(steps))
    lane, place = lane[step], place[step]
    events_by_lane: list[list[CurveEvent]] = [[] for _ in records]
    if not step.size:
        return events_by_lane
    y, tangent, length, start_values = (
        np.array([rows[i][k + shift] for i, k in zip(lane, place, strict=True)])
        for rows, shift in (
            ([item.y for item in records], 0),
            ([item.tangent for item in records], 0),
            ([item.lengths for item in records], 1),
            (tests, 0),
        )
    )
    # At the start of a step both tangents of the cusp test function are equal: its value is their norm in the plane.
    start_values = np.where(
        test == CUSP, np.linalg.norm(tangent[:, -2:], axis=1), start_values[np.arange(test.size), test]
    )
    event_paths = jax.tree.map(lambda leaf: np.asarray(leaf)[lane], paths)

    def read_values(rows: np.ndarray, points: PathPoints) -> np.ndarray:
        values = points.tests[np.arange(rows.size), test[rows]].copy()
        if (cubic_rows := np.flatnonzero(test[rows] == CUBIC)).size:
            values[cubic_rows] = _cubic_coefficients(
                jax.tree.map(lambda leaf: leaf[rows[cubic_rows]], event_paths), points.y[cubic_rows]
            )
        return values

    s, located, is_zero = locate(event_paths, y, tangent, length, test, start_values, settings, read_values)
    at_rest = np.linalg.norm(predict_and_correct(event_paths, y, tangent, s).tangent[:, -2:], axis=1) < _CUSP_TANGENT
    # In the order of lanes, points and arclengths; events after the end of a curve are skipped.
    for number in np.lexsort((s, place, lane)):
        column, lane_events = int(test[number]), events_by_lane[lane[number]]
        if not is_zero[number] or (column == CUSP and not at_rest[number]) or (lane_events and lane_events[-1].ends):
            continue
        path = jax.tree.map(lambda leaf, i=number: leaf[i], event_paths)
        kind, ends = _classify(path, column, located[number], kinds[lane[number]], settings)
        graze_test, point_y = _GRAZING_TESTS.get(CurveTests._fields[column], ""), located[number]
        # The equations are singular where mirror pairs or doubled orbits merge with the simpler orbit: use its curve.
        if path.condition in ("flight_graze", "contact_graze") and kind in _MERGING_KINDS and graze_test:
            point_y = locate_on_simpler_curve(path, point_y, _MERGING_KINDS[kind], settings)
        lane_events.append(CurveEvent(int(place[number]), float(s[number]), kind, graze_test, point_y, ends))
    return events_by_lane


@jitted
def _batch_coefficients(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[Array, "orbit impact 3"]
) -> Float[Array, " orbit"]:
    return jax.vmap(cubic_coefficient)(pair, sequence, impact_unknowns)


def _cubic_coefficients(paths: CurvePath, ys: np.ndarray) -> np.ndarray:
    """Compute the cubic coefficients of points of flips, with one path per point."""
    pair, impact_unknowns = paths.pair_and_unknowns(ys)
    return tiles.map_tiles(
        lambda rows: _batch_coefficients(*rows), (pair, paths.sequence, impact_unknowns), _CUBIC_BATCHES
    )


def _tests_with_cubics(paths: CurvePath, records: list[PathRecord]) -> list[np.ndarray]:
    """Return the test functions of all points, with the cubic coefficients on curves of flips.

    No step depends on these coefficients, so that they are computed only here.
    """
    tests = [record.tests for record in records]
    # Only curves with a multiplier of -1 (flips and pitchforks) have the coefficient.
    flips = np.flatnonzero(paths.multiplier < 0) if paths.condition == "multiplier" else np.zeros(0, int)
    if flips.size:
        sizes = [len(tests[lane]) for lane in flips]
        rows = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[flips], sizes, axis=0), paths)
        values = np.split(
            _cubic_coefficients(rows, np.concatenate([records[lane].y for lane in flips])), np.cumsum(sizes)[:-1]
        )
        for lane, cubics in zip(flips, values, strict=True):
            tests[lane] = tests[lane].copy()
            tests[lane][:, CUBIC] = cubics
    return tests


def _classify(path: CurvePath, test: int, y: np.ndarray, kind: str, settings: ContinuationSettings) -> tuple[str, bool]:
    """Return the kind of a change of sign in column `test`, on a curve of `kind`, and whether the curve ends there."""
    name = CurveTests._fields[test]
    if test == CUSP:
        return _turning_kind(orbits_at(path, y[None]), settings)
    if test == CUBIC:
        return ("degenerate pitchfork" if kind == "pitchfork" else "generalised flip"), False
    # A curve of a limit crosses bifurcations and continues; it ends where an orbit grazes.
    limit = path.device is not None
    if name in ("plus", "minus"):
        flip_kind = "pitchfork" if bool(path.sequence.mirrored) else "flip"
        return f"{'fold' if name == 'plus' else flip_kind}{' at a limit' if limit else '-graze'}", False
    if name == "resonance":
        return "resonant graze", False
    if name == "degeneracy":
        return ("double limit" if limit else "degenerate graze"), True
    if name in _GRAZING_TESTS and limit:
        return "graze at a limit", True
    if name in _GRAZING_TESTS and kind.startswith("grazing"):
        # Where a simpler orbit grazes once, its mirror pair or the doubled orbit grazes twice.
        merging = _merging_bifurcation(orbits_at(path, y[None]), settings)
        return (f"{merging}-graze" if merging else "double graze"), True
    if name in _GRAZING_TESTS:
        return f"{kind}-graze", True
    bound, _, axis = name.partition("_")
    return f"{path.along[axis == 'second']} {bound}", True


def _turning_kind(orbit: Orbit, settings: ContinuationSettings) -> tuple[str, bool]:
    """Return the kind of a turning point of a curve in the plane, and whether the curve ends there.

    It is a cusp of folds, or the point where folds of a mirror pair (or of doubled orbits) merge into the simpler
    orbit. Beyond a merging point the curve would return over the same parameters, with the mirror image or with the
    same orbit shifted by a period, so that it ends there.
    """
    merging = _merging_bifurcation(orbit, settings)
    return {"pitchfork": "degenerate pitchfork", "flip": "generalised flip"}.get(merging, "cusp"), bool(merging)


def _merging_bifurcation(orbit: Orbit, settings: ContinuationSettings) -> str:
    """Return the bifurcation where an orbit has merged into a simpler orbit: "pitchfork", "flip" or "".

    A mirror pair merges into a symmetric orbit at a pitchfork, doubled orbits into an orbit of half the period at a
    flip.
    """
    if not bool(orbit.sequence.mirrored[0]) and bool(symmetry.is_symmetric(orbit, settings.asymmetry)[0]):
        return "pitchfork"
    period = int(orbit_properties.counts(orbit, settings.asymmetry).period[0])
    return "flip" if period < 0.5 * float(orbit.sequence.span[0]) else ""
