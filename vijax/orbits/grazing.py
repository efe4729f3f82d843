"""How far an orbit is from grazing: what makes the solution of its equations a real motion, as smooth functions."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import contacts, flights, shooting
from vijax.orbits.flights import NOTHING, SAME_TURN
from vijax.orbits.shooting import Knots, Sequence
from vijax.runtime.xla import each


class Clearance(NamedTuple):
    """Positive on real orbits; zero where one grazes."""

    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall, over that into it: the ball stays


class Between(NamedTuple):
    """What happens between the onsets: the clearances, and when each contact on a soft wall is deepest (else NaN)."""

    clearance: Clearance
    deepest: Float[Array, " impact"]


def _contacts(pair: ImpactPair, departure: shooting.Departure, knots: Knots, real):
    """Find when each contact is deepest, and its least penetration at a minimum inside where there is one, and when."""
    t, speed, stay = knots.T
    turns = each(partial(contacts.turns, pair))(departure.side, t, speed, stay, real)
    deepest = jnp.where(turns.lost | (turns.crest == 0), jnp.nan, turns.crest)
    shallow = jnp.where(jnp.isfinite(turns.lowest), turns.lowest, NOTHING)
    return deepest, jnp.where(turns.lost, jnp.nan, shallow), turns.trough


def between(
    pair: ImpactPair,
    sequence: Sequence,
    knots: Knots,
    departure: shooting.Departure | None = None,
    /,
    touch: Float[Array, " impact"] | None = None,
    split: Float[Array, " impact"] | None = None,
) -> Between:
    """Find the motion of an orbit between its onsets; clearances are the least of all impacts, NaN if not known.

    Every turning point is visited, as the engine does it: of the hundreds in a long contact samples would miss the one
    that decides.

    Args:
        departure: How each contact ends, where that is known already.
        touch: How long after the end of each contact the ball is known to touch a wall; NaN where it is not.
        split: How long after its onset each contact is known to come back to its wall; NaN where none is. None is
            deepest then.
    """
    real = sequence.real
    # Padded impacts are given harmless knots.
    knots = jnp.where(real[:, None], knots, 1.0)
    departure = shooting.departures(pair, sequence, knots) if departure is None else departure

    def least(values):
        return jnp.where(real, values, NOTHING).min()

    if touch is None:
        touch = jnp.full_like(departure.t, jnp.nan)
    flight, _ = _flights(pair, departure, real, touch)
    if pair.rigid:
        deepest = jnp.full_like(departure.side, jnp.nan)
        contact = leaves = jnp.full_like(pair.d, NOTHING)
    else:
        deepest, shallow, _ = _contacts(pair, departure, knots, real)
        if split is not None:
            shallow = _halves(pair, departure, knots, real, split)
        # At a rigid wall a ball that comes at all leaves.
        exits = jnp.where(pair.hard(departure.side), NOTHING, departure.speed / knots[:, 1])
        contact, leaves = least(shallow), least(exits)
    return Between(Clearance(least(knots[:, 1]), least(flight), contact, leaves), deepest)


def _flights(pair: ImpactPair, departure: shooting.Departure, real, touch):
    """Find the least room in every flight, and how long after the contact it is."""
    flight = departure.side, departure.speed, departure.t, departure.next_t - departure.t
    return each(partial(flights.nearest_turn, pair))(*flight, real, touch)


def _halves(pair: ImpactPair, departure: shooting.Departure, knots: Knots, real, split):
    """Find the least penetration at a minimum inside each contact, where one is known to come back to the wall.

    Before and after it apart: as a minimum of its own it would hide others, or come out below zero by rounding.
    """
    parted = real & jnp.isfinite(split)
    split = jnp.where(parted, split, 0.0)
    onset, speed, stay = knots.T
    before = jnp.stack([onset, speed, jnp.where(parted, split - SAME_TURN, stay)], axis=1)
    after = jnp.stack([onset + split, 0.0 * speed, stay - split], axis=1)
    shallow = [_contacts(pair, departure, half, there)[1] for half, there in ((before, real), (after, parted))]
    return jnp.minimum(*shallow)


class NearTurns(NamedTuple):
    """How near each flight, or contact, comes to grazing: the least room, how long after it began, and at which wall.

    The room is inf where there is no impact.
    """

    room: Float[Array, " impact"]
    when: Float[Array, " impact"]
    wall: Float[Array, " impact"]


def flight_turns(pair: ImpactPair, sequence: Sequence, knots: Knots) -> NearTurns:
    """Find where each flight turns closest to a wall."""
    real = sequence.real
    departure = shooting.departures(pair, sequence, jnp.where(real[:, None], knots, 1.0))
    room, when = _flights(pair, departure, real, jnp.full_like(departure.t, jnp.nan))
    rise, _ = flights.flown(pair, departure.t, -departure.side * departure.speed, when)
    return NearTurns(jnp.where(real, room, jnp.inf), when, jnp.sign(0.5 * departure.side * pair.d + rise))


def contact_turns(pair: ImpactPair, sequence: Sequence, knots: Knots) -> NearTurns:
    """Find where each contact with a soft wall is shallowest at a minimum inside."""
    real = sequence.real
    knots = jnp.where(real[:, None], knots, 1.0)
    departure = shooting.departures(pair, sequence, knots)
    _, shallow, when = _contacts(pair, departure, knots, real)
    return NearTurns(jnp.where(real, shallow, jnp.inf), when, departure.side)


def closest_turn(
    pair: ImpactPair, sequence: Sequence, knots: Knots
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Find where the ball turns closest to a wall in flight: after which impact, how long after it, and which wall."""
    return _nearest(flight_turns(pair, sequence, knots))


def shallowest_turn(
    pair: ImpactPair, sequence: Sequence, knots: Knots
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Find where a contact is shallowest at a minimum inside: of which impact, how long after its onset, which wall."""
    return _nearest(contact_turns(pair, sequence, knots))


def _nearest(turns: NearTurns) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    index = turns.room.argmin().astype(jnp.int32)
    return index, turns.when[index], turns.wall[index]
