"""Refinement: computed cells, interpolated cells, and their agreement with the full map."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vijax import plots, sweep
from vijax.maps import refinement
from vijax.maps.refinement import Mesh
from vijax.maps.sweep import load, plan, save
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.records import Status
from vijax.plots import kind_maps, number_maps

LEVELS = 3
LINE = np.linspace(0.0, 1.0, 65)


def prescribed_map(axes, kind=None, power=None, **fields):
    """Return a map with prescribed results: `kind` gives the period and `power` gives P as functions of the axes."""
    x = np.meshgrid(*axes, indexing="ij")
    ones = np.ones(x[0].shape)
    plane = {
        "P": np.exp(sum(x)) if power is None else power(*x),
        "P_stderr": 0 * ones,
        "period": ones if kind is None else kind(*x),
        "impacts_left": ones,
        "impacts_right": ones,
        "restitution_left": 0.5 * ones,
        "restitution_right": 0.5 * ones,
        "status": 0 * ones,
        "periods_run": 30 * ones,
    } | {name: field(*x) for name, field in fields.items()}
    integers = ("period", "impacts_left", "impacts_right", "status")
    plane = {name: (1 * values).ravel().astype(int if name in integers else float) for name, values in plane.items()}
    return plane | {name: plane[name][:, None] for name in ("P", "P_stderr")}


def refined(axes, plane, levels=LEVELS, level_ground=True):
    """Refine a prescribed map; return its variables and the mask of the computed cells."""
    mesh = Mesh(tuple(axes), levels)
    shape = tuple(axis.size for axis in axes)
    ground = np.full(plane["period"].size, level_ground)
    result = {name: np.full_like(values, -99) for name, values in plane.items()}
    computed = np.zeros(plane["period"].size, bool)
    for cells in refinement.cells_by_round(mesh, result, ground):
        assert not computed[cells].any()
        computed[cells] = True
        for name, values in plane.items():
            result[name][cells] = values[cells]
    refinement.interpolate_missing(mesh, result, computed, ground)
    return {name: values.reshape(shape) for name, values in result.items()}, computed.reshape(shape)


def lattice_size(axes, levels):
    return np.prod([len({*range(0, axis.size, 2**levels), axis.size - 1}) for axis in axes])


# --- maps without borders ------------------------------------------------------------------------------------------


ODD = {
    "one axis": [np.linspace(1, 2, 100)],
    "odd lengths": [np.linspace(0, 1, 50), np.linspace(0, 1, 37)],
    "three axes": [np.linspace(0, 1, 34), np.linspace(0, 1, 40), np.linspace(0, 1, 33)],
    "irregular": [np.geomspace(1, 400, 41), np.sort(np.random.default_rng(1).uniform(size=60))],
    "falling": [np.linspace(1, 0, 44), np.linspace(0, 1, 33)],
    "out of order": [np.random.default_rng(2).uniform(size=45), np.linspace(0, 1, 36)],
    "repeated": [np.repeat(np.linspace(0, 1, 12), 3), np.linspace(0, 1, 33)],
}


@pytest.mark.parametrize("axes", ODD.values(), ids=ODD)
def test_power_law_is_interpolated_exactly_from_the_coarsest_lattice(axes):
    def law(*x):
        return np.prod([y**1.5 if (y > 0).all() else np.exp(y / 3) for y in x], axis=0)

    plane = prescribed_map(axes, power=law)
    result, computed = refined(axes, plane)
    assert computed.sum() == lattice_size(axes, LEVELS)
    np.testing.assert_allclose(result["P"].ravel(), plane["P"].ravel(), rtol=1e-12)


def test_last_point_of_all_axes_is_computed():
    axes = [np.linspace(0, 1, 44), np.linspace(0, 1, 61)]
    _, computed = refined(axes, prescribed_map(axes))
    assert computed[-1, -1]
    assert computed[-1].sum() == len({*range(0, 61, 8), 60})


def test_a_short_axis_is_coarsened_less():
    axes = [LINE, np.array([0.0, 0.1, 0.5, 0.6, 1.0]), np.linspace(0, 1, 20)]
    _, computed = refined(axes, prescribed_map(axes))
    assert computed.sum() == 9 * 5 * len({*range(0, 20, 4), 19})


@pytest.mark.parametrize(("points", "levels"), [(8, 0), (9, 1), (16, 1), (17, 2), (129, 5), (1024, 7)])
def test_coarsest_lattice_has_at_least_four_steps(points, levels):
    assert refinement.max_levels(points) == levels


# --- borders --------------------------------------------------------------------------------------------------------


def touches_another_kind(kind):
    """Return True for cells with a neighbour of another kind along an axis."""
    touching = np.zeros(kind.shape, bool)
    for axis in range(kind.ndim):
        a, b = np.moveaxis(kind, axis, 0), np.moveaxis(touching, axis, 0)
        b[1:] |= a[1:] != a[:-1]
        b[:-1] |= a[1:] != a[:-1]
    return touching


def disc(*x):
    return 1 + (sum((y - 0.47) ** 2 for y in x) < 0.09)


@pytest.mark.parametrize("axes", [[LINE], [LINE, LINE], [LINE[:50:2] * 1.3, LINE[::2], LINE[::3]]], ids=len)
def test_cells_at_a_border_are_computed(axes):
    plane = prescribed_map(axes, kind=disc, power=lambda *x: np.exp(sum(x)) * 100 ** disc(*x))
    result, computed = refined(axes, plane, levels=2)
    border = touches_another_kind(plane["period"].reshape(computed.shape))
    assert computed[border].all()
    np.testing.assert_array_equal(result["period"].ravel(), plane["period"])
    np.testing.assert_allclose(result["P"].ravel(), plane["P"].ravel(), rtol=refinement.P_RTOL)
    assert computed.sum() < computed.size


def test_neighbours_of_a_block_on_a_border_are_split():
    _, computed = refined(
        [LINE], prescribed_map([LINE], kind=lambda x: 1 + (x > LINE[32]), power=lambda x: 1 + 0 * x), levels=1
    )
    np.testing.assert_array_equal(np.flatnonzero(computed[1::2]) * 2 + 1, [31, 33, 35])


def test_number_of_computed_cells_scales_with_the_length_of_the_border():
    axes = [np.linspace(0, 1, 513)] * 2
    _, computed = refined(axes, prescribed_map(axes, kind=disc, power=lambda *x: 1 + 0 * x[0]))
    assert computed.mean() < 0.06


def test_tongue_that_the_coarse_lattice_misses_is_followed():
    # The coarse lattice misses the thin tongue; the border splits a block that contains its end.
    def tongue(x, y):
        return 1 + ((y > 0.5) | ((abs(x - 0.46) < 0.02) & (y > 0.05)))

    axes = [LINE, LINE]
    plane = prescribed_map(axes, kind=tongue)
    result, _ = refined(axes, plane)
    np.testing.assert_array_equal(result["period"].ravel(), plane["period"])


@given(seed=st.integers(0, 10**6), levels=st.integers(1, 3), shape=st.tuples(*[st.integers(33, 50)] * 2))
@example(seed=1, levels=2, shape=(35, 34))  # narrow blocks at the ends; only their neighbours request their corners
@example(seed=53, levels=3, shape=(35, 34))
@settings(max_examples=15)
def test_computed_cells_agree_with_the_interpolation_around_them(seed, levels, shape):
    """Check all blocks of all levels: a block is either computed completely or of one kind within the tolerance."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(-9, 9, (2, 4))
    axes = [np.linspace(0, 1, size) for size in shape]

    def wave(x, y):
        return sum(np.sin(a * x + b * y + 3 * a) for a, b in waves.T)

    def speckled(x, y):
        return np.where(rng.uniform(size=x.shape) < 0.01, 3, 1 + (wave(x, y) > 1))

    plane = prescribed_map(axes, kind=speckled, power=lambda x, y: np.exp(wave(x, y)))
    result, computed = refined(axes, plane, levels)
    kind, power = plane["period"].reshape(shape), plane["P"].reshape(shape)
    mesh = Mesh(tuple(axes), levels)
    for level in range(1, levels + 1):
        sides = [itertools.pairwise(mesh.ranks(axis, level)) for axis in (0, 1)]
        halves = [mesh.ranks(axis, level - 1) for axis in (0, 1)]
        for (a, b), (c, d) in itertools.product(*sides):
            inside, ends = np.s_[a : b + 1, c : d + 1], np.ix_([a, b], [c, d])
            within = np.ix_(
                *(half[(low <= half) & (half <= high)] for half, low, high in zip(halves, (a, c), (b, d), strict=True))
            )
            if not computed[ends].all() or computed[within].all():
                continue
            corners = kind[ends]
            assert (kind[inside][computed[inside]] == corners[0, 0]).all()
            assert (result["period"][inside] == corners[0, 0]).all()
            x, y = ((ranks - ranks[0]) / (ranks[-1] - ranks[0]) for ranks in (np.arange(a, b + 1), np.arange(c, d + 1)))
            logs = np.log(power[ends])
            guess = np.stack([1 - x, x]).T @ logs @ np.stack([1 - y, y])
            assert (abs(guess - np.log(power[inside]))[computed[inside]] <= refinement.P_RTOL).all()


def test_status_alone_makes_a_border():
    axes = [LINE, LINE]
    plane = prescribed_map(axes, status=lambda x, y: np.where(x > 0.51, Status.STICKING, Status.OK))
    result, computed = refined(axes, plane)
    np.testing.assert_array_equal(result["status"].ravel(), plane["status"])
    assert computed[[32, 33]].all()


def test_failed_cells_are_a_separate_kind():
    axes = [LINE, LINE]
    plane = prescribed_map(
        axes,
        power=lambda x, y: np.where(x > 0.51, np.nan, 1.0),
        kind=lambda x, y: np.where(x > 0.51, -1, 1),
        status=lambda x, y: np.where(x > 0.51, Status.NONFINITE, Status.OK),
    )
    result, computed = refined(axes, plane)
    np.testing.assert_array_equal(result["P"].ravel(), plane["P"].ravel())
    assert computed.mean() < 0.5


def test_cells_without_energy_are_a_separate_kind():
    axes = [LINE]
    plane = prescribed_map(axes, power=lambda x: np.where(x < 0.49, 0.0, 1.0))
    result, computed = refined(axes, plane)
    np.testing.assert_array_equal(result["P"][LINE < 0.49], 0)
    assert computed[[31, 32]].all()


# --- P --------------------------------------------------------------------------------------------------------------


def resonance(x, y):
    return 1 / ((x - 0.4) ** 2 + 0.01) + y


def test_smooth_peak_is_within_the_tolerance_and_refined_locally():
    axes = [np.linspace(0, 1, 257), LINE]
    plane = prescribed_map(axes, power=resonance)
    result, computed = refined(axes, plane)
    np.testing.assert_allclose(result["P"].ravel(), plane["P"].ravel(), rtol=refinement.P_RTOL)
    assert lattice_size(axes, LEVELS) < computed.sum() < 0.3 * computed.size
    assert computed[80:120].mean() > 2 * computed[200:].mean()


def test_largest_deviation_of_all_variants_decides():
    axes = [np.linspace(0, 1, 257), LINE]
    plane, plain = prescribed_map(axes, power=resonance), prescribed_map(axes)
    for name in ("P", "P_stderr"):
        plane[name] = np.concatenate([plain[name], plane[name]], axis=1)
    ground = np.ones(plane["period"].size, bool)
    mesh, computed = Mesh(tuple(axes), LEVELS), ~ground
    for cells in refinement.cells_by_round(mesh, plane, ground):
        computed[cells] = True
    filled = {name: np.where(computed.reshape(-1, *[1] * (v.ndim - 1)), v, -99) for name, v in plane.items()}
    refinement.interpolate_missing(mesh, filled, computed, ground)
    np.testing.assert_allclose(filled["P"], plane["P"], rtol=refinement.P_RTOL)


@pytest.mark.parametrize(("error", "refined_too"), [(0.1, False), (0.0, True)])
def test_noise_within_its_standard_error_is_not_refined(error, refined_too):
    axes = [LINE, LINE]
    noise = np.random.default_rng(3).uniform(-0.1, 0.1, (65, 65))
    plane = prescribed_map(axes, power=lambda x, y: 1 + noise, P_stderr=lambda x, y: error + 0 * x)
    _, computed = refined(axes, plane)
    assert (computed.sum() > lattice_size(axes, LEVELS)) == refined_too


# --- interpolated cells ---------------------------------------------------------------------------------------------


@pytest.fixture
def mirrors():
    """Return a map of 1:2 orbits and their mirror images 2:1 in random cells."""
    axes = [LINE, LINE]
    turned = np.random.default_rng(4).uniform(size=(65, 65)) < 0.5

    def sided(turned_value, usual_value):
        return lambda x, y: np.where(turned, turned_value(x), usual_value(x))

    single, double = (lambda x: 1), (lambda x: 2)
    low, high = (lambda x: 0.3 + 0.1 * x), (lambda x: 0.8 - 0.1 * x)
    return axes, prescribed_map(
        axes,
        impacts_left=sided(double, single),
        impacts_right=sided(single, double),
        restitution_left=sided(high, low),
        restitution_right=sided(low, high),
        asymmetry=sided(lambda x: -0.2 - x, lambda x: 0.2 + x),
    )


def test_mirror_images_are_a_single_kind_and_interpolated_cells_take_either(mirrors):
    axes, plane = mirrors
    result, computed = refined(axes, plane)
    assert computed.sum() == lattice_size(axes, LEVELS)
    turned = result["impacts_left"] == 2
    assert 0.2 < turned.mean() < 0.8
    np.testing.assert_array_equal(result["impacts_right"], np.where(turned, 1, 2))
    x = LINE[:, None] + 0 * LINE
    np.testing.assert_allclose(result["restitution_left"], np.where(turned, 0.8 - 0.1 * x, 0.3 + 0.1 * x), rtol=2e-3)
    np.testing.assert_allclose(result["restitution_right"], np.where(turned, 0.3 + 0.1 * x, 0.8 - 0.1 * x), rtol=2e-3)
    np.testing.assert_allclose(result["asymmetry"], np.where(turned, -0.2 - x, 0.2 + x), rtol=5e-2)


def test_with_gravity_mirror_images_are_two_kinds(mirrors):
    axes, plane = mirrors
    result, computed = refined(axes, plane, level_ground=False)
    np.testing.assert_array_equal(result["impacts_left"].ravel(), plane["impacts_left"])
    assert computed.mean() > 0.99


def test_interpolated_cells_have_no_simulated_periods():
    axes = [LINE, LINE]
    result, computed = refined(axes, prescribed_map(axes))
    np.testing.assert_array_equal(result["periods_run"], np.where(computed, 30, 0))


# --- sweeps ---------------------------------------------------------------------------------------------------------

# Two calls of the smallest tile on two cores; other tests compile the same program.
AXES = {"d": np.linspace(0.2, 0.3, 66), "kappa": np.geomspace(20, 200, 31)}
PERIODS = 60


@pytest.fixture(scope="module")
def both():
    """Return the full map, the refined map, and the arguments of the progress callback of the refined map."""
    reports = []
    full = sweep(**AXES, periods=PERIODS)
    return full, sweep(**AXES, periods=PERIODS, refine=2, progress=lambda *counts: reports.append(counts)), reports


def test_computed_cells_are_bit_identical_to_the_full_sweep(both):
    full, refined_map, _ = both
    computed = refined_map.computed.values
    assert computed.dtype == bool
    assert 0.1 < computed.mean() < 0.95
    assert set(refined_map.data_vars) == {*full.data_vars, "computed"}
    for name in full.data_vars:
        np.testing.assert_array_equal(
            full[name].values[computed], refined_map[name].values[computed], err_msg=str(name)
        )
        assert refined_map[name].dims == full[name].dims
        assert refined_map[name].dtype == full[name].dtype
    assert not (refined_map["P"] == full["P"]).values[~computed].all()


def test_interpolated_cells_are_close_to_the_full_sweep(both):
    full, refined_map, _ = both
    filled = ~refined_map.computed.values
    same_period = (full.period == refined_map.period).values[filled]
    assert same_period.mean() > 0.95
    deviation = abs(refined_map.P / full.P - 1).values[filled][same_period]
    assert (deviation < refinement.P_RTOL).mean() > 0.95
    np.testing.assert_array_equal(refined_map.periods_run.values[filled], 0)


def test_attributes_count_the_computed_cells(both):
    full, refined_map, _ = both
    assert refined_map.attrs["refine"] == 2
    assert refined_map.attrs["refine_tolerance"] == refinement.P_RTOL
    assert refined_map.attrs["refine_computed"] == refined_map.computed.values.sum()
    assert refined_map.attrs["refine_shown"] == refined_map.computed.size
    assert not [name for name in full.attrs if "refine" in name]


def test_progress_total_grows_with_the_requested_cells(both):
    _, refined_map, reports = both
    done, total = (np.array(column) for column in zip(*reports, strict=True))
    assert reports[0] == (0, lattice_size(AXES.values(), 2))
    assert (np.diff(done) >= 0).all()
    assert (np.diff(total) >= 0).all()
    assert reports[-1] == (refined_map.computed.values.sum(),) * 2


def test_refined_map_is_plotted_and_stored(both, tmp_path):
    _, refined_map, _ = both
    for draw in (number_maps.power_map, kind_maps.label_map):
        plots.save(draw(refined_map), tmp_path / f"{draw.__name__}.png")
    save(refined_map, tmp_path / "map.zarr")
    loaded = load(tmp_path / "map.zarr")
    assert loaded.identical(refined_map)


@pytest.mark.long
def test_variants_are_interpolated_and_outputs_are_selected():
    result = sweep(d=np.linspace(0.25, 0.3, 18), A=[1.0, 2.0], kappa=300.0, outputs=["P"], periods=PERIODS, refine=1)
    assert set(result.data_vars) == {"P", "status", "computed"}
    assert result.computed.dims == ("d",)
    assert result.computed.values[[0, 2, 16, 17]].all()
    assert not result.computed.values.all()
    curve = np.log(result.P.values)
    assert curve.shape == (18, 2)
    assert (abs(np.diff(curve, 2, axis=0)) < refinement.P_RTOL).all()


BAD = [
    (0, {}, "refine must be a whole number of at least 1; got 0"),
    (1.5, {}, "refine must be a whole number of at least 1; got 1.5"),
    ("two", {}, "refine must be a whole number of at least 1; got 'two'"),
    (5, {}, "at most 4 levels for 66 values; got 5"),
    (1, {"d": 0.2, "kappa": 30.0}, "at most 0 levels for 1 values; got 1"),
    (1, {"d": np.linspace(0.1, 0.3, 8), "kappa": 30.0}, "at most 0 levels for 8 values; got 1"),
    (2, {"wall": "rigid", "d": 0.2}, "at most 0 levels for 1 values; got 2"),  # kappa changes only the energies there
    (2, {"until": "window"}, "refine must be left out with until='window', whose cells have no label; got 2"),
]


@pytest.mark.parametrize(
    ("levels", "changes", "message"), BAD, ids=[f"{levels}-{message[:20]}" for levels, _, message in BAD]
)
def test_invalid_levels_are_rejected(levels, changes, message):
    choices = {"until": "attractor", "wall": "soft"}
    axes = AXES | choices | changes
    chosen = SweepSettings(**{name: axes.pop(name) for name in choices})
    with pytest.raises(ValueError, match="refine") as error:
        plan(axes, None, None, chosen, levels)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
