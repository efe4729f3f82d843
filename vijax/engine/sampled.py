"""One impact of every lane by certified sampling: any gamma, any contact that a few free cycles decide.

A lane whose crossing `sampling` cannot tell for sure is declined, and `exact.step` does it instead. There is no search
in it that has to converge, which makes it several times cheaper than the careful step.
"""

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.engine.exact import stick_speed
from vijax.engine.impact import Arrival, Ball, LaneImpact
from vijax.engine.quick import through
from vijax.engine.roots import converged_step, householder
from vijax.engine.sampling import (
    FINEST,
    SAMPLES,
    Crest,
    Crossing,
    Pass,
    Rows,
    Samples,
    chord,
    curb_of,
    first_crossing,
    joined,
    least,
    onward,
    powers,
    safe_for,
    search,
)
from vijax.model import energy, flow
from vijax.model.flow import PI, Force, Membrane
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Lane, Mask, choose
from vijax.runtime.xla import on_cpu, share, shared

Zeros = Float[Array, "zero lane"]  # the exit, and the crest where it is asked for

_EBB = 0.9  # share of a way without crossings that is left out: at its end a contact may be as good as over


@shared
def _fly(pair: ImpactPair, lane: Ball, known: Arrival | None = None) -> Arrival:
    """Find the end of every lane's flight; those that are known for sure cost no pass."""
    half, gamma = 0.5 * pair.d, pair.gamma
    eps = jnp.finfo(half.dtype).eps
    bend = 1 + jnp.abs(gamma)
    force = share(flow.flight_force(gamma, lane.t))
    level, drift = lane.u + force.c / PI**2, lane.v - force.q / PI
    order = jnp.arange(1, SAMPLES + 1, dtype=half.dtype)[:, None]

    def advance(at: Pass) -> Pass:
        sine, cosine = flow.phasor(lane.t + at.s)
        u = level + at.s * (drift - 0.5 * gamma * at.s) - cosine / PI**2
        v = drift - gamma * at.s + sine / PI
        # Where the flight begins the gap is 0, not its rounding.
        right, left = jnp.maximum(half - u, 0.0), jnp.maximum(half + u, 0.0)
        safe = jnp.minimum(safe_for(right, -v, bend), safe_for(left, v, bend))
        h = share(jnp.minimum(FINEST * at.zoom, 0.5 * safe))
        turn_sine, turn_cosine = flow.phasor(h)
        re, im = powers(turn_cosine, turn_sine)
        s = at.s + h * order
        push = share(cosine * re - sine * im)
        u = share(level + s * (drift - 0.5 * gamma * s) - push / PI**2)
        slack = 64 * eps * (jnp.abs(level) + s[-1] * (jnp.abs(drift) + bend * s[-1]) + 1)
        curb = share(curb_of(push - gamma, jnp.full_like(h, PI**2), h))
        up, down = share((first_crossing(half - u, curb, slack), first_crossing(half + u, curb, slack)))
        rises = up.closes < down.closes
        crossing = Crossing(jnp.minimum(up.closes, down.closes), jnp.minimum(up.doubt, down.doubt))
        return onward(at, s, h, crossing, jnp.where(rises, 1.0, -1.0), half - jnp.where(rises, u, -u), at.crest)

    found = search(advance, jnp.zeros_like(half) if known is None else known.sure.astype(half.dtype))
    distance = half - found.side * lane.u
    at = chord(found)
    for _ in range(2):
        rise, v = flow.flight(force, lane.v, at)
        sine, cosine = flow.phasor(lane.t + at)
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


def _ebbed(c: _Contact, at: Pass, free_size: Lane, steady_size: Lane, deep: bool) -> Pass:
    """Go on to where a contact may end: while the swing is smaller than the steady response, w has no zero.

    Gravity prolongs contacts for dozens of swings, too many to sample. Where the greatest depth is wanted the way is
    taken only if nothing on it can be as deep as the crest so far.
    """
    steady, swing = c.steady.later(at.s), free_size * jnp.exp(-c.m.zeta * at.s)
    level, rate = steady.c - steady.g, -PI * steady.q
    ebbs = (at.side == 0) & (level > swing)
    way = _EBB * safe_for(jnp.maximum(level - swing, 0.0), rate, PI**2 * steady_size)
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

    With the last step towards each, and the derivatives of w before that step. The last iteration's closed form is the
    careful one, which loses nothing in short contacts and at resonance. With one before it, some slow exits stay in
    doubt. A CPU has the careful step for these sooner than another iteration of all; an accelerator does not.
    """
    for _ in range(1 if on_cpu() else 2):
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
    order = jnp.arange(1, SAMPLES + 1, dtype=speed.dtype)[:, None]

    def advance(at: Pass) -> Pass:
        at = share(_ebbed(c, at, free_size, steady_size, deep))
        turned = _turned(c, at.s)
        along, across, steady = turned
        w, z = _state(c, turned)
        bend = free_bend * jnp.exp(-m.zeta * at.s) + steady_bend
        finest = FINEST * at.zoom * jnp.minimum(1.0, PI / m.omega1)
        h = share(jnp.minimum(finest, 0.5 * safe_for(jnp.maximum(w, 0.0), z, bend)))
        decay, turn = jnp.exp(-m.zeta * h), m.omega1 * h
        drive_sine, drive_cosine = flow.phasor(h)
        turns = jnp.stack([decay * jnp.cos(turn), drive_cosine]), jnp.stack([decay * jnp.sin(turn), drive_sine])
        real, imaginary = powers(*share(turns))
        (re, drive_re), (im, drive_im) = share((real[:, 0], real[:, 1])), share((imaginary[:, 0], imaginary[:, 1]))
        held = share(steady.c * drive_re - steady.q * drive_im)
        w = share(along * re + across * im + held - steady.g)
        along, across = share((stiff * along - twist * across, stiff * across + twist * along))
        push = share(along * re + across * im - PI**2 * held)
        fourth = free_bend * m.kappa * m.kappa + PI**2 * steady_bend
        curb = share(curb_of(push, fourth, h))
        crossing = share(first_crossing(w, curb, slack))
        s = at.s + h * order
        third = free_bend * m.kappa + PI * steady_bend
        crest = _higher(at, w, push, s, h, (third, fourth), jnp.minimum(*crossing)) if deep else at.crest
        return onward(at, s, h, crossing, jnp.ones_like(h), w, crest)

    found = search(advance, jnp.zeros_like(speed))
    polished = share(_polish(c, jnp.stack([chord(found), found.crest.when] if deep else [chord(found)])))
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


def _higher_of(one: tuple[Samples, Samples], other: tuple[Samples, Samples]) -> tuple[Samples, Samples]:
    """Take the higher of two samples with its time, the first of equals: heights that recur may differ in rounding."""
    (height, when), (other_height, other_when) = one, other
    beaten = (other_height > height) | ((other_height == height) & (other_when < when))
    return jax.tree.map(partial(jnp.where, beaten), other, one)


@shared
def _bends(push: Samples, h: Lane, third: Lane, fourth: Lane) -> tuple[Samples, Samples]:
    """Bound w" around each sample, as far as the next ones: what it is at most, and what it is in size.

    Between two samples it is no further from its chord than 1/8 h^2 times the bound of its second derivative. That is
    much nearer than what the bound of its first one allows, where a large swing and a large response all but cancel:
    close to resonance. Before the first sample and after the last there is no chord.
    """
    size, slack, change = jnp.abs(push), 0.125 * h * h * fourth, third * h

    def around(samples: Samples) -> Samples:
        inner = jnp.maximum(jnp.maximum(samples[:-2], samples[2:]), samples[1:-1]) + slack
        return jnp.concatenate([samples[:1] + change, inner, samples[-1:] + change])

    return around(push), around(size)


@shared
def _higher(at: Pass, w: Samples, push: Samples, s: Samples, h: Lane, bounds: tuple[Lane, Lane], last: Lane) -> Crest:
    """Find the highest sample so far.

    Where w" < 0 the samples around the highest hold one maximum, its own. `bounds` are those of the third and fourth
    derivatives. A maximum is half a step from a sample at most, and a whole one before the first sample of a pass.
    """
    most_bend, bend_size = share(_bends(push, h, *bounds))
    order = jnp.arange(SAMPLES, dtype=w.dtype)[:, None]
    seen = share(jnp.where(order <= last, w, -jnp.inf))
    top, when = share(joined(_higher_of, (seen, s)))
    former = at.crest
    better = share(top > former.height)
    when, height = share((jnp.where(better, when, former.when), jnp.where(better, top, former.height)))
    hidden = share(seen + jnp.where(order == 0, 0.5, 0.125) * h * h * bend_size)
    near = jnp.abs(s - when) < 2.5 * h
    around = near & (most_bend < 0)
    apart = -least(share(jnp.where(around, jnp.inf, -hidden)))
    beaten = jnp.where(better & (when - former.when > 2.5 * h), former.most, 0.0)
    rival = jnp.maximum(former.rival, jnp.maximum(apart, beaten))
    most = jnp.where(better, -least(share(jnp.where(near, -hidden, jnp.inf))), former.most)
    return Crest(when, jnp.where(better, h, former.step), height, most, rival)


class _Contacted(NamedTuple):
    """What a contact made of the ball."""

    duration: Lane
    out: Lane
    depth: Lane | None
    work: Lane | None
    tangent: tuple[Lane, Lane, Lane, Lane] | None
    sure: Mask


def sampled_step(
    pair: ImpactPair,
    lane: Ball,
    arrival: Arrival | None = None,
    *,
    unsure: bool = False,
    deep: bool = False,
    work: bool = False,
    tangent: bool = False,
) -> tuple[LaneImpact, Mask]:
    """Take every lane one impact on by certified sampling.

    Args:
        arrival: The end of the flight, where a cheaper way to it is known.
        unsure: Look for the end of flights whose `arrival` is not sure; else such a lane is declined.
        deep: Also find the greatest depth.
        work: Also find the work given to the membrane.
        tangent: Also give the tangent map of the step, flight and saltations included.

    Returns:
        The impact, and for which lanes it is certain.
    """
    flight, speed, side, sure = arrival if arrival is not None and not unsure else _fly(pair, lane, arrival)
    side = jnp.where(side < 0, -1.0, 1.0).astype(flight.dtype)
    onset_t, passed = flow.wrap_phase(lane.t + flight)
    onset_n, v_in = lane.n + passed, side * speed

    def rigid(wall: ImpactPair) -> _Contacted:
        out, contact = wall.r * speed, None
        depth = speed * energy.rigid_depth(wall) if deep else None
        given = energy.membrane_work_rigid(v_in, wall.r) if work else None
        if tangent:
            push = flow.acceleration(pair.gamma, onset_t)
            contact = (-wall.r, jnp.zeros_like(out), (1 + wall.r) * push / v_in, -wall.r)
        return _Contacted(jnp.zeros_like(speed), out, depth, given, contact, out > 10 * stick_speed(out.dtype))

    def soft(wall: ImpactPair) -> _Contacted:
        m, given, contact = flow.membrane(wall), None, None
        duration, out, depth, certain = _touch(m, flow.contact_force(pair.gamma, side, onset_t), speed, deep)
        if work:
            given = energy.membrane_work(m.kappa, m.mu, pair.gamma, side, onset_t, duration, v_in, -side * out)
        if tangent:
            h, slope = flow.free_response(m, duration)
            contact = (slope, h, -m.kappa * m.kappa * h, slope + m.mu * h)
        return _Contacted(duration, out, depth, given, contact, certain)

    duration, out, depth, given, contact, certain = pair.met(side, rigid, soft)
    sure = sure & certain
    leave_t, passed = flow.wrap_phase(onset_t + duration)
    after = Ball(0.5 * side * pair.d, -side * out, leave_t, onset_n + passed)
    matrix = None if contact is None else through(contact, flight)
    return LaneImpact(onset_t, onset_n, side, v_in, -side * out, flight, duration, after, depth, given, matrix), sure
