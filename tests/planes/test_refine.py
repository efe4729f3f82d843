"""Refinement: what is computed, what is filled, and that neither contradicts the full plane."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vijax import plots, sweep
from vijax.model.records import Status
from vijax.planes import refine
from vijax.planes.refine import Mesh
from vijax.planes.sweep import load, plan, save
from vijax.planes.sweep_settings import SweepSettings
from vijax.plots import kind_maps, number_maps

LEVELS = 3
LINE = np.linspace(0.0, 1.0, 65)


def painted(axes, kind=None, power=None, **fields):
    """A plane whose every cell is known beforehand: kinds of motion by period, and P, each a function of the axes."""
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
    whole = ("period", "impacts_left", "impacts_right", "status")
    plane = {name: (1 * values).ravel().astype(int if name in whole else float) for name, values in plane.items()}
    return plane | {name: plane[name][:, None] for name in ("P", "P_stderr")}


def refined(axes, plane, levels=LEVELS, level_ground=True):
    """What refinement makes of a painted plane, and which cells it asked for."""
    mesh = Mesh(tuple(axes), levels)
    shape = tuple(axis.size for axis in axes)
    ground = np.full(plane["period"].size, level_ground)
    found = {name: np.full_like(values, -99) for name, values in plane.items()}
    known = np.zeros(plane["period"].size, bool)
    for cells in refine.rounds(mesh, found, ground):
        assert not known[cells].any()
        known[cells] = True
        for name, values in plane.items():
            found[name][cells] = values[cells]
    refine.fill(mesh, found, known, ground)
    return {name: values.reshape(shape) for name, values in found.items()}, known.reshape(shape)


def lattice_size(axes, levels):
    return np.prod([len({*range(0, axis.size, 2**levels), axis.size - 1}) for axis in axes])


# --- where nothing happens ------------------------------------------------------------------------------------------


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
def test_a_power_law_is_filled_exactly_from_the_coarsest_lattice(axes):
    def law(*x):
        return np.prod([y**1.5 if (y > 0).all() else np.exp(y / 3) for y in x], axis=0)

    plane = painted(axes, power=law)
    found, known = refined(axes, plane)
    assert known.sum() == lattice_size(axes, LEVELS)
    np.testing.assert_allclose(found["P"].ravel(), plane["P"].ravel(), rtol=1e-12)


def test_the_last_point_of_every_axis_is_computed():
    axes = [np.linspace(0, 1, 44), np.linspace(0, 1, 61)]
    _, known = refined(axes, painted(axes))
    assert known[-1, -1]
    assert known[-1].sum() == len({*range(0, 61, 8), 60})


def test_a_short_axis_is_coarsened_less():
    axes = [LINE, np.array([0.0, 0.1, 0.5, 0.6, 1.0]), np.linspace(0, 1, 20)]
    _, known = refined(axes, painted(axes))
    assert known.sum() == 9 * 5 * len({*range(0, 20, 4), 19})


@pytest.mark.parametrize(("points", "levels"), [(8, 0), (9, 1), (16, 1), (17, 2), (129, 5), (1024, 7)])
def test_four_steps_are_left(points, levels):
    assert refine.most_levels(points) == levels


# --- borders --------------------------------------------------------------------------------------------------------


def beside_another(kind):
    """Cells with a neighbour of another kind along an axis."""
    found = np.zeros(kind.shape, bool)
    for axis in range(kind.ndim):
        a, b = np.moveaxis(kind, axis, 0), np.moveaxis(found, axis, 0)
        b[1:] |= a[1:] != a[:-1]
        b[:-1] |= a[1:] != a[:-1]
    return found


def disc(*x):
    return 1 + (sum((y - 0.47) ** 2 for y in x) < 0.09)


@pytest.mark.parametrize("axes", [[LINE], [LINE, LINE], [LINE[:50:2] * 1.3, LINE[::2], LINE[::3]]], ids=len)
def test_a_border_is_found_and_nothing_is_filled_across_it(axes):
    plane = painted(axes, kind=disc, power=lambda *x: np.exp(sum(x)) * 100 ** disc(*x))
    found, known = refined(axes, plane, levels=2)
    border = beside_another(plane["period"].reshape(known.shape))
    assert known[border].all()
    np.testing.assert_array_equal(found["period"].ravel(), plane["period"])
    np.testing.assert_allclose(found["P"].ravel(), plane["P"].ravel(), rtol=refine.TOLERANCE)
    assert known.sum() < known.size


def test_the_neighbours_of_a_block_on_a_border_are_split():
    _, known = refined([LINE], painted([LINE], kind=lambda x: 1 + (x > LINE[32]), power=lambda x: 1 + 0 * x), levels=1)
    np.testing.assert_array_equal(np.flatnonzero(known[1::2]) * 2 + 1, [31, 33, 35])


def test_a_border_costs_its_length():
    axes = [np.linspace(0, 1, 513)] * 2
    _, known = refined(axes, painted(axes, kind=disc, power=lambda *x: 1 + 0 * x[0]))
    assert known.mean() < 0.06


def test_a_tongue_that_only_a_neighbour_met_is_followed():
    # A tongue too thin for the coarse lattice leaves a block that a border splits.
    def tongue(x, y):
        return 1 + ((y > 0.5) | ((abs(x - 0.46) < 0.02) & (y > 0.05)))

    axes = [LINE, LINE]
    plane = painted(axes, kind=tongue)
    found, _ = refined(axes, plane)
    np.testing.assert_array_equal(found["period"].ravel(), plane["period"])


@given(seed=st.integers(0, 10**6), levels=st.integers(1, 3), shape=st.tuples(*[st.integers(33, 50)] * 2))
@example(seed=1, levels=2, shape=(35, 34))  # narrow blocks at the ends, whose corners only their neighbours ask for
@example(seed=53, levels=3, shape=(35, 34))
@settings(max_examples=15)
def test_nothing_computed_contradicts_what_is_filled(seed, levels, shape):
    """Brute force over all blocks of all levels: either they are computed to the last cell, or they are of one kind."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(-9, 9, (2, 4))
    axes = [np.linspace(0, 1, size) for size in shape]

    def wave(x, y):
        return sum(np.sin(a * x + b * y + 3 * a) for a, b in waves.T)

    def speckled(x, y):
        return np.where(rng.uniform(size=x.shape) < 0.01, 3, 1 + (wave(x, y) > 1))

    plane = painted(axes, kind=speckled, power=lambda x, y: np.exp(wave(x, y)))
    found, known = refined(axes, plane, levels)
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
            if not known[ends].all() or known[within].all():
                continue
            corners = kind[ends]
            assert (kind[inside][known[inside]] == corners[0, 0]).all()
            assert (found["period"][inside] == corners[0, 0]).all()
            x, y = ((ranks - ranks[0]) / (ranks[-1] - ranks[0]) for ranks in (np.arange(a, b + 1), np.arange(c, d + 1)))
            logs = np.log(power[ends])
            guess = np.stack([1 - x, x]).T @ logs @ np.stack([1 - y, y])
            assert (abs(guess - np.log(power[inside]))[known[inside]] <= refine.TOLERANCE).all()


def test_status_alone_makes_a_border():
    axes = [LINE, LINE]
    plane = painted(axes, status=lambda x, y: np.where(x > 0.51, Status.STICKING, Status.OK))
    found, known = refined(axes, plane)
    np.testing.assert_array_equal(found["status"].ravel(), plane["status"])
    assert known[[32, 33]].all()


def test_failed_cells_are_a_kind_of_their_own():
    axes = [LINE, LINE]
    plane = painted(
        axes,
        power=lambda x, y: np.where(x > 0.51, np.nan, 1.0),
        kind=lambda x, y: np.where(x > 0.51, -1, 1),
        status=lambda x, y: np.where(x > 0.51, Status.NONFINITE, Status.OK),
    )
    found, known = refined(axes, plane)
    np.testing.assert_array_equal(found["P"].ravel(), plane["P"].ravel())
    assert known.mean() < 0.5


def test_no_energy_is_a_kind_of_its_own():
    axes = [LINE]
    plane = painted(axes, power=lambda x: np.where(x < 0.49, 0.0, 1.0))
    found, known = refined(axes, plane)
    np.testing.assert_array_equal(found["P"][LINE < 0.49], 0)
    assert known[[31, 32]].all()


# --- P --------------------------------------------------------------------------------------------------------------


def resonance(x, y):
    return 1 / ((x - 0.4) ** 2 + 0.01) + y


def test_a_smooth_peak_is_within_the_tolerance_and_costs_more_than_a_plain():
    axes = [np.linspace(0, 1, 257), LINE]
    plane = painted(axes, power=resonance)
    found, known = refined(axes, plane)
    np.testing.assert_allclose(found["P"].ravel(), plane["P"].ravel(), rtol=refine.TOLERANCE)
    assert lattice_size(axes, LEVELS) < known.sum() < 0.3 * known.size
    assert known[80:120].mean() > 2 * known[200:].mean()


def test_the_worst_of_all_variants_counts():
    axes = [np.linspace(0, 1, 257), LINE]
    plane, plain = painted(axes, power=resonance), painted(axes)
    for name in ("P", "P_stderr"):
        plane[name] = np.concatenate([plain[name], plane[name]], axis=1)
    ground = np.ones(plane["period"].size, bool)
    mesh, known = Mesh(tuple(axes), LEVELS), ~ground
    for cells in refine.rounds(mesh, plane, ground):
        known[cells] = True
    filled = {name: np.where(known.reshape(-1, *[1] * (v.ndim - 1)), v, -99) for name, v in plane.items()}
    refine.fill(mesh, filled, known, ground)
    np.testing.assert_allclose(filled["P"], plane["P"], rtol=refine.TOLERANCE)


@pytest.mark.parametrize(("error", "refined_too"), [(0.1, False), (0.0, True)])
def test_noise_within_its_standard_error_is_not_refined(error, refined_too):
    axes = [LINE, LINE]
    noise = np.random.default_rng(3).uniform(-0.1, 0.1, (65, 65))
    plane = painted(axes, power=lambda x, y: 1 + noise, P_stderr=lambda x, y: error + 0 * x)
    _, known = refined(axes, plane)
    assert (known.sum() > lattice_size(axes, LEVELS)) == refined_too


# --- what is filled -------------------------------------------------------------------------------------------------


@pytest.fixture
def mirrors():
    """A plane of 1:2 orbits and their mirror images 2:1, as chance has it."""
    axes = [LINE, LINE]
    turned = np.random.default_rng(4).uniform(size=(65, 65)) < 0.5

    def sided(one, other):
        return lambda x, y: np.where(turned, one(x), other(x))

    few, many = (lambda x: 1), (lambda x: 2)
    low, high = (lambda x: 0.3 + 0.1 * x), (lambda x: 0.8 - 0.1 * x)
    return axes, painted(
        axes,
        impacts_left=sided(many, few),
        impacts_right=sided(few, many),
        restitution_left=sided(high, low),
        restitution_right=sided(low, high),
        asymmetry=sided(lambda x: -0.2 - x, lambda x: 0.2 + x),
    )


def test_mirror_images_are_one_kind_and_each_filled_cell_is_one_of_them(mirrors):
    axes, plane = mirrors
    found, known = refined(axes, plane)
    assert known.sum() == lattice_size(axes, LEVELS)
    turned = found["impacts_left"] == 2
    assert 0.2 < turned.mean() < 0.8
    np.testing.assert_array_equal(found["impacts_right"], np.where(turned, 1, 2))
    x = LINE[:, None] + 0 * LINE
    np.testing.assert_allclose(found["restitution_left"], np.where(turned, 0.8 - 0.1 * x, 0.3 + 0.1 * x), rtol=2e-3)
    np.testing.assert_allclose(found["restitution_right"], np.where(turned, 0.3 + 0.1 * x, 0.8 - 0.1 * x), rtol=2e-3)
    np.testing.assert_allclose(found["asymmetry"], np.where(turned, -0.2 - x, 0.2 + x), rtol=5e-2)


def test_with_gravity_mirror_images_are_two_kinds(mirrors):
    axes, plane = mirrors
    found, known = refined(axes, plane, level_ground=False)
    np.testing.assert_array_equal(found["impacts_left"].ravel(), plane["impacts_left"])
    assert known.mean() > 0.99


def test_no_periods_were_run_in_a_filled_cell():
    axes = [LINE, LINE]
    found, known = refined(axes, painted(axes))
    np.testing.assert_array_equal(found["periods_run"], np.where(known, 30, 0))


# --- sweeps ---------------------------------------------------------------------------------------------------------

# On two cores two calls of the smallest tile, whose program other tests compile as well.
AXES = {"d": np.linspace(0.2, 0.3, 66), "kappa": np.geomspace(20, 200, 31)}
PERIODS = 60


@pytest.fixture(scope="module")
def both():
    """A plane in full and refined, and what the progress callback of the second was told."""
    told = []
    full = sweep(**AXES, periods=PERIODS)
    return full, sweep(**AXES, periods=PERIODS, refine=2, progress=lambda *said: told.append(said)), told


def test_computed_cells_are_those_of_the_full_sweep_bit_for_bit(both):
    full, found, _ = both
    computed = found.computed.values
    assert computed.dtype == bool
    assert 0.1 < computed.mean() < 0.95
    assert set(found.data_vars) == {*full.data_vars, "computed"}
    for name in full.data_vars:
        np.testing.assert_array_equal(full[name].values[computed], found[name].values[computed], err_msg=str(name))
        assert found[name].dims == full[name].dims
        assert found[name].dtype == full[name].dtype
    assert not (found["P"] == full["P"]).values[~computed].all()


def test_filled_cells_are_close_to_the_full_sweep(both):
    full, found, _ = both
    filled = ~found.computed.values
    like = (full.period == found.period).values[filled]
    assert like.mean() > 0.95
    off = abs(found.P / full.P - 1).values[filled][like]
    assert (off < refine.TOLERANCE).mean() > 0.95
    np.testing.assert_array_equal(found.periods_run.values[filled], 0)


def test_attributes_say_what_was_computed(both):
    full, found, _ = both
    assert found.attrs["refine"] == 2
    assert found.attrs["refine_tolerance"] == refine.TOLERANCE
    assert found.attrs["refine_computed"] == found.computed.values.sum()
    assert found.attrs["refine_shown"] == found.computed.size
    assert not [name for name in full.attrs if "refine" in name]


def test_progress_grows_with_what_is_wanted(both):
    _, found, told = both
    done, total = (np.array(column) for column in zip(*told, strict=True))
    assert told[0] == (0, lattice_size(AXES.values(), 2))
    assert (np.diff(done) >= 0).all()
    assert (np.diff(total) >= 0).all()
    assert told[-1] == (found.computed.values.sum(),) * 2


def test_a_refined_map_is_drawn_and_stored_as_any_other(both, tmp_path):
    _, found, _ = both
    for draw in (number_maps.power_map, kind_maps.label_map):
        plots.save(draw(found), tmp_path / f"{draw.__name__}.png")
    save(found, tmp_path / "map.zarr")
    back = load(tmp_path / "map.zarr")
    assert back.identical(found)


@pytest.mark.long
def test_variants_are_filled_along_and_other_outputs_left_out():
    found = sweep(d=np.linspace(0.25, 0.3, 18), A=[1.0, 2.0], kappa=300.0, outputs=["P"], periods=PERIODS, refine=1)
    assert set(found.data_vars) == {"P", "status", "computed"}
    assert found.computed.dims == ("d",)
    assert found.computed.values[[0, 2, 16, 17]].all()
    assert not found.computed.values.all()
    curve = np.log(found.P.values)
    assert curve.shape == (18, 2)
    assert (abs(np.diff(curve, 2, axis=0)) < refine.TOLERANCE).all()


BAD = [
    (0, {}, "refine must be a whole number of at least 1; got 0"),
    (1.5, {}, "refine must be a whole number of at least 1; got 1.5"),
    ("two", {}, "refine must be a whole number of at least 1; got 'two'"),
    (5, {}, "at most 4 levels for 66 values; got 5"),
    (1, {"d": 0.2, "kappa": 30.0}, "at most 0 levels for 1 values; got 1"),
    (1, {"d": np.linspace(0.1, 0.3, 8), "kappa": 30.0}, "at most 0 levels for 8 values; got 1"),
    (2, {"wall": "rigid", "d": 0.2}, "at most 0 levels for 1 values; got 2"),  # kappa enters energies alone there
    (2, {"until": "window"}, "refine must be left out with until='window', whose cells have no label; got 2"),
]


@pytest.mark.parametrize(("levels", "changes", "say"), BAD, ids=[f"{levels}-{say[:20]}" for levels, _, say in BAD])
def test_bad_levels_are_refused_at_the_door(levels, changes, say):
    choices = {"until": "attractor", "wall": "soft"}
    asked = AXES | choices | changes
    chosen = SweepSettings(**{name: asked.pop(name) for name in choices})
    with pytest.raises(ValueError, match="refine") as error:
        plan(asked, None, None, chosen, levels)
    assert say in str(error.value)
    assert "\n" not in str(error.value)
