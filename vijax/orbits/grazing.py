"""How far an orbit is from grazing: what makes the solution of its equations a real motion, as smooth functions."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.engine import contact_search, flight_search
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import Knots, Sequence

_NOTHING = 1.0  # clearance where there is nothing to clear


class Clearance(NamedTuple):
    """Positive on real orbits; zero where one grazes."""

    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall, over that into it: the ball stays


class _Flight(eqx.Module):
    """A flight on its way: how far it was looked at, the velocity there, and the least room at a turning point yet."""

    s: Float[Array, ""]
    v: Float[Array, ""]
    room: Float[Array, ""]


def _flight_room(pair: ImpactPair, side, speed, t, length, real):
    """Find the least distance from a wall at a turning point of the flight that follows a contact.

    Between zeros of the acceleration the velocity is monotone, so that no turning point is missed.
    """
    force, v0 = flow.flight_force(pair.gamma, t), -side * speed

    def onward(at: _Flight) -> _Flight:
        end = jnp.minimum(jnp.minimum(flight_search.next_turn(force, at.s), at.s + flight_search.LONGEST_PIECE), length)
        v_end, turns, turn = flight_search.monotone_piece(force, v0, at.s, at.v, end, real)
        rise, _ = flow.flight(force, v0, turn)
        # Where the velocity changes from rising to falling the wall ahead is the right one.
        room = 0.5 * pair.d - jnp.sign(at.v) * (0.5 * side * pair.d + rise)
        return _Flight(end, v_end, jnp.where(turns, jnp.minimum(at.room, room), at.room))

    start = _Flight(jnp.zeros_like(t), v0, jnp.full_like(t, _NOTHING))
    return lax.while_loop(lambda at: real & (at.s < length), onward, start).room


class Between(NamedTuple):
    """What happens between the onsets: the clearances, and when each contact on a soft wall is deepest (else NaN)."""

    clearance: Clearance
    deepest: Float[Array, "impact"]


def _contact(pair: ImpactPair, side, knot, real):
    """Find when a contact is deepest, and its least penetration at a minimum inside where there is one."""
    t, speed, stay = knot
    zero, wanted = jnp.zeros_like(t), real & (stay > 0)
    force = flow.contact_force(pair.gamma, side, t)
    turns = contact_search.turning_points(flow.membrane(pair, rolled=True), force, zero, speed, wanted, length=stay)
    deepest = jnp.where(turns.lost | (turns.crest == 0), jnp.nan, turns.crest)
    shallow = jnp.where(jnp.isfinite(turns.lowest), turns.lowest, _NOTHING)
    return deepest, jnp.where(turns.lost, jnp.nan, shallow)


def between(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Between:
    """Find the motion of an orbit between its onsets; clearances are the least of all impacts, NaN if not known.

    Every turning point is visited, as the engine does it: of the hundreds in a long contact samples would miss the one
    that decides.
    """
    real = sequence.real
    # Padded impacts are given harmless knots.
    knots = jnp.where(real[:, None], knots, 1.0)
    departure = shooting.departures(pair, sequence, knots)

    def least(values):
        return jnp.where(real, values, _NOTHING).min()

    flights = jax.vmap(_flight_room, in_axes=(None, 0, 0, 0, 0, 0))
    flight = flights(pair, departure.side, departure.speed, departure.t, departure.next_t - departure.t, real)
    if pair.rigid:
        deepest = jnp.full_like(departure.side, jnp.nan)
        contact = leaves = jnp.full_like(pair.d, _NOTHING)
    else:
        deepest, shallow = jax.vmap(_contact, in_axes=(None, 0, 0, 0))(pair, departure.side, knots, real)
        contact, leaves = least(shallow), least(departure.speed / knots[:, 1])
    return Between(Clearance(least(knots[:, 1]), least(flight), contact, leaves), deepest)
