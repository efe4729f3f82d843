"""`vijax response`: from its arguments to a store, a picture and a few lines, and one line after bad input."""

import numpy as np
import pytest
import xarray as xr

from vijax.cli.main import main

TINY = ["response", "--realisations", "4", "--periods", "12", "--transient", "4", "--noise", "0.05,8"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_store_a_picture_and_what_was_found(folder, capsys):
    assert main([*TINY, "--kappa", "3"]) == 0
    said = capsys.readouterr().out
    assert "excitation: harmonics 1.0 + noise of level 0.05 up to 8.0 times the frequency, seed 0" in said
    assert "of the time, left after" in said
    found = xr.open_zarr(folder / "response.zarr")
    assert found.sizes["realisation"] == 4
    assert float(found["time_share"].sum()) == pytest.approx(1)
    assert (folder / "response.png").stat().st_size > 10_000


def test_a_measured_record(folder, capsys):
    time = np.linspace(0, 60, 6001)
    np.savetxt("bench.txt", np.c_[time, np.cos(np.pi * time)])
    arguments = ["response", "--realisations", "2", "--periods", "8", "--transient", "2", "--record", "bench.txt"]
    assert main([*arguments, "--plot", "bench.png"]) == 0
    assert "excitation: record of 6001 samples every 0.01 s, once" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--kappa", "3,4"], "kappa must be one number here; got 2 of them"),
        (["--plot", "response.doc"], "plot must end in"),
        (["--noise", "0.05"], "it must be two numbers"),
        (["--realisations", "1"], "realisations must be a whole number of at least 2"),
        (["--seed", "-1"], "seed must be a whole number of at least 0"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, says):
    assert main([*TINY, *arguments]) == 2
    said = capsys.readouterr().err.splitlines()
    assert says in said[-1]
    assert not list(folder.iterdir())
