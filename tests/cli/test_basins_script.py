"""`scripts/basins.py`: its arguments give a store, a picture and a table; bad input leaves no file."""

import re

import numpy as np
import pytest

from scripts import basins as script
from vijax.maps import sweep

TINY = ["--d", "0.2", "--kappa", "3", "--periods", "200"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


BAD = [
    (["--merge-mirrors", "--gamma", "0.1"], "merge_mirrors must be left out unless gamma is 0"),
    (["--wall", "rigid", "--u0=-0.2:0.2:5"], "u0 must lie in the gap"),
    (["--u0", "0"], "plot must have two axes of more than one value; got v0 alone"),
    (["--starts", "10"], "single cell"),
    (["--starts", "10", "--d", "0.1,0.2"], "got d alone"),
    (["--starts", "0", "--d", "0.1,0.2", "--r", "0.3,0.5"], "starts must be a whole number of at least 1"),
    (["--starts", "9", "--v0=-1:1:3"], "v0 must be left out where starts are drawn"),
    (["--speed", "1"], "speed must come with starts; got 1.0 alone"),
    (["--seed", "1"], "seed must come with starts; got 1 alone"),
    (["--starts", "9", "--speed", "0", "--d", "0.1,0.2", "--r", "0.3,0.5"], "speed must be a positive finite number"),
    (["--out", "basins.nc"], "out must end in .zarr"),
    (["--plot", "basins.doc"], "plot must end in"),
    (["--set", "d=1"], "give --d=1"),
    (["--r", "2"], r"r must lie in \(0, 1\]; got 2"),
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


def test_the_default_starts_span_the_gap(folder, monkeypatch):
    plans = []

    def run(plan, progress):
        plans.append(plan)
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run", run)
    assert script.main([]) == 130
    (plan,) = plans
    assert plan.cells.sizes == {"u0": 256, "v0": 256}
    assert {name: float(plan.cells.quantities[name]) for name in ("d", "kappa", "r")} == {
        "d": 0.2,
        "kappa": 3,
        "r": 0.5,
    }
    np.testing.assert_allclose(plan.cells.axes["u0"].values[[0, -1]], [-0.1 + 0.1 / 256, 0.1 - 0.1 / 256])
    np.testing.assert_allclose(plan.cells.axes["v0"].values[[0, -1]], [-0.6, 0.6])


def test_a_map_of_starts_is_written_as_store_picture_and_table(folder, capsys):
    assert script.main([*TINY, "--v0=-0.6:0.6:24", "--merge-mirrors"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["basins.png", "basins.zarr"]
    dataset = sweep.load(folder / "basins.zarr")
    assert dict(dataset.sizes) == {"u0": 24, "v0": 24, "attractor": 3}
    output = capsys.readouterr().out
    assert "576 starts in" in output
    assert "mirror images as one" in output
    for label, starts in zip(dataset.label.values, dataset.starts.values, strict=True):
        assert re.search(rf"^{label} +{starts} ", output, re.MULTILINE), output


def test_a_map_of_parameters_counts_attractors(folder, capsys):
    arguments = ["--d", "0.19,0.2", "--kappa", "3,3.2", "--periods", "200", "--starts", "40", "--plot", "map.png"]
    assert script.main([*arguments, "--out", "map.zarr"]) == 0
    dataset = sweep.load(folder / "map.zarr")
    assert dict(dataset.sizes) == {"d": 2, "kappa": 2, "start": 40, "attractor": dataset.sizes["attractor"]}
    numbers, cells = np.unique(dataset.attractors, return_counts=True)
    tally = ", ".join(f"{number}: {count}" for number, count in zip(numbers, cells, strict=True))
    assert f"cells by number of attractors: {tally}\n" in capsys.readouterr().out
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")


def test_an_aperiodic_attractor_has_its_simulated_periods(folder, capsys):
    assert script.main(["--d", "0.3", "--kappa", "3", "--periods", "200", "--v0=-0.6:0.6:5", "--out", "a.zarr"]) == 0
    assert re.search(r"^aperiodic .* simulated (200|800|3200) periods$", capsys.readouterr().out, re.MULTILINE)
