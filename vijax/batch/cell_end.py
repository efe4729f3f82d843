"""What ends a cell: its window is over, no impact comes, the ball rests for ever, or there is no going on.

Where an attractor is sought, the search decides too: `attractor_search.review`.
"""

import math

import jax.numpy as jnp
from jaxtyping import Int

from vijax.batch.cell import FULL_WINDOW, TANGENT_SCALE, TRANSIENT_SHARE, Cell, Event, Lane, Mask, Plan, Settings
from vijax.model.records import Status
from vijax.runtime.arrays import AnyArray, present

# Impacts per forcing period after which a cell is stopped: a chatter without end would hold its lane for ever.
_IMPACTS = 512
# Steps likewise, where the method chooses them: with a tolerance that rounding does not let it meet, it would go on.
_STEPS = 20_000
# Times its periods for which a cell that is undecided when they are spent goes on. With 1 half again as many of them
# stay undecided, with 9 a third fewer; but the last lanes of a tile run that long while the others stand idle, and a
# plane of 128 x 128 cells then takes twice its time.
_LATE_SHARE = 3.0
# Growth of the tangent map over a cell's window, in powers of e, from which motion without an orbit is chaos. A smaller
# one takes slow transients of periodic orbits for it, a larger one leaves weak chaos undecided in short windows.
_CHAOS = 7.0


def last_period(plan: Plan, settings: Settings, cell: Cell) -> Lane:
    """Return the last period of a cell's window.

    A window that a failed round delays is a share of the run long too. A cell that is undecided, or whose window had
    too few impacts, runs on.
    """
    since, c = cell.since, cell.candidate
    if c is None:
        return settings.periods + settings.transient + jnp.zeros_like(since)
    late = jnp.where(c.late, _LATE_SHARE * settings.periods, 0.0)
    periods = settings.periods * c.stretch
    return jnp.maximum(periods + late, since + jnp.ceil(TRANSIENT_SHARE * periods))


def few_impacts(cell: Cell, window: Lane, enough: int) -> Mask:
    """Return which cells have too few impacts in their window.

    Args:
        cell: Lanes.
        window: Length of the window in periods.
        enough: Impacts that a window of at least `FULL_WINDOW` periods needs; a shorter one needs fewer, in proportion.
    """
    return cell.tally.left + cell.tally.right < enough * jnp.minimum(window / FULL_WINDOW, 1.0)


def ended(cell: Cell, event: Event, count: Lane, end: Lane) -> tuple[Int[AnyArray, " lane"], Mask]:
    """Say how cells end by an event, and which do.

    Args:
        cell: As it was.
        event: What happened to it.
        count: Its impacts, this one included.
        end: The last period of its window; whether that is over, the onset of the impact says.
    """
    status = jnp.where(event.quiet, Status.NO_IMPACT, cell.status)
    status = jnp.where(event.permanent, Status.PERMANENT_CONTACT, status).astype(cell.status.dtype)
    spent = count > _IMPACTS * (end + 1)
    broken = event.real & ~jnp.isfinite(event.impact.v_out + event.impact.after.t)
    status = jnp.where(spent, Status.EVENT_BUDGET, jnp.where(broken, Status.NONFINITE, status))
    return status.astype(cell.status.dtype), event.quiet | event.permanent | spent | broken


def growth(cell: Cell) -> Lane:
    """Give the growth of the tangent map over the window so far, in powers of e."""
    a, b, c, d = present(cell.tangent)
    return jnp.log(jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d)) + present(cell.exponent) * math.log(TANGENT_SCALE)


def chaotic(cell: Cell) -> Mask:
    """Say which cells that follow no orbit are chaos."""
    return growth(cell) > _CHAOS


def out_of_steps(cell: Cell, taken: Int[AnyArray, " lane"], end: Lane) -> Mask:
    """Say which cells have taken more steps than any motion needs."""
    return cell.running & (taken.astype(cell.count.dtype) > _STEPS * (end + 1))


def failed(status: Int[AnyArray, "..."]) -> Mask:
    """Say which cells came to no end of their own: nothing they saw counts."""
    return (status == Status.EVENT_BUDGET) | (status == Status.NONFINITE)
