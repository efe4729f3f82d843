"""Orbits are climbed from in turns: another one follows where nothing was verified to give what was promised."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from vijax.design import candidates
from vijax.design.candidates import OrbitCandidates
from vijax.design.design_settings import DesignSettings
from vijax.design.multistart import Effort, SurveyResult, SurveyTask
from vijax.design.promise import Met, Promise
from vijax.model.device import Harvester


class Ended(NamedTuple):
    """In place of a summary: periods and impacts of every orbit, which are all of a kind of their own."""

    period: np.ndarray
    impacts_left: np.ndarray
    impacts_right: np.ndarray


class Level(NamedTuple):
    """In place of a pair: whether the walls may change places."""

    symmetric: np.ndarray


def met(values, lacks=0.0):
    """Motions of one device along kappa, by the objective and what they lack to the limits."""
    count, nothing = len(values), None
    step, zero = np.arange(count), np.zeros(count, int)
    hope = Promise(np.log(values), np.broadcast_to(float(lacks), count).copy())
    ended, level = Ended(1 + step, zero + 1, zero + 1), Level(np.ones(count, bool))
    some: Any = nothing
    return Met(some, hope, level, ended, some, step[:, None] / 10, zero, zero, step)


@pytest.fixture
def survey(monkeypatch):
    """Make candidates of orbits and other motion with given objectives; which orbits are taken is a list of them."""
    monkeypatch.setattr(candidates, "flown", lambda *_: None)
    box = np.array([[[0.0], [5.0]]])

    def made(orbits, others, alone=False, **settings):
        effort = Effort(256, 8, 16, 200, DesignSettings(**settings))
        task = SurveyTask([Harvester()], ("kappa",), box, "P", effort)
        nothing: Any = None
        taken = OrbitCandidates(SurveyResult(task, met(orbits), met(others), nothing), alone)

        def take(known=None):
            begun = taken.take(None if known is None else np.log([known]))
            return begun and [orbits[round(10 * z)] for z in begun.z[:, 0]]

        return take

    return made


def test_what_promises_too_little_is_climbed_where_the_promise_of_other_motion_is_broken(survey):
    take = survey([4.0, 1.0, 3.0, 2.9], [5.0, 2.0])
    # Orbits that give less than 0.7 of what aperiodic motion promises do not matter, unless it gives less.
    assert take() == [4.0]
    assert take(4.0) == [3.0, 2.9]
    assert take(4.0) is None
    assert take(1e-5) == [1.0]


def test_a_promise_that_is_kept_ends_the_search(survey):
    take = survey([4.0, 1.0, 3.0], [5.0])
    assert take() == [4.0]
    assert take(5.0) is None


def test_where_nothing_is_verified_all_orbits_are_climbed_the_most_promising_first(survey):
    take = survey([1.0, 3.0, 2.0], [50.0], max_ascents=2)
    assert take() is None
    nothing = math.exp(-math.inf)
    with np.errstate(divide="ignore"):
        assert take(nothing) == [3.0, 2.0]
        assert take(nothing) == [1.0]


def test_orbits_alone_are_measured_by_orbits_alone(survey):
    assert survey([1.0, 3.0], [50.0], alone=True)() == [1.0, 3.0]
