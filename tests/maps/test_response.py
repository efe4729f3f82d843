"""Response of a device to noise: standard errors, distributions, and times in the basins of attractors."""

from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

import vijax
from vijax import Harmonics, Harvester, Noise, Status, Waveform, response, trajectory
from vijax.maps.response import _quantiles

DEVICE = Harvester(omega=5 * np.pi, omega0=150.0, s=0.008)  # d 0.2, kappa 30
MULTISTABLE = Harvester(omega=5 * np.pi, omega0=15.0, s=0.008)
NOISY = Harmonics() + Noise(0.05, 16)


@pytest.fixture(scope="module")
def result():
    return response(DEVICE, NOISY, realisations=16, periods=60, transient=20)


def test_densities_are_normalised_and_agree_with_quantiles(result):
    for name, axis in (("speed", "impact_speed"), ("penetration", "penetration")):
        width = float(result[axis][1] - result[axis][0])
        assert float(result[f"{name}_density"].sum()) * width == pytest.approx(1)
        mean = float((result[axis] * result[f"{name}_density"]).sum() * width)
        quantiles = result[f"{name}_quantile"].values
        assert (np.diff(quantiles) > 0).all()
        assert quantiles[0] / 2 < mean < quantiles[2] <= result[f"max_{axis}"]
        assert (result[f"{name}_density_stderr"].values >= 0).all()


@pytest.mark.long
def test_power_equals_sweeps_from_the_same_starts(result):
    """Every realisation equals the cell of a map with the same start and the same noise."""
    from vijax.maps.execution.start_lattice import unit_starts

    pair = DEVICE.pair()
    across, fast = unit_starts(16)
    arguments = {
        "device": DEVICE,
        "until": "window",
        "periods": 60,
        "transient": 20,
        "excitation": NOISY,
        "outputs": ["P"],
    }
    for i in (0, 7):
        P = vijax.sweep(**arguments, u0=across[i] * float(pair.d), v0=1.2 * fast[i])["P"]
        assert float(P) == pytest.approx(float(result["P_realisation"][i]), rel=1e-9)
    assert float(result["P"]) == pytest.approx(result["P_realisation"].values.mean())


@pytest.mark.long
@pytest.mark.parametrize("wall", ["rigid", "rigid_right"])
def test_rigid_walls_agree_with_sweeps(wall):
    """With rigid walls, power and depth come from the nominal membrane or from the wall that has a membrane."""
    from vijax.maps.execution.start_lattice import unit_starts

    result = response(DEVICE, NOISY, wall=wall, realisations=4, periods=40, transient=10)
    assert result.attrs["wall"] == wall
    across, fast = unit_starts(4)
    start = {"u0": across * float(DEVICE.pair().d), "v0": 1.2 * fast}
    arguments = {"device": DEVICE, "wall": wall, "until": "window", "periods": 40, "transient": 10, "excitation": NOISY}
    for i in range(4):
        cell = vijax.sweep(**arguments, u0=start["u0"][i], v0=start["v0"][i])
        assert float(cell.P) == pytest.approx(float(result["P_realisation"][i]), rel=1e-9)
        assert float(cell.max_penetration) <= float(result["max_penetration"]) * (1 + 1e-9)
    assert float(result["time_share"].sum()) == pytest.approx(1)


@pytest.mark.long
def test_standard_error_agrees_with_the_scatter_between_seeds(result):
    others = [
        response(
            DEVICE, Harmonics() + Noise(0.05, 16, seed), realisations=16, periods=60, transient=20, attractors=False
        )
        for seed in range(1, 7)
    ]
    for name in ("P", "impacts_per_period"):
        spread = np.std([float(other[name]) for other in others], ddof=1)
        stderr = np.mean([float(other[f"{name}_stderr"]) for other in others])
        assert 0.3 < spread / stderr < 3, name
    assert "time_share" not in others[0]


@pytest.mark.long
def test_standard_errors_of_quantiles_are_right_in_the_tails():
    """Impacts of one realisation are correlated; quantiles of 200 random data sets scatter by their standard errors."""
    arguments = SimpleNamespace(realisations=64)
    random = np.random.default_rng(4)
    samples = []
    for _ in range(200):
        count = random.integers(100, 300, 64)
        realisation = np.repeat(np.arange(64), count)
        samples.append(
            _quantiles(
                arguments,
                realisation,
                np.repeat(random.uniform(1, 2, 64), count) * random.exponential(size=realisation.size),
            )
        )
    quantiles, errors = np.moveaxis(samples, 1, 0)
    z = (quantiles - quantiles.mean(axis=0)) / errors
    assert (np.abs(np.sqrt((z**2).mean(axis=0)) - 1) < 0.15).all()
    assert ((np.abs(z) > 3).mean(axis=0) < 0.03).all()


def test_quantile_with_few_impacts_above_it_has_no_error():
    arguments = SimpleNamespace(realisations=8)
    realisation = np.arange(9_000) % 8
    values = np.random.default_rng(5).random(9_000)
    assert np.isfinite(_quantiles(arguments, realisation, values)[0]).all()
    assert np.isnan(_quantiles(arguments, realisation, values)[1]).tolist() == [False, False, False, True]


def test_half_of_the_impacts_exceed_a_limit_at_the_median(result):
    limit = float(result["penetration_quantile"].sel(quantile=0.5))
    device = vijax.Harvester(omega=5 * np.pi, omega0=150.0, s=0.008, penetration_limit=limit)
    limited = response(device, NOISY, realisations=16, periods=60, transient=20, attractors=False)
    assert float(limited["beyond_limit"]) == pytest.approx(0.5, abs=1e-3)
    assert 0 < float(limited["beyond_limit_stderr"]) < 0.05
    assert float(result["beyond_limit"]) == 0


def test_motions_leave_basins_only_with_noise():
    arguments = {"realisations": 12, "periods": 30, "transient": 60}
    almost_noiseless = response(MULTISTABLE, Harmonics() + Noise(1e-9, 8), **arguments)
    assert almost_noiseless.sizes["attractor"] > 1
    assert not almost_noiseless["losses"].any()
    assert np.isinf(almost_noiseless["time_until_lost"]).all()
    noisy = response(MULTISTABLE, Harmonics() + Noise(0.03, 8), **arguments)
    for result in (almost_noiseless, noisy):
        assert float(result["time_share"].sum()) == pytest.approx(1)
    assert noisy["losses"].sum() > 20
    best = noisy.isel(attractor=0)
    assert 1 < float(best["time_until_lost"]) < 30
    # A motion that leaves a basin enters another one, so the sum of the losses is the number of changes of basin.
    assert (np.diff(noisy["time_share"]) <= 0).all()


ROUGH = Waveform(np.random.default_rng(0).normal(size=128), 32.0)


@pytest.mark.parametrize(
    "excitation", [None, *(pytest.param(x, marks=pytest.mark.long) for x in (ROUGH, Noise(0.5, 16)))], ids=str
)
def test_only_noise_on_a_periodic_forcing_has_a_table_of_attractors(excitation):
    result = response(DEVICE, excitation, realisations=4, periods=8, transient=2)
    assert "time_share" not in result
    assert float(result["P_stderr"]) >= 0
    assert result.attrs["excitation"] == ("sine" if excitation is None else str(excitation))


def test_failed_realisation_is_excluded_from_means(monkeypatch):
    """One of five realisations exceeds its event budget; P is the mean of the other four."""
    arguments = {"realisations": 5, "periods": 30, "transient": 6, "attractors": False}
    complete = response(DEVICE, NOISY, **arguments)

    def with_failed_realisation(*args, **kwargs):
        path = trajectory(*args, **kwargs)
        return eqx.tree_at(lambda p: p.status, path, path.status.at[2].set(Status.EVENT_BUDGET))

    monkeypatch.setattr("vijax.maps.response.complete_trajectory", with_failed_realisation)
    reduced = response(DEVICE, NOISY, **arguments)
    others = np.delete(complete["P_realisation"].values, 2)
    assert float(reduced["P"]) == pytest.approx(others.mean())
    assert np.isnan(reduced["P_realisation"].values).tolist() == [False, False, True, False, False]
    assert int(reduced["status"][2]) == Status.EVENT_BUDGET
    assert float(reduced["P_stderr"]) == pytest.approx(others.std(ddof=1) / 2)


def test_response_without_impacts_is_plotted(tmp_path):
    no_impact = response(Harvester(omega=5 * np.pi, omega0=150.0, s=2.0), None, realisations=4, periods=8, transient=2)
    assert float(no_impact["P"]) == 0
    assert np.isnan(no_impact["speed_quantile"]).all()
    vijax.plots.save(vijax.plots.response(no_impact), tmp_path / "still.png")


def test_invalid_arguments_are_named_in_the_error():
    with pytest.raises(ValueError, match="realisations must be a whole number of at least 2; got 1"):
        response(DEVICE, NOISY, realisations=1)
    with pytest.raises(ValueError, match="excitation must be of the kind Excitation"):
        response(DEVICE, 3)
    with pytest.raises(ValueError, match="periods and transient must end within the record"):
        response(DEVICE, Waveform([0.0, 1.0], 2.0, looped=False))
