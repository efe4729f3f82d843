"""Attractors that cells of a map reach from their own start, or from the motion of a neighbouring cell."""

from typing import Any

import jax
import numpy as np

from vijax.continuation.from_map.map_borders import Borders, LabelledPlane
from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.simulation import simulate

_MAX_PERIODS = 400  # largest number of forcing periods simulated in a cell, as in a sweep
_TILE = 64  # chains that are simulated together
_CHAIN_LENGTH = 2  # cells of a chain, simulated one after another


def attractor_states(plane: LabelledPlane, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a state on the confirmed attractor of each cell, and the number of impacts per period of this attractor.

    A state is displacement, velocity and phase. State and number of impacts are zero where no attractor is reached.
    """
    result = _simulate(plane, np.repeat(cells[:, None], _CHAIN_LENGTH, axis=1), 1)
    end: Any = result.handover
    states = np.stack([end.u[:, 0], end.v[:, 0], end.t[:, 0]], axis=1)
    impacts = (result.impacts_left + result.impacts_right)[:, 0]
    # A start without an attractor has NaN at its end.
    is_finite = np.isfinite(states).all(axis=1)
    return np.where(is_finite[:, None], states, 0.0), np.where(is_finite, impacts, 0)


def both_attract(plane: LabelledPlane, borders: Borders) -> np.ndarray:
    """Return for each border whether it separates basins: the motions of both cells attract in both cells.

    Then nothing bifurcates at the border. The motion of each cell is simulated until its attractor is confirmed, and
    continued with the parameters of the other cell. The result is True if both motions keep their labels.
    """
    label_persists = np.full(len(borders), True)
    # Either cell is the first one of a chain of two.
    for here, there in ((borders.cell, borders.other_cell), (borders.other_cell, borders.cell)):
        if not len(borders):
            break
        chains = np.stack([here, there], axis=1)
        result = _simulate(plane, chains, _CHAIN_LENGTH)
        # Without gravity and with equal walls, mirror images have one label.
        symmetric = plane.pairs(chains).symmetric
        counts = result.period, result.impacts_left, result.impacts_right, result.status
        labels = label(*counts, merge_mirrors=symmetric)
        # The label must be that of the first cell in both cells of the chain.
        label_persists &= (labels == plane.labels[tuple(here.T)][:, None]).all(axis=1)
    return label_persists


def _simulate(plane: LabelledPlane, chains: np.ndarray, links: int) -> Any:
    """Simulate the first `links` cells of chains of cells [chain, cell, row and column]; see `simulate.run_chains`.

    The program for chains takes 0.9 s for 64 cells; recorded trajectories would take a hundred times as long.
    """
    parts = [_simulate_tile(plane, chains[first : first + _TILE], links) for first in range(0, len(chains), _TILE)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _simulate_tile(plane: LabelledPlane, chains: np.ndarray, links: int) -> Any:
    # Rows are repeated to a fixed number of chains, so that one program is enough. Attractors do not depend on sizes in
    # SI units, so that any device can be passed.
    padded = np.resize(chains, (_TILE, *chains.shape[1:]))
    pair = plane.pairs(padded)
    u, v = (plane.cells[name][tuple(padded[:, 0].T)] for name in ("u0", "v0"))
    start = simulate.Starts(u, v, np.zeros_like(u))
    unit_sizes: Any = np.ones((_TILE, _CHAIN_LENGTH))
    options: Any = {"periods": _MAX_PERIODS, "recorded_periods": 1, "count": len(chains), "links": links}
    result = simulate.run_chains(
        pair, start, simulate.UnitRatio(unit_sizes, unit_sizes), unit_sizes, unit_sizes, Harvester(), **options
    )
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chains)], result)
