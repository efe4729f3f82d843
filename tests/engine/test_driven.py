"""Excitations that are not the sine: 40-digit sequences, DOP853, orders, noise, derivatives, and the exact engine."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vijax
from benchmarks import contact_work
from tests.engine.driven_digits import DIGITS, march
from vijax import Harmonics, Noise, Sides, Waveform, impact_pair, trajectory
from vijax.engine import taylor
from vijax.engine.taylor import Oscillator, Push
from vijax.model.records import Status
from vijax.model.waves import Wave

SAMPLES = 64
# d, kappa, r, gamma, u0, v0; of two walls the left one first.
CASES = [
    (0.2, 40.0, 0.5, 0.0, 0.02, 0.3),
    (0.3, 6.0, 0.4, 0.1, -0.05, -0.2),
    (0.25, 300.0, 0.2, 0.0, 0.05, -0.4),
    (0.15, (12.0, 90.0), (0.4, 0.6), -0.2, 0.0, 0.5),
]
# A forcing of the sine's size with all that is rough: neighbouring samples know nothing of each other.
ROUGH = np.random.default_rng(11).normal(size=192)
SINE = Harmonics([1.0, 0.0])
"""The sine, by the method of all other excitations."""


def pair_of(case):
    return impact_pair(*(Sides(*x) if isinstance(x, tuple) else x for x in case[:4]))


# --- the motion -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_forty_digits(case):
    """Errors of all that is known of an impact: rounding at first, and what the motion makes of it later."""
    impacts = trajectory(pair_of(case), *case[4:], 40, excitation=Waveform(ROUGH, SAMPLES)).impacts
    with mp.workdps(DIGITS):
        rows = march(case, ROUGH, SAMPLES, 7)
        for k, row in enumerate(rows):
            hit = jax.tree.map(lambda x, k=k: x[k], impacts)
            assert int(hit.side) == row.side
            got = 2 * int(hit.n) + mp.mpf(float(hit.t)), *map(float, (hit.v_in, hit.v_out, hit.duration, hit.depth))
            want = (row.onset, row.v_in, row.v_out, row.duration, row.depth)
            errors = [float(abs(mp.mpf(a) - b)) for a, b in zip(got, want, strict=True)]
            assert max(errors) < (1e-13 if k < 4 else 1e-11), (k, errors)


def dop853(case, values, count):
    """Onsets, speeds, and durations of the first impacts by SciPy, sample by sample with located events."""
    d, kappa, r, gamma, u, v = case
    mu, half, gap = 0.0 if kappa is None else float(impact_pair(*case[:4]).mu), d / 2, 2 / SAMPLES
    rows, side, y, t, k, onset = [], 0, np.array([u, v]), 0.0, 0, (0.0, 0.0)
    while len(rows) < count and k < 80 * SAMPLES:
        begin, (f0, f1) = k * gap, (values[i % values.size] for i in (k, k + 1))
        push = lambda t, f0=f0, f1=f1, begin=begin: f0 + (f1 - f0) * (t - begin) / gap - gamma  # noqa: E731
        while t < begin + gap:
            told = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
            if side == 0:
                events = [lambda t, y, w=w: half - w * y[0] for w in (1, -1)]
                run = lambda t, y, push=push: (y[1], push(t))  # noqa: E731
                told["max_step"] = gap / 16
            else:
                events = [lambda t, y: y[0]]
                run = lambda t, y, push=push, side=side: (  # noqa: E731
                    y[1],
                    side * push(t) - mu * y[1] - kappa**2 * y[0],
                )
                told["max_step"] = min(gap / 3, 0.3 / kappa)
            for event in events:
                event.terminal, event.direction = True, -1
            found = solve_ivp(run, (t, begin + gap), y, events=events, **told)
            t, y = float(found.t[-1]), found.y[:, -1]
            if found.status != 1:
                t = begin + gap
                break
            if kappa is None:
                rows.append((t, y[1], -r * y[1], 0.0))
                y = np.array([np.sign(y[0]) * half, -r * y[1]])
            elif side == 0:
                side = 1 if found.t_events[0].size else -1
                onset, y = (t, y[1]), np.array([0.0, side * y[1]])
            else:
                rows.append((onset[0], onset[1], side * y[1], t - onset[0]))
                y, side = np.array([side * half, side * y[1]]), 0
        k += 1
    return np.array(rows[:count])


@pytest.mark.parametrize("rigid", [False, pytest.param(True, marks=pytest.mark.long)])
@pytest.mark.parametrize("number", [pytest.param(i, marks=[pytest.mark.long] if i else []) for i in range(20)])
def test_dop853_on_random_records(number, rigid):
    """The first ten impacts to 1e-10, of motions that make no more than a thousand of an error until then.

    Without chatter, of which SciPy makes ever smaller steps.
    """
    g = np.random.default_rng(100 + number)
    growth, slowest = np.inf, 0.0
    while growth > 1e3 or slowest < 0.01:
        values, off = g.normal(size=256), np.array([0.0, 1e-8])
        d, kappa, r = g.uniform(0.1, 0.4), np.exp(g.uniform(np.log(4), np.log(300))), g.uniform(0.2, 0.5)
        start = g.choice([0.0, g.uniform(-0.3, 0.3)]), g.uniform(-0.4, 0.4) * d, g.uniform(-0.5, 0.5)
        case = (d, None, r + 0.3, *start) if rigid else (d, kappa, r, *start)
        found = trajectory(pair_of(case), case[4] + off, case[5], 80, excitation=Waveform(values, SAMPLES)).impacts
        hits = jax.tree.map(np.asarray, found)
        rows = np.stack([2 * hits.n + hits.t, hits.v_in, hits.v_out, hits.duration], axis=-1)[:, :10]
        growth, slowest = np.max(np.abs(rows[1] - rows[0])) / 1e-8, np.abs(rows[0, :, 1]).min()
    ours = rows[0]
    np.testing.assert_allclose(ours, dop853(case, values, 10), rtol=0, atol=1e-10)


def test_a_sampled_sine_converges_with_order_two():
    pair = impact_pair(0.2, np.array([8.0, 60.0, 400.0]), 0.3)
    exact, errors = trajectory(pair, 0.05, -0.4, 6).impacts, []
    counts = 2 ** np.arange(6, 11)
    for n in counts:
        # All are as long, which makes one program of them.
        sampled = trajectory(pair, 0.05, -0.4, 6, excitation=Waveform(np.cos(2 * np.pi * np.arange(1024) / n), n))
        errors.append(np.abs(sampled.impacts.v_in - exact.v_in)[:, :8].max(axis=1))
    slopes = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert (np.abs(slopes - 2) < 0.05).all(), slopes


def test_one_harmonic_is_the_sine():
    pair = impact_pair(0.2, np.array([10.0, 400.0]), 0.5)
    sine, named = trajectory(pair, 0.05, -0.4, 10), trajectory(pair, 0.05, -0.4, 10, excitation=Harmonics())
    assert all(map(np.array_equal, jax.tree.leaves(sine.states), jax.tree.leaves(named.states)))
    assert np.array_equal(sine.impacts.v_in, named.impacts.v_in, equal_nan=True)


@pytest.mark.parametrize("gamma", [0.0, 0.3])
def test_the_sine_by_the_method_of_all_others(gamma):
    """Against the exact engine, impact by impact."""
    pair = impact_pair(np.array([0.2, 0.3, 0.25]), np.array([400.0, 5.0, 30.0]), np.array([0.5, 0.6, 0.3]), gamma)
    exact, ours = trajectory(pair, 0.0, -0.4, 6), trajectory(pair, 0.0, -0.4, 6, excitation=SINE)
    assert np.array_equal(exact.filled, ours.filled)
    for name in ("t", "v_in", "v_out", "duration", "depth"):
        np.testing.assert_allclose(getattr(ours.impacts, name), getattr(exact.impacts, name), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(ours.impacts.work, exact.impacts.work, rtol=1e-11)
    np.testing.assert_allclose(ours.states.u, exact.states.u, rtol=0, atol=1e-12)


FOUR = Harmonics([1.0, 0.6, 0.6, 0.6], [0.0, 1.0, 2.0, 3.0])
# Nearly undamped, nearly critical, long and short contacts; the first was off by 9e-6 in its third impact.
WORKED = [
    (impact_pair(0.11041892852358624, 11.894084509106502, 0.73353802030145365), (0.0231589713, -0.3094867174)),
    (impact_pair(0.2, 3.0, 0.99, 0.3), (0.05, 0.2)),
    (impact_pair(3.0, 400.0, 0.05, -0.4), (0.1, -0.3)),
    (impact_pair(0.05, Sides(12.5, 90.0), Sides(0.8, 0.3)), (0.0, 0.5)),
]


def test_the_energy_given_to_a_membrane_is_exact_to_rounding():
    """Worst of 4,101 drawn impacts by benchmarks/contact_work.py: 1.4e-14; by the closed form of orbits 2.2e-12."""
    found = np.concatenate([contact_work.errors((pair, start, FOUR), 4) for pair, start in WORKED])
    assert len(found) >= 40
    assert found[:, 0].max() < 1e-13
    assert found[:, 1].max() < 1e-11


RIGID = [(0.3, 0.6, 0.0), (0.05, 0.8, 0.1), (0.2, 0.5, 0.0), (0.25, 0.3, 0.3), (0.6, 0.2, -0.5), (0.1, 0.4, 0.9)]
"""d, r and gamma: balls that fly from wall to wall, and such that chatter, stay and are let go."""


@pytest.mark.parametrize("wall", [pytest.param("rigid", marks=pytest.mark.long), "rigid_left"])
def test_the_sine_at_rigid_walls(wall):
    """Impact by impact; of a chatter all bounces but those that end it, which are told apart by rounding alone."""
    d, r, gamma = np.array(RIGID).T
    pair = impact_pair(d, None if wall == "rigid" else Sides(None, 40.0), r, gamma)
    exact, ours = (trajectory(pair, 0.0, -0.4, 8, max_impacts=300, excitation=given) for given in (None, SINE))
    np.testing.assert_allclose(ours.states.u, exact.states.u, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(ours.states.mode, exact.states.mode)
    held = 0
    for index in range(d.size):
        both = []
        for found in (exact, ours):
            hits = jax.tree.map(lambda x, index=index: np.asarray(x[index]), found.impacts)
            fast = np.abs(hits.v_in) > 1e-6
            # Nothing is pressed, and nothing given, while a ball rests.
            rested = hits.duration > 0 if wall == "rigid" else np.zeros_like(fast)
            assert hits.depth[rested].max(initial=0) < 1e-6
            assert np.abs(hits.work[rested]).max(initial=0) < 1e-12
            rest = np.cumsum(np.where(hits.duration > 0, hits.duration, 0.0))
            names = ("side", "v_in", "v_out", "depth", "work")
            both.append(np.stack([2 * hits.n + hits.t, rest, *(getattr(hits, name) for name in names)])[:, fast])
        # The last bounces are taken for rest a little earlier here.
        np.testing.assert_allclose(both[1][1], both[0][1], rtol=0, atol=5e-6)
        np.testing.assert_allclose(np.delete(both[1], 1, axis=0), np.delete(both[0], 1, axis=0), rtol=0, atol=2e-9)
        held += both[0][1, -1] > 0
    assert held >= 2


@pytest.mark.long
def test_attractors_at_rigid_walls_are_those_of_the_sine():
    """Newton puts balls a little beyond a wall on its way; the first cell was wrong when such met the wall at once."""
    told = {"d": [0.06521739130434782, 0.19, 0.3, 0.4], "r": [0.3, 0.7454545454545456], "gamma": [-0.2, 0.2]}
    told |= {"wall": "rigid", "outputs": ["P", "period", "impacts_left", "impacts_right", "lyapunov", "status"]}
    sine, ours = vijax.sweep(**told), vijax.sweep(**told, excitation=SINE)
    np.testing.assert_array_equal(ours.status, sine.status)
    periodic = (sine.period > 0) & (sine.status == Status.OK)
    assert int(periodic.sum()) >= 4
    assert bool((sine.status == Status.STICKING).any())
    for name in ("period", "impacts_left", "impacts_right"):
        np.testing.assert_array_equal(ours[name].values[periodic], sine[name].values[periodic])
    np.testing.assert_allclose(ours.P.values[periodic], sine.P.values[periodic], rtol=1e-10)
    grows = [found.lyapunov.values[periodic] for found in (ours, sine)]
    np.testing.assert_allclose(*grows, rtol=1e-6)
    stuck = (sine.status == Status.STICKING).values
    np.testing.assert_allclose(ours.P.values[stuck], sine.P.values[stuck], rtol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_rigid_wall_lets_go_of_a_ball_when_the_push_turns(side):
    """A push that falls on a straight line from 1, and turns 2.5 samples after the start."""
    line = side * (1 - 0.4 * np.arange(SAMPLES))
    pair = impact_pair(0.2, None, 0.5)
    given = Waveform(line, SAMPLES)
    impacts = [trajectory(pair, side * u, 0.0, 1, excitation=given).impacts for u in (0.1, 0.0999)]
    found, dropped = jax.tree.map(np.asarray, impacts)
    begin, pull = 2.5 * 2 / SAMPLES, 0.4 * SAMPLES / 2
    # From there on the ball is pulled away more and more: u = half - pull s^3/6.
    met = begin + np.cbrt(6 * 0.2 / pull)
    assert found.side[0] == -side
    np.testing.assert_allclose(2 * found.n[0] + found.t[0], met, rtol=1e-12)
    np.testing.assert_allclose(found.v_in[0], -side * pull * (met - begin) ** 2 / 2, rtol=1e-12)
    # One that comes to rest there has an impact that lasts as long.
    last = np.argmax(dropped.duration > 0)
    ends = 2 * dropped.n[last] + dropped.t[last] + dropped.duration[last]
    assert dropped.v_out[last] == 0
    np.testing.assert_allclose(ends, begin, rtol=1e-12)


@pytest.mark.parametrize("start", [0.0999, 0.1])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_ball_rests_through_the_silence_of_a_record(side, start):
    """A push, then none for a while, then a pull: the ball stays until that begins, and no impact is made up."""
    quiet = np.concatenate([np.ones(12), np.zeros(20), -np.ones(32)])
    given = Waveform(side * quiet, SAMPLES)
    found = trajectory(impact_pair(0.2, None, 0.5), side * start, 0.0, 1, excitation=given)
    assert found.status == Status.OK
    hits = jax.tree.map(np.asarray, found.impacts)
    there = np.flatnonzero((hits.side == -side) & np.isfinite(hits.v_in))
    # Let go after 31 samples, by a pull that takes one more to grow to 1: it goes a sixth of its square meanwhile.
    gap, begin = 2 / SAMPLES, 31 * 2 / SAMPLES
    fall, speed = gap**2 / 6, gap / 2
    met = begin + gap - speed + np.sqrt(speed**2 + 2 * (0.2 - fall))
    np.testing.assert_allclose((2 * hits.n + hits.t)[there[0]], met, rtol=1e-7)
    before = hits.v_in[: there[0]]
    assert (np.abs(before) > 1e-8).all()
    assert hits.duration[: there[0]].max(initial=0) > (0.7 if start < 0.1 else -1)


def test_a_ball_at_rest_on_a_wall_in_silence_stays():
    nothing = Waveform(np.zeros(SAMPLES), SAMPLES)
    found = trajectory(impact_pair(0.2, None, 0.5), np.array([-0.1, 0.1]), 0.0, 2, excitation=nothing)
    np.testing.assert_array_equal(found.filled, 0)
    np.testing.assert_array_equal(found.states.u, [[-0.1] * 2, [0.1] * 2])


@pytest.mark.long
def test_derivatives_at_rigid_walls_against_differences():
    pair, rough = impact_pair(0.2, None, 0.5), Waveform(ROUGH, SAMPLES)

    def speed(r, u):
        return trajectory(replace(pair, r=r), u, 0.3, 8, excitation=rough).impacts.v_in[3]

    by_r, by_u = jax.jacfwd(speed, argnums=(0, 1))(0.5, 0.02)
    h = 1e-6
    np.testing.assert_allclose(by_r, (speed(0.5 + h, 0.02) - speed(0.5 - h, 0.02)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(by_u, (speed(0.5, 0.02 + h) - speed(0.5, 0.02 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.long
def test_derivatives_at_rigid_walls_in_reverse_are_those_forward():
    pair, rough = impact_pair(0.2, None, 0.5), Waveform(ROUGH, SAMPLES)

    def speed(r, u):
        return trajectory(replace(pair, r=r), u, 0.3, 8, excitation=rough).impacts.v_in[3]

    forward, reverse = (of(speed, argnums=(0, 1))(0.5, 0.02) for of in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)


@pytest.mark.long
def test_two_harmonics_against_dop853():
    """The second at 0.6 of the first, with a phase: contact and flight under a forcing with no line in it."""
    case = 0.2, 25.0, 0.4, 0.1, 0.02, 0.3
    n = 4096
    t = 2 * np.arange(n) / n
    fine = Waveform(np.cos(np.pi * t) + 0.6 * np.cos(2 * np.pi * t + 0.7), n)
    finer = trajectory(pair_of(case), *case[4:], 6, excitation=fine).impacts
    ours = trajectory(pair_of(case), *case[4:], 6, excitation=Harmonics([1.0, 0.6], [0.0, 0.7])).impacts
    # A line through samples is off by (pi k/n)^2/2 of each harmonic.
    np.testing.assert_allclose(ours.v_in, finer.v_in, rtol=0, atol=2e-5)
    assert np.nanmax(np.abs(ours.v_in - finer.v_in)) > 1e-8


def test_samples_need_not_fit_into_the_period():
    """A record is refined to three times its samples, which changes nothing; periods end between its samples."""
    coarse = Waveform(ROUGH, 10 * np.pi)
    fine = Waveform(np.interp(np.arange(3 * 192) / 3, np.arange(193), np.append(ROUGH, ROUGH[0])), 30 * np.pi)
    pair = impact_pair(0.2, np.array([12.0, 200.0]), 0.2)
    one, other = (trajectory(pair, 0.05, -0.4, 8, excitation=x) for x in (coarse, fine))
    np.testing.assert_allclose(one.states.u, other.states.u, rtol=0, atol=1e-11)
    np.testing.assert_allclose(one.impacts.t, other.impacts.t, rtol=0, atol=1e-11)
    assert np.isfinite(one.states.v).all()


def test_a_map_tells_time_where_periods_end_between_samples():
    """Contacts and flights over the end of a period: their lengths are those of the motion, impact by impact."""
    wave, told = Waveform(ROUGH, 10 * np.pi), {"u0": 0.02, "v0": 0.3, "r": 0.4}
    found = vijax.sweep(
        d=0.2, kappa=[9.0, 40.0], **told, excitation=wave, until="window", periods=8, outputs=["contact_time", "P"]
    )
    hits = trajectory(impact_pair(0.2, np.array([9.0, 40.0]), 0.4), 0.02, 0.3, 8, excitation=wave).impacts
    np.testing.assert_allclose(found["contact_time"], np.nanmean(hits.duration, axis=1), rtol=1e-7)


def test_a_start_in_contact_and_at_any_phase():
    """Half of a run goes on from where the ball is: between samples in flight, inside a wall in contact."""
    pair, wave = impact_pair(0.1, 4.0, 0.5), Waveform(ROUGH, SAMPLES)
    whole = trajectory(pair, 0.05, -0.4, 12, excitation=wave)
    modes = np.asarray(whole.states.mode)[:-1]
    assert set(modes) == {-1, 0, 1}
    for mode in (-1, 0, 1):
        k = int(np.flatnonzero(modes == mode)[0])
        state = jax.tree.map(lambda x, k=k: x[k], whole.states)
        rest = trajectory(pair, state.u, state.v, 12, 2.0 * (k + 1), excitation=wave)
        np.testing.assert_allclose(rest.states.u[-1], whole.states.u[-1], rtol=0, atol=1e-11)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_start_at_rest_on_a_wall(side):
    """Pushed into it, off it, or pushed by gravity alone: as the sine by its own engine, at a knot and between two."""
    u0 = 0.15 * side
    # Where the sine at its height pushes the ball off, it comes back to graze the same wall: nobody can tell.
    for gamma, t0 in ((0.0, 0.5 * (1 - side)), (0.0, 0.3), (0.5, 0.0)):
        pair = impact_pair(0.3, 20.0, 0.5, gamma)
        exact, ours = (trajectory(pair, u0, 0.0, 4, t0, excitation=x) for x in (None, SINE))
        assert int(ours.status) == int(exact.status) == 0
        assert np.array_equal(ours.filled, exact.filled)
        np.testing.assert_allclose(ours.impacts.t, exact.impacts.t, rtol=0, atol=1e-11)
        np.testing.assert_allclose(ours.states.u, exact.states.u, rtol=0, atol=1e-12)


def test_the_push_of_a_start_is_that_of_its_own_forcing():
    """At phase 0 the sine pushes to the right, this record to the left: the ball leaves the right wall at once."""
    pushed = trajectory(impact_pair(0.3, 20.0, 0.5), 0.15, 0.0, 2, excitation=Waveform([-1.0, -1.0, 0.5, -0.2], 4.0))
    assert int(pushed.impacts.side[0]) == -1
    flight = 2 * float(pushed.impacts.n[0]) + float(pushed.impacts.t[0])
    assert flight == pytest.approx(np.sqrt(2 * 0.3), abs=0.05)
    # At phase 1 the sine pushes to the left, this one to the right: the ball is held, and no impact begins.
    held = trajectory(impact_pair(0.3, 20.0, 0.5), 0.15, 0.0, 3, 1.0, excitation=Waveform([-1.0, -1.0, 1.0, 0.5], 4.0))
    assert int(held.filled) > 0
    assert (np.abs(held.impacts.v_in)[: int(held.filled)] > 0.01).all()


@pytest.mark.long
def test_a_ball_that_comes_to_rest_inside_a_membrane():
    """A constant push above gravity: nothing but rounding is left of the motion, and no step waits for an event."""
    pair = impact_pair(0.12, np.array([24.9, 400.0, 2000.0]), 0.28)
    path = trajectory(pair, 0.0024, 0.4, 30, excitation=Waveform(np.full(5, 0.3), 5.0))
    assert (np.asarray(path.status) == Status.PERMANENT_CONTACT).all()
    np.testing.assert_allclose(path.states.u[:, -1], 0.06 + 0.3 / np.asarray(pair.kappa) ** 2, rtol=0, atol=1e-15)


RECORD, WAVES = Waveform(ROUGH, SAMPLES), Harmonics([1.0, 0.4])


def fourth(excitation, p):
    """Of the fourth impact: onset, exit speed, depth and duration."""
    d, kappa, r, gamma, u, v = p
    hits = trajectory(impact_pair(d, kappa, r, gamma), u, v, 5, max_impacts=4, excitation=excitation).impacts
    return jnp.stack([hits.t[3], hits.v_out[3], hits.depth[3], hits.duration[3]])


PLACE = jnp.array([0.2, 20.0, 0.4, 0.05, 0.02, 0.3])


@pytest.mark.parametrize("excitation", [RECORD, pytest.param(WAVES, marks=pytest.mark.long)], ids=["record", "waves"])
def test_derivatives_against_differences(excitation):
    """By every parameter of the pair and the start; all steps are one call."""
    forward = jax.jacfwd(partial(fourth, excitation))(PLACE)
    h = 1e-6 * np.asarray(PLACE)
    beside = np.asarray(PLACE)[:, None] + np.concatenate([np.diag(h), -np.diag(h)], axis=1)
    d, kappa, r, gamma, u, v = beside
    hits = trajectory(impact_pair(d, kappa, r, gamma), u, v, 5, max_impacts=4, excitation=excitation).impacts
    there = np.stack([np.asarray(x)[:, 3] for x in (hits.t, hits.v_out, hits.depth, hits.duration)])
    change = (there[:, : h.size] - there[:, h.size :]) / (2 * h)
    np.testing.assert_allclose(forward, change, rtol=2e-6, atol=1e-8)


@pytest.mark.long
@pytest.mark.parametrize("excitation", [RECORD, WAVES], ids=["record", "waves"])
def test_derivatives_in_reverse_are_those_forward(excitation):
    forward, reverse = (jac(partial(fourth, excitation))(PLACE) for jac in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)


# --- noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bandwidth", [2.0, pytest.param(40.0, marks=pytest.mark.long)])
def test_noise_spreads_velocities_as_its_level_says(bandwidth):
    """A ball that meets no wall: the variance of its velocity is level^2 t, less what straight lines leave out."""
    level, balls, periods = 0.3, 4096, 8
    start = np.linspace(-1, 1, balls)
    states = trajectory(impact_pair(1e3, 10.0, 0.5), start, 0.0, periods, excitation=Noise(level, bandwidth)).states
    assert np.isfinite(states.v).all()
    for k in (3, periods - 1):
        t = 2.0 * (k + 1)
        # The velocity is the integral of straight lines: half of the first and of the last value are not in it.
        expected = level**2 * (t - 0.5 / bandwidth)
        spread = np.var(states.v[:, k])
        assert abs(spread / expected - 1) < 3 * np.sqrt(2 / balls), (k, spread / expected)
        assert abs(np.mean(states.v[:, k])) < 3 * np.sqrt(expected / balls)


@pytest.mark.long
def test_noise_of_level_zero_is_none():
    plane = {"d": np.linspace(0.1, 0.3, 6), "kappa": np.geomspace(5, 300, 6), "r": 0.5}
    quiet = vijax.sweep(**plane, excitation=SINE + Noise(0.0, 32), outputs=["P", "period", "impacts_left"])
    sine = vijax.sweep(**plane, outputs=["P", "period", "impacts_left"])
    periodic = sine["period"] > 0
    assert np.array_equal(quiet["period"], sine["period"])
    assert np.array_equal(quiet["impacts_left"], sine["impacts_left"])
    assert float(np.abs(quiet["P"] / sine["P"] - 1).where(periodic).max()) < 1e-9


@pytest.mark.long
def test_little_noise_changes_little():
    """P of a 1:1 orbit moves by the square of the level, and the window of the smallest one is the noiseless one."""
    told = {"d": 0.2, "kappa": 40.0, "r": 0.5, "until": "window", "periods": 200, "transient": 50, "outputs": ["P"]}
    quiet = float(vijax.sweep(**told, excitation=SINE)["P"])
    off = [
        abs(float(vijax.sweep(**told, excitation=SINE + Noise(level, 32))["P"]) / quiet - 1) for level in (1e-9, 1e-2)
    ]
    assert off[0] < 1e-8 < off[1] < 0.05


@pytest.mark.long
def test_noise_is_that_of_its_cell_in_every_plane():
    """Not that of a lane, a tile, or a neighbour; another for every start, seed and cell."""
    excitation = SINE + Noise(0.05, 16, seed=7)
    told = {"r": 0.5, "until": "window", "periods": 40, "outputs": ["P"], "excitation": excitation}
    d, kappa = np.linspace(0.1, 0.3, 7), np.geomspace(5, 300, 5)
    plane = vijax.sweep(d=d, kappa=kappa, **told)["P"]
    part = vijax.sweep(kappa=kappa[::-1][:3], d=d[2:4], **told)["P"]
    assert np.array_equal(part.values.T, plane.values[2:4, ::-1][:, :3])
    other = vijax.sweep(d=d, kappa=kappa, **told | {"excitation": SINE + Noise(0.05, 16, seed=8)})["P"]
    assert (other.values != plane.values).all()
    starts = trajectory(
        impact_pair(0.2, 30.0, 0.5), np.array([0.0, -0.0, 1e-5]), -0.4, 10, excitation=excitation
    ).states.v
    assert np.array_equal(starts[0], starts[1])
    assert not np.allclose(starts[0], starts[2], atol=1e-3)


@pytest.mark.parametrize("bandwidth", [30.0, *(pytest.param(x, marks=pytest.mark.long) for x in (5.0, 12.0))])
def test_noise_shares_knots_with_a_record(bandwidth):
    """Finer noise on a record, as fine or coarser: of level next to nothing it is the record."""
    pair, record = impact_pair(0.2, 30.0, 0.4), Waveform(ROUGH, 24.0)
    plain = trajectory(pair, 0.02, 0.3, 6, excitation=record)
    noisy = trajectory(pair, 0.02, 0.3, 6, excitation=record + Noise(1e-13, bandwidth))
    np.testing.assert_allclose(noisy.impacts.v_in, plain.impacts.v_in, rtol=0, atol=1e-8)
    assert not np.array_equal(noisy.impacts.v_in, plain.impacts.v_in, equal_nan=True)


# --- what a step is made of -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kappa", "mu", "pace"), [(0.0, 0.0, 0), (3.0, 1.0, 1), (400.0, 172.363, 1), (7.0, 0.0, 3)])
def test_pieces_are_exact_to_rounding(kappa, mu, pace):
    """A piece as long as a series reaches, against SciPy's exponential of the whole linear system."""
    from scipy.linalg import expm

    s = taylor.REACH / max(kappa, pace * np.pi, 1.0)
    level, slope, c, q, x, z = 0.7, -3.0, 0.4, -0.9, 1e-3 if kappa > 50 else 0.2, 0.5
    push = (
        Push(*map(jnp.asarray, (level, slope)), (Wave(pace, jnp.asarray(c), jnp.asarray(q)),))
        if pace
        else Push(jnp.asarray(level), jnp.asarray(slope))
    )
    spring = Oscillator(*map(jnp.asarray, (kappa, kappa**2, mu, 1.0)))
    far, fast = taylor.moved(spring, push, jnp.asarray(x), jnp.asarray(z), jnp.asarray(s))
    # (x, x', line, its slope, cosine part, sine part) in one linear system.
    w = pace * np.pi
    a = np.zeros((6, 6))
    a[0, 1], a[1, 0], a[1, 1], a[1, 2], a[2, 3] = 1, -(kappa**2), -mu, 1, 1
    a[1, 4], a[4, 5], a[5, 4] = bool(pace), -w, w
    end = expm(a * s) @ np.array([x, z, level, slope, c, q])
    np.testing.assert_allclose([far, fast], end[:2], rtol=2e-14)


def test_certificates_never_lie():
    """Random quartics: whatever is certain of one holds at every point of a scan; and much is certain."""
    g = np.random.default_rng(5)
    f = g.normal(size=(5, 4000)) * np.array([1.0, 2.0, 4.0, 8.0, 0.0])[:, None]
    f[0] = np.where(g.random(4000) < 0.3, 0.0, np.abs(f[0]))
    most, s = np.abs(g.normal(size=4000)) * 20, g.uniform(0.1, 1.0, 4000)
    fourth = most * g.uniform(-1, 1, 4000)
    t = s * np.linspace(0, 1, 401)[1:, None]
    value = f[0] + t * (f[1] + t * (f[2] / 2 + t * (f[3] / 6 + t * fourth / 24)))
    rate = f[1] + t * (f[2] + t * (f[3] / 2 + t * fourth / 6))
    bend = f[2] + t * (f[3] + t * fourth / 2)
    above = np.asarray(taylor.above(tuple(jnp.asarray(f[:4])), jnp.asarray(most), jnp.asarray(s)))
    falling = np.asarray(taylor.falling(tuple(jnp.asarray(f[1:4])), jnp.asarray(most), jnp.asarray(s)))
    steady = np.asarray(taylor.steady_sign(tuple(jnp.asarray(f[2:4])), jnp.asarray(most), jnp.asarray(s)))
    for claim, holds in ((above, value > 0), (falling, rate < 0), (steady, np.abs(np.sign(bend).sum(axis=0)) == 400)):
        true = holds.all(axis=0) if holds.ndim > 1 else holds
        assert not (claim & ~true).any()
        assert claim.sum() > 0.3 * true.sum() > 100


def test_the_fourth_derivative_stays_within_its_bound():
    """Random membranes, pushes and states, in flight too; and the bound is worth something."""
    g = np.random.default_rng(9)
    count = 3000
    kappa = np.where(g.random(count) < 0.3, 0.0, np.exp(g.uniform(0, 6, count)))
    mu = kappa * g.uniform(0, 2, count)
    level, slope, c, q, x, z = g.normal(size=(6, count)) * np.array([1, 5, 1, 1, 0.1, 0.5])[:, None]
    spring = Oscillator(*map(jnp.asarray, (kappa, kappa**2, mu, kappa)))
    push = Push(jnp.asarray(level), jnp.asarray(slope), (Wave(2, jnp.asarray(c), jnp.asarray(q)),))
    reach = taylor.REACH / np.maximum(kappa, 2 * np.pi) * g.uniform(0.01, 1, count)
    bend = (2 * np.pi) ** 2 * np.hypot(c, q)
    now = taylor.rates(spring, push, jnp.asarray(x), jnp.asarray(z))
    most = np.asarray(taylor.steepest(spring, jnp.asarray(bend), now, jnp.asarray(reach)))
    seen = np.zeros(count)
    for part in np.linspace(0, 1, 21):
        s = jnp.asarray(reach * part)
        there = taylor.rates(spring, push.later(s), *taylor.moved(spring, push, jnp.asarray(x), jnp.asarray(z), s))
        seen = np.maximum(seen, np.abs(there.snap))
    assert (seen <= most * (1 + 1e-9)).all()
    assert np.median(seen / most) > 0.1
