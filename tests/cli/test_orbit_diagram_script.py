"""`scripts/orbit_diagram.py`: from its arguments to a store and a picture, and nothing at all after bad input."""

import numpy as np
import pytest

import vijax
from scripts import orbit_diagram as script

TINY = ["--along", "d=0.3:0.2:3", "--kappa", "40,400", "--periods", "120", "--recorded-periods", "2"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_store_a_picture_and_a_summary(folder, capsys):
    assert script.main([*TINY, "--direction", "both"]) == 0
    said = capsys.readouterr().out
    assert "12 points in" in said
    assert "points by status: ok 12" in said
    assert "points by label: 1:1 12" in said
    assert "wrote orbit_diagram.zarr, orbit_diagram.png" in said
    ds = vijax.load(folder / "orbit_diagram.zarr")
    assert dict(ds.P.sizes) == {"direction": 2, "kappa": 2, "d": 3}
    np.testing.assert_allclose(ds.d, [0.3, 0.25, 0.2])
    assert ds.attrs["periods"] == 120
    assert (folder / "orbit_diagram.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (["--along", "0.3:0.2:3"], "along must be AXIS=VALUES"),
        (["--along", "x=1:2:3"], "along must be AXIS=VALUES"),
        (["--along", "u0=0:0.1:3"], "along must be"),
        (["--along", "d=0.3"], "along must have several values"),
        (["--along", "d=0.3:0.2:3", "--d", "0.2"], "d must not be given twice"),
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
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, say):
    assert script.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert say in said
    assert len(said.splitlines()) == 1
    assert not list(folder.iterdir())
