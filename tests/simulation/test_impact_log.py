"""Records of many balls at once, against trajectories of the same balls."""

import jax
import numpy as np
import pytest

import vijax
from vijax.model.records import State
from vijax.simulation.impact_log import record_impacts

PERIODS = 8
D = np.array([0.1, 0.12, 0.12, 0.2, 0.3, 0.3])


def initial_states(pair, u, v, t=0.0, n=0, mode=0):
    u, v, t, n, mode = np.broadcast_arrays(u, v, t, n, mode, pair.d)[:5]
    return State(u, v, t, n.astype(np.int32), mode.astype(np.int32))


@pytest.fixture(scope="module", params=["soft", "rigid"])
def runs(request):
    kappa = np.array([400.0, 400.0, 4.0, 12.65, 40.0, 4.0]) if request.param == "soft" else None
    pair = vijax.impact_pair(D, kappa, np.array([0.5, 0.5, 0.5, 0.5, 0.9, 0.5]))
    u0, v0 = np.array([0.02, 0.05, -0.05, 0.09, 0.0, 0.0]), np.array([0.3, -0.48, 0.2, 0.1, 0.0, 0.0])
    path = vijax.trajectory(pair, u0, v0, periods=PERIODS)
    return pair, initial_states(pair, u0, v0), path


def test_all_impacts_are_recorded(runs):
    pair, start, path = runs
    record = record_impacts(pair, start, PERIODS, np.ones(6, bool))
    assert np.array_equal(record.filled, path.filled)
    most = record.filled.max()
    for name, values in record.impacts.items():
        expected = np.array(getattr(path.impacts, name), float)[:, :most]
        expected[np.arange(most) >= record.filled[:, None]] = np.nan
        np.testing.assert_allclose(values, expected, atol=1e-8, err_msg=name)


def test_states_at_phase_0_in_flight_and_in_contact(runs):
    pair, start, path = runs
    record = record_impacts(pair, start, PERIODS, np.ones(6, bool))
    np.testing.assert_allclose(record.u, path.states.u, atol=1e-9)
    np.testing.assert_allclose(record.v, path.states.v, atol=1e-8)


def test_impacts_before_the_first_period_are_not_recorded(runs):
    pair, start, path = runs
    record = record_impacts(pair, initial_states(pair, start.u, start.v, n=-3), PERIODS - 3, np.ones(6, bool))
    np.testing.assert_allclose(record.u, path.states.u[:, 3:], atol=1e-9)
    for i in range(6):
        recorded = np.flatnonzero(np.asarray(path.impacts.n[i])[: int(path.filled[i])] >= 3)
        np.testing.assert_allclose(record.impacts["t"][i, : record.filled[i]], path.impacts.t[i][recorded], atol=1e-9)


def test_unselected_balls_have_no_record(runs):
    pair, start, _ = runs
    selected = np.arange(6) == 1
    record = record_impacts(pair, start, PERIODS, selected)
    assert np.array_equal(np.isfinite(record.u).all(axis=1), selected)
    assert np.array_equal(record.filled > 0, selected)
    nothing = record_impacts(pair, start, PERIODS, np.zeros(6, bool))
    assert np.isnan(nothing.u).all()
    assert nothing.impacts["v_in"].shape == (6, 0)


def drawn(count, gamma, rigid):
    """Return balls of random cells; some start in a contact, some before the first period."""
    draw = np.random.default_rng(11)
    d, kappa = draw.uniform(0.08, 0.25, count), np.exp(draw.uniform(np.log(4.0), np.log(300.0), count))
    pair = vijax.impact_pair(d, None if rigid else kappa, draw.uniform(0.3, 0.8, count), gamma)
    contact_side = np.zeros(count) if rigid else draw.choice([-1, 0, 0, 0, 1], count)
    u = np.where(contact_side == 0, draw.uniform(-0.45, 0.45, count) * d, contact_side * (0.5 * d + 0.1 / kappa))
    return pair, initial_states(
        pair, u, draw.uniform(-0.5, 0.5, count), n=draw.choice([-2, 0], count), mode=contact_side.astype(int)
    )


@pytest.mark.parametrize("gamma", [0.0, 0.3])
@pytest.mark.parametrize("rigid", [False, True])
def test_the_record_of_a_ball_does_not_depend_on_other_balls(gamma, rigid):
    """300 balls use the fast step; batches of 100 use the exact step."""
    pair, start = drawn(300, gamma, rigid)
    many = record_impacts(pair, start, 3, np.ones(300, bool))
    for first in (0, 100, 200):
        rows = slice(first, first + 100)
        part, at = (jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], tree) for tree in (pair, start))
        few = record_impacts(part, at, 3, np.ones(100, bool))
        assert np.array_equal(few.filled, many.filled[rows])
        for name, values in few.impacts.items():
            np.testing.assert_allclose(many.impacts[name][rows, : values.shape[1]], values, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(many.u[rows], few.u, atol=1e-9)
        np.testing.assert_allclose(many.v[rows], few.v, atol=1e-9)
