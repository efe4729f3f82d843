"""Turning points under several harmonics: as many as in a dense scan, also where two lie between two samples."""

import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.impact.exact.turn_search import harmonic_curvature_bound, visit_turns
from vijax.impact.taylor.taylor import Oscillator, Push
from vijax.model import flow
from vijax.model.forcing.waves import Wave, contact_motion, flight_motion

MOST = 256


def harmonics(draw, orders):
    return tuple(Wave(k, jnp.asarray(draw.normal() / k), jnp.asarray(draw.normal() / k)) for k in orders)


def turns_of(spring, push, course, length):
    """Return the times of all turning points, and True where the velocity rises."""

    def record_turn(state, s, x, rising):
        count, when, rises = state
        return count + 1, when.at[count].set(s), rises.at[count].set(rising)

    blank = jnp.int32(0), jnp.full(MOST, jnp.nan), jnp.zeros(MOST, bool)
    (count, when, rises), lost = visit_turns(
        spring, push, course, jnp.asarray(length), jnp.asarray(True), record_turn, blank
    )
    assert not lost
    return np.asarray(when)[: int(count)], np.asarray(rises)[: int(count)]


def scanned(course, length):
    """Return the sign changes of the velocity between a hundred thousand samples."""
    s = np.linspace(0, length, 100_001)
    z = np.asarray(course(jnp.asarray(s))[1])
    at = np.flatnonzero(z[:-1] * z[1:] < 0)
    return s[at], z[at] < 0, s[1]


@pytest.mark.parametrize("seed", range(6))
def test_turning_points_of_flights_agree_with_a_scan(seed):
    draw = np.random.default_rng(seed)
    waves, gamma = harmonics(draw, (1, 2, 3, 7)), jnp.asarray(0.01 * draw.normal())
    # The mean velocity is zero.
    v, zero = sum(wave.q / (wave.order * np.pi) for wave in waves), jnp.zeros(())
    course = lambda s: flight_motion(waves, gamma, v, s)  # noqa: E731
    spring = Oscillator(zero, zero, zero, zero + jnp.inf)
    when, rises = turns_of(spring, Push(-gamma, zero, waves), course, 6.0)
    near, rising, step = scanned(course, 6.0)
    assert len(near) > 4
    assert len(when) == len(near)
    np.testing.assert_allclose(when, near, rtol=0, atol=step)
    np.testing.assert_array_equal(rises, rising)
    np.testing.assert_allclose(course(jnp.asarray(when))[1], 0.0, atol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_turning_points_of_contacts_agree_with_a_scan(seed):
    draw = np.random.default_rng(100 + seed)
    waves, gamma = harmonics(draw, (1, 2, 5)), jnp.asarray(-2.0)
    m = flow.membrane(vijax.impact_pair(0.2, float(draw.uniform(3, 60)), 0.8))
    zero = jnp.zeros(())
    course = lambda s: contact_motion(m, waves, 1.0, gamma, 0.5, s)  # noqa: E731
    spring = Oscillator(m.kappa, m.kappa * m.kappa, m.mu, zero + jnp.inf)
    when, rises = turns_of(spring, Push(-gamma, zero, waves), course, 3.0)
    near, rising, step = scanned(course, 3.0)
    assert len(when) == len(near) > 4
    np.testing.assert_allclose(when, near, rtol=0, atol=step)
    np.testing.assert_array_equal(rises, rising)


def test_two_turning_points_within_a_millionth_are_both_detected():
    """The velocity is below zero for a moment, near a sign change of the acceleration."""
    waves, zero = (Wave(1, jnp.asarray(-1.0), jnp.zeros(())), Wave(3, jnp.asarray(0.05), jnp.zeros(()))), jnp.zeros(())
    spring, push = Oscillator(zero, zero, zero, zero + jnp.inf), Push(zero, zero, waves)
    low = float(flight_motion(waves, zero, 0.0, jnp.asarray(0.5))[1])
    bend = float(push.later(jnp.asarray(0.5)).derivatives()[1])
    for dip, number in ((5e-7, 2), (-5e-7, 0)):
        v = -low - np.sign(dip) * 0.5 * bend * dip**2
        when, rises = turns_of(spring, push, lambda s, v=v: flight_motion(waves, zero, v, s), 1.0)
        assert len(when) == number
        if number:
            np.testing.assert_allclose(when, [0.5 - dip, 0.5 + dip], rtol=0, atol=1e-9)
            assert rises.tolist() == [False, True]


def test_a_motion_that_begins_at_rest_does_not_turn_there():
    waves, zero = (Wave(1, jnp.asarray(1.0), jnp.zeros(())), Wave(2, jnp.zeros(()), jnp.asarray(0.3))), jnp.zeros(())
    spring = Oscillator(zero, zero, zero, zero + jnp.inf)
    when, _ = turns_of(spring, Push(zero, zero, waves), lambda s: flight_motion(waves, zero, 0.0, s), 1.9)
    near, _, step = scanned(lambda s: flight_motion(waves, zero, 0.0, s), 1.9)
    np.testing.assert_allclose(when, near, rtol=0, atol=step)
    assert when.min() > 0.1


def test_the_second_derivative_of_a_push_is_bounded():
    draw = np.random.default_rng(5)
    waves = harmonics(draw, (1, 2, 3))
    most = max(
        abs(float(Push(jnp.zeros(()), jnp.zeros(()), waves).later(s).derivatives()[2])) for s in np.linspace(0, 2, 400)
    )
    assert most <= float(harmonic_curvature_bound(waves)) < 2.5 * most
