"""Gravity-prolonged contacts: the certified ends and depths of the fast step are right."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import long_contact, pairs
from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import BallState
from vijax.model import flow

COUNT, ROUNDS, SAMPLES = 8192, 8, 200


def hops(rng):
    """Return slow balls on the wall that gravity presses them onto; their speeds allow a few swings in the membrane."""
    kappa, r = np.exp(rng.uniform(np.log(5), np.log(200), COUNT)), rng.uniform(0.05, 0.95, COUNT)
    gamma = rng.uniform(0.2, 0.98, COUNT) * rng.choice([-1, 1], COUNT)
    speed, t = np.exp(rng.uniform(-2.5, 2, COUNT)) / kappa, rng.uniform(0, 2, COUNT)
    return pairs(rng.uniform(0.05, 0.3, COUNT), kappa, r, gamma), speed, t


@jax.jit
def penetrations(pair, hit):
    """Return w at many times of the contacts, by the closed form."""
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, hit.side, hit.onset_t)
    at = jnp.linspace(0, 1, SAMPLES, endpoint=False)[1:, None] * hit.duration
    return jax.vmap(lambda s: flow.oscillate(wall, force, jnp.zeros_like(s), hit.side * hit.v_in, s)[0])(at)


@partial(jax.jit, static_argnames="deep")
def step(pair, ball, deep):
    wall = fast_walls.prepare_walls(pair, gravity_regime=GravityRegime.STRONG)
    outcome = fast_step.fast_step(wall, pair.gamma, ball, deep=deep, work=deep, tangent=True)
    return outcome.impact, outcome.certified, penetrations(pair, outcome.impact)


def leave(pair, side, v, t, deep):
    """Start balls at a wall and return the results of the step."""
    balls = BallState(*(jnp.asarray(x) for x in (0.5 * side * pair.d, -side * v, t, 0 * t)))
    return jax.tree.map(np.asarray, step(jax.tree.map(jnp.asarray, pair), balls, deep))


@pytest.fixture(scope="module", params=[False, True], ids=["exit", "depth"])
def long_contacts(request):
    """Certified contacts of hops, longer than the free contact: the cells, the impacts, the depths at many times."""
    rng, parts = np.random.default_rng(11), []
    for _ in range(ROUNDS):
        pair, v, t = hops(rng)
        hit, certified, w = leave(pair, -np.sign(pair.gamma), v, t, request.param)
        keep = certified & (free_contacts(pair, hit) > 1.05)
        parts.append(jax.tree.map(lambda leaf, keep=keep: leaf[keep], (pair, hit, w.T)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def free_contacts(pair, hit):
    """Return the duration of each contact in units of the free contact."""
    return hit.duration * pair.kappa / np.hypot(np.pi, np.log(pair.r))


def test_certified_contacts_are_many_and_of_both_kinds(long_contacts):
    pair, hit, _ = long_contacts
    length = free_contacts(pair, hit)
    assert length.size > 0.1 * COUNT * ROUNDS
    assert np.mean(length > 3) > 0.2
    assert np.mean(length < 2) > 0.1


def test_contacts_end_at_their_first_zero(long_contacts):
    pair, hit, w = long_contacts
    assert np.min(w * pair.kappa[:, None] ** 2) > 0
    sample = slice(0, 4096)
    pair, hit = jax.tree.map(lambda leaf: leaf[sample], (pair, hit))
    state = (pair.kappa, pair.r, pair.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, hit.duration)
    end, rate = long_contact(*state)
    assert np.max(np.abs(end)) < 1e-14
    assert np.max(np.abs(rate - hit.side * hit.v_out)) < 1e-12
    log_r = np.log(pair.r)
    omega1 = pair.kappa * np.pi / np.hypot(np.pi, log_r)
    h = np.exp(log_r * free_contacts(pair, hit)) * np.sin(omega1 * hit.duration) / omega1
    assert np.max(np.abs(hit.tangent[2] / pair.kappa**2 + h)) < 1e-12


def test_no_contact_is_deeper_than_its_first_crest(long_contacts):
    pair, hit, w = long_contacts
    if hit.depth is not None:
        share = w.max(axis=1) / hit.depth
        assert np.max(share) < 1 + 1e-12
        assert np.min(share[free_contacts(pair, hit) < 5]) > 0.99


def test_crests_far_from_the_free_crest_are_located():
    """With one round of sines to the crest, 0.61 of the steps are certified."""
    rng, shares = np.random.default_rng(11), []
    for _ in range(ROUNDS):
        pair, v, t = hops(rng)
        shares.append(leave(pair, -np.sign(pair.gamma), v, t, True)[1].mean())
    assert np.mean(shares) > 0.63


def test_a_contact_that_ends_slowly_is_certified():
    """With one correction of the step to its exit, this contact is not certified."""
    d, kappa, r, gamma = 0.06441284123535639, 42.86727297639803, 0.639641708545424, 0.9102778815739276
    v, t = np.full(COUNT, 0.005376395230627496), np.full(COUNT, 0.018888211608415917)
    hit, certified, w = leave(pairs(np.full(COUNT, d), kappa, r, gamma), -np.ones(COUNT), v, t, False)
    assert certified.all()
    assert w.min() > 0
    assert np.max(hit.v_out / hit.v_in) < 0  # The ball leaves the wall that it entered.


@pytest.mark.long
def test_a_contact_that_just_ends_at_the_first_minimum_has_no_later_end():
    """One contact of three million: w is below zero for a moment; without a certificate the next zero would result."""
    d, kappa, r, gamma = 0.20003687089776961, 17.661471184654324, 0.08972374016170381, 0.48703763561527846
    pair = pairs(np.full(COUNT, d), kappa, r, gamma)
    v, t = np.full(COUNT, 0.00308047696298712), np.full(COUNT, 0.74201334413739)
    hit, certified, w = leave(pair, np.ones(COUNT), v, t, False)
    assert w[:, 0].min() < 0
    assert not certified.any()
    assert hit.side[0] == -1
