"""Certified sampling: where it is sure it is right, whatever walls, gravity and restitution; it often is sure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import TILE, both_ways, march, pairs, start
from vijax.engine import sampled
from vijax.engine.impact import Ball

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
    program = jax.jit(lambda pair, lane: sampled.sampled_step(pair, lane, deep=True, tangent=True))
    parts = []
    # In batches as small as the lanes serve: a sampled step holds some dozens of samples a lane.
    for k in range(many):
        lane = Ball(*(jnp.asarray(getattr(ran.before, name)[:, k], float) for name in ("u", "v", "t", "n")))
        parts.append(jax.tree.map(np.asarray, program(jax.tree.map(jnp.asarray, pair), lane)))
    hit, sure = jax.tree.map(lambda *x: np.stack(x, axis=1).reshape(TILE * many), *parts)
    return request.param, flat, hit, sure


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
