"""Selection of the orbits of a survey that start ascents, round by round, the highest scores first.

A score only predicts an objective: an ascent may end at an orbit that is not attracting, and a long simulation may
measure less than a short one. If the verified objective of a device is below the prediction, the next round therefore
takes further orbits.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax.design.design_settings import DesignSettings
from vijax.design.survey.attractor_survey import RecordedOrbits, record_orbits
from vijax.design.survey.device_survey import SurveyResult, SurveyTask, first_moving
from vijax.design.survey.motion_scores import SurveyMotions, average_at_places, highest_admissible_score
from vijax.model.device import Harvester
from vijax.model.tuned_quantities import LINEAR

SCORE_TOLERANCE = 0.01
"""A verified objective counts as below its prediction only if ln(predicted / verified) exceeds this value."""

# An orbit that breaks a limit has this score plus its margin, so that it ranks below all admissible orbits.
_INADMISSIBLE_SCORE = -1e3


class AscentStarts(NamedTuple):
    """Starts of ascents, [start]: recorded orbit, device, variables, and index of the device in the search."""

    orbits: RecordedOrbits
    device: Harvester
    z: np.ndarray
    device_index: np.ndarray

    def select(self, index: np.ndarray) -> "AscentStarts":
        """Return the starts with the specified indices."""
        return jax.tree.map(lambda x: x[index], self)


class OrbitCandidates:
    """The orbits of a survey that have not been climbed yet; `take` returns the starts of one round.

    Attributes:
        target: Log-objective that each device is expected to reach: at first the highest score of an admissible orbit
            or, without `orbits_only`, of any admissible motion; -inf without admissible motion. A device takes part in
            the next round if its verified objective is below the target.

    Args:
        result: Result of the survey.
        orbits_only: True if only orbits can be designs.
    """

    def __init__(self, result: SurveyResult, orbits_only: bool):
        self._task, self._orbits, self._orbits_only = result.task, result.orbits, orbits_only
        devices = len(result.task.devices)
        self.target = highest_admissible_score(devices, result.orbits)
        if not orbits_only:
            self.target = np.maximum(self.target, highest_admissible_score(devices, average_at_places(result.others)))
        self._remaining = np.zeros(result.orbits.device_index.size, bool)
        self._remaining[_select_promising(result.orbits, devices, result.task.points, result.task.effort.settings)] = (
            True
        )

    def take(self, best_verified: np.ndarray | None) -> AscentStarts | None:
        """Return the orbits to climb in the next round as starts of ascents; None if there are none.

        Args:
            best_verified: Logarithm of the best verified objective of every device, -inf where there is none; None in
                the first round.
        """
        orbits, remaining = self._orbits, self._remaining
        if best_verified is not None:
            is_missed = np.isinf(best_verified) | (best_verified < self.target - SCORE_TOLERANCE)
            # A missed target is lowered to the verified objective, which also lowers the score that
            # `_select_competitive` requires.
            self.target = np.where(is_missed, best_verified, self.target)
            remaining = remaining & is_missed[orbits.device_index]
        rows = np.flatnonzero(remaining)
        # If other motion can be a design, orbits that are unlikely to reach the target are left out.
        if not self._orbits_only:
            rows = rows[_select_competitive(orbits.select(rows), self.target, self._task)]
        if best_verified is not None:
            rows = _select_highest(
                rows, orbits.device_index[rows], orbits.scores.total[rows], self._task.effort.settings.max_ascents
            )
        # Each orbit is climbed once.
        self._remaining[rows] = False
        if not rows.size:
            return None
        chosen = orbits.select(rows)
        return AscentStarts(
            record_orbits(chosen.pair, chosen.summary, self._task.effort.max_impacts),
            chosen.device,
            chosen.z,
            chosen.device_index,
        )


def _select_highest(rows: np.ndarray, device_index: np.ndarray, score: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` rows of each device with the highest scores, in ascending order of the rows."""
    order = np.lexsort((-score, device_index))
    # Rank of each row within its device, by descending score.
    rank = np.arange(order.size) - np.searchsorted(device_index[order], device_index[order])
    return np.sort(rows[order[rank < count]])


def _select_promising(motions: SurveyMotions, devices: int, points: int, settings: DesignSettings) -> np.ndarray:
    """Return the indices of the orbits to climb: local maxima of the score of their kind along the steps.

    A kind is determined by device, level, period and numbers of impacts at both walls; at level ground the walls may be
    exchanged. Orbits with many impacts must also have a high score.
    """
    scores = motions.scores
    score = np.where(scores.margin < 0, _INADMISSIBLE_SCORE + scores.margin, scores.value)
    more, fewer = _count_impacts(motions)
    kind = np.column_stack([motions.device_index, motions.level, motions.summary.period, more, fewer])
    maxima = select_local_maxima(kind, motions.step, score, max(1, points // settings.max_local_maxima))
    # Orbits with more than `max_unconditional_impacts` are climbed only if their score is high.
    is_high = scores.total > highest_admissible_score(devices, motions)[motions.device_index] + math.log(
        settings.min_score_share
    )
    return maxima[(is_high | (more + fewer <= settings.max_unconditional_impacts))[maxima]]


def select_local_maxima(group: np.ndarray, step: np.ndarray, score: np.ndarray, reach: int) -> np.ndarray:
    """Return the rows with the highest score of their group within `reach` steps, at most one row per step.

    If several rows of a group have the highest score at one step, the first of them is returned.

    Args:
        group: Keys of each row, [row, key]; rows with equal keys form a group.
        step, score: Step of the survey and score of each row.
        reach: Largest distance in steps of two rows that are compared.
    """
    # Sorted by group, step and descending score, so that the first row of a step has the highest score.
    order = np.lexsort((-score, step, *group.T[::-1]))
    keys = np.column_stack([group, step])[order]
    is_first = np.append(True, (np.diff(keys, axis=0) != 0).any(axis=1))[: order.size]
    best, keys = order[is_first], keys[is_first]
    height, is_maximum = score[best], np.ones(best.size, bool)
    # One row per step is left, so rows within `reach` steps are at most `reach` positions apart.
    for distance in range(1, reach + 1):
        difference = keys[distance:] - keys[:-distance]
        is_near = (difference[:, :-1] == 0).all(axis=1) & (difference[:, -1] <= reach)
        is_maximum[:-distance] &= ~is_near | (height[:-distance] >= height[distance:])
        is_maximum[distance:] &= ~is_near | (height[distance:] >= height[:-distance])
    return np.sort(best[is_maximum])


def _count_impacts(motions: SurveyMotions) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of left and right impacts; at level ground the larger and the smaller number."""
    left, right = motions.summary.impacts_left, motions.summary.impacts_right
    # At level ground a mirror image exchanges left and right impacts.
    swap = motions.pair.symmetric & (right > left)
    return np.where(swap, right, left), np.where(swap, left, right)


def _select_competitive(motions: SurveyMotions, target: np.ndarray, task: SurveyTask) -> np.ndarray:
    """Return the indices of the orbits with a high score and a small violation.

    This selection applies if any motion can be a design. In tests on random devices, no ascent to a best design started
    from an orbit with a low score or a large violation.
    """
    is_near = motions.scores.margin >= -_largest_violation(task)[motions.device_index]
    return np.flatnonzero(
        is_near
        & (motions.scores.total >= target[motions.device_index] + math.log(task.effort.settings.min_competitive_share))
    )


def _largest_violation(task: SurveyTask) -> np.ndarray:
    """Return the largest violation, as a logarithm, of the orbits that are climbed, for each device.

    If the first quantity is the only tuned quantity that affects the motion, the violation is also limited to a number
    of steps, because the survey finds an orbit with a larger violation within the limits at another step.
    """
    first, settings = first_moving(task.tune), task.effort.settings
    largest = np.full(len(task.devices), settings.max_violation)
    # The limit in steps applies only if one quantity affects the motion and its variable is its logarithm.
    if first is None or task.tune[first] in LINEAR or len(task.levels) > 1:
        return largest
    # Change of the logarithm of the first quantity in one step of the survey.
    step = (task.box[:, 1, first] - task.box[:, 0, first]) / max(task.points - 1, 1)
    return np.minimum(largest, settings.max_violation_steps * step)
