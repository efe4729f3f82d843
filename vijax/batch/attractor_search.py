"""The attractor of a cell: an impact that recurs, then rounds of Newton on the tangent map that confirm it or not."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.batch.cell import TANGENT_SCALE, Candidate, Cell, Lane, Mask, Plan, Settings, blank_tally
from vijax.batch.cell_end import chaotic, failed
from vijax.batch.chain import depart
from vijax.engine.impact import Ball, LaneImpact
from vijax.model import flow
from vijax.model.records import Status
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share

# Longest recurrence, in forcing periods, that counts as periodic; what takes longer is chaos, or undecided. With a
# larger one chaos comes back by chance more often, and each time costs a search.
MAX_PERIOD = 32
# Newton rounds on one candidate, each an orbit long. The digits double in each: what has none after so many is no
# orbit.
_ROUNDS = 8
# The same two for a late cell, whose periods are spent without a verdict. Its orbit may be long; and near a pitchfork,
# from as far off as the motion still is, Newton's first steps go but a third of the way.
_LATE_PERIOD, _LATE_ROUNDS = 128, 16
# A late cell's recurrence counts within so many times that of the slowest motion, `late_recurrence`.
_LATE_GAIN = 4.0
# Newton's steps of a late cell together move the ball by less than this (the gap is d wide), and are at most so many
# times as long as the way that they lead: with more of either they pass by the orbit that the motion comes to.
_LATE_REACH, _DETOUR = 0.1, 2.0
# A late cell is followed for such a share of its periods, to see whether it comes nearer to the orbit, by at least such
# a power of the multiplier: not by the first, as multipliers differ a little where the motion is.
_FOLLOWED_SHARE, _PACE = 0.25, 0.5
# The orbit of a late cell attracts by at least so much a round: otherwise it may be at its bifurcation.
_MARGIN = 1e-6
_SHORT = 8  # longest period, in forcing periods, of an orbit whose surroundings are taken to be wide
# Solving for Newton's step multiplies rounding. A step that stalls has arrived for that reason up to this multiple of
# the tolerance, and above it for another.
_GAIN = 1e3
# Newton's second step is below this part of the first one where the ball was within the orbit's reach.
_WITHIN = 0.3


def grain(settings: Settings) -> Float[Array, ""] | float:
    """Say how far apart a round from one point may end: not at all, unless a solver chooses its steps."""
    return 0.0 if settings.method is None else settings.method.grain


def recurrence(dtype, grain=0.0):
    """Say how closely an impact must recur to start a Newton round: 1e-6 in float64, more as the method is coarse."""
    return (1e-6 if dtype == jnp.float64 else 3e-3) + 100 * grain


def late_recurrence(periods):
    """Say how closely an impact must recur once the periods are spent: as that of the slowest motion does by then.

    At a pitchfork the distance x to the orbit shrinks by c x^3 a period: it is (2 c n)^(-1/2) after n periods, and the
    motion recurs to within c^(-1/2) (2 n)^(-3/2).
    """
    return _LATE_GAIN * (2 * periods) ** -1.5


def settled(dtype, grain=0.0):
    """Give the Newton correction below which an orbit is accepted, of u and u': 2e-12 in float64, 4e-6 in float32.

    In float32 that is nearer to rounding: an orbit accepted at the first look would keep the decay of a flip, which
    recurs sooner after two turns than after one, and have twice its period.
    """
    return (1e4 if dtype == jnp.float64 else 30.0) * float(jnp.finfo(dtype).eps) + grain


def blank_candidate(settings: Settings, like: Lane, ball: Ball) -> Candidate:
    """Make a search that has seen no impact yet."""
    zero, no = jnp.zeros_like(like), jnp.zeros(like.shape, bool)
    inf = jnp.full_like(like, jnp.inf)
    return Candidate(
        anchor_t=zero,
        anchor_n=zero,
        anchor_v=inf,
        anchor_count=zero,
        next_anchor=zero,
        tolerance=jnp.full_like(like, recurrence(like.dtype, grain(settings))),
        found=no,
        tracing=no,
        left=zero,
        length=zero,
        period=zero,
        prime=zero,
        base=ball,
        origin=ball,
        moved=zero,
        last=inf,
        rounds=zero,
        late=no,
        laps=zero,
        followed=no,
    )


def recur(settings: Settings, cell: Cell, impact: LaneImpact, kept: Mask, count: Lane):
    """Compare the impact with the anchor, an earlier one moved on by a quarter of the count; end rounds."""
    c = cell.candidate
    if c is None:
        return None, jnp.zeros_like(kept)
    lag = (impact.onset_n - c.anchor_n) + 0.5 * (impact.onset_t - c.anchor_t)  # counted in forcing periods
    period = jnp.round(lag)
    near = (2 * jnp.abs(lag - period) + jnp.abs(impact.v_in - c.anchor_v) < c.tolerance) & (period >= 1)
    found = kept & ~c.tracing & near & (period <= jnp.where(c.late, _LATE_PERIOD, MAX_PERIOD))
    fresh = kept & ~c.tracing & ~found & (count >= c.next_anchor)
    left = c.left - (kept & c.tracing).astype(c.left.dtype)
    finished = kept & c.tracing & (left <= 0)
    # On a round the anchor is the round's first impact.
    opening = kept & c.tracing & (c.left == c.length)
    again = kept & c.tracing & ~opening & (period >= 1) & (c.prime == c.period)
    same = 1e-2 * recurrence(lag.dtype, 100 * grain(settings))
    again = again & (2 * jnp.abs(lag - period) + jnp.abs(impact.v_in - c.anchor_v) < same)
    fresh, again, found = share((fresh | opening, again, found))
    candidate = replace(
        c,
        anchor_t=jnp.where(fresh, impact.onset_t, c.anchor_t),
        anchor_n=jnp.where(fresh, impact.onset_n, c.anchor_n),
        anchor_v=jnp.where(fresh, impact.v_in, c.anchor_v),
        anchor_count=jnp.where(fresh, count, c.anchor_count),
        next_anchor=jnp.where(fresh, count + 8 + jnp.floor(0.25 * count), c.next_anchor),
        found=c.found | found,
        left=left,
        length=jnp.where(found, count - c.anchor_count, c.length),
        period=jnp.where(found, period, c.period),
        prime=jnp.where(again, period, c.prime),
    )
    return candidate, found | finished


def review(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Decide about the cells that have stopped: start a round, judge one, or end."""
    stopped = ~cell.running & ~cell.done
    lost = failed(cell.status)
    if cell.candidate is None:
        return replace(cell, done=cell.done | stopped)
    c = cell.candidate
    start = stopped & c.found & ~lost
    judged = stopped & c.tracing & (c.left <= 0) & ~lost
    newton = _newton(cell)
    verdict = _judge(settings, cell, newton, judged)
    cell = _begin_round(plan, settings, cell, newton, verdict, start)
    cell = _back_to_search(plan, cell, verdict.bad, 10 * grain(settings))
    spent = stopped & ~start & ~judged & ~lost & _undecided(plan, cell)
    cell = _search_on(settings, cell, spent)
    goes_on = start | verdict.again | verdict.follow | verdict.approached | verdict.bad | spent
    confirmed = verdict.good | verdict.follow
    return replace(
        cell,
        done=cell.done | (stopped & ~goes_on),
        multiplier=jnp.where(confirmed, newton.largest, present(cell.multiplier)),
    )


class _Newton(NamedTuple):
    """What a finished round says of the orbit that it followed.

    Attributes:
        size: Newton's correction of the round's start, |u| + |v|; inf where the round tells nothing.
        u, v: Its components.
        largest: Modulus of the largest Floquet multiplier.
        gain: How many times larger a rounding of the round's end is in the correction.
        miss: How far the round's end is from its start, |u| + |v|.
    """

    size: Lane
    u: Lane
    v: Lane
    largest: Lane
    gain: Lane
    miss: Lane


class _Verdict(NamedTuple):
    """What becomes of cells that have flown a round; each is one of these.

    Attributes:
        good: The orbit is the attractor.
        again: Newton's method goes on, by another round.
        follow: It has arrived, but the motion had not: that is to be followed from where it was.
        approached: The motion was followed and comes nearer to the orbit, whose own round is then flown once more.
        bad: There is no orbit, or it is not what attracts the motion.
    """

    good: Mask
    again: Mask
    follow: Mask
    approached: Mask
    bad: Mask


def _judge(settings: Settings, cell: Cell, newton: _Newton, judged: Mask) -> _Verdict:
    """Judge the cells that have flown their round."""
    c, size, least = present(cell.candidate), newton.size, grain(settings)
    flown = judged & (c.laps > 1)
    judged = judged & ~flown
    close, far = settled(size.dtype, least), jnp.where(c.late, _LATE_REACH, 1e3 * recurrence(size.dtype, least))
    # Rounding leaves of a step what it gains in solving. A step that shrinks slowly for any other reason is not there
    # yet: near a flip, where the motion after two turns is nearly what it was, Newton gains but a third a round.
    arrived = (size < close) | ((size < close * jnp.clip(newton.gain, 1.0, _GAIN)) & (size > 0.25 * c.last))
    # A long orbit attracts from so near that chaos may pass it within the recurrence and go on. There Newton's second
    # step is no shorter than the first: the orbit is a real one, but the ball is not on its way to it.
    astray = (c.period > _SHORT) & (c.rounds == 1) & (size > jnp.maximum(_WITHIN * c.last, close))
    astray = astray | (c.late & ~_straight(c, newton))
    confirmed = judged & arrived & (newton.largest < jnp.where(c.late, 1 - _MARGIN, 1 + 1e-6)) & ~astray
    rounds = jnp.where(c.late, _LATE_ROUNDS, _ROUNDS)
    # Where a bounded, contracting Newton step leads nowhere near, the recurrence was a coincidence.
    hopeless = arrived | astray | ~(size + c.moved < far) | (c.rounds >= rounds)
    follow = confirmed & c.late & ~c.followed
    approached = flown & _comes_nearer(cell, newton, _GAIN * close)
    return _Verdict(
        good=confirmed & ~follow,
        again=judged & ~confirmed & ~hopeless,
        follow=follow,
        approached=approached,
        bad=(judged & ~confirmed & hopeless) | (flown & ~approached),
    )


def _newton(cell: Cell) -> _Newton:
    """Compute Newton's correction of the round's start, by the tangent map of the round."""
    c, tangent = present(cell.candidate), present(cell.tangent)
    grown = jnp.exp(present(cell.exponent) * jnp.log(TANGENT_SCALE))
    m = jnp.stack([jnp.stack(tangent[:2], -1), jnp.stack(tangent[2:], -1)], -2) * grown[:, None, None]
    # The round ended at an exit; fly on (or back) to the phase at which it began.
    rest = 2 * (c.base.n + c.laps * c.period - cell.ball.n) + (c.base.t - cell.ball.t)
    rise, v = flow.flight(flow.flight_force(cell.pair.gamma, cell.ball.t), cell.ball.v, rest)
    m = jax.vmap(flow.flight_matrix)(rest) @ m
    miss_u, miss_v = cell.ball.u + rise - c.base.u, v - c.base.v
    a, b, e, d = 1 - m[:, 0, 0], -m[:, 0, 1], -m[:, 1, 0], 1 - m[:, 1, 1]
    determinant = a * d - b * e
    safe = jnp.where(determinant == 0, jnp.nan, determinant)
    nudge_u, nudge_v = (d * miss_u - b * miss_v) / safe, (a * miss_v - e * miss_u) / safe
    gain = (jnp.abs(a) + jnp.abs(b) + jnp.abs(e) + jnp.abs(d)) / jnp.abs(safe)
    half_trace = 0.5 * (m[:, 0, 0] + m[:, 1, 1])
    product = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    spread = half_trace * half_trace - product
    largest = jnp.where(
        spread > 0, jnp.abs(half_trace) + jnp.sqrt(jnp.maximum(spread, 0.0)), jnp.sqrt(jnp.maximum(product, 0.0))
    )
    astray = jnp.where(jnp.abs(rest) < 0.05, 0.0, jnp.inf)
    size = jnp.abs(nudge_u) + jnp.abs(nudge_v) + astray
    miss = jnp.abs(miss_u) + jnp.abs(miss_v) + astray
    return _Newton(jnp.where(jnp.isfinite(size), size, jnp.inf), nudge_u, nudge_v, largest, gain, miss)


def _begin_round(plan: Plan, settings: Settings, cell: Cell, newton: _Newton, verdict: _Verdict, first: Mask) -> Cell:
    """Set lanes off on a round: from where they are, from the last round's start, corrected or as it was.

    Or on several, from where the search stood, to see whether the motion comes to the orbit.
    """
    c, size = present(cell.candidate), newton.size
    stepped = verdict.again | verdict.follow
    begin = first | stepped | verdict.approached
    corrected = Ball(c.base.u + newton.u, c.base.v + newton.v, c.base.t, c.base.n)
    base = choose(first, cell.ball, choose(stepped, corrected, c.base))
    one, zero = jnp.ones_like(size), jnp.zeros_like(size)
    many = jnp.maximum(jnp.ceil(_FOLLOWED_SHARE * settings.periods / jnp.maximum(c.period, 1.0)), 2.0)
    laps = jnp.where(begin, jnp.where(verdict.follow, many, 1.0), c.laps)
    candidate = replace(
        c,
        found=c.found & ~begin,
        tracing=c.tracing | begin,
        left=jnp.where(begin, laps * c.length, c.left),
        laps=laps,
        followed=(c.followed & ~first) | verdict.approached,
        prime=jnp.where(begin, c.period, c.prime),
        base=base,
        origin=choose(first, cell.ball, c.origin),
        moved=jnp.where(first, 0.0, jnp.where(stepped, c.moved + size, c.moved)),
        last=jnp.where(first, jnp.inf, jnp.where(stepped, size, c.last)),
        rounds=jnp.where(first, 0.0, jnp.where(stepped, c.rounds + 1, c.rounds)),
    )
    return replace(
        cell,
        candidate=candidate,
        ball=choose(begin, choose(verdict.follow, c.origin, base), cell.ball),
        tally=choose(begin, blank_tally(plan, size), cell.tally),
        tangent=choose(begin, (one, zero, zero, one), cell.tangent),
        exponent=choose(begin, zero, cell.exponent),
        running=cell.running | begin,
        relay=depart(cell, begin),
    )


def _back_to_search(plan: Plan, cell: Cell, bad: Mask, least: Float[Array, ""] | float) -> Cell:
    """Give up a candidate that is no attractor: go on from where the search stood, a hundred times more strictly.

    Newton may have taken the ball onto an orbit that repels, which it would leave only after hundreds of periods.
    What recurs to rounding and is none will not become one: the search is over, or it would hold the cell for
    thousands of periods, each failed round beginning its window anew.
    """
    c = present(cell.candidate)
    zero = jnp.zeros_like(cell.since)
    ball = choose(bad, c.origin, cell.ball)
    rounding = jnp.finfo(zero.dtype).eps
    tighter = jnp.where(c.tolerance > rounding, jnp.maximum(1e-2 * c.tolerance, jnp.maximum(least, rounding)), 0.0)
    candidate = replace(
        c,
        tracing=c.tracing & ~bad,
        tolerance=jnp.where(bad, tighter, c.tolerance),
        anchor_v=jnp.where(bad, jnp.inf, c.anchor_v),
        next_anchor=jnp.where(bad, cell.count, c.next_anchor),
    )
    return replace(
        cell,
        candidate=candidate,
        ball=ball,
        tally=choose(bad, blank_tally(plan, zero), cell.tally),
        # The round spoiled the window's sums: it starts again here.
        since=jnp.where(bad, jnp.maximum(cell.since, ball.n + 1), cell.since),
        batch=jnp.where(bad, -1.0, cell.batch),
        running=cell.running | bad,
    )


def _straight(c: Candidate, newton: _Newton) -> Mask:
    """Say whether Newton's steps lead from where the motion is, and contracts, to the orbit without turning back.

    If they do, no other orbit lies in between.
    """
    u, v = c.base.u + newton.u - c.origin.u, c.base.v + newton.v - c.origin.v
    return (c.moved + newton.size < _DETOUR * (jnp.abs(u) + jnp.abs(v))) & ((c.rounds > 0) | (newton.largest < 1))


def _comes_nearer(cell: Cell, newton: _Newton, least: float) -> Mask:
    """Say whether a motion that was followed has come nearer to the orbit, at the pace of its multiplier or faster."""
    c = present(cell.candidate)
    before = jnp.abs(c.origin.u - c.base.u) + jnp.abs(c.origin.v - c.base.v)
    shrunk = jnp.exp(_PACE * c.laps * jnp.log(present(cell.multiplier)))
    return newton.miss < jnp.maximum(before * shrunk, least)


def _undecided(plan: Plan, cell: Cell) -> Mask:
    """Say which cells that have spent their periods may search on.

    What a chained cell hands on is its state at a period that is known beforehand.
    """
    waits = ~present(cell.candidate).late & (cell.status == Status.OK) & ~chaotic(cell)
    return waits & (not plan.chained)


def _search_on(settings: Settings, cell: Cell, spent: Mask) -> Cell:
    """Let cells whose periods are spent without a verdict run on for a while, content with a coarser recurrence.

    Near a bifurcation motion takes thousands of periods to recur to the sixth digit, but Newton finds from afar what
    it comes to.
    """
    c = present(cell.candidate)
    candidate = replace(
        c,
        late=c.late | spent,
        tolerance=jnp.where(spent, jnp.maximum(c.tolerance, late_recurrence(settings.periods)), c.tolerance),
        anchor_v=jnp.where(spent, jnp.inf, c.anchor_v),
        next_anchor=jnp.where(spent, cell.count, c.next_anchor),
    )
    return replace(cell, candidate=candidate, running=cell.running | spent)
