"""What is kept of a cell that has ended."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from vijax.batch.cell import Cell, Harvest, Lane, Mask, Plan, Settings, Tally, batch_length
from vijax.batch.cell_end import chaotic, failed, few_impacts, growth, last_period
from vijax.batch.chain import Handover, hand_over
from vijax.engine.impact import Ball
from vijax.model.records import Status
from vijax.model.sides import Sides, named
from vijax.runtime.arrays import AnyArray, Values, present

# The square of the longest flight over the mean square from which flights count as rare and long, see `_unmet_flights`:
# at most 8 in chaos without them, 42 in the median in level gaps wider than 2/pi^2.
_LONG_FLIGHT = 12.0
# Part of the expected variance by long flights that is added to the one of batch means, which has some of it: with
# 0.25, 0.5 and 1 the differences of averages over their standard errors have a root mean square of 0.99, 0.86 and 0.73.
_UNMET_SHARE = 0.5
# An aperiodic cell with fewer impacts in its window has the status FEW_IMPACTS; see `few_impacts`.
_FEWEST_IMPACTS = 100


class Summary(eqx.Module):
    """What is kept of every cell; nondimensional unless said. Fields not asked for are None."""

    P: Float[AnyArray, "cell variant"] | None  # J per half period
    P_stderr: Float[AnyArray, "cell variant"] | None
    energy_ratio: Float[AnyArray, "cell variant"] | None  # largest E_j/W_j
    deepest: Float[AnyArray, " cell"] | None
    deepest_left: Float[AnyArray, " cell"] | None  # the greatest at the left wall; None where both walls are equal
    deepest_right: Float[AnyArray, " cell"] | None
    fastest: Float[AnyArray, " cell"]
    asymmetry: Float[AnyArray, " cell"] | None  # mean of v_in over the greatest speed
    period: Int[AnyArray, " cell"]
    impacts_left: Int[AnyArray, " cell"]
    impacts_right: Int[AnyArray, " cell"]
    impacts_per_period: Float[AnyArray, " cell"]
    restitution: Float[AnyArray, " cell"]
    restitution_left: Float[AnyArray, " cell"]
    restitution_right: Float[AnyArray, " cell"]
    contact_time: Float[AnyArray, " cell"]
    contact_fraction: Float[AnyArray, " cell"]
    lyapunov: Float[AnyArray, " cell"] | None
    periods_run: Float[AnyArray, " cell"]
    status: Int[AnyArray, " cell"]
    handover: Handover | None = None  # chained cells alone have one


def shapes(plan: Plan, dtype: Any) -> Any:
    """Give what `unload` gives of one cell, as shapes: tracing it for them takes a fifth of a second a program."""
    number: Any = jax.ShapeDtypeStruct((1,), dtype)
    whole = jax.ShapeDtypeStruct((1,), jnp.int32)
    energies = ("P", "P_stderr", "energy_ratio")
    kinds: dict[str, Any] = dict.fromkeys(energies, jax.ShapeDtypeStruct((1, plan.variants), dtype))
    kinds |= dict.fromkeys(("period", "impacts_left", "impacts_right", "status"), whole)
    kinds |= {"handover": Handover(number, number, number, Ball(*[number] * 4), number)}
    asked = dict.fromkeys(energies, plan.energies)
    asked |= {"energy_ratio": plan.energies and plan.work, "deepest": plan.deep}
    asked |= dict.fromkeys(("deepest_left", "deepest_right"), plan.deep and plan.unequal)
    asked |= {"asymmetry": plan.asymmetry, "lyapunov": plan.tangent, "handover": plan.chained}
    names = Summary.__dataclass_fields__
    fields: dict[str, Any] = {name: kinds.get(name, number) if asked.get(name, True) else None for name in names}
    return Summary(**fields)


class _End(eqx.Module):
    """How cells ended; every cell is one of periodic, still, failed or none of these.

    Attributes:
        periodic: On an orbit: the sums are those of one round.
        silent: Without an impact.
        permanent: In contact for ever.
        failed: Stopped: nothing can be said.
        end, window: The last period, and how many the window has.
        span: How many periods the sums are over.
        prime: The period of the orbit; `span` where none is sought.
    """

    periodic: Mask
    silent: Mask
    permanent: Mask
    failed: Mask
    end: Lane
    window: Lane
    span: Lane
    prime: Lane

    @property
    def still(self) -> Mask:
        """Say which balls are at rest, in flight or in contact."""
        return self.silent | self.permanent


def _ended(plan: Plan, settings: Settings, cell: Cell) -> _End:
    c, impacts = cell.candidate, cell.tally.left + cell.tally.right
    lost = failed(cell.status)
    periodic = (jnp.zeros_like(cell.running) if c is None else c.tracing) & ~lost
    permanent = cell.status == Status.PERMANENT_CONTACT
    end = last_period(plan, settings, cell)
    window = end - cell.since
    span = jnp.where(periodic, 1.0 if c is None else c.period, window)
    quiet = impacts == 0 if c is None else (impacts == 0) | (cell.status == Status.NO_IMPACT)
    silent = ~periodic & ~lost & ~permanent & quiet
    return _End(periodic, silent, permanent, lost, end, window, span, span if c is None else c.prime)


def unload(plan: Plan, settings: Settings, cell: Cell) -> Summary:
    """Compute the summary of cells that are done."""
    t, e = cell.tally, _ended(plan, settings, cell)
    still, failed, hits = e.still, e.failed, t.left + t.right
    period, status, lyapunov = _kind(cell, e)

    def measured(value):
        value = jnp.where(still, 0.0, value)
        return jnp.where(failed, jnp.nan, value)

    labelled = e.periodic | (still & (cell.candidate is not None))

    def number(impacts):
        """Count impacts in the period of the label, -1 where there is none."""
        each = jnp.where(still, 0.0, jnp.round(impacts * e.prime / e.span))
        return jnp.where(labelled, each, -1.0).astype(jnp.int32)

    def depth(value):
        return jnp.where(failed, jnp.nan, jnp.where(e.silent, 0.0, value))

    power, error, ratio = _harvested(settings, cell, e)
    greatest = {"deepest": t.deepest} | named("deepest", t.deepest_sides or Sides(None, None))
    depths: dict[str, Any] = {name: None if x is None else depth(x) for name, x in greatest.items()}
    ran = cell.ball.n + 0.5 * cell.ball.t
    return Summary(
        P=power,
        P_stderr=error,
        energy_ratio=ratio,
        **depths,
        fastest=measured(t.fastest),
        period=period.astype(jnp.int32),
        impacts_left=number(t.left),
        impacts_right=number(t.right),
        impacts_per_period=measured(hits / e.span),
        **_means(t, hits, still),
        contact_fraction=jnp.where(e.permanent, 1.0, measured(t.contact / (2 * e.span))),
        lyapunov=lyapunov,
        periods_run=jnp.where(e.periodic, ran, jnp.where(failed | still, jnp.minimum(ran, e.end), e.end)),
        status=status.astype(jnp.int32),
        handover=hand_over(settings, cell, e.periodic, failed, e.end) if plan.chained else None,
    )


def _means(t: Tally, hits: Lane, still: Mask) -> dict[str, Any]:
    """Compute means over impacts; NaN for cells without impacts, and for those `still`."""

    def per(total, number):
        return jnp.where((number > 0) & ~still, total / jnp.where(number > 0, number, 1.0), jnp.nan)

    return {
        "asymmetry": None if t.momentum is None else per(t.momentum, hits * t.fastest),
        "restitution": per(t.rebound_left + t.rebound_right, hits),
        "restitution_left": per(t.rebound_left, t.left),
        "restitution_right": per(t.rebound_right, t.right),
        "contact_time": per(t.contact, hits),
    }


def _kind(cell: Cell, e: _End) -> tuple[Lane, Int[AnyArray, " lane"], Lane | None]:
    """Tell the period (0: chaos, -1: neither known), status and Lyapunov exponent."""
    attractor, none = cell.candidate is not None, e.still | e.failed
    period, lyapunov = jnp.where(e.periodic, e.prime, -1.0), None
    status = jnp.where(e.silent, Status.NO_IMPACT, jnp.where(e.permanent | e.failed, cell.status, Status.OK))
    if cell.tangent is not None:
        lyapunov = jnp.where(e.periodic, jnp.log(present(cell.multiplier)) / e.span, growth(cell) / e.window)
        lyapunov = jnp.where(none, jnp.nan, lyapunov)
        if attractor:
            chaos = chaotic(cell)
            period = jnp.where(e.periodic, e.prime, jnp.where(chaos, 0.0, -1.0))
            few = few_impacts(cell, e.window, _FEWEST_IMPACTS)
            status = jnp.where(few & ~e.periodic & ~none, Status.FEW_IMPACTS, status)
            status = jnp.where(~e.periodic & ~chaos & ~none, Status.SLOW, status)
            status = jnp.where(e.periodic & present(cell.candidate).late, Status.CONVERGING, status)
    if attractor:
        period = jnp.where(e.still, 1.0, jnp.where(e.failed, -1.0, period))
    if cell.tally.stuck is not None:
        status = jnp.where(cell.tally.stuck & (status == Status.OK), Status.STICKING, status)
    return period, status, lyapunov


def _harvested(settings: Settings, cell: Cell, e: _End) -> tuple[Values | None, Values | None, Values | None]:
    """Tell power, its standard error and the largest energy ratio, as far as they are asked for."""
    harvest = cell.tally.harvest
    if harvest is None:
        return None, None, None
    power, error = _power(settings, cell, harvest, e)
    ratio = None if harvest.ratio is None else jnp.where(e.still[:, None], 0.0, harvest.ratio)
    return jax.tree.map(lambda x: jnp.where(e.failed[:, None], jnp.nan, x), (power, error, ratio))


def _unmet_flights(cell: Cell, harvest: Harvest, e: _End) -> Lane:
    """Compute the relative variance of P by flights longer than the window has met; 0 where none are to come.

    With durations T of flights, P(T > t) = C t^(-3/2) for long t, and a window of length W, flights up to the longest
    one add 3 C W sqrt(max(T)) to sum(T^2). A window of that length is expected to have 3 C W sqrt(W). A flight that is
    longer than others by T takes the part T / W of the energy.
    """
    window = 2 * e.window
    unfinished = jnp.clip(2 * (e.end - cell.ball.n) - cell.ball.t, 0.0, window)
    longest = jnp.minimum(jnp.maximum(harvest.longest, unfinished), window)
    squares, number = harvest.flights + unfinished * unfinished, cell.tally.left + cell.tally.right + 1
    rare = number * longest * longest > _LONG_FLIGHT * squares
    spread = _UNMET_SHARE * squares * jnp.sqrt(window / jnp.where(rare, longest, 1.0)) / (window * window)
    return jnp.where(rare, spread, 0.0)


def _power(settings: Settings, cell: Cell, harvest: Harvest, e: _End) -> tuple[Values, Values]:
    """Compute the energy per half period, and its standard error (0 on an orbit).

    The standard error is that of batch means, and of rare long flights. On level ground a ball that is slow in a gap
    wider than 2/pi^2 flies for hundreds of periods: durations of flights have a tail of exponent 3/2, of which a window
    meets too little.
    """
    length = batch_length(settings, cell.candidate)
    batches = jnp.floor(e.window / length)
    last = (cell.batch < batches)[:, None]  # the running batch is a whole one: nothing came after it
    past = harvest.past + jnp.where(last, harvest.batch, 0.0)
    square = harvest.square + jnp.where(last, harvest.batch * harvest.batch, 0.0)
    number = jnp.maximum(batches, 1.0)[:, None]
    mean = past / number
    spread = jnp.maximum(square / number - mean * mean, 0.0) * number / jnp.maximum(number - 1, 1.0)
    power = (harvest.past + harvest.batch) / (2 * e.span)[:, None]
    error = jnp.sqrt(spread / number) / (2 * length).reshape(-1, 1)
    unmet = _unmet_flights(cell, harvest, e)[:, None]
    error = jnp.where(unmet > 0, jnp.hypot(error, power * jnp.sqrt(unmet)), error)
    error = jnp.where((batches >= 2)[:, None], error, jnp.nan)
    none = e.still[:, None]
    return jnp.where(none, 0.0, power), jnp.where(none | e.periodic[:, None], 0.0, error)
