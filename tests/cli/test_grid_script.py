"""`scripts/grid.py`: its arguments give a store and a picture; bad input leaves no file."""

import logging
import os
import re
import signal
import subprocess
import sys
import time

import click
import numpy as np
import pytest
import xarray as xr

import vijax
from scripts import grid as script
from tests.helpers import SCRIPTS, no_cell_runs
from vijax.cli import closing, progress
from vijax.cli.commands.sweep import _place
from vijax.cli.commands.sweep import sweep as sweep_page
from vijax.maps import map_dataset, outputs, sweep
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.records import Status
from vijax.plots import figure, kind_maps, number_maps
from vijax.plots.style import axis_label

TINY = ["--d", "0.2,0.3", "--kappa", "100:400:3:log", "--periods", "40"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# A background job of a shell ignores SIGINT, and so would its children.
INTERRUPTIBLE = (
    "import runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


def started(arguments, folder):
    command = [sys.executable, "-c", INTERRUPTIBLE, str(SCRIPTS / "grid.py"), *arguments]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **pipes)


BAD = [
    (["--r", "1.2"], r"r must lie in \(0, 1\]; got 1.2"),
    (["--d", "0"], "d must be positive"),
    (["--workers", "0"], "workers must be a whole number of at least 1; got 0"),
    (["--workers", "2", "--plot", "map.png"], "workers requires out"),
    (["--workers", "2", "--scheduler", "10.0.0.1:8786"], "workers must be left out with scheduler"),
    (["--workers", "2", "--compare", "rigid"], "workers must be left out with compare"),
    (["--workers", "2", "--out", "map.zarr", "--refine", "2"], "workers must be left out with refine"),
    (["--starts", "3", "--show", "label"], "show must be among P, power.*with several starts"),
    (["--starts", "3", "--refine", "2"], "refine must be left out where cells have several starts"),
    (["--starts", "3", "--outputs", "P", "--plot", "map.png"], "outputs must hold attractors, undecided, admissible"),
    (["--starts", "3", "--compare", "rigid"], "starts must not be chosen with compare"),
    (["--show", "best_share"], "show must be label, or among"),
    (["--scheduler", "somewhere"], "scheduler must be an address"),
    (["--kappa", "inf"], 'wall="rigid"'),
    (["--omega=-1"], "omega must be positive"),
    (["--d", "0.1:0.2:0"], "N in LO:HI:N"),
    (["--u0=-1:1:5:log"], "log axis"),
    (["--d", "0.1:0.2"], "d must be a number, a comma list"),
    (["--d", "@nowhere"], "can be read; got '@nowhere'"),
    (["--d", "0.1", "--s", "0.3"], "d and s give the same quantity"),
    (["--wall", "rigid", "--u0", "0.2", "--d", "0.1,0.2"], "u0 must lie in the gap"),
    (["--wall", "hard"], "wall must be"),
    (["--dtype", "float16"], "dtype must be"),
    (["--method", "euler"], "method must be"),
    (["--solver", "Tsit5"], "solver must be left out unless method is"),
    (["--method", "ode", "--solver", "Euler"], "solver must be among"),
    (["--method", "ode", "--rtol", "0"], "rtol must be a finite number"),
    (["--method", "ode", "--atol", "small"], "--atol"),
    (["--method", "rk4", "--steps", "4"], "steps must be a whole number of at least 8"),
    (["--method", "rk4", "--steps", "1.5"], "--steps"),
    (["--membrane", "hunt-crossley", "--chi", "0.5"], 'membrane must be linear for method="exact"'),
    (
        ["--method", "ode", "--membrane", "rubber"],
        "membrane must be one of linear, hunt-crossley, hyperelastic; got 'rubber'",
    ),
    (["--method", "ode", "--membrane", "hunt-crossley"], "chi must be given"),
    (["--method", "ode", "--chi", "0.5"], "chi must be left out"),
    (["--method", "ode", "--exponent", "2"], "exponent must be left out"),
    (["--method", "ode", "--membrane", "hyperelastic", "--radius", "0.1"], "prestretch must be given"),
    (["--method", "ode", "--membrane", "hyperelastic", "--prestretch", "2", "--radius", "3kg"], "radius must be in m"),
    (["--beta", "20"], "beta must have a unit beyond pi/2, as 20deg or 20rad; got '20'"),
    (["--beta", "0:20:3"], "beta must have a unit beyond pi/2"),
    (["--method", "ode", "--membrane", "hyperelastic", "--chi", "2"], "chi must be left out unless --membrane is hunt"),
    (["--method", "ode", "--stretch-limit", "20"], "stretch_limit must be left out unless --membrane is hyper"),
    (["--method", "ode", "--membrane", "hunt-crossley", "--chi=-1"], "chi must be one finite number"),
    (["--method", "ode", "--membrane", "hunt-crossley", "--chi", "0.5", "--r", "0.5"], "r must be left out"),
    (["--until", "never"], "until must be"),
    (["--periods", "0"], "periods must be"),
    (["--periods", "many"], "--periods"),
    (["--outputs", "Q"], "outputs must be among"),
    (["--outputs", "P"], "outputs must hold period, admissible"),
    (["--set", "weight=1"], "weight must be a constant of the device"),
    (["--set", "r=0.3"], "give --r=0.3"),
    (["--set", "V"], "NAME=VALUE"),
    (["--set", "m_b=-1"], "m_b must be positive"),
    (["--out", "nowhere/map.zarr"], "out must lie in a folder that exists"),
    (["--out", "/dev/null/map.zarr"], "exists; got /dev/null/map.zarr; /dev/null is no folder, take another place"),
    (["--out", "map.nc"], "out must end in .zarr"),
    (["--plot", "map.doc"], "plot must end in"),
    (["--omega", "3:12:50"], "at most 36 panels; got 50 values of omega"),
    (["--d", "0.1", "--kappa", "30", "--plot", "map.png"], "single cell"),
    (["--tolerance", "0.05"], "tolerance must come with compare; got 0.05 alone"),
    (["--compare", "rigid", "--tolerance", "0"], "tolerance must be a positive number"),
    (["--compare", "rigid", "--tolerance=-0.1"], "tolerance must be a positive number"),
    (["--compare", "rigid", "--tolerance", "nan"], "tolerance must be a positive number"),
    (["--compare", "rigid", "--tolerance", "5 percent"], "tolerance must be a fraction such as 5% or 0.05"),
    (["--compare", "rigid", "--tolerance=-5%"], "tolerance must be a positive number"),
    (["--compare", "rigid", "--tolerance", "5"], "tolerance must be a fraction such as 5% or 0.05; got '5'; write 5%"),
    (["--compare", "soft"], "compare must be"),
    (["--compare", "rigid", "--wall", "rigid"], "wall must not be chosen with compare"),
    (["--compare", "rigid", "--outputs", "P"], "outputs must not be chosen with compare"),
    (["--compare", "rigid", "--u0", "0.2", "--d", "0.1,0.2"], "u0 must lie in the gap"),
    (["--compare", "rigid", "--d", "0.1", "--kappa", "30", "--plot", "map.png"], "single cell"),
    (["--compare", "rigid", "--plot", "map.doc"], "plot must end in"),
    (["--refine", "0"], "refine must be a whole number of at least 1; got 0"),
    (["--refine", "9"], "refine must leave 4 steps .* at most 4 levels for 128 values; got 9"),
    (["--refine", "2", "--until", "window"], "refine must be left out with until='window'"),
    (["--refine", "some"], "--refine"),
    (["--refine", "2", "--compare", "rigid"], "refine must not be chosen with compare"),
    (["--show", "phase"], "show must be label, or among P, power, .*; got 'phase'"),
    (["--show", "label", "--until", "window"], "must not be label unless .* got until window"),
    (["--show", "label", "--compare", "rigid"], "show must be left out with compare, .* got label"),
    (["--show", "label", "--outputs", "period"], "outputs must hold impacts_left, impacts_right"),
    (["--show", "power", "--compare", "rigid"], "show must be left out with compare"),
    (["--show", "power", "--outputs", "P"], "outputs must hold power for a picture"),
    (["--show", "status", "--kappa", "3"], "two axes of more than one value; got d alone"),
    (["--show", "max_penetration", "--d", "0.1", "--kappa", "3", "--plot", "map.png"], "single cell"),
    (["--show", "label", "--kappa", "3"], "two axes of more than one value; got d alone"),
    (["--gravity", "1"], "No such option"),
    (["more"], "unexpected extra argument"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, monkeypatch, arguments, message):
    monkeypatch.setattr(sweep, "run", None)  # nothing may run
    assert script.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert re.search(message, err)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(("option", "name"), [("--out", "map.zarr"), ("--plot", "map.png")])
def test_existing_files_are_detected_before_the_run(folder, capsys, monkeypatch, option, name):
    monkeypatch.setattr(sweep, "run", None)
    (folder / name).write_text("precious")
    assert script.main([option, name]) == 2
    assert "must not exist yet" in capsys.readouterr().err
    assert (folder / name).read_text() == "precious"


@pytest.fixture
def planned(monkeypatch, folder):
    """Return a function that runs the script and returns the plan that it passes to `run`."""
    plans = []

    def run(plan, *args):
        plans.append(plan)
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run", run)

    def plan(*arguments):
        assert script.main(list(arguments)) == 130
        return plans.pop()

    return plan


def test_default_plane(planned):
    plan = planned()
    assert plan.cells.sizes == {"d": 128, "kappa": 128}
    d, kappa = plan.cells.axes["d"].values, plan.cells.axes["kappa"].values
    np.testing.assert_allclose(d, np.linspace(0.05, 0.3, 128))
    np.testing.assert_allclose(kappa, np.geomspace(3, 400, 128))
    quantities = {name: float(plan.cells.quantities[name]) for name in ("r", "gamma", "omega")}
    assert quantities == {"r": 0.5, "gamma": 0.0, "omega": np.pi}
    assert plan.settings.periods == 400
    assert "lyapunov" not in plan.outputs


@pytest.mark.parametrize(
    ("arguments", "sizes"),
    [
        (["--kappa", "3,4", "--d", "0.1:0.2:3"], {"kappa": 2, "d": 3}),
        (["--gamma", "0,0.1"], {"d": 128, "kappa": 128, "gamma": 2}),
        (["--omega0", "20:400:5", "--omega", "pi:6pi:4"], {"omega0": 5, "omega": 4}),
        (["--s", "0.1:0.3:5", "--d", "0.1"], None),
        (["--d", "0.2", "--u0=-0.1:0.1:9", "--v0", "-1:1:3"], {"kappa": 128, "u0": 9, "v0": 3}),
        (["--k", "300,560", "--d", "0.1,0.2", "--beta=-0.1,0.1"], {"k": 2, "d": 2, "beta": 2}),
    ],
)
def test_axes_in_the_specified_order(planned, arguments, sizes):
    if sizes is None:
        assert script.main(arguments) == 2
    else:
        assert planned(*arguments).cells.sizes == sizes


def test_settings_and_constants_are_passed_on(planned):
    settings = ["--until", "window", "--transient", "5", "--periods", "7", "--wall", "rigid"]
    plan = planned(*settings, "--set", "V=1000", "--set", "m_b=0.01")
    assert plan.settings == SweepSettings(until="window", transient=5, periods=7, wall="rigid")
    assert (plan.device.V, plan.device.m_b) == (1000.0, 0.01)


def test_unequal_walls_are_passed_on(planned):
    """A value for one wall replaces the default of both walls."""
    plan = planned("--kappa_left", "20:40:3", "--r_right", "0.6", "--set", "V_left=1500")
    assert list(plan.cells.sizes) == ["d", "kappa_left"]
    assert plan.cells.has_unequal_walls
    assert float(plan.cells.quantities["r_right"]) == 0.6
    assert (float(plan.device.V.left), float(plan.device.V.right)) == (1500.0, 2000.0)
    assert planned("--wall", "rigid_left").settings.wall == "rigid_left"
    assert planned("--set", "w0_left=0.2mm").device.w0.left == pytest.approx(2e-4, rel=1e-12)


def test_methods_and_membranes_are_passed_on(planned):
    plan = planned("--method", "ode", "--solver", "Dopri8", "--rtol", "1e-9", "--atol", "1e-11")
    assert (plan.method.solver, plan.method.rtol, plan.method.atol) == ("Dopri8", 1e-9, 1e-11)
    plan = planned("--method", "ode", "--membrane", "hunt-crossley", "--chi", "0.5", "--exponent", "1.4")
    assert (plan.method.law.chi, plan.method.law.exponent) == (0.5, 1.4)
    rubber = ("--membrane", "hyperelastic", "--prestretch", "1.4", "--radius", "0.1")
    assert planned("--method", "ode", *rubber).method.law == vijax.Hyperelastic(1.4, 0.1)
    assert planned("--method", "ode", *rubber[:-1], "20mm").method.law == vijax.Hyperelastic(1.4, 0.02)
    assert planned("--method", "ode", *rubber[:-2]).method.law == vijax.Hyperelastic(1.4, 0.0063)  # R0 of the device
    law = planned("--method", "rk4", *rubber, "--stretch-limit", "20").method.law
    assert (law.prestretch, law.radius, law.stretch_limit) == (1.4, 0.1, 20.0)
    plan = planned("--method", "rk4", "--steps", "500", "--membrane", "linear")
    assert plan.method.steps == 500
    assert planned().method is None


def test_a_map_of_labels_requests_exponents(folder, monkeypatch):
    plans, drawn = [], []
    ok = xr.Variable("d", [0, 0], {"flag_values": [0], "flag_meanings": "ok"})
    monkeypatch.setattr(
        sweep, "run", lambda plan, *args: plans.append(plan) or args[0](0, 1) or xr.Dataset({"status": ok})
    )
    monkeypatch.setattr(kind_maps, "label_map", lambda dataset: "labels")
    monkeypatch.setattr(figure, "save", lambda made, path: drawn.append((made, path.name)))
    assert script.main(["--show", "label", "--plot", "labels.png"]) == 0
    assert {"lyapunov", "P", "period"} < set(plans[0].outputs)
    assert "asymmetry" not in plans[0].outputs
    assert drawn == [("labels", "labels.png")]


def test_a_refined_map_reports_its_computed_cells(folder, monkeypatch, capsys):
    plans = []
    ok = xr.Variable("d", [0, 0], {"flag_values": [0], "flag_meanings": "ok"})
    dataset = xr.Dataset(
        {"status": ok, "computed": ("d", [True, False])}, attrs={"refine_computed": 1, "refine_shown": 2}
    )

    def run(plan, report, *_):
        plans.append(plan)
        report(0, 1)
        report(1, 1)
        return dataset

    monkeypatch.setattr(sweep, "run", run)
    monkeypatch.setattr(number_maps, "power_map", lambda dataset: None)
    monkeypatch.setattr(figure, "save", lambda made, path: None)
    assert script.main(["--refine", "3", "--plot", "map.png"]) == 0
    assert plans[0].refine == 3
    out = capsys.readouterr().out
    assert out.startswith("1 cell in")
    assert "cells computed: 1 of 2 shown, 50.0%; the others filled" in out


def test_a_summary_counts_inadmissible_cells_by_limit():
    codes = xr.Variable("d", np.array([0, 1, 1, 2, 3, -1], np.int8))
    (line,) = closing.limit_lines(xr.Dataset({"violated_limits": codes}))
    counted = "energy ratio limit 2, penetration limit 1, both limits 1"
    assert line == f"inadmissible cells: 5 of 6 (unknown 1, {counted}); see docs: model"
    (line,) = closing.limit_lines(xr.Dataset({"violated_limits": codes[:1]}))
    assert line == "inadmissible cells: 0 of 1"
    assert not closing.limit_lines(xr.Dataset())


@pytest.mark.long
def test_a_wide_gap_with_a_single_start_advises_more_starts():
    d = xr.DataArray([0.2, 0.21], dims="d")
    level, inclined = (xr.Dataset(coords={"d": d, "gamma": gamma}) for gamma in (0.0, 0.1))
    (line,) = closing.wide_gap_lines(level, "vijax sweep ")
    assert line.startswith("d > 2/pi^2 at gamma = 0 in 50.0% of the cells")
    assert line.endswith("try vijax sweep --starts 64")
    assert "everywhere" in closing.wide_gap_lines(level.isel(d=[1]))[0]
    assert not closing.wide_gap_lines(level.isel(d=[0]))
    assert not closing.wide_gap_lines(inclined)
    assert not closing.wide_gap_lines(level.assign_attrs(starts=64))
    assert not closing.wide_gap_lines(level.expand_dims(v0=[0.1, 0.2]))


def test_axes_are_in_hertz_where_they_were_specified_in_hertz(folder, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(number_maps, "power_map", drawn.append)
    monkeypatch.setattr(figure, "save", lambda made, path: None)
    with no_cell_runs():
        for omega, store in (("1Hz:2Hz:3", "hertz.zarr"), ("7:12:3", "angular.zarr")):
            names = ["--out", store, "--plot", "map.png"]
            assert script.main(["--omega", omega, "--s", "0.2", "--omega0", "20,400", *names]) == 0
    hertz, angular = drawn
    np.testing.assert_allclose(hertz["omega"], [1, 1.5, 2], rtol=1e-14)
    assert axis_label(hertz["omega"]) == r"$\omega / 2 \pi$ [Hz]"
    np.testing.assert_allclose(angular["omega"], [7, 9.5, 12], rtol=1e-14)
    assert axis_label(angular["omega"]) == r"$\omega$ [rad s$^{-1}$]"
    np.testing.assert_allclose(
        sweep.load(folder / "hertz.zarr")["omega"], 2 * np.pi * np.array([1, 1.5, 2]), rtol=1e-14
    )


def test_the_best_cell_is_in_hertz_where_it_was_specified_in_hertz():
    cell = xr.DataArray(2e-5, {"omega": ((), 4 * np.pi, {"units": "rad s-1"}), "d": 0.2})
    dataset = cell.expand_dims("omega").to_dataset(name="P")
    texts = {}
    for omega in ("1Hz:2Hz:3", "7:12:3"):
        with click.Context(sweep_page, info_name="sweep") as context:
            context.params = {"omega": omega}
            texts[omega] = _place(dataset["P"][0], dataset)
    assert texts["1Hz:2Hz:3"] == "2e-05 J per half period, 8e-05 W at omega = 2 Hz"
    assert texts["7:12:3"].endswith("at omega = 12.5664 rad s-1")


@pytest.mark.long
def test_several_starts_from_arguments_to_store_and_picture(folder, capsys):
    names = ["--out", "expected.zarr", "--plot", "expected.png"]
    assert script.main([*TINY, "--starts", "5", *names]) == 0
    assert "cells by attractors found: 1 " in capsys.readouterr().out
    dataset = sweep.load(folder / "expected.zarr")
    assert dataset.attrs["starts"] == 5
    assert "best_share" in dataset
    assert (folder / "expected.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("admissible", "message"), [(True, "admissible\n"), (False, "inadmissible; see docs: model\n")]
)
def test_a_single_cell_has_no_picture_and_its_energy_is_printed(folder, capsys, monkeypatch, admissible, message):
    ok = ("d", [0], {"flag_values": [0], "flag_meanings": "ok"})
    dataset = xr.Dataset({"status": ok, "P": ("d", [2e-5]), "admissible": ("d", [admissible])}, {"omega": np.pi})

    def run(plan, report, *_):
        report(0, 1)
        report(1, 1)
        return dataset

    monkeypatch.setattr(sweep, "run", run)
    assert script.main(["--d", "0.1", "--kappa", "50"]) == 0
    out = capsys.readouterr().out
    assert f"P: 2e-05 J per half period, 2e-05 W, {message}" in out
    assert "wrote power_map.zarr\n" in out


def test_the_progress_bar_follows_a_total_that_grows(capsys):
    with progress.progress(8) as show:
        for done, total in ((0, 2), (2, 2), (2, 5), (5, 5)):
            show(done, total)
    assert "5/5" in capsys.readouterr().err


def test_from_arguments_to_store_and_picture(folder, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")  # programs are stored in the default folder
    process = started([*TINY, "--out", "map.zarr", "--plot", "map.png"], folder)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    dataset = sweep.load(folder / "map.zarr")
    assert dict(dataset.sizes) == {"d": 2, "kappa": 3}
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")
    assert "6/6" in err.replace(".00", "")  # the progress bar has reached its end
    peak = map_dataset.best(dataset)
    for part in (
        "6 cells in",
        "cells/s",
        "by status: ok 6",
        "by period: period 1 ",
        f"inadmissible cells: {int((~dataset['admissible']).sum())} of 6",
        f"{float(peak):.6g} J per half period, {float(peak):.6g} W at",
        "d > 2/pi^2 at gamma = 0 in 50.0% of the cells: the motion depends on the start, and this map has one start; "
        "try --starts 64",
    ):
        assert part in out, part
    assert sorted(path.name for path in folder.iterdir()) == ["cache", "map.png", "map.zarr"]
    assert any((folder / "cache").rglob("*jit*"))  # the next run need not compile


@pytest.mark.skipif(sys.platform == "win32", reason="SIGINT reaches no single process there")
def test_ctrl_c_retains_the_finished_cells(folder):
    process = started(["--d", "0.05:0.3:512", "--kappa", "3:400:512:log", "--out", "map.zarr"], folder)
    try:
        while not (folder / "map.zarr").exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        time.sleep(1)  # until it simulates tiles
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert err.endswith("stopped; 0 of 262,144 cells are in map.zarr; the same command continues from there\n")
    assert {path.name for path in folder.iterdir()} <= {"cache", "map.zarr"}
    assert (sweep.load(folder / "map.zarr")["status"] == Status.NOT_RUN).all()


@pytest.mark.long
def test_the_bar_shows_the_current_stage(folder, capsys):
    assert script.main([*TINY, "--out", "map.zarr"]) == 0
    err = capsys.readouterr().err
    assert err.index("starting") < err.index("compiling") < err.index("running 6 cells side by side") < err.index("6/6")
    assert not logging.getLogger("vijax.waiting").handlers


@pytest.mark.parametrize(
    ("count", "seconds", "text"),
    [(12, 35.0, "0.343 cells/s"), (3, 1.0, "3 cells/s"), (26395, 1.0, "26,395 cells/s"), (0, 1.0, "0 cells/s")],
)
def test_a_slow_rate_has_decimals(count, seconds, text):
    assert closing.rate_text(count, seconds).endswith(f" {text}")


def test_advice_is_printed_with_a_status():
    status = outputs.flagged(xr.Variable("d", [0, 4, 4, 2]), Status)
    lines = closing.statuses(xr.DataArray(status)).split("\n")
    assert lines[0] == "cells by status: ok 1, permanent_contact 1, slow 2"
    assert lines[1] == f"    permanent_contact: {Status(2).advice}"
    assert lines[2:] == [f"    slow: {Status(4).advice}; see docs: status"]


@pytest.mark.long
def test_any_variable_can_be_plotted(folder):
    assert script.main([*TINY, "--show", "max_penetration", "--outputs", "P,max_penetration"]) == 0
    assert {path.name for path in folder.iterdir()} == {"max_penetration_map.zarr", "max_penetration_map.png"}
