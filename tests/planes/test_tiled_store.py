"""Planes on disk: tiles and their records, what goes on and what is refused, one writer, any number of devices."""

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
from vijax.batch import simulate
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.planes import dataset, tiled_store
from vijax.planes import sweep as sweeps
from vijax.planes.outputs import default_outputs
from vijax.planes.sweep import load, sweep

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
FEW = AXES | {"outputs": ["P"]}
MOST = 6  # cells of a tile, here


@pytest.fixture
def calls(monkeypatch):
    """A stand-in for the engine and small tiles; the list tells the cells of every call but those that only compile."""
    made = []

    def summarise(*args, count, **settings):
        made.extend([count] if count else [])
        return stand_in(*args, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setenv("VIJAX_TILE", str(MOST))
    monkeypatch.setattr("vijax.planes.dispatch.places", lambda: jax.devices()[:1])
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


def test_a_store_is_compared_with_the_plane_unless_it_was_made_a_moment_ago(calls, out, monkeypatch):
    compared, check_same = [], tiled_store.store_metadata.check_same
    monkeypatch.setattr(
        tiled_store.store_metadata, "check_same", lambda *given: compared.append(1) or check_same(*given)
    )
    sweep(**FEW, out=out)
    assert not compared
    sweep(**FEW, out=out)
    assert len(compared) == 2  # before anything runs, and again when nobody else writes there
    sweep(**FEW, out=out, overwrite=True)
    assert len(compared) == 2


def test_another_run_that_was_faster_is_not_taken_for_this_one(calls, out, monkeypatch):
    other = sweep(**AXES, outputs=["period"], out=out.with_name("other.zarr"))
    make = tiled_store._make

    def slow(planned, birth, target):
        shutil.copytree(out.with_name("other.zarr"), target)
        make(planned, birth, target)

    monkeypatch.setattr(tiled_store, "_make", slow)
    with pytest.raises(FileExistsError, match="P is left out"):
        sweep(**FEW, out=out)
    assert load(out).identical(other.load())


@pytest.mark.parametrize("axes", PLANES.values(), ids=PLANES)
def test_a_study_holds_what_the_sweep_in_memory_returns(calls, out, axes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = sweep(**axes, out=out)
        xr.testing.assert_identical(found.load(), sweep(**axes))
        xr.testing.assert_identical(load(out), found)


def test_what_the_tiles_need_is_compiled_while_their_store_is_made(out, monkeypatch):
    compiling, opened = threading.Event(), tiled_store.opened

    def summarise(*args, count, **settings):
        if not count:
            compiling.set()
        return stand_in(*args, count=count, **settings)

    def opened_meanwhile(*args):
        assert compiling.wait(timeout=20)
        return opened(*args)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr(tiled_store, "opened", opened_meanwhile)
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
    sweeps.save(sweep(**AXES), out)
    with pytest.raises(FileExistsError, match="saved whole"):
        sweep(**AXES, out=out)
    sweep(**AXES, out=out, overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "beside", ["", "{}", '{"attributes": {"source": "vijax 0.1.0"}}'], ids=["alone", "zarr", "ours"]
)
def test_what_vijax_did_not_write_stays(calls, out, overwrite, beside):
    (out / "chapters").mkdir(parents=True)
    thesis = out / "chapters" / "thesis.tex"
    thesis.write_text("precious")
    if beside:
        (out / "zarr.json").write_text(beside)
    with pytest.raises((FileExistsError, ValueError), match=r"thesis.tex; move it" if overwrite else "must"):
        sweep(**AXES, out=out, overwrite=overwrite)
    assert thesis.read_text() == "precious"


STRANGERS = ["thesis.tex", "P/notes.txt", "P/c/0/x", "status/tiles/mine.json", "mine/zarr.json", "mine/c/0"]


@pytest.mark.parametrize("name", STRANGERS)
@pytest.mark.parametrize("whole", [False, True], ids=["study", "saved"])
def test_a_foreign_file_within_a_store_keeps_it(calls, out, name, whole):
    sweeps.save(sweep(**FEW), out) if whole else sweep(**FEW, out=out)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text("precious")
    with pytest.raises(FileExistsError, match=f"which holds {name}; move it elsewhere") as error:
        sweep(**AXES, out=out, overwrite=True)
    assert "\n" not in str(error.value)
    with pytest.raises(FileExistsError, match="path must not replace what vijax did not write"):
        sweeps.save(sweep(**AXES), out, overwrite=True)
    assert (out / name).read_text() == "precious"


def test_a_store_of_somebody_else_stays(calls, out):
    xr.Dataset({"P": ("d", np.arange(3.0))}).to_zarr(out, consolidated=False)
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match=r"out must not .*map\.zarr"):
            sweep(**AXES, out=out, overwrite=overwrite)
    assert xr.open_zarr(out, consolidated=False)["P"].size == 3


def test_a_link_goes_on_pointing_where_it_does(calls, out):
    place = out.with_name("disk.zarr")
    sweep(**AXES, out=place)
    out.symlink_to(place.name)
    sweep(**AXES, r=0.4, out=out, overwrite=True)
    assert out.is_symlink()
    xr.testing.assert_identical(load(place), sweep(**AXES, r=0.4))
    assert {path.name for path in out.parent.iterdir()} == {"map.zarr", "disk.zarr"}


@pytest.mark.parametrize("name", ["map.nc", "map", "map.zarr.json"])
def test_a_store_ends_in_zarr(calls, tmp_path, name):
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=f"out must end in .zarr; got '.*{name}'"):
            sweep(**AXES, out=tmp_path / name, overwrite=overwrite)
    with pytest.raises(ValueError, match=f"path must end in .zarr; got '.*{name}'"):
        sweeps.save(sweep(**AXES), tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_second_writer_is_refused(calls, out, overwrite):
    planned = sweeps.plan(AXES)
    with tiled_store.opened(planned, out):
        with pytest.raises(BlockingIOError, match=r"out must not be in use; got .*map\.zarr, which another"):
            sweep(**AXES, out=out, overwrite=overwrite)
        with pytest.raises(BlockingIOError, match="in use"):
            tiled_store.check(planned, out, overwrite)
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
    assert tiled_store.extents(sizes, most) == expected


def test_a_small_plane_has_tiles_for_everyone(monkeypatch):
    monkeypatch.setattr(tiled_store, "places", lambda: jax.devices()[:1] * 2)
    plane = {"d": np.linspace(0.1, 0.3, 128), "kappa": np.geomspace(3, 400, 64)}
    cells = sweeps.plan(plane).cells
    assert math.prod(tiled_store.blocks(cells).values()) * 4 == cells.count


def test_a_tile_of_many_variants_has_fewer_cells():
    """A chunk has two million numbers at most."""
    plane = {"d": np.linspace(0.1, 0.3, 64), "kappa": np.geomspace(3, 400, 64)}
    few, many = (tiled_store.blocks(sweeps.plan(plane | {"A": np.linspace(1, 2, n)}).cells) for n in (2, 4096))
    assert set(few) == set(many) == {"d", "kappa"}
    assert math.prod(many.values()) * 4096 == 2**21
    assert math.prod(few.values()) >= 1024


def test_tiles_stay_as_they_were_made(calls, out, monkeypatch):
    stopped_after(8, out, **AXES)
    monkeypatch.setenv("VIJAX_TILE", "20")
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


def test_files_of_a_killed_process_are_cleared_and_no_others(calls, out):
    stopped_after(8, out, **AXES)
    tiles, token = out / "status" / "tiles", "0123456789abcdef"
    left = [out / "P" / "c" / "0" / ".1.99.part", tiles / ".3.99.part.json", tiles / f".3.{token}.part.json"]
    others = [
        out / "notes.part1.txt",
        out / "P" / "c" / ".notes.99.part",
        out / "x.part" / "thesis.tex",
        out / "P" / "c" / "9" / f".9.{token}.part",
    ]
    for folder in (others[-1].parent, others[-2].parent):
        folder.mkdir()
    for path in (*left, *others):
        path.write_text("half")
    sweep(**AXES, out=out)
    assert not any(path.exists() for path in left)
    assert all(path.read_text() == "half" for path in others)
    xr.testing.assert_identical(load(out), sweep(**AXES))


def test_what_is_run_again_is_said(calls, out, caplog):
    sweep(**AXES, out=out)
    records(out)[0].write_text("{")
    with caplog.at_level(logging.WARNING):
        sweep(**AXES, out=out)
    assert [record.getMessage() for record in caplog.records] == [
        f"tile 0 of {out} is run again: its record cannot be read"
    ]


@pytest.mark.parametrize("files", [5, [], {"P/c/0/0": 5}], ids=str)
def test_a_record_of_nonsense_is_written_again(calls, out, files):
    whole = sweep(**FEW, out=out).load()
    change(files=files)(records(out)[0])
    with pytest.raises(ValueError, match=r"where (P/c/0/0|status/tiles/0.json) (is not what|cannot be)"):
        load(out)
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), whole)
    assert json.loads(records(out)[0].read_text())["files"] != files


# --- left by killed runs ---------------------------------------------------------------------------------------------


def left_beside(out: Path, *files: str) -> Path:
    """The working folder of a killed run."""
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
def test_what_a_killed_run_left_is_cleared_away(calls, out, caplog, files, overwrite):
    sweep(**AXES, out=out)
    left = left_beside(out, *files)
    sweep(**AXES, out=out, overwrite=overwrite)
    # What is empty may be of a living run, which would make another.
    told = [f"{left.name}, which a killed run had left, is removed"] if files[1:] else []
    assert [said.getMessage() for said in caplog.records] == told
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("reads", [False, True])
def test_what_a_killed_run_had_put_aside_is_back(calls, out, caplog, reads):
    """Where the disk cannot exchange two names a store is nowhere for a moment."""
    whole = sweep(**AXES, out=out).load()
    left = left_beside(out, "lock", "new/zarr.json")
    out.rename(left / "old")
    calls.clear()
    xr.testing.assert_identical(load(out) if reads else sweep(**AXES, out=out).load(), whole)
    assert sum(calls) == 0
    assert [said.getMessage() for said in caplog.records] == ["map.zarr, which a killed run had put aside, is back"]
    assert [path.name for path in out.parent.iterdir()] == [out.name]


WRITER = """
import sys
from pathlib import Path
from vijax.planes.store_folder import replacing_store
with replacing_store("out", Path(sys.argv[1]), overwrite=True) as new:
    new.mkdir()
    print(new, flush=True)
    input()
"""


def test_what_a_living_run_is_at_stays(calls, out):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", WRITER, str(out)], **pipes) as process:
        part = Path(process.stdout.readline().strip())
        whole = sweep(**AXES, out=out).load()
        assert part.is_dir()
        process.kill()
        process.communicate()
    sweep(**AXES, out=out)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    xr.testing.assert_identical(load(out), whole)


@pytest.mark.parametrize("kind", ["study", "saved"])
def test_a_disk_that_cannot_exchange_names_loses_nothing(calls, out, monkeypatch, kind):
    monkeypatch.setattr("vijax.planes.store_folder.exchange", lambda one, other: False)
    sweep(**AXES, r=0.4, out=out) if kind == "study" else sweeps.save(sweep(**AXES, r=0.4), out)
    found = sweep(**AXES, out=out, overwrite=True).load()
    xr.testing.assert_identical(load(out), found)
    sweeps.save(found, out, overwrite=True)
    xr.testing.assert_identical(load(out), found)
    assert [path.name for path in out.parent.iterdir()] == [out.name]


# --- damage ----------------------------------------------------------------------------------------------------------


def change(**entries):
    """Other entries of a file of metadata."""

    def edit(file):
        file.write_text(json.dumps(json.loads(file.read_text()) | entries))

    return edit


def attribute(name, value):
    """Another attribute in a file of metadata; none if the value is None."""

    def edit(file):
        content = json.loads(file.read_text())
        content["attributes"] = {k: v for k, v in (content["attributes"] | {name: value}).items() if v is not None}
        file.write_text(json.dumps(content))

    return edit


def exchange(file):
    """The values of another coordinate, a sound chunk."""
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
    "the list": ("vijax.json", change(birth="another")),
    "text": ("P/zarr.json", lambda file: file.write_bytes(b"\xff{")),
    "no metadata": ("zarr.json", Path.unlink),
    "a list": ("vijax.json", lambda file: file.write_text("[]")),
}


@pytest.mark.parametrize(("name", "edit"), EDITS.values(), ids=EDITS)
def test_an_edit_is_noticed_and_mended(calls, out, caplog, name, edit):
    whole = sweep(**FEW, out=out).load()
    before = (out / name).read_bytes()
    edit(out / name)
    with pytest.raises(ValueError, match=f"where {name} is .*; run again, the call that made it mends it") as error:
        load(out)
    assert "\n" not in str(error.value)
    with pytest.raises(FileExistsError, match=r"out must .*, where .*, allow overwriting|; allow overwriting") as error:
        sweep(**FEW | {"d": np.linspace(0.1, 0.29, 5)}, r=0.4, periods=40, out=out)
    assert "\n" not in str(error.value)
    calls.clear()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), whole)
    xr.testing.assert_identical(load(out), whole)
    assert (out / name).read_bytes() == before
    assert sum(calls) == 0
    assert [said.getMessage().partition(" is written again")[0] for said in caplog.records] == [f"{name} of {out}"]


def test_metadata_are_mended_by_whatever_version(calls, out, monkeypatch):
    whole = sweep(**FEW, out=out).load()
    monkeypatch.setattr(dataset, "made_by", lambda: {"source": "vijax 9"})
    for name in ("zarr.json", "P/zarr.json"):
        (out / name).unlink()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), whole)


def test_an_edit_of_a_saved_map_is_noticed(calls, out):
    sweeps.save(sweep(**AXES), out)
    (out / "P" / "c" / "0" / "0").unlink()
    with pytest.raises(ValueError, match="where P/c/0/0 is missing; make it anew"):
        load(out)


def test_a_variable_that_is_gone_is_run_again(calls, out):
    whole = sweep(**AXES, out=out).load()
    shutil.rmtree(out / "P")
    with pytest.raises(ValueError, match=r"where P/zarr.json is missing"):
        load(out)
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), whole)


@pytest.mark.parametrize("damage", [lambda file: file.write_text("{}"), Path.unlink])
def test_a_store_without_its_list_is_mended_as_far_as_its_metadata_tell(calls, out, caplog, damage):
    whole = sweep(**FEW, out=out).load()
    damage(out / "vijax.json")
    attribute("units", "mJ")(out / "P" / "zarr.json")
    calls.clear()
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), whole)
    xr.testing.assert_identical(load(out), whole)
    assert sum(calls) == 0
    names = [said.getMessage().partition(f" of {out} is written again")[0] for said in caplog.records]
    assert names == ["P/zarr.json", "vijax.json"]
    damage(out / "vijax.json")
    exchange(out / "d" / "c" / "0")
    with pytest.raises(FileExistsError, match=r"where vijax.json .* tell whether d/c/0 is what was written; allow"):
        sweep(**FEW, out=out)


@pytest.mark.parametrize("damage", [lambda lock: lock.write_bytes(b"\xff\x00"), Path.unlink])
def test_a_lock_that_is_lost_is_made_again(calls, out, damage):
    whole = sweep(**AXES, out=out).load()
    lock = out / "status" / "tiles" / "lock"
    before = lock.read_bytes()
    damage(lock)
    calls.clear()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), whole)
    assert sum(calls) == 0
    assert lock.read_bytes() == before


def test_a_folder_in_place_of_a_file_is_named_and_stays(calls, out):
    sweep(**AXES, out=out)
    for name in ("P/c/0/0", "P/zarr.json", "status/tiles/0.json", "status/tiles/lock"):
        (out / name).rename(out / "kept")
        (out / name).mkdir()
        with pytest.raises(FileExistsError, match=f"{name} must be a file that vijax wrote; got a folder; remove it"):
            sweep(**AXES, out=out)
        (out / name).rmdir()
        (out / "kept").rename(out / name)


def as_before(out):
    """Make a store what an earlier version wrote: no list, no metadata kept together, records by variable."""
    (out / "vijax.json").unlink()
    root = json.loads((out / "zarr.json").read_text())
    del root["consolidated_metadata"]
    (out / "zarr.json").write_text(json.dumps(root))
    for record in records(out):
        content = json.loads(record.read_text())
        content["files"] = {name.partition("/")[0]: value for name, value in content["files"].items()}
        record.write_text(json.dumps(content))


def test_a_store_of_an_earlier_version_opens_and_goes_on(calls, out):
    whole = sweep(**AXES)
    stopped_after(8, out, **AXES)
    as_before(out)
    before, done = len(calls), len(records(out))
    with pytest.warns(UserWarning, match="has no vijax.json, .* edits of its metadata go unseen"):
        assert (load(out)["status"] == Status.NOT_RUN).any()
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), whole)
    assert len(calls) - before == len(records(out)) - done
    for damage, say in (("{}", "path must name a store that can be read"), ("{", "where P/zarr.json cannot be read")):
        (out / "P" / "zarr.json").write_text(damage)
        with pytest.raises(ValueError, match=say) as error:
            load(out)
        assert "\n" not in str(error.value)
    sweep(**AXES, out=out, overwrite=True)


def test_a_store_goes_on_without_outputs_that_came_in_a_later_version(calls, out):
    earlier = [name for name in default_outputs(1) if name != "violated_limits"]
    whole = sweep(**AXES, outputs=earlier)
    stopped_after(8, out, **AXES, outputs=earlier)
    xr.testing.assert_identical(sweep(**AXES, out=out).load(), whole)
    assert "violated_limits" in sweep(**AXES, out=out, overwrite=True)


def test_a_store_opens_anywhere_without_a_warning(calls, out):
    stopped_after(8, out, **AXES)
    whole = sweep(**AXES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (xr.open_zarr(out)["status"] == Status.NOT_RUN).any()
        sweep(**AXES, out=out)
        xr.testing.assert_identical(xr.open_zarr(out, chunks=None).load(), whole)
        sweeps.save(whole, out.with_name("saved.zarr"))
        xr.testing.assert_identical(xr.open_zarr(out.with_name("saved.zarr"), chunks=None).load(), whole)


# --- with the engine -------------------------------------------------------------------------------------------------

ON_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import numpy as np
import vijax
from vijax.runtime import tiles
assert set(tiles.places()) == set(jax.devices())
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
    one, two = stores
    assert one.attrs["device"] != two.attrs["device"]
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=str(name))
