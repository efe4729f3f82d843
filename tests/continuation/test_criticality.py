"""The cubic coefficient at flips and pitchforks: its sign against trajectories, its value against a normal form.

`benchmarks/criticality.py` draws the cases, of soft, rigid and inclined walls, and computes the trajectories.
"""

import jax
import numpy as np
import pytest

from benchmarks import criticality
from tests.helpers import cases
from vijax.continuation import branch_switching
from vijax.continuation.branch_events import Point
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.model.records import Status
from vijax.orbits import periodic

STORED = criticality.stored_cases()
GROUPS = [(kind, walls) for kind in ("flip", "pitchfork") for walls in ("soft", "rigid")]


def name(case):
    return f"{case.kind} {case.walls} {case.coefficient:.6g}"


BY_NAME = {name(case): case for case in STORED}
# Every run computes the normal form of one case per group and side; long runs compute all of them.
SHORT_CASES = {(case.kind, case.walls, case.supercritical): name(case) for case in reversed(STORED)}


@pytest.fixture(scope="module")
def coefficients():
    return criticality.coefficients(STORED)


def test_there_are_flips_and_pitchforks_of_all_kinds_of_wall():
    assert {group: sum((case.kind, case.walls) == group for case in STORED) for group in GROUPS} == dict.fromkeys(
        GROUPS, 15
    )
    assert sum(case.gamma != 0 for case in STORED) >= 5


def test_sign_predicts_the_side_and_the_stability_of_the_new_orbits(coefficients):
    for case, coefficient in zip(STORED, coefficients, strict=True):
        assert (coefficient > 0) == case.supercritical == case.attracts, name(case)


def test_value_matches_the_normal_form_in_50_digits(coefficients):
    np.testing.assert_allclose(coefficients, [case.coefficient for case in STORED], rtol=1e-6)


@pytest.mark.parametrize(
    "case", cases(BY_NAME, long=tuple(label for label in BY_NAME if label not in SHORT_CASES.values()))
)
def test_normal_form_matches_the_stored_value(case):
    assert criticality.normal_form(BY_NAME[case]) == pytest.approx(BY_NAME[case].coefficient, rel=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("case", BY_NAME)
def test_simulations_repeat_the_stored_result(case):
    result = criticality.simulated_bifurcation(BY_NAME[case])
    assert (result.supercritical, result.attracts) == (BY_NAME[case].supercritical, BY_NAME[case].attracts)


@pytest.mark.long
@pytest.mark.parametrize("case", BY_NAME)
def test_doubled_orbits_and_mirror_pairs_lie_on_the_predicted_side(case):
    """Branches have the multipliers of the new orbits and lie on the repelling side of the simple orbit."""
    stored = BY_NAME[case]
    pair, sequence, impact_unknowns = criticality.orbits([stored])
    count = len(stored.side)
    sequence = jax.tree.map(lambda leaf: leaf[:, :count] if leaf.ndim == 2 else leaf, sequence)
    orbit = periodic.verify_solutions(pair, sequence, impact_unknowns[:, :count])
    value = float(np.asarray(getattr(pair, stored.along))[0])
    assert orbit.status[0] == Status.OK
    point = Point(stored.kind, value, orbit)
    settings = ContinuationSettings(first_step=1e-4, max_grazings=0)
    low, high = sorted((0.9 * value, 1.1 * value))
    within = low, min(high, criticality.MOST.get(stored.along, high))
    for branch in branch_switching.switch_branch(point, stored.along, within, points=4, settings=settings):
        offset = branch.values[-1] - value
        repels = criticality.orbit_near(stored, criticality.EXCESS[-1]).pair
        on_repelling_side = np.sign(offset) == np.sign(float(np.asarray(getattr(repels, stored.along))[0]) - value)
        assert bool(on_repelling_side) == stored.supercritical
        assert bool(branch.stable[-1]) == stored.attracts
