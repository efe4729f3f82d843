"""The motion of single starts, impact by impact: recorded, sampled at phase 0, differentiable both ways."""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from importlib import import_module
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vijax import checks, exact, flow
from vijax.membrane import HuntCrossley, Law
from vijax.method import Method, Rk4, choose, repeated
from vijax.model import Impact, ImpactPair, State, Status, WithStatus, check_pair, check_start

_CHUNK = 64  # steps that a differentiated run computes twice, to remember only where a chunk began and what it decided
_STEPS = 256  # steps of an adaptive solver per impact and period, before a run is stopped
_IMPACT, _STATE = 56, 32  # bytes of a record
_HELD = 8  # a contact that outlasts the last period by so many is for ever


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


def _one(periods: int, max_impacts: int, pair: ImpactPair, u0, v0, t0) -> Trajectory:
    start = _begin(pair, u0, v0, t0)

    def advance(carry, _):
        state, over = carry
        horizon = jnp.where(over, 0.0, 2.0 * (periods - state.n).astype(u0.dtype) - state.t)
        out = exact.step(pair, state, horizon, rolled=True)
        ends = over | out.quiet | out.permanent | (horizon <= 0)
        after = jax.tree.map(lambda new, old: jnp.where(ends, old, new), out.state, state)
        return (after, ends), (state, out, over)

    # One step more than impacts: the flight or contact in which the last period ends.
    steps = max_impacts + 1
    (_, _), (begun, out, idle) = lax.scan(advance, (start, jnp.asarray(False)), None, length=steps)
    real = ~idle & (out.impact.side != 0)
    real = real & (jnp.cumsum(real) <= max_impacts) & (out.impact.n < periods)
    order = jnp.argsort(~real, stable=True)[:max_impacts]
    filled = real.sum(dtype=jnp.int32)
    there = jnp.arange(max_impacts, dtype=jnp.int32) < filled

    def keep(leaf):
        blank = 0 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.nan
        return jnp.where(there, leaf[order], blank)

    clock = jnp.where(idle, jnp.inf, _time(begun))
    ended = out.quiet | out.permanent
    until = jnp.where(idle | ended, jnp.inf, _time(out.state))

    def strobe(k):
        now = 2.0 * k.astype(u0.dtype)
        index = jnp.clip(jnp.searchsorted(clock, now, side="right") - 1, 0, steps - 1)
        first, happened = jax.tree.map(lambda leaf: leaf[index], (begun, out))
        known = now <= until[index]
        when = jnp.where(known, 2.0 * (k - first.n).astype(u0.dtype) - first.t, 0.0)
        u, v, mode = ball_at(pair, first, happened, when)
        blank = jnp.where(known, 0.0, jnp.nan)
        return State(u + blank, v + blank, jnp.zeros_like(u), k, mode)

    states = jax.vmap(strobe)(jnp.arange(1, periods + 1, dtype=jnp.int32))
    permanent = (out.permanent & ~idle).any()
    short = ~(ended & ~idle).any() & (until[-1] < 2.0 * periods)
    status = jnp.where(permanent, Status.PERMANENT_CONTACT, jnp.where(filled == 0, Status.NO_IMPACT, Status.OK))
    status = jnp.where(short, Status.EVENT_BUDGET, status).astype(jnp.int32)
    return Trajectory(jax.tree.map(keep, out.impact), filled, states, status)


class _Recording(eqx.Module):
    """The loop's state of stepped runs: carries, what was found so far, and whether something broke."""

    carry: Any
    impacts: Impact
    filled: Int[Array, "lane"]
    states: State
    broken: Array


def _recording(periods: int, max_impacts: int, carry: Any, like: Float[Array, "lane"]) -> _Recording:
    """Empty records."""
    lanes = like.shape[0]
    whole = jnp.zeros(lanes, jnp.int32)

    def blank(width):
        return jnp.full((lanes, width), jnp.nan, like.dtype), jnp.zeros((lanes, width), jnp.int32)

    x, n = blank(max_impacts)
    impacts = Impact(n=n, t=x, side=n, v_in=x, v_out=x, depth=x, duration=x, work=x)
    x, n = blank(periods)
    k = jnp.broadcast_to(jnp.arange(1, periods + 1, dtype=jnp.int32), n.shape)
    return _Recording(carry, impacts, whole, State(x, x, x, k, n), jnp.zeros(lanes, bool))


def _write(table: Any, row: Any, index: Int[Array, "lane"], wanted: Array) -> Any:
    """A table [lane, width] with a row written at each lane's index, where wanted."""

    def write(leaf, value):
        column = jnp.where(wanted, index, leaf.shape[1])
        return leaf.at[jnp.arange(leaf.shape[0], dtype=jnp.int32), column].set(value.astype(leaf.dtype), mode="drop")

    return jax.tree.map(write, table, row)


def _stepped(room: str, steps: int, periods: int, max_impacts: int, method: Method, pair, u0, v0, t0) -> Trajectory:
    """Stepping engines: all lanes step together, each until its last period is over and its last contact has ended."""
    engine = import_module(f"vijax.{room}")
    begun = jax.vmap(_begin)(pair, u0, v0, t0)
    wall = jax.vmap(method.law.wall)(pair)
    carry = jax.vmap(partial(engine.start, method, deep=True, tangent=False))(pair, begun)
    start = _recording(periods, max_impacts, carry, u0)

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

    def chunk(r: _Recording, _):
        def go(r):
            return lax.scan(lambda r, _: (advance(r), None), r, None, length=_CHUNK)[0]

        return lax.cond(runs(r).any(), repeated(go), lambda r: r, r), None

    end, _ = lax.scan(chunk, start, None, length=-(-steps // _CHUNK))
    m = end.carry
    held = (m.mode != 0) & (m.n >= periods) & (m.onset_n < periods)
    short = runs(end) | ((end.filled >= max_impacts) & (m.n < periods))
    status = jnp.where(held, Status.PERMANENT_CONTACT, jnp.where(end.filled == 0, Status.NO_IMPACT, Status.OK))
    status = jnp.where(end.broken, Status.NONFINITE, jnp.where(short, Status.EVENT_BUDGET, status))
    return Trajectory(end.impacts, end.filled, end.states, status.astype(jnp.int32))


@lru_cache(maxsize=32)
def _compiled_steps(room: str, steps: int, periods: int, max_impacts: int) -> Callable[..., Trajectory]:
    return jax.jit(partial(_stepped, room, steps, periods, max_impacts))


def _by_steps(method: Method, periods: int, max_impacts: int, pair: ImpactPair, *starts) -> Trajectory:
    """A trajectory by a stepping engine, of starts of any shape."""
    shape = starts[0].shape
    pair, starts = jax.tree.map(lambda x: x.reshape(-1), (pair, starts))
    if isinstance(method, Rk4):
        room, steps = "rk4", int(method.steps) * (periods + _HELD)
    else:
        room, steps = "ode", _STEPS * (periods + max_impacts)
    dtype = starts[0].dtype
    method = jax.tree.map(lambda x: jnp.asarray(x, dtype), method)
    flat = _compiled_steps(room, steps, periods, max_impacts)(method, pair, *starts)
    return jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), flat)


@lru_cache(maxsize=32)
def _compiled(periods: int, max_impacts: int, axes: int) -> Callable[..., Trajectory]:
    run = partial(_one, periods, max_impacts)
    for _ in range(axes):
        run = jax.vmap(run)
    return jax.jit(run)


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


def trajectory(
    pair: ImpactPair,
    u0: Float[Array, "..."] | float,
    v0: Float[Array, "..."] | float,
    periods: int,
    t0: Float[Array, "..."] | float = 0.0,
    *,
    max_impacts: int | None = None,
    method: str | Method = "exact",
    solver: str | None = None,
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
        method: "exact", "ode" or "rk4", as in `sweep`; or the record of a stepping method (`vijax.method`).
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
    room = 16 * periods + 16 if max_impacts is None else checks.whole("max_impacts", max_impacts, 1)
    _check_starts(pair, periods, {"u0": u0, "v0": v0, "t0": t0})
    count = math.prod(checks.shapes(u0=u0, v0=v0, t0=t0, pair=pair.d))
    checks.fits(("periods", "max_impacts"), count * (room * _IMPACT + periods * _STATE), "impacts and states")
    dtype = jnp.result_type(pair.d)
    numbers = [jnp.asarray(x, dtype) for x in (u0, v0, t0)]
    shape = jnp.broadcast_shapes(*(x.shape for x in numbers), *(jnp.shape(x) for x in jax.tree.leaves(pair)))
    pair = jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, dtype), shape), pair)
    u0, v0, t0 = (jnp.broadcast_to(x, shape) for x in numbers)
    if told is not None:
        return _by_steps(told, periods, room, pair, u0, v0, t0)
    return _compiled(periods, room, len(shape))(pair, u0, v0, t0)
