"""The ascent climbs to constrained maxima that are known, stays admissible on the way, and stops at an edge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax.design.ascent import Box, Climb, Look, ascend, converged

LOOKS = 60
BOX = Box(jnp.full((1, 2), -2.0), jnp.full((1, 2), 2.0), 0.3)


def climb(value, margins, starts, box=BOX, exists=lambda z: True) -> Climb:
    """Ascent of a function of one point from several."""

    def look(z, near, memory):
        height, gradient = jax.vmap(jax.value_and_grad(value))(z)
        there = jax.vmap(exists)(z) & jnp.isfinite(height)
        return Look(height, gradient, jax.vmap(margins)(z), jax.vmap(jax.jacfwd(margins))(z), there, memory)

    starts = jnp.asarray(starts, float)
    wide = Box(*(jnp.broadcast_to(x, starts.shape) for x in box[:2]), box.radius)
    return jax.jit(lambda z: ascend(look, z, jnp.zeros(len(z)), wide, LOOKS))(starts)


def valley(z):
    """A curved ridge, highest at (1, 1)."""
    return -((z[0] - 1) ** 2) - 10 * (z[1] - z[0] ** 2) ** 2


def disc(z):
    return jnp.array([1 - z[0] ** 2 - z[1] ** 2])


@pytest.fixture(scope="module")
def in_disc():
    return climb(valley, disc, np.random.default_rng(0).uniform(-1, 1, (12, 2)))


def test_a_curved_constraint_holds_the_maximum(in_disc):
    # By SLSQP of SciPy, tolerance 1e-12.
    np.testing.assert_allclose(in_disc.z, np.broadcast_to([0.78874049, 0.61472631], (12, 2)), atol=1e-5)
    assert (in_disc.evaluations <= LOOKS).all()


def test_every_point_from_the_first_admissible_one_on_is(in_disc):
    path = np.asarray(in_disc.path)
    lacks = 1 - (path**2).sum(axis=-1)
    for start in lacks.T:
        known = start[np.isfinite(start)]
        first = int(np.argmax(known > 0))
        assert (known[first:] > 0).all()
        # Before that every step was nearer.
        assert (np.diff(known[: first + 1]) > 0).all()


def test_a_maximum_inside_is_found_to_the_last_digits():
    end = climb(
        lambda z: -jnp.cosh(z[0] - 0.3) - (z[1] + 0.2) ** 4 - (z[1] + 0.2) ** 2, disc, [[-0.5, 0.5], [0.6, -0.7]]
    )
    np.testing.assert_allclose(end.z, [[0.3, -0.2]] * 2, atol=1e-7)
    assert not end.lost.any()


def test_bounds_hold_it():
    box = Box(jnp.array([[-2.0, -2.0]]), jnp.array([[0.5, 2.0]]), 0.3)
    end = climb(valley, lambda z: jnp.ones(1), [[0.0, 0.0], [-1.5, 1.0]], box)
    np.testing.assert_allclose(end.z, [[0.5, 0.25]] * 2, atol=1e-5)
    assert (end.z[:, 0] < 0.5).all()


def test_an_edge_beyond_which_there_is_no_point_stops_it_there():
    end = climb(lambda z: z[0] - z[1] ** 2, lambda z: jnp.ones(1), [[-0.9, 0.0]], exists=lambda z: z[0] < 0.25)
    assert end.lost[0]
    assert 0.25 - 1e-6 < end.z[0, 0] < 0.25


def test_a_start_that_is_no_point_goes_nowhere():
    end = climb(lambda z: z[0], lambda z: jnp.ones(1), [[0.5, 0.0]], exists=lambda z: z[0] < 0.25)
    assert end.lost[0]
    assert end.evaluations[0] == 1
    np.testing.assert_array_equal(end.z, [[0.5, 0.0]])


def test_an_edge_towards_which_only_the_barrier_pushes_is_left_again():
    # Highest at the constraint z0 = 0; the barrier's first maximum, at z0 = 0.03, lies beyond the edge.
    starts = [[0.019, 0.1], [0.01, -0.3]]
    end = climb(lambda z: -z[0] - z[1] ** 2, lambda z: z[:1], starts, exists=lambda z: z[0] < 0.02)
    np.testing.assert_allclose(end.z, np.zeros((2, 2)), atol=1e-6)
    assert (end.z[:, 0] > 0).all()


def test_a_maximum_of_the_barrier_that_rounding_hides_does_not_end_the_ascent():
    # Values are right to 1.5e-8: near the maximum of a barrier no trial is seen to be higher.
    end = climb(lambda z: 1e8 - 3 * z[0] - z[1] ** 2, lambda z: z[:1], [[0.01, 0.01], [0.9, -0.3], [1.7, 0.2]])
    np.testing.assert_allclose(end.z[:, 0], np.zeros(3), atol=1e-7)
    assert bool(converged(end).all())
