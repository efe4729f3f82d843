"""Points of a lattice fill a cube evenly in any number of dimensions; a longer lattice starts with the same points."""

import numpy as np
import pytest

from vijax.runtime.numerics.low_discrepancy import lattice


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_points_are_even_and_do_not_depend_on_their_number(size):
    points = lattice(4096, size)
    assert points.shape == (size, 4096)
    assert ((points >= 0) & (points < 1)).all()
    np.testing.assert_array_equal(lattice(100, size), points[:, :100])
    # Every eighth of every axis has its share of the points, far more evenly than points at random.
    for axis in points:
        counts = np.histogram(axis, 8, (0, 1))[0]
        assert np.abs(counts - 512).max() < 8


def test_powers_of_the_step_solve_its_equation():
    for size in range(1, 5):
        first = (lattice(1, size)[0, 0] - 0.5) % 1
        assert (1 / first) ** (size + 1) == pytest.approx(1 / first + 1)
