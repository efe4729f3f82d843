"""`scripts/curves.py`: files of the curves of a simulated or loaded map, and one line after bad input."""

import numpy as np
import pytest

import vijax
from scripts import curves as script
from scripts import grid
from vijax.continuation.from_map import map_curves
from vijax.plots.style import is_drawn

# A map of rigid walls with a pitchfork of the symmetric orbit, with as many cells as in `continuation/test_curves`.
PLANE = ["--wall", "rigid", "--d", "0.24:0.3:4", "--r", "0.4:0.6:4"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_map_is_simulated_and_its_curves_are_written_to_three_files(folder, capsys):
    assert script.main([*PLANE, "--max-rounds", "0"]) == 0
    output = capsys.readouterr().out
    dataset = vijax.load(folder / "curves.zarr")
    assert "pitchfork" in dataset["kind"].values
    assert f"of {dataset.attrs['borders']:,}" in output
    rows = (folder / "curves.csv").read_text().splitlines()
    assert len(rows) == 1 + int(np.isfinite(dataset["d"]).sum())
    assert is_drawn(folder / "curves.png")


def stopped(dataset, **budget):
    """Run a search that Ctrl-C ends after its first curves: it reports its progress after each batch of curves."""
    steps = []

    def stop(*step):
        steps.append(step)
        if len(steps) > 1:
            raise KeyboardInterrupt

    return SEARCH(dataset, progress=stop)


SEARCH = map_curves.bifurcation_curves


def test_ctrl_c_saves_partial_results_and_reports_them(folder, capsys, monkeypatch):
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
    ("arguments", "message"),
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
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, arguments, message):
    assert script.main(arguments) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("error: ")
    assert message in line
    assert not list(folder.iterdir())


def test_a_store_without_labels_is_rejected(folder, capsys):
    vijax.save(vijax.sweep(d=[0.2, 0.3], kappa=[3.0, 40.0], outputs=["P"], periods=40), "map.zarr")
    assert script.main(["--map", "map.zarr"]) == 2
    assert "--map: dataset must hold period" in capsys.readouterr().err
