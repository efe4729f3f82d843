"""The quick flight: the first wall crossing without gravity, in straight-line arithmetic, certified or declined."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.impact import Ball, Lane
from vijax.engine.polynomial import arcsine, phase, sine_cosine
from vijax.engine.roots import converged_step, converges, householder, single
from vijax.model.flow import PI
from vijax.runtime.xla import share, shared

_ROUNDS = 3  # so many run in single precision, before the one in double
_NEAR = 64  # roundings within which an extremum may be on either side of a wall


def _kepler(slope: Lane, goal: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Find the root y of sin y + slope y = goal nearest 0, the last step to it, and sin and cos of y before that."""
    p, g = single((slope, goal))
    y = jnp.clip(g / (1 + p), -2.6, 2.6)
    for _ in range(_ROUNDS):
        sine, cosine = reflected(y)
        y = share(y + householder(sine + p * y - g, p + cosine, -sine, -cosine))
    y = share(y.astype(slope.dtype))
    sine, cosine = reflected(y)
    step = share(householder(sine + slope * y - goal, slope + cosine, -sine, -cosine))
    return y + step, step, sine, cosine


@shared
def reflected(y: Lane) -> tuple[Lane, Lane]:
    """Compute sin and cos on |y| <= pi + 0.08."""
    size = jnp.abs(y)
    beyond = size > 0.5 * PI
    sine, cosine = sine_cosine(jnp.where(beyond, PI - size, size))
    return jnp.where(y < 0, -sine, sine), jnp.where(beyond, -cosine, cosine)


class Flight(eqx.Module):
    """Arrival at a wall, in the frame where the ball starts downwards; sin and cos of the angle past its centre."""

    elapsed: Lane
    speed: Lane  # towards the wall
    flip: Lane  # +-1: the frame is mirrored
    wall: Lane  # +-1 in the frame
    sine: Lane
    cosine: Lane
    sure: Bool[Array, " lane"]
    never: Bool[Array, " lane"]


class _Stretch(NamedTuple):
    """The monotone stretch of a flight that ends at a wall, in the frame where the ball starts downwards."""

    up: Bool[Array, " lane"]  # whether it ends at the upper wall
    periods: Lane  # before it begins
    doubt: Bool[Array, " lane"]  # an extremum on the way may be a graze or a miss


def _stretch(half: Lane, u: Lane, p: Lane, ahead: Lane, cosine: Lane) -> _Stretch:
    """Find the stretch by comparing extrema with the walls, in single precision: what is closer than that is in doubt.

    The centre of the first stretch is a time `ahead`.
    """
    inside = jnp.clip(p, -1.0, 1.0)
    angle = arcsine(inside) * (1 / PI)
    swing = jnp.sqrt((1 - inside) * (1 + inside)) * (1 / PI**2)
    drift = p * (1 / PI)
    u_centre = u + drift * ahead + cosine * (1 / PI**2)
    lowest = u_centre + drift * (0.5 - angle) - swing
    highest = u_centre + drift * (1.5 + angle) + swing
    lowest, highest, u_centre, drift = share((lowest, highest, u_centre, drift))
    falls = p <= -1  # downwards for ever
    left, right = (lowest <= -half) | falls, highest >= half
    up = ~left & (right | (drift > 0))
    slow_point = jnp.where(falls, u_centre + drift, lowest)
    short = jnp.where(drift > 0, half - highest, slow_point + half)  # still to climb or sink, period by period
    periods = jnp.ceil(short / jnp.maximum(jnp.abs(2 * drift), jnp.finfo(half.dtype).tiny))
    periods = jnp.where((right & ~left) | (left & ~falls), 0.0, jnp.maximum(periods, 0.0))
    margin = _NEAR * jnp.finfo(half.dtype).eps
    beyond = jnp.where(up, highest - half, lowest + half) + 2 * drift * periods
    near = jnp.abs(beyond) < margin
    before = (jnp.abs(beyond - 2 * drift) < margin) & (periods > 0)
    passed = (jnp.abs(lowest + half) < margin) | (~left & (jnp.abs(highest - half) < margin))
    flat = jnp.abs(jnp.abs(p) - 1) < margin  # there may be extrema or none
    return _Stretch(up, periods, ((near | before | passed) & ~falls) | flat)


@shared
def fly(half: Lane, lane: Ball) -> Flight:
    """Find the first wall crossing without gravity: pick the monotone stretch that holds it, then Kepler's equation.

    u' = (p + sin pi t)/pi. For |p| < 1 the extrema are closed-form, and each period lifts them by 2p/pi, so comparing
    two of them with the walls and one division give the crossing's stretch. About the centre of a stretch the crossing
    obeys sin y + P y = G, Kepler's equation, monotone there; a Householder iteration from the centre, where the left
    side is nearly straight, converges in two or three rounds.
    """
    eps = jnp.finfo(half.dtype).eps
    flip = jnp.where(lane.v < 0, 1.0, -1.0).astype(half.dtype)
    sine, cosine = phase(lane.t)
    sine, cosine = flip * sine, flip * cosine
    t = jnp.where(flip > 0, lane.t, jnp.where(lane.t >= 1, lane.t - 1, lane.t + 1))
    u = flip * lane.u
    p = flip * PI * lane.v - sine
    u, t, p, cosine = share((u, t, p, cosine))
    # A ball at rest begins a stretch, as one that has just turned, if the forcing pulls it downwards in this frame.
    falls = cosine < 0
    centre = jnp.where(t < 0.5, -0.5, 1.5).astype(t.dtype)
    stretch = _stretch(*single((half, u, p, centre - t, cosine)))
    wall = jnp.where(stretch.up, 1.0, -1.0).astype(half.dtype)
    periods = stretch.periods.astype(half.dtype)
    drift = p * (1 / PI)
    away = centre + jnp.where(stretch.up, 1.0, 0.0) + 2 * periods - t
    slope = wall * p
    goal = PI**2 * (half - wall * (u + drift * away + cosine * (1 / PI**2)))
    never = periods > 1e7
    slope, goal, away, doubt = share((slope, goal, away, stretch.doubt))
    y, step, sine, cosine = _kepler(slope, goal)
    square = step * step
    turn_sine, turn_cosine = step * (1 - square * (1 / 6)), 1 - square * (0.5 - square * (1 / 24))
    # The iteration is of fourth order: what is left after the last step is (stiffness step)^3 step.
    converged = converges(step, 1.0, slope + cosine, sine, converged_step(eps))
    sine, cosine = sine * turn_cosine + cosine * turn_sine, cosine * turn_cosine - sine * turn_sine
    speed = (slope + cosine) * (1 / PI)
    elapsed = away + y * (1 / PI)
    # A short hop loses its leading digits in the phases.
    moves = lane.v != 0
    # One at rest that meets no wall may stay where it is for ever.
    known = moves | (falls & ~never)
    sure = converged & ~doubt & (speed > 0) & (elapsed > 1 / 256) & known & (jnp.abs(y) < 3.4)
    return Flight(elapsed, speed, flip, wall, sine, cosine, sure, never & moves)
