"""Studies after faults: killed and stopped processes, a full disk, a read-only store, damaged files.

A stand-in replaces the engine; `benchmarks/faults.py` runs the same faults with the engine.
"""

import errno
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

from scripts import grid as script
from tests.helpers import cases, stand_in
from vijax import plots
from vijax.cli.process import leave
from vijax.maps import sweep as sweeps
from vijax.maps.execution import dispatch
from vijax.maps.storage import tiled_store
from vijax.maps.sweep import load, sweep
from vijax.plots.style import is_drawn
from vijax.runtime import files
from vijax.simulation import simulate

AXES = {"d": np.linspace(0.1, 0.3, 8), "kappa": np.geomspace(3, 400, 6)}
ARGUMENTS = ["--d", "0.1:0.3:8", "--kappa", "3:400:6:log", "--out", "map.zarr"]
TILE_CELLS = 6


def slow_engine(*args, **settings):
    time.sleep(0.05)
    return stand_in(*args, **settings)


def prepare():
    """Install the stand-in in this process."""
    simulate.summarise, dispatch.tile_devices = slow_engine, lambda: jax.devices()[:1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", str(TILE_CELLS))
    monkeypatch.setattr(dispatch, "tile_devices", lambda: jax.devices()[:1])
    return tmp_path


def assert_undisturbed(path):
    """Assert that a store equals an undisturbed sweep and that no temporary file remains."""
    result, expected = load(path), sweep(**AXES)
    for name in expected:
        np.testing.assert_array_equal(result[name], expected[name], err_msg=str(name))
    assert not list(Path(path).rglob("*.part*"))


CHILD = "import sys; from tests.benchmarks import test_faults; test_faults.child(sys.argv[1:])"


def child(arguments):
    """Run the script with the stand-in; the tests may stop or kill this process."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # children of a background job ignore SIGINT by default
    prepare()
    leave(script.main(arguments))


def started(folder):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", CHILD, *ARGUMENTS], cwd=folder, **pipes)


def wait_for_tiles(folder, process, number):
    tiles = folder / "map.zarr" / "status" / "tiles"
    while len(list(tiles.glob("[0-9]*.json"))) < number:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)


SIGNALS = [(signal.SIGKILL, -9), (signal.SIGTERM, 143), (signal.SIGINT, 130)]


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
@pytest.mark.parametrize(("signal_number", "code"), SIGNALS, ids=[signal_number.name for signal_number, _ in SIGNALS])
def test_stopped_process_loses_no_completed_tile(folder, signal_number, code):
    process = started(folder)
    try:
        wait_for_tiles(folder, process, 2)
        process.send_signal(signal_number)
        _, stderr = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == code
    done = study_records(folder)
    assert len(done) >= 2
    if signal_number != signal.SIGKILL:
        completed_cells = TILE_CELLS * len(done)
        last_line = stderr.strip().splitlines()[-1]
        assert (
            last_line
            == f"stopped; {completed_cells} of 48 cells are in map.zarr; the same command continues from there"
        )
    assert script.main([*ARGUMENTS]) == 0
    assert study_records(folder).items() >= done.items()
    assert_undisturbed("map.zarr")


def study_records(folder):
    """Return the completion records of tiles with their modification times."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "map.zarr/status/tiles").glob("[0-9]*.json")}


def test_second_process_is_rejected_with_a_single_line(folder, capsys):
    process = started(folder)
    try:
        wait_for_tiles(folder, process, 1)
        assert script.main(ARGUMENTS) == 2
        assert capsys.readouterr().err == (
            "error: out must not be in use; got map.zarr, which another run is writing; see docs: studies\n"
        )
        assert script.main([*ARGUMENTS, "--overwrite"]) == 2
        process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    assert_undisturbed("map.zarr")


@pytest.mark.parametrize("at", ["chunk", "record"])
def test_full_disk_error_is_a_single_line_and_completed_tiles_remain(folder, capsys, monkeypatch, at):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")

    def write_json(report, path):
        if path.name == "3.json":
            raise full
        files.write_json(report, path)

    def _chunk_files(dims, place):
        if place == {"d": 1, "kappa": 1}:  # of tile 3
            raise full
        return chunks(dims, place)

    chunks = tiled_store._chunk_files
    with monkeypatch.context() as disk:
        disk.setattr(
            *(
                (tiled_store, "write_json", write_json)
                if at == "record"
                else (tiled_store, "_chunk_files", _chunk_files)
            )
        )
        assert script.main(ARGUMENTS) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        "error: No space left on device (somewhere); "
        "18 of 48 cells are in map.zarr; the same command continues from there"
    )
    assert len(study_records(folder)) == 3
    assert script.main(ARGUMENTS) == 0
    assert_undisturbed("map.zarr")


def test_read_only_store_is_named_in_the_error(folder, capsys, monkeypatch):
    sweep(**AXES, out="map.zarr")
    opened = os.open

    def refuse(path, flags, *args, **options):
        if "map.zarr" in os.fspath(path) and flags & (os.O_WRONLY | os.O_RDWR):
            raise PermissionError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return opened(path, flags, *args, **options)

    with monkeypatch.context() as disk:
        disk.setattr(os, "open", refuse)
        assert script.main(ARGUMENTS) == 2
    message = "error: out must be a store that can be written; got map.zarr (Read-only file system)\n"
    assert capsys.readouterr().err == message
    assert_undisturbed("map.zarr")


def truncate(chunk):
    chunk.write_bytes(chunk.read_bytes()[:-3])


def flip(chunk):
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)


def exchange(chunk):
    """Replace a chunk by another valid chunk."""
    chunk.write_bytes((chunk.parent.parent / "0" / "0").read_bytes())


def pipe(chunk):
    """Replace a chunk by a named pipe; a read of it never returns."""
    chunk.unlink()
    os.mkfifo(chunk)


def device(chunk):
    """Replace a chunk by a link to a device without end."""
    chunk.unlink()
    chunk.symlink_to("/dev/zero")


DAMAGES = {
    truncate: "P/c/2/1 is not what was written",
    flip: "P/c/2/1 is not what was written",
    exchange: "P/c/2/1 is not what was written",
    Path.unlink: "P/c/2/1 is missing",
    pipe: "P/c/2/1 is no regular file",
    device: "P/c/2/1 is no regular file",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=[damage.__name__ for damage in DAMAGES])
def test_damaged_chunk_is_simulated_again(folder, caplog, damage):
    sweep(**AXES, out="map.zarr")
    before = study_records(folder)
    damage(folder / "map.zarr" / "P" / "c" / "2" / "1")
    with pytest.raises(ValueError, match=f"where {DAMAGES[damage]}; repeat the call that made it, which repairs it"):
        load("map.zarr")
    with caplog.at_level(logging.WARNING):
        result = sweep(**AXES, out="map.zarr")
    assert [record.getMessage() for record in caplog.records] == [f"tile 5 of map.zarr is run again: {DAMAGES[damage]}"]
    again = study_records(folder)
    assert [name for name in before if again[name] != before[name]] == ["5.json"]
    assert_undisturbed("map.zarr")
    xr.testing.assert_identical(result.load(), load("map.zarr"))


# --- foreign files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", cases(["map.png", "map.pdf", "map.svg", "map.eps"], long=("map.pdf", "map.eps")))
def test_plot_of_vijax_is_replaced_and_a_foreign_file_is_not(folder, capsys, name):
    assert script.main([*ARGUMENTS, "--plot", name]) == 0
    drawn = (folder / name).read_bytes()
    assert script.main([*ARGUMENTS, "--plot", name]) == 0
    for foreign in (drawn.replace(b"vijax", b"dream"), b"precious"):
        (folder / name).write_bytes(foreign)
        capsys.readouterr()
        assert script.main([*ARGUMENTS, "--plot", name]) == 2
        message = f"error: plot must be new or a picture drawn by vijax; got {name}; take another name\n"
        assert capsys.readouterr().err == message
        assert (folder / name).read_bytes() == foreign
    assert script.main([*ARGUMENTS, "--plot", name, "--overwrite"]) == 0
    assert is_drawn(folder / name)


@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_foreign_folder_is_not_overwritten(folder, capsys, option):
    name = "map.zarr" if option == "--out" else "map.png"
    (folder / name).mkdir()
    for file in ("zarr.json", "thesis.tex"):
        (folder / name / file).write_text("{}")
    assert script.main([option, name, "--overwrite"]) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith(f"error: {option[2:]} must not replace")
    assert stderr.count("\n") == 1
    assert (folder / name / "thesis.tex").exists()


def test_plot_never_replaces_a_folder(folder):
    sweeps.save(sweep(**AXES), "map.zarr")
    (folder / "map.png").mkdir()
    (folder / "map.png" / "thesis.tex").write_text("precious")
    with pytest.raises(IsADirectoryError):
        plots.save(plots.power_map(load("map.zarr")), "map.png")
    assert [path.name for path in (folder / "map.png").iterdir()] == ["thesis.tex"]


def test_temporary_plot_of_a_killed_run_is_removed(folder, capsys, caplog):
    remnant = folder / ".map.0123456789abcdef.part.png"
    remnant.write_text("half")
    assert script.main([*ARGUMENTS, "--plot", "map.png"]) == 0
    assert [record.getMessage() for record in caplog.records] == [f"removed {remnant.name}, left by a killed run"]
    assert {path.name for path in folder.iterdir()} == {"map.zarr", "map.png"}


@pytest.mark.parametrize("coding", ["latin-1", "ascii", "utf-8"])
def test_name_that_the_terminal_cannot_encode_does_not_stop_a_run(folder, monkeypatch, coding):
    name = "\u03ba\udcff.zarr"  # a Greek letter and a byte that is not valid UTF-8
    with open("told.txt", "w", encoding=coding) as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert script.main([*ARGUMENTS[:-1], name]) == 0
    assert b".zarr\n" in (folder / "told.txt").read_bytes()
    assert_undisturbed(name)
