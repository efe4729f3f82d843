"""Maps on disk: tiles and their records, resumed and rejected calls, one writer, any number of devices."""

import json
import logging
import math
import os
import shutil
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

from tests.helpers import stand_in
from vijax.maps import map_dataset
from vijax.maps import sweep as sweeps
from vijax.maps.outputs import default_outputs
from vijax.maps.storage import tiled_store
from vijax.maps.sweep import load, sweep
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.simulation import simulate

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
FEW = AXES | {"outputs": ["P"]}
MAX_TILE_CELLS = 6


@pytest.fixture
def calls(monkeypatch):
    """Replace the engine by a stand-in, use small tiles; return a list of the cells of all calls that simulate."""
    counts = []

    def summarise(*args, count, **settings):
        counts.extend([count] if count else [])
        return stand_in(*args, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setenv("VIJAX_TILE", str(MAX_TILE_CELLS))
    monkeypatch.setattr("vijax.maps.execution.dispatch.tile_devices", lambda: jax.devices()[:1])
    return counts


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "map.zarr"


class Stop(BaseException):
    """Exception that stops a run after some tiles."""


def stopped_after(cells, out, **axes):
    """Run a sweep and stop it when `cells` cells are done."""

    def stop(done, total):
        if done >= cells:
            raise Stop

    before = set(threading.enumerate())
    with pytest.raises(Stop):
        sweep(**axes, out=out, progress=stop)
    # Tiles in progress finish soon; wait for them.
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


def test_store_is_compared_with_the_map_unless_it_is_new(calls, out, monkeypatch):
    compared, check_same = [], tiled_store.store_metadata.check_same
    monkeypatch.setattr(
        tiled_store.store_metadata, "check_same", lambda *arguments: compared.append(1) or check_same(*arguments)
    )
    sweep(**FEW, out=out)
    assert not compared
    sweep(**FEW, out=out)
    assert len(compared) == 2  # once before any simulation and once under the lock
    sweep(**FEW, out=out, overwrite=True)
    assert len(compared) == 2


def test_store_created_by_a_concurrent_run_is_compared(calls, out, monkeypatch):
    other = sweep(**AXES, outputs=["period"], out=out.with_name("other.zarr"))
    make = tiled_store._create_store

    def create_after_other_run(planned, store_id, target):
        shutil.copytree(out.with_name("other.zarr"), target)
        make(planned, store_id, target)

    monkeypatch.setattr(tiled_store, "_create_store", create_after_other_run)
    with pytest.raises(FileExistsError, match="P is left out"):
        sweep(**FEW, out=out)
    assert load(out).identical(other.load())


@pytest.mark.parametrize("axes", PLANES.values(), ids=PLANES)
def test_study_equals_the_sweep_in_memory(calls, out, axes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = sweep(**axes, out=out)
        xr.testing.assert_identical(result.load(), sweep(**axes))
        xr.testing.assert_identical(load(out), result)


def test_programs_are_compiled_while_the_store_is_created(out, monkeypatch):
    compiling, open_study = threading.Event(), tiled_store.open_study

    def summarise(*args, count, **settings):
        if not count:
            compiling.set()
        return stand_in(*args, count=count, **settings)

    def open_after_compilation(*args):
        assert compiling.wait(timeout=20)
        return open_study(*args)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr(tiled_store, "open_study", open_after_compilation)
    sweep(**AXES, out=out)
    assert len(records(out)) == 1


def test_chunks_are_tiles_and_tiles_have_records(calls, out):
    sweep(**AXES, A=[1.0, 2.0], out=out)
    tiles = records(out)
    assert max(calls) <= MAX_TILE_CELLS
    assert len(calls) == len(tiles) == 4
    for name in ("P", "period", "status"):
        chunks = [path for path in (out / name / "c").rglob("*") if path.is_file()]
        assert len(chunks) == len(tiles), name
    record = json.loads(tiles[0].read_text())
    assert {"cells", "seconds", "finished", "source", "commit", "version_jax", "device", "files"} <= set(record)
    assert sum(json.loads(tile.read_text())["cells"] for tile in tiles) == 20
    arrays = [json.loads(path.read_text()) for path in out.glob("*/zarr.json")]
    assert all(array["codecs"][-1]["name"] == "crc32c" for array in arrays)


def test_same_call_resumes_a_stopped_study(calls, out):
    stopped_after(8, out, **AXES)
    before, done = len(calls), len(records(out))
    times = {path: path.stat().st_mtime_ns for path in records(out)}
    steps = []
    result = sweep(**AXES, out=out, progress=lambda *step: steps.append(step))
    assert 0 < done < len(records(out))
    assert steps[0] == (sum(json.loads(path.read_text())["cells"] for path in times), 20)
    assert steps[-1] == (20, 20)
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    assert len(calls) - before == len(records(out)) - done
    xr.testing.assert_identical(result.load(), sweep(**AXES))


def test_finished_study_simulates_no_cell(calls, out):
    expected = sweep(**AXES, out=out).load()
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), expected)
    assert not calls


def test_unfinished_store_is_loaded_with_status_not_run(calls, out):
    stopped_after(8, out, **AXES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = load(out)
    missing = result["status"] == Status.NOT_RUN
    assert 0 < missing.sum() < 20
    assert result["P"].isnull().equals(missing.drop_attrs())
    assert (result["period"].where(missing, -1) == -1).all()
    assert result["status"].attrs["flag_meanings"].split()[Status.NOT_RUN] == "not_run"
    expected = sweep(**AXES)
    for name in expected:
        np.testing.assert_array_equal(result[name].values[~missing.values], expected[name].values[~missing.values])


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


@pytest.mark.parametrize(("change", "message"), OTHER, ids=[next(iter(change)) for change, _ in OTHER])
def test_error_for_another_map_names_the_differences(calls, out, change, message):
    stopped_after(8, out, **AXES)
    before, count = load(out), len(calls)
    with pytest.raises(FileExistsError, match=f"out must be new or hold the same plane; got .*{message}") as error:
        sweep(**AXES | change, out=out)
    assert "\n" not in str(error.value)
    assert len(calls) == count
    xr.testing.assert_identical(load(out), before)


def test_axis_with_equal_ends_and_another_value_is_another_map(calls, out):
    sweep(d=[0.1, 0.2, 0.3], out=out)
    with pytest.raises(FileExistsError, match="d is 3 values"):
        sweep(d=[0.1, 0.25, 0.3], out=out)


def test_overwrite_simulates_all_cells(calls, out):
    sweep(**AXES, out=out)
    calls.clear()
    result = sweep(**AXES, r=0.4, out=out, overwrite=True)
    assert sum(calls) == 20
    xr.testing.assert_identical(result.load(), sweep(**AXES, r=0.4))
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_saved_map_is_not_resumed(calls, out):
    sweeps.save(sweep(**AXES), out)
    with pytest.raises(FileExistsError, match="saved whole"):
        sweep(**AXES, out=out)
    sweep(**AXES, out=out, overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "root_metadata", ["", "{}", '{"attributes": {"source": "vijax 0.1.0"}}'], ids=["alone", "zarr", "ours"]
)
def test_foreign_folder_is_not_changed(calls, out, overwrite, root_metadata):
    (out / "chapters").mkdir(parents=True)
    thesis = out / "chapters" / "thesis.tex"
    thesis.write_text("precious")
    if root_metadata:
        (out / "zarr.json").write_text(root_metadata)
    with pytest.raises((FileExistsError, ValueError), match=r"thesis.tex; move it" if overwrite else "must"):
        sweep(**AXES, out=out, overwrite=overwrite)
    assert thesis.read_text() == "precious"


FOREIGN_FILES = ["thesis.tex", "P/notes.txt", "P/c/0/x", "status/tiles/mine.json", "mine/zarr.json", "mine/c/0"]


@pytest.mark.parametrize("name", FOREIGN_FILES)
@pytest.mark.parametrize("saved", [False, True], ids=["study", "saved"])
def test_store_with_a_foreign_file_is_not_replaced(calls, out, name, saved):
    sweeps.save(sweep(**FEW), out) if saved else sweep(**FEW, out=out)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text("precious")
    with pytest.raises(FileExistsError, match=f"which holds {name}; move it elsewhere") as error:
        sweep(**AXES, out=out, overwrite=True)
    assert "\n" not in str(error.value)
    with pytest.raises(FileExistsError, match="path must not replace what vijax did not write"):
        sweeps.save(sweep(**AXES), out, overwrite=True)
    assert (out / name).read_text() == "precious"


def test_foreign_zarr_store_is_not_replaced(calls, out):
    xr.Dataset({"P": ("d", np.arange(3.0))}).to_zarr(out, consolidated=False)
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match=r"out must not .*map\.zarr"):
            sweep(**AXES, out=out, overwrite=overwrite)
    assert xr.open_zarr(out, consolidated=False)["P"].size == 3


def test_link_to_a_store_is_followed_and_not_replaced(calls, out):
    target = out.with_name("disk.zarr")
    sweep(**AXES, out=target)
    out.symlink_to(target.name)
    sweep(**AXES, r=0.4, out=out, overwrite=True)
    assert out.is_symlink()
    xr.testing.assert_identical(load(target), sweep(**AXES, r=0.4))
    assert {path.name for path in out.parent.iterdir()} == {"map.zarr", "disk.zarr"}


@pytest.mark.parametrize("name", ["map.nc", "map", "map.zarr.json"])
def test_path_of_a_store_must_end_in_zarr(calls, tmp_path, name):
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=f"out must end in .zarr; got '.*{name}'"):
            sweep(**AXES, out=tmp_path / name, overwrite=overwrite)
    with pytest.raises(ValueError, match=f"path must end in .zarr; got '.*{name}'"):
        sweeps.save(sweep(**AXES), tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("overwrite", [False, True])
def test_second_writer_is_rejected(calls, out, overwrite):
    planned = sweeps.plan(AXES)
    with tiled_store.open_study(planned, out):
        with pytest.raises(BlockingIOError, match=r"out must not be in use; got .*map\.zarr, which another"):
            sweep(**AXES, out=out, overwrite=overwrite)
        with pytest.raises(BlockingIOError, match="in use"):
            tiled_store.check_writable(planned, out, overwrite)
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
def test_tiles_are_blocks_of_limited_size(sizes, most, expected):
    assert tiled_store.block_lengths(sizes, most) == expected


def test_small_map_has_tiles_for_all_devices(monkeypatch):
    monkeypatch.setattr(tiled_store, "tile_devices", lambda: jax.devices()[:1] * 2)
    plane = {"d": np.linspace(0.1, 0.3, 128), "kappa": np.geomspace(3, 400, 64)}
    cells = sweeps.plan(plane).cells
    assert math.prod(tiled_store.tile_lengths(cells).values()) * 4 == cells.count


def test_a_tile_of_many_variants_has_fewer_cells():
    """A chunk has at most two million numbers."""
    plane = {"d": np.linspace(0.1, 0.3, 64), "kappa": np.geomspace(3, 400, 64)}
    few, many = (tiled_store.tile_lengths(sweeps.plan(plane | {"A": np.linspace(1, 2, n)}).cells) for n in (2, 4096))
    assert set(few) == set(many) == {"d", "kappa"}
    assert math.prod(many.values()) * 4096 == 2**21
    assert math.prod(few.values()) >= 1024


def test_resumed_study_has_the_tile_size_of_its_store(calls, out, monkeypatch):
    stopped_after(8, out, **AXES)
    monkeypatch.setenv("VIJAX_TILE", "20")
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), sweep(**AXES))
    assert max(calls[:-1]) <= MAX_TILE_CELLS  # the last call belongs to the sweep in memory


@pytest.mark.parametrize("axes", [PLANES[name] for name in ("plane", "variants first", "single precision")])
def test_files_are_byte_identical_to_zarr(calls, out, axes):
    result = sweep(**axes, out=out)
    for name in result.data_vars:
        array = zarr.open_array(out / name, mode="r+").with_config({"write_empty_chunks": True})
        values = array[...]
        files = {file: file.read_bytes() for file in (out / name / "c").rglob("*") if file.is_file()}
        for file in files:
            file.unlink()
        array[...] = values
        assert len(files) > 1
        assert files == {file: file.read_bytes() for file in files}


def test_tile_selects_the_quantities_of_its_cells(calls, out):
    # d depends on three axes here; a tile must select its values.
    axes = {"omega": [3.0, 4.0], "s": [0.2, 0.3, 0.4], "A": [1.0, 2.0, 3.0], "omega0": [50.0, 100.0]}
    xr.testing.assert_identical(sweep(**axes, out=out).load(), sweep(**axes))


def test_only_temporary_files_of_a_killed_process_are_removed(calls, out):
    stopped_after(8, out, **AXES)
    tiles, token = out / "status" / "tiles", "0123456789abcdef"
    remnants = [out / "P" / "c" / "0" / ".1.99.part", tiles / ".3.99.part.json", tiles / f".3.{token}.part.json"]
    foreign = [
        out / "notes.part1.txt",
        out / "P" / "c" / ".notes.99.part",
        out / "x.part" / "thesis.tex",
        out / "P" / "c" / "9" / f".9.{token}.part",
    ]
    for folder in (foreign[-1].parent, foreign[-2].parent):
        folder.mkdir()
    for path in (*remnants, *foreign):
        path.write_text("half")
    sweep(**AXES, out=out)
    assert not any(path.exists() for path in remnants)
    assert all(path.read_text() == "half" for path in foreign)
    xr.testing.assert_identical(load(out), sweep(**AXES))


def test_tile_that_is_run_again_is_logged(calls, out, caplog):
    sweep(**AXES, out=out)
    records(out)[0].write_text("{")
    with caplog.at_level(logging.WARNING):
        sweep(**AXES, out=out)
    assert [record.getMessage() for record in caplog.records] == [
        f"tile 0 of {out} is run again: its record cannot be read"
    ]


@pytest.mark.parametrize("files", [5, [], {"P/c/0/0": 5}], ids=str)
def test_invalid_record_is_written_again(calls, out, files):
    expected = sweep(**FEW, out=out).load()
    change(files=files)(records(out)[0])
    with pytest.raises(ValueError, match=r"where (P/c/0/0|status/tiles/0.json) (is not what|cannot be)"):
        load(out)
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)
    assert json.loads(records(out)[0].read_text())["files"] != files


# --- files of killed runs --------------------------------------------------------------------------------------------


def make_remnant(out: Path, *files: str) -> Path:
    """Create the working folder of a killed run."""
    folder = out.with_name(".map.0123456789abcdef.part.zarr")
    folder.mkdir()
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{")
    return folder


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "files", [[], ["lock"], ["lock", "new/zarr.json"], ["old/zarr.json", "old/vijax.json"]], ids=str
)
def test_working_folder_of_a_killed_run_is_removed(calls, out, caplog, files, overwrite):
    sweep(**AXES, out=out)
    remnant = make_remnant(out, *files)
    sweep(**AXES, out=out, overwrite=overwrite)
    # An empty folder may belong to an active run, which creates it again if it is removed.
    expected_messages = [f"removed {remnant.name}, left by a killed run"] if files[1:] else []
    assert [entry.getMessage() for entry in caplog.records] == expected_messages
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("reads", [False, True])
def test_store_that_a_killed_run_moved_is_restored(calls, out, caplog, reads):
    """On a disk without atomic exchange the path of a store is missing for a moment during a replacement."""
    expected = sweep(**AXES, out=out).load()
    remnant = make_remnant(out, "lock", "new/zarr.json")
    out.rename(remnant / "old")
    calls.clear()
    xr.testing.assert_identical(load(out) if reads else sweep(**AXES, out=out).load(), expected)
    assert sum(calls) == 0
    assert [entry.getMessage() for entry in caplog.records] == ["restored map.zarr, which a killed run had moved away"]
    assert [path.name for path in out.parent.iterdir()] == [out.name]


WRITER = """
import sys
from pathlib import Path
from vijax.maps.storage.store_folder import replacing_store
with replacing_store("out", Path(sys.argv[1]), overwrite=True) as new:
    new.mkdir()
    print(new, flush=True)
    input()
"""


def test_working_folder_of_an_active_run_is_not_removed(calls, out):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", WRITER, str(out)], **pipes) as process:
        part = Path(process.stdout.readline().strip())
        expected = sweep(**AXES, out=out).load()
        assert part.is_dir()
        process.kill()
        process.communicate()
    sweep(**AXES, out=out)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    xr.testing.assert_identical(load(out), expected)


@pytest.mark.parametrize("kind", ["study", "saved"])
def test_overwrite_works_on_a_disk_without_atomic_exchange(calls, out, monkeypatch, kind):
    monkeypatch.setattr("vijax.maps.storage.store_folder.exchange", lambda first, other: False)
    sweep(**AXES, r=0.4, out=out) if kind == "study" else sweeps.save(sweep(**AXES, r=0.4), out)
    result = sweep(**AXES, out=out, overwrite=True).load()
    xr.testing.assert_identical(load(out), result)
    sweeps.save(result, out, overwrite=True)
    xr.testing.assert_identical(load(out), result)
    assert [path.name for path in out.parent.iterdir()] == [out.name]


# --- damage ----------------------------------------------------------------------------------------------------------


def change(**entries):
    """Return an edit that changes entries of a metadata file."""

    def edit(file):
        file.write_text(json.dumps(json.loads(file.read_text()) | entries))

    return edit


def attribute(name, value):
    """Return an edit that sets an attribute in a metadata file, or removes it if the value is None."""

    def edit(file):
        content = json.loads(file.read_text())
        content["attributes"] = {k: v for k, v in (content["attributes"] | {name: value}).items() if v is not None}
        file.write_text(json.dumps(content))

    return edit


def exchange(file):
    """Replace a chunk by the valid chunk of another coordinate."""
    file.write_bytes((file.parent.parent.parent / "kappa" / "c" / "0").read_bytes())


BIG_ENDIAN = [{"name": "bytes", "configuration": {"endian": "big"}}, {"name": "zstd"}, {"name": "crc32c"}]
EDITS = {
    "data type": ("P/zarr.json", change(data_type="int64", fill_value=0)),
    "byte order": ("P/zarr.json", change(codecs=BIG_ENDIAN)),
    "no codec": ("P/zarr.json", change(codecs=[{"name": "bytes"}])),
    "chunk shape": ("P/zarr.json", change(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2, 2]}})),
    "scale": ("P/zarr.json", attribute("scale_factor", 2.0)),
    "units": ("P/zarr.json", attribute("units", "mJ")),
    "flags": ("status/zarr.json", attribute("flag_meanings", None)),
    "a coordinate's units": ("kappa/zarr.json", attribute("units", "m")),
    "a coordinate": ("d/c/0", exchange),
    "a scalar coordinate": ("r/c", Path.unlink),
    "a setting": ("zarr.json", attribute("periods", 50)),
    "metadata kept together": ("zarr.json", change(consolidated_metadata=None)),
    "the list": ("vijax.json", change(store_id="another")),
    "text": ("P/zarr.json", lambda file: file.write_bytes(b"\xff{")),
    "no metadata": ("zarr.json", Path.unlink),
    "a list": ("vijax.json", lambda file: file.write_text("[]")),
}


@pytest.mark.parametrize(("name", "edit"), EDITS.values(), ids=EDITS)
def test_edit_is_detected_and_repaired(calls, out, caplog, name, edit):
    expected = sweep(**FEW, out=out).load()
    before = (out / name).read_bytes()
    edit(out / name)
    with pytest.raises(
        ValueError, match=f"where {name} is .*; repeat the call that made it, which repairs it"
    ) as error:
        load(out)
    assert "\n" not in str(error.value)
    with pytest.raises(FileExistsError, match=r"out must .*, where .*, allow overwriting|; allow overwriting") as error:
        sweep(**FEW | {"d": np.linspace(0.1, 0.29, 5)}, r=0.4, periods=40, out=out)
    assert "\n" not in str(error.value)
    calls.clear()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)
    xr.testing.assert_identical(load(out), expected)
    assert (out / name).read_bytes() == before
    assert sum(calls) == 0
    assert [entry.getMessage().partition(" is written again")[0] for entry in caplog.records] == [f"{name} of {out}"]


def test_metadata_are_repaired_by_any_version(calls, out, monkeypatch):
    expected = sweep(**FEW, out=out).load()
    monkeypatch.setattr(map_dataset, "installation_attributes", lambda: {"source": "vijax 9"})
    for name in ("zarr.json", "P/zarr.json"):
        (out / name).unlink()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)


def test_edit_of_a_saved_map_is_detected(calls, out):
    sweeps.save(sweep(**AXES), out)
    (out / "P" / "c" / "0" / "0").unlink()
    with pytest.raises(ValueError, match="where P/c/0/0 is missing; write it again"):
        load(out)


def test_lost_variable_is_simulated_again(calls, out):
    expected = sweep(**AXES, out=out).load()
    shutil.rmtree(out / "P")
    with pytest.raises(ValueError, match=r"where P/zarr.json is missing"):
        load(out)
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), expected)


@pytest.mark.parametrize("damage", [lambda file: file.write_text("{}"), Path.unlink])
def test_store_without_a_list_is_repaired_from_its_metadata(calls, out, caplog, damage):
    expected = sweep(**FEW, out=out).load()
    damage(out / "vijax.json")
    attribute("units", "mJ")(out / "P" / "zarr.json")
    calls.clear()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)
    xr.testing.assert_identical(load(out), expected)
    assert sum(calls) == 0
    names = [entry.getMessage().partition(f" of {out} is written again")[0] for entry in caplog.records]
    assert names == ["P/zarr.json", "vijax.json"]
    damage(out / "vijax.json")
    exchange(out / "d" / "c" / "0")
    with pytest.raises(FileExistsError, match=r"where vijax.json .* without which d/c/0 cannot be verified; allow"):
        sweep(**FEW, out=out)


@pytest.mark.parametrize("damage", [lambda lock: lock.write_bytes(b"\xff\x00"), Path.unlink])
def test_lost_lock_is_created_again(calls, out, damage):
    expected = sweep(**AXES, out=out).load()
    lock = out / "status" / "tiles" / "lock"
    before = lock.read_bytes()
    damage(lock)
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), expected)
    assert sum(calls) == 0
    assert lock.read_bytes() == before


def test_folder_in_place_of_a_file_is_named_and_not_removed(calls, out):
    sweep(**AXES, out=out)
    for name in ("P/c/0/0", "P/zarr.json", "status/tiles/0.json", "status/tiles/lock"):
        (out / name).rename(out / "kept")
        (out / name).mkdir()
        with pytest.raises(FileExistsError, match=f"{name} must be a file that vijax wrote; got a folder; remove it"):
            sweep(**AXES, out=out)
        (out / name).rmdir()
        (out / "kept").rename(out / name)


def convert_to_earlier_version(out):
    """Convert a store to the form of an earlier version: no list, no consolidated metadata, records by variable."""
    (out / "vijax.json").unlink()
    root = json.loads((out / "zarr.json").read_text())
    del root["consolidated_metadata"]
    (out / "zarr.json").write_text(json.dumps(root))
    for record in records(out):
        content = json.loads(record.read_text())
        content["files"] = {name.partition("/")[0]: value for name, value in content["files"].items()}
        record.write_text(json.dumps(content))


def test_store_of_an_earlier_version_is_loaded_and_resumed(calls, out):
    expected = sweep(**AXES)
    stopped_after(8, out, **AXES)
    convert_to_earlier_version(out)
    before, done = len(calls), len(records(out))
    with pytest.warns(UserWarning, match="has no vijax.json, .* changes of its metadata cannot be detected"):
        assert (load(out)["status"] == Status.NOT_RUN).any()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), expected)
    assert len(calls) - before == len(records(out)) - done
    for damage, message in (
        ("{}", "path must name a store that can be read"),
        ("{", "where P/zarr.json cannot be read"),
    ):
        (out / "P" / "zarr.json").write_text(damage)
        with pytest.raises(ValueError, match=message) as error:
            load(out)
        assert "\n" not in str(error.value)
    sweep(**AXES, out=out, overwrite=True)


def test_store_without_outputs_of_later_versions_is_resumed(calls, out):
    earlier = [name for name in default_outputs(1) if name != "violated_limits"]
    expected = sweep(**AXES, outputs=earlier)
    stopped_after(8, out, **AXES, outputs=earlier)
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), expected)
    assert "violated_limits" in sweep(**AXES, out=out, overwrite=True)


def test_store_opens_in_xarray_without_a_warning(calls, out):
    stopped_after(8, out, **AXES)
    expected = sweep(**AXES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (xr.open_zarr(out)["status"] == Status.NOT_RUN).any()
        sweep(**AXES, out=out)
        xr.testing.assert_identical(xr.open_zarr(out, chunks=None).load(), expected)
        sweeps.save(expected, out.with_name("saved.zarr"))
        xr.testing.assert_identical(xr.open_zarr(out.with_name("saved.zarr"), chunks=None).load(), expected)


# --- with the engine -------------------------------------------------------------------------------------------------

ON_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import numpy as np
import vijax
from vijax.runtime import tiles
assert set(tiles.tile_devices()) == set(jax.devices())
axes = dict(d=np.linspace(0.2, 0.3, 17), r=np.linspace(0.3, 0.7, 21), wall="rigid", periods=12, until="window")
vijax.sweep(**axes, outputs=["impacts_per_period", "restitution"], out=sys.argv[2])
"""


@pytest.mark.long
def test_results_do_not_depend_on_the_number_of_devices(tmp_path):
    stores = []
    for number in (1, 2):
        path = tmp_path / f"{number}.zarr"
        command, environment = [sys.executable, "-c", ON_DEVICES, str(number), str(path)], {"VIJAX_TILE": "128"}
        subprocess.run(command, env=os.environ | environment, check=True)
        assert len(list((path / "status" / "tiles").glob("*.json"))) == 4
        stores.append(load(path))
    first, second = stores
    assert first.attrs["device"] != second.attrs["device"]
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=str(name))
