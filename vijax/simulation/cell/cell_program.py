"""The `Program` of a cell: functions that load a cell, step it, apply fallbacks, review it and return its summary."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vijax.impact.exact import exact_step
from vijax.impact.fast import fast_walls
from vijax.impact.impact import Arrival, BallState
from vijax.model.device import Harvester, electrical_device
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import Sides
from vijax.simulation import impact_step, method_steps
from vijax.simulation.attractor.attractor_search import blank_candidate, review
from vijax.simulation.cell import chain
from vijax.simulation.cell.cell import Cell, Entry, Plan, Settings, blank_tally
from vijax.simulation.scheduler import lane_rounds, record_rows
from vijax.simulation.summary import unload


def load(plan: Plan, settings: Settings, entry: Entry) -> Cell:
    """Return new cells, one per row of the cell table."""
    pair, d = entry.pair, entry.pair.d
    zero, no = jnp.zeros_like(d), jnp.zeros(d.shape, bool)
    ball = BallState(entry.u, entry.v, zero if entry.t is None else entry.t, zero)
    # -1 or +1 if the start lies in contact with that wall, else 0.
    start_mode = exact_step.start_mode(pair, ball.u, ball.v, ball.t)
    # First period of the window; sums start there.
    start = settings.transient + zero
    # Identity matrix: the tangent map before the first impact.
    eye = (zero + 1, zero, zero, zero + 1) if plan.tangent else None
    attractor, method = plan.until == "attractor", settings.method
    return Cell(
        pair=pair,
        wall=fast_walls.prepare_walls(pair, gravity_regime=plan.gravity_regime) if method is None else None,
        method_state=None if method is None else method_steps.start_method(method, plan, entry, ball, start_mode),
        length=entry.length,
        speed=entry.speed,
        device=entry.device,
        ball=ball,
        mode=start_mode,
        running=~no,
        declined=no,
        needs_robust=no,
        arrival=Arrival(zero, zero, zero, no) if impact_step.stores_arrival(plan) and method is None else None,
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
        chain_state=chain.begin(ball, start_mode) if plan.chained else None,
    )


def entry_shapes(plan: Plan, dtype: Any) -> Entry:
    """Return the shapes of an `Entry` of one cell, as needed to unpack rows of the cell table."""
    number: Any = jax.ShapeDtypeStruct((1,), dtype)
    wall_number: Any = Sides(number, number) if plan.has_unequal_walls else number
    kappa: Any = None if plan.rigid else wall_number
    if plan.rigid_side:
        kappa = Sides(*(None if side == plan.rigid_side else number for side in (-1, 1)))
    pair = ImpactPair(number, kappa, wall_number, number)
    device = electrical_device(Harvester(), has_unequal_walls=plan.has_unequal_walls) if plan.devices else None
    device = jax.tree.map(lambda _: number, device)
    return Entry(
        pair, length=number, speed=number, u=number, v=number, t=number if plan.chained else None, device=device
    )


def program(plan: Plan, settings: Settings) -> lane_rounds.Program:
    """Return the program of a cell for the exact engine or a stepping method."""
    entry, method = entry_shapes(plan, settings.periods.dtype), settings.method
    cells = lane_rounds.Program(
        load=lambda table: load(plan, settings, record_rows.unpack(table, entry)),
        step=partial(impact_step.step, plan, settings),
        review=partial(review, plan, settings),
        stopped=lambda cell: ~cell.running,
        done=lambda cell: cell.done,
        unload=lambda cell: record_rows.pack(unload(plan, settings, cell)),
        fixed=lambda cell: (cell.pair, cell.wall, cell.length, cell.speed, cell.device),
    )
    # A stepping method has its own loop over steps and no fallbacks; its carry may contain more than numbers.
    if method is not None:
        return cells._replace(
            step=partial(method_steps.step, method),
            review=partial(method_steps.review_steps, method, plan, settings),
            steps=method_steps.STEPS,
            arithmetic=method.arithmetic,
            numbers=False,
        )
    return cells._replace(
        service=lane_rounds.Service(
            declined=lambda cell: cell.declined,
            needs_robust=lambda cell: cell.needs_robust,
            request=partial(impact_step.request, plan, settings),
            fast_fallback=partial(impact_step.sampled_answer, plan),
            robust_fallback=partial(impact_step.robust_answer, plan),
            settle=partial(impact_step.settle, plan, settings),
        )
    )
