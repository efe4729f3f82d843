"""The impact map applied once to any number of balls: quick, sampled or careful, as each needs."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from vijax.batch import advance
from vijax.batch.cell import Event, Plan, walls_of
from vijax.engine import quick, quick_wall
from vijax.engine.ground import Ground
from vijax.engine.impact import Ball
from vijax.model.pair import ImpactPair
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.programs import jitted

# Forcing periods in which an impact must come; the map tells of none that comes later, and no orbit may have such a
# flight.
_HORIZON = 64.0
_TILES = (64, 512, 4096)  # balls of one compiled call: a few sizes, so that few programs are compiled


class Next(eqx.Module):
    """The next impact of every ball; `real` is false where none comes or the contact never ends."""

    t: Float[AnyArray, " ball"]  # onset, since phase 0 of the period in which the ball set out
    side: Float[AnyArray, " ball"]
    v_in: Float[AnyArray, " ball"]
    v_out: Float[AnyArray, " ball"]
    duration: Float[AnyArray, " ball"]
    depth: Float[AnyArray, " ball"]
    work: Float[AnyArray, " ball"]
    real: Bool[AnyArray, " ball"]


def _quick_answer(plan: Plan, request: advance.Request) -> advance.Answer:
    """Answer by the quick step."""
    wall = quick_wall.prepare(request.pair, ground=plan.ground)
    impact, _, sure, never = quick.quick_step(wall, request.pair.gamma, request.ball, deep=True, work=True)
    no = jnp.zeros_like(sure)
    return advance.Answer(Event(impact, sure, never, no, no), no, sure | never)


def _sampled_answer(plan: Plan, request: advance.Request) -> advance.Answer:
    """Answer by certified sampling; of a contact alone where the quick step knows the flight."""
    if advance.knows_arrival(plan):
        wall = quick_wall.prepare(request.pair, ground=plan.ground)
        known = quick.quick_step(wall, request.pair.gamma, request.ball).arrival
        request = replace(request, arrival=known)
    return advance.sampled_answer(plan, request)


def _careful_answer(plan: Plan, request: advance.Request) -> advance.Answer:
    """Answer by the careful step, whose program is compiled for longer than it runs."""
    return advance.careful_answer(plan, request, rolled=True)


@lru_cache(maxsize=16)
def _compiled(answer: Callable, plan: Plan):
    def work(request: advance.Request) -> tuple[Next, Bool[AnyArray, " ball"]]:
        given = answer(plan, request)
        impact, real = given.event.impact, given.event.real & ~given.event.permanent
        onset = 2 * impact.onset_n + impact.onset_t
        seen = impact.side, impact.v_in, impact.v_out, impact.duration, impact.depth, impact.work
        return Next(onset, *seen, real), given.sure

    return jitted(work, name=f"{work.__module__}.{work.__qualname__} {answer.__qualname__} {plan}")


def _answered(work: Callable, requests: advance.Request) -> tuple[Next, np.ndarray]:
    """Ask the work about every request, in padded tiles."""
    parts = []
    for tile in tiles.tiles(requests.held.size, _TILES):
        part = work(jax.tree.map(lambda leaf, rows=tile.rows: leaf[rows], requests))
        parts.append(jax.tree.map(lambda leaf, real=tile.real: np.asarray(leaf)[:real], part))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def next_impacts(
    pair: ImpactPair,
    side: Float[AnyArray, " ball"],
    speed: Float[AnyArray, " ball"],
    t: Float[AnyArray, " ball"],
    *,
    ground: Ground,
) -> Next:
    """Fly every ball from the end of a contact to and through the next one.

    Args:
        pair: Cells, one a ball.
        side: Wall that the ball leaves, -1 or +1.
        speed: Its speed away from there.
        t: Phase, in [0, 2).
        ground: That of all cells with which one program is shared.
    """
    plan = Plan(until="window", **walls_of(pair), ground=ground, deep=True, work=True, tangent=False)
    pair, side, speed, t = jax.tree.map(np.asarray, (pair, side, speed, t))
    zero: Any = np.zeros_like(t)
    ball = Ball(0.5 * side * pair.d, -side * speed, t, zero)
    requests = advance.Request(pair, ball, zero, zero + _HORIZON)
    # What one step is not sure of is left to the next, which costs several times as much. For a few balls that is less
    # than what the programs of the others take to compile.
    few = requests.held.size <= _TILES[0]
    first, *others = [_careful_answer] if few else [_quick_answer, _sampled_answer, _careful_answer]
    found, sure = _answered(_compiled(first, plan), requests)
    for step in others:
        rest = np.flatnonzero(~sure)
        if rest.size:
            again, certain = _answered(_compiled(step, plan), jax.tree.map(partial(np.take, indices=rest), requests))
            found = jax.tree.map(partial(tiles.replaced, rest), found, again)
            sure = tiles.replaced(rest, sure, certain)
    return found
