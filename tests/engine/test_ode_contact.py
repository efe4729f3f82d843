"""Contacts of known length with membranes of any law: against closed forms, SciPy's DOP853, and their own order."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import vijax
from vijax.engine import contact_search, ode_contact
from vijax.model import flow
from vijax.model.membrane import Linear, with_law

SOFT = vijax.impact_pair(0.2, 40.0, 0.5, 0.1)
LOSSY = replace(SOFT, r=None)
LAWS = {
    "hertz": (LOSSY, vijax.HuntCrossley(0.2)),
    "between": (LOSSY, vijax.HuntCrossley(0.5, 2.2)),
    "rubber": (SOFT, vijax.Hyperelastic(1.5, 0.02, 4.0)),
}


def onset(pair, law, side=1.0, t=0.3, speed=0.7):
    """A contact that a ball begins."""
    return ode_contact.contact(replace(pair, law=law), *map(jnp.asarray, (side, t, speed)))


def length(of):
    """How long a contact lasts."""
    s, states = ode_contact.course(of, jnp.asarray(0.6), 400)
    first = int(np.argmax(np.asarray(states.w) < 0))
    low, high = (float(x) for x in s[first - 1 : first + 1])
    return jnp.asarray(brentq(lambda s: float(ode_contact.held(of, jnp.asarray(s), 128).w), low, high, xtol=1e-15))


@pytest.mark.parametrize(
    ("kappa", "side", "t", "speed", "stay"),
    [
        (3.0, 1.0, 0.3, 0.7, 0.8),
        (40.0, -1.0, 1.7, 0.2, 0.07),
        (400.0, 1.0, 0.9, 1.3, 0.008),
        (25.0, -1.0, 0.2, 0.0, 0.2),
    ],
)
def test_a_spring_of_steps_is_that_of_closed_forms(kappa, side, t, speed, stay):
    pair = vijax.impact_pair(0.2, kappa, 0.6, 0.1)
    of, stay = onset(pair, Linear(), side, t, speed), jnp.asarray(stay)
    wall = flow.membrane(pair)

    def closed(onset):
        return jnp.stack(flow.oscillate(wall, flow.contact_force(pair.gamma, side, onset[0]), 0.0, onset[1], onset[2]))

    end = ode_contact.end(of, stay)
    slopes = jax.jacfwd(closed)(jnp.stack([of.t, of.speed, stay]))
    np.testing.assert_allclose((end.w, end.z), closed((of.t, of.speed, stay)), rtol=0, atol=3e-12)
    np.testing.assert_allclose((end.w_slope, end.z_slope), slopes, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(ode_contact.tangent(of, stay), flow.contact_matrix(wall, stay), rtol=1e-10, atol=1e-11)
    lost = 0.5 * float(of.speed**2 - end.z**2)
    np.testing.assert_allclose(
        ode_contact.held(of, stay).work, lost + _forced(pair, side, t, speed, stay), rtol=1e-10, atol=1e-12
    )


def _forced(pair, side, t, speed, stay):
    """What the forcing gives to a ball within a contact, by quadrature."""
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, side, t)
    x, weight = np.polynomial.legendre.leggauss(64)
    s = 0.5 * stay * (x + 1)
    rate = np.array([float(flow.oscillate(wall, force, 0.0, speed, one)[1]) for one in s])
    return 0.5 * stay * np.sum(weight * rate * side * (np.cos(np.pi * (t + s)) - float(pair.gamma)))


@pytest.mark.parametrize("name", LAWS)
def test_contacts_are_those_of_another_solver(name):
    of = onset(*LAWS[name], side=-1.0, t=1.4)
    stay = length(of)

    def field(s, y):
        pull = float(of.wall(*map(jnp.asarray, y[:2])))
        return y[1], float(of.push(jnp.asarray(s))) + pull, -pull * y[1]

    # As close as the solver comes to w = 0, where the force of Hertz is not smooth.
    run = solve_ivp(field, (0, float(stay)), (0, 0.7, 0), method="DOP853", rtol=3e-13, atol=1e-14)
    np.testing.assert_allclose(tuple(ode_contact.held(of, stay)), run.y[:, -1], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", LAWS)
def test_the_order_is_that_of_smooth_forces(name):
    of = onset(*LAWS[name])
    stay = length(of)
    exact = ode_contact.held(of, stay, 1024)
    off = [max(abs(float(a - b)) for a, b in zip(ode_contact.held(of, stay, n), exact, strict=True)) for n in (8, 16)]
    # Eight for a power series; for w^2.2, which is none in the root of time, what is left of that.
    assert off[0] / off[1] > 2**6
    assert float(ode_contact.error(of, stay)) < 1e-10


@pytest.mark.parametrize("name", LAWS)
def test_the_tangent_map_is_that_of_neighbours(name):
    """A ball that is a little off in flight meets the wall a little earlier, and leaves it so."""
    of = onset(*LAWS[name])
    stay = length(of)

    def after(w, z):
        """Where a ball is, flown on as if there were no wall, that was there at the time of the onset."""
        # Back or on to the wall, by flight.
        early = brentq(lambda s: w + z * s + _fall(of, 0.0, s)[0], -0.1, 0.1, xtol=1e-16)
        speed = z + _fall(of, 0.0, early)[1]
        one = onset(*LAWS[name], t=0.3 + early, speed=speed)
        left = length(one)
        rate = float(ode_contact.held(one, left, 128).z)
        rest = float(stay) - early - float(left)
        fallen, faster = _fall(one, float(left), rest)
        return np.array([rate * rest + fallen, rate + faster])

    step = 1e-4
    columns = [
        (after(step, 0.7) - after(-step, 0.7)) / (2 * step),
        (after(0.0, 0.7 + step) - after(0.0, 0.7 - step)) / (2 * step),
    ]
    np.testing.assert_allclose(ode_contact.tangent(of, stay), np.stack(columns, axis=1), rtol=2e-5, atol=2e-5)


def _fall(of, begin, s):
    """How far, and how much faster, a ball goes by the forcing alone."""
    x, weight = np.polynomial.legendre.leggauss(16)
    when = begin + 0.5 * s * (x + 1)
    push = np.array(jax.vmap(of.push)(jnp.asarray(when)))
    return 0.5 * s * np.sum(weight * push * (begin + s - when)), 0.5 * s * np.sum(weight * push)


def test_a_spring_without_loss_gives_back_what_it_got():
    of = onset(LOSSY, vijax.HuntCrossley(0.0))
    assert abs(float(ode_contact.held(of, length(of)).work)) < 1e-12


def test_turning_points_are_those_of_the_search():
    """A long contact that a membrane swings in: its deepest point, and its shallowest between."""
    pair = vijax.impact_pair(0.2, 9.0, 0.9, -0.9)
    side, t, speed = map(jnp.asarray, (1.0, 0.1, 0.05))
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, side, t)
    stay = jnp.asarray(1.2)
    known = contact_search.turning_points(wall, force, 0.0 * t, speed, jnp.asarray(True), length=stay)
    assert np.isfinite(known.lowest)
    turns = ode_contact.turns(onset(pair, Linear(), side, t, speed), stay)
    np.testing.assert_allclose(turns.crest, known.crest, atol=1e-9)
    np.testing.assert_allclose(turns.trough, known.trough, atol=1e-9)
    np.testing.assert_allclose(turns.lowest, known.lowest, atol=1e-12)
    assert not turns.lost


@pytest.mark.parametrize("stay", [0.08, 0.3, 0.6, 1.0])
def test_the_error_that_is_told_is_no_smaller_than_the_true_one(stay):
    """Up to 13 swings in a contact, of which 32 steps lose five digits."""
    of, stay = onset(vijax.impact_pair(0.2, 40.0, 0.9, -0.9), Linear()), jnp.asarray(stay)
    wall = flow.membrane(vijax.impact_pair(0.2, 40.0, 0.9, -0.9))
    w, z = flow.oscillate(wall, flow.contact_force(jnp.asarray(-0.9), of.side, of.t), 0.0, of.speed, stay)
    there = ode_contact.held(of, stay)
    off = max(abs(float(there.w - w)) / float(stay), abs(float(there.z - z)))
    told = float(ode_contact.error(of, stay))
    assert off <= 1.1 * told + 1e-14
    assert told < 20 * off + 1e-14


def test_a_contact_without_a_turning_point_is_lost():
    turns = ode_contact.turns(onset(SOFT, Linear()), jnp.asarray(0.001))
    assert turns.lost
    assert turns.lowest == np.inf


def test_numbers_of_a_law_are_those_of_every_cell():
    class Sum(vijax.MembraneLaw):
        weights: jax.Array

        def acceleration(self, pair, w, z):
            return -(pair.kappa**2) * (self.weights[0] * w + self.weights[1] * w**3) - pair.mu * z

    given = with_law(vijax.impact_pair([0.2, 0.3], 40.0, 0.5), Sum(jnp.array([1.0, 500.0])))
    assert given.law.weights.shape == (2, 2)
    assert with_law(SOFT, Linear()) is SOFT
    assert with_law(SOFT, None) is SOFT


@pytest.mark.parametrize(
    ("pair", "law", "said"),
    [
        (vijax.impact_pair(0.2, None, 0.5), vijax.Hyperelastic(1.5, 0.02), "membrane must be left out with a rigid"),
        (vijax.impact_pair(0.2, vijax.Sides(40.0, None), 0.5), vijax.Hyperelastic(1.5, 0.02), "membrane must be left"),
        (SOFT, vijax.HuntCrossley(0.5), "r must be None with a membrane that takes none"),
        (LOSSY, vijax.Hyperelastic(1.5, 0.02), "r must be None with a membrane that takes none"),
        (SOFT, 3.0, "membrane must be a vijax.HuntCrossley"),
    ],
)
def test_membranes_that_a_pair_cannot_have_are_refused(pair, law, said):
    with pytest.raises(ValueError, match=said):
        with_law(pair, law)
