"""Search for the attractor of a cell: a recurrent impact, then Newton rounds that confirm or reject its orbit.

An impact recurs if it has the phase and v_in of the anchor, an earlier impact, within a tolerance. The impacts between
them are the candidate orbit. The cell then follows the candidate orbit from one impact for one period of the orbit (a
round). With the round's map F, its tangent map M and its start x, Newton's correction of the start is

    x_new = x + (I - M)^(-1) (F(x) - x)

`round_decision` decides from the size of the correction and the multipliers of M; `review` applies the decision.
"""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.impact.impact import BallState, LaneImpact
from vijax.model.records import Status
from vijax.runtime.arrays import not_none, round_half_up, select
from vijax.runtime.compilation.xla import materialise
from vijax.simulation.attractor.round_decision import Correction, RoundDecision, correction, decide
from vijax.simulation.attractor.search_tolerances import (
    LATE_PERIOD,
    MAX_PERIOD,
    late_tolerance,
    recurrence_tolerance,
    repeatability_of,
)
from vijax.simulation.cell.cell import (
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
from vijax.simulation.cell.cell_end import chaotic, failed, few_impacts, last_period
from vijax.simulation.cell.chain import depart

# A late cell, which has spent its periods without a decision, is followed for this share of `periods`, to test whether
# its motion approaches the orbit of Newton's method.
_FOLLOWED_SHARE = 0.25


def blank_candidate(settings: Settings, like: Lane, ball: BallState) -> Candidate:
    """Return the state of a search before the first impact."""
    zero, no = jnp.zeros_like(like), jnp.zeros(like.shape, bool)
    inf = jnp.full_like(like, jnp.inf)
    return Candidate(
        anchor_t=zero,
        anchor_n=zero,
        anchor_v=inf,
        anchor_count=zero,
        next_anchor=zero,
        tolerance=jnp.full_like(like, recurrence_tolerance(like.dtype, repeatability_of(settings))),
        recurred=no,
        tracing=no,
        remaining=zero,
        length=zero,
        period=zero,
        prime=zero,
        round_start=ball,
        search_ball=ball,
        step_sum=zero,
        last_step=inf,
        rounds=zero,
        late=no,
        laps=zero,
        followed=no,
        extension=zero + 1,
    )


def recur(settings: Settings, cell: Cell, impact: LaneImpact, counted: Mask, count: Lane):
    """Compare the impact with the anchor, and count the impacts of rounds.

    The anchor moves to the current impact each time the number of impacts has grown by a quarter plus 8. The anchor
    thus leaves the transient, and periods up to MAX_PERIOD fit between two moves.

    Returns:
        The new candidate, and True for cells that stop for a review: an impact has recurred, or a round is complete.
    """
    c = cell.candidate
    if c is None:
        return None, jnp.zeros_like(counted)
    lag = (impact.onset_n - c.anchor_n) + 0.5 * (impact.onset_t - c.anchor_t)  # in forcing periods of T = 2
    period = round_half_up(lag)
    # Distance of the two impacts: phase difference plus difference of v_in.
    close = (2 * jnp.abs(lag - period) + jnp.abs(impact.v_in - c.anchor_v) < c.tolerance) & (period >= 1)
    recurred = counted & ~c.tracing & close & (period <= jnp.where(c.late, LATE_PERIOD, MAX_PERIOD))
    fresh = counted & ~c.tracing & ~recurred & (count >= c.next_anchor)
    remaining = c.remaining - (counted & c.tracing).astype(c.remaining.dtype)
    finished = counted & c.tracing & (remaining <= 0)
    # In a round the anchor is the first impact of this round.
    opening = counted & c.tracing & (c.remaining == c.length)
    # If the anchor recurs before the round is complete, the prime period of the orbit is shorter. Only the first such
    # recurrence counts.
    again = counted & c.tracing & ~opening & (period >= 1) & (c.prime == c.period)
    same = 1e-2 * recurrence_tolerance(lag.dtype, 100 * repeatability_of(settings))
    again = again & (2 * jnp.abs(lag - period) + jnp.abs(impact.v_in - c.anchor_v) < same)
    fresh, again, recurred = materialise((fresh | opening, again, recurred))
    candidate = replace(
        c,
        anchor_t=jnp.where(fresh, impact.onset_t, c.anchor_t),
        anchor_n=jnp.where(fresh, impact.onset_n, c.anchor_n),
        anchor_v=jnp.where(fresh, impact.v_in, c.anchor_v),
        anchor_count=jnp.where(fresh, count, c.anchor_count),
        next_anchor=jnp.where(fresh, count + 8 + jnp.floor(0.25 * count), c.next_anchor),
        recurred=c.recurred | recurred,
        remaining=remaining,
        length=jnp.where(recurred, count - c.anchor_count, c.length),
        period=jnp.where(recurred, period, c.period),
        prime=jnp.where(again, period, c.prime),
    )
    return candidate, recurred | finished


def review(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Decide about the stopped cells: start a round, evaluate a complete round, extend the run, or end the cell."""
    stopped = ~cell.running & ~cell.done
    is_failed = failed(cell.status)
    if cell.candidate is None:
        return replace(cell, done=cell.done | stopped)
    c = cell.candidate
    start = stopped & c.recurred & ~is_failed
    complete = stopped & c.tracing & (c.remaining <= 0) & ~is_failed
    newton_step = correction(cell, settings.method)
    decision = decide(settings, cell, newton_step, complete)
    cell = _begin_round(plan, settings, cell, newton_step, decision, start)
    cell = _back_to_search(plan, cell, decision.bad, 10 * repeatability_of(settings))
    out_of_periods = stopped & ~start & ~complete & ~is_failed & _undecided(plan, cell)
    cell = _search_on(settings, cell, out_of_periods)
    with_few_impacts = (
        stopped & ~start & ~complete & ~is_failed & ~out_of_periods & _has_few_impacts(plan, settings, cell)
    )
    cell = _run_on(plan, settings, cell, with_few_impacts)
    continues = (
        start
        | decision.again
        | decision.follow
        | decision.approached
        | decision.bad
        | out_of_periods
        | with_few_impacts
    )
    confirmed = decision.good | decision.follow
    return replace(
        cell,
        done=cell.done | (stopped & ~continues),
        multiplier=jnp.where(confirmed, newton_step.largest, not_none(cell.multiplier)),
    )


def _begin_round(
    plan: Plan, settings: Settings, cell: Cell, newton: Correction, decision: RoundDecision, first: Mask
) -> Cell:
    """Start a round: from the current state, from the last round's start, or from that start after Newton's correction.

    If the decision is to follow the motion, a cell instead starts from the state of the search and runs for several
    periods of the orbit, to test whether the motion approaches the orbit.
    """
    c, size = not_none(cell.candidate), newton.size
    stepped = decision.again | decision.follow
    begin = first | stepped | decision.approached
    corrected = BallState(c.round_start.u + newton.u, c.round_start.v + newton.v, c.round_start.t, c.round_start.n)
    round_start = select(first, cell.ball, select(stepped, corrected, c.round_start))
    unit, zero = jnp.ones_like(size), jnp.zeros_like(size)
    turns = jnp.maximum(jnp.ceil(_FOLLOWED_SHARE * settings.periods / jnp.maximum(c.period, 1.0)), 2.0)
    laps = jnp.where(begin, jnp.where(decision.follow, turns, 1.0), c.laps)
    candidate = replace(
        c,
        recurred=c.recurred & ~begin,
        tracing=c.tracing | begin,
        remaining=jnp.where(begin, laps * c.length, c.remaining),
        laps=laps,
        followed=(c.followed & ~first) | decision.approached,
        prime=jnp.where(begin, c.period, c.prime),
        round_start=round_start,
        search_ball=select(first, cell.ball, c.search_ball),
        step_sum=jnp.where(first, 0.0, jnp.where(stepped, c.step_sum + size, c.step_sum)),
        last_step=jnp.where(first, jnp.inf, jnp.where(stepped, size, c.last_step)),
        rounds=jnp.where(first, 0.0, jnp.where(stepped, c.rounds + 1, c.rounds)),
    )
    return replace(
        cell,
        candidate=candidate,
        ball=select(begin, select(decision.follow, c.search_ball, round_start), cell.ball),
        tally=select(begin, blank_tally(plan, size), cell.tally),
        tangent=select(begin, (unit, zero, zero, unit), cell.tangent),
        exponent=select(begin, zero, cell.exponent),
        running=cell.running | begin,
        chain_state=depart(cell, begin),
    )


def _back_to_search(plan: Plan, cell: Cell, rejected: Mask, repeatability: Float[Array, ""] | float) -> Cell:
    """Reject a candidate: continue from the state of the search, with a tolerance 100 times smaller.

    Newton's method may have moved the ball onto a repelling orbit, which it would leave only after hundreds of periods.
    If the motion already recurs to rounding, a smaller tolerance cannot help: the tolerance becomes 0 and the search
    ends. If the search continued, each failed round would restart the window, and the cell would run for thousands of
    periods.
    """
    c = not_none(cell.candidate)
    zero = jnp.zeros_like(cell.since)
    ball = select(rejected, c.search_ball, cell.ball)
    rounding = jnp.finfo(zero.dtype).eps
    tighter = jnp.where(
        c.tolerance > rounding, jnp.maximum(1e-2 * c.tolerance, jnp.maximum(repeatability, rounding)), 0.0
    )
    candidate = replace(
        c,
        tracing=c.tracing & ~rejected,
        tolerance=jnp.where(rejected, tighter, c.tolerance),
        anchor_v=jnp.where(rejected, jnp.inf, c.anchor_v),
        next_anchor=jnp.where(rejected, cell.count, c.next_anchor),
    )
    return replace(
        cell,
        candidate=candidate,
        ball=ball,
        tally=select(rejected, blank_tally(plan, zero), cell.tally),
        # The rejected round has replaced the sums of the window, so the window starts again at the current period.
        since=jnp.where(rejected, jnp.maximum(cell.since, ball.n + 1), cell.since),
        batch=jnp.where(rejected, -1.0, cell.batch),
        running=cell.running | rejected,
    )


def _undecided(plan: Plan, cell: Cell) -> Mask:
    """Return True for cells that have spent their periods and may continue the search.

    Chained cells never continue, because the next cell of the chain needs the state at a fixed period.
    """
    may_wait = ~not_none(cell.candidate).late & (cell.status == Status.OK) & ~chaotic(cell)
    return may_wait & (not plan.chained)


def _has_few_impacts(plan: Plan, settings: Settings, cell: Cell) -> Mask:
    """Return True for aperiodic cells that have too few impacts in their window and may run on."""
    candidate, window = not_none(cell.candidate), last_period(plan, settings, cell) - cell.since
    too_few = few_impacts(cell, window, ENOUGH_IMPACTS)
    aperiodic = (cell.status == Status.OK) & ~candidate.tracing & chaotic(cell) & too_few
    return aperiodic & (candidate.extension < LONGEST_RUN) & (not plan.chained)


def _run_on(plan: Plan, settings: Settings, cell: Cell, selected: Mask) -> Cell:
    """Continue cells with too few impacts: with a longer window that begins at the end of the old one."""
    candidate, zero = not_none(cell.candidate), jnp.zeros_like(cell.since)
    return replace(
        cell,
        candidate=replace(candidate, extension=jnp.where(selected, RUN_ON * candidate.extension, candidate.extension)),
        tally=select(selected, blank_tally(plan, zero), cell.tally),
        since=jnp.where(selected, last_period(plan, settings, cell), cell.since),
        batch=jnp.where(selected, -1.0, cell.batch),
        running=cell.running | selected,
    )


def _search_on(settings: Settings, cell: Cell, selected: Mask) -> Cell:
    """Let cells that have spent their periods without a decision continue, with a larger recurrence tolerance.

    Near a bifurcation the motion takes thousands of periods to recur to six digits, but Newton's method converges to
    the orbit that it approaches from a large distance.
    """
    c = not_none(cell.candidate)
    candidate = replace(
        c,
        late=c.late | selected,
        tolerance=jnp.where(selected, jnp.maximum(c.tolerance, late_tolerance(settings.periods)), c.tolerance),
        anchor_v=jnp.where(selected, jnp.inf, c.anchor_v),
        next_anchor=jnp.where(selected, cell.count, c.next_anchor),
    )
    return replace(cell, candidate=candidate, running=cell.running | selected)
