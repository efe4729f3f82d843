"""Designs set out from the best of every kind, from narrow windows in chaos, and from orbits just beyond a limit."""

import dataclasses

import jax
import numpy as np
import pytest

from vijax.design import candidates, multistart, optimise
from vijax.design.candidates import OrbitCandidates
from vijax.design.design_settings import DesignSettings
from vijax.design.multistart import Effort, SurveyTask
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair


def device(d, r, A, omega):
    unit = Harvester(A=A, omega=omega, r=r)
    return dataclasses.replace(unit, s=d * unit.length_unit)


# Their best orbits by a scan of 2,000 kappa: 3:3/2T from kappa 22.83 to 22.95 in chaos; 4:7/4T, within the penetration
# limit from kappa 51.8 on, to its flip soon after.
IN_CHAOS = device(0.073195, 0.854762, 2.460536, 9.218106)
BEYOND = device(0.123487, 0.510445, 2.045754, 4.755139)


def surveyed(devices, box, effort, orbits_alone=True):
    """Where ascents along kappa begin, other motion, and what was met of each device."""
    found = multistart.find(SurveyTask(devices, ("kappa",), box, "P", effort), orbits_alone=orbits_alone)
    return OrbitCandidates(found, orbits_alone).take(None), found.others, found.looked


def found(given, low, high, steps, balls, periods=200):
    """What `find` finds between two kappa: the starts, their kinds (period, more and fewer impacts), their kappa."""
    bounds = {"kappa": (low, high)}
    box = optimise.check([given], ("kappa",), bounds, "P", ())
    met, _, looked = surveyed([given], box, Effort(steps, balls, 16, periods))
    left, right = ((met.flown.side == side).sum(axis=1) for side in (-1, 1))
    kinds = np.column_stack([met.flown.span / 2, np.maximum(left, right), np.minimum(left, right)]).astype(int)
    assert looked[0].orbits >= len(kinds)
    return met, kinds, np.asarray(met.flown.pair.kappa)


def test_a_narrow_window_in_chaos_is_met():
    low, high, steps = 22.6, 23.2, 2
    assert not ((np.geomspace(low, high, steps) > 22.8) & (np.geomspace(low, high, steps) < 23)).any()
    # A dozen cells are within it, and three quarters of starts have left chaos after a thousand periods.
    _, kinds, kappa = found(IN_CHAOS, low, high, steps, 32, 1000)
    window = (kinds == (2, 3, 3)).all(axis=1)
    assert (np.abs(kappa[window] - 22.89) < 0.07).any()


def test_a_long_orbit_just_beyond_a_limit_is_climbed_from():
    met, kinds, kappa = found(BEYOND, 48.5, 64.0, 5, 4)
    depth = np.nanmax(met.flown.depth, axis=1) * BEYOND.length_unit / BEYOND.depth_limit
    long = (kinds == (4, 7, 4)).all(axis=1)
    assert (long & (depth > 1)).any()
    assert (depth[~long] < 1).any()
    assert (kappa[long] < 51.9).all()


@pytest.mark.parametrize(("reach", "chosen"), [(3, [1, 4, 5, 6]), (2, [0, 1, 4, 5, 6])])
def test_only_the_best_of_a_kind_within_reach_climbs(reach, chosen):
    kind = np.array([[0, 1], [0, 1], [0, 1], [0, 1], [0, 1], [0, 2], [1, 1]])
    step, score = np.array([0, 3, 4, 20, 20, 3, 3]), np.array([1.0, 3.0, 2.0, 5.0, 6.0, 0.0, 0.0])
    np.testing.assert_array_equal(candidates.highest(kind, step, score, reach), chosen)


def test_giving_up_early_loses_no_start_that_may_win():
    def starts(**settings):
        box = optimise.check([BEYOND], ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
        far = Effort(128, 2, 16, 200)._replace(settings=DesignSettings(**settings))
        begun, unrest, _ = surveyed([BEYOND], box, far, orbits_alone=False)
        return begun.z, np.asarray(unrest.ended.periods_run).sum()

    (soon, flown), (late, more) = starts(), starts(first_periods=200)
    np.testing.assert_array_equal(soon, late)
    assert flown < 0.8 * more


def test_a_survey_looks_along_the_first_quantity_at_values_of_the_others_that_lie_evenly():
    names, count = ("kappa", "d", "r"), 16
    bounds = {"kappa": (3.0, 400.0), "d": (0.04, 0.25), "r": (0.2, 0.8)}
    box = optimise.check([BEYOND], names, bounds, "P", ())
    far = Effort(2, 1, 16, 10)._replace(settings=DesignSettings(survey_levels=count))
    task = SurveyTask([BEYOND], names, box, "expected", far)
    met, _ = multistart.every_start(task)
    low, high = box[0]
    places = np.unique(np.round((met.z - low) / (high - low), 9), axis=0)
    assert len(places) == len(met.z) == 2 * count == task.cells
    others = np.unique(places[:, 1:], axis=0)
    assert len(others) == count
    # No motion may hide between two values, nor beyond the last one.
    np.testing.assert_allclose(np.sort(others[:, 0]), (np.arange(count) + 0.5) / count)
    assert np.diff(np.sort(others[:, 1]), prepend=0.0, append=1.0).max() < 2 / count


def test_starts_of_one_device_do_not_depend_on_the_others():
    devices = [IN_CHAOS, BEYOND]

    def of(some):
        box = optimise.check(some, ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
        met, _, looked = surveyed(some, box, Effort(128, 2, 16, 200))
        return [
            (met.flown.pair.kappa[own], met.flown.knots[own], looked[i].orbits)
            for i in range(len(some))
            for own in [met.owner == i]
        ]

    together = of(devices)
    assert all(len(kappa) for kappa, *_ in together)
    for device, beside in zip(devices, together, strict=True):
        for one, other in zip(of([device])[0], beside, strict=True):
            np.testing.assert_array_equal(one, other)


def test_every_other_ball_in_a_wide_gap_is_as_fast_as_the_forcing_can_keep_it():
    numbers = np.arange(40)
    d = np.where(numbers < 20, 0.3, 4.0)
    pair = ImpactPair(d, np.full(40, 50.0), np.full(40, 0.8), np.zeros(40))
    starts = multistart._starts(pair, numbers, 64, 0)
    speed = np.abs(starts.v)
    assert speed[d < 1].max() <= 0.6
    assert speed[(d > 1) & (numbers % 2 == 0)].max() <= 0.6
    # From wall to wall the forcing adds 2/pi at most, and an impact takes a fifth.
    assert 0.6 < speed[d > 1].max() <= 2 / np.pi / 0.2
    assert (np.abs(starts.u) <= 0.49 * d).all()
    # Further draws do not change the first ones.
    more = multistart._starts(*jax.tree.map(lambda x: np.tile(x, 2), (pair, numbers)), 64, 0)
    np.testing.assert_array_equal(more.v[:40], starts.v)


def test_wide_gaps_take_more_starts_and_longer_flights():
    devices = [device(d, 0.5, 2.0, 5.0) for d in (0.3, 1.3, 5.0, 40.0)]
    box = optimise.check(devices, ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
    task = SurveyTask(devices, ("kappa",), box, "P", Effort(128, 2, 16, 200))
    np.testing.assert_array_equal(task.balls, 256 * np.array([1, 2, 8, 8]))
    assert task.flown == 200 * 256 * (1 + 2 * 2 + 8 * 8 + 8 * 64)
    asked = optimise.expected(task)
    assert asked.cells == 256 * 19
