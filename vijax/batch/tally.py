"""Adding an impact to a cell: its sums, its tangent map, its recurrence; `cell_end` says whether it stops there."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from vijax.batch.attractor_search import recur
from vijax.batch.cell import (
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
from vijax.batch.cell_end import ended, last_period
from vijax.batch.chain import note
from vijax.engine.impact import LaneImpact
from vijax.model import energy
from vijax.model.sides import Sides
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share


def add_event(plan: Plan, settings: Settings, cell: Cell, event: Event) -> Cell:
    """Add one event to a cell."""
    impact = event.impact
    end = last_period(plan, settings, cell)
    over = event.real & (impact.onset_n >= end)
    tracing = jnp.zeros_like(over) if cell.candidate is None else cell.candidate.tracing
    over = over & ~tracing
    kept = event.real & ~over & ~event.permanent
    counted = kept & (tracing | (impact.onset_n >= cell.since))
    over, kept, counted = share((over, kept, counted))
    count = cell.count + kept.astype(cell.count.dtype)
    status, stop = ended(cell, event, count, end)
    tangent, exponent = _extend_tangent(cell, impact, kept, counted)
    batch = jnp.where(counted & ~tracing, _batch_of(settings, cell, impact), cell.batch)
    # A batch that has ended is squared away before the first impact of the next is added.
    turned = counted & ~tracing & (batch != cell.batch) & (cell.batch >= 0)
    batch, turned = share((batch, turned))
    tally = _add(settings, cell, impact, counted, turned, event.stuck)
    if tally.deepest is not None:
        # A contact for ever has a depth although no impact ends it.
        tally = _deeper(tally, impact, event.permanent & ~jnp.isnan(present(impact.depth)))
    candidate, found = recur(settings, cell, impact, kept, count)
    return replace(
        cell,
        ball=choose(kept, impact.after, cell.ball),
        running=cell.running & ~(stop | over | found),
        status=status,
        count=count,
        batch=batch,
        tally=tally,
        candidate=candidate,
        tangent=tangent,
        exponent=exponent,
        relay=note(settings, cell, impact, kept, end),
    )


def _batch_of(settings: Settings, cell: Cell, impact: LaneImpact) -> Lane:
    return jnp.floor((impact.onset_n - cell.since) / batch_length(settings, cell.candidate))


def _extend_tangent(cell: Cell, impact: LaneImpact, kept: Mask, counted: Mask):
    """Put the new step on the left of the tangent map; the first impact of the window starts it afresh."""
    if cell.tangent is None:
        return None, None
    fresh = counted & (cell.batch < 0)
    if cell.candidate is not None:
        fresh = fresh & ~cell.candidate.tracing
    a, b, c, d = (jnp.where(fresh, unit, old) for unit, old in zip((1.0, 0.0, 0.0, 1.0), cell.tangent, strict=True))
    p, q, r, s = present(impact.tangent)
    a, b, c, d = p * a + q * c, p * b + q * d, r * a + s * c, r * b + s * d
    size = jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d)
    shrink = jnp.where(size > TANGENT_SCALE, 1 / TANGENT_SCALE, jnp.where(size < 1 / TANGENT_SCALE, TANGENT_SCALE, 1.0))
    carried = jnp.where(size > TANGENT_SCALE, 1.0, jnp.where(size < 1 / TANGENT_SCALE, -1.0, 0.0))
    exponent = jnp.where(fresh, 0.0, present(cell.exponent))
    new = tuple(jnp.where(kept, x * shrink, old) for x, old in zip((a, b, c, d), cell.tangent, strict=True))
    return new, jnp.where(kept, exponent + carried, present(cell.exponent))


def _add(settings: Settings, cell: Cell, impact: LaneImpact, counted: Mask, turned: Mask, stuck: Mask) -> Tally:
    """Add one impact to the tally."""
    old = cell.tally
    left, right = counted & (impact.side < 0), counted & (impact.side > 0)
    rebound = share(-impact.v_out / jnp.where(impact.v_in == 0, 1.0, impact.v_in))
    speed = jnp.where(counted, jnp.abs(impact.v_in), 0.0)
    harvest = None if old.harvest is None else _harvested(settings, cell, old.harvest, impact, counted, turned)
    momentum = None
    if old.momentum is not None:
        momentum = old.momentum + jnp.where(counted, impact.v_in, 0.0)
    if old.deepest is not None:
        old = _deeper(old, impact, counted)
    return Tally(
        left=old.left + left.astype(speed.dtype),
        right=old.right + right.astype(speed.dtype),
        rebound_left=old.rebound_left + jnp.where(left, rebound, 0.0),
        rebound_right=old.rebound_right + jnp.where(right, rebound, 0.0),
        contact=old.contact + jnp.where(counted, impact.duration, 0.0),
        fastest=jnp.maximum(old.fastest, speed),
        momentum=momentum,
        deepest=old.deepest,
        deepest_sides=old.deepest_sides,
        harvest=harvest,
        stuck=None if old.stuck is None else old.stuck | (counted & stuck),
    )


def _deeper(old: Tally, impact: LaneImpact, counted: Mask) -> Tally:
    """Take the depth of one impact into the greatest so far: of all, and of its wall where the walls may differ."""
    depth = present(impact.depth)

    def greatest(so_far: Lane, here: Mask) -> Lane:
        return jnp.where(here, jnp.maximum(so_far, depth), so_far)

    sides = old.deepest_sides
    if sides is not None:
        left, right = counted & (impact.side < 0), counted & (impact.side > 0)
        sides = Sides(greatest(sides.left, left), greatest(sides.right, right))
    return replace(old, deepest=greatest(present(old.deepest), counted), deepest_sides=sides)


def _harvested(
    settings: Settings, cell: Cell, old: Harvest, impact: LaneImpact, counted: Mask, turned: Mask
) -> Harvest:
    """Add what one impact harvests."""
    metres = (present(impact.depth) * cell.length)[:, None] * settings.length_variant
    device = settings.device if cell.device is None else jax.tree.map(lambda x: x[:, None], cell.device)
    device = device.at(impact.side[:, None])
    got = share(energy.harvested_energy(device, metres))
    wide, ended = counted[:, None], turned[:, None]
    ratio = old.ratio
    if ratio is not None:
        speeds = cell.speed[:, None] * settings.speed_variant
        given = device.m_b * speeds * speeds * present(impact.work)[:, None]
        ratio = jnp.where(wide, jnp.maximum(ratio, energy.energy_ratio(got, given)), ratio)
    flight = jnp.where(counted, impact.flight, 0.0)
    return Harvest(
        batch=jnp.where(ended, 0.0, old.batch) + jnp.where(wide, got, 0.0),
        past=jnp.where(ended, old.past + old.batch, old.past),
        square=jnp.where(ended, old.square + old.batch * old.batch, old.square),
        ratio=ratio,
        flights=old.flights + flight * flight,
        longest=jnp.maximum(old.longest, flight),
    )
