"""Ascents of the objective on periodic orbits, from the orbits of a survey to verified optima."""

import itertools
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design import objective as design_objective
from vijax.design.aperiodic.ensemble import DesignTask
from vijax.design.ascent import AscentState, Box, ascend, converged
from vijax.design.design_settings import DesignSettings
from vijax.design.objective import AscentBatch, ObjectiveSpec
from vijax.design.optimum import AscentEnd, VerifiedOptima, verify_ends
from vijax.design.robustness.tolerance import Nodes
from vijax.design.survey.orbit_candidates import AscentStarts
from vijax.runtime import public_api, tiles
from vijax.runtime.compilation.programs import jitted

_IMPACT_WIDTHS = (4, 8)  # orbits are padded to one of these numbers of impacts, or to the longest orbit
# Number of starts of one compiled call. A larger number is slower (16 starts: 1.4 times the time), because starts that
# end early wait for the others, and because the equations of many orbits with 16 impacts exceed the first-level cache.
_STARTS_PER_CALL = 4


def climb_orbits(
    task: DesignTask, starts: AscentStarts, tolerance_nodes: Nodes, max_evaluations: int
) -> VerifiedOptima:
    """Run the ascents from the orbits of all devices, and return verified optima and dropped ends of each device."""
    spec = ObjectiveSpec(
        jnp.asarray(tolerance_nodes.factors),
        jnp.asarray(tolerance_nodes.weights),
        task.tune,
        tolerance_nodes.names,
        task.objective,
    )
    ends = _climb(spec, starts, task.box, max_evaluations, task.settings)
    return verify_ends(spec, starts, ends, task.devices, max_evaluations, task.settings)


@lru_cache(maxsize=8)
def _compiled(max_evaluations: int, settings: DesignSettings):
    """Return the compiled ascent for a largest number of evaluations and settings."""

    def climb(spec: ObjectiveSpec, batch: AscentBatch) -> AscentState:
        box = Box(batch.low, batch.high, settings.max_step)
        evaluate = partial(design_objective.evaluate_objective, spec, batch)
        return ascend(
            evaluate, batch.z, design_objective.follow_node_orbits(spec, batch), box, max_evaluations, settings
        )

    return jitted(climb, often=True)


def _climb(
    spec: ObjectiveSpec, starts: AscentStarts, box: np.ndarray, max_evaluations: int, settings: DesignSettings
) -> list[AscentEnd]:
    """Climb from every start and return the ends. Orbits are grouped by number of impacts into tiles for all cores."""
    count, program = (starts.orbits.side != 0).sum(axis=1), _compiled(max_evaluations, settings)
    ends: list[AscentEnd | None] = [None] * count.size

    def climb_tile(group: np.ndarray, width: int, tile: tiles.Tile) -> None:
        """Climb from the starts of one tile and store their ends."""
        rows = group[tile.rows]
        tile_starts, bounds = starts.select(rows), box[starts.device_index[rows]].swapaxes(0, 1)
        arrays = (jnp.asarray(x) for x in (tile_starts.orbits.impact_unknowns[:, :width], tile_starts.z, *bounds))
        end = program(
            spec,
            AscentBatch(jax.tree.map(jnp.asarray, tile_starts.device), tile_starts.orbits.sequence(width), *arrays),
        )
        evaluation, reached_edge, has_converged, evaluations = (
            jax.tree.map(np.asarray, x) for x in (end.evaluation, end.reached_edge, converged(end), end.evaluations)
        )
        path, path_objective, z = np.asarray(end.path), np.asarray(end.path_objective), np.asarray(end.z)
        for row, index in enumerate(rows[: tile.real]):
            ends[index] = AscentEnd(
                z[row],
                # The ascent maximises the logarithm of the objective.
                float(np.exp(evaluation.value[row])) if evaluation.exists[row] else np.nan,
                evaluation.gradient[row],
                evaluation.margins[row],
                # Node 0 is the nominal device.
                evaluation.memory.impact_unknowns[row, 0],
                bool(reached_edge[row]),
                bool(has_converged[row]),
                int(evaluations[row]),
                path[:, row],
                path_objective[:, row],
            )

    jobs = []
    longest = starts.orbits.side.shape[1]
    widths = [0, *(width for width in _IMPACT_WIDTHS if width < longest), longest]
    # Orbits with most impacts come first. They take longest, and at the end would keep one core busy while others are
    # idle.
    for width, shorter in itertools.pairwise(reversed(widths)):
        group = np.flatnonzero((count > shorter) & (count <= width))
        jobs += [(group, width, tile) for tile in tiles.tiles(group.size, (_STARTS_PER_CALL,))]
    with public_api.pool(tiles.workers()) as pool:
        list(pool.map(lambda job: climb_tile(*job), jobs))
    # Every start has an end, because it belongs to exactly one tile. The filter is for the type checker.
    return [end for end in ends if end is not None]
