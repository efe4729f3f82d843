"""The impact map: many balls at once do what the careful step does to each."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import TILE, march, pairs, start
from vijax.batch.impact_map import next_impacts
from vijax.engine.ground import Ground, ground_of
from vijax.model.pair import impact_pair


@pytest.mark.parametrize(("wall", "gamma"), [("soft", 0.0), ("rigid", 0.0), ("soft", 0.3)])
def test_it_agrees_with_the_careful_step(wall, gamma):
    rng = np.random.default_rng(2)
    d, kappa = rng.uniform(0.05, 0.3, TILE), np.exp(rng.uniform(1, 6, TILE))
    pair = pairs(d, kappa if wall == "soft" else None, 0.5, gamma)
    side, speed, t = rng.choice([-1.0, 1.0], TILE), rng.uniform(0.001, 0.6, TILE), rng.uniform(0, 2, TILE)
    found = next_impacts(pair, jnp.asarray(side), jnp.asarray(speed), jnp.asarray(t), ground=ground_of(gamma))
    out = march(pair, start(0.5 * side * d, -side * speed, t)).out
    impact = out.impact
    assert found.real.all()
    np.testing.assert_array_equal(found.side, impact.side[:, 0])
    for mine, theirs in (
        (found.t, 2.0 * impact.n + impact.t),
        (found.v_in, impact.v_in),
        (found.v_out, impact.v_out),
        (found.duration, out.stay),
        (found.depth, impact.depth),
        (found.work, impact.work),
    ):
        np.testing.assert_allclose(mine, theirs[:, 0], rtol=1e-9, atol=1e-11)


def test_a_contact_that_never_ends_is_told():
    # Three times the forcing holds the ball in a soft, damped wall; the stiff one throws it back.
    pair = impact_pair(np.full(2, 0.3), np.array([3.0, 400.0]), np.array([0.05, 0.5]), 3.0)
    found = next_impacts(
        pair, jnp.array([-1.0, -1.0]), jnp.array([0.1, 0.1]), jnp.array([0.0, 0.0]), ground=Ground.GENTLE
    )
    np.testing.assert_array_equal(found.real, [False, True])
