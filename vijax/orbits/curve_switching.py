"""Switching between curves: which of them begin at the points of codimension 2 that others have met."""

from typing import Any

import jax
import numpy as np

from vijax.orbits import grazing, periodic, symmetry
from vijax.orbits.curve_equations import Touch
from vijax.orbits.curve_events import CurvePoint
from vijax.orbits.curve_lanes import Offshoot
from vijax.orbits.curve_starts import CurveStart, alone, curve_start, with_touch
from vijax.orbits.events import Point
from vijax.orbits.periodic import Orbit
from vijax.orbits.switching import leaving
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_BIFURCATIONS = ("fold", "flip", "pitchfork")
_DEGENERATE = {"generalised flip": "flip", "degenerate pitchfork": "pitchfork"}
_flights = jitted(grazing.flight_turns)


def offshoots(kind: str, point: CurvePoint, asymmetry: float) -> list[Offshoot]:
    """List the curves that begin at what a curve of a kind met; none at a cusp, which a curve passes.

    Args:
        kind: Of the curve.
        point: What it met.
        asymmetry: How far from its mirror image an orbit at a pitchfork may be.
    """
    met, orbit, place = point.kind, point.orbit, point.values
    bifurcates = met.removesuffix(" at a limit").removesuffix("-graze")
    if bifurcates in _BIFURCATIONS and kind not in _BIFURCATIONS:
        # On the curve of a graze the simple orbit touches, but where a pair or doubled orbits come back to it.
        if point.test:
            return [_simple(bifurcates, orbit, place, asymmetry)]
        touching = [_doubled(start) for start in _touching(orbit, place)[:1]] if kind == "grazing" else []
        return [_start(bifurcates, orbit, place), *(touching if bifurcates != "fold" else [])]
    if met == "resonant graze":
        return _hitting(orbit, place)
    if met in _DEGENERATE:
        simple = _DEGENERATE[met], orbit, place, asymmetry
        return [_simple(*simple) if kind == "fold" else _doubled(CurveStart("fold", orbit, place))]
    if met == "double graze" and point.test == "flight":
        return [Offshoot(start) for start in _touching(orbit, place)]
    if point.test:
        start = curve_start(Point(f"grazing {point.test}", 0.0, orbit), place, asymmetry)
        return [] if isinstance(start, str) else [Offshoot(start)]
    return []


def _start(kind: str, orbit: Orbit, place: tuple[float, float]) -> Offshoot:
    return Offshoot(CurveStart(kind, orbit, place))


def _touching(orbit: Orbit, place: tuple[float, float]) -> list[CurveStart]:
    """Make starts of an orbit that touches walls twice, one a touch."""
    turns = jax.tree.map(np.asarray, _flights(*alone(orbit)))
    return [
        CurveStart("grazing", orbit, place, int(index), float(turns.when[index]), float(turns.wall[index]))
        for index in turns.room.argsort()[:2]
    ]


def _hitting(orbit: Orbit, place: tuple[float, float]) -> list[Offshoot]:
    """Begin folds and flips of the orbits that hit the wall where this one touches it: there their speed is 0."""
    (_, _, _, impact, wait, wall), *_ = _touching(orbit, place)
    touch: Any = np.int32(impact), np.float64(wall)
    hit = with_touch(orbit.pair, orbit.knots, orbit.sequence, Touch(*touch), np.array([wait]))
    hit = periodic.widened(hit, tiles.padded(hit.knots.shape[1]))
    flip = "pitchfork" if bool(orbit.sequence.mirrored[0]) else "flip"
    return [_start("fold", hit, place), _start(flip, hit, place)]


def _doubled(start: CurveStart) -> Offshoot:
    """Begin the same of doubled orbits, or of mirror pairs, where an orbit bifurcates to them."""
    twice, ahead = leaving(start.orbit)
    return Offshoot(start._replace(orbit=twice), ahead)


def _simple(kind: str, orbit: Orbit, place: tuple[float, float], asymmetry: float) -> Offshoot:
    """Begin the flips, or pitchforks, of the orbit that doubled ones, or mirror pairs, have come to."""
    if kind == "pitchfork":
        return _start(kind, symmetry.halved(orbit, asymmetry), place)
    return _start(kind, periodic.mean_turn(orbit, np.full(1, 2)), place)
