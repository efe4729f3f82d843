"""One impact of every lane by certified sampling, for any gamma and any contact of a few free cycles.

A lane is declined if `crossing_samples` does not certify its crossing, and `exact_step.step` computes it instead. No
iteration to convergence is involved, so this step is several times cheaper than the robust one.
"""

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.impact.exact.crossing_samples import (
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
    powers,
    record_pass,
    reduce_samples,
    safe_for,
    search,
    smallest_sample,
)
from vijax.impact.exact.exact_step import stick_speed
from vijax.impact.fast.fast_step import compose_tangent
from vijax.impact.impact import Arrival, BallState, LaneImpact
from vijax.impact.roots import converged_step, householder
from vijax.model import energy, flow
from vijax.model.flow import PI, Force, Membrane
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Lane, Mask, select
from vijax.runtime.compilation.xla import materialise, materialised, on_cpu

Zeros = Float[Array, "zero lane"]  # the exit, and the crest if it is requested

# Fraction of an interval without crossings that is skipped. The rest is sampled, because at the end of the interval the
# ball may be close to its exit.
_SKIP_FRACTION = 0.9


@materialised
def _sampled_flight(pair: ImpactPair, lane: BallState, arrival: Arrival | None = None) -> Arrival:
    """Return the end of every lane's flight; a lane with a certified `arrival` keeps it and is not searched."""
    half, gamma = 0.5 * pair.d, pair.gamma
    eps = jnp.finfo(half.dtype).eps
    # Bound of |u''|.
    bend = 1 + jnp.abs(gamma)
    force = materialise(flow.flight_force(gamma, lane.t))
    level, drift = lane.u + force.c / PI**2, lane.v - force.q / PI
    order = jnp.arange(1, SAMPLES + 1, dtype=half.dtype)[:, None]

    def advance(at: Pass) -> Pass:
        sine, cosine = flow.phasor(lane.t + at.s)
        u = level + at.s * (drift - 0.5 * gamma * at.s) - cosine / PI**2
        v = drift - gamma * at.s + sine / PI
        # At the start of the flight the clearance is 0, not its rounding error.
        right, left = jnp.maximum(half - u, 0.0), jnp.maximum(half + u, 0.0)
        safe = jnp.minimum(safe_for(right, -v, bend), safe_for(left, v, bend))
        h = materialise(jnp.minimum(FINEST * at.zoom, 0.5 * safe))
        turn_sine, turn_cosine = flow.phasor(h)
        # Sample k needs the phase of k h: powers of one complex number replace sines and cosines.
        re, im = powers(turn_cosine, turn_sine)
        s = at.s + h * order
        push = materialise(cosine * re - sine * im)
        u = materialise(level + s * (drift - 0.5 * gamma * s) - push / PI**2)
        rounding = 64 * eps * (jnp.abs(level) + s[-1] * (jnp.abs(drift) + bend * s[-1]) + 1)
        curb = materialise(curb_of(push - gamma, jnp.full_like(h, PI**2), h))
        up, down = materialise((first_crossing(half - u, curb, rounding), first_crossing(half + u, curb, rounding)))
        rises = up.closes < down.closes
        crossing = Crossing(jnp.minimum(up.closes, down.closes), jnp.minimum(up.uncertain, down.uncertain))
        return record_pass(at, s, h, crossing, jnp.where(rises, 1.0, -1.0), half - jnp.where(rises, u, -u), at.crest)

    result = search(advance, jnp.zeros_like(half) if arrival is None else arrival.certified.astype(half.dtype))
    distance = half - result.side * lane.u
    at = chord(result)
    # Two fourth-order steps from the chord converge to rounding.
    for _ in range(2):
        rise, v = flow.flight(force, lane.v, at)
        sine, cosine = flow.phasor(lane.t + at)
        push, jerk = gamma - cosine, PI * sine
        step = householder(distance - result.side * rise, -result.side * v, result.side * push, result.side * jerk)
        at, step = materialise((at + step, step))
    speed = result.side * flow.flight(force, lane.v, at)[1]
    certified = (result.side != 0) & (jnp.abs(step) < converged_step(eps)) & (speed > 0) & (at > 0)
    new = Arrival(at, speed, result.side, certified)
    return new if arrival is None else select(arrival.certified, arrival, new)


class _Contact(NamedTuple):
    """Closed form of a contact: steady response, and coefficients of the free part for cos and sin of omega1 s."""

    m: Membrane
    force: Force
    speed: Lane
    steady: Force
    free_cos: Lane
    free_sin: Lane


@materialised
def _contact(m: Membrane, force: Force, speed: Lane) -> _Contact:
    """Return the closed form of a contact from w = 0 with speed w'."""
    steady = flow.steady_response(m, force)
    free_cos = steady.g - steady.c
    free_sin = (speed + PI * steady.q + m.zeta * free_cos) / m.omega1
    return _Contact(m, force, speed, steady, free_cos, free_sin)


@materialised
def _turned(c: _Contact, s: Rows) -> tuple[Rows, Rows, Force]:
    """Return the closed form relative to time s: free part, its quadrature component, and steady response."""
    decay, turn = jnp.exp(-c.m.zeta * s), c.m.omega1 * s
    cosine, sine = materialise((decay * jnp.cos(turn), decay * jnp.sin(turn)))
    along, across = c.free_cos * cosine + c.free_sin * sine, c.free_sin * cosine - c.free_cos * sine
    return along, across, c.steady.later(s)


def _skip_prolonged(c: _Contact, at: Pass, free_size: Lane, steady_size: Lane, deep: bool) -> Pass:
    """Advance the search to a time when a contact may end.

    While the amplitude of the free part is smaller than the steady response, w has no zero. Gravity can prolong a
    contact over dozens of oscillations, too many to sample. If the largest depth is requested (`deep`), the interval is
    skipped only if w cannot be as large on it as at the deepest sample so far.
    """
    steady, swing = c.steady.later(at.s), free_size * jnp.exp(-c.m.zeta * at.s)
    level, rate = steady.c - steady.g, -PI * steady.q
    can_skip = (at.side == 0) & (level > swing)
    skip = _SKIP_FRACTION * safe_for(jnp.maximum(level - swing, 0.0), rate, PI**2 * steady_size)
    if not deep:
        return at._replace(s=at.s + jnp.where(can_skip, skip, 0.0))
    # Upper bound of w from at.s on.
    most = steady_size - steady.g + swing
    can_skip = can_skip & (most < at.crest.height)
    crest = at.crest._replace(second=jnp.where(can_skip, jnp.maximum(at.crest.second, most), at.crest.second))
    return at._replace(s=at.s + jnp.where(can_skip, skip, 0.0), crest=crest)


@materialised
def _state(c: _Contact, turned: tuple[Rows, Rows, Force]) -> tuple[Rows, Rows]:
    """Return w and w' from the free part and the steady response."""
    along, across, steady = turned
    w = along + steady.c - steady.g
    return w, c.m.omega1 * across - c.m.zeta * along - PI * steady.q


@materialised
def _step(c: _Contact, s: Zeros, w: Zeros, z: Zeros) -> tuple[Zeros, tuple[Zeros, ...]]:
    """Return the fourth-order step towards a zero of w (first row) or w' (second row), and the derivatives."""
    later, square = c.force.later(s), c.m.kappa * c.m.kappa
    push = later.c - later.g - c.m.mu * z - square * w
    jerk = -PI * later.q - c.m.mu * push - square * z
    snap = -(PI**2) * later.c - c.m.mu * jerk - square * push
    derivatives = materialise((w, z, push, jerk, snap))
    crest = jnp.arange(s.shape[0])[:, None] == 1
    ours = (jnp.where(crest, after, f) for f, after in pairwise(derivatives))
    return householder(*ours), derivatives


def _polish(c: _Contact, s: Zeros) -> tuple[Zeros, Zeros, tuple[Zeros, ...]]:
    """Refine approximate times s of the exit (first row, a zero of w) and of the crest (second row, if any, of w').

    The last iteration uses the robust closed form, which loses no digits in short contacts and at resonance. With only
    one iteration before it, some slow exits are not certified. On a CPU the fallback for these exits is cheaper than
    another iteration for all lanes; on an accelerator it is not.

    Returns:
        The refined times, the last steps to them, and w and its derivatives before the last steps.
    """
    for _ in range(1 if on_cpu() else 2):
        w, z = _state(c, _turned(c, s))
        s = materialise(s + _step(c, s, w, z)[0])
    w, z = flow.oscillate(c.m, c.force, jnp.zeros_like(s), c.speed, s)
    step, derivatives = _step(c, s, w, z)
    return s + step, step, derivatives


def _sampled_contact(m: Membrane, force: Force, speed: Lane, deep: bool) -> tuple[Lane, Lane, Lane | None, Mask]:
    """Return the contact duration, the outward speed, the largest depth if `deep`, and whether they are certified."""
    eps = jnp.finfo(speed.dtype).eps
    c = _contact(m, force, speed)
    free_size, steady_size = jnp.hypot(c.free_cos, c.free_sin), jnp.hypot(c.steady.c, c.steady.q)
    slack = 64 * eps * (free_size + steady_size + jnp.abs(c.steady.g))
    # |w''| of the free part is at most kappa^2 times its amplitude, which decays.
    free_bend, steady_bend = materialise((m.kappa * m.kappa * free_size * m.kappa / m.omega1, PI**2 * steady_size))
    # Second derivative of the free part: its amplitudes times (-zeta + i omega1)^2.
    stiff, twist = materialise((m.zeta * m.zeta - m.omega1 * m.omega1, 2 * m.zeta * m.omega1))
    order = jnp.arange(1, SAMPLES + 1, dtype=speed.dtype)[:, None]

    def advance(at: Pass) -> Pass:
        at = materialise(_skip_prolonged(c, at, free_size, steady_size, deep))
        turned = _turned(c, at.s)
        along, across, steady = turned
        w, z = _state(c, turned)
        bend = free_bend * jnp.exp(-m.zeta * at.s) + steady_bend
        finest = FINEST * at.zoom * jnp.minimum(1.0, PI / m.omega1)
        h = materialise(jnp.minimum(finest, 0.5 * safe_for(jnp.maximum(w, 0.0), z, bend)))
        decay, turn = jnp.exp(-m.zeta * h), m.omega1 * h
        drive_sine, drive_cosine = flow.phasor(h)
        turns = jnp.stack([decay * jnp.cos(turn), drive_cosine]), jnp.stack([decay * jnp.sin(turn), drive_sine])
        real, imaginary = powers(*materialise(turns))
        (re, drive_re), (im, drive_im) = (materialise((x[:, 0], x[:, 1])) for x in (real, imaginary))
        steady_samples = materialise(steady.c * drive_re - steady.q * drive_im)
        w = materialise(along * re + across * im + steady_samples - steady.g)
        along, across = materialise((stiff * along - twist * across, stiff * across + twist * along))
        push = materialise(along * re + across * im - PI**2 * steady_samples)
        fourth = free_bend * m.kappa * m.kappa + PI**2 * steady_bend
        curb = materialise(curb_of(push, fourth, h))
        crossing = materialise(first_crossing(w, curb, slack))
        s = at.s + h * order
        third = free_bend * m.kappa + PI * steady_bend
        crest = _update_crest(at, w, push, s, h, (third, fourth), jnp.minimum(*crossing)) if deep else at.crest
        return record_pass(at, s, h, crossing, jnp.ones_like(h), w, crest)

    end = search(advance, jnp.zeros_like(speed))
    polished = materialise(_polish(c, jnp.stack([chord(end), end.crest.when] if deep else [chord(end)])))
    duration, step, (_, z, push, jerk, _) = jax.tree.map(lambda rows: rows[0], polished)
    out = -(z + step * (push + step * (0.5 * jerk)))
    stiffness = jnp.maximum(m.omega1, jnp.abs(push / z))
    certified = (end.side != 0) & (stiffness * jnp.abs(step) < converged_step(eps)) & (out > 0)
    if not deep:
        return (*materialise((duration, out)), None, materialise(certified))
    when, step, (w, z, push, jerk, snap) = jax.tree.map(lambda rows: rows[1], polished)
    depth = w + step * (z + step * (0.5 * push + step * (jerk / 6 + step * snap / 24)))
    stiffness = jnp.maximum(m.omega1, jnp.abs(jerk / push))
    certified = certified & (stiffness * jnp.abs(step) < 16 * converged_step(eps)) & (push < 0)
    certified = certified & (jnp.abs(when - end.crest.when) < end.crest.step) & (depth > end.crest.second) & (when > 0)
    return materialise((duration, out, depth, certified))


def _higher_of(first: tuple[Samples, Samples], second: tuple[Samples, Samples]) -> tuple[Samples, Samples]:
    """Return the higher of two samples (height, time); if the heights are equal, the earlier sample.

    Equal heights of a recurring motion may still differ by rounding.
    """
    (height, when), (other_height, other_when) = first, second
    beaten = (other_height > height) | ((other_height == height) & (other_when < when))
    return jax.tree.map(partial(jnp.where, beaten), second, first)


@materialised
def _bends(push: Samples, h: Lane, third: Lane, fourth: Lane) -> tuple[Samples, Samples]:
    """Return upper bounds of w'' and of |w''| around each sample, as far as the neighbouring samples.

    Between two samples w'' differs from its chord by at most h^2/8 times `fourth`, the bound of |w''''|. Close to
    resonance, where a large free part and a large steady response nearly cancel, this is much sharper than a bound by
    `third`, the bound of |w'''|. Before the first sample and after the last one there is no chord, so `third` is used.
    """
    size, slack, change = jnp.abs(push), 0.125 * h * h * fourth, third * h

    def around(samples: Samples) -> Samples:
        inner = jnp.maximum(jnp.maximum(samples[:-2], samples[2:]), samples[1:-1]) + slack
        return jnp.concatenate([samples[:1] + change, inner, samples[-1:] + change])

    return around(push), around(size)


@materialised
def _update_crest(
    at: Pass, w: Samples, push: Samples, s: Samples, h: Lane, bounds: tuple[Lane, Lane], last: Lane
) -> Crest:
    """Return the record of the highest sample so far, updated by the samples up to index `last`.

    Where w'' < 0 around the highest sample, w has only one maximum there. Any other maximum counts for the bound
    `second`. `bounds` holds the bounds of the third and the fourth derivative of w. A maximum is at most half a step
    from a sample, and at most a whole step before the first sample of a pass.
    """
    most_bend, bend_size = materialise(_bends(push, h, *bounds))
    order = jnp.arange(SAMPLES, dtype=w.dtype)[:, None]
    candidates = materialise(jnp.where(order <= last, w, -jnp.inf))
    top, when = materialise(reduce_samples(_higher_of, (candidates, s)))
    former = at.crest
    better = materialise(top > former.height)
    when, height = materialise((jnp.where(better, when, former.when), jnp.where(better, top, former.height)))
    # Largest possible value of w around each sample: |w''| times half the squared distance to the maximum.
    hidden = materialise(candidates + jnp.where(order == 0, 0.5, 0.125) * h * h * bend_size)
    near = jnp.abs(s - when) < 2.5 * h
    around = near & (most_bend < 0)
    distant = -smallest_sample(materialise(jnp.where(around, jnp.inf, -hidden)))
    former_bound = jnp.where(better & (when - former.when > 2.5 * h), former.most, 0.0)
    second = jnp.maximum(former.second, jnp.maximum(distant, former_bound))
    most = jnp.where(better, -smallest_sample(materialise(jnp.where(near, -hidden, jnp.inf))), former.most)
    return Crest(when, jnp.where(better, h, former.step), height, most, second)


class _ContactResult(NamedTuple):
    """Result of a contact in every lane."""

    duration: Lane
    out: Lane
    depth: Lane | None
    work: Lane | None
    tangent: tuple[Lane, Lane, Lane, Lane] | None
    certified: Mask


def sampled_step(
    pair: ImpactPair,
    lane: BallState,
    arrival: Arrival | None = None,
    *,
    sample_flights: bool = False,
    deep: bool = False,
    work: bool = False,
    tangent: bool = False,
) -> tuple[LaneImpact, Mask]:
    """Advance every lane by one impact by certified sampling.

    Args:
        pair: Cells, one per lane.
        lane: State of the ball in each lane.
        arrival: End of the flight from a cheaper method; None if there is none, and then all flights are sampled.
        sample_flights: If True, flights with an uncertified `arrival` are sampled; if False, such lanes are declined.
        deep: Also compute the largest depth.
        work: Also compute the work given to the membrane.
        tangent: Also compute the tangent map of the step, flight and saltations included.

    Returns:
        The impact, and for each lane whether it is certified.
    """
    flight, speed, side, certified = (
        arrival if arrival is not None and not sample_flights else _sampled_flight(pair, lane, arrival)
    )
    side = jnp.where(side < 0, -1.0, 1.0).astype(flight.dtype)
    onset_t, periods = flow.wrap_phase(lane.t + flight)
    onset_n, v_in = lane.n + periods, side * speed

    def rigid(wall: ImpactPair) -> _ContactResult:
        out, contact = wall.r * speed, None
        depth = speed * energy.rigid_depth(wall) if deep else None
        membrane_work = energy.membrane_work_rigid(v_in, wall.r) if work else None
        if tangent:
            push = flow.acceleration(pair.gamma, onset_t)
            contact = (-wall.r, jnp.zeros_like(out), (1 + wall.r) * push / v_in, -wall.r)
        return _ContactResult(
            jnp.zeros_like(speed), out, depth, membrane_work, contact, out > 10 * stick_speed(out.dtype)
        )

    def soft(wall: ImpactPair) -> _ContactResult:
        m, membrane_work, contact = flow.membrane(wall), None, None
        duration, out, depth, contact_certified = _sampled_contact(
            m, flow.contact_force(pair.gamma, side, onset_t), speed, deep
        )
        if work:
            membrane_work = energy.membrane_work(m.kappa, m.mu, pair.gamma, side, onset_t, duration, v_in, -side * out)
        if tangent:
            h, slope = flow.free_response(m, duration)
            contact = (slope, h, -m.kappa * m.kappa * h, slope + m.mu * h)
        return _ContactResult(duration, out, depth, membrane_work, contact, contact_certified)

    duration, out, depth, membrane_work, contact, contact_certified = pair.by_wall_kind(side, rigid, soft)
    certified = certified & contact_certified
    leave_t, periods = flow.wrap_phase(onset_t + duration)
    after = BallState(0.5 * side * pair.d, -side * out, leave_t, onset_n + periods)
    matrix = None if contact is None else compose_tangent(contact, flight)
    return LaneImpact(
        onset_t, onset_n, side, v_in, -side * out, flight, duration, after, depth, membrane_work, matrix
    ), certified
