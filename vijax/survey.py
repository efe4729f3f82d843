"""Which periodic orbits attract along chains of cells: where designs set out from."""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax import simulate
from vijax.lanes import Tile, tiles, workers
from vijax.model import Harvester, ImpactPair, State, Status
from vijax.orbit import Orbit, solve
from vijax.record import record
from vijax.shooting import Sequence
from vijax.simulate import LINKS


class Survey(NamedTuple):
    """Attractors found: verified orbits, and the cell of each, in the order of chain and link."""

    orbit: Orbit
    chain: np.ndarray
    link: np.ndarray


def survey(
    pair: ImpactPair,
    u0: np.ndarray,
    v0: np.ndarray,
    kick: np.ndarray,
    *,
    longest: int,
    impacts: int,
    periods: int,
) -> Survey:
    """The periodic attractors along chains of cells, each cell starting in the state in which the last one ended.

    Args:
        pair: Cells [chain, link], 64 links at most.
        u0, v0: Starts of the chains.
        kick: Factor on the velocity that a cell hands on to the next: 1 follows an attractor, others leave its basin.
        longest, impacts: Most forcing periods, and most impacts, of an orbit that is wanted.
        periods: Forcing periods that the search for an attractor may take in a cell.

    Returns:
        The orbits; aperiodic and silent cells, and longer orbits, have none.
    """
    pair = jax.tree.map(np.asarray, pair)
    chains, links = pair.d.shape

    def work(tile: Tile) -> tuple[np.ndarray, ...]:
        rows = tile.rows
        wide = jax.tree.map(lambda x: np.pad(x[rows], ((0, 0), (0, LINKS - links)), mode="edge"), pair)
        start = u0[rows], v0[rows], kick[rows]
        chain, *found = _attractors(wide, start, (tile.real, links), (longest, impacts, periods))
        return rows[chain], *found

    with ThreadPoolExecutor(workers()) as pool:
        parts = list(pool.map(work, tiles(chains, (simulate.chains_at_once(chains),))))
    chain = np.concatenate([part[0] for part in parts])
    link, side, span, knots = (np.concatenate([part[i] for part in parts]) for i in range(1, 5))
    own = jax.tree.map(lambda x: jnp.asarray(x[chain, link]), pair)
    sequence = Sequence(jnp.asarray(side), jnp.asarray(span), jnp.zeros(chain.size, bool))
    orbits = solve(own, sequence, jnp.asarray(knots))
    good = np.flatnonzero(np.asarray(orbits.status) == Status.OK)
    return Survey(orbits[good], chain[good], link[good])


def _attractors(pair: ImpactPair, start: tuple, real: tuple[int, int], limits: tuple[int, int, int]):
    """Chain, link, walls, span and knots of every periodic attractor of a tile of chains."""
    longest, impacts, periods = limits
    u0, v0, kick = start
    chains, links = real
    one = jnp.ones_like(jnp.asarray(pair.d))
    summary = simulate.follow(
        jax.tree.map(jnp.asarray, pair),
        simulate.Starts(jnp.asarray(u0), jnp.asarray(v0), jnp.zeros(u0.shape)),
        simulate.Growth(one, one * kick[:, None]),
        one,
        one,
        Harvester(),
        periods=periods,
        keep=longest,
        count=chains,
        links=links,
    )
    found = jax.tree.map(lambda x: np.asarray(x)[:chains, :links], summary)
    count = found.impacts_left + found.impacts_right
    fine = np.isin(found.status, (Status.OK, Status.STICKING)) & (found.period > 0) & (found.period <= longest)
    chain, link = np.nonzero(fine & (count > 0) & (count <= impacts))
    mark = jax.tree.map(lambda x: x[chain, link], (found.handover.mark, found.handover.held))
    u, v, t, n, held = jax.tree.leaves(mark)
    whole = (x.astype(np.int32) for x in (n, held))
    own = jax.tree.map(lambda x: x[chain, link], pair)
    flown = record(own, State(u, v, t, *whole), longest, np.ones(chain.size, bool)).impacts
    table = {name: np.pad(x, ((0, 0), (0, impacts)))[:, :impacts] for name, x in flown.items()}
    real_ones = np.arange(impacts) < count[chain, link][:, None]
    knots = np.stack([2 * table["n"] + table["t"], np.abs(table["v_in"]), table["duration"]], axis=-1)
    side = np.where(real_ones, table["side"], 0).astype(np.int32)
    return chain, link, side, 2.0 * found.period[chain, link], np.where(real_ones[..., None], knots, 0.0)
