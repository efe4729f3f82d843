"""Robust search for the first wall crossing of a flight, across all turning points of the ball.

In flight u'' = cos(pi t) - gamma (in general the force of `flow.Force`). Between zeros of the acceleration the velocity
is monotone, and between zeros of the velocity the position is monotone, so each crossing has a bracket.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from vijax.impact.roots import bracketed_root
from vijax.impact.sign_intervals import sign_interval_after
from vijax.model import flow
from vijax.model.flow import Force
from vijax.runtime.arrays import Flag, Scalar


class _WallSearch(eqx.Module):
    """State of the search for the first crossing: no crossing on (0, s] while `side` is 0.

    When a crossing is found, `side` is the side of its wall, and the crossing lies in [low, high].
    """

    s: Scalar
    v: Scalar
    turn: Scalar  # Next zero of the acceleration.
    side: Scalar
    low: Scalar
    high: Scalar


def next_acceleration_zero(force: Force, s: Scalar) -> Scalar:
    """Return the next zero of the acceleration of a flight after s."""
    return sign_interval_after(force, s).end


# Longest piece that a search examines at once, in half periods of the forcing. It also ends a piece if the acceleration
# has no zero.
LONGEST_PIECE = 1.0


def monotone_piece(
    force: Force, v0: Scalar, s: Scalar, v: Scalar, end: Scalar, active: Flag
) -> tuple[Scalar, Flag, Scalar]:
    """Return the velocity at the end of a piece of a flight, whether the ball turns on the piece, and the turning time.

    On the piece the acceleration keeps its sign, so the velocity is monotone and has at most one zero.

    Args:
        force, v0: Force and initial velocity of the flight, as in `flow.flight`.
        s, v: Start of the piece, and the velocity there.
        end: End of the piece.
        active: If False, the time of the turning point is not computed.
    """

    def velocity(s):
        return flow.flight(force, v0, s)[1]

    v_end = velocity(end)
    turns = v * v_end < 0
    # `bracketed_root` needs a function that is positive at the start: the velocity is mirrored if it is negative.
    up = jnp.where(v > 0, 1.0, -1.0)
    turn = bracketed_root(
        lambda s: (up * velocity(s), up * force.at(s)), s, end, jnp.where(turns, s, end), turns & active
    )
    return v_end, turns, turn


def next_wall(
    force: Force, clearances: tuple[Scalar, Scalar], v0: Scalar, horizon: Scalar, active: Flag
) -> tuple[Scalar, Scalar]:
    """Return the time and the side of the first wall crossing; the side is 0 if there is none before `horizon`.

    Between zeros of the acceleration (closed-form) the velocity is monotone, so each velocity zero has a bracket.
    Between velocity zeros the position is monotone, so each crossing has a bracket. `clearances` holds the distances to
    the left and the right wall at the start.
    """

    def scan(c: _WallSearch) -> _WallSearch:
        end = jnp.minimum(c.turn, c.s + LONGEST_PIECE)
        v_end, turns, turn = monotone_piece(force, v0, c.s, c.v, end, active)
        middle = jnp.where(turns, turn, end)
        # From rest the ball moves in the direction of its velocity at the end of the piece.
        heading = jnp.where(c.v == 0, jnp.sign(v_end), jnp.sign(c.v))
        # At most one crossing lies before the turning point and one after it; the earlier one counts.
        before_turn = _passed_wall(force, clearances, v0, heading, middle)
        after_turn = _passed_wall(force, clearances, v0, jnp.sign(v_end), end)
        side = jnp.where(before_turn != 0, before_turn, after_turn)
        low, high = jnp.where(before_turn != 0, c.s, middle), jnp.where(before_turn != 0, middle, end)
        return _WallSearch(end, v_end, next_acceleration_zero(force, end), side, low, high)

    zero = jnp.zeros_like(v0)
    start = _WallSearch(zero, v0, next_acceleration_zero(force, zero), zero, zero, zero)
    result = lax.while_loop(lambda c: active & (c.side == 0) & (c.s < horizon), scan, start)
    distance = jnp.where(result.side > 0, clearances[1], clearances[0])

    def residual(s):
        rise, v = flow.flight(force, v0, s)
        return distance - result.side * rise, -result.side * v

    reached = active & (result.side != 0)
    return bracketed_root(residual, result.low, result.high, 0.5 * (result.low + result.high), reached), result.side


def _passed_wall(force, clearances, v0, heading, s):
    """Return `heading` (-1 or +1) if the ball is beyond the wall on that side at time s, else 0."""
    rise, _ = flow.flight(force, v0, s)
    past = jnp.where(heading > 0, rise > clearances[1], rise < -clearances[0])
    return jnp.where(past & (heading != 0), heading, 0.0)
