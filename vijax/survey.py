"""Which periodic orbits attract in many cells: where designs set out from."""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax import simulate
from vijax.lanes import workers
from vijax.model import ImpactPair, State, Status
from vijax.orbit import Orbit, solve
from vijax.record import record
from vijax.shooting import Sequence

_SMALLEST_TILE, _LARGEST_TILE = 512, 8192  # cells of a call


class Survey(NamedTuple):
    """Attractors found: verified orbits, and the cell of each, in the order of the cells."""

    orbit: Orbit
    cell: np.ndarray


def survey(pair: ImpactPair, u0: np.ndarray, v0: np.ndarray, *, longest: int, impacts: int, periods: int) -> Survey:
    """The periodic attractors of cells.

    Args:
        pair: Cells [cell], soft.
        u0, v0: Where each starts, at phase 0.
        longest, impacts: Most forcing periods, and most impacts, of an orbit that is wanted.
        periods: Forcing periods that the search for an attractor may take.

    Returns:
        The orbits; aperiodic and silent cells, and longer orbits, have none.
    """
    pair = jax.tree.map(np.asarray, pair)
    cells = pair.d.size
    share = math.ceil(cells / workers())
    size = min(max(1 << (share - 1).bit_length(), _SMALLEST_TILE), _LARGEST_TILE)
    number = math.ceil(cells / size)
    # Strided tiles cost the same.
    tiles = [np.arange(first, cells, number) for first in range(number)]
    with ThreadPoolExecutor(workers()) as pool:
        parts = list(pool.map(lambda rows: _attractors(pair, (u0, v0), rows, size, (longest, impacts, periods)), tiles))
    every = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(every[0])
    cell, side, span, knots = (part[order] for part in every)
    sequence = Sequence(jnp.asarray(side), jnp.asarray(span), jnp.zeros(cell.size, bool))
    orbits = solve(jax.tree.map(lambda x: jnp.asarray(x[cell]), pair), sequence, jnp.asarray(knots))
    good = np.flatnonzero(np.asarray(orbits.status) == Status.OK)
    return Survey(orbits[good], cell[good])


def _attractors(pair: ImpactPair, starts: tuple, rows: np.ndarray, size: int, limits: tuple[int, int, int]):
    """Cell, walls, span and knots of every periodic attractor of some cells, padded to a tile."""
    longest, impacts, periods = limits
    padded = np.resize(rows, size)
    own, u0, v0 = jax.tree.map(lambda x: jnp.asarray(x[padded]), (pair, *starts))
    summary = simulate.attractors(own, u0, v0, periods=periods, keep=longest, count=rows.size)
    found = jax.tree.map(lambda x: np.asarray(x)[: rows.size], summary)
    count = found.impacts_left + found.impacts_right
    fine = np.isin(found.status, (Status.OK, Status.STICKING)) & (found.period > 0) & (found.period <= longest)
    some = np.flatnonzero(fine & (count > 0) & (count <= impacts))
    cell, count = rows[some], count[some]
    u, v, t, n, held = jax.tree.leaves(jax.tree.map(lambda x: x[some], (found.handover.mark, found.handover.held)))
    mark = State(u, v, t, n.astype(np.int32), held.astype(np.int32))
    flown = record(jax.tree.map(lambda x: x[cell], pair), mark, longest, np.ones(cell.size, bool)).impacts
    table = {name: np.pad(x, ((0, 0), (0, impacts)))[:, :impacts] for name, x in flown.items()}
    real = np.arange(impacts) < count[:, None]
    knots = np.stack([2 * table["n"] + table["t"], np.abs(table["v_in"]), table["duration"]], axis=-1)
    side = np.where(real, table["side"], 0).astype(np.int32)
    return cell, side, 2.0 * found.period[some], np.where(real[..., None], knots, 0.0)
