"""Excitations: validation, units, sums, and names."""

import math

import numpy as np
import pytest

import vijax
from vijax import Harmonics, Harvester, Noise, Record, Waveform
from vijax.impact.forcing import forcing_of
from vijax.maps.axes import counted_periods
from vijax.model.forcing.excitation import check_run_excitation

TIME = np.linspace(0, 4, 401)
SHAKEN = np.cos(4 * np.pi * TIME)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Harmonics([0.0, 0.0]), "amplitudes must be one number a harmonic, not all 0; got"),
        (lambda: Harmonics([[1.0]]), "amplitudes must"),
        (lambda: Harmonics([1.0, math.nan]), "amplitudes must be finite; got nan at index 1"),
        (lambda: Harmonics([1.0, 0.5], [0.0, 0.1, 0.2]), "phases must be one number, or one a harmonic, 2; got 3"),
        (lambda: Waveform([1.0], 64), r"values must be a row of at least two numbers; got shape \(1,\)"),
        (lambda: Waveform([1.0, 2.0], 1.5), "samples must be a number from 2 to 1,000,000"),
        (lambda: Waveform([1.0, 2.0], 64, "yes"), "looped must be True or False; got 'yes'"),
        (lambda: Record(TIME, SHAKEN[:-1]), "acceleration must hold one number a time, 401; got 400"),
        (lambda: Record(TIME**2, SHAKEN), "time must rise by even steps, to 0.001 of one; got steps from"),
        (lambda: Record(TIME[::-1], SHAKEN), "time must rise by even steps"),
        (lambda: Noise(-1.0, 32), "level must be a finite number of at least 0; got -1.0"),
        (lambda: Noise(0.1, 0.5), "bandwidth must be a number from 1 to 10.5"),
        (lambda: Noise(0.1, 32, -3), "seed must be a whole number of at least 0; got -3"),
        (lambda: Noise(0.1, 32) + Noise(0.1, 16), "excitation must hold at most one of noises; got 2"),
        (lambda: Waveform([1.0, 2.0], 8) + Record(TIME, SHAKEN), "at most one of records and waveforms; got 2"),
        (lambda: Noise(0.1, 32) + 3, "excitation must be of the kind Excitation; got 3"),
    ],
)
def test_errors_name_invalid_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_record_is_converted_to_the_units_of_a_device():
    record = Record(TIME, SHAKEN, looped=True)
    wave = record.waveform(Harvester(A=2.0, omega=4 * np.pi))
    assert np.array_equal(wave.values, SHAKEN / 2)
    assert wave.samples == pytest.approx(50, rel=1e-12)
    assert wave.looped
    once = Record(TIME, SHAKEN).waveform(Harvester(omega=4 * np.pi))
    assert once.periods == pytest.approx(8, rel=1e-12)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (Harvester(omega=np.array([1.0, 2.0])), "omega must be one number with a record; got 2"),
        (Harvester(omega=600.0), "omega must give the record 2 to 1,000,000 samples in a period .*; lower it"),
        (Harvester(omega=1e-6), "omega must give the record 2 to 1,000,000 samples in a period .*; raise it"),
    ],
)
def test_invalid_units_are_rejected(device, message):
    with pytest.raises(ValueError, match=message):
        Record(TIME, SHAKEN).waveform(device)


def test_excitations_supported_by_a_run():
    record, once = Record(TIME, SHAKEN), Waveform(SHAKEN, 50.0, looped=False)
    with pytest.raises(ValueError, match=r"excitation must be in the units of the pair; got a Record"):
        check_run_excitation(record, 5)
    with pytest.raises(ValueError, match='within the record, 8 periods; got 9; periods="all" takes all of it'):
        check_run_excitation(once, 9)
    with pytest.raises(ValueError, match='until must be "window" with an excitation that does not repeat'):
        check_run_excitation(Harmonics() + Noise(0.1, 32), 9, repeats=True)
    assert check_run_excitation(once, 8) is once
    assert check_run_excitation(Harmonics([1.0, 0.2]) + Noise(0.0, 32), 9, repeats=True).is_periodic


def test_names_distinguish_excitations():
    knots_per_sample = [
        Harmonics(),
        Harmonics([1.0, 0.1]),
        Harmonics([1.0, 0.1], 0.2),
        Waveform(SHAKEN, 50.0),
        Waveform(SHAKEN, 51.0),
        Waveform(SHAKEN, 50.0, looped=False),
        Waveform(SHAKEN * (1 + 1e-15), 50.0),
        Record(TIME, SHAKEN),
        Noise(0.1, 32),
        Noise(0.1, 32, 1),
        Harmonics() + Noise(0.1, 32),
    ]
    assert len({str(excitation) for excitation in knots_per_sample}) == len(knots_per_sample)
    assert str(knots_per_sample[-1]) == "harmonics 1.0 + noise of level 0.1 up to 32.0 times the frequency, seed 0"


def test_harmonics_add_up():
    f = forcing_of(Harmonics([1.0, 0.0, 0.4]) + Harmonics([-0.5], math.pi / 2))
    assert f.orders == (1, 3)
    assert str(sum([Harmonics(), Noise(0.1, 4)])) == str(Harmonics() + Noise(0.1, 4))
    assert f.is_periodic
    np.testing.assert_allclose(f.cosines + 1j * f.sines, [1.0 - 0.5j, 0.4], atol=1e-15)
    assert not forcing_of(Harmonics() + Noise(0.1, 4)).is_periodic


@pytest.mark.parametrize(
    ("bandwidth", "knots_per_period", "knots_per_sample", "knots_per_noise_value"),
    [(30.0, 72.0, 3, 1), (12.0, 24.0, 1, 1), (5.0, 24.0, 1, 2)],
)
def test_records_and_noise_share_knots(bandwidth, knots_per_period, knots_per_sample, knots_per_noise_value):
    f = forcing_of(Waveform(SHAKEN, 24.0) + Noise(0.1, bandwidth))
    assert (f.knots_per_period, f.knots_per_sample, f.knots_per_noise_value) == (
        knots_per_period,
        knots_per_sample,
        knots_per_noise_value,
    )
    # level^2 is the variance of a velocity over time, so values at shorter intervals are larger.
    assert f.level**2 * knots_per_noise_value * 2 / knots_per_period == pytest.approx(0.01)


# --- validation -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "ode"}, 'method must be "exact" with noise of level 0.1 .*; got'),
        ({"until": "attractor"}, 'until must be "window"'),
        ({"excitation": "sine"}, "excitation must be of the kind Excitation; got 'sine'"),
    ],
)
def test_a_sweep_rejects_invalid_excitations(arguments, message):
    with pytest.raises(ValueError, match=message):
        vijax.sweep(d=0.2, kappa=30.0, **{"until": "window", "excitation": Noise(0.1, 16)} | arguments)


def test_a_trajectory_rejects_invalid_excitations():
    pair = vijax.impact_pair(0.2, None, 0.5)
    with pytest.raises(ValueError, match="excitation must be in the units of the pair"):
        vijax.trajectory(pair, 0.0, 0.4, 3, excitation=Record(TIME, SHAKEN))


def test_power_under_a_record_does_not_depend_on_the_units():
    """A and omega are only units: P in watts does not depend on them, and an axis of either is rejected."""
    record = Record(TIME, SHAKEN, looped=True)
    settings = {
        "omega0": [50.0, 200.0],
        "s": 0.01,
        "until": "window",
        "excitation": record,
        "outputs": ["power", "status"],
    }
    start = {"u0": 0.0, "v0": 0.0}
    reference = vijax.sweep(**settings, **start, omega=4 * np.pi, A=1.0, periods=80)
    rescaled = vijax.sweep(**settings, **start, device=Harvester(A=2.0, omega=8 * np.pi), periods=160)
    np.testing.assert_allclose(reference["power"], rescaled["power"], rtol=1e-6)
    assert reference.attrs["excitation"] == str(record)
    with pytest.raises(
        ValueError, match="omega must be one number with a record, because it is the unit of the record; got 2"
    ):
        vijax.sweep(**settings, omega=[3.0, 4.0])


def test_a_record_contains_an_integer_number_of_periods():
    record = Record(np.arange(0.0, 10.7, 0.1), np.ones(107))
    device = Harvester(omega=2 * np.pi)
    assert counted_periods("all", record, 2, {"d": 0.2, "omega": None}, device) == 8
    assert counted_periods("all", record, 0, {"omega": 4 * np.pi}, device) == 21
    wave = record.waveform(device)
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    assert vijax.trajectory(pair, 0.0, 0.3, "all", excitation=wave).states.u.shape == (10,)
    for excitation, message in (
        (None, 'periods must be a number unless a record ends the run; got "all"'),
        (Record(record.time, record.acceleration, looped=True), "periods must be a number unless a record ends"),
    ):
        with pytest.raises(ValueError, match=message):
            vijax.sweep(d=0.2, device=device, until="window", periods="all", excitation=excitation)
    with pytest.raises(ValueError, match="transient must leave a whole period of the record, 10 periods; got 10"):
        vijax.response(device, record, periods="all", transient=10)
    with pytest.raises(ValueError, match=r'periods must be "all"; got .half.; or a whole number of at least 1'):
        vijax.response(device, record, periods="half")
