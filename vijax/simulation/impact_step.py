"""One impact of every lane by the exact engine: the certified fast step, and two fallbacks for lanes that it declines.

`step` advances every lane by the fast step, which certifies its own result. A lane without a certificate is declined
and keeps its state. `request` collects the state of declined lanes, `sampled_answer` (fast fallback: certified
sampling) and `robust_answer` (robust fallback: the exact engine's full search) compute the impact, and `settle` writes
the answers back.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vijax.impact.exact import exact_step, sampled_step
from vijax.impact.fast import fast_step
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import Arrival, BallState, LaneImpact
from vijax.model.forcing.waves import mean_velocity, sine
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.runtime.arrays import not_none, select
from vijax.runtime.compilation import xla
from vijax.simulation.cell.cell import Cell, Event, Lane, Mask, Plan, Settings
from vijax.simulation.cell.cell_end import last_period
from vijax.simulation.cell.tally import add_event

# The end of a flight is sought up to this number of forcing periods after the last one. With fewer, a slow ball that
# flies towards a wall would be reported as a ball without an impact.
EXTRA_PERIODS = 64
# If a drifting ball takes more half periods of the forcing than this to cross the gap, the result is that no impact
# follows.
_MAX_CROSSING_TIME = 1e7


def step(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Advance every lane by one impact with the fast step; lanes without a certified result become `declined`."""
    pair, ball = cell.pair, cell.ball
    wall: Any = not_none(cell.wall)
    impact, arrival, certified, escapes = fast_step.fast_step(
        wall, pair.gamma, ball, deep=plan.deep, work=plan.work, tangent=plan.tangent
    )
    active = cell.running & ~cell.declined
    # The fast step starts in flight only: a ball that starts in contact is declined.
    free = active & (cell.mode == 0)
    no = jnp.zeros_like(active)
    event = Event(impact, free & certified, free & escapes, no, no)
    declined = active & ~(free & (certified | escapes))
    cell = replace(cell, declined=cell.declined | declined)
    if stores_arrival(plan):
        # A declined lane does not move, so every step computes the same arrival until a fallback computes the impact.
        cell = replace(cell, arrival=arrival)
    return add_event(plan, settings, cell, event)


def stores_arrival(plan: Plan) -> bool:
    """Return True if a declined lane stores the end of its flight, as it does with soft walls.

    With soft walls the fast step nearly always certifies the flight, and declines the contact.
    """
    return not plan.rigid


class Request(eqx.Module):
    """State of a lane that the fast step declined, as the fallbacks need it."""

    pair: ImpactPair
    ball: BallState
    mode: Lane  # side of the contact at the start, 0 in flight
    end: Lane  # last period of the window
    arrival: Arrival | None = None  # end of the flight, if the fast step has certified it


class Answer(eqx.Module):
    """Result of a request; a lane without a certified result requests the robust fallback next."""

    event: Event
    exit_only: Mask  # the contact began before the run: the ball moves to its exit, no impact is counted
    certified: Mask  # the answer is certified


def request(plan: Plan, settings: Settings, cell: Cell) -> Request:
    """Return the request of each lane."""
    return Request(cell.pair, cell.ball, cell.mode, last_period(plan, settings, cell), cell.arrival)


def sampled_answer(plan: Plan, request: Request) -> Answer:
    """Answer requests by certified sampling (fast fallback).

    On level ground (gamma = 0) the fast step certifies nearly all flights. On a CPU the few other flights are not
    sampled, but left to the robust fallback. On an accelerator they are sampled, because the robust fallback, with its
    nested loops, takes many times as long as sampling, even for a few lanes.
    """
    sample_flights = plan.gravity_regime is not GravityRegime.NONE or not xla.on_cpu()
    impact, certified = sampled_step.sampled_step(
        request.pair,
        request.ball,
        request.arrival,
        sample_flights=sample_flights,
        deep=plan.deep,
        work=plan.work,
        tangent=plan.tangent,
    )
    no = jnp.zeros_like(certified)
    certified = certified & (request.mode == 0)
    return Answer(Event(impact, certified, no, no, no), no, certified)


def robust_answer(plan: Plan, request: Request, *, rolled: bool = False) -> Answer:
    """Answer requests by `exact_step.step`, which certifies every lane (robust fallback); `rolled` is passed to it."""
    pair, ball, mode = request.pair, request.ball, request.mode
    horizon = 2 * (jnp.maximum(request.end - ball.n, 0.0) + EXTRA_PERIODS)
    state = State(ball.u, ball.v, ball.t, jnp.zeros(ball.n.shape, jnp.int32), mode.astype(jnp.int32))
    out = xla.map_lanes(exact_step.step)(pair, state, horizon, deep=plan.deep, rolled=rolled)
    matrix = None
    if plan.tangent:
        matrix_rows = exact_step.tangent_map(pair, out)
        matrix = (matrix_rows[0, 0], matrix_rows[0, 1], matrix_rows[1, 0], matrix_rows[1, 1])
    after = out.state
    # If a drifting ball reaches a wall only after the horizon, it counts as an impact at period inf, which ends the
    # window.
    late = out.no_impact & ~remains_in_gap(pair, mean_velocity(sine(ball.t), ball.v))
    impact = LaneImpact(
        onset_t=out.impact.t,
        onset_n=jnp.where(late, jnp.inf, ball.n + out.impact.n.astype(ball.n.dtype)),
        side=jnp.where(out.impact.side < 0, -1.0, 1.0).astype(ball.u.dtype),
        v_in=out.impact.v_in,
        v_out=out.impact.v_out,
        flight=out.flight,
        duration=out.contact_duration,
        after=BallState(after.u, after.v, after.t, ball.n + after.n.astype(ball.n.dtype)),
        depth=out.impact.depth if plan.deep else None,
        work=out.impact.work if plan.work else None,
        tangent=matrix,
    )
    event = Event(impact, (out.impact.side != 0) | late, out.no_impact & ~late, out.permanent, out.stuck)
    return Answer(event, (mode != 0) & ~out.permanent, jnp.ones_like(out.no_impact))


def remains_in_gap(pair: ImpactPair, mean_velocity: Lane) -> Mask:
    """Return True where a free flight with this mean velocity practically never leaves the gap."""
    return jnp.abs(mean_velocity) + jnp.abs(pair.gamma) < pair.d / _MAX_CROSSING_TIME


def settle(plan: Plan, settings: Settings, cell: Cell, answer: Answer, in_batch: Mask) -> Cell:
    """Write the answers of a batch of lanes (`in_batch`) into their cells, and count the impacts."""
    event, exit_only = answer.event, answer.exit_only & in_batch
    certified = in_batch & answer.certified
    event = Event(
        event.impact,
        event.real & certified,
        event.no_impact & certified,
        event.permanent & certified,
        event.stuck & certified,
    )
    cell = replace(
        cell,
        declined=cell.declined & ~certified,
        # A lane of the batch without a certified answer needs the robust fallback next.
        needs_robust=(cell.needs_robust | in_batch) & ~certified,
        ball=select(exit_only, event.impact.after, cell.ball),
        mode=jnp.where(exit_only, 0.0, cell.mode),
    )
    return add_event(plan, settings, cell, event)
