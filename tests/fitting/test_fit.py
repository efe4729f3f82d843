"""`vijax.fit` recovers a device from its impacts with right standard errors and reports undetermined unknowns."""

import dataclasses

import jax
import numpy as np
import pint
import pytest

import vijax
from tests.fitting.bench import SIDES, measured, measured_with_restitution, with_faults
from vijax.fitting import standard_errors
from vijax.model.device import with_pair
from vijax.runtime.compilation import xla

DEVICE = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=60.0, r=0.6)
GUESS = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=52.0, r=0.5)
PERIOD = 2 * np.pi / 10
ERROR = 1e-3 * PERIOD


@pytest.fixture(autouse=True)
def optimised(monkeypatch):
    """Optimise the compiled programs of fits, which run thousands of times; tests take a fifth less time."""
    options = xla.compiler_options
    monkeypatch.setattr(xla, "compiler_options", lambda **how: options(**how) | {"xla_backend_optimization_level": 1})


@pytest.fixture(scope="module")
def timed():
    return measured(DEVICE, 100, error=ERROR, seed=1)


@pytest.fixture(scope="module")
def fitted(timed):
    """Fit of the timed impacts from the guess."""
    return vijax.fit(timed.times, timed.sides, timing_error=ERROR, device=GUESS)


def pulls(result, **truth):
    return np.array([(result.values[name] - value) / result.stderr[name] for name, value in truth.items()])


def test_device_is_recovered_from_impact_times(timed, fitted):
    result = fitted
    assert result.converged
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3
    assert result.stderr["omega0"] < 0.05
    assert result.stderr["r"] < 2e-3
    assert 0.85 < result.misfit.size < 1.15
    assert 0.001 < result.misfit.p_value < 0.999
    assert abs(result.constancy.slope) < 3 * result.constancy.stderr
    assert not result.excluded.any()
    assert result.undetermined == result.alternatives == ()
    np.testing.assert_allclose(result.speeds, timed.speeds, atol=0.01)
    assert float(result.device.omega0) == result.values["omega0"]
    assert "impacts left out: 0" in str(result)


def test_fit_without_errors_is_exact():
    impacts = measured(DEVICE, 60)
    result = vijax.fit(impacts.times, impacts.sides, timing_error=1e-9, device=GUESS)
    assert result.values["omega0"] == pytest.approx(60.0, rel=1e-7)
    assert result.values["r"] == pytest.approx(0.6, rel=1e-7)


def test_speeds_reduce_the_standard_errors(timed, fitted):
    error = 0.01
    speeds = timed.speeds + error * np.random.default_rng(2).normal(size=timed.speeds.size)
    options = {"speed_error": error, "timing_error": ERROR, "device": GUESS}
    result = vijax.fit(timed.times, speeds=timed.sides * speeds, **options)
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3
    assert result.stderr["r"] < fitted.stderr["r"]
    assert result.misfit.degrees_of_freedom == fitted.misfit.degrees_of_freedom + timed.times.size - 1


def test_missed_and_false_impacts_are_excluded(timed):
    times, sides, false = with_faults(timed.times, timed.sides, missed=[60], false=[(151, 0.4, timed.sides[151])])
    result = vijax.fit(times, sides, timing_error=ERROR, device=GUESS)
    assert result.converged
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3
    assert np.flatnonzero(result.false).tolist() == false.tolist() == [151]
    assert np.flatnonzero(result.excluded).tolist() == [59, 60, 151]
    assert np.isnan(result.residuals[151])
    assert "impacts left out: 3 of 257; false: 151" in str(result)


@pytest.mark.long
def test_many_measurement_faults_are_excluded_together(timed):
    # Two false impacts are consecutive, another is next to a missed impact, and another is the last but one.
    last = timed.times.size - 2
    times, sides, false = with_faults(
        timed.times,
        timed.sides,
        missed=(70, 122, 123, 210),
        false=[(40, 0.3, 1.0), (40, 0.6, -1.0), (120, 0.5, 1.0), (last, 0.5, -1.0)],
    )
    result = vijax.fit(times, sides, timing_error=ERROR, device=GUESS)
    assert result.converged
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3
    assert set(np.flatnonzero(result.false)) >= set(false[:3])
    assert result.excluded.sum() <= 14
    assert result.misfit.p_value > 0.001


@pytest.mark.long
def test_false_impact_does_not_mislead_the_search():
    pair = vijax.impact_pair(d=0.256921516, kappa=58.7548623, r=0.61585343, gamma=-0.0484533)
    device = with_pair(vijax.Harvester(A=1.79495762790131, omega=35.819029154), pair)
    device = jax.tree.map(float, device)
    error = 1e-4 * 2 * np.pi / device.omega
    run = measured(device, 90, skip=9, error=error, start=(0.3 * 0.256921516, -0.3))
    times, sides, false = with_faults(run.times, run.sides, false=[(50, 0.4, run.sides[50])])
    guess = dataclasses.replace(device, omega0=1.03 * device.omega0, r=0.97 * device.r)
    result = vijax.fit(times, sides, timing_error=error, device=guess)
    assert result.converged
    assert np.flatnonzero(result.false).tolist() == false.tolist() == [51]
    assert np.abs(pulls(result, omega0=device.omega0, r=device.r)).max() < 3


@pytest.mark.long
def test_false_impact_does_not_bias_weakly_determined_unknowns():
    # Two kinds of impact do not determine four unknowns; the unknowns can adapt to a false impact.
    device = vijax.Harvester(
        A=4.1115632263930468, omega=16.485525555290415, omega0=68.04814423558298, r=0.4265226512389042,
        s=0.0411297903570154, beta=0.0060176126499510265,
    )  # fmt: skip
    guess = dataclasses.replace(
        device, omega0=71.81011171907637, r=0.4204310329571738, s=0.04424478007327288, beta=0.0058686623987271105
    )
    error, unknown = 1e-4 * 2 * np.pi / device.omega, ("omega0", "r", "s", "beta")
    run = measured(device, 200, skip=229, start=(0.3 * float(device.pair().d), -0.3))
    clean = run.times + error * np.random.default_rng(1).normal(size=170)
    times, sides, _ = with_faults(clean, run.sides, false=[(23, 0.5435, -1.0)])
    result = vijax.fit(times, sides, timing_error=error, device=guess, unknown=unknown)
    for name in unknown:
        assert abs(result.values[name] - getattr(device, name)) < 3 * result.stderr[name]
    assert result.undetermined or result.false.any()


@pytest.mark.long
def test_wrong_speed_is_excluded(timed):
    error = 0.01
    speeds = timed.speeds + error * np.random.default_rng(2).normal(size=timed.speeds.size)
    speeds[30] += 0.3
    result = vijax.fit(timed.times, timed.sides, timing_error=ERROR, speeds=speeds, speed_error=error, device=GUESS)
    assert result.converged
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3
    assert result.misfit.p_value > 0.001
    assert np.flatnonzero(result.excluded).tolist() == [30]


def test_units_of_pint(timed, fitted):
    # Units are converted: milliseconds are not read as seconds, and metres are not times.
    ureg = pint.UnitRegistry()
    options = {"device": GUESS}
    with_units = vijax.fit(timed.times * 1e3 * ureg.ms, timed.sides, timing_error=ERROR * 1e6 * ureg.us, **options)
    assert with_units.values["r"] == pytest.approx(fitted.values["r"], rel=1e-6)
    with pytest.raises(ValueError, match="times must be in s"):
        vijax.fit(timed.times * ureg.m, timed.sides, timing_error=ERROR, **options)
    record = vijax.Record(np.arange(5) * 1e3 * ureg.ms, np.ones(5) * ureg.cm / ureg.s**2)
    assert record.step == pytest.approx(1.0)
    assert record.acceleration[0] == pytest.approx(0.01)


def test_fit_without_degrees_of_freedom_prints():
    # A gross error excludes all but two equations of five impacts, and no equation is left for the misfit.
    impacts = measured(DEVICE, 30)
    times = impacts.times[:5].copy()
    times[1] = (times[1] + times[2]) / 2
    result = vijax.fit(times, impacts.sides[:5], timing_error=ERROR, device=GUESS)
    assert "misfit" in str(result)
    assert not (result.converged and result.misfit.degrees_of_freedom < 1)
    assert result.report()["misfit"]["degrees_of_freedom"] == result.misfit.degrees_of_freedom


@pytest.mark.long
def test_standard_errors_grow_if_the_timing_error_is_underestimated(timed):
    right = vijax.fit(timed.times, timed.sides, timing_error=ERROR, device=GUESS)
    underestimated = vijax.fit(timed.times, timed.sides, timing_error=ERROR / 4, device=GUESS)
    assert underestimated.misfit.size == pytest.approx(4 * right.misfit.size, rel=0.15)
    assert underestimated.misfit.p_value < 1e-6
    assert underestimated.stderr["r"] == pytest.approx(right.stderr["r"] * right.misfit.size, rel=0.3)
    assert underestimated.converged
    # If the errors are larger by far, the fit does not converge.
    assert not vijax.fit(timed.times, timed.sides, timing_error=ERROR / 16, device=GUESS).converged


@pytest.mark.long
def test_slow_rise_of_the_misfit_widens_the_standard_errors(monkeypatch):
    impacts = measured(DEVICE, 60, wall="rigid", error=ERROR, seed=4)
    options = {"timing_error": ERROR, "device": DEVICE, "unknown": ("s", "r"), "wall": "rigid"}
    plain = vijax.fit(impacts.times, impacts.sides, **options)
    # At two standard errors the sum rises by 4. If it rises by 1 there, the standard errors double.
    monkeypatch.setattr(standard_errors, "least_sum_at", lambda _task, _certain, shift, _others: (1.0, 0.0 * shift))
    wider = vijax.fit(impacts.times, impacts.sides, **options)
    assert wider.stderr["r"] == pytest.approx(2 * plain.stderr["r"], rel=1e-6)


@pytest.mark.long
def test_value_at_its_limit_is_undetermined():
    # A single kind of impact does not determine four unknowns: r tends to 1, the limit without loss.
    device = vijax.Harvester(s=0.08, omega=10.0, A=3.0, r=0.4)
    impacts = measured(device, 150, wall="rigid", error=ERROR, skip=180, seed=1)
    unknown = ("r", "s", "beta", "delay")
    result = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=device, unknown=unknown, wall="rigid")
    assert result.undetermined
    assert result.stderr["r"] == np.inf


@pytest.mark.long
def test_nearest_of_equally_good_devices_is_selected():
    # Two devices, which differ by a factor of two in stiffness, fit a motion with few kinds of impact.
    pair = vijax.impact_pair(d=0.2619, kappa=9.993, r=0.6963, gamma=0.0396)
    device = jax.tree.map(float, with_pair(vijax.Harvester(), pair))
    impacts = measured(device, 150, skip=60, error=2e-3, seed=3)
    ends = []
    for stiffness, r in ((0.9, 0.65), (2.2, 0.93)):
        guess = dataclasses.replace(device, omega0=device.omega0 * stiffness, r=r)
        result = vijax.fit(impacts.times, impacts.sides, timing_error=2e-3, device=guess)
        assert result.converged
        ends.append(result)
    near, far = ends
    assert abs(near.values["omega0"] - device.omega0) < 4 * near.stderr["omega0"]
    assert far.values["omega0"] > 1.5 * device.omega0
    assert abs(near.misfit.chi2 - far.misfit.chi2) < 9
    others = [other["omega0"] for other in (*near.alternatives, *far.alternatives)]
    assert others


def test_inseparable_unknowns_are_named():
    # Times alone have no unit of length: a device twice as large, shaken twice as strongly, has the same times.
    impacts = measured(DEVICE, 80, wall="rigid", error=ERROR, seed=4)
    options = {"timing_error": ERROR, "device": DEVICE, "unknown": ("r", "s", "A"), "wall": "rigid"}
    result = vijax.fit(impacts.times, impacts.sides, **options)
    assert result.undetermined == (("s", "A"),)
    assert result.stderr["s"] == result.stderr["A"] == np.inf
    assert abs(result.values["r"] - 0.6) < 3 * result.stderr["r"] < 0.05
    assert np.isnan(result.correlation[1, 2])
    assert "s and A cannot be determined separately from these data" in str(result)
    # Speeds have a unit of length.
    with_speeds = vijax.fit(impacts.times, impacts.sides, speeds=impacts.speeds, speed_error=1e-3, **options)
    assert with_speeds.undetermined == ()
    assert np.abs(pulls(with_speeds, r=0.6, s=0.02, A=3.0)).max() < 3


@pytest.mark.long
def test_single_kind_of_impact_leaves_two_unknowns_undetermined():
    # Without gravity both impacts of a 1:1 motion are equal: a single equation for stiffness and restitution.
    device = vijax.Harvester(s=0.08, omega=10.0, A=3.0, omega0=60.0, r=0.4)
    impacts = measured(device, 120, error=ERROR, skip=100)
    assert np.ptp(impacts.speeds) < 1e-6
    result = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=device)
    assert result.undetermined
    assert result.stderr["omega0"] == np.inf
    # Impacts of equal speed do not show whether restitution depends on speed.
    assert result.constancy.stderr > 1


@pytest.mark.long
def test_fit_with_rigid_walls():
    impacts = measured(DEVICE, 80, wall="rigid", error=ERROR, seed=4)
    result = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=GUESS, unknown=("s", "r"), wall="rigid")
    assert np.abs(pulls(result, s=0.02, r=0.6)).max() < 3


@pytest.mark.long
def test_fit_of_two_rigid_walls_and_a_clock_delay():
    impacts = measured(SIDES, 60, wall="rigid", error=ERROR, seed=5)
    unknown = ("r_left", "r_right", "delay")
    options = {"timing_error": ERROR, "device": SIDES, "unknown": unknown, "wall": "rigid"}
    result = vijax.fit(impacts.times + 0.28, impacts.sides, **options)
    assert result.converged
    assert np.abs(pulls(result, r_left=0.6, r_right=0.5, delay=0.28)).max() < 3


@pytest.mark.long
def test_fit_of_two_membranes_and_a_clock_delay():
    impacts = measured(SIDES, 60, error=ERROR, seed=5)
    unknown = ("omega0_left", "r_right", "delay")
    result = vijax.fit(impacts.times + 0.2, impacts.sides, timing_error=ERROR, device=SIDES, unknown=unknown)
    assert result.converged
    assert np.abs(pulls(result, omega0_left=60.0, r_right=0.5, delay=0.2)).max() < 3


@pytest.mark.long
def test_fit_with_a_record_that_starts_at_another_time():
    time = 3.0 + np.arange(0, 40, 0.02)
    shake = 3 * np.cos(10 * time) + np.random.default_rng(6).normal(size=time.size) * 0.2
    record = vijax.Record(time, shake)
    impacts = measured(DEVICE, 40, excitation=record.waveform(DEVICE), error=ERROR, seed=7)
    result = vijax.fit(impacts.times + 3.0, impacts.sides, record, timing_error=ERROR, device=GUESS)
    assert result.converged
    assert np.abs(pulls(result, omega0=60.0, r=0.6)).max() < 3


def test_speed_dependent_restitution_is_detected():
    # Faster impacts lose more: r falls by 0.1 from one end of the speeds to the other.
    impacts = measured_with_restitution(DEVICE, 120, lambda speed: 0.65 - 0.25 * speed, error=ERROR, seed=8)
    result = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=GUESS)
    assert result.constancy.p_value < 1e-6
    assert result.constancy.slope == pytest.approx(-0.25, abs=0.08)
    assert "restitution: depends on speed" in str(result)


VALID = {"times": [0.0, 0.3, 0.7, 1.1, 1.5, 2.0], "sides": [1, -1, 1, -1, 1, -1], "timing_error": 1e-3}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"times": [0.0, 0.3, 0.2, 1.1, 1.5, 2.0]}, "times must rise from impact to impact; got 0.2 at index 2"),
        ({"times": [0.0, 0.3], "sides": [1, -1]}, "times must be at least 4 impacts; got 2"),
        (
            {"sides": [1, -1, 1, -1, 1, 2]},
            "sides must be -1 left or .1 right; got 2",
        ),
        ({"sides": [1, -1]}, "sides must hold one number a time, 6; got 2"),
        ({"sides": None}, "sides must be given"),
        ({"timing_error": 0.0}, "timing_error must be a positive finite number"),
        ({"speeds": np.ones(6)}, "speed_error must be given with speeds"),
        ({"speed_error": 0.1}, "speed_error must be given with speeds, .* without speeds"),
        ({"unknown": "V"}, "unknown must be among .*delay; got"),
        ({"unknown": ("r", "r_left")}, "unknown must name a quantity once; got r and r_left"),
        ({"unknown": ("omega0", "r", "s", "gamma")}, "of 4 at least 7 impacts without speeds; got 6"),
        ({"wall": "rigid"}, "unknown must have an effect at rigid walls; got omega0"),
        ({"excitation": vijax.Harmonics() + vijax.Noise(0.1, 8)}, "excitation must be known; got noise"),
        ({"excitation": vijax.Record([0.0, 0.1, 0.2], [1.0, 0.0, 1.0])}, "times must lie within the record"),
        (
            {"excitation": vijax.Record([0.0, 0.1, 0.2], [1.0, 0.0, 1.0], looped=True), "unknown": "omega"},
            "unknown must have an effect on the motion; got omega",
        ),
        ({"unknown": ("delay", "delay")}, "unknown must name a quantity once; got delay and delay"),
        (
            {"wall": "rigid_left", "unknown": "omega0_left"},
            "unknown must have an effect at rigid walls; got omega0_left",
        ),
        ({"sides": None, "speeds": np.ones(6), "speed_error": 0.1}, "speeds must be velocities, negative at the left"),
        ({"speeds": [-1, 1, 1, -1, 1, -1], "speed_error": 0.1}, "speeds must have the signs of sides, or none; got -1"),
        ({"times": []}, "times must be one number an impact, of at least 4; got none"),
        ({"device": SIDES, "unknown": "r"}, "unknown must name r_left or r_right, or both"),
    ],
)
def test_invalid_arguments_raise(wrong, message):
    with pytest.raises(ValueError, match=message):
        vijax.fit(**VALID | wrong)
