"""One cell from start to summary: transient, attractor test, Newton polish, and the folds of its impacts.

Every cell is a small state machine on its lane. It searches until an impact recurs, then follows the candidate orbit
from one impact around to the next, adding up its measures and its tangent map; Newton's step on that map either
confirms the orbit (the sums of the last round are the answer) or sends the cell back to search, more sceptical. A cell
that reaches its last period without an orbit reports averages over the window since its transient.
"""

from functools import lru_cache, partial
from importlib import import_module
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vijax import energy, exact, flow, lanes, quick, sampled
from vijax.method import Method, Ode, Passage
from vijax.model import Harvester, ImpactPair, State, Status
from vijax.quick import Hit, Lanes, Wall

Lane = Float[Array, "lane"]
Mask = Bool[Array, "lane"]

MAX_PERIOD = 32  # longest recurrence, in forcing periods, that counts as periodic
TRANSIENT_SHARE = 0.25  # of the periods that a cell without an orbit leaves out of its averages
_BATCHES = 24  # batch means behind a standard error
_BUDGET = 512  # impacts per period before a cell is stopped
_ROUNDS = 8  # Newton rounds on one candidate
_CHAOS = 7.0  # growth of the tangent map, in powers of e, that a transient of a periodic orbit does not reach
_QUIET = 64  # periods beyond the last one in which the end of a flight is still looked for
_FOR_EVER = 1e7  # half periods
_STEPS = 20_000  # steps per period before a cell of a stepping engine is stopped
_SCALE = 2.0**40  # the tangent map is kept between 1/_SCALE and _SCALE, the rest in an exponent

ENERGY = frozenset({"P", "P_stderr", "energy_ratio"})
DEEP = ENERGY | {"deepest"}


class Scale(eqx.Module):
    """SI size of the units of every cell, times the variants that share its dynamics.

    Metres per unit of depth of variant m of cell i: length[i] length_variant[m]; a rigid wall's depth is that of
    kappa = 1, so its length is divided by kappa. Metres per second per unit of speed: likewise.
    """

    length: Float[Array, "cell"]
    speed: Float[Array, "cell"]
    length_variant: Float[Array, "variant"]
    speed_variant: Float[Array, "variant"]


class Summary(eqx.Module):
    """What is kept of every cell; nondimensional unless said. Fields not asked for are None."""

    P: Float[Array, "cell variant"] | None  # J per half period
    P_stderr: Float[Array, "cell variant"] | None
    energy_ratio: Float[Array, "cell variant"] | None  # largest E_j/W_j
    deepest: Float[Array, "cell"] | None
    fastest: Float[Array, "cell"]
    period: Int[Array, "cell"]
    impacts_left: Int[Array, "cell"]
    impacts_right: Int[Array, "cell"]
    impacts_per_period: Float[Array, "cell"]
    restitution: Float[Array, "cell"]
    restitution_left: Float[Array, "cell"]
    restitution_right: Float[Array, "cell"]
    contact_time: Float[Array, "cell"]
    contact_fraction: Float[Array, "cell"]
    lyapunov: Float[Array, "cell"] | None
    periods_run: Float[Array, "cell"]
    status: Int[Array, "cell"]


class Plan(eqx.Module):
    """What a run is asked for: the static choices that select a compiled program."""

    until: str = eqx.field(static=True)
    stepping: str | None = eqx.field(static=True)  # the room of the stepping engine, None for the exact one
    rigid: bool = eqx.field(static=True)
    level: bool = eqx.field(static=True)  # gamma = 0 everywhere
    deep: bool = eqx.field(static=True)
    energies: bool = eqx.field(static=True)
    tangent: bool = eqx.field(static=True)
    variants: int = eqx.field(static=True)


class Settings(eqx.Module):
    """What a run is asked for: the traced numbers."""

    periods: Float[Array, ""]
    transient: Float[Array, ""]
    device: Harvester
    method: Method | None
    length_variant: Float[Array, "variant"]
    speed_variant: Float[Array, "variant"]


class Tally(eqx.Module):
    """Sums over the impacts of a window or of one round of a candidate orbit."""

    left: Lane
    right: Lane
    rebound_left: Lane  # sum of -v_out/v_in
    rebound_right: Lane
    contact: Lane
    fastest: Lane
    deepest: Lane | None
    energy: Float[Array, "lane variant"] | None  # of the running batch
    energy_past: Float[Array, "lane variant"] | None  # of the full batches
    energy_square: Float[Array, "lane variant"] | None  # of their sums, squared
    ratio: Float[Array, "lane variant"] | None
    stuck: Mask | None


class Candidate(eqx.Module):
    """The recurrence test and the Newton rounds of an attractor search."""

    anchor_t: Lane
    anchor_n: Lane
    anchor_v: Lane
    anchor_count: Lane
    next_anchor: Lane
    tolerance: Lane
    found: Mask  # a recurrence waits for review
    tracing: Mask  # on a round of a candidate orbit
    left: Lane  # impacts still to come in this round, or that a round will have
    length: Lane  # impacts of a round
    period: Lane
    prime: Lane  # smallest recurrence seen on this round: a flip's slow decay recurs sooner after two turns than one
    base: Lanes
    moved: Lane
    last: Lane
    rounds: Lane


class Course(eqx.Module):
    """A lane of a stepping engine: its wall, the engine's carry, and the last impact if it waits to be folded."""

    wall: Any
    carry: Any
    waits: Mask
    passage: Passage


class Cell(eqx.Module):
    """A lane's cell: parameters, where the ball is, and what has been seen."""

    pair: ImpactPair
    wall: Wall | None
    course: Course | None
    length: Lane
    speed: Lane
    ball: Lanes
    held: Lane  # mode of a start in contact
    running: Mask
    declined: Mask
    hard: Mask  # declined by sampling too
    done: Mask
    status: Int[Array, "lane"]
    count: Lane  # impacts so far
    since: Lane  # first period of the window
    batch: Lane  # running batch of the window, -1 before it
    tally: Tally
    candidate: Candidate | None
    tangent: tuple[Lane, Lane, Lane, Lane] | None
    exponent: Lane | None
    multiplier: Lane | None


class _Event(eqx.Module):
    """A hit with what only the careful step can meet: nothing within the horizon, a contact for ever, sticking."""

    hit: Hit
    real: Mask  # an onset was seen
    quiet: Mask
    permanent: Mask
    stuck: Mask


# --- loading --------------------------------------------------------------------------------------


def _tally(plan: Plan, like: Lane) -> Tally:
    zero = jnp.zeros_like(like)
    wide = jnp.zeros((*like.shape, plan.variants), like.dtype) if plan.energies else None
    stuck = jnp.zeros(like.shape, bool) if plan.rigid else None
    deepest = zero if plan.deep else None
    return Tally(zero, zero, zero, zero, zero, zero, deepest, wide, wide, wide, wide, stuck)


def _candidate(settings: Settings, like: Lane, ball: Lanes) -> Candidate:
    zero, no = jnp.zeros_like(like), jnp.zeros(like.shape, bool)
    inf = jnp.full_like(like, jnp.inf)
    tolerance = jnp.full_like(like, _recurrence(like.dtype, _grain(settings)))
    return Candidate(zero, zero, inf, zero, zero, tolerance, no, no, zero, zero, zero, zero, ball, zero, inf, zero)


def _grain(settings: Settings) -> Float[Array, ""] | float:
    """How far a round started from one point may end apart: nothing but where a solver chooses its steps."""
    return settings.method.rtol if isinstance(settings.method, Ode) else 0.0


def _recurrence(dtype, grain=0.0):
    """How closely an impact must recur to start a Newton round: 1e-6 in float64, and more as the method is coarse."""
    return (1e-6 if dtype == jnp.float64 else 3e-3) + 100 * grain


def _settled(dtype, grain=0.0):
    """Newton correction below which an orbit is accepted, in units of u and u': 2e-12 in float64, likewise."""
    return 1e4 * float(jnp.finfo(dtype).eps) + grain


def _load(plan: Plan, settings: Settings, rows: Float[Array, "lane in"]) -> Cell:
    """Fresh cells from rows (d, kappa, r, gamma, length, speed, u0, v0)."""
    d, kappa, r, gamma, length, speed, u, v = rows.T
    pair = ImpactPair(d, None if plan.rigid else kappa, r, gamma)
    zero, no = jnp.zeros_like(d), jnp.zeros(d.shape, bool)
    ball = Lanes(u, v, zero, zero)
    held = exact.start_mode(pair, u, v, zero)
    start = settings.transient + zero
    eye = (zero + 1, zero, zero, zero + 1) if plan.tangent else None
    attractor = plan.until == "attractor"
    return Cell(
        pair=pair,
        wall=quick.prepare(pair) if plan.level and plan.stepping is None else None,
        course=_set_off(plan, settings, pair, ball, held) if plan.stepping else None,
        length=length,
        speed=speed,
        ball=ball,
        held=held,
        running=~no,
        declined=no,
        hard=no,
        done=no,
        status=jnp.zeros(d.shape, jnp.int32),
        count=zero,
        since=start,
        batch=zero - 1,
        tally=_tally(plan, d),
        candidate=_candidate(settings, d, ball) if attractor else None,
        tangent=eye,
        exponent=zero if plan.tangent else None,
        multiplier=zero if plan.tangent else None,
    )


# --- trips ----------------------------------------------------------------------------------------


def _last_period(plan: Plan, settings: Settings, since: Lane) -> Lane:
    """Where the window of a cell ends; one that a failed round made begin late is a share of the periods long too."""
    if plan.until == "window":
        return settings.periods + settings.transient + jnp.zeros_like(since)
    return jnp.maximum(settings.periods, since + jnp.ceil(TRANSIENT_SHARE * settings.periods))


def _batch_length(plan: Plan, settings: Settings) -> Float[Array, ""]:
    window = settings.periods * (1.0 if plan.until == "window" else 1 - TRANSIENT_SHARE)
    return jnp.maximum(jnp.floor(window / _BATCHES), 1.0)


def _trip(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """One impact of every lane: by the quick step on level cells, by certified sampling with gravity."""
    pair, ball = cell.pair, cell.ball
    if plan.level:
        hit, sure, never = quick.quick_step(cell.wall, pair.gamma, ball, deep=plan.deep, tangent=plan.tangent)
    else:
        hit, sure = sampled.sampled_step(pair, ball, deep=plan.deep, tangent=plan.tangent)
        never = jnp.zeros_like(sure)
    active = cell.running & ~cell.declined
    free = active & (cell.held == 0)
    no = jnp.zeros_like(active)
    event = _Event(hit, free & sure, free & never, no, no)
    declined = active & ~(free & (sure | never))
    hard = cell.hard | declined if not plan.level else cell.hard  # sampling will not do better a second time
    cell = eqx.tree_at(lambda c: (c.declined, c.hard), cell, (cell.declined | declined, hard))
    return _fold(plan, settings, cell, event)


class _Request(eqx.Module):
    """What a lane that the quick step declined hands over to be served."""

    pair: ImpactPair
    ball: Lanes
    held: Lane
    end: Lane  # last period


class _Answer(eqx.Module):
    """What became of a request; a lane whose answer is not sure asks again, for the careful step."""

    event: _Event
    left: Mask  # a contact that had no onset: the ball moves and nothing is counted
    sure: Mask


def _request(plan: Plan, settings: Settings, cell: Cell) -> _Request:
    return _Request(cell.pair, cell.ball, cell.held, _last_period(plan, settings, cell.since))


def _sampled_answer(plan: Plan, request: _Request) -> _Answer:
    """Of level cells: where walls are soft it is the contact that the quick step declines nearly always."""
    arrival = None if plan.rigid else quick.arrive(0.5 * request.pair.d, request.ball)
    hit, sure = sampled.sampled_step(request.pair, request.ball, arrival, deep=plan.deep, tangent=plan.tangent)
    no = jnp.zeros_like(sure)
    sure = sure & (request.held == 0)
    return _Answer(_Event(hit, sure, no, no, no), no, sure)


def _careful_answer(plan: Plan, request: _Request) -> _Answer:
    """`exact.step` on every lane."""
    pair, ball, held = request.pair, request.ball, request.held
    horizon = 2 * (jnp.maximum(request.end - ball.n, 0.0) + _QUIET)
    state = State(ball.u, ball.v, ball.t, jnp.zeros(ball.n.shape, jnp.int32), held.astype(jnp.int32))
    out = jax.vmap(partial(exact.step, deep=plan.deep))(pair, state, horizon)
    matrix = None
    if plan.tangent:
        rows = jax.vmap(exact.tangent)(pair, out)
        matrix = (rows[:, 0, 0], rows[:, 0, 1], rows[:, 1, 0], rows[:, 1, 1])
    after = out.state
    # A flight that drifts comes to a wall after the horizon.
    late = out.quiet & ~_neutral(pair, ball)
    hit = Hit(
        onset_t=out.impact.t,
        onset_n=jnp.where(late, jnp.inf, ball.n + out.impact.n.astype(ball.n.dtype)),
        side=jnp.where(out.impact.side < 0, -1.0, 1.0).astype(ball.u.dtype),
        v_in=out.impact.v_in,
        v_out=out.impact.v_out,
        flight=out.flight,
        duration=out.stay,
        after=Lanes(after.u, after.v, after.t, ball.n + after.n.astype(ball.n.dtype)),
        depth=out.impact.depth if plan.deep else None,
        work=out.impact.work if plan.deep else None,
        tangent=matrix,
    )
    event = _Event(hit, (out.impact.side != 0) | late, out.quiet & ~late, out.permanent, out.stuck)
    return _Answer(event, (held != 0) & ~out.permanent, jnp.ones_like(out.quiet))


def _neutral(pair: ImpactPair, ball: Lanes) -> Mask:
    """Whether a flight that nothing stops stays within the gap for as good as ever."""
    drift = ball.v - jnp.sin(flow.PI * ball.t) / flow.PI
    return jnp.abs(drift) + jnp.abs(pair.gamma) < pair.d / _FOR_EVER


def _settle(plan: Plan, settings: Settings, cell: Cell, answer: _Answer, served: Mask) -> Cell:
    """The cells with the answers of those that were served."""
    event, left = answer.event, answer.left & served
    ours = served & answer.sure
    event = _Event(event.hit, event.real & ours, event.quiet & ours, event.permanent & ours, event.stuck & ours)
    cell = eqx.tree_at(
        lambda c: (c.declined, c.hard, c.ball, c.held),
        cell,
        (
            cell.declined & ~ours,
            (cell.hard | served) & ~ours,
            _where(left, event.hit.after, cell.ball),
            jnp.where(left, 0.0, cell.held),
        ),
    )
    return _fold(plan, settings, cell, event)


def _stepping(plan: Plan) -> ModuleType:
    """The room of the stepping engine, loaded when it is first asked for: diffrax takes a second."""
    return import_module(f"vijax.{plan.stepping}")


def _set_off(plan: Plan, settings: Settings, pair: ImpactPair, ball: Lanes, held: Lane) -> Course:
    """Lanes of a stepping engine at the start of a run or of a round."""
    engine, method = _stepping(plan), settings.method
    whole = ball.n.astype(jnp.int32)
    state = State(ball.u, ball.v, ball.t, whole, held.astype(jnp.int32))
    carry = jax.vmap(partial(engine.start, method, deep=plan.deep, tangent=plan.tangent))(pair, state)
    wall = jax.vmap(method.law.wall)(pair)
    _, passage, _ = jax.eval_shape(jax.vmap(partial(engine.step, method)), pair, wall, carry)
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), passage)
    return Course(wall, carry, jnp.zeros(ball.u.shape, bool), blank)


def _stepping_trip(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """One solver step of every lane. A finished impact waits for review; a lane that finishes another waits with it."""
    old = cell.course
    step = partial(_stepping(plan).step, settings.method)
    carry, passage, finished = flow.share(jax.vmap(step)(cell.pair, old.wall, old.carry))
    blocked = old.waits & finished
    new = Course(
        old.wall,
        _where(blocked, old.carry, carry),
        old.waits | finished,
        _where(finished & ~blocked, passage, old.passage),
    )
    return eqx.tree_at(lambda c: c.course, cell, new)


def _stepping_review(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Fold the impacts that wait, end flights and contacts that outlast the run, and review what has stopped."""
    course, carry, passage = cell.course, cell.course.carry, cell.course.passage
    impact, after = passage.impact, passage.after
    waits = course.waits & cell.running
    # A round of a candidate orbit may begin close to the end and go on beyond it.
    end = _last_period(plan, settings, cell.since)
    late = carry.n.astype(cell.count.dtype) - jnp.maximum(end, cell.ball.n)
    idle = cell.running & ~course.waits
    out = idle & (carry.mode == 0) & (late >= (_QUIET if cell.candidate is not None else 0))
    quiet = out & _neutral(cell.pair, cell.ball)
    permanent = idle & (carry.mode != 0) & (late >= _QUIET)
    hit = Hit(
        onset_t=impact.t,
        onset_n=jnp.where(out, jnp.inf, impact.n.astype(impact.t.dtype)),
        side=impact.side.astype(impact.t.dtype),
        v_in=impact.v_in,
        v_out=impact.v_out,
        flight=passage.flight,
        duration=impact.duration,
        after=Lanes(after.u, after.v, after.t, after.n.astype(after.t.dtype)),
        depth=jnp.where(permanent, carry.depth, impact.depth) if plan.deep else None,
        work=impact.work if plan.deep else None,
        tangent=passage.tangent,
    )
    cell = _fold(plan, settings, cell, _Event(hit, waits | (out & ~quiet), quiet, permanent, jnp.zeros_like(waits)))
    if plan.stepping == "ode":  # the steps of the other are counted by its clock
        spent = cell.running & (carry.steps.astype(cell.count.dtype) > _STEPS * (end + 1))
        status = jnp.where(spent, Status.EVENT_BUDGET, cell.status).astype(cell.status.dtype)
        cell = eqx.tree_at(lambda c: (c.running, c.status), cell, (cell.running & ~spent, status))
    stopped = ~cell.running
    cell = _review(plan, settings, cell)
    again = _set_off(plan, settings, cell.pair, cell.ball, jnp.zeros_like(cell.count))
    course = eqx.tree_at(lambda c: c.waits, course, jnp.zeros_like(waits))
    return eqx.tree_at(lambda c: c.course, cell, _where(stopped & cell.running, again, course))


def _where(mask: Mask, new, old):
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def _fold(plan: Plan, settings: Settings, cell: Cell, event: _Event) -> Cell:
    """Add one event to a cell."""
    hit = event.hit
    ended = event.quiet | event.permanent
    end = _last_period(plan, settings, cell.since)
    over = event.real & (hit.onset_n >= end)
    tracing = jnp.zeros_like(over) if cell.candidate is None else cell.candidate.tracing
    over = over & ~tracing
    kept = event.real & ~over & ~event.permanent
    status = jnp.where(event.quiet, Status.NO_IMPACT, cell.status)
    status = jnp.where(event.permanent, Status.PERMANENT_CONTACT, status).astype(cell.status.dtype)
    counted = kept & (tracing | (hit.onset_n >= cell.since))
    count = cell.count + kept.astype(cell.count.dtype)
    spent = count > _BUDGET * (end + 1)
    broken = event.real & ~jnp.isfinite(hit.v_out + hit.after.t)
    status = jnp.where(spent, Status.EVENT_BUDGET, jnp.where(broken, Status.NONFINITE, status))
    tangent, exponent = _extend_tangent(cell, hit, kept, counted)
    batch = jnp.where(counted & ~tracing, _batch_of(plan, settings, cell, hit), cell.batch)
    tally = _add(plan, settings, cell, hit, counted, batch, tracing, event.stuck)
    if plan.deep:
        # A contact for ever has a depth although no impact ends it.
        held = event.permanent & (hit.depth > tally.deepest)
        tally = eqx.tree_at(lambda t: t.deepest, tally, jnp.where(held, hit.depth, tally.deepest))
    candidate, found = _recur(settings, cell, hit, kept, count)
    stop = over | ended | spent | broken | found
    return eqx.tree_at(
        lambda c: (c.ball, c.running, c.status, c.count, c.batch, c.tally, c.candidate, c.tangent, c.exponent),
        cell,
        (
            _where(kept, hit.after, cell.ball),
            cell.running & ~stop,
            status.astype(cell.status.dtype),
            count,
            batch,
            tally,
            candidate,
            tangent,
            exponent,
        ),
        is_leaf=lambda x: x is None,
    )


def _batch_of(plan: Plan, settings: Settings, cell: Cell, hit: Hit) -> Lane:
    return jnp.floor((hit.onset_n - cell.since) / _batch_length(plan, settings))


def _extend_tangent(cell: Cell, hit: Hit, kept: Mask, counted: Mask):
    """Tangent map with the new step on the left; started afresh by the first impact of the window."""
    if cell.tangent is None:
        return None, None
    fresh = counted & (cell.batch < 0)
    if cell.candidate is not None:
        fresh = fresh & ~cell.candidate.tracing
    a, b, c, d = (jnp.where(fresh, unit, old) for unit, old in zip((1.0, 0.0, 0.0, 1.0), cell.tangent, strict=True))
    p, q, r, s = hit.tangent
    a, b, c, d = p * a + q * c, p * b + q * d, r * a + s * c, r * b + s * d
    size = jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d)
    shrink = jnp.where(size > _SCALE, 1 / _SCALE, jnp.where(size < 1 / _SCALE, _SCALE, 1.0))
    carried = jnp.where(size > _SCALE, 1.0, jnp.where(size < 1 / _SCALE, -1.0, 0.0))
    exponent = jnp.where(fresh, 0.0, cell.exponent)
    new = tuple(jnp.where(kept, x * shrink, old) for x, old in zip((a, b, c, d), cell.tangent, strict=True))
    return new, jnp.where(kept, exponent + carried, cell.exponent)


def _add(plan, settings, cell: Cell, hit: Hit, counted: Mask, batch: Lane, tracing: Mask, stuck: Mask) -> Tally:
    """The tally with one impact more; a batch that has ended is squared away first."""
    old = cell.tally
    left, right = counted & (hit.side < 0), counted & (hit.side > 0)
    rebound = -hit.v_out / jnp.where(hit.v_in == 0, 1.0, hit.v_in)
    speed = jnp.where(counted, jnp.abs(hit.v_in), 0.0)
    ratio = gain = past = square = None
    if plan.energies:
        metres = (hit.depth * cell.length)[:, None] * settings.length_variant
        speeds = cell.speed[:, None] * settings.speed_variant
        got = energy.harvested_energy(settings.device, metres)
        given = settings.device.m_b * speeds * speeds * hit.work[:, None]
        wide = counted[:, None]
        ratio = jnp.where(wide, jnp.maximum(old.ratio, energy.energy_ratio(got, given)), old.ratio)
        turned = (counted & ~tracing & (batch != cell.batch) & (cell.batch >= 0))[:, None]
        past = jnp.where(turned, old.energy_past + old.energy, old.energy_past)
        square = jnp.where(turned, old.energy_square + old.energy * old.energy, old.energy_square)
        gain = jnp.where(turned, 0.0, old.energy) + jnp.where(wide, got, 0.0)
    return Tally(
        left=old.left + left.astype(speed.dtype),
        right=old.right + right.astype(speed.dtype),
        rebound_left=old.rebound_left + jnp.where(left, rebound, 0.0),
        rebound_right=old.rebound_right + jnp.where(right, rebound, 0.0),
        contact=old.contact + jnp.where(counted, hit.duration, 0.0),
        fastest=jnp.maximum(old.fastest, speed),
        deepest=jnp.where(counted, jnp.maximum(old.deepest, hit.depth), old.deepest) if plan.deep else None,
        energy=gain,
        energy_past=past,
        energy_square=square,
        ratio=ratio,
        stuck=old.stuck | (counted & stuck) if plan.rigid else None,
    )


def _recur(settings: Settings, cell: Cell, hit: Hit, kept: Mask, count: Lane):
    """Compare the impact with the anchor, an earlier one moved on by a quarter of the count; end rounds."""
    c = cell.candidate
    if c is None:
        return None, jnp.zeros_like(kept)
    lag = (hit.onset_n - c.anchor_n) + 0.5 * (hit.onset_t - c.anchor_t)  # in periods
    period = jnp.round(lag)
    near = (2 * jnp.abs(lag - period) + jnp.abs(hit.v_in - c.anchor_v) < c.tolerance) & (period >= 1)
    found = kept & ~c.tracing & near & (period <= MAX_PERIOD)
    fresh = kept & ~c.tracing & ~found & (count >= c.next_anchor)
    left = c.left - (kept & c.tracing).astype(c.left.dtype)
    finished = kept & c.tracing & (left <= 0)
    # On a round the anchor is the round's first impact.
    opening = kept & c.tracing & (c.left == c.length)
    again = kept & c.tracing & ~opening & (period >= 1) & (c.prime == c.period)
    same = 1e-2 * _recurrence(lag.dtype, 100 * _grain(settings))
    again = again & (2 * jnp.abs(lag - period) + jnp.abs(hit.v_in - c.anchor_v) < same)
    fresh = fresh | opening
    return (
        Candidate(
            anchor_t=jnp.where(fresh, hit.onset_t, c.anchor_t),
            anchor_n=jnp.where(fresh, hit.onset_n, c.anchor_n),
            anchor_v=jnp.where(fresh, hit.v_in, c.anchor_v),
            anchor_count=jnp.where(fresh, count, c.anchor_count),
            next_anchor=jnp.where(fresh, count + 8 + jnp.floor(0.25 * count), c.next_anchor),
            tolerance=c.tolerance,
            found=c.found | found,
            tracing=c.tracing,
            left=left,
            length=jnp.where(found, count - c.anchor_count, c.length),
            period=jnp.where(found, period, c.period),
            prime=jnp.where(again, period, c.prime),
            base=c.base,
            moved=c.moved,
            last=c.last,
            rounds=c.rounds,
        ),
        found | finished,
    )


# --- review ---------------------------------------------------------------------------------------


def _review(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Decide about the cells that have stopped: start a round, judge one, or end."""
    stopped = ~cell.running & ~cell.done
    failed = (cell.status == Status.EVENT_BUDGET) | (cell.status == Status.NONFINITE)
    if cell.candidate is None:
        return eqx.tree_at(lambda c: c.done, cell, cell.done | stopped)
    c = cell.candidate
    start = stopped & c.found & ~failed
    judged = stopped & c.tracing & (c.left <= 0) & ~failed
    size, nudge_u, nudge_v, largest = _newton(plan, cell)
    grain = _grain(settings)
    close, far = _settled(size.dtype, grain), 1e3 * _recurrence(size.dtype, grain)
    settled = (size < close) | ((size < 1e3 * close) & (size > 0.25 * c.last))
    good = judged & settled & (largest < 1 + 1e-6)
    # Where a bounded, contracting Newton step leads nowhere near, the recurrence was a coincidence.
    bad = judged & ~good & (settled | ~(size + c.moved < far) | (c.rounds >= _ROUNDS))
    again = judged & ~good & ~bad
    cell = _begin_round(plan, cell, start | again, start, nudge_u, nudge_v, size)
    cell = _back_to_search(plan, cell, bad, 10 * grain)
    done = cell.done | (stopped & ~start & ~again & ~bad)
    return eqx.tree_at(lambda x: (x.done, x.multiplier), cell, (done, jnp.where(good, largest, cell.multiplier)))


def _newton(plan: Plan, cell: Cell):
    """Size and components of Newton's correction of the round's start, and the largest Floquet multiplier."""
    c = cell.candidate
    grown = jnp.exp(cell.exponent * jnp.log(_SCALE))
    m = jnp.stack([jnp.stack(cell.tangent[:2], -1), jnp.stack(cell.tangent[2:], -1)], -2) * grown[:, None, None]
    # The round ended at an exit; fly on (or back) to the phase at which it began.
    rest = 2 * (c.base.n + c.period - cell.ball.n) + (c.base.t - cell.ball.t)
    rise, v = jax.vmap(flow.flight)(cell.pair.gamma, cell.ball.t, cell.ball.v, rest)
    m = jax.vmap(flow.flight_matrix)(rest) @ m
    miss_u, miss_v = cell.ball.u + rise - c.base.u, v - c.base.v
    a, b, e, d = 1 - m[:, 0, 0], -m[:, 0, 1], -m[:, 1, 0], 1 - m[:, 1, 1]
    determinant = a * d - b * e
    safe = jnp.where(determinant == 0, jnp.nan, determinant)
    nudge_u, nudge_v = (d * miss_u - b * miss_v) / safe, (a * miss_v - e * miss_u) / safe
    half_trace = 0.5 * (m[:, 0, 0] + m[:, 1, 1])
    product = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    spread = half_trace * half_trace - product
    largest = jnp.where(
        spread > 0, jnp.abs(half_trace) + jnp.sqrt(jnp.maximum(spread, 0.0)), jnp.sqrt(jnp.maximum(product, 0.0))
    )
    size = jnp.abs(nudge_u) + jnp.abs(nudge_v) + jnp.where(jnp.abs(rest) < 0.05, 0.0, jnp.inf)
    return jnp.where(jnp.isfinite(size), size, jnp.inf), nudge_u, nudge_v, largest


def _begin_round(plan: Plan, cell: Cell, begin: Mask, first: Mask, nudge_u: Lane, nudge_v: Lane, size: Lane) -> Cell:
    """Set lanes off on a round: from where they are, or from the last round's start, corrected."""
    c = cell.candidate
    corrected = Lanes(c.base.u + nudge_u, c.base.v + nudge_v, c.base.t, c.base.n)
    base = _where(begin, _where(first, cell.ball, corrected), c.base)
    new = Candidate(
        anchor_t=c.anchor_t,
        anchor_n=c.anchor_n,
        anchor_v=c.anchor_v,
        anchor_count=c.anchor_count,
        next_anchor=c.next_anchor,
        tolerance=c.tolerance,
        found=c.found & ~begin,
        tracing=c.tracing | begin,
        left=jnp.where(begin, c.length, c.left),
        length=c.length,
        period=c.period,
        prime=jnp.where(begin, c.period, c.prime),
        base=base,
        moved=jnp.where(begin, jnp.where(first, 0.0, c.moved + size), c.moved),
        last=jnp.where(begin, jnp.where(first, jnp.inf, size), c.last),
        rounds=jnp.where(begin, jnp.where(first, 0.0, c.rounds + 1), c.rounds),
    )
    one, zero = jnp.ones_like(size), jnp.zeros_like(size)
    return eqx.tree_at(
        lambda x: (x.candidate, x.ball, x.tally, x.tangent, x.exponent, x.running),
        cell,
        (
            new,
            _where(begin, base, cell.ball),
            _where(begin, _tally(plan, size), cell.tally),
            _where(begin, (one, zero, zero, one), cell.tangent),
            _where(begin, zero, cell.exponent),
            cell.running | begin,
        ),
    )


def _back_to_search(plan: Plan, cell: Cell, bad: Mask, least: Float[Array, ""] | float) -> Cell:
    """A candidate that is no attractor: go on from where the round ended, with a tolerance a hundred times tighter."""
    c = cell.candidate
    zero = jnp.zeros_like(cell.since)
    new = eqx.tree_at(
        lambda x: (x.tracing, x.tolerance, x.anchor_v, x.next_anchor),
        c,
        (
            c.tracing & ~bad,
            jnp.where(bad, jnp.maximum(1e-2 * c.tolerance, least), c.tolerance),
            jnp.where(bad, jnp.inf, c.anchor_v),
            jnp.where(bad, cell.count, c.next_anchor),
        ),
    )
    return eqx.tree_at(
        lambda x: (x.candidate, x.tally, x.since, x.batch, x.running),
        cell,
        (
            new,
            _where(bad, _tally(plan, zero), cell.tally),
            # The round spoiled the window's sums: it starts again here.
            jnp.where(bad, jnp.maximum(cell.since, cell.ball.n + 1), cell.since),
            jnp.where(bad, -1.0, cell.batch),
            cell.running | bad,
        ),
    )


# --- results --------------------------------------------------------------------------------------


def _unload(plan: Plan, settings: Settings, cell: Cell) -> Summary:
    t = cell.tally
    attractor = cell.candidate is not None
    periodic = cell.candidate.tracing if attractor else jnp.zeros_like(cell.running)
    failed = (cell.status == Status.EVENT_BUDGET) | (cell.status == Status.NONFINITE)
    periodic = periodic & ~failed
    quiet, permanent = cell.status == Status.NO_IMPACT, cell.status == Status.PERMANENT_CONTACT
    end = _last_period(plan, settings, cell.since)
    window = end - cell.since
    span = jnp.where(periodic, cell.candidate.period if attractor else 1.0, window)
    hits = t.left + t.right
    silent = ~periodic & ~failed & ~permanent & ((hits == 0) | (quiet if attractor else False))
    still = silent | permanent
    status = jnp.where(silent, Status.NO_IMPACT, jnp.where(permanent | failed, cell.status, Status.OK))
    prime = cell.candidate.prime if attractor else span
    period = jnp.where(periodic, prime, -1.0)
    lyapunov = None
    if plan.tangent:
        size = sum(jnp.abs(x) for x in cell.tangent)
        growth = jnp.log(size) + cell.exponent * jnp.log(_SCALE)
        chaotic = growth > _CHAOS
        lyapunov = jnp.where(periodic, jnp.log(cell.multiplier) / span, growth / window)
        lyapunov = jnp.where(still | failed, jnp.nan, lyapunov)
        if attractor:
            period = jnp.where(periodic, prime, jnp.where(chaotic, 0.0, -1.0))
            status = jnp.where(~periodic & ~chaotic & ~still & ~failed, Status.SLOW, status)
    if attractor:
        period = jnp.where(still, 1.0, jnp.where(failed, -1.0, period))
    if plan.rigid:
        status = jnp.where(t.stuck & (status == Status.OK), Status.STICKING, status)

    def per(total, number):
        return jnp.where((number > 0) & ~still, total / jnp.where(number > 0, number, 1.0), jnp.nan)

    def measured(value):
        value = jnp.where(still, 0.0, value)
        return jnp.where(failed, jnp.nan, value)

    power = error = ratio = None
    if plan.energies:
        power, error = _power(plan, settings, cell, periodic, still, window, span)
        power, error = jnp.where(failed[:, None], jnp.nan, power), jnp.where(failed[:, None], jnp.nan, error)
        ratio = jnp.where(failed[:, None], jnp.nan, jnp.where(still[:, None], 0.0, t.ratio))
    ran = cell.ball.n + 0.5 * cell.ball.t
    labelled = periodic | (still & attractor)
    return Summary(
        P=power,
        P_stderr=error,
        energy_ratio=ratio,
        deepest=jnp.where(failed, jnp.nan, jnp.where(silent, 0.0, t.deepest)) if plan.deep else None,
        fastest=measured(t.fastest),
        period=period,
        impacts_left=jnp.where(labelled, jnp.where(still, 0.0, jnp.round(t.left * prime / span)), -1.0),
        impacts_right=jnp.where(labelled, jnp.where(still, 0.0, jnp.round(t.right * prime / span)), -1.0),
        impacts_per_period=measured(hits / span),
        restitution=per(t.rebound_left + t.rebound_right, hits),
        restitution_left=per(t.rebound_left, t.left),
        restitution_right=per(t.rebound_right, t.right),
        contact_time=per(t.contact, hits),
        contact_fraction=jnp.where(permanent, 1.0, measured(t.contact / (2 * span))),
        lyapunov=lyapunov,
        periods_run=jnp.where(periodic, ran, jnp.where(failed | still, jnp.minimum(ran, end), end)),
        status=status,
    )


def _power(plan, settings, cell: Cell, periodic: Mask, still: Mask, window: Lane, span: Lane):
    """Energy per half period, and its standard error by batch means (0 on an orbit)."""
    t = cell.tally
    length = _batch_length(plan, settings)
    batches = jnp.floor(window / length)
    last = (cell.batch < batches)[:, None]  # the running batch is a whole one: nothing came after it
    past = t.energy_past + jnp.where(last, t.energy, 0.0)
    square = t.energy_square + jnp.where(last, t.energy * t.energy, 0.0)
    number = jnp.maximum(batches, 1.0)[:, None]
    mean = past / number
    spread = jnp.maximum(square / number - mean * mean, 0.0) * number / jnp.maximum(number - 1, 1.0)
    error = jnp.sqrt(spread / number) / (2 * length)
    error = jnp.where((batches >= 2)[:, None], error, jnp.nan)
    power = (t.energy_past + t.energy) / (2 * span)[:, None]
    none = still[:, None]
    return jnp.where(none, 0.0, power), jnp.where(none | periodic[:, None], 0.0, error)


def _program(plan: Plan, settings: Settings) -> lanes.Program:
    program = lanes.Program(
        load=partial(_load, plan, settings),
        trip=partial(_stepping_trip if plan.stepping else _trip, plan, settings),
        review=partial(_stepping_review if plan.stepping else _review, plan, settings),
        stopped=lambda cell: ~cell.running,
        done=lambda cell: cell.done,
        unload=lambda cell: _pack(_unload(plan, settings, cell)),
    )
    if plan.stepping:
        return program
    return program._replace(
        service=lanes.Service(
            declined=lambda cell: cell.declined,
            hard=lambda cell: cell.hard,
            request=partial(_request, plan, settings),
            second=partial(_sampled_answer, plan) if plan.level else None,
            careful=partial(_careful_answer, plan),
            settle=partial(_settle, plan, settings),
        )
    )


def _pack(summary: Summary) -> Float[Array, "row out"]:
    """A summary as rows of one table: one write a cell."""
    leaves = jax.tree.leaves(summary)
    dtype = summary.impacts_per_period.dtype
    return jnp.concatenate([(x if x.ndim == 2 else x[:, None]).astype(dtype) for x in leaves], axis=1)


def _unpack(plan: Plan, table: Float[Array, "cell out"]) -> Summary:
    """The table of `_pack` as a summary again, counts and codes as integers."""
    column = 0

    def take(width: int | None):
        nonlocal column
        column += width or 1
        return table[:, column - 1] if width is None else table[:, column - width : column]

    def whole():
        return take(None).astype(jnp.int32)

    wide = plan.variants
    return Summary(
        P=take(wide) if plan.energies else None,
        P_stderr=take(wide) if plan.energies else None,
        energy_ratio=take(wide) if plan.energies else None,
        deepest=take(None) if plan.deep else None,
        fastest=take(None),
        period=whole(),
        impacts_left=whole(),
        impacts_right=whole(),
        impacts_per_period=take(None),
        restitution=take(None),
        restitution_left=take(None),
        restitution_right=take(None),
        contact_time=take(None),
        contact_fraction=take(None),
        lyapunov=take(None) if plan.tangent else None,
        periods_run=take(None),
        status=whole(),
    )


def _columns(plan: Plan) -> int:
    return 12 + 3 * plan.variants * plan.energies + plan.deep + plan.tangent


@lru_cache(maxsize=32)
def _compiled(plan: Plan, width: int):
    """The jitted program of a plan: a whole tile of cells in one call."""

    def tile(cells, count, settings):
        table = lanes.run(_program(plan, settings), cells, count, _columns(plan), width)
        return _unpack(plan, table)

    return jax.jit(tile, compiler_options=lanes.compiler_options())


def _width(cells: int, level: bool) -> int:
    """Lanes for a tile: enough to fill vectors and hide loop overhead, few enough to stay in cache and to refill.

    A sampled step holds some dozens of samples a lane.
    """
    return max(min(cells // 8, 512 if level else 256), 128)


def tolerances(dtype: str) -> dict[str, float]:
    """The tolerances that a run in the given precision uses, by name."""
    kind = jnp.dtype(dtype)
    return {
        "recurrence": _recurrence(kind),
        "orbit": _settled(kind),
        "stick_speed": exact.stick_speed(kind),
        "max_period": float(MAX_PERIOD),
    }


def summarise(
    pair: ImpactPair,
    u0: Float[Array, "cell"],
    v0: Float[Array, "cell"],
    scale: Scale,
    device: Harvester,
    *,
    periods: int = 400,
    until: str = "attractor",
    transient: int = 0,
    outputs: frozenset[str] = frozenset({"P"}),
    method: Method | None = None,
    count: int | None = None,
) -> Summary:
    """Run a tile of cells from phase 0, each until its attractor is certain or its window is over, in one jitted call.

    Args:
        pair: Cells; `kappa=None` for rigid walls.
        u0, v0: Starts.
        scale: SI sizes; see `Scale`.
        device: Electrical constants, mass and penetration limit.
        periods: Length of the window, or the most that the search for an attractor may take.
        until: "attractor" or "window".
        transient: Periods before the window ("window" only).
        outputs: Names of `Summary` fields that must be there; what only others need is not computed.
        method: The stepping method (`method.choose` makes it); None for the exact engine.
        count: How many cells are real, the rest being padding; all unless given.

    Returns:
        The summary; a cell that fails says so in `status` and holds NaN.
    """
    dtype = pair.d.dtype
    plan = Plan(
        until=until,
        stepping=None if method is None else "ode" if isinstance(method, Ode) else "rk4",
        rigid=pair.kappa is None,
        level=bool((np.asarray(pair.gamma) == 0).all()),
        deep=bool(outputs & DEEP),
        energies=bool(outputs & ENERGY),
        tangent=until == "attractor" or "lyapunov" in outputs,
        variants=scale.length_variant.shape[0],
    )
    kappa = jnp.ones_like(pair.d) if pair.kappa is None else pair.kappa
    cells = jnp.stack([pair.d, kappa, pair.r, pair.gamma, scale.length, scale.speed, u0, v0], axis=1)
    number = jnp.asarray(pair.d.shape[0] if count is None else count, jnp.int32)
    settings = Settings(
        periods=jnp.asarray(periods, dtype),
        transient=jnp.asarray(transient if until == "window" else jnp.floor(TRANSIENT_SHARE * periods), dtype),
        device=jax.tree.map(lambda x: jnp.asarray(x, dtype), device),
        method=jax.tree.map(lambda x: jnp.asarray(x, dtype), method),
        length_variant=scale.length_variant.astype(dtype),
        speed_variant=scale.speed_variant.astype(dtype),
    )
    return _compiled(plan, _width(pair.d.shape[0], plan.level))(cells, number, settings)
