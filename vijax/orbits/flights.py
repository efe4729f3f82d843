"""The flights of an orbit: where they lead, what pushes the ball, and where it turns; by the sine or by harmonics."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.engine import flight_search, turn_search
from vijax.engine.taylor import Oscillator, Push
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.waves import drift, pushing, waves_at
from vijax.runtime.arrays import Scalar, Values, choose

NOTHING = 1.0  # clearance where there is nothing to clear
# Half periods between two turning points that are one, found twice: far more than the search is off, except where the
# acceleration vanishes too, and far less than the ball takes from one to another.
SAME_TURN = 1e-6


def flown(pair: ImpactPair, t: Values, v: Values, s: Values) -> tuple[Values, Values]:
    """Compute how far a ball flies in a time s that has velocity v at a time t, and its velocity then."""
    return drift(waves_at(pair, t), pair.gamma, v, s)


def acceleration(pair: ImpactPair, t: Values) -> Values:
    """Compute the acceleration in flight at a time."""
    return pushing(waves_at(pair, t), pair.gamma)


class _Turn(eqx.Module):
    """Of the turning points of a flight so far, the one with the least room to its wall: how much, and when."""

    room: Float[Array, ""]
    when: Float[Array, ""]


def nearest_turn(pair: ImpactPair, side, speed, t, length, real, touch) -> tuple[Scalar, Scalar]:
    """Find the least distance from a wall at a turning point of the flight that follows a contact, and when that is.

    Args:
        pair: One cell.
        side, speed: The wall that the ball leaves, and how fast.
        t, length: When the flight begins, and how long it is.
        real: Whether it is there.
        touch: How long after its beginning it is known to touch a wall, which is left out; NaN where it is not.
    """
    v0 = -side * speed
    start = _Turn(jnp.full_like(t, NOTHING), jnp.full_like(t, jnp.nan))

    def look(seen: _Turn, s: Scalar, rise: Scalar, rising) -> _Turn:
        # Where the velocity changes from rising to falling the wall ahead is the right one.
        ahead = jnp.where(rising, -1.0, 1.0)
        room = 0.5 * pair.d - ahead * (0.5 * side * pair.d + rise)
        least = ~(jnp.abs(s - touch) < SAME_TURN) & (room < seen.room)
        return _Turn(jnp.where(least, room, seen.room), jnp.where(least, s, seen.when))

    if pair.waves is None:
        seen = _sine_turns(pair, v0, t, length, real, look, start)
    else:
        waves, zero = waves_at(pair, t), jnp.zeros_like(t)
        push, free = Push(-pair.gamma, zero, waves), Oscillator(zero, zero, zero, zero + jnp.inf)
        course = lambda s: drift(waves, pair.gamma, v0, s)  # noqa: E731
        seen, lost = turn_search.visit_turns(free, push, course, length, real, look, start)
        seen = _Turn(jnp.where(lost, jnp.nan, seen.room), seen.when)
    return seen.room, seen.when


class _Flight(eqx.Module):
    """A flight on its way: how far it was looked at, the velocity there, what was seen yet."""

    s: Float[Array, ""]
    v: Float[Array, ""]
    seen: _Turn


def _sine_turns(pair: ImpactPair, v0, t, length, real, look, start: _Turn) -> _Turn:
    """Visit every turning point of a flight: there is one at most from zero to zero of the acceleration, all known."""
    force = flow.flight_force(pair.gamma, t)

    def onward(at: _Flight) -> _Flight:
        end = jnp.minimum(jnp.minimum(flight_search.next_turn(force, at.s), at.s + flight_search.LONGEST_PIECE), length)
        v_end, turns, turn = flight_search.monotone_piece(force, v0, at.s, at.v, end, real)
        seen = look(at.seen, turn, flow.flight(force, v0, turn)[0], at.v < 0)
        return _Flight(end, v_end, choose(turns, seen, at.seen))

    begin = _Flight(jnp.zeros_like(t), v0, start)
    return lax.while_loop(lambda at: real & (at.s < length), onward, begin).seen
