"""Axes, cells, sweeps and stores: values and dimensions of maps, save and load."""

import json
import math
import re
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

from tests.helpers import stand_in
from vijax.maps import map_dataset
from vijax.maps import sweep as sweeps
from vijax.maps.axes import parse_axis
from vijax.maps.cells import cells
from vijax.maps.storage import store_folder
from vijax.maps.sweep import load, save, sweep
from vijax.model.device import Harvester, device_from_attributes
from vijax.model.records import Status
from vijax.model.walls.laws import HuntCrossley
from vijax.runtime.compilation import export_cache
from vijax.simulation import simulate

LONG = 40  # periods; the 1:1 orbits of these tests converge within them
ENERGY_ONLY = {"P", "power", "P_stderr", "energy_ratio", "admissible", "violated_limits", "max_penetration"}
ENERGY_ONLY |= {"max_impact_speed"}


@pytest.fixture
def engine(monkeypatch):
    """Replace the engine by a stand-in; return a list of (number of cells, settings, pair, device) of the tiles."""
    tiles = []

    def summarise(pair, u0, v0, scale, device, *, count, **settings):
        tiles.append((int(count), settings, pair, device))
        return stand_in(pair, u0, v0, scale, device, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    return tiles


@pytest.fixture
def no_engine(monkeypatch):
    def summarise(*args, **settings):
        raise AssertionError("the engine ran")

    monkeypatch.setattr(simulate, "summarise", summarise)


# --- axes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0.5", 0.5),
        ("-3e-2", -0.03),
        ("pi", math.pi),
        ("-0.5pi", -0.5 * math.pi),
        ("1,2.5, 4", [1, 2.5, 4]),
        ("0.1:0.3:3", [0.1, 0.2, 0.3]),
        ("-0.1:0.1:5", [-0.1, -0.05, 0, 0.05, 0.1]),
        ("3:3:1", [3]),
        ("1:100:3:log", [1, 10, 100]),
        ("-4:-1:3:log", [-4, -2, -1]),
        ("pi:3pi:3", [math.pi, 2 * math.pi, 3 * math.pi]),
    ],
)
def test_axis_text(text, values):
    parsed = parse_axis("u0", text)
    assert parsed.shape == np.shape(values)
    np.testing.assert_allclose(parsed, values, rtol=1e-15, atol=1e-17)


def test_range_includes_its_ends():
    values = parse_axis("kappa", "3:400:128:log")
    assert (values[0], values[-1], values.size) == (3.0, 400.0, 128)


def test_axis_from_file(tmp_path):
    file = tmp_path / "axis.txt"
    file.write_text("0.1 0.2\n0.25,0.3\n")
    np.testing.assert_array_equal(parse_axis("d", f"@{file}"), [0.1, 0.2, 0.25, 0.3])


@pytest.mark.parametrize(
    "text",
    [
        *("", "x", "1,,2", "pipi", "pi2", "nan", "1,inf", "@nowhere"),
        *("1:2", ":::", "1:2:0", "1:2:-3", "1:2:2.5", "1:inf:3"),
        *("1:2:3:lin", "1:2:3:log:4", "0:1:5:log", "-1:1:5:log"),
    ],
)
def test_malformed_axis_text_names_the_axis_and_the_text(text):
    with pytest.raises(ValueError, match=r"u0\b") as error:
        parse_axis("u0", text)
    assert "\n" not in str(error.value)


def test_dimensions_have_the_order_of_the_arguments():
    map_cells = cells({"kappa": [10.0, 20.0], "r": 0.5, "d": [0.1, 0.2, 0.3]}, Harvester(), "soft")
    assert list(map_cells.sizes.items()) == [("kappa", 2), ("d", 3)]


@pytest.mark.parametrize(
    ("axes", "wall", "dynamic"),
    [
        ({"d": 2, "kappa": 3, "A": 4, "omega": 5}, "soft", ["d", "kappa"]),
        ({"omega": 5, "omega0": 3}, "soft", ["omega", "omega0"]),
        ({"omega": 5, "s": 3, "kappa": 2}, "soft", ["omega", "s", "kappa"]),
        ({"omega": 5, "d": 3}, "soft", ["omega", "d"]),  # kappa is a property of the device and depends on omega
        ({"omega": 5, "d": 3}, "rigid", ["d"]),
        ({"d": 2, "kappa": 3, "r": 4}, "rigid", ["d", "r"]),
        ({"d": 2, "k": 3, "u0": 4}, "rigid", ["d", "u0"]),
        ({"d": 2, "gamma": 3, "A": 4}, "soft", ["d", "gamma"]),
        ({"d": 2, "beta": 3, "A": 4}, "soft", ["d", "beta", "A"]),
        ({"s": 2, "A": 4}, "soft", ["s", "A"]),
    ],
)
def test_cells_with_equal_dynamics_share_a_simulation(axes, wall, dynamic):
    # Starts are well inside the gap of every cell.
    values = {name: (0.001 if name == "u0" else 0.01) * np.arange(1, size + 1) for name, size in axes.items()}
    map_cells = cells(values, Harvester(), wall)
    assert list(map_cells.dynamic) == dynamic
    assert map_cells.count == math.prod(axes[dim] for dim in dynamic)
    assert set(map_cells.dynamic) | set(map_cells.variant) == set(axes)


def test_level_tube_ignores_the_forcing_amplitude():
    assert cells({"d": 0.2, "beta": [0.0, 0.0], "A": [1.0, 2.0]}, Harvester(), "soft").variant == ("A",)


def test_physical_axes_agree_with_the_device():
    device = Harvester(beta=0.02)
    axes = {"omega": [3.0, 7.0], "k": [300.0, 900.0], "A": [1.0, 2.0], "s": [0.2, 0.3]}
    map_cells = cells(axes, device, "soft")
    quantities = {
        name: map_cells.flat(map_cells.quantities[name], np.arange(16)).reshape(2, 2, 2, 2)
        for name in ("d", "kappa", "gamma")
    }
    for index in np.ndindex(2, 2, 2, 2):
        omega, k, amplitude, s = (values[i] for values, i in zip(axes.values(), index, strict=True))
        pair = Harvester(beta=0.02, omega=omega, omega0=math.sqrt(k / 0.0035), A=amplitude, s=s).pair()
        for name, values in quantities.items():
            np.testing.assert_allclose(values[index], getattr(pair, name), rtol=1e-14)


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_scales_are_products_of_a_cell_and_a_variant(wall):
    axes = {"A": [1.0, 3.0], "d": [0.1, 0.2], "omega": [3.0, 7.0], "kappa": [20.0, 50.0]}
    map_cells = cells(axes, Harvester(), wall)
    for scale, power, bare in ((map_cells.length, 2, wall == "soft"), (map_cells.speed, 1, True)):
        product = map_cells.flat(scale, np.arange(map_cells.count))[:, None] * map_cells.factors(scale)
        dims = map_cells.dynamic + map_cells.variant
        actual = xr.Variable(dims, product.reshape([2] * 4)).transpose(*axes).values
        a, _, omega, kappa = np.meshgrid(*axes.values(), indexing="ij")
        np.testing.assert_allclose(actual, a * math.pi**power / omega**power / (1 if bare else kappa), rtol=1e-15)


# --- validation ------------------------------------------------------------------------------------------------------

BAD = [
    ({"r": [0.5, -0.2]}, r"r must lie in \(0, 1\]; got -0.2 at index 1"),
    ({"r": 0.0}, "r must lie"),
    ({"d": 0.0}, "d must be positive"),
    ({"kappa": np.inf}, "rigid"),
    ({"kappa": [-1.0]}, "kappa must be positive"),
    ({"omega": 0.0}, "omega must be positive"),
    ({"A": [1.0, np.nan]}, "A must be .* index 1"),
    ({"gamma": np.inf}, "gamma must be finite"),
    ({"v0": [0.0, np.nan]}, "v0 must be finite"),
    ({"d": "0.1"}, "d must be a real number"),
    ({"d": [[0.1]]}, "d must be a number or a 1-D array"),
    ({"d": []}, "d must hold at least one number; got shape"),
    ({"d": 0.1, "s": 0.3}, "d and s"),
    ({"omega0": 100.0, "k": 500.0}, "omega0 and k"),
    ({"gamma": 0.1, "beta": 0.1}, "gamma and beta"),
    ({"wall": "rigid", "d": [0.2, 0.1], "u0": 0.08}, "u0 must lie in the gap .* got 0.08 where d = 0.1"),
    ({"wall": "hard"}, "wall must be among soft, rigid, rigid_left, rigid_right"),
    ({"until": "chaos"}, "until must be"),
    ({"method": "euler"}, 'method must be "exact" or "ode" or "rk4"; got \'euler\''),
    ({"solver": "Tsit5"}, "solver must be left out unless method is \"ode\"; got 'Tsit5'"),
    ({"method": "rk4", "rtol": 1e-8}, "rtol must be left out unless method is"),
    ({"method": "ode", "steps": 100}, 'steps must be left out unless method is "rk4"; got 100'),
    ({"method": "ode", "solver": "Euler"}, "solver must be among Bosh3, .* got 'Euler'"),
    ({"method": "ode", "rtol": 0.0}, "rtol must be a finite number of at least 1.8e-15; got 0.0"),
    (
        {"method": "ode", "rtol": 1e-8, "dtype": "float32"},
        "rtol must be a finite number of at least 9.5e-07; got 1e-08",
    ),
    ({"method": "ode", "atol": -1e-9}, "atol must be a finite number above 0; got -1e-09"),
    ({"method": "ode", "atol": "fine"}, "atol must be a finite number above 0; got 'fine'"),
    ({"method": "rk4", "steps": 4}, "steps must be a whole number of at least 8; got 4"),
    ({"method": "rk4", "steps": 1e3}, "steps must be a whole number"),
    ({"method": "ode", "wall": "rigid"}, 'wall must be "soft" for method="ode"; got \'rigid\''),
    ({"method": "ode", "membrane": "linear"}, "membrane must be a vijax.HuntCrossley"),
    ({"membrane": HuntCrossley(0.5)}, 'membrane must be linear for method="exact"; got .* use method="ode"'),
    ({"method": "ode", "membrane": HuntCrossley(0.5), "r": 0.5}, "r must be left out with a membrane"),
    ({"dtype": "float16"}, "dtype must be"),
    ({"periods": 0}, "periods must be a whole number of at least 1; got 0"),
    ({"periods": 1.5}, "periods must be"),
    ({"transient": -1}, "transient must be"),
    ({"outputs": ["P", "Q"]}, "outputs must be among .* got 'Q'"),
    ({"device": Harvester(s=np.array([0.1, 0.2]))}, "device.s must be one number"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[str(arguments)[:40] for arguments, _ in BAD])
def test_invalid_arguments_are_rejected_before_any_simulation(no_engine, arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        sweep(**arguments)
    assert "\n" not in str(error.value)


def test_an_unknown_axis_is_named(no_engine):
    with pytest.raises(TypeError, match="no axis 'kapa'"):
        sweep(kapa=3.0)


# --- cells to map and back -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["0", "some", "32769", ""])
def test_invalid_tile_size_is_rejected_before_any_simulation(no_engine, monkeypatch, text):
    monkeypatch.setenv("VIJAX_TILE", text)
    with pytest.raises(ValueError, match=re.escape(f"VIJAX_TILE must be a whole number from 1 to 32768; got {text!r}")):
        sweep(d=0.2, kappa=3.0)


def test_results_of_cells_have_the_right_position(engine, monkeypatch):
    monkeypatch.setenv("VIJAX_TILE", "8")
    axes = {"A": [1.0, 2.0, 5.0], "kappa": [3.0, 30.0, 300.0], "gamma": [0.1, 0.0], "d": np.linspace(0.1, 0.3, 11)}
    steps = []
    main_thread = threading.current_thread()
    result = sweep(
        **axes, omega=6.0, progress=lambda *step: steps.append((threading.current_thread() is main_thread, *step))
    )
    assert result["P"].dims == ("A", "kappa", "gamma", "d")
    assert result["period"].dims == ("kappa", "gamma", "d")
    expected = result["d"] + 10 * result["kappa"] + 1e4 * result["gamma"] + 1e5 * result["u0"]
    np.testing.assert_allclose(result["impacts_per_period"], expected.transpose(*result["impacts_per_period"].dims))
    energy = (expected * result["A"] * math.pi**2 / 36).transpose(*result["P"].dims)
    np.testing.assert_allclose(result["P"], energy, rtol=1e-14)
    np.testing.assert_allclose(result["power"], energy * 6 / math.pi, rtol=1e-14)
    assert sum(count for count, *_ in engine) == 66
    assert max(count for count, *_ in engine) <= 8
    # A tile never mixes level and inclined cells, because the two kinds have different programs.
    assert all(len(set((np.asarray(pair.gamma) == 0).tolist())) == 1 for _, _, pair, _ in engine)
    assert [step[1] for step in steps] == sorted(step[1] for step in steps)
    assert steps[0] == (True, 0, 66)
    assert steps[-1] == (True, 66, 66)


@pytest.mark.parametrize("wall", ["soft", "rigid"])
def test_variables_have_only_the_dimensions_that_they_depend_on(engine, wall):
    result = sweep(d=[0.1, 0.2], kappa=[10.0, 20.0, 30.0], omega=[3.0, 4.0], wall=wall)
    variants = {"omega"} if wall == "soft" else {"omega", "kappa"}
    for name, variable in result.items():
        expected = {"d", "kappa", "omega"} - (set() if name in ENERGY_ONLY else variants)
        # Impact speeds at rigid walls do not depend on kappa.
        expected -= {"kappa"} if (name, wall) == ("max_impact_speed", "rigid") else set()
        assert set(variable.dims) == expected, name
        assert list(variable.dims) == [dim for dim in ("d", "kappa", "omega") if dim in expected]


def test_variables_and_coordinates_have_units_and_long_names(engine):
    result = sweep(omega=[3.0, 4.0], omega0=[50.0, 60.0])
    for name, variable in result.variables.items():
        assert variable.attrs["units"], name
        assert variable.attrs["long_name"], name
    assert result["d"].dims == ("omega",)
    assert result["kappa"].dims == ("omega", "omega0")
    # At fixed s, d kappa^2 is proportional to omega0^2 for every omega.
    np.testing.assert_allclose(*xr.broadcast(result["d"] * result["kappa"] ** 2, 0.3 * result["omega0"] ** 2))
    assert result["status"].attrs["flag_values"] == [int(status) for status in Status]
    assert result["status"].attrs["flag_meanings"].split()[Status.SLOW] == "slow"
    assert result["status"].dtype == np.int8


def test_attributes_record_how_the_map_was_made(engine):
    result = sweep(d=0.2, periods=7, transient=3, until="window", device=Harvester(V=1000.0), outputs=["P"])
    expected = {"periods": 7, "transient": 3, "until": "window", "wall": "soft", "method": "exact", "dtype": "float64"}
    assert expected.items() <= result.attrs.items()
    assert result.attrs["harvester_V"] == 1000.0
    assert result.attrs["version_jax"] == jax.__version__
    assert {"commit", "device", "outputs", "version_python"} <= set(result.attrs)
    assert any(name.startswith("tolerance_") for name in result.attrs)
    json.dumps(result.attrs)


def test_only_requested_outputs_are_computed(engine):
    result = sweep(d=[0.1, 0.2], kappa=20.0, outputs=["impacts_per_period"])
    assert set(result) == {"impacts_per_period", "status"}
    assert engine[0][1]["outputs"] == {"impacts_per_period", "status"}
    assert not {"asymmetry", "lyapunov"} & set(sweep(d=0.1, kappa=20.0))
    assert set(sweep(d=0.1, kappa=20.0, outputs="lyapunov")) == {"lyapunov", "status"}


def test_admissible_requires_energy_and_depth(monkeypatch):
    plan = sweeps.plan({"d": [0.1, 0.2, 0.3, 0.4], "kappa": 20.0, "omega": math.pi}, ["admissible", "violated_limits"])
    ratio = np.array([[0.5], [1.5], [0.5], [np.nan]])
    result = map_dataset.make_map(
        plan, {"energy_ratio": ratio, "deepest": np.array([0.0062, 0.001, 0.0064, 0.001]), "status": np.zeros(4, int)}
    )
    assert result["admissible"].values.tolist() == [True, False, False, False]
    violated = result["violated_limits"]
    words = dict(zip(violated.flag_values, violated.flag_meanings.split(), strict=True))
    names = [words[code] for code in violated.values.tolist()]
    assert names == ["none", "energy_ratio_limit", "penetration_limit", "unknown"]
    assert violated.dtype == np.int8


def test_energy_ratio_limit_decides_admissibility_and_is_recorded(engine):
    device = Harvester(energy_ratio_limit=0.2, penetration_limit=math.inf)
    result = sweep(d=[0.1, 0.2, 0.3], kappa=1e-3, u0=0.0, device=device, outputs=["energy_ratio", "admissible"])
    assert (result["energy_ratio"] > 0.2).values.tolist() == [False, True, True]
    assert result["admissible"].values.tolist() == [True, False, False]
    assert result.attrs["harvester_energy_ratio_limit"] == 0.2
    assert device_from_attributes(result.attrs).energy_ratio_limit == 0.2


def test_ctrl_c_drops_the_waiting_tiles(engine, monkeypatch):
    monkeypatch.setenv("VIJAX_TILE", "2")
    slow = simulate.summarise

    def summarise(*args, **settings):
        time.sleep(0.01)
        return slow(*args, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)

    def stop(done, total):
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(d=np.linspace(0.1, 0.3, 200), kappa=20.0, progress=stop)
    time.sleep(1.0)  # longer than the time of all hundred tiles
    assert len(engine) < 50


# --- the store -------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(engine) -> xr.Dataset:
    result = sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 5), A=[1.0, 2.0])
    result["restitution"][0, 0] = np.nan
    return result


def test_loaded_map_equals_the_saved_map(small, tmp_path):
    save(small, tmp_path / "map.zarr")
    xr.testing.assert_identical(load(tmp_path / "map.zarr"), small)
    assert [path.name for path in tmp_path.iterdir()] == ["map.zarr"]


def test_loaded_map_of_a_single_cell_equals_the_saved_map(engine, tmp_path):
    single = sweep(d=0.2, kappa=20.0, dtype="float32")
    save(single, tmp_path / "map.zarr")
    xr.testing.assert_identical(load(tmp_path / "map.zarr"), single)


def test_flipped_bit_is_detected(small, tmp_path):
    save(small, tmp_path / "map.zarr")
    chunk = next(path for path in (tmp_path / "map.zarr" / "P" / "c").rglob("*") if path.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(ValueError, match=r"where P/c/.* is not what was written; write it again"):
        load(tmp_path / "map.zarr")


def test_all_arrays_have_a_checksum(small, tmp_path):
    save(small, tmp_path / "map.zarr")
    arrays = [json.loads(path.read_text()) for path in (tmp_path / "map.zarr").glob("*/zarr.json")]
    assert len(arrays) == len(small.variables)
    assert all(array["codecs"][-1]["name"] == "crc32c" for array in arrays)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("before", [False, True], ids=["new", "replaced"])
def test_interrupted_save_does_not_change_the_existing_store(small, tmp_path, monkeypatch, failure, before):
    target = tmp_path / "map.zarr"
    if before:
        save(small.isel(A=0), target)

    write = xr.Dataset.to_zarr

    def to_zarr(self, store, **options):
        write(self, store, **options)  # all files except the list
        raise failure

    monkeypatch.setattr(xr.Dataset, "to_zarr", to_zarr)
    with pytest.raises(failure):
        save(small, target, overwrite=True)
    assert list(tmp_path.iterdir()) == ([target] if before else [])
    if before:
        xr.testing.assert_identical(load(target), small.isel(A=0))


def test_interrupted_replacement_restores_the_old_store(small, tmp_path, monkeypatch):
    def rename(source, target):
        if source.name == "new":
            raise KeyboardInterrupt
        source.rename(target)

    save(small.isel(A=0), tmp_path / "map.zarr")
    monkeypatch.setattr(store_folder, "exchange", lambda first, other: False)  # as on a disk without atomic exchange
    monkeypatch.setattr(store_folder, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        save(small, tmp_path / "map.zarr", overwrite=True)
    xr.testing.assert_identical(load(tmp_path / "map.zarr"), small.isel(A=0))
    assert [path.name for path in tmp_path.iterdir()] == ["map.zarr"]


def test_overwrite_replaces_only_stores_of_vijax(small, tmp_path):
    target = tmp_path / "map.zarr"
    save(small.isel(A=0), target)
    with pytest.raises(FileExistsError, match="path must not exist"):
        save(small, target)
    save(small, target, overwrite=True)
    xr.testing.assert_identical(load(target), small)
    folder = tmp_path / "thesis.zarr"
    folder.mkdir()
    with pytest.raises(FileExistsError, match="no store of vijax"):
        save(small, folder, overwrite=True)


@pytest.mark.parametrize(("name", "error"), [("missing/map.zarr", FileNotFoundError), ("", ValueError)])
def test_invalid_path_is_named_in_the_error(small, tmp_path, monkeypatch, name, error):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match="path must"):
        save(small, name)


def test_load_of_a_missing_path_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="path must name a zarr store"):
        load(tmp_path / "map.zarr")


# --- with the engine -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plane() -> xr.Dataset:
    return sweep(d=[0.2, 0.25, 0.3], kappa=[100.0, 400.0], periods=LONG)


def test_a_stiff_wide_gap_has_symmetric_orbits(plane):
    assert plane["P"].dims == ("d", "kappa")
    stiff = plane.sel(kappa=400.0)
    for name in ("period", "impacts_left", "impacts_right"):
        assert (stiff[name] == 1).all(), name
    assert (stiff["impacts_per_period"] == 2).all()
    assert (stiff["status"] == Status.OK).all()
    assert (stiff["P_stderr"] == 0).all()
    assert plane["admissible"].all()


@pytest.mark.long
def test_transient_is_accepted_only_with_a_window():
    cells = {"d": [0.12, 0.3], "kappa": 400.0, "r": 0.5, "periods": 40, "outputs": ["P", "period"]}
    with pytest.raises(ValueError, match=r"transient must be 0 with until='attractor'.*got 30"):
        sweep(**cells, transient=30)
    windows = [sweep(**cells, until="window", transient=transient) for transient in (0, 30)]
    assert (abs(windows[0].P / windows[1].P - 1) > 1e-6).all()


def test_cells_of_the_reference_plane():
    reference = json.loads((Path(__file__).parents[1] / "data" / "plane_cells.json").read_text())["cells"]
    fast_cells = [cell for cell in reference if cell["p"] > 0 and cell["converged_after"] < LONG / 2][:8]
    for cell in fast_cells:
        result = sweep(periods=LONG, **{name: cell[name] for name in ("d", "kappa", "r", "gamma", "u0", "v0")})
        actual = [int(result[name]) for name in ("period", "impacts_left", "impacts_right")]
        assert actual == [cell[name] for name in ("p", "left", "right")]
        np.testing.assert_allclose(result["P"], cell["P_J"], rtol=1e-9)


def test_cell_of_a_map_equals_the_single_cell(plane):
    single = sweep(d=0.25, kappa=400.0, periods=LONG)
    expected = plane.sel(d=0.25, kappa=400.0)
    for name in plane.data_vars:
        np.testing.assert_array_equal(single[name], expected[name], err_msg=str(name))


# Cells with some of these kappa once depended on the lane; two kappa are near the resonance, with many fallbacks.
MIXED = {"d": np.linspace(0.02, 0.6, 12), "kappa": np.geomspace(2, 3000, 41)[[2, 3, 13, 16, 18, 29, 39]]}


@pytest.fixture
def optimised(monkeypatch):
    """Compile with the default flags; without optimisation XLA fuses no multiplication with an addition."""
    monkeypatch.setenv("XLA_FLAGS", "")
    simulate.compiled.cache_clear()
    yield
    simulate.compiled.cache_clear()


@pytest.mark.long
def test_cells_are_bit_identical_in_different_maps(optimised, tmp_path):
    d, kappa = MIXED["d"], MIXED["kappa"]
    mixed = sweep(d=d, kappa=kappa, r=0.6)
    assert (mixed["period"] > 0).any()
    assert (mixed["period"] == 0).any()
    others = {
        "axes in another order": sweep(kappa=kappa, d=d, r=0.6),
        "an axis more": sweep(r=np.linspace(0.6, 0.9, 12), d=d, kappa=kappa).isel(r=0),
        "in a store": sweep(kappa=kappa, d=d[::-1], r=0.6, out=tmp_path / "plane.zarr"),
        "fewer cells": sweep(d=d, kappa=kappa[:2], r=0.6),
    }
    for case, other in others.items():
        for name in mixed.data_vars:
            actual = other[name].sel(d=d).transpose("d", "kappa")
            expected = mixed[name].sel(kappa=actual["kappa"])
            np.testing.assert_array_equal(actual, expected, err_msg=f"{name}, {case}")


@pytest.mark.long
def test_maps_of_all_sizes_share_two_programs(tmp_path, monkeypatch):
    """One program for few cells, one program for all other sizes."""
    programs, jitted = [], export_cache.TracedProgram._jitted
    monkeypatch.setattr(
        export_cache.TracedProgram, "_jitted", lambda *args: programs.append(args[0]._name) or jitted(*args)
    )
    simulate.compiled.cache_clear()
    sweep(d=[0.2, 0.25], r=0.5, periods=1)
    sweep(d=np.linspace(0.02, 0.6, 16), kappa=[5.0, 50.0, 90.0, 500.0], r=0.5, periods=1)
    assert len(programs) == 1
    sweep(d=np.linspace(0.02, 0.6, 37), kappa=np.geomspace(2, 3000, 61), r=0.5, periods=1)
    sweep(d=[0.2, 0.25], kappa=np.geomspace(2, 3000, 1000), r=0.5, periods=1, out=tmp_path / "plane.zarr")
    assert len(programs) == 2


@pytest.mark.long
def test_periodic_cells_hardly_depend_on_the_other_outputs():
    mixed = sweep(**MIXED, r=0.6)
    other = sweep(**MIXED, r=0.6, outputs=["restitution", "contact_time", "period"])
    periodic = mixed["period"] > 0
    assert periodic.any()
    for name in ("status", "period"):
        np.testing.assert_array_equal(other[name], mixed[name], err_msg=name)
    for name in ("restitution", "contact_time"):
        np.testing.assert_allclose(other[name].where(periodic), mixed[name].where(periodic), rtol=1e-12)


@pytest.mark.long
def test_physical_and_dimensionless_axes_give_the_same_map(plane):
    # d = s omega^2 / (A pi^2) and kappa = omega0 pi / omega, at A = 1 and omega = pi.
    physical = sweep(s=[0.2, 0.25, 0.3], omega0=[100.0, 400.0], periods=LONG)
    np.testing.assert_allclose(physical["P"], plane["P"], rtol=1e-9)
    np.testing.assert_array_equal(physical["period"], plane["period"])


@pytest.mark.long
def test_variants_equal_separate_sweeps(plane):
    both = sweep(d=[0.2, 0.3], kappa=400.0, A=[1.0, 2.0], periods=LONG)
    np.testing.assert_allclose(both["P"].sel(A=1.0), plane["P"].sel(d=[0.2, 0.3], kappa=400.0), rtol=1e-12)
    louder = sweep(d=[0.2, 0.3], kappa=400.0, A=2.0, periods=LONG)
    for name in ("P", "energy_ratio", "max_penetration", "max_impact_speed"):
        np.testing.assert_allclose(both[name].sel(A=2.0), louder[name], rtol=1e-12, err_msg=name)


@pytest.mark.long
def test_rigid_walls_in_single_precision():
    result = sweep(d=[0.25, 0.3], kappa=[200.0, 400.0], wall="rigid", dtype="float32", periods=LONG)
    assert result["P"].dtype == np.float32
    assert result["P"].dims == ("d", "kappa")
    assert result["period"].dims == ("d",)
    assert (result["period"] == 1).all()
    # Eq. (35): the depth is proportional to 1/kappa; the energy of a small depth is proportional to its square.
    np.testing.assert_allclose(
        result["max_penetration"].sel(kappa=200.0), 2 * result["max_penetration"].sel(kappa=400.0)
    )
    np.testing.assert_allclose(result["restitution"], 0.5, rtol=1e-5)


@pytest.mark.long
def test_flight_that_ends_after_the_last_period_has_not_status_no_impact():
    # These cells once had status no_impact and P = 0, because their flight ends long after the last period.
    result = [
        sweep(d=d, kappa=kappa, periods=1000, outputs=["P", "impacts_per_period"])
        for d, kappa in ((0.22258064516129034, 3.07741935483871), (0.22580645161290322, 3.1548387096774193))
    ]
    for cell in result:
        assert int(cell.status) != Status.NO_IMPACT
        assert float(cell.P) > 0
        assert float(cell.impacts_per_period) > 0
