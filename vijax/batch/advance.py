"""One impact of every lane by the exact engine: the quick step, a service for what it declines."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vijax.batch.cell import Cell, Event, Lane, Mask, Plan, Settings
from vijax.batch.cell_end import last_period
from vijax.batch.tally import add_event
from vijax.engine import exact, quick, sampled
from vijax.engine.ground import Ground
from vijax.engine.impact import Arrival, Ball, LaneImpact
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.waves import mean_velocity, sine
from vijax.runtime import xla
from vijax.runtime.arrays import choose, present

# Forcing periods beyond the last one in which the end of a flight is still looked for. With fewer, a slow ball that has
# a wall ahead of it is told to meet none.
QUIET = 64
# Half periods of the forcing that a ball which only drifts takes to cross the gap if it is to count as meeting no wall.
_FOR_EVER = 1e7


def step(plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Take every lane one impact on: by the quick step."""
    pair, ball = cell.pair, cell.ball
    wall: Any = present(cell.wall)
    impact, arrival, sure, never = quick.quick_step(
        wall, pair.gamma, ball, deep=plan.deep, work=plan.work, tangent=plan.tangent
    )
    active = cell.running & ~cell.declined
    free = active & (cell.held == 0)
    no = jnp.zeros_like(active)
    event = Event(impact, free & sure, free & never, no, no)
    declined = active & ~(free & (sure | never))
    cell = replace(cell, declined=cell.declined | declined)
    if knows_arrival(plan):
        # A lane that is declined stays where it is: until it is served every step finds the same arrival.
        cell = replace(cell, arrival=arrival)
    return add_event(plan, settings, cell, event)


def knows_arrival(plan: Plan) -> bool:
    """Say whether a declined lane's flight is known: of soft walls it is nearly always the contact that is declined."""
    return not plan.rigid


class Request(eqx.Module):
    """What a lane that the quick step declined hands over to be served."""

    pair: ImpactPair
    ball: Ball
    held: Lane
    end: Lane  # last period
    arrival: Arrival | None = None  # where the flight ends, if that is known


class Answer(eqx.Module):
    """What became of a request; a lane whose answer is not sure asks again, for the careful step."""

    event: Event
    left: Mask  # a contact that had no onset: the ball moves and nothing is counted
    sure: Mask


def request(plan: Plan, settings: Settings, cell: Cell) -> Request:
    """Say what serving each lane would need."""
    return Request(cell.pair, cell.ball, cell.held, last_period(plan, settings, cell), cell.arrival)


def sampled_answer(plan: Plan, request: Request) -> Answer:
    """Answer by certified sampling.

    On level ground the quick step is unsure of so few flights that none is sampled, but on an accelerator: there the
    careful step, loops within loops, takes many times as long as this one, however few lanes ask for it.
    """
    unsure = plan.ground is not Ground.LEVEL or not xla.on_cpu()
    impact, sure = sampled.sampled_step(
        request.pair,
        request.ball,
        request.arrival,
        unsure=unsure,
        deep=plan.deep,
        work=plan.work,
        tangent=plan.tangent,
    )
    no = jnp.zeros_like(sure)
    sure = sure & (request.held == 0)
    return Answer(Event(impact, sure, no, no, no), no, sure)


def careful_answer(plan: Plan, request: Request, *, rolled: bool = False) -> Answer:
    """Answer by `exact.step`, which is sure of every lane; `rolled` is as there."""
    pair, ball, held = request.pair, request.ball, request.held
    horizon = 2 * (jnp.maximum(request.end - ball.n, 0.0) + QUIET)
    state = State(ball.u, ball.v, ball.t, jnp.zeros(ball.n.shape, jnp.int32), held.astype(jnp.int32))
    out = xla.each(exact.step)(pair, state, horizon, deep=plan.deep, rolled=rolled)
    matrix = None
    if plan.tangent:
        rows = exact.tangent(pair, out)
        matrix = (rows[0, 0], rows[0, 1], rows[1, 0], rows[1, 1])
    after = out.state
    # A flight that drifts comes to a wall after the horizon.
    late = out.quiet & ~neutral(pair, mean_velocity(sine(ball.t), ball.v))
    impact = LaneImpact(
        onset_t=out.impact.t,
        onset_n=jnp.where(late, jnp.inf, ball.n + out.impact.n.astype(ball.n.dtype)),
        side=jnp.where(out.impact.side < 0, -1.0, 1.0).astype(ball.u.dtype),
        v_in=out.impact.v_in,
        v_out=out.impact.v_out,
        flight=out.flight,
        duration=out.stay,
        after=Ball(after.u, after.v, after.t, ball.n + after.n.astype(ball.n.dtype)),
        depth=out.impact.depth if plan.deep else None,
        work=out.impact.work if plan.work else None,
        tangent=matrix,
    )
    event = Event(impact, (out.impact.side != 0) | late, out.quiet & ~late, out.permanent, out.stuck)
    return Answer(event, (held != 0) & ~out.permanent, jnp.ones_like(out.quiet))


def neutral(pair: ImpactPair, mean_velocity: Lane) -> Mask:
    """Say whether a flight that nothing stops stays within the gap for as good as ever."""
    return jnp.abs(mean_velocity) + jnp.abs(pair.gamma) < pair.d / _FOR_EVER


def settle(plan: Plan, settings: Settings, cell: Cell, answer: Answer, served: Mask) -> Cell:
    """Give the cells with the answers of those that were served."""
    event, left = answer.event, answer.left & served
    ours = served & answer.sure
    event = Event(event.impact, event.real & ours, event.quiet & ours, event.permanent & ours, event.stuck & ours)
    cell = replace(
        cell,
        declined=cell.declined & ~ours,
        hard=(cell.hard | served) & ~ours,
        ball=choose(left, event.impact.after, cell.ball),
        held=jnp.where(left, 0.0, cell.held),
    )
    return add_event(plan, settings, cell, event)
