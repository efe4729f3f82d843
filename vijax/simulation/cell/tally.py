"""Addition of one event to a cell: to its sums, tangent map and recurrence test; `cell_end` decides whether it ends."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from vijax.impact.impact import LaneImpact
from vijax.model import energy
from vijax.model.walls.sides import Sides
from vijax.runtime.arrays import not_none, select
from vijax.runtime.compilation.xla import materialise
from vijax.simulation.attractor.attractor_search import recur
from vijax.simulation.cell.cell import (
    TANGENT_SCALE,
    Cell,
    Event,
    Harvest,
    Lane,
    Mask,
    Plan,
    Settings,
    Tally,
    batch_length,
)
from vijax.simulation.cell.cell_end import ended, last_period
from vijax.simulation.cell.chain import note


def add_event(plan: Plan, settings: Settings, cell: Cell, event: Event) -> Cell:
    """Add one event to a cell."""
    impact = event.impact
    end = last_period(plan, settings, cell)
    # An onset after the last period ends the window, and is not counted.
    after_end = event.real & (impact.onset_n >= end)
    tracing = jnp.zeros_like(after_end) if cell.candidate is None else cell.candidate.tracing
    after_end = after_end & ~tracing
    is_impact = event.real & ~after_end & ~event.permanent
    in_window = is_impact & (tracing | (impact.onset_n >= cell.since))
    after_end, is_impact, in_window = materialise((after_end, is_impact, in_window))
    count = cell.count + is_impact.astype(cell.count.dtype)
    status, stop = ended(cell, event, count, end)
    tangent, exponent = _extend_tangent(cell, impact, is_impact, in_window)
    batch = jnp.where(in_window & ~tracing, _batch_of(settings, cell, impact), cell.batch)
    # A full batch is added to the sums before the first impact of the next batch is counted.
    batch_full = in_window & ~tracing & (batch != cell.batch) & (cell.batch >= 0)
    batch, batch_full = materialise((batch, batch_full))
    tally = _add(settings, cell, impact, in_window, batch_full, event.stuck)
    if tally.deepest is not None:
        # A contact that never ends has a depth, although it counts as no impact.
        tally = _deeper(tally, impact, event.permanent & ~jnp.isnan(not_none(impact.depth)))
    candidate, review_due = recur(settings, cell, impact, is_impact, count)
    return replace(
        cell,
        ball=select(is_impact, impact.after, cell.ball),
        running=cell.running & ~(stop | after_end | review_due),
        status=status,
        count=count,
        batch=batch,
        tally=tally,
        candidate=candidate,
        tangent=tangent,
        exponent=exponent,
        chain_state=note(settings, cell, impact, is_impact, end),
    )


def _batch_of(settings: Settings, cell: Cell, impact: LaneImpact) -> Lane:
    return jnp.floor((impact.onset_n - cell.since) / batch_length(settings, cell.candidate))


def _extend_tangent(cell: Cell, impact: LaneImpact, is_impact: Mask, in_window: Mask):
    """Multiply the tangent map from the left by the impact's map; at the window's first impact, start from identity."""
    if cell.tangent is None:
        return None, None
    fresh = in_window & (cell.batch < 0)
    if cell.candidate is not None:
        fresh = fresh & ~cell.candidate.tracing
    a, b, c, d = (jnp.where(fresh, unit, old) for unit, old in zip((1.0, 0.0, 0.0, 1.0), cell.tangent, strict=True))
    p, q, r, s = not_none(impact.tangent)
    a, b, c, d = p * a + q * c, p * b + q * d, r * a + s * c, r * b + s * d
    # Rescale by a power of two when the map leaves [1/TANGENT_SCALE, TANGENT_SCALE]; the exponent keeps the factor.
    size = jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d)
    shrink = jnp.where(size > TANGENT_SCALE, 1 / TANGENT_SCALE, jnp.where(size < 1 / TANGENT_SCALE, TANGENT_SCALE, 1.0))
    exponent_step = jnp.where(size > TANGENT_SCALE, 1.0, jnp.where(size < 1 / TANGENT_SCALE, -1.0, 0.0))
    exponent = jnp.where(fresh, 0.0, not_none(cell.exponent))
    new = tuple(jnp.where(is_impact, x * shrink, old) for x, old in zip((a, b, c, d), cell.tangent, strict=True))
    return new, jnp.where(is_impact, exponent + exponent_step, not_none(cell.exponent))


def _add(settings: Settings, cell: Cell, impact: LaneImpact, in_window: Mask, batch_full: Mask, stuck: Mask) -> Tally:
    """Add one impact to the tally."""
    old = cell.tally
    left, right = in_window & (impact.side < 0), in_window & (impact.side > 0)
    rebound = materialise(-impact.v_out / jnp.where(impact.v_in == 0, 1.0, impact.v_in))
    speed = jnp.where(in_window, jnp.abs(impact.v_in), 0.0)
    harvest = None if old.harvest is None else _harvested(settings, cell, old.harvest, impact, in_window, batch_full)
    momentum = None
    if old.momentum is not None:
        momentum = old.momentum + jnp.where(in_window, impact.v_in, 0.0)
    if old.deepest is not None:
        old = _deeper(old, impact, in_window)
    return Tally(
        left=old.left + left.astype(speed.dtype),
        right=old.right + right.astype(speed.dtype),
        rebound_left=old.rebound_left + jnp.where(left, rebound, 0.0),
        rebound_right=old.rebound_right + jnp.where(right, rebound, 0.0),
        contact=old.contact + jnp.where(in_window, impact.duration, 0.0),
        fastest=jnp.maximum(old.fastest, speed),
        momentum=momentum,
        deepest=old.deepest,
        deepest_sides=old.deepest_sides,
        harvest=harvest,
        stuck=None if old.stuck is None else old.stuck | (in_window & stuck),
    )


def _deeper(old: Tally, impact: LaneImpact, in_window: Mask) -> Tally:
    """Update the greatest depth with one impact: over all impacts, and per wall if the walls may differ."""
    depth = not_none(impact.depth)

    def greatest(so_far: Lane, selected: Mask) -> Lane:
        return jnp.where(selected, jnp.maximum(so_far, depth), so_far)

    sides = old.deepest_sides
    if sides is not None:
        left, right = in_window & (impact.side < 0), in_window & (impact.side > 0)
        sides = Sides(greatest(sides.left, left), greatest(sides.right, right))
    return replace(old, deepest=greatest(not_none(old.deepest), in_window), deepest_sides=sides)


def _harvested(
    settings: Settings, cell: Cell, old: Harvest, impact: LaneImpact, in_window: Mask, batch_full: Mask
) -> Harvest:
    """Add the energy that one impact harvests, for every variant."""
    # Depth in metres, [lane, variant].
    metres = (not_none(impact.depth) * cell.length)[:, None] * settings.length_variant
    device = settings.device if cell.device is None else jax.tree.map(lambda x: x[:, None], cell.device)
    device = device.at(impact.side[:, None])
    harvested = materialise(energy.harvested_energy(device, metres))
    in_window_wide, batch_full_wide = in_window[:, None], batch_full[:, None]
    ratio = old.ratio
    if ratio is not None:
        speeds = cell.speed[:, None] * settings.speed_variant
        # W_j in joules: `work` is per unit mass, in squared units of velocity.
        impact_work = device.m_b * speeds * speeds * not_none(impact.work)[:, None]
        ratio = jnp.where(in_window_wide, jnp.maximum(ratio, energy.energy_ratio(harvested, impact_work)), ratio)
    flight = jnp.where(in_window, impact.flight, 0.0)
    return Harvest(
        batch=jnp.where(batch_full_wide, 0.0, old.batch) + jnp.where(in_window_wide, harvested, 0.0),
        past=jnp.where(batch_full_wide, old.past + old.batch, old.past),
        square=jnp.where(batch_full_wide, old.square + old.batch * old.batch, old.square),
        ratio=ratio,
        flight_squares=old.flight_squares + flight * flight,
        longest_flight=jnp.maximum(old.longest_flight, flight),
    )
