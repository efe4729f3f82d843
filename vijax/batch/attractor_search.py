"""The attractor of a cell: an impact that recurs, then rounds of Newton on the tangent map that confirm it or not."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.batch.cell import (
    ENOUGH_IMPACTS,
    LONGEST_RUN,
    RUN_ON,
    Candidate,
    Cell,
    Lane,
    Mask,
    Plan,
    Settings,
    blank_tally,
)
from vijax.batch.cell_end import chaotic, failed, few_impacts, last_period
from vijax.batch.chain import depart
from vijax.batch.recurrence import LATE_PERIOD, MAX_PERIOD, grain, late_recurrence, recurrence
from vijax.batch.verdict import Correction, Verdict, correction, judge
from vijax.engine.impact import Ball, LaneImpact
from vijax.model.records import Status
from vijax.runtime.arrays import choose, nearest, present
from vijax.runtime.xla import share

# A late cell, whose periods are spent without a verdict, is followed for such a share of them, to see whether it comes
# nearer to the orbit that Newton's method found.
_FOLLOWED_SHARE = 0.25


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
        stretch=zero + 1,
    )


def recur(settings: Settings, cell: Cell, impact: LaneImpact, kept: Mask, count: Lane):
    """Compare the impact with the anchor, an earlier one moved on by a quarter of the count; end rounds."""
    c = cell.candidate
    if c is None:
        return None, jnp.zeros_like(kept)
    lag = (impact.onset_n - c.anchor_n) + 0.5 * (impact.onset_t - c.anchor_t)  # counted in forcing periods
    period = nearest(lag)
    near = (2 * jnp.abs(lag - period) + jnp.abs(impact.v_in - c.anchor_v) < c.tolerance) & (period >= 1)
    found = kept & ~c.tracing & near & (period <= jnp.where(c.late, LATE_PERIOD, MAX_PERIOD))
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
    newton = correction(cell, settings.method)
    verdict = judge(settings, cell, newton, judged)
    cell = _begin_round(plan, settings, cell, newton, verdict, start)
    cell = _back_to_search(plan, cell, verdict.bad, 10 * grain(settings))
    spent = stopped & ~start & ~judged & ~lost & _undecided(plan, cell)
    cell = _search_on(settings, cell, spent)
    few = stopped & ~start & ~judged & ~lost & ~spent & _lacks_impacts(plan, settings, cell)
    cell = _run_on(plan, settings, cell, few)
    goes_on = start | verdict.again | verdict.follow | verdict.approached | verdict.bad | spent | few
    confirmed = verdict.good | verdict.follow
    return replace(
        cell,
        done=cell.done | (stopped & ~goes_on),
        multiplier=jnp.where(confirmed, newton.largest, present(cell.multiplier)),
    )


def _begin_round(plan: Plan, settings: Settings, cell: Cell, newton: Correction, verdict: Verdict, first: Mask) -> Cell:
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


def _undecided(plan: Plan, cell: Cell) -> Mask:
    """Say which cells that have spent their periods may search on.

    What a chained cell hands on is its state at a period that is known beforehand.
    """
    waits = ~present(cell.candidate).late & (cell.status == Status.OK) & ~chaotic(cell)
    return waits & (not plan.chained)


def _lacks_impacts(plan: Plan, settings: Settings, cell: Cell) -> Mask:
    """Return which aperiodic cells have too few impacts in their window, and may run on."""
    candidate, window = present(cell.candidate), last_period(plan, settings, cell) - cell.since
    few = few_impacts(cell, window, ENOUGH_IMPACTS)
    lacks = (cell.status == Status.OK) & ~candidate.tracing & chaotic(cell) & few
    return lacks & (candidate.stretch < LONGEST_RUN) & (not plan.chained)


def _run_on(plan: Plan, settings: Settings, cell: Cell, few: Mask) -> Cell:
    """Continue cells whose window has too few impacts: with a longer window, which begins where that one ends."""
    candidate, zero = present(cell.candidate), jnp.zeros_like(cell.since)
    return replace(
        cell,
        candidate=replace(candidate, stretch=jnp.where(few, RUN_ON * candidate.stretch, candidate.stretch)),
        tally=choose(few, blank_tally(plan, zero), cell.tally),
        since=jnp.where(few, last_period(plan, settings, cell), cell.since),
        batch=jnp.where(few, -1.0, cell.batch),
        running=cell.running | few,
    )


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
