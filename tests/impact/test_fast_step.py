"""The fast step: its certified results are right, and on the planes of its design range most steps are certified."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import EPS, HORIZON, TILE, fast_and_exact, march, pairs, start
from vijax.impact.exact import contact_search, exact_step
from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.impact import BallState

COUNT = 16 * TILE


def drawn(rng, r):
    """Return cells of the plane d 0.05..0.3 x kappa 3..400 (log) and starts on their trajectories."""
    d, kappa = rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(np.log(3), np.log(400), TILE))
    return d, kappa, np.full(TILE, r), rng.uniform(-0.45, 0.45, TILE) * d, rng.uniform(-0.7, 0.7, TILE)


@pytest.fixture(scope="module", params=["soft", "rigid"])
def both(request):
    """The exact steps of random trajectories, and the fast step from each of their states."""
    rng = np.random.default_rng(5)
    d, kappa, r, u, v = drawn(rng, 0.5)
    pair = pairs(d, kappa if request.param == "soft" else None, r, 0.0)
    ran = march(pair, start(u, v, rng.uniform(0, 2, TILE)))
    pair = jax.tree.map(lambda x: jnp.asarray(np.repeat(x, ran.out.flight.shape[1])), pair)
    flat = jax.tree.map(lambda x: x.reshape(COUNT, *x.shape[2:]), ran)
    lane = BallState(*(jnp.asarray(getattr(flat.before, name), float) for name in ("u", "v", "t", "n")))

    def program(pair, lane):
        return fast_step.fast_step(
            fast_walls.prepare_walls(pair), jnp.zeros_like(lane.u), lane, deep=True, work=True, tangent=True
        )

    hit, _, certified, escapes = jax.tree.map(np.asarray, jax.jit(program)(pair, lane))
    return request.param, flat, hit, certified, escapes


def test_certified_impacts_agree_with_the_exact_step(both):
    kind, exact, hit, certified, escapes = both
    out, impact = exact.out, exact.out.impact
    plain = certified & (impact.side != 0)
    assert np.array_equal(certified & ~out.stuck, plain)
    assert not np.any(escapes & (impact.side != 0))
    assert np.array_equal(hit.side[plain], impact.side[plain])
    speed = np.abs(impact.v_in[plain])
    # Rounding of the position moves the crossing by eps over the speed.
    moved = 1e-15 + 100 * EPS * 0.01 / speed
    clock = 2 * hit.onset_n + hit.onset_t - 2 * impact.n - impact.t
    assert np.max(np.abs(clock[plain]) / moved) < 1e3
    for name, (got, want) in fast_and_exact(hit, out).items():
        assert np.max(np.abs(got - want)[plain] * speed) < 1e-12, (kind, name)
    # The largest error is 1.5e-15: the time of the crest is approximate, and one Newton step makes the depth exact.
    assert np.max(np.abs(hit.depth / impact.depth - 1)[plain] * speed) < 2e-14
    got, want = np.stack(hit.tangent, axis=1), exact.tangent.reshape(COUNT, 4)
    size = np.linalg.norm(want, axis=1)
    assert np.max((np.abs(got - want).max(axis=1) / np.maximum(1, size) * np.abs(impact.v_in))[plain]) < 1e-12


def test_most_steps_are_certified(both):
    _, exact, _, certified, _ = both
    impacts = exact.out.impact.side != 0
    assert certified[impacts].mean() > 0.95


def near_grazes(rng, count):
    """Return level flights with an extremum 1e-14 to 1e-2 from a wall, on either side; some drift or hardly turn."""
    drift = rng.choice(3, count)
    p = rng.uniform(-1.3, 1.3, count)
    sign, size = np.sign(p), 10.0 ** rng.uniform(-14, -1, count)
    p = np.select([drift == 1, drift == 2], [sign * (1 + rng.choice([-1, 1], count) * size), sign * size], p)
    t0, d, lower = rng.uniform(0, 2, count), 10.0 ** rng.uniform(-2, 0.3, count), rng.random(count) < 0.5
    angle = np.arcsin(np.clip(p, -1, 1)) / np.pi
    extremum = np.where(lower, -angle, 1 + angle)
    extremum += 2 * (np.ceil((t0 - extremum) / 2) + rng.integers(0, 6, count))
    rise = p / np.pi * (extremum - t0) - (np.cos(np.pi * extremum) - np.cos(np.pi * t0)) / np.pi**2
    off = rng.choice([-1, 1], count) * 10.0 ** rng.uniform(-14, -2, count)
    u, v = np.where(lower, -d, d) / 2 + off - rise, (p + np.sin(np.pi * t0)) / np.pi
    flip = rng.choice([-1, 1], count)
    inside = np.abs(u) <= d / 2
    return tuple(x[inside] for x in (d, flip * u, flip * v, np.where(flip > 0, t0, (t0 + 1) % 2)))


def test_no_crossing_is_missed_near_a_graze():
    d, u, v, t = (x[:4096] for x in near_grazes(np.random.default_rng(8), 40_000))
    pair = jax.tree.map(jnp.asarray, pairs(d, None, 0.5, 0.0))
    lane = BallState(*map(jnp.asarray, (u, v, t, np.zeros_like(t))))
    step = jax.jit(lambda pair, lane: fast_step.fast_step(fast_walls.prepare_walls(pair), jnp.zeros_like(lane.u), lane))
    careful = jax.jit(jax.vmap(exact_step.step, in_axes=(0, 0, None)))
    hit, _, certified, escapes = jax.tree.map(np.asarray, step(pair, lane))
    out = careful(pair, jax.tree.map(jnp.asarray, start(u, v, t)), HORIZON)
    assert u.size == 4096
    assert 0.2 < certified.mean() < 0.8
    assert not escapes.any()
    impacting = certified & (hit.flight < HORIZON)
    np.testing.assert_array_equal(hit.side[impacting], out.impact.side[impacting])
    np.testing.assert_allclose(hit.flight[impacting], out.flight[impacting], rtol=1e-6, atol=1e-6)


def test_a_ball_at_rest_moves_where_the_forcing_pulls_it_up():
    """Each cell of a plane has such a start, at rest at phase 0; the other half falls back to the exact step."""
    rng = np.random.default_rng(4)
    d, t = 10.0 ** rng.uniform(-2, 0.3, 4096), rng.uniform(0, 2, 4096)
    u = rng.uniform(-0.5, 0.5, 4096) * d
    t[:256], t[256:512], t[512:1024], u[:2048] = 0.0, 1e-9, rng.choice([0.5, 1.5], 512), 0.0
    pair, rest = jax.tree.map(jnp.asarray, pairs(d, None, 0.5, 0.0)), np.zeros_like(t)
    lane = BallState(*map(jnp.asarray, (u, rest, t, rest)))
    step = jax.jit(lambda pair, lane: fast_step.fast_step(fast_walls.prepare_walls(pair), jnp.zeros_like(lane.u), lane))
    careful = jax.jit(jax.vmap(exact_step.step, in_axes=(0, 0, None)))
    hit, _, certified, escapes = jax.tree.map(np.asarray, step(pair, lane))
    out = careful(pair, jax.tree.map(jnp.asarray, start(u, rest, t)), HORIZON)
    assert not escapes.any()
    assert not certified[np.cos(np.pi * t) < -EPS].any()
    small = d < 1 / np.pi**2  # the swing is twice this value
    assert certified[:512][small[:512]].mean() > 0.95
    wide = d > 4.1 / np.pi**2  # a ball in almost free motion swings there without an impact
    assert wide[:512].sum() > 50
    assert not certified[:512][wide[:512]].any()
    impacting = certified & (hit.flight < HORIZON)
    assert impacting.mean() > 0.3
    np.testing.assert_array_equal(hit.side[impacting], out.impact.side[impacting])
    np.testing.assert_allclose(hit.flight[impacting], out.flight[impacting], rtol=1e-12)


def test_a_stage_limit_returns_the_result_or_nan():
    """A limited number of stages returns the unlimited result or NaN; it once returned an intermediate depth."""
    rng = np.random.default_rng(5)
    count = 256
    d, kappa = rng.uniform(0.05, 0.3, count), np.exp(rng.uniform(np.log(3), np.log(400), count))
    pair = jax.tree.map(jnp.asarray, pairs(d, kappa, 0.5, 0.0))
    before = start(0.5 * d, -(10.0 ** rng.uniform(-3, 0, count)), rng.uniform(0, 2, count))
    state = jax.tree.map(jnp.asarray, before)

    @jax.jit
    def step(max_stages):
        return jax.vmap(lambda p, s: exact_step.step(p, s, jnp.asarray(HORIZON), max_stages=max_stages))(pair, state)

    short, full = step(jnp.int32(6)), step(jnp.int32(contact_search.MAX_STAGES))
    contact_duration, depth = np.asarray(short.contact_duration), np.asarray(short.impact.depth)
    decided = np.isfinite(contact_duration) & np.isfinite(depth)
    assert 0.3 * count < decided.sum() < count
    assert np.array_equal(contact_duration[decided], np.asarray(full.contact_duration)[decided])
    assert np.array_equal(depth[decided], np.asarray(full.impact.depth)[decided])
