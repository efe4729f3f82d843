"""The equations between impact times: they hold on motions of the engines, and their derivatives are right."""

import jax
import numpy as np
import pytest

import vijax
from tests.fitting.bench import SIDES, measured
from vijax.fitting import unknowns
from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Ends, Restitution, guessed_motions, interval
from vijax.fitting.mismatch import least_chain, linearised
from vijax.fitting.series import Series
from vijax.fitting.shaking import shaking

# Every kind of push at once: a harmonic besides the sine's, and samples that make a knot in every contact.
ROUGH = vijax.Harmonics([0.0, 0.4], [0.0, 1.0]) + vijax.Waveform(
    np.random.default_rng(7).normal(size=401) * 0.5 + 1.2 * np.cos(np.pi * np.arange(401) / 10), 20.0
)
SCENES = {
    "the sine": (vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=60.0, r=0.6), None, "soft", ("omega0", "r")),
    # A ball that stays in a membrane for more than three half turns, on the verge of leaving it sooner.
    "slow": (vijax.Harvester(s=0.012, omega=11.25, A=4.24, omega0=49.54, r=0.724), None, "soft", ("omega0", "r")),
    "rigid": (vijax.Harvester(s=0.02, omega=10.0, A=3.0, r=0.6, beta=0.01), None, "rigid", ("s", "r")),
    "all at once": (SIDES, ROUGH, "soft", ("kappa_left", "r_right", "gamma", "A")),
}


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    device, excitation, wall, names = SCENES[request.param]
    impacts = measured(device, 120 if request.param == "slow" else 40, excitation=excitation, wall=wall)
    longest = 2 * float(np.diff(impacts.times).max() * device.omega / np.pi)
    known = jax.tree.map(np.asarray, device)
    shape = jax.tree.map(np.asarray, shaking(excitation, longest, 5.0))
    model = FitModel(known, names, wall, shape, unknowns.limits(device, names))
    series = Series(impacts.times, impacts.sides, impacts.speeds, 1e-3, 1e-3)
    return model, series, unknowns.known(device, names)


def about(scene, z=None, times=None):
    model, series, known = scene
    asked = model, series, known if z is None else z, series.times if times is None else times
    return linearised(*asked)


def test_they_hold_on_a_motion_of_the_engine(scene):
    linear = about(scene)
    model, series, _ = scene
    # What two intervals say of an impact, and a speed that was measured, agree to rounding; none is missed.
    told = linear.answered & (np.abs(linear.off) < 1e-9)
    # Of several ways from an impact to the next that of the ball is taken, under a rough push almost always.
    assert told.mean() > (0.98 if model.shaking.sampled else 0.999)
    # On the verge of leaving, a contact multiplies rounding.
    assert np.abs(linear.off[told]).max() < 1e-11
    assert np.median(np.abs(linear.off)) < 1e-13
    assert linear.outside.max() <= 1e-9
    assert linear.off.size == series.equations


# Onsets in half periods, and speeds, of contacts beside whose motion there is another that all but agrees with it.
CLOSE = np.meshgrid(np.linspace(1.59, 1.61, 15), np.linspace(0.088, 0.1, 15))
# And of those after which the ball comes back to the same wall at once.
BRIEF = [[1.50371681, 1.80588092, 1.34429923], [0.11902198, 0.11063276, 0.03665731]]


@pytest.mark.parametrize("onsets", [CLOSE, BRIEF], ids=["close motions", "brief flights"])
def test_no_motion_to_the_next_impact_is_missed(onsets):
    device, _, wall, _ = SCENES["slow"]
    pair, push = device.pair(wall), shaking(None, 6.0, 5.0)
    t, speed = (np.ravel(numbers) for numbers in onsets)
    after = vijax.trajectory(pair, 0.5 * pair.d, speed, 3, t).impacts
    n, next_t, next_side = (np.asarray(leaf, float)[:, 0] for leaf in (after.n, after.t, after.side))

    def speeds(*told):
        ends, none = Ends(np.asarray(1.0), *told), Restitution(np.asarray(0.0), np.asarray(0.0))
        near, _ = guessed_motions(pair, push, ends)
        return jax.vmap(lambda one: interval(pair, push, none, ends, one).speed)(near)

    each = jax.vmap(speeds)
    off = np.abs(np.asarray(jax.jit(each)(next_side, t, 2 * n + next_t)) - speed[:, None])
    assert np.nanmin(off, axis=1).max() < 1e-9


@pytest.mark.parametrize("scene", ["the sine", "rigid", "all at once"], indirect=True)
def test_derivatives_by_times_and_unknowns(scene):
    _, series, z = scene
    linear = about(scene)
    rng = np.random.default_rng(3)
    smooth = linear.answered & (np.abs(linear.off) < 1e-9)
    for _ in range(2):
        by_z, by_t, h = rng.normal(size=z.size), rng.normal(size=series.times.size), 1e-7
        up, down = (about(scene, z + sign * h * by_z, series.times + sign * h * by_t).off for sign in (1, -1))
        slope = linear.by_unknown @ by_z + linear.by_time @ by_t
        off = (np.abs((up - down) / (2 * h) - slope) / (1 + np.abs(slope)))[smooth]
        # The differences are off by the curvature, which slow impacts have much of.
        assert np.median(off) < 1e-6
        assert off.max() < 3e-4


@pytest.mark.parametrize("scene", ["the sine", "rigid"], indirect=True)
def test_offset_and_slope_are_those_of_restitution(scene):
    model, _, _ = scene
    linear = about(scene)
    r = float(model.device.r)
    by_r = linear.by_unknown[:, model.names.index("r")] / r
    np.testing.assert_allclose(linear.by_restitution[:, 0], by_r, atol=1e-9 * np.abs(by_r).max())
    # Of the speed of an impact both hang on the same r, at one speed.
    every, speeds = linear.by_restitution, linear.speeds[linear.impact]
    about_speed = linear.own_variance > 0
    np.testing.assert_allclose(every[about_speed, 1], (every[:, 0] * speeds)[about_speed], rtol=1e-6)


def test_the_chain_of_motions_that_agree_best_is_taken():
    # The first motion of the middle interval is as good by itself, but does not fit what comes before and after.
    speeds = np.array([[0.3, np.nan], [0.5, 0.2], [0.4, 0.9]])
    arrivals = np.array([[0.2, np.nan], [0.9, 0.4], [0.1, 0.1]])
    own = np.where(np.isnan(speeds), 10.0, 0.0)
    np.testing.assert_array_equal(least_chain(speeds, arrivals, own), [0, 1, 0])
    # Unless that costs more than it is off: then the last one is taken that fits the first.
    own[1, 1] = 1.0
    np.testing.assert_array_equal(least_chain(speeds, arrivals, own), [0, 0, 1])
