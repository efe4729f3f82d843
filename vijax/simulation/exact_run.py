"""Trajectories by the exact engine: calls of a fixed number of steps; records are cut to the requested numbers."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from vijax.impact.exact import exact_step
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, Status
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray, select
from vijax.runtime.compilation.programs import jitted, start_compilation
from vijax.runtime.compilation.xla import loop_body, map_lanes, reuse_trace
from vijax.simulation.run_records import Capacity, RunLimits, Trajectory, no_impact, start_of

# Steps of the exact engine in one compiled call. They suffice for 15 to 30 periods, so that a short run is one call,
# and are so few that little time is lost if all runs end early in a call.
_CALL_STEPS = 64
# Numbers of balls for which one compiled call computes the states at phase 0.
_STROBES = (64, 4096)


def _steps_of(impacts: Any) -> Any:
    """Return the number of steps that a run needs for this number of recorded impacts.

    One more step is needed for a contact at the start, and one for the flight or contact at the end of the last period.
    """
    return impacts + 2


def _time(state: State) -> Float[AnyArray, "..."]:
    """Return the time since phase 0 of period 0."""
    return 2.0 * state.n.astype(state.t.dtype) + state.t


def ball_at(pair: ImpactPair, start: State, out: exact_step.ExactResult, when: Float[AnyArray, ""]) -> tuple:
    """Return u, v and mode (side of the contact, 0 in flight) at the time `when` after the start of a step."""
    in_flight = (when <= out.flight) | out.no_impact
    rise, v = flow.flight(flow.flight_force(pair.gamma, start.t), start.v, jnp.where(in_flight, when, 0.0))
    # A start in contact has no flight; w0 is its penetration.
    in_contact = start.mode != 0
    side = jnp.where(in_contact, start.mode, out.impact.side).astype(rise.dtype)
    contact_time = jnp.where(in_flight, 0.0, when - out.flight)

    def rigid(_: ImpactPair) -> tuple:
        # On a rigid wall a contact has a duration only if the ball is stuck: it is then at rest on the wall.
        return jnp.zeros_like(rise), jnp.zeros_like(rise)

    def soft(wall: ImpactPair) -> tuple:
        force = flow.contact_force(pair.gamma, side, out.impact.t)
        w0 = jnp.where(in_contact, side * start.u - 0.5 * pair.d, 0.0)
        return flow.oscillate(flow.membrane(wall, rolled=True), force, w0, side * out.impact.v_in, contact_time)

    w, z = pair.by_wall_kind(side, rigid, soft)
    u = jnp.where(in_flight, start.u + rise, side * (0.5 * pair.d + w))
    return u, jnp.where(in_flight, v, side * z), jnp.where(in_flight, 0, side.astype(jnp.int32))


class _StepRecords(NamedTuple):
    """Steps of the exact engine: the state at the start of each step, and the step's outcome; arrays [row, step].

    Attributes:
        idle: True if the run had ended before this step.
    """

    start: State
    out: exact_step.ExactResult
    idle: Bool[AnyArray, "row step"]


class _RunStates(NamedTuple):
    """Current state of every run; `over` is True for runs that have ended."""

    state: State
    over: Bool[AnyArray, " row"]


def _start_states(pair: ImpactPair, u0, v0, t0) -> _RunStates:
    return _RunStates(jax.vmap(start_of)(pair, u0, v0, t0), jnp.zeros(u0.shape, bool))


def _advance_steps(limits: RunLimits, pair: ImpactPair, states: _RunStates, first: Int[AnyArray, ""], count: int):
    """Advance balls by `count` steps, numbered from `first`; return the states reached and the steps."""

    def advance(states: _RunStates, index):
        state, over = states
        idle = over | (index >= _steps_of(limits.max_impacts))
        # Time from the ball's state to the end of the last period; an idle row searches for no impact.
        horizon = jnp.where(idle, 0.0, 2.0 * (limits.periods - state.n).astype(state.t.dtype) - state.t)

        @reuse_trace
        def step():
            return map_lanes(exact_step.step)(pair, state, horizon, rolled=True)

        def no_step():
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(step))

        # If all rows are idle, the step is skipped, so that records longer than the runs cost no time.
        out = lax.cond(idle.all(), no_step, step)
        over = over | (~idle & (out.no_impact | out.permanent | (horizon <= 0)))
        ends = idle | over
        after = jax.tree.map(lambda new, old: jnp.where(ends, old, new), out.state, state)
        return _RunStates(after, over), _StepRecords(state, out, idle)

    states, steps = lax.scan(loop_body(advance), states, first + jnp.arange(count, dtype=jnp.int32))
    return states, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), steps)


def _blank_states(count: int, dtype: Any) -> _RunStates:
    """Return the states of runs that have not started."""
    number: Any = np.zeros(count, dtype)
    integer: Any = np.zeros(count, np.int32)
    return _RunStates(State(number, number, number, integer, integer), integer > 0)


@jitted
def _call_steps(limits: RunLimits, pair: ImpactPair, starts: tuple, states: _RunStates, first: Any):
    """Advance balls by one call; the first call also sets the starts, because one program compiles faster than two."""
    states = select(first == 0, _start_states(pair, *starts), states)
    return _advance_steps(limits, pair, states, first, _CALL_STEPS)


def _all_steps(
    limits: RunLimits, capacity: Capacity, pair: ImpactPair, starts: tuple
) -> tuple[_RunStates, _StepRecords]:
    """Compute the steps of all rows: a fixed number (the capacity) if traced, else until all runs have ended."""
    steps = _steps_of(capacity.impacts)
    if tiles.array_namespace((pair, starts)) is jnp:
        return _advance_steps(limits, pair, _start_states(pair, *starts), jnp.int32(0), steps)
    # All calls have one length, so that one program serves every number of periods. A program for each number of
    # periods would need 4 s to compile, and 800 memory mappings.
    _compile_strobes(pair, starts[0].size * capacity.periods)
    parts = []
    states = _blank_states(starts[0].size, starts[0].dtype)
    for first in range(0, steps, _CALL_STEPS):
        # The states are converted to NumPy's arrays, as in the first call, because JAX would compile a second program
        # for arguments that are JAX's arrays.
        states, step_rows = jax.tree.map(np.asarray, _call_steps(limits, pair, starts, states, np.int32(first)))
        parts.append(step_rows)
        if states.over.all():
            break
    return states, jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)


def exact_run(limits: RunLimits, pair: ImpactPair, u0, v0, t0, *, capacity: Capacity) -> Trajectory:
    """Run rows of starts by the exact engine."""
    states_reached, steps = _all_steps(limits, capacity, pair, (u0, v0, t0))
    library = tiles.array_namespace((pair, steps))
    out, idle = steps.out, steps.idle
    real = ~idle & (out.impact.side != 0) & (out.impact.n < limits.periods)
    recorded = library.cumsum(real, axis=1, dtype=library.int32) <= limits.max_impacts
    has_unrecorded = (real & ~recorded).any(axis=1)
    real = real & recorded
    filled = real.sum(axis=1, dtype=library.int32)
    is_filled = library.arange(capacity.impacts, dtype=library.int32) < filled[:, None]
    # Stable sort: recorded impacts first, in order; the rest is padding.
    order = library.argsort(~real, axis=1, stable=True)[:, : capacity.impacts]
    order = library.pad(order, ((0, 0), (0, capacity.impacts - order.shape[1])))

    def keep(leaf):
        blank = 0 if library.issubdtype(leaf.dtype, library.integer) else library.nan
        return library.where(is_filled, library.take_along_axis(leaf, order, axis=1), blank)

    states = _strobes(pair, steps, capacity.periods)
    permanent = (out.permanent & ~idle).any(axis=1)
    short = ~states_reached.over & (
        _time(states_reached.state) < 2.0 * limits.periods.astype(states_reached.state.t.dtype)
    )
    status = library.where(no_impact(filled, states, limits.periods), Status.NO_IMPACT, Status.OK)
    status = library.where(permanent, Status.PERMANENT_CONTACT, status)
    status = library.where(short | has_unrecorded, Status.EVENT_BUDGET, status).astype(library.int32)
    return Trajectory(jax.tree.map(keep, out.impact), filled, states, status)


def _strobes(pair: ImpactPair, steps: _StepRecords, periods: int) -> State:
    """Return states [row, period] at phase 0 of periods 1 ... `periods`, each from the last step that began earlier."""
    library = tiles.array_namespace((pair, steps))
    start, out, idle = steps
    clock = library.where(idle, library.inf, _time(start))
    # A step without an end (no impact, permanent contact) covers all later times.
    ended = idle | out.no_impact | out.permanent
    until = library.where(ended, library.inf, _time(out.state))
    k = library.broadcast_to(library.arange(1, periods + 1, dtype=library.int32), (clock.shape[0], periods))
    now = 2.0 * k.astype(clock.dtype)
    index = library.clip(_last_step_before(clock, now), 0, clock.shape[1] - 1)
    start_at, out_at, until_at = jax.tree.map(
        lambda leaf: library.take_along_axis(leaf, index, axis=1), (start, out, until)
    )
    is_covered = now <= until_at
    time_in_step = library.where(is_covered, 2.0 * (k - start_at.n).astype(clock.dtype) - start_at.t, 0.0)
    wide = jax.tree.map(lambda leaf: library.broadcast_to(leaf[:, None], k.shape), pair)
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1), (wide, start_at, out_at, time_in_step))
    u, v, mode = jax.tree.map(lambda leaf: leaf.reshape(k.shape), tiles.map_tiles(balls_at, rows, _STROBES))
    blank = library.where(is_covered, 0.0, library.nan).astype(u.dtype)
    return State(u + blank, v + blank, library.zeros_like(u), k, mode)


@jitted
def balls_at(rows: tuple) -> tuple:
    """Apply `ball_at` to many balls."""
    return jax.vmap(ball_at)(*rows)


def _compile_strobes(pair: ImpactPair, count: int) -> None:
    """Start the compilation of the program that computes `count` balls at phase 0."""
    size = tiles.tiles(count, _STROBES)[0].rows.size
    rows: Any = jax.tree.map(lambda leaf: np.broadcast_to(leaf[:1], size), pair)
    number, (states, no) = rows.d, _blank_states(size, rows.d.dtype)
    impact = Impact(states.n, number, states.n, number, number, number, number, number)
    start_compilation(
        balls_at, (rows, states, exact_step.ExactResult(states, impact, number, number, no, no, no), number)
    )


def _last_step_before(
    clock: Float[AnyArray, "row step"], now: Float[AnyArray, "row period"]
) -> Int[AnyArray, "row period"]:
    """Return the index of the last step of each row that began at or before the time `now`; -1 if there is none."""
    if tiles.array_namespace((clock, now)) is jnp:
        return jax.vmap(partial(jnp.searchsorted, side="right"))(clock, now) - 1
    rows: Any = zip(clock, now, strict=True)
    index: Any = np.stack([np.searchsorted(row, when, side="right") for row, when in rows])
    return index - 1
