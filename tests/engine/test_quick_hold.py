"""Contacts that gravity prolongs: where the quick step is sure of their end and of their depth, both are right."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import long_contact, pairs
from vijax.engine import quick, quick_wall
from vijax.engine.ground import Ground
from vijax.engine.impact import Ball
from vijax.model import flow

COUNT, ROUNDS, SAMPLES = 8192, 8, 200


def hops(rng):
    """Slow balls off the wall that gravity presses them onto, so fast as the membrane lets them swing a little."""
    kappa, r = np.exp(rng.uniform(np.log(5), np.log(200), COUNT)), rng.uniform(0.05, 0.95, COUNT)
    gamma = rng.uniform(0.2, 0.98, COUNT) * rng.choice([-1, 1], COUNT)
    speed, t = np.exp(rng.uniform(-2.5, 2, COUNT)) / kappa, rng.uniform(0, 2, COUNT)
    return pairs(rng.uniform(0.05, 0.3, COUNT), kappa, r, gamma), speed, t


@jax.jit
def penetrations(pair, hit):
    """Compute w at many times of contacts, by the closed form."""
    wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, hit.side, hit.onset_t)
    at = jnp.linspace(0, 1, SAMPLES, endpoint=False)[1:, None] * hit.duration
    return jax.vmap(lambda s: flow.oscillate(wall, force, jnp.zeros_like(s), hit.side * hit.v_in, s)[0])(at)


@partial(jax.jit, static_argnames="deep")
def step(pair, ball, deep):
    wall = quick_wall.prepare(pair, ground=Ground.STEEP)
    found = quick.quick_step(wall, pair.gamma, ball, deep=deep, work=deep, tangent=True)
    return found.impact, found.sure, penetrations(pair, found.impact)


def leave(pair, side, v, t, deep):
    """Let balls leave a wall, and see what comes of it."""
    given = Ball(*(jnp.asarray(x) for x in (0.5 * side * pair.d, -side * v, t, 0 * t)))
    return jax.tree.map(np.asarray, step(jax.tree.map(jnp.asarray, pair), given, deep))


@pytest.fixture(scope="module", params=[False, True], ids=["exit", "depth"])
def prolonged(request):
    """Sure contacts of hops that outlast the free one: the cells, the impacts, how deep they are at many times."""
    rng, parts = np.random.default_rng(11), []
    for _ in range(ROUNDS):
        pair, v, t = hops(rng)
        hit, sure, w = leave(pair, -np.sign(pair.gamma), v, t, request.param)
        keep = sure & (free_contacts(pair, hit) > 1.05)
        parts.append(jax.tree.map(lambda leaf, keep=keep: leaf[keep], (pair, hit, w.T)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def free_contacts(pair, hit):
    """How many free contacts each lasts."""
    return hit.duration * pair.kappa / np.hypot(np.pi, np.log(pair.r))


def test_they_are_many_and_of_both_kinds(prolonged):
    pair, hit, _ = prolonged
    length = free_contacts(pair, hit)
    assert length.size > 0.1 * COUNT * ROUNDS
    assert np.mean(length > 3) > 0.2
    assert np.mean(length < 2) > 0.1


def test_each_ends_at_its_first_zero(prolonged):
    pair, hit, w = prolonged
    assert np.min(w * pair.kappa[:, None] ** 2) > 0
    some = slice(0, 4096)
    pair, hit = jax.tree.map(lambda leaf: leaf[some], (pair, hit))
    state = (pair.kappa, pair.r, pair.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, hit.duration)
    end, rate = long_contact(*state)
    assert np.max(np.abs(end)) < 1e-14
    assert np.max(np.abs(rate - hit.side * hit.v_out)) < 1e-12
    log_r = np.log(pair.r)
    omega1 = pair.kappa * np.pi / np.hypot(np.pi, log_r)
    h = np.exp(log_r * free_contacts(pair, hit)) * np.sin(omega1 * hit.duration) / omega1
    assert np.max(np.abs(hit.tangent[2] / pair.kappa**2 + h)) < 1e-12


def test_none_is_deeper_than_its_first_crest(prolonged):
    pair, hit, w = prolonged
    if hit.depth is not None:
        share = w.max(axis=1) / hit.depth
        assert np.max(share) < 1 + 1e-12
        assert np.min(share[free_contacts(pair, hit) < 5]) > 0.99


def test_crests_far_from_the_free_one_are_found():
    """With one round of sines to the crest 0.61 of the steps are sure."""
    rng, shares = np.random.default_rng(11), []
    for _ in range(ROUNDS):
        pair, v, t = hops(rng)
        shares.append(leave(pair, -np.sign(pair.gamma), v, t, True)[1].mean())
    assert np.mean(shares) > 0.63


def test_a_contact_that_ends_slowly_is_sure():
    """With one correction of the step to its exit it is declined."""
    d, kappa, r, gamma = 0.06441284123535639, 42.86727297639803, 0.639641708545424, 0.9102778815739276
    v, t = np.full(COUNT, 0.005376395230627496), np.full(COUNT, 0.018888211608415917)
    hit, sure, w = leave(pairs(np.full(COUNT, d), kappa, r, gamma), -np.ones(COUNT), v, t, False)
    assert sure.all()
    assert w.min() > 0
    assert np.max(hit.v_out / hit.v_in) < 0  # It leaves the wall that it meets.


@pytest.mark.long
def test_a_contact_that_just_ends_at_the_first_low_has_no_later_end():
    """One of three million: its w is below zero for a moment, and would be said to end where it is so again."""
    d, kappa, r, gamma = 0.20003687089776961, 17.661471184654324, 0.08972374016170381, 0.48703763561527846
    pair = pairs(np.full(COUNT, d), kappa, r, gamma)
    v, t = np.full(COUNT, 0.00308047696298712), np.full(COUNT, 0.74201334413739)
    hit, sure, w = leave(pair, np.ones(COUNT), v, t, False)
    assert w[:, 0].min() < 0
    assert not sure.any()
    assert hit.side[0] == -1
