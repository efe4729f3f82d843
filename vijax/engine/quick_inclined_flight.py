"""The quick flight with gravity: the first wall crossing, in straight-line arithmetic, certified or declined.

A flight is parted where its acceleration cos(pi t) - gamma is zero, at two phases that are constants of the cell. On a
piece u' is monotone, so u is concave, or convex and then mirrored. In units of 1/pi^2, by the angle y since the piece's
centre, where t is whole, every piece reads

    U(y) = level + rate y - slope y^2/2 - (1 - cos y),    |y| < width,

with slope gamma or -gamma. Its ends need no sine of the flight. A concave U that ends beyond the upper wall crosses it
once; else it does so if its maximum is beyond; else it crosses the lower wall once if it ends beyond that. A zero of
U - wall with U' towards the wall is that crossing, there being no other, so what finds it needs no proof.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32

from vijax.engine.impact import Ball, Lane
from vijax.engine.polynomial import phase
from vijax.engine.quick_flight import Flight, reflected
from vijax.engine.roots import correction, householder, single
from vijax.model.flow import PI
from vijax.runtime.arrays import choose
from vijax.runtime.xla import share, shared

_PIECES = 3  # a flight that is not over after so many is declined: one of a thousand at gamma 0.1, of 200 at 0
_ROUNDS = 2  # so many run in single precision, before the one in double
_NEAR = 8  # roundings within which an end or a maximum may be on either side of a wall
_STEP = 2e-3  # longest last step: the Taylor polynomial of fifth order leaves out 1e-19 of it

Flags = Bool[Array, "lane"]
Rough = Float32[Array, "lane"]


class Shape(eqx.Module):
    """What all concave, or all convex, pieces of a cell have in common; the latter mirrored."""

    width: Rough
    fall: Rough  # level less the mean of U at both ends
    turn: Rough  # rate less U' at the right end
    lift: Rough  # the maximum is at most rate^2 (lift + swell rate^2) above level
    swell: Rough


class Incline(eqx.Module):
    """What the flights of a cell need of its gravity and no impact changes."""

    gamma: Lane
    turn: Lane  # the acceleration is zero at the phases turn and 2 - turn
    concave: Shape
    convex: Shape


def incline(gamma: Lane) -> Incline:
    """Compute constants of flights; beyond |gamma| = 1 the acceleration keeps its sign, and half the pieces are empty.

    U' = 0 at y has rate = slope y + sin y, an odd function whose inverse has a power series without negative terms, and
    the maximum, the integral of this inverse, is above level by rate^2 times a series in rate^2 that grows faster than
    its first term: below the line in rate^2 that meets it at the end of the piece.
    """
    turn = jnp.arccos(jnp.clip(gamma, -1.0, 1.0)) * (1 / PI)
    return Incline(gamma, turn, _shape(gamma, 1 - turn), _shape(-gamma, turn))


def _shape(slope: Lane, half_turns: Lane) -> Shape:
    width = PI * half_turns
    turn = slope * width + jnp.sin(width)
    fall = 0.5 * slope * width * width + 1 - jnp.cos(width)
    lift = 0.5 / (1 + slope)
    # Of an empty piece these are NaN, and no comparison with them is true.
    swell = (width / turn - fall / (turn * turn) - lift) / (turn * turn)
    return Shape(*single((width, fall, turn, lift, swell)))


class _Course(NamedTuple):
    """A flight where the piece it begins on is concave: U = C + D x - g x^2/2 + cos y, x the angle since the start."""

    place: Lane  # C
    drift: Lane  # D
    slope: Lane  # g
    begin: Lane  # y of the start
    half: Lane


class _Motion(NamedTuple):
    """The motion on a piece."""

    level: Lane
    rate: Lane
    slope: Lane


class _Point(NamedTuple):
    """A point of a piece: y, the distance from a wall, U' there."""

    y: Rough
    f: Rough
    v: Rough


def _about(course: _Course, odd: Flags, begin: Lane) -> _Motion:
    """Find the motion about the centre of a piece, the start of the flight at y = `begin`; odd ones are mirrored."""
    place, drift, slope = (jnp.where(odd, -x, x) for x in (course.place, course.drift, course.slope))
    return _Motion(place + 1 - begin * (drift + 0.5 * slope * begin), drift + slope * begin, slope)


def _derivatives(motion: _Motion, y: Lane) -> tuple[Lane, Lane, Lane, Lane, Lane]:
    """Compute U and its derivatives at y, five in all."""
    sine, cosine = reflected(y)
    u = motion.level + y * (motion.rate - 0.5 * motion.slope * y) - (1 - cosine)
    return u, motion.rate - motion.slope * y - sine, -(motion.slope + cosine), sine, cosine


# What is known of a piece: nothing happens, it ends beyond a wall, or it may have a maximum beyond the upper wall.
_NONE, _UP, _DOWN, _PEAK, _PEAK_OR_DOWN = 0.0, 1.0, 2.0, 3.0, 4.0


def _end(motion: _Motion, shape: Shape) -> tuple[Rough, Rough]:
    """Compute U and U' at the right end of a piece."""
    return motion.level - shape.fall + shape.width * motion.rate, motion.rate - shape.turn


@shared
def _kind(motion: _Motion, shape: Shape, speed: Rough, near: Rough) -> Rough:
    """Tell what is known of a piece that begins with U' = speed, where U within rounding of a wall may be beyond it.

    A crossing that is taken for certain and does not exist has no root on the piece.
    """
    end, end_v = _end(motion, shape)
    square = motion.rate * motion.rate
    top = motion.level + square * (shape.lift + shape.swell * square)
    peak = (speed > 0) & (end_v < 0) & (top > near)
    down = end < -near
    kind = jnp.where(peak, jnp.where(down, _PEAK_OR_DOWN, _PEAK), jnp.where(down, _DOWN, _NONE))
    return jnp.where(end > near, _UP, kind).astype(jnp.float32)


@shared
def _next(motion: _Motion, shape: Shape, after: Shape) -> _Motion:
    """Find the motion on the piece after one, mirrored: where that ends -U and -U' are those of this one."""
    end, end_v = _end(motion, shape)
    rate = -(end_v + after.turn)
    return _Motion(after.fall + after.width * rate - end, rate, -motion.slope)


@shared
def _summit(motion: _Motion, shape: Shape, near: Rough, far: Rough) -> Rough:
    """Say 1 where a maximum is beyond `far`, -1 where it is not beyond `near`: by Taylor polynomials after one step."""
    motion = share(motion._replace(rate=jnp.abs(motion.rate)))
    square = motion.rate * motion.rate
    y = share(jnp.minimum(motion.rate * (2 * shape.lift + 4 * shape.swell * square), shape.width))
    u, v, bend, third, fourth = _derivatives(motion, y)
    step = share(householder(v, bend, third, fourth))
    u = u + step * (v + step * (0.5 * bend + step * ((1 / 6) * third + step * (1 / 24) * fourth)))
    v = v + step * (bend + step * (0.5 * third + step * (1 / 6) * fourth))
    square = step * step
    # A concave function is below its tangent. What both polynomials leave out is less than step^4.
    more = (jnp.abs(v) + square * square) * shape.width
    return jnp.where(u - square * square > far, 1.0, jnp.where(u + more < near, -1.0, 0.0)).astype(jnp.float32)


@shared
def _find(course: _Course, incline: Incline, flip: Rough, speed: Rough) -> Rough:
    """Find the piece on which the flight meets a wall: its number from 1, negative for the lower wall; 0: unknown.

    By the ends of the pieces, and by one maximum at most.
    """
    # What rounding can do to U on all of the pieces.
    reach = _PIECES * PI
    size = course.half + jnp.abs(course.place) + reach * (jnp.abs(course.drift) + 0.5 * reach * jnp.abs(course.slope))
    margin = share(_NEAR * float(jnp.finfo(size.dtype).eps) * size)
    near, far = course.half - margin, course.half + margin
    even = choose(flip > 0, incline.concave, incline.convex)
    odd = choose(flip > 0, incline.convex, incline.concave)
    one = share(_about(course, jnp.zeros_like(flip, bool), course.begin))
    two = _next(one, even, odd)
    three = _next(two, odd, even)
    first = _kind(one, even, speed, near)
    second = _kind(two, odd, two.rate + odd.turn, near)
    third = _kind(three, even, three.rate + even.turn, near)
    at_first, at_second = first != _NONE, second != _NONE
    number = jnp.where(at_first, 1.0, jnp.where(at_second, 2.0, 3.0))
    kind = jnp.where(at_first, first, jnp.where(at_second, second, third))
    motion = choose(at_first, one, choose(at_second, two, three))
    summit = _summit(motion, choose(number == 2, odd, even), near, far)
    unsure = (kind == _PEAK) | (kind == _PEAK_OR_DOWN)
    # Where the maximum is not beyond the wall the flight goes on.
    on = (kind == _PEAK) & (summit < 0)
    second_next = at_first & at_second
    after = jnp.where(number == 3, _NONE, jnp.where(second_next, second, third))
    up = (kind == _UP) | (unsure & (summit > 0)) | (on & (after == _UP))
    down = (kind == _DOWN) | ((kind == _PEAK_OR_DOWN) & (summit < 0)) | (on & (after == _DOWN))
    number = jnp.where(on, jnp.where(second_next, 2.0, 3.0), number)
    return jnp.where(up, number, jnp.where(down, -number, 0.0)).astype(jnp.float32)


@shared
def _guess(left: _Point, slope: Rough, wall: Rough, width: Rough) -> Rough:
    """Guess where f is 0: by the parabola that touches it on the left, as bent as f is a little further on."""
    # Of all shares of the way a quarter leaves the fewest flights without a root.
    further = left.y + (1 / 12) * (width - left.y)
    square = further * further
    cosine = 1 - square * (1 / 2 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320))))
    bend = slope + cosine
    root = jnp.sqrt(jnp.maximum(left.v * left.v + 2 * bend * left.f, 0.0))
    ahead = wall * left.v > 0
    y = jnp.where(ahead, -2 * left.f, left.v - wall * root) / jnp.where(ahead, left.v + wall * root, bend)
    return left.y + jnp.clip(y, 0, width - left.y)


class _Root(NamedTuple):
    """A crossing: y, its sine and cosine, and whether the iteration has converged to rounding."""

    y: Lane
    sine: Lane
    cosine: Lane
    converged: Flags


def _root(goal: _Motion, guess: Rough, width: Rough) -> _Root:
    """Find the zero of U: Householder's steps, the last one in double precision and corrected on its Taylor polynomial.

    That correction is a Newton step without another sine. It squares what is left, which lets a round fewer do, and
    slow crossings, whose place single precision leaves open.
    """
    rough, y = single(goal), guess
    for _ in range(_ROUNDS):
        *f, _ = _derivatives(rough, y)
        y = share(jnp.clip(y + householder(*f), -width, width))
    y = share(y.astype(goal.level.dtype))
    f, f1, f2, f3, f4 = share(_derivatives(goal, y))
    step = share(householder(f, f1, f2, f3))
    more = share(correction(step, (f, f1, f2, f3, f4, -f3)))
    step = step + more
    square = step * step
    turn_sine, turn_cosine = step * (1 - square * (1 / 6)), 1 - square * (0.5 - square * (1 / 24))
    sine, cosine = f3 * turn_cosine + f4 * turn_sine, f4 * turn_cosine - f3 * turn_sine
    # What Newton leaves is more^2 times f2/f1, where eps times f2/f1 is the rounding of the place over the speed.
    eps = float(jnp.finfo(y.dtype).eps)
    return _Root(y + step, sine, cosine, (jnp.abs(more) < 0.1 * eps**0.5) & (jnp.abs(step) < _STEP))


@shared
def fly(half: Lane, incline: Incline, lane: Ball) -> Flight:
    """Find the first wall crossing with gravity: pick its piece by the ends of pieces, then find one root."""
    t = lane.t
    late = t >= 2 - incline.turn
    convex = (t < incline.turn) | late
    centre = jnp.where(convex, jnp.where(late, 2.0, 0.0), 1.0).astype(t.dtype)
    flip = jnp.where(convex, -1.0, 1.0).astype(t.dtype)
    sine, cosine = phase(t)
    u, v = PI**2 * flip * lane.u, PI * flip * lane.v
    course = share(_Course(u + flip * cosine, v - flip * sine, flip * incline.gamma, PI * (t - centre), PI**2 * half))
    found = _find(single(course), incline, *single((flip, v)))
    number = jnp.abs(found)
    odd, rough_wall = number == 2, jnp.where(found < 0, -1.0, 1.0).astype(jnp.float32)
    wall = rough_wall.astype(t.dtype)
    away = centre + (number.astype(t.dtype) - 1) - t
    motion = _about(course, odd, -PI * away)
    goal = share(motion._replace(level=motion.level - wall * course.half))
    shape = choose(odd ^ convex, incline.convex, incline.concave)
    rough, width = single(goal), shape.width
    begun = _Point(*single((course.begin, u - wall * course.half, v)))
    end = _Point(-width, rough.level - shape.fall - width * rough.rate, rough.rate + shape.turn)
    root = _root(goal, _guess(share(choose(number == 1, begun, end)), rough.slope, rough_wall, width), width)
    speed = wall * (goal.rate - goal.slope * root.y - root.sine) * (1 / PI)
    elapsed = away + root.y * (1 / PI)
    # A short hop loses its leading digits in the phases.
    sure = root.converged & (found != 0) & (jnp.abs(root.y) < width.astype(t.dtype)) & (speed > 0) & (elapsed > 1 / 256)
    return Flight(
        elapsed,
        speed,
        flip=jnp.where(odd, -flip, flip),
        wall=wall,
        sine=wall * root.cosine,
        cosine=-wall * root.sine,
        sure=sure & (lane.v != 0),
        never=jnp.zeros_like(sure),
    )
