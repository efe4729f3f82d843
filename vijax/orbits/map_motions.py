"""Where the balls of cells of a map settle, alone or set from there into the cell next to theirs."""

from typing import Any

import jax
import numpy as np

from vijax.batch import simulate
from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.orbits.map_borders import Borders, LabelledPlane

_SETTLE = 400  # forcing periods that a ball is flown in a cell at most, as in a sweep
_TILE = 64  # balls that are flown together
_CELLS = 2  # Each ball is flown in so many cells, one after another.


def settled(plane: LabelledPlane, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fly the balls of some cells until their attractors are certain: displacement, velocity, phase; impacts a round.

    States are zero, and impacts none, where a ball is lost.
    """
    found = _flown(plane, np.repeat(cells[:, None], _CELLS, axis=1), 1)
    end: Any = found.handover
    states = np.stack([end.u[:, 0], end.v[:, 0], end.t[:, 0]], axis=1)
    impacts = (found.impacts_left + found.impacts_right)[:, 0]
    known = np.isfinite(states).all(axis=1)
    return np.where(known[:, None], states, 0.0), np.where(known, impacts, 0)


def both_attract(plane: LabelledPlane, beside: Borders) -> np.ndarray:
    """Say at which borders the motions of both cells attract in both: basins are parted there, nothing bifurcates.

    The ball of either cell settles, is set into the other cell as it moves, and must keep its label.
    """
    kept = np.full(len(beside), True)
    for here, there in ((beside.cell, beside.beyond), (beside.beyond, beside.cell)):
        if not len(beside):
            break
        chains = np.stack([here, there], axis=1)
        found = _flown(plane, chains, _CELLS)
        level = plane.pairs(chains).symmetric
        counts = found.period, found.impacts_left, found.impacts_right, found.status
        names = label(*counts, merge_mirrors=level)
        kept &= (names == plane.names[tuple(here.T)][:, None]).all(axis=1)
    return kept


def _flown(plane: LabelledPlane, chains: np.ndarray, links: int) -> Any:
    """Fly balls through the first so many cells of their chains [ball, cell, row and column]; see `simulate.follow`.

    By the program of chains of cells: a trajectory that is recorded takes a hundred times as long, 0.9 s for 64 cells.
    """
    parts = [_tile(plane, chains[first : first + _TILE], links) for first in range(0, len(chains), _TILE)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _tile(plane: LabelledPlane, chains: np.ndarray, links: int) -> Any:
    # Rows are repeated, for one number of chains needs one program. No attractor depends on sizes in SI units.
    more = np.resize(chains, (_TILE, *chains.shape[1:]))
    pair = plane.pairs(more)
    u, v = (plane.cells[name][tuple(more[:, 0].T)] for name in ("u0", "v0"))
    start = simulate.Starts(u, v, np.zeros_like(u))
    one: Any = np.ones((_TILE, _CELLS))
    told: Any = {"periods": _SETTLE, "recorded_periods": 1, "count": len(chains), "links": links}
    found = simulate.follow(pair, start, simulate.Growth(one, one), one, one, Harvester(), **told)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chains)], found)
