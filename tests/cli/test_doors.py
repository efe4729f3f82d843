"""Doors: a sample of the malformed calls and command lines that `benchmarks/doors.py` tries, and what runs may cost."""

import os
import sys
from contextlib import nullcontext
from functools import partial
from io import StringIO
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from benchmarks import doors, malformed
from scripts import grid as script
from tests.helpers import stand_in
from vijax.batch import simulate
from vijax.cli import arguments
from vijax.planes import estimate, sweep
from vijax.planes.axes import parse_axis
from vijax.runtime import checks

CALLS = list(islice(doors.TABLES["calls"](), 7, None, 23))
LINES = list(islice(doors.TABLES["lines"](), 5, None, 13))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


class BegunError(Exception):
    """What a run raises that was begun."""


def begin(*_):
    """Take the first word of progress, which comes before the first cell."""
    raise BegunError


@pytest.fixture
def begun(monkeypatch):
    """How many cells each run of the command was to have, none of which runs: they end where their bar begins."""
    totals = []

    def bar(*, total, **_):
        totals.append(total)
        raise BegunError

    bar.write = print
    monkeypatch.setattr("tqdm.tqdm", bar)
    return totals


@pytest.mark.parametrize("case", CALLS, ids=[case.text for case in CALLS])
def test_a_malformed_call_is_met_by_one_line_that_names_the_argument(folder, case):
    assert not doors.called(case)


@pytest.mark.parametrize("case", LINES, ids=[case.text.encode("unicode_escape").decode() for case in LINES])
def test_a_malformed_line_is_met_by_one_line_that_names_the_option(folder, case):
    assert not doors.told(case)
    assert not list(folder.iterdir())


def test_the_judges_see_what_is_unclear():
    def say(error):
        raise error

    for made, flaw in (
        (lambda: 3, "silent"),
        (partial(say, ValueError("periods must be 1")), ""),
        (partial(say, ValueError("it must be 1")), "periods not named"),
        (partial(say, ValueError("periods must\nbe 1")), "2 lines"),
        (partial(say, AttributeError("periods")), "AttributeError"),
        (partial(np.zeros, "periods"), "from"),
    ):
        assert doors.called(malformed.Case("", ("periods",), made)).startswith(flaw) or flaw == "from"


def test_both_tables_are_as_large_as_they_are_said_to_be():
    assert [sum(1 for _ in table()) for table in doors.TABLES.values()] >= [508, 1313]


# --- what may be traced ----------------------------------------------------------------------------------------------


def test_traced_values_still_pass_the_doors_that_are_differentiated():
    one = malformed.an_orbit()[0]

    def traced(x):
        pair = vijax.impact_pair(x, 40.0, 0.5)
        device = vijax.Harvester(s=x)
        flown = vijax.trajectory(pair, 0.1 * x, -x, 2)
        kept = vijax.steady(device, one, pair=pair)
        return flown.filled, kept.P, vijax.harvested_energy(device, x)

    assert [out.shape for out in jax.eval_shape(traced, 0.2)] == [(), (), ()]


# --- size ------------------------------------------------------------------------------------------------------------


def test_an_axis_from_a_file_without_an_end_is_refused_unread():
    with pytest.raises(ValueError, match="d must name a file that can be read; got '@/dev/zero'"):
        parse_axis("d", "@/dev/zero")


def test_what_does_not_fit_in_memory_names_its_arguments(monkeypatch):
    monkeypatch.setattr(checks, "memory", lambda: 1e6)
    plane = {"d": np.linspace(0.1, 0.3, 100), "kappa": np.linspace(3, 40, 100)}
    with pytest.raises(ValueError, match=r"d and kappa must be so few that 10,000 cells fit in memory, 0.001 GB"):
        vijax.sweep(**plane, progress=begin)
    with pytest.raises(ValueError, match="starts must be so few"):
        vijax.basin_fractions(d=0.2, kappa=3.0, starts=9999, progress=begin)


def test_a_store_may_be_larger_than_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(checks, "memory", lambda: 1e6)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    found = vijax.sweep(d=np.linspace(0.1, 0.3, 100), kappa=np.linspace(3, 40, 100), out=tmp_path / "map.zarr")
    assert found.nbytes > 1e6
    assert not (found.status == vijax.Status.NOT_RUN).any()


@pytest.fixture
def kept(tmp_path):
    """A folder of compiled programs in which no pace is known."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def planned(side, **axes):
    plane = {"d": np.linspace(0.1, 0.3, side), "kappa": np.linspace(3, 40, side)}
    return sweep.plan(plane | axes)


@pytest.fixture
def watched(monkeypatch):
    """What a run told that spent a hundred seconds on compiling and ten on nine thousand cells, and its watch."""
    clock = iter([0.0, 100.0, 103.0, 110.0])
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: next(clock))
    told = []
    watch = estimate.Watch(lambda *step: told.append(step))
    for done in (0, 1000, 5000, 10_000):
        watch(done, 10_000)
    return told, watch


def test_the_next_estimate_is_by_the_pace_of_the_last_run(kept, watched):
    told, watch = watched
    assert estimate.of(planned(1000)).seconds == pytest.approx(2e-7 * 400 * 10**6)
    watch.keep(planned(100))
    assert told[-1] == (10_000, 10_000)
    assert estimate.of(planned(1000)).seconds == pytest.approx(10 / 9000 * 10**6)
    inclined = planned(1000, gamma=0.1)  # whose pace nobody knows
    assert estimate.of(inclined).seconds == pytest.approx(5e-7 * 400 * 10**6)


def test_a_run_of_few_cells_leaves_no_pace(kept, monkeypatch):
    """It takes as long as its slowest cell: 25 cells of an inclined device made a map of 128 x 128 take four days."""
    clock = iter([0.0, 1.0, 20.0])
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: next(clock))
    watch = estimate.Watch(lambda *_: None)
    for done in (0, 13, 25):
        watch(done, 25)
    watch.keep(planned(5))
    assert not (kept / "paces.json").exists()


def test_a_run_is_not_lost_with_its_pace(kept, watched):
    (kept / "closed").touch()
    jax.config.update("jax_compilation_cache_dir", str(kept / "closed"))
    watched[1].keep(planned(100))
    assert (kept / "closed").is_file()


@pytest.mark.parametrize("spoil", [lambda path: path.write_text("{"), os.mkfifo])
def test_a_pace_that_cannot_be_read_is_none(kept, spoil):
    spoil(kept / "paces.json")
    assert estimate.of(planned(100)).seconds == pytest.approx(2e-7 * 400 * 10**4)


def test_a_long_run_asks_and_wants_yes(kept, folder, capsys, begun):
    plane = ["--d", "0.1:0.3:30000", "--kappa", "3:40:30000", "--out", "map.zarr"]
    assert script.main(plane) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: yes must be given beyond an hour or 10 GB; got 900,000,000 cells, up to 137 GB")
    assert said.count("\n") == 1
    assert not begun
    assert not list(folder.glob("*.zarr"))
    with pytest.raises(BegunError):
        script.main([*plane, "--yes"])
    assert begun == [900_000_000]


@pytest.mark.parametrize(("answer", "end"), [("y\n", pytest.raises(BegunError)), ("n\n", nullcontext())])
def test_a_terminal_is_asked(kept, folder, monkeypatch, begun, answer, end):
    terminal = StringIO(answer)
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stdin", terminal)
    with end:
        assert script.main(["--d", "0.1:0.3:30000", "--kappa", "3:40:30000", "--out", "map.zarr"]) == 130
    assert len(begun) == (answer == "y\n")


def test_a_long_run_in_python_is_told_in_the_log(kept, folder, monkeypatch, caplog):
    monkeypatch.setattr(simulate, "summarise", stand_in)
    plane = {"d": np.linspace(0.1, 0.3, 30_000), "kappa": np.linspace(3, 40, 30_000)}
    with pytest.raises(BegunError):
        vijax.sweep(**plane, out="map.zarr", progress=begin)
    assert "a long run begins: 900,000,000 cells" in caplog.text


# --- one meaning of a tolerance --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "value"), [("5%", 0.05), ("0.05", 0.05), ("12.5%", 0.125)])
def test_a_part_may_be_written_in_percent(text, value):
    assert arguments.part("tolerance", text) == value


@pytest.mark.parametrize("number", [3, np.int32(3), jnp.asarray(3), np.array(3)])
def test_whole_numbers_of_any_library_pass(number):
    assert checks.whole("periods", number, 1) == 3
