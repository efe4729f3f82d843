"""Ascents along periodic orbits: from what a survey met, in compiled calls of few starts, to optima of each device."""

import itertools
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design import objective as aims
from vijax.design.ascent import Box, Climb, ascend, converged
from vijax.design.candidates import Begun
from vijax.design.design_settings import DesignSettings
from vijax.design.ensemble import Task
from vijax.design.objective import Batch, Scene
from vijax.design.optimum import End, VerifiedOptima, verified
from vijax.design.tolerance import Nodes
from vijax.runtime import context, tiles
from vijax.runtime.programs import jitted

_WIDTHS = (4, 8)  # impacts that orbits are padded to, those of more to the most there may be
# Starts of one compiled call. Those that end soon wait for the others, in Newton's search as in the ascent, and the
# equations of more than a few orbits of 16 impacts leave the first cache: calls of 16 take 1.4 times as long.
_TILE = 4


def search(task: Task, starts: Begun, cloud: Nodes, max_evaluations: int) -> VerifiedOptima:
    """Climb along the orbits of every device; give its optima, the best first, and ends that are none."""
    scene = Scene(jnp.asarray(cloud.factors), jnp.asarray(cloud.weights), task.tune, cloud.names, task.objective)
    ends = _climbed(scene, starts, task.box, max_evaluations, task.settings)
    return verified(scene, starts, ends, task.devices, max_evaluations, task.settings)


@lru_cache(maxsize=8)
def _compiled(max_evaluations: int, settings: DesignSettings):
    def climb(scene: Scene, batch: Batch) -> Climb:
        box = Box(batch.low, batch.high, settings.max_step)
        look = partial(aims.look, scene, batch)
        return ascend(look, batch.z, aims.begin(scene, batch), box, max_evaluations, settings)

    return jitted(climb, often=True)


def _climbed(scene: Scene, starts: Begun, box: np.ndarray, max_evaluations: int, settings: DesignSettings) -> list[End]:
    """Climb from every start, in padded tiles on every core: orbits of few impacts and of many apart."""
    count, work = (starts.flown.side != 0).sum(axis=1), _compiled(max_evaluations, settings)
    ends: list[End | None] = [None] * count.size

    def part(some: np.ndarray, width: int, tile: tiles.Tile) -> None:
        rows = some[tile.rows]
        own, bounds = starts.some(rows), box[starts.owner[rows]].swapaxes(0, 1)
        begun = (jnp.asarray(x) for x in (own.flown.knots[:, :width], own.z, *bounds))
        end = work(scene, Batch(jax.tree.map(jnp.asarray, own.device), own.flown.sequence(width), *begun))
        seen, lost, settled, taken = (
            jax.tree.map(np.asarray, x) for x in (end.seen, end.lost, converged(end), end.evaluations)
        )
        path, heights, z = np.asarray(end.path), np.asarray(end.heights), np.asarray(end.z)
        for row, index in enumerate(rows[: tile.real]):
            ends[index] = End(
                z[row],
                float(np.exp(seen.value[row])) if seen.there[row] else np.nan,
                seen.gradient[row],
                seen.margins[row],
                seen.memory.knots[row, 0],
                bool(lost[row]),
                bool(settled[row]),
                int(taken[row]),
                path[:, row],
                heights[:, row],
            )

    jobs = []
    most = starts.flown.side.shape[1]
    widths = [0, *(width for width in _WIDTHS if width < most), most]
    # The widest first, for they take longest: no core is left with one of them at the end.
    for width, few in itertools.pairwise(reversed(widths)):
        some = np.flatnonzero((count > few) & (count <= width))
        jobs += [(some, width, tile) for tile in tiles.tiles(some.size, (_TILE,))]
    with context.pool(tiles.workers()) as pool:
        list(pool.map(lambda job: part(*job), jobs))
    return [end for end in ends if end is not None]
