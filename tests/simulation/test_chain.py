"""Start of the next cell of a chain after a permanent contact: a ball at rest on a wall."""

import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.maps.orbit_diagram import orbit_diagram
from vijax.model import flow
from vijax.model.records import Status
from vijax.simulation.cell import chain


@pytest.mark.parametrize("gamma", [-1.5, 2.0])
def test_a_ball_at_rest_in_a_soft_wall_moves_periodically(gamma):
    pair = vijax.impact_pair(jnp.full(2, 0.2), jnp.array([4.0, 40.0]), jnp.full(2, 0.5), jnp.full(2, gamma))
    ball = chain.resting(pair, jnp.full(2, 400.0))
    side = -np.sign(gamma)
    for i in range(2):
        wall = flow.membrane(vijax.impact_pair(0.2, pair.kappa[i], 0.5))
        w, z = side * ball.u[i] - 0.1, side * ball.v[i]
        assert w > 0
        force = flow.contact_force(jnp.asarray(gamma), jnp.asarray(side), jnp.asarray(0.0))
        np.testing.assert_allclose(flow.oscillate(wall, force, w, z, jnp.asarray(2.0)), (w, z), atol=1e-13)


def test_a_ball_at_rest_is_the_start_of_the_next_cell():
    """At gamma > 1 the ball rests on the left wall; at the next smaller gamma it leaves from there."""
    ds = orbit_diagram(along="gamma", values=[1.2, 1.1, 0.3], d=0.2, wall="rigid", periods=60, recorded_periods=5)
    assert ds.status.sel(gamma=[1.2, 1.1]).values.tolist() == [Status.PERMANENT_CONTACT] * 2
    np.testing.assert_array_equal(ds.u_strobe.sel(gamma=[1.2, 1.1]), -0.1)
    assert ds.filled.sel(gamma=1.2) == 0 < ds.filled.sel(gamma=0.3)
