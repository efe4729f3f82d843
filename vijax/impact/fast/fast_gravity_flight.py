"""Fast flight with gravity: the first wall crossing in straight-line arithmetic, certified or declined.

A flight is divided where its acceleration cos(pi t) - gamma is zero, at two phases that are constants of the cell. On a
piece u' is monotone, so u is concave, or convex and then mirrored. In units of 1/pi^2, with the angle y from the centre
of the piece, where t is an integer, every piece reads

    U(y) = level + rate y - slope y^2/2 - (1 - cos y),    |y| < width,

with slope gamma or -gamma. U at the ends of a piece needs no sine that depends on the flight. A concave U that ends
beyond the upper wall crosses this wall once. Otherwise U crosses the upper wall if its maximum is beyond this wall, and
if not, it crosses the lower wall once if it ends beyond the lower wall. A piece thus holds only one first crossing, and
any zero of U - wall with U' towards the wall is this crossing. The selection of the piece therefore needs no
certificate.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32

from vijax.impact.fast.fast_flight import Flight, reflected
from vijax.impact.impact import BallState, Lane
from vijax.impact.polynomial import phase
from vijax.impact.roots import correction, householder, single
from vijax.model.flow import PI
from vijax.runtime.arrays import select
from vijax.runtime.compilation.xla import materialise, materialised

_PIECES = 3  # a flight with more pieces is declined: one in a thousand at gamma 0.1, one in 200 at gamma 0
_ROUNDS = 2  # iterations in single precision, before one in double precision
_NEAR = 8  # an end or a maximum within this number of roundings of a wall may lie on either side of the wall
_STEP = 2e-3  # longest last step for which the Taylor polynomial of degree five has a relative error of 1e-19

Flags = Bool[Array, "lane"]
Rough = Float32[Array, "lane"]


class Shape(eqx.Module):
    """Constants of all concave pieces of a cell, or of all its convex pieces after mirroring."""

    width: Rough
    fall: Rough  # level minus the mean of U at both ends
    turn: Rough  # rate minus U' at the right end
    lift: Rough  # the maximum is at most rate^2 (lift + swell rate^2) above level
    swell: Rough


class GravityConstants(eqx.Module):
    """Constants of a cell with gravity that all its flights share."""

    gamma: Lane
    turn: Lane  # the acceleration is zero at the phases turn and 2 - turn
    concave: Shape
    convex: Shape


def gravity_constants(gamma: Lane) -> GravityConstants:
    """Return the constants of a cell that all its flights with gravity share.

    For |gamma| > 1 the acceleration keeps its sign, and half of the pieces are empty.

    Bound of a maximum: at a maximum y, rate = slope y + sin y. This is an odd function of y, and the power series of
    its inverse has no negative terms. The maximum exceeds level by the integral of the inverse over the rate, which is
    rate^2 times a power series in rate^2 without negative terms. The series is convex, so it lies below the straight
    line in rate^2 that agrees with it at rate = 0 and at the end of the piece.
    """
    turn = jnp.arccos(jnp.clip(gamma, -1.0, 1.0)) * (1 / PI)
    return GravityConstants(gamma, turn, _shape(gamma, 1 - turn), _shape(-gamma, turn))


def _shape(slope: Lane, half_turns: Lane) -> Shape:
    width = PI * half_turns
    turn = slope * width + jnp.sin(width)
    fall = 0.5 * slope * width * width + 1 - jnp.cos(width)
    lift = 0.5 / (1 + slope)
    # For an empty piece these are NaN, and every comparison with them is false.
    swell = (width / turn - fall / (turn * turn) - lift) / (turn * turn)
    return Shape(*single((width, fall, turn, lift, swell)))


class _Course(NamedTuple):
    """Flight in the frame where its first piece is concave: U = C + D x - g x^2/2 + cos y, x = y - begin."""

    place: Lane  # C
    drift: Lane  # D
    slope: Lane  # g
    begin: Lane  # y at the start
    half: Lane


class _Motion(NamedTuple):
    """Coefficients of the motion on a piece."""

    level: Lane
    rate: Lane
    slope: Lane


class _Point(NamedTuple):
    """A point of a piece: y, the signed distance from a wall, and U' there."""

    y: Rough
    f: Rough
    v: Rough


def _about(course: _Course, odd: Flags, begin: Lane) -> _Motion:
    """Return the motion about the centre of a piece. The flight starts at y = `begin`; where `odd`, U is mirrored."""
    place, drift, slope = (jnp.where(odd, -x, x) for x in (course.place, course.drift, course.slope))
    return _Motion(place + 1 - begin * (drift + 0.5 * slope * begin), drift + slope * begin, slope)


def _derivatives(motion: _Motion, y: Lane) -> tuple[Lane, Lane, Lane, Lane, Lane]:
    """Return U and its first four derivatives at y."""
    sine, cosine = reflected(y)
    u = motion.level + y * (motion.rate - 0.5 * motion.slope * y) - (1 - cosine)
    return u, motion.rate - motion.slope * y - sine, -(motion.slope + cosine), sine, cosine


# Kinds of a piece: no crossing, its end beyond a wall, or possibly a maximum beyond the upper wall.
_NONE, _UP, _DOWN, _PEAK, _PEAK_OR_DOWN = 0.0, 1.0, 2.0, 3.0, 4.0


def _end(motion: _Motion, shape: Shape) -> tuple[Rough, Rough]:
    """Return U and U' at the right end of a piece."""
    return motion.level - shape.fall + shape.width * motion.rate, motion.rate - shape.turn


@materialised
def _kind(motion: _Motion, shape: Shape, speed: Rough, near: Rough) -> Rough:
    """Return the kind of a piece that begins with U' = speed; U within rounding of a wall may count as beyond the wall.

    This is safe: if the crossing does not exist, the iteration finds no root on the piece, and the lane is declined.
    """
    end, end_v = _end(motion, shape)
    square = motion.rate * motion.rate
    # Upper bound of the maximum on the piece.
    top = motion.level + square * (shape.lift + shape.swell * square)
    peak = (speed > 0) & (end_v < 0) & (top > near)
    down = end < -near
    kind = jnp.where(peak, jnp.where(down, _PEAK_OR_DOWN, _PEAK), jnp.where(down, _DOWN, _NONE))
    return jnp.where(end > near, _UP, kind).astype(jnp.float32)


@materialised
def _next(motion: _Motion, shape: Shape, after: Shape) -> _Motion:
    """Return the motion on the next piece, which is mirrored: its -U and -U' at the start continue U and U'."""
    end, end_v = _end(motion, shape)
    rate = -(end_v + after.turn)
    return _Motion(after.fall + after.width * rate - end, rate, -motion.slope)


@materialised
def _summit(motion: _Motion, shape: Shape, near: Rough, far: Rough) -> Rough:
    """Return 1 if the maximum of U on a piece is above `far`, -1 if it is below `near`, and 0 if undecided.

    One Householder step and Taylor polynomials about its end locate the maximum.
    """
    motion = materialise(motion._replace(rate=jnp.abs(motion.rate)))
    square = motion.rate * motion.rate
    y = materialise(jnp.minimum(motion.rate * (2 * shape.lift + 4 * shape.swell * square), shape.width))
    u, v, bend, third, fourth = _derivatives(motion, y)
    step = materialise(householder(v, bend, third, fourth))
    u = u + step * (v + step * (0.5 * bend + step * ((1 / 6) * third + step * (1 / 24) * fourth)))
    v = v + step * (bend + step * (0.5 * third + step * (1 / 6) * fourth))
    square = step * step
    # A concave function lies below its tangent. The remainder of both polynomials is less than step^4.
    more = (jnp.abs(v) + square * square) * shape.width
    return jnp.where(u - square * square > far, 1.0, jnp.where(u + more < near, -1.0, 0.0)).astype(jnp.float32)


@materialised
def _find_piece(course: _Course, gravity: GravityConstants, flip: Rough, speed: Rough) -> Rough:
    """Return the number of the piece with the first crossing, from 1.

    The number is negative if the crossing is at the lower wall, and 0 if the piece is not determined. U at the ends of
    the pieces, and at most one maximum of U, determine the piece.
    """
    # Bound of the rounding error of U on all pieces.
    reach = _PIECES * PI
    size = course.half + jnp.abs(course.place) + reach * (jnp.abs(course.drift) + 0.5 * reach * jnp.abs(course.slope))
    margin = materialise(_NEAR * float(jnp.finfo(size.dtype).eps) * size)
    near, far = course.half - margin, course.half + margin
    even = select(flip > 0, gravity.concave, gravity.convex)
    odd = select(flip > 0, gravity.convex, gravity.concave)
    first_piece = materialise(_about(course, jnp.zeros_like(flip, bool), course.begin))
    second_piece = _next(first_piece, even, odd)
    third_piece = _next(second_piece, odd, even)
    first = _kind(first_piece, even, speed, near)
    second = _kind(second_piece, odd, second_piece.rate + odd.turn, near)
    third = _kind(third_piece, even, third_piece.rate + even.turn, near)
    at_first, at_second = first != _NONE, second != _NONE
    number = jnp.where(at_first, 1.0, jnp.where(at_second, 2.0, 3.0))
    kind = jnp.where(at_first, first, jnp.where(at_second, second, third))
    motion = select(at_first, first_piece, select(at_second, second_piece, third_piece))
    summit = _summit(motion, select(number == 2, odd, even), near, far)
    maybe_peak = (kind == _PEAK) | (kind == _PEAK_OR_DOWN)
    # If the maximum is not beyond the wall, the flight continues.
    continues = (kind == _PEAK) & (summit < 0)
    second_next = at_first & at_second
    after = jnp.where(number == 3, _NONE, jnp.where(second_next, second, third))
    up = (kind == _UP) | (maybe_peak & (summit > 0)) | (continues & (after == _UP))
    down = (kind == _DOWN) | ((kind == _PEAK_OR_DOWN) & (summit < 0)) | (continues & (after == _DOWN))
    number = jnp.where(continues, jnp.where(second_next, 2.0, 3.0), number)
    return jnp.where(up, number, jnp.where(down, -number, 0.0)).astype(jnp.float32)


@materialised
def _guess(begin: _Point, slope: Rough, wall: Rough, width: Rough) -> Rough:
    """Return an initial value for the zero of f: the zero of a parabola that is tangent to f at the left end.

    Its curvature is the curvature of f a little to the right.
    """
    # At a twelfth of the piece; this fraction leaves the fewest flights without a root.
    further = begin.y + (1 / 12) * (width - begin.y)
    square = further * further
    cosine = 1 - square * (1 / 2 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320))))
    bend = slope + cosine
    root = jnp.sqrt(jnp.maximum(begin.v * begin.v + 2 * bend * begin.f, 0.0))
    towards_wall = wall * begin.v > 0
    # Two forms of the quadratic formula; each is free of cancellation for its sign of U'.
    y = jnp.where(towards_wall, -2 * begin.f, begin.v - wall * root) / jnp.where(
        towards_wall, begin.v + wall * root, bend
    )
    return begin.y + jnp.clip(y, 0, width - begin.y)


class _Root(NamedTuple):
    """A crossing: y, its sine and cosine, and whether the iteration has converged to rounding."""

    y: Lane
    sine: Lane
    cosine: Lane
    converged: Flags


def _root(goal: _Motion, guess: Rough, width: Rough) -> _Root:
    """Return the zero of U: Householder steps, the last one in double precision and corrected on its Taylor polynomial.

    The correction is a Newton step without another sine; it squares the remaining error. It saves one iteration, and it
    locates slow crossings, which the iterations in single precision do not resolve.
    """
    rough, y = single(goal), guess
    for _ in range(_ROUNDS):
        *f, _ = _derivatives(rough, y)
        y = materialise(jnp.clip(y + householder(*f), -width, width))
    y = materialise(y.astype(goal.level.dtype))
    f, f1, f2, f3, f4 = materialise(_derivatives(goal, y))
    step = materialise(householder(f, f1, f2, f3))
    more = materialise(correction(step, (f, f1, f2, f3, f4, -f3)))
    step = step + more
    square = step * step
    turn_sine, turn_cosine = step * (1 - square * (1 / 6)), 1 - square * (0.5 - square * (1 / 24))
    sine, cosine = f3 * turn_cosine + f4 * turn_sine, f4 * turn_cosine - f3 * turn_sine
    # The error after Newton's step is more^2 f2/f1. The rounding error of the place over the speed is eps f2/f1.
    eps = float(jnp.finfo(y.dtype).eps)
    return _Root(y + step, sine, cosine, (jnp.abs(more) < 0.1 * eps**0.5) & (jnp.abs(step) < _STEP))


@materialised
def fast_gravity_flight(half: Lane, gravity: GravityConstants, lane: BallState) -> Flight:
    """Return the first wall crossing with gravity: select its piece by the pieces' ends, then solve for one root."""
    t = lane.t
    # The acceleration is positive, so u is convex, for t < turn and for t > 2 - turn.
    late = t >= 2 - gravity.turn
    convex = (t < gravity.turn) | late
    centre = jnp.where(convex, jnp.where(late, 2.0, 0.0), 1.0).astype(t.dtype)
    flip = jnp.where(convex, -1.0, 1.0).astype(t.dtype)
    sine, cosine = phase(t)
    u, v = PI**2 * flip * lane.u, PI * flip * lane.v
    course = materialise(
        _Course(u + flip * cosine, v - flip * sine, flip * gravity.gamma, PI * (t - centre), PI**2 * half)
    )
    piece = _find_piece(single(course), gravity, *single((flip, v)))
    number = jnp.abs(piece)
    odd, rough_wall = number == 2, jnp.where(piece < 0, -1.0, 1.0).astype(jnp.float32)
    wall = rough_wall.astype(t.dtype)
    centre_time = centre + (number.astype(t.dtype) - 1) - t
    motion = _about(course, odd, -PI * centre_time)
    goal = materialise(motion._replace(level=motion.level - wall * course.half))
    shape = select(odd ^ convex, gravity.convex, gravity.concave)
    rough, width = single(goal), shape.width
    start = _Point(*single((course.begin, u - wall * course.half, v)))
    end = _Point(-width, rough.level - shape.fall - width * rough.rate, rough.rate + shape.turn)
    root = _root(goal, _guess(materialise(select(number == 1, start, end)), rough.slope, rough_wall, width), width)
    speed = wall * (goal.rate - goal.slope * root.y - root.sine) * (1 / PI)
    elapsed = centre_time + root.y * (1 / PI)
    # A short flight loses its leading digits in the difference of phases.
    certified = (
        root.converged & (piece != 0) & (jnp.abs(root.y) < width.astype(t.dtype)) & (speed > 0) & (elapsed > 1 / 256)
    )
    return Flight(
        elapsed,
        speed,
        flip=jnp.where(odd, -flip, flip),
        wall=wall,
        sine=wall * root.cosine,
        cosine=-wall * root.sine,
        certified=certified & (lane.v != 0),
        escapes=jnp.zeros_like(certified),
    )
