"""A survey finds the attractors of a sweep as verified orbits and omits motions that are not periodic."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.design.survey.attractor_survey import gap_time_factor, simulate_survey
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import clearances, orbit_properties, periodic
from vijax.simulation.simulate import Starts

KAPPA = np.geomspace(3, 400, 64)


@pytest.fixture(scope="module")
def survey():
    """Survey along kappa at d = 0.2, and at d = 0.12, where chaos occurs; it has more cells than a tile."""
    d, kappa, u0 = (x.ravel() for x in np.broadcast_arrays(*np.ix_([0.2, 0.12], KAPPA, np.linspace(-0.05, 0.05, 9))))
    pair = ImpactPair(d, kappa, np.full(d.size, 0.5), np.zeros(d.size))
    device = jax.tree.map(lambda x: np.full(d.size, x), vijax.Harvester(penetration_limit=0.0063))
    survey_run = simulate_survey(
        pair, device, Starts(u0, np.full(d.size, -0.47898), np.zeros(d.size)), max_period=4, periods=400
    )
    return pair, survey_run, survey_run.orbits(8)


@pytest.fixture(scope="module")
def orbit(survey):
    """Orbits solved from the candidates of the survey."""
    *_, candidates = survey
    return periodic.solve(
        jax.tree.map(jnp.asarray, candidates.pair), candidates.sequence(8), jnp.asarray(candidates.impact_unknowns)
    )


def test_orbits_agree_with_a_sweep(survey, orbit):
    pair, _, candidates = survey
    # From kappa 5 on, d = 0.2 has one attractor, up to mirror images; nine starts reach it, and it is listed once.
    here = np.flatnonzero((pair.d[candidates.cell] == 0.2) & (pair.kappa[candidates.cell] > KAPPA[7]))
    np.testing.assert_array_equal(pair.kappa[candidates.cell[here]], KAPPA[8:])
    swept = vijax.sweep(d=0.2, kappa=KAPPA[8:], r=0.5, outputs=["P", "period"])
    np.testing.assert_allclose(orbit_properties.orbit_power(orbit[here], vijax.Harvester()), swept["P"], rtol=1e-7)
    np.testing.assert_array_equal(orbit_properties.counts(orbit[here]).period, swept["period"])


def test_simulated_attractors_agree_with_their_orbits_and_cells(survey, orbit):
    pair, _, candidates = survey
    assert (np.asarray(orbit.status) == Status.OK).all()
    assert (np.abs(np.asarray(orbit.multipliers)).max(axis=1) < 1).all()
    real = candidates.side != 0
    for name in ("depth", "work"):
        np.testing.assert_array_equal(np.isnan(getattr(candidates, name)), ~real)
        np.testing.assert_allclose(getattr(candidates, name)[real], np.asarray(getattr(orbit, name))[real], rtol=1e-6)
    np.testing.assert_array_equal(candidates.pair.kappa, pair.kappa[candidates.cell])
    np.testing.assert_array_equal(candidates.pair.d, pair.d[candidates.cell])
    assert (np.diff(candidates.cell) > 0).all()


def test_coexisting_attractors_are_detected(survey, orbit):
    pair, _, candidates = survey
    many = np.flatnonzero((pair.d[candidates.cell] == 0.2) & (pair.kappa[candidates.cell] == 3.0))
    power = np.asarray(orbit_properties.orbit_power(orbit[many], vijax.Harvester()))
    assert np.unique(np.round(1e9 * power)).size == many.size > 1


def test_chaos_has_no_orbit(survey):
    _, _, candidates = survey
    chaos = np.flatnonzero(swept("period") == 0)
    assert chaos.size
    assert not np.isin(chaos + KAPPA.size * 9, candidates.cell).any()


@functools.cache
def swept(name):
    return vijax.sweep(d=0.12, kappa=KAPPA, u0=np.linspace(-0.05, 0.05, 9), r=0.5)[name].values.ravel()


def test_non_orbit_cells_have_the_averages_of_a_sweep(survey):
    _, survey_run, candidates = survey
    chaos = np.flatnonzero(swept("period") == 0) + KAPPA.size * 9
    cells = survey_run.non_orbit_cells(8)
    assert set(chaos) <= set(cells)
    assert not np.isin(cells, candidates.cell).any()
    # The survey simulates the same cells with one device per cell; in another program chaos rounds differently.
    survey_power = survey_run.summary.P[chaos, 0]
    np.testing.assert_allclose(survey_power, swept("P")[chaos - KAPPA.size * 9], rtol=0.2)
    assert abs(survey_power.mean() / swept("P")[chaos - KAPPA.size * 9].mean() - 1) < 0.01
    assert (survey_run.summary.energy_ratio[chaos, 0] > 0).all()


def test_periods_of_a_survey_grow_with_the_time_to_cross_the_gap():
    np.testing.assert_array_equal(gap_time_factor([0.01, 1.19, 1.2, 2.3, 2.4, 9.7]), [1, 1, 2, 2, 4, 16])
    count = 4
    d, kappa = np.array([0.12, 3.0, 0.12, 3.0]), np.full(count, 200.0)
    pair = ImpactPair(d, kappa, np.full(count, 0.5), np.zeros(count))
    device = jax.tree.map(lambda x: np.full(count, x), vijax.Harvester(penetration_limit=0.0063))
    starts = Starts(np.zeros(count), np.array([0.3, 0.3, 0.2, 1e-9]), np.zeros(count))
    periods = 60 * gap_time_factor(d)
    survey_run = simulate_survey(pair, device, starts, max_period=4 * gap_time_factor(d), periods=periods)
    np.testing.assert_array_equal(survey_run.max_period, [4, 16, 4, 16])
    single_run = simulate_survey(*jax.tree.map(lambda x: x[1:2], (pair, device, starts)), max_period=16, periods=240)
    np.testing.assert_array_equal(survey_run.summary.P[1], single_run.summary.P[0])
    aperiodic = np.asarray(survey_run.summary.period) <= 0
    assert (survey_run.summary.periods_run[aperiodic] >= periods[aperiodic]).all()
    # A ball without an impact in a wide gap counts as a non-orbit cell.
    assert survey_run.summary.status[3] == Status.NO_IMPACT
    assert 3 in survey_run.non_orbit_cells(8)


def test_clearances_agree_with_the_motion_between_impacts(orbit):
    subset = orbit[np.arange(0, len(orbit), 61)]
    sequence, impact_unknowns = subset.sequence, jnp.nan_to_num(subset.impact_unknowns)
    clearance = jax.jit(jax.vmap(clearances.interior_motion))(subset.pair, sequence, impact_unknowns).clearance
    assert (np.stack(clearance) > 0).all()
    _, u, _ = orbit_properties.orbit_path(subset, samples=2001)
    for index in range(len(subset)):
        half = 0.5 * float(subset.pair.d[index])
        pieces = u[index].reshape(-1, 2001)[: 2 * int(subset.count[index])]
        turns = [half - x for piece in pieces[1::2] for x in _turning(piece)]
        expected = min([*turns, 1.0])
        assert float(clearance.flight[index]) == pytest.approx(expected, abs=1e-6)


def _turning(u):
    """Return the turning points of a sampled flight: maxima, and minima with reversed sign."""
    step = np.diff(u)
    places = np.flatnonzero(step[1:] * step[:-1] < 0) + 1
    return [u[i] if step[i - 1] > 0 else -u[i] for i in places]
