"""What a study survives: killed and stopped processes, a full disk, a store it may not write, damaged files.

With a stand-in for the engine; `benchmarks/faults.py` does the same to the real one.
"""

import errno
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import command
import grid as script
import jax
import numpy as np
import pytest
import xarray as xr
from helpers import SCRIPTS, stand_in

from vijax import calls, simulate, store, study
from vijax.grid import load, sweep

AXES = {"d": np.linspace(0.1, 0.3, 8), "kappa": np.geomspace(3, 400, 6)}
ARGUMENTS = ["--d", "0.1:0.3:8", "--kappa", "3:400:6:log", "--out", "map.zarr"]
MOST = 6


def slow_engine(*args, **settings):
    time.sleep(0.05)
    return stand_in(*args, **settings)


def prepare():
    """The stand-in and small tiles, in this process."""
    simulate.summarise, study.LARGEST_TILE, calls.places = slow_engine, MOST, lambda: jax.devices()[:1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setattr(study, "LARGEST_TILE", MOST)
    monkeypatch.setattr(calls, "places", lambda: jax.devices()[:1])
    return tmp_path


def is_undisturbed(path):
    """Whether a store holds what one does that nothing befell."""
    found, whole = load(path), sweep(**AXES)
    for name in whole:
        np.testing.assert_array_equal(found[name], whole[name], err_msg=str(name))
    assert not list(Path(path).rglob("*.part*"))


CHILD = "import sys; sys.path[:0] = sys.argv[1:3]; import test_faults; test_faults.child(sys.argv[3:])"


def child(arguments):
    """The script with the stand-in, in a process that may be killed."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's children ignore it
    prepare()
    sys.exit(script.main(arguments))


def started(folder):
    paths = [str(SCRIPTS), str(Path(__file__).parent)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", CHILD, *paths, *ARGUMENTS], cwd=folder, **pipes)


def wait_for_tiles(folder, process, number):
    tiles = folder / "map.zarr" / "status" / "tiles"
    while len(list(tiles.glob("[0-9]*.json"))) < number:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)


SIGNALS = [(signal.SIGKILL, -9), (signal.SIGTERM, 143), (signal.SIGINT, 130)]


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
@pytest.mark.parametrize(("which", "code"), SIGNALS, ids=[which.name for which, _ in SIGNALS])
def test_a_stopped_process_loses_nothing(folder, which, code):
    process = started(folder)
    try:
        wait_for_tiles(folder, process, 2)
        process.send_signal(which)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == code
    done = study_records(folder)
    assert len(done) >= 2
    if which != signal.SIGKILL:
        kept = MOST * len(done)
        last = said.strip().splitlines()[-1]
        assert last == f"stopped; {kept} of 48 cells are in map.zarr; the same command goes on from there"
    assert script.main([*ARGUMENTS]) == 0
    assert study_records(folder).items() >= done.items()
    is_undisturbed("map.zarr")


def study_records(folder):
    """Completion records and when they were written."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "map.zarr/status/tiles").glob("[0-9]*.json")}


def test_a_second_process_is_refused_in_one_line(folder, capsys):
    process = started(folder)
    try:
        wait_for_tiles(folder, process, 1)
        assert script.main(ARGUMENTS) == 2
        assert capsys.readouterr().err == (
            "error: out must not be in use; got map.zarr, which another run is writing\n"
        )
        assert script.main([*ARGUMENTS, "--overwrite"]) == 2
        process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    is_undisturbed("map.zarr")


@pytest.fixture
def leaves(monkeypatch):
    """Exit codes that the script would have ended the process with."""
    codes = []
    monkeypatch.setattr(command.os, "_exit", codes.append)
    return codes


@pytest.mark.parametrize("at", ["chunk", "record"])
def test_a_full_disk_is_one_line_and_what_is_done_stays(folder, capsys, monkeypatch, leaves, at):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")

    def write_json(report, path):
        if path.name == "3.json":
            raise full
        store.write_json(report, path)

    def _files(path, dims, place):
        if place == {"d": 1, "kappa": 1}:  # of tile 3
            raise full
        return files(path, dims, place)

    files = study._files
    with monkeypatch.context() as disk:
        disk.setattr(*((study, "write_json", write_json) if at == "record" else (study, "_files", _files)))
        script.main(ARGUMENTS)
    assert leaves == [1]
    assert capsys.readouterr().err.splitlines()[-1] == (
        "error: No space left on device (somewhere); "
        "18 of 48 cells are in map.zarr; the same command goes on from there"
    )
    assert len(study_records(folder)) == 3
    assert script.main(ARGUMENTS) == 0
    is_undisturbed("map.zarr")


def test_a_store_that_became_read_only_is_named(folder, capsys, monkeypatch):
    sweep(**AXES, out="map.zarr")
    opened = Path.open

    def refuse(self, mode="r", *args, **options):
        if mode == "r+":
            raise PermissionError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        return opened(self, mode, *args, **options)

    with monkeypatch.context() as disk:
        disk.setattr(Path, "open", refuse)
        assert script.main(ARGUMENTS) == 2
    said = "error: out must be a store that can be written; got map.zarr (Read-only file system)\n"
    assert capsys.readouterr().err == said
    is_undisturbed("map.zarr")


def truncate(chunk):
    chunk.write_bytes(chunk.read_bytes()[:-3])


def flip(chunk):
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)


def exchange(chunk):
    """A sound chunk in the wrong place."""
    chunk.write_bytes((chunk.parent.parent / "0" / "0").read_bytes())


DAMAGES = {
    truncate: "P/c/2/1 is not what was written",
    flip: "P/c/2/1 is not what was written",
    exchange: "P/c/2/1 is not what was written",
    Path.unlink: "P/c/2/1 is missing",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=[damage.__name__ for damage in DAMAGES])
def test_a_damaged_chunk_is_run_again(folder, caplog, damage):
    sweep(**AXES, out="map.zarr")
    before = study_records(folder)
    damage(folder / "map.zarr" / "P" / "c" / "2" / "1")
    with caplog.at_level(logging.WARNING):
        found = sweep(**AXES, out="map.zarr")
    assert [record.getMessage() for record in caplog.records] == [f"tile 5 of map.zarr is run again: {DAMAGES[damage]}"]
    again = study_records(folder)
    assert [name for name in before if again[name] != before[name]] == ["5.json"]
    is_undisturbed("map.zarr")
    xr.testing.assert_identical(found.load(), load("map.zarr"))
