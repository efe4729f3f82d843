"""Stores after a power cut: saved maps and completed tiles are present, and a study resumes.

`benchmarks/power_loss.py` tests every state of the disk model in `benchmarks/disk_model.py`.
"""

import re
from pathlib import Path

import jax
import pytest

from benchmarks import disk_model, power_loss
from tests.helpers import stand_in
from vijax.maps.storage import store_folder
from vijax.runtime import files
from vijax.simulation import simulate

STATES = {
    "a study": 8,
    "a study that repairs damage": 4,
    "a study that replaces another": 4,
    "save that replaces a map": 4,
}


@pytest.fixture(autouse=True)
def engine(monkeypatch):
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", "6")
    monkeypatch.setattr("vijax.maps.execution.dispatch.tile_devices", lambda: jax.devices()[:1])


@pytest.mark.parametrize("name", STATES)
def test_a_power_cut_breaks_no_guarantee(name):
    outcomes = power_loss.lose(power_loss.scenarios()[name], STATES[name], seed=0)
    assert [outcome.broken for outcome in outcomes if outcome.broken] == []


def test_power_cut_breaks_no_guarantee_on_a_disk_without_atomic_exchange(monkeypatch):
    monkeypatch.setattr(store_folder, "exchange", lambda outcome, other: False)
    outcomes = power_loss.lose(power_loss.scenarios()["save that replaces a map"], 5, seed=0)
    assert [outcome.broken for outcome in outcomes if outcome.broken] == []


@pytest.mark.parametrize("name", ["a study", "save"])
def test_without_flushing_guarantees_are_broken(monkeypatch, name):
    """The disk model detects writes that are not flushed."""
    monkeypatch.setattr(files, "_flush", lambda path: None)
    add = disk_model.Recording.add
    monkeypatch.setattr(
        disk_model.Recording,
        "add",
        lambda self, kind, *arguments: None if kind == "flush" else add(self, kind, *arguments),
    )
    outcomes = power_loss.lose(power_loss.scenarios()[name], 6, seed=0)
    assert any(outcome.broken for outcome in outcomes)


@pytest.mark.parametrize("name", STATES)
def test_all_changes_of_a_store_are_recorded(tmp_path, name):
    recording = power_loss.record(power_loss.scenarios()[name], tmp_path)
    paths = {path.relative_to(tmp_path).as_posix(): path for path in tmp_path.rglob("*")}
    contents = {path: file.read_bytes() if file.is_file() else None for path, file in paths.items()}
    assert disk_model.last(recording) == contents


def test_files_and_folders_are_flushed_with_fsync(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr("os.fsync", lambda descriptor: flushed.append(Path(f"/proc/self/fd/{descriptor}").resolve()))
    files.replace_files({tmp_path / "a" / "b.json": b"b"}, {tmp_path / "c.json": b"c"}, within=tmp_path)
    names = [path.relative_to(tmp_path).as_posix() for path in flushed]
    assert sorted(re.sub("[0-9a-f]{16}", "", name) for name in names[:3]) == [".", ".c..part.json", "a/.b..part.json"]
    assert names[3:] == ["a", "."]
