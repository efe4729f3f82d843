"""Basins, fractions: planted attractors are found again, and known ones in the engine's motion."""

import functools

import numpy as np
import pytest
import xarray as xr

from vijax.model.records import Status
from vijax.planes import basins as tables
from vijax.planes import sweep
from vijax.planes.basins import basin_fractions, basins, matched, plan_basins, plan_fractions
from vijax.planes.sweep_settings import SweepSettings

NOISE = 1e-10  # of invariants from start to start; the engine's is below 3e-11


def planted(kinds, which, dims=("d", "u0", "v0"), noise=NOISE, **further):
    """A sweep whose starts end on the attractors that `which` tells, of the kinds given by their invariants."""
    random = np.random.default_rng(3)
    blank = {"status": 0, "max_impact_speed": 0.5, "asymmetry": 0.1, "contact_fraction": 0.2, "P": 1e-6}
    blank |= {"restitution_left": 0.4, "restitution_right": 0.5, "impacts_per_period": 2.0, "lyapunov": -0.5}
    blank |= {"period": 1, "impacts_left": 1, "impacts_right": 1, "admissible": True, "periods_run": 40.0}
    which = np.asarray(which)
    found = {}
    for name, usual in blank.items():
        values = np.array([kind.get(name, usual) for kind in kinds])[which]
        if name in tables.INVARIANTS:
            values = values * (1 + noise * random.uniform(-1, 1, which.shape))
        found[name] = (dims, values)
    return xr.Dataset(found | further)


def same_partition(basin, which) -> bool:
    pairs = set(zip(np.ravel(basin), np.ravel(which), strict=True))
    return len(pairs) == len(set(np.ravel(basin))) == len(set(np.ravel(which)))


APART = {
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


@pytest.mark.parametrize("other", APART.values(), ids=APART)
def test_whatever_tells_attractors_apart_does(other):
    which = np.random.default_rng(1).integers(0, 2, (1, 12, 15))
    assert same_partition(matched(planted([{}, other], which)).basin, which)


def test_every_cell_has_its_own_table_the_commonest_first():
    kinds = [{"P": 1e-6}, {"period": 2, "impacts_right": 2, "P": 2e-6}, {"max_impact_speed": 0.7, "P": 3e-6}]
    which = np.zeros((3, 4, 5), int)
    which[0, :, :3] = 1
    which[1, 1:] = 2
    which[1, 0, 0] = 1
    found = matched(planted(kinds, which))
    assert found.basin.dims == ("d", "u0", "v0")
    assert found.label.values.tolist() == [["1:2/2T", "1:1", ""], ["1:1", "1:1", "1:2/2T"], ["1:1", "", ""]]
    assert found.starts.values.tolist() == [[12, 8, 0], [15, 4, 1], [20, 0, 0]]
    assert found.attractors.values.tolist() == [2, 3, 1]
    np.testing.assert_allclose(found.fraction.sum("attractor"), 1.0)
    assert float(found.fraction_stderr[0, 0]) == pytest.approx((0.6 * 0.4 / 20) ** 0.5)
    np.testing.assert_allclose(found.P.values[1], [3e-6, 1e-6, 2e-6])
    assert np.isnan(found.P.values[2, 1])
    for cell in range(3):
        power = found.P.values[cell][found.basin.values[cell]]
        np.testing.assert_allclose(power, np.array([1e-6, 2e-6, 3e-6])[which[cell]])


def test_mirror_images_merge_on_request():
    one = {"period": 2, "impacts_left": 1, "impacts_right": 2}
    image = {"period": 2, "impacts_left": 2, "impacts_right": 1, "asymmetry": -0.1}
    image |= {"restitution_left": 0.5, "restitution_right": 0.4}
    which = np.random.default_rng(2).choice(3, (1, 20, 20), p=[0.3, 0.6, 0.1])
    data = planted([one, image, {}], which)
    assert matched(data).attractors == 3
    assert matched(data).label.values.tolist() == [["2:1/2T", "1:2/2T", "1:1"]]
    merged = matched(data, merge_mirrors=True)
    assert merged.label.values.tolist() == [["1:2/2T", "1:1"]]
    assert (merged.impacts_left.values[0, 0], merged.impacts_right.values[0, 0]) == (1, 2)
    assert merged.starts.values[0, 0] == (which < 2).sum()
    other_pair = data.assign(asymmetry=data.asymmetry * np.where(which == 0, 2.0, 1.0))
    assert matched(other_pair, merge_mirrors=True).attractors == 3


def test_a_cloud_of_starts_wider_than_the_tolerance_is_not_one_orbit():
    which = np.zeros((1, 30, 30), int)
    assert matched(planted([{}], which, noise=1e-7)).attractors == 1
    assert matched(planted([{}], which, noise=1e-2)).attractors > 1


def test_chaos_is_one_entry_whatever_its_averages_and_says_how_long_was_looked():
    chaos = {"period": 0, "impacts_left": -1, "impacts_right": -1, "periods_run": 400.0, "lyapunov": 0.7}
    slow = {"period": -1, "impacts_left": -1, "impacts_right": -1, "status": Status.SLOW}
    failed = slow | {"status": Status.NONFINITE}
    which = np.concatenate([np.repeat([0, 0, 0, 1, 2], 18), np.full(10, 3)]).reshape(1, 10, 10)
    data = planted([chaos, slow, {}, failed], which, noise=0.1)
    data["P"][:] = np.random.default_rng(4).uniform(0.9e-6, 1.1e-6, which.shape)
    quiet = data.where(which != 2, planted([{}], 0 * which))
    found = matched(quiet.astype({name: data[name].dtype for name in data}))
    assert found.label.values.tolist() == [["aperiodic", "undecided", "1:1", "failed"]]
    assert found.periodic.values.tolist() == [[False, False, True, False]]
    assert found.periods_run.values[0, 0] == 400
    assert found.attractors == 2  # undecided and failed starts are none
    assert float(found.P[0, 0]) == pytest.approx(float(data.P.values[which == 0].mean()))


def test_energies_keep_dimensions_that_the_motion_does_not_depend_on():
    which = np.random.default_rng(5).integers(0, 2, (6, 7))
    data = planted([{"period": 2}, {}], which, dims=("u0", "v0"))
    factor = xr.DataArray([1.0, 4.0], dims="A")
    found = matched(data.assign(P=data.P * factor, max_impact_speed=factor * data.max_impact_speed))
    assert found.P.dims == ("A", "attractor")
    np.testing.assert_allclose(found.P, [[1e-6, 1e-6], [4e-6, 4e-6]])
    assert same_partition(found.basin, which)


# --- starts -----------------------------------------------------------------------------------------------------------


def drawn(**given):
    rigid = SweepSettings(wall="rigid")
    of = plan_fractions({"d": [0.1, 0.3], "kappa": 10.0}, settings=rigid, starts=2000, **given).cells
    return (of.quantities[name].transpose(..., "start").values for name in ("u0", "v0"))


@pytest.mark.parametrize("seed", [None, 7])
def test_starts_fill_the_gap_and_the_speeds_evenly(seed):
    u0, v0 = drawn(seed=seed)
    assert u0.shape == (2, 2000)
    for places, reach in ((u0[0], 0.05), (u0[1], 0.15), (v0, 0.6)):
        assert np.all(abs(places) < reach)
        counts, _ = np.histogram(places, 10, (-reach, reach))
        assert np.all(abs(counts - 200) < (15 if seed is None else 60)), counts
    assert abs(np.corrcoef(u0[0], v0)[0, 1]) < 0.06


def test_a_seed_tells_the_starts():
    (first, _), (again, _), (other, _) = drawn(seed=1), drawn(seed=1), drawn(seed=2)
    np.testing.assert_array_equal(first, again)
    assert np.all(first != other)


def test_a_plane_covers_the_widest_gap_unless_told():
    of = plan_basins({"d": [0.1, 0.2], "kappa": 3.0, "v0": np.linspace(-1, 1, 9)}).cells
    assert of.sizes == {"u0": 9, "v0": 9, "d": 2}
    np.testing.assert_allclose(of.given["u0"].values[[0, -1]], [-0.1 + 0.1 / 9, 0.1 - 0.1 / 9])


@pytest.mark.parametrize(
    ("call", "say"),
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
def test_bad_input_runs_nothing(monkeypatch, call, say):
    monkeypatch.setattr(sweep, "run", None)
    with pytest.raises((ValueError, TypeError), match=say):
        call()


# --- the engine's attractors ------------------------------------------------------------------------------------------


@functools.cache
def known():
    """The three of d = 0.2, kappa = 3, and beyond 2/pi^2 motions that touch no wall; one compiled program."""
    return basin_fractions(d=[0.2, 0.3], kappa=3.0, r=0.5, starts=500, periods=200)


@pytest.mark.long
def test_three_attractors_coexist_in_known_shares():
    found = known().isel(d=0)
    shares = dict(zip(found.label.values, found.fraction.values, strict=True))
    assert set(shares) - {""} == {"1:2/2T", "2:1/2T", "2:2/3T", "1:1"}
    assert shares["1:2/2T"] + shares["2:1/2T"] == pytest.approx(0.571, abs=0.05)
    assert shares["2:2/3T"] == pytest.approx(0.422, abs=0.05)
    energies = dict(zip(found.label.values, found.P.values, strict=True))
    assert energies["1:2/2T"] == pytest.approx(energies["2:1/2T"], rel=1e-12)


def test_the_sign_of_the_mean_impact_velocity_tells_mirror_images_apart():
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
    apart = known().isel(d=0)
    merged = basin_fractions(d=[0.2, 0.3], kappa=3.0, r=0.5, starts=500, periods=200, merge_mirrors=True).isel(d=0)
    assert merged.label.values[:3].tolist() == ["1:2/2T", "2:2/3T", "1:1"]
    pair = np.isin(apart.label.values, ["1:2/2T", "2:1/2T"])
    assert merged.fraction.values[0] == pytest.approx(apart.fraction.values[pair].sum())


def test_the_neutral_family_is_one_entry():
    # From rest at the phase 0 the ball goes 2/pi^2 = 0.203 to the right and back.
    found = basins(d=0.3, kappa=3.0, r=0.5, u0=np.linspace(-0.14, -0.06, 5), v0=[0.0, 0.3], periods=200)
    words = found.label.values[found.basin.values]
    assert words[:, 0].tolist() == ["no impact"] * 5
    assert (found.label == "no impact").sum() == 1
    assert found.P[found.label.values == "no impact"] == 0
    assert found.basin.dims == ("u0", "v0")


def test_what_looks_like_chaos_says_for_how_long():
    found = known().isel(d=1)
    assert found.label.values[0] == "aperiodic"
    assert found.periods_run[0] >= 200  # one of its starts went on, undecided by then
    assert found.lyapunov[0] > 0.3
    assert not found.periodic[0]
