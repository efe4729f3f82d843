"""The search for the best designs of some devices: a survey, then rounds of climbing and verifying candidates.

A candidate is an orbit or a place, a combination of values of the tuned quantities with motion other than an orbit. A
round takes the candidates with the highest predicted objective that earlier rounds have not taken. A device takes part
in the next round if its verified objective is below the prediction of its candidates. The best design of a device is
the verified design with the highest objective.
"""

import math

import numpy as np

from vijax.design import orbit_ascents
from vijax.design.aperiodic import aperiodic_search, design_confirmation
from vijax.design.aperiodic.aperiodic_search import AscentPlace, PlaceCandidates
from vijax.design.aperiodic.ensemble import DesignTask
from vijax.design.optimum import AperiodicOptimum, DroppedCandidate, Optimum
from vijax.design.robustness.tolerance import Nodes
from vijax.design.survey.device_survey import Effort, SurveySummary, SurveyTask, survey_all_starts, survey_devices
from vijax.design.survey.orbit_candidates import AscentStarts, OrbitCandidates


class DeviceSearch:
    """The search for the best design of one device.

    Args:
        summary: Summary of the survey of the device.
        same: Distance of two optima, in the logarithms of their quantities, below which they count as one.

    Attributes:
        summary: The argument `summary`.
        orbits, others: Verified designs, on orbits and on other motion.
        ascents, places: Numbers of climbed candidates: orbits, and places with other motion.
        dropped: Candidates that failed verification, and confirmed designs on other motion that a better one replaced.
    """

    def __init__(self, summary: SurveySummary, same: float):
        self.summary, self._same = summary, same
        self.orbits: list[Optimum] = []
        self.others: list[AperiodicOptimum] = []
        self.ascents, self.places = 0, 0
        self.dropped: list[DroppedCandidate] = []

    @property
    def optima(self) -> tuple[Optimum | AperiodicOptimum, ...]:
        """Return the distinct designs by descending objective.

        Of the designs on other motion only the best is included, and only if it has a higher objective than all orbits.
        """
        orbits: list[Optimum] = []
        for optimum in sorted(self.orbits, key=lambda optimum: -optimum.objective_value):
            # Ascents of different rounds may end at one optimum.
            if all(np.abs(optimum.z - other.z).max() > self._same for other in orbits):
                orbits.append(optimum)
        other = max(self.others, key=lambda optimum: optimum.objective_value, default=None)
        # If the objectives are equal, the orbit is preferred, because its P has no statistical error.
        if other is None or (orbits and orbits[0].objective_value >= other.objective_value):
            return tuple(orbits)
        return (other, *orbits)

    @property
    def best_log(self) -> float:
        """Return the logarithm of the best verified objective; -inf where there is none."""
        optima = self.optima
        return math.log(optima[0].objective_value) if optima else -math.inf

    @property
    def unconfirmed(self) -> tuple[DroppedCandidate, ...]:
        """Return the dropped candidates with a prediction above the best verified objective, the highest first."""
        # Without a design `best_log` is -inf and the threshold is 0, so all dropped candidates are returned.
        threshold = math.exp(self.best_log)
        candidates = [candidate for candidate in self.dropped if candidate.predicted > threshold]
        return tuple(sorted(candidates, key=lambda candidate: -candidate.predicted))


def search_designs(
    task: DesignTask, survey_effort: Effort, tolerance_nodes: Nodes, max_evaluations: int, orbits_only: bool
) -> list[DeviceSearch]:
    """Find the best designs of some devices.

    Args:
        task: The search.
        survey_effort: Size of the survey.
        tolerance_nodes: Quadrature nodes over the tolerances, for the objectives "mean" and "worst".
        max_evaluations: Largest number of evaluations of one ascent.
        orbits_only: True if only orbits can be designs.
    """
    survey_task = SurveyTask(task.devices, task.tune, task.box, task.objective, survey_effort)
    orbits = None
    if task.expected:
        others, summaries = survey_all_starts(survey_task)
    else:
        result = survey_devices(survey_task, orbits_only=orbits_only)
        orbits, others, summaries = OrbitCandidates(result, orbits_only), result.others, result.summaries
    places = None if orbits_only else PlaceCandidates(task, others)
    searches, tried = [DeviceSearch(item, task.settings.same_optimum) for item in summaries], []
    for round_index in range(task.settings.max_rounds):
        # The first round has no verified designs to compare with.
        starts = orbits.take(_best_logs(searches) if round_index else None) if orbits else None
        if starts is not None:
            _climb(task, starts, tolerance_nodes, max_evaluations, searches)
        chosen = places.take(_best_logs(searches), not round_index) if places else []
        tried += _confirm(task, aperiodic_search.climb_places(task, chosen, _best_logs(searches)), searches)
        # Without a candidate in this round the search ends.
        if starts is None and not chosen:
            break
    # For devices without a design, places are confirmed again, with samples that may end on different motions.
    unverified = [item for item in tried if math.isinf(searches[item.device_index].best_log)]
    _confirm(task, unverified, searches, mixtures=True)
    return searches


def _best_logs(searches: list[DeviceSearch]) -> np.ndarray:
    """Return the logarithm of the best verified objective of each device."""
    return np.array([search.best_log for search in searches])


def _climb(
    task: DesignTask, starts: AscentStarts, tolerance_nodes: Nodes, max_evaluations: int, searches: list[DeviceSearch]
) -> None:
    """Climb from orbits, and add the verified designs."""
    optima_and_dropped = orbit_ascents.climb_orbits(task, starts, tolerance_nodes, max_evaluations)
    # Number of ascents of each device, 0 for a device without ascents.
    count = np.bincount(starts.device_index, minlength=len(searches)).tolist()
    for search, optima, dropped, number in zip(searches, *optima_and_dropped, count, strict=True):
        search.orbits += optima
        search.dropped += dropped
        search.ascents += number


def _confirm(
    task: DesignTask, places: list[AscentPlace], searches: list[DeviceSearch], *, mixtures: bool = False
) -> list[AscentPlace]:
    """Confirm places in long simulations, add the results to `searches`, and return `places` unchanged."""
    if places:
        confirmed = design_confirmation.confirm_designs(task, places, _best_logs(searches), mixtures=mixtures)
        for search, best, dropped in zip(searches, *confirmed, strict=True):
            search.others += [best] if best else []
            search.dropped += dropped
    for place in places:
        # With `mixtures` the places are confirmed a second time, so they are already counted.
        searches[place.device_index].places += not mixtures
    return places
