"""Lyapunov exponents and survival of chaos: known ones, and a planted lifetime is found again."""

import functools

import numpy as np
import pytest
import xarray as xr

from vijax.batch.trajectory import trajectory
from vijax.model.pair import impact_pair
from vijax.planes import sweep
from vijax.planes.basins import spread
from vijax.planes.chaos import lyapunov, survival
from vijax.planes.sweep_settings import SPEED


@pytest.mark.parametrize(
    ("call", "say"),
    [
        (lambda: lyapunov(d=0.2, starts=1), "starts must be a whole number of at least 2"),
        (lambda: lyapunov(d=0.2, periods=0), "periods must be a whole number of at least 1"),
        (lambda: survival(d=0.2, periods=7), "periods must be a whole number of at least 8"),
    ],
)
def test_bad_input_runs_nothing(monkeypatch, call, say):
    monkeypatch.setattr(sweep, "run", None)
    with pytest.raises(ValueError, match=say):
        call()


@functools.cache
def chaos():
    told = []
    found = lyapunov(d=0.12, kappa=400.0, r=0.5, wall="rigid", progress=lambda *counts: told.append(counts))
    return found, told


def test_a_known_exponent_and_its_error():
    found, told = chaos()
    error = float(found.lyapunov_stderr)
    assert 0 < error < 0.01 * 1.04
    assert abs(float(found.lyapunov) - 1.04) < 3 * error + 0.005  # known to two decimals
    assert found.lyapunov_lowest < found.lyapunov < found.lyapunov_highest
    assert (told[0], told[-1]) == ((0, 128), (128, 128))


@pytest.mark.long
def test_the_growth_from_the_identity_does_not_bias_a_short_window():
    short = lyapunov(d=0.12, kappa=400.0, r=0.5, wall="rigid", starts=1024, periods=20)
    error = float(np.hypot(short.lyapunov_stderr, chaos()[0].lyapunov_stderr))
    assert error < 0.01  # from the identity it would be 0.08 off
    assert abs(float(short.lyapunov - chaos()[0].lyapunov)) < 4 * error


@pytest.mark.long
def test_chaos_that_ends_at_random_has_its_mean_lifetime(monkeypatch):
    mean = 3000.0
    random = np.random.default_rng(6)
    ends = np.stack([random.exponential(mean, 4000), np.full(4000, np.inf), np.zeros(4000)])
    ends[0, :1000] = 50.0  # straight to an attractor: no part of the law
    kinds = random.integers(0, 3, 4000)

    def run(planned, progress):
        """After its end a motion is periodic, or creeps with rare impacts, or touches no wall."""
        chaotic = ends > planned.settings.transient
        exponents = np.where(chaotic, 0.9, np.array([-0.5, 0.05, np.nan])[kinds])
        impacts = np.where(chaotic, 1.3, np.array([2.0, 0.02, 0.0])[kinds])
        dims = ("d", "start")
        return xr.Dataset({"lyapunov": (dims, exponents), "impacts_per_period": (dims, impacts)})

    monkeypatch.setattr(sweep, "run", run)
    found = survival(d=[0.2, 0.3, 0.4], starts=4000, periods=8000)
    assert found.after.values.tolist() == list(range(1000, 9000, 1000))
    error = float(found.lifetime_stderr[0])
    assert 0.01 * mean < error < 0.03 * mean
    assert abs(float(found.lifetime[0]) - mean) < 3 * error
    np.testing.assert_array_equal(found.lifetime[1:], [np.inf, np.nan])
    np.testing.assert_array_equal(found.lifetime_stderr[1:], [np.inf, np.nan])
    np.testing.assert_allclose(found.survival[0], 0.75 * np.exp(-found.after / mean), atol=0.03)
    assert np.all(found.survival[1] == 1)


def test_an_attractor_survives():
    found = survival(d=0.12, kappa=400.0, r=0.5, wall="rigid", starts=20, periods=80)
    assert np.all(found.survival == 1)
    assert np.isinf(found.lifetime)


# Wide gaps: the ball often drifts for hundreds of periods without an impact, and chaos resumes.
INTERMITTENT = [(3.55, 11.1, 0.32), (9.063, 29.9, 0.5), (5.318, 11.2, 0.29), (0.893, 6.7, 0.43)]


@pytest.mark.parametrize(
    ("d", "kappa", "r"), [*(pytest.param(*cell, marks=pytest.mark.long) for cell in INTERMITTENT[:3]), INTERMITTENT[3]]
)
def test_the_share_of_survivors_never_rises(d, kappa, r):
    found = survival(d=d, kappa=kappa, r=r, starts=128, periods=1600)
    assert (np.diff(found.survival) <= 0).all()
    assert found.survival[0] > 0.9


def test_survivors_are_those_of_trajectories():
    """Chaos that ends on an orbit of period 3, after some 2000 periods; a motion is seen to be chaotic for 200 more."""
    d, kappa, r, starts, periods, ahead = 7.129, 23.5, 0.93, 160, 2000, 300
    found = survival(d=d, kappa=kappa, r=r, starts=starts, periods=periods)
    across, fast = (x.values for x in spread(starts, None))
    run = trajectory(impact_pair(d, kappa, r), across * d, 2 * SPEED * fast, periods + ahead, max_impacts=periods)
    u, v = np.asarray(run.states.u), np.asarray(run.states.v)
    away = np.abs(u[:, 6:] - u[:, :-6]) + np.abs(v[:, 6:] - v[:, :-6]) > 0.1
    ends = away.shape[1] - away[:, ::-1].argmax(axis=1)
    noise = 3 * np.sqrt(0.5 / starts)  # two samples: chaos parts the engines
    for after, share in zip(found.after.values, found.survival.values, strict=True):
        assert (ends > after + 200).mean() - noise < share < (ends > after).mean() + noise
