"""The quick step: where it is sure it is right, and on the planes it was made for it is nearly always sure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import EPS, HORIZON, TILE, both_ways, march, pairs, start
from vijax.engine import contact_search, exact, quick, quick_wall
from vijax.engine.impact import Ball

COUNT = 16 * TILE


def drawn(rng, r):
    """Cells of the plane d 0.05..0.3 x kappa 3..400 (log) and starts somewhere on their trajectories."""
    d, kappa = rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(np.log(3), np.log(400), TILE))
    return d, kappa, np.full(TILE, r), rng.uniform(-0.45, 0.45, TILE) * d, rng.uniform(-0.7, 0.7, TILE)


@pytest.fixture(scope="module", params=["soft", "rigid"])
def both(request):
    """The exact steps of drawn trajectories, and the quick step from each of their states."""
    rng = np.random.default_rng(5)
    d, kappa, r, u, v = drawn(rng, 0.5)
    pair = pairs(d, kappa if request.param == "soft" else None, r, 0.0)
    ran = march(pair, start(u, v, rng.uniform(0, 2, TILE)))
    pair = jax.tree.map(lambda x: jnp.asarray(np.repeat(x, ran.out.flight.shape[1])), pair)
    flat = jax.tree.map(lambda x: x.reshape(COUNT, *x.shape[2:]), ran)
    lane = Ball(*(jnp.asarray(getattr(flat.before, name), float) for name in ("u", "v", "t", "n")))

    def program(pair, lane):
        return quick.quick_step(
            quick_wall.prepare(pair), jnp.zeros_like(lane.u), lane, deep=True, work=True, tangent=True
        )

    hit, _, sure, never = jax.tree.map(np.asarray, jax.jit(program)(pair, lane))
    return request.param, flat, hit, sure, never


def test_where_sure_it_agrees_with_the_exact_step(both):
    kind, exact, hit, sure, never = both
    out, impact = exact.out, exact.out.impact
    plain = sure & (impact.side != 0)
    assert np.array_equal(sure & ~out.stuck, plain)
    assert not np.any(never & (impact.side != 0))
    assert np.array_equal(hit.side[plain], impact.side[plain])
    speed = np.abs(impact.v_in[plain])
    # A rounding of the place moves the crossing by eps over the speed.
    moved = 1e-15 + 100 * EPS * 0.01 / speed
    clock = 2 * hit.onset_n + hit.onset_t - 2 * impact.n - impact.t
    assert np.max(np.abs(clock[plain]) / moved) < 1e3
    for name, (got, want) in both_ways(hit, out).items():
        assert np.max(np.abs(got - want)[plain] * speed) < 1e-12, (kind, name)
    # The worst is 1.5e-15: the time of the crest is rough, and one step of Newton's makes the depth exact.
    assert np.max(np.abs(hit.depth / impact.depth - 1)[plain] * speed) < 2e-14
    got, want = np.stack(hit.tangent, axis=1), exact.tangent.reshape(COUNT, 4)
    size = np.linalg.norm(want, axis=1)
    assert np.max((np.abs(got - want).max(axis=1) / np.maximum(1, size) * np.abs(impact.v_in))[plain]) < 1e-12


def test_it_is_sure_of_nearly_every_step(both):
    _, exact, _, sure, _ = both
    impacts = exact.out.impact.side != 0
    assert sure[impacts].mean() > 0.95


def near_grazes(rng, count):
    """Level flights with an extremum 1e-14 to 1e-2 on either side of a wall; some all but monotone, some that drift."""
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


def test_no_crossing_is_missed_beside_a_graze():
    d, u, v, t = (x[:4096] for x in near_grazes(np.random.default_rng(8), 40_000))
    pair = jax.tree.map(jnp.asarray, pairs(d, None, 0.5, 0.0))
    lane = Ball(*map(jnp.asarray, (u, v, t, np.zeros_like(t))))
    step = jax.jit(lambda pair, lane: quick.quick_step(quick_wall.prepare(pair), jnp.zeros_like(lane.u), lane))
    careful = jax.jit(jax.vmap(exact.step, in_axes=(0, 0, None)))
    hit, _, sure, never = jax.tree.map(np.asarray, step(pair, lane))
    out = careful(pair, jax.tree.map(jnp.asarray, start(u, v, t)), HORIZON)
    assert u.size == 4096
    assert 0.2 < sure.mean() < 0.8
    assert not never.any()
    told = sure & (hit.flight < HORIZON)
    np.testing.assert_array_equal(hit.side[told], out.impact.side[told])
    np.testing.assert_allclose(hit.flight[told], out.flight[told], rtol=1e-6, atol=1e-6)


def test_a_ball_at_rest_is_flown_where_the_forcing_pulls_it_up():
    """The start of every cell of a plane, at rest at phase 0, is one; the other half is left to the careful step."""
    rng = np.random.default_rng(4)
    d, t = 10.0 ** rng.uniform(-2, 0.3, 4096), rng.uniform(0, 2, 4096)
    u = rng.uniform(-0.5, 0.5, 4096) * d
    t[:256], t[256:512], t[512:1024], u[:2048] = 0.0, 1e-9, rng.choice([0.5, 1.5], 512), 0.0
    pair, rest = jax.tree.map(jnp.asarray, pairs(d, None, 0.5, 0.0)), np.zeros_like(t)
    lane = Ball(*map(jnp.asarray, (u, rest, t, rest)))
    step = jax.jit(lambda pair, lane: quick.quick_step(quick_wall.prepare(pair), jnp.zeros_like(lane.u), lane))
    careful = jax.jit(jax.vmap(exact.step, in_axes=(0, 0, None)))
    hit, _, sure, never = jax.tree.map(np.asarray, step(pair, lane))
    out = careful(pair, jax.tree.map(jnp.asarray, start(u, rest, t)), HORIZON)
    assert not never.any()
    assert not sure[np.cos(np.pi * t) < -EPS].any()
    small = d < 1 / np.pi**2  # the swing is twice that
    assert sure[:512][small[:512]].mean() > 0.95
    wide = d > 4.1 / np.pi**2  # a ball that as good as nothing moves on swings there for ever
    assert wide[:512].sum() > 50
    assert not sure[:512][wide[:512]].any()
    told = sure & (hit.flight < HORIZON)
    assert told.mean() > 0.3
    np.testing.assert_array_equal(hit.side[told], out.impact.side[told])
    np.testing.assert_allclose(hit.flight[told], out.flight[told], rtol=1e-12)


def test_patience_decides_or_says_that_it_did_not():
    """A limited patience gives the unlimited answer or NaN (it once gave the depth found so far)."""
    rng = np.random.default_rng(5)
    count = 256
    d, kappa = rng.uniform(0.05, 0.3, count), np.exp(rng.uniform(np.log(3), np.log(400), count))
    pair = jax.tree.map(jnp.asarray, pairs(d, kappa, 0.5, 0.0))
    before = start(0.5 * d, -(10.0 ** rng.uniform(-3, 0, count)), rng.uniform(0, 2, count))
    state = jax.tree.map(jnp.asarray, before)

    @jax.jit
    def step(patience):
        return jax.vmap(lambda p, s: exact.step(p, s, jnp.asarray(HORIZON), patience=patience))(pair, state)

    short, full = step(jnp.int32(6)), step(jnp.int32(contact_search.PATIENCE))
    stay, depth = np.asarray(short.stay), np.asarray(short.impact.depth)
    decided = np.isfinite(stay) & np.isfinite(depth)
    assert 0.3 * count < decided.sum() < count
    assert np.array_equal(stay[decided], np.asarray(full.stay)[decided])
    assert np.array_equal(depth[decided], np.asarray(full.impact.depth)[decided])
