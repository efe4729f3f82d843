"""Dense curves between impacts: contacts start and end on the walls, and the curve passes the simulated states."""

import numpy as np
import pytest

import vijax
from vijax.orbits.motion import curve, states

PERIODS = 6


def simulate_curve(wall: str, gamma: float):
    pair = vijax.impact_pair(0.2, 40.0 if wall == "soft" else None, 0.5, gamma)
    path = vijax.trajectory(pair, 0.02, 0.3, PERIODS)
    recorded = path.impacts
    t = np.asarray(recorded.t) + 2.0 * np.asarray(recorded.n)
    impacts = (t, recorded.side, recorded.v_in, recorded.v_out, recorded.duration)
    return pair, path, impacts, curve(pair, *impacts, samples=400)


@pytest.fixture(scope="module", params=[("soft", 0.0), ("soft", 0.2), ("rigid", 0.0)], ids=str)
def case(request):
    return simulate_curve(*request.param)


def test_the_curve_passes_through_the_stroboscopic_states(case):
    _, path, _, line = case
    clock = 2.0 * np.arange(1, PERIODS)  # the last impact ends before the last period
    distinct = np.diff(line.t) > 0
    for values, strobes in ((line.u, path.states.u), (line.v, path.states.v)):
        # Samples are 1/400 of a flight apart; linear interpolation has a smaller error than this tolerance.
        interpolated = np.interp(clock, line.t[1:][distinct], values[1:][distinct])
        np.testing.assert_allclose(interpolated, np.asarray(strobes)[: PERIODS - 1], atol=2e-5)


def test_contacts_begin_and_end_on_the_wall(case):
    pair, path, _, line = case
    count = int(path.filled)
    u, v = (part.reshape(count, 2, -1) for part in (line.u, line.v))
    wall = 0.5 * float(pair.d) * np.asarray(path.impacts.side[:count])
    for part in (u[:, 0, 0], u[:, 0, -1], u[:, 1, 0]):
        np.testing.assert_allclose(part, wall, atol=1e-14)
    np.testing.assert_allclose(v[:, 0, 0], path.impacts.v_in[:count], atol=1e-14)
    np.testing.assert_allclose(v[:, 1, 0], path.impacts.v_out[:count], atol=1e-14)
    np.testing.assert_allclose(u[:-1, 1, -1], wall[1:], atol=1e-14)


def test_states_at_specified_times_equal_the_simulated_states(case):
    pair, path, impacts, line = case
    u, v = states(pair, *impacts, when=2.0 * np.arange(PERIODS))
    np.testing.assert_allclose(u[1:], path.states.u[: PERIODS - 1], atol=1e-13)
    np.testing.assert_allclose(v[1:], path.states.v[: PERIODS - 1], atol=1e-12)
    assert np.isnan([u[0], v[0]]).all()  # before the first impact
    u, v = states(pair, *impacts, when=line.t[:400])  # in contact
    np.testing.assert_allclose([u, v], [line.u[:400], line.v[:400]], atol=1e-13)


def test_curve_without_impacts_is_empty():
    missing = np.full(5, np.nan)
    line = curve(vijax.impact_pair(0.3, 40.0, 0.5), missing, missing, missing, missing, missing)
    assert line.t.size == 0


def test_later_impacts_do_not_change_the_earlier_curve():
    pair, row = vijax.impact_pair(0.2, 40.0, 0.5), np.array([0.1, 1.1, 2.1, 3.1])
    side = np.array([1, -1, 1, -1])
    short, long = (curve(pair, row[:n], side[:n], 0.3 * side[:n], -0.15 * side[:n], 0 * row[:n]) for n in (3, 4))
    np.testing.assert_array_equal(short.u[: 5 * 48], long.u[: 5 * 48])
