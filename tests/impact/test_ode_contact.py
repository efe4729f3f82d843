"""Contacts of known duration with membranes of any law, against closed forms, SciPy's DOP853, and their order."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import vijax
from vijax.impact.exact import contact_search
from vijax.impact.ode import ode_contact
from vijax.model import flow
from vijax.model.walls.membrane import Linear, with_law

SOFT = vijax.impact_pair(0.2, 40.0, 0.5, 0.1)
WITHOUT_RESTITUTION = replace(SOFT, r=None)
LAWS = {
    "hertz": (WITHOUT_RESTITUTION, vijax.HuntCrossley(0.2)),
    "between": (WITHOUT_RESTITUTION, vijax.HuntCrossley(0.5, 2.2)),
    "rubber": (SOFT, vijax.Hyperelastic(1.5, 0.02, 4.0)),
}


def onset(pair, law, side=1.0, t=0.3, speed=0.7):
    """Return a contact at its onset."""
    return ode_contact.contact(replace(pair, law=law), *map(jnp.asarray, (side, t, speed)))


def length(of):
    """Return the duration of a contact."""
    s, states = ode_contact.simulate_contact(of, jnp.asarray(0.6), 400)
    first = int(np.argmax(np.asarray(states.w) < 0))
    low, high = (float(x) for x in s[first - 1 : first + 1])
    return jnp.asarray(
        brentq(lambda s: float(ode_contact.contact_state_at(of, jnp.asarray(s), 128).w), low, high, xtol=1e-15)
    )


@pytest.mark.parametrize(
    ("kappa", "side", "t", "speed", "contact_duration"),
    [
        (3.0, 1.0, 0.3, 0.7, 0.8),
        (40.0, -1.0, 1.7, 0.2, 0.07),
        (400.0, 1.0, 0.9, 1.3, 0.008),
        (25.0, -1.0, 0.2, 0.0, 0.2),
    ],
)
def test_a_stepped_linear_contact_agrees_with_the_closed_form(kappa, side, t, speed, contact_duration):
    pair = vijax.impact_pair(0.2, kappa, 0.6, 0.1)
    of, contact_duration = onset(pair, Linear(), side, t, speed), jnp.asarray(contact_duration)
    wall = flow.membrane(pair)

    def closed(onset):
        return jnp.stack(flow.oscillate(wall, flow.contact_force(pair.gamma, side, onset[0]), 0.0, onset[1], onset[2]))

    end = ode_contact.contact_endpoint(of, contact_duration)
    slopes = jax.jacfwd(closed)(jnp.stack([of.t, of.speed, contact_duration]))
    np.testing.assert_allclose((end.w, end.z), closed((of.t, of.speed, contact_duration)), rtol=0, atol=3e-12)
    np.testing.assert_allclose((end.w_slope, end.z_slope), slopes, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        ode_contact.tangent_map(of, contact_duration),
        flow.contact_matrix(wall, contact_duration),
        rtol=1e-10,
        atol=1e-11,
    )
    lost = 0.5 * float(of.speed**2 - end.z**2)
    np.testing.assert_allclose(
        ode_contact.contact_state_at(of, contact_duration).work,
        lost + _forced(pair, side, t, speed, contact_duration),
        rtol=1e-10,
        atol=1e-12,
    )


def _forced(pair, side, t, speed, contact_duration):
    """Return the work of the forcing on a ball within a contact, by quadrature."""
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, side, t)
    x, weight = np.polynomial.legendre.leggauss(64)
    s = 0.5 * contact_duration * (x + 1)
    rate = np.array([float(flow.oscillate(wall, force, 0.0, speed, time)[1]) for time in s])
    return 0.5 * contact_duration * np.sum(weight * rate * side * (np.cos(np.pi * (t + s)) - float(pair.gamma)))


@pytest.mark.parametrize("name", LAWS)
def test_contacts_agree_with_scipy(name):
    of = onset(*LAWS[name], side=-1.0, t=1.4)
    contact_duration = length(of)

    def field(s, y):
        pull = float(of.wall(*map(jnp.asarray, y[:2])))
        return y[1], float(of.push(jnp.asarray(s))) + pull, -pull * y[1]

    # The solver stops slightly away from w = 0, where the force of Hertz is not smooth.
    run = solve_ivp(field, (0, float(contact_duration)), (0, 0.7, 0), method="DOP853", rtol=3e-13, atol=1e-14)
    np.testing.assert_allclose(
        tuple(ode_contact.contact_state_at(of, contact_duration)), run.y[:, -1], rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("name", LAWS)
def test_the_order_is_the_order_for_smooth_forces(name):
    of = onset(*LAWS[name])
    contact_duration = length(of)
    exact = ode_contact.contact_state_at(of, contact_duration, 1024)
    off = [
        max(
            abs(float(a - b)) for a, b in zip(ode_contact.contact_state_at(of, contact_duration, n), exact, strict=True)
        )
        for n in (8, 16)
    ]
    # Order eight for a power series; less for w^2.2, which is not a power series in the root of time.
    assert off[0] / off[1] > 2**6
    assert float(ode_contact.error_estimate(of, contact_duration)) < 1e-10


@pytest.mark.parametrize("name", LAWS)
def test_the_tangent_map_agrees_with_neighbouring_motions(name):
    """A ball with a small deviation in flight reaches the wall and leaves it slightly earlier."""
    of = onset(*LAWS[name])
    contact_duration = length(of)

    def after(w, z):
        """Return the state, in flight after the exit, of a ball at w with speed z at the time of the onset."""
        # Flight back to the wall, or on to it.
        early = brentq(lambda s: w + z * s + _fall(of, 0.0, s)[0], -0.1, 0.1, xtol=1e-16)
        speed = z + _fall(of, 0.0, early)[1]
        neighbour = onset(*LAWS[name], t=0.3 + early, speed=speed)
        duration = length(neighbour)
        rate = float(ode_contact.contact_state_at(neighbour, duration, 128).z)
        rest = float(contact_duration) - early - float(duration)
        fallen, faster = _fall(neighbour, float(duration), rest)
        return np.array([rate * rest + fallen, rate + faster])

    step = 1e-4
    columns = [
        (after(step, 0.7) - after(-step, 0.7)) / (2 * step),
        (after(0.0, 0.7 + step) - after(0.0, 0.7 - step)) / (2 * step),
    ]
    np.testing.assert_allclose(
        ode_contact.tangent_map(of, contact_duration), np.stack(columns, axis=1), rtol=2e-5, atol=2e-5
    )


def _fall(of, begin, s):
    """Return displacement and change of velocity of a ball by the forcing alone."""
    x, weight = np.polynomial.legendre.leggauss(16)
    when = begin + 0.5 * s * (x + 1)
    push = np.array(jax.vmap(of.push)(jnp.asarray(when)))
    return 0.5 * s * np.sum(weight * push * (begin + s - when)), 0.5 * s * np.sum(weight * push)


def test_a_spring_without_loss_returns_its_energy():
    of = onset(WITHOUT_RESTITUTION, vijax.HuntCrossley(0.0))
    assert abs(float(ode_contact.contact_state_at(of, length(of)).work)) < 1e-12


def test_turning_points_agree_with_the_search():
    """In a long contact the membrane swings: its deepest point, and the shallowest point between the swings."""
    pair = vijax.impact_pair(0.2, 9.0, 0.9, -0.9)
    side, t, speed = map(jnp.asarray, (1.0, 0.1, 0.05))
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, side, t)
    contact_duration = jnp.asarray(1.2)
    expected = contact_search.turning_points(
        wall, force, 0.0 * t, speed, jnp.asarray(True), contact_duration=contact_duration
    )
    assert np.isfinite(expected.lowest)
    turns = ode_contact.turning_points(onset(pair, Linear(), side, t, speed), contact_duration)
    np.testing.assert_allclose(turns.crest, expected.crest, atol=1e-9)
    np.testing.assert_allclose(turns.trough, expected.trough, atol=1e-9)
    np.testing.assert_allclose(turns.lowest, expected.lowest, atol=1e-12)
    assert not turns.failed


@pytest.mark.parametrize("contact_duration", [0.08, 0.3, 0.6, 1.0])
def test_the_error_estimate_is_no_smaller_than_the_error(contact_duration):
    """Up to 13 swings in a contact: 32 steps lose five digits of them."""
    of, contact_duration = onset(vijax.impact_pair(0.2, 40.0, 0.9, -0.9), Linear()), jnp.asarray(contact_duration)
    wall = flow.membrane(vijax.impact_pair(0.2, 40.0, 0.9, -0.9))
    w, z = flow.oscillate(wall, flow.contact_force(jnp.asarray(-0.9), of.side, of.t), 0.0, of.speed, contact_duration)
    there = ode_contact.contact_state_at(of, contact_duration)
    off = max(abs(float(there.w - w)) / float(contact_duration), abs(float(there.z - z)))
    estimate = float(ode_contact.error_estimate(of, contact_duration))
    assert off <= 1.1 * estimate + 1e-14
    assert estimate < 20 * off + 1e-14


def test_a_contact_without_a_turning_point_fails():
    turns = ode_contact.turning_points(onset(SOFT, Linear()), jnp.asarray(0.001))
    assert turns.failed
    assert turns.lowest == np.inf


def test_parameters_of_a_law_are_broadcast_to_all_cells():
    class Sum(vijax.MembraneLaw):
        weights: jax.Array

        def acceleration(self, pair, w, z):
            return -(pair.kappa**2) * (self.weights[0] * w + self.weights[1] * w**3) - pair.mu * z

    broadcast = with_law(vijax.impact_pair([0.2, 0.3], 40.0, 0.5), Sum(jnp.array([1.0, 500.0])))
    assert broadcast.law.weights.shape == (2, 2)
    assert with_law(SOFT, Linear()) is SOFT
    assert with_law(SOFT, None) is SOFT


@pytest.mark.parametrize(
    ("pair", "law", "message"),
    [
        (vijax.impact_pair(0.2, None, 0.5), vijax.Hyperelastic(1.5, 0.02), "membrane must be left out with a rigid"),
        (vijax.impact_pair(0.2, vijax.Sides(40.0, None), 0.5), vijax.Hyperelastic(1.5, 0.02), "membrane must be left"),
        (SOFT, vijax.HuntCrossley(0.5), "r must be None with a membrane that takes none"),
        (WITHOUT_RESTITUTION, vijax.Hyperelastic(1.5, 0.02), "r must be None with a membrane that takes none"),
        (SOFT, 3.0, "membrane must be a vijax.HuntCrossley"),
    ],
)
def test_membranes_that_do_not_fit_the_pair_are_rejected(pair, law, message):
    with pytest.raises(ValueError, match=message):
        with_law(pair, law)
