"""What a device does under noise: errors that hold, distributions that add up, basins that are kept to."""

from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

import vijax
from vijax import Harmonics, Harvester, Noise, Status, Waveform, response, trajectory
from vijax.planes.response import _quantiles

DEVICE = Harvester(omega=5 * np.pi, omega0=150.0, s=0.008)  # d 0.2, kappa 30
MULTISTABLE = Harvester(omega=5 * np.pi, omega0=15.0, s=0.008)
NOISY = Harmonics() + Noise(0.05, 16)


@pytest.fixture(scope="module")
def found():
    return response(DEVICE, NOISY, realisations=16, periods=60, transient=20)


def test_densities_are_those_of_all_impacts(found):
    for of, axis in (("speed", "impact_speed"), ("penetration", "penetration")):
        width = float(found[axis][1] - found[axis][0])
        assert float(found[f"{of}_density"].sum()) * width == pytest.approx(1)
        mean = float((found[axis] * found[f"{of}_density"]).sum() * width)
        quantiles = found[f"{of}_quantile"].values
        assert (np.diff(quantiles) > 0).all()
        assert quantiles[0] / 2 < mean < quantiles[2] <= found[f"max_{axis}"]
        assert (found[f"{of}_density_stderr"].values >= 0).all()


@pytest.mark.long
def test_power_is_that_of_sweeps_from_the_same_starts(found):
    """The noise of a start is that of the cell in a map: every realisation is a cell of one."""
    from vijax.planes.start_places import start_places

    pair = DEVICE.pair()
    across, fast = start_places(16)
    told = {"device": DEVICE, "until": "window", "periods": 60, "transient": 20, "excitation": NOISY, "outputs": ["P"]}
    for i in (0, 7):
        P = vijax.sweep(**told, u0=across[i] * float(pair.d), v0=1.2 * fast[i])["P"]
        assert float(P) == pytest.approx(float(found["P_realisation"][i]), rel=1e-9)
    assert float(found["P"]) == pytest.approx(found["P_realisation"].values.mean())


@pytest.mark.long
@pytest.mark.parametrize("wall", ["rigid", "rigid_right"])
def test_rigid_walls_are_those_of_sweeps(wall):
    """Power, depth and limit by the membrane that rigid walls are lent, or by the one wall that has one."""
    from vijax.planes.start_places import start_places

    found = response(DEVICE, NOISY, wall=wall, realisations=4, periods=40, transient=10)
    assert found.attrs["wall"] == wall
    across, fast = start_places(4)
    start = {"u0": across * float(DEVICE.pair().d), "v0": 1.2 * fast}
    told = {"device": DEVICE, "wall": wall, "until": "window", "periods": 40, "transient": 10, "excitation": NOISY}
    for i in range(4):
        cell = vijax.sweep(**told, u0=start["u0"][i], v0=start["v0"][i])
        assert float(cell.P) == pytest.approx(float(found["P_realisation"][i]), rel=1e-9)
        assert float(cell.max_penetration) <= float(found["max_penetration"]) * (1 + 1e-9)
    assert float(found["time_share"].sum()) == pytest.approx(1)


@pytest.mark.long
def test_the_error_is_how_far_other_seeds_are(found):
    others = [
        response(
            DEVICE, Harmonics() + Noise(0.05, 16, seed), realisations=16, periods=60, transient=20, attractors=False
        )
        for seed in range(1, 7)
    ]
    for name in ("P", "impacts_per_period"):
        spread = np.std([float(one[name]) for one in others], ddof=1)
        told = np.mean([float(one[f"{name}_stderr"]) for one in others])
        assert 0.3 < spread / told < 3, name
    assert "time_share" not in others[0]


@pytest.mark.long
def test_errors_of_quantiles_hold_in_the_tails():
    """Impacts of a realisation are alike: in 200 draws of 64 realisations quantiles scatter as their errors say."""
    asked = SimpleNamespace(realisations=64)
    draw = np.random.default_rng(4)
    found = []
    for _ in range(200):
        count = draw.integers(100, 300, 64)
        of = np.repeat(np.arange(64), count)
        found.append(_quantiles(asked, of, np.repeat(draw.uniform(1, 2, 64), count) * draw.exponential(size=of.size)))
    quantiles, errors = np.moveaxis(found, 1, 0)
    z = (quantiles - quantiles.mean(axis=0)) / errors
    assert (np.abs(np.sqrt((z**2).mean(axis=0)) - 1) < 0.15).all()
    assert ((np.abs(z) > 3).mean(axis=0) < 0.03).all()


def test_a_quantile_that_few_impacts_pass_has_no_error():
    asked = SimpleNamespace(realisations=8)
    of = np.arange(9_000) % 8
    values = np.random.default_rng(5).random(9_000)
    assert np.isfinite(_quantiles(asked, of, values)[0]).all()
    assert np.isnan(_quantiles(asked, of, values)[1]).tolist() == [False, False, False, True]


def test_a_limit_in_the_middle_is_passed_by_half(found):
    limit = float(found["penetration_quantile"].sel(quantile=0.5))
    device = vijax.Harvester(omega=5 * np.pi, omega0=150.0, s=0.008, penetration_limit=limit)
    again = response(device, NOISY, realisations=16, periods=60, transient=20, attractors=False)
    assert float(again["beyond_limit"]) == pytest.approx(0.5, abs=1e-3)
    assert 0 < float(again["beyond_limit_stderr"]) < 0.05
    assert float(found["beyond_limit"]) == 0


def test_basins_are_kept_to_without_noise_and_left_with_it():
    told = {"realisations": 12, "periods": 30, "transient": 60}
    calm = response(MULTISTABLE, Harmonics() + Noise(1e-9, 8), **told)
    assert calm.sizes["attractor"] > 1
    assert not calm["losses"].any()
    assert np.isinf(calm["time_until_lost"]).all()
    rough = response(MULTISTABLE, Harmonics() + Noise(0.03, 8), **told)
    for one in (calm, rough):
        assert float(one["time_share"].sum()) == pytest.approx(1)
    assert rough["losses"].sum() > 20
    kept = rough.isel(attractor=0)
    assert 1 < float(kept["time_until_lost"]) < 30
    # What is left is entered again but for the end: losses of all are the changes of basin.
    assert (np.diff(rough["time_share"]) <= 0).all()


ROUGH = Waveform(np.random.default_rng(0).normal(size=128), 32.0)


@pytest.mark.parametrize(
    "excitation", [None, *(pytest.param(x, marks=pytest.mark.long) for x in (ROUGH, Noise(0.5, 16)))], ids=str
)
def test_only_noise_on_what_repeats_has_a_table(excitation):
    one = response(DEVICE, excitation, realisations=4, periods=8, transient=2)
    assert "time_share" not in one
    assert float(one["P_stderr"]) >= 0
    assert one.attrs["excitation"] == ("sine" if excitation is None else str(excitation))


def test_a_realisation_that_fails_counts_nowhere(monkeypatch):
    """One of five has no room for its impacts: P is that of the four others, and its status says so."""
    told = {"realisations": 5, "periods": 30, "transient": 6, "attractors": False}
    whole = response(DEVICE, NOISY, **told)

    def cramped(*args, **kwargs):
        path = trajectory(*args, **kwargs)
        return eqx.tree_at(lambda p: p.status, path, path.status.at[2].set(Status.EVENT_BUDGET))

    monkeypatch.setattr("vijax.planes.response.complete_trajectory", cramped)
    less = response(DEVICE, NOISY, **told)
    others = np.delete(whole["P_realisation"].values, 2)
    assert float(less["P"]) == pytest.approx(others.mean())
    assert np.isnan(less["P_realisation"].values).tolist() == [False, False, True, False, False]
    assert int(less["status"][2]) == Status.EVENT_BUDGET
    assert float(less["P_stderr"]) == pytest.approx(others.std(ddof=1) / 2)


def test_a_device_that_meets_no_wall_is_drawn(tmp_path):
    still = response(Harvester(omega=5 * np.pi, omega0=150.0, s=2.0), None, realisations=4, periods=8, transient=2)
    assert float(still["P"]) == 0
    assert np.isnan(still["speed_quantile"]).all()
    vijax.plots.save(vijax.plots.response(still), tmp_path / "still.png")


def test_what_cannot_be_is_named():
    with pytest.raises(ValueError, match="realisations must be a whole number of at least 2; got 1"):
        response(DEVICE, NOISY, realisations=1)
    with pytest.raises(ValueError, match="excitation must be of the kind Excitation"):
        response(DEVICE, 3)
    with pytest.raises(ValueError, match="periods and transient must end within the record"):
        response(DEVICE, Waveform([0.0, 1.0], 2.0, looped=False))
