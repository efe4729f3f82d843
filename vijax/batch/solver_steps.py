"""One step of every lane by a method that steps through time, and what is made of the impacts that it finishes."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from vijax.batch.advance import QUIET, neutral
from vijax.batch.attractor_search import review
from vijax.batch.cell import Cell, Course, Entry, Event, Lane, Plan, Settings
from vijax.batch.cell_end import last_period, out_of_steps
from vijax.batch.tally import add_event
from vijax.engine.impact import Ball, LaneImpact
from vijax.engine.method import Method
from vijax.model.membrane import has_units, in_units
from vijax.model.pair import ImpactPair
from vijax.model.records import State, Status
from vijax.model.waves import mean_velocity
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share

# Steps between two rounds: an impact takes a dozen and more, and a lane waits for the next round with the second alone.
STEPS = 32


def set_off(method: Method, plan: Plan, of: Cell | Entry, ball: Ball, held: Lane) -> Course:
    """Set lanes off at the start of a run or of a round."""
    pair = _with_law(method, of)
    whole = ball.n.astype(jnp.int32)
    state = State(ball.u, ball.v, ball.t, whole, held.astype(jnp.int32))
    carry = jax.vmap(partial(method.start, deep=plan.deep, tangent=plan.tangent))(pair, state)
    wall = jax.vmap(method.walls)(pair)
    _, outcome, _ = jax.eval_shape(jax.vmap(method.step), pair, wall, carry)
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), outcome)
    return Course(wall, carry, jnp.zeros(ball.u.shape, bool), blank)


def _with_law(method: Method, of: Cell | Entry) -> ImpactPair:
    """Return the pairs of lanes; with the method's law in the units of each, where its numbers have a dimension."""
    if not has_units(method.law):
        return of.pair
    return replace(of.pair, law=jax.vmap(partial(in_units, method.law))(of.length, of.speed))


def step(method: Method, cell: Cell) -> Cell:
    """Take every lane one step on. A finished impact waits for review; a lane that finishes another waits with it."""
    old = present(cell.course)
    carry, outcome, finished = share(jax.vmap(method.step)(cell.pair, old.wall, old.carry))
    blocked = old.waits & finished
    new = Course(
        old.wall,
        choose(blocked, old.carry, carry),
        old.waits | finished,
        choose(finished & ~blocked, outcome, old.outcome),
    )
    return replace(cell, course=new)


def review_steps(method: Method, plan: Plan, settings: Settings, cell: Cell) -> Cell:
    """Add the impacts that wait, end flights and contacts that outlast the run, and review what has stopped."""
    course = present(cell.course)
    carry, outcome = course.carry, course.outcome
    impact, after = outcome.impact, outcome.after
    waits = course.waits & cell.running
    # A round of a candidate orbit may begin close to the end and go on beyond it.
    end = last_period(plan, settings, cell)
    late = carry.n.astype(cell.count.dtype) - jnp.maximum(end, cell.ball.n)
    idle = cell.running & ~course.waits
    out = idle & (carry.mode == 0) & (late >= (QUIET if cell.candidate is not None else 0))
    # A forcing that does not repeat leaves no ball alone for ever.
    mean = mean_velocity(method.waves(cell.ball.t), cell.ball.v)
    alone = neutral(cell.pair, mean) & method.repeats
    quiet = out & (alone | jax.vmap(method.rests)(cell.pair, carry))
    permanent = idle & (carry.mode != 0) & (late >= QUIET)
    lane_impact = LaneImpact(
        onset_t=impact.t,
        onset_n=jnp.where(out, jnp.inf, impact.n.astype(impact.t.dtype)),
        side=impact.side.astype(impact.t.dtype),
        v_in=impact.v_in,
        v_out=impact.v_out,
        flight=outcome.flight,
        duration=impact.duration,
        after=Ball(after.u, after.v, after.t, after.n.astype(after.t.dtype)),
        depth=jnp.where(permanent, carry.depth, impact.depth) if plan.deep else None,
        work=impact.work if plan.work else None,
        tangent=outcome.tangent,
    )
    # A rigid wall that has a contact of some length has held the ball.
    stuck = waits & cell.pair.hard(lane_impact.side) & (impact.duration > 0)
    event = Event(lane_impact, waits | (out & ~quiet), quiet, permanent, stuck)
    cell = add_event(plan, settings, cell, event)
    taken = method.taken(carry)
    if taken is not None:
        spent = out_of_steps(cell, taken, end)
        status = jnp.where(spent, Status.EVENT_BUDGET, cell.status).astype(cell.status.dtype)
        cell = replace(cell, running=cell.running & ~spent, status=status)
    stopped = ~cell.running
    cell = review(plan, settings, cell)
    course = replace(course, waits=jnp.zeros_like(waits))
    if cell.candidate is not None:
        # A search sets its lanes off again, for another round; a window has one way alone.
        again = set_off(method, plan, cell, cell.ball, jnp.zeros_like(cell.count))
        course = choose(stopped & cell.running, again, course)
    return replace(cell, course=course)
