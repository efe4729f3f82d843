"""`vijax response`: its arguments give a store, a picture and a few lines; bad input gives one line."""

import numpy as np
import pytest
import xarray as xr

from vijax.cli.main import main

TINY = ["response", "--realisations", "4", "--periods", "12", "--transient", "4", "--noise", "0.05,8"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_store_a_picture_and_a_summary_are_written(folder, capsys):
    assert main([*TINY, "--kappa", "3"]) == 0
    output = capsys.readouterr().out
    assert "excitation: harmonics 1.0 + noise of level 0.05 up to 8.0 times the frequency, seed 0" in output
    assert "of the time, lost after" in output
    dataset = xr.open_zarr(folder / "response.zarr")
    assert dataset.sizes["realisation"] == 4
    assert float(dataset["time_share"].sum()) == pytest.approx(1)
    assert (folder / "response.png").stat().st_size > 10_000


def test_a_measured_record_is_simulated(folder, capsys):
    time = np.linspace(0, 60, 6001)
    np.savetxt("bench.txt", np.c_[time, np.cos(np.pi * time)])
    arguments = ["response", "--realisations", "2", "--periods", "8", "--transient", "2", "--record", "bench.txt"]
    assert main([*arguments, "--plot", "bench.png"]) == 0
    assert "excitation: record of 6001 samples every 0.01 s, once" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--kappa", "3,4"], "kappa must be one number here; got 2 of them"),
        (["--plot", "response.doc"], "plot must end in"),
        (["--noise", "0.05"], "it must be two numbers"),
        (["--realisations", "1"], "realisations must be a whole number of at least 2"),
        (["--seed", "-1"], "seed must be a whole number of at least 0"),
    ],
)
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, arguments, message):
    assert main([*TINY, *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert message in lines[-1]
    assert not list(folder.iterdir())
