"""The impact map, applied once to any number of balls, by the fast step or a fallback as needed.

The map takes the exit from a contact (phase, speed) to the next impact: flight, contact, exit.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import BallState
from vijax.model.pair import ImpactPair
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation.programs import jitted
from vijax.simulation import impact_step
from vijax.simulation.cell.cell import Event, Plan, walls_of

# Forcing periods within which the next impact must follow. The map does not detect later impacts, so it cannot compute
# orbits with longer flights.
_HORIZON = 64.0
_TILES = (64, 512, 4096)  # balls per compiled call: a few sizes need few programs


class NextImpact(eqx.Module):
    """The next impact of every ball; `real` is False if none follows or the contact never ends."""

    t: Float[AnyArray, " ball"]  # onset, since phase 0 of the period of the ball's start
    side: Float[AnyArray, " ball"]
    v_in: Float[AnyArray, " ball"]
    v_out: Float[AnyArray, " ball"]
    duration: Float[AnyArray, " ball"]
    depth: Float[AnyArray, " ball"]
    work: Float[AnyArray, " ball"]
    real: Bool[AnyArray, " ball"]


def _fast_answer(plan: Plan, request: impact_step.Request) -> impact_step.Answer:
    """Compute the next impacts by the fast step."""
    wall = fast_walls.prepare_walls(request.pair, gravity_regime=plan.gravity_regime)
    impact, _, certified, escapes = fast_step.fast_step(wall, request.pair.gamma, request.ball, deep=True, work=True)
    no = jnp.zeros_like(certified)
    return impact_step.Answer(Event(impact, certified, escapes, no, no), no, certified | escapes)


def _sampled_answer(plan: Plan, request: impact_step.Request) -> impact_step.Answer:
    """Compute the next impacts by certified samples: of the contact only, if the fast step has certified the flight."""
    if impact_step.stores_arrival(plan):
        wall = fast_walls.prepare_walls(request.pair, gravity_regime=plan.gravity_regime)
        arrival = fast_step.fast_step(wall, request.pair.gamma, request.ball).arrival
        request = replace(request, arrival=arrival)
    return impact_step.sampled_answer(plan, request)


def _robust_answer(plan: Plan, request: impact_step.Request) -> impact_step.Answer:
    """Compute the next impacts by the exact step, in rolled loops as the program compiles longer than it runs."""
    return impact_step.robust_answer(plan, request, rolled=True)


@lru_cache(maxsize=16)
def _compiled(answer: Callable, plan: Plan):
    def work(request: impact_step.Request) -> tuple[NextImpact, Bool[AnyArray, " ball"]]:
        answers = answer(plan, request)
        impact, real = answers.event.impact, answers.event.real & ~answers.event.permanent
        onset = 2 * impact.onset_n + impact.onset_t
        fields = impact.side, impact.v_in, impact.v_out, impact.duration, impact.depth, impact.work
        return NextImpact(onset, *fields, real), answers.certified

    return jitted(work, name=f"{work.__module__}.{work.__qualname__} {answer.__qualname__} {plan}")


def _answered(work: Callable, requests: impact_step.Request) -> tuple[NextImpact, np.ndarray]:
    """Return the answers to all requests, computed in padded tiles."""
    parts = []
    for tile in tiles.tiles(requests.mode.size, _TILES):
        part = work(jax.tree.map(lambda leaf, rows=tile.rows: leaf[rows], requests))
        parts.append(jax.tree.map(lambda leaf, real=tile.real: np.asarray(leaf)[:real], part))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def next_impacts(
    pair: ImpactPair,
    side: Float[AnyArray, " ball"],
    speed: Float[AnyArray, " ball"],
    t: Float[AnyArray, " ball"],
    *,
    gravity_regime: GravityRegime,
) -> NextImpact:
    """Simulate every ball from the end of a contact to the end of the next one.

    Args:
        pair: Cells, one per ball.
        side: Wall that the ball leaves, -1 or +1.
        speed: Speed of the ball away from the wall.
        t: Phase of the exit from the wall, in [0, 2).
        gravity_regime: Range of gamma of all cells that share one program.
    """
    plan = Plan(until="window", **walls_of(pair), gravity_regime=gravity_regime, deep=True, work=True, tangent=False)
    pair, side, speed, t = jax.tree.map(np.asarray, (pair, side, speed, t))
    zero: Any = np.zeros_like(t)
    ball = BallState(0.5 * side * pair.d, -side * speed, t, zero)
    requests = impact_step.Request(pair, ball, zero, zero + _HORIZON)
    # Requests without a certified answer pass to the next method, which is several times as slow. Few balls are all
    # computed by the last and slowest method, because it takes less time than the compilation of the programs of the
    # faster methods.
    is_small = requests.mode.size <= _TILES[0]
    first, *others = [_robust_answer] if is_small else [_fast_answer, _sampled_answer, _robust_answer]
    impacts, certified = _answered(_compiled(first, plan), requests)
    for step in others:
        remaining = np.flatnonzero(~certified)
        if remaining.size:
            more_impacts, more_certified = _answered(
                _compiled(step, plan), jax.tree.map(partial(np.take, indices=remaining), requests)
            )
            impacts = jax.tree.map(partial(tiles.with_replaced_rows, remaining), impacts, more_impacts)
            certified = tiles.with_replaced_rows(remaining, certified, more_certified)
    return impacts
