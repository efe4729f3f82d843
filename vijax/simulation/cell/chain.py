"""Chained cells: the start of a cell from the final state of the previous one, and the start of the recorded periods.

A cell on a certified orbit ends early; its final state is the state of that orbit after all of its periods.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

from vijax.impact.impact import BallState, LaneImpact
from vijax.impact.method import Method, waves_of
from vijax.model import flow
from vijax.model.forcing.waves import flight_motion, steady_contact
from vijax.model.pair import ImpactPair
from vijax.model.quantities import START_REACH
from vijax.model.records import Status
from vijax.runtime.arrays import not_none, select
from vijax.simulation.cell.cell import Cell, ChainState, Lane, Mask, Settings


class Handover(eqx.Module):
    """Final state of a chained cell, and the state at the start of its recorded periods.

    Attributes:
        u, v, t: The ball at the end of the periods, at phase 0; if the ball is in contact then, at the exit of the
            contact.
        mark: The ball at the last exit before the recorded periods, or at the start of the run if there is no such
            exit; for a cell without impacts or in permanent contact, at the start of the recorded periods. Its n is
            counted from the first recorded period, so an earlier mark has n < 0.
        mode: Side of the contact at the mark, 0 in flight.
    """

    u: Lane
    v: Lane
    t: Lane
    mark: BallState
    mode: Lane


def begin(ball: BallState, mode: Lane) -> ChainState:
    """Return the `ChainState` of a chained cell that has just started."""
    return ChainState(start=ball, mark=ball, mode=mode, last=ball, latest=jnp.full_like(mode, -jnp.inf))


def note(settings: Settings, cell: Cell, impact: LaneImpact, is_impact: Mask, end: Lane) -> ChainState | None:
    """Return the `ChainState` of a cell after one impact.

    A cell is chained if its final state is the start of the next cell. For other cells the result is None.
    """
    old = cell.chain_state
    if old is None:
        return None
    candidate, recorded = not_none(cell.candidate), not_none(settings.recorded_periods)
    tracing, period = candidate.tracing, jnp.maximum(candidate.period, 1.0)
    # The last exit before the recorded periods becomes the mark.
    before_recording = is_impact & ~tracing & (impact.after.n < end - recorded)
    # In a round of a periodic orbit, shift the impact by whole periods of the orbit to the last time before the end.
    shift = _round_shift(impact.onset_n, end, period)
    onset = impact.onset_n + shift + 0.5 * impact.onset_t
    is_latest = is_impact & tracing & (onset > old.latest)
    return replace(
        old,
        mark=select(before_recording, impact.after, old.mark),
        mode=jnp.where(before_recording, 0.0, old.mode),
        last=select(is_latest, _shifted(impact.after, shift), old.last),
        latest=jnp.where(is_latest, onset, old.latest),
    )


def _round_shift(n: Lane, end: Lane, period: Lane) -> Lane:
    """Return the whole rounds, in forcing periods, that shift period n to the last such period before `end`."""
    return period * (jnp.ceil((end - n) / period) - 1)


def _shifted(ball: BallState, periods: Lane) -> BallState:
    return BallState(ball.u, ball.v, ball.t, ball.n + periods)


def depart(cell: Cell, starts: Mask) -> ChainState | None:
    """Return the record at the beginning of a round: the latest impact is reset."""
    old = cell.chain_state
    if old is None:
        return None
    return replace(old, latest=jnp.where(starts, -jnp.inf, old.latest))


def hand_over(settings: Settings, cell: Cell, periodic: Mask, failed: Mask, end: Lane) -> Handover:
    """Return the final state of cells that are done; the final state of a failed cell is its start."""
    old, pair = not_none(cell.chain_state), cell.pair
    no_impact, permanent = cell.status == Status.NO_IMPACT, cell.status == Status.PERMANENT_CONTACT
    last = select(periodic, old.last, cell.ball)
    in_flight = last.n < end
    # Time of flight until the end of the last period, at phase 0.
    flight_time = jnp.where(in_flight, 2 * (end - last.n) - last.t, 0.0)
    rise, v = flight_motion(waves_of(settings.method, last.t), pair.gamma, last.v, flight_time)
    ball = BallState(last.u + rise, v, jnp.where(in_flight, 0.0, last.t), end)
    ball = select(permanent, resting(pair, end, settings.method), ball)
    first = end - not_none(settings.recorded_periods)
    mark = select(periodic, _shifted(last, _round_shift(last.n, first, not_none(cell.candidate).period)), old.mark)
    mark = select(no_impact | permanent, BallState(ball.u, ball.v, ball.t, first), mark)
    mode = jnp.where(permanent, jnp.sign(ball.u), jnp.where(periodic | no_impact, 0.0, old.mode))
    ball = select(failed, old.start, ball)
    return Handover(ball.u, ball.v, ball.t, _shifted(mark, -first), mode)


def resting(pair: ImpactPair, end: Lane, method: Method | None = None) -> BallState:
    """Return the state at phase 0 of a ball in permanent contact with the lower wall, after all transients."""
    side, zero = -jnp.sign(pair.gamma), jnp.zeros_like(end)

    def rigid(_: ImpactPair) -> tuple:
        return zero, zero

    def soft(wall: ImpactPair) -> tuple:
        def steady(wall, side):
            return steady_contact(flow.membrane(wall), waves_of(method, jnp.zeros_like(side)), side, wall.gamma)

        return jax.vmap(steady)(wall, side)

    w, z = pair.by_wall_kind(side, rigid, soft)
    return BallState(side * (0.5 * pair.d + w), side * z, zero, end)


def within(pair: ImpactPair, u: Lane) -> Lane:
    """Return the start displacements, clipped into the gap where the wall is rigid."""
    return jnp.where(pair.is_rigid_at(u), jnp.clip(u, -START_REACH * pair.d, START_REACH * pair.d), u)
