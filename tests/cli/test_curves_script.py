"""`scripts/curves.py`: what it writes of a map, run or loaded, and one line after bad input."""

import numpy as np
import pytest

import vijax
from scripts import curves as script
from scripts import grid
from vijax.orbits import map_curves
from vijax.plots.style import is_drawn

# A corner of rigid walls in which the symmetric orbit breaks, with as many cells as `orbits/test_curves` has.
PLANE = ["--wall", "rigid", "--d", "0.24:0.3:4", "--r", "0.4:0.6:4"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_map_is_run_and_its_curves_are_written_three_ways(folder, capsys):
    assert script.main([*PLANE, "--max-rounds", "0"]) == 0
    said = capsys.readouterr().out
    found = vijax.load(folder / "curves.zarr")
    assert "pitchfork" in found["kind"].values
    assert f"of {found.attrs['borders']:,}" in said
    rows = (folder / "curves.csv").read_text().splitlines()
    assert len(rows) == 1 + int(np.isfinite(found["d"]).sum())
    assert is_drawn(folder / "curves.png")


def stopped(dataset, **budget):
    """Stand in for a search that Ctrl-C ends once it has curves: it tells its progress after each batch of them."""
    told = []

    def stop(*step):
        told.append(step)
        if len(told) > 1:
            raise KeyboardInterrupt

    return SEARCH(dataset, progress=stop)


SEARCH = map_curves.bifurcation_curves


def test_ctrl_c_keeps_what_was_found_and_says_so(folder, capsys, monkeypatch):
    assert grid.main([*PLANE, "--kappa", "400", "--out", "map.zarr"]) == 0
    monkeypatch.setattr(map_curves, "bifurcation_curves", stopped)
    assert script.main(["--map", "map.zarr", "--out", "curves.zarr"]) == 130
    out, err = capsys.readouterr()
    assert "the search was stopped" in out
    assert "found until then are kept" in err.splitlines()[-1]
    assert vijax.load(folder / "curves.zarr").attrs["ended"] == "stopped"


@pytest.mark.long
def test_a_map_may_be_drawn_with_its_curves(folder, capsys):
    assert grid.main([*PLANE, "--kappa", "400", "--show", "label", "--curves", "--plot", "labels.png"]) == 0
    assert "within a cell of a curve" in capsys.readouterr().out
    assert is_drawn(folder / "labels.png")


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (["--map", "nowhere.zarr"], "--map: path must name a zarr store"),
        (["--map", "nowhere.zarr", "--d", "0.2"], "d must be left out with map"),
        (["--map", "nowhere.zarr", "--wall", "rigid"], "wall must be left out with map"),
        (["--d", "0.2", "--kappa", "3:40:4"], "must have several values for curves; got kappa"),
        (
            ["--d", "0.2:0.3:4", "--kappa", "3", "--A", "1:2:3"],
            "that the motion depends on, and nothing else, must have several values",
        ),
        (
            ["--d", "0.2:0.3:4", "--kappa", "3:40:4", "--v0=-1:1:3"],
            "must have several values for curves; got d, kappa, v0",
        ),
        (["--wall", "rigid", "--d", "0.2:0.3:4", "--kappa", "3:40:4"], "must have several values for curves; got d"),
        (["--csv", "curves.txt"], "csv must end in .csv"),
        (["--ground", "mass"], "ground must be among label, P"),
        (["--max-seconds", "-1"], "max_seconds must be a positive number"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, say):
    assert script.main(arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("error: ")
    assert say in said
    assert not list(folder.iterdir())


def test_a_store_without_labels_is_told(folder, capsys):
    vijax.save(vijax.sweep(d=[0.2, 0.3], kappa=[3.0, 40.0], outputs=["P"], periods=40), "map.zarr")
    assert script.main(["--map", "map.zarr"]) == 2
    assert "--map: dataset must hold period" in capsys.readouterr().err
