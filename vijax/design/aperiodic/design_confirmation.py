"""Confirm designs with motions other than orbits: many samples are simulated for long at exactly the design's values.

If the samples break a limit, or end on different motions, the design is moved a little and simulated again. If a
simulation measures a lower objective than predicted, places with a prediction above the measured value follow.
"""

import dataclasses
from collections import Counter
from typing import NamedTuple

import jax
import numpy as np

from vijax.design.aperiodic.aperiodic_search import AscentPlace, maximise_surfaces
from vijax.design.aperiodic.ensemble import (
    DesignTask,
    Ensemble,
    has_no_impact,
    is_impacting,
    repeat_starts,
    simulate_ensembles,
)
from vijax.design.aperiodic.motion_averages import LIMIT_NAMES
from vijax.design.optimum import AperiodicOptimum, DroppedCandidate
from vijax.design.survey.orbit_candidates import SCORE_TOLERANCE
from vijax.model.tuned_quantities import to_values, tune_device
from vijax.simulation.simulate import Starts

# reserve for extremes beyond the simulated ones, in units of (median margin - worst margin)
_TAIL_FACTOR = 1.5
# delays, in forcing periods, of every second sample, second pair and second four: 8 different sums
_PHASE_SHIFTS = 1, 2, 4
_BOUND_DISTANCE = 2  # a bound nearer than this many radii of the first ensemble is tried, too
# A simulation is not in the window of the best design if ln(best / measured) exceeds this value.
_WINDOW_DEPTH = 0.1
_WINDOW_SHIFT = 0.5  # first shift out of a window, divided by `last_radius`
_SLOPE_ERRORS = 2  # half width of the confidence interval of a slope, in standard errors
# If |slope| is certainly above the first value, the end is no maximum. Otherwise it is a maximum if |slope| is
# certainly below the second value.
_STEEP_SLOPE, _LARGEST_SLOPE = 0.1, 1.0
_ACTIVE_FACTOR = 10  # a limit is active if its margin is below this factor times `limit_reserve`


@dataclasses.dataclass
class _Confirmation:
    """State of the confirmation of one device; the place confirmed at present is the last one of `places`.

    Attributes:
        places: Candidates for the best design, the highest prediction last.
        reserve: Margin that the design keeps to the limits on the fitted surface, as a logarithm.
        shift: Distance from the maximum of the surface to the design, to leave a window; 0 at first.
        failures: Number of simulations about the last place that failed.
        mixed: Number of these simulations that ended on different motions.
        passed: Results of the stages of `DesignTask.confirmation_stages` that the last place has passed, in order.
        best: The best design that passed all simulations.
        dropped: Places that did not pass, and designs that passed but were replaced by a better one.
    """

    places: list[AscentPlace]
    reserve: float
    shift: float = 0.0
    failures: int = 0
    mixed: int = 0
    passed: "list[_MeasuredDesign]" = dataclasses.field(default_factory=list)
    best: AperiodicOptimum | None = None
    dropped: list[DroppedCandidate] = dataclasses.field(default_factory=list)

    @property
    def stage(self) -> int:
        """Return the index of the next stage in `DesignTask.confirmation_stages`."""
        return len(self.passed)

    def close(self, task: DesignTask) -> AscentPlace:
        """Remove the last place and return it; reset the counters for the next place."""
        self.reserve, self.shift, self.failures, self.mixed = task.settings.limit_reserve, 0.0, 0, 0
        self.passed = []
        return self.places.pop()

    def drop(self, task: DesignTask, measured: "_MeasuredDesign", reason: str) -> None:
        """Remove the last place, and append it to `dropped` with the reason."""
        optimum, predicted = measured.optimum, float(np.exp(self.close(task).predicted_log))
        self.dropped.append(DroppedCandidate(optimum.values, optimum.label, predicted, optimum.objective_value, reason))


class ConfirmedDesigns(NamedTuple):
    """For each device: the best confirmed design, or None, and the dropped candidates."""

    best: list[AperiodicOptimum | None]
    dropped: list[list[DroppedCandidate]]


def confirm_designs(
    task: DesignTask, places: list[AscentPlace], best_verified: np.ndarray, *, mixtures: bool = False
) -> ConfirmedDesigns:
    """Confirm the best place of every device by long simulations.

    Args:
        task: The search.
        places: Results of `climb_places`.
        best_verified: Logarithm of the best verified objective of each device; a place with no higher objective is not
            a design.
        mixtures: True if samples of one simulation may end on different motions; their mean is then the objective.
    """
    settings, threshold = task.settings, np.array(best_verified, float)
    confirmations: dict[int, _Confirmation] = {}
    for place in sorted(places, key=lambda place: place.predicted_log):
        # A place is a candidate if its prediction exceeds the threshold and it breaks no limit by more than the radius.
        if (
            place.predicted_log > threshold[place.device_index]
            and place.surface.margins.min() > -settings.ensemble_radius
        ):
            place.radius = max(place.radius, settings.last_radius)
            confirmations.setdefault(place.device_index, _Confirmation([], settings.limit_reserve)).places.append(place)
    while unfinished := {
        device_index: confirmation for device_index, confirmation in confirmations.items() if confirmation.places
    }:
        # Short simulations come first for all devices, because many ensembles in one call keep every lane busy.
        stage = min(confirmation.stage for confirmation in unfinished.values())
        current = {
            device_index: confirmation
            for device_index, confirmation in unfinished.items()
            if confirmation.stage == stage
        }
        for device_index, measured in _simulate_stage(task, current, stage).items():
            _apply_result(task, current[device_index], measured, threshold[device_index], mixtures)
            if (confirmed := current[device_index].best) is not None:
                # A confirmed design raises the threshold for the remaining places of its device.
                threshold[device_index] = max(threshold[device_index], np.log(confirmed.objective_value))
            _drop_lower_places(current[device_index], threshold[device_index])
    best = [
        confirmations[device_index].best if device_index in confirmations else None
        for device_index in range(len(task.devices))
    ]
    return ConfirmedDesigns(
        best,
        [
            confirmations[device_index].dropped if device_index in confirmations else []
            for device_index in range(len(task.devices))
        ],
    )


def _apply_result(
    task: DesignTask, confirmation: _Confirmation, measured: "_MeasuredDesign", threshold: float, mixtures: bool
) -> None:
    """Apply the result of a simulation: drop the last place, move its design, or let it pass to the next stage."""
    place, objective_value = confirmation.places[-1], measured.optimum.objective_value
    if (measured.mixed and not mixtures) or measured.margin < 0:
        _move_design(task, confirmation, measured, measured.mixed and not mixtures)
    elif not objective_value or np.log(objective_value) <= threshold:
        if (
            objective_value
            and place.predicted_log > threshold + SCORE_TOLERANCE
            and np.log(objective_value) > threshold - _WINDOW_DEPTH
        ):
            # The samples may have ended in the window of the best orbit. The predicted motion exists next to this
            # window.
            _move_design(task, confirmation, measured, True)
        else:
            confirmation.drop(task, measured, "a long simulation measures less")
    else:
        confirmation.passed.append(measured)
        if confirmation.stage == len(task.confirmation_stages):
            if confirmation.best is not None:
                previous = confirmation.best
                dropped = DroppedCandidate(
                    previous.values,
                    previous.label,
                    previous.predicted,
                    previous.objective_value,
                    "another design has a higher objective",
                )
                confirmation.dropped.append(dropped)
            confirmation.best = measured.optimum
            confirmation.close(task)
            confirmation.places += _at_bounds(task, place, measured)


def _at_bounds(task: DesignTask, place: AscentPlace, measured: "_MeasuredDesign") -> list[AscentPlace]:
    """Return places at the bounds near a confirmed design; none if the design is a certain maximum.

    The prediction at a bound uses the upper end of the confidence interval of the slope.
    """
    if measured.optimum.stopped == "maximum":
        return []
    reach, surface = _BOUND_DISTANCE * task.settings.ensemble_radius * task.unit(place.device_index), place.surface
    bound_places = []
    for bound in task.box[place.device_index]:
        for i in np.flatnonzero((measured.z != bound) & (np.abs(bound - measured.z) <= reach)):
            z = measured.z.copy()
            z[i] = bound[i]
            # The step has one component, so the slope is gradient[i] * step.
            step = z[i] - measured.z[i]
            slope = surface.gradient[i] * step + _SLOPE_ERRORS * surface.gradient_error[i] * abs(step)
            predicted = float(np.log(measured.optimum.objective_value) + slope)
            bound_place = dataclasses.replace(
                place, z=z, best=z, radius=0.0, starts=measured.optimum.starts, predicted_log=predicted
            )
            bound_places.append(bound_place)
    return sorted(bound_places, key=lambda bound_place: bound_place.predicted_log)


def _drop_lower_places(confirmation: _Confirmation, threshold: float) -> None:
    """If a design is confirmed, remove the places with a prediction at or below the threshold plus tolerance."""
    if confirmation.best is not None and not confirmation.passed:
        confirmation.places = [
            place for place in confirmation.places if place.predicted_log > threshold + SCORE_TOLERANCE
        ]


def _simulate_stage(
    task: DesignTask, confirmations: dict[int, _Confirmation], stage: int
) -> "dict[int, _MeasuredDesign]":
    """Simulate one stage of the last place of each confirmation; return the results by device index."""
    device_index, ordered = np.array(list(confirmations)), list(confirmations.values())
    places = [confirmation.places[-1] for confirmation in ordered]
    # Later stages continue at the same design from the last states of the stage before.
    if stage:
        passed = [confirmation.passed[-1] for confirmation in ordered]
        z, starts = np.array([item.z for item in passed]), [item.optimum.starts for item in passed]
    else:
        shift = np.array([confirmation.shift for confirmation in ordered])[:, None]
        z = maximise_surfaces(task, places, np.array([confirmation.reserve for confirmation in ordered])) + shift
        z = np.clip(z, task.box[device_index, 0], task.box[device_index, 1])
        starts = stagger_phases(task, device_index, z, [item.starts for item in places])
    samples, periods = task.confirmation_stages[stage]
    ensembles = simulate_ensembles(task, device_index, z, np.zeros(len(z)), starts, periods, samples)
    confirms = stage + 1 == len(task.confirmation_stages) and not task.expected
    return {
        item.device_index: _measure_design(task, item, place_z, ensemble, confirms)
        for item, place_z, ensemble in zip(places, z, ensembles, strict=True)
    }


def stagger_phases(task: DesignTask, device_index: np.ndarray, z: np.ndarray, starts: list[Starts]) -> list[Starts]:
    """Return starts that are advanced by different numbers of forcing periods.

    An attractor may have several bands, which a trajectory visits in turn. Samples that start in one band stay
    together, so an average over a number of periods that is no multiple of the bands has the same error in all of them,
    and the scatter of the samples does not show this error.
    """
    if task.expected:
        return starts
    samples, no_spread = task.settings.confirm_samples, np.zeros(len(z))
    all_starts = [repeat_starts(start, samples) for start in starts]
    for shift in _PHASE_SHIFTS:
        # samples with the bit `shift` set in their index
        late = np.flatnonzero(np.arange(samples) & shift)
        if not late.size:
            break
        late_starts = [jax.tree.map(lambda x, late=late: x[late], start) for start in all_starts]
        for start, ensemble in zip(
            all_starts, simulate_ensembles(task, device_index, z, no_spread, late_starts, shift, late.size), strict=True
        ):
            # Overwrite the starts of these samples by their states after `shift` more periods.
            for x, advanced in zip(*map(jax.tree.leaves, (start, ensemble.averages.end)), strict=True):
                x[late] = advanced
    return all_starts


def _move_design(task: DesignTask, confirmation: _Confirmation, measured: "_MeasuredDesign", mixed: bool) -> None:
    """Move a refuted design further within the limits or out of a window; after too many failures, drop its place."""
    settings = task.settings
    confirmation.failures += 1
    confirmation.passed = []
    if confirmation.failures == settings.max_confirmations:
        confirmation.drop(task, measured, measured.flaw)
    elif mixed:
        # Chaos exists on both sides of a window, so shifts go down and up in turn, by growing distances.
        confirmation.mixed += 1
        confirmation.shift = (
            _WINDOW_SHIFT * settings.last_radius * (-1) ** confirmation.mixed * (1 + confirmation.mixed // 2)
        )
    else:
        violation = settings.limit_reserve - measured.margin
        confirmation.reserve += violation
        # The trust region grows by the same amount, so that it does not stop the design at the same point again.
        confirmation.places[-1].radius += violation


@dataclasses.dataclass(frozen=True)
class _MeasuredDesign:
    """A design with the values that a simulation measured.

    Attributes:
        optimum, z: The design, and the variables of its tuned quantities.
        margin: Smallest margin to the limits after the reserve of `reserved_margins`, as a logarithm; negative if
            broken.
        mixed: True if the samples ended on different motions, or one of them had no motion with an average.
    """

    optimum: AperiodicOptimum
    z: np.ndarray
    margin: float
    mixed: bool

    @property
    def flaw(self) -> str:
        """Return the reason why the simulation refutes the design."""
        if self.margin < 0:
            return f"breaks a limit by {100 * np.expm1(-self.margin):.2g} %"
        if self.mixed:
            shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in self.optimum.shares.items())
            return f"a long simulation ends on different motions: {shares}"
        return "a long simulation measures less"


def reserved_margins(margins: np.ndarray, share: float, *, confirms: bool) -> np.ndarray:
    """Return the margin of a simulation to each limit [constraint], as a logarithm.

    For a confirming simulation a reserve is subtracted, since another simulation of the same length may reach larger
    extremes. The reserve is 1.5 times the distance from the median to the worst sample. If the extremes of the samples
    have an exponential tail, the worst of 64 samples lies 4.5 decay lengths beyond the median, and one repetition in
    eighty exceeds the reserve. If the attractor has a sharp bound, all samples have reached it, and the reserve is
    zero.

    Args:
        margins: Margins of each sample to every constraint [sample, constraint].
        share: Part of the samples that must keep within the limits.
        confirms: True if the simulation confirms a design on one motion.
    """
    # "lower" selects the margin of one sample without interpolation; for share = 1 the worst margin.
    worst = np.quantile(margins, 1 - share, axis=0, method="lower")
    return worst - _TAIL_FACTOR * (np.median(margins, axis=0) - worst) if confirms else worst


def _measure_design(
    task: DesignTask, place: AscentPlace, z: np.ndarray, ensemble: Ensemble, confirms: bool
) -> _MeasuredDesign:
    """Return a design with the averages and extremes of its ensemble."""
    averages, device = ensemble.averages, ensemble.device
    shares, impacting = Counter(averages.labels().tolist()), is_impacting(averages)
    # Labels of samples with impacts; if there are none, labels of all samples.
    kinds = Counter(averages.labels()[impacting].tolist()) or shares
    # Samples without an impact count as aperiodic motion; next to any other motion the ensemble is mixed.
    mixed = (
        len(kinds) > 1
        or not (impacting | has_no_impact(averages)).all()
        or (has_no_impact(averages).any() and "aperiodic" not in kinds)
    )
    margin = reserved_margins(
        averages.margins()[impacting] if impacting.any() else averages.margins(), task.reliability, confirms=confirms
    )
    objective = averages.value(task.objective, device)
    tuned_device = jax.tree.map(float, tune_device(task.devices[place.device_index], task.tune, z))
    low, high = task.box[place.device_index]
    active = _active(task, z - low, high - z, margin)
    P = float(averages.P.mean())
    optimum = AperiodicOptimum(
        values=dict(zip(task.tune, np.asarray(to_values(task.tune, z)).tolist(), strict=True)),
        device=tuned_device,
        label=kinds.most_common(1)[0][0],
        objective_value=float(objective.mean()),
        P=P,
        P_stderr=float(averages.P.std(ddof=1) / np.sqrt(averages.P.size)),
        power=P * float(tuned_device.omega) / np.pi,
        speed=float(np.nan_to_num(averages.speed).max()),
        max_penetration=float(np.nan_to_num(averages.depth).max()),
        energy_ratio=float(np.nan_to_num(averages.ratio).max()),
        lyapunov=float(np.nanmean(averages.lyapunov)) if np.isfinite(averages.lyapunov).any() else float("nan"),
        admissible=float((averages.margins().min(axis=1) >= 0).mean()),
        shares={name: count / averages.P.size for name, count in shares.most_common()},
        gradient=dict(zip(task.tune, place.surface.gradient.tolist(), strict=True)),
        gradient_stderr=dict(zip(task.tune, place.surface.gradient_error.tolist(), strict=True)),
        active=active,
        stopped=_stopped(place, active),
        ensembles=place.ensembles,
        predicted=float(np.exp(place.predicted_log)),
        confirmation_size=(averages.P.size, ensemble.periods),
        starts=averages.end,
        path=np.asarray(to_values(task.tune, np.array([centre for centre, _ in place.path]))),
        path_objective=np.array([objective_value for _, objective_value in place.path]),
    )
    return _MeasuredDesign(optimum, z, float(margin.min()), bool(mixed) and not task.expected)


def _active(task: DesignTask, above: np.ndarray, below: np.ndarray, margins: np.ndarray) -> tuple[str, ...]:
    """Return the names of the limits and bounds that are active at the design."""
    settings = task.settings
    limits = zip(LIMIT_NAMES, margins, strict=True)
    names = [word for word, distance in limits if distance < _ACTIVE_FACTOR * settings.limit_reserve]
    for side, to_bounds in (("lower", above), ("upper", below)):
        distances = zip(task.tune, to_bounds, strict=True)
        names += [f"{side} bound of {name}" for name, distance in distances if distance < settings.active_margin]
    return tuple(names)


def _stopped(place: AscentPlace, active: tuple[str, ...]) -> str:
    """Return why the climb ended, as in `AperiodicOptimum`; "maximum" only if all slopes are certainly small."""
    if place.stopped != "maximum" or active:
        return place.stopped or "ensembles"
    slope, error = np.abs(place.surface.gradient), _SLOPE_ERRORS * place.surface.gradient_error
    if (slope > error + _STEEP_SLOPE).any():
        return "slope"
    return "maximum" if (slope + error < _LARGEST_SLOPE).all() else "noise"
