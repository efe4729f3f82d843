"""`scripts/design.py`: from its arguments to a report, a picture and words, and nothing at all after bad input."""

import json

import command
import design as script
import numpy as np
import pytest

from vijax.store import write_json

FEW = ["--balls", "1"]
SMALL = ["--d", "0.2", "--r", "0.5", "--A", "3", "--omega", "10pi", "--set", "V=1700", *FEW]
# Of the reference.
KAPPA, ENERGY, DEPTH = 4.00713, 57.75761e-6, 6.026e-3

BAD = [
    (["--tune", "mass"], "tune must be among"),
    (["--tune", "d,s"], "tune must name a quantity once"),
    (["--bounds", "omega0=20"], "bounds must be NAME=LO:HI"),
    (["--bounds", "mass=1:2"], "bounds must be NAME=LO:HI"),
    (["--bounds", "r=0.2:0.4"], "bounds must be those of a tuned quantity"),
    (["--bounds", "omega0=40:20"], "bounds of omega0 must be two, the lower first"),
    (["--bounds", "omega0=-1:20"], "omega0 must be positive"),
    (["--tolerance", "omega0"], "tolerance must be NAME=5%"),
    (["--tolerance", "omega0=5%:normal"], "tolerances must be uniform or lognormal"),
    (["--tolerance", "beta=5%"], "tolerances must be those of"),
    (["--tolerance", "omega0=5%,omega0=2%"], "tolerances must name a constant once"),
    (["--objective", "most"], "objective must be among"),
    (["--objective", "worst"], "tolerances must be given with objective mean or worst"),
    (["--objective", "worst", "--tolerance", "s=1%:lognormal"], "tolerances of a worst case must be uniform"),
    (["--balls", "0"], "balls must be a whole number of at least 1; got 0"),
    (["--over", "d"], "over must be NAME=VALUES"),
    (["--over", "u0=0:0.1:3"], "over must be NAME=VALUES"),
    (["--over", "d=0.1:0.2:3", "--d", "0.2"], "d must not be given twice"),
    (["--over", "d=0.1:0.2:3", "--s", "0.2"], "d and s give the same quantity"),
    (["--over", "kappa=4:40:3"], "over must name what is not tuned"),
    (["--d", "0.2,0.3"], "d must be one number"),
    (["--set", "V=0"], "V must not be zero"),
    (["--set", "d=1"], "give --d=1"),
    (["--r", "2"], "r must lie in (0, 1]; got 2"),
    (["--out", "design.zarr"], "out must end in .json"),
    (["--plot", "design.txt"], "plot must end in"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "keep_compiled", lambda: None)
    return tmp_path


@pytest.mark.parametrize(("arguments", "say"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, arguments, say):
    assert script.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert say in said
    assert len(said.splitlines()) == 1
    assert not list(folder.iterdir())


def strict(path):
    """A report; what is no strict JSON raises."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_a_report_is_strict_json_whole_or_not_at_all(folder):
    write_json(
        {"a": np.array([1.0, np.nan]), "b": (np.float64(np.inf), np.bool_(True), None, "c")}, folder / "one.json"
    )
    assert strict(folder / "one.json") == {"a": [1.0, None], "b": [None, True, None, "c"]}
    with pytest.raises(TypeError):
        write_json({"a": object()}, folder / "two.json")
    assert [path.name for path in folder.iterdir()] == ["one.json"]


@pytest.mark.slow
def test_the_small_device_has_its_optimum_beside_the_cliff(folder, capsys, monkeypatch):
    monkeypatch.setattr(script, "_POINTS", 12)
    monkeypatch.setattr(script, "_NEAR", 8)
    monkeypatch.setattr(script, "_BASINS", 100)
    assert script.main([*SMALL, "--tolerance", "omega0=5%"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["design.json", "design.png"]
    report, said = strict(folder / "design.json"), capsys.readouterr().out
    best = report["best"]
    assert best["pair"]["kappa"] == pytest.approx(KAPPA, rel=1e-5)
    assert best["P"] == pytest.approx(ENERGY, rel=1e-6)
    assert max(best["penetration"]) == pytest.approx(DEPTH, rel=1e-3)
    assert (best["label"], best["stopped"], best["active"]) == ("1:1", "maximum", [])
    assert best["largest_multiplier"] == pytest.approx(0.533, abs=1e-3)
    assert best["path"][-1] == pytest.approx([best["values"]["omega0"]], rel=1e-6)
    below, above = report["surroundings"]["below"], report["surroundings"]["above"]
    assert (below["kind"], above["kind"]) == ("fold", "none")
    assert 0.9 < report["surroundings"]["share"] <= 1
    spread = report["spread"]
    assert 0.8 * ENERGY < spread["worst"] < spread["mean"] < ENERGY
    assert report["tolerances"] == [{"name": "omega0", "spread": 0.05, "kind": "uniform"}]
    for text in (
        "P 57.75761 uJ per half period",
        "an interior optimum",
        "below, fold 7.8",
        "wrote design.json, design.png",
    ):
        assert text in said


def test_designs_along_an_axis(folder, capsys):
    arguments = [*SMALL[2:], "--over", "d=0.16,0.2", "--out", "map.json", "--plot", "map.png"]
    assert script.main(arguments) == 0
    report = strict(folder / "map.json")
    assert report["over"] == {"name": "d", "values": [0.16, 0.2]}
    assert [one["best"]["pair"]["d"] for one in report["designs"]] == pytest.approx([0.16, 0.2])
    assert report["designs"][1]["best"]["P"] == pytest.approx(ENERGY, rel=1e-6)
    assert "d 0.2: omega0 = 40.07126 rad/s, 1:1, P 57.758 uJ, interior" in capsys.readouterr().out
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_an_optimum_on_the_penetration_limit_says_so_and_what_lies_beyond(folder, capsys, monkeypatch):
    monkeypatch.setattr(script, "_POINTS", 24)
    monkeypatch.setattr(script, "_NEAR", 8)
    monkeypatch.setattr(script, "_BASINS", 100)
    assert script.main(["--d", "0.2", "--out", "paper.json", *FEW]) == 0
    report, said = strict(folder / "paper.json"), capsys.readouterr().out
    assert max(report["best"]["penetration"]) == pytest.approx(report["best"]["penetration_limit"], rel=1e-6)
    assert "held by: penetration limit" in said
    assert not report["highest"]["admissible"]
    assert report["highest"]["P"] > 100 * report["best"]["P"]
    assert "not physical: P alone would choose omega0" in said
    assert not (folder / "design.png").exists()
