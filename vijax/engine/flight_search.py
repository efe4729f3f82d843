"""The careful search of a flight: its first wall, past every turn of the ball on the way."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from vijax.engine.forcing_sign import spell_after
from vijax.engine.roots import bracketed_root
from vijax.model import flow
from vijax.model.flow import Force
from vijax.runtime.arrays import Flag, Scalar


class _Scan(eqx.Module):
    """Search for the next wall: none on (0, s]; then the wall and a bracket of the crossing."""

    s: Scalar
    v: Scalar
    turn: Scalar  # next zero of the acceleration
    side: Scalar
    low: Scalar
    high: Scalar


def next_turn(force: Force, s: Scalar) -> Scalar:
    """Find the next zero of a flight's acceleration after s."""
    return spell_after(force, s).end


# Half periods of the forcing: a flight is looked at in pieces of at most this length, also where its acceleration has
# no zero.
LONGEST_PIECE = 1.0


def monotone_piece(
    force: Force, v0: Scalar, s: Scalar, v: Scalar, end: Scalar, wanted: Flag
) -> tuple[Scalar, Flag, Scalar]:
    """Find the velocity at the end of a piece without a zero of the acceleration, and whether and when the ball turns.

    Args:
        force, v0: Of the flight, as in `flow.flight`.
        s, v: Where the piece begins, and the velocity there.
        end: Where it ends.
        wanted: Whether to look for the turn.
    """

    def velocity(s):
        return flow.flight(force, v0, s)[1]

    v_end = velocity(end)
    turns = v * v_end < 0
    up = jnp.where(v > 0, 1.0, -1.0)
    turn = bracketed_root(
        lambda s: (up * velocity(s), up * force.at(s)), s, end, jnp.where(turns, s, end), turns & wanted
    )
    return v_end, turns, turn


def next_wall(
    force: Force, room: tuple[Scalar, Scalar], v0: Scalar, horizon: Scalar, wanted: Flag
) -> tuple[Scalar, Scalar]:
    """Find the time to the first wall crossing and its side (0: none before `horizon`).

    Between zeros of the acceleration (analytic) the velocity is monotone, so each velocity zero is bracketed; between
    those the position is monotone, so each crossing is bracketed. `room` holds the room to the left and right wall.
    """

    def scan(c: _Scan) -> _Scan:
        end = jnp.minimum(c.turn, c.s + LONGEST_PIECE)
        v_end, turns, turn = monotone_piece(force, v0, c.s, c.v, end, wanted)
        middle = jnp.where(turns, turn, end)
        heading = jnp.where(c.v == 0, jnp.sign(v_end), jnp.sign(c.v))
        first = _beyond(force, room, v0, heading, middle)
        second = _beyond(force, room, v0, jnp.sign(v_end), end)
        side = jnp.where(first != 0, first, second)
        low, high = jnp.where(first != 0, c.s, middle), jnp.where(first != 0, middle, end)
        return _Scan(end, v_end, next_turn(force, end), side, low, high)

    zero = jnp.zeros_like(v0)
    start = _Scan(zero, v0, next_turn(force, zero), zero, zero, zero)
    found = lax.while_loop(lambda c: wanted & (c.side == 0) & (c.s < horizon), scan, start)
    distance = jnp.where(found.side > 0, room[1], room[0])

    def gap(s):
        rise, v = flow.flight(force, v0, s)
        return distance - found.side * rise, -found.side * v

    reached = wanted & (found.side != 0)
    return bracketed_root(gap, found.low, found.high, 0.5 * (found.low + found.high), reached), found.side


def _beyond(force, room, v0, heading, s):
    """Give `heading` if the ball, moving that way, is past the wall there at time s, else 0."""
    rise, _ = flow.flight(force, v0, s)
    past = jnp.where(heading > 0, rise > room[1], rise < -room[0])
    return jnp.where(past & (heading != 0), heading, 0.0)
