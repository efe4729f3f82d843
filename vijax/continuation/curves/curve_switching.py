"""Switching between curves: the curves that begin at points of codimension 2 on other curves.

The possible new curves depend on the kind of the point: the curve of the bifurcation on a curve of grazing, the curve
of the graze on a curve of bifurcations, the folds of doubled orbits at a generalised flip, and so on.
"""

from typing import Any

import jax
import numpy as np

from vijax.continuation.branch_events import Point
from vijax.continuation.branch_switching import switch_direction
from vijax.continuation.curves.curve_equations import EventLocation
from vijax.continuation.curves.curve_events import CurvePoint
from vijax.continuation.curves.curve_preparation import SwitchStart
from vijax.continuation.curves.curve_starts import CurveStart, curve_start, single_orbit, with_grazing_impact
from vijax.orbits import clearances, periodic, symmetry
from vijax.orbits.periodic import Orbit
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted

_BIFURCATIONS = ("fold", "flip", "pitchfork")
_DEGENERATE = {"generalised flip": "flip", "degenerate pitchfork": "pitchfork"}
_flight_turning_points = jitted(clearances.flight_turning_points)


def switch_starts(kind: str, point: CurvePoint, asymmetry: float) -> list[SwitchStart]:
    """Return the starts of the curves that begin at a point of codimension 2; none at a cusp, which the curve passes.

    Args:
        kind: Kind of the curve through the point.
        point: The point.
        asymmetry: Largest distance of an orbit at a pitchfork from its mirror image.
    """
    point_kind, orbit, parameters = point.kind, point.orbit, point.values
    bifurcates = point_kind.removesuffix(" at a limit").removesuffix("-graze")
    if bifurcates in _BIFURCATIONS and kind not in _BIFURCATIONS:
        # If a test function of a graze vanishes, a mirror pair or doubled orbits merge into the simpler orbit.
        # Otherwise the simpler orbit itself is on the curve.
        if point.test:
            return [_simpler_start(bifurcates, orbit, parameters, asymmetry)]
        doubled_grazes = (
            [_doubled_start(start) for start in _grazing_starts(orbit, parameters)[:1]] if kind == "grazing" else []
        )
        return [_start(bifurcates, orbit, parameters), *(doubled_grazes if bifurcates != "fold" else [])]
    if point_kind == "resonant graze":
        return _impact_starts(orbit, parameters)
    # At a degenerate pitchfork (generalised flip) the curve of pitchforks (flips) meets the curve of folds of mirror
    # pairs (doubled orbits). The new curve is the other one of the two.
    if point_kind in _DEGENERATE:
        arguments = _DEGENERATE[point_kind], orbit, parameters, asymmetry
        return [_simpler_start(*arguments) if kind == "fold" else _doubled_start(CurveStart("fold", orbit, parameters))]
    if point_kind == "double graze" and point.test == "flight":
        return [SwitchStart(start) for start in _grazing_starts(orbit, parameters)]
    if point.test:
        start = curve_start(Point(f"grazing {point.test}", 0.0, orbit), parameters, asymmetry)
        return [] if isinstance(start, str) else [SwitchStart(start)]
    return []


def _start(kind: str, orbit: Orbit, parameters: tuple[float, float]) -> SwitchStart:
    return SwitchStart(CurveStart(kind, orbit, parameters))


def _grazing_starts(orbit: Orbit, parameters: tuple[float, float]) -> list[CurveStart]:
    """Return the starts of an orbit that grazes walls twice, one per graze."""
    turns = jax.tree.map(np.asarray, _flight_turning_points(*single_orbit(orbit)))
    return [
        CurveStart("grazing", orbit, parameters, int(index), float(turns.time[index]), float(turns.wall[index]))
        # The two flights with the least clearance are the two that graze.
        for index in turns.clearance.argsort()[:2]
    ]


def _impact_starts(orbit: Orbit, parameters: tuple[float, float]) -> list[SwitchStart]:
    """Return the starts of folds and flips of orbits with an impact at the graze of a rigid wall.

    At the point itself that impact has the speed 0.
    """
    (_, _, _, impact, delay, wall), *_ = _grazing_starts(orbit, parameters)
    location: Any = np.int32(impact), np.float64(wall)
    with_impact = with_grazing_impact(
        orbit.pair, orbit.impact_unknowns, orbit.sequence, EventLocation(*location), np.array([delay])
    )
    # Padded like all orbits on curves, so that few programs are compiled.
    with_impact = periodic.pad_orbits(with_impact, tiles.padded(with_impact.impact_unknowns.shape[1]))
    flip_kind = "pitchfork" if bool(orbit.sequence.mirrored[0]) else "flip"
    return [_start("fold", with_impact, parameters), _start(flip_kind, with_impact, parameters)]


def _doubled_start(start: CurveStart) -> SwitchStart:
    """Return the start of a curve of the same kind for the doubled orbits, or mirror pairs, that bifurcate there."""
    doubled, direction = switch_direction(start.orbit)
    return SwitchStart(start._replace(orbit=doubled), direction)


def _simpler_start(kind: str, orbit: Orbit, parameters: tuple[float, float], asymmetry: float) -> SwitchStart:
    """Return the start of the flips (pitchforks) of the orbit into which doubled orbits (a mirror pair) merge."""
    if kind == "pitchfork":
        return _start(kind, symmetry.close_half_way(orbit, asymmetry), parameters)
    # The mean of the two repetitions has a smaller error than either of them.
    return _start(kind, periodic.solve_mean_repetition(orbit, np.full(1, 2)), parameters)
