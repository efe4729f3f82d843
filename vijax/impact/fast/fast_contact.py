"""Fast contact: one membrane contact in straight-line arithmetic, certified or declined.

The exit is the first zero of w. One or two Householder steps (order four) in single precision approach it, and one in
double precision ends the iteration. Certificates from `fast_crest` and `gravity_prolonged` ensure that the located zero
is the first one. In this folder the free contact is the contact without forcing and gravity; it lasts pi/omega1.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.fast.fast_contact_motion import (
    ContactCourse,
    ContactEntry,
    ContactState,
    Reference,
    at_reference,
    contact_state_at,
    course_at,
    entry_of,
    higher_derivatives,
    in_reach,
)
from vijax.impact.fast.fast_crest import deepest, rough_crest
from vijax.impact.fast.fast_flight import Flight
from vijax.impact.fast.fast_walls import SoftWall
from vijax.impact.fast.gravity_prolonged import gravity_prolonged_contact
from vijax.impact.impact import Lane
from vijax.impact.roots import converged_step, converges, correction, householder, single, taylor
from vijax.model.flow import PI
from vijax.runtime.arrays import not_none, select
from vijax.runtime.compilation.xla import materialise, materialised


class Exit(eqx.Module):
    """End of a contact: its duration s, the outward speed, sin and cos of omega1 s, and the decay exp(-zeta s)."""

    duration: Lane
    speed: Lane
    sine: Lane
    cosine: Lane
    decay: Lane
    drive: tuple[Lane, Lane] | None  # sin and cos of pi s, if the work is requested


class _Guess(eqx.Module):
    """Initial values for crest and exit of a short contact, which ends long before pi/omega1.

    Attributes:
        short: The contact is short. If False, the other fields are not used.
        hop: Approximate time from the onset to the exit.
        rise: Approximate time from the onset to the crest.
    """

    short: Bool[Array, " lane"]
    hop: Lane
    rise: Lane


@materialised
def _guess(wall: SoftWall, entry: ContactEntry) -> _Guess:
    """Return initial values from the cubic Taylor polynomial at the onset.

    With gravity, a Newton step on the Taylor polynomial of degree six follows.
    """
    speed, square = entry.speed, wall.kappa * wall.kappa
    push = entry.force - 2 * wall.zeta * speed
    jerk = -PI * entry.force_sin - 2 * wall.zeta * push - square * speed
    # Discriminant of the quadratic equation w/s = 0, where w is the cubic Taylor polynomial.
    bend = 0.25 * push * push - (2 / 3) * jerk * speed
    # Smallest positive root of v + push s/2 + jerk s^2/6, written without cancellation.
    hop = 2 * speed / (jnp.sqrt(jnp.maximum(bend, 0.0)) - 0.5 * push)
    short = (bend > 0) & (hop > 0) & (hop < wall.hop)
    # Smallest positive root of w' = v + push s + jerk s^2/2.
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


@materialised
def fast_contact(
    wall: SoftWall, flight: Flight, deep: bool, work: bool, begins: Lane
) -> tuple[Exit, Lane | None, Bool[Array, " lane"]]:
    """Return the exit, the largest depth if `deep`, and whether the contact is certified.

    In a certified contact, w rises once and then falls until the exit, or the contact is certified by
    `gravity_prolonged`. The iteration for the exit starts at one of three times:

    - pi/omega1, the end of the free contact (the contact without forcing). At this time exp(-zeta s) = r by
      calibration of zeta, so no function has to be evaluated.
    - For a slow entry against the forcing, the root of the cubic Taylor polynomial, about half of pi/omega1.
    - For a contact that gravity prolongs until the forcing lifts the ball off, about the time when the membrane's
      steady response to gravity and forcing returns to zero.

    Args:
        wall, flight: Wall, and the flight that ends there.
        deep: If True, compute the depth.
        work: If True, compute `Exit.drive`, which the work needs.
        begins: Phase of the forcing towards the wall at the onset.
    """
    eps = jnp.finfo(wall.half.dtype).eps
    entry = entry_of(wall, flight)
    rough_wall, rough_entry = single((replace(wall, gravity=None), entry))
    guess = _guess(rough_wall, rough_entry)
    reference = free_reference(wall, guess.short)
    prolonged = None
    if wall.steady_exit is not None:
        prolonged, late_reference = gravity_prolonged_contact(wall, entry, (rough_wall, rough_entry), begins)
        reference = materialise(select(prolonged.outlasts_free, late_reference, reference))
        guess = replace(guess, short=guess.short & ~prolonged.outlasts_free)
    course = materialise(course_at(entry, reference))
    s, reached = _rough_exit(rough_wall, rough_entry, guess, single(course))
    s = materialise(s.astype(entry.speed.dtype))
    at = materialise(contact_state_at(wall, course, s))
    step = materialise(householder(entry.penetration(at), at.rate, at.push, at.jerk))
    out = -(at.rate + step * (at.push + step * (0.5 * at.jerk + step * (1 / 6) * higher_derivatives(wall, at)[0])))
    duration = reference.s + s + step
    # The iteration is of fourth order, so the size of the last step bounds the error. If omega1 s at the exit is below
    # 0.25, the closed form loses two digits, so such a contact is declined.
    converged = reached & converges(step, wall.omega1, at.rate, at.push, converged_step(eps))
    converged = converged & (wall.omega1 * duration > 0.25)
    crest = rough_crest(
        rough_wall, rough_entry, (guess.short, guess.rise), single((duration, at.drive, at.force)), deep
    )
    is_first = crest.first & crest.only
    if prolonged is not None:
        late_is_first = prolonged.is_first_zero(*single((duration, out)))
        is_first = jnp.where(
            prolonged.outlasts_free,
            late_is_first & crest.first & not_none(crest.highest) if deep else late_is_first,
            is_first,
        )
    depth, exact = deepest(wall, entry, crest) if deep else (None, jnp.ones_like(is_first))
    is_first = is_first & exact
    certified = wall.certifiable & converged & (out > 0) & is_first
    turn = wall.omega1 * step
    twist = turn * turn
    turn_sine, turn_cosine = turn * (1 - twist * (1 / 6)), 1 - twist * (0.5 - twist * (1 / 24))
    sine, cosine = at.sine * turn_cosine + at.cosine * turn_sine, at.cosine * turn_cosine - at.sine * turn_sine
    # `sine` and `cosine` are relative to the reference of the course; rotate them to the onset.
    turned_sine = sine * reference.cosine + cosine * reference.sine
    turned_cosine = cosine * reference.cosine - sine * reference.sine
    angle = wall.zeta * step
    decay = at.decay * (1 - angle * (1 - angle * (0.5 - angle * (1 / 6))))
    drive = _turned(entry, at, PI * step) if work else None
    return Exit(duration, out, turned_sine, turned_cosine, decay, drive), depth, certified


def free_reference(wall: SoftWall, short: Bool[Array, " lane"]) -> Reference:
    """Return the reference time of the exit search: the end of the free contact, or half this time for short contacts.

    Sine, cosine and decay at these two times are constants of the wall. The free contact is a contact without forcing.
    """
    none = jnp.zeros_like(wall.span)
    # At half the span omega1 s = pi/2 and the decay is sqrt(r). At the span omega1 s = pi and the decay is r.
    middle = Reference(0.5 * wall.span, wall.cos_middle, wall.sin_middle, none, none + 1, wall.root_r)
    far = Reference(wall.span, wall.cos_span, wall.sin_span, none - 1, none, wall.r)
    return select(short, middle, far)


def _turned(entry: ContactEntry, at: ContactState, turn: Lane) -> tuple[Lane, Lane]:
    """Return sin and cos of the forcing's phase change since the onset, a small angle `turn` after the state `at`."""
    square = turn * turn
    sine, cosine = turn * (1 - square * (1 / 6)), 1 - 0.5 * square
    # at.force and `ahead` are the cosine and the sine of the forcing's phase at `at`.
    ahead = at.drive * (-1 / PI)
    force_cos, force_sin = at.force * cosine - ahead * sine, ahead * cosine + at.force * sine
    return (
        force_sin * entry.force_cos - force_cos * entry.force_sin,
        force_cos * entry.force_cos + force_sin * entry.force_sin,
    )


@materialised
def _rough_exit(
    wall: SoftWall, entry: ContactEntry, guess: _Guess, course: ContactCourse
) -> tuple[Lane, Bool[Array, " lane"]]:
    """Return the exit time in single precision, and whether all arguments of the polynomials were within their range.

    The time is relative to the reference of the course.

    One Householder step starts at the reference, and a second one at the end of the first. A Newton step on the Taylor
    polynomial then corrects the second step without another sine. In the regime of strong gravity two such corrections
    follow, because one is not accurate enough for contacts that end slowly.
    """
    free = at_reference(wall, course)
    near = guess.hop - 0.5 * wall.span
    s = materialise(jnp.where(guess.short, near, householder(entry.penetration(free), free.rate, free.push, free.jerk)))
    reached = in_reach(wall, s)
    at = materialise(contact_state_at(wall, course, jnp.where(reached, s, 0.0)))
    derivatives = entry.penetration(at), at.rate, at.push, at.jerk, *higher_derivatives(wall, at)
    step = materialise(householder(*derivatives[:4]))
    for _ in range(1 if wall.steady_exit is None else 2):
        step = step + correction(step, derivatives)
    s = materialise(s + step)
    reached = reached & in_reach(wall, s)
    return jnp.where(reached, s, 0.0), reached
