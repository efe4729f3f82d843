"""Where curves begin: at what branches met, brought into the one form in which each kind of bifurcation is followed."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import flights, grazing, symmetry
from vijax.orbits.curve_equations import Touch
from vijax.orbits.events import Point
from vijax.orbits.parameter import skews
from vijax.orbits.periodic import Orbit, check_orbit, guessed, proven
from vijax.orbits.shooting import Sequence
from vijax.runtime import checks
from vijax.runtime.programs import jitted


class CurveStart(NamedTuple):
    """A bifurcation from which a curve is to be followed.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing" (of a flight) or "grazing contact".
        orbit: The orbit there, alone: closed half way at a pitchfork; at a graze without the impact that fades.
        place: Both parameters of the plane.
        impact, wait, wall: At a graze, how long after the end of which contact the ball touches which wall, or after
            the onset of which contact it comes back to it from inside; else of no meaning.
    """

    kind: str
    orbit: Orbit
    place: tuple[float, float]
    impact: int = 0
    wait: float = 0.0
    wall: float = 1.0


def check_points(points: Any) -> list[Point]:
    """Take points of branches, if curves can begin at them: at least one, an orbit each, all of one kind of wall."""
    listed = checks.sequence("points", points, Point, "points of branches, such as branch.points")
    if not listed:
        raise ValueError("points must hold at least one to begin at; got none; branches meet them")
    for index, point in enumerate(listed):
        if len(check_orbit(point.orbit)) != 1:
            raise ValueError(f"points must have one orbit each; got {len(point.orbit)} at index {index}; take [0:1]")
        if point.orbit.pair.walls != listed[0].orbit.pair.walls:
            raise ValueError(f"points must be of one kind of wall; got soft and rigid ones, the first at index {index}")
    return listed


def curve_start(
    point: Point, place: tuple[float, float], asymmetry: float, plane: Iterable[str] = ()
) -> CurveStart | str:
    """Make a start of what a branch met, or say why no curve can be followed from there.

    Args:
        point: What was met.
        place: Both parameters of the plane there.
        asymmetry: How far from its mirror image an orbit at a pitchfork may be.
        plane: Both parameters, where some may take the symmetry of the walls away.
    """
    kind, orbit = point.kind, point.orbit
    if any(map(skews, plane)):
        if kind == "pitchfork":
            return "two folds meet in a pitchfork where the symmetry of the walls goes, and begin the curves"
        orbit = symmetry.unfolded(orbit)
    if kind == "grazing exit":
        return "the graze of an exit is that of an impact, or of a contact, which begin curves"
    if kind in ("grazing flight", "grazing contact"):
        inside = kind == "grazing contact"
        index, wait, wall = (_shallowest if inside else _closest)(*alone(orbit))
        return CurveStart(kind if inside else "grazing", orbit, place, int(index), float(wait), float(wall))
    if kind == "grazing impact":
        return _without_impact(orbit, place)
    if int(orbit.status[0]) != Status.OK:
        return "no ball flies its orbit"
    if kind == "pitchfork":
        orbit = symmetry.halved(orbit, asymmetry)
    return CurveStart(kind, orbit, place)


_closest, _shallowest = jitted(grazing.closest_turn), jitted(grazing.shallowest_turn)


def alone(orbit: Orbit):
    """Give pair, sequence and knots of an orbit that is alone."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], (orbit.pair, orbit.sequence, orbit.knots))


def _without_impact(orbit: Orbit, place: tuple[float, float]) -> CurveStart | str:
    """Leave out the impact whose speed has come to zero: what is left touches a wall in flight, or from inside.

    From inside where the forcing holds the ball on its wall: the contact before goes on through the impact.
    """
    pair, sequence, knots = alone(orbit)
    count = int(sequence.real.sum())
    index = int(np.where(sequence.real, knots[:, 1], np.inf).argmin())
    side, (t, _, stay) = int(sequence.side[index]), knots[index]
    if count == 1:
        return "no impact would be left"
    inside = side * float(flights.acceleration(pair, t)) > 0
    if inside and pair.hard(side):
        return "the forcing holds the ball on its wall"
    rest = np.delete(np.arange(len(knots)), index)
    rest = np.append(rest, rest[-1:])  # The row keeps its width: the last impact stands twice, as padding.
    walls = np.where(np.arange(len(knots)) < count - 1, sequence.side[rest], 0)
    # The impact before it; of the first one that is the last, a turn earlier.
    before, again = (index - 1, False) if index else (count - 2, True)
    wall = -side if again and sequence.mirrored else side
    onset, knots = t + (float(sequence.span) if again else 0.0), knots[rest]
    began, _, held = knots[before]
    wait = onset - began - (0.0 if inside else held)
    if inside:
        knots[before, 2] = onset + stay - began
    given = guessed(walls[None], np.atleast_1d(sequence.span), np.atleast_1d(sequence.mirrored), knots[None])
    kept = proven(orbit.pair, *given)
    return CurveStart("grazing contact" if inside else "grazing", kept, place, before, float(wait), float(wall))


def with_touch(
    pair: ImpactPair, knots, sequence: Sequence, touch: Touch, wait: np.ndarray, *, inside: bool = False
) -> Orbit:
    """Make orbits of some that touch a wall, in flight or from inside: with an impact of speed 0 there."""
    place, knots = int(touch.impact) + 1, np.array(knots)
    onset, _, stay = knots[:, place - 1].T
    begin, rest = (onset + wait, stay - wait) if inside else (onset + stay + wait, 0.0 * wait)
    if inside:
        knots[:, place - 1, 2] = wait
    more = np.stack([begin, 0.0 * wait, rest], axis=1)
    ways = np.asarray(sequence.span), np.asarray(sequence.mirrored)
    side = np.insert(sequence.side, place, touch.wall.astype(np.int32), axis=1)
    return proven(pair, *guessed(side, *ways, np.insert(knots, place, more, axis=1)))
