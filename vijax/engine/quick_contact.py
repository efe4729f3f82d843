"""The quick contact: one membrane contact in straight-line arithmetic, certified or declined."""

import math
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.impact import Lane
from vijax.engine.polynomial import long_decay, phase
from vijax.engine.quick_course import ContactCourse, ContactState, at_reference, in_reach, motion
from vijax.engine.quick_flight import Flight
from vijax.engine.quick_wall import DEEP_REACH, DOUBT, LONG_REACH, SoftWall
from vijax.engine.roots import converged_step, householder, single
from vijax.model.flow import PI, horner
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share, shared

# Rounds in single precision towards the exit and the crest, after the first step from the reference. With fewer, the
# step in double precision that follows is too long more often, and the lane is declined: it costs time and no digits.
_EXIT_ROUNDS, _CREST_ROUNDS = 2, 2
# The last step to the crest may be such a part of the last one to the exit: the depth is then off by three roundings at
# most. After a longer one its digits go, and with less more lanes are declined.
_CREST_STEP = 1 / 8


def _course(entry: "_Entry", cosine: Lane, sine: Lane, free: tuple[Lane, Lane], decay: Lane) -> ContactCourse:
    """Rotate the contact to a reference time of given cos and sin of pi s; `free` is its free part there."""
    steady_cos, steady_sin, force_cos, force_sin = entry.parts
    return ContactCourse(
        steady_cos * cosine + steady_sin * sine,
        steady_sin * cosine - steady_cos * sine,
        force_cos * cosine - force_sin * sine,
        force_cos * sine + force_sin * cosine,
        *free,
        decay,
    )


def _taylor(derivatives: tuple[Lane, ...], order: int, s: Lane) -> Lane:
    """Sum derivatives[k] s^k/(k + order)!."""
    return horner(tuple(d * (1 / math.factorial(k + order)) for k, d in enumerate(derivatives)), s)


class Exit(eqx.Module):
    """The end of a contact: duration and outward speed; sin, cos of omega1 s and exp(-zeta s) there."""

    duration: Lane
    speed: Lane
    sine: Lane
    cosine: Lane
    decay: Lane


class _Entry(eqx.Module):
    """A contact at its onset: speed into the wall, forcing and steady response in phase and a quarter turn behind."""

    speed: Lane
    force_cos: Lane
    force_sin: Lane
    steady_cos: Lane
    steady_sin: Lane
    free_cos: Lane
    free_sin: Lane
    pressure: Lane | None  # Gravity presses the ball into the wall by this much; None on level ground.
    rest: Lane | None  # The membrane's steady response to that pressure.

    def penetration(self, at: ContactState) -> Lane:
        """All of w."""
        return at.w if self.rest is None else at.w + self.rest

    @property
    def force(self) -> Lane:
        """All of the forcing at the onset."""
        return self.force_cos if self.pressure is None else self.force_cos + self.pressure

    @property
    def parts(self) -> tuple[Lane, ...]:
        """Give what `_course` rotates."""
        return self.steady_cos, self.steady_sin, self.force_cos, self.force_sin


@shared
def _entry(wall: SoftWall, flight: Flight) -> _Entry:
    """Find forcing and steady response as the contact begins.

    The forcing is force_cos cos(pi s) - force_sin sin(pi s), its steady response steady_cos cos + steady_sin sin.
    """
    force_cos, force_sin = -flight.sine, flight.cosine
    steady_cos = wall.gain_in * force_cos + wall.gain_out * force_sin
    steady_sin = wall.gain_out * force_cos - wall.gain_in * force_sin
    pressure, rest, steady = None, None, steady_cos
    if wall.incline is not None:
        pressure = -flight.flip * flight.wall * wall.incline.gamma
        rest = pressure / (wall.kappa * wall.kappa)
        steady = steady_cos + rest
    free_sin = (flight.speed - PI * steady_sin - wall.zeta * steady) / wall.omega1
    return _Entry(flight.speed, force_cos, force_sin, steady_cos, steady_sin, -steady, free_sin, pressure, rest)


class _Guess(eqx.Module):
    """Where to look for crest and exit of a contact that ends long before pi/omega1."""

    short: Bool[Array, "lane"]
    hop: Lane
    rise: Lane


@shared
def _guess(wall: SoftWall, entry: _Entry) -> _Guess:
    """Guess from the cubic Taylor polynomial at the onset, and a Newton step on that of degree six."""
    speed, square = entry.speed, wall.kappa * wall.kappa
    push = entry.force - 2 * wall.zeta * speed
    jerk = -PI * entry.force_sin - 2 * wall.zeta * push - square * speed
    bend = 0.25 * push * push - (2 / 3) * jerk * speed
    hop = 2 * speed / (jnp.sqrt(jnp.maximum(bend, 0.0)) - 0.5 * push)
    short = (bend > 0) & (hop > 0) & (hop < wall.hop)
    snap = -(PI**2) * entry.force_cos - 2 * wall.zeta * jerk - square * push
    fifth = PI**3 * entry.force_sin - 2 * wall.zeta * snap - square * jerk
    sixth = PI**4 * entry.force_cos - 2 * wall.zeta * fifth - square * snap
    derivatives = (speed, push, jerk, snap, fifth, sixth)
    value = _taylor(derivatives, 1, hop) * hop
    slope = _taylor(derivatives, 0, hop)
    hop = jnp.where(slope < 0, hop - value / slope, hop)
    rise = 2 * speed / (jnp.sqrt(jnp.maximum(push * push - 2 * jerk * speed, 0.0)) - push)
    rise = rise - _taylor(derivatives, 0, rise) / _taylor(derivatives[1:], 0, rise)
    return _Guess(short, hop, rise)


@shared
def _lasts(wall: SoftWall, entry: _Entry, when: Lane) -> Bool[Array, "lane"]:
    """Say whether a contact is sure to last until about `when`, the end of its steady response.

    The membrane, pressed by gravity, follows the forcing and comes back with it, its swing as good as gone. w is
    positive: for the time of a free contact since the forcing is (Duhamel with h > 0); then since the steady response
    is above the first low of the swing, and above its envelope at that low and at 1/kappa before `when`, where their
    difference falls: it rises before it falls, -log of a sine being convex. From there on the steady response falls
    faster than the envelope of the swing rises, so that w falls until its zero, at most 1/(2 kappa) from `when`.
    """
    ebb = present(wall.ebb)
    rest, pressure = present(entry.rest), present(entry.pressure)
    swing = share(jnp.sqrt(entry.free_cos * entry.free_cos + entry.free_sin * entry.free_sin))
    brake = wall.zeta / wall.kappa
    # Within 1/kappa of that time the swing is slower than the steady response, which falls.
    ring = swing * long_decay(wall.zeta * when) * (1 + brake + brake * brake)
    size = jnp.abs(wall.gain_in) + jnp.abs(wall.gain_out)
    fades = ebb.rate - PI**2 * size / wall.kappa > 1.1 * wall.kappa * ring
    # A forcing into the wall keeps w positive for the time of a free contact.
    force = entry.force_cos * wall.cos_span - entry.force_sin * wall.sin_span + pressure
    drive = entry.force_sin * wall.cos_span + entry.force_cos * wall.sin_span
    held = (entry.force > DOUBT) & (force > DOUBT) & ((entry.force_sin <= 0) | (drive >= 0)) & (wall.span < 1)
    # From then on the steady response is beyond what is left of the swing, whose first low is a crest's time later.
    low = swing * wall.r * wall.crest_decay + DOUBT * rest
    steady_cos = entry.steady_cos * wall.cos_span + entry.steady_sin * wall.sin_span
    steady_sin = entry.steady_sin * wall.cos_span - entry.steady_cos * wall.sin_span
    later = steady_cos * wall.cos_crest + steady_sin * wall.sin_crest
    deep = (steady_cos + rest > low) & (later + rest > low) & (when < wall.span + ebb.arc)
    late = when - 1 / wall.kappa > wall.span + wall.crest
    return (pressure > 0) & (entry.free_sin > 0) & held & deep & fades & late


@shared
def _long_course(wall: SoftWall, entry: _Entry, when: Lane, cosine: Lane, sine: Lane) -> ContactCourse:
    """Rotate the contact to where its steady response ends, with cos and sin of omega1 s there."""
    ebb = present(wall.ebb)
    free = (entry.free_cos * cosine + entry.free_sin * sine, entry.free_sin * cosine - entry.free_cos * sine)
    return ContactCourse(
        -present(entry.rest), ebb.rate * (-1 / PI), ebb.force_cos, ebb.force_sin, *free, long_decay(wall.zeta * when)
    )


@shared
def touch(wall: SoftWall, flight: Flight, deep: bool, begins: Lane) -> tuple[Exit, Lane | None, Bool[Array, "lane"]]:
    """Find the exit, the greatest depth if asked for, and whether w rises once and falls once until then for certain.

    The exit is sought from pi/omega1, where the free contact ends and exp(-zeta pi/omega1) = r by calibration, so that
    nothing has to be evaluated there; that of a slow entry against the forcing, from the root of its cubic Taylor
    polynomial, about half of pi/omega1. Where gravity holds the ball on the wall until the forcing takes it off, about
    when the membrane without its swing would come back.

    Args:
        begins: Phase of the forcing towards the wall at the onset.
    """
    eps = jnp.finfo(wall.half.dtype).eps
    entry = _entry(wall, flight)
    rough, begun = single((replace(wall, incline=None), entry))
    guess = _guess(rough, begun)
    middle = _course(entry, wall.cos_middle, wall.sin_middle, (entry.free_sin, -entry.free_cos), wall.root_r)
    far = _course(entry, wall.cos_span, wall.sin_span, (-entry.free_cos, -entry.free_sin), wall.r)
    course = share(choose(guess.short, middle, far))
    reference = jnp.where(guess.short, 0.5 * wall.span, wall.span)
    long = None
    if wall.ebb is not None:
        when = wall.ebb.phase - begins
        when = share(when - 2 * jnp.floor(0.5 * when))
        long = _lasts(rough, begun, when.astype(jnp.float32))
        turns = wall.omega1 * when * (1 / PI)
        wide_sine, wide_cosine = share(phase(turns - 2 * jnp.floor(0.5 * turns)))
        course = share(choose(long, _long_course(wall, entry, when, wide_cosine, wide_sine), course))
        reference = jnp.where(long, when, reference)
        guess = replace(guess, short=guess.short & ~long)
    s, reached = _rough_exit(rough, begun, guess, single(course))
    s = share(s.astype(reference.dtype))
    at = share(motion(wall, course, s))
    step = share(householder(entry.penetration(at), at.rate, at.push, at.jerk))
    out = -(at.rate + step * (at.push + step * (0.5 * at.jerk)))
    duration = reference + s + step
    stiffness = jnp.maximum(wall.omega1, jnp.abs(at.push / at.rate))
    # The iteration is of fourth order; and in a shorter contact the closed form has lost two digits.
    converged = reached & (stiffness * jnp.abs(step) < converged_step(eps)) & (wall.omega1 * duration > 0.25)
    crest = _rough_crest(rough, begun, guess, single((duration, at.drive, at.force)))
    certain = crest.first & crest.only
    if long is not None:
        ebbs = wall.kappa * jnp.abs(duration - when) < 0.5
        certain = jnp.where(long, ebbs & crest.first & present(crest.highest) if deep else ebbs, certain)
    depth, exact = _deepest(wall, entry, crest.s) if deep else (None, jnp.ones_like(certain))
    certain = certain & exact
    sure = wall.usable & converged & (out > 0) & certain
    turn = wall.omega1 * step
    twist = turn * turn
    turn_sine, turn_cosine = turn * (1 - twist * (1 / 6)), 1 - twist * (0.5 - twist * (1 / 24))
    sine, cosine = at.sine * turn_cosine + at.cosine * turn_sine, at.cosine * turn_cosine - at.sine * turn_sine
    short = guess.short
    # So far they count from the course's reference, half or a whole free contact after the onset, or much later.
    turned_sine, turned_cosine = jnp.where(short, cosine, -sine), jnp.where(short, -sine, -cosine)
    if long is not None:
        turned_sine = jnp.where(long, sine * wide_cosine + cosine * wide_sine, turned_sine)
        turned_cosine = jnp.where(long, cosine * wide_cosine - sine * wide_sine, turned_cosine)
    rot = wall.zeta * step
    decay = at.decay * (1 - rot * (1 - rot * (0.5 - rot * (1 / 6))))
    return Exit(duration, out, turned_sine, turned_cosine, decay), depth, sure


@shared
def _rough_exit(
    wall: SoftWall, entry: _Entry, guess: _Guess, course: ContactCourse
) -> tuple[Lane, Bool[Array, "lane"]]:
    """Find the exit from the course's reference in single precision, and whether the polynomials held on the way."""
    free = at_reference(wall, course)
    near = guess.hop - 0.5 * wall.span
    s = share(jnp.where(guess.short, near, householder(entry.penetration(free), free.rate, free.push, free.jerk)))
    reached = in_reach(wall, s)
    for _ in range(_EXIT_ROUNDS):
        at = share(motion(wall, course, jnp.where(reached, s, 0.0)))
        s = share(s + householder(entry.penetration(at), at.rate, at.push, at.jerk))
        reached = reached & in_reach(wall, s)
    return jnp.where(reached, s, 0.0), reached


@shared
def _crest_course(wall: SoftWall, entry: _Entry) -> ContactCourse:
    """Rotate the contact to the free time of greatest depth: cos and sin of omega1 s are zeta/kappa, omega1/kappa."""
    cosine, sine = share((wall.zeta / wall.kappa, wall.omega1 / wall.kappa))
    free = (entry.free_cos * cosine + entry.free_sin * sine, entry.free_sin * cosine - entry.free_cos * sine)
    return _course(entry, wall.cos_crest, wall.sin_crest, free, wall.crest_decay)


def _snap(wall: SoftWall, at: ContactState) -> Lane:
    """Compute the fourth derivative of w."""
    return -(PI**2) * at.force - 2 * wall.zeta * at.jerk - wall.kappa * wall.kappa * at.push


class _FirstCrest(eqx.Module):
    """Where w' is zero for the first time, and what is certain of it."""

    s: Lane  # The time, counted from that of the free contact's crest.
    first: Bool[Array, "lane"]  # It is found, and w rises until then.
    only: Bool[Array, "lane"]  # w has no other extremum before the exit.
    highest: Bool[Array, "lane"] | None  # None where gravity prolongs no contact: w does not come back to this height.


def _stays_below(wall: SoftWall, at: ContactState) -> Bool[Array, "lane"]:
    """Say whether w stays below its first crest as long as its steady response S ebbs, however often it swings.

    Call w - S the swing, of the envelope a at the crest. S is positive, so concave, for half a free contact. If S falls
    there, w is concave until the swing falls, too. If S rises, w' is at most S' at the crest less what the swing loses,
    which is log-concave, and enough at the end of that time if tan of the swing's phase, S'/(kappa a) its sine, is at
    most the root of r. From then on the swing is below a share of a, until it is negative; when it is positive again a
    free contact has passed and the envelope has fallen to r a. S is at most its amplitude, or where it falls what it
    was at the crest.
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
    share_left = jnp.maximum(wall.r, wall.root_r * wall.zeta / wall.kappa)
    rest = (1 + DOUBT) * (climb + share_left * envelope)
    slow = (1 + DOUBT) * 2 * rate * rate < wall.r * (wall.kappa * envelope) ** 2
    return (steady > 0) & (later > 0) & (swing > rest) & slow


@shared
def _rough_crest(wall: SoftWall, entry: _Entry, guess: _Guess, end: tuple[Lane, Lane, Lane]) -> _FirstCrest:
    """Find when w is largest, from the free contact's time, and whether it has no other extremum before the exit.

    In single precision, with what is close called uncertain. `end` holds the duration and f' and f at the exit.

    w' is an oscillator too, driven by the derivative f' of the forcing. Write e^(zeta s) w' = phi q with phi the free
    solution: q rises while f' > 0 and falls while f' < 0. Up to the crest, an f' that ends negative allows one zero.
    Beyond it -w' > 0 has no zero while f' < 0, and where f' ends positive at most one, so none if -w' > 0 at the exit.
    Moreover a minimum of w needs a positive forcing. Else by size: `SoftWall.steep` and `SoftWall.lift`. All that holds
    while f' changes its sign once at most, for half a period (the level step asks that of the whole contact).
    """
    duration, exit_drive, exit_force = end
    course = _crest_course(wall, entry)
    free = at_reference(wall, course)
    near = guess.rise - wall.crest
    s = share(jnp.where(guess.short, near, householder(free.rate, free.push, free.jerk, _snap(wall, free))))
    reached = in_reach(wall, s)
    for _ in range(_CREST_ROUNDS):
        at = share(motion(wall, course, jnp.where(reached, s, 0.0)))
        step = share(householder(at.rate, at.push, at.jerk, _snap(wall, at)))
        s = share(s + step)
        reached = reached & in_reach(wall, s)
    stiffness = jnp.maximum(wall.omega1, jnp.abs(at.jerk / at.push))
    converged = reached & (stiffness * jnp.abs(step) < DOUBT) & (at.push < 0)
    when = wall.crest + s
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
    highest = None if wall.ebb is None else _stays_below(wall, at)
    first = converged & first & (wall.omega1 * when > DOUBT)
    return _FirstCrest(jnp.where(reached, s, 0.0), first, only & inside, highest)


def _deepest(wall: SoftWall, entry: _Entry, crest: Lane) -> tuple[Lane, Bool[Array, "lane"]]:
    """Find the greatest depth, and whether `crest`, its rough time from the free contact's, was close enough for it.

    The depth is stationary: with Newton's step h to the crest, w + h w'/2 misses it by terms of h^3 alone.
    """
    at = motion(wall, _crest_course(wall, entry), crest.astype(entry.speed.dtype))
    # No more of the state is stored: each value that is takes a pass of its own.
    depth, rate, push, jerk = share((entry.penetration(at), at.rate, at.push, at.jerk))
    step = share(-rate / push)
    close = _CREST_STEP * converged_step(jnp.finfo(depth.dtype).eps)
    near = (wall.omega1 * jnp.abs(step) < close) & (jnp.abs(jerk * step) < close * jnp.abs(push))
    return depth + 0.5 * step * rate, near
