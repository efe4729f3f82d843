"""Starts of a cell, spread over gap and velocity: the same positions in every cell for the same number of starts."""

import numpy as np

from vijax.runtime.numerics.low_discrepancy import lattice


def unit_starts(count: int, seed: int | None = None) -> np.ndarray:
    """Return starts spread evenly over the unit square around 0, [2, start].

    The first row is u0 in units of the gap d, the second is v0 in units of twice the largest speed.

    Args:
        count: Number of starts.
        seed: Seed of starts drawn at random; by default they lie on a lattice, which is more even.
    """
    return (lattice(count, 2) if seed is None else np.random.default_rng(seed).random((2, count))) - 0.5
