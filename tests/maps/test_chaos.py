"""Lyapunov exponents against reference values; survival of chaos recovers a planted mean lifetime."""

import functools

import numpy as np
import pytest
import xarray as xr

from vijax.maps import sweep
from vijax.maps.basins import start_variables
from vijax.maps.chaos import lyapunov, survival
from vijax.maps.sweep_settings import SPEED
from vijax.model.pair import impact_pair
from vijax.simulation.trajectory import trajectory


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lyapunov(d=0.2, starts=1), "starts must be a whole number of at least 2"),
        (lambda: lyapunov(d=0.2, periods=0), "periods must be a whole number of at least 1"),
        (lambda: survival(d=0.2, periods=7), "periods must be a whole number of at least 8"),
    ],
)
def test_invalid_arguments_are_rejected_before_any_simulation(monkeypatch, call, message):
    monkeypatch.setattr(sweep, "run", None)
    with pytest.raises(ValueError, match=message):
        call()


@functools.cache
def chaos():
    reports = []
    result = lyapunov(d=0.12, kappa=400.0, r=0.5, wall="rigid", progress=lambda *counts: reports.append(counts))
    return result, reports


def test_exponent_agrees_with_the_reference_within_its_error():
    result, reports = chaos()
    error = float(result.lyapunov_stderr)
    assert 0 < error < 0.01 * 1.04
    assert abs(float(result.lyapunov) - 1.04) < 3 * error + 0.005  # the reference has two decimals
    assert result.lyapunov_lowest < result.lyapunov < result.lyapunov_highest
    assert (reports[0], reports[-1]) == ((0, 128), (128, 128))


@pytest.mark.long
def test_exponent_of_a_short_window_is_unbiased():
    short = lyapunov(d=0.12, kappa=400.0, r=0.5, wall="rigid", starts=1024, periods=20)
    error = float(np.hypot(short.lyapunov_stderr, chaos()[0].lyapunov_stderr))
    assert error < 0.01  # a tangent map that starts from the identity would give a bias of 0.08
    assert abs(float(short.lyapunov - chaos()[0].lyapunov)) < 4 * error


@pytest.mark.long
def test_mean_lifetime_of_transient_chaos_is_recovered(monkeypatch):
    mean = 3000.0
    random = np.random.default_rng(6)
    ends = np.stack([random.exponential(mean, 4000), np.full(4000, np.inf), np.zeros(4000)])
    ends[0, :1000] = 50.0  # starts that reach an attractor at once do not follow the exponential law
    kinds = random.integers(0, 3, 4000)

    def run(planned, progress):
        """Return a sweep: after its chaotic part a motion is periodic, has rare impacts, or has no impact."""
        chaotic = ends > planned.settings.transient
        exponents = np.where(chaotic, 0.9, np.array([-0.5, 0.05, np.nan])[kinds])
        impacts = np.where(chaotic, 1.3, np.array([2.0, 0.02, 0.0])[kinds])
        dims = ("d", "start")
        return xr.Dataset({"lyapunov": (dims, exponents), "impacts_per_period": (dims, impacts)})

    monkeypatch.setattr(sweep, "run", run)
    result = survival(d=[0.2, 0.3, 0.4], starts=4000, periods=8000)
    assert result.after.values.tolist() == list(range(1000, 9000, 1000))
    error = float(result.lifetime_stderr[0])
    assert 0.01 * mean < error < 0.03 * mean
    assert abs(float(result.lifetime[0]) - mean) < 3 * error
    np.testing.assert_array_equal(result.lifetime[1:], [np.inf, np.nan])
    np.testing.assert_array_equal(result.lifetime_stderr[1:], [np.inf, np.nan])
    np.testing.assert_allclose(result.survival[0], 0.75 * np.exp(-result.after / mean), atol=0.03)
    assert np.all(result.survival[1] == 1)


def test_chaotic_attractor_has_infinite_lifetime():
    result = survival(d=0.12, kappa=400.0, r=0.5, wall="rigid", starts=20, periods=80)
    assert np.all(result.survival == 1)
    assert np.isinf(result.lifetime)


# Wide gaps: the ball often drifts for hundreds of periods without an impact, and chaos resumes.
INTERMITTENT = [(3.55, 11.1, 0.32), (9.063, 29.9, 0.5), (5.318, 11.2, 0.29), (0.893, 6.7, 0.43)]


@pytest.mark.parametrize(
    ("d", "kappa", "r"), [*(pytest.param(*cell, marks=pytest.mark.long) for cell in INTERMITTENT[:3]), INTERMITTENT[3]]
)
def test_surviving_fraction_never_increases(d, kappa, r):
    result = survival(d=d, kappa=kappa, r=r, starts=128, periods=1600)
    assert (np.diff(result.survival) <= 0).all()
    assert result.survival[0] > 0.9


def test_surviving_fraction_agrees_with_trajectories():
    """Compare with trajectories: chaos ends on an orbit of period 3 after about 2000 periods.

    `survival` may count a motion as chaotic for up to 200 periods after its end.
    """
    d, kappa, r, starts, periods, ahead = 7.129, 23.5, 0.93, 160, 2000, 300
    result = survival(d=d, kappa=kappa, r=r, starts=starts, periods=periods)
    positions, speeds = (x.values for x in start_variables(starts, None))
    run = trajectory(impact_pair(d, kappa, r), positions * d, 2 * SPEED * speeds, periods + ahead, max_impacts=periods)
    u, v = np.asarray(run.states.u), np.asarray(run.states.v)
    aperiodic = np.abs(u[:, 6:] - u[:, :-6]) + np.abs(v[:, 6:] - v[:, :-6]) > 0.1
    ends = aperiodic.shape[1] - aperiodic[:, ::-1].argmax(axis=1)
    noise = 3 * np.sqrt(0.5 / starts)  # two independent samples: chaos makes the motions of the two engines diverge
    for after, share in zip(result.after.values, result.survival.values, strict=True):
        assert (ends > after + 200).mean() - noise < share < (ends > after).mean() + noise
