"""The cubic coefficient at flips and pitchforks: its sign against trajectories, its value against a normal form.

`benchmarks/criticality.py` drew the cases, of soft, rigid and inclined walls, and computed the trajectories.
"""

import jax
import numpy as np
import pytest

from benchmarks import criticality
from tests.helpers import cases
from vijax.model.records import Status
from vijax.orbits import periodic, switching
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.events import Point

KEPT = criticality.kept()
GROUPS = [(kind, walls) for kind in ("flip", "pitchfork") for walls in ("soft", "rigid")]


def name(case):
    return f"{case.kind} {case.walls} {case.coefficient:.6g}"


BY_NAME = {name(case): case for case in KEPT}
# The normal form of one case of each group and side is computed in every run, of the others in long runs alone.
FEW = {(case.kind, case.walls, case.beyond): name(case) for case in reversed(KEPT)}


@pytest.fixture(scope="module")
def found():
    return criticality.coefficients(KEPT)


def test_there_are_flips_and_pitchforks_of_all_kinds_of_wall():
    assert {group: sum((case.kind, case.walls) == group for case in KEPT) for group in GROUPS} == dict.fromkeys(
        GROUPS, 15
    )
    assert sum(case.gamma != 0 for case in KEPT) >= 5


def test_the_sign_says_on_which_side_others_begin_and_whether_they_attract(found):
    for case, coefficient in zip(KEPT, found, strict=True):
        assert (coefficient > 0) == case.beyond == case.attracts, name(case)


def test_the_value_is_that_of_the_normal_form_in_50_digits(found):
    np.testing.assert_allclose(found, [case.coefficient for case in KEPT], rtol=1e-6)


@pytest.mark.parametrize("case", cases(BY_NAME, long=tuple(one for one in BY_NAME if one not in FEW.values())))
def test_the_normal_form_is_the_kept_one(case):
    assert criticality.normal_form(BY_NAME[case]) == pytest.approx(BY_NAME[case].coefficient, rel=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("case", BY_NAME)
def test_balls_say_what_they_have_said(case):
    told = criticality.verdict(BY_NAME[case])
    assert (told.beyond, told.attracts) == (BY_NAME[case].beyond, BY_NAME[case].attracts)


@pytest.mark.long
@pytest.mark.parametrize("case", BY_NAME)
def test_doubled_orbits_and_mirror_pairs_lie_where_the_sign_says(case):
    """By branches: their multipliers, and the side of the bifurcation on which the simple orbit repels."""
    own = BY_NAME[case]
    pair, sequence, knots = criticality.orbits([own])
    count = len(own.side)
    sequence = jax.tree.map(lambda leaf: leaf[:, :count] if leaf.ndim == 2 else leaf, sequence)
    orbit = periodic.proven(pair, sequence, knots[:, :count])
    value = float(np.asarray(getattr(pair, own.along))[0])
    assert orbit.status[0] == Status.OK
    point = Point(own.kind, value, orbit)
    settings = ContinuationSettings(first_step=1e-4, max_grazings=0)
    low, high = sorted((0.9 * value, 1.1 * value))
    within = low, min(high, criticality.MOST.get(own.along, high))
    for branch in switching.switch(point, own.along, within, points=4, settings=settings):
        away = branch.values[-1] - value
        repels = criticality.beside(own, criticality.EXCESS[-1]).pair
        beyond = np.sign(away) == np.sign(float(np.asarray(getattr(repels, own.along))[0]) - value)
        assert bool(beyond) == own.beyond
        assert bool(branch.stable[-1]) == own.attracts
