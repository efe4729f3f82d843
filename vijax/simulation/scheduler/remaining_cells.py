"""The remaining cells of an accelerator's tile are finished on the CPU cores of its host.

An accelerator takes nearly as long for a step of one lane as for a step of 8,000, and some cells of every map have
thousands of impacts to go, or need a fallback with nested loops again and again. An accelerator would take many times
as long for these cells as for all others together. CPU cores are fast with few cells, and the complete state of each
cell is passed to them. Begin with `run`.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from vijax.model.device import Harvester, electrical_device
from vijax.runtime import public_api, tiles
from vijax.runtime.compilation import export_cache, xla
from vijax.simulation.cell import cell_program
from vijax.simulation.cell.cell import Plan, Settings
from vijax.simulation.scheduler import accelerator_scheduler, lane_scheduler, record_rows
from vijax.simulation.summary import Summary, summary_shapes

# Number of remaining cells for each CPU core. With half as many an H100 works 0.05 s longer for 1024 x 1024 cells, and
# the 16 cores of its host finish no sooner.
_CELLS_PER_CORE = 512
# Lanes per core: with 64 the last cells, which have the most impacts to go, would delay the end.
_LANES = 32


def max_remaining_cells() -> int:
    """Return the number of cells that an accelerator leaves to the CPU cores; 0 if a CPU runs the tile."""
    if xla.on_cpu() or (core := _core()) is None:
        return 0
    with jax.default_device(core):
        return _CELLS_PER_CORE * tiles.workers()


@lru_cache(maxsize=32)
def _compiled_until_few(plan: Plan, width: int, few: int) -> export_cache.TracedProgram:
    """Return the program that ends when `few` cells are left for the cores; its result rows are transposed."""

    def tile(cells, count, settings):
        outputs = record_rows.width(summary_shapes(plan, cells.dtype))
        results, remaining = accelerator_scheduler.run_until_few(
            cell_program.program(plan, settings), cells, count, outputs, width, few
        )
        return results.T, remaining

    return export_cache.TracedProgram(tile, f"{tile.__qualname__} {plan} {width} {few}")


def run(plan: Plan, inputs: Any, real: int, few: int) -> Summary:
    """Run a tile on an accelerator, and finish its last cells on the CPU cores of its host.

    Args:
        plan: Static choices of the run.
        inputs: Rows of the cell table, number of real cells, and settings: arguments of the compiled call.
        real: Number of real cells; with 0 the programs are compiled and nothing is run.
        few: Number of cells left to the cores at most: `max_remaining_cells`.
    """
    cells, count, settings = inputs
    like = summary_shapes(plan, cells.dtype)
    with public_api.pool(2) as threads:
        ready = threads.submit(prepare, plan, settings)  # compiled while the other program is
        memory = threads.submit(_written_to, (record_rows.width(like), cells.shape[0] if real else 0), cells.dtype)
        columns, remaining = _compiled_until_few(plan, lane_scheduler.width_of(cells.shape[0]), few)(
            cells, count, settings
        )
        ready.result()
        table = memory.result()
        if not real:
            return record_rows.unpack(table.T, like)
        cell, lane = np.asarray(remaining.cell), np.asarray(remaining.lanes)
        is_real = cell >= 0
        last = threads.submit(finish, plan, settings, lane[is_real])
        table[...] = columns  # copied from the accelerator while the cores compute
        summary = record_rows.unpack(table.T[:real], like)
        last_results = record_rows.unpack(last.result(), like)
    for field, values in zip(jax.tree.leaves(summary), jax.tree.leaves(last_results), strict=True):
        field[cell[is_real]] = values
    return summary


def _written_to(shape: tuple[int, ...], kind: Any) -> np.ndarray:
    """Return an array with its memory already mapped, by a first write while the accelerator computes."""
    table = np.empty(shape, kind)
    table.fill(0)
    return table


def _core() -> jax.Device | None:
    """Return the CPU device of JAX; None if JAX was configured without it."""
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:
        return None


def _entry(plan: Plan, kind: Any) -> Any:
    """Return the shape of one row of the cell table."""
    return jax.ShapeDtypeStruct((1, record_rows.width(cell_program.entry_shapes(plan, kind))), kind)


@lru_cache(maxsize=32)
def _compiled(plan: Plan) -> export_cache.TracedProgram:
    """Return the program of a core's share: unfinished cells, run to their end."""

    def finish(table, count, settings):
        kind = table.dtype
        cells = accelerator_scheduler.resume_program(cell_program.program(plan, settings), _entry(plan, kind))
        return lane_scheduler.run(cells, table, count, record_rows.width(summary_shapes(plan, kind)), _LANES)

    return export_cache.TracedProgram(finish, f"{finish.__qualname__} {plan}")


def prepare(plan: Plan, settings: Settings) -> None:
    """Compile the program that `finish` needs, by a call with zero cells."""
    kind = np.dtype(settings.periods.dtype)
    with jax.default_device(_core()):
        _finish_share(plan, jax.tree.map(np.asarray, settings), np.zeros((0, _columns(plan, kind)), kind))


@lru_cache(maxsize=32)
def _columns(plan: Plan, kind: np.dtype) -> int:
    """Return the number of columns of the state of a cell."""
    zero: Any = np.zeros((), kind)
    variants: Any = np.zeros(plan.variants, kind)
    settings = Settings(
        zero, zero, electrical_device(Harvester()), None, variants, variants, zero if plan.chained else None
    )
    return record_rows.width(jax.eval_shape(cell_program.program(plan, settings).load, _entry(plan, kind)))


def finish(plan: Plan, settings: Settings, states: np.ndarray) -> np.ndarray:
    """Run cells to their end, on all cores.

    Args:
        plan, settings: As for the tile.
        states: State of each cell [cell, column], as `accelerator_scheduler.run_until_few` returns it; at most
            `max_remaining_cells` cells.

    Returns:
        Result rows of the cells, [cell, column].
    """
    settings = jax.tree.map(np.asarray, settings)
    with jax.default_device(_core()):
        workers = tiles.workers()
        # Strided shares spread neighbouring cells, which are often slow for the same reason, over the cores.
        shares = [states[first::workers] for first in range(workers)]
        with public_api.pool(workers) as pool:
            parts = list(pool.map(partial(_finish_share, plan, settings), shares))
    result_rows = np.empty((len(states), parts[0].shape[1]), parts[0].dtype)
    for first, part in enumerate(parts):
        result_rows[first::workers] = part
    return result_rows


def _finish_share(plan: Plan, settings: Settings, states: np.ndarray) -> np.ndarray:
    """Run the share of one core to its end, padded so that one program serves all shares."""
    table = np.zeros((_CELLS_PER_CORE, states.shape[1]), states.dtype)
    table[: len(states)] = states
    return np.asarray(_compiled(plan)(table, np.int32(len(states)), settings))[: len(states)]
