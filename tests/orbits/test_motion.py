"""The dense curve between impacts: on the walls at both ends of a contact, through the states that the engine gives."""

import numpy as np
import pytest

import vijax
from vijax.orbits.motion import curve, states

PERIODS = 6


def drawn(wall: str, gamma: float):
    pair = vijax.impact_pair(0.2, 40.0 if wall == "soft" else None, 0.5, gamma)
    path = vijax.trajectory(pair, 0.02, 0.3, PERIODS)
    found = path.impacts
    t = np.asarray(found.t) + 2.0 * np.asarray(found.n)
    impacts = (t, found.side, found.v_in, found.v_out, found.duration)
    return pair, path, impacts, curve(pair, *impacts, samples=400)


@pytest.fixture(scope="module", params=[("soft", 0.0), ("soft", 0.2), ("rigid", 0.0)], ids=str)
def case(request):
    return drawn(*request.param)


def test_the_curve_passes_through_the_stroboscopic_states(case):
    _, path, _, line = case
    clock = 2.0 * np.arange(1, PERIODS)  # the last impact ends before the last period does
    apart = np.diff(line.t) > 0
    for values, strobes in ((line.u, path.states.u), (line.v, path.states.v)):
        # Between samples 1/400 of a flight apart a straight line errs by less than this.
        between = np.interp(clock, line.t[1:][apart], values[1:][apart])
        np.testing.assert_allclose(between, np.asarray(strobes)[: PERIODS - 1], atol=2e-5)


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


def test_states_at_given_times_are_those_of_the_engine(case):
    pair, path, impacts, line = case
    u, v = states(pair, *impacts, when=2.0 * np.arange(PERIODS))
    np.testing.assert_allclose(u[1:], path.states.u[: PERIODS - 1], atol=1e-13)
    np.testing.assert_allclose(v[1:], path.states.v[: PERIODS - 1], atol=1e-12)
    assert np.isnan([u[0], v[0]]).all()  # before the first impact
    u, v = states(pair, *impacts, when=line.t[:400])  # in contact
    np.testing.assert_allclose([u, v], [line.u[:400], line.v[:400]], atol=1e-13)


def test_no_impact_draws_nothing():
    nothing = np.full(5, np.nan)
    line = curve(vijax.impact_pair(0.3, 40.0, 0.5), nothing, nothing, nothing, nothing, nothing)
    assert line.t.size == 0


def test_later_impacts_change_nothing_before_them():
    pair, row = vijax.impact_pair(0.2, 40.0, 0.5), np.array([0.1, 1.1, 2.1, 3.1])
    side = np.array([1, -1, 1, -1])
    short, long = (curve(pair, row[:n], side[:n], 0.3 * side[:n], -0.15 * side[:n], 0 * row[:n]) for n in (3, 4))
    np.testing.assert_array_equal(short.u[: 5 * 48], long.u[: 5 * 48])
