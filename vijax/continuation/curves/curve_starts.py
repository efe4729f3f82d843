"""Starts of curves: events on branches, converted to the form that each kind of curve needs.

A curve of pitchforks starts from a symmetric orbit, stored as half a period. A curve of grazings starts from the orbit
without the impact of speed zero.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.continuation.branch_events import Point
from vijax.continuation.continuation_parameter import breaks_mirror_symmetry
from vijax.continuation.curves.curve_equations import EventLocation
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import clearances, flights, symmetry
from vijax.orbits.periodic import Orbit, check_orbit, make_guess, verify_solutions
from vijax.orbits.shooting import Sequence
from vijax.runtime import validation
from vijax.runtime.compilation.programs import jitted


class CurveStart(NamedTuple):
    """A bifurcation as the start of a curve.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing" (in flight), "grazing contact", "penetration limit" or "energy
            limit".
        orbit: The orbit at the bifurcation, along a leading axis of one. At a pitchfork it is stored as half a period;
            the second half is the mirror image. At a graze it does not include the impact of speed zero.
        parameters: Values of both parameters of the plane.
        impact, delay, wall: At a graze in flight, the ball touches `wall` a time `delay` after the end of the contact
            with index `impact`; at a graze in a contact, a time `delay` after the onset of that contact. At a limit,
            `impact` is the index of the impact at the limit, and the other two are unused. At other kinds all are
            unused.
    """

    kind: str
    orbit: Orbit
    parameters: tuple[float, float]
    impact: int = 0
    delay: float = 0.0
    wall: float = 1.0


def check_points(points: Any) -> list[Point]:
    """Return points of branches as a list, if curves can begin at them.

    There is at least one point; each has one orbit, and all have one kind of wall.
    """
    point_list = validation.validate_records("points", points, Point, "points of branches, such as branch.points")
    if not point_list:
        raise ValueError("points must hold at least one to begin at; got none; branches meet them")
    for index, point in enumerate(point_list):
        if len(check_orbit(point.orbit)) != 1:
            raise ValueError(f"points must have one orbit each; got {len(point.orbit)} at index {index}; take [0:1]")
        if point.orbit.pair.walls != point_list[0].orbit.pair.walls:
            raise ValueError(f"points must be of one kind of wall; got soft and rigid ones, the first at index {index}")
    return point_list


def curve_start(
    point: Point, parameters: tuple[float, float], asymmetry: float, plane: Iterable[str] = ()
) -> CurveStart | str:
    """Return a start at an event of a branch, or the reason for which no curve can be followed from there.

    Args:
        point: The event.
        parameters: Both parameters of the plane there.
        asymmetry: Largest distance of an orbit at a pitchfork from its mirror image.
        plane: Names of both parameters. If one of them breaks the mirror symmetry, orbits are stored as a full period.
    """
    kind, orbit = point.kind, point.orbit
    if any(map(breaks_mirror_symmetry, plane)):
        if kind == "pitchfork":
            return "without mirror symmetry a pitchfork consists of two folds; begin at the folds"
        orbit = symmetry.unfold(orbit)
    if kind == "grazing exit":
        return "begin at the grazing impact or grazing contact at the same value"
    if kind in ("grazing flight", "grazing contact"):
        inside = kind == "grazing contact"
        index, delay, wall = (_shallowest_contact_minimum if inside else _nearest_flight_turning_point)(
            *single_orbit(orbit)
        )
        return CurveStart(kind if inside else "grazing", orbit, parameters, int(index), float(delay), float(wall))
    # Without its impact of speed 0 the orbit is regular at the graze.
    if kind == "grazing impact":
        return _without_impact(orbit, parameters)
    if int(orbit.status[0]) != Status.OK:
        return "its orbit is not verified"
    if kind == "pitchfork":
        orbit = symmetry.close_half_way(orbit, asymmetry)
    return CurveStart(kind, orbit, parameters)


_nearest_flight_turning_point, _shallowest_contact_minimum = (
    jitted(clearances.nearest_flight_turning_point),
    jitted(clearances.shallowest_contact_minimum),
)


def single_orbit(orbit: Orbit):
    """Return pair, sequence and impact unknowns of a single orbit, without its leading axis."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], (orbit.pair, orbit.sequence, orbit.impact_unknowns))


def _without_impact(orbit: Orbit, parameters: tuple[float, float]) -> CurveStart | str:
    """Return a start without the impact of speed zero: the remaining orbit grazes in flight or in a contact.

    If the acceleration points into the wall, the orbit grazes in a contact, because the previous contact continues
    through the impact.
    """
    pair, sequence, impact_unknowns = single_orbit(orbit)
    count = int(sequence.real.sum())
    index = int(np.where(sequence.real, impact_unknowns[:, 1], np.inf).argmin())
    side, (t, _, contact_duration) = int(sequence.side[index]), impact_unknowns[index]
    if count == 1:
        return "the orbit has no other impact"
    # True if the acceleration points into the wall. At a soft wall the previous contact then continues through the
    # impact.
    in_contact = side * float(flights.acceleration(pair, t)) > 0
    if in_contact and pair.is_rigid_at(side):
        return "the ball sticks to its wall there"
    remaining = np.delete(np.arange(len(impact_unknowns)), index)
    # The row keeps its width: the last impact is repeated as padding.
    remaining = np.append(remaining, remaining[-1:])
    # A wall of 0 marks a padded impact.
    walls = np.where(np.arange(len(impact_unknowns)) < count - 1, sequence.side[remaining], 0)
    # Index of the previous impact. Before the first impact comes the last one, a span earlier.
    before, wraps = (index - 1, False) if index else (count - 2, True)
    wall = -side if wraps and sequence.mirrored else side
    onset, impact_unknowns = t + (float(sequence.span) if wraps else 0.0), impact_unknowns[remaining]
    previous_onset, _, previous_duration = impact_unknowns[before]
    delay = onset - previous_onset - (0.0 if in_contact else previous_duration)
    if in_contact:
        # The previous contact lasts until the end of the impact that is left out.
        impact_unknowns[before, 2] = onset + contact_duration - previous_onset
    guess = make_guess(
        walls[None], np.atleast_1d(sequence.span), np.atleast_1d(sequence.mirrored), impact_unknowns[None]
    )
    remaining_orbit = verify_solutions(orbit.pair, *guess)
    return CurveStart(
        "grazing contact" if in_contact else "grazing", remaining_orbit, parameters, before, float(delay), float(wall)
    )


def with_grazing_impact(
    pair: ImpactPair,
    impact_unknowns,
    sequence: Sequence,
    location: EventLocation,
    delay: np.ndarray,
    *,
    in_contact: bool = False,
) -> Orbit:
    """Return orbits that graze a wall, with an impact of speed 0 inserted at the graze, in flight or in a contact.

    Args:
        pair, impact_unknowns, sequence: Parameters, impact unknowns and walls of the orbits, one row each.
        location: Impact and wall of the graze.
        delay: Time from the end (in flight) or the onset (in a contact) of that impact to the graze, one per orbit.
        in_contact: Whether the ball grazes in a contact.
    """
    index, impact_unknowns = int(location.impact) + 1, np.array(impact_unknowns)
    onset, _, contact_duration = impact_unknowns[:, index - 1].T
    # Onset and contact duration of the inserted impact: the rest of the contact, or zero in flight.
    begin, inserted_duration = (
        (onset + delay, contact_duration - delay) if in_contact else (onset + contact_duration + delay, 0.0 * delay)
    )
    if in_contact:
        # A contact that grazes from inside is split in two at the graze.
        impact_unknowns[:, index - 1, 2] = delay
    inserted = np.stack([begin, 0.0 * delay, inserted_duration], axis=1)
    closing = np.asarray(sequence.span), np.asarray(sequence.mirrored)
    side = np.insert(sequence.side, index, location.wall.astype(np.int32), axis=1)
    return verify_solutions(pair, *make_guess(side, *closing, np.insert(impact_unknowns, index, inserted, axis=1)))
