"""Results of cells that are done: power and its standard error, period, impacts, restitution, exponents, status.

The sums of the tally are divided by the span: one round of a confirmed orbit, or the window. The power is P =
sum(E_j)/(2 p) over p forcing periods (Eq. 36: energy per half forcing period). Without an orbit the standard error of P
comes from batch means.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from vijax.impact.impact import BallState
from vijax.model.records import Status
from vijax.model.walls.sides import Sides, values_by_name
from vijax.runtime.arrays import AnyArray, Values, not_none
from vijax.simulation.cell.cell import Cell, Harvest, Lane, Mask, Plan, Settings, Tally, batch_length
from vijax.simulation.cell.cell_end import chaotic, failed, few_impacts, growth, last_period
from vijax.simulation.cell.chain import Handover, hand_over

# The longest flight of a window counts as rare if its squared duration exceeds this multiple of the mean squared
# duration. The ratio is at most 8 in chaos without rare flights. On level ground, in gaps wider than 2/pi^2, its median
# is 42. See `_unmet_flights`.
_LONG_FLIGHT = 12.0
# Part of the expected variance due to long flights that is added to the variance of batch means. The part is below 1
# because the variance of batch means contains some of it already. With 0.25, 0.5 and 1 the difference of two averages,
# divided by its standard error, has a root mean square of 0.99, 0.86 and 0.73; 1 would be exact.
_UNMET_SHARE = 0.5
# An aperiodic cell with fewer impacts in its window has the status FEW_IMPACTS; see `few_impacts`.
_FEWEST_IMPACTS = 100


class Summary(eqx.Module):
    """Results of every cell; nondimensional unless a unit is stated. Fields that are not requested are None."""

    P: Float[AnyArray, "cell variant"] | None  # J per half forcing period
    P_stderr: Float[AnyArray, "cell variant"] | None
    energy_ratio: Float[AnyArray, "cell variant"] | None  # largest ratio E_j/W_j of harvested energy to work
    deepest: Float[AnyArray, " cell"] | None
    deepest_left: Float[AnyArray, " cell"] | None  # greatest depth at the left wall; None where both walls are equal
    deepest_right: Float[AnyArray, " cell"] | None
    fastest: Float[AnyArray, " cell"]
    asymmetry: Float[AnyArray, " cell"] | None  # mean of v_in, divided by the greatest speed
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
    handover: Handover | None = None  # chained cells only


def summary_shapes(plan: Plan, dtype: Any) -> Any:
    """Return the shapes of the result of `unload` for one cell, without a trace of `unload`, which would take 0.2 s."""
    number: Any = jax.ShapeDtypeStruct((1,), dtype)
    integer = jax.ShapeDtypeStruct((1,), jnp.int32)
    energies = ("P", "P_stderr", "energy_ratio")
    kinds: dict[str, Any] = dict.fromkeys(energies, jax.ShapeDtypeStruct((1, plan.variants), dtype))
    kinds |= dict.fromkeys(("period", "impacts_left", "impacts_right", "status"), integer)
    kinds |= {"handover": Handover(number, number, number, BallState(*[number] * 4), number)}
    requested = dict.fromkeys(energies, plan.energies)
    requested |= {"energy_ratio": plan.energies and plan.work, "deepest": plan.deep}
    requested |= dict.fromkeys(("deepest_left", "deepest_right"), plan.deep and plan.has_unequal_walls)
    requested |= {"asymmetry": plan.asymmetry, "lyapunov": plan.tangent, "handover": plan.chained}
    names = Summary.__dataclass_fields__
    fields: dict[str, Any] = {name: kinds.get(name, number) if requested.get(name, True) else None for name in names}
    return Summary(**fields)


class _End(eqx.Module):
    """Classification of the end of cells; each cell is periodic, still, failed or none of these.

    Attributes:
        periodic: On an orbit: the sums cover one round.
        silent: Without an impact.
        permanent: In a contact that never ends.
        failed: Stopped by a budget or not finite: no result is valid.
        end, window: The last period, and the number of periods of the window.
        span: Number of periods that the sums cover.
        prime: Prime period of the orbit; `span` if no orbit is sought.
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
        """Return True for balls at rest, in flight or in contact."""
        return self.silent | self.permanent


def _ended(plan: Plan, settings: Settings, cell: Cell) -> _End:
    c, impacts = cell.candidate, cell.tally.left + cell.tally.right
    is_failed = failed(cell.status)
    periodic = (jnp.zeros_like(cell.running) if c is None else c.tracing) & ~is_failed
    permanent = cell.status == Status.PERMANENT_CONTACT
    end = last_period(plan, settings, cell)
    window = end - cell.since
    span = jnp.where(periodic, 1.0 if c is None else c.period, window)
    no_impact = impacts == 0 if c is None else (impacts == 0) | (cell.status == Status.NO_IMPACT)
    silent = ~periodic & ~is_failed & ~permanent & no_impact
    return _End(periodic, silent, permanent, is_failed, end, window, span, span if c is None else c.prime)


def unload(plan: Plan, settings: Settings, cell: Cell) -> Summary:
    """Return the summary of cells that are done."""
    t, e = cell.tally, _ended(plan, settings, cell)
    # A ball at rest has the value 0 in every measure, a failed cell has NaN.
    still, failed, hits = e.still, e.failed, t.left + t.right
    period, status, lyapunov = _kind(cell, e)

    def measured(value):
        value = jnp.where(still, 0.0, value)
        return jnp.where(failed, jnp.nan, value)

    # A ball at rest has the label 0:0/1T if an attractor is sought.
    labelled = e.periodic | (still & (cell.candidate is not None))

    def number(impacts):
        """Return the number of impacts in one period of the motion; -1 for cells without a label."""
        rounded = jnp.where(still, 0.0, jnp.round(impacts * e.prime / e.span))
        return jnp.where(labelled, rounded, -1.0).astype(jnp.int32)

    def depth(value):
        return jnp.where(failed, jnp.nan, jnp.where(e.silent, 0.0, value))

    power, error, ratio = _harvested(settings, cell, e)
    greatest = {"deepest": t.deepest} | values_by_name("deepest", t.deepest_sides or Sides(None, None))
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
    """Return means over impacts; NaN for cells without impacts, and for `still` ones."""

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
    """Return the period (0: chaos, -1: undecided), the status and the Lyapunov exponent per forcing period."""
    attractor, void = cell.candidate is not None, e.still | e.failed
    period, lyapunov = jnp.where(e.periodic, e.prime, -1.0), None
    status = jnp.where(e.silent, Status.NO_IMPACT, jnp.where(e.permanent | e.failed, cell.status, Status.OK))
    if cell.tangent is not None:
        # On an orbit the exponent is ln |multiplier| per period; otherwise the growth of the tangent map over the
        # window.
        lyapunov = jnp.where(e.periodic, jnp.log(not_none(cell.multiplier)) / e.span, growth(cell) / e.window)
        lyapunov = jnp.where(void, jnp.nan, lyapunov)
        if attractor:
            chaos = chaotic(cell)
            period = jnp.where(e.periodic, e.prime, jnp.where(chaos, 0.0, -1.0))
            # Later assignments take precedence over earlier ones.
            too_few = few_impacts(cell, e.window, _FEWEST_IMPACTS)
            status = jnp.where(too_few & ~e.periodic & ~void, Status.FEW_IMPACTS, status)
            status = jnp.where(~e.periodic & ~chaos & ~void, Status.SLOW, status)
            status = jnp.where(e.periodic & not_none(cell.candidate).late, Status.CONVERGING, status)
    if attractor:
        period = jnp.where(e.still, 1.0, jnp.where(e.failed, -1.0, period))
    if cell.tally.stuck is not None:
        status = jnp.where(cell.tally.stuck & (status == Status.OK), Status.STICKING, status)
    return period, status, lyapunov


def _harvested(settings: Settings, cell: Cell, e: _End) -> tuple[Values | None, Values | None, Values | None]:
    """Return power, its standard error and the largest energy ratio; None for values that are not requested."""
    harvest = cell.tally.harvest
    if harvest is None:
        return None, None, None
    power, error = _power(settings, cell, harvest, e)
    ratio = None if harvest.ratio is None else jnp.where(e.still[:, None], 0.0, harvest.ratio)
    return jax.tree.map(lambda x: jnp.where(e.failed[:, None], jnp.nan, x), (power, error, ratio))


def _unmet_flights(cell: Cell, harvest: Harvest, e: _End) -> Lane:
    """Return the relative variance of P due to flights longer than all in the window; 0 if none are expected.

    Let a flight have the duration T, let the probability of T > t be C t^(-3/2) for long t, and let a window have the
    length W. Flights up to the longest one in the window, max(T), then add 3 C W sqrt(max(T)) to sum(T^2); flights up
    to the length W would add 3 C W sqrt(W). A flight that is longer than the others by T reduces the energy of the
    window by the share T / W.
    """
    window = 2 * e.window
    unfinished = jnp.clip(2 * (e.end - cell.ball.n) - cell.ball.t, 0.0, window)
    longest = jnp.minimum(jnp.maximum(harvest.longest_flight, unfinished), window)
    squares, number = harvest.flight_squares + unfinished * unfinished, cell.tally.left + cell.tally.right + 1
    rare = number * longest * longest > _LONG_FLIGHT * squares
    variance = _UNMET_SHARE * squares * jnp.sqrt(window / jnp.where(rare, longest, 1.0)) / (window * window)
    return jnp.where(rare, variance, 0.0)


def _power(settings: Settings, cell: Cell, harvest: Harvest, e: _End) -> tuple[Values, Values]:
    """Return the energy per half period, and its standard error (0 on an orbit).

    The standard error combines batch means and rare long flights. On level ground a slow ball in a gap wider than
    2/pi^2 can fly for hundreds of periods: the durations of flights have a tail of exponent 3/2, and a window contains
    too few of the long ones.
    """
    length = batch_length(settings, cell.candidate)
    batches = jnp.floor(e.window / length)
    last_is_full = (cell.batch < batches)[:, None]  # the current batch is full: no impact came after it
    past = harvest.past + jnp.where(last_is_full, harvest.batch, 0.0)
    square = harvest.square + jnp.where(last_is_full, harvest.batch * harvest.batch, 0.0)
    count = jnp.maximum(batches, 1.0)[:, None]
    mean = past / count
    # Unbiased variance of the batch sums.
    variance = jnp.maximum(square / count - mean * mean, 0.0) * count / jnp.maximum(count - 1, 1.0)
    power = (harvest.past + harvest.batch) / (2 * e.span)[:, None]
    error = jnp.sqrt(variance / count) / (2 * length).reshape(-1, 1)
    unmet = _unmet_flights(cell, harvest, e)[:, None]
    error = jnp.where(unmet > 0, jnp.hypot(error, power * jnp.sqrt(unmet)), error)
    error = jnp.where((batches >= 2)[:, None], error, jnp.nan)
    at_rest = e.still[:, None]
    return jnp.where(at_rest, 0.0, power), jnp.where(at_rest | e.periodic[:, None], 0.0, error)
