"""Orbits, steady states and branches under several harmonics, against the sine and simulations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from tests.helpers import Plain, refusals
from vijax.impact.forcing import excitation_attributes, with_harmonics
from vijax.model.records import Status
from vijax.orbits import flights, orbit_search, periodic, symmetry

PAIR = vijax.impact_pair(0.2, 40.0, 0.5, 0.02)
LEVEL = vijax.impact_pair(0.2, 40.0, 0.5)
DEVICE = vijax.Harvester()
THREE_HARMONICS = vijax.Harmonics([1.0, 0.3, 0.1], [0.0, 0.7, -1.0])
ODD_HARMONICS = vijax.Harmonics([1.0, 0.0, 0.2], [0.0, 0.0, 1.0])
IMPACTS = "t", "v_in", "v_out", "depth", "duration"


@pytest.fixture(scope="module")
def attractor():
    """Return the attractor under three harmonics, from the end of a simulation."""
    return vijax.orbits_from_states(PAIR, 0.0, 0.1, settle=100, excitation=THREE_HARMONICS)


def test_single_harmonic_is_the_sine():
    sine = vijax.find_orbits(PAIR, "LR", guesses=64)
    harmonic = vijax.find_orbits(PAIR, "LR", guesses=64, excitation=vijax.Harmonics())
    assert harmonic.pair.waves is None
    np.testing.assert_array_equal(harmonic.impact_unknowns, sine.impact_unknowns)
    # A forcing that differs from the sine by rounding is a sum of harmonics: other searches and other sums.
    nearly = vijax.find_orbits(PAIR, "LR", guesses=64, excitation=vijax.Harmonics([1.0, 1e-15]))
    assert nearly.pair.waves is not None
    assert len(nearly) == len(sine) == 3
    for name in ("impact_unknowns", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(nearly, name), getattr(sine, name), rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    "kappa",
    [40.0, pytest.param(None, marks=pytest.mark.long), pytest.param(vijax.Sides(40.0, None), marks=pytest.mark.long)],
    ids=["soft", "rigid", "one rigid"],
)
def test_orbit_from_a_start_is_the_simulated_attractor(kappa):
    pair = vijax.impact_pair(0.2, kappa, 0.5, 0.02)
    orbit = vijax.orbits_from_states(pair, 0.0, 0.1, settle=200, excitation=THREE_HARMONICS)
    assert orbit.status[0] == Status.OK
    assert np.abs(orbit.multipliers).max() < 1
    run = vijax.trajectory(pair, 0.0, 0.1, 400, excitation=THREE_HARMONICS)
    last = slice(int(run.filled) - int(orbit.count[0]), int(run.filled))
    impacts = vijax.orbit_impacts(orbit)
    for name in IMPACTS:
        simulated, expected = (np.ravel(getattr(run.impacts, name)[last]), np.ravel(getattr(impacts, name)))
        np.testing.assert_allclose(
            np.sort(simulated), np.sort(expected)[: simulated.size], rtol=0, atol=1e-12, err_msg=name
        )
    # The simulation integrates the energy of an impact; the orbit has a closed form.
    work = np.ravel(impacts.work)[: len(np.ravel(run.impacts.work[last]))]
    np.testing.assert_allclose(np.sort(np.ravel(run.impacts.work[last])), np.sort(work), rtol=1e-11)


@pytest.mark.long
def test_search_returns_the_attractor_and_a_repelling_orbit(attractor):
    label = "".join("L" if side < 0 else "R" for side in np.asarray(attractor.sequence.side)[0] if side)
    orbits = vijax.find_orbits(PAIR, label, guesses=256, excitation=THREE_HARMONICS)
    signature = vijax.orbits.orbit_properties.orbit_signature
    assert np.abs(signature(orbits) - signature(attractor)).max(axis=1).min() < 1e-9
    repelling = vijax.find_orbits(PAIR, "LR", guesses=256, excitation=THREE_HARMONICS)
    assert np.abs(repelling.multipliers).max() > 1
    # The deviation from the repelling orbit grows by its largest multiplier in one period.
    (clock, u, v), offset = vijax.orbit_path(repelling), 1e-7
    start = int(np.nanargmin(np.abs(np.asarray(clock)[0] % 2 - 1)))
    begin = float(np.asarray(clock)[0, start]) % 2
    runs = vijax.trajectory(
        PAIR, [u[0, start], u[0, start] + offset], [v[0, start]] * 2, 8, begin, excitation=THREE_HARMONICS
    )
    distance = np.hypot(*(np.diff(np.asarray(leaf), axis=0)[0] for leaf in (runs.states.u, runs.states.v)))
    growth = np.abs(np.asarray(repelling.multipliers)).max()
    assert distance[5] / distance[4] == pytest.approx(growth, rel=1e-3)


@pytest.mark.long
def test_shifted_phases_of_the_harmonics_shift_the_orbit_in_time(attractor):
    shift = 0.37
    later = vijax.Harmonics(
        THREE_HARMONICS.amplitudes, [p + (k + 1) * np.pi * shift for k, p in enumerate(THREE_HARMONICS.phases)]
    )
    impact_unknowns = np.asarray(attractor.impact_unknowns) - np.array([shift, 0.0, 0.0])
    moved = periodic.solve(with_harmonics(attractor.pair, later), attractor.sequence, impact_unknowns)
    assert moved.status[0] == Status.OK
    difference = (np.asarray(moved.impact_unknowns) - impact_unknowns)[0, :3] / np.array([2.0, 1.0, 1.0])
    np.testing.assert_allclose(difference - np.round(difference[:1]), 0.0, atol=1e-12)
    np.testing.assert_allclose(moved.work, attractor.work, rtol=1e-12)


@pytest.mark.long
def test_steady_state_has_the_power_of_the_map(attractor):
    state = vijax.steady(DEVICE, attractor[0], pair=PAIR)
    dataset = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.02, excitation=THREE_HARMONICS)
    assert state.status == Status.OK
    assert float(state.P) == pytest.approx(float(dataset.P), rel=1e-12)
    assert float(vijax.orbit_power(attractor, DEVICE)[0]) == pytest.approx(float(dataset.P), rel=1e-12)
    work = np.asarray(attractor.work)[0, :3] * float(DEVICE.m_b * DEVICE.speed_unit**2)
    np.testing.assert_allclose(np.asarray(state.work)[:3], work, rtol=1e-12)


def test_derivatives_match_finite_differences(attractor):
    def power(pair):
        return vijax.steady(DEVICE, attractor[0], pair=pair).P

    slopes = jax.grad(power)(PAIR)
    for name, h in (("d", 1e-4), ("kappa", 4e-3), ("r", 1e-4), ("gamma", 1e-5)):
        powers = [power(replace(PAIR, **{name: getattr(PAIR, name) + n * h})) for n in (-2, -1, 1, 2)]
        difference = float(powers[0] - 8 * powers[1] + 8 * powers[2] - powers[3]) / (12 * h)
        assert float(getattr(slopes, name)) == pytest.approx(difference, rel=1e-7), name


@pytest.mark.long
def test_derivative_by_a_harmonic_matches_finite_differences(attractor):
    """The derivative is the effect of the second harmonic on the power."""
    pair = attractor[0].pair

    def power(second):
        first, wave, third = pair.waves
        return vijax.steady(DEVICE, attractor[0], pair=replace(pair, waves=(first, replace(wave, c=second), third))).P

    slope, h = float(jax.grad(power)(pair.waves[1].c)), 1e-4
    high, low = (float(power(pair.waves[1].c + sign * h)) for sign in (1, -1))
    assert slope == pytest.approx((high - low) / (2 * h), rel=1e-5)


@pytest.mark.long
def test_orbits_scale_with_the_amplitude_of_the_forcing():
    """At five times the amplitude all lengths, speeds and guesses of speeds are five times as large."""
    small = vijax.find_orbits(PAIR, "LR", guesses=64)
    wide = vijax.impact_pair(5 * 0.2, 40.0, 0.5, 5 * 0.02)
    large = vijax.find_orbits(wide, "LR", guesses=64, excitation=vijax.Harmonics([5.0]))
    assert len(large) == len(small) == 3
    scale = np.array([1.0, 5.0, 1.0])
    np.testing.assert_allclose(
        np.sort(large.impact_unknowns / scale, axis=0), np.sort(small.impact_unknowns, axis=0), rtol=0, atol=1e-11
    )
    assert orbit_search._relative_forcing_speed(with_harmonics(wide, vijax.Harmonics([5.0, 2.0]))) == pytest.approx(6.0)
    assert orbit_search._relative_forcing_speed(with_harmonics(wide, vijax.Harmonics([0.1]))) == 1.0


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_nearest_turning_point_of_a_flight_matches_a_scan(seed):
    generator = np.random.default_rng(seed)
    pair, side, speed, t = (
        with_harmonics(PAIR, THREE_HARMONICS),
        -1.0,
        generator.uniform(0.1, 0.4),
        generator.uniform(0, 2),
    )
    s = np.linspace(0, 2, 200_001)
    rise, v = (np.asarray(x) for x in flights.advance_flight(pair, jnp.asarray(t), speed, jnp.asarray(s)))
    turns = np.flatnonzero(v[:-1] * v[1:] < 0)
    assert turns.size > 0
    ahead = np.sign(v[turns])
    clearances = 0.1 - ahead * (-0.1 + rise[turns])
    arguments = (jnp.asarray(x) for x in (side, speed, t, 2.0, True, np.nan))
    clearance, when = flights.nearest_turning_point(pair, *arguments)
    if clearances.min() < 1:
        assert float(clearance) == pytest.approx(clearances.min(), abs=1e-9)
        assert float(when) == pytest.approx(s[turns[clearances.argmin()]], abs=2e-5)


def test_attributes_contain_the_specified_harmonics():
    assert excitation_attributes(with_harmonics(PAIR, THREE_HARMONICS)) == {"excitation": str(THREE_HARMONICS)}
    assert excitation_attributes(PAIR) == {}


def test_level_pair_is_symmetric_only_under_odd_harmonics():
    assert bool(with_harmonics(LEVEL, ODD_HARMONICS).symmetric)
    assert not bool(with_harmonics(LEVEL, THREE_HARMONICS).symmetric)
    assert not bool(with_harmonics(PAIR, ODD_HARMONICS).symmetric)


@pytest.mark.long
def test_mirror_images_are_orbits_only_under_odd_harmonics():
    odd, general = (
        vijax.find_orbits(LEVEL, "LR", guesses=64, excitation=excitation)
        for excitation in (ODD_HARMONICS, THREE_HARMONICS)
    )
    assert symmetry.is_symmetric(odd).tolist() == [True]
    assert not symmetry.is_symmetric(general).any()
    half = symmetry.close_half_way(odd)
    assert half.count.tolist() == [1]
    np.testing.assert_allclose(half.multipliers, odd.multipliers, rtol=1e-10)
    np.testing.assert_allclose(
        symmetry.unfold(half).impact_unknowns[..., 1:], odd.impact_unknowns[..., 1:], rtol=0, atol=1e-12
    )
    assert float(vijax.steady(DEVICE, half[0], pair=LEVEL).P) == pytest.approx(
        float(vijax.orbit_power(odd, DEVICE)[0]), rel=1e-12
    )


@pytest.mark.long
def test_orbit_that_crosses_the_other_wall_is_virtual():
    wide = vijax.find_orbits(vijax.impact_pair(0.9, 40.0, 0.5, 0.2), "L", guesses=64, excitation=THREE_HARMONICS)
    assert (np.asarray(wide.status) == Status.OK).all()
    assert len(wide) > 0
    narrow = replace(wide.pair, d=jnp.full(len(wide), 0.02))
    verified = periodic.verify_solutions(narrow, wide.sequence, wide.impact_unknowns)
    assert (np.asarray(verified.status) == Status.VIRTUAL).all()


@pytest.mark.long
def test_user_defined_linear_law_has_the_orbits_under_harmonics():
    closed, stepped = (
        vijax.find_orbits(PAIR, "LR", guesses=64, membrane=law, excitation=THREE_HARMONICS) for law in (None, Plain())
    )
    assert len(closed) == len(stepped) == 1
    for name in ("impact_unknowns", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(stepped, name), getattr(closed, name), rtol=0, atol=1e-11, err_msg=name)


@pytest.mark.long
def test_branch_flips_where_simulations_double_their_period(attractor):
    (branch,) = vijax.follow_orbits(attractor, "d", (0.1, 0.22))
    flips = [float(point.value) for point in branch.points if point.kind == "flip"]
    assert flips[-1] == pytest.approx(0.1212797, abs=1e-7)
    dataset = vijax.sweep(
        d=flips[-1] + np.array([-2e-4, 2e-4]), kappa=40.0, r=0.5, gamma=0.02, excitation=THREE_HARMONICS, periods=4000
    )
    assert dataset.period.values.ravel().tolist() == [2, 1]
    attribute = vijax.branch_dataset([branch]).attrs["excitation"]
    assert attribute == str(THREE_HARMONICS)


@pytest.mark.long
def test_curve_of_flips_is_where_simulations_double_their_period(attractor):
    (branch,) = vijax.follow_orbits(attractor, "d", (0.115, 0.22))
    flip = [point for point in branch.points if point.kind == "flip"][-1]
    (curve,) = vijax.follow_curves([flip], "d", {"d": (0.11, 0.14), "r": (0.45, 0.55)})
    row = int(np.argmin(np.abs(curve.values[:, 1] - 0.52)))
    d, r = curve.values[row]
    dataset = vijax.sweep(
        d=d + np.array([-3e-4, 3e-4]), kappa=40.0, r=r, gamma=0.02, excitation=THREE_HARMONICS, periods=4000
    )
    assert dataset.period.values.ravel().tolist() == [2, 1]


@pytest.mark.parametrize(
    ("excitation", "message"),
    [
        (vijax.Harmonics() + vijax.Noise(0.1, 8), "excitation must repeat every period, .* got harmonics 1.0 . noise"),
        (vijax.Waveform(np.zeros(8), 4), "excitation must repeat every period"),
        (vijax.Harmonics([1.0]) + vijax.Harmonics([-1.0]), "excitation must not cancel"),
        (3.0, "excitation must be of the kind Excitation; got 3.0"),
    ],
)
def test_excitations_that_do_not_repeat_raise(excitation, message):
    for call in (
        lambda: vijax.find_orbits(PAIR, "LR", excitation=excitation),
        lambda: vijax.orbits_from_states(PAIR, 0.0, 0.1, excitation=excitation),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_functions_of_the_sine_reject_an_orbit_with_harmonics(attractor):
    for error in refusals(attractor[0].pair):
        assert "pair must know of no harmonics here; got some; give them as excitation=" in error


@pytest.mark.long
def test_simulation_with_a_user_defined_law_converges_to_the_orbit(attractor):
    orbit = vijax.orbits_from_states(PAIR, 0.0, 0.1, settle=100, membrane=Plain(), excitation=THREE_HARMONICS)
    assert orbit.status[0] == Status.OK
    np.testing.assert_allclose(
        np.asarray(orbit.impact_unknowns)[0, :3], np.asarray(attractor.impact_unknowns)[0, :3], rtol=0, atol=1e-10
    )
