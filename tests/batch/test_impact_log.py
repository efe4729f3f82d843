"""Records of many balls at once, against the same balls followed one by one."""

import jax
import numpy as np
import pytest

import vijax
from vijax.batch.impact_log import record
from vijax.model.records import State

PERIODS = 8
D = np.array([0.1, 0.12, 0.12, 0.2, 0.3, 0.3])


def begun(pair, u, v, t=0.0, n=0, mode=0):
    u, v, t, n, mode = np.broadcast_arrays(u, v, t, n, mode, pair.d)[:5]
    return State(u, v, t, n.astype(np.int32), mode.astype(np.int32))


@pytest.fixture(scope="module", params=["soft", "rigid"])
def runs(request):
    kappa = np.array([400.0, 400.0, 4.0, 12.65, 40.0, 4.0]) if request.param == "soft" else None
    pair = vijax.impact_pair(D, kappa, np.array([0.5, 0.5, 0.5, 0.5, 0.9, 0.5]))
    u0, v0 = np.array([0.02, 0.05, -0.05, 0.09, 0.0, 0.0]), np.array([0.3, -0.48, 0.2, 0.1, 0.0, 0.0])
    path = vijax.trajectory(pair, u0, v0, periods=PERIODS)
    return pair, begun(pair, u0, v0), path


def test_every_impact_is_there(runs):
    pair, start, path = runs
    found = record(pair, start, PERIODS, np.ones(6, bool))
    assert np.array_equal(found.filled, path.filled)
    most = found.filled.max()
    for name, values in found.impacts.items():
        expected = np.array(getattr(path.impacts, name), float)[:, :most]
        expected[np.arange(most) >= found.filled[:, None]] = np.nan
        np.testing.assert_allclose(values, expected, atol=1e-8, err_msg=name)


def test_the_ball_at_phase_0_in_flight_and_in_contact(runs):
    pair, start, path = runs
    found = record(pair, start, PERIODS, np.ones(6, bool))
    np.testing.assert_allclose(found.u, path.states.u, atol=1e-9)
    np.testing.assert_allclose(found.v, path.states.v, atol=1e-8)


def test_what_lies_before_the_first_period_is_left_out(runs):
    pair, start, path = runs
    found = record(pair, begun(pair, start.u, start.v, n=-3), PERIODS - 3, np.ones(6, bool))
    np.testing.assert_allclose(found.u, path.states.u[:, 3:], atol=1e-9)
    for i in range(6):
        kept = np.flatnonzero(np.asarray(path.impacts.n[i])[: int(path.filled[i])] >= 3)
        np.testing.assert_allclose(found.impacts["t"][i, : found.filled[i]], path.impacts.t[i][kept], atol=1e-9)


def test_balls_that_are_not_wanted_hold_nothing(runs):
    pair, start, _ = runs
    wanted = np.arange(6) == 1
    found = record(pair, start, PERIODS, wanted)
    assert np.array_equal(np.isfinite(found.u).all(axis=1), wanted)
    assert np.array_equal(found.filled > 0, wanted)
    nothing = record(pair, start, PERIODS, np.zeros(6, bool))
    assert np.isnan(nothing.u).all()
    assert nothing.impacts["v_in"].shape == (6, 0)


def drawn(count, gamma, rigid):
    """Balls of random cells, some of which begin in a contact, some before the first period."""
    draw = np.random.default_rng(11)
    d, kappa = draw.uniform(0.08, 0.25, count), np.exp(draw.uniform(np.log(4.0), np.log(300.0), count))
    pair = vijax.impact_pair(d, None if rigid else kappa, draw.uniform(0.3, 0.8, count), gamma)
    held = np.zeros(count) if rigid else draw.choice([-1, 0, 0, 0, 1], count)
    u = np.where(held == 0, draw.uniform(-0.45, 0.45, count) * d, held * (0.5 * d + 0.1 / kappa))
    return pair, begun(pair, u, draw.uniform(-0.5, 0.5, count), n=draw.choice([-2, 0], count), mode=held.astype(int))


@pytest.mark.parametrize("gamma", [0.0, 0.3])
@pytest.mark.parametrize("rigid", [False, True])
def test_many_balls_have_the_record_that_each_has_alone(gamma, rigid):
    """Many take the quick step; few the careful one, which each has here in parts of 100."""
    pair, start = drawn(300, gamma, rigid)
    many = record(pair, start, 3, np.ones(300, bool))
    for first in (0, 100, 200):
        rows = slice(first, first + 100)
        own, at = (jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], tree) for tree in (pair, start))
        few = record(own, at, 3, np.ones(100, bool))
        assert np.array_equal(few.filled, many.filled[rows])
        for name, values in few.impacts.items():
            np.testing.assert_allclose(many.impacts[name][rows, : values.shape[1]], values, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(many.u[rows], few.u, atol=1e-9)
        np.testing.assert_allclose(many.v[rows], few.v, atol=1e-9)
