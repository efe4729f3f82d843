"""The best design is the highest that was verified, whichever turn verified it, and what was dropped is reported."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vijax.design import turns
from vijax.design.design_settings import DesignSettings
from vijax.design.ensemble import Task
from vijax.design.multistart import Effort
from vijax.design.optimum import DroppedCandidate, VerifiedOptima
from vijax.model.device import Harvester

NOTHING: Any = None


def optimum(height, z=0.0):
    return SimpleNamespace(height=height, z=np.array([z]), best=height)


def dropped(predicted):
    return DroppedCandidate({"kappa": 1.0}, "1:1", predicted, math.nan, "the orbit repels")


@pytest.fixture
def searched(monkeypatch):
    """Search with a survey and turns that give what is asked for; what was known in each turn, and the search.

    Args:
        orbits: Heights that the ascents of each turn verify, None where no orbit is left.
        others: Heights that the long flights of each turn verify; the last one is for mixtures.
        lost: Predicted heights of what they drop.
    """

    def made(orbits, others, lost=(), **settings):
        seen: list[Any] = []
        mixed: list[bool] = []
        left, flights = iter(orbits), iter(others)

        def take(known):
            seen.append(None if known is None else known[0])
            heights = next(left)
            return None if heights is None else SimpleNamespace(owner=np.zeros(1, int), heights=heights)

        def climb(_task, begun, *_):
            return VerifiedOptima([[optimum(x) for x in begun.heights]], [[dropped(x) for x in lost]])

        def prove(_task, _places, _known, *, mixtures=False):
            mixed.append(mixtures)
            height = next(flights)
            return [optimum(height) if height else None], [[]]

        found = SimpleNamespace(others=NOTHING, looked=["met"])
        monkeypatch.setattr(turns, "find", lambda *_, **__: found)
        monkeypatch.setattr(turns, "OrbitCandidates", lambda *_: SimpleNamespace(take=take))
        place = SimpleNamespace(owner=0)
        places = SimpleNamespace(take=lambda *_: [place])
        monkeypatch.setattr(turns, "PlaceCandidates", lambda *_: places)
        monkeypatch.setattr(turns.orbit_ascents, "search", climb)
        monkeypatch.setattr(turns.aperiodic_search, "search", lambda _task, chosen, _known: chosen)
        monkeypatch.setattr(turns.long_flight, "prove", prove)
        box = np.array([[[0.0], [5.0]]])
        task = Task([Harvester()], ("kappa",), box, "P", (), 1.0, DesignSettings(**settings))
        (one,) = turns.search(task, Effort(2, 1, 2, 10, task.settings), NOTHING, 10, False)
        return one, seen, mixed

    return made


def test_the_best_design_is_the_highest_of_all_turns(searched):
    one, seen, mixed = searched([[1.0], [6.0], None], [2.0, 0.0, 0.0], max_turns=3)
    assert [each.height for each in one.optima] == [6.0]
    assert seen == [None, pytest.approx(math.log(2.0)), pytest.approx(math.log(6.0))]
    assert (one.ascents, one.places, mixed) == (2, 3, [False] * 3)


def test_other_motion_that_gives_more_stands_before_the_orbits(searched):
    one, *_ = searched([[1.0], None], [2.0, 0.0], max_turns=2)
    assert [each.height for each in one.optima] == [2.0, 1.0]


@pytest.mark.parametrize("most", [1, 2])
def test_turns_are_counted(searched, most):
    _, seen, _ = searched([[1.0], [1.5], [1.7]], [0.0] * 3, max_turns=most)
    assert len(seen) == most


def test_mixtures_count_where_nothing_else_is_a_design(searched):
    one, _, mixed = searched([None], [0.0, 0.5], max_turns=1)
    assert mixed == [False, True]
    assert [each.height for each in one.optima] == [0.5]


def test_what_promised_more_than_the_best_is_reported(searched):
    one, *_ = searched([[1.0]], [2.0], lost=(1.5, 3.0, 4.0), max_turns=1)
    assert [each.predicted for each in one.lost] == [4.0, 3.0]


def test_one_optimum_of_two_turns_is_told_once(searched):
    one, *_ = searched([[1.0], [1.0]], [0.0] * 2, max_turns=2)
    assert len(one.optima) == 1
