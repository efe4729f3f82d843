"""Systems of blocks in a ring have the solution of the dense system, also if single blocks are singular."""

import jax
import numpy as np
import pytest

from vijax.runtime.numerics import ring_solve


@pytest.mark.parametrize(("blocks", "real", "border", "sides"), [(1, 1, 1, 2), (4, 3, 2, 1), (8, 8, 0, 1)])
def test_rings_are_solved_with_their_border(blocks, real, border, sides):
    draw = np.random.default_rng(blocks)
    diagonal, next_block = draw.normal(size=(2, blocks, 3, 3))
    next_block[:, :, 2] = 0
    border_columns, border_rows = draw.normal(size=(blocks, 3, border)), draw.normal(size=(border, blocks, 3))
    is_closing = np.arange(blocks) == real - 1
    diagonal[real:], next_block[real:], border_columns[real:] = np.eye(3), 0, 0
    if real > 1:
        diagonal[1, :, :2] = 0  # This block alone is singular.
    ring = ring_solve.BlockRing(
        diagonal, next_block, is_closing, border_columns, border_rows, draw.normal(size=(border, border))
    )
    right, bottom = draw.normal(size=(blocks, 3, sides)), draw.normal(size=(border, sides))
    inner, outer = jax.jit(ring_solve.solve)(ring, right, bottom)
    matrix = np.zeros(2 * (3 * blocks + border,))
    for k in range(blocks):
        rows, after = slice(3 * k, 3 * k + 3), 0 if is_closing[k] else (k + 1) % blocks
        matrix[rows, rows] += diagonal[k]
        matrix[rows, 3 * after : 3 * after + 3] += next_block[k]
        matrix[rows, 3 * blocks :] = border_columns[k]
    matrix[3 * blocks :] = np.concatenate([border_rows.reshape(border, 3 * blocks), ring.border_corner], axis=1)
    np.testing.assert_allclose(ring.dense, matrix, rtol=0, atol=1e-15)
    expected = np.linalg.solve(matrix, np.concatenate([right.reshape(3 * blocks, sides), bottom]))
    solution = np.concatenate([np.asarray(inner).reshape(3 * blocks, sides), outer])
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-13 * np.linalg.cond(matrix))
