"""A cell in a chain: where it starts, what it hands on, where the impacts that are wanted of it begin.

A cell on a certified orbit ends there, in the state in which the orbit would be after all of its periods.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

from vijax.batch.cell import Cell, Lane, Mask, Relay, Settings
from vijax.engine.impact import Ball, LaneImpact
from vijax.engine.method import Method, waves_of
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.quantities import START_REACH
from vijax.model.records import Status
from vijax.model.waves import drift, held_response
from vijax.runtime.arrays import choose, present


class Handover(eqx.Module):
    """How a cell ended, and where its kept periods are to be flown again from.

    Attributes:
        u, v, t: The ball at the end of the periods, at phase 0; where a contact spans that moment, at its exit.
        mark: The ball at an exit before the kept periods, its periods counted from their first (so n < 0), or at the
            start; of a cell at rest in flight or contact, at their beginning.
        held: Mode at the mark.
    """

    u: Lane
    v: Lane
    t: Lane
    mark: Ball
    held: Lane


def begin(ball: Ball, held: Lane) -> Relay:
    """Make the record of a cell that has just started."""
    return Relay(start=ball, mark=ball, held=held, last=ball, latest=jnp.full_like(held, -jnp.inf))


def note(settings: Settings, cell: Cell, impact: LaneImpact, kept: Mask, end: Lane) -> Relay | None:
    """Add one impact to the record; there is none of a cell that is not chained."""
    old = cell.relay
    if old is None:
        return None
    candidate, recorded = present(cell.candidate), present(settings.recorded_periods)
    tracing, period = candidate.tracing, jnp.maximum(candidate.period, 1.0)
    early = kept & ~tracing & (impact.after.n < end - recorded)
    ahead = _ahead(impact.onset_n, end, period)
    onset = impact.onset_n + ahead + 0.5 * impact.onset_t
    later = kept & tracing & (onset > old.latest)
    return replace(
        old,
        mark=choose(early, impact.after, old.mark),
        held=jnp.where(early, 0.0, old.held),
        last=choose(later, _moved(impact.after, ahead), old.last),
        latest=jnp.where(later, onset, old.latest),
    )


def _ahead(n: Lane, end: Lane, period: Lane) -> Lane:
    """Count whole rounds, in periods, that take period n to the last such period before `end`."""
    return period * (jnp.ceil((end - n) / period) - 1)


def _moved(ball: Ball, periods: Lane) -> Ball:
    return Ball(ball.u, ball.v, ball.t, ball.n + periods)


def depart(cell: Cell, begins: Mask) -> Relay | None:
    """Make the record ready for a round that begins."""
    old = cell.relay
    if old is None:
        return None
    return replace(old, latest=jnp.where(begins, -jnp.inf, old.latest))


def hand_over(settings: Settings, cell: Cell, periodic: Mask, failed: Mask, end: Lane) -> Handover:
    """Give what is handed on of cells that are done; of one that failed, its start."""
    old, pair = present(cell.relay), cell.pair
    quiet, permanent = cell.status == Status.NO_IMPACT, cell.status == Status.PERMANENT_CONTACT
    last = choose(periodic, old.last, cell.ball)
    aloft = last.n < end
    left = jnp.where(aloft, 2 * (end - last.n) - last.t, 0.0)
    rise, v = drift(waves_of(settings.method, last.t), pair.gamma, last.v, left)
    ball = Ball(last.u + rise, v, jnp.where(aloft, 0.0, last.t), end)
    ball = choose(permanent, resting(pair, end, settings.method), ball)
    first = end - present(settings.recorded_periods)
    mark = choose(periodic, _moved(last, _ahead(last.n, first, present(cell.candidate).period)), old.mark)
    mark = choose(quiet | permanent, Ball(ball.u, ball.v, ball.t, first), mark)
    held = jnp.where(permanent, jnp.sign(ball.u), jnp.where(periodic | quiet, 0.0, old.held))
    ball = choose(failed, old.start, ball)
    return Handover(ball.u, ball.v, ball.t, _moved(mark, -first), held)


def resting(pair: ImpactPair, end: Lane, method: Method | None = None) -> Ball:
    """Make a ball that stays for ever on the wall on which it lies, at phase 0, once only its steady motion is left."""
    side, zero = -jnp.sign(pair.gamma), jnp.zeros_like(end)

    def rigid(_: ImpactPair) -> tuple:
        return zero, zero

    def soft(wall: ImpactPair) -> tuple:
        def steady(wall, side):
            return held_response(flow.membrane(wall), waves_of(method, jnp.zeros_like(side)), side, wall.gamma)

        return jax.vmap(steady)(wall, side)

    w, z = pair.met(side, rigid, soft)
    return Ball(side * (0.5 * pair.d + w), side * z, zero, end)


def within(pair: ImpactPair, u: Lane) -> Lane:
    """Put a start that the gap of a rigid wall does not hold back into it; give the displacement."""
    return jnp.where(pair.hard(u), jnp.clip(u, -START_REACH * pair.d, START_REACH * pair.d), u)
