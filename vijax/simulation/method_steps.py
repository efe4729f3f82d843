"""Lanes of stepping methods: one step of every lane, and the review that adds the impacts that the steps completed."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from vijax.impact.impact import BallState, LaneImpact
from vijax.impact.method import Method
from vijax.model.forcing.waves import mean_velocity
from vijax.model.pair import ImpactPair
from vijax.model.records import State, Status
from vijax.model.walls.membrane import has_units, in_units
from vijax.runtime.arrays import not_none, select
from vijax.runtime.compilation.xla import materialise
from vijax.simulation.attractor.attractor_search import review
from vijax.simulation.cell.cell import Cell, Entry, Event, Lane, MethodState, Plan, Settings
from vijax.simulation.cell.cell_end import last_period, out_of_steps
from vijax.simulation.cell.tally import add_event
from vijax.simulation.impact_step import EXTRA_PERIODS, remains_in_gap

# Steps between two reviews. An impact takes at least a dozen steps; a lane that completes a second impact waits for the
# next review.
STEPS = 32


def start_method(method: Method, plan: Plan, of: Cell | Entry, ball: BallState, mode: Lane) -> MethodState:
    """Return the method's state at the start of a run or of a round."""
    pair = _with_law(method, of)
    integer = ball.n.astype(jnp.int32)
    state = State(ball.u, ball.v, ball.t, integer, mode.astype(jnp.int32))
    carry = jax.vmap(partial(method.start, deep=plan.deep, tangent=plan.tangent))(pair, state)
    wall = jax.vmap(method.walls)(pair)
    _, outcome, _ = jax.eval_shape(jax.vmap(method.step), pair, wall, carry)
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), outcome)
    return MethodState(wall, carry, jnp.zeros(ball.u.shape, bool), blank)


def _with_law(method: Method, of: Cell | Entry) -> ImpactPair:
    """Return the pairs of lanes, with the method's law in the units of each lane if the law has a dimension."""
    if not has_units(method.law):
        return of.pair
    return replace(of.pair, law=jax.vmap(partial(in_units, method.law))(of.length, of.speed))


def step(method: Method, cell: Cell) -> Cell:
    """Advance every lane by one step.

    A finished impact is stored until the next review. A lane that would finish a second impact before that review keeps
    its state instead.
    """
    old = not_none(cell.method_state)
    carry, outcome, finished = materialise(jax.vmap(method.step)(cell.pair, old.wall, old.carry))
    second_impact = old.pending & finished
    new = MethodState(
        old.wall,
        select(second_impact, old.carry, carry),
        old.pending | finished,
        select(finished & ~second_impact, outcome, old.outcome),
    )
    return replace(cell, method_state=new)


def review_steps(method: Method, plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Add the pending impacts, end flights and contacts that outlast the run, and review the stopped cells."""
    method_state = not_none(cell.method_state)
    carry, outcome = method_state.carry, method_state.outcome
    impact, after = outcome.impact, outcome.after
    has_impact = method_state.pending & cell.running
    # A round of a candidate orbit may begin close to the end of the window and continue beyond it.
    end = last_period(plan, settings, cell)
    overtime = carry.n.astype(cell.count.dtype) - jnp.maximum(end, cell.ball.n)
    idle = cell.running & ~method_state.pending
    unended_flight = idle & (carry.mode == 0) & (overtime >= (EXTRA_PERIODS if cell.candidate is not None else 0))
    # Under a forcing that does not repeat, no ball stays in the gap for ever.
    mean = mean_velocity(method.waves(cell.ball.t), cell.ball.v)
    remains = remains_in_gap(cell.pair, mean) & method.has_periodic_forcing
    no_impact = unended_flight & (remains | jax.vmap(method.is_at_rest)(cell.pair, carry))
    permanent = idle & (carry.mode != 0) & (overtime >= EXTRA_PERIODS)
    lane_impact = LaneImpact(
        onset_t=impact.t,
        onset_n=jnp.where(unended_flight, jnp.inf, impact.n.astype(impact.t.dtype)),
        side=impact.side.astype(impact.t.dtype),
        v_in=impact.v_in,
        v_out=impact.v_out,
        flight=outcome.flight,
        duration=impact.duration,
        after=BallState(after.u, after.v, after.t, after.n.astype(after.t.dtype)),
        depth=jnp.where(permanent, carry.depth, impact.depth) if plan.deep else None,
        work=impact.work if plan.work else None,
        tangent=outcome.tangent,
    )
    # A contact of positive duration with a rigid wall means that the ball stuck to it.
    stuck = has_impact & cell.pair.is_rigid_at(lane_impact.side) & (impact.duration > 0)
    event = Event(lane_impact, has_impact | (unended_flight & ~no_impact), no_impact, permanent, stuck)
    cell = add_event(plan, settings, cell, event)
    step_count = method.step_count(carry)
    if step_count is not None:
        spent = out_of_steps(cell, step_count, end)
        status = jnp.where(spent, Status.EVENT_BUDGET, cell.status).astype(cell.status.dtype)
        cell = replace(cell, running=cell.running & ~spent, status=status)
    stopped = ~cell.running
    cell = review(plan, settings, cell)
    method_state = replace(method_state, pending=jnp.zeros_like(has_impact))
    if cell.candidate is not None:
        # A search for an attractor restarts lanes for another round; a run over a fixed window has no second round.
        restarted = start_method(method, plan, cell, cell.ball, jnp.zeros_like(cell.count))
        method_state = select(stopped & cell.running, restarted, method_state)
    return replace(cell, method_state=method_state)
