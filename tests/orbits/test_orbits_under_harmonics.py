"""Orbits, steady states and branches under several harmonics: the sine as one of them, and what runs come to."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from tests.helpers import Plain, refusals
from vijax.engine.forcing import told_harmonics, with_harmonics
from vijax.model.records import Status
from vijax.orbits import flights, orbit_search, periodic, symmetry

PAIR = vijax.impact_pair(0.2, 40.0, 0.5, 0.02)
LEVEL = vijax.impact_pair(0.2, 40.0, 0.5)
DEVICE = vijax.Harvester()
ROUGH = vijax.Harmonics([1.0, 0.3, 0.1], [0.0, 0.7, -1.0])
ODD = vijax.Harmonics([1.0, 0.0, 0.2], [0.0, 0.0, 1.0])
IMPACTS = "t", "v_in", "v_out", "depth", "duration"


@pytest.fixture(scope="module")
def rough():
    """The attractor of a ball under three harmonics, found from where a run comes to."""
    return vijax.orbits_from_states(PAIR, 0.0, 0.1, settle=100, excitation=ROUGH)


def test_the_sine_is_one_of_them():
    sine = vijax.find_orbits(PAIR, "LR", guesses=64)
    known = vijax.find_orbits(PAIR, "LR", guesses=64, excitation=vijax.Harmonics())
    assert known.pair.waves is None
    np.testing.assert_array_equal(known.knots, sine.knots)
    # What is not the sine, but for rounding, takes the form of harmonics: other searches and other sums.
    nearly = vijax.find_orbits(PAIR, "LR", guesses=64, excitation=vijax.Harmonics([1.0, 1e-15]))
    assert nearly.pair.waves is not None
    assert len(nearly) == len(sine) == 3
    for name in ("knots", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(nearly, name), getattr(sine, name), rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    "kappa",
    [40.0, pytest.param(None, marks=pytest.mark.long), pytest.param(vijax.Sides(40.0, None), marks=pytest.mark.long)],
    ids=["soft", "rigid", "one rigid"],
)
def test_an_attractor_is_the_motion_that_a_run_comes_to(kappa):
    pair = vijax.impact_pair(0.2, kappa, 0.5, 0.02)
    found = vijax.orbits_from_states(pair, 0.0, 0.1, settle=200, excitation=ROUGH)
    assert found.status[0] == Status.OK
    assert np.abs(found.multipliers).max() < 1
    run = vijax.trajectory(pair, 0.0, 0.1, 400, excitation=ROUGH)
    last = slice(int(run.filled) - int(found.count[0]), int(run.filled))
    known = vijax.orbit_impacts(found)
    for name in IMPACTS:
        ends, orbits = (np.ravel(getattr(run.impacts, name)[last]), np.ravel(getattr(known, name)))
        np.testing.assert_allclose(np.sort(ends), np.sort(orbits)[: ends.size], rtol=0, atol=1e-12, err_msg=name)
    # A run integrates the energy of an impact; an orbit has a closed form.
    work = np.ravel(known.work)[: len(np.ravel(run.impacts.work[last]))]
    np.testing.assert_allclose(np.sort(np.ravel(run.impacts.work[last])), np.sort(work), rtol=1e-11)


@pytest.mark.long
def test_a_search_finds_the_attractor_and_what_repels(rough):
    label = "".join("L" if side < 0 else "R" for side in np.asarray(rough.sequence.side)[0] if side)
    found = vijax.find_orbits(PAIR, label, guesses=256, excitation=ROUGH)
    marks = vijax.orbits.orbit_properties.marks
    assert np.abs(marks(found) - marks(rough)).max(axis=1).min() < 1e-9
    repelling = vijax.find_orbits(PAIR, "LR", guesses=256, excitation=ROUGH)
    assert np.abs(repelling.multipliers).max() > 1
    # The ball leaves it as fast as its multiplier says.
    (clock, u, v), far = vijax.orbit_path(repelling), 1e-7
    start = int(np.nanargmin(np.abs(np.asarray(clock)[0] % 2 - 1)))
    begin = float(np.asarray(clock)[0, start]) % 2
    runs = vijax.trajectory(PAIR, [u[0, start], u[0, start] + far], [v[0, start]] * 2, 8, begin, excitation=ROUGH)
    apart = np.hypot(*(np.diff(np.asarray(leaf), axis=0)[0] for leaf in (runs.states.u, runs.states.v)))
    growth = np.abs(np.asarray(repelling.multipliers)).max()
    assert apart[5] / apart[4] == pytest.approx(growth, rel=1e-3)


@pytest.mark.long
def test_a_later_start_of_the_clock_is_the_same_orbit_earlier(rough):
    shift = 0.37
    later = vijax.Harmonics(ROUGH.amplitudes, [p + (k + 1) * np.pi * shift for k, p in enumerate(ROUGH.phases)])
    knots = np.asarray(rough.knots) - np.array([shift, 0.0, 0.0])
    moved = periodic.solve(with_harmonics(rough.pair, later), rough.sequence, knots)
    assert moved.status[0] == Status.OK
    gone = (np.asarray(moved.knots) - knots)[0, :3] / np.array([2.0, 1.0, 1.0])
    np.testing.assert_allclose(gone - np.round(gone[:1]), 0.0, atol=1e-12)
    np.testing.assert_allclose(moved.work, rough.work, rtol=1e-12)


@pytest.mark.long
def test_a_steady_state_harvests_what_a_map_says(rough):
    found = vijax.steady(DEVICE, rough[0], pair=PAIR)
    known = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.02, excitation=ROUGH)
    assert found.status == Status.OK
    assert float(found.P) == pytest.approx(float(known.P), rel=1e-12)
    assert float(vijax.orbit_power(rough, DEVICE)[0]) == pytest.approx(float(known.P), rel=1e-12)
    work = np.asarray(rough.work)[0, :3] * float(DEVICE.m_b * DEVICE.speed_unit**2)
    np.testing.assert_allclose(np.asarray(found.work)[:3], work, rtol=1e-12)


def test_derivatives_are_those_of_differences(rough):
    def power(pair):
        return vijax.steady(DEVICE, rough[0], pair=pair).P

    slopes = jax.grad(power)(PAIR)
    for name, h in (("d", 1e-4), ("kappa", 4e-3), ("r", 1e-4), ("gamma", 1e-5)):
        near = [power(replace(PAIR, **{name: getattr(PAIR, name) + n * h})) for n in (-2, -1, 1, 2)]
        difference = float(near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * h)
        assert float(getattr(slopes, name)) == pytest.approx(difference, rel=1e-7), name


@pytest.mark.long
def test_the_harmonics_have_derivatives_too(rough):
    """A designer of the shaking asks what a second harmonic does."""
    own = rough[0].pair

    def power(second):
        first, other, third = own.waves
        return vijax.steady(DEVICE, rough[0], pair=replace(own, waves=(first, replace(other, c=second), third))).P

    slope, h = float(jax.grad(power)(own.waves[1].c)), 1e-4
    one, other = (float(power(own.waves[1].c + sign * h)) for sign in (1, -1))
    assert slope == pytest.approx((one - other) / (2 * h), rel=1e-5)


@pytest.mark.long
def test_a_capsule_that_is_shaken_harder_has_the_orbits_of_a_smaller_one():
    """Of five times the amplitude: all lengths and speeds are five times as large, guesses of speeds too."""
    small = vijax.find_orbits(PAIR, "LR", guesses=64)
    wide = vijax.impact_pair(5 * 0.2, 40.0, 0.5, 5 * 0.02)
    large = vijax.find_orbits(wide, "LR", guesses=64, excitation=vijax.Harmonics([5.0]))
    assert len(large) == len(small) == 3
    scale = np.array([1.0, 5.0, 1.0])
    np.testing.assert_allclose(np.sort(large.knots / scale, axis=0), np.sort(small.knots, axis=0), rtol=0, atol=1e-11)
    assert orbit_search._strength(with_harmonics(wide, vijax.Harmonics([5.0, 2.0]))) == pytest.approx(6.0)
    assert orbit_search._strength(with_harmonics(wide, vijax.Harmonics([0.1]))) == 1.0


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_the_nearest_turn_of_a_flight_is_that_of_a_scan(seed):
    draw = np.random.default_rng(seed)
    pair, side, speed, t = with_harmonics(PAIR, ROUGH), -1.0, draw.uniform(0.1, 0.4), draw.uniform(0, 2)
    s = np.linspace(0, 2, 200_001)
    rise, v = (np.asarray(x) for x in flights.flown(pair, jnp.asarray(t), speed, jnp.asarray(s)))
    turns = np.flatnonzero(v[:-1] * v[1:] < 0)
    assert turns.size > 0
    ahead = np.sign(v[turns])
    rooms = 0.1 - ahead * (-0.1 + rise[turns])
    told = (jnp.asarray(x) for x in (side, speed, t, 2.0, True, np.nan))
    room, when = flights.nearest_turn(pair, *told)
    if rooms.min() < 1:
        assert float(room) == pytest.approx(rooms.min(), abs=1e-9)
        assert float(when) == pytest.approx(s[turns[rooms.argmin()]], abs=2e-5)


def test_harmonics_are_told_as_they_were_given():
    assert told_harmonics(with_harmonics(PAIR, ROUGH)) == {"excitation": str(ROUGH)}
    assert told_harmonics(PAIR) == {}


def test_odd_harmonics_alone_leave_a_level_pair_symmetric():
    assert bool(with_harmonics(LEVEL, ODD).symmetric)
    assert not bool(with_harmonics(LEVEL, ROUGH).symmetric)
    assert not bool(with_harmonics(PAIR, ODD).symmetric)


@pytest.mark.long
def test_mirror_images_are_orbits_under_odd_harmonics_alone():
    odd, rough = (vijax.find_orbits(LEVEL, "LR", guesses=64, excitation=one) for one in (ODD, ROUGH))
    assert symmetry.symmetric(odd).tolist() == [True]
    assert not symmetry.symmetric(rough).any()
    half = symmetry.halved(odd)
    assert half.count.tolist() == [1]
    np.testing.assert_allclose(half.multipliers, odd.multipliers, rtol=1e-10)
    np.testing.assert_allclose(symmetry.unfolded(half).knots[..., 1:], odd.knots[..., 1:], rtol=0, atol=1e-12)
    assert float(vijax.steady(DEVICE, half[0], pair=LEVEL).P) == pytest.approx(
        float(vijax.orbit_power(odd, DEVICE)[0]), rel=1e-12
    )


@pytest.mark.long
def test_a_ball_that_meets_a_wall_between_is_seen():
    wide = vijax.find_orbits(vijax.impact_pair(0.9, 40.0, 0.5, 0.2), "L", guesses=64, excitation=ROUGH)
    assert (np.asarray(wide.status) == Status.OK).all()
    assert len(wide) > 0
    narrow = replace(wide.pair, d=jnp.full(len(wide), 0.02))
    again = periodic.proven(narrow, wide.sequence, wide.knots)
    assert (np.asarray(again.status) == Status.VIRTUAL).all()


@pytest.mark.long
def test_a_membrane_of_any_law_may_be_shaken_so():
    closed, stepped = (
        vijax.find_orbits(PAIR, "LR", guesses=64, membrane=law, excitation=ROUGH) for law in (None, Plain())
    )
    assert len(closed) == len(stepped) == 1
    for name in ("knots", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(stepped, name), getattr(closed, name), rtol=0, atol=1e-11, err_msg=name)


@pytest.mark.long
def test_a_branch_flips_where_runs_double_their_period(rough):
    (branch,) = vijax.follow_orbits(rough, "d", (0.1, 0.22))
    flips = [float(point.value) for point in branch.points if point.kind == "flip"]
    assert flips[-1] == pytest.approx(0.1212797, abs=1e-7)
    near = vijax.sweep(
        d=flips[-1] + np.array([-2e-4, 2e-4]), kappa=40.0, r=0.5, gamma=0.02, excitation=ROUGH, periods=4000
    )
    assert near.period.values.ravel().tolist() == [2, 1]
    told = vijax.branch_dataset([branch]).attrs["excitation"]
    assert told == str(ROUGH)


@pytest.mark.long
def test_a_curve_goes_through_the_flip_of_a_branch(rough):
    (branch,) = vijax.follow_orbits(rough, "d", (0.115, 0.22))
    flip = [point for point in branch.points if point.kind == "flip"][-1]
    (curve,) = vijax.follow_curves([flip], "d", {"d": (0.11, 0.14), "r": (0.45, 0.55)})
    row = int(np.argmin(np.abs(curve.values[:, 1] - 0.52)))
    d, r = curve.values[row]
    near = vijax.sweep(d=d + np.array([-3e-4, 3e-4]), kappa=40.0, r=r, gamma=0.02, excitation=ROUGH, periods=4000)
    assert near.period.values.ravel().tolist() == [2, 1]


@pytest.mark.parametrize(
    ("excitation", "said"),
    [
        (vijax.Harmonics() + vijax.Noise(0.1, 8), "excitation must repeat every period, .* got harmonics 1.0 . noise"),
        (vijax.Waveform(np.zeros(8), 4), "excitation must repeat every period"),
        (vijax.Harmonics([1.0]) + vijax.Harmonics([-1.0]), "excitation must not cancel"),
        (3.0, "excitation must be of the kind Excitation; got 3.0"),
    ],
)
def test_what_does_not_repeat_has_no_orbits(excitation, said):
    for call in (
        lambda: vijax.find_orbits(PAIR, "LR", excitation=excitation),
        lambda: vijax.orbits_from_states(PAIR, 0.0, 0.1, excitation=excitation),
    ):
        with pytest.raises(ValueError, match=said):
            call()


def test_what_knows_no_harmonics_refuses_the_pair_of_an_orbit(rough):
    for error in refusals(rough[0].pair):
        assert "pair must know of no harmonics here; got some; give them as excitation=" in error


@pytest.mark.long
def test_a_run_with_any_membrane_comes_to_an_orbit(rough):
    found = vijax.orbits_from_states(PAIR, 0.0, 0.1, settle=100, membrane=Plain(), excitation=ROUGH)
    assert found.status[0] == Status.OK
    np.testing.assert_allclose(np.asarray(found.knots)[0, :3], np.asarray(rough.knots)[0, :3], rtol=0, atol=1e-10)
