"""The best membrane: designs climb, by exact gradients, from the attractors of a coarse survey to admissible optima.

`optimise` runs a survey, jitted ascents from the attractors found, and the verification of the distinct optima. If a
trial step leaves its branch, loses stability or breaks a constraint, the step is halved (`ascent`).
"""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design import design_search
from vijax.design import objective as design_objective
from vijax.design.aperiodic.ensemble import DesignTask
from vijax.design.design_search import DeviceSearch
from vijax.design.design_settings import DEFAULT, DesignSettings, validate_settings
from vijax.design.objective import OBJECTIVES, AscentBatch, ObjectiveSpec
from vijax.design.optimum import AperiodicOptimum, BaseOptimum, DroppedCandidate, Optimum
from vijax.design.robustness import off_design
from vijax.design.robustness.tolerance import (
    Nodes,
    Tolerance,
    ToleranceStatistics,
    nodes,
    validate_samples,
    validate_tolerances,
)
from vijax.design.survey.device_survey import Effort, SurveySummary, SurveyTask
from vijax.maps.execution import estimate
from vijax.maps.execution.estimate import Estimate
from vijax.model.choices import Motion, Objective
from vijax.model.device import Harvester, scalar_device
from vijax.model.tuned_quantities import NAMES, bounds_of, check_names, to_values, to_variables
from vijax.model.walls.sides import values_by_name
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api

TOLERANCE_OBJECTIVES = ("mean", "worst")
_LOG = logging.getLogger(__name__)
# Largest accepted arguments.
_MAX_EVALUATIONS, _MAX_POINTS, _MAX_IMPACTS = 10**5, 10**7, 256
_BYTES_PER_START = 1000  # bytes of memory per start of a survey
# Largest total number of starts of devices that are designed in one group. The memory needed is limited by groups.
_MAX_GROUP_STARTS = 2**18


@dataclass(frozen=True)
class Design:
    """The result for one device: the distinct optima, the highest objective first; none if no motion is admissible.

    Only the first optimum may have a motion that is not an orbit (`AperiodicOptimum`).

    Attributes:
        optima: The distinct optima, the highest objective first.
        tune, bounds: Tuned quantities, and their bounds.
        objective: One of `OBJECTIVES`.
        tolerances: Tolerances of the objective.
        survey: Summary of the motions that the survey found.
        ascents: Number of ascents, one from each selected attractor.
        places: Number of combinations of tuned quantities where averages of motion other than orbits were climbed.
        dropped: Candidates with a higher predicted objective than the best design, and the reason why each was dropped;
            the highest prediction first.
    """

    optima: tuple[Optimum | AperiodicOptimum, ...]
    tune: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    objective: Objective
    tolerances: tuple[Tolerance, ...]
    survey: SurveySummary
    ascents: int
    places: int = 0
    dropped: tuple[DroppedCandidate, ...] = ()

    @property
    def best(self) -> Optimum | AperiodicOptimum | None:
        """Return the optimum with the highest objective; None if there is none."""
        return self.optima[0] if self.optima else None

    @property
    def orbits(self) -> tuple[Optimum, ...]:
        """Return the optima with an orbit, the highest objective first."""
        return tuple(optimum for optimum in self.optima if isinstance(optimum, Optimum))


@public_api
def optimise(
    device: Harvester | None = None,
    *,
    tune: str | Iterable[str] = ("omega0",),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    objective: Objective = "P",
    motion: Motion = "any",
    tolerances: Iterable[Tolerance] = (),
    reliability: float = 1.0,
    samples: int | None = None,
    survey_points: int = 256,
    starts: int = 8,
    survey_periods: int = 200,
    max_impacts: int = 16,
    max_evaluations: int = 60,
    settings: DesignSettings = DEFAULT,
) -> Design:
    """Find the admissible designs of one device with the highest objective, the best first.

    Args:
        device: Device that supplies the quantities that are not tuned; by default Tables I and II.
        tune: Names of the quantities to tune: constants of the device, or k, kappa, d, gamma. The name omega0 tunes
            both membranes, omega0_left one.
        bounds: Bounds of tuned quantities, (low, high) by name. Defaults: kappa 2 to 400, omega0 and k accordingly, r
            0.05 to 0.95, inclinations +-0.1 rad, all others half to twice the value of the device.
        objective: "P" [J per half period], "power" [W], "speed" [m/s]; over the tolerances, "mean" or "worst" of P on
            one orbit; "expected", the mean of P over samples that start anywhere in the gap and over the tolerances, if
            specified.
        motion: "any" returns the best motion, periodic or aperiodic; averages of aperiodic motion are climbed by
            ensembles. "periodic" returns orbits only. The objectives "mean" and "worst" always use orbits only.
        tolerances: Scatter of the constants, `Tolerance` records, for "mean", "worst" and "expected".
        reliability: Share of the samples that must keep within the limits in the whole simulation, 0.5 to 1; below 1
            only for the objective "expected".
        samples: Number of random devices over the tolerances for "mean" and "worst"; by default a quadrature is used.
        survey_points: Number of values of the first quantity where a survey searches for attractors. The survey is
            refined automatically where chaos has a higher predicted objective than the best orbit, because narrow
            windows there may contain a better orbit.
        starts: Number of starts at each of these values; more starts find attractors with smaller basins.
        survey_periods: Largest number of forcing periods simulated for each start; more in a wide gap.
        max_impacts: Largest number of impacts of an orbit that is searched for, 1 to 256. With a smaller number,
            compilation and ascents are faster.
        max_evaluations: Largest number of evaluations of objective and gradient in one ascent.
        settings: Settings of survey, ascent and verification; see `DesignSettings`.

    Raises:
        ValueError: An argument is invalid; the message states the argument, the requirement and the value.
    """
    return optimise_all(
        [scalar_device(device)],
        tune=tune,
        bounds=bounds,
        objective=objective,
        motion=motion,
        tolerances=tolerances,
        reliability=reliability,
        samples=samples,
        survey_points=survey_points,
        starts=starts,
        survey_periods=survey_periods,
        max_impacts=max_impacts,
        max_evaluations=max_evaluations,
        settings=settings,
    )[0]


@public_api
def optimise_all(
    devices: Iterable[Harvester],
    *,
    tune: str | Iterable[str] = ("omega0",),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    objective: Objective = "P",
    motion: Motion = "any",
    tolerances: Iterable[Tolerance] = (),
    reliability: float = 1.0,
    samples: int | None = None,
    survey_points: int = 256,
    starts: int = 8,
    survey_periods: int = 200,
    max_impacts: int = 16,
    max_evaluations: int = 60,
    settings: DesignSettings = DEFAULT,
) -> list[Design]:
    """Find the admissible designs of each device with the highest objective, with tuned quantities between bounds.

    A coarse survey along the first quantity simulates many starts of the ball. Ascents start from the attractors found
    and climb along exact gradients in jitted calls. An optimum on an orbit is admissible in every impact (E_j <= W_j,
    penetration within the device's limit), attracting, and verified by the exact impact map.

    Args:
        devices: Devices to design, with scalar constants; the quantities that are not tuned keep their values.
        tune, bounds, objective, motion, tolerances, reliability, samples: As in `optimise`, for all devices.
        survey_points, starts, survey_periods, max_impacts, max_evaluations, settings: As in `optimise`, for each
            device.

    Returns:
        One `Design` per device.

    Raises:
        ValueError: An argument is invalid; the message states the argument, the requirement and the value.
    """
    devices = validation.validate_records("devices", devices, Harvester, "vijax.Harvester records")
    tune, bounds = validation.validate_choices("tune", tune, NAMES), {} if bounds is None else bounds
    scatter = validate_tolerances(tolerances)
    reliability = validate_motion(motion, objective, reliability)
    samples = _validate_device_count(samples, objective)
    max_evaluations = validation.validate_integer("max_evaluations", max_evaluations, 2, _MAX_EVALUATIONS)
    size = make_effort(survey_points, starts, max_impacts, survey_periods)._replace(
        settings=validate_settings(settings)
    )
    box = validate_bounds(devices, tune, bounds, objective, scatter)
    if (cost := estimate_survey(SurveyTask(devices, tune, box, objective, size))).needs_confirmation:
        _LOG.warning("a long run starts: %s", cost)
    # The task holds tolerances only for "expected". For "mean" and "worst" they enter as nodes, below.
    task = DesignTask(devices, tune, box, objective, scatter if objective == "expected" else (), reliability, settings)
    orbits_only = motion == "periodic" or objective in TOLERANCE_OBJECTIVES
    searches = _design_groups(task, size, nodes(scatter, samples), max_evaluations, orbits_only)
    return [
        Design(
            optima=search.optima,
            tune=tune,
            bounds=dict(zip(tune, map(tuple, np.asarray(to_values(tune, limits)).T.tolist()), strict=True)),
            objective=objective,
            tolerances=scatter,
            survey=search.summary,
            ascents=search.ascents,
            places=search.places,
            dropped=search.unconfirmed,
        )
        for search, limits in zip(searches, box, strict=True)
    ]


def _validate_device_count(samples: int | None, objective: Objective) -> int | None:
    """Return the number of random devices, or raise ValueError if it is invalid or specified with "expected"."""
    samples = None if samples is None else validate_samples(samples)
    if objective == "expected" and samples is not None:
        raise ValueError(
            f"samples must be left out with objective expected, which draws a device for each start; got {samples!r}; "
            "settings=DesignSettings(expected_samples=...) sets their number"
        )
    return samples


def _design_groups(
    task: DesignTask, size: Effort, tolerance_nodes: Nodes, max_evaluations: int, orbits_only: bool
) -> list[DeviceSearch]:
    """Design groups of devices (`_group_devices`) one after another, to limit the memory."""
    searches = []
    for group in _group_devices(SurveyTask(task.devices, task.tune, task.box, task.objective, size).total_starts):
        group_task = task._replace(devices=task.devices[group], box=task.box[group])
        searches += design_search.search_designs(group_task, size, tolerance_nodes, max_evaluations, orbits_only)
    return searches


def _group_devices(starts: np.ndarray) -> list[slice]:
    """Split devices in order into groups of at most `_MAX_GROUP_STARTS` starts, or of one device with more."""
    groups, first, total = [], 0, 0
    for index, device_starts in enumerate(starts.tolist()):
        if index > first and total + device_starts > _MAX_GROUP_STARTS:
            groups.append(slice(first, index))
            first, total = index, 0
        total += device_starts
    # The last group ends with the last device.
    return [*groups, slice(first, len(starts))]


@public_api
def tolerance_statistics(
    optimum: Optimum | AperiodicOptimum, tolerances: Iterable[Tolerance], samples: int | None = None
) -> ToleranceStatistics:
    """Compute the statistics of P of a design when constants scatter.

    An orbit is followed to the devices at the nodes of the tolerances. For other motion, samples that start on the
    motion are simulated in random devices.

    Args:
        optimum: An optimum of `optimise`.
        tolerances: Constants that scatter, and their spread: `Tolerance` records.
        samples: Number of random devices. By default a quadrature is used for an orbit, and 256 random devices for
            aperiodic motion.

    Raises:
        ValueError: A tolerance is invalid.
    """
    validation.validate_instance("optimum", optimum, BaseOptimum, "vijax.optimise(...).best")
    tolerance_records = validate_tolerances(tolerances)
    if isinstance(optimum, AperiodicOptimum):
        return off_design.simulate_tolerances(
            [optimum], tolerance_records, None if samples is None else validate_samples(samples)
        )[0]
    tolerance_nodes, no_variables = nodes(tolerance_records, samples), jnp.zeros((1, 0))
    # Nothing is tuned here, so there are no variables, and the devices differ only by the tolerances.
    spec = ObjectiveSpec(
        jnp.asarray(tolerance_nodes.factors), jnp.asarray(tolerance_nodes.weights), (), tolerance_nodes.names, "P"
    )
    device = jax.tree.map(lambda x: jnp.array([x], float), optimum.device)
    orbit = optimum.orbit
    batch = AscentBatch(
        device, orbit.sequence, jnp.nan_to_num(orbit.impact_unknowns), no_variables, no_variables, no_variables
    )
    return ToleranceStatistics(*(float(x[0]) for x in design_objective.spread_over_tolerances(spec, batch)))


def make_effort(survey_points: int, starts: int, max_impacts: int, survey_periods: int = 200) -> Effort:
    """Return the `Effort` of a survey from validated arguments; raise ValueError if one is invalid."""
    return Effort(
        # At least 2 points, both ends of the bounds, because the interval between points is width / (points - 1).
        validation.validate_integer("survey_points", survey_points, 2, _MAX_POINTS),
        validation.validate_integer("starts", starts, 1, _MAX_POINTS),
        validation.validate_integer("max_impacts", max_impacts, 1, _MAX_IMPACTS),
        validation.validate_integer("survey_periods", survey_periods, 1),
    )


def estimate_survey(task: SurveyTask) -> Estimate:
    """Estimate time and memory of the first survey of some devices, which costs more than the ascents.

    Raises:
        ValueError: The starts that are simulated together do not fit in memory.
    """
    starts = task.total_starts
    # A device with more starts than `_MAX_GROUP_STARTS` is one group, so its starts are in memory together.
    count, together = int(starts.sum()), min(int(starts.sum()), max(int(starts.max()), _MAX_GROUP_STARTS))
    validation.check_memory(("survey_points", "starts"), together * _BYTES_PER_START, f"{together:,} starts")
    # The estimate takes the mean number of periods per start.
    return estimate.estimate_recorded_run(count, task.max_total_periods // count, together * _BYTES_PER_START)


@public_api
def validate_bounds(
    devices: list[Harvester],
    tune: tuple[str, ...],
    bounds: Mapping[str, tuple[float, float]],
    objective: str,
    tolerances: tuple[Tolerance, ...],
) -> np.ndarray:
    """Return the bounds of the variables [device, 2, variable]; raise ValueError if an argument is invalid."""
    check_names(tune)
    if not devices:
        raise ValueError("devices must hold at least one; got none")
    for device in devices:
        # Without a voltage every harvested energy is 0, and the objective is flat.
        if not any(map(float, values_by_name("V", scalar_device(device).V).values())):
            raise ValueError("V must not be zero for a design to harvest; got 0")
    # "mean" and "worst" require tolerances, "expected" allows them, and all other objectives forbid them.
    over = objective in TOLERANCE_OBJECTIVES
    if over != bool(tolerances) and objective != "expected":
        need = "come with objective mean, worst or expected" if tolerances else "be given with objective mean or worst"
        raise ValueError(see("design", f"tolerances must {need}; got {len(tolerances)} with objective {objective!r}"))
    validate_tolerances(tolerances, bounded=objective == "worst")
    return np.array([to_variables(tune, bounds_of(tune, bounds, device)) for device in devices])


def validate_motion(motion: str, objective: str, reliability: float) -> float:
    """Return the reliability as a float; raise ValueError if motion, objective or reliability is invalid.

    The three arguments must also be compatible with each other.
    """
    validation.validate_choice("motion", motion, get_args(Motion))
    validation.validate_choice("objective", objective, OBJECTIVES)
    # "expected" averages over any motion, because random starts may end on aperiodic motion.
    if motion == "periodic" and objective == "expected":
        raise ValueError(
            see("design", 'motion must be "any" with objective expected, which takes every start; got "periodic"')
        )
    # With a share below 0.5 the median sample could break the limits.
    share = validation.validate_real("reliability", reliability, "a number from 0.5 to 1", lambda x: 0.5 <= x <= 1)
    if share < 1 and objective != "expected":
        raise ValueError(
            see("design", f"reliability must be 1 unless the objective is expected; got {share:g} with {objective!r}")
        )
    return share
