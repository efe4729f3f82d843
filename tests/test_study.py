"""Planes on disk: tiles and their records, what goes on and what is refused, one writer, any number of devices."""

import json
import logging
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
import zarr
from helpers import SETTINGS, stand_in

from vijax import grid, simulate, study
from vijax.grid import load, sweep
from vijax.model import Harvester, Status

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
MOST = 6  # cells of a tile, here


@pytest.fixture
def calls(monkeypatch):
    """A stand-in for the engine and small tiles; the list tells the cells of every call but those that only compile."""
    made = []

    def summarise(*args, count, **settings):
        made.extend([count] if count else [])
        return stand_in(*args, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr(study, "LARGEST_TILE", MOST)
    monkeypatch.setattr("vijax.calls.places", lambda: jax.devices()[:1])
    return made


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "map.zarr"


class Stop(BaseException):
    """What stops a run after some tiles."""


def stopped_after(cells, out, **axes):
    """A sweep that ends once so many cells are done."""

    def stop(done, total):
        if done >= cells:
            raise Stop

    before = set(threading.enumerate())
    with pytest.raises(Stop):
        sweep(**axes, out=out, progress=stop)
    # Tiles that run end by themselves, which is soon.
    for thread in set(threading.enumerate()) - before:
        if thread.name.startswith("ThreadPoolExecutor"):
            thread.join(timeout=60)


def records(out) -> list[Path]:
    return sorted((out / "status" / "tiles").glob("[0-9]*.json"))


PLANES = {
    "plane": AXES,
    "one axis": {"kappa": np.geomspace(3, 400, 20), "d": 0.2},
    "one cell": {"d": 0.2, "kappa": 30.0},
    "variants": AXES | {"A": [1.0, 2.0, 5.0], "omega": 6.0},
    "variants first": {"A": [1.0, 2.0]} | AXES,
    "one cell's variants": {"A": [1.0, 2.0], "d": 0.2, "kappa": 30.0},
    "level and not": AXES | {"gamma": [0.1, 0.0, -0.1]},
    "inclined by beta": {"beta": [0.0, 0.1], "A": [1.0, 2.0], "d": [0.2, 0.3]},
    "physical": {"omega": [3.0, 4.0, 5.0], "omega0": np.geomspace(20, 400, 6)},
    "rigid": AXES | {"wall": "rigid"},
    "single precision": AXES | {"dtype": "float32"},
    "few outputs": AXES | {"outputs": ["lyapunov"]},
    "other method": AXES | {"method": "rk4"},
}


@pytest.mark.parametrize("axes", PLANES.values(), ids=PLANES)
def test_a_study_holds_what_the_sweep_in_memory_returns(calls, out, axes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = sweep(**axes, out=out)
        xr.testing.assert_identical(found.load(), sweep(**axes))
        xr.testing.assert_identical(load(out), found)


def test_what_the_tiles_need_is_compiled_while_their_store_is_made(out, monkeypatch):
    compiling, opened = threading.Event(), study.opened

    def summarise(*args, count, **settings):
        if not count:
            compiling.set()
        return stand_in(*args, count=count, **settings)

    def opened_meanwhile(*args):
        assert compiling.wait(timeout=20)
        return opened(*args)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr(study, "opened", opened_meanwhile)
    sweep(**AXES, out=out)
    assert len(records(out)) == 1


def test_every_chunk_is_a_tile_and_every_tile_has_a_record(calls, out):
    sweep(**AXES, A=[1.0, 2.0], out=out)
    tiles = records(out)
    assert max(calls) <= MOST
    assert len(calls) == len(tiles) == 4
    for name in ("P", "period", "status"):
        chunks = [path for path in (out / name / "c").rglob("*") if path.is_file()]
        assert len(chunks) == len(tiles), name
    record = json.loads(tiles[0].read_text())
    assert {"cells", "seconds", "finished", "source", "commit", "version_jax", "device", "files"} <= set(record)
    assert sum(json.loads(tile.read_text())["cells"] for tile in tiles) == 20
    arrays = [json.loads(path.read_text()) for path in out.glob("*/zarr.json")]
    assert all(array["codecs"][-1]["name"] == "crc32c" for array in arrays)


def test_the_same_call_goes_on_where_it_stopped(calls, out):
    stopped_after(8, out, **AXES)
    before, done = len(calls), len(records(out))
    times = {path: path.stat().st_mtime_ns for path in records(out)}
    steps = []
    found = sweep(**AXES, out=out, progress=lambda *step: steps.append(step))
    assert 0 < done < len(records(out))
    assert steps[0] == (sum(json.loads(path.read_text())["cells"] for path in times), 20)
    assert steps[-1] == (20, 20)
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    assert len(calls) - before == len(records(out)) - done
    xr.testing.assert_identical(found.load(), sweep(**AXES))


def test_a_finished_study_runs_nothing(calls, out):
    whole = sweep(**AXES, out=out).load()
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), whole)
    assert not calls


def test_an_unfinished_store_opens_and_says_what_is_missing(calls, out):
    stopped_after(8, out, **AXES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load(out)
    missing = found["status"] == Status.NOT_RUN
    assert 0 < missing.sum() < 20
    assert found["P"].isnull().equals(missing.drop_attrs())
    assert (found["period"].where(missing, -1) == -1).all()
    assert found["status"].attrs["flag_meanings"].split()[Status.NOT_RUN] == "not_run"
    whole = sweep(**AXES)
    for name in whole:
        np.testing.assert_array_equal(found[name].values[~missing.values], whole[name].values[~missing.values])


OTHER = [
    ({"periods": 50}, "periods is 400, and not 50"),
    ({"wall": "rigid"}, "wall is soft, and not rigid"),
    ({"dtype": "float32"}, "dtype is float64, and not float32"),
    ({"method": "rk4", "steps": 50}, "method is exact, and not rk4; membrane is left out, and not linear; steps"),
    ({"outputs": ["P"]}, "outputs is P power .* and not P status"),
    ({"r": 0.4}, "r is 0.5, and not 0.4"),
    ({"d": np.linspace(0.1, 0.3, 8)}, "d is 5 values over d from 0.1 to 0.3, and not 8 values"),
    ({"kappa": np.geomspace(3, 401, 4)}, "kappa is 4 values .* to 400.*, and not 4 values .* to 401"),
    ({"A": [1.0, 2.0]}, "A is 1.0, and not 2 values over A from 1.0 to 2.0"),
    ({"device": Harvester(V=1000.0)}, "harvester_V is 2000.0, and not 1000.0"),
]


@pytest.mark.parametrize(("change", "say"), OTHER, ids=[next(iter(change)) for change, _ in OTHER])
def test_another_plane_is_refused_by_what_differs(calls, out, change, say):
    stopped_after(8, out, **AXES)
    before, count = load(out), len(calls)
    with pytest.raises(FileExistsError, match=f"out must be new or hold the same plane; got .*{say}") as error:
        sweep(**AXES | change, out=out)
    assert "\n" not in str(error.value)
    assert len(calls) == count
    xr.testing.assert_identical(load(out), before)


def test_one_value_among_equal_ends_makes_another_plane(calls, out):
    sweep(d=[0.1, 0.2, 0.3], out=out)
    with pytest.raises(FileExistsError, match="d is 3 values"):
        sweep(d=[0.1, 0.25, 0.3], out=out)


def test_overwrite_begins_anew(calls, out):
    sweep(**AXES, out=out)
    calls.clear()
    found = sweep(**AXES, r=0.4, out=out, overwrite=True)
    assert sum(calls) == 20
    xr.testing.assert_identical(found.load(), sweep(**AXES, r=0.4))
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_a_store_that_was_saved_whole_does_not_go_on(calls, out):
    grid.save(sweep(**AXES), out)
    with pytest.raises(FileExistsError, match="saved whole"):
        sweep(**AXES, out=out)
    sweep(**AXES, out=out, overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_no_store_stays(calls, out, overwrite):
    out.mkdir()
    (out / "thesis").write_text("precious")
    with pytest.raises(FileExistsError, match="out must not"):
        sweep(**AXES, out=out, overwrite=overwrite)
    assert (out / "thesis").read_text() == "precious"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_second_writer_is_refused(calls, out, overwrite):
    planned = grid.plan(AXES, **SETTINGS)
    with study.opened(planned, out):
        with pytest.raises(BlockingIOError, match=r"out must not be in use; got .*map\.zarr, which another"):
            sweep(**AXES, out=out, overwrite=overwrite)
        with pytest.raises(BlockingIOError, match="in use"):
            study.check(planned, out, overwrite)
    sweep(**AXES, out=out, overwrite=overwrite)


@pytest.mark.parametrize(
    ("sizes", "most", "expected"),
    [
        ({"d": 512, "kappa": 512}, 32768, {"d": 128, "kappa": 256}),
        ({"d": 5, "kappa": 4}, 6, {"d": 3, "kappa": 2}),
        ({"d": 3}, 10, {"d": 3}),
        ({"d": 5, "r": 1}, 1, {"d": 1, "r": 1}),
        ({}, 10, {}),
    ],
)
def test_tiles_are_blocks_of_at_most_so_many_cells(sizes, most, expected):
    assert study.extents(sizes, most) == expected


def test_a_small_plane_has_tiles_for_everyone(calls, out, monkeypatch):
    monkeypatch.setattr(study, "LARGEST_TILE", 1000)
    monkeypatch.setattr(study, "SMALLEST_TILE", 3)
    monkeypatch.setattr(study, "places", lambda: jax.devices()[:1] * 2)
    sweep(**AXES, out=out)
    assert len(calls) >= 4
    assert max(calls) <= 5


def test_a_tile_of_many_variants_has_fewer_cells(calls, out, monkeypatch):
    monkeypatch.setattr(study, "_LARGEST_CHUNK", 8)
    sweep(**AXES, A=[1.0, 2.0, 3.0, 4.0], out=out)
    assert max(calls) == 2


def test_tiles_stay_as_they_were_made(calls, out, monkeypatch):
    stopped_after(8, out, **AXES)
    monkeypatch.setattr(study, "LARGEST_TILE", 20)
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), sweep(**AXES))
    assert max(calls[:-1]) <= MOST  # the last call is that of the sweep in memory


@pytest.mark.parametrize("axes", [PLANES[name] for name in ("plane", "variants first", "single precision")])
def test_files_are_those_that_zarr_writes(calls, out, axes):
    found = sweep(**axes, out=out)
    for name in found.data_vars:
        array = zarr.open_array(out / name, mode="r+").with_config({"write_empty_chunks": True})
        values = array[...]
        files = {file: file.read_bytes() for file in (out / name / "c").rglob("*") if file.is_file()}
        for file in files:
            file.unlink()
        array[...] = values
        assert len(files) > 1
        assert files == {file: file.read_bytes() for file in files}


def test_quantities_are_taken_cell_by_cell(calls, out):
    # Three axes make d here: a tile must find its own values among them.
    axes = {"omega": [3.0, 4.0], "s": [0.2, 0.3, 0.4], "A": [1.0, 2.0, 3.0], "omega0": [50.0, 100.0]}
    xr.testing.assert_identical(sweep(**axes, out=out).load(), sweep(**axes))


def test_files_of_a_killed_process_are_cleared(calls, out):
    stopped_after(8, out, **AXES)
    left = [out / "P" / "c" / "0" / "1.abc.partial", out / "status" / "tiles" / ".3.99.part.json"]
    for path in left:
        path.write_text("half")
    sweep(**AXES, out=out)
    assert not any(path.exists() for path in left)


def test_what_is_run_again_is_said(calls, out, caplog):
    sweep(**AXES, out=out)
    records(out)[0].write_text("{")
    with caplog.at_level(logging.WARNING):
        sweep(**AXES, out=out)
    assert [record.getMessage() for record in caplog.records] == [
        f"tile 0 of {out} is run again: its record cannot be read"
    ]


# --- with the engine -------------------------------------------------------------------------------------------------

ON_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import numpy as np
import vijax
from vijax import calls, lanes
assert set(lanes.places()) == set(jax.devices())
calls.SMALLEST_TILE = 128
vijax.study.LARGEST_TILE = 128
axes = dict(d=np.linspace(0.2, 0.3, 17), r=np.linspace(0.3, 0.7, 21), wall="rigid", periods=12, until="window")
vijax.sweep(**axes, outputs=["impacts_per_period", "restitution"], out=sys.argv[2])
"""


def test_results_do_not_depend_on_the_number_of_devices(tmp_path):
    stores = []
    for number in (1, 2):
        path = tmp_path / f"{number}.zarr"
        subprocess.run([sys.executable, "-c", ON_DEVICES, str(number), str(path)], check=True)
        stores.append(load(path))
    one, two = stores
    assert one.attrs["device"] != two.attrs["device"]
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=str(name))
