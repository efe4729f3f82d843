"""The best design has the highest verified objective of all rounds, and dropped candidates are reported."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vijax.design import design_search
from vijax.design.aperiodic.ensemble import DesignTask
from vijax.design.design_settings import DesignSettings
from vijax.design.optimum import DroppedCandidate, VerifiedOptima
from vijax.design.survey.device_survey import Effort
from vijax.model.device import Harvester

NOTHING: Any = None


def optimum(height, z=0.0):
    return SimpleNamespace(objective_value=height, z=np.array([z]), best=height)


def dropped(predicted):
    return DroppedCandidate({"kappa": 1.0}, "1:1", predicted, math.nan, "the orbit repels")


@pytest.fixture
def run_search(monkeypatch):
    """Run a search with replaced results; return the search, the best objective before each round, and mixture flags.

    Args:
        orbits: Heights that the ascents of each round verify; None if no orbit remains.
        others: Heights that the long simulations of each round verify; the last one is for mixtures.
        lost: Predicted heights of the dropped candidates.
    """

    def run(orbits, others, lost=(), **settings):
        best_logs: list[Any] = []
        mixed: list[bool] = []
        orbit_heights, confirmed_heights = iter(orbits), iter(others)

        def take(best_log):
            best_logs.append(None if best_log is None else best_log[0])
            heights = next(orbit_heights)
            return None if heights is None else SimpleNamespace(device_index=np.zeros(1, int), heights=heights)

        def climb(_task, candidates, *_):
            return VerifiedOptima([[optimum(x) for x in candidates.heights]], [[dropped(x) for x in lost]])

        def confirm(_task, _places, _best_log, *, mixtures=False):
            mixed.append(mixtures)
            height = next(confirmed_heights)
            return [optimum(height) if height else None], [[]]

        survey = SimpleNamespace(others=NOTHING, summaries=["met"])
        monkeypatch.setattr(design_search, "survey_devices", lambda *_, **__: survey)
        monkeypatch.setattr(design_search, "OrbitCandidates", lambda *_: SimpleNamespace(take=take))
        place = SimpleNamespace(device_index=0)
        places = SimpleNamespace(take=lambda *_: [place])
        monkeypatch.setattr(design_search, "PlaceCandidates", lambda *_: places)
        monkeypatch.setattr(design_search.orbit_ascents, "climb_orbits", climb)
        monkeypatch.setattr(design_search.aperiodic_search, "climb_places", lambda _task, chosen, _best_log: chosen)
        monkeypatch.setattr(design_search.design_confirmation, "confirm_designs", confirm)
        box = np.array([[[0.0], [5.0]]])
        task = DesignTask([Harvester()], ("kappa",), box, "P", (), 1.0, DesignSettings(**settings))
        (result,) = design_search.search_designs(task, Effort(2, 1, 2, 10, task.settings), NOTHING, 10, False)
        return result, best_logs, mixed

    return run


def test_best_design_is_the_highest_of_all_rounds(run_search):
    result, best_logs, mixed = run_search([[1.0], [6.0], None], [2.0, 0.0, 0.0], max_rounds=3)
    assert [design.objective_value for design in result.optima] == [6.0]
    assert best_logs == [None, pytest.approx(math.log(2.0)), pytest.approx(math.log(6.0))]
    assert (result.ascents, result.places, mixed) == (2, 3, [False] * 3)


def test_aperiodic_design_with_more_power_precedes_the_orbits(run_search):
    result, *_ = run_search([[1.0], None], [2.0, 0.0], max_rounds=2)
    assert [design.objective_value for design in result.optima] == [2.0, 1.0]


@pytest.mark.parametrize("most", [1, 2])
def test_number_of_rounds_is_limited(run_search, most):
    _, best_logs, _ = run_search([[1.0], [1.5], [1.7]], [0.0] * 3, max_rounds=most)
    assert len(best_logs) == most


def test_mixtures_count_only_without_another_design(run_search):
    result, _, mixed = run_search([None], [0.0, 0.5], max_rounds=1)
    assert mixed == [False, True]
    assert [design.objective_value for design in result.optima] == [0.5]


def test_candidates_predicted_above_the_best_are_reported(run_search):
    result, *_ = run_search([[1.0]], [2.0], lost=(1.5, 3.0, 4.0), max_rounds=1)
    assert [design.predicted for design in result.unconfirmed] == [4.0, 3.0]


def test_repeated_optimum_is_listed_once(run_search):
    result, *_ = run_search([[1.0], [1.0]], [0.0] * 2, max_rounds=2)
    assert len(result.optima) == 1
