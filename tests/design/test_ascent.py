"""The ascent reaches known constrained maxima, keeps its path admissible, and stops at an edge of existence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vijax.design.ascent import AscentState, Box, Evaluation, ascend, converged

MAX_EVALUATIONS = 60
BOX = Box(jnp.full((1, 2), -2.0), jnp.full((1, 2), 2.0), 0.3)


def climb(value, margins, starts, box=BOX, exists=lambda z: True) -> AscentState:
    """Return the ascents of a function of one point from several starts."""

    def evaluate(z, near, memory):
        height, gradient = jax.vmap(jax.value_and_grad(value))(z)
        valid = jax.vmap(exists)(z) & jnp.isfinite(height)
        return Evaluation(height, gradient, jax.vmap(margins)(z), jax.vmap(jax.jacfwd(margins))(z), valid, memory)

    starts = jnp.asarray(starts, float)
    bounds = Box(*(jnp.broadcast_to(x, starts.shape) for x in box[:2]), box.radius)
    return jax.jit(lambda z: ascend(evaluate, z, jnp.zeros(len(z)), bounds, MAX_EVALUATIONS))(starts)


def valley(z):
    """A curved ridge, highest at (1, 1)."""
    return -((z[0] - 1) ** 2) - 10 * (z[1] - z[0] ** 2) ** 2


def disc(z):
    return jnp.array([1 - z[0] ** 2 - z[1] ** 2])


@pytest.fixture(scope="module")
def in_disc():
    return climb(valley, disc, np.random.default_rng(0).uniform(-1, 1, (12, 2)))


def test_maximum_on_a_curved_constraint(in_disc):
    # Reference: SLSQP of SciPy with tolerance 1e-12.
    np.testing.assert_allclose(in_disc.z, np.broadcast_to([0.78874049, 0.61472631], (12, 2)), atol=1e-5)
    assert (in_disc.evaluations <= MAX_EVALUATIONS).all()


def test_points_stay_admissible_after_the_first_admissible_point(in_disc):
    path = np.asarray(in_disc.path)
    margin = 1 - (path**2).sum(axis=-1)
    for start in margin.T:
        finite_margins = start[np.isfinite(start)]
        first = int(np.argmax(finite_margins > 0))
        assert (finite_margins[first:] > 0).all()
        # Before that point, each step reduces the violation.
        assert (np.diff(finite_margins[: first + 1]) > 0).all()


def test_interior_maximum_is_accurate_to_the_last_digits():
    end = climb(
        lambda z: -jnp.cosh(z[0] - 0.3) - (z[1] + 0.2) ** 4 - (z[1] + 0.2) ** 2, disc, [[-0.5, 0.5], [0.6, -0.7]]
    )
    np.testing.assert_allclose(end.z, [[0.3, -0.2]] * 2, atol=1e-7)
    assert not end.reached_edge.any()


def test_maximum_on_the_bounds():
    box = Box(jnp.array([[-2.0, -2.0]]), jnp.array([[0.5, 2.0]]), 0.3)
    end = climb(valley, lambda z: jnp.ones(1), [[0.0, 0.0], [-1.5, 1.0]], box)
    np.testing.assert_allclose(end.z, [[0.5, 0.25]] * 2, atol=1e-5)
    assert (end.z[:, 0] < 0.5).all()


def test_ascent_stops_at_an_edge_of_existence():
    end = climb(lambda z: z[0] - z[1] ** 2, lambda z: jnp.ones(1), [[-0.9, 0.0]], exists=lambda z: z[0] < 0.25)
    assert end.reached_edge[0]
    assert 0.25 - 1e-6 < end.z[0, 0] < 0.25


def test_invalid_start_does_not_move():
    end = climb(lambda z: z[0], lambda z: jnp.ones(1), [[0.5, 0.0]], exists=lambda z: z[0] < 0.25)
    assert end.reached_edge[0]
    assert end.evaluations[0] == 1
    np.testing.assert_array_equal(end.z, [[0.5, 0.0]])


def test_ascent_leaves_an_edge_that_only_the_barrier_leads_to():
    # The maximum is at the constraint z0 = 0. The first maximum of the barrier, z0 = 0.03, lies beyond the edge.
    starts = [[0.019, 0.1], [0.01, -0.3]]
    end = climb(lambda z: -z[0] - z[1] ** 2, lambda z: z[:1], starts, exists=lambda z: z[0] < 0.02)
    np.testing.assert_allclose(end.z, np.zeros((2, 2)), atol=1e-6)
    assert (end.z[:, 0] > 0).all()


def test_barrier_maximum_hidden_by_rounding_does_not_end_the_ascent():
    # Values are accurate to 1.5e-8. Near the maximum of a barrier the difference of two trials is smaller.
    end = climb(lambda z: 1e8 - 3 * z[0] - z[1] ** 2, lambda z: z[:1], [[0.01, 0.01], [0.9, -0.3], [1.7, 0.2]])
    np.testing.assert_allclose(end.z[:, 0], np.zeros(3), atol=1e-7)
    assert bool(converged(end).all())
