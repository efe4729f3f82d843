"""The impact map of many balls at once agrees with the exact step of each ball."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import TILE, march, pairs, start
from vijax.impact.gravity_regime import GravityRegime, gravity_regime_of
from vijax.model.pair import impact_pair
from vijax.simulation.impact_map import next_impacts


@pytest.mark.parametrize(("wall", "gamma"), [("soft", 0.0), ("rigid", 0.0), ("soft", 0.3)])
def test_the_impact_map_agrees_with_the_exact_step(wall, gamma):
    rng = np.random.default_rng(2)
    d, kappa = rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(1, 6, TILE))
    pair = pairs(d, kappa if wall == "soft" else None, 0.5, gamma)
    side, speed, t = rng.choice([-1.0, 1.0], TILE), rng.uniform(0.001, 0.6, TILE), rng.uniform(0, 2, TILE)
    hits = next_impacts(
        pair, jnp.asarray(side), jnp.asarray(speed), jnp.asarray(t), gravity_regime=gravity_regime_of(gamma)
    )
    out = march(pair, start(0.5 * side * d, -side * speed, t)).out
    impact = out.impact
    assert hits.real.all()
    np.testing.assert_array_equal(hits.side, impact.side[:, 0])
    for mine, theirs in (
        (hits.t, 2.0 * impact.n + impact.t),
        (hits.v_in, impact.v_in),
        (hits.v_out, impact.v_out),
        (hits.duration, out.contact_duration),
        (hits.depth, impact.depth),
        (hits.work, impact.work),
    ):
        np.testing.assert_allclose(mine, theirs[:, 0], rtol=1e-9, atol=1e-11)


def test_permanent_contacts_are_reported():
    # Gravity of three times the forcing presses the ball into a soft, damped wall for ever; the stiff wall repels it.
    pair = impact_pair(np.full(2, 0.3), np.array([3.0, 400.0]), np.array([0.05, 0.5]), 3.0)
    hits = next_impacts(
        pair, jnp.array([-1.0, -1.0]), jnp.array([0.1, 0.1]), jnp.array([0.0, 0.0]), gravity_regime=GravityRegime.WEAK
    )
    np.testing.assert_array_equal(hits.real, [False, True])
