"""The search for the best designs of some devices: a survey, then turns of candidates that are climbed and verified.

A turn takes the most promising candidates that were not taken before, orbits and other motion. Another turn follows
for each device of which nothing was verified to give what its candidates promised. The best design of a device is the
highest that was verified.
"""

import math

import numpy as np

from vijax.design import aperiodic_search, long_flight, orbit_ascents
from vijax.design.aperiodic_search import Place, PlaceCandidates
from vijax.design.candidates import Begun, OrbitCandidates
from vijax.design.ensemble import Task
from vijax.design.multistart import Effort, Looked, SurveyTask, every_start, find
from vijax.design.optimum import AperiodicOptimum, DroppedCandidate, Optimum
from vijax.design.tolerance import Nodes


class DeviceSearch:
    """The search for the best design of one device.

    Args:
        looked: See below.
        same: Distance of two optima, in the logarithms of their quantities, below which they are one.

    Attributes:
        looked: What its survey met.
        orbits, others: Designs that were verified, on orbits and on other motion.
        ascents, places: Candidates that were taken, orbits and values of the tuned quantities with other motion.
        dropped: Candidates that were not verified, and designs that another one outdoes.
    """

    def __init__(self, looked: Looked, same: float):
        self.looked, self._same = looked, same
        self.orbits: list[Optimum] = []
        self.others: list[AperiodicOptimum] = []
        self.ascents, self.places = 0, 0
        self.dropped: list[DroppedCandidate] = []

    @property
    def optima(self) -> tuple[Optimum | AperiodicOptimum, ...]:
        """Return the designs, the best first; of those on no orbit the best alone, if no orbit gives more."""
        orbits: list[Optimum] = []
        for one in sorted(self.orbits, key=lambda one: -one.height):
            # Ascents of different turns may end at one optimum.
            if all(np.abs(one.z - other.z).max() > self._same for other in orbits):
                orbits.append(one)
        other = max(self.others, key=lambda one: one.height, default=None)
        if other is None or (orbits and orbits[0].height >= other.height):
            return tuple(orbits)
        return (other, *orbits)

    @property
    def known(self) -> float:
        """Return the logarithm of the best objective that is verified; -inf where none is."""
        optima = self.optima
        return math.log(optima[0].height) if optima else -math.inf

    @property
    def lost(self) -> tuple[DroppedCandidate, ...]:
        """Return the candidates that promised more than the best design gives, the most promising first."""
        least = math.exp(self.known)
        some = [one for one in self.dropped if one.predicted > least]
        return tuple(sorted(some, key=lambda one: -one.predicted))


def search(task: Task, far: Effort, cloud: Nodes, max_evaluations: int, orbits_alone: bool) -> list[DeviceSearch]:
    """Find the best designs of some devices.

    Args:
        task: What is sought.
        far: How far the survey looks.
        cloud: Devices that are off by the tolerances of the objective.
        max_evaluations: Of one ascent.
        orbits_alone: Whether no other motion than an orbit may win.
    """
    surveyed = SurveyTask(task.devices, task.tune, task.box, task.objective, far)
    orbits = None
    if task.expected:
        others, looked = every_start(surveyed)
    else:
        result = find(surveyed, orbits_alone=orbits_alone)
        orbits, others, looked = OrbitCandidates(result, orbits_alone), result.others, result.looked
    places = None if orbits_alone else PlaceCandidates(task, others)
    found, tried = [DeviceSearch(one, task.settings.same_optimum) for one in looked], []
    for turn in range(task.settings.max_turns):
        begun = orbits.take(_known(found) if turn else None) if orbits else None
        if begun is not None:
            _climb(task, begun, cloud, max_evaluations, found)
        chosen = places.take(_known(found), not turn) if places else []
        tried += _prove(task, aperiodic_search.search(task, chosen, _known(found)), found)
        if begun is None and not chosen:
            break
    # Better than no design is the mean of the motions that the balls of one flight end on.
    none = [one for one in tried if math.isinf(found[one.owner].known)]
    _prove(task, none, found, mixtures=True)
    return found


def _known(found: list[DeviceSearch]) -> np.ndarray:
    return np.array([one.known for one in found])


def _climb(task: Task, begun: Begun, cloud: Nodes, max_evaluations: int, found: list[DeviceSearch]) -> None:
    """Climb from orbits, and add what was verified."""
    verified = orbit_ascents.search(task, begun, cloud, max_evaluations)
    count = np.bincount(begun.owner, minlength=len(found)).tolist()
    for one, optima, dropped, number in zip(found, *verified, count, strict=True):
        one.orbits += optima
        one.dropped += dropped
        one.ascents += number


def _prove(task: Task, places: list[Place], found: list[DeviceSearch], *, mixtures: bool = False) -> list[Place]:
    """Fly places for long, add what was verified, and give the places."""
    if places:
        proved = long_flight.prove(task, places, _known(found), mixtures=mixtures)
        for one, best, dropped in zip(found, *proved, strict=True):
            one.others += [best] if best else []
            one.dropped += dropped
    for place in places:
        found[place.owner].places += not mixtures
    return places
