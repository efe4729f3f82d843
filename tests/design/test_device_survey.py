"""Candidates are the best motions of all kinds, narrow windows in chaos, and orbits just outside a limit."""

import dataclasses

import jax
import numpy as np
import pytest

from vijax.design import optimise
from vijax.design.design_settings import DesignSettings
from vijax.design.survey import device_survey, orbit_candidates
from vijax.design.survey.device_survey import Effort, SurveyTask
from vijax.design.survey.orbit_candidates import OrbitCandidates
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair


def device(d, r, A, omega):
    unit = Harvester(A=A, omega=omega, r=r)
    return dataclasses.replace(unit, s=d * unit.length_unit)


# Best orbits from a scan of 2,000 values of kappa: 3:3/2T in chaos, for kappa from 22.83 to 22.95; 4:7/4T, within the
# penetration limit from kappa 51.8 to its flip at a slightly larger kappa.
IN_CHAOS = device(0.073195, 0.854762, 2.460536, 9.218106)
NEAR_LIMIT = device(0.123487, 0.510445, 2.045754, 4.755139)


def run_survey(devices, box, effort, orbits_only=True):
    """Return the candidates for ascents along kappa, the other motions, and the summary of each device."""
    survey = device_survey.survey_devices(SurveyTask(devices, ("kappa",), box, "P", effort), orbits_only=orbits_only)
    return OrbitCandidates(survey, orbits_only).take(None), survey.others, survey.summaries


def survey_candidates(harvester, low, high, steps, starts, periods=200):
    """Return the candidates between two kappa, their kinds (period, more and fewer impacts), and their kappa."""
    bounds = {"kappa": (low, high)}
    box = optimise.validate_bounds([harvester], ("kappa",), bounds, "P", ())
    candidates, _, summaries = run_survey([harvester], box, Effort(steps, starts, 16, periods))
    left, right = ((candidates.orbits.side == side).sum(axis=1) for side in (-1, 1))
    kinds = np.column_stack([candidates.orbits.span / 2, np.maximum(left, right), np.minimum(left, right)]).astype(int)
    assert summaries[0].orbits >= len(kinds)
    return candidates, kinds, np.asarray(candidates.orbits.pair.kappa)


def test_a_narrow_window_in_chaos_is_detected():
    low, high, steps = 22.6, 23.2, 2
    assert not ((np.geomspace(low, high, steps) > 22.8) & (np.geomspace(low, high, steps) < 23)).any()
    # The window contains a dozen cells. Three quarters of starts leave chaotic transients within 1,000 periods.
    _, kinds, kappa = survey_candidates(IN_CHAOS, low, high, steps, 32, 1000)
    window = (kinds == (2, 3, 3)).all(axis=1)
    assert (np.abs(kappa[window] - 22.89) < 0.07).any()


def test_a_long_orbit_just_outside_a_limit_is_a_candidate():
    candidates, kinds, kappa = survey_candidates(NEAR_LIMIT, 48.5, 64.0, 5, 4)
    depth = np.nanmax(candidates.orbits.depth, axis=1) * NEAR_LIMIT.length_unit / NEAR_LIMIT.depth_limit
    long = (kinds == (4, 7, 4)).all(axis=1)
    assert (long & (depth > 1)).any()
    assert (depth[~long] < 1).any()
    assert (kappa[long] < 51.9).all()


@pytest.mark.parametrize(("reach", "chosen"), [(3, [1, 4, 5, 6]), (2, [0, 1, 4, 5, 6])])
def test_only_the_best_of_a_kind_within_reach_is_selected(reach, chosen):
    kind = np.array([[0, 1], [0, 1], [0, 1], [0, 1], [0, 1], [0, 2], [1, 1]])
    step, score = np.array([0, 3, 4, 20, 20, 3, 3]), np.array([1.0, 3.0, 2.0, 5.0, 6.0, 0.0, 0.0])
    np.testing.assert_array_equal(orbit_candidates.select_local_maxima(kind, step, score, reach), chosen)


def test_early_rejection_does_not_change_the_candidates():
    def starts(**settings):
        box = optimise.validate_bounds([NEAR_LIMIT], ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
        effort = Effort(128, 2, 16, 200)._replace(settings=DesignSettings(**settings))
        candidates, motions, _ = run_survey([NEAR_LIMIT], box, effort, orbits_only=False)
        return candidates.z, np.asarray(motions.summary.periods_run).sum()

    (early_z, early_periods), (late_z, late_periods) = starts(), starts(first_periods=200)
    np.testing.assert_array_equal(early_z, late_z)
    assert early_periods < 0.8 * late_periods


def test_survey_scans_the_first_quantity_at_evenly_spread_other_values():
    names, count = ("kappa", "d", "r"), 16
    bounds = {"kappa": (3.0, 400.0), "d": (0.04, 0.25), "r": (0.2, 0.8)}
    box = optimise.validate_bounds([NEAR_LIMIT], names, bounds, "P", ())
    effort = Effort(2, 1, 16, 10)._replace(settings=DesignSettings(survey_levels=count))
    task = SurveyTask([NEAR_LIMIT], names, box, "expected", effort)
    motions, _ = device_survey.survey_all_starts(task)
    low, high = box[0]
    places = np.unique(np.round((motions.z - low) / (high - low), 9), axis=0)
    assert len(places) == len(motions.z) == 2 * count == task.cells
    others = np.unique(places[:, 1:], axis=0)
    assert len(others) == count
    # No large interval is left without a value, also at the bounds, since motion there would remain undetected.
    np.testing.assert_allclose(np.sort(others[:, 0]), (np.arange(count) + 0.5) / count)
    assert np.diff(np.sort(others[:, 1]), prepend=0.0, append=1.0).max() < 2 / count


def test_starts_of_a_device_do_not_depend_on_other_devices():
    devices = [IN_CHAOS, NEAR_LIMIT]

    def survey_results(subset):
        box = optimise.validate_bounds(subset, ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
        candidates, _, summaries = run_survey(subset, box, Effort(128, 2, 16, 200))
        return [
            (candidates.orbits.pair.kappa[selected], candidates.orbits.impact_unknowns[selected], summaries[i].orbits)
            for i in range(len(subset))
            for selected in [candidates.device_index == i]
        ]

    together = survey_results(devices)
    assert all(len(kappa) for kappa, *_ in together)
    for device, expected in zip(devices, together, strict=True):
        for actual, reference in zip(survey_results([device])[0], expected, strict=True):
            np.testing.assert_array_equal(actual, reference)


def test_half_of_the_starts_in_a_wide_gap_have_up_to_the_largest_speed():
    numbers = np.arange(40)
    d = np.where(numbers < 20, 0.3, 4.0)
    pair = ImpactPair(d, np.full(40, 50.0), np.full(40, 0.8), np.zeros(40))
    starts = device_survey._draw_starts(pair, numbers, 64, 0)
    speed = np.abs(starts.v)
    assert speed[d < 1].max() <= 0.6
    assert speed[(d > 1) & (numbers % 2 == 0)].max() <= 0.6
    # The forcing adds at most 2/pi from wall to wall, and an impact removes a fifth of the speed.
    assert 0.6 < speed[d > 1].max() <= 2 / np.pi / 0.2
    assert (np.abs(starts.u) <= 0.49 * d).all()
    # Further draws do not change the first ones.
    more = device_survey._draw_starts(*jax.tree.map(lambda x: np.tile(x, 2), (pair, numbers)), 64, 0)
    np.testing.assert_array_equal(more.v[:40], starts.v)


def test_wide_gaps_need_more_starts_and_longer_simulations():
    devices = [device(d, 0.5, 2.0, 5.0) for d in (0.3, 1.3, 5.0, 40.0)]
    box = optimise.validate_bounds(devices, ("kappa",), {"kappa": (2.0, 400.0)}, "P", ())
    task = SurveyTask(devices, ("kappa",), box, "P", Effort(128, 2, 16, 200))
    np.testing.assert_array_equal(task.total_starts, 256 * np.array([1, 2, 8, 8]))
    assert task.max_total_periods == 200 * 256 * (1 + 2 * 2 + 8 * 8 + 8 * 64)
    estimate = optimise.estimate_survey(task)
    assert estimate.cells == 256 * 19
