"""Conditions that end a cell: its window is over, no impact follows, the contact never ends, or the computation fails.

In the search for an attractor `attractor_search.review` also decides on the end.
"""

import math

import jax.numpy as jnp
from jaxtyping import Int

from vijax.model.records import Status
from vijax.runtime.arrays import AnyArray, not_none
from vijax.simulation.cell.cell import (
    FULL_WINDOW,
    TANGENT_SCALE,
    TRANSIENT_SHARE,
    Cell,
    Event,
    Lane,
    Mask,
    Plan,
    Settings,
)

# Impacts per forcing period after which a cell is stopped: an endless chatter would otherwise occupy its lane for ever.
_MAX_IMPACTS_PER_PERIOD = 512
# Steps per forcing period after which a cell is stopped, for methods with variable steps. A run would never end if
# rounding prevented the steps from meeting their tolerance.
_MAX_STEPS_PER_PERIOD = 20_000
# An undecided cell runs on for this multiple of `periods`. Compared with 3, half again as many cells remain undecided
# with 1, and a third fewer with 9. With 9, however, a plane of 128 x 128 cells takes twice as long, because the last
# lanes of a tile run on while the others idle.
_LATE_SHARE = 3.0
# Logarithm of the growth of the tangent map over a window above which motion without an orbit counts as chaos. A
# smaller value mistakes slow transients of periodic orbits for chaos; a larger one leaves weak chaos undecided in short
# windows.
_CHAOS_GROWTH = 7.0


def last_period(plan: Plan, settings: Settings, cell: Cell) -> Lane:
    """Return the last period of a cell's window.

    After a failed Newton round the window begins later; its end is then moved so that the window lasts at least the
    share TRANSIENT_SHARE of the run. Undecided cells (`late`), and cells with too few impacts in their window
    (`extension` > 1), have a later last period.
    """
    since, c = cell.since, cell.candidate
    if c is None:
        return settings.periods + settings.transient + jnp.zeros_like(since)
    late = jnp.where(c.late, _LATE_SHARE * settings.periods, 0.0)
    periods = settings.periods * c.extension
    return jnp.maximum(periods + late, since + jnp.ceil(TRANSIENT_SHARE * periods))


def few_impacts(cell: Cell, window: Lane, enough: int) -> Mask:
    """Return True for cells with too few impacts in their window.

    Args:
        cell: Lanes.
        window: Length of the window in periods.
        enough: Impacts needed in a window of at least `FULL_WINDOW` periods; a shorter one needs proportionally fewer.
    """
    return cell.tally.left + cell.tally.right < enough * jnp.minimum(window / FULL_WINDOW, 1.0)


def ended(cell: Cell, event: Event, count: Lane, end: Lane) -> tuple[Int[AnyArray, " lane"], Mask]:
    """Return the status of cells after an event, and a mask of the cells that end with this event.

    Args:
        cell: State before the event.
        event: The event.
        count: Number of impacts of the cell, including the event.
        end: Last period of the cell's window. The caller tests whether the onset of the impact is after this period.
    """
    status = jnp.where(event.no_impact, Status.NO_IMPACT, cell.status)
    status = jnp.where(event.permanent, Status.PERMANENT_CONTACT, status).astype(cell.status.dtype)
    spent = count > _MAX_IMPACTS_PER_PERIOD * (end + 1)
    # An impact with a velocity or time that is not finite invalidates the cell.
    broken = event.real & ~jnp.isfinite(event.impact.v_out + event.impact.after.t)
    status = jnp.where(spent, Status.EVENT_BUDGET, jnp.where(broken, Status.NONFINITE, status))
    return status.astype(cell.status.dtype), event.no_impact | event.permanent | spent | broken


def growth(cell: Cell) -> Lane:
    """Return ln of the growth of the tangent map over the window so far; the growth is the sum of |entries|."""
    a, b, c, d = not_none(cell.tangent)
    return jnp.log(jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d)) + not_none(cell.exponent) * math.log(
        TANGENT_SCALE
    )


def chaotic(cell: Cell) -> Mask:
    """Return True if the tangent map has grown as in chaos; the caller excludes cells on an orbit."""
    return growth(cell) > _CHAOS_GROWTH


def out_of_steps(cell: Cell, step_count: Int[AnyArray, " lane"], end: Lane) -> Mask:
    """Return True for running cells with more steps than any motion needs."""
    return cell.running & (step_count.astype(cell.count.dtype) > _MAX_STEPS_PER_PERIOD * (end + 1))


def failed(status: Int[AnyArray, "..."]) -> Mask:
    """Return True for cells that were stopped by a budget or are not finite; their results are void."""
    return (status == Status.EVENT_BUDGET) | (status == Status.NONFINITE)
