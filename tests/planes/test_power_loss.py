"""Stores after a power cut: a map that was saved and tiles that are done are there, and a study goes on.

`benchmarks/power_loss.py` tries every state of the model of a disk in `benchmarks/disk_model.py`.
"""

import re
from pathlib import Path

import jax
import pytest

from benchmarks import disk_model, power_loss
from tests.helpers import stand_in
from vijax.batch import simulate
from vijax.planes import store_folder
from vijax.runtime import files

STATES = {
    "a study": 8,
    "a study that mends damage": 4,
    "a study that replaces another": 4,
    "save that replaces a map": 4,
}


@pytest.fixture(autouse=True)
def engine(monkeypatch):
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", "6")
    monkeypatch.setattr("vijax.planes.dispatch.places", lambda: jax.devices()[:1])


@pytest.mark.parametrize("name", STATES)
def test_a_power_cut_breaks_no_promise(name):
    outcomes = power_loss.lose(power_loss.scenarios()[name], STATES[name], seed=0)
    assert [one.broken for one in outcomes if one.broken] == []


def test_a_power_cut_breaks_no_promise_where_the_disk_cannot_exchange_names(monkeypatch):
    monkeypatch.setattr(store_folder, "exchange", lambda one, other: False)
    outcomes = power_loss.lose(power_loss.scenarios()["save that replaces a map"], 5, seed=0)
    assert [one.broken for one in outcomes if one.broken] == []


@pytest.mark.parametrize("name", ["a study", "save"])
def test_without_flushing_promises_are_broken(monkeypatch, name):
    """The model notices what is not flushed."""
    monkeypatch.setattr(files, "_flush", lambda path: None)
    add = disk_model.Recording.add
    monkeypatch.setattr(
        disk_model.Recording, "add", lambda self, kind, *given: None if kind == "flush" else add(self, kind, *given)
    )
    outcomes = power_loss.lose(power_loss.scenarios()[name], 6, seed=0)
    assert any(one.broken for one in outcomes)


@pytest.mark.parametrize("name", STATES)
def test_all_that_changes_a_store_is_recorded(tmp_path, name):
    recording = power_loss.record(power_loss.scenarios()[name], tmp_path)
    there = {path.relative_to(tmp_path).as_posix(): path for path in tmp_path.rglob("*")}
    found = {path: file.read_bytes() if file.is_file() else None for path, file in there.items()}
    assert disk_model.last(recording) == found


def test_what_is_flushed_is_flushed_by_the_system(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr("os.fsync", lambda descriptor: flushed.append(Path(f"/proc/self/fd/{descriptor}").resolve()))
    files.replace_files({tmp_path / "a" / "b.json": b"b"}, {tmp_path / "c.json": b"c"}, within=tmp_path)
    names = [path.relative_to(tmp_path).as_posix() for path in flushed]
    assert sorted(re.sub("[0-9a-f]{16}", "", name) for name in names[:3]) == [".", ".c..part.json", "a/.b..part.json"]
    assert names[3:] == ["a", "."]
