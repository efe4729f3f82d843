"""Runs of the exact engine, recorded: stretches of steps in one compiled call each, cut to what was asked for."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from vijax.batch.run_records import Asked, Room, Trajectory, no_impact, start_of
from vijax.engine import exact
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, Status
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray, choose
from vijax.runtime.programs import begin, jitted
from vijax.runtime.xla import each, loop_body, once

# The exact engine takes so many steps in one compiled call: enough for 15 to 30 periods, so that short runs are one
# call, and few enough that the host waits for no long one after every ball has arrived.
_STRETCH = 64
# Balls at phase 0 are found together in calls of few sizes.
_STROBES = (64, 4096)


def _steps_of(impacts: Any) -> Any:
    """Return the number of steps of a run with so many recorded impacts.

    One step more is a contact in which the ball starts, one more the flight or contact in which the last period ends.
    """
    return impacts + 2


def _time(state: State) -> Float[AnyArray, "..."]:
    """Compute the time since phase 0 of period 0."""
    return 2.0 * state.n.astype(state.t.dtype) + state.t


def ball_at(pair: ImpactPair, start: State, out: exact.Outcome, when: Float[AnyArray, ""]) -> tuple:
    """Compute displacement, velocity and mode at a time `when` after the start of a step."""
    aloft = (when <= out.flight) | out.quiet
    rise, v = flow.flight(flow.flight_force(pair.gamma, start.t), start.v, jnp.where(aloft, when, 0.0))
    held = start.mode != 0
    side = jnp.where(held, start.mode, out.impact.side).astype(rise.dtype)
    inside = jnp.where(aloft, 0.0, when - out.flight)

    def rigid(_: ImpactPair) -> tuple:
        # Only sticking lasts: at rest on the wall.
        return jnp.zeros_like(rise), jnp.zeros_like(rise)

    def soft(wall: ImpactPair) -> tuple:
        force = flow.contact_force(pair.gamma, side, out.impact.t)
        w0 = jnp.where(held, side * start.u - 0.5 * pair.d, 0.0)
        return flow.oscillate(flow.membrane(wall, rolled=True), force, w0, side * out.impact.v_in, inside)

    w, z = pair.met(side, rigid, soft)
    u = jnp.where(aloft, start.u + rise, side * (0.5 * pair.d + w))
    return u, jnp.where(aloft, v, side * z), jnp.where(aloft, 0, side.astype(jnp.int32))


class _Flown(NamedTuple):
    """Steps of the exact engine [row, step]: the start of each, what came of it.

    Attributes:
        idle: Whether the run had ended before.
    """

    begun: State
    out: exact.Outcome
    idle: Bool[AnyArray, "row step"]


class _Reached(NamedTuple):
    """Where runs of the exact engine are, and which of them are over."""

    state: State
    over: Bool[AnyArray, " row"]


def _set_out(pair: ImpactPair, u0, v0, t0) -> _Reached:
    return _Reached(jax.vmap(start_of)(pair, u0, v0, t0), jnp.zeros(u0.shape, bool))


def _onward(asked: Asked, pair: ImpactPair, reached: _Reached, first: Int[AnyArray, ""], count: int):
    """Take balls so many steps on, the first of a given number in the run: where they are then, and the `_Flown`."""

    def advance(reached: _Reached, index):
        state, over = reached
        idle = over | (index >= _steps_of(asked.max_impacts))
        horizon = jnp.where(idle, 0.0, 2.0 * (asked.periods - state.n).astype(state.t.dtype) - state.t)

        @once
        def fly():
            return each(exact.step)(pair, state, horizon, rolled=True)

        def rest():
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(fly))

        # Room that is not asked for costs no time.
        out = lax.cond(idle.all(), rest, fly)
        over = over | (~idle & (out.quiet | out.permanent | (horizon <= 0)))
        ends = idle | over
        after = jax.tree.map(lambda new, old: jnp.where(ends, old, new), out.state, state)
        return _Reached(after, over), _Flown(state, out, idle)

    reached, flown = lax.scan(loop_body(advance), reached, first + jnp.arange(count, dtype=jnp.int32))
    return reached, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), flown)


def _nowhere(count: int, dtype: Any) -> _Reached:
    """Make what a run is that has not begun."""
    number: Any = np.zeros(count, dtype)
    whole: Any = np.zeros(count, np.int32)
    return _Reached(State(number, number, number, whole, whole), whole > 0)


@jitted
def _stretch(asked: Asked, pair: ImpactPair, starts: tuple, reached: _Reached, first: Any):
    """Take balls a stretch on; the first begins where they start. One program compiles sooner than two."""
    reached = choose(first == 0, _set_out(pair, *starts), reached)
    return _onward(asked, pair, reached, first, _STRETCH)


def _fly(asked: Asked, room: Room, pair: ImpactPair, starts: tuple) -> tuple[_Reached, _Flown]:
    """Take all steps of rows of starts: as many as there is room for where traced, else until all runs are over."""
    steps = _steps_of(room.impacts)
    if tiles.library((pair, starts)) is jnp:
        return _onward(asked, pair, _set_out(pair, *starts), jnp.int32(0), steps)
    # Stretches of one length need one program, where every number of periods would need its own: 4 s and 800 mappings.
    _begin_strobes(pair, starts[0].size * room.periods)
    parts = []
    reached = _nowhere(starts[0].size, starts[0].dtype)
    for first in range(0, steps, _STRETCH):
        # NumPy's arrays, as the first ones are: with JAX's own JAX compiles the program once more.
        reached, flown = jax.tree.map(np.asarray, _stretch(asked, pair, starts, reached, np.int32(first)))
        parts.append(flown)
        if reached.over.all():
            break
    return reached, jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)


def exact_run(asked: Asked, pair: ImpactPair, u0, v0, t0, *, room: Room) -> Trajectory:
    """Run rows of starts by the exact engine."""
    reached, flown = _fly(asked, room, pair, (u0, v0, t0))
    own = tiles.library((pair, flown))
    out, idle = flown.out, flown.idle
    real = ~idle & (out.impact.side != 0) & (out.impact.n < asked.periods)
    recorded = own.cumsum(real, axis=1, dtype=own.int32) <= asked.max_impacts
    lost = (real & ~recorded).any(axis=1)
    real = real & recorded
    filled = real.sum(axis=1, dtype=own.int32)
    there = own.arange(room.impacts, dtype=own.int32) < filled[:, None]
    order = own.argsort(~real, axis=1, stable=True)[:, : room.impacts]
    order = own.pad(order, ((0, 0), (0, room.impacts - order.shape[1])))

    def keep(leaf):
        blank = 0 if own.issubdtype(leaf.dtype, own.integer) else own.nan
        return own.where(there, own.take_along_axis(leaf, order, axis=1), blank)

    states = _strobes(pair, flown, room.periods)
    permanent = (out.permanent & ~idle).any(axis=1)
    short = ~reached.over & (_time(reached.state) < 2.0 * asked.periods.astype(reached.state.t.dtype))
    status = own.where(no_impact(filled, states, asked.periods), Status.NO_IMPACT, Status.OK)
    status = own.where(permanent, Status.PERMANENT_CONTACT, status)
    status = own.where(short | lost, Status.EVENT_BUDGET, status).astype(own.int32)
    return Trajectory(jax.tree.map(keep, out.impact), filled, states, status)


def _strobes(pair: ImpactPair, flown: _Flown, periods: int) -> State:
    """Find the balls at phase 0 of periods 1 ... periods, [row, period]: each in the last step that began before."""
    own = tiles.library((pair, flown))
    begun, out, idle = flown
    clock = own.where(idle, own.inf, _time(begun))
    # A step that nothing ends is the last word on all that comes.
    ended = idle | out.quiet | out.permanent
    until = own.where(ended, own.inf, _time(out.state))
    k = own.broadcast_to(own.arange(1, periods + 1, dtype=own.int32), (clock.shape[0], periods))
    now = 2.0 * k.astype(clock.dtype)
    index = own.clip(_before(clock, now), 0, clock.shape[1] - 1)
    first, happened, last = jax.tree.map(lambda leaf: own.take_along_axis(leaf, index, axis=1), (begun, out, until))
    known = now <= last
    when = own.where(known, 2.0 * (k - first.n).astype(clock.dtype) - first.t, 0.0)
    wide = jax.tree.map(lambda leaf: own.broadcast_to(leaf[:, None], k.shape), pair)
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1), (wide, first, happened, when))
    u, v, mode = jax.tree.map(lambda leaf: leaf.reshape(k.shape), tiles.map_tiles(balls_at, rows, _STROBES))
    blank = own.where(known, 0.0, own.nan).astype(u.dtype)
    return State(u + blank, v + blank, own.zeros_like(u), k, mode)


@jitted
def balls_at(rows: tuple) -> tuple:
    """Do what `ball_at` does, for many balls: of each what that takes."""
    return jax.vmap(ball_at)(*rows)


def _begin_strobes(pair: ImpactPair, count: int) -> None:
    """Begin to compile what finds so many balls at phase 0."""
    size = tiles.tiles(count, _STROBES)[0].rows.size
    rows: Any = jax.tree.map(lambda leaf: np.broadcast_to(leaf[:1], size), pair)
    number, (start, no) = rows.d, _nowhere(size, rows.d.dtype)
    impact = Impact(start.n, number, start.n, number, number, number, number, number)
    begin(balls_at, (rows, start, exact.Outcome(start, impact, number, number, no, no, no), number))


def _before(clock: Float[AnyArray, "row step"], now: Float[AnyArray, "row period"]) -> Int[AnyArray, "row period"]:
    """Find the last step of each row that began by then; -1 before all."""
    if tiles.library((clock, now)) is jnp:
        return jax.vmap(partial(jnp.searchsorted, side="right"))(clock, now) - 1
    rows: Any = zip(clock, now, strict=True)
    index: Any = np.stack([np.searchsorted(row, when, side="right") for row, when in rows])
    return index - 1
