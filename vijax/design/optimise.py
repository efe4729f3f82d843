"""The best membrane: designs climb, by exact gradients, from the attractors of a coarse survey to admissible optima.

`optimise` is the line: starts -> one jitted ascent of all of them -> distinct optima, verified.
Where a trial leaves its branch, loses stability or breaks a constraint, it is cut back (`ascent`).
"""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design import objective as aims
from vijax.design import off_design, turns
from vijax.design.design_settings import DEFAULT, DesignSettings, check_settings
from vijax.design.ensemble import Task
from vijax.design.multistart import Effort, Looked, SurveyTask
from vijax.design.objective import OBJECTIVES, Batch, Scene
from vijax.design.optimum import AnyOptimum, AperiodicOptimum, DroppedCandidate, Optimum
from vijax.design.tolerance import Nodes, Spread, Tolerance, check_samples, check_tolerances, nodes
from vijax.design.turns import DeviceSearch
from vijax.model.choices import Motion, Objective
from vijax.model.device import Harvester, one_device
from vijax.model.sides import named
from vijax.model.variables import NAMES, check_names, limits, values, variables
from vijax.planes import estimate
from vijax.planes.estimate import Estimate
from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.pages import see

OVER_TOLERANCES = ("mean", "worst")
_LOG = logging.getLogger(__name__)
_MOST_EVALUATIONS, _MOST_POINTS, _MOST_IMPACTS = 10**5, 10**7, 256
_BALL = 1000  # bytes that a survey keeps of a ball
# Balls of a survey, at most, of devices that are designed together: memory does not grow with devices beyond these.
_TOGETHER = 2**18


@dataclass(frozen=True)
class Design:
    """What was found for one device: the distinct optima, the best first (none if no motion is admissible).

    One of them, the best, may be of a motion that is no orbit (`AperiodicOptimum`).

    Attributes:
        optima: The distinct ones that were found, the best first.
        tune, bounds: What was tuned, between which values.
        objective: Of `OBJECTIVES`.
        tolerances: Of the objective.
        looked: What the survey met, periodic and not.
        ascents: How many there were, one from each attractor chosen.
        places: Values of the tuned quantities at which averages of other motion were climbed.
        dropped: Candidates that promised more than the best design gives, and why each is none; the most promising
            first.
    """

    optima: tuple[Optimum | AperiodicOptimum, ...]
    tune: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    objective: Objective
    tolerances: tuple[Tolerance, ...]
    looked: Looked
    ascents: int
    places: int = 0
    dropped: tuple[DroppedCandidate, ...] = ()

    @property
    def best(self) -> Optimum | AperiodicOptimum | None:
        """Give the highest optimum."""
        return self.optima[0] if self.optima else None

    @property
    def orbits(self) -> tuple[Optimum, ...]:
        """Give those whose motion is an orbit that was climbed, the best first."""
        return tuple(one for one in self.optima if isinstance(one, Optimum))


@door
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
    """Find the admissible designs of one device that harvest most, the best first.

    Args:
        device: Where quantities that are not tuned are taken from; Tables I and II unless given.
        tune: Constants of the device, or k, kappa, d, gamma; omega0 is the membrane's, omega0_left that of one.
        bounds: Of tuned quantities, (low, high) by name. Unless given: kappa 2 to 400, omega0 and k as that gives them,
            r 0.05 to 0.95, inclinations +-0.1 rad, all else half to twice what the device has.
        objective: "P" [J per half period], "power" [W], "speed" [m/s]; over the tolerances, "mean" or "worst" of P on
            one orbit; "expected" P, over balls that start anywhere and over the tolerances, if there are any.
        motion: "any" takes the best motion, chaos too, whose averages ensembles of balls climb; "periodic" the best
            orbit. Over tolerances orbits alone are followed.
        tolerances: How constants scatter, `Tolerance` records, for "mean", "worst" and "expected".
        reliability: Share of the balls of "expected" that have to keep the limits in all that is flown.
        samples: Random devices for "mean" and "worst", in place of a quadrature.
        survey_points: Values of the first quantity at which a survey looks for attractors. It looks closer, by itself,
            where chaos promises more than the best orbit so far: there the best orbit may live in a narrow window.
        starts: Of the ball, from which it looks at each of them; more meet attractors with small basins.
        survey_periods: Forcing periods that each of them may take.
        max_impacts: Of an orbit, 1 to 256: longer ones are not looked for. Fewer are compiled and climb faster.
        max_evaluations: Of objective and gradient, in one ascent.
        settings: Of survey, ascent and verification; see `DesignSettings`.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    return optimise_all(
        [one_device(device)],
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


@door
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
    """Find the admissible designs that harvest most, each device's tuned quantities between bounds.

    Attractors of a coarse survey along the first quantity, from many starts of the ball, are where the ascents begin.
    All of them climb in one jitted call along exact gradients; an optimum is admissible in every impact (E_j <= W_j,
    penetration within the device's limit), attracting, and verified by the exact impact map.

    Args:
        devices: Where quantities that are not tuned are taken from; scalars.
        tune, bounds, objective, motion, tolerances, reliability, samples: What is sought, as in `optimise`.
        survey_points, starts, survey_periods, max_impacts, max_evaluations, settings: How far to look, as there.

    Returns:
        One `Design` a device.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    devices = checks.sequence("devices", devices, Harvester, "vijax.Harvester records")
    tune, bounds = checks.words("tune", tune, NAMES), {} if bounds is None else bounds
    scatter = check_tolerances(tolerances)
    reliability = check_motion(motion, objective, reliability)
    samples = None if samples is None else check_samples(samples)
    if objective == "expected" and samples is not None:
        raise ValueError(
            f"samples must be left out with objective expected, whose balls have random devices; got {samples!r}; "
            "settings=DesignSettings(expected_balls=...) says how many"
        )
    max_evaluations = checks.whole("max_evaluations", max_evaluations, 2, _MOST_EVALUATIONS)
    far = effort(survey_points, starts, max_impacts, survey_periods)._replace(settings=check_settings(settings))
    box = check(devices, tune, bounds, objective, scatter)
    if (asked := expected(SurveyTask(devices, tune, box, objective, far))).long:
        _LOG.warning("a long run begins: %s", asked)
    task = Task(devices, tune, box, objective, scatter if objective == "expected" else (), reliability, settings)
    alone = motion == "periodic" or objective in OVER_TOLERANCES
    found = _in_groups(task, far, nodes(scatter, samples), max_evaluations, alone)
    return [
        Design(
            optima=one.optima,
            tune=tune,
            bounds=dict(zip(tune, map(tuple, np.asarray(values(tune, limits)).T.tolist()), strict=True)),
            objective=objective,
            tolerances=scatter,
            looked=one.looked,
            ascents=one.ascents,
            places=one.places,
            dropped=one.lost,
        )
        for one, limits in zip(found, box, strict=True)
    ]


def _in_groups(task: Task, far: Effort, cloud: Nodes, max_evaluations: int, orbits_alone: bool) -> list[DeviceSearch]:
    """Design some devices after others, as many together as memory is meant for."""
    found = []
    for some in _groups(SurveyTask(task.devices, task.tune, task.box, task.objective, far).balls):
        own = task._replace(devices=task.devices[some], box=task.box[some])
        found += turns.search(own, far, cloud, max_evaluations, orbits_alone)
    return found


def _groups(balls: np.ndarray) -> list[slice]:
    """Divide devices by their balls into groups with at most `_TOGETHER` of them, or with one device."""
    groups, first, total = [], 0, 0
    for index, own in enumerate(balls.tolist()):
        if index > first and total + own > _TOGETHER:
            groups.append(slice(first, index))
            first, total = index, 0
        total += own
    return [*groups, slice(first, len(balls))]


@door
def under(optimum: Optimum | AperiodicOptimum, tolerances: Iterable[Tolerance], samples: int | None = None) -> Spread:
    """Find what becomes of a design when constants scatter.

    Of a motion that is no orbit the balls of random devices tell, each of which starts on it.

    Args:
        optimum: Of `optimise`.
        tolerances: Which constants scatter, and by how much: `Tolerance` records.
        samples: Random devices, in place of a quadrature; of chaos 256 unless given.

    Raises:
        ValueError: A tolerance that cannot be.
    """
    checks.instance("optimum", optimum, AnyOptimum, "vijax.optimise(...).best")
    scatter = check_tolerances(tolerances)
    if isinstance(optimum, AperiodicOptimum):
        return off_design.scattered([optimum], scatter, None if samples is None else check_samples(samples))[0]
    cloud, none = nodes(scatter, samples), jnp.zeros((1, 0))
    scene = Scene(jnp.asarray(cloud.factors), jnp.asarray(cloud.weights), (), cloud.names, "P")
    device = jax.tree.map(lambda x: jnp.array([x], float), optimum.device)
    orbit = optimum.orbit
    batch = Batch(device, orbit.sequence, jnp.nan_to_num(orbit.knots), none, none, none)
    return Spread(*(float(x[0]) for x in aims.spread(scene, batch)))


def effort(survey_points: int, starts: int, max_impacts: int, survey_periods: int = 200) -> Effort:
    """Say how far a survey looks; raise ValueError as `optimise_all` does."""
    return Effort(
        checks.whole("survey_points", survey_points, 2, _MOST_POINTS),
        checks.whole("starts", starts, 1, _MOST_POINTS),
        checks.whole("max_impacts", max_impacts, 1, _MOST_IMPACTS),
        checks.whole("survey_periods", survey_periods, 1),
    )


def expected(task: SurveyTask) -> Estimate:
    """Estimate what the first survey of some devices asks of the machine; ascents take less.

    Raises:
        ValueError: If the balls that are flown together do not fit in memory.
    """
    balls = task.balls
    count, together = int(balls.sum()), min(int(balls.sum()), max(int(balls.max()), _TOGETHER))
    checks.fits(("survey_points", "starts"), together * _BALL, f"{together:,} balls")
    return estimate.of_recorded(count, task.flown // count, together * _BALL)


@door
def check(
    devices: list[Harvester],
    tune: tuple[str, ...],
    bounds: Mapping[str, tuple[float, float]],
    objective: str,
    tolerances: tuple[Tolerance, ...],
) -> np.ndarray:
    """Give the bounds [device, 2, variable] asked for; raise ValueError as `optimise_all` does, but run nothing."""
    check_names(tune)
    if not devices:
        raise ValueError("devices must hold at least one; got none")
    for device in devices:
        if not any(map(float, named("V", one_device(device).V).values())):
            raise ValueError("V must not be zero for a design to harvest; got 0")
    over = objective in OVER_TOLERANCES
    if over != bool(tolerances) and objective != "expected":
        need = "come with objective mean, worst or expected" if tolerances else "be given with objective mean or worst"
        raise ValueError(see("design", f"tolerances must {need}; got {len(tolerances)} with objective {objective!r}"))
    check_tolerances(tolerances, bounded=objective == "worst")
    return np.array([variables(tune, limits(tune, bounds, device)) for device in devices])


def check_motion(motion: str, objective: str, reliability: float) -> float:
    """Take the reliability, if motion, objective and it go together; raise ValueError as `optimise_all` does."""
    checks.choice("motion", motion, get_args(Motion))
    checks.choice("objective", objective, OBJECTIVES)
    if motion == "periodic" and objective == "expected":
        raise ValueError(
            see("design", 'motion must be "any" with objective expected, which takes every start; got "periodic"')
        )
    share = checks.real("reliability", reliability, "a number from 0.5 to 1", lambda x: 0.5 <= x <= 1)
    if share < 1 and objective != "expected":
        raise ValueError(
            see("design", f"reliability must be 1 unless the objective is expected; got {share:g} with {objective!r}")
        )
    return share
