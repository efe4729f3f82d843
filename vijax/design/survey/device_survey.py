"""Surveys: simulation of devices from many starts, at values of the tuned quantities spread over the bounds.

`survey_devices` runs a coarse survey and then a refinement where aperiodic or undecided motion has a higher score than
any orbit found, because narrow windows of periodic motion lie there. `orbit_candidates` selects the orbits to climb
from the result.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax.design.aperiodic.motion_averages import LIMIT_NAMES, summary_averages
from vijax.design.design_settings import DEFAULT, DesignSettings
from vijax.design.survey.attractor_survey import Survey, gap_time_factor, simulate_survey
from vijax.design.survey.motion_scores import (
    SurveyMotions,
    average_at_places,
    highest_admissible_score,
    is_near_limits,
    score_motions,
)
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.tuned_quantities import affects_motion, to_values, tune_device, tuned_devices_and_pairs
from vijax.runtime import tiles
from vijax.runtime.numerics.low_discrepancy import lattice
from vijax.simulation.simulate import Starts

_TILES = (512, 4096, 32768)  # numbers of cells of one compiled call
_START_RANGE = 0.49, 0.6  # largest |u| / d, and largest |v|, of a start
# largest gain of speed by the forcing in one flight: 2/pi, because the forcing adds the change of sin(pi t)/pi
_LARGEST_KICK = 2 / math.pi


class Effort(NamedTuple):
    """Size of a survey.

    Attributes:
        points: Number of values of the first tuned quantity that affects the motion.
        starts: Number of starts at each value.
        max_impacts: Largest number of impacts of an orbit from which an ascent of the objective may start.
        periods: Largest number of forcing periods of a start in a gap below 1.2; multiplied by `gap_time_factor` in
            wider gaps.
        settings: Settings of the design.
    """

    points: int
    starts: int
    max_impacts: int
    periods: int
    settings: DesignSettings = DEFAULT


class SurveySummary(NamedTuple):
    """Numbers of motions that the survey of one device found, and the best motion that is not an orbit.

    Attributes:
        starts: Number of simulated starts.
        orbits, admissible: Number of periodic attractors with at most `max_impacts` impacts; number of these attractors
            that break no limit.
        aperiodic_points: Number of combinations of values of the tuned quantities with other motion: aperiodic,
            undecided, or an orbit that is too long.
        P: Largest mean energy per half forcing period of such motion that breaks no limit [J]. The mean is over the
            starts at one combination. 0 if there is no such motion.
        values: Tuned quantities at the motion with energy P; empty if there is none.
        limit, violation: If all motions break a limit: name of the limit that the motion with the smallest violation
            breaks, and this violation relative to the limit. Otherwise "" and 0.
        permanent_contact, no_impact, undecided: Shares of the starts that end in permanent contact with one wall,
            without an impact, and undecided.
    """

    starts: int
    orbits: int
    admissible: int
    aperiodic_points: int
    P: float
    values: dict[str, float]
    limit: str
    violation: float
    permanent_contact: float
    no_impact: float
    undecided: float


class SurveyTask(NamedTuple):
    """Devices to survey, names of the tuned quantities, their bounds [device, 2, variable], objective and effort."""

    devices: list[Harvester]
    tune: tuple[str, ...]
    box: np.ndarray
    objective: str
    effort: Effort

    @property
    def points(self) -> int:
        """Return the number of values of the first tuned quantity that affects the motion; 1 if there is none."""
        return 1 if first_moving(self.tune) is None else self.effort.points

    @property
    def cells(self) -> int:
        """Return the total number of starts of a device, without the additional starts in a wide gap."""
        return len(self.levels) * self.points * self.effort.starts

    @property
    def starts(self) -> np.ndarray:
        """Return the number of starts at every value for each device; more in wide gaps with more attractors."""
        return self.effort.starts * np.minimum(self._time_factor, self.effort.settings.max_wide_start_factor)

    @property
    def total_starts(self) -> np.ndarray:
        """Return the total number of starts of each device in the coarse survey; the refinement has at most as many."""
        return len(self.levels) * self.points * self.starts

    @property
    def max_total_periods(self) -> int:
        """Return an upper bound of the total of forcing periods over all starts of all devices."""
        return int((self.total_starts * self._time_factor).sum()) * self.effort.periods

    @property
    def _time_factor(self) -> np.ndarray:
        """Return `gap_time_factor` of each device, for the gap in the middle of the bounds."""
        devices = jax.tree.map(lambda *x: np.array(x, float), *self.devices)
        middle = jax.vmap(lambda device, z: tune_device(device, self.tune, z))(devices, self.box.mean(axis=1))
        return np.broadcast_to(gap_time_factor(middle.s / middle.length_unit), len(self.devices))

    @property
    def levels(self) -> np.ndarray:
        """Return combinations [level, quantity] of the quantities other than the first, as positions from 0 to 1."""
        return _level_values(self.tune, self.effort)


class SurveyResult(NamedTuple):
    """Result of `survey_devices`.

    Attributes:
        task: The survey.
        orbits: Orbits with at most `max_impacts` impacts; ascents of the objective may start from them.
        others: All other motions.
        summaries: Summary of every device.
    """

    task: SurveyTask
    orbits: SurveyMotions
    others: SurveyMotions
    summaries: list[SurveySummary]


def survey_devices(task: SurveyTask, *, orbits_only: bool = True) -> SurveyResult:
    """Survey every device coarsely, then refine the survey near promising aperiodic motion.

    Args:
        task: The survey. For an objective over tolerances, motions are scored by P.
        orbits_only: True if only orbits can be designs. Aperiodic motion then only determines where the survey is
            refined.
    """
    effort, devices = task.effort, len(task.devices)
    surveyed = _survey_coarsely(task) if orbits_only else _survey_in_two_stages(task)
    orbits, others = surveyed.orbits(effort.max_impacts), surveyed.non_orbits(effort.max_impacts)
    # If no tuned quantity affects the motion, the survey has no steps to refine.
    if first_moving(task.tune) is not None:
        highest = highest_admissible_score(
            devices, *((orbits,) if orbits_only else (orbits, average_at_places(others)))
        )
        is_promising = others.scores.total > highest[others.device_index] + math.log(effort.settings.min_score_share)
        # Chaos far beyond the limits may contain windows with orbits within the limits. If only orbits can be designs,
        # all promising motion is therefore refined, otherwise only motion near the limits.
        is_promising &= orbits_only | is_near_limits(others.select(is_promising), others, effort.settings)
        places = _refine_places(others.select(is_promising), task)
        if places.device_index.size:
            # The seed is 1, so that the starts differ from the starts of the coarse survey, which has seed 0.
            refined = _survey_places(task, places, 1)
            added = refined.orbits(effort.max_impacts), refined.non_orbits(effort.max_impacts)
            orbits, others = jax.tree.map(lambda *x: np.concatenate(x), (orbits, others), added)
    return SurveyResult(task, orbits, others, _summarise(task, orbits, others, surveyed))


def survey_all_starts(task: SurveyTask) -> tuple[SurveyMotions, list[SurveySummary]]:
    """Return the motions of all starts, which the objective "expected" averages, and the summary of each device."""
    surveyed = _survey_coarsely(task)
    orbits, others = surveyed.orbits(task.effort.max_impacts), surveyed.non_orbits(task.effort.max_impacts)
    return surveyed.all_motions(), _summarise(task, orbits, others, surveyed)


def _survey_coarsely(task: SurveyTask) -> "_SurveyedPlaces":
    """Survey all combinations of levels and steps, with the same number of starts of a device at each."""
    starts = task.starts
    device_index = np.repeat(np.arange(len(task.devices)), len(task.levels) * task.points * starts)
    # The cells of a device are numbered along the first quantity, then by start, then by level.
    number = np.concatenate([np.arange(len(task.levels) * task.points * count) for count in starts])
    level, step = np.divmod(number // starts[device_index], task.points)
    return _survey_places(task, _SurveyPlaces(device_index, level, step / max(task.points - 1, 1), number), 0)


def _survey_in_two_stages(task: SurveyTask) -> "_SurveyedPlaces":
    """Survey coarsely in two stages, for searches with any kind of motion.

    The first stage is short. Cells that are not on an orbit after it are continued only at or next to a step with a
    high score near the limits.
    """
    effort, devices = task.effort, len(task.devices)
    short = min(effort.settings.first_periods, effort.periods)
    # The short limit does not affect cells that settle on an orbit earlier.
    surveyed = _survey_coarsely(task._replace(effort=effort._replace(periods=short)))
    cells = surveyed.results.non_orbit_cells(effort.max_impacts)
    orbits, others = surveyed.orbits(effort.max_impacts), surveyed.motions(cells)
    highest = highest_admissible_score(devices, orbits, average_at_places(others))
    may_win = others.scores.total > highest[others.device_index] + math.log(effort.settings.min_competitive_share)
    may_win = is_near_limits(others.select(may_win), others, effort.settings)
    if short == effort.periods or not may_win.any():
        return surveyed
    periods = effort.periods * gap_time_factor(surveyed.results.pair.d)
    return surveyed._replace(results=surveyed.results.resume(cells[may_win], surveyed.device, periods))


def _summarise(
    task: SurveyTask, orbits: SurveyMotions, others: SurveyMotions, surveyed: "_SurveyedPlaces"
) -> list[SurveySummary]:
    """Return the summary of every device: motions of both surveys, and shares of starts of the coarse survey."""
    # P of the summary is a mean over starts for every objective.
    mean = average_at_places(others._replace(scores=score_motions(others.averages, others.device, "P"))).scores
    power = np.where(mean.margin < 0, 0.0, np.exp(mean.value))
    device_index = np.concatenate([orbits.device_index, others.device_index])
    margins = np.concatenate([item.averages.margins() for item in (orbits, others)])
    status = surveyed.results.summary.status

    def summarise_device(index: int) -> SurveySummary:
        """Return the summary of one device."""
        is_orbit, other_rows = orbits.device_index == index, np.flatnonzero(others.device_index == index)
        best_row = other_rows[power[other_rows].argmax()] if other_rows.size else None
        best = 0.0 if best_row is None else float(power[best_row])
        where = np.asarray(to_values(task.tune, others.z[best_row])).tolist() if best else []
        device_margins = margins[device_index == index]
        nearest = (
            device_margins[np.nan_to_num(device_margins, nan=-np.inf).min(axis=1).argmax()]
            if len(device_margins)
            else np.zeros(2)
        )
        # `nearest` has both margins of the motion with the largest minimum of both margins.
        breaks = bool(nearest.min() < 0)
        device_status = status[surveyed.places.device_index == index]
        return SurveySummary(
            starts=device_status.size,
            orbits=int(is_orbit.sum()),
            admissible=int((orbits.scores.margin[is_orbit] >= 0).sum()),
            aperiodic_points=len(np.unique(others.z[other_rows[others.averages.P[other_rows] > 0]], axis=0)),
            P=best,
            values=dict(zip(task.tune, where, strict=bool(best))),
            limit=LIMIT_NAMES[int(nearest.argmin())] if breaks else "",
            violation=math.expm1(-float(nearest.min())) if breaks else 0.0,
            permanent_contact=float((device_status == Status.PERMANENT_CONTACT).mean()),
            no_impact=float((device_status == Status.NO_IMPACT).mean()),
            undecided=float((device_status == Status.SLOW).mean()),
        )

    return [summarise_device(item) for item in range(len(task.devices))]


class _SurveyPlaces(NamedTuple):
    """Device, tuned quantities and number of every cell of a survey, [cell].

    Attributes:
        device_index, level: Index of the device, and of the combination of the quantities other than the first.
        part: Position of the first quantity within its bounds, 0 to 1.
        number: Index of the cell among the cells of its device, which determines its random start.
    """

    device_index: np.ndarray
    level: np.ndarray
    part: np.ndarray
    number: np.ndarray


def first_moving(tune: tuple[str, ...]) -> int | None:
    """Return the index of the first tuned quantity that affects the motion; None if there is none. Surveys vary it."""
    return next((i for i, name in enumerate(tune) if affects_motion(name)), None)


def _level_values(tune: tuple[str, ...], effort: Effort) -> np.ndarray:
    """Return evenly spread combinations [level, quantity] of the quantities other than the first, from 0 to 1."""
    first = first_moving(tune)
    others = [i for i, name in enumerate(tune) if i != first and affects_motion(name)]
    count = effort.settings.survey_levels if others else 1
    # Quantities that do not affect the motion stay in the middle of their bounds.
    parts = np.full((count, len(tune)), 0.5)
    if others:
        # One other quantity has an even grid. For several, the first has the grid and the others have lattice points.
        parts[:, others[0]] = (np.arange(count) + 0.5) / count
        if others[1:]:
            parts[:, others[1:]] = lattice(count, len(others) - 1).T
    return parts


class _SurveyedPlaces(NamedTuple):
    """A simulated survey: objective, results, and device, variables, place and step of every cell."""

    objective: str
    results: Survey
    device: Harvester
    z: np.ndarray
    places: _SurveyPlaces
    step: np.ndarray

    def orbits(self, impacts: int) -> SurveyMotions:
        """Return the periodic attractors with at most `impacts` impacts."""
        return self.motions(self.results.orbit_cells(impacts, self.places.device_index))

    def non_orbits(self, impacts: int) -> SurveyMotions:
        """Return the motions other than orbits with at most `impacts` impacts."""
        return self.motions(self.results.non_orbit_cells(impacts))

    def all_motions(self) -> SurveyMotions:
        """Return the motions of all cells."""
        return self.motions(np.arange(self.step.size))

    def motions(self, cells: np.ndarray) -> SurveyMotions:
        """Return the motions of cells, by their indices."""
        survey_rows = (self.results.pair, self.results.summary)
        (pair, summary), device, z, places, step = jax.tree.map(lambda x: x[cells], (survey_rows, *self[2:]))
        results = summary_averages(device, summary)
        scores = score_motions(results, device, self.objective)
        return SurveyMotions(results, scores, pair, summary, device, z, places.device_index, places.level, step)


def _survey_places(task: SurveyTask, places: _SurveyPlaces, seed: int) -> _SurveyedPlaces:
    """Simulate the cells at some places; the number of a cell determines its random start.

    The random numbers are the same for every device, so that the results of a device do not depend on the others.
    """
    devices, tune, box, objective, effort = task
    first, parts = first_moving(tune), task.levels[places.level]
    if first is not None:
        parts[:, first] = places.part
    low, high = box[places.device_index].swapaxes(0, 1)
    # z is linear in `parts`, so the values of a quantity with a logarithmic variable are geometrically spaced.
    z = low + parts * (high - low)
    base_devices = jax.tree.map(lambda *x: np.array(x, float)[places.device_index], *devices)
    tuned_devices, pair = tiles.map_tiles(
        lambda rows: tuned_devices_and_pairs(rows[0], rows[1], tune), (base_devices, z), _TILES
    )
    # The longest orbit and the periods grow with the time for crossing the gap.
    max_period, periods = (count * gap_time_factor(pair.d) for count in (effort.settings.max_period, effort.periods))
    starts = _draw_starts(pair, places.number, task.cells, seed)
    results = simulate_survey(pair, tuned_devices, starts, max_period=max_period, periods=periods)
    step = np.round(places.part * (effort.points - 1)).astype(int)
    return _SurveyedPlaces(objective, results, tuned_devices, z, places, step)


def _draw_starts(pair: ImpactPair, number: np.ndarray, cells: int, seed: int) -> Starts:
    """Return the random start of every cell. Starts are drawn in blocks of `cells`; numbers beyond use further blocks.

    In a wide gap every other cell has a range of velocities up to the largest one that the forcing can sustain. The
    reason is that fast orbits harvest more, and that a fast ball loses speed at impacts until it reaches such an orbit.
    """
    range_u, speed = _START_RANGE
    draws = [
        np.random.default_rng([seed, draw] if draw else seed).uniform(-1, 1, (2, cells))
        for draw in range(1 + int(number.max()) // cells)
    ]
    u0, v0 = np.concatenate(draws, axis=1)[:, number]
    # With restitution r the speed v of an orbit satisfies v <= r v + 2/pi, so v <= (2/pi) / (1 - r).
    larger_r = np.maximum(pair.at(1).r, pair.at(-1).r)
    fast = np.minimum(pair.d, _LARGEST_KICK / np.maximum(1 - larger_r, 0.1))
    # Cells with an odd number have the larger range of velocities.
    largest_speed = np.where(number % 2 == 1, np.maximum(speed, fast), speed)
    return Starts(range_u * u0 * pair.d, largest_speed * v0, np.zeros_like(v0))


def _refine_places(motions: SurveyMotions, task: SurveyTask) -> _SurveyPlaces:
    """Return the places that refine the survey at the steps of the specified motions.

    The cells of a device, at most as many as in the coarse survey, are divided evenly among these steps and spread
    evenly over the interval of each step.
    """
    effort = task.effort
    # A step is refined once, however many motions it has.
    device_index, level, step = np.unique(
        np.column_stack([motions.device_index, motions.level, motions.step]), axis=0
    ).T
    places = [_SurveyPlaces(*np.zeros((4, 0), int))]
    for index in np.unique(device_index):
        rows = np.flatnonzero(device_index == index)
        number = np.arange(min(rows.size * effort.settings.survey_refinement * effort.starts, task.cells))
        row, turn = rows[number % rows.size], number // rows.size
        # Cells at one step are spread over the interval from half a step below to half a step above it.
        part = (step[row] + (turn + 0.5) / (turn.max() + 1) - 0.5) / (effort.points - 1)
        places.append(_SurveyPlaces(device_index[row], level[row], np.clip(part, 0.0, 1.0), number))
    return jax.tree.map(lambda *x: np.concatenate(x), *places)
