"""Fast flight without gravity: the first wall crossing in straight-line arithmetic, certified or declined.

u' = (p + sin(pi t))/pi with p constant, so the extrema of u are closed-form and the crossing solves Kepler's equation
sin y + P y = G (see `fast_flight`).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.impact import BallState, Lane
from vijax.impact.polynomial import arcsine, phase, sine_cosine
from vijax.impact.roots import converged_step, converges, householder, single
from vijax.model.flow import PI
from vijax.runtime.compilation.xla import materialise, materialised

_ROUNDS = 3  # iterations in single precision, before one in double precision
_NEAR = 64  # an extremum within this number of machine epsilons of a wall may lie on either side of the wall


def _kepler(slope: Lane, goal: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Return the root y of sin y + slope y = goal nearest 0, the last step, and sin and cos of y before this step."""
    p, g = single((slope, goal))
    # The left side is nearly straight about y = 0, with slope 1 + p.
    y = jnp.clip(g / (1 + p), -2.6, 2.6)
    for _ in range(_ROUNDS):
        sine, cosine = reflected(y)
        y = materialise(y + householder(sine + p * y - g, p + cosine, -sine, -cosine))
    y = materialise(y.astype(slope.dtype))
    sine, cosine = reflected(y)
    step = materialise(householder(sine + slope * y - goal, slope + cosine, -sine, -cosine))
    return y + step, step, sine, cosine


@materialised
def reflected(y: Lane) -> tuple[Lane, Lane]:
    """Return sin and cos on |y| <= pi + 0.08, by reflection at a quarter turn."""
    size = jnp.abs(y)
    is_folded = size > 0.5 * PI
    sine, cosine = sine_cosine(jnp.where(is_folded, PI - size, size))
    return jnp.where(y < 0, -sine, sine), jnp.where(is_folded, -cosine, cosine)


class Flight(eqx.Module):
    """End of a flight at a wall, in the frame where the ball starts downwards.

    Attributes:
        elapsed: Duration of the flight.
        speed: Speed towards the wall.
        flip: +-1; -1 if the frame is mirrored relative to the device.
        wall: Side of the wall in the frame, +-1.
        sine, cosine: Forcing at the onset: a time s later, the forcing towards the wall, without gravity, is
            -sine cos(pi s) - cosine sin(pi s).
        certified: The flight is certified.
        escapes: The ball reaches no wall again.
    """

    elapsed: Lane
    speed: Lane
    flip: Lane
    wall: Lane
    sine: Lane
    cosine: Lane
    certified: Bool[Array, " lane"]
    escapes: Bool[Array, " lane"]


class _Stretch(NamedTuple):
    """Monotone part of a flight that ends at a wall, in the frame where the ball starts downwards."""

    up: Bool[Array, " lane"]  # it ends at the upper wall
    periods: Lane  # whole periods before it begins
    uncertain: Bool[Array, " lane"]  # an extremum on the way may graze or miss a wall


def _stretch(half: Lane, u: Lane, p: Lane, ahead: Lane, cosine: Lane) -> _Stretch:
    """Return the monotone part with the crossing, by comparison of the extrema with the walls in single precision.

    Comparisons within rounding count as uncertain. `ahead` is the time from the start of the flight to the centre of
    its first monotone part.
    """
    inside = jnp.clip(p, -1.0, 1.0)
    # Extrema lie where sin(pi t) = -p. `swing` is the deviation of u from its mean drift at an extremum.
    angle = arcsine(inside) * (1 / PI)
    swing = jnp.sqrt((1 - inside) * (1 + inside)) * (1 / PI**2)
    drift = p * (1 / PI)
    u_centre = u + drift * ahead + cosine * (1 / PI**2)
    lowest = u_centre + drift * (0.5 - angle) - swing
    highest = u_centre + drift * (1.5 + angle) + swing
    lowest, highest, u_centre, drift = materialise((lowest, highest, u_centre, drift))
    falls = p <= -1  # the ball moves downwards for ever
    reaches_lower, reaches_upper = (lowest <= -half) | falls, highest >= half
    up = ~reaches_lower & (reaches_upper | (drift > 0))
    slow_point = jnp.where(falls, u_centre + drift, lowest)
    # distance that the deciding extremum still has to move to reach its wall; it moves by 2 |drift| per period
    short = jnp.where(drift > 0, half - highest, slow_point + half)
    periods = jnp.ceil(short / jnp.maximum(jnp.abs(2 * drift), jnp.finfo(half.dtype).tiny))
    periods = jnp.where((reaches_upper & ~reaches_lower) | (reaches_lower & ~falls), 0.0, jnp.maximum(periods, 0.0))
    margin = _NEAR * jnp.finfo(half.dtype).eps
    # Position of the deciding extremum relative to its wall, after the skipped periods.
    overshoot = jnp.where(up, highest - half, lowest + half) + 2 * drift * periods
    is_near = jnp.abs(overshoot) < margin
    before = (jnp.abs(overshoot - 2 * drift) < margin) & (periods > 0)
    passed = (jnp.abs(lowest + half) < margin) | (~reaches_lower & (jnp.abs(highest - half) < margin))
    flat = jnp.abs(jnp.abs(p) - 1) < margin  # extrema may or may not exist
    return _Stretch(up, periods, ((is_near | before | passed) & ~falls) | flat)


@materialised
def fast_flight(half: Lane, lane: BallState) -> Flight:
    """Return the first wall crossing without gravity: select the monotone part that holds it, then solve for the root.

    u' = (p + sin pi t)/pi. For |p| < 1 the extrema of u are closed-form, and each period raises them by 2p/pi.
    Comparing two of them with the walls, and one division, therefore give the monotone part with the crossing. About
    the centre of that part the crossing satisfies sin y + P y = G, Kepler's equation, with a monotone left side. A
    Householder iteration from the centre, where the left side is nearly straight, converges in two or three iterations.
    """
    eps = jnp.finfo(half.dtype).eps
    # Mirror upward starts: u -> -u shifts the phase of the forcing by half a period, which is 1.
    flip = jnp.where(lane.v < 0, 1.0, -1.0).astype(half.dtype)
    sine, cosine = phase(lane.t)
    sine, cosine = flip * sine, flip * cosine
    t = jnp.where(flip > 0, lane.t, jnp.where(lane.t >= 1, lane.t - 1, lane.t + 1))
    u = flip * lane.u
    p = flip * PI * lane.v - sine
    u, t, p, cosine = materialise((u, t, p, cosine))
    # A ball at rest is at the start of a monotone part, as after a turning point, if the forcing pulls it downwards in
    # this frame.
    falls = cosine < 0
    centre = jnp.where(t < 0.5, -0.5, 1.5).astype(t.dtype)
    part = _stretch(*single((half, u, p, centre - t, cosine)))
    wall = jnp.where(part.up, 1.0, -1.0).astype(half.dtype)
    periods = part.periods.astype(half.dtype)
    drift = p * (1 / PI)
    away = centre + jnp.where(part.up, 1.0, 0.0) + 2 * periods - t
    # Kepler's equation about the centre of the part: sin y + slope y = goal, with y the angle from the centre.
    slope = wall * p
    goal = PI**2 * (half - wall * (u + drift * away + cosine * (1 / PI**2)))
    # A drift that needs so many periods to reach a wall counts as zero: it may be a rounding error.
    escapes = periods > 1e7
    slope, goal, away, uncertain = materialise((slope, goal, away, part.uncertain))
    y, step, sine, cosine = _kepler(slope, goal)
    square = step * step
    turn_sine, turn_cosine = step * (1 - square * (1 / 6)), 1 - square * (0.5 - square * (1 / 24))
    # The iteration is of fourth order: the error after the last step is (stiffness step)^3 step.
    converged = converges(step, 1.0, slope + cosine, sine, converged_step(eps))
    sine, cosine = sine * turn_cosine + cosine * turn_sine, cosine * turn_cosine - sine * turn_sine
    speed = (slope + cosine) * (1 / PI)
    elapsed = away + y * (1 / PI)
    moves = lane.v != 0
    # A ball at rest that reaches no wall may stay at its place for ever.
    determined = moves | (falls & ~escapes)
    # A short flight loses its leading digits in the difference of phases.
    certified = converged & ~uncertain & (speed > 0) & (elapsed > 1 / 256) & determined & (jnp.abs(y) < 3.4)
    return Flight(elapsed, speed, flip, wall, sine, cosine, certified, escapes & moves)
