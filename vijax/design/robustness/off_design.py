"""Motion at values near a design: range with the same motion, motion beyond it, tolerances, and arrival of starts."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.design.aperiodic.ensemble import DesignTask, Ensemble, has_no_impact, is_impacting, simulate_ensembles
from vijax.design.aperiodic.motion_averages import Averages
from vijax.design.design_settings import DEFAULT
from vijax.design.optimum import AperiodicOptimum, BaseOptimum, Optimum
from vijax.design.robustness.tolerance import Tolerance, ToleranceStatistics, validate_samples, validate_tolerances
from vijax.model.tuned_quantities import LINEAR, to_variables
from vijax.runtime import validation
from vijax.runtime.public_api import public_api
from vijax.simulation.simulate import Starts

_RANGE = 0.1  # largest tested change of a quantity, relative to its value; of an inclination in rad
_FIRST_STEP = 1e-4 * _RANGE  # first step; a range below a hundredth of its value is resolved to a tenth of it
_STEP_GROWTH = 2.0  # factor on the step if the motion persisted
_APERIODIC_SAMPLES = 8  # samples of an aperiodic motion, because the average of one varies at random
_PERIODS = 400  # forcing periods of each sample at each step
_ARRIVAL_STARTS = 256, 2000  # number of starts, and forcing periods simulated for each
_DEVICES = 256  # default number of random devices
# If |change of ln P| exceeds _STEEPEST times the relative change of the quantity plus _LEAST_JUMP, the motion counts as
# another one.
_STEEPEST, _LEAST_JUMP = 10.0, 0.02
_SAME_ORBIT = 1e-6  # relative difference of P below which a motion with the same label is the design's orbit


class Side(NamedTuple):
    """Smaller or larger values of one tuned quantity: how far the motion of a design persists.

    Attributes:
        percent: Largest tested change with the same motion, in percent of the quantity; for an inclination, in percent
            of 1 rad.
        persists: True if the motion persists over the whole tested range, 10 %.
        label, P, admissible: Label, P [J] and admissibility of the motion just beyond `percent`; if the motion
            persists, at the end of the range.
    """

    percent: float
    persists: bool
    label: str
    P: float
    admissible: bool


_NO_RANGE = Side(0.0, False, "", 0.0, False)


class ParameterRange(NamedTuple):
    """Range of one tuned quantity with the same motion: the sides with smaller and with larger values."""

    name: str
    below: Side
    above: Side

    @property
    def percent(self) -> float:
        """Return the smaller `percent` of both sides."""
        return min(self.below.percent, self.above.percent)


class ArrivalStatistics(NamedTuple):
    """Share of starts anywhere in the gap that reach the motion of a design, and the forcing periods that they need.

    Attributes:
        share: Share of the starts that end on the motion.
        median, p90: Periods after which half and nine tenths of the arriving starts have arrived; NaN for motion that
            is not an orbit.
        periods: Forcing periods simulated for each start.
    """

    share: float
    median: float
    p90: float
    periods: int


@public_api
def parameter_ranges(optimum: Optimum | AperiodicOptimum) -> tuple[ParameterRange, ...]:
    """Compute how far each tuned quantity may change with the motion of a design unchanged, and the motion beyond.

    One quantity is changed in growing steps, with all others fixed. At each step a sample continues from its last
    state: one sample for an orbit, eight for aperiodic motion.
    """
    validation.validate_instance("optimum", optimum, BaseOptimum, "vijax.optimise(...).best")
    names = tuple(optimum.values)
    samples = _APERIODIC_SAMPLES if optimum.label == "aperiodic" else 1
    first = jax.tree.map(lambda x: x[:samples], _starts_on_motion(optimum))
    # Order: below and above for each quantity in turn.
    side_searches = [_SideSearch(index, sign, first, optimum.P) for index in range(len(names)) for sign in (-1, 1)]
    while unfinished := [side_search for side_search in side_searches if side_search.unfinished]:
        _advance_sides(optimum, names, unfinished)
    sides = [side_search.side for side_search in side_searches]
    return tuple(ParameterRange(name, *sides[2 * i : 2 * i + 2]) for i, name in enumerate(names))


@dataclasses.dataclass
class _SideSearch:
    """The search for the end of the range on one side of one quantity, with samples that follow the motion.

    Attributes:
        index, sign: Index of the tuned quantity; -1 for smaller values, +1 for larger values.
        starts: Current states of the samples.
        P: Mean P of the samples at the change reached [J].
        change: Largest change with the same motion so far, relative to the quantity.
        step: Next increment of the change.
        side: The result so far.
    """

    index: int
    sign: int
    starts: Starts
    P: float
    change: float = 0.0
    step: float = _FIRST_STEP
    side: Side = _NO_RANGE

    @property
    def unfinished(self) -> bool:
        """Return True until the end of the range is located to a thousandth of its value, or to 1e-6 if larger."""
        return self.change < _RANGE and self.step > max(0.1 * _FIRST_STEP, 1e-3 * self.change)


def _advance_sides(optimum: Optimum | AperiodicOptimum, names: tuple[str, ...], unfinished: list[_SideSearch]) -> None:
    """Advance every side by one step; reduce the step where the motion did not persist."""
    z = np.repeat(_variables_of(optimum, names)[None], len(unfinished), axis=0)
    changes = [min(side_search.change + side_search.step, _RANGE) for side_search in unfinished]
    for row, (side_search, change) in enumerate(zip(unfinished, changes, strict=True)):
        # A logarithmic variable changes by log(1 + change).
        z[row, side_search.index] += (
            side_search.sign * change if names[side_search.index] in LINEAR else np.log1p(side_search.sign * change)
        )
    no_spread = np.zeros(len(unfinished))
    starts = [side_search.starts for side_search in unfinished]
    ensembles = simulate_ensembles(
        _make_task(optimum, "P"), no_spread.astype(int), z, no_spread, starts, _PERIODS, len(starts[0].v)
    )
    for side_search, change, ensemble in zip(unfinished, changes, ensembles, strict=True):
        P, admissible = float(np.nan_to_num(ensemble.averages.P).mean()), bool(ensemble.averages.margins().min() >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Beyond a fold another orbit may have the same label, so a jump of P also ends the range.
            smooth = abs(np.log(P / side_search.P)) < _STEEPEST * (change - side_search.change) + _LEAST_JUMP
        is_on_motion = _is_on_motion(optimum, ensemble.averages)
        # If a sample has left the motion, the label of the first such sample is reported.
        name = str(ensemble.averages.labels()[int(is_on_motion.argmin())])
        if is_on_motion.mean() >= 0.5 and smooth:
            side_search.change, side_search.P, side_search.starts, side_search.step = (
                change,
                P,
                ensemble.averages.end,
                _STEP_GROWTH * side_search.step,
            )
            side_search.side = Side(100 * change, change >= _RANGE, name, P, admissible)
        else:
            # The motion has changed, so the next trial is nearer to the last change with the same motion.
            side_search.step = 0.25 * side_search.step
            side_search.side = Side(100 * side_search.change, False, name, P, admissible)


@public_api
def arrival_statistics(optimum: Optimum | AperiodicOptimum) -> ArrivalStatistics:
    """Compute the share of starts anywhere in the gap that reach the motion of a design, and the periods they need."""
    validation.validate_instance("optimum", optimum, BaseOptimum, "vijax.optimise(...).best")
    samples, periods = _ARRIVAL_STARTS
    names, task = tuple(optimum.values), _make_task(optimum, "expected")
    (ensemble,) = simulate_ensembles(
        task, np.array([0]), _variables_of(optimum, names)[None], np.zeros(1), [], periods, samples
    )
    arrived = _is_on_motion(optimum, ensemble.averages)
    if optimum.label != "aperiodic":
        # Another orbit with the same label has another P, so equal P identifies the orbit of the design.
        arrived &= np.abs(ensemble.averages.P / optimum.P - 1) < _SAME_ORBIT
        arrival_periods = ensemble.averages.periods_run[arrived]
        quantiles = (
            (float(np.median(arrival_periods)), float(np.quantile(arrival_periods, 0.9)))
            if arrival_periods.size
            else (math.nan, math.nan)
        )
    else:
        quantiles = (math.nan, math.nan)
    return ArrivalStatistics(float(arrived.mean()), *quantiles, ensemble.periods)


@public_api
def rank_under_tolerances(
    optima: Iterable[Optimum | AperiodicOptimum], tolerances: Iterable[Tolerance], samples: int | None = None
) -> tuple[tuple[Optimum | AperiodicOptimum, ToleranceStatistics], ...]:
    """Rank optima by the mean P of devices with constants scattered by tolerances, the highest first.

    For each optimum, samples that start on its motion are simulated in random devices. P counts for every final motion.
    For an optimum in a narrow window most samples end on another motion; `optimise.tolerance_statistics`, which follows
    the orbit, counts them as 0.

    Args:
        optima: Optima of one `Design`.
        tolerances: Scatter of the constants.
        samples: Number of random devices, 256 by default.

    Raises:
        ValueError: A tolerance is invalid.
    """
    optimum_list: Any = tuple(
        validation.validate_records("optima", optima, BaseOptimum, "the optima of vijax.optimise(...)")
    )
    spreads = simulate_tolerances(
        optimum_list, validate_tolerances(tolerances), None if samples is None else validate_samples(samples)
    )
    return tuple(sorted(zip(optimum_list, spreads, strict=True), key=lambda pair: -pair[1].mean))


def simulate_tolerances(
    optima: Sequence[Optimum | AperiodicOptimum], tolerances: tuple[Tolerance, ...], samples: int | None
) -> list[ToleranceStatistics]:
    """Return the statistics of each optimum over random devices, with any motion; see `rank_under_tolerances`."""
    if not optima:
        return []
    devices = _DEVICES if samples is None else samples
    tune = tuple(optima[0].values)
    # Without bounds, random devices are not moved back into the bounds of the design.
    no_bounds = np.full((len(optima), 2, len(tune)), [[[-np.inf], [np.inf]]])
    task = DesignTask([item.device for item in optima], tune, no_bounds, "P", tolerances, 1.0, DEFAULT)
    z, device_index = np.array([_variables_of(item, tune) for item in optima]), np.arange(len(optima))
    ensembles = simulate_ensembles(
        task, device_index, z, np.zeros(len(optima)), [_starts_on_motion(item) for item in optima], _PERIODS, devices
    )
    return [_spread_statistics(item) for item in ensembles]


def _spread_statistics(ensemble: Ensemble) -> ToleranceStatistics:
    """Return the statistics of the devices of an ensemble."""
    impacting = is_impacting(ensemble.averages)
    # A device that breaks a limit counts as 0 in the mean but with its P in the worst value.
    admissible = impacting & (ensemble.averages.margins().min(axis=1) >= 0)
    P = np.where(impacting, np.nan_to_num(ensemble.averages.P), 0.0)
    return ToleranceStatistics(
        mean=float(np.where(admissible, P, 0.0).mean()),
        worst=float(P.min()),
        lost=float(1 - impacting.mean()),
        inadmissible=float((impacting & ~admissible).mean()),
    )


def _make_task(optimum: Optimum | AperiodicOptimum, objective: str) -> DesignTask:
    """Return a `DesignTask` for simulations of one optimum, without bounds and tolerances."""
    no_bounds = np.full((1, 2, len(optimum.values)), [[[-np.inf], [np.inf]]])
    return DesignTask([optimum.device], tuple(optimum.values), no_bounds, objective, (), 1.0, DEFAULT)


def _variables_of(optimum: Optimum | AperiodicOptimum, names: tuple[str, ...]) -> np.ndarray:
    """Return the variables of an optimum."""
    return to_variables(names, [optimum.values[name] for name in names])


def _starts_on_motion(optimum: Optimum | AperiodicOptimum) -> Starts:
    """Return starts on the motion: the first impact of an orbit, or the last states of an `AperiodicOptimum`."""
    if isinstance(optimum, AperiodicOptimum):
        return optimum.starts
    orbit = optimum.orbit
    # The state at the onset of the first impact is u = side d/2, v = side * speed.
    t, speed, _ = np.asarray(orbit.impact_unknowns)[0, 0]
    side = float(np.asarray(orbit.sequence.side)[0, 0])
    half = 0.5 * float(np.asarray(orbit.pair.d)[0])
    columns: Any = (np.array([x]) for x in (side * half, side * speed, t % 2.0))
    return Starts(*columns)


def _is_on_motion(optimum: Optimum | AperiodicOptimum, averages: Averages) -> np.ndarray:
    """Return a mask of the samples on a motion with the design's label or its mirror image."""
    # A mirror image has the numbers of left and right impacts exchanged.
    mirrored = averages._replace(left=averages.right, right=averages.left)
    has_label = (averages.labels() == optimum.label) | (mirrored.labels() == optimum.label)
    # A sample without an impact may be on an aperiodic motion, because flights in a wide gap can be very long.
    return has_label | (has_no_impact(averages) & (optimum.label == "aperiodic"))
