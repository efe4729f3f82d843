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

import jax
import numpy as np
import pytest
import xarray as xr

from scripts import grid as script
from tests.helpers import cases, stand_in
from vijax import plots
from vijax.batch import simulate
from vijax.cli.process import leave
from vijax.planes import dispatch, tiled_store
from vijax.planes import sweep as sweeps
from vijax.planes.sweep import load, sweep
from vijax.plots.style import is_drawn
from vijax.runtime import files

AXES = {"d": np.linspace(0.1, 0.3, 8), "kappa": np.geomspace(3, 400, 6)}
ARGUMENTS = ["--d", "0.1:0.3:8", "--kappa", "3:400:6:log", "--out", "map.zarr"]
MOST = 6


def slow_engine(*args, **settings):
    time.sleep(0.05)
    return stand_in(*args, **settings)


def prepare():
    """The stand-in, in this process."""
    simulate.summarise, dispatch.places = slow_engine, lambda: jax.devices()[:1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", str(MOST))
    monkeypatch.setattr(dispatch, "places", lambda: jax.devices()[:1])
    return tmp_path


def is_undisturbed(path):
    """Whether a store holds what one does that nothing befell."""
    found, whole = load(path), sweep(**AXES)
    for name in whole:
        np.testing.assert_array_equal(found[name], whole[name], err_msg=str(name))
    assert not list(Path(path).rglob("*.part*"))


CHILD = "import sys; from tests.benchmarks import test_faults; test_faults.child(sys.argv[1:])"


def child(arguments):
    """The script with the stand-in, in a process that may be killed."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's children ignore it
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
            "error: out must not be in use; got map.zarr, which another run is writing; see docs: studies\n"
        )
        assert script.main([*ARGUMENTS, "--overwrite"]) == 2
        process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    is_undisturbed("map.zarr")


@pytest.mark.parametrize("at", ["chunk", "record"])
def test_a_full_disk_is_one_line_and_what_is_done_stays(folder, capsys, monkeypatch, at):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")

    def write_json(report, path):
        if path.name == "3.json":
            raise full
        files.write_json(report, path)

    def _files(dims, place):
        if place == {"d": 1, "kappa": 1}:  # of tile 3
            raise full
        return chunks(dims, place)

    chunks = tiled_store._files
    with monkeypatch.context() as disk:
        disk.setattr(*((tiled_store, "write_json", write_json) if at == "record" else (tiled_store, "_files", _files)))
        assert script.main(ARGUMENTS) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        "error: No space left on device (somewhere); "
        "18 of 48 cells are in map.zarr; the same command goes on from there"
    )
    assert len(study_records(folder)) == 3
    assert script.main(ARGUMENTS) == 0
    is_undisturbed("map.zarr")


def test_a_store_that_became_read_only_is_named(folder, capsys, monkeypatch):
    sweep(**AXES, out="map.zarr")
    opened = os.open

    def refuse(path, flags, *args, **options):
        if "map.zarr" in os.fspath(path) and flags & (os.O_WRONLY | os.O_RDWR):
            raise PermissionError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return opened(path, flags, *args, **options)

    with monkeypatch.context() as disk:
        disk.setattr(os, "open", refuse)
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


def pipe(chunk):
    """What takes for ever to read."""
    chunk.unlink()
    os.mkfifo(chunk)


def device(chunk):
    """What never ends."""
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
def test_a_damaged_chunk_is_run_again(folder, caplog, damage):
    sweep(**AXES, out="map.zarr")
    before = study_records(folder)
    damage(folder / "map.zarr" / "P" / "c" / "2" / "1")
    with pytest.raises(ValueError, match=f"where {DAMAGES[damage]}; run again, the call that made it mends it"):
        load("map.zarr")
    with caplog.at_level(logging.WARNING):
        found = sweep(**AXES, out="map.zarr")
    assert [record.getMessage() for record in caplog.records] == [f"tile 5 of map.zarr is run again: {DAMAGES[damage]}"]
    again = study_records(folder)
    assert [name for name in before if again[name] != before[name]] == ["5.json"]
    is_undisturbed("map.zarr")
    xr.testing.assert_identical(found.load(), load("map.zarr"))


# --- what is not the run's own ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", cases(["map.png", "map.pdf", "map.svg", "map.eps"], long=("map.pdf", "map.eps")))
def test_a_picture_is_drawn_again_unless_it_is_somebody_elses(folder, capsys, name):
    assert script.main([*ARGUMENTS, "--plot", name]) == 0
    drawn = (folder / name).read_bytes()
    assert script.main([*ARGUMENTS, "--plot", name]) == 0
    for foreign in (drawn.replace(b"vijax", b"dream"), b"precious"):
        (folder / name).write_bytes(foreign)
        capsys.readouterr()
        assert script.main([*ARGUMENTS, "--plot", name]) == 2
        said = f"error: plot must be new or a picture drawn by vijax; got {name}; take another name\n"
        assert capsys.readouterr().err == said
        assert (folder / name).read_bytes() == foreign
    assert script.main([*ARGUMENTS, "--plot", name, "--overwrite"]) == 0
    assert is_drawn(folder / name)


@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_a_folder_of_somebody_else_is_not_overwritten(folder, capsys, option):
    name = "map.zarr" if option == "--out" else "map.png"
    (folder / name).mkdir()
    for file in ("zarr.json", "thesis.tex"):
        (folder / name / file).write_text("{}")
    assert script.main([option, name, "--overwrite"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {option[2:]} must not replace")
    assert said.count("\n") == 1
    assert (folder / name / "thesis.tex").exists()


def test_a_picture_never_replaces_a_folder(folder):
    sweeps.save(sweep(**AXES), "map.zarr")
    (folder / "map.png").mkdir()
    (folder / "map.png" / "thesis.tex").write_text("precious")
    with pytest.raises(IsADirectoryError):
        plots.save(plots.power_map(load("map.zarr")), "map.png")
    assert [path.name for path in (folder / "map.png").iterdir()] == ["thesis.tex"]


def test_what_a_killed_run_left_beside_a_picture_is_cleared_away(folder, capsys, caplog):
    left = folder / ".map.0123456789abcdef.part.png"
    left.write_text("half")
    assert script.main([*ARGUMENTS, "--plot", "map.png"]) == 0
    assert [said.getMessage() for said in caplog.records] == [f"{left.name}, which a killed run had left, is removed"]
    assert {path.name for path in folder.iterdir()} == {"map.zarr", "map.png"}


@pytest.mark.parametrize("coding", ["latin-1", "ascii", "utf-8"])
def test_a_terminal_that_cannot_show_a_name_ends_no_run(folder, monkeypatch, coding):
    name = "\u03ba\udcff.zarr"  # a Greek letter, and a byte that is no letter
    with open("told.txt", "w", encoding=coding) as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert script.main([*ARGUMENTS[:-1], name]) == 0
    assert b".zarr\n" in (folder / "told.txt").read_bytes()
    is_undisturbed(name)
