"""The last cells of an accelerator's tile: the cores beside it fly them to their end.

A step of one lane takes an accelerator nearly as long as that of eight thousand, and some cells of every map have
thousands of impacts to go, or ask again and again for a step with loops in it: it would work on them for many times as
long as on all others together. Cores are quick with few cells, and nothing that is known of one gets lost on the way.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from vijax.batch import accelerator_lanes, cell_program, lanes, rows
from vijax.batch.cell import Plan, Settings
from vijax.batch.summary import shapes
from vijax.model.device import Harvester, electrical
from vijax.runtime import context, export_cache, tiles, xla

# Cells that a core takes over. With half as many an H100 works a twentieth of a second longer for 1024 x 1024 cells,
# and the 16 cores of its host are done no sooner.
_EACH = 512
# Lanes of a core: with 64 the last cells, which have the most impacts to go, would be waited for longer.
_LANES = 32


def most() -> int:
    """Say how many cells an accelerator leaves to the cores beside it; none where those are what computes."""
    if xla.on_cpu() or (core := _core()) is None:
        return 0
    with jax.default_device(core):
        return _EACH * tiles.workers()


def _core() -> jax.Device | None:
    """Find the device that is the cores; None if JAX was told to leave them alone."""
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        return None


def _entry(plan: Plan, kind: Any) -> Any:
    """Give what a tile is told of a cell, a row, as its shape."""
    return jax.ShapeDtypeStruct((1, rows.width(cell_program.entry_shapes(plan, kind))), kind)


@lru_cache(maxsize=32)
def _compiled(plan: Plan) -> export_cache.TracedProgram:
    """Compile the program of a core's share: cells that are on their way, to their end."""

    def finish(table, count, settings):
        kind = table.dtype
        cells = accelerator_lanes.resumed(cell_program.program(plan, settings), _entry(plan, kind))
        return lanes.run(cells, table, count, rows.width(shapes(plan, kind)), _LANES)

    return export_cache.TracedProgram(finish, f"{finish.__qualname__} {plan}")


def prepare(plan: Plan, settings: Settings) -> None:
    """Compile what `finish` needs: by a share without a cell, which costs nothing once that is done."""
    kind = np.dtype(settings.periods.dtype)
    with jax.default_device(_core()):
        _finish_share(plan, jax.tree.map(np.asarray, settings), np.zeros((0, _columns(plan, kind)), kind))


@lru_cache(maxsize=32)
def _columns(plan: Plan, kind: np.dtype) -> int:
    """Count the columns of what is known of a cell."""
    zero: Any = np.zeros((), kind)
    variants: Any = np.zeros(plan.variants, kind)
    settings = Settings(zero, zero, electrical(Harvester()), None, variants, variants, zero if plan.chained else None)
    return rows.width(jax.eval_shape(cell_program.program(plan, settings).load, _entry(plan, kind)))


def finish(plan: Plan, settings: Settings, left: np.ndarray) -> np.ndarray:
    """Fly cells to their end, on all cores.

    Args:
        plan, settings: Those of the tile.
        left: What is known of each [cell, column], as `accelerator_lanes.run_most` gives it; no more than `most`.

    Returns:
        Their rows of results [cell, column].
    """
    settings = jax.tree.map(np.asarray, settings)
    with jax.default_device(_core()):
        workers = tiles.workers()
        # Strided, so that no core is left with the slow ones.
        shares = [left[first::workers] for first in range(workers)]
        with context.pool(workers) as pool:
            parts = list(pool.map(partial(_finish_share, plan, settings), shares))
    found = np.empty((len(left), parts[0].shape[1]), parts[0].dtype)
    for first, part in enumerate(parts):
        found[first::workers] = part
    return found


def _finish_share(plan: Plan, settings: Settings, left: np.ndarray) -> np.ndarray:
    """Fly the share of one core, padded so that one program serves all."""
    table = np.zeros((_EACH, left.shape[1]), left.dtype)
    table[: len(left)] = left
    return np.asarray(_compiled(plan)(table, np.int32(len(left)), settings))[: len(left)]
