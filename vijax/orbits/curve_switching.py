"""Switching between curves: which of them begin at the points of codimension 2 that others have met."""

from typing import Any

import jax
import numpy as np

from vijax.orbits import grazing, periodic, shooting, symmetry
from vijax.orbits.curve_equations import Touch
from vijax.orbits.curve_events import CurvePoint
from vijax.orbits.curve_lanes import Offshoot
from vijax.orbits.curve_starts import CurveStart, curve_start, with_touch
from vijax.orbits.events import Point
from vijax.orbits.periodic import Orbit
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_BIFURCATIONS = ("fold", "flip", "pitchfork")
_DEGENERATE = {"generalised flip": "flip", "degenerate pitchfork": "pitchfork"}
_flights, _linearised = jitted(grazing.flight_turns), jitted(shooting.linearise)


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
        touching = [_doubled(start, orbit) for start in _touching(orbit, place)[:1]] if kind == "grazing" else []
        return [_start(bifurcates, orbit, place), *(touching if bifurcates != "fold" else [])]
    if met == "resonant graze":
        return _hitting(orbit, place)
    if met in _DEGENERATE:
        simple = _DEGENERATE[met], orbit, place, asymmetry
        return [_simple(*simple) if kind == "fold" else _doubled(CurveStart("fold", orbit, place), orbit)]
    if met == "double graze" and point.test == "flight":
        return [Offshoot(start) for start in _touching(orbit, place)]
    if point.test:
        start = curve_start(Point(f"grazing {point.test}", 0.0, orbit), place, asymmetry)
        return [] if isinstance(start, str) else [Offshoot(start)]
    return []


def _start(kind: str, orbit: Orbit, place: tuple[float, float]) -> Offshoot:
    return Offshoot(CurveStart(kind, orbit, place))


def _alone(orbit: Orbit):
    """Give pair, sequence and knots of an orbit that is alone."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], (orbit.pair, orbit.sequence, orbit.knots))


def _touching(orbit: Orbit, place: tuple[float, float]) -> list[CurveStart]:
    """Make starts of an orbit that touches walls twice, one a touch."""
    turns = jax.tree.map(np.asarray, _flights(*_alone(orbit)))
    return [
        CurveStart("grazing", orbit, place, int(index), float(turns.when[index]), float(turns.wall[index]))
        for index in turns.room.argsort()[:2]
    ]


def _hitting(orbit: Orbit, place: tuple[float, float]) -> list[Offshoot]:
    """Begin folds and flips of the orbits that hit the wall where this one touches it: there their speed is 0."""
    (_, _, _, impact, wait, wall), *_ = _touching(orbit, place)
    pair, sequence, knots = orbit.pair, orbit.sequence, orbit.knots
    alone = jax.tree.map(lambda leaf: np.asarray(leaf)[:1], (pair, sequence))
    touch: Any = np.int32(impact), np.float64(wall)
    hit = with_touch(alone[0], knots, alone[1], Touch(*touch), np.array([wait]))
    hit = periodic.widened(hit, tiles.padded(hit.knots.shape[1]))
    flip = "pitchfork" if bool(orbit.sequence.mirrored[0]) else "flip"
    return [_start("fold", hit, place), _start(flip, hit, place)]


def _doubled(start: CurveStart, orbit: Orbit) -> Offshoot:
    """Begin the same of doubled orbits, or of mirror pairs, where an orbit bifurcates to them."""
    twice = symmetry.doubled(orbit)
    pair, sequence, knots = _alone(twice)
    padded: Any = np.where(sequence.real[:, None], knots, 0.0)
    slope = np.asarray(_linearised(pair, sequence, padded).slope)
    return Offshoot(start._replace(orbit=twice), np.linalg.svd(slope)[2][-1])


def _simple(kind: str, orbit: Orbit, place: tuple[float, float], asymmetry: float) -> Offshoot:
    """Begin the flips, or pitchforks, of the orbit that doubled ones, or mirror pairs, have come to."""
    if kind == "pitchfork":
        return _start(kind, symmetry.halved(orbit, asymmetry), place)
    count, host = int(orbit.count[0]) // 2, jax.tree.map(np.asarray, orbit)
    side, knots = host.sequence.side[:, :count], host.knots[:, :count]
    once = periodic.guessed(side, 0.5 * host.sequence.span, host.sequence.mirrored, knots)
    return _start(kind, periodic.solved(host.pair, *once), place)
