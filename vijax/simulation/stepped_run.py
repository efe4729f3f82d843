"""Recorded runs of stepping methods: all lanes take their steps together."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.impact.method import MAX_CONTACT_PERIODS, Method, checkpoint_steps
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State, Status
from vijax.runtime.arrays import AnyArray, select
from vijax.runtime.compilation.programs import jitted
from vijax.simulation.run_records import CHUNK, Capacity, RunLimits, Trajectory, no_impact, start_of


class _Recording(eqx.Module):
    """State of the loop of stepped runs.

    Attributes:
        carry: State of the method.
        impacts, filled, states: As in `Trajectory`.
        broken: True if an impact is not finite.
        has_unrecorded: True if an impact came after `max_impacts` were recorded.
    """

    carry: Any
    impacts: Impact
    filled: Int[AnyArray, " lane"]
    states: State
    broken: Array
    has_unrecorded: Array


def _recording(capacity: Capacity, carry: Any, like: Float[AnyArray, " lane"]) -> _Recording:
    """Return empty records."""
    lanes = like.shape[0]
    integer = jnp.zeros(lanes, jnp.int32)

    def blank(width):
        return jnp.full((lanes, width), jnp.nan, like.dtype), jnp.zeros((lanes, width), jnp.int32)

    x, n = blank(capacity.impacts)
    impacts = Impact(n=n, t=x, side=n, v_in=x, v_out=x, depth=x, duration=x, work=x)
    x, n = blank(capacity.periods)
    k = jnp.broadcast_to(jnp.arange(1, capacity.periods + 1, dtype=jnp.int32), n.shape)
    no = jnp.zeros(lanes, bool)
    return _Recording(carry, impacts, integer, State(x, x, x, k, n), no, no)


def _write(table: Any, row: Any, index: Int[AnyArray, " lane"], selected: Array) -> Any:
    """Write a row into a table [lane, width], at the index of each selected lane; other lanes are unchanged."""

    def write(leaf, value):
        column = jnp.where(selected, index, leaf.shape[1])
        return leaf.at[jnp.arange(leaf.shape[0], dtype=jnp.int32), column].set(value.astype(leaf.dtype), mode="drop")

    return jax.tree.map(write, table, row)


@partial(jitted, static=("capacity",))
def stepped_run(limits: RunLimits, method: Method, pair: ImpactPair, u0, v0, t0, *, capacity: Capacity) -> Trajectory:
    """Advance all lanes together, each until its last period is over and its last contact has ended.

    Without derivatives the number of chunks is unlimited. For derivatives it is bounded by `capacity.chunks`, because
    JAX cannot differentiate a loop of unbounded length in reverse. Chunks after the end of all runs are skipped.
    """
    periods, max_impacts, chunks = limits
    start_states = jax.vmap(start_of)(pair, u0, v0, t0)
    wall = jax.vmap(method.walls)(pair)
    carry = jax.vmap(partial(method.start, deep=True, tangent=False))(pair, start_states)
    start = _recording(capacity, carry, u0)

    def runs(r: _Recording):
        m = r.carry
        # A contact that began before the end of the last period is continued for at most MAX_CONTACT_PERIODS periods.
        inside = (m.mode != 0) & (m.onset_n < periods)
        return ~r.broken & ~r.has_unrecorded & ((m.n < periods) | (inside & (m.n < periods + MAX_CONTACT_PERIODS)))

    def advance(r: _Recording) -> _Recording:
        going = runs(r)
        carry, outcome, ended = jax.vmap(partial(method.step, recorded=True))(pair, wall, r.carry)
        impact = outcome.impact
        real = going & ended & (impact.n < periods)
        recorded = real & (r.filled < max_impacts)
        strobe = going & (carry.n > r.carry.n) & (carry.n <= periods)
        ball = jax.vmap(method.ball)(pair, carry)
        return _Recording(
            carry=select(going, carry, r.carry),
            impacts=_write(r.impacts, impact, r.filled, recorded),
            filled=r.filled + recorded.astype(jnp.int32),
            states=_write(r.states, ball, carry.n - 1, strobe),
            broken=r.broken | (real & ~jnp.isfinite(impact.v_out)),
            has_unrecorded=r.has_unrecorded | (real & ~recorded),
        )

    def chunk(r: _Recording) -> _Recording:
        return lax.scan(lambda r, _: (advance(r), None), r, None, length=CHUNK)[0]

    def continues(r: _Recording, index):
        return runs(r).any() & (index < chunks)

    def if_needed(r: _Recording, index):
        return lax.cond(continues(r, index), checkpoint_steps(chunk), lambda r: r, r), None

    if capacity.chunks is None:
        end, _ = lax.while_loop(lambda at: continues(*at), lambda at: (chunk(at[0]), at[1] + 1), (start, jnp.int32(0)))
    else:
        end, _ = lax.scan(if_needed, start, jnp.arange(capacity.chunks, dtype=jnp.int32))
    m = end.carry
    in_long_contact = (m.mode != 0) & (m.n >= periods) & (m.onset_n < periods)
    status = jnp.where(no_impact(end.filled, end.states, periods), Status.NO_IMPACT, Status.OK)
    status = jnp.where(in_long_contact, Status.PERMANENT_CONTACT, status)
    status = jnp.where(runs(end) | end.has_unrecorded, Status.EVENT_BUDGET, status)
    status = jnp.where(end.broken, Status.NONFINITE, status)
    return Trajectory(end.impacts, end.filled, end.states, status.astype(jnp.int32))
