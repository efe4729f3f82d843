"""`vijax.fit`: the device comes back from its impacts, with errors that hold, and what is not told is said."""

import dataclasses

import jax
import numpy as np
import pint
import pytest

import vijax
from tests.fitting.bench import SIDES, measured, measured_one_by_one, with_faults
from vijax.fitting import errors
from vijax.model.device import with_pair
from vijax.runtime import xla

DEVICE = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=60.0, r=0.6)
GUESS = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=52.0, r=0.5)
PERIOD = 2 * np.pi / 10
ERROR = 1e-3 * PERIOD


@pytest.fixture(autouse=True)
def optimised(monkeypatch):
    """Optimise what a fit compiles, as it runs that thousands of times: a fifth less to wait."""
    options = xla.compiler_options
    monkeypatch.setattr(xla, "compiler_options", lambda **how: options(**how) | {"xla_backend_optimization_level": 1})


@pytest.fixture(scope="module")
def timed():
    return measured(DEVICE, 100, error=ERROR, seed=1)


@pytest.fixture(scope="module")
def fitted(timed):
    """The fit of those times from the guess."""
    return vijax.fit(timed.times, timed.sides, timing_error=ERROR, device=GUESS)


def pulls(found, **truth):
    return np.array([(found.values[name] - value) / found.stderr[name] for name, value in truth.items()])


def test_a_device_comes_back_from_its_times(timed, fitted):
    found = fitted
    assert found.converged
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3
    assert found.stderr["omega0"] < 0.05
    assert found.stderr["r"] < 2e-3
    assert 0.85 < found.misfit.size < 1.15
    assert 0.001 < found.misfit.p_value < 0.999
    assert abs(found.constancy.slope) < 3 * found.constancy.stderr
    assert not found.astray.any()
    assert found.untold == found.alternatives == ()
    np.testing.assert_allclose(found.speeds, timed.speeds, atol=0.01)
    assert float(found.device.omega0) == found.values["omega0"]
    assert "impacts left out: 0" in str(found)


def test_without_errors_it_is_exact():
    impacts = measured(DEVICE, 60)
    found = vijax.fit(impacts.times, impacts.sides, timing_error=1e-9, device=GUESS)
    assert found.values["omega0"] == pytest.approx(60.0, rel=1e-7)
    assert found.values["r"] == pytest.approx(0.6, rel=1e-7)


def test_speeds_add_to_what_is_known(timed, fitted):
    error = 0.01
    speeds = timed.speeds + error * np.random.default_rng(2).normal(size=timed.speeds.size)
    told = {"speed_error": error, "timing_error": ERROR, "device": GUESS}
    found = vijax.fit(timed.times, speeds=timed.sides * speeds, **told)
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3
    assert found.stderr["r"] < fitted.stderr["r"]
    assert found.misfit.freedom == fitted.misfit.freedom + timed.times.size - 1


def test_impacts_that_the_bench_missed_or_invented_are_left_out(timed):
    times, sides, false = with_faults(timed.times, timed.sides, missed=[60], false=[(151, 0.4, timed.sides[151])])
    found = vijax.fit(times, sides, timing_error=ERROR, device=GUESS)
    assert found.converged
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3
    assert np.flatnonzero(found.false).tolist() == false.tolist() == [151]
    assert np.flatnonzero(found.astray).tolist() == [59, 60, 151]
    assert np.isnan(found.residuals[151])
    assert "impacts left out: 3 of 257; false: 151" in str(found)


@pytest.mark.long
def test_many_faults_of_the_bench_are_found_at_once(timed):
    # Two false impacts follow each other, one is next to a missed impact, one is the last but one.
    last = timed.times.size - 2
    times, sides, false = with_faults(
        timed.times,
        timed.sides,
        missed=(70, 122, 123, 210),
        false=[(40, 0.3, 1.0), (40, 0.6, -1.0), (120, 0.5, 1.0), (last, 0.5, -1.0)],
    )
    found = vijax.fit(times, sides, timing_error=ERROR, device=GUESS)
    assert found.converged
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3
    assert set(np.flatnonzero(found.false)) >= set(false[:3])
    assert found.astray.sum() <= 14
    assert found.misfit.p_value > 0.001


@pytest.mark.long
def test_a_false_impact_does_not_lead_the_search_away():
    pair = vijax.impact_pair(d=0.256921516, kappa=58.7548623, r=0.61585343, gamma=-0.0484533)
    device = with_pair(vijax.Harvester(A=1.79495762790131, omega=35.819029154), pair)
    device = jax.tree.map(float, device)
    error = 1e-4 * 2 * np.pi / device.omega
    run = measured(device, 90, skip=9, error=error, start=(0.3 * 0.256921516, -0.3))
    times, sides, false = with_faults(run.times, run.sides, false=[(50, 0.4, run.sides[50])])
    guess = dataclasses.replace(device, omega0=1.03 * device.omega0, r=0.97 * device.r)
    found = vijax.fit(times, sides, timing_error=error, device=guess)
    assert found.converged
    assert np.flatnonzero(found.false).tolist() == false.tolist() == [51]
    assert np.abs(pulls(found, omega0=device.omega0, r=device.r)).max() < 3


@pytest.mark.long
def test_a_value_that_rests_on_one_false_impact_is_not_stated():
    # A motion of two kinds of impact does not tell four unknowns; these can adapt to a false impact, which then holds.
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
    found = vijax.fit(times, sides, timing_error=error, device=guess, unknown=unknown)
    for name in unknown:
        assert abs(found.values[name] - getattr(device, name)) < 3 * found.stderr[name]
    assert found.untold or found.false.any()


@pytest.mark.long
def test_a_wrong_speed_is_left_out(timed):
    error = 0.01
    speeds = timed.speeds + error * np.random.default_rng(2).normal(size=timed.speeds.size)
    speeds[30] += 0.3
    found = vijax.fit(timed.times, timed.sides, timing_error=ERROR, speeds=speeds, speed_error=error, device=GUESS)
    assert found.converged
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3
    assert found.misfit.p_value > 0.001
    assert np.flatnonzero(found.astray).tolist() == [30]


def test_units_of_pint(timed, fitted):
    # Not dropped: milliseconds are no seconds, and metres no times.
    ureg = pint.UnitRegistry()
    told = {"device": GUESS}
    with_units = vijax.fit(timed.times * 1e3 * ureg.ms, timed.sides, timing_error=ERROR * 1e6 * ureg.us, **told)
    assert with_units.values["r"] == pytest.approx(fitted.values["r"], rel=1e-6)
    with pytest.raises(ValueError, match="times must be in s"):
        vijax.fit(timed.times * ureg.m, timed.sides, timing_error=ERROR, **told)
    record = vijax.Record(np.arange(5) * 1e3 * ureg.ms, np.ones(5) * ureg.cm / ureg.s**2)
    assert record.step == pytest.approx(1.0)
    assert record.acceleration[0] == pytest.approx(0.01)


def test_a_fit_that_says_nothing_prints():
    # All but two equations of five impacts go aside with a gross error: there is no misfit of none.
    impacts = measured(DEVICE, 30)
    times = impacts.times[:5].copy()
    times[1] = (times[1] + times[2]) / 2
    found = vijax.fit(times, impacts.sides[:5], timing_error=ERROR, device=GUESS)
    assert "misfit" in str(found)
    assert not (found.converged and found.misfit.freedom < 1)
    assert found.report()["misfit"]["freedom"] == found.misfit.freedom


@pytest.mark.long
def test_errors_that_are_larger_than_was_said_are_those_of_the_values_too(timed):
    right = vijax.fit(timed.times, timed.sides, timing_error=ERROR, device=GUESS)
    bold = vijax.fit(timed.times, timed.sides, timing_error=ERROR / 4, device=GUESS)
    assert bold.misfit.size == pytest.approx(4 * right.misfit.size, rel=0.15)
    assert bold.misfit.p_value < 1e-6
    assert bold.stderr["r"] == pytest.approx(right.stderr["r"] * right.misfit.size, rel=0.3)
    assert bold.converged
    # Of errors that are larger by far no device is said to be found.
    assert not vijax.fit(timed.times, timed.sides, timing_error=ERROR / 16, device=GUESS).converged


@pytest.mark.long
def test_a_sum_that_rises_more_slowly_than_its_derivatives_say_widens_the_errors(monkeypatch):
    impacts = measured(DEVICE, 60, wall="rigid", error=ERROR, seed=4)
    told = {"timing_error": ERROR, "device": DEVICE, "unknown": ("s", "r"), "wall": "rigid"}
    plain = vijax.fit(impacts.times, impacts.sides, **told)
    # Two standard errors off it rises by 4. Where by 1, they are one.
    monkeypatch.setattr(errors, "beside", lambda _task, _sure, shift, _others: (1.0, 0.0 * shift))
    wider = vijax.fit(impacts.times, impacts.sides, **told)
    assert wider.stderr["r"] == pytest.approx(2 * plain.stderr["r"], rel=1e-6)


@pytest.mark.long
def test_a_value_that_runs_to_its_limit_is_not_told():
    # One kind of impact cannot tell four unknowns: r runs to 1, where nothing is lost.
    device = vijax.Harvester(s=0.08, omega=10.0, A=3.0, r=0.4)
    impacts = measured(device, 150, wall="rigid", error=ERROR, skip=180, seed=1)
    unknown = ("r", "s", "beta", "delay")
    found = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=device, unknown=unknown, wall="rigid")
    assert found.untold
    assert found.stderr["r"] == np.inf


@pytest.mark.long
def test_of_devices_that_fit_as_well_the_nearest_to_what_was_known_is_taken():
    # A motion of few kinds of impact has two devices, which differ by a factor of two in stiffness.
    pair = vijax.impact_pair(d=0.2619, kappa=9.993, r=0.6963, gamma=0.0396)
    device = jax.tree.map(float, with_pair(vijax.Harvester(), pair))
    impacts = measured(device, 150, skip=60, error=2e-3, seed=3)
    ends = []
    for stiffness, r in ((0.9, 0.65), (2.2, 0.93)):
        guess = dataclasses.replace(device, omega0=device.omega0 * stiffness, r=r)
        found = vijax.fit(impacts.times, impacts.sides, timing_error=2e-3, device=guess)
        assert found.converged
        ends.append(found)
    near, far = ends
    assert abs(near.values["omega0"] - device.omega0) < 4 * near.stderr["omega0"]
    assert far.values["omega0"] > 1.5 * device.omega0
    assert abs(near.misfit.chi2 - far.misfit.chi2) < 9
    others = [other["omega0"] for other in (*near.alternatives, *far.alternatives)]
    assert others


def test_what_cannot_be_told_apart_is_named():
    # Times alone have no unit of length: a device twice as large, shaken twice as hard, has the same impacts.
    impacts = measured(DEVICE, 80, wall="rigid", error=ERROR, seed=4)
    told = {"timing_error": ERROR, "device": DEVICE, "unknown": ("r", "s", "A"), "wall": "rigid"}
    found = vijax.fit(impacts.times, impacts.sides, **told)
    assert found.untold == (("s", "A"),)
    assert found.stderr["s"] == found.stderr["A"] == np.inf
    assert abs(found.values["r"] - 0.6) < 3 * found.stderr["r"] < 0.05
    assert np.isnan(found.correlation[1, 2])
    assert "s and A cannot be told apart from these data" in str(found)
    # A speed has one.
    with_speeds = vijax.fit(impacts.times, impacts.sides, speeds=impacts.speeds, speed_error=1e-3, **told)
    assert with_speeds.untold == ()
    assert np.abs(pulls(with_speeds, r=0.6, s=0.02, A=3.0)).max() < 3


@pytest.mark.long
def test_a_motion_of_one_kind_of_impact_does_not_tell_two_unknowns():
    # On level ground both impacts of a 1:1 motion are alike: one equation for stiffness and restitution.
    device = vijax.Harvester(s=0.08, omega=10.0, A=3.0, omega0=60.0, r=0.4)
    impacts = measured(device, 120, error=ERROR, skip=100)
    assert np.ptp(impacts.speeds) < 1e-6
    found = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=device)
    assert found.untold
    assert found.stderr["omega0"] == np.inf
    # Nor do impacts of one speed tell whether restitution hangs on it.
    assert found.constancy.stderr > 1


@pytest.mark.long
def test_rigid_walls():
    impacts = measured(DEVICE, 80, wall="rigid", error=ERROR, seed=4)
    found = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=GUESS, unknown=("s", "r"), wall="rigid")
    assert np.abs(pulls(found, s=0.02, r=0.6)).max() < 3


@pytest.mark.long
def test_two_walls_and_a_clock_that_is_late():
    impacts = measured(SIDES, 60, wall="rigid", error=ERROR, seed=5)
    unknown = ("r_left", "r_right", "delay")
    told = {"timing_error": ERROR, "device": SIDES, "unknown": unknown, "wall": "rigid"}
    found = vijax.fit(impacts.times + 0.28, impacts.sides, **told)
    assert found.converged
    assert np.abs(pulls(found, r_left=0.6, r_right=0.5, delay=0.28)).max() < 3


@pytest.mark.long
def test_two_membranes_and_a_clock_that_is_late():
    impacts = measured(SIDES, 60, error=ERROR, seed=5)
    unknown = ("omega0_left", "r_right", "delay")
    found = vijax.fit(impacts.times + 0.2, impacts.sides, timing_error=ERROR, device=SIDES, unknown=unknown)
    assert found.converged
    assert np.abs(pulls(found, omega0_left=60.0, r_right=0.5, delay=0.2)).max() < 3


@pytest.mark.long
def test_a_measured_record_on_its_own_clock():
    time = 3.0 + np.arange(0, 40, 0.02)
    shake = 3 * np.cos(10 * time) + np.random.default_rng(6).normal(size=time.size) * 0.2
    record = vijax.Record(time, shake)
    impacts = measured(DEVICE, 40, excitation=record.waveform(DEVICE), error=ERROR, seed=7)
    found = vijax.fit(impacts.times + 3.0, impacts.sides, record, timing_error=ERROR, device=GUESS)
    assert found.converged
    assert np.abs(pulls(found, omega0=60.0, r=0.6)).max() < 3


def test_restitution_that_hangs_on_speed_is_noticed():
    # Faster impacts lose more: r falls by 0.1 from one end of the speeds to the other.
    impacts = measured_one_by_one(DEVICE, 120, lambda speed: 0.65 - 0.25 * speed, error=ERROR, seed=8)
    found = vijax.fit(impacts.times, impacts.sides, timing_error=ERROR, device=GUESS)
    assert found.constancy.p_value < 1e-6
    assert found.constancy.slope == pytest.approx(-0.25, abs=0.08)
    assert "restitution: hangs on speed" in str(found)


GOOD = {"times": [0.0, 0.3, 0.7, 1.1, 1.5, 2.0], "sides": [1, -1, 1, -1, 1, -1], "timing_error": 1e-3}


@pytest.mark.parametrize(
    ("wrong", "says"),
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
        ({"wall": "rigid"}, "unknown must be told by rigid walls; got omega0"),
        ({"excitation": vijax.Harmonics() + vijax.Noise(0.1, 8)}, "excitation must be known; got noise"),
        ({"excitation": vijax.Record([0.0, 0.1, 0.2], [1.0, 0.0, 1.0])}, "times must lie within the record"),
        (
            {"excitation": vijax.Record([0.0, 0.1, 0.2], [1.0, 0.0, 1.0], looped=True), "unknown": "omega"},
            "unknown must be told by the motion; got omega",
        ),
        ({"unknown": ("delay", "delay")}, "unknown must name a quantity once; got delay and delay"),
        ({"wall": "rigid_left", "unknown": "omega0_left"}, "unknown must be told by rigid walls; got omega0_left"),
        ({"sides": None, "speeds": np.ones(6), "speed_error": 0.1}, "speeds must be velocities, negative at the left"),
        ({"speeds": [-1, 1, 1, -1, 1, -1], "speed_error": 0.1}, "speeds must have the signs of sides, or none; got -1"),
        ({"times": []}, "times must be one number an impact, of at least 4; got none"),
        ({"device": SIDES, "unknown": "r"}, "unknown must name r_left or r_right, or both"),
    ],
)
def test_bad_input_says_what_must_hold(wrong, says):
    with pytest.raises(ValueError, match=says):
        vijax.fit(**GOOD | wrong)
