"""Designs: the small fast device's optimum, the admissible one of the paper's, cliffs, tolerances, what is refused."""

import dataclasses
import math

import jax
import numpy as np
import pytest

import vijax
from vijax import design
from vijax.model import Harvester, Status
from vijax.surroundings import surroundings, weighted
from vijax.tolerance import Tolerance

FAST = Harvester(A=3.0, omega=10 * math.pi, V=1700.0)
FAST = dataclasses.replace(FAST, s=0.2 * FAST.length_unit)
PAPER = Harvester(s=0.2)


def kappa(optimum):
    return optimum.device.omega0 * math.pi / optimum.device.omega


@pytest.fixture(scope="module")
def found():
    """Both devices in one call."""
    return design.optimise_all([FAST, PAPER], balls=2)


def test_the_small_fast_device(found):
    best = found[0].best
    assert kappa(best) == pytest.approx(4.00713, abs=1e-5)
    assert best.height == pytest.approx(57.75761e-6, rel=1e-7)
    assert float(best.state.depth.max()) == pytest.approx(6.026e-3, abs=1e-6)
    assert float(best.state.multiplier) == pytest.approx(0.533, abs=1e-3)
    assert (best.stopped, best.active, best.label) == ("maximum", (), "1:1")
    assert abs(best.gradient["omega0"]) < 1e-5


def test_the_papers_device_is_held_by_the_penetration_limit(found):
    best = found[1].best
    assert kappa(best) == pytest.approx(64.669, abs=1e-3)
    deepest = float(best.state.depth.max())
    assert deepest <= PAPER.depth_limit
    assert deepest == pytest.approx(PAPER.depth_limit, rel=1e-6)
    assert len(best.active) == 1
    assert "penetration limit" in best.active[0]
    # It would gain by breaking it.
    assert best.gradient["omega0"] < -1


def test_every_optimum_is_admissible_attracting_and_what_a_simulation_says(found):
    for one in [optimum for each in found for optimum in each.optima]:
        state = one.state
        assert (state.energy <= state.work).all()
        assert (state.depth <= one.device.depth_limit).all()
        assert state.multiplier < 1
        assert int(one.orbit.status[0]) == Status.OK
        assert one.looks <= 60
        assert all(math.isfinite(x) for x in (*one.values.values(), *one.gradient.values(), one.height))
        low, high = found[0].bounds["omega0"] if one.device.omega > 20 else found[1].bounds["omega0"]
        assert low <= one.values["omega0"] <= high
    best = found[0].best
    swept = vijax.sweep(
        d=0.2, kappa=kappa(best), r=0.5, device=best.device, v0=np.array([-0.47898, 0.25]), outputs=["P", "admissible"]
    )
    assert float(swept["P"].max()) == pytest.approx(best.height, rel=1e-9)
    assert bool(swept["admissible"].all())


def test_paths_rise_and_begin_at_an_attractor(found):
    for one in found[0].optima:
        assert one.path.shape == (one.heights.size, 1)
        assert one.heights[-1] == one.height
    best = found[0].best
    assert best.heights[-1] > best.heights[0]
    # What never falls is the height with the barrier, whose weight is 0.03 at first.
    assert (np.diff(best.heights) > -0.02 * best.height).all()
    assert best.heights.argmax() >= len(best.heights) - 2


def test_a_supremum_is_no_maximum(found):
    # Another 1:1 orbit of the device ends in a fold while it rises.
    ends = [one for one in found[0].optima if one.stopped == "supremum"]
    assert ends
    assert all(one.height < found[0].best.height for one in ends)


def test_tolerances_of_a_design(found):
    best = found[0].best
    narrow = design.under(best, [Tolerance("omega0", 0.05)])
    assert narrow.lost == narrow.inadmissible == 0
    assert narrow.worst < narrow.mean < best.height
    # The orbit ends 7.8 % below: of a wider distribution some devices fall off.
    wide = design.under(best, [Tolerance("omega0", 0.1)])
    assert wide.lost == pytest.approx((0.1 - 0.078) / 0.2, abs=0.06)
    assert wide.worst == 0


@pytest.mark.slow
def test_what_lies_around(found):
    around = surroundings(found[0].best, starts=32)
    assert around.below.kind == "fold"
    assert around.below.percent == pytest.approx(-7.81, abs=0.05)
    assert (around.above.kind, around.above.percent) == ("none", pytest.approx(50))
    assert around.attractors[0].label == "1:1"
    assert around.share > 0.9
    assert sum(one.share for one in around.attractors) == pytest.approx(1)


@pytest.mark.slow
def test_the_worst_case_design_gives_up_nominal_power_for_it(found):
    tolerance = [Tolerance("omega0", 0.05)]
    robust = design.optimise(
        FAST, objective="worst", tolerances=tolerance, bounds={"omega0": (38.0, 45.0)}, balls=1
    ).best
    nominal = found[0].best
    assert robust.height > design.under(nominal, tolerance).worst
    assert float(robust.state.P) < nominal.height
    assert design.under(robust, tolerance).worst == pytest.approx(robust.height, rel=1e-12)
    # At the kink both ends of the tolerance yield alike: no step along kappa raises both.
    assert robust.values["omega0"] > nominal.values["omega0"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"objective": "energy"}, "objective must be among P, power"),
        ({"objective": "mean"}, "tolerances must be given with"),
        ({"tolerances": [Tolerance("omega0", 0.05)]}, "tolerances must come with objective mean or worst"),
        ({"tune": ("omega0", "k")}, "must name a quantity once"),
        ({"bounds": {"r": (0.1, 0.2)}}, "bounds must be those of a tuned quantity"),
        ({"looks": 1}, "looks must be a whole number of at least 2"),
        ({"balls": 0}, "balls must be a whole number of at least 1"),
    ],
)
def test_bad_input_is_told(settings, words):
    with pytest.raises(ValueError, match=words):
        design.optimise(FAST, **settings)


def test_devices_that_cannot_be_designed_are_told():
    with pytest.raises(ValueError, match="must hold at least one"):
        design.optimise_all([])
    with pytest.raises(ValueError, match="V must not be zero"):
        design.optimise(dataclasses.replace(FAST, V=0.0))
    with pytest.raises(ValueError, match="give many devices as a list"):
        design.optimise(jax.tree.map(lambda x: np.full(2, x), FAST))


@pytest.mark.slow
def test_weighing_basins_moves_away_from_where_few_starts_lead(found):
    nominal = found[0].best
    best = weighted(found[0], starts=16)
    around = surroundings(nominal, starts=16)
    assert best.height >= float(nominal.state.P) * around.share
    assert best.height <= float(best.state.P) * (1 + 1e-9)
    assert int(best.orbit.status[0]) == Status.OK
    assert best.label == nominal.label
    low, high = found[0].bounds["omega0"]
    assert low <= best.values["omega0"] <= high
