"""The impact map applied once to any number of balls: quick, sampled or careful, as each needs."""

from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vijax import lanes, quick, sampled, trips
from vijax.cell import Event, Mask, Plan, choose
from vijax.model import ImpactPair
from vijax.quick import Lanes, Wall

_HORIZON = 64.0  # periods in which an impact must come
_TILES = (512, 8192)  # balls of one compiled call: two sizes, so that two programs serve every number
_LANES = 256


class Next(eqx.Module):
    """The next impact of every ball; `real` is false where none comes or the contact never ends."""

    t: Float[Array, "ball"]  # onset, since phase 0 of the period in which the ball set out
    side: Float[Array, "ball"]
    v_in: Float[Array, "ball"]
    v_out: Float[Array, "ball"]
    duration: Float[Array, "ball"]
    depth: Float[Array, "ball"]
    work: Float[Array, "ball"]
    real: Bool[Array, "ball"]


class _Ball(eqx.Module):
    """A lane: where its ball sets out, and what came of it."""

    pair: ImpactPair
    wall: Wall | None
    ball: Lanes
    found: Next
    done: Mask
    declined: Mask
    hard: Mask


def _load(plan: Plan, rows: Float[Array, "ball 6"]) -> _Ball:
    """Fresh lanes from rows (d, kappa, r, gamma, wall, outward speed, phase)."""
    d, kappa, r, gamma, side, speed, t = rows.T
    pair = ImpactPair(d, None if plan.rigid else kappa, r, gamma)
    zero, no = jnp.zeros_like(d), jnp.zeros(d.shape, bool)
    ball = Lanes(0.5 * side * d, -side * speed, t, zero)
    wall = quick.prepare(pair) if plan.level else None
    return _Ball(pair, wall, ball, Next(zero, zero, zero, zero, zero, zero, zero, no), no, no, no)


def _trip(plan: Plan, lane: _Ball) -> _Ball:
    if plan.level:
        hit, sure, never = quick.quick_step(lane.wall, lane.pair.gamma, lane.ball, deep=True)
    else:
        hit, sure = sampled.sampled_step(lane.pair, lane.ball, deep=True)
        never = jnp.zeros_like(sure)
    active = ~lane.done & ~lane.declined
    no = jnp.zeros_like(active)
    lane = _record(lane, Event(hit, sure, never, no, no), active & (sure | never))
    declined = active & ~(sure | never)
    hard = lane.hard | declined if not plan.level else lane.hard
    return eqx.tree_at(lambda x: (x.declined, x.hard), lane, (lane.declined | declined, hard))


def _record(lane: _Ball, event: Event, ours: Mask) -> _Ball:
    hit = event.hit
    onset = 2 * hit.onset_n + hit.onset_t
    found = Next(onset, hit.side, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, event.real)
    return eqx.tree_at(lambda x: (x.found, x.done), lane, (choose(ours, found, lane.found), lane.done | ours))


def _settle(lane: _Ball, answer: trips.Answer, served: Mask) -> _Ball:
    ours = served & answer.sure
    lane = _record(lane, answer.event, ours)
    hard = (lane.hard | served) & ~ours
    return eqx.tree_at(lambda x: (x.declined, x.hard), lane, (lane.declined & ~ours, hard))


def _request(lane: _Ball) -> trips.Request:
    zero = jnp.zeros_like(lane.ball.n)
    return trips.Request(lane.pair, lane.ball, zero, zero + _HORIZON)


def _unload(lane: _Ball) -> Float[Array, "ball 8"]:
    return jnp.stack([leaf.astype(lane.ball.t.dtype) for leaf in jax.tree.leaves(lane.found)], axis=1)


@lru_cache(maxsize=8)
def _compiled(plan: Plan, width: int):
    program = lanes.Program(
        load=partial(_load, plan),
        trip=partial(_trip, plan),
        review=lambda lane: lane,
        stopped=lambda lane: lane.done,
        done=lambda lane: lane.done,
        unload=_unload,
        service=lanes.Service(
            declined=lambda lane: lane.declined,
            hard=lambda lane: lane.hard,
            request=_request,
            second=partial(trips.sampled_answer, plan) if plan.level else None,
            careful=partial(trips.careful_answer, plan),
            settle=_settle,
        ),
    )

    def tile(rows, count):
        return lanes.run(program, rows, count, len(Next.__dataclass_fields__), width)

    return jax.jit(tile, compiler_options=lanes.compiler_options())


def next_impacts(pair: ImpactPair, side, speed, t, *, level: bool) -> Next:
    """Fly every ball from the end of a contact to and through the next one.

    Args:
        pair: Cells, one a ball.
        side: Wall that the ball leaves, -1 or +1.
        speed: Its speed away from there.
        t: Phase, in [0, 2).
        level: Whether gamma is 0 everywhere.
    """
    kappa = jnp.ones_like(pair.d) if pair.kappa is None else pair.kappa
    rows = jnp.stack([pair.d, kappa, pair.r, pair.gamma, side.astype(pair.d.dtype), speed, t], axis=1)
    plan = Plan(
        until="window",
        stepping=None,
        rigid=pair.kappa is None,
        level=level,
        deep=True,
        energies=False,
        tangent=False,
        asymmetry=False,
        variants=1,
    )
    tile = _TILES[0] if rows.shape[0] <= _TILES[0] else _TILES[1]
    parts = []
    for start in range(0, rows.shape[0], tile):
        part = rows[start : start + tile]
        count = part.shape[0]
        part = jnp.concatenate([part, jnp.broadcast_to(part[:1], (tile - count, part.shape[1]))])
        parts.append(_compiled(plan, _LANES)(part, jnp.asarray(count, jnp.int32))[:count])
    table = jnp.concatenate(parts)
    t, side, v_in, v_out, duration, depth, work, real = table.T
    return Next(t, side, v_in, v_out, duration, depth, work, real != 0)
