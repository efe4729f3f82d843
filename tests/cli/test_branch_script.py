"""`scripts/branch.py`: the starts of its branches, and no file after bad input."""

import pytest

import vijax
from scripts import branch as script

SHAKEN = ["--wall", "rigid", "--A", "100", "--guesses", "32", "--max-switches", "0"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_branch_starts_within_bounds_that_exclude_the_device(folder, capsys):
    # The device of Tables I and II is forced at pi rad/s.
    assert script.main([*SHAKEN, "--along", "omega=4.8Hz:5.2Hz", "--out", "branch.zarr"]) == 0
    assert "1:1: omega 30.1593 to 32.6726" in capsys.readouterr().out
    dataset = vijax.load(folder / "branch.zarr")
    assert dataset.attrs["along"] == "omega"
    assert {str(dataset[f"end_{end}"].values[0]) for end in ("first", "last")} == {"low", "high"}


@pytest.mark.long
def test_the_output_of_a_branch_names_its_membrane(folder, capsys):
    arguments = ["--kappa", "40", "--along", "d=0.19:0.21", "--membrane", "hunt-crossley", "--chi", "0.3"]
    assert script.main([*arguments, "--guesses", "32", "--max-switches", "0", "--out", "branch.zarr"]) == 0
    assert "met pitchfork 0.19705393" in capsys.readouterr().out
    dataset = vijax.load(folder / "branch.zarr")
    assert dataset.attrs["membrane"] == "hunt-crossley with chi 0.3, exponent 1.5"
    assert "r" not in dataset.coords


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--wall", "soft", "--r_left", "0.5", "--membrane", "hunt-crossley", "--chi", "0.3"],
            "r_left must be left out with a membrane that has no restitution; got 0.5",
        ),
        (
            ["--wall", "soft", "--along", "r=0.3:0.5", "--membrane", "hunt-crossley", "--chi", "0.3"],
            "the law of this membrane specifies its loss, not r",
        ),
        (
            ["--wall", "soft", "--harmonics", "1,-1", "--phases", "0,0,0"],
            "phases must be one number, or one a harmonic, 2; got 3",
        ),
        (
            ["--membrane", "hyperelastic", "--prestretch", "2", "--radius", "1"],
            "membrane must be left out with a rigid",
        ),
        (
            ["--omega", "3", "--along", "omega=6pi:16pi"],
            "omega must lie within the bounds of along",
        ),
        (["--along", "omega=20pi:21pi", "--A", "1"], "got none with 1:1 at omega = 64.4026, 63.6173"),
        (["--along", "omega0=20:400"], "a rigid wall has no kappa or omega0 or k"),
        (["--along", "u0=0:1"], "along must be among"),
        (["--along", "omega"], "along must be NAME=LO:HI"),
        (["--along", "s=1Hz:2Hz"], "s must be in m"),
    ],
)
def test_bad_input_prints_a_single_line_and_exits_with_code_2(folder, capsys, arguments, message):
    assert script.main([*SHAKEN, *arguments]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("error: ")
    assert message in line
    assert not list(folder.iterdir())


@pytest.mark.long
def test_the_output_of_a_branch_names_its_harmonics(folder, capsys):
    arguments = ["--kappa", "40", "--along", "d=0.19:0.21", "--harmonics", "1,0.3", "--phases", "0,0.7"]
    assert script.main([*arguments, "--guesses", "32", "--max-switches", "0", "--out", "branch.zarr"]) == 0
    dataset = vijax.load(folder / "branch.zarr")
    assert dataset.attrs["excitation"] == "harmonics 1.0, 0.3 at 0.7 rad"
    assert "orbits stable" in capsys.readouterr().out


def test_harmonics_are_passed_to_the_search(folder, capsys, monkeypatch):
    excitations = []

    def search(pair, impacts, **settings):
        excitations.append(settings["excitation"])
        raise ValueError("enough")

    monkeypatch.setattr("vijax.orbits.orbit_search.find_orbits", search)
    assert script.main(["--kappa", "40", "--harmonics", "1,0.3", "--phases", "0,0.7"]) == 2
    assert capsys.readouterr().err.strip().endswith("enough")
    assert excitations == [vijax.Harmonics([1.0, 0.3], [0.0, 0.7])]
    assert not list(folder.iterdir())
