"""The last cells of an accelerator's tile: the cores beside it fly them to their end.

A step of one lane takes an accelerator nearly as long as that of eight thousand, and some cells of every map have
thousands of impacts to go, or ask again and again for a step with loops in it: it would work on them for many times as
long as on all others together. Cores are quick with few cells, and nothing that is known of one gets lost on the way.
Begin with `run`.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from vijax.batch import accelerator_lanes, cell_program, lanes, rows
from vijax.batch.cell import Plan, Settings
from vijax.batch.summary import Summary, shapes
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


@lru_cache(maxsize=32)
def _compiled_most(plan: Plan, width: int, few: int) -> export_cache.TracedProgram:
    """Compile the program of a plan that ends when so few cells are left for the cores, with columns as rows."""

    def tile(cells, count, settings):
        outputs = rows.width(shapes(plan, cells.dtype))
        results, left = accelerator_lanes.run_most(
            cell_program.program(plan, settings), cells, count, outputs, width, few
        )
        return results.T, left

    return export_cache.TracedProgram(tile, f"{tile.__qualname__} {plan} {width} {few}")


def run(plan: Plan, given: Any, real: int, few: int) -> Summary:
    """Run a tile on an accelerator, whose last cells the cores beside it fly.

    Args:
        plan: What is asked for.
        given: Rows of the cell table, how many are real, and the settings, as compiled calls are given them.
        real: How many are real; with 0 all that is needed is compiled.
        few: How many cells the cores take over at most: `most`.
    """
    cells, count, settings = given
    like = shapes(plan, cells.dtype)
    with context.pool(2) as beside:
        ready = beside.submit(prepare, plan, settings)  # compiled while the other program is
        memory = beside.submit(_written_to, (rows.width(like), cells.shape[0] if real else 0), cells.dtype)
        columns, left = _compiled_most(plan, lanes.width_of(cells.shape[0]), few)(cells, count, settings)
        ready.result()
        table = memory.result()
        if not real:
            return rows.unpack(table.T, like)
        cell, lane = np.asarray(left.cell), np.asarray(left.lanes)
        there = cell >= 0
        last = beside.submit(finish, plan, settings, lane[there])
        table[...] = columns  # copied from the accelerator while the cores fly
        found = rows.unpack(table.T[:real], like)
        rest = rows.unpack(last.result(), like)
    for field, values in zip(jax.tree.leaves(found), jax.tree.leaves(rest), strict=True):
        field[cell[there]] = values
    return found


def _written_to(shape: tuple[int, ...], kind: Any) -> np.ndarray:
    """Give an array that the system has given memory: when it is first written to, while an accelerator works."""
    table = np.empty(shape, kind)
    table.fill(0)
    return table


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
