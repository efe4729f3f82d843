"""Excitations from command-line options."""

import numpy as np
import pytest

from vijax import Harmonics, Noise, Record
from vijax.cli.options.excitation import take_excitation

NONE = {"harmonics": None, "phases": None, "record": None, "looped": False, "noise": None, "seed": None}


def parse_excitation(**options):
    rest = NONE | options | {"periods": 3}
    excitation = take_excitation(rest)
    assert rest == {"periods": 3}
    return excitation


def test_options_make_excitations(tmp_path):
    assert parse_excitation() is None
    assert str(parse_excitation(harmonics="1,0.3", phases="0,0.5")) == str(Harmonics([1.0, 0.3], [0.0, 0.5]))
    assert parse_excitation(harmonics="1", phases="90deg").phases == (pytest.approx(0.5 * np.pi, rel=1e-15),)
    assert str(parse_excitation(noise="0.05,32", seed=4)) == str(Harmonics() + Noise(0.05, 32, 4))
    assert str(parse_excitation(noise="0.05,32", harmonics="0.5")) == str(Harmonics(0.5) + Noise(0.05, 32))
    time, acceleration = np.linspace(0, 1, 50), np.random.default_rng(0).normal(size=50)
    for delimiter in (",", " "):
        file = tmp_path / "bench.txt"
        np.savetxt(file, np.c_[time, acceleration], delimiter=delimiter, header="time acceleration", fmt="%.17g")
        assert str(parse_excitation(record=str(file), looped=True)) == str(Record(time, acceleration, looped=True))
        assert str(parse_excitation(record=str(file), noise="0.1,8")) == str(Record(time, acceleration) + Noise(0.1, 8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"phases": "0"}, "phases must be left out without --harmonics; got 0"),
        ({"looped": True}, "looped must be left out without --record"),
        ({"seed": 3}, "seed must be left out without --noise; got 3"),
        ({"harmonics": "1,x"}, "--harmonics: it must be numbers separated by commas; got '1,x'"),
        ({"noise": "0.1"}, "--noise: it must be two numbers, a level and a highest frequency; got '0.1'"),
        ({"noise": "-1,32"}, "--noise: level must be"),
        ({"record": "nowhere.csv"}, "--record must be a text file of two columns of numbers; got 'nowhere.csv'"),
    ],
)
def test_an_invalid_excitation_names_its_option(options, message):
    with pytest.raises(ValueError, match=message):
        parse_excitation(**options)


@pytest.mark.parametrize(
    ("names", "delimiter"), [("time,acceleration", ","), ("t a", " "), ('"t [s]", "a [m/s^2]"', ",")]
)
def test_a_first_line_of_names_is_skipped(tmp_path, names, delimiter):
    file, rows = tmp_path / "bench.csv", np.c_[np.arange(5.0), np.ones(5)]
    np.savetxt(file, rows, delimiter=delimiter, header=names, comments="")
    assert str(parse_excitation(record=str(file))) == str(Record(*rows.T))


def test_a_line_of_names_among_numbers_is_refused(tmp_path):
    file = tmp_path / "bench.csv"
    file.write_text("0,1\ntime,acceleration\n1,1\n")
    with pytest.raises(ValueError, match="--record must be a text file of two columns of numbers; got"):
        parse_excitation(record=str(file))


def test_a_file_of_three_columns_is_refused(tmp_path):
    file = tmp_path / "three.txt"
    np.savetxt(file, np.ones((5, 3)))
    with pytest.raises(ValueError, match="two columns of numbers; got 3 in"):
        parse_excitation(record=str(file))
