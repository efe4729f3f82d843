"""The crest of a contact: when it is deepest, how deep, and whether w rises once until then and falls once after."""

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
    further,
    in_reach,
    motion,
)
from vijax.engine.quick_wall import DEEP_REACH, DOUBT, LONG_REACH, SoftWall
from vijax.engine.roots import converged_step, converges, correction, householder
from vijax.model.flow import PI
from vijax.runtime.xla import share, shared

# The step to the crest in single precision is this long at most, in parts of 1/omega1: its Taylor polynomials hold.
_STEP = 0.15
# The last step to the crest may be such a part of the last one to the exit: the depth is then off by three roundings at
# most. After a longer one its digits go, and with less more lanes are declined.
_CREST_STEP = 1 / 8


@shared
def _crest_course(wall: SoftWall, entry: ContactEntry) -> ContactCourse:
    """Rotate the contact to the free time of greatest depth: cos and sin of omega1 s are zeta/kappa, omega1/kappa."""
    cosine, sine = share((wall.zeta / wall.kappa, wall.omega1 / wall.kappa))
    return course_at(entry, Reference(wall.crest, wall.cos_crest, wall.sin_crest, cosine, sine, wall.crest_decay))


class FirstCrest(eqx.Module):
    """Where w' is zero for the first time, and what is certain of it."""

    s: Lane  # The time, counted from that of the free contact's crest.
    push: Lane  # w'' there,
    jerk: Lane  # and w'''.
    first: Bool[Array, " lane"]  # It is found, and w rises until then.
    only: Bool[Array, " lane"]  # w has no other extremum before the exit.
    highest: Bool[Array, " lane"] | None  # w does not come back to this height; None where that is not needed.


class _Place(eqx.Module):
    """A zero of w' in single precision: its time from the free contact's crest, and the contact there."""

    s: Lane
    w: Lane  # The penetration there, but for what gravity adds,
    force: Lane  # the periodic part of the forcing,
    push: Lane  # w'',
    jerk: Lane  # w''',
    drive: Lane  # and the derivative of the forcing.
    converged: Bool[Array, " lane"]


def _stays_below(wall: SoftWall, at: _Place) -> Bool[Array, " lane"]:
    """Say whether w stays below its first crest as long as its steady response S ebbs, however often it swings.

    Call w - S the swing, of the envelope a at the crest, where its rate is -S'. A time y later S has gained S' y at
    most, and M y^2/2 where it is not positive, so concave, all the while; the swing has gained -S' h(y) and lost
    kappa^2 H(y) of itself, H the integral of h. Both (y - h)/H and y^2/H rise, so that w is below the crest for half a
    free contact if it is at its end. From then on the swing falls until it is negative. Its next maximum is r^2 of the
    last, and that is a/(1 - c (tan f + c)) at most, c = zeta/omega1 and f the swing's phase at the crest; it is also
    below r a. The maximum after it, r^2 less, comes when three free contacts have passed. S is at most its amplitude,
    or where it falls what it was at the crest, or where it still rises then no more than it is then.
    """
    quadrature = -at.drive * (1 / PI)
    steady = wall.gain_in * at.force + wall.gain_out * quadrature
    across = wall.gain_out * at.force - wall.gain_in * quadrature
    rate = PI * across
    swing = at.w - steady
    swing_across = (wall.zeta * swing - rate) / wall.omega1
    envelope = jnp.sqrt(swing * swing + swing_across * swing_across)
    climb = jnp.where(rate > 0, jnp.sqrt(steady * steady + across * across) - steady, 0.0)
    later = steady * wall.cos_middle + across * wall.sin_middle
    concave = (steady > 0) & (later > 0)
    bend = jnp.where(concave, 0.0, PI**2 * (jnp.abs(wall.gain_in) + jnp.abs(wall.gain_out)))
    half, decay, tilt = share((0.5 * wall.span, wall.zeta / wall.omega1, jnp.abs(swing_across)))
    gained = jnp.maximum(rate, 0.0) * (half - wall.root_r / wall.omega1) + 0.5 * bend * half * half
    falls = (1 + DOUBT) * gained < swing * (1 - decay * wall.root_r)
    slip = decay * (tilt / swing + decay)
    share_left = jnp.where(slip < 1 - wall.r, wall.r * wall.r / (1 - slip), wall.r)
    next_one = jnp.maximum(share_left * envelope, wall.root_r * tilt)
    cosine = wall.cos_span * (4 * wall.cos_span * wall.cos_span - 3)
    sine = wall.sin_span * (3 - 4 * wall.sin_span * wall.sin_span)
    rising = (rate > 0) & (across * cosine - steady * sine > 0) & (3 * wall.span < 1)
    soon = jnp.where(rising, steady * (cosine - 1) + across * sine, climb)
    higher = jnp.maximum(soon + next_one, climb + wall.r * wall.r * next_one)
    return falls & (swing > (1 + DOUBT) * higher)


def _rough_place(wall: SoftWall, course: ContactCourse, hop: tuple[Bool[Array, " lane"], Lane], rounds: int) -> _Place:
    """Find where w' is zero, from the free contact's crest or that of a hop; 0 where the polynomials do not hold.

    As `quick_contact` finds the exit, in so many rounds; the contact at the crest is that of Taylor polynomials, too.
    """
    free = at_reference(wall, course)
    short, rise = hop
    s = share(jnp.where(short, rise - wall.crest, _toward(wall, free)))
    reached = in_reach(wall, s)
    for _ in range(rounds - 1):
        s = share(s + _toward(wall, share(motion(wall, course, jnp.where(reached, s, 0.0)))))
        reached = reached & in_reach(wall, s)
    at = share(motion(wall, course, jnp.where(reached, s, 0.0)))
    snap, fifth = share(further(wall, at))
    step = share(householder(at.rate, at.push, at.jerk, snap))
    missed = share(correction(step, (at.rate, at.push, at.jerk, snap, fifth)))
    step, s = share((step + missed, s + step + missed))
    converged = converges(step, wall.omega1, at.push, at.jerk, _STEP) & (at.push < 0)
    converged = converged & converges(missed, wall.omega1, at.push, at.jerk, DOUBT)
    reached = reached & in_reach(wall, s)
    turn = PI * step
    sine, cosine = turn * (1 - turn * turn * (1 / 6)), 1 - 0.5 * turn * turn
    return _Place(
        jnp.where(reached, s, 0.0),
        at.w + step * (at.rate + step * (0.5 * at.push + step * (1 / 6) * at.jerk)),
        at.force * cosine + at.drive * sine * (1 / PI),
        at.push + step * (at.jerk + step * (0.5 * snap + step * (1 / 6) * fifth)),
        at.jerk + step * (snap + step * 0.5 * fifth),
        at.drive * cosine - PI * at.force * sine,
        reached & converged,
    )


def _toward(wall: SoftWall, at: ContactState) -> Lane:
    """Compute the step towards a zero of w'."""
    return householder(at.rate, at.push, at.jerk, further(wall, at)[0])


@shared
def rough_crest(
    wall: SoftWall,
    entry: ContactEntry,
    hop: tuple[Bool[Array, " lane"], Lane],
    end: tuple[Lane, Lane, Lane],
    deep: bool,
) -> FirstCrest:
    """Find when w is largest, from the free contact's time, and whether it has no other extremum before the exit.

    In single precision, with what is close called uncertain. `hop` says whether the contact ends long before a free
    one, and when it is deepest then; `end` holds the duration and f' and f at the exit. Where the depth is asked for
    (`deep`) on steep ground crests far from the free one matter, too: they take another round.

    w' is an oscillator too, driven by the derivative f' of the forcing. Write e^(zeta s) w' = phi q with phi the free
    solution: q rises while f' > 0 and falls while f' < 0. Up to the crest, an f' that ends negative allows one zero.
    Beyond it -w' > 0 has no zero while f' < 0, and where f' ends positive at most one, so none if -w' > 0 at the exit.
    Moreover a minimum of w needs a positive forcing. Else by size: `SoftWall.steep` and `SoftWall.lift`. All that holds
    while f' changes its sign once at most, for half a period (the level step asks that of the whole contact).
    """
    duration, exit_drive, exit_force = end
    course = _crest_course(wall, entry)
    at = share(_rough_place(wall, course, hop, 2 if deep and wall.ebb is not None else 1))
    when = wall.crest + at.s
    way = duration - when
    falls, pulled, one_change = at.drive <= -DOUBT, at.force <= -DOUBT, duration < 1 - DOUBT
    first = falls & ((entry.force_sin >= 0) | ((entry.force > 0) & (course.force_sin >= DOUBT)))
    if entry.pressure is None:
        first = (one_change & (first | ((entry.force <= 0) & pulled))) | (entry.speed > wall.steep)
        only = one_change & (falls | (exit_drive > DOUBT) | (pulled & (exit_force <= -DOUBT)))
    else:
        # With gravity the forcing is positive for more than half a period, or for less. Where it is negative at both
        # ends it may be positive between them in the latter case alone, and then where f' has changed its sign.
        pressed = entry.pressure >= 0
        pulled = at.force + entry.pressure <= -DOUBT
        first_pulled = pulled & (pressed | (entry.force_sin >= 0) | (at.drive >= DOUBT))
        only_pulled = pulled & pressed & (exit_force + entry.pressure <= -DOUBT)
        if wall.ebb is not None:
            # While the forcing is into the wall and rises, w' has no zero before the free crest, and those at which it
            # falls are the time of a free contact apart: one near the free crest is the first.
            first = first | ((entry.force >= DOUBT) & (entry.force_sin <= -DOUBT) & (at.drive >= DOUBT))
        first = ((when < 1 - DOUBT) & (first | ((entry.force <= 0) & first_pulled))) | (entry.speed > wall.steep)
        only = (way < 1 - DOUBT) & (falls | (exit_drive > DOUBT) | only_pulled)
    # While its periodic part is positive f' falls, so its value at the crest bounds it.
    positive = (at.force > DOUBT) & (exit_force > DOUBT) & one_change
    if entry.pressure is not None:
        # Once f' is negative it stays so for half a period.
        positive = (at.force > DOUBT) & ((exit_force > DOUBT) | (exit_drive < -DOUBT)) & (way < 1 - DOUBT)
    most = jnp.where(positive, jnp.maximum(at.drive, 0.0) + DOUBT, PI)
    only = only | ((-at.push > most * wall.lift) & (wall.omega1 * way < DEEP_REACH))
    if wall.long_lift is not None:
        only = only | ((-at.push > most * wall.long_lift) & (wall.omega1 * way < LONG_REACH))
    if entry.pressure is not None:
        # A forcing that is never positive allows no minimum.
        outwards = entry.pressure < -1
        first, only = first | outwards, only | outwards
    inside = (wall.omega1 * way > DOUBT) & (way < (1 - DOUBT) * wall.span)
    highest = _stays_below(wall, at) if deep and wall.ebb is not None else None
    first = at.converged & first & (wall.omega1 * when > DOUBT)
    return FirstCrest(at.s, at.push, at.jerk, first, only & inside, highest)


def deepest(wall: SoftWall, entry: ContactEntry, crest: FirstCrest) -> tuple[Lane, Bool[Array, " lane"]]:
    """Find the greatest depth, and whether the rough time of the crest was close enough for it.

    The depth is stationary: with Newton's step h to the crest, w + h w'/2 misses it by terms of h^3 alone.
    """
    at = motion(wall, _crest_course(wall, entry), crest.s.astype(entry.speed.dtype))
    # No more of the state is stored: each value that is takes a pass of its own.
    depth, rate = share((entry.penetration(at), at.rate))
    step = share(-rate.astype(crest.push.dtype) / crest.push)
    close = _CREST_STEP * converged_step(jnp.finfo(depth.dtype).eps)
    near = converges(step, wall.omega1.astype(step.dtype), crest.push, crest.jerk, close)
    return depth + 0.5 * step.astype(depth.dtype) * rate, near
