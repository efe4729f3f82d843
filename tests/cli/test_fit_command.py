"""`vijax fit`: a file of impacts gives a report, a picture and a few lines; bad input gives one line."""

import json

import numpy as np
import pytest

import vijax
from tests.fitting.bench import measured
from vijax.cli.main import main

DEVICE = vijax.Harvester(s=0.02, omega=10.0, A=3.0, r=0.6)
OPTIONS = ["--timing-error", "1e-4", "--s", "22mm", "--omega", "10", "--A", "3", "--wall", "rigid", "--unknown", "s,r"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    impacts = measured(DEVICE, 40, wall="rigid", error=1e-4)
    np.savetxt("impacts.csv", np.c_[impacts], delimiter=",", header="time,side,speed")
    return tmp_path


def test_a_report_and_a_picture_are_written(folder, capsys):
    assert main(["fit", "impacts.csv", *OPTIONS]) == 0
    output = capsys.readouterr().out
    assert "s = 0.02" in output
    assert "misfit:" in output
    report = json.loads((folder / "fit.json").read_text())
    assert report["values"]["r"] == pytest.approx(0.6, abs=0.005)
    assert report["converged"]
    assert report["units"] == {"s": "m", "r": ""}
    assert (folder / "fit.png").stat().st_size > 10_000


def test_speeds_are_read_from_the_third_column(folder, capsys):
    arguments = ["fit", "impacts.csv", *OPTIONS[:-1], "s,A,r", "--speed-error", "1e-3", "--out", "speeds.json"]
    assert main(arguments) == 0
    values = json.loads((folder / "speeds.json").read_text())["values"]
    assert values["A"] == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.csv", *OPTIONS], "IMPACTS must be a text file of two or three columns"),
        (["impacts.csv", *OPTIONS, "--timing-error", "-1"], "timing_error must be a positive finite number"),
        (["impacts.csv", *OPTIONS, "--unknown", "V"], "unknown must be among"),
        (["impacts.csv", *OPTIONS, "--out", "fit.zarr"], "out must end in .json"),
        (["impacts.csv", *OPTIONS, "--s", "0.01,0.02"], "s must be one number here; got 2 of them"),
        (["impacts.csv"], "Missing option '--timing-error'"),
    ],
)
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, arguments, message):
    assert main(["fit", *arguments]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert [path.name for path in folder.iterdir()] == ["impacts.csv"]
