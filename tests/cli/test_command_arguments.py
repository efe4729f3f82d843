"""A sample of the malformed calls and command lines of `benchmarks/malformed_inputs.py`, and the cost of runs."""

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
from benchmarks import malformed, malformed_inputs
from scripts import grid as script
from tests.helpers import stand_in
from vijax.cli import arguments
from vijax.maps import sweep
from vijax.maps.axes import parse_axis
from vijax.maps.execution import estimate
from vijax.runtime import validation
from vijax.simulation import simulate

CALLS = list(islice(malformed_inputs.TABLES["calls"](), 7, None, 23))
LINES = list(islice(malformed_inputs.TABLES["lines"](), 5, None, 13))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


class StartedError(Exception):
    """Raised where a run starts."""


def stop_at_start(*_):
    """End a run at its first progress message, before the first cell."""
    raise StartedError


@pytest.fixture
def planned_cells(monkeypatch):
    """The number of cells of each run of the command; a run ends where its progress bar starts."""
    totals = []

    def bar(*, total, **_):
        totals.append(total)
        raise StartedError

    bar.write = print
    monkeypatch.setattr("tqdm.tqdm", bar)
    return totals


@pytest.mark.parametrize("case", CALLS, ids=[case.text for case in CALLS])
def test_a_malformed_call_raises_a_single_line_that_names_the_argument(folder, case):
    assert not malformed_inputs.flaw_of_call(case)


@pytest.mark.parametrize("case", LINES, ids=[case.text.encode("unicode_escape").decode() for case in LINES])
def test_a_malformed_line_prints_a_single_line_that_names_the_option(folder, case):
    assert not malformed_inputs.flaw_of_line(case)
    assert not list(folder.iterdir())


def test_unclear_errors_are_flaws():
    def fail(error):
        raise error

    for made, flaw in (
        (lambda: 3, "silent"),
        (partial(fail, ValueError("periods must be 1")), ""),
        (partial(fail, ValueError("it must be 1")), "periods not named"),
        (partial(fail, ValueError("periods must\nbe 1")), "2 lines"),
        (partial(fail, AttributeError("periods")), "AttributeError"),
        (partial(np.zeros, "periods"), "from"),
    ):
        assert malformed_inputs.flaw_of_call(malformed.Case("", ("periods",), made)).startswith(flaw) or flaw == "from"


def test_both_tables_have_the_documented_size():
    assert [sum(1 for _ in table()) for table in malformed_inputs.TABLES.values()] >= [508, 1313]


# --- traced arguments ------------------------------------------------------------------------------------------------


def test_differentiable_functions_accept_traced_values():
    orbit = malformed.an_orbit()[0]

    def traced(x):
        pair = vijax.impact_pair(x, 40.0, 0.5)
        device = vijax.Harvester(s=x)
        motion = vijax.trajectory(pair, 0.1 * x, -x, 2)
        steady_state = vijax.steady(device, orbit, pair=pair)
        return motion.filled, steady_state.P, vijax.harvested_energy(device, x)

    assert [out.shape for out in jax.eval_shape(traced, 0.2)] == [(), (), ()]


# --- size ------------------------------------------------------------------------------------------------------------


def test_an_axis_from_an_endless_file_is_refused():
    with pytest.raises(ValueError, match="d must name a file that can be read; got '@/dev/zero'"):
        parse_axis("d", "@/dev/zero")


def test_a_map_that_exceeds_memory_names_its_arguments(monkeypatch):
    monkeypatch.setattr(validation, "memory", lambda: 1e6)
    plane = {"d": np.linspace(0.1, 0.3, 100), "kappa": np.linspace(3, 40, 100)}
    with pytest.raises(ValueError, match=r"d and kappa must be so few that 10,000 cells fit in memory, 0.001 GB"):
        vijax.sweep(**plane, progress=stop_at_start)
    with pytest.raises(ValueError, match="starts must be so few"):
        vijax.basin_fractions(d=0.2, kappa=3.0, starts=9999, progress=stop_at_start)


def test_a_store_may_be_larger_than_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(validation, "memory", lambda: 1e6)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    dataset = vijax.sweep(d=np.linspace(0.1, 0.3, 100), kappa=np.linspace(3, 40, 100), out=tmp_path / "map.zarr")
    assert dataset.nbytes > 1e6
    assert not (dataset.status == vijax.Status.NOT_RUN).any()


@pytest.fixture
def empty_cache(tmp_path):
    """A folder of compiled programs without recorded costs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def planned(side, **axes):
    plane = {"d": np.linspace(0.1, 0.3, side), "kappa": np.linspace(3, 40, side)}
    return sweep.plan(plane | axes)


@pytest.fixture
def cost_meter(monkeypatch):
    """Progress and cost meter of a run: a hundred seconds of compilation, then nine thousand cells in ten seconds."""
    clock = iter([0.0, 100.0, 103.0, 110.0])
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: next(clock))
    steps = []
    meter = estimate.CostMeter(lambda *step: steps.append(step))
    for done in (0, 1000, 5000, 10_000):
        meter(done, 10_000)
    return steps, meter


def test_the_next_estimate_uses_the_cost_of_the_last_run(empty_cache, cost_meter):
    steps, meter = cost_meter
    assert estimate.estimate_runs(planned(1000)).seconds == pytest.approx(2e-7 * 400 * 10**6)
    meter.store_cost(planned(100))
    assert steps[-1] == (10_000, 10_000)
    assert estimate.estimate_runs(planned(1000)).seconds == pytest.approx(10 / 9000 * 10**6)
    inclined = planned(1000, gamma=0.1)  # no cost is recorded for it
    assert estimate.estimate_runs(inclined).seconds == pytest.approx(5e-7 * 400 * 10**6)


def test_a_run_of_few_cells_records_no_cost(empty_cache, monkeypatch):
    """It takes as long as its slowest cell: by 25 inclined cells, a map of 128 x 128 would take four days."""
    clock = iter([0.0, 1.0, 20.0])
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: next(clock))
    meter = estimate.CostMeter(lambda *_: None)
    for done in (0, 13, 25):
        meter(done, 25)
    meter.store_cost(planned(5))
    assert not (empty_cache / "costs.json").exists()


def test_a_run_survives_a_cost_that_cannot_be_stored(empty_cache, cost_meter):
    (empty_cache / "closed").touch()
    jax.config.update("jax_compilation_cache_dir", str(empty_cache / "closed"))
    cost_meter[1].store_cost(planned(100))
    assert (empty_cache / "closed").is_file()


@pytest.mark.parametrize("spoil", [lambda path: path.write_text("{"), os.mkfifo])
def test_a_cost_that_cannot_be_read_is_ignored(empty_cache, spoil):
    spoil(empty_cache / "costs.json")
    assert estimate.estimate_runs(planned(100)).seconds == pytest.approx(2e-7 * 400 * 10**4)


def test_a_long_run_requires_the_option_yes(empty_cache, folder, capsys, planned_cells):
    plane = ["--d", "0.1:0.3:30000", "--kappa", "3:40:30000", "--out", "map.zarr"]
    assert script.main(plane) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: yes must be given beyond an hour or 10 GB; got 900,000,000 cells, up to 137 GB")
    assert error.count("\n") == 1
    assert not planned_cells
    assert not list(folder.glob("*.zarr"))
    with pytest.raises(StartedError):
        script.main([*plane, "--yes"])
    assert planned_cells == [900_000_000]


@pytest.mark.parametrize(("answer", "end"), [("y\n", pytest.raises(StartedError)), ("n\n", nullcontext())])
def test_a_terminal_requests_confirmation(empty_cache, folder, monkeypatch, planned_cells, answer, end):
    terminal = StringIO(answer)
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stdin", terminal)
    with end:
        assert script.main(["--d", "0.1:0.3:30000", "--kappa", "3:40:30000", "--out", "map.zarr"]) == 130
    assert len(planned_cells) == (answer == "y\n")


def test_a_long_run_in_python_is_logged(empty_cache, folder, monkeypatch, caplog):
    monkeypatch.setattr(simulate, "summarise", stand_in)
    plane = {"d": np.linspace(0.1, 0.3, 30_000), "kappa": np.linspace(3, 40, 30_000)}
    with pytest.raises(StartedError):
        vijax.sweep(**plane, out="map.zarr", progress=stop_at_start)
    assert "a long run starts: 900,000,000 cells" in caplog.text


# --- one meaning of a tolerance --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "value"), [("5%", 0.05), ("0.05", 0.05), ("12.5%", 0.125)])
def test_a_fraction_may_be_written_in_percent(text, value):
    assert arguments.parse_fraction("tolerance", text) == value


@pytest.mark.parametrize("number", [3, np.int32(3), jnp.asarray(3), np.array(3)])
def test_integers_of_any_library_pass(number):
    assert validation.validate_integer("periods", number, 1) == 3
