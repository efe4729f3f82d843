"""Where methods fail: the quick figures of `benchmarks/failures.py`; the usual method is wrong, and vijax is not."""

import math
from functools import cache

import matplotlib.image
import numpy as np
import pytest

from benchmarks import charts, failures


@cache
def measured(name):
    """The quick figures of a scene as two columns: by the usual method, and by vijax."""
    figures = list(failures.SCENES[name].measure(True))
    return np.array([f.usual for f in figures]), np.array([f.vijax for f in figures])


def test_every_scene_has_its_test():
    assert {f"test_{name}" for name in failures.SCENES} <= set(globals())


def test_stability():
    (limit, blown, short, ample), vijax = measured("stability")
    # On the imaginary axis, for an elastic wall, RK4 is stable up to sqrt(8).
    assert failures.stability_limit(1.0) == pytest.approx(math.sqrt(8), abs=1e-3)
    assert 2.6 < limit < 3
    assert limit < blown < 1.5 * limit  # a contact of few steps ends before it has grown
    assert short < 0.1
    assert ample == 1
    assert np.all(vijax[2:] == 1)


def test_the_stability_map_is_drawn(tmp_path):
    found = failures.stability_map(12)
    charts.stability_map(found, tmp_path / "map.png")
    assert np.ptp(matplotlib.image.imread(tmp_path / "map.png")) > 0.5
    with pytest.raises(ValueError, match="plot must end in"):
        charts.stability_map(found, tmp_path / "map.csv")


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
    (miscounts, restless, _, restless_finer), (miscounted, slow, *_) = measured("labels")
    assert miscounts > 0.05
    assert min(restless, restless_finer) > 0.3
    assert miscounted == 0
    assert slow < 0.1  # within 400 periods; the rest are still on their way


@pytest.mark.long
def test_gradients():
    (*blind, _), (*seen, exact) = measured("gradients")
    assert min(blind) > 0.3  # from 500 to 32,000 steps
    assert seen[-1] < 1e-6
    assert seen[-1] < 1e-3 * seen[0]
    assert exact < 1e-6


def test_roots():
    usual, vijax = measured("roots")
    assert np.all(usual > 0)
    assert usual[1] > 0.1
    assert usual[2] > 0.5
    assert np.all(vijax == 0)


def test_chatter_restarts():
    (time, still, _), (reached, _, stay) = measured("chatter_restarts")
    assert time < 4
    assert still > 300
    assert reached == 6
    assert stay > 0.1


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
    assert np.all(fine == exact)  # steps enough for these: the exact counts are what RK4 tends to


def test_chaos():
    (periods, late), (_, average) = measured("chaos")
    assert 15 < periods < 60
    assert late > 1e-2
    assert average < 0.01


@pytest.mark.long
def test_windows():
    (many, cells), (found, _) = measured("windows")
    assert cells >= 4
    assert many > 0.3
    assert found == 0  # each of these cells has one attractor


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
