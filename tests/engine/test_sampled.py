"""Certified sampling: where it is sure it is right, whatever walls, gravity and restitution; it often is sure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import TILE, both_ways, long_contact, march, pairs, start
from vijax.engine import exact, sampled
from vijax.engine.impact import Arrival, Ball
from vijax.engine.sampling import joined, least
from vijax.model.records import State
from vijax.runtime.unrolled import unrolled

RESTITUTIONS, SLOPES = [0.05, 0.2, 0.5, 0.9, 0.99, 1.0], [0.0, 0.1, -0.5, 1.2]
SURE = {"plane": 0.97, "wide": 0.65, "rigid": 0.65}  # least share of the impacts, a few per cent below the measured


def cells(kind, rng):
    if kind == "plane":
        return rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(np.log(3), np.log(400), TILE)), 0.5, 0.0
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e4), TILE)) if kind == "wide" else None
    d = np.exp(rng.uniform(np.log(0.01), np.log(2), TILE))
    return d, kappa, rng.choice(RESTITUTIONS, TILE), rng.choice(SLOPES, TILE)


@pytest.fixture(scope="module", params=list(SURE))
def both(request):
    """Exact steps of drawn trajectories, and the sampled step from each of their states."""
    rng = np.random.default_rng(11)
    d, kappa, r, gamma = cells(request.param, rng)
    pair = pairs(d, kappa, r, gamma)
    ran = march(pair, start(rng.uniform(-0.45, 0.45, TILE) * d, rng.uniform(-0.7, 0.7, TILE), rng.uniform(0, 2, TILE)))
    many = ran.out.flight.shape[1]
    flat = jax.tree.map(lambda x: x.reshape(TILE * many, *x.shape[2:]), ran)
    program = jax.jit(lambda pair, lane: sampled.sampled_step(pair, lane, deep=True, work=True, tangent=True))
    parts = []
    # In batches as small as the lanes serve: a sampled step holds some dozens of samples a lane.
    for k in range(many):
        lane = Ball(*(jnp.asarray(getattr(ran.before, name)[:, k], float) for name in ("u", "v", "t", "n")))
        parts.append(jax.tree.map(np.asarray, program(jax.tree.map(jnp.asarray, pair), lane)))
    hit, sure = jax.tree.map(lambda *x: np.stack(x, axis=1).reshape(TILE * many), *parts)
    return request.param, flat, hit, sure


@pytest.mark.parametrize("count", [1, 2, 31, 32])
def test_samples_are_joined_however_many(count):
    samples = jnp.asarray(np.random.default_rng(count).normal(size=(count, 5)))
    np.testing.assert_array_equal(least(samples), samples.min(axis=0))
    order = jnp.arange(count, dtype=float)[:, None] + jnp.zeros(5)
    height, when = joined(sampled._higher_of, (samples, order))
    np.testing.assert_array_equal((height, when), (samples.max(axis=0), samples.argmax(axis=0)))


@pytest.mark.parametrize("places", [(3, 17), (15, 16), (1, 30, 31)])
def test_of_equal_samples_the_first_is_the_highest(places):
    heights = jnp.zeros((32, 1)).at[jnp.asarray(places)].set(1.0)
    _, when = joined(sampled._higher_of, (heights, jnp.arange(32.0)[:, None]))
    assert when == places[0]


def test_where_sure_it_agrees_with_the_exact_step(both):
    kind, exact, hit, sure = both
    out, impact = exact.out, exact.out.impact
    assert np.all(impact.side[sure] != 0)
    assert not np.any(out.stuck[sure])
    assert np.array_equal(hit.side[sure], impact.side[sure])
    speed = np.minimum(np.abs(impact.v_in), 1)
    clock = 2 * hit.onset_n + hit.onset_t - 2 * impact.n - impact.t
    for name, (got, want) in (both_ways(hit, out) | {"onset": (clock, 0 * clock)}).items():
        assert np.max(np.abs(got - want)[sure] * speed[sure]) < 1e-12, (kind, name)
    got, want = np.stack(hit.tangent, axis=1), exact.tangent.reshape(-1, 4)
    size = np.maximum(1, np.linalg.norm(want, axis=1))
    # A rounding of the duration turns the map by kappa times that.
    assert np.max((np.abs(got - want).max(axis=1) / size * np.abs(impact.v_in))[sure]) < 1e-11


def test_it_is_sure_of_most_steps(both):
    kind, exact, _, sure = both
    impacts = exact.out.impact.side != 0
    assert sure[impacts].mean() > SURE[kind]


@jax.jit
def deep_step(pair, lane):
    return sampled.sampled_step(pair, lane, deep=True, work=True)


def lanes(u, v, t):
    return Ball(*(jnp.asarray(np.resize(x, TILE), float) for x in (u, v, t, 0.0)))


# Gap, stiffness, restitution, slope, speed off the left wall and phase. Of two crests of such a contact, half a pass of
# samples apart, the later has the higher sample and is lower by 3e-4 of its height.
RIVALS = np.array(
    [
        (
            0.19614113245211967,
            32.66422103242416,
            0.9288353416838601,
            0.18850543591307128,
            0.00020460711682489854,
            0.5829541238242877,
        ),
        (
            0.05881831292187383,
            31.528484742074,
            0.976772673958856,
            1.3866717889362103,
            0.0001745899331999761,
            0.3785440530057138,
        ),
    ]
)


def pressed(rng):
    """Balls that fall slowly on a membrane and that gravity holds there, some for dozens of swings; two hard cases."""
    d, kappa, r = np.full(TILE, 0.2), np.exp(rng.uniform(np.log(5), np.log(300), TILE)), rng.uniform(0.1, 0.95, TILE)
    gamma, speed = rng.uniform(0.2, 1.2, TILE), np.exp(rng.uniform(-7, 0, TILE)) / np.sqrt(kappa)
    t = rng.uniform(0, 2, TILE)
    for column, some in zip((d, kappa, r, gamma, speed, t), RIVALS.T, strict=True):
        column[: some.size] = some
    return pairs(d, kappa, r, gamma), -0.5 * d, speed, t


def test_contacts_that_gravity_prolongs_are_sampled_where_they_may_end():
    longest, shares = 0.0, []
    for seed in range(8):
        pair, u, v, t = pressed(np.random.default_rng(seed))
        hit, sure = jax.tree.map(np.asarray, deep_step(jax.tree.map(jnp.asarray, pair), lanes(u, v, t)))
        shares.append(sure.mean())
        cell, hit = jax.tree.map(lambda x, sure=sure: x[sure, None], (pair, hit))
        s = hit.duration * np.linspace(0, 1, 20_001)  # the longest contact's swings have 200 of them each
        state = (cell.kappa, cell.r, cell.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, s)
        w, _ = long_contact(*state)
        assert np.max(np.abs(w.max(axis=1) / hit.depth[:, 0] - 1)) < 2e-5
        longest = max(longest, float(np.max(hit.duration * cell.kappa)) / np.pi)
    assert np.mean(shares) > 0.55
    assert longest > 50


def off_the_left_wall(kappas, speeds, count=512):
    """Sampled and exact steps of balls that fall on the left wall of a narrow gap, at any phase."""
    rng = np.random.default_rng(5)
    kappa, v, t = rng.uniform(*kappas, count), rng.uniform(*speeds, count), rng.uniform(0, 2, count)
    pair = jax.tree.map(jnp.asarray, pairs(np.full(count, 0.06), kappa, np.full(count, 0.5), np.zeros(count)))
    at = [jnp.asarray(np.resize(x, count), float) for x in (-0.03, v, t)]
    still = jnp.zeros(count, jnp.int32)
    step = jax.jit(jax.vmap(lambda pair, state: exact.step(pair, state, jnp.asarray(100.0))))
    sample = jax.jit(lambda pair, lane: sampled.sampled_step(pair, lane, deep=True, work=True))
    return sample(pair, Ball(*at, jnp.zeros(count))), step(pair, State(*at, still, still)).impact


@pytest.mark.long
def test_close_to_resonance_few_contacts_are_in_doubt():
    """There a large swing and a large response all but cancel, and bounds that add them up say nothing: 13 % were."""
    (hit, sure), impact = off_the_left_wall(kappas=(2.6, 3.8), speeds=(0.1, 0.5))
    assert np.mean(sure) > 0.97
    np.testing.assert_allclose(hit.depth[sure], impact.depth[sure], rtol=1e-12)


@pytest.mark.long
def test_on_an_accelerator_no_slow_exit_is_in_doubt(monkeypatch):
    """Where the ball all but stays, the chord between two samples is a poor guess of when it leaves: 9 % were."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    (hit, sure), impact = off_the_left_wall(kappas=(8, 15), speeds=(0.05, 0.4), count=4096)
    slow = np.abs(impact.v_out) < 0.1 * np.abs(impact.v_in)
    assert slow.sum() > 50
    assert np.all(sure[slow])
    np.testing.assert_allclose(hit.v_out[slow], impact.v_out[slow], rtol=1e-11)


@pytest.mark.long
def test_an_accelerator_finds_the_same_lane_by_lane(monkeypatch):
    """There the step is a kernel that knows single lanes alone, and looks samples up in another way."""
    pair, u, v, t = pressed(np.random.default_rng(4))
    given = jax.tree.map(jnp.asarray, pair), lanes(u, v, t)
    plain = deep_step(*given)
    leaves, tree = jax.tree.flatten(given)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    @jax.jit
    def lane_by_lane(*leaves):
        return unrolled(
            lambda some: sampled.sampled_step(*jax.tree.unflatten(tree, some), deep=True, work=True), list(leaves)
        )

    hit, sure = jax.tree.unflatten(jax.tree.structure(plain), lane_by_lane(*leaves))
    assert np.mean(plain[1]) > 0.5
    assert np.all(np.asarray(sure) >= np.asarray(plain[1]))  # it polishes exits once more
    sure = plain[1]
    for name in ("flight", "duration", "v_out", "depth", "work"):
        got, want = (np.asarray(getattr(one, name))[np.asarray(sure)] for one in (hit, plain[0]))
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-14)


def test_flights_that_are_not_sure_are_sampled_where_asked_for():
    """A flight that is known for sure is taken as it is told, however wrong; another is looked for where asked for."""
    pair, u, v, t = pressed(np.random.default_rng(3))
    pair, lane = jax.tree.map(jnp.asarray, pair), lanes(u, v, t)
    found, certain = jax.tree.map(np.asarray, deep_step(pair, lane))
    known = np.arange(TILE) % 2 == 0
    told = Arrival(
        jnp.where(known, found.flight + 0.125, 0.0),
        jnp.asarray(found.side * found.v_in),
        found.side,
        jnp.asarray(known),
    )
    for unsure in (False, True):
        hit, sure = sampled.sampled_step(pair, lane, told, unsure=unsure, deep=True, work=True)
        assert np.array_equal(np.asarray(hit.flight)[known], found.flight[known] + 0.125)
        if not unsure:
            assert not np.any(np.asarray(sure)[~known])
    assert np.array_equal(np.asarray(sure)[~known], certain[~known])
    assert np.max(np.abs(np.asarray(hit.flight) - found.flight)[~known & certain]) < 1e-13
