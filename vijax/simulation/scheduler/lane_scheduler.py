"""Scheduler: run N independent cells on L lanes in one compiled loop of fixed shape; free lanes take waiting cells.

The memory is proportional to L and to the rows of the input and result tables. Begin with `_run`: refill and round
(`lane_rounds`) alternate until no cell is left.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.arrays import select
from vijax.runtime.compilation.xla import on_cpu, replace_rows, round_up_to_blocks
from vijax.simulation.scheduler import accelerator_scheduler, lane_storage, small_batch_scheduler
from vijax.simulation.scheduler.lane_rounds import (
    Carry,
    LaneState,
    Program,
    Succeed,
    batch_of,
    count_movable,
    run_round,
    take_lanes,
)

# A batch of lanes, for a fallback or a refill, is one in _SHARE lanes, and at least _FEWEST. With a larger batch slow
# cells wait longer.
_SHARE, _FEWEST = 32, 4
# Least number of rows of the cell table on a CPU, and number of lanes. They do not depend on the number of cells, so
# that one program serves every plane: its compilation takes as long as the simulation of half a million cells. With 512
# lanes planes of 10^5 cells would run 3 % faster.
TABLE_ROWS, _LANES = 32_768, 64
# Runs of up to this many cells on a CPU use `small_batch_scheduler`; so do runs with at most as many chains as it has
# lanes.
SMALL_BATCH = 64


class _Queue(NamedTuple):
    """State of the loop: the lanes, the next cell to start, the results so far."""

    at: LaneState
    waiting: Int[Array, ""]
    results: Float[Array, "cell out"]


class _Table(NamedTuple):
    """The cells of a run, one row of parameters each, and the number of real ones."""

    cells: Float[Array, "cell in"]
    real: Int[Array, ""]


def uses_small_batch(cells: int) -> bool:
    """Return True if a run of `cells` cells uses the program of `small_batch_scheduler`."""
    return on_cpu() and cells <= SMALL_BATCH


def width_of(cells: int) -> int:
    """Return the number of lanes for a tile of `cells` cells.

    Lanes must fill the vectors and outweigh the overhead of loops, but fit in the cache.

    At the end of a tile free lanes idle: 4,096 cells take 1.5 times as long with 512 lanes as with 64.
    """
    if uses_small_batch(cells):
        return small_batch_scheduler.LANES
    return _LANES if on_cpu() else accelerator_scheduler.width_of(cells)


def table_rows(cells: int, variants: int) -> int:
    """Return the number of rows of a tile's table; each row holds the results of all variants of a device."""
    if uses_small_batch(cells):
        return SMALL_BATCH
    return max(cells, TABLE_ROWS // variants) if on_cpu() else cells


def _batch_width(lanes: int) -> int:
    """Return how many of `lanes` lanes form one batch.

    A batch is a group of lanes that together run a fallback for their impacts, or receive new cells.
    """
    if not on_cpu():
        return accelerator_scheduler.batch_width(lanes)
    return max(lanes // _SHARE, _FEWEST)


def run(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int, lanes: int
) -> Float[Array, "cell out"]:
    """Run the first `count` cells to their end; rows past `count` are zeros.

    A cell's result depends on its row alone: lanes never exchange values, and each is advanced by the same elementwise
    arithmetic at every position. The result is bit-identical at every position only if values used by several outputs
    are stored (`xla.materialise`): LLVM splits one loop into several, for whole vectors and for the remainder, and
    fuses multiplications and additions differently in each.

    Args:
        program: Definition of a cell.
        cells: One row of parameters per cell.
        count: Number of real cells; the table may be padded.
        outputs: Length of a result row.
        lanes: Least number of lanes. On a CPU, a number up to `small_batch_scheduler.LANES` selects that scheduler,
            which has exactly `small_batch_scheduler.LANES` lanes.
    """
    if not on_cpu():
        return accelerator_scheduler.run(program, cells, count, outputs, lanes)
    if lanes <= small_batch_scheduler.LANES:
        return small_batch_scheduler.run(program, cells, count, outputs)
    return _run(program, _Table(cells, count), outputs, lanes).results


def _run(program: Program, table: _Table, outputs: int, lanes: int) -> _Queue:
    """Run cells until none waits and none is at work."""
    lanes = round_up_to_blocks(lanes)
    width = _batch_width(lanes)

    def refill_and_round(queue: _Queue) -> _Queue:
        queue = _refill(program, table, width, queue)
        return queue._replace(at=queue.at._replace(carry=run_round(program, width, queue.at)))

    def unfinished(queue: _Queue) -> Bool[Array, ""]:
        return (queue.at.cell >= 0).any() | (queue.waiting < table.real)

    return lax.while_loop(unfinished, refill_and_round, _all_waiting(program, table, outputs, lanes))


def _all_waiting(program: Program, table: _Table, outputs: int, lanes: int) -> _Queue:
    """Return the queue before any cell is loaded; lanes hold zeros until `_refill` loads the first cells."""
    fresh = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, table.cells.shape[1]), table.cells.dtype))
    return _Queue(
        LaneState(jnp.full(lanes, -1, jnp.int32), jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), fresh)),
        waiting=jnp.asarray(0, jnp.int32),
        results=jnp.zeros((table.cells.shape[0], outputs), table.cells.dtype),
    )


def _refill(program: Program, table: _Table, width: int, queue: _Queue) -> _Queue:
    """Write the results of finished cells and load waiting ones, one batch at a time, as long as it pays."""
    # The decision and the exchange are kernels; the scatter into the result table is not, as no kernel may contain one.
    due = program.kernel(partial(_refill_due, program, table, width))
    exchange = program.kernel(partial(_exchange, program, table, width))

    def exchange_batch(queue: _Queue) -> _Queue:
        at, waiting, rows, result_rows = exchange(queue.at, queue.waiting)
        return queue._replace(at=at, waiting=waiting, results=queue.results.at[rows].set(result_rows, mode="drop"))

    return lax.while_loop(lambda queue: due(queue.at, queue.waiting), exchange_batch, queue)


def _free(program: Program, table: _Table, at: LaneState, waiting: Int[Array, ""]) -> Bool[Array, " lane"]:
    """Return True for lanes with a finished cell, and for lanes that await their first cell."""
    return jnp.where(at.cell >= 0, program.done(at.carry), waiting < table.real)


def _refill_due(program: Program, table: _Table, width: int, at: LaneState, waiting: Int[Array, ""]) -> Bool[Array, ""]:
    # While cells wait, a refill pays only for several lanes.
    enough = jnp.where(waiting < table.real, width, 1)
    return _free(program, table, at, waiting).sum() >= enough


def _exchange(program: Program, table: _Table, width: int, at: LaneState, waiting: Int[Array, ""]):
    """Load new cells into a batch of free lanes, and return the result rows of the cells that were finished there.

    Result rows of lanes without a finished cell have an index past the end of the table; the scatter drops them.
    """
    cells, count = table.cells, table.real
    batch = batch_of(_free(program, table, at, waiting), width)
    rows = at.cell[batch.members]
    rows = jnp.where((jnp.arange(width, dtype=jnp.int32) < batch.real) & (rows >= 0), rows, cells.shape[0])
    result_rows = program.unload(take_lanes(at.carry, batch.members))
    start = waiting + jnp.arange(width, dtype=jnp.int32)
    fresh = LaneState(jnp.where(start < count, start, -1), program.load(cells[jnp.minimum(start, cells.shape[0] - 1)]))
    return replace_rows(at, fresh, batch.members, batch.real), waiting + batch.real, rows, result_rows


def _lane_functions(program: Program, columns: int, kind: Any, lanes: int) -> tuple[Callable[..., Any], ...]:
    """Return three functions: load lanes, convert stored lanes to the program's record, run a round."""
    if on_cpu():
        return program.load, lambda carry: carry, partial(run_round, program)
    storage = lane_storage.choose_storage(program, columns, kind, lanes)

    def advance(width: int, at: LaneState) -> Any:
        return accelerator_scheduler.run_round(
            program, storage, width, at, accelerator_scheduler.count(program, storage, at)
        )

    return storage.load, storage.record, advance


class _Chains(NamedTuple):
    """State of the loop: lanes, the link of its chain that each lane works on (-1: none is left), the results."""

    carry: Carry
    link: Int[Array, " lane"]
    results: Float[Array, "lane link out"]


def chain(
    program: Program,
    succeed: Succeed,
    links: Float[Array, "lane link in"],
    count: Int[Array, ""],
    length: Int[Array, ""],
    outputs: int,
) -> Float[Array, "lane link out"]:
    """Run chains of cells, one lane each: every cell but the first starts where the previous one ended.

    A lane with a finished link waits until a few more lanes have finished theirs. These lanes then load their next
    links together, because a load costs as much as many steps.

    Args:
        program: Definition of a cell.
        succeed: Computes the rows of the next cells from the finished ones.
        links: The rows of every chain in order.
        count, length: Number of real chains, and of real links of a chain; the results of others are zeros.
        outputs: Length of a result row.
    """
    lanes, most, columns = links.shape
    if on_cpu() and lanes <= small_batch_scheduler.LANES:
        return small_batch_scheduler.chain(program, succeed, links, count, length, outputs)
    width = _batch_width(lanes)
    load, record, run_lanes = _lane_functions(program, columns, links.dtype, lanes)
    # Number of finished links that triggers the load of their next links.
    enough = max(lanes // _SHARE, 1)
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def ended(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, "lane"]:
        return (link >= 0) & program.done(record(carry))

    def due(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, ""]:
        number = ended(carry, link).sum()
        return (number >= enough) | ((number > 0) & (number >= count_movable(program, LaneState(link, record(carry)))))

    def exchange(carry: Carry, link: Int[Array, "lane"]):
        """Advance a batch of lanes to their next links; return their result rows and positions there."""
        batch = batch_of(ended(carry, link), width)
        rows, batch_carry = batch.members, take_lanes(carry, batch.members)
        link_index = link[rows]
        has_next = link_index + 1 < length
        fresh = load(succeed(record(batch_carry), links[rows, jnp.minimum(link_index + 1, most - 1)]))
        new = select(has_next, fresh, batch_carry), jnp.where(has_next, link_index + 1, -1)
        place = jnp.where(jnp.arange(width, dtype=jnp.int32) < batch.real, link_index, most)
        return *replace_rows((carry, link), new, rows, batch.real), rows, place, program.unload(record(batch_carry))

    def pass_on(state: _Chains) -> _Chains:
        carry, link, rows, place, result_rows = program.kernel(exchange)(state.carry, state.link)
        return _Chains(carry, link, state.results.at[rows, place].set(result_rows, mode="drop"))

    def advance(state: _Chains) -> _Chains:
        is_due = program.kernel(due)
        state = lax.while_loop(lambda state: is_due(state.carry, state.link), pass_on, state)
        return state._replace(carry=run_lanes(width, LaneState(state.link, state.carry)))

    start = _Chains(
        carry=load(links[:, 0]),
        link=jnp.where(lane < count, 0, -1).astype(jnp.int32),
        results=jnp.zeros((lanes, most, outputs), links.dtype),
    )
    return lax.while_loop(lambda state: (state.link >= 0).any(), advance, start).results
