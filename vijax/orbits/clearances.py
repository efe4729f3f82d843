"""Distances of an orbit from grazing: all positive exactly if the ball can follow the orbit.

The equations of `shooting` hold at the impacts only. A solution may therefore pass through a wall between two impacts,
or remain in a contact that has already ended. Neither happens if the four clearances are positive. They are smooth
functions of parameters and impact unknowns, so that continuation locates a grazing as the zero of one of them.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import contacts, flights, shooting
from vijax.orbits.flights import DEFAULT_CLEARANCE, TURN_TOLERANCE
from vijax.orbits.shooting import ImpactUnknowns, Sequence
from vijax.runtime.compilation.xla import map_lanes


class Clearance(NamedTuple):
    """Least distances of an orbit from grazing, over its impacts: all positive if the ball can follow the orbit."""

    speed: Float[Array, ""]  # least speed into a wall; an impact vanishes at zero
    flight: Float[Array, ""]  # least distance to a wall at a turning point in flight; an impact appears at zero
    contact: Float[Array, ""]  # least penetration at a minimum inside a contact; the contact splits at zero
    exit: Float[Array, ""]  # least ratio of exit speed to entry speed; the ball does not leave the wall at zero


class InteriorMotion(NamedTuple):
    """Properties of an orbit between its onsets.

    Attributes:
        clearance: The least distances from grazing, over all impacts.
        deepest: Time from the onset to the deepest point of each contact; NaN at a rigid wall, and if the search
            failed.
    """

    clearance: Clearance
    deepest: Float[Array, " impact"]


def _contacts(pair: ImpactPair, exits: shooting.ContactExits, impact_unknowns: ImpactUnknowns, real):
    """Compute for each contact the time of the deepest point, and depth and time of the shallowest minimum inside.

    The depth is NaN if the search failed, and `DEFAULT_CLEARANCE` if the contact has no minimum inside.
    """
    t, speed, contact_duration = impact_unknowns.T
    # `crest == 0` marks a rigid wall or padding.
    turns = map_lanes(partial(contacts.turning_points, pair))(exits.side, t, speed, contact_duration, real)
    deepest = jnp.where(turns.failed | (turns.crest == 0), jnp.nan, turns.crest)
    shallow = jnp.where(jnp.isfinite(turns.lowest), turns.lowest, DEFAULT_CLEARANCE)
    return deepest, jnp.where(turns.failed, jnp.nan, shallow), turns.trough


def interior_motion(
    pair: ImpactPair,
    sequence: Sequence,
    impact_unknowns: ImpactUnknowns,
    exits: shooting.ContactExits | None = None,
    /,
    flight_graze: Float[Array, " impact"] | None = None,
    contact_graze: Float[Array, " impact"] | None = None,
) -> InteriorMotion:
    """Compute clearances and deepest points of an orbit from the motion between its onsets.

    Every turning point is visited, because a long contact has hundreds of turning points and sampling could miss the
    one with the least clearance. Each clearance is the least over all impacts, NaN if a search failed.

    Args:
        pair, sequence, impact_unknowns: The orbit, with its impact unknowns.
        exits: The ends of the contacts of the orbit; computed if None.
        flight_graze: Time from the end of each contact to the point where the ball touches a wall in the following
            flight; NaN if it touches none. The clearance of the flight does not include this point.
        contact_graze: Time from the onset of each contact to the point inside it where the ball returns to the wall;
            NaN if it does not return. If this argument is specified, `deepest` in the result has no meaning.
    """
    real = sequence.real
    # Padded impacts get unknowns of 1, which keep all functions below finite.
    impact_unknowns = jnp.where(real[:, None], impact_unknowns, 1.0)
    exits = shooting.contact_exits(pair, sequence, impact_unknowns) if exits is None else exits

    def least(values):
        return jnp.where(real, values, DEFAULT_CLEARANCE).min()

    if flight_graze is None:
        flight_graze = jnp.full_like(exits.t, jnp.nan)
    least_clearance, _ = _flights(pair, exits, real, flight_graze)
    if pair.rigid:
        deepest = jnp.full_like(exits.side, jnp.nan)
        least_penetration = exit_ratio = jnp.full_like(pair.d, DEFAULT_CLEARANCE)
    else:
        deepest, shallow, _ = _contacts(pair, exits, impact_unknowns, real)
        if contact_graze is not None:
            shallow = _least_penetration_of_parts(pair, exits, impact_unknowns, real, contact_graze)
        # A ball that hits a rigid wall with a positive speed always leaves it, so that the ratio has no lower limit
        # there.
        exit_ratios = jnp.where(pair.is_rigid_at(exits.side), DEFAULT_CLEARANCE, exits.speed / impact_unknowns[:, 1])
        least_penetration, exit_ratio = least(shallow), least(exit_ratios)
    return InteriorMotion(
        Clearance(least(impact_unknowns[:, 1]), least(least_clearance), least_penetration, exit_ratio), deepest
    )


def _flights(pair: ImpactPair, exits: shooting.ContactExits, real, graze_time):
    """Compute for each flight the least distance to a wall at a turning point, and the time from the exit to it."""
    flight = exits.side, exits.speed, exits.t, exits.next_t - exits.t
    return map_lanes(partial(flights.nearest_turning_point, pair))(*flight, real, graze_time)


def _least_penetration_of_parts(
    pair: ImpactPair, exits: shooting.ContactExits, impact_unknowns: ImpactUnknowns, real, return_time
):
    """Compute the least penetration at a minimum inside each contact, without a known return to the wall.

    The part before and the part after the return are searched separately. In a search of the whole contact, the return
    would be the shallowest minimum and would hide all others, and rounding could make its penetration negative.
    """
    has_return = real & jnp.isfinite(return_time)
    return_time = jnp.where(has_return, return_time, 0.0)
    onset, speed, contact_duration = impact_unknowns.T
    # The first part ends `TURN_TOLERANCE` early, so that it does not contain the return itself. The second part starts
    # at the return with speed 0.
    before = jnp.stack([onset, speed, jnp.where(has_return, return_time - TURN_TOLERANCE, contact_duration)], axis=1)
    after = jnp.stack([onset + return_time, 0.0 * speed, contact_duration - return_time], axis=1)
    shallow = [_contacts(pair, exits, half, exists)[1] for half, exists in ((before, real), (after, has_return))]
    return jnp.minimum(*shallow)


class NearestTurningPoints(NamedTuple):
    """Distance of each flight, or of each contact, from grazing.

    A flight grazes if it touches a wall where the ball turns round. A contact grazes if the penetration falls to zero
    inside the contact and rises again.

    Attributes:
        clearance: Of a flight, the distance to the wall at the turning point nearest to a wall. Of a contact, the
            penetration at the lowest of its interior minima. inf for padding.
        time: Time from the start of the flight or contact to this turning point or minimum.
        wall: Side of the wall near this turning point, or of the wall in contact, -1 or +1.
    """

    clearance: Float[Array, " impact"]
    time: Float[Array, " impact"]
    wall: Float[Array, " impact"]


def flight_turning_points(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns
) -> NearestTurningPoints:
    """Locate the turning point of each flight that is nearest to a wall."""
    real = sequence.real
    exits = shooting.contact_exits(pair, sequence, jnp.where(real[:, None], impact_unknowns, 1.0))
    clearance, time = _flights(pair, exits, real, jnp.full_like(exits.t, jnp.nan))
    # The sign of the displacement at the turning point specifies the wall that the ball approaches.
    rise, _ = flights.advance_flight(pair, exits.t, -exits.side * exits.speed, time)
    return NearestTurningPoints(jnp.where(real, clearance, jnp.inf), time, jnp.sign(0.5 * exits.side * pair.d + rise))


def contact_minima(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> NearestTurningPoints:
    """Locate the shallowest minimum inside each contact with a soft wall."""
    real = sequence.real
    impact_unknowns = jnp.where(real[:, None], impact_unknowns, 1.0)
    exits = shooting.contact_exits(pair, sequence, impact_unknowns)
    _, shallow, time = _contacts(pair, exits, impact_unknowns, real)
    return NearestTurningPoints(jnp.where(real, shallow, jnp.inf), time, exits.side)


def nearest_flight_turning_point(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Locate the turning point nearest to a wall, among all flights of an orbit.

    Return the index of the impact before the flight, the time from the exit of this impact to the turning point, and
    the wall (-1 or +1).
    """
    return _nearest(flight_turning_points(pair, sequence, impact_unknowns))


def shallowest_contact_minimum(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return impact index, time since the onset, and wall of the shallowest minimum inside a contact."""
    return _nearest(contact_minima(pair, sequence, impact_unknowns))


def _nearest(turns: NearestTurningPoints) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    index = turns.clearance.argmin().astype(jnp.int32)
    return index, turns.time[index], turns.wall[index]
