"""What lanes are told of a cell: how it is loaded, stepped, served, reviewed and unloaded; from its start or a row."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vijax.batch import advance, chain, lane_rounds, rows, solver_steps
from vijax.batch.attractor_search import blank_candidate, review
from vijax.batch.cell import Cell, Entry, Plan, Settings, blank_tally
from vijax.batch.summary import unload
from vijax.engine import exact, quick_wall
from vijax.engine.impact import Arrival, Ball
from vijax.model.device import Harvester, electrical
from vijax.model.pair import ImpactPair
from vijax.model.sides import Sides


def load(plan: Plan, settings: Settings, entry: Entry) -> Cell:
    """Make fresh cells."""
    pair, d = entry.pair, entry.pair.d
    zero, no = jnp.zeros_like(d), jnp.zeros(d.shape, bool)
    ball = Ball(entry.u, entry.v, zero if entry.t is None else entry.t, zero)
    held = exact.start_mode(pair, ball.u, ball.v, ball.t)
    start = settings.transient + zero
    eye = (zero + 1, zero, zero, zero + 1) if plan.tangent else None
    attractor, method = plan.until == "attractor", settings.method
    return Cell(
        pair=pair,
        wall=quick_wall.prepare(pair, ground=plan.ground) if method is None else None,
        course=None if method is None else solver_steps.set_off(method, plan, entry, ball, held),
        length=entry.length,
        speed=entry.speed,
        device=entry.device,
        ball=ball,
        held=held,
        running=~no,
        declined=no,
        hard=no,
        arrival=Arrival(zero, zero, zero, no) if advance.knows_arrival(plan) and method is None else None,
        done=no,
        status=jnp.zeros(d.shape, jnp.int32),
        count=zero,
        since=start,
        batch=zero - 1,
        tally=blank_tally(plan, d),
        candidate=blank_candidate(settings, d, ball) if attractor else None,
        tangent=eye,
        exponent=zero if plan.tangent else None,
        multiplier=zero if plan.tangent else None,
        relay=chain.begin(ball, held) if plan.chained else None,
    )


def entry_shapes(plan: Plan, dtype: Any) -> Entry:
    """Give what a run is told of a cell, as shapes."""
    one: Any = jax.ShapeDtypeStruct((1,), dtype)
    each: Any = Sides(one, one) if plan.unequal else one
    kappa: Any = None if plan.rigid else each
    if plan.hard_wall:
        kappa = Sides(*(None if side == plan.hard_wall else one for side in (-1, 1)))
    pair = ImpactPair(one, kappa, each, one)
    device = electrical(Harvester(), unequal=plan.unequal) if plan.devices else None
    device = jax.tree.map(lambda _: one, device)
    return Entry(pair, length=one, speed=one, u=one, v=one, t=one if plan.chained else None, device=device)


def program(plan: Plan, settings: Settings) -> lane_rounds.Program:
    """Make what lanes are told of a cell."""
    entry, method = entry_shapes(plan, settings.periods.dtype), settings.method
    cells = lane_rounds.Program(
        load=lambda table: load(plan, settings, rows.unpack(table, entry)),
        step=partial(advance.step, plan, settings),
        review=partial(review, plan, settings),
        stopped=lambda cell: ~cell.running,
        done=lambda cell: cell.done,
        unload=lambda cell: rows.pack(unload(plan, settings, cell)),
        fixed=lambda cell: (cell.pair, cell.wall, cell.length, cell.speed, cell.device),
    )
    if method is not None:
        return cells._replace(
            step=partial(solver_steps.step, method),
            review=partial(solver_steps.review_steps, method, plan, settings),
            steps=solver_steps.STEPS,
            arithmetic=method.arithmetic,
            numbers=False,
        )
    return cells._replace(
        service=lane_rounds.Service(
            declined=lambda cell: cell.declined,
            hard=lambda cell: cell.hard,
            request=partial(advance.request, plan, settings),
            second=partial(advance.sampled_answer, plan),
            careful=partial(advance.careful_answer, plan),
            settle=partial(advance.settle, plan, settings),
        )
    )
