"""The equations between impact times hold on simulated motions, and their derivatives are right."""

import jax
import numpy as np
import pytest

import vijax
from tests.fitting.bench import SIDES, measured
from vijax.fitting import unknowns
from vijax.fitting.fit_excitation import fit_excitation
from vijax.fitting.fit_model import FitModel
from vijax.fitting.interval import Ends, Restitution, guess_motions, interval
from vijax.fitting.series import Series
from vijax.fitting.time_equations import least_chain, linearise

# All kinds of forcing together: a harmonic besides the sine, and samples with a knot in all contacts.
ROUGH_FORCING = vijax.Harmonics([0.0, 0.4], [0.0, 1.0]) + vijax.Waveform(
    np.random.default_rng(7).normal(size=401) * 0.5 + 1.2 * np.cos(np.pi * np.arange(401) / 10), 20.0
)
CASES = {
    "the sine": (vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=60.0, r=0.6), None, "soft", ("omega0", "r")),
    # The ball is in contact for more than three half oscillations and nearly leaves earlier.
    "slow": (vijax.Harvester(s=0.012, omega=11.25, A=4.24, omega0=49.54, r=0.724), None, "soft", ("omega0", "r")),
    "rigid": (vijax.Harvester(s=0.02, omega=10.0, A=3.0, r=0.6, beta=0.01), None, "rigid", ("s", "r")),
    "all at once": (SIDES, ROUGH_FORCING, "soft", ("kappa_left", "r_right", "gamma", "A")),
}


@pytest.fixture(scope="module", params=CASES)
def scene(request):
    device, excitation, wall, names = CASES[request.param]
    impacts = measured(device, 120 if request.param == "slow" else 40, excitation=excitation, wall=wall)
    longest = 2 * float(np.diff(impacts.times).max() * device.omega / np.pi)
    array_device = jax.tree.map(np.asarray, device)
    shape = jax.tree.map(np.asarray, fit_excitation(excitation, longest, 5.0))
    model = FitModel(array_device, names, wall, shape, unknowns.limits(device, names))
    series = Series(impacts.times, impacts.sides, impacts.speeds, 1e-3, 1e-3)
    return model, series, unknowns.variables_of_device(device, names)


def linearised(scene, z=None, times=None):
    model, series, variables = scene
    arguments = model, series, variables if z is None else z, series.times if times is None else times
    return linearise(*arguments)


def test_equations_hold_on_simulated_motions(scene):
    linear = linearised(scene)
    model, series, _ = scene
    # The speeds from two intervals and the measured speed of an impact agree to rounding; no motion is missed.
    accurate = linear.has_motion & (np.abs(linear.equation_residuals) < 1e-9)
    # Of several motions to the next impact the simulated motion is selected; under rough forcing, almost always.
    assert accurate.mean() > (0.98 if model.excitation.sampled else 0.999)
    # A contact that nearly ends earlier amplifies rounding.
    assert np.abs(linear.equation_residuals[accurate]).max() < 1e-11
    assert np.median(np.abs(linear.equation_residuals)) < 1e-13
    assert linear.outside.max() <= 1e-9
    assert linear.equation_residuals.size == series.equations


# Onsets in half periods, and speeds, of contacts with a second motion close to the simulated motion.
CLOSE = np.meshgrid(np.linspace(1.59, 1.61, 15), np.linspace(0.088, 0.1, 15))
# Onsets and speeds of contacts after which the ball returns to the same wall immediately.
BRIEF = [[1.50371681, 1.80588092, 1.34429923], [0.11902198, 0.11063276, 0.03665731]]


@pytest.mark.parametrize("onsets", [CLOSE, BRIEF], ids=["close motions", "brief flights"])
def test_no_motion_to_the_next_impact_is_missed(onsets):
    device, _, wall, _ = CASES["slow"]
    pair, forcing = device.pair(wall), fit_excitation(None, 6.0, 5.0)
    t, speed = (np.ravel(numbers) for numbers in onsets)
    after = vijax.trajectory(pair, 0.5 * pair.d, speed, 3, t).impacts
    n, next_t, next_side = (np.asarray(leaf, float)[:, 0] for leaf in (after.n, after.t, after.side))

    def speeds(*end_values):
        ends, none = Ends(np.asarray(1.0), *end_values), Restitution(np.asarray(0.0), np.asarray(0.0))
        near, _ = guess_motions(pair, forcing, ends)
        return jax.vmap(lambda guess: interval(pair, forcing, none, ends, guess).speed)(near)

    batched_speeds = jax.vmap(speeds)
    off = np.abs(np.asarray(jax.jit(batched_speeds)(next_side, t, 2 * n + next_t)) - speed[:, None])
    assert np.nanmin(off, axis=1).max() < 1e-9


@pytest.mark.parametrize("scene", ["the sine", "rigid", "all at once"], indirect=True)
def test_derivatives_by_times_and_unknowns_agree_with_differences(scene):
    _, series, z = scene
    linear = linearised(scene)
    rng = np.random.default_rng(3)
    smooth = linear.has_motion & (np.abs(linear.equation_residuals) < 1e-9)
    for _ in range(2):
        by_z, by_t, h = rng.normal(size=z.size), rng.normal(size=series.times.size), 1e-7
        up, down = (
            linearised(scene, z + sign * h * by_z, series.times + sign * h * by_t).equation_residuals
            for sign in (1, -1)
        )
        slope = linear.by_unknown @ by_z + linear.by_time @ by_t
        off = (np.abs((up - down) / (2 * h) - slope) / (1 + np.abs(slope)))[smooth]
        # The error of the differences grows with the curvature, which is large for slow impacts.
        assert np.median(off) < 1e-6
        assert off.max() < 3e-4


@pytest.mark.parametrize("scene", ["the sine", "rigid"], indirect=True)
def test_derivatives_by_restitution_agree_with_the_unknown_r(scene):
    model, _, _ = scene
    linear = linearised(scene)
    r = float(model.device.r)
    by_r = linear.by_unknown[:, model.names.index("r")] / r
    np.testing.assert_allclose(linear.by_restitution[:, 0], by_r, atol=1e-9 * np.abs(by_r).max())
    # In an equation for the speed of an impact, r occurs at this speed alone.
    derivatives, speeds = linear.by_restitution, linear.speeds[linear.impact]
    about_speed = linear.extra_variance > 0
    np.testing.assert_allclose(derivatives[about_speed, 1], (derivatives[:, 0] * speeds)[about_speed], rtol=1e-6)


def test_chain_of_motions_with_the_best_agreement_is_selected():
    # The first motion of the middle interval has the same cost but does not agree with the intervals around it.
    speeds = np.array([[0.3, np.nan], [0.5, 0.2], [0.4, 0.9]])
    arrivals = np.array([[0.2, np.nan], [0.9, 0.4], [0.1, 0.1]])
    costs = np.where(np.isnan(speeds), 10.0, 0.0)
    np.testing.assert_array_equal(least_chain(speeds, arrivals, costs), [0, 1, 0])
    # If the second motion costs more than the disagreement, the first motion and the last that fits it are selected.
    costs[1, 1] = 1.0
    np.testing.assert_array_equal(least_chain(speeds, arrivals, costs), [0, 0, 1])
