"""Where the starts of a cell lie: the same places in every cell, and wherever as many are asked for."""

import numpy as np

from vijax.runtime.lattice import lattice


def start_places(count: int, seed: int | None = None) -> np.ndarray:
    """Spread starts evenly over the unit square around 0, [2, start]: parts of the gap, and of twice the largest speed.

    Args:
        count: How many.
        seed: Of starts drawn at random; unless given they lie on a lattice, which is more even.
    """
    return (lattice(count, 2) if seed is None else np.random.default_rng(seed).random((2, count))) - 0.5
