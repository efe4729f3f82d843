"""Orbits are climbed in rounds: further orbits follow if no verified objective reaches the scores."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from vijax.design.design_settings import DesignSettings
from vijax.design.survey import orbit_candidates
from vijax.design.survey.device_survey import Effort, SurveyResult, SurveyTask
from vijax.design.survey.motion_scores import MotionScores, SurveyMotions
from vijax.design.survey.orbit_candidates import OrbitCandidates
from vijax.model.device import Harvester


class FixedSummary(NamedTuple):
    """Summary with fixed periods and impacts; all orbits are of different kinds."""

    period: np.ndarray
    impacts_left: np.ndarray
    impacts_right: np.ndarray


class FixedPair(NamedTuple):
    """Pair with a fixed symmetry of its walls."""

    symmetric: np.ndarray


def make_motions(values, margin=0.0):
    """Return motions of a device along kappa with the objectives and the margin to the limits."""
    count, nothing = len(values), None
    step, zero = np.arange(count), np.zeros(count, int)
    scores = MotionScores(np.log(values), np.broadcast_to(float(margin), count).copy())
    summary, pair = FixedSummary(1 + step, zero + 1, zero + 1), FixedPair(np.ones(count, bool))
    unused: Any = nothing
    return SurveyMotions(unused, scores, pair, summary, unused, step[:, None] / 10, zero, zero, step)


@pytest.fixture
def survey(monkeypatch):
    """Make candidates of orbits and other motion by their objectives; `take` returns the selected objectives."""
    monkeypatch.setattr(orbit_candidates, "record_orbits", lambda *_: None)
    box = np.array([[[0.0], [5.0]]])

    def make(orbits, others, alone=False, **settings):
        effort = Effort(256, 8, 16, 200, DesignSettings(**settings))
        task = SurveyTask([Harvester()], ("kappa",), box, "P", effort)
        nothing: Any = None
        candidates = OrbitCandidates(SurveyResult(task, make_motions(orbits), make_motions(others), nothing), alone)

        def take(best=None):
            selection = candidates.take(None if best is None else np.log([best]))
            return selection and [orbits[round(10 * z)] for z in selection.z[:, 0]]

        return take

    return make


def test_lower_orbits_are_climbed_if_other_motion_falls_below_its_score(survey):
    take = survey([4.0, 1.0, 3.0, 2.9], [5.0, 2.0])
    # Orbits below 0.7 of the score of aperiodic motion are excluded unless its verified objective is smaller.
    assert take() == [4.0]
    assert take(4.0) == [3.0, 2.9]
    assert take(4.0) is None
    assert take(1e-5) == [1.0]


def test_search_ends_if_the_verified_objective_reaches_the_score(survey):
    take = survey([4.0, 1.0, 3.0], [5.0])
    assert take() == [4.0]
    assert take(5.0) is None


def test_without_a_verified_design_all_orbits_are_climbed_by_score(survey):
    take = survey([1.0, 3.0, 2.0], [50.0], max_ascents=2)
    assert take() is None
    nothing = math.exp(-math.inf)
    with np.errstate(divide="ignore"):
        assert take(nothing) == [3.0, 2.0]
        assert take(nothing) == [1.0]


def test_periodic_search_ignores_scores_of_other_motion(survey):
    assert survey([1.0, 3.0], [50.0], alone=True)() == [1.0, 3.0]
