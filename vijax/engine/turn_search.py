"""Every turning point of a motion under several harmonics, where no formula says when the acceleration changes sign.

A piece of the motion on which its velocity, or its acceleration, keeps its sign for certain holds one at most.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vijax.engine import taylor
from vijax.engine.flight_search import LONGEST_PIECE
from vijax.engine.roots import bracketed_root
from vijax.engine.taylor import Oscillator, Push
from vijax.model.flow import PI
from vijax.model.waves import Waves
from vijax.runtime.arrays import Flag, Scalar, choose

# A piece so short, in half periods, holds one turning point at most whatever bounds say: where the velocity and the
# acceleration vanish together nothing is certain of any piece.
_SHORTEST = 1e-9
PATIENCE = 100_000  # pieces of one motion: the longest contact of an orbit, of a thousand periods, takes a tenth


class _Walk(eqx.Module):
    """A motion on its way: how far it was looked at, where the ball is, which way it went last, the next piece."""

    s: Scalar
    x: Scalar
    z: Scalar
    heading: Scalar
    trial: Scalar
    pieces: Array
    seen: Any


def harmonic_bend(waves: Waves) -> Scalar:
    """Bound the second derivative of what harmonics push with."""
    return sum(((wave.order * PI) ** 2 * jnp.hypot(wave.c, wave.q) for wave in waves), start=jnp.zeros(()))


def visit_turns(
    spring: Oscillator, push: Push, course: Callable, length: Scalar, wanted: Flag, look: Callable, seen: Any
) -> tuple[Any, Flag]:
    """Visit every turning point of a motion in order, and gather what is seen there.

    Args:
        spring, push: The membrane that the ball is in, and what pushes it from the beginning of the motion on.
        course: Gives displacement and velocity at a time since then.
        length: Of the motion.
        wanted: Whether to look at all.
        look: Makes what is seen, of what was seen before, the time, the displacement, and whether the velocity rises.
        seen: What is seen before the first.

    Returns:
        What is seen after the last, and whether the motion took too many pieces to get there.
    """
    zero = jnp.zeros_like(length)
    bend = harmonic_bend(push.waves)

    def onward(walk: _Walk) -> _Walk:
        h = jnp.minimum(walk.trial, length - walk.s)
        end = walk.s + h
        now = taylor.rates(spring, push.later(walk.s), walk.x, walk.z)
        most = taylor.steepest(spring, bend, now, h)
        x, z = course(end)
        keeps = taylor.steady_sign((now.z, now.a), jnp.abs(now.j) + h * most, h)
        sure = keeps | taylor.steady_sign((now.a, now.j), most, h) | (h <= _SHORTEST)
        heading = jnp.where(sure & (walk.heading == 0), jnp.sign(z), walk.heading)
        turns = sure & (heading * z < 0)

        def slowing(s: Scalar) -> tuple[Scalar, Scalar]:
            there, speed = course(s)
            return heading * speed, heading * taylor.rates(spring, push.later(s), there, speed).a

        turn = bracketed_root(slowing, walk.s, end, jnp.where(turns, walk.s, end), turns & wanted)
        seen = choose(turns, look(walk.seen, turn, course(turn)[0], heading < 0), walk.seen)
        return _Walk(
            s=jnp.where(sure, end, walk.s),
            x=jnp.where(sure, x, walk.x),
            z=jnp.where(sure, z, walk.z),
            heading=jnp.where(turns, -heading, heading),
            trial=jnp.where(sure, jnp.minimum(2 * h, LONGEST_PIECE), 0.5 * h),
            pieces=walk.pieces + 1,
            seen=seen,
        )

    def going(walk: _Walk) -> Flag:
        return wanted & (walk.s < length) & (walk.pieces < PATIENCE)

    x, z = course(zero)
    now = taylor.rates(spring, push, x, z)
    heading = jnp.sign(jnp.where(now.z == 0, now.a, now.z))
    start = _Walk(zero, x, z, heading, zero + LONGEST_PIECE, jnp.int32(0), seen)
    end = lax.while_loop(going, onward, start)
    return end.seen, wanted & (end.s < length)
