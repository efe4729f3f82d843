"""What is kept of a cell that has ended."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from vijax.batch.cell import TANGENT_SCALE, Cell, Lane, Mask, Plan, Settings, batch_length, last_period
from vijax.batch.chain import Handover, hand_over
from vijax.engine.impact import Ball
from vijax.model.records import Status
from vijax.runtime.arrays import AnyArray

_CHAOS = 7.0  # growth of the tangent map, in powers of e, that a transient of a periodic orbit does not reach


class Summary(eqx.Module):
    """What is kept of every cell; nondimensional unless said. Fields not asked for are None."""

    P: Float[AnyArray, "cell variant"] | None  # J per half period
    P_stderr: Float[AnyArray, "cell variant"] | None
    energy_ratio: Float[AnyArray, "cell variant"] | None  # largest E_j/W_j
    deepest: Float[AnyArray, "cell"] | None
    fastest: Float[AnyArray, "cell"]
    asymmetry: Float[AnyArray, "cell"] | None  # mean of v_in over the greatest speed
    period: Int[AnyArray, "cell"]
    impacts_left: Int[AnyArray, "cell"]
    impacts_right: Int[AnyArray, "cell"]
    impacts_per_period: Float[AnyArray, "cell"]
    restitution: Float[AnyArray, "cell"]
    restitution_left: Float[AnyArray, "cell"]
    restitution_right: Float[AnyArray, "cell"]
    contact_time: Float[AnyArray, "cell"]
    contact_fraction: Float[AnyArray, "cell"]
    lyapunov: Float[AnyArray, "cell"] | None
    periods_run: Float[AnyArray, "cell"]
    status: Int[AnyArray, "cell"]
    handover: Handover | None = None  # chained cells alone have one


def shapes(plan: Plan, dtype: Any) -> Any:
    """What `unload` gives of one cell, as shapes: tracing it for them takes a fifth of a second of every program."""
    number: Any = jax.ShapeDtypeStruct((1,), dtype)
    whole = jax.ShapeDtypeStruct((1,), jnp.int32)
    energies = ("P", "P_stderr", "energy_ratio")
    kinds: dict[str, Any] = dict.fromkeys(energies, jax.ShapeDtypeStruct((1, plan.variants), dtype))
    kinds |= dict.fromkeys(("period", "impacts_left", "impacts_right", "status"), whole)
    kinds |= {"handover": Handover(number, number, number, Ball(*[number] * 4), number)}
    asked = dict.fromkeys(energies, plan.energies)
    asked |= {"deepest": plan.deep, "asymmetry": plan.asymmetry, "lyapunov": plan.tangent, "handover": plan.chained}
    fields = Summary.__dataclass_fields__
    return Summary(**{name: kinds.get(name, number) if asked.get(name, True) else None for name in fields})


def unload(plan: Plan, settings: Settings, cell: Cell) -> Summary:
    """What is kept of cells that are done."""
    t = cell.tally
    attractor = cell.candidate is not None
    periodic = cell.candidate.tracing if attractor else jnp.zeros_like(cell.running)
    failed = (cell.status == Status.EVENT_BUDGET) | (cell.status == Status.NONFINITE)
    periodic = periodic & ~failed
    quiet, permanent = cell.status == Status.NO_IMPACT, cell.status == Status.PERMANENT_CONTACT
    end = last_period(plan, settings, cell.since)
    window = end - cell.since
    span = jnp.where(periodic, cell.candidate.period if attractor else 1.0, window)
    hits = t.left + t.right
    silent = ~periodic & ~failed & ~permanent & ((hits == 0) | (quiet if attractor else False))
    still = silent | permanent
    status = jnp.where(silent, Status.NO_IMPACT, jnp.where(permanent | failed, cell.status, Status.OK))
    prime = cell.candidate.prime if attractor else span
    period = jnp.where(periodic, prime, -1.0)
    lyapunov = None
    if plan.tangent:
        size = sum(jnp.abs(x) for x in cell.tangent)
        growth = jnp.log(size) + cell.exponent * jnp.log(TANGENT_SCALE)
        chaotic = growth > _CHAOS
        lyapunov = jnp.where(periodic, jnp.log(cell.multiplier) / span, growth / window)
        lyapunov = jnp.where(still | failed, jnp.nan, lyapunov)
        if attractor:
            period = jnp.where(periodic, prime, jnp.where(chaotic, 0.0, -1.0))
            status = jnp.where(~periodic & ~chaotic & ~still & ~failed, Status.SLOW, status)
    if attractor:
        period = jnp.where(still, 1.0, jnp.where(failed, -1.0, period))
    if plan.rigid:
        status = jnp.where(t.stuck & (status == Status.OK), Status.STICKING, status)

    def per(total, number):
        return jnp.where((number > 0) & ~still, total / jnp.where(number > 0, number, 1.0), jnp.nan)

    def measured(value):
        value = jnp.where(still, 0.0, value)
        return jnp.where(failed, jnp.nan, value)

    labelled = periodic | (still & attractor)

    def number(impacts):
        """Impacts in the period of the label, -1 where there is none."""
        each = jnp.where(still, 0.0, jnp.round(impacts * prime / span))
        return jnp.where(labelled, each, -1.0).astype(jnp.int32)

    power = error = ratio = None
    if plan.energies:
        power, error = _power(plan, settings, cell, periodic, still, window, span)
        power, error = jnp.where(failed[:, None], jnp.nan, power), jnp.where(failed[:, None], jnp.nan, error)
        ratio = jnp.where(failed[:, None], jnp.nan, jnp.where(still[:, None], 0.0, t.ratio))
    ran = cell.ball.n + 0.5 * cell.ball.t
    return Summary(
        P=power,
        P_stderr=error,
        energy_ratio=ratio,
        deepest=jnp.where(failed, jnp.nan, jnp.where(silent, 0.0, t.deepest)) if plan.deep else None,
        fastest=measured(t.fastest),
        asymmetry=per(t.momentum, hits * t.fastest) if plan.asymmetry else None,
        period=period.astype(jnp.int32),
        impacts_left=number(t.left),
        impacts_right=number(t.right),
        impacts_per_period=measured(hits / span),
        restitution=per(t.rebound_left + t.rebound_right, hits),
        restitution_left=per(t.rebound_left, t.left),
        restitution_right=per(t.rebound_right, t.right),
        contact_time=per(t.contact, hits),
        contact_fraction=jnp.where(permanent, 1.0, measured(t.contact / (2 * span))),
        lyapunov=lyapunov,
        periods_run=jnp.where(periodic, ran, jnp.where(failed | still, jnp.minimum(ran, end), end)),
        status=status.astype(jnp.int32),
        handover=hand_over(settings, cell, periodic, failed, end) if plan.chained else None,
    )


def _power(plan, settings, cell: Cell, periodic: Mask, still: Mask, window: Lane, span: Lane):
    """Energy per half period, and its standard error by batch means (0 on an orbit)."""
    t = cell.tally
    length = batch_length(plan, settings)
    batches = jnp.floor(window / length)
    last = (cell.batch < batches)[:, None]  # the running batch is a whole one: nothing came after it
    past = t.energy_past + jnp.where(last, t.energy, 0.0)
    square = t.energy_square + jnp.where(last, t.energy * t.energy, 0.0)
    number = jnp.maximum(batches, 1.0)[:, None]
    mean = past / number
    spread = jnp.maximum(square / number - mean * mean, 0.0) * number / jnp.maximum(number - 1, 1.0)
    error = jnp.sqrt(spread / number) / (2 * length)
    error = jnp.where((batches >= 2)[:, None], error, jnp.nan)
    power = (t.energy_past + t.energy) / (2 * span)[:, None]
    none = still[:, None]
    return jnp.where(none, 0.0, power), jnp.where(none | periodic[:, None], 0.0, error)
