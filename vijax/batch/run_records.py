"""What a recorded run is asked for, and the record that it returns."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Int

from vijax.engine import exact
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, WithStatus
from vijax.runtime.arrays import AnyArray

# A differentiated run computes so many steps twice: it remembers only where a chunk began and what it decided.
CHUNK = 64


class Trajectory(WithStatus):
    """Impacts and stroboscopic states of one start, or of many along leading axes.

    Attributes:
        impacts: `Impact` records along the last axis, in order; NaN (side 0) beyond `filled`.
        filled: How many impacts there are.
        states: The ball at phase 0 of periods 1 ... periods, along the last axis; NaN where `impacts` was too short.
        status: OK; NO_IMPACT if no impact began and the ball is in flight at the end of the last period;
            PERMANENT_CONTACT; EVENT_BUDGET if an impact of these periods is not recorded, as `max_impacts` were before.
    """

    impacts: Impact
    filled: Int[AnyArray, "..."]
    states: State
    status: Int[AnyArray, "..."]


class Asked(NamedTuple):
    """How far a run goes: traced, so that one program serves all numbers that its records have room for.

    Attributes:
        periods, max_impacts: As asked for.
        chunks: How often a method may take `CHUNK` steps.
    """

    periods: Int[AnyArray, ""]
    max_impacts: Int[AnyArray, ""]
    chunks: Int[AnyArray, ""]


class Room(NamedTuple):
    """How many of each a program has room for; of chunks for any number (None) where no derivative is taken."""

    periods: int
    impacts: int
    chunks: int | None


def start_of(pair: ImpactPair, u0, v0, t0) -> State:
    """Make the start a state, in contact or in flight."""
    t, n = flow.wrap_phase(t0)
    return State(u0, v0, t, n.astype(jnp.int32), exact.start_mode(pair, u0, v0, t).astype(jnp.int32))


def no_impact(filled: Int[AnyArray, " row"], states: State, periods: Int[AnyArray, ""]) -> Bool[AnyArray, " row"]:
    """Return True for runs without an impact, unless the ball is in contact at the end of the last period.

    A contact that began before the run is no impact, but a ball that stays in it has met a wall.
    """
    return (filled == 0) & (states.mode[:, periods - 1] == 0)
