"""Limits of a recorded run, and the record that it returns."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Int

from vijax.impact.exact import exact_step
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, WithStatus
from vijax.runtime.arrays import AnyArray

# Number of steps of a chunk. For a reverse derivative only the state at the start of each chunk and the decisions taken
# in the chunk are stored; its steps are computed a second time.
CHUNK = 64


class Trajectory(WithStatus):
    """Impacts and stroboscopic states of one start, or of many along leading axes.

    Attributes:
        impacts: `Impact` records along the last axis, in order; NaN (side 0) beyond `filled`.
        filled: Number of impacts.
        states: The ball at phase 0 of periods 1 ... periods, along the last axis; NaN for times that the run did not
            reach before `max_impacts` were recorded.
        status: OK; NO_IMPACT if no impact began and the ball is in flight at the end of the last period;
            PERMANENT_CONTACT; EVENT_BUDGET if an impact of these periods is not recorded because `max_impacts` were
            recorded before; NONFINITE if a stepping method computed an impact that is not finite.
    """

    impacts: Impact
    filled: Int[AnyArray, "..."]
    states: State
    status: Int[AnyArray, "..."]


class RunLimits(NamedTuple):
    """Limits of a run; they are traced, so that one program serves all limits up to the capacity of its records.

    Attributes:
        periods, max_impacts: As specified by the user.
        chunks: Limit for the number of chunks of `CHUNK` steps of a method.
    """

    periods: Int[AnyArray, ""]
    max_impacts: Int[AnyArray, ""]
    chunks: Int[AnyArray, ""]


class Capacity(NamedTuple):
    """Capacities of a program's records. `chunks` is None (no limit) if no derivative is taken."""

    periods: int
    impacts: int
    chunks: int | None


def start_of(pair: ImpactPair, u0, v0, t0) -> State:
    """Return the start as a state, in contact or in flight."""
    t, n = flow.wrap_phase(t0)
    return State(u0, v0, t, n.astype(jnp.int32), exact_step.start_mode(pair, u0, v0, t).astype(jnp.int32))


def no_impact(filled: Int[AnyArray, " row"], states: State, periods: Int[AnyArray, ""]) -> Bool[AnyArray, " row"]:
    """Return True for runs without an impact, unless the ball is in contact at the end of the last period.

    A contact that began before the run does not count as an impact, but a ball that is still in contact has met a wall.
    """
    return (filled == 0) & (states.mode[:, periods - 1] == 0)
