"""`scripts/orbit_diagram.py`: its arguments give a store and a picture; bad input leaves no file."""

import numpy as np
import pytest

import vijax
from scripts import orbit_diagram as script

TINY = ["--along", "d=0.3:0.2:3", "--kappa", "40,400", "--periods", "120", "--recorded-periods", "2"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_store_a_picture_and_a_summary_are_written(folder, capsys):
    assert script.main([*TINY, "--direction", "both"]) == 0
    output = capsys.readouterr().out
    assert "12 points in" in output
    assert "points by status: ok 12" in output
    assert "points by label: 1:1 12" in output
    assert "wrote orbit_diagram.zarr, orbit_diagram.png" in output
    ds = vijax.load(folder / "orbit_diagram.zarr")
    assert dict(ds.P.sizes) == {"direction": 2, "kappa": 2, "d": 3}
    np.testing.assert_allclose(ds.d, [0.3, 0.25, 0.2])
    assert ds.attrs["periods"] == 120
    assert (folder / "orbit_diagram.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--along", "0.3:0.2:3"], "along must be AXIS=VALUES"),
        (["--along", "x=1:2:3"], "along must be AXIS=VALUES"),
        (["--along", "u0=0:0.1:3"], "along must be"),
        (["--along", "d=0.3"], "along must have several values"),
        (["--along", "d=0.3:0.2:3", "--d", "0.2"], "d must be specified once"),
        (["--kappa=-1"], "kappa must be positive"),
        (["--recorded-periods", "500"], "recorded_periods must be at most periods"),
        (["--direction", "left"], "direction must be"),
        (["--quantity", "speed"], "quantity must be among"),
        (["--kappa", "40,400", "--r", "0.3,0.5"], "at most one axis besides d"),
        (["--plot", "diagram.txt"], "plot must end in"),
        (["--out", "diagram.nc"], "out must end in .zarr"),
        (["--set", "d=1"], "set must name a constant"),
    ],
)
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, arguments, message):
    assert script.main(arguments) == 2
    output = capsys.readouterr().err
    assert output.startswith("error: ")
    assert message in output
    assert len(output.splitlines()) == 1
    assert not list(folder.iterdir())
