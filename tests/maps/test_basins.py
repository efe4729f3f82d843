"""Basins and basin fractions: planted attractors are recovered, and the engine reproduces known attractors."""

import functools

import numpy as np
import pytest
import xarray as xr

from vijax.maps import basins as tables
from vijax.maps import sweep
from vijax.maps.basins import basin_fractions, basins, match_attractors, plan_basins, plan_fractions
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.records import Status

NOISE = 1e-10  # relative scatter of the invariants between starts; the engine's scatter is below 3e-11


def planted(kinds, indices, dims=("d", "u0", "v0"), noise=NOISE, **extra):
    """Return a sweep result: `kinds` lists the invariants of the attractors, `indices` selects one for each start."""
    random = np.random.default_rng(3)
    defaults = {"status": 0, "max_impact_speed": 0.5, "asymmetry": 0.1, "contact_fraction": 0.2, "P": 1e-6}
    defaults |= {"restitution_left": 0.4, "restitution_right": 0.5, "impacts_per_period": 2.0, "lyapunov": -0.5}
    defaults |= {"period": 1, "impacts_left": 1, "impacts_right": 1, "admissible": True, "periods_run": 40.0}
    indices = np.asarray(indices)
    variables = {}
    for name, default in defaults.items():
        values = np.array([kind.get(name, default) for kind in kinds])[indices]
        if name in tables.INVARIANTS:
            values = values * (1 + noise * random.uniform(-1, 1, indices.shape))
        variables[name] = (dims, values)
    return xr.Dataset(variables | extra)


def same_partition(basin, indices) -> bool:
    pairs = set(zip(np.ravel(basin), np.ravel(indices), strict=True))
    return len(pairs) == len(set(np.ravel(basin))) == len(set(np.ravel(indices)))


DIFFERENCES = {
    "period": {"period": 2},
    "counts": {"impacts_left": 2},
    "other counts": {"impacts_right": 2},
    "speed": {"max_impact_speed": 0.501},
    "contact": {"contact_fraction": 0.2002},
    "restitution": {"restitution_right": 0.501},
    "mirror image": {"asymmetry": -0.1},
    "aperiodic": {"period": 0, "impacts_left": -1, "impacts_right": -1},
    "undecided": {"period": -1, "impacts_left": -1, "impacts_right": -1, "status": Status.SLOW},
    "failed": {"period": -1, "impacts_left": -1, "impacts_right": -1, "status": Status.NONFINITE},
}


@pytest.mark.parametrize("other", DIFFERENCES.values(), ids=DIFFERENCES)
def test_attractors_that_differ_in_an_invariant_are_separated(other):
    indices = np.random.default_rng(1).integers(0, 2, (1, 12, 15))
    assert same_partition(match_attractors(planted([{}, other], indices)).basin, indices)


def test_table_of_a_cell_is_sorted_by_decreasing_basin_fraction():
    kinds = [{"P": 1e-6}, {"period": 2, "impacts_right": 2, "P": 2e-6}, {"max_impact_speed": 0.7, "P": 3e-6}]
    indices = np.zeros((3, 4, 5), int)
    indices[0, :, :3] = 1
    indices[1, 1:] = 2
    indices[1, 0, 0] = 1
    result = match_attractors(planted(kinds, indices))
    assert result.basin.dims == ("d", "u0", "v0")
    assert result.label.values.tolist() == [["1:2/2T", "1:1", ""], ["1:1", "1:1", "1:2/2T"], ["1:1", "", ""]]
    assert result.starts.values.tolist() == [[12, 8, 0], [15, 4, 1], [20, 0, 0]]
    assert result.attractors.values.tolist() == [2, 3, 1]
    np.testing.assert_allclose(result.fraction.sum("attractor"), 1.0)
    assert float(result.fraction_stderr[0, 0]) == pytest.approx((0.6 * 0.4 / 20) ** 0.5)
    np.testing.assert_allclose(result.P.values[1], [3e-6, 1e-6, 2e-6])
    assert np.isnan(result.P.values[2, 1])
    for cell in range(3):
        power = result.P.values[cell][result.basin.values[cell]]
        np.testing.assert_allclose(power, np.array([1e-6, 2e-6, 3e-6])[indices[cell]])


def test_mirror_images_merge_on_request():
    orbit = {"period": 2, "impacts_left": 1, "impacts_right": 2}
    image = {"period": 2, "impacts_left": 2, "impacts_right": 1, "asymmetry": -0.1}
    image |= {"restitution_left": 0.5, "restitution_right": 0.4}
    indices = np.random.default_rng(2).choice(3, (1, 20, 20), p=[0.3, 0.6, 0.1])
    data = planted([orbit, image, {}], indices)
    assert match_attractors(data).attractors == 3
    assert match_attractors(data).label.values.tolist() == [["2:1/2T", "1:2/2T", "1:1"]]
    merged = match_attractors(data, merge_mirrors=True)
    assert merged.label.values.tolist() == [["1:2/2T", "1:1"]]
    assert (merged.impacts_left.values[0, 0], merged.impacts_right.values[0, 0]) == (1, 2)
    assert merged.starts.values[0, 0] == (indices < 2).sum()
    unrelated = data.assign(asymmetry=data.asymmetry * np.where(indices == 0, 2.0, 1.0))
    assert match_attractors(unrelated, merge_mirrors=True).attractors == 3


def test_starts_that_scatter_more_than_the_tolerance_are_several_attractors():
    indices = np.zeros((1, 30, 30), int)
    assert match_attractors(planted([{}], indices, noise=1e-7)).attractors == 1
    assert match_attractors(planted([{}], indices, noise=1e-2)).attractors > 1


def test_chaos_is_a_single_entry_with_the_number_of_simulated_periods():
    chaos = {"period": 0, "impacts_left": -1, "impacts_right": -1, "periods_run": 400.0, "lyapunov": 0.7}
    slow = {"period": -1, "impacts_left": -1, "impacts_right": -1, "status": Status.SLOW}
    failed = slow | {"status": Status.NONFINITE}
    indices = np.concatenate([np.repeat([0, 0, 0, 1, 2], 18), np.full(10, 3)]).reshape(1, 10, 10)
    data = planted([chaos, slow, {}, failed], indices, noise=0.1)
    data["P"][:] = np.random.default_rng(4).uniform(0.9e-6, 1.1e-6, indices.shape)
    mixed = data.where(indices != 2, planted([{}], 0 * indices))
    result = match_attractors(mixed.astype({name: data[name].dtype for name in data}))
    assert result.label.values.tolist() == [["aperiodic", "undecided", "1:1", "failed"]]
    assert result.periodic.values.tolist() == [[False, False, True, False]]
    assert result.periods_run.values[0, 0] == 400
    assert result.attractors == 2  # undecided and failed starts are not attractors
    assert float(result.P[0, 0]) == pytest.approx(float(data.P.values[indices == 0].mean()))


def test_energies_keep_dimensions_that_the_motion_does_not_depend_on():
    indices = np.random.default_rng(5).integers(0, 2, (6, 7))
    data = planted([{"period": 2}, {}], indices, dims=("u0", "v0"))
    factor = xr.DataArray([1.0, 4.0], dims="A")
    result = match_attractors(data.assign(P=data.P * factor, max_impact_speed=factor * data.max_impact_speed))
    assert result.P.dims == ("A", "attractor")
    np.testing.assert_allclose(result.P, [[1e-6, 1e-6], [4e-6, 4e-6]])
    assert same_partition(result.basin, indices)


# --- starts -----------------------------------------------------------------------------------------------------------


def draw_starts(**options):
    rigid = SweepSettings(wall="rigid")
    plan_cells = plan_fractions({"d": [0.1, 0.3], "kappa": 10.0}, settings=rigid, starts=2000, **options).cells
    return (plan_cells.quantities[name].transpose(..., "start").values for name in ("u0", "v0"))


@pytest.mark.parametrize("seed", [None, 7])
def test_starts_fill_the_gap_and_the_speeds_evenly(seed):
    u0, v0 = draw_starts(seed=seed)
    assert u0.shape == (2, 2000)
    for values, limit in ((u0[0], 0.05), (u0[1], 0.15), (v0, 0.6)):
        assert np.all(abs(values) < limit)
        counts, _ = np.histogram(values, 10, (-limit, limit))
        assert np.all(abs(counts - 200) < (15 if seed is None else 60)), counts
    assert abs(np.corrcoef(u0[0], v0)[0, 1]) < 0.06


def test_starts_depend_on_the_seed():
    (first, _), (again, _), (other, _) = draw_starts(seed=1), draw_starts(seed=1), draw_starts(seed=2)
    np.testing.assert_array_equal(first, again)
    assert np.all(first != other)


def test_default_plane_of_starts_covers_the_widest_gap():
    plan_cells = plan_basins({"d": [0.1, 0.2], "kappa": 3.0, "v0": np.linspace(-1, 1, 9)}).cells
    assert plan_cells.sizes == {"u0": 9, "v0": 9, "d": 2}
    np.testing.assert_allclose(plan_cells.axes["u0"].values[[0, -1]], [-0.1 + 0.1 / 9, 0.1 - 0.1 / 9])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: basins(d=0.2, gamma=[0.0, 0.1], merge_mirrors=True), "unless gamma is 0 everywhere; got gamma = 0.1"),
        (lambda: basins(d=0.2, u0=[0.2], v0=[0.0], wall="rigid"), "u0 must lie in the gap"),
        (lambda: basins(d=0.2, periods=0), "periods must be"),
        (lambda: basin_fractions(d=0.2, u0=0.1), "u0 must be left out where starts are drawn"),
        (lambda: basin_fractions(d=0.2, starts=0), "starts must be a whole number of at least 1"),
        (lambda: basin_fractions(d=0.2, speed=0.0), "speed must be a positive finite number"),
        (lambda: basin_fractions(d=0.2, colour=1), "there is no axis 'colour'"),
    ],
)
def test_invalid_arguments_are_rejected_before_any_simulation(monkeypatch, call, message):
    monkeypatch.setattr(sweep, "run", None)
    with pytest.raises((ValueError, TypeError), match=message):
        call()


# --- the engine's attractors ------------------------------------------------------------------------------------------


@functools.cache
def reference_basins():
    """Return basins at d = 0.2 (three attractors) and d = 0.3 (chaos, motions without impact) from one program."""
    return basin_fractions(d=[0.2, 0.3], kappa=3.0, r=0.5, starts=500, periods=200)


@pytest.mark.long
def test_three_coexisting_attractors_have_the_expected_fractions():
    result = reference_basins().isel(d=0)
    shares = dict(zip(result.label.values, result.fraction.values, strict=True))
    assert set(shares) - {""} == {"1:2/2T", "2:1/2T", "2:2/3T", "1:1"}
    assert shares["1:2/2T"] + shares["2:1/2T"] == pytest.approx(0.571, abs=0.05)
    assert shares["2:2/3T"] == pytest.approx(0.422, abs=0.05)
    energies = dict(zip(result.label.values, result.P.values, strict=True))
    assert energies["1:2/2T"] == pytest.approx(energies["2:1/2T"], rel=1e-12)


def test_sign_of_the_mean_impact_velocity_separates_mirror_images():
    short = SweepSettings(periods=200)
    swept = sweep.run(plan_fractions({"d": [0.2, 0.3], "kappa": 3.0, "r": 0.5}, settings=short, starts=500)).isel(d=0)
    few, many, both = (
        swept["asymmetry"].values[(swept["impacts_left"] == left) & (swept["impacts_right"] == right)]
        for left, right in ((1, 2), (2, 1), (2, 2))
    )
    assert 0.01 < abs(few[0]) < 1
    np.testing.assert_allclose(few, few[0], rtol=1e-9)
    np.testing.assert_allclose(many, -few[0], rtol=1e-9)
    np.testing.assert_allclose(both, 0.0, atol=1e-9)


@pytest.mark.long
def test_merged_mirror_images_are_the_sum_of_both():
    separate = reference_basins().isel(d=0)
    merged = basin_fractions(d=[0.2, 0.3], kappa=3.0, r=0.5, starts=500, periods=200, merge_mirrors=True).isel(d=0)
    assert merged.label.values[:3].tolist() == ["1:2/2T", "2:2/3T", "1:1"]
    pair = np.isin(separate.label.values, ["1:2/2T", "2:1/2T"])
    assert merged.fraction.values[0] == pytest.approx(separate.fraction.values[pair].sum())


def test_neutral_family_is_a_single_entry():
    # From rest at the phase 0 the ball moves 2/pi^2 = 0.203 to the right and back.
    result = basins(d=0.3, kappa=3.0, r=0.5, u0=np.linspace(-0.14, -0.06, 5), v0=[0.0, 0.3], periods=200)
    labels = result.label.values[result.basin.values]
    assert labels[:, 0].tolist() == ["no impact"] * 5
    assert (result.label == "no impact").sum() == 1
    assert result.P[result.label.values == "no impact"] == 0
    assert result.basin.dims == ("u0", "v0")


def test_aperiodic_entry_has_the_number_of_simulated_periods():
    result = reference_basins().isel(d=1)
    assert result.label.values[0] == "aperiodic"
    assert result.periods_run[0] >= 200  # one start was undecided after 200 periods and was simulated further
    assert result.lyapunov[0] > 0.3
    assert not result.periodic[0]
