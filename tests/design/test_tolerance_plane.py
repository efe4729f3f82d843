"""The nearest bifurcation in the plane of two tolerances agrees with branches continued to it."""

import dataclasses

import numpy as np
import pytest

import vijax
from benchmarks.malformed import an_optimum
from vijax.continuation import branch_switching
from vijax.design import report_lines
from vijax.design.robustness import tolerance_plane
from vijax.design.robustness.tolerance import Tolerance
from vijax.model.device import with_pair
from vijax.orbits import orbit_search

# The small device of the documentation at its optimum. Its orbit ends in a fold 7.8 % below.
PAIR = vijax.impact_pair(0.2, 4.0071261, 0.5)
DEVICE = with_pair(vijax.Harvester(A=3.0, omega=10 * np.pi, V=1700.0), PAIR)
BOTH = (Tolerance("omega0", 0.05), Tolerance("s", 0.02))


@pytest.fixture(scope="module")
def plane():
    orbits = orbit_search.find_orbits(PAIR, "RL", guesses=32)
    attracts = np.abs(np.asarray(orbits.multipliers)).max(axis=1).argmin()
    optimum = dataclasses.replace(an_optimum(), orbit=orbits[attracts : attracts + 1], device=DEVICE)
    return vijax.tolerance_plane(optimum, BOTH)


def test_nearest_bifurcation_lies_at_the_fold_of_a_branch(plane):
    near = plane.nearest
    # Two folds meet in a cusp near the optimum. The fold below it in omega0 belongs to its orbit. The other fold is
    # nearer but belongs to another orbit, so the motion persists within the tolerances.
    assert near.kind == "fold"
    assert near.percent[0] < 0 < near.percent[1]
    assert near.factor > 1
    away = [abs(off) / (100 * tolerance.spread) for off, tolerance in zip(near.percent, BOTH, strict=True)]
    assert max(away) == pytest.approx(near.factor, rel=1e-9)
    # Along omega0 alone the fold is 7.8 % away; if the gap scatters, too, it is nearer.
    assert 0 < near.factor < 7.81 / 5
    device = dataclasses.replace(DEVICE, s=near.values[1])
    start = orbit_search.find_orbits(device.pair(), "RL", guesses=32)
    branches = branch_switching.follow_families(start, "omega0", (30.0, 60.0), device=device, max_switches=0)
    folds = [point.value for branch in branches for point in branch.points if point.kind == "fold"]
    # Between two points of the curve, the nearest point is computed on a straight line.
    assert min(abs(value / near.values[0] - 1) for value in folds) < 1e-4


@pytest.mark.long
def test_report_states_the_distance_of_the_bifurcation(plane):
    entry = {
        "names": ["omega0", "s"],
        "spreads": [0.05, 0.02],
        "bounds": plane.bounds,
        "curves": len(plane.curves),
        "nearest": plane.nearest._asdict(),
        "limit": None,
    }
    first, second, third = report_lines._plane_lines(entry)
    assert "in the plane of omega0 +-5 % and s +-2 %" in first
    assert f"nearest bifurcation: fold, {plane.nearest.factor:.3g} times the tolerances away" in second
    assert "nearest limit: none within omega0" in third


@pytest.mark.parametrize(
    ("piece", "place"),
    [
        (((2.0, -3.0), (0.0, 6.0)), (2.0, 0.0)),  # across an axis
        (((1.0, 4.0), (3.0, -3.0)), (2.5, 2.5)),  # equal distances along both axes
        (((5.0, 1.0), (1.0, 1.0)), (5.0, 1.0)),  # at the start of the segment
        (((2.0, 2.0), (0.0, 0.0)), (2.0, 2.0)),  # segment of length zero
    ],
)
def test_closest_point_of_a_segment_in_units_of_the_tolerances(piece, place):
    begin, step = (np.array([row]) for row in piece)
    at, factor, which = tolerance_plane._closest_point(begin, step)
    assert which == 0
    dense = begin + np.linspace(0, 1, 10_001)[:, None] * step
    assert factor == pytest.approx(np.abs(dense).max(axis=1).min(), abs=1e-3)
    assert np.abs(at).max() == pytest.approx(max(map(abs, place)), abs=1e-12)
