"""Scenes of `benchmarks/failures.py` with quick settings: the usual method fails and vijax gives the right result."""

import math
from functools import cache

import matplotlib.image
import numpy as np
import pytest

from benchmarks import charts, failures


@cache
def measured(name):
    """Return the quick figures of a scene as two arrays: the usual method and vijax."""
    figures = list(failures.SCENES[name].measure(True))
    return np.array([f.usual for f in figures]), np.array([f.vijax for f in figures])


def test_all_scenes_have_tests():
    assert {f"test_{name}" for name in failures.SCENES} <= set(globals())


def test_stability():
    (limit, blown, short, ample), vijax = measured("stability")
    # On the imaginary axis, for an elastic wall, RK4 is stable up to sqrt(8).
    assert failures.stability_limit(1.0) == pytest.approx(math.sqrt(8), abs=1e-3)
    assert 2.6 < limit < 3
    assert limit < blown < 1.5 * limit  # a contact of few steps ends before the error has grown
    assert short < 0.1
    assert ample == 1
    assert np.all(vijax[2:] == 1)


def test_stability_map_is_plotted(tmp_path):
    result = failures.stability_map(12)
    charts.stability_map(result, tmp_path / "map.png")
    assert np.ptp(matplotlib.image.imread(tmp_path / "map.png")) > 0.5
    with pytest.raises(ValueError, match="plot must end in"):
        charts.stability_map(result, tmp_path / "map.csv")


@pytest.mark.long
def test_order():
    (rk4, _), (_, tsit5) = measured("order")
    assert 0.7 < rk4 < 1.3
    assert tsit5 > 4.5


@pytest.mark.long
def test_speeds():
    (median, worst), vijax = measured("speeds")
    assert median > 0.1
    assert worst > 0.3
    assert np.all(vijax < 1e-12)


@pytest.mark.long
def test_labels():
    (miscounts, aperiodic, _, aperiodic_finer), (miscounted, slow, *_) = measured("labels")
    assert miscounts > 0.05
    assert min(aperiodic, aperiodic_finer) > 0.3
    assert miscounted == 0
    assert slow < 0.1  # within 400 periods; the other cells have not converged


@pytest.mark.long
def test_gradients():
    (*usual_errors, _), (*errors, exact) = measured("gradients")
    assert min(usual_errors) > 0.3  # from 500 to 32,000 steps
    assert errors[-1] < 1e-6
    assert errors[-1] < 1e-3 * errors[0]
    assert exact < 1e-6


def test_roots():
    usual, vijax = measured("roots")
    assert np.all(usual > 0)
    assert usual[1] > 0.1
    assert usual[2] > 0.5
    assert np.all(vijax == 0)


def test_chatter_restarts():
    (time, stopped, _), (reached, _, duration) = measured("chatter_restarts")
    assert time < 4
    assert stopped > 300
    assert reached == 6
    assert duration > 0.1


def test_grazing():
    (*_, differences, _, _), (slow, fast, rigid, tangent, soft, soft_fast) = measured("grazing")
    assert rigid == pytest.approx(-1, abs=0.01)
    assert slow > 1e3 * fast
    assert soft == pytest.approx(1, rel=0.01)
    assert soft_fast < 100
    assert differences > 0.5
    assert tangent < 1e-3


@pytest.mark.long
def test_chatter():
    usual, vijax = measured("chatter")
    coarse, fine = np.split(usual, 2)
    exact = vijax[: coarse.size]
    assert np.any(coarse != exact)
    assert np.all(exact == np.rint(exact))
    assert np.all(np.diff(exact) > 0)  # stiffer walls chatter longer
    assert np.all(fine == exact)  # with enough steps RK4 converges to the exact counts


def test_chaos():
    (periods, late), (_, average) = measured("chaos")
    assert 15 < periods < 60
    assert late > 1e-2
    assert average < 0.01


@pytest.mark.long
def test_windows():
    (many, cells), (multistable, _) = measured("windows")
    assert cells >= 4
    assert many > 0.3
    assert multistable == 0  # each of these cells has one attractor


@pytest.mark.long
def test_resonance():
    usual, vijax = measured("resonance")
    assert usual[-1] > 1e-6
    assert np.all(np.diff(usual) > 0)
    assert np.all(vijax < 1e-14)


@pytest.mark.long
def test_single_precision():
    (first, *_, worst, labels), (*_, double, _) = measured("single_precision")
    assert 1e-9 < first < 1e-6
    assert first < worst < 1e-3
    assert double < 1e-14
    assert labels < 0.1
