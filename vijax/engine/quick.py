"""The regular impact in straight-line arithmetic: one flight without gravity and one contact, certified or declined.

Elementwise over lanes: fixed trips, polynomial sine, cosine and exponential on known ranges, no library call. A lane
whose impact is not certified to be the first and converged to rounding is declined, and `exact.step` does it instead.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vijax.engine.exact import stick_speed
from vijax.engine.polynomial import EXP_REACH, REACH, arcsine, exp, phase, sine_cosine
from vijax.model import energy
from vijax.model.flow import PI, horner, membrane
from vijax.model.pair import ImpactPair
from vijax.runtime.xla import once, share

Lane = Float[Array, "lane"]

_FLIGHT_TRIPS = 3  # in single precision, before the one in double
_EXIT_TRIPS = 2
_CREST_TRIPS = 2
_NEAR = 64  # roundings within which an extremum may be on either side of a wall
_DOUBT = 1e-3  # a sign or a bound that is closer is not trusted to single precision
_DEEP_REACH = 2.6  # longest way from the deepest point to the exit, in radians of omega1


class Lanes(eqx.Module):
    """The state between impacts, all floating point: displacement, velocity, phase in [0, 2), periods completed."""

    u: Lane
    v: Lane
    t: Lane
    n: Lane


class Wall(eqx.Module):
    """What the contact of a cell needs and no impact changes."""

    half: Lane
    r: Lane
    chi: Lane | None = None  # rigid: greatest depth per speed
    kappa: Lane | None = None
    zeta: Lane | None = None
    omega1: Lane | None = None
    gain_in: Lane | None = None  # steady response per forcing, in phase
    gain_out: Lane | None = None  # and a quarter turn behind
    span: Lane | None = None  # pi/omega1: the free contact
    cos_span: Lane | None = None
    sin_span: Lane | None = None
    cos_middle: Lane | None = None
    sin_middle: Lane | None = None
    root_r: Lane | None = None
    hop: Lane | None = None  # a contact whose cubic Taylor polynomial ends before this is expanded about half the span
    crest: Lane | None = None  # free time of greatest depth
    cos_crest: Lane | None = None
    sin_crest: Lane | None = None
    crest_decay: Lane | None = None
    steep: Lane | None = None  # least speed at which w' is sure to have its first zero near the free crest
    lift: Lane | None = None  # least -w'' at the crest, per bound of f', that keeps w' negative until the exit
    usable: Bool[Array, "lane"] | None = None


class Hit(eqx.Module):
    """One impact of every lane: onset, exit and, where asked for, depth, work and tangent map (row by row)."""

    onset_t: Lane
    onset_n: Lane
    side: Lane
    v_in: Lane
    v_out: Lane
    flight: Lane
    duration: Lane
    after: Lanes
    depth: Lane | None = None
    work: Lane | None = None
    tangent: tuple[Lane, Lane, Lane, Lane] | None = None


def prepare(pair: ImpactPair) -> Wall:
    """Constants of the quick step for every cell.

    The size certificates, for a forcing of at most 1: while v h'(s) > h(s), up to half the free time of greatest depth
    s_a, w' stays positive (Duhamel with h' > 0), and once kappa^2 w(s_a) >= 1 it falls until its zero ("steep"). From
    there -w' starts with slope V = -w'' and is driven by at most max f': it stays positive while V h > max f' H, H the
    integral of h ("lift"); h/H falls with time since h is log-concave.
    """
    if pair.kappa is None:
        return Wall(0.5 * pair.d, pair.r, chi=energy.rigid_penetration(pair.r))
    wall = membrane(pair)
    kappa, zeta, omega1 = wall.kappa, wall.zeta, wall.omega1
    square = kappa * kappa
    stiffness, loss = square - PI**2, 2 * zeta * PI
    size = stiffness * stiffness + loss * loss
    span, theta = PI / omega1, jnp.arctan2(omega1, zeta)
    crest = theta / omega1
    bend = zeta * zeta - (2 / 3) * (4 * zeta * zeta - square)

    def response(x):  # h, h' and H at omega1 s = x
        decay = jnp.exp(-zeta / omega1 * x)
        h, slope = decay * jnp.sin(x) / omega1, decay * (jnp.cos(x) - zeta / omega1 * jnp.sin(x))
        return h, slope, (1 - slope - 2 * zeta * h) / square

    h_a, slope_a, static_a = response(0.5 * theta)
    h_d, _, static_d = response(jnp.full_like(theta, _DEEP_REACH))
    return Wall(
        half=0.5 * pair.d,
        r=pair.r,
        kappa=kappa,
        zeta=zeta,
        omega1=omega1,
        gain_in=stiffness / size,
        gain_out=loss / size,
        span=span,
        cos_span=jnp.cos(PI * span),
        sin_span=jnp.sin(PI * span),
        cos_middle=jnp.cos(0.5 * PI * span),
        sin_middle=jnp.sin(0.5 * PI * span),
        root_r=jnp.sqrt(pair.r),
        hop=jnp.where(bend > 0, 1.6 / (jnp.sqrt(jnp.maximum(bend, 0.0)) + zeta), 0.0),  # 0.8 of the free contact's
        crest=crest,
        cos_crest=jnp.cos(PI * crest),
        sin_crest=jnp.sin(PI * crest),
        crest_decay=jnp.exp(-zeta * crest),
        steep=(1 + _DOUBT) * jnp.maximum(h_a / slope_a, (1 / square + static_a) / h_a),
        lift=(1 + _DOUBT) * static_d / h_d,
        # Near the resonance the steady response is large and cancels.
        usable=(size > 1.0) & (pair.r > 1e-2),
    )


def converged_step(eps: Any) -> float:
    """Largest last step, times the stiffness, after which a fourth-order iteration is off by eps."""
    return float(eps) ** 0.25


def householder(f: Lane, f1: Lane, f2: Lane, f3: Lane) -> Lane:
    """Step of the fourth-order root iteration from f and its first three derivatives; one division."""
    slope, bent = f1 * f1, f * f2
    return -f * (6 * slope - 3 * bent) / (6 * f1 * (slope - bent) + f * f * f3)


def _single(tree: Any) -> Any:
    """Floating leaves in single precision.

    An iteration of fourth order needs double precision in its last trip alone: the others cost a quarter as much.
    """
    return share(jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != jnp.bool_ else x, tree))


def _kepler(slope: Lane, goal: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Root y of sin y + slope y = goal nearest 0, the last step towards it, and sin and cos of y before that step."""
    p, g = _single((slope, goal))
    y = jnp.clip(g / (1 + p), -2.6, 2.6)
    for _ in range(_FLIGHT_TRIPS):
        sine, cosine = _reflected(y)
        y = share(y + householder(sine + p * y - g, p + cosine, -sine, -cosine))
    y = share(y.astype(slope.dtype))
    sine, cosine = _reflected(y)
    step = share(householder(sine + slope * y - goal, slope + cosine, -sine, -cosine))
    return y + step, step, sine, cosine


def _reflected(y: Lane) -> tuple[Lane, Lane]:
    """sin and cos on |y| <= pi + 0.08."""
    size = jnp.abs(y)
    beyond = size > 0.5 * PI
    sine, cosine = sine_cosine(jnp.where(beyond, PI - size, size))
    return share((jnp.where(y < 0, -sine, sine), jnp.where(beyond, -cosine, cosine)))


class _Flight(eqx.Module):
    """Arrival at a wall, in the frame where the ball starts downwards; sin and cos of the angle past its centre."""

    elapsed: Lane
    speed: Lane  # towards the wall
    flip: Lane  # +-1: the frame is mirrored
    wall: Lane  # +-1 in the frame
    sine: Lane
    cosine: Lane
    sure: Bool[Array, "lane"]
    never: Bool[Array, "lane"]


class _Stretch(NamedTuple):
    """The monotone stretch of a flight that ends at a wall, in the frame where the ball starts downwards."""

    up: Bool[Array, "lane"]  # to the upper wall
    periods: Lane  # before it begins
    doubt: Bool[Array, "lane"]  # an extremum on the way may be a graze or a miss


def _stretch(half: Lane, u: Lane, p: Lane, ahead: Lane, cosine: Lane) -> _Stretch:
    """By comparing extrema with the walls, in single precision: what is closer than that can tell is in doubt.

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


def _fly(half: Lane, lane: Lanes) -> _Flight:
    """First wall crossing without gravity: pick the one monotone stretch that holds it, then Kepler's equation.

    u' = (p + sin pi t)/pi. For |p| < 1 the extrema are closed-form, and each period lifts them by 2p/pi, so comparing
    two of them with the walls and one division give the crossing's stretch. About the centre of a stretch the crossing
    obeys sin y + P y = G, Kepler's equation, monotone there; a Householder iteration from the centre, where the left
    side is nearly straight, converges in two or three trips.
    """
    eps = jnp.finfo(half.dtype).eps
    flip = jnp.where(lane.v < 0, 1.0, -1.0).astype(half.dtype)
    sine, cosine = phase(lane.t)
    sine, cosine = flip * sine, flip * cosine
    t = jnp.where(flip > 0, lane.t, jnp.where(lane.t >= 1, lane.t - 1, lane.t + 1))
    u = flip * lane.u
    p = flip * PI * lane.v - sine
    u, t, p, cosine = share((u, t, p, cosine))
    centre = jnp.where(t < 0.5, -0.5, 1.5).astype(t.dtype)
    stretch = _stretch(*_single((half, u, p, centre - t, cosine)))
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
    stiffness = jnp.maximum(1.0, jnp.abs(sine / (slope + cosine)))
    sine, cosine = sine * turn_cosine + cosine * turn_sine, cosine * turn_cosine - sine * turn_sine
    speed = (slope + cosine) * (1 / PI)
    elapsed = away + y * (1 / PI)
    # The iteration is of fourth order: what is left after the last step is (stiffness step)^3 step.
    converged = stiffness * jnp.abs(step) < converged_step(eps)
    # A short hop loses its leading digits in the phases.
    sure = converged & ~doubt & (speed > 0) & (elapsed > 1 / 256) & (lane.v != 0) & (jnp.abs(y) < 3.4)
    return _Flight(*share((elapsed, speed, flip, wall, sine, cosine, sure, never & (lane.v != 0))))


class _Motion(eqx.Module):
    """Penetration w and its derivatives at one time of the contact, with the parts they were made of."""

    w: Lane
    rate: Lane
    force: Lane
    push: Lane  # w''
    jerk: Lane  # w'''
    drive: Lane  # derivative of the forcing
    sine: Lane
    cosine: Lane
    decay: Lane


class _Course(eqx.Module):
    """A contact as seen from one reference time: steady part, forcing and free part rotated to it."""

    steady_cos: Lane
    steady_sin: Lane
    force_cos: Lane
    force_sin: Lane
    free_cos: Lane
    free_sin: Lane
    decay: Lane


@once
def _motion(wall: Wall, course: _Course, s: Lane) -> _Motion:
    """The contact at time s from the course's reference."""
    sine, cosine = sine_cosine(wall.omega1 * s)
    drive_sine, drive_cosine = sine_cosine(PI * s)
    decay = course.decay * exp(-wall.zeta * s)
    along = course.free_cos * cosine + course.free_sin * sine
    across = course.free_sin * cosine - course.free_cos * sine
    steady = course.steady_cos * drive_cosine + course.steady_sin * drive_sine
    steady_rate = PI * (course.steady_sin * drive_cosine - course.steady_cos * drive_sine)
    force = course.force_cos * drive_cosine - course.force_sin * drive_sine
    drive = -PI * (course.force_sin * drive_cosine + course.force_cos * drive_sine)
    w = steady + decay * along
    rate = steady_rate + decay * (wall.omega1 * across - wall.zeta * along)
    return _derivatives(wall, w, rate, force, drive, sine, cosine, decay)


def _derivatives(wall, w, rate, force, drive, sine, cosine, decay) -> _Motion:
    push = force - 2 * wall.zeta * rate - wall.kappa * wall.kappa * w
    jerk = drive - 2 * wall.zeta * push - wall.kappa * wall.kappa * rate
    return _Motion(w, rate, force, push, jerk, drive, sine, cosine, decay)


def _at_reference(wall: Wall, course: _Course) -> _Motion:
    """The contact at the course's reference: no sine and no exponential is needed there."""
    one, zero = jnp.ones_like(course.decay), jnp.zeros_like(course.decay)
    w = course.steady_cos + course.decay * course.free_cos
    rate = PI * course.steady_sin + course.decay * (wall.omega1 * course.free_sin - wall.zeta * course.free_cos)
    return _derivatives(wall, w, rate, course.force_cos, -PI * course.force_sin, zero, one, course.decay)


def _in_reach(wall: Wall, s: Lane) -> Bool[Array, "lane"]:
    """Whether the polynomials of `_motion` hold at s."""
    return (jnp.maximum(wall.omega1, PI) * jnp.abs(s) < REACH) & (wall.zeta * jnp.abs(s) < EXP_REACH)


def _course(parts: tuple[Lane, ...], cosine: Lane, sine: Lane, free: tuple[Lane, Lane], decay: Lane) -> _Course:
    """The contact rotated to a reference time with the given cos and sin of pi s; `free` is its free part there."""
    steady_cos, steady_sin, force_cos, force_sin = parts
    return _Course(
        steady_cos * cosine + steady_sin * sine,
        steady_sin * cosine - steady_cos * sine,
        force_cos * cosine - force_sin * sine,
        force_cos * sine + force_sin * cosine,
        *free,
        decay,
    )


def _taylor(derivatives: tuple[Lane, ...], order: int, s: Lane) -> Lane:
    """Sum of derivatives[k] s^k/(k + order)!."""
    return horner(tuple(d * (1 / math.factorial(k + order)) for k, d in enumerate(derivatives)), s)


def _either(short: Bool[Array, "lane"], near: _Course, far: _Course) -> _Course:
    return share(jax.tree.map(lambda a, b: jnp.where(short, a, b), near, far))


class _Exit(eqx.Module):
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

    @property
    def parts(self) -> tuple[Lane, ...]:
        """What `_course` rotates."""
        return self.steady_cos, self.steady_sin, self.force_cos, self.force_sin


def _entry(wall: Wall, flight: _Flight) -> _Entry:
    """The forcing is force_cos cos(pi s) - force_sin sin(pi s), its steady response steady_cos cos + steady_sin sin."""
    force_cos, force_sin = -flight.sine, flight.cosine
    steady_cos = wall.gain_in * force_cos + wall.gain_out * force_sin
    steady_sin = wall.gain_out * force_cos - wall.gain_in * force_sin
    free_sin = (flight.speed - PI * steady_sin - wall.zeta * steady_cos) / wall.omega1
    return share(_Entry(flight.speed, force_cos, force_sin, steady_cos, steady_sin, -steady_cos, free_sin))


class _Guess(eqx.Module):
    """Where to look for crest and exit of a contact that ends long before pi/omega1."""

    short: Bool[Array, "lane"]
    hop: Lane
    rise: Lane


def _guess(wall: Wall, entry: _Entry) -> _Guess:
    """From the cubic Taylor polynomial at the onset, and a Newton step on that of degree six."""
    speed, square = entry.speed, wall.kappa * wall.kappa
    push = entry.force_cos - 2 * wall.zeta * speed
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
    return share(_Guess(short, hop, rise))


def _touch(wall: Wall, flight: _Flight, deep: bool) -> tuple[_Exit, Lane | None, Bool[Array, "lane"]]:
    """Exit of the contact, its greatest depth if asked for, and certainty that w rises once and falls once until then.

    The exit is sought from pi/omega1, where the free contact ends and exp(-zeta pi/omega1) = r by calibration, so that
    nothing has to be evaluated there; that of a slow entry against the forcing, from the root of its cubic Taylor
    polynomial, about half of pi/omega1.
    """
    eps = jnp.finfo(wall.half.dtype).eps
    entry = _entry(wall, flight)
    rough, begun = _single((wall, entry))
    guess = _guess(rough, begun)
    middle = _course(entry.parts, wall.cos_middle, wall.sin_middle, (entry.free_sin, -entry.free_cos), wall.root_r)
    far = _course(entry.parts, wall.cos_span, wall.sin_span, (-entry.free_cos, -entry.free_sin), wall.r)
    course = _either(guess.short, middle, far)
    reference = jnp.where(guess.short, 0.5 * wall.span, wall.span)
    s, reached = _rough_exit(rough, begun, guess, _single(course))
    s = share(s.astype(reference.dtype))
    at = share(_motion(wall, course, s))
    step = share(householder(at.w, at.rate, at.push, at.jerk))
    out = -(at.rate + step * (at.push + step * (0.5 * at.jerk)))
    duration = reference + s + step
    stiffness = jnp.maximum(wall.omega1, jnp.abs(at.push / at.rate))
    # The iteration is of fourth order; and in a shorter contact the closed form has lost two digits.
    converged = reached & (stiffness * jnp.abs(step) < converged_step(eps)) & (wall.omega1 * duration > 0.25)
    crest, certain = _rough_crest(rough, begun, guess, _single((duration, at.drive, at.force)))
    depth = None
    if deep:
        depth, exact = _deepest(wall, entry, crest)
        certain = certain & exact
    sure = wall.usable & converged & (out > 0) & certain
    turn = wall.omega1 * step
    twist = turn * turn
    turn_sine, turn_cosine = turn * (1 - twist * (1 / 6)), 1 - twist * (0.5 - twist * (1 / 24))
    sine, cosine = at.sine * turn_cosine + at.cosine * turn_sine, at.cosine * turn_cosine - at.sine * turn_sine
    short = guess.short
    sine, cosine = jnp.where(short, cosine, -sine), jnp.where(short, -sine, -cosine)  # from the reference to the onset
    rot = wall.zeta * step
    decay = at.decay * (1 - rot * (1 - rot * (0.5 - rot * (1 / 6))))
    return share((_Exit(duration, out, sine, cosine, decay), depth, sure))


def _rough_exit(wall: Wall, entry: _Entry, guess: _Guess, course: _Course) -> tuple[Lane, Bool[Array, "lane"]]:
    """Time of the exit from the course's reference in single precision, and whether the polynomials held on the way."""
    free = _at_reference(wall, course)
    near = guess.hop - 0.5 * wall.span
    s = share(jnp.where(guess.short, near, householder(free.w, free.rate, free.push, free.jerk)))
    reached = _in_reach(wall, s)
    for _ in range(_EXIT_TRIPS):
        at = share(_motion(wall, course, jnp.where(reached, s, 0.0)))
        s = share(s + householder(at.w, at.rate, at.push, at.jerk))
        reached = reached & _in_reach(wall, s)
    return share((jnp.where(reached, s, 0.0), reached))


def _crest_course(wall: Wall, entry: _Entry) -> _Course:
    """The contact rotated to the free time of greatest depth: cos and sin of omega1 s are zeta/kappa, omega1/kappa."""
    cosine, sine = wall.zeta / wall.kappa, wall.omega1 / wall.kappa
    free = (entry.free_cos * cosine + entry.free_sin * sine, entry.free_sin * cosine - entry.free_cos * sine)
    return share(_course(entry.parts, wall.cos_crest, wall.sin_crest, free, wall.crest_decay))


def _snap(wall: Wall, at: _Motion) -> Lane:
    """Fourth derivative of w."""
    return -(PI**2) * at.force - 2 * wall.zeta * at.jerk - wall.kappa * wall.kappa * at.push


def _rough_crest(
    wall: Wall, entry: _Entry, guess: _Guess, end: tuple[Lane, Lane, Lane]
) -> tuple[Lane, Bool[Array, "lane"]]:
    """Time of greatest depth from the free contact's, and certainty that w has no other extremum before the exit.

    In single precision, with what is close called uncertain. `end` holds the duration and f' and f at the exit.

    w' is an oscillator too, driven by the derivative f' of the forcing. Write e^(zeta s) w' = phi q with phi the free
    solution: q rises while f' > 0 and falls while f' < 0. Up to the crest, an f' that ends negative allows one zero.
    Beyond it -w' > 0 has no zero while f' < 0, and where f' ends positive at most one, so none if -w' > 0 at the exit.
    Moreover a minimum of w needs a positive forcing. Else by size: `Wall.steep` and `Wall.lift`.
    """
    duration, exit_drive, exit_force = end
    course = _crest_course(wall, entry)
    free = _at_reference(wall, course)
    near = guess.rise - wall.crest
    s = share(jnp.where(guess.short, near, householder(free.rate, free.push, free.jerk, _snap(wall, free))))
    reached = _in_reach(wall, s)
    for _ in range(_CREST_TRIPS):
        at = share(_motion(wall, course, jnp.where(reached, s, 0.0)))
        step = householder(at.rate, at.push, at.jerk, _snap(wall, at))
        s, step = share((s + step, step))
        reached = reached & _in_reach(wall, s)
    stiffness = jnp.maximum(wall.omega1, jnp.abs(at.jerk / at.push))
    converged = reached & (stiffness * jnp.abs(step) < _DOUBT) & (at.push < 0)
    when = wall.crest + s
    way = duration - when
    falls, pulled, one_change = at.drive <= -_DOUBT, at.force <= -_DOUBT, duration < 1 - _DOUBT
    first = falls & ((entry.force_sin >= 0) | ((entry.force_cos > 0) & (course.force_sin >= _DOUBT)))
    first = (one_change & (first | ((entry.force_cos <= 0) & pulled))) | (entry.speed > wall.steep)
    only = one_change & (falls | (exit_drive > _DOUBT) | (pulled & (exit_force <= -_DOUBT)))
    # While the forcing is positive f' falls, so its value at the crest bounds it.
    positive = (at.force > _DOUBT) & (exit_force > _DOUBT) & one_change
    most = jnp.where(positive, jnp.maximum(at.drive, 0.0) + _DOUBT, PI)
    only = only | ((-at.push > most * wall.lift) & (wall.omega1 * way < _DEEP_REACH))
    inside = (wall.omega1 * when > _DOUBT) & (wall.omega1 * way > _DOUBT) & (way < (1 - _DOUBT) * wall.span)
    return share((jnp.where(reached, s, 0.0), converged & first & only & inside))


def _deepest(wall: Wall, entry: _Entry, crest: Lane) -> tuple[Lane, Bool[Array, "lane"]]:
    """Greatest depth, and whether `crest`, its rough time from the free contact's, was close enough to tell."""
    at = share(_motion(wall, _crest_course(wall, entry), crest.astype(entry.speed.dtype)))
    fourth = _snap(wall, at)
    step = share(householder(at.rate, at.push, at.jerk, fourth))
    depth = at.w + step * (at.rate + step * (0.5 * at.push + step * ((1 / 6) * at.jerk + step * (1 / 24) * fourth)))
    # The depth is stationary, and its Taylor polynomial of fifth order: a coarser time than the exit's will do.
    stiffness = jnp.maximum(wall.omega1, jnp.abs(at.jerk / at.push))
    return depth, stiffness * jnp.abs(step) < 16 * converged_step(jnp.finfo(depth.dtype).eps)


def through(contact: tuple[Lane, ...], elapsed: Lane) -> tuple[Lane, Lane, Lane, Lane]:
    """Tangent map (row by row) of a flight and the contact after it."""
    a, b, c, d = contact
    return a, a * elapsed + b, c, c * elapsed + d


class Arrival(NamedTuple):
    """A flight's end: its length, the speed into the wall, the wall's side, and whether all that is certain."""

    flight: Lane
    speed: Lane
    side: Lane
    sure: Bool[Array, "lane"]


class Quick(NamedTuple):
    """What the quick step made of every lane."""

    hit: Hit
    arrival: Arrival
    sure: Bool[Array, "lane"]  # of all of the hit
    never: Bool[Array, "lane"]  # will meet no wall again


def quick_step(wall: Wall, gamma: Lane, lane: Lanes, *, deep: bool = False, tangent: bool = False) -> Quick:
    """One impact of every lane by the regular path; gamma must be 0.

    Args:
        deep: Also find the greatest depth and the work given to the membrane.
        tangent: Also give the tangent map of the step, flight and saltations included.
    """
    flight = _fly(wall.half, lane)
    side = flight.flip * flight.wall
    arrival = Arrival(flight.elapsed, flight.speed, side, flight.sure & ~flight.never)
    onset = lane.t + flight.elapsed
    passed = jnp.floor(0.5 * onset)
    onset_t, onset_n = onset - 2 * passed, lane.n + passed
    v_in = side * flight.speed
    depth = work = contact = None
    if wall.kappa is None:
        out, duration = wall.r * flight.speed, jnp.zeros_like(onset)
        leave_t, leave_n = onset_t, onset_n
        sure = out > 10 * stick_speed(out.dtype)
        if deep:
            depth, work = wall.chi * flight.speed, energy.membrane_work_rigid(v_in, wall.r)
        if tangent:
            # In the frame of the wall the acceleration there is -sine.
            contact = (-wall.r, jnp.zeros_like(out), -(1 + wall.r) * flight.sine / flight.speed, -wall.r)
    else:
        left, depth, sure = _touch(wall, flight, deep)
        duration, out = left.duration, left.speed
        leave = onset_t + duration
        passed = jnp.floor(0.5 * leave)
        leave_t, leave_n = leave - 2 * passed, onset_n + passed
        if deep:
            work = energy.membrane_work(wall.kappa, 2 * wall.zeta, gamma, side, onset_t, duration, v_in, -side * out)
        if tangent:
            h = left.decay * left.sine / wall.omega1
            slope = left.decay * left.cosine - wall.zeta * h
            contact = (slope, h, -wall.kappa * wall.kappa * h, slope + 2 * wall.zeta * h)
    matrix = None if contact is None else through(contact, flight.elapsed)
    after = Lanes(side * wall.half, -side * out, leave_t, leave_n)
    hit = Hit(onset_t, onset_n, side, v_in, -side * out, flight.elapsed, duration, after, depth, work, matrix)
    return Quick(hit, arrival, sure & arrival.sure, flight.never & flight.sure)
