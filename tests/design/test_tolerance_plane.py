"""What bounds an optimum in the plane of two tolerances, against branches that are followed to it."""

import dataclasses

import numpy as np
import pytest

import vijax
from benchmarks.malformed import an_optimum
from vijax.design import report_lines, tolerance_plane
from vijax.design.tolerance import Tolerance
from vijax.model.device import with_pair
from vijax.orbits import orbit_search, switching

# The small device of the documentation at its optimum, whose orbit ends in a fold 7.8 % below.
PAIR = vijax.impact_pair(0.2, 4.0071261, 0.5)
DEVICE = with_pair(vijax.Harvester(A=3.0, omega=10 * np.pi, V=1700.0), PAIR)
BOTH = (Tolerance("omega0", 0.05), Tolerance("s", 0.02))


@pytest.fixture(scope="module")
def plane():
    found = orbit_search.search(PAIR, "RL", guesses=32)
    attracts = np.abs(np.asarray(found.multipliers)).max(axis=1).argmin()
    optimum = dataclasses.replace(an_optimum(), orbit=found[attracts : attracts + 1], device=DEVICE)
    return vijax.design_plane(optimum, BOTH)


def test_the_nearest_bifurcation_is_where_a_branch_meets_it(plane):
    near = plane.nearest
    # Of the two folds that meet in a cusp beside the optimum, the one below it in omega0 is its own orbit's; the other
    # one, which is nearer, is that of another orbit, and within the tolerances the motion lasts.
    assert near.kind == "fold"
    assert near.percent[0] < 0 < near.percent[1]
    assert near.times > 1
    away = [abs(off) / (100 * one.spread) for off, one in zip(near.percent, BOTH, strict=True)]
    assert max(away) == pytest.approx(near.times, rel=1e-9)
    # Along omega0 alone the fold is 7.8 % off; where the gap may be off too, it is nearer.
    assert 0 < near.times < 7.81 / 5
    device = dataclasses.replace(DEVICE, s=near.values[1])
    start = orbit_search.search(device.pair(), "RL", guesses=32)
    branches = switching.family(start, "omega0", (30.0, 60.0), device=device, max_switches=0)
    folds = [point.value for branch in branches for point in branch.points if point.kind == "fold"]
    # Between two points of the curve the nearest one is on the straight line.
    assert min(abs(value / near.values[0] - 1) for value in folds) < 1e-4


@pytest.mark.long
def test_the_report_says_how_far_it_is(plane):
    told = {
        "names": ["omega0", "s"],
        "spreads": [0.05, 0.02],
        "within": plane.within,
        "curves": len(plane.curves),
        "nearest": plane.nearest._asdict(),
        "limit": None,
    }
    first, second, third = report_lines._in_plane(told)
    assert "in the plane of omega0 +-5 % and s +-2 %" in first
    assert f"nearest bifurcation: fold, {plane.nearest.times:.3g} times the tolerances away" in second
    assert "nearest limit: none within omega0" in third


@pytest.mark.parametrize(
    ("piece", "place"),
    [
        (((2.0, -3.0), (0.0, 6.0)), (2.0, 0.0)),  # across an axis
        (((1.0, 4.0), (3.0, -3.0)), (2.5, 2.5)),  # where both are as large
        (((5.0, 1.0), (1.0, 1.0)), (5.0, 1.0)),  # its end
        (((2.0, 2.0), (0.0, 0.0)), (2.0, 2.0)),  # of no length
    ],
)
def test_the_box_of_the_tolerances_meets_a_piece_where_it_first_reaches_it(piece, place):
    begin, step = (np.array([row]) for row in piece)
    at, times, which = tolerance_plane._closest(begin, step)
    assert which == 0
    dense = begin + np.linspace(0, 1, 10_001)[:, None] * step
    assert times == pytest.approx(np.abs(dense).max(axis=1).min(), abs=1e-3)
    assert np.abs(at).max() == pytest.approx(max(map(abs, place)), abs=1e-12)
