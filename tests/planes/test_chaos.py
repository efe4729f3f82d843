"""Lyapunov exponents and survival of chaos: known ones, and a planted lifetime is found again."""

import functools

import numpy as np
import pytest
import xarray as xr

from vijax.planes import sweep
from vijax.planes.chaos import lyapunov, survival


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


def test_the_growth_from_the_identity_does_not_bias_a_short_window():
    short = lyapunov(d=0.12, kappa=400.0, r=0.5, wall="rigid", starts=1024, periods=20)
    error = float(np.hypot(short.lyapunov_stderr, chaos()[0].lyapunov_stderr))
    assert error < 0.01  # from the identity it would be 0.08 off
    assert abs(float(short.lyapunov - chaos()[0].lyapunov)) < 4 * error


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
