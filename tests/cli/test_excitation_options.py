"""What shakes the capsule, as options say it."""

import numpy as np
import pytest

from vijax import Harmonics, Noise, Record
from vijax.cli.excitation import take_excitation

NONE = {"harmonics": None, "phases": None, "record": None, "looped": False, "noise": None, "seed": None}


def taken(**given):
    rest = NONE | given | {"periods": 3}
    excitation = take_excitation(rest)
    assert rest == {"periods": 3}
    return excitation


def test_options_make_excitations(tmp_path):
    assert taken() is None
    assert str(taken(harmonics="1,0.3", phases="0,0.5")) == str(Harmonics([1.0, 0.3], [0.0, 0.5]))
    assert taken(harmonics="1", phases="90deg").phases == (pytest.approx(0.5 * np.pi, rel=1e-15),)
    assert str(taken(noise="0.05,32", seed=4)) == str(Harmonics() + Noise(0.05, 32, 4))
    assert str(taken(noise="0.05,32", harmonics="0.5")) == str(Harmonics(0.5) + Noise(0.05, 32))
    time, shaken = np.linspace(0, 1, 50), np.random.default_rng(0).normal(size=50)
    for delimiter in (",", " "):
        file = tmp_path / "bench.txt"
        np.savetxt(file, np.c_[time, shaken], delimiter=delimiter, header="time acceleration", fmt="%.17g")
        assert str(taken(record=str(file), looped=True)) == str(Record(time, shaken, looped=True))
        assert str(taken(record=str(file), noise="0.1,8")) == str(Record(time, shaken) + Noise(0.1, 8))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"phases": "0"}, "phases must be left out without --harmonics; got 0"),
        ({"looped": True}, "looped must be left out without --record"),
        ({"seed": 3}, "seed must be left out without --noise; got 3"),
        ({"harmonics": "1,x"}, "--harmonics: it must be numbers parted by commas; got '1,x'"),
        ({"noise": "0.1"}, "--noise: it must be two numbers, a level and a highest frequency; got '0.1'"),
        ({"noise": "-1,32"}, "--noise: level must be"),
        ({"record": "nowhere.csv"}, "--record must be a text file of two columns of numbers; got 'nowhere.csv'"),
    ],
)
def test_what_cannot_be_names_its_option(given, says):
    with pytest.raises(ValueError, match=says):
        taken(**given)


@pytest.mark.parametrize(
    ("names", "delimiter"), [("time,acceleration", ","), ("t a", " "), ('"t [s]", "a [m/s^2]"', ",")]
)
def test_a_first_line_of_names_is_left_out(tmp_path, names, delimiter):
    file, rows = tmp_path / "bench.csv", np.c_[np.arange(5.0), np.ones(5)]
    np.savetxt(file, rows, delimiter=delimiter, header=names, comments="")
    assert str(taken(record=str(file))) == str(Record(*rows.T))


def test_a_line_of_names_among_numbers_is_refused(tmp_path):
    file = tmp_path / "bench.csv"
    file.write_text("0,1\ntime,acceleration\n1,1\n")
    with pytest.raises(ValueError, match="--record must be a text file of two columns of numbers; got"):
        taken(record=str(file))


def test_a_file_of_other_columns(tmp_path):
    file = tmp_path / "three.txt"
    np.savetxt(file, np.ones((5, 3)))
    with pytest.raises(ValueError, match="two columns of numbers; got 3 in"):
        taken(record=str(file))
