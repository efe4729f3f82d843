"""One impact of every lane by certified sampling: any gamma, any contact that a few free cycles decide.

Samples a fixed distance apart, and a bound M on the second derivative between them, tell where a crossing can be: from
a > 0 to b > 0 a step h apart there is none if sqrt(a) + sqrt(b) > h sqrt(M/2), and from a > 0 to b <= 0 there is just
one if a - b > M h^2/2. A lane with a closer call is declined, and `exact.step` does it instead. There is no search in
it that has to converge, which makes it several times cheaper than the careful step.
"""

from collections.abc import Callable
from functools import partial, reduce
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.engine.exact import stick_speed
from vijax.engine.impact import Arrival, Ball, LaneImpact
from vijax.engine.quick import through
from vijax.engine.roots import converged_step, householder
from vijax.model import energy, flow
from vijax.model.flow import PI, Force, Membrane
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Lane, Mask, choose
from vijax.runtime.xla import share, shared

Samples = Float[Array, "sample lane"]
Zeros = Float[Array, "zero lane"]  # the exit, and the crest where it is asked for
Rows = Float[Array, "*row lane"]
Powers = Float[Array, "sample *row lane"]

_SAMPLES = 32  # A pass takes so many; a power of two, as `_powers` doubles them.
_PASSES = 6  # After these a lane is declined, for the careful step to do: more keep the others waiting.
_ZOOM = 1 / 16  # where a pass met a doubt, the next one samples so much more closely
_FINEST = 1 / 8  # longest sampling step, in half periods of the forcing and of the membrane
_NONE = float(_SAMPLES)
_EBB = 0.9  # share of a way without crossings that is left out: at its end a contact may be as good as over


class _Crest(NamedTuple):
    """Where a contact is deepest so far."""

    when: Lane  # when the highest sample was
    step: Lane
    height: Lane
    most: Lane  # how high the maximum beside it could be
    rival: Lane  # and another one


class _Pass(NamedTuple):
    """Search of every lane for its first crossing: none on (0, s]; then one between s and s + h."""

    s: Lane
    h: Lane
    zoom: Lane  # how much finer than usual the next samples are
    side: Lane  # +-1: the wall that is crossed; 0: none yet
    start: Lane  # distance at s and at s + h
    end: Lane
    crest: _Crest


def _powers(re: Rows, im: Rows) -> tuple[Powers, Powers]:
    """Compute powers 1 to _SAMPLES of a complex number per lane, by doubling."""
    real, imaginary = re[None], im[None]
    while real.shape[0] < _SAMPLES:
        more = (real * re - imaginary * im, real * im + imaginary * re)
        real, imaginary = share((jnp.concatenate([real, more[0]]), jnp.concatenate([imaginary, more[1]])))
        re, im = share((re * re - im * im, 2 * re * im))
    return real, imaginary


@shared
def _least(samples: Samples) -> Lane:
    """Find the smallest of each lane: a chain over whole rows is one vector loop, XLA's reduction a scalar one."""
    return reduce(jnp.minimum, samples)


def _safe(gap: Lane, rate: Lane, bend: Lane) -> Lane:
    """Find a time before which a gap that changes at `rate` cannot close if its second derivative is above -bend."""
    return (rate + jnp.sqrt(jnp.maximum(rate * rate + 2 * bend * gap, 0.0))) / bend


class _Crossing(NamedTuple):
    """The first interval of a pass in which a gap surely closes, and the first that is in doubt; else _NONE."""

    closes: Lane
    doubt: Lane


def _curb(bend: Samples, fourth: Lane, h: Lane) -> Float[Array, "interval lane"]:
    """Bound h^2/2 |g"| between samples of g", by their chord and a bound of its second derivative."""
    size = jnp.abs(bend)
    return 0.5 * h * h * (jnp.maximum(size[:-1], size[1:]) + 0.125 * h * h * fourth)


def _first_crossing(gap: Samples, curb: Float[Array, "interval lane"], slack: Lane) -> _Crossing:
    """Find the first crossing among samples; `slack` is the rounding of one."""
    order = jnp.arange(_SAMPLES - 1, dtype=gap.dtype)[:, None]
    root = share(jnp.sqrt(jnp.maximum(gap - slack, 0.0)))
    clear = root[:-1] + root[1:] > jnp.sqrt(curb)
    closes = (gap[:-1] > 0) & (gap[1:] <= 0)
    plain = closes & (gap[:-1] - gap[1:] > curb + slack)
    return _Crossing(
        _least(share(jnp.where(plain, order, _NONE))), _least(share(jnp.where(clear | plain, _NONE, order)))
    )


def _at(samples: Samples, index: Lane) -> Lane:
    row = jnp.clip(index, 0, _SAMPLES - 1).astype(jnp.int32)
    return jnp.take_along_axis(samples, row[None], axis=0)[0]


def _search(advance: Callable[[_Pass], _Pass], side: Lane) -> _Pass:
    """Pass after pass until every lane has its crossing; one that begins with a `side` is not searched."""
    zero, one = jnp.zeros_like(side), jnp.ones_like(side)
    start = _Pass(zero, zero, one, side, one, zero, _Crest(zero, zero, zero, zero, zero))

    def searching(carry):
        at, passes = carry
        return (at.side == 0).any() & (passes < _PASSES)

    return lax.while_loop(searching, lambda carry: (advance(carry[0]), carry[1] + 1), (start, 0))[0]


def _next(at: _Pass, s: Samples, h: Lane, crossing: _Crossing, side: Lane, gap: Samples, crest: _Crest) -> _Pass:
    """Note a pass: the record stands at the crossing, the first doubt, or the end; crossings found are kept."""
    index = jnp.minimum(crossing.closes, crossing.doubt)
    doubtful = crossing.doubt < crossing.closes
    zoom = jnp.where(doubtful, at.zoom * _ZOOM, jnp.minimum(at.zoom / _ZOOM, 1.0))
    side = jnp.where(crossing.closes < crossing.doubt, side, 0.0).astype(h.dtype)
    new = _Pass(_at(s, index), h, zoom, side, _at(gap, index), _at(gap, index + 1), crest)
    return jax.tree.map(lambda fresh, kept: jnp.where(at.side == 0, fresh, kept), new, at)


@shared
def _chord(found: _Pass) -> Lane:
    return found.s + found.h * found.start / (found.start - found.end)


@shared
def _fly(pair: ImpactPair, lane: Ball, known: Arrival | None = None) -> Arrival:
    """Find the end of every lane's flight; those that are known for sure cost no pass."""
    half, gamma = 0.5 * pair.d, pair.gamma
    eps = jnp.finfo(half.dtype).eps
    bend = 1 + jnp.abs(gamma)
    force = share(flow.flight_force(gamma, lane.t))
    level, drift = lane.u + force.c / PI**2, lane.v - force.q / PI
    order = jnp.arange(1, _SAMPLES + 1, dtype=half.dtype)[:, None]

    def advance(at: _Pass) -> _Pass:
        sine, cosine, _, _ = flow.half_turn(lane.t + at.s)
        u = level + at.s * (drift - 0.5 * gamma * at.s) - cosine / PI**2
        v = drift - gamma * at.s + sine / PI
        # Where the flight begins the gap is 0, not its rounding.
        right, left = jnp.maximum(half - u, 0.0), jnp.maximum(half + u, 0.0)
        safe = jnp.minimum(_safe(right, -v, bend), _safe(left, v, bend))
        h = share(jnp.minimum(_FINEST * at.zoom, 0.5 * safe))
        turn_sine, turn_cosine, _, _ = flow.half_turn(h)
        re, im = _powers(turn_cosine, turn_sine)
        s = at.s + h * order
        push = share(cosine * re - sine * im)
        u = share(level + s * (drift - 0.5 * gamma * s) - push / PI**2)
        slack = 64 * eps * (jnp.abs(level) + s[-1] * (jnp.abs(drift) + bend * s[-1]) + 1)
        curb = share(_curb(push - gamma, jnp.full_like(h, PI**2), h))
        up, down = share((_first_crossing(half - u, curb, slack), _first_crossing(half + u, curb, slack)))
        rises = up.closes < down.closes
        crossing = _Crossing(jnp.minimum(up.closes, down.closes), jnp.minimum(up.doubt, down.doubt))
        return _next(at, s, h, crossing, jnp.where(rises, 1.0, -1.0), half - jnp.where(rises, u, -u), at.crest)

    found = _search(advance, jnp.zeros_like(half) if known is None else known.sure.astype(half.dtype))
    distance = half - found.side * lane.u
    at = _chord(found)
    for _ in range(2):
        rise, v = flow.flight(force, lane.v, at)
        sine, cosine, _, _ = flow.half_turn(lane.t + at)
        push, jerk = gamma - cosine, PI * sine
        step = householder(distance - found.side * rise, -found.side * v, found.side * push, found.side * jerk)
        at, step = share((at + step, step))
    speed = found.side * flow.flight(force, lane.v, at)[1]
    sure = (found.side != 0) & (jnp.abs(step) < converged_step(eps)) & (speed > 0) & (at > 0)
    new = Arrival(at, speed, found.side, sure)
    return new if known is None else choose(known.sure, known, new)


class _Contact(NamedTuple):
    """A contact's closed form: steady response, and the free part in phase and a quarter turn behind."""

    m: Membrane
    force: Force
    speed: Lane
    steady: Force
    free_cos: Lane
    free_sin: Lane


@shared
def _contact(m: Membrane, force: Force, speed: Lane) -> _Contact:
    steady = flow.steady_response(m, force)
    free_cos = steady.g - steady.c
    free_sin = (speed + PI * steady.q + m.zeta * free_cos) / m.omega1
    return _Contact(m, force, speed, steady, free_cos, free_sin)


@shared
def _turned(c: _Contact, s: Rows) -> tuple[Rows, Rows, Force]:
    """Start the clocks of the contact's free part and steady response at s."""
    decay, turn = jnp.exp(-c.m.zeta * s), c.m.omega1 * s
    cosine, sine = share((decay * jnp.cos(turn), decay * jnp.sin(turn)))
    along, across = c.free_cos * cosine + c.free_sin * sine, c.free_sin * cosine - c.free_cos * sine
    return along, across, c.steady.later(s)


def _ebbed(c: _Contact, at: _Pass, free_size: Lane, steady_size: Lane, deep: bool) -> _Pass:
    """Go on to where a contact may end: while the swing is smaller than the steady response, w has no zero.

    Gravity prolongs contacts for dozens of swings, too many to sample. Where the greatest depth is wanted the way is
    taken only if nothing on it can be as deep as the crest so far.
    """
    steady, swing = c.steady.later(at.s), free_size * jnp.exp(-c.m.zeta * at.s)
    level, rate = steady.c - steady.g, -PI * steady.q
    ebbs = (at.side == 0) & (level > swing)
    way = _EBB * _safe(jnp.maximum(level - swing, 0.0), rate, PI**2 * steady_size)
    if not deep:
        return at._replace(s=at.s + jnp.where(ebbs, way, 0.0))
    most = steady_size - steady.g + swing
    ebbs = ebbs & (most < at.crest.height)
    crest = at.crest._replace(rival=jnp.where(ebbs, jnp.maximum(at.crest.rival, most), at.crest.rival))
    return at._replace(s=at.s + jnp.where(ebbs, way, 0.0), crest=crest)


@shared
def _state(c: _Contact, turned: tuple[Rows, Rows, Force]) -> tuple[Rows, Rows]:
    along, across, steady = turned
    w = along + steady.c - steady.g
    return w, c.m.omega1 * across - c.m.zeta * along - PI * steady.q


@shared
def _step(c: _Contact, s: Zeros, w: Zeros, z: Zeros) -> tuple[Zeros, tuple[Zeros, ...]]:
    """Compute the fourth-order step towards a zero of w (first row) or w' (second row), and the derivatives in it."""
    later, square = c.force.later(s), c.m.kappa * c.m.kappa
    push = later.c - later.g - c.m.mu * z - square * w
    jerk = -PI * later.q - c.m.mu * push - square * z
    snap = -(PI**2) * later.c - c.m.mu * jerk - square * push
    derivatives = share((w, z, push, jerk, snap))
    crest = jnp.arange(s.shape[0])[:, None] == 1
    ours = (jnp.where(crest, after, f) for f, after in pairwise(derivatives))
    return householder(*ours), derivatives


def _polish(c: _Contact, s: Zeros) -> tuple[Zeros, Zeros, tuple[Zeros, ...]]:
    """Find the exit, a zero of w, near the first row of s, and the crest, a zero of w', near its second, if any.

    With the last step towards each, and the derivatives of w before that step. The second iteration's closed form is
    the careful one, which loses nothing in short contacts and at resonance.
    """
    w, z = _state(c, _turned(c, s))
    s = share(s + _step(c, s, w, z)[0])
    w, z = flow.oscillate(c.m, c.force, jnp.zeros_like(s), c.speed, s)
    step, derivatives = _step(c, s, w, z)
    return s + step, step, derivatives


def _touch(m: Membrane, force: Force, speed: Lane, deep: bool) -> tuple[Lane, Lane, Lane | None, Mask]:
    """Find duration of the contact, outward speed, greatest depth if asked for, and certainty."""
    eps = jnp.finfo(speed.dtype).eps
    c = _contact(m, force, speed)
    free_size, steady_size = jnp.hypot(c.free_cos, c.free_sin), jnp.hypot(c.steady.c, c.steady.q)
    slack = 64 * eps * (free_size + steady_size + jnp.abs(c.steady.g))
    # |w''| of the free part is at most kappa^2 times its amplitude, which decays.
    free_bend, steady_bend = share((m.kappa * m.kappa * free_size * m.kappa / m.omega1, PI**2 * steady_size))
    # The second derivative of the free part: its amplitudes times (-zeta + i omega1)^2.
    stiff, twist = share((m.zeta * m.zeta - m.omega1 * m.omega1, 2 * m.zeta * m.omega1))
    order = jnp.arange(1, _SAMPLES + 1, dtype=speed.dtype)[:, None]

    def advance(at: _Pass) -> _Pass:
        at = share(_ebbed(c, at, free_size, steady_size, deep))
        turned = _turned(c, at.s)
        along, across, steady = turned
        w, z = _state(c, turned)
        bend = free_bend * jnp.exp(-m.zeta * at.s) + steady_bend
        finest = _FINEST * at.zoom * jnp.minimum(1.0, PI / m.omega1)
        h = share(jnp.minimum(finest, 0.5 * _safe(jnp.maximum(w, 0.0), z, bend)))
        decay, turn = jnp.exp(-m.zeta * h), m.omega1 * h
        drive_sine, drive_cosine, _, _ = flow.half_turn(h)
        turns = jnp.stack([decay * jnp.cos(turn), drive_cosine]), jnp.stack([decay * jnp.sin(turn), drive_sine])
        real, imaginary = _powers(*share(turns))
        (re, drive_re), (im, drive_im) = share((real[:, 0], real[:, 1])), share((imaginary[:, 0], imaginary[:, 1]))
        held = share(steady.c * drive_re - steady.q * drive_im)
        w = share(along * re + across * im + held - steady.g)
        along, across = share((stiff * along - twist * across, stiff * across + twist * along))
        push = share(along * re + across * im - PI**2 * held)
        curb = share(_curb(push, free_bend * m.kappa * m.kappa + PI**2 * steady_bend, h))
        crossing = share(_first_crossing(w, curb, slack))
        s = at.s + h * order
        last, change = jnp.minimum(*crossing), (free_bend * m.kappa + PI * steady_bend) * h
        crest = _higher(at, w, push, s, h, change, last) if deep else at.crest
        return _next(at, s, h, crossing, jnp.ones_like(h), w, crest)

    found = _search(advance, jnp.zeros_like(speed))
    polished = share(_polish(c, jnp.stack([_chord(found), found.crest.when] if deep else [_chord(found)])))
    duration, step, (_, z, push, jerk, _) = jax.tree.map(lambda rows: rows[0], polished)
    out = -(z + step * (push + step * (0.5 * jerk)))
    sharp = jnp.maximum(m.omega1, jnp.abs(push / z))
    sure = (found.side != 0) & (sharp * jnp.abs(step) < converged_step(eps)) & (out > 0)
    if not deep:
        return (*share((duration, out)), None, share(sure))
    when, step, (w, z, push, jerk, snap) = jax.tree.map(lambda rows: rows[1], polished)
    depth = w + step * (z + step * (0.5 * push + step * (jerk / 6 + step * snap / 24)))
    sharp = jnp.maximum(m.omega1, jnp.abs(jerk / push))
    sure = sure & (sharp * jnp.abs(step) < 16 * converged_step(eps)) & (push < 0)
    sure = sure & (jnp.abs(when - found.crest.when) < found.crest.step) & (depth > found.crest.rival) & (when > 0)
    return share((duration, out, depth, sure))


def _higher_of(one: tuple[Lane, Lane], other: tuple[Lane, Lane]) -> tuple[Lane, Lane]:
    """Take the higher of two samples with its time, the first of equals: heights that recur may differ in rounding."""
    return jax.tree.map(partial(jnp.where, other[0] > one[0]), other, one)


@shared
def _higher(at: _Pass, w: Samples, push: Samples, s: Samples, h: Lane, change: Lane, last: Lane) -> _Crest:
    """Find the highest sample so far.

    Where w" < 0 the samples around the highest hold one maximum, its own. `change` bounds that of w" over a step. A
    maximum is half a step from a sample at most, and a whole one before the first sample of a pass.
    """
    order = jnp.arange(_SAMPLES, dtype=w.dtype)[:, None]
    seen = share(jnp.where(order <= last, w, -jnp.inf))
    top, when = share(reduce(_higher_of, zip(seen, s, strict=True)))
    former = at.crest
    better = share(top > former.height)
    when, height = share((jnp.where(better, when, former.when), jnp.where(better, top, former.height)))
    hidden = share(seen + jnp.where(order == 0, 0.5, 0.125) * h * h * (jnp.abs(push) + change))
    near = jnp.abs(s - when) < 2.5 * h
    around = near & (push + change < 0)
    apart = -_least(share(jnp.where(around, jnp.inf, -hidden)))
    beaten = jnp.where(better & (when - former.when > 2.5 * h), former.most, 0.0)
    rival = jnp.maximum(former.rival, jnp.maximum(apart, beaten))
    most = jnp.where(better, -_least(share(jnp.where(near, -hidden, jnp.inf))), former.most)
    return _Crest(when, jnp.where(better, h, former.step), height, most, rival)


def sampled_step(
    pair: ImpactPair,
    lane: Ball,
    arrival: Arrival | None = None,
    *,
    unsure: bool = False,
    deep: bool = False,
    tangent: bool = False,
) -> tuple[LaneImpact, Mask]:
    """Take every lane one impact on by certified sampling.

    Args:
        arrival: The end of the flight, where a cheaper way to it is known.
        unsure: Look for the end of flights whose `arrival` is not sure; else such a lane is declined.
        deep: Also find the greatest depth and the work given to the membrane.
        tangent: Also give the tangent map of the step, flight and saltations included.

    Returns:
        The impact, and for which lanes it is certain.
    """
    flight, speed, side, sure = arrival if arrival is not None and not unsure else _fly(pair, lane, arrival)
    side = jnp.where(side < 0, -1.0, 1.0).astype(flight.dtype)
    onset_t, passed = flow.wrap_phase(lane.t + flight)
    onset_n, v_in = lane.n + passed, side * speed
    depth = work = contact = None
    if pair.rigid:
        out, duration = pair.r * speed, jnp.zeros_like(speed)
        sure = sure & (out > 10 * stick_speed(out.dtype))
        if deep:
            depth, work = speed * energy.rigid_penetration(pair.r), energy.membrane_work_rigid(v_in, pair.r)
        if tangent:
            push = flow.acceleration(pair.gamma, onset_t)
            contact = (-pair.r, jnp.zeros_like(out), (1 + pair.r) * push / v_in, -pair.r)
    else:
        m = flow.membrane(pair)
        duration, out, depth, certain = _touch(m, flow.contact_force(pair.gamma, side, onset_t), speed, deep)
        sure = sure & certain
        if deep:
            work = energy.membrane_work(m.kappa, m.mu, pair.gamma, side, onset_t, duration, v_in, -side * out)
        if tangent:
            h, slope = flow.free_response(m, duration)
            contact = (slope, h, -m.kappa * m.kappa * h, slope + m.mu * h)
    leave_t, passed = flow.wrap_phase(onset_t + duration)
    after = Ball(0.5 * side * pair.d, -side * out, leave_t, onset_n + passed)
    matrix = None if contact is None else through(contact, flight)
    return LaneImpact(onset_t, onset_n, side, v_in, -side * out, flight, duration, after, depth, work, matrix), sure
