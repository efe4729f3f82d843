"""Motions found by surveys, and their scores: the logarithm of the objective, and the margin to the limits.

A survey simulates each start briefly, so a score is a prediction of the verified objective. If an orbit breaks a limit,
an ascent may move it to the limit. The energy decreases with the depth on the way, so value + margin, with a negative
margin, estimates the objective at the limit.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.design.aperiodic.motion_averages import Averages
from vijax.design.design_settings import DesignSettings
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair


class MotionScores(NamedTuple):
    """Scores of motions: logarithm of the objective, and smallest margin to a limit, or 0 if no limit is broken."""

    value: np.ndarray
    margin: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Return value + margin, an estimate of the log-objective after an ascent to the limit."""
        return self.value + self.margin


def score_motions(averages: Averages, device: Harvester, objective: str) -> MotionScores:
    """Return the scores of motions for an objective; `device` holds one device per motion."""
    with np.errstate(divide="ignore"):
        # A motion without an average has the objective 0, so its score is -inf.
        value = np.log(np.nan_to_num(averages.value(objective, device)))
    # `initial` makes 0 the largest margin. `nanmin` ignores NaN, the margin of a motion without an average.
    return MotionScores(value, np.nanmin(averages.margins(), axis=1, initial=0.0))


class SurveyMotions(NamedTuple):
    """Motions that a survey found, [motion].

    Attributes:
        averages: Averages of the motions.
        scores: Scores for the objective of the search.
        pair, summary: Pair and `Summary` of the cell of each motion.
        device: Device of each motion.
        z: Variables of the tuned quantities of this device.
        device_index: Index of the device in the list of devices.
        level, step: Index of the combination of the quantities other than the first, and of the value of the first
            quantity.
    """

    averages: Averages
    scores: MotionScores
    pair: ImpactPair
    summary: Any
    device: Harvester
    z: np.ndarray
    device_index: np.ndarray
    level: np.ndarray
    step: np.ndarray

    def select(self, index: np.ndarray) -> "SurveyMotions":
        """Return the motions with the specified indices."""
        return jax.tree.map(lambda x: x[index], self)


def average_at_places(motions: SurveyMotions) -> SurveyMotions:
    """Return the motions with scores averaged over all motions at the same values of the tuned quantities.

    The average of a single start over a short simulation varies at random, and the largest of many such averages
    overestimates the objective. The margin becomes the smallest margin at the same values.
    """
    place, count = _place_indices(motions)
    with np.errstate(divide="ignore"):
        # The mean is taken over the objective itself, not over its logarithm.
        mean = np.log(np.bincount(place, np.exp(motions.scores.value)) / count)
    # `minimum.at` is used because indexed assignment would keep only the last motion of each place.
    worst = np.full(count.size, np.inf)
    np.minimum.at(worst, place, motions.scores.margin)
    return motions._replace(scores=MotionScores(mean[place], worst[place]))


def _place_indices(motions: SurveyMotions) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each motion, the index of its device and tuned quantities, and for each index the count."""
    _, place, count = np.unique(
        np.column_stack([motions.device_index, motions.z]), axis=0, return_inverse=True, return_counts=True
    )
    return place.ravel(), count


def highest_admissible_score(devices: int, *groups: SurveyMotions) -> np.ndarray:
    """Return the highest log-objective of each device over motions that break no limit; -inf if there is none."""
    highest = np.full(devices, -np.inf)
    for motions in groups:
        np.maximum.at(highest, motions.device_index, np.where(motions.scores.margin < 0, -np.inf, motions.scores.value))
    return highest


def is_near_limits(references: SurveyMotions, motions: SurveyMotions, settings: DesignSettings) -> np.ndarray:
    """Return a mask of the motions at or next to a step with a reference motion near or within the limits.

    Args:
        references: Motions that may lie near the limits.
        motions: Motions for which the mask is returned.
        settings: A reference motion is near the limits if no violation exceeds `max_violation`.
    """
    within = np.flatnonzero(references.scores.margin >= -settings.max_violation)
    shape = [1 + int(x.max(initial=0)) for x in (motions.device_index, motions.level)]
    # Step s has index s + 1 in the table, so that the neighbours of the first and the last step have entries.
    near = np.zeros((*shape, 3 + int(motions.step.max(initial=0))), bool)
    # Mark the steps of the references and the two neighbours of each.
    for offset in range(3):
        near[references.device_index[within], references.level[within], references.step[within] + offset] = True
    return near[motions.device_index, motions.level, motions.step + 1]
