"""The adaptive method under several harmonics: agreement with the exact method, and membranes of any law."""

import jax
import numpy as np
import pytest

import vijax
from tests.helpers import Cubic, Plain
from vijax.impact.method_choice import choose_method

PAIR = vijax.impact_pair(0.2, 40.0, 0.5, 0.02)
ROUGH = vijax.Harmonics([1.0, 0.3, 0.1], [0.0, 0.7, -1.0])
FINE = {"method": "ode", "solver": "Dopri8", "rtol": 1e-12, "atol": 1e-14}
CELL = {"d": 0.2, "kappa": 40.0, "r": 0.5, "gamma": 0.02}


def test_the_motion_agrees_with_the_exact_method():
    exact, stepped = (vijax.trajectory(PAIR, 0.0, 0.1, 6, excitation=ROUGH, **how) for how in ({}, FINE))
    assert int(stepped.filled) == int(exact.filled) > 8
    for name in ("t", "v_in", "v_out", "depth", "duration"):
        actual, expected = (np.asarray(getattr(run.impacts, name))[:10] for run in (stepped, exact))
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(stepped.impacts.work[:10], exact.impacts.work[:10], rtol=1e-6)


def test_the_method_returns_the_waves_of_its_excitation():
    """The search for an attractor uses these waves to follow flights without impact."""
    stepped, exact = (choose_method(name, {}, excitation=ROUGH).waves(0.3) for name in ("ode", "exact"))
    assert [wave.order for wave in stepped] == [wave.order for wave in exact] == [1, 2, 3]
    for actual, expected in zip(stepped, exact, strict=True):
        np.testing.assert_allclose((actual.c, actual.q), (expected.c, expected.q), rtol=0, atol=1e-15)


@pytest.mark.long
def test_derivatives_agree_with_the_exact_method():
    def speed(pair, how):
        return vijax.trajectory(pair, 0.0, 0.1, 3, excitation=ROUGH, **how).impacts.v_in[2]

    slopes = [jax.jacfwd(lambda pair, how=how: speed(pair, how))(PAIR) for how in ({}, FINE)]
    for name in ("d", "kappa", "r", "gamma"):
        expected, actual = (float(getattr(slope, name)) for slope in slopes)
        assert actual == pytest.approx(expected, rel=1e-7), name


@pytest.mark.long
def test_labels_and_power_of_attractors_agree_with_the_exact_method():
    axes = {"d": np.linspace(0.15, 0.25, 3), "kappa": np.array([30.0, 60.0]), "r": 0.5, "gamma": 0.02}
    exact = vijax.sweep(**axes, excitation=ROUGH)
    stepped = vijax.sweep(**axes, excitation=ROUGH, method="ode", rtol=1e-10, atol=1e-12)
    for name in ("period", "impacts_left", "impacts_right"):
        np.testing.assert_array_equal(stepped[name], exact[name], err_msg=name)
    regular = (exact.period > 0).values
    assert regular.sum() > 3
    np.testing.assert_allclose(stepped.P.values[regular], exact.P.values[regular], rtol=1e-6)
    assert stepped.attrs["excitation"] == str(ROUGH)
    assert stepped.attrs["membrane"] == "linear"
    assert stepped.attrs["rtol"] == 1e-10


@pytest.mark.long
def test_a_stiffening_membrane_responds_to_all_harmonics():
    law = Cubic(500.0)
    orbits = vijax.find_orbits(PAIR, "LLR", guesses=64, membrane=law, excitation=ROUGH)
    attracts = np.abs(np.asarray(orbits.multipliers)).max(axis=1) < 1
    plane = vijax.sweep(**CELL, method="ode", rtol=1e-10, atol=1e-12, membrane=law, excitation=ROUGH)
    power = np.asarray(vijax.orbit_power(orbits, vijax.Harvester()))[attracts]
    assert np.abs(power / float(plane.P) - 1).min() < 1e-7


@pytest.mark.parametrize(
    ("how", "excitation", "message"),
    [
        (
            {"method": "rk4"},
            ROUGH,
            'method must be "exact", or "ode" with harmonics, with harmonics 1.0, 0.3 at 0.7 rad, .*; got .rk4',
        ),
        (FINE, ROUGH + vijax.Noise(0.1, 8), 'method must be "exact" with harmonics .* noise of level 0.1 .*; got .ode'),
        (FINE, vijax.Waveform(np.zeros(64), 4), 'method must be "exact" with waveform of 64 samples, .*; got .ode'),
        (FINE | {"friction": 0.1}, ROUGH, "friction must be left out with an excitation; got 0.1"),
        (FINE, vijax.Harmonics([1.0]) + vijax.Harmonics([-1.0]), "excitation must not cancel"),
        ({"membrane": Plain()}, ROUGH, 'membrane must be linear for method="exact"'),
    ],
)
def test_unsupported_arguments_raise(how, excitation, message):
    with pytest.raises(ValueError, match=message):
        vijax.trajectory(PAIR, 0.0, 0.1, 4, excitation=excitation, **how)
