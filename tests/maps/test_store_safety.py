"""Stores from other sources, edited stores, concurrent writers: no foreign file changes, no wrong value loads."""

import json
import logging
import os
import pickle
import shutil
import threading
import zlib
from itertools import islice
from pathlib import Path

import jax
import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr

from tests.helpers import stand_in
from vijax.explorer.source import Source
from vijax.maps import sweep as sweeps
from vijax.maps.execution import cluster
from vijax.maps.storage import store, tiled_store
from vijax.maps.sweep import load, save, sweep
from vijax.model.records import Status
from vijax.runtime import validation
from vijax.simulation import simulate

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
FEW = AXES | {"outputs": ["P"]}
MAX_TILE_CELLS = 6


@pytest.fixture(autouse=True)
def engine(monkeypatch):
    """Replace the engine by a stand-in and use small tiles."""
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", str(MAX_TILE_CELLS))
    monkeypatch.setattr("vijax.maps.execution.dispatch.tile_devices", lambda: jax.devices()[:1])


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "map.zarr"


@pytest.fixture
def elsewhere(tmp_path) -> Path:
    """Return a foreign folder with files that have the names of files of a store."""
    folder = tmp_path / "elsewhere"
    for name in ("0.json", "lock", "zarr.json", ".0.99.part", "c/0/0"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("precious")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fingerprint(text: bytes) -> str:
    return f"{len(text)} bytes, CRC-32 {zlib.crc32(text):08x}"


def forge(out: Path, **entries) -> None:
    """Change entries of the list of a store and update its checksum."""
    inventory = json.loads((out / "vijax.json").read_text())
    del inventory["checksum"]
    for name, entry in entries.items():
        inventory[name] = inventory[name] | entry if isinstance(entry, dict) else entry
    checksum = fingerprint(json.dumps(inventory, sort_keys=True).encode())
    (out / "vijax.json").write_text(json.dumps(inventory | {"checksum": checksum}))


def declare(out: Path, *shape: int, chunks: tuple[int, ...] | None = None) -> None:
    """Declare other lengths of the axes of a store and list the changed metadata."""
    sizes = dict(zip(AXES, shape, strict=True))
    metadata = {}
    for file in out.glob("*/zarr.json"):
        array = json.loads(file.read_text())
        dims = array.get("dimension_names") or []
        array["shape"] = [sizes.get(dim, length) for dim, length in zip(dims, array["shape"], strict=True)]
        if chunks is not None and len(dims) == 2:
            lengths = dict(zip(AXES, chunks, strict=True))
            configuration = array["chunk_grid"]["configuration"]
            shorter = [lengths.get(dim, old) for dim, old in zip(dims, configuration["chunk_shape"], strict=True)]
            configuration["chunk_shape"] = shorter
        metadata[file.parent.name] = array
        file.write_text(json.dumps(array))
    root = json.loads((out / "zarr.json").read_text())
    root["consolidated_metadata"]["metadata"] = metadata
    (out / "zarr.json").write_text(json.dumps(root))
    metadata_texts = {file.relative_to(out).as_posix(): file.read_text() for file in out.rglob("zarr.json")}
    forge(
        out, files={name: fingerprint(text.encode()) for name, text in metadata_texts.items()}, metadata=metadata_texts
    )


# --- hostile stores --------------------------------------------------------------------------------------------------

NAMES = {
    "beside": "../elsewhere/.bashrc",
    "named as metadata": "../elsewhere/zarr.json",
    "named as an array": "../zarr.json",
    "through a chunk": "P/c/../../../elsewhere/zarr.json",
    "from the root": "/{elsewhere}/zarr.json",
    "a dot": "P/./zarr.json",
    "another folder": "P/notes.txt",
    "another array": "mine/zarr.json",
}


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_forged_list_writes_no_file_outside_the_store(out, elsewhere, name):
    expected = sweep(**FEW, out=out).load()
    name = name.format(elsewhere=str(elsewhere)[1:])
    forge(out, files={name: fingerprint(b"evil")}, metadata={name: "evil"})
    before, inside = content(elsewhere), set(content(out))
    with pytest.raises(ValueError, match=r"where .* is "):
        load(out)
    # A list with impossible names is damaged and is repaired; a list with one more array belongs to another map.
    if name == NAMES["another array"]:
        with pytest.raises(FileExistsError, match=r"where mine/zarr\.json is missing"):
            sweep(**FEW, out=out)
    else:
        xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)
    assert content(elsewhere) == before
    assert set(content(out)) == inside
    assert not (out.parent / "zarr.json").exists()


def test_list_with_invalid_entries_is_repaired(out):
    expected = sweep(**FEW, out=out).load()
    for entries in (
        {"store_id": 5},
        {"tile": [3, 2]},
        {"tile": {"d": 0, "kappa": 2}},
        {"files": 5},
        {"metadata": None},
    ):
        forge(out, **entries)
        with pytest.raises(ValueError, match=r"where vijax.json is not what was written"):
            load(out)
        xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)


def test_list_with_other_tiles_is_rejected(out):
    sweep(**FEW, out=out)
    declare(out, 5, 4, chunks=(1, 1))
    with pytest.raises(FileExistsError, match="must be new or hold the same plane"):
        sweep(**FEW, out=out)


LINKS = ["P", "P/c", "P/c/0", "status", "status/tiles"]


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_is_written_or_removed_through_a_link(out, elsewhere, name, overwrite):
    sweep(**FEW, out=out)
    shutil.rmtree(out / name)
    (out / name).symlink_to(elsewhere)
    before = content(elsewhere)
    for call in (lambda: sweep(**FEW, out=out, overwrite=overwrite), lambda: save(sweep(**FEW), out, overwrite=True)):
        with pytest.raises(FileExistsError, match=f"{name} must .*; got a link|which holds {name};"):
            call()
    assert content(elsewhere) == before
    assert (out / name).is_symlink()


@pytest.mark.parametrize("name", ["P/zarr.json", "vijax.json", "status/tiles/lock", "status/tiles/0.json", "P/c/0/0"])
def test_link_in_place_of_a_file_is_replaced_and_not_followed(out, elsewhere, name):
    expected = sweep(**FEW, out=out).load()
    (out / name).unlink()
    (out / name).symlink_to(elsewhere / "lock")
    before = content(elsewhere)
    xr.testing.assert_identical(sweep(**FEW, out=out).load(), expected)
    assert content(elsewhere) == before
    assert not (out / name).is_symlink()


@pytest.mark.parametrize("nested", [False, True], ids=["store", "array within"])
def test_zarr_format_2_is_rejected(out, nested):
    """Codecs of zarr format 2 may execute code: numcodecs before 0.16.6 unpickles chunks."""
    folder = out / "P" if nested else out
    if nested:
        sweep(**FEW, out=out)
        shutil.rmtree(folder)
        shutil.rmtree(out / "status")
        (out / "vijax.json").unlink()
        root = json.loads((out / "zarr.json").read_text())
        del root["consolidated_metadata"]
        (out / "zarr.json").write_text(json.dumps(root))
        zarr.create_array(folder, data=np.arange(3.0), zarr_format=2)
    else:
        xr.Dataset({"P": ("d", np.arange(3.0))}).to_zarr(out, zarr_format=2, consolidated=True)
        (out / "vijax.json").write_text('{"files": {}, "metadata": {}}')
        inventory = {"files": {}, "metadata": {}}
        inventory["checksum"] = fingerprint(json.dumps(inventory, sort_keys=True).encode())
        (out / "vijax.json").write_text(json.dumps(inventory))
    with pytest.raises(ValueError, match="path must name a store") as error:
        load(out)
    assert "\n" not in str(error.value)


class FileCreator:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_no_chunk_is_unpickled(out, monkeypatch):
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True)  # as before numcodecs 0.16.6
    array = {
        "zarr_format": 2,
        "shape": [1],
        "chunks": [1],
        "dtype": "|O",
        "fill_value": None,
        "order": "C",
        "filters": [{"id": "vlen-utf8"}],
        "compressor": {"id": "pickle"},
    }
    metadata = {
        ".zgroup": {"zarr_format": 2},
        ".zattrs": {},
        "P/.zarray": array,
        "P/.zattrs": {"_ARRAY_DIMENSIONS": ["d"]},
    }
    (out / "P").mkdir(parents=True)
    for name, entry in metadata.items():
        (out / name).write_text(json.dumps(entry))
    (out / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": metadata}))
    (out / "P" / "0").write_bytes(pickle.dumps(FileCreator(out.with_name("evil"))))
    inventory = {"files": {}, "metadata": {}}
    (out / "vijax.json").write_text(json.dumps(inventory | {"checksum": fingerprint(json.dumps(inventory).encode())}))
    with pytest.raises(ValueError, match="path must name a store that can be read"):
        load(out)
    assert not out.with_name("evil").exists()


# --- foreign files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sibling", [".map.999997.old.zarr", ".map.0123456789abcdef.part.zarr"])
@pytest.mark.parametrize("name", ["thesis.tex", "new/P/c/2024/06/15"])
def test_sibling_folders_with_foreign_files_are_not_removed(out, sibling, name):
    file = out.with_name(sibling) / name
    file.parent.mkdir(parents=True)
    file.write_text("precious")
    save(sweep(**FEW), out)
    sweep(**FEW, out=out, overwrite=True)
    assert file.read_text() == "precious"


FOREIGN_FILES = [
    "P/c/2024/06/15",
    "P/c/2024/6",
    "P/c/0/0/0",
    "P/c/00/0",
    "P/c/9/9",
    "status/tiles/9999.json",
    "zarrXjson",
    "vijaxXjson",
    "A/zarrXjson",
]


@pytest.mark.parametrize("saved", [False, True], ids=["study", "saved"])
@pytest.mark.parametrize("has_list", [True, False], ids=["listed", "without its list"])
@pytest.mark.parametrize("name", FOREIGN_FILES)
def test_store_with_a_foreign_file_named_like_a_chunk_is_not_replaced(out, saved, has_list, name):
    save(sweep(**FEW), out) if saved else sweep(**FEW, out=out)
    if name == "P/c/0/0/0":
        (out / "P/c/0/0").unlink()
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text("precious")
    if not has_list:
        (out / "vijax.json").unlink()
    for call in (lambda: sweep(**FEW, out=out, overwrite=True), lambda: save(sweep(**FEW), out, overwrite=True)):
        with pytest.raises(FileExistsError, match=f"which holds {name}; move it elsewhere"):
            call()
    assert (out / name).read_text() == "precious"


@pytest.mark.parametrize("name", ["notes", "P/notes", "P/c/7", "status/tiles/more"])
def test_store_with_a_foreign_empty_folder_is_not_replaced(out, name):
    sweep(**FEW, out=out)
    (out / name).mkdir()
    with pytest.raises(FileExistsError, match=f"which holds {name}; move it elsewhere"):
        save(sweep(**FEW), out, overwrite=True)
    assert (out / name).is_dir()


# --- two writers -----------------------------------------------------------------------------------------------------


def small(value: float) -> xr.Dataset:
    return xr.Dataset({"P": ("d", np.full(64, value)), "status": ("d", np.full(64, int(value), "i1"))})


def test_concurrent_saves_to_a_path_leave_a_complete_store(out):
    """Threads share one process number, as processes in two containers may."""
    datasets = [small(1.0), small(2.0)]
    save(small(0.0), out)
    for _ in range(10):
        start, errors = threading.Barrier(2), []

        def write(dataset, start=start, errors=errors):
            start.wait()
            try:
                save(dataset, out, overwrite=True)
            except Exception as error:
                errors.append(error)

        threads = [threading.Thread(target=write, args=(dataset,)) for dataset in datasets]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not errors
        assert any(load(out).identical(dataset) for dataset in datasets)
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_later_of_two_concurrent_saves_to_a_new_path_is_rejected(out, monkeypatch):
    started, released = threading.Event(), threading.Event()
    write_store = store.write_store

    def wait_and_write(*arguments):
        started.set()
        assert released.wait(60)
        return write_store(*arguments)

    monkeypatch.setattr(store, "write_store", wait_and_write)
    errors = []

    def first():
        try:
            save(small(1.0), out)
        except FileExistsError as error:
            errors.append(error)

    thread = threading.Thread(target=first)
    thread.start()
    assert started.wait(60)
    monkeypatch.setattr(store, "write_store", write_store)
    save(small(2.0), out)
    released.set()
    thread.join()
    assert len(errors) == 1
    assert "path must not exist yet" in str(errors[0])
    xr.testing.assert_identical(load(out), small(2.0))
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_save_does_not_remove_the_working_folder_of_another_save(out, monkeypatch, caplog):
    write_store, parts = store.write_store, []

    def save_concurrently(dataset, part, *more):
        result = write_store(dataset, part, *more)
        if not parts:
            parts.append(part)
            save(small(2.0), out, overwrite=True)
            assert (part / "zarr.json").exists()
        return result

    monkeypatch.setattr(store, "write_store", save_concurrently)
    with caplog.at_level(logging.WARNING):
        save(small(1.0), out, overwrite=True)
    assert not caplog.records
    xr.testing.assert_identical(load(out), small(1.0))


def test_save_over_a_study_that_is_being_written_is_rejected(out):
    with (
        tiled_store.open_study(sweeps.plan(AXES), out),
        pytest.raises(BlockingIOError, match="path must not be in use"),
    ):
        save(small(1.0), out, overwrite=True)
    save(small(1.0), out, overwrite=True)
    xr.testing.assert_identical(load(out), small(1.0))


def test_map_that_is_replaced_during_load_is_loaded_again(out, monkeypatch):
    save(small(1.0).assign_coords(d=np.arange(64.0)), out)
    open_zarr, replacements = xr.open_zarr, []

    def open_and_replace(*args, **options):
        result = open_zarr(*args, **options)
        if not replacements:
            replacements.append(1)
            save(small(2.0), out, overwrite=True)
        return result

    monkeypatch.setattr(xr, "open_zarr", open_and_replace)
    xr.testing.assert_identical(load(out), small(2.0))


# --- lost chunks -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("saved", [False, True], ids=["study", "saved"])
@pytest.mark.parametrize("name", ["status", "P", "impacts_left"])
def test_lost_chunk_without_a_list_has_status_not_run(out, saved, name):
    expected = sweep(**AXES)
    save(expected, out) if saved else sweep(**AXES, out=out)
    (out / "vijax.json").unlink()
    (out / name / "c" / "0" / "0").unlink()
    with pytest.warns(UserWarning, match="has no vijax.json"):
        result = load(out)
    lost = (result["status"] == Status.NOT_RUN).values
    assert lost.any()
    assert not (expected["status"] == Status.NOT_RUN).any()
    for variable in expected.data_vars:
        np.testing.assert_array_equal(result[variable].values[~lost], expected[variable].values[~lost])
    # Any zarr reader detects the loss by the status or by fill values.
    with xr.open_zarr(out, consolidated=False, chunks=None) as plain:
        fill_value = {"status": Status.NOT_RUN, "P": np.nan, "impacts_left": -1}[name]
        np.testing.assert_array_equal(np.unique(plain[name].values[lost]), [fill_value])


def test_lost_chunk_of_a_map_without_status_is_an_error(out):
    save(small(1.0)[["P"]], out)
    (out / "vijax.json").unlink()
    (out / "P" / "c" / "0").unlink()
    with pytest.raises(ValueError, match="where P/c/0 is missing; write it again"):
        load(out)


def test_lost_coordinate_without_a_list_is_an_error(out):
    sweep(**AXES, out=out)
    (out / "vijax.json").unlink()
    (out / "d" / "c" / "0").unlink()
    with pytest.raises(ValueError, match="where d/c/0 is missing"):
        load(out)


@pytest.mark.parametrize("lost", ["status/zarr.json", "status"])
def test_lost_variable_without_a_list_is_an_error(out, lost):
    save(sweep(**AXES), out)
    (out / "vijax.json").unlink()
    shutil.rmtree(out / lost) if lost == "status" else (out / lost).unlink()
    with pytest.raises(ValueError, match=r"where status/zarr\.json is missing"):
        load(out)


# --- declared sizes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("has_list", [True, False], ids=["listed", "without its list"])
@pytest.mark.parametrize(
    ("shape", "chunks", "message"),
    [
        ((10**6, 10**6), None, "must name a map that fits in memory, 16 GB; got .*, whose arrays take 9 TB"),
        ((10**400, 4), None, "must name a map that fits in memory, 16 GB; got .*, whose arrays take .* TB"),
        ((60000, 60000), None, "must name a map that fits in memory, 16 GB; got .*, whose arrays take 32.4 GB"),
        ((30000, 30000), (3, 2), "must name a map of at most 1,000,000 chunks in an array; got .*, where P has 150,"),
        ((0, 0), None, "must name a map of at least one cell; got .*, where status has 0 x 0"),
        ((1, 1), None, "where .* has 1.* in chunks of .*"),
        ((-1, 4), None, "must name a store"),
    ],
    ids=["trillion", "googol", "large", "many chunks", "none", "one", "negative"],
)
def test_store_with_impossible_sizes_is_rejected_in_a_single_line(out, monkeypatch, shape, chunks, message, has_list):
    monkeypatch.setattr(validation, "memory", lambda: 16e9)
    sweep(**FEW, out=out)
    declare(out, *shape, chunks=chunks)
    if not has_list:
        (out / "vijax.json").unlink()
    with pytest.raises(ValueError, match=message) as error:
        load(out)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="source: path must name"):
        Source(out).check()


def test_part_of_a_map_without_a_list_is_loaded(out):
    part = sweep(**AXES)[["P", "status"]]
    save(part, out)
    (out / "vijax.json").unlink()
    with pytest.warns(UserWarning, match=r"has no vijax\.json"):
        xr.testing.assert_identical(load(out), part)


def test_consolidated_metadata_with_impossible_sizes_are_rejected(out, monkeypatch):
    monkeypatch.setattr(validation, "memory", lambda: 16e9)
    sweep(**FEW, out=out)
    texts = {file: file.read_text() for file in out.glob("*/zarr.json")}
    declare(out, 60000, 60000)
    for file, text in texts.items():
        file.write_text(text)
    forge(out, files={file.relative_to(out).as_posix(): fingerprint(text.encode()) for file, text in texts.items()})
    with pytest.raises(ValueError, match=r"must name a map that fits in memory, 16 GB; got .* take 32.4 GB"):
        load(out)


@pytest.mark.parametrize("name", ["a/b", "..", ".", "vijax.json", "zarr.json"])
def test_variable_with_an_invalid_folder_name_is_rejected(out, name):
    with pytest.raises(ValueError, match="dataset must have variables that can name a folder; got"):
        save(small(1.0).rename(P=name), out)
    assert not list(out.parent.iterdir())


def test_map_of_a_single_cell_is_loaded_and_rejected_by_the_explorer(out):
    result = sweep(d=[0.2], kappa=[30.0], out=out).load()
    xr.testing.assert_identical(load(out), result)
    with pytest.raises(ValueError, match="source: dataset must have two axes of more than one value; got none"):
        Source(out).check()


# --- names of paths --------------------------------------------------------------------------------------------------


def test_path_with_a_line_break_is_escaped_in_errors(tmp_path):
    path = tmp_path / "a\nb.zarr"
    for call in (load, lambda path: sweep(**FEW, out=path / "c.zarr"), lambda path: save(small(1.0), path / "c.zarr")):
        with pytest.raises(OSError, match=r"a\\nb\.zarr") as error:
            call(path)
        assert "\n" not in str(error.value)
    save(small(1.0), path)
    for call in (
        lambda: save(small(1.0), path),
        lambda: sweep(**FEW, out=path),
        lambda: ((path / "P/c/0").write_text("{"), load(path)),
        lambda: ((path / "vijax.json").unlink(), (path / "P/zarr.json").write_text("{}"), load(path)),
    ):
        with pytest.raises((ValueError, OSError), match=r"a\\nb\.zarr") as error:
            call()
        assert "\n" not in str(error.value)


def test_path_that_cannot_be_encoded_is_rejected():
    for call in (load, lambda path: save(small(1.0), path), lambda path: sweep(**FEW, out=path)):
        with pytest.raises(ValueError, match=r"must be a path, as text or a pathlib.Path; got '\\ud800\.zarr'"):
            call("\ud800.zarr")


def test_link_to_itself_is_named_in_the_error(out):
    out.symlink_to(out.name)
    for call in (
        lambda: load(out),
        lambda: save(small(1.0), out),
        lambda: save(small(1.0), out, overwrite=True),
        lambda: sweep(**FEW, out=out),
    ):
        with pytest.raises(OSError, match=r"must .*map\.zarr") as error:
            call()
        assert "\n" not in str(error.value)
    assert os.readlink(out) == out.name


# --- a lost scheduler ------------------------------------------------------------------------------------------------


def test_completed_tiles_are_counted_when_the_scheduler_is_lost(out, monkeypatch):
    def lost(work, tasks, workers):
        for task in islice(tasks, 2):
            work(task)
        raise ConnectionError("the scheduler was lost")
        yield

    monkeypatch.setattr(cluster, "check_available", lambda workers: None)
    monkeypatch.setattr(cluster, "run_tasks", lost)
    with pytest.raises(ConnectionError) as error:
        sweep(**FEW, out=out, workers="tcp://127.0.0.1:1")
    done = sum(json.loads(record.read_text())["cells"] for record in (out / "status" / "tiles").glob("*.json"))
    assert done > 0
    assert error.value.__notes__ == [f"{done} of 20 cells are in {out}; the same command continues from there"]
