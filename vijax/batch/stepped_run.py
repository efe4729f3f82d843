"""Runs of methods that step through time, recorded: all lanes step together."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.batch.run_records import CHUNK, Asked, Room, Trajectory, no_impact, start_of
from vijax.engine.method import HELD, Method, repeated
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, Status
from vijax.runtime.arrays import AnyArray, choose
from vijax.runtime.programs import jitted


class _Recording(eqx.Module):
    """State of the loop of stepped runs.

    Attributes:
        carry: That of the method.
        impacts, filled, states: As in `Trajectory`.
        broken: True if an impact is not finite.
        lost: True if an impact came after `max_impacts` were recorded.
    """

    carry: Any
    impacts: Impact
    filled: Int[AnyArray, " lane"]
    states: State
    broken: Array
    lost: Array


def _recording(room: Room, carry: Any, like: Float[AnyArray, " lane"]) -> _Recording:
    """Make empty records."""
    lanes = like.shape[0]
    whole = jnp.zeros(lanes, jnp.int32)

    def blank(width):
        return jnp.full((lanes, width), jnp.nan, like.dtype), jnp.zeros((lanes, width), jnp.int32)

    x, n = blank(room.impacts)
    impacts = Impact(n=n, t=x, side=n, v_in=x, v_out=x, depth=x, duration=x, work=x)
    x, n = blank(room.periods)
    k = jnp.broadcast_to(jnp.arange(1, room.periods + 1, dtype=jnp.int32), n.shape)
    no = jnp.zeros(lanes, bool)
    return _Recording(carry, impacts, whole, State(x, x, x, k, n), no, no)


def _write(table: Any, row: Any, index: Int[AnyArray, " lane"], wanted: Array) -> Any:
    """Write a row into a table [lane, width] at each lane's index, where wanted."""

    def write(leaf, value):
        column = jnp.where(wanted, index, leaf.shape[1])
        return leaf.at[jnp.arange(leaf.shape[0], dtype=jnp.int32), column].set(value.astype(leaf.dtype), mode="drop")

    return jax.tree.map(write, table, row)


@partial(jitted, static=("room",))
def stepped_run(asked: Asked, method: Method, pair: ImpactPair, u0, v0, t0, *, room: Room) -> Trajectory:
    """Step all lanes together, each until its last period is over and its last contact has ended."""
    periods, max_impacts, chunks = asked
    begun = jax.vmap(start_of)(pair, u0, v0, t0)
    wall = jax.vmap(method.walls)(pair)
    carry = jax.vmap(partial(method.start, deep=True, tangent=False))(pair, begun)
    start = _recording(room, carry, u0)

    def runs(r: _Recording):
        m = r.carry
        inside = (m.mode != 0) & (m.onset_n < periods)
        return ~r.broken & ~r.lost & ((m.n < periods) | (inside & (m.n < periods + HELD)))

    def advance(r: _Recording) -> _Recording:
        going = runs(r)
        carry, outcome, ended = jax.vmap(partial(method.step, recorded=True))(pair, wall, r.carry)
        impact = outcome.impact
        real = going & ended & (impact.n < periods)
        recorded = real & (r.filled < max_impacts)
        strobe = going & (carry.n > r.carry.n) & (carry.n <= periods)
        ball = jax.vmap(method.ball)(pair, carry)
        return _Recording(
            carry=choose(going, carry, r.carry),
            impacts=_write(r.impacts, impact, r.filled, recorded),
            filled=r.filled + recorded.astype(jnp.int32),
            states=_write(r.states, ball, carry.n - 1, strobe),
            broken=r.broken | (real & ~jnp.isfinite(impact.v_out)),
            lost=r.lost | (real & ~recorded),
        )

    def chunk(r: _Recording) -> _Recording:
        return lax.scan(lambda r, _: (advance(r), None), r, None, length=CHUNK)[0]

    def goes_on(r: _Recording, index):
        return runs(r).any() & (index < chunks)

    def if_needed(r: _Recording, index):
        return lax.cond(goes_on(r, index), repeated(chunk), lambda r: r, r), None

    if room.chunks is None:
        end, _ = lax.while_loop(lambda at: goes_on(*at), lambda at: (chunk(at[0]), at[1] + 1), (start, jnp.int32(0)))
    else:
        end, _ = lax.scan(if_needed, start, jnp.arange(room.chunks, dtype=jnp.int32))
    m = end.carry
    held = (m.mode != 0) & (m.n >= periods) & (m.onset_n < periods)
    status = jnp.where(no_impact(end.filled, end.states, periods), Status.NO_IMPACT, Status.OK)
    status = jnp.where(held, Status.PERMANENT_CONTACT, status)
    status = jnp.where(runs(end) | end.lost, Status.EVENT_BUDGET, status)
    status = jnp.where(end.broken, Status.NONFINITE, status)
    return Trajectory(end.impacts, end.filled, end.states, status.astype(jnp.int32))
