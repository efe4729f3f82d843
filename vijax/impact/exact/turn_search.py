"""Search for every turning point of a motion under several harmonics, where the acceleration's zeros have no formula.

If the velocity or the acceleration is certified to keep its sign on a piece of the motion, the piece holds at most one
turning point.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vijax.impact.exact.flight_search import LONGEST_PIECE
from vijax.impact.roots import bracketed_root
from vijax.impact.taylor import taylor
from vijax.impact.taylor.taylor import Oscillator, Push
from vijax.model.flow import PI
from vijax.model.forcing.waves import Waves
from vijax.runtime.arrays import Flag, Scalar, select

# In half periods of the forcing. A piece shorter than this counts, without a certificate, as a piece with at most one
# turning point, because no piece can be certified at a time when velocity and acceleration are both zero.
_SHORTEST = 1e-9
# Largest number of pieces of one motion. The longest contact of an orbit, a thousand periods, takes a tenth of it.
MAX_PIECES = 100_000


class _TurnScan(eqx.Module):
    """State of the search: time, state of the ball, its last direction, and the length of the next piece."""

    s: Scalar
    x: Scalar
    z: Scalar
    heading: Scalar
    trial: Scalar
    pieces: Array
    record: Any


def harmonic_curvature_bound(waves: Waves) -> Scalar:
    """Return a bound of the second derivative of a sum of harmonics."""
    return sum(((wave.order * PI) ** 2 * jnp.hypot(wave.c, wave.q) for wave in waves), start=jnp.zeros(()))


def visit_turns(
    spring: Oscillator, push: Push, course: Callable, length: Scalar, active: Flag, update: Callable, record: Any
) -> tuple[Any, Flag]:
    """Visit every turning point of a motion in order, and update a record at each.

    Args:
        spring, push: Membrane that the ball is in, and force from the start of the motion on.
        course: Function of the time since the start; returns displacement and velocity.
        length: Duration of the motion.
        active: If False, nothing is searched.
        update: Function of the record, the time, the displacement, and whether the turning point is a minimum; returns
            the new record.
        record: Record before the first turning point.

    Returns:
        The record after the last turning point, and whether the motion took too many pieces.
    """
    zero = jnp.zeros_like(length)
    curvature_bound = harmonic_curvature_bound(push.waves)

    def advance(scan: _TurnScan) -> _TurnScan:
        # A piece that is not certified is halved. After a certified piece the next piece is twice as long.
        h = jnp.minimum(scan.trial, length - scan.s)
        end = scan.s + h
        now = taylor.rates(spring, push.later(scan.s), scan.x, scan.z)
        most = taylor.fourth_derivative_bound(spring, curvature_bound, now, h)
        x, z = course(end)
        no_turn = taylor.certify_constant_sign((now.z, now.a), jnp.abs(now.j) + h * most, h)
        certified = no_turn | taylor.certify_constant_sign((now.a, now.j), most, h) | (h <= _SHORTEST)
        heading = jnp.where(certified & (scan.heading == 0), jnp.sign(z), scan.heading)
        turns = certified & (heading * z < 0)

        def speed_before_turn(s: Scalar) -> tuple[Scalar, Scalar]:
            there, speed = course(s)
            return heading * speed, heading * taylor.rates(spring, push.later(s), there, speed).a

        turn = bracketed_root(speed_before_turn, scan.s, end, jnp.where(turns, scan.s, end), turns & active)
        record = select(turns, update(scan.record, turn, course(turn)[0], heading < 0), scan.record)
        return _TurnScan(
            s=jnp.where(certified, end, scan.s),
            x=jnp.where(certified, x, scan.x),
            z=jnp.where(certified, z, scan.z),
            heading=jnp.where(turns, -heading, heading),
            trial=jnp.where(certified, jnp.minimum(2 * h, LONGEST_PIECE), 0.5 * h),
            pieces=scan.pieces + 1,
            record=record,
        )

    def going(scan: _TurnScan) -> Flag:
        return active & (scan.s < length) & (scan.pieces < MAX_PIECES)

    x, z = course(zero)
    now = taylor.rates(spring, push, x, z)
    # From rest the ball moves in the direction of its acceleration.
    heading = jnp.sign(jnp.where(now.z == 0, now.a, now.z))
    start = _TurnScan(zero, x, z, heading, zero + LONGEST_PIECE, jnp.int32(0), record)
    end = lax.while_loop(going, advance, start)
    return end.record, active & (end.s < length)
