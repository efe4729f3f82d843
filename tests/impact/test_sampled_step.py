"""The sampled step: its certified results are right at any walls, gravity and restitution, and most are certified."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import TILE, fast_and_exact, long_contact, march, pairs, start
from vijax.impact.exact import exact_step, sampled_step
from vijax.impact.exact.crossing_samples import reduce_samples, smallest_sample
from vijax.impact.impact import Arrival, BallState
from vijax.model.records import State
from vijax.runtime.compilation.lane_unrolling import unrolled

RESTITUTIONS, SLOPES = [0.05, 0.2, 0.5, 0.9, 0.99, 1.0], [0.0, 0.1, -0.5, 1.2]
# Least certified share of the impacts, a few per cent below the measured share.
MIN_CERTIFIED = {"plane": 0.97, "wide": 0.65, "rigid": 0.65}


def cells(kind, rng):
    if kind == "plane":
        return rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(np.log(3), np.log(400), TILE)), 0.5, 0.0
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e4), TILE)) if kind == "wide" else None
    d = np.exp(rng.uniform(np.log(0.01), np.log(2), TILE))
    return d, kappa, rng.choice(RESTITUTIONS, TILE), rng.choice(SLOPES, TILE)


@pytest.fixture(scope="module", params=list(MIN_CERTIFIED))
def both(request):
    """Exact steps of random trajectories, and the sampled step from each of their states."""
    rng = np.random.default_rng(11)
    d, kappa, r, gamma = cells(request.param, rng)
    pair = pairs(d, kappa, r, gamma)
    ran = march(pair, start(rng.uniform(-0.45, 0.45, TILE) * d, rng.uniform(-0.7, 0.7, TILE), rng.uniform(0, 2, TILE)))
    many = ran.out.flight.shape[1]
    flat = jax.tree.map(lambda x: x.reshape(TILE * many, *x.shape[2:]), ran)
    program = jax.jit(lambda pair, lane: sampled_step.sampled_step(pair, lane, deep=True, work=True, tangent=True))
    parts = []
    # One batch per impact: the sampled step stores some dozens of samples per lane.
    for k in range(many):
        lane = BallState(*(jnp.asarray(getattr(ran.before, name)[:, k], float) for name in ("u", "v", "t", "n")))
        parts.append(jax.tree.map(np.asarray, program(jax.tree.map(jnp.asarray, pair), lane)))
    hit, certified = jax.tree.map(lambda *x: np.stack(x, axis=1).reshape(TILE * many), *parts)
    return request.param, flat, hit, certified


@pytest.mark.parametrize("count", [1, 2, 31, 32])
def test_any_number_of_samples_is_reduced(count):
    samples = jnp.asarray(np.random.default_rng(count).normal(size=(count, 5)))
    np.testing.assert_array_equal(smallest_sample(samples), samples.min(axis=0))
    order = jnp.arange(count, dtype=float)[:, None] + jnp.zeros(5)
    height, when = reduce_samples(sampled_step._higher_of, (samples, order))
    np.testing.assert_array_equal((height, when), (samples.max(axis=0), samples.argmax(axis=0)))


@pytest.mark.parametrize("places", [(3, 17), (15, 16), (1, 30, 31)])
def test_the_first_of_equal_samples_is_the_highest(places):
    heights = jnp.zeros((32, 1)).at[jnp.asarray(places)].set(1.0)
    _, when = reduce_samples(sampled_step._higher_of, (heights, jnp.arange(32.0)[:, None]))
    assert when == places[0]


def test_certified_impacts_agree_with_the_exact_step(both):
    kind, exact, hit, certified = both
    out, impact = exact.out, exact.out.impact
    assert np.all(impact.side[certified] != 0)
    assert not np.any(out.stuck[certified])
    assert np.array_equal(hit.side[certified], impact.side[certified])
    speed = np.minimum(np.abs(impact.v_in), 1)
    clock = 2 * hit.onset_n + hit.onset_t - 2 * impact.n - impact.t
    for name, (got, want) in (fast_and_exact(hit, out) | {"onset": (clock, 0 * clock)}).items():
        assert np.max(np.abs(got - want)[certified] * speed[certified]) < 1e-12, (kind, name)
    got, want = np.stack(hit.tangent, axis=1), exact.tangent.reshape(-1, 4)
    size = np.maximum(1, np.linalg.norm(want, axis=1))
    # Rounding of the contact duration changes the tangent map by kappa times the rounding.
    assert np.max((np.abs(got - want).max(axis=1) / size * np.abs(impact.v_in))[certified]) < 1e-11


def test_most_steps_are_certified(both):
    kind, exact, _, certified = both
    impacts = exact.out.impact.side != 0
    assert certified[impacts].mean() > MIN_CERTIFIED[kind]


@jax.jit
def deep_step(pair, lane):
    return sampled_step.sampled_step(pair, lane, deep=True, work=True)


def lanes(u, v, t):
    return BallState(*(jnp.asarray(np.resize(x, TILE), float) for x in (u, v, t, 0.0)))


# Gap, stiffness, restitution, slope, speed off the left wall and phase. Such a contact has two crests half a sampling
# pass apart; the later crest has the higher sample and is lower by 3e-4 of its height.
TWO_CRESTS = np.array(
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


def gravity_contacts(rng):
    """Return slow balls that gravity presses on a membrane, and two contacts with two crests."""
    d, kappa, r = np.full(TILE, 0.2), np.exp(rng.uniform(np.log(5), np.log(300), TILE)), rng.uniform(0.1, 0.95, TILE)
    gamma, speed = rng.uniform(0.2, 1.2, TILE), np.exp(rng.uniform(-7, 0, TILE)) / np.sqrt(kappa)
    t = rng.uniform(0, 2, TILE)
    for column, values in zip((d, kappa, r, gamma, speed, t), TWO_CRESTS.T, strict=True):
        column[: values.size] = values
    return pairs(d, kappa, r, gamma), -0.5 * d, speed, t


def test_gravity_prolonged_contacts_are_sampled_at_their_possible_ends():
    longest, shares = 0.0, []
    for seed in range(8):
        pair, u, v, t = gravity_contacts(np.random.default_rng(seed))
        hit, certified = jax.tree.map(np.asarray, deep_step(jax.tree.map(jnp.asarray, pair), lanes(u, v, t)))
        shares.append(certified.mean())
        cell, hit = jax.tree.map(lambda x, certified=certified: x[certified, None], (pair, hit))
        s = hit.duration * np.linspace(0, 1, 20_001)  # 200 samples per swing of the longest contact
        state = (cell.kappa, cell.r, cell.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, s)
        w, _ = long_contact(*state)
        assert np.max(np.abs(w.max(axis=1) / hit.depth[:, 0] - 1)) < 2e-5
        longest = max(longest, float(np.max(hit.duration * cell.kappa)) / np.pi)
    assert np.mean(shares) > 0.55
    assert longest > 50


def steps_from_a_wall(kappas, speeds, count=512):
    """Return sampled and exact steps of balls that start at the left wall of a narrow gap, at any phase."""
    rng = np.random.default_rng(5)
    kappa, v, t = rng.uniform(*kappas, count), rng.uniform(*speeds, count), rng.uniform(0, 2, count)
    pair = jax.tree.map(jnp.asarray, pairs(np.full(count, 0.06), kappa, np.full(count, 0.5), np.zeros(count)))
    at = [jnp.asarray(np.resize(x, count), float) for x in (-0.03, v, t)]
    still = jnp.zeros(count, jnp.int32)
    step = jax.jit(jax.vmap(lambda pair, state: exact_step.step(pair, state, jnp.asarray(100.0))))
    sample = jax.jit(lambda pair, lane: sampled_step.sampled_step(pair, lane, deep=True, work=True))
    return sample(pair, BallState(*at, jnp.zeros(count))), step(pair, State(*at, still, still)).impact


@pytest.mark.long
def test_close_to_resonance_few_contacts_are_uncertified():
    """A large swing and a large response nearly cancel, so that bounds of their sum fail: 13 % were uncertified."""
    (hit, certified), impact = steps_from_a_wall(kappas=(2.6, 3.8), speeds=(0.1, 0.5))
    assert np.mean(certified) > 0.97
    np.testing.assert_allclose(hit.depth[certified], impact.depth[certified], rtol=1e-12)


@pytest.mark.long
def test_all_slow_exits_are_certified_on_an_accelerator(monkeypatch):
    """Where the ball is slow, the chord between two samples is a poor guess of the exit: 9 % were uncertified."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    (hit, certified), impact = steps_from_a_wall(kappas=(8, 15), speeds=(0.05, 0.4), count=4096)
    slow = np.abs(impact.v_out) < 0.1 * np.abs(impact.v_in)
    assert slow.sum() > 50
    assert np.all(certified[slow])
    np.testing.assert_allclose(hit.v_out[slow], impact.v_out[slow], rtol=1e-11)


@pytest.mark.long
def test_results_on_an_accelerator_are_the_same_lane_by_lane(monkeypatch):
    """On an accelerator the step is a kernel of single lanes and looks up samples in another way."""
    pair, u, v, t = gravity_contacts(np.random.default_rng(4))
    arguments = jax.tree.map(jnp.asarray, pair), lanes(u, v, t)
    plain = deep_step(*arguments)
    leaves, tree = jax.tree.flatten(arguments)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    @jax.jit
    def lane_by_lane(*leaves):
        return unrolled(
            lambda lane_leaves: sampled_step.sampled_step(*jax.tree.unflatten(tree, lane_leaves), deep=True, work=True),
            list(leaves),
        )

    hit, certified = jax.tree.unflatten(jax.tree.structure(plain), lane_by_lane(*leaves))
    assert np.mean(plain[1]) > 0.5
    assert np.all(np.asarray(certified) >= np.asarray(plain[1]))  # the kernel corrects exits once more
    certified = plain[1]
    for name in ("flight", "duration", "v_out", "depth", "work"):
        got, want = (np.asarray(getattr(impacts, name))[np.asarray(certified)] for impacts in (hit, plain[0]))
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-14)


def test_uncertified_flights_are_sampled_if_requested():
    """The step uses certified arrivals unchanged, even wrong ones, and computes other flights only if requested."""
    pair, u, v, t = gravity_contacts(np.random.default_rng(3))
    pair, lane = jax.tree.map(jnp.asarray, pair), lanes(u, v, t)
    expected, certain = jax.tree.map(np.asarray, deep_step(pair, lane))
    certified_flights = np.arange(TILE) % 2 == 0
    arrivals = Arrival(
        jnp.where(certified_flights, expected.flight + 0.125, 0.0),
        jnp.asarray(expected.side * expected.v_in),
        expected.side,
        jnp.asarray(certified_flights),
    )
    for sample_flights in (False, True):
        hit, certified = sampled_step.sampled_step(
            pair, lane, arrivals, sample_flights=sample_flights, deep=True, work=True
        )
        assert np.array_equal(np.asarray(hit.flight)[certified_flights], expected.flight[certified_flights] + 0.125)
        if not sample_flights:
            assert not np.any(np.asarray(certified)[~certified_flights])
    assert np.array_equal(np.asarray(certified)[~certified_flights], certain[~certified_flights])
    assert np.max(np.abs(np.asarray(hit.flight) - expected.flight)[~certified_flights & certain]) < 1e-13
