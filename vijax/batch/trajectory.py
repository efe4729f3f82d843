"""The motion of single starts, impact by impact: recorded, sampled at phase 0, differentiable both ways."""

import math
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vijax.engine import exact
from vijax.engine.method import Method, MethodName, Rk4, SolverName, choose, repeated
from vijax.model import flow
from vijax.model.membrane import HuntCrossley, Law
from vijax.model.pair import ImpactPair, check_pair, check_start
from vijax.model.records import Impact, State, Status, WithStatus
from vijax.runtime import checks, tiles
from vijax.runtime.context import door

# A differentiated run computes so many steps twice: it remembers only where a chunk began and what it decided.
_CHUNK = 64
# An adaptive solver that takes more steps than this per impact and period is stopped.
_STEPS = 256
_IMPACT, _STATE = 56, 32  # bytes of a record
# The exact engine takes so many steps in one compiled call: enough for 15 to 30 periods, so that short runs are one
# call, and few enough that the host waits for no long one after every ball has arrived.
_STRETCH = 64
# Few sizes of compiled calls are few programs: starts that fly together, and balls at phase 0 that are found together.
_TILES, _STROBES = (1, 8, 64, 512, 4096), (64, 4096)
# A contact that outlasts the last period by so many is taken to last for ever.
_HELD = 8


class Trajectory(WithStatus):
    """Impacts and stroboscopic states of one start, or of many along leading axes.

    Attributes:
        impacts: `Impact` records along the last axis, in order; NaN (side 0) beyond `filled`.
        filled: How many impacts there are.
        states: The ball at phase 0 of periods 1 ... periods, along the last axis; NaN where `impacts` was too short.
        status: OK, NO_IMPACT, PERMANENT_CONTACT, or EVENT_BUDGET where `max_impacts` came before the last period.
    """

    impacts: Impact
    filled: Int[Array, "..."]
    states: State
    status: Int[Array, "..."]


def _begin(pair: ImpactPair, u0, v0, t0) -> State:
    """The start as a state, in contact or in flight."""
    t, n = flow.wrap_phase(t0)
    return State(u0, v0, t, n.astype(jnp.int32), exact.start_mode(pair, u0, v0, t).astype(jnp.int32))


def _time(state: State) -> Float[Array, "..."]:
    """Time since phase 0 of period 0."""
    return 2.0 * state.n.astype(state.t.dtype) + state.t


def ball_at(pair: ImpactPair, start: State, out: exact.Outcome, when: Float[Array, ""]) -> tuple:
    """Displacement, velocity and mode at a time `when` after the start of a step."""
    aloft = (when <= out.flight) | out.quiet
    rise, v = flow.flight(pair.gamma, start.t, start.v, jnp.where(aloft, when, 0.0))
    held = start.mode != 0
    side = jnp.where(held, start.mode, out.impact.side).astype(rise.dtype)
    inside = jnp.where(aloft, 0.0, when - out.flight)
    if pair.kappa is None:
        # Only sticking lasts: at rest on the wall.
        w, z = jnp.zeros_like(rise), jnp.zeros_like(rise)
    else:
        force = flow.contact_force(pair.gamma, side, out.impact.t)
        w0 = jnp.where(held, side * start.u - 0.5 * pair.d, 0.0)
        w, z = flow.oscillate(flow.membrane(pair, rolled=True), force, w0, side * out.impact.v_in, inside)
    u = jnp.where(aloft, start.u + rise, side * (0.5 * pair.d + w))
    return u, jnp.where(aloft, v, side * z), jnp.where(aloft, 0, side.astype(jnp.int32))


class _Asked(NamedTuple):
    """How far a run goes: traced, so that one program serves all numbers that its records have room for.

    Attributes:
        periods, max_impacts: As asked for.
        chunks: How often a stepping engine may take `_CHUNK` steps.
    """

    periods: Int[Array, ""]
    max_impacts: Int[Array, ""]
    chunks: Int[Array, ""]


class _Room(NamedTuple):
    """How many of each a program has room for."""

    periods: int
    impacts: int
    chunks: int


class _Flown(NamedTuple):
    """Steps of the exact engine [row, step]: the start of each, what came of it.

    Attributes:
        idle: Whether the run had ended before.
    """

    begun: State
    out: exact.Outcome
    idle: Bool[Array, "row step"]


class _Reached(NamedTuple):
    """Where runs of the exact engine are, and which of them are over."""

    state: State
    over: Bool[Array, "row"]


@jax.jit
def _set_out(pair: ImpactPair, u0, v0, t0) -> _Reached:
    return _Reached(jax.vmap(_begin)(pair, u0, v0, t0), jnp.zeros(u0.shape, bool))


def _onward(asked: _Asked, pair: ImpactPair, reached: _Reached, first: Int[Array, ""], count: int):
    """So many steps on, the first of which has a number in the run: where the balls are then, and the `_Flown`."""

    def advance(reached: _Reached, index):
        state, over = reached
        idle = over | (index > asked.max_impacts)
        horizon = jnp.where(idle, 0.0, 2.0 * (asked.periods - state.n).astype(state.t.dtype) - state.t)

        def fly():
            return jax.vmap(partial(exact.step, rolled=True))(pair, state, horizon)

        def rest():
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(fly))

        # Room that is not asked for costs no time.
        out = lax.cond(idle.all(), rest, fly)
        over = over | (~idle & (out.quiet | out.permanent | (horizon <= 0)))
        ends = idle | over
        after = jax.tree.map(lambda new, old: jnp.where(ends, old, new), out.state, state)
        return _Reached(after, over), _Flown(state, out, idle)

    reached, flown = lax.scan(advance, reached, first + jnp.arange(count, dtype=jnp.int32))
    return reached, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), flown)


_stretch = jax.jit(partial(_onward, count=_STRETCH))


def _fly(asked: _Asked, room: _Room, pair: ImpactPair, starts: tuple) -> tuple[_Reached, _Flown]:
    """All steps of rows of starts: as many as there is room for where they are traced, else until all runs are over."""
    reached = _set_out(pair, *starts)
    # One step more than impacts: the flight or contact in which the last period ends.
    steps = room.impacts + 1
    if tiles.library((pair, starts)) is jnp:
        return _onward(asked, pair, reached, jnp.int32(0), steps)
    # Stretches of one length need one program, where every number of periods would need its own: 4 s and 800 mappings.
    parts = []
    for first in range(0, steps, _STRETCH):
        reached, flown = _stretch(asked, pair, reached, np.int32(first))
        parts.append(jax.tree.map(np.asarray, flown))
        if np.asarray(reached.over).all():
            break
    flown = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    return jax.tree.map(np.asarray, reached), flown


def _exact(asked: _Asked, pair: ImpactPair, u0, v0, t0, *, room: _Room) -> Trajectory:
    """By the exact engine, of rows of starts."""
    reached, flown = _fly(asked, room, pair, (u0, v0, t0))
    own = tiles.library((pair, flown))
    out, idle = flown.out, flown.idle
    real = ~idle & (out.impact.side != 0)
    counted = own.cumsum(real, axis=1, dtype=own.int32)
    real = real & (counted <= asked.max_impacts) & (out.impact.n < asked.periods)
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
    status = own.where(permanent, Status.PERMANENT_CONTACT, own.where(filled == 0, Status.NO_IMPACT, Status.OK))
    status = own.where(short, Status.EVENT_BUDGET, status).astype(own.int32)
    return Trajectory(jax.tree.map(keep, out.impact), filled, states, status)


_exact_traced = jax.jit(_exact, static_argnames="room")


def _strobes(pair: ImpactPair, flown: _Flown, periods: int) -> State:
    """The balls at phase 0 of periods 1 ... periods, [row, period]: each in the last step that began before."""
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
    u, v, mode = jax.tree.map(lambda leaf: leaf.reshape(k.shape), tiles.map_tiles(_balls_at, rows, _STROBES))
    blank = own.where(known, 0.0, own.nan).astype(u.dtype)
    return State(u + blank, v + blank, own.zeros_like(u), k, mode)


@jax.jit
def _balls_at(rows: tuple) -> tuple:
    return jax.vmap(ball_at)(*rows)


def _before(clock: Float[Array, "row step"], now: Float[Array, "row period"]) -> Int[Array, "row period"]:
    """The last step of each row that began by then; -1 before all."""
    if tiles.library((clock, now)) is jnp:
        return jax.vmap(partial(jnp.searchsorted, side="right"))(clock, now) - 1
    rows: Any = zip(clock, now, strict=True)
    index: Any = np.stack([np.searchsorted(row, when, side="right") for row, when in rows])
    return index - 1


class _Recording(eqx.Module):
    """The loop's state of stepped runs: carries, what was found so far, and whether something broke."""

    carry: Any
    impacts: Impact
    filled: Int[Array, "lane"]
    states: State
    broken: Array


def _recording(room: _Room, carry: Any, like: Float[Array, "lane"]) -> _Recording:
    """Empty records."""
    lanes = like.shape[0]
    whole = jnp.zeros(lanes, jnp.int32)

    def blank(width):
        return jnp.full((lanes, width), jnp.nan, like.dtype), jnp.zeros((lanes, width), jnp.int32)

    x, n = blank(room.impacts)
    impacts = Impact(n=n, t=x, side=n, v_in=x, v_out=x, depth=x, duration=x, work=x)
    x, n = blank(room.periods)
    k = jnp.broadcast_to(jnp.arange(1, room.periods + 1, dtype=jnp.int32), n.shape)
    return _Recording(carry, impacts, whole, State(x, x, x, k, n), jnp.zeros(lanes, bool))


def _write(table: Any, row: Any, index: Int[Array, "lane"], wanted: Array) -> Any:
    """A table [lane, width] with a row written at each lane's index, where wanted."""

    def write(leaf, value):
        column = jnp.where(wanted, index, leaf.shape[1])
        return leaf.at[jnp.arange(leaf.shape[0], dtype=jnp.int32), column].set(value.astype(leaf.dtype), mode="drop")

    return jax.tree.map(write, table, row)


@partial(jax.jit, static_argnames=("name", "room"))
def _stepped(asked: _Asked, method: Method, pair: ImpactPair, u0, v0, t0, *, name: str, room: _Room) -> Trajectory:
    """Stepping engines: all lanes step together, each until its last period is over and its last contact has ended."""
    engine = import_module(f"vijax.engine.{name}")
    periods, max_impacts, chunks = asked
    begun = jax.vmap(_begin)(pair, u0, v0, t0)
    wall = jax.vmap(method.law.wall)(pair)
    carry = jax.vmap(partial(engine.start, method, deep=True, tangent=False))(pair, begun)
    start = _recording(room, carry, u0)

    def runs(r: _Recording):
        m = r.carry
        inside = (m.mode != 0) & (m.onset_n < periods)
        full = (r.filled >= max_impacts) & (m.mode != 0)
        return ~r.broken & ~full & ((m.n < periods) | (inside & (m.n < periods + _HELD)))

    def advance(r: _Recording) -> _Recording:
        going = runs(r)
        carry, passage, ended = jax.vmap(partial(engine.step, method, recorded=True))(pair, wall, r.carry)
        impact = passage.impact
        real = going & ended & (impact.n < periods)
        strobe = going & (carry.n > r.carry.n) & (carry.n <= periods)
        ball = jax.vmap(lambda pair, m: engine.ball(pair, method, m))(pair, carry)
        return _Recording(
            carry=jax.tree.map(lambda new, old: jnp.where(going, new, old), carry, r.carry),
            impacts=_write(r.impacts, impact, r.filled, real),
            filled=r.filled + real.astype(jnp.int32),
            states=_write(r.states, ball, carry.n - 1, strobe),
            broken=r.broken | (real & ~jnp.isfinite(impact.v_out)),
        )

    def chunk(r: _Recording, index):
        def go(r):
            return lax.scan(lambda r, _: (advance(r), None), r, None, length=_CHUNK)[0]

        return lax.cond(runs(r).any() & (index < chunks), repeated(go), lambda r: r, r), None

    end, _ = lax.scan(chunk, start, jnp.arange(room.chunks, dtype=jnp.int32))
    m = end.carry
    held = (m.mode != 0) & (m.n >= periods) & (m.onset_n < periods)
    short = runs(end) | ((end.filled >= max_impacts) & (m.n < periods))
    status = jnp.where(held, Status.PERMANENT_CONTACT, jnp.where(end.filled == 0, Status.NO_IMPACT, Status.OK))
    status = jnp.where(end.broken, Status.NONFINITE, jnp.where(short, Status.EVENT_BUDGET, status))
    return Trajectory(end.impacts, end.filled, end.states, status.astype(jnp.int32))


def _steps(method: Method | None, periods: int, max_impacts: int) -> int:
    """Most steps of a stepping engine."""
    if method is None:
        return 0
    return int(method.steps) * (periods + _HELD) if isinstance(method, Rk4) else _STEPS * (periods + max_impacts)


def _wall(pair: ImpactPair) -> str:
    return "rigid" if pair.kappa is None else "soft"


def _precision(pair: ImpactPair) -> str:
    return str(jnp.result_type(float, pair.d))


def _told(pair: ImpactPair, method: Any, options: Mapping[str, Any]) -> Method | None:
    """The method, as `choose` makes it unless it is a record already, if the pair suits its membrane."""
    if not isinstance(method, Method):
        method = choose(method, options, wall=_wall(pair), dtype=_precision(pair))
    lossy = method is None or not isinstance(method.law, HuntCrossley)
    if (pair.r is None) == lossy:
        raise ValueError(
            f"r must be None with a Hunt-Crossley membrane, and a number with others; got {checks.shown(pair.r)}"
        )
    return method


def _check_starts(pair: ImpactPair, periods: int, starts: Mapping[str, Any]) -> None:
    """Raise ValueError unless the ball can start so; traced starts pass unseen."""
    for name, start in starts.items():
        if checks.is_concrete(start):
            checks.finite(name, start)
    check_start(pair, "u0", starts["u0"])
    if checks.is_concrete(starts["t0"]):
        t0 = np.asarray(starts["t0"])
        good = (t0 >= 0) & (t0 < 2 * periods)
        if not good.all():
            raise ValueError(f"t0 must lie in [0, 2 periods), here [0, {2 * periods}); got {checks.first(t0, good)}")


@door
def trajectory(
    pair: ImpactPair,
    u0: ArrayLike,
    v0: ArrayLike,
    periods: int,
    t0: ArrayLike = 0.0,
    *,
    max_impacts: int | None = None,
    method: MethodName | Method = "exact",
    solver: SolverName | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    membrane: Law | None = None,
    steps: int | None = None,
) -> Trajectory:
    """Follow one start, or an array of starts, for a number of forcing periods.

    Args:
        pair: One cell, or arrays that broadcast against the starts.
        u0, v0: Displacement and velocity at time t0.
        periods: The motion is followed to t = 2 periods.
        t0: Time of the start, in [0, 2 periods).
        max_impacts: Room for impacts; 16 a period and 16 more unless given.
        method: "exact", "ode" or "rk4", as in `sweep`; or the record of a stepping method (`vijax.engine.method`).
        solver, rtol, atol, membrane, steps: As in `sweep`. With a `HuntCrossley` membrane the pair's r is None.

    Returns:
        The `Trajectory`. Differentiable in pair and start, forward and reverse: a scan of bounded length. The exact
        engine to any order; "ode" once, as the lengths of its steps are constants to a derivative; "rk4" not
        usefully, as its derivatives miss the jump at the wall.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    options = {"solver": solver, "rtol": rtol, "atol": atol, "membrane": membrane, "steps": steps}
    told = _told(check_pair(pair), method, options)
    periods = checks.whole("periods", periods, 1)
    room = _most(periods) if max_impacts is None else checks.whole("max_impacts", max_impacts, 1)
    _check_starts(pair, periods, {"u0": u0, "v0": v0, "t0": t0})
    count = math.prod(checks.shapes(u0=u0, v0=v0, t0=t0, pair=pair.d))
    checks.fits(("periods", "max_impacts"), count * (room * _IMPACT + periods * _STATE), "impacts and states")
    found, shape = _followed(told, pair, (u0, v0, t0), periods, max_impacts)
    return _cut(found, shape, periods, room)


def _followed(
    method: Method | None, pair: ImpactPair, starts: tuple, periods: int, max_impacts: int | None
) -> tuple[Trajectory, tuple[int, ...]]:
    """The trajectories of all starts as rows, records padded; and the shape that the starts have."""
    dtype, own = jnp.result_type(pair.d), tiles.library((pair, starts))
    shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves((pair, starts))))
    rows = jax.tree.map(lambda x: own.broadcast_to(own.asarray(x, dtype), shape).reshape(-1), (pair, starts))
    most = _most(periods) if max_impacts is None else max_impacts
    chunks = -(-_steps(method, periods, most) // _CHUNK)
    numbers: Any = (np.int32(number) for number in (periods, most, chunks))
    asked = _Asked(*numbers)
    wide = tiles.padded(periods)
    room = _Room(wide, _most(wide) if max_impacts is None else tiles.padded(max_impacts), tiles.padded(chunks))
    if method is None and own is np:
        work = partial(_exact, asked, room=_Room(periods, most, chunks))
    elif method is None:
        work = partial(_exact_traced, asked, room=room)
    else:
        method = jax.tree.map(lambda x: jnp.asarray(x, dtype), method)
        name = "rk4" if isinstance(method, Rk4) else "ode"
        work = partial(_stepped, asked, method, name=name, room=room)
    return tiles.map_tiles(lambda row: work(row[0], *row[1]), rows, _TILES), shape


def _most(periods: int) -> int:
    """Room for impacts in so many periods, unless something else is asked for."""
    return 16 * periods + 16


def _cut(found: Trajectory, shape: tuple[int, ...], periods: int, max_impacts: int) -> Trajectory:
    """Without what lies beyond the numbers asked for, in the shape of the starts."""

    def shaped(leaf, width=None):
        return leaf.reshape(shape + leaf.shape[1:])[..., :width] if leaf.ndim > 1 else leaf.reshape(shape)

    impacts, states = (
        jax.tree.map(partial(shaped, width=width), part)
        for part, width in ((found.impacts, max_impacts), (found.states, periods))
    )
    return tiles.arrays(Trajectory(impacts, shaped(found.filled), states, shaped(found.status)))
