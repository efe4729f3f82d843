"""A survey finds the attractors that a sweep finds, as verified orbits, and leaves out what is none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.batch.simulate import Starts
from vijax.design.survey import stretch, survey
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import grazing, orbit_properties, periodic

KAPPA = np.geomspace(3, 400, 64)


@pytest.fixture(scope="module")
def found():
    """Along kappa at d = 0.2, and at d = 0.12, where chaos is; more cells than a tile holds."""
    d, kappa, u0 = (x.ravel() for x in np.broadcast_arrays(*np.ix_([0.2, 0.12], KAPPA, np.linspace(-0.05, 0.05, 9))))
    pair = ImpactPair(d, kappa, np.full(d.size, 0.5), np.zeros(d.size))
    device = jax.tree.map(lambda x: np.full(d.size, x), vijax.Harvester(penetration_limit=0.0063))
    ran = survey(pair, device, Starts(u0, np.full(d.size, -0.47898), np.zeros(d.size)), longest=4, periods=400)
    return pair, ran, ran.orbits(8)


@pytest.fixture(scope="module")
def orbit(found):
    """The orbits of what was flown."""
    *_, met = found
    return periodic.solve(jax.tree.map(jnp.asarray, met.pair), met.sequence(8), jnp.asarray(met.knots))


def test_orbits_are_those_of_a_sweep(found, orbit):
    pair, _, met = found
    # The only attractor at d = 0.2 from kappa 5 on, mirror images aside: nine starts meet it, it is there once.
    here = np.flatnonzero((pair.d[met.cell] == 0.2) & (pair.kappa[met.cell] > KAPPA[7]))
    np.testing.assert_array_equal(pair.kappa[met.cell[here]], KAPPA[8:])
    swept = vijax.sweep(d=0.2, kappa=KAPPA[8:], r=0.5, outputs=["P", "period"])
    np.testing.assert_allclose(orbit_properties.power(orbit[here], vijax.Harvester()), swept["P"], rtol=1e-7)
    np.testing.assert_array_equal(orbit_properties.counts(orbit[here]).period, swept["period"])


def test_attractors_are_flown_as_their_orbits_are_and_stand_at_their_cells(found, orbit):
    pair, _, met = found
    assert (np.asarray(orbit.status) == Status.OK).all()
    assert (np.abs(np.asarray(orbit.multipliers)).max(axis=1) < 1).all()
    real = met.side != 0
    for name in ("depth", "work"):
        np.testing.assert_array_equal(np.isnan(getattr(met, name)), ~real)
        np.testing.assert_allclose(getattr(met, name)[real], np.asarray(getattr(orbit, name))[real], rtol=1e-6)
    np.testing.assert_array_equal(met.pair.kappa, pair.kappa[met.cell])
    np.testing.assert_array_equal(met.pair.d, pair.d[met.cell])
    assert (np.diff(met.cell) > 0).all()


def test_coexisting_attractors_are_met(found, orbit):
    pair, _, met = found
    many = np.flatnonzero((pair.d[met.cell] == 0.2) & (pair.kappa[met.cell] == 3.0))
    power = np.asarray(orbit_properties.power(orbit[many], vijax.Harvester()))
    assert np.unique(np.round(1e9 * power)).size == many.size > 1


def test_chaos_has_no_orbit(found):
    _, _, met = found
    chaos = np.flatnonzero(swept("period") == 0)
    assert chaos.size
    assert not np.isin(chaos + KAPPA.size * 9, met.cell).any()


@functools.cache
def swept(name):
    return vijax.sweep(d=0.12, kappa=KAPPA, u0=np.linspace(-0.05, 0.05, 9), r=0.5)[name].values.ravel()


def test_what_is_no_orbit_has_the_averages_of_a_sweep(found):
    _, ran, met = found
    chaos = np.flatnonzero(swept("period") == 0) + KAPPA.size * 9
    cells = ran.restless(8)
    assert set(chaos) <= set(cells)
    assert not np.isin(cells, met.cell).any()
    # The same flights, with each cell's own device: beside other programs chaos rounds otherwise.
    own = ran.ended.P[chaos, 0]
    np.testing.assert_allclose(own, swept("P")[chaos - KAPPA.size * 9], rtol=0.2)
    assert abs(own.mean() / swept("P")[chaos - KAPPA.size * 9].mean() - 1) < 0.01
    assert (ran.ended.energy_ratio[chaos, 0] > 0).all()


def test_flights_in_wide_gaps_take_as_many_more_periods_as_balls_take_to_cross():
    np.testing.assert_array_equal(stretch([0.01, 1.19, 1.2, 2.3, 2.4, 9.7]), [1, 1, 2, 2, 4, 16])
    count = 4
    d, kappa = np.array([0.12, 3.0, 0.12, 3.0]), np.full(count, 200.0)
    pair = ImpactPair(d, kappa, np.full(count, 0.5), np.zeros(count))
    device = jax.tree.map(lambda x: np.full(count, x), vijax.Harvester(penetration_limit=0.0063))
    starts = Starts(np.zeros(count), np.array([0.3, 0.3, 0.2, 1e-9]), np.zeros(count))
    periods = 60 * stretch(d)
    ran = survey(pair, device, starts, longest=4 * stretch(d), periods=periods)
    np.testing.assert_array_equal(ran.longest, [4, 16, 4, 16])
    one = survey(*jax.tree.map(lambda x: x[1:2], (pair, device, starts)), longest=16, periods=240)
    np.testing.assert_array_equal(ran.ended.P[1], one.ended.P[0])
    aperiodic = np.asarray(ran.ended.period) <= 0
    assert (ran.ended.periods_run[aperiodic] >= periods[aperiodic]).all()
    # A ball that has met no wall yet in a wide gap is one of those that are on no orbit.
    assert ran.ended.status[3] == Status.NO_IMPACT
    assert 3 in ran.restless(8)


def test_clearances_are_those_of_the_motion_in_between(orbit):
    some = orbit[np.arange(0, len(orbit), 61)]
    sequence, knots = some.sequence, jnp.nan_to_num(some.knots)
    room = jax.jit(jax.vmap(grazing.between))(some.pair, sequence, knots).clearance
    assert (np.stack(room) > 0).all()
    _, u, _ = orbit_properties.path(some, samples=2001)
    for index in range(len(some)):
        half = 0.5 * float(some.pair.d[index])
        pieces = u[index].reshape(-1, 2001)[: 2 * int(some.count[index])]
        turns = [half - x for piece in pieces[1::2] for x in _turning(piece)]
        wanted = min([*turns, 1.0])
        assert float(room.flight[index]) == pytest.approx(wanted, abs=1e-6)


def _turning(u):
    """Turning points of a sampled flight: maxima as they are, minima from the left wall, turned over."""
    step = np.diff(u)
    places = np.flatnonzero(step[1:] * step[:-1] < 0) + 1
    return [u[i] if step[i - 1] > 0 else -u[i] for i in places]
