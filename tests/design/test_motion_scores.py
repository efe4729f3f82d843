"""Scores of motions, and the selection of motions near their limits."""

from typing import Any, NamedTuple

import numpy as np

from vijax.design.design_settings import DesignSettings
from vijax.design.survey.motion_scores import (
    SurveyMotions,
    average_at_places,
    highest_admissible_score,
    is_near_limits,
    score_motions,
)


class FixedAverages(NamedTuple):
    """Averages with fixed objectives and margins to the limits."""

    objective: np.ndarray
    margin: np.ndarray

    def value(self, objective: str, device: Any) -> np.ndarray:
        """Return the objective."""
        return self.objective

    def margins(self) -> np.ndarray:
        """Return the margins [motion, limit]."""
        return self.margin[:, None]


def make_motions(value, margin, step, device_index):
    zero = np.zeros(len(value), int)
    nothing: Any = None
    averages: Any = FixedAverages(np.asarray(value, float), np.asarray(margin, float))
    return SurveyMotions(
        averages,
        score_motions(averages, nothing, "P"),
        nothing,
        nothing,
        nothing,
        zero,
        np.asarray(device_index),
        zero,
        np.asarray(step),
    )


def test_motions_near_a_limit_include_neighbouring_steps():
    # The first device violates a limit by 0.2 at step 3; the second device violates it by 0.4 at the same step.
    motions = make_motions(np.ones(7), [-1, -1, -1, -0.2, -1, -1, -0.4], [0, 1, 2, 3, 4, 5, 3], [0, 0, 0, 0, 0, 0, 1])
    near = is_near_limits(motions, motions, DesignSettings(max_violation=0.3))
    np.testing.assert_array_equal(near, [False, False, True, True, True, False, False])
    assert is_near_limits(motions, motions, DesignSettings(max_violation=0.5))[-1]


def test_highest_score_is_of_an_admissible_motion():
    most = highest_admissible_score(
        3, make_motions([1, 5], [0, -0.1], [0, 1], [0, 0]), make_motions([3], [0], [0], [1])
    )
    np.testing.assert_allclose(most, [0.0, np.log(3), -np.inf])


def test_score_of_a_place_is_the_mean_with_the_worst_margin():
    motions = make_motions([4, 0, 1, 9], [0.2, 0.1, -0.5, 0.3], [0, 0, 1, 0], [0, 0, 0, 1])._replace(
        z=np.array([[1.0], [1.0], [2.0], [1.0]])
    )
    scores = average_at_places(motions).scores
    np.testing.assert_allclose(np.exp(scores.value), [2, 2, 1, 9])
    np.testing.assert_allclose(scores.margin, [0, 0, -0.5, 0])
