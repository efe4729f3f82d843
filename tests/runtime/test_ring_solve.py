"""Systems of blocks in a ring are solved as dense ones are, though no block be regular alone."""

import jax
import numpy as np
import pytest

from vijax.runtime import ring_solve


@pytest.mark.parametrize(("blocks", "real", "border", "sides"), [(1, 1, 1, 2), (4, 3, 2, 1), (8, 8, 0, 1)])
def test_rings_are_solved_with_their_border(blocks, real, border, sides):
    draw = np.random.default_rng(blocks)
    here, there = draw.normal(size=(2, blocks, 3, 3))
    there[:, :, 2] = 0
    beside, below = draw.normal(size=(blocks, 3, border)), draw.normal(size=(border, blocks, 3))
    closes = np.arange(blocks) == real - 1
    here[real:], there[real:], beside[real:] = np.eye(3), 0, 0
    if real > 1:
        here[1, :, :2] = 0  # A block that is not regular alone.
    ring = ring_solve.Ring(here, there, closes, beside, below, draw.normal(size=(border, border)))
    right, bottom = draw.normal(size=(blocks, 3, sides)), draw.normal(size=(border, sides))
    inner, outer = jax.jit(ring_solve.solve)(ring, right, bottom)
    matrix = np.zeros(2 * (3 * blocks + border,))
    for k in range(blocks):
        rows, after = slice(3 * k, 3 * k + 3), 0 if closes[k] else (k + 1) % blocks
        matrix[rows, rows] += here[k]
        matrix[rows, 3 * after : 3 * after + 3] += there[k]
        matrix[rows, 3 * blocks :] = beside[k]
    matrix[3 * blocks :] = np.concatenate([below.reshape(border, 3 * blocks), ring.corner], axis=1)
    np.testing.assert_allclose(ring.dense, matrix, rtol=0, atol=1e-15)
    expected = np.linalg.solve(matrix, np.concatenate([right.reshape(3 * blocks, sides), bottom]))
    found = np.concatenate([np.asarray(inner).reshape(3 * blocks, sides), outer])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.linalg.cond(matrix))
