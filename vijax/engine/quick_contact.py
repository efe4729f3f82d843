"""The quick contact: one membrane contact in straight-line arithmetic, certified or declined."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.impact import Lane
from vijax.engine.quick_course import (
    ContactCourse,
    ContactEntry,
    ContactState,
    Reference,
    at_reference,
    course_at,
    entry_of,
    further,
    in_reach,
    motion,
)
from vijax.engine.quick_crest import deepest, rough_crest
from vijax.engine.quick_flight import Flight
from vijax.engine.quick_hold import prolonged
from vijax.engine.quick_wall import SoftWall
from vijax.engine.roots import converged_step, converges, correction, householder, single, taylor
from vijax.model.flow import PI
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share, shared


class Exit(eqx.Module):
    """The end of a contact: duration and outward speed; sin, cos of omega1 s and exp(-zeta s) there."""

    duration: Lane
    speed: Lane
    sine: Lane
    cosine: Lane
    decay: Lane
    drive: tuple[Lane, Lane] | None  # Sin, cos of pi s, where the work is asked for.


class _Guess(eqx.Module):
    """Where to look for crest and exit of a contact that ends long before pi/omega1."""

    short: Bool[Array, " lane"]
    hop: Lane
    rise: Lane


@shared
def _guess(wall: SoftWall, entry: ContactEntry) -> _Guess:
    """Guess from the cubic Taylor polynomial at the onset; with gravity a Newton step on that of degree six follows."""
    speed, square = entry.speed, wall.kappa * wall.kappa
    push = entry.force - 2 * wall.zeta * speed
    jerk = -PI * entry.force_sin - 2 * wall.zeta * push - square * speed
    bend = 0.25 * push * push - (2 / 3) * jerk * speed
    hop = 2 * speed / (jnp.sqrt(jnp.maximum(bend, 0.0)) - 0.5 * push)
    short = (bend > 0) & (hop > 0) & (hop < wall.hop)
    rise = 2 * speed / (jnp.sqrt(jnp.maximum(push * push - 2 * jerk * speed, 0.0)) - push)
    if entry.pressure is None:
        return _Guess(short, hop, rise)
    snap = -(PI**2) * entry.force_cos - 2 * wall.zeta * jerk - square * push
    fifth = PI**3 * entry.force_sin - 2 * wall.zeta * snap - square * jerk
    sixth = PI**4 * entry.force_cos - 2 * wall.zeta * fifth - square * snap
    derivatives = (speed, push, jerk, snap, fifth, sixth)
    value = taylor(derivatives, 1, hop) * hop
    slope = taylor(derivatives, 0, hop)
    hop = jnp.where(slope < 0, hop - value / slope, hop)
    return _Guess(short, hop, rise + correction(rise, derivatives))


@shared
def touch(
    wall: SoftWall, flight: Flight, deep: bool, work: bool, begins: Lane
) -> tuple[Exit, Lane | None, Bool[Array, " lane"]]:
    """Find the exit, the greatest depth if asked for, and whether w rises once and falls once until then for certain.

    The exit is sought from pi/omega1, where the free contact ends and exp(-zeta pi/omega1) = r by calibration, so that
    nothing has to be evaluated there; that of a slow entry against the forcing, from the root of its cubic Taylor
    polynomial, about half of pi/omega1. Where gravity holds the ball on the wall until the forcing takes it off, about
    when the membrane without its swing would come back.

    Args:
        wall, flight: Those that meet.
        deep: Whether the depth is asked for.
        work: Whether `Exit.drive` is, of which the work is made.
        begins: Phase of the forcing towards the wall at the onset.
    """
    eps = jnp.finfo(wall.half.dtype).eps
    entry = entry_of(wall, flight)
    rough, begun = single((replace(wall, incline=None), entry))
    guess = _guess(rough, begun)
    reference = free_reference(wall, guess.short)
    lasting = None
    if wall.ebb is not None:
        lasting, late = prolonged(wall, entry, (rough, begun), begins)
        reference = share(choose(lasting.long, late, reference))
        guess = replace(guess, short=guess.short & ~lasting.long)
    course = share(course_at(entry, reference))
    s, reached = _rough_exit(rough, begun, guess, single(course))
    s = share(s.astype(entry.speed.dtype))
    at = share(motion(wall, course, s))
    step = share(householder(entry.penetration(at), at.rate, at.push, at.jerk))
    out = -(at.rate + step * (at.push + step * (0.5 * at.jerk + step * (1 / 6) * further(wall, at)[0])))
    duration = reference.s + s + step
    # The iteration is of fourth order; and in a shorter contact the closed form has lost two digits.
    converged = reached & converges(step, wall.omega1, at.rate, at.push, converged_step(eps))
    converged = converged & (wall.omega1 * duration > 0.25)
    crest = rough_crest(rough, begun, (guess.short, guess.rise), single((duration, at.drive, at.force)), deep)
    certain = crest.first & crest.only
    if lasting is not None:
        last = lasting.ends(*single((duration, out)))
        certain = jnp.where(lasting.long, last & crest.first & present(crest.highest) if deep else last, certain)
    depth, exact = deepest(wall, entry, crest) if deep else (None, jnp.ones_like(certain))
    certain = certain & exact
    sure = wall.usable & converged & (out > 0) & certain
    turn = wall.omega1 * step
    twist = turn * turn
    turn_sine, turn_cosine = turn * (1 - twist * (1 / 6)), 1 - twist * (0.5 - twist * (1 / 24))
    sine, cosine = at.sine * turn_cosine + at.cosine * turn_sine, at.cosine * turn_cosine - at.sine * turn_sine
    # So far they count from the course's reference.
    turned_sine = sine * reference.cosine + cosine * reference.sine
    turned_cosine = cosine * reference.cosine - sine * reference.sine
    rot = wall.zeta * step
    decay = at.decay * (1 - rot * (1 - rot * (0.5 - rot * (1 / 6))))
    drive = _turned(entry, at, PI * step) if work else None
    return Exit(duration, out, turned_sine, turned_cosine, decay, drive), depth, sure


def free_reference(wall: SoftWall, short: Bool[Array, " lane"]) -> Reference:
    """Describe where the free contact ends, or its half where the contact is short: no sine is needed there."""
    none = jnp.zeros_like(wall.span)
    middle = Reference(0.5 * wall.span, wall.cos_middle, wall.sin_middle, none, none + 1, wall.root_r)
    far = Reference(wall.span, wall.cos_span, wall.sin_span, none - 1, none, wall.r)
    return choose(short, middle, far)


def _turned(entry: ContactEntry, at: ContactState, turn: Lane) -> tuple[Lane, Lane]:
    """Compute sin and cos of what the forcing has turned since the onset, a small turn further than at `at`."""
    square = turn * turn
    sine, cosine = turn * (1 - square * (1 / 6)), 1 - 0.5 * square
    ahead = at.drive * (-1 / PI)
    force_cos, force_sin = at.force * cosine - ahead * sine, ahead * cosine + at.force * sine
    return (
        force_sin * entry.force_cos - force_cos * entry.force_sin,
        force_cos * entry.force_cos + force_sin * entry.force_sin,
    )


@shared
def _rough_exit(
    wall: SoftWall, entry: ContactEntry, guess: _Guess, course: ContactCourse
) -> tuple[Lane, Bool[Array, " lane"]]:
    """Find the exit from the course's reference in single precision, and whether the polynomials held on the way.

    One step from the reference, one from there. What that misses its Taylor polynomial tells, without another sine. On
    steep ground it tells twice: of contacts that end slowly the first answer is not close enough.
    """
    free = at_reference(wall, course)
    near = guess.hop - 0.5 * wall.span
    s = share(jnp.where(guess.short, near, householder(entry.penetration(free), free.rate, free.push, free.jerk)))
    reached = in_reach(wall, s)
    at = share(motion(wall, course, jnp.where(reached, s, 0.0)))
    derivatives = entry.penetration(at), at.rate, at.push, at.jerk, *further(wall, at)
    step = share(householder(*derivatives[:4]))
    for _ in range(1 if wall.ebb is None else 2):
        step = step + correction(step, derivatives)
    s = share(s + step)
    reached = reached & in_reach(wall, s)
    return jnp.where(reached, s, 0.0), reached
