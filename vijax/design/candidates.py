"""Candidates for the best design: the orbits of a survey that are climbed from, the most promising first.

What a motion promises need not last: an ascent may end at an orbit that does not attract, and a long flight may measure
less than a short one. So there are several turns. Each one takes the orbits that may lead to a better design than the
best one that is verified by then.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax.design.design_settings import DesignSettings
from vijax.design.multistart import SurveyResult, SurveyTask, first_moving
from vijax.design.promise import Met, at_places, highest_promise
from vijax.design.survey import Flown, flown
from vijax.model.device import Harvester
from vijax.model.variables import LINEAR

KEPT = 0.01
"""A promise is kept by a design that is verified to give no less than this part below it, as a logarithm."""

_HOPELESS = -1e3  # score of what breaks a constraint, before what it lacks


class Begun(NamedTuple):
    """Where ascents begin, [start]: an orbit as it was flown, its device and variables, which of the devices it is."""

    flown: Flown
    device: Harvester
    z: np.ndarray
    owner: np.ndarray

    def some(self, index: np.ndarray) -> "Begun":
        """Pick those with the given indices."""
        return jax.tree.map(lambda x: x[index], self)


class OrbitCandidates:
    """The orbits of a survey that are climbed from, in turns.

    Attributes:
        most: Logarithm of the objective that the best motion of every device promises, orbits or any: what a design has
            to give for the promise to be kept; -inf where nothing admissible is left.

    Args:
        result: Of the survey.
        orbits_alone: Whether no other motion may win.
    """

    def __init__(self, result: SurveyResult, orbits_alone: bool):
        self._task, self._orbits, self._alone = result.task, result.orbits, orbits_alone
        devices = len(result.task.devices)
        self.most = highest_promise(devices, result.orbits)
        if not orbits_alone:
            self.most = np.maximum(self.most, highest_promise(devices, at_places(result.others)))
        self._left = np.zeros(result.orbits.owner.size, bool)
        self._left[_promising(result.orbits, devices, result.task.points, result.task.effort.settings)] = True

    def take(self, known: np.ndarray | None) -> Begun | None:
        """Take the orbits that may lead to a better design; None if there are none.

        Args:
            known: Logarithm of the best objective of every device that is verified, -inf where there is none; None in
                the first turn.
        """
        orbits, left = self._orbits, self._left
        if known is not None:
            broken = np.isinf(known) | (known < self.most - KEPT)
            self.most = np.where(broken, known, self.most)
            left = left & broken[orbits.owner]
        rows = np.flatnonzero(left)
        if not self._alone:
            rows = rows[_rivals(orbits.some(rows), self.most, self._task)]
        if known is not None:
            rows = _first(rows, orbits.owner[rows], orbits.hope.total[rows], self._task.effort.settings.max_ascents)
        self._left[rows] = False
        if not rows.size:
            return None
        some = orbits.some(rows)
        return Begun(flown(some.pair, some.ended, self._task.effort.max_impacts), some.device, some.z, some.owner)


def _first(rows: np.ndarray, owner: np.ndarray, score: np.ndarray, most: int) -> np.ndarray:
    """Choose so many rows of every owner at most, those with the highest scores, in their order."""
    order = np.lexsort((-score, owner))
    place = np.arange(order.size) - np.searchsorted(owner[order], owner[order])
    return np.sort(rows[order[place < most]])


def _promising(met: Met, devices: int, points: int, settings: DesignSettings) -> np.ndarray:
    """Choose the attractors to climb from: the best of their kind as far as so many steps away.

    A kind is given by span and impacts; the walls may change places where the tube is level.
    """
    hope = met.hope
    score = np.where(hope.lacks < 0, _HOPELESS + hope.lacks, hope.value)
    left, right = _impacts(met)
    kind = np.column_stack([met.owner, met.level, met.ended.period, left, right])
    found = highest(kind, met.step, score, max(1, points // settings.max_hills))
    enough = hope.total > highest_promise(devices, met)[met.owner] + math.log(settings.min_promise)
    return found[(enough | (left + right <= settings.max_sure_impacts))[found]]


def highest(group: np.ndarray, step: np.ndarray, score: np.ndarray, reach: int) -> np.ndarray:
    """Find the rows that none of their group beats within so many steps; of one step's rows the first best.

    Args:
        group: What rows of one group have in common, [row, ...].
        step, score: Where and how high each stands.
        reach: How many steps away a higher row beats it.
    """
    order = np.lexsort((-score, step, *group.T[::-1]))
    place = np.column_stack([group, step])[order]
    new = np.append(True, (np.diff(place, axis=0) != 0).any(axis=1))[: order.size]
    best, place = order[new], place[new]
    height, top = score[best], np.ones(best.size, bool)
    for ahead in range(1, reach + 1):
        apart = place[ahead:] - place[:-ahead]
        near = (apart[:, :-1] == 0).all(axis=1) & (apart[:, -1] <= reach)
        top[:-ahead] &= ~near | (height[:-ahead] >= height[ahead:])
        top[ahead:] &= ~near | (height[ahead:] >= height[:-ahead])
    return np.sort(best[top])


def _impacts(met: Met) -> tuple[np.ndarray, np.ndarray]:
    """Count left and right impacts of orbits; in a level tube the more and the fewer."""
    left, right = met.ended.impacts_left, met.ended.impacts_right
    swap = met.pair.symmetric & (right > left)
    return np.where(swap, right, left), np.where(swap, left, right)


def _rivals(met: Met, most: np.ndarray, task: SurveyTask) -> np.ndarray:
    """Choose the attractors that may lead to the best design, where any motion may win.

    What promises too little, or exceeds a limit by far, never did.
    """
    near = met.hope.lacks >= -_excess(task)[met.owner]
    return np.flatnonzero(near & (met.hope.total >= most[met.owner] + math.log(task.effort.settings.min_rival)))


def _excess(task: SurveyTask) -> np.ndarray:
    """Say by how much an orbit of every device may exceed a limit to be climbed from, as a logarithm.

    Where the first quantity alone moves the ball, the survey has met the orbit nearer to where it keeps its limits.
    """
    first, settings = first_moving(task.tune), task.effort.settings
    most = np.full(len(task.devices), settings.max_excess)
    if first is None or task.tune[first] in LINEAR or len(task.levels) > 1:
        return most
    step = (task.box[:, 1, first] - task.box[:, 0, first]) / max(task.points - 1, 1)
    return np.minimum(most, settings.max_excess_steps * step)
