"""Which periodic attractors many cells meet: where designs set out from."""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax import simulate
from vijax.lanes import workers
from vijax.model import ImpactPair, State, Status
from vijax.record import record
from vijax.shooting import Sequence

_SMALLEST_TILE, _LARGEST_TILE = 512, 8192  # cells of a call
_SAME = 1e-6  # relative difference within which attractors of one pair are the same; see `attractor`


class Survey(NamedTuple):
    """Attractors as they were flown, in the order of the cells that met them first; `orbit.solve` makes orbits of them.

    Attributes:
        pair: Parameters of each [attractor].
        side, knots: Its impacts, [attractor, impact], padded with side 0 and zeros; see `Orbit`.
        span: Time after which it closes.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each; NaN beyond.
        cell: Which one met it first.
    """

    pair: ImpactPair
    side: np.ndarray
    knots: np.ndarray
    span: np.ndarray
    depth: np.ndarray
    work: np.ndarray
    cell: np.ndarray

    def sequence(self, width: int) -> Sequence:
        """Walls and closing of all, of so many impacts."""
        return Sequence(jnp.asarray(self.side[:, :width]), jnp.asarray(self.span), jnp.zeros(self.span.size, bool))


def survey(pair: ImpactPair, u0: np.ndarray, v0: np.ndarray, *, longest: int, impacts: int, periods: int) -> Survey:
    """The periodic attractors of cells; of cells that differ in their starts alone each one once.

    Args:
        pair: Cells [cell], soft.
        u0, v0: Where each starts, at phase 0.
        longest, impacts: Most forcing periods, and most impacts, of an orbit that is wanted.
        periods: Forcing periods that the search for an attractor may take.

    Returns:
        Attractors, of mirror images on level ground one; aperiodic and silent cells, and longer orbits, have none.
    """
    pair = jax.tree.map(np.asarray, pair)
    ended = _ended(pair, (u0, v0), longest, periods)
    count = ended.impacts_left + ended.impacts_right
    fine = np.isin(ended.status, (Status.OK, Status.STICKING)) & (ended.period > 0) & (ended.period <= longest)
    some = np.flatnonzero(fine & (count > 0) & (count <= impacts))
    own, ended = jax.tree.map(lambda x: x[some], (pair, ended))
    once = _distinct(own, ended)
    cell = some[once]
    own, ended = jax.tree.map(lambda x: x[once], (own, ended))
    flown = _recorded(own, ended, impacts)
    return Survey(pair=own, span=2.0 * ended.period, cell=cell, **flown)


def _ended(pair: ImpactPair, starts: tuple[np.ndarray, np.ndarray], longest: int, periods: int) -> Any:
    """How every cell ended, a `Summary`, in tiles on every core."""
    cells = pair.d.size
    share = math.ceil(cells / workers())
    size = min(max(1 << (share - 1).bit_length(), _SMALLEST_TILE), _LARGEST_TILE)
    number = math.ceil(cells / size)
    # Strided tiles cost the same.
    tiles = [np.arange(first, cells, number) for first in range(number)]

    def part(rows: np.ndarray) -> Any:
        own, u0, v0 = jax.tree.map(lambda x: jnp.asarray(x[np.resize(rows, size)]), (pair, *starts))
        summary = simulate.attractors(own, u0, v0, periods=periods, keep=longest, count=rows.size)
        return jax.tree.map(lambda x: np.asarray(x)[: rows.size], summary)

    with ThreadPoolExecutor(workers()) as pool:
        parts = list(pool.map(part, tiles))
    order = np.argsort(np.concatenate(tiles))
    return jax.tree.map(lambda *x: np.concatenate(x)[order], *parts)


def _distinct(pair: ImpactPair, ended: Any) -> np.ndarray:
    """Indices of the cells that met an attractor of their pair first; by impacts, greatest speed and depth."""
    left, right = ended.impacts_left, ended.impacts_right
    swap = (pair.gamma == 0) & (right > left)
    measures = [np.round(np.log(x) / _SAME) for x in (ended.fastest, ended.deepest)]
    counts = ended.period, np.where(swap, right, left), np.where(swap, left, right)
    _, first = np.unique(np.column_stack([*jax.tree.leaves(pair), *counts, *measures]), axis=0, return_index=True)
    return np.sort(first)


def _recorded(pair: ImpactPair, ended: Any, impacts: int) -> dict[str, np.ndarray]:
    """Walls, knots, depths and works of the last impacts of cells."""
    u, v, t, n, held = jax.tree.leaves((ended.handover.mark, ended.handover.held))
    mark = State(u, v, t, n.astype(np.int32), held.astype(np.int32))
    table = {
        name: np.full((u.size, impacts), np.nan) for name in ("n", "t", "side", "v_in", "duration", "depth", "work")
    }

    def part(rows: np.ndarray) -> None:
        own, at = jax.tree.map(lambda x: x[rows], (pair, mark))
        flown = record(own, at, int(ended.period[rows[0]]), np.ones(rows.size, bool)).impacts
        for name, column in table.items():
            width = min(flown[name].shape[1], impacts)
            column[rows, :width] = flown[name][:, :width]

    alike = [np.flatnonzero(ended.period == period) for period in np.unique(ended.period)]
    parts = [rows for some in alike for rows in np.array_split(some, min(workers(), some.size))]
    with ThreadPoolExecutor(workers()) as pool:
        list(pool.map(part, parts))
    real = np.arange(impacts) < (ended.impacts_left + ended.impacts_right)[:, None]
    knots = np.stack([2 * table["n"] + table["t"], np.abs(table["v_in"]), table["duration"]], axis=-1)
    return {
        "side": np.where(real, table["side"], 0).astype(np.int32),
        "knots": np.where(real[..., None], knots, 0.0),
        **{name: np.where(real, table[name], np.nan) for name in ("depth", "work")},
    }
