"""The flights of an orbit: motion, acceleration, and the turning point nearest to a wall.

The motion u'' = -gamma + forcing is closed-form, under the sine (Eqs. (6)-(7) of the paper) and under harmonics.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.impact.exact import flight_search, turn_search
from vijax.impact.taylor.taylor import Oscillator, Push
from vijax.model import flow
from vijax.model.forcing.waves import flight_motion, forcing_acceleration, waves_at
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Scalar, Values, select

DEFAULT_CLEARANCE = 1.0  # clearance of a flight without turning points, and of padding
# Two turning points closer in time than this, in half forcing periods, are treated as one. The tolerance is far above
# the error of the search, unless the acceleration also vanishes at the turning point, and far below the time from one
# turning point to the next.
TURN_TOLERANCE = 1e-6


def advance_flight(pair: ImpactPair, t: Values, v: Values, s: Values) -> tuple[Values, Values]:
    """Compute displacement (from 0) and velocity of a ball a time s after it has velocity v at time t."""
    return flight_motion(waves_at(pair, t), pair.gamma, v, s)


def acceleration(pair: ImpactPair, t: Values) -> Values:
    """Compute the acceleration in flight at time t."""
    return forcing_acceleration(waves_at(pair, t), pair.gamma)


class _NearestTurn(eqx.Module):
    """The turning point with the least clearance so far.

    Attributes:
        clearance: Distance to the wall that the ball approaches before the turning point.
        time: Time from the beginning of the flight to the turning point; NaN if no turning point has been found.
    """

    clearance: Float[Array, ""]
    time: Float[Array, ""]


def nearest_turning_point(pair: ImpactPair, side, speed, t, length, real, graze_time) -> tuple[Scalar, Scalar]:
    """Compute the least distance to a wall at the turning points of the flight after a contact, and its time.

    Args:
        pair: Parameters of one cell.
        side, speed: The wall that the ball leaves, and the speed away from it.
        t, length: Start and duration of the flight.
        real: Whether the flight exists; False for padding.
        graze_time: Time from the start to the point where a grazing orbit touches a wall; this turning point is left
            out. NaN if the flight touches no wall.

    Returns:
        The clearance, and the time from the start to its turning point. The clearance is NaN if the search under
        harmonics failed, and `DEFAULT_CLEARANCE` if the flight has no turning point.
    """
    v0 = -side * speed
    start = _NearestTurn(jnp.full_like(t, DEFAULT_CLEARANCE), jnp.full_like(t, jnp.nan))

    def update(nearest: _NearestTurn, s: Scalar, rise: Scalar, rising) -> _NearestTurn:
        # The ball turns back from the right wall where its velocity changes from positive to negative, and from the
        # left wall where it changes from negative to positive. `rising` is True in the second case.
        ahead = jnp.where(rising, -1.0, 1.0)
        clearance = 0.5 * pair.d - ahead * (0.5 * side * pair.d + rise)
        least = ~(jnp.abs(s - graze_time) < TURN_TOLERANCE) & (clearance < nearest.clearance)
        return _NearestTurn(jnp.where(least, clearance, nearest.clearance), jnp.where(least, s, nearest.time))

    if pair.waves is None:
        nearest = _sine_turns(pair, v0, t, length, real, update, start)
    else:
        waves, zero = waves_at(pair, t), jnp.zeros_like(t)
        push, free = Push(-pair.gamma, zero, waves), Oscillator(zero, zero, zero, zero + jnp.inf)
        state_at = lambda s: flight_motion(waves, pair.gamma, v0, s)  # noqa: E731
        nearest, lost = turn_search.visit_turns(free, push, state_at, length, real, update, start)
        nearest = _NearestTurn(jnp.where(lost, jnp.nan, nearest.clearance), nearest.time)
    return nearest.clearance, nearest.time


class _Flight(eqx.Module):
    """State of the search along a flight.

    Attributes:
        s: End of the part that has been searched.
        v: Velocity at time s.
        nearest: The turning point nearest to a wall in the searched part.
    """

    s: Float[Array, ""]
    v: Float[Array, ""]
    nearest: _NearestTurn


def _sine_turns(pair: ImpactPair, v0, t, length, real, update, start: _NearestTurn) -> _NearestTurn:
    """Visit every turning point of a flight under the sine.

    The zeros of the acceleration are analytic. Between two of them the velocity is monotone, so that each interval has
    at most one turning point and none is missed.
    """
    force = flow.flight_force(pair.gamma, t)

    def next_interval(state: _Flight) -> _Flight:
        # `LONGEST_PIECE` bounds an interval if the acceleration has no zeros (|gamma| > 1).
        end = jnp.minimum(
            jnp.minimum(flight_search.next_acceleration_zero(force, state.s), state.s + flight_search.LONGEST_PIECE),
            length,
        )
        v_end, turns, turn = flight_search.monotone_piece(force, v0, state.s, state.v, end, real)
        nearest = update(state.nearest, turn, flow.flight(force, v0, turn)[0], state.v < 0)
        return _Flight(end, v_end, select(turns, nearest, state.nearest))

    begin = _Flight(jnp.zeros_like(t), v0, start)
    return lax.while_loop(lambda state: real & (state.s < length), next_interval, begin).nearest
