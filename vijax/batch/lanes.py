"""Run N independent cells on L lanes in one compiled loop of fixed shape; finished lanes take waiting cells.

Memory is set by L and by the rows that go in and come out. Begin with `_run`: refill, round (`lane_rounds`), until
nothing is left.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch import accelerator_lanes, few_lanes, held_lanes
from vijax.batch.lane_rounds import AtWork, Carry, Program, Succeed, able, batch_of, run_round, take
from vijax.runtime.arrays import choose
from vijax.runtime.xla import on_cpu, put, whole_blocks

# One lane in so many is served or refilled together, and so many at least. A larger batch keeps slow cells waiting.
_SHARE, _FEWEST = 32, 4
# Rows of a CPU's table, and its lanes, however many cells there are: one program, which takes as long to compile as to
# run half a million cells, serves every plane. With 512 lanes planes of 10^5 cells would run a thirtieth sooner.
TABLE, _LANES = 32_768, 64
# So few cells of a CPU have a program of their own, `few_lanes`, as have as many chains as it has lanes.
FEW = 64


class _Queue(NamedTuple):
    """The loop's state: the lanes, the next cell to start, the results so far."""

    at: AtWork
    waiting: Int[Array, ""]
    results: Float[Array, "cell out"]


class _Table(NamedTuple):
    """The cells of a run, one row of parameters each, and how many of them are real."""

    cells: Float[Array, "cell in"]
    real: Int[Array, ""]


def few(cells: int) -> bool:
    """Say whether so many cells have the program of `few_lanes`."""
    return on_cpu() and cells <= FEW


def width_of(cells: int) -> int:
    """Choose the lanes of a tile: enough to fill vectors and hide loop overhead, few enough for cache and refilling.

    At the end of a tile they stand idle: 4,096 cells take half again as long with 512 lanes as with 64.
    """
    if few(cells):
        return few_lanes.LANES
    return _LANES if on_cpu() else accelerator_lanes.width_of(cells)


def table_rows(cells: int, variants: int) -> int:
    """Choose how many rows the table of a tile has, each with results for so many variants of a device."""
    if few(cells):
        return FEW
    return max(cells, TABLE // variants) if on_cpu() else cells


def _served(lanes: int) -> int:
    """Choose how many lanes are served or refilled together."""
    if not on_cpu():
        return accelerator_lanes.served(lanes)
    return max(lanes // _SHARE, _FEWEST)


def run(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int, lanes: int
) -> Float[Array, "cell out"]:
    """Run the first `count` cells to their end; rows past `count` come back as zeros.

    Args:
        program: What a cell is.
        cells: One row of parameters a cell.
        count: How many are real; the table may be padded.
        outputs: Length of a result row.
        lanes: How many cells are worked on at once, at least; up to `few_lanes.LANES` of a CPU: as many as those.

    A cell's result depends on its row alone: lanes never exchange anything, and each is advanced by the same
    elementwise arithmetic wherever it sits. To the last bit only if what several results need is stored (`xla.share`):
    LLVM makes several loops of one, of whole vectors and of what is left, and fuses multiplications and additions in
    each as it sees fit.
    """
    if not on_cpu():
        return accelerator_lanes.run(program, cells, count, outputs, lanes)
    if lanes <= few_lanes.LANES:
        return few_lanes.run(program, cells, count, outputs)
    return _run(program, _Table(cells, count), outputs, lanes).results


def _run(program: Program, table: _Table, outputs: int, lanes: int) -> _Queue:
    """Run cells until none waits and none is on its way."""
    lanes = whole_blocks(lanes)
    width = _served(lanes)

    def refill_and_round(queue: _Queue) -> _Queue:
        queue = _refill(program, table, width, queue)
        return queue._replace(at=queue.at._replace(carry=run_round(program, width, queue.at)))

    def goes_on(queue: _Queue) -> Bool[Array, ""]:
        return (queue.at.cell >= 0).any() | (queue.waiting < table.real)

    return lax.while_loop(goes_on, refill_and_round, _all_waiting(program, table, outputs, lanes))


def _all_waiting(program: Program, table: _Table, outputs: int, lanes: int) -> _Queue:
    """Make the queue before any cell is loaded: `_refill` loads the first ones too, until then lanes hold zeros."""
    fresh = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, table.cells.shape[1]), table.cells.dtype))
    return _Queue(
        AtWork(jnp.full(lanes, -1, jnp.int32), jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), fresh)),
        waiting=jnp.asarray(0, jnp.int32),
        results=jnp.zeros((table.cells.shape[0], outputs), table.cells.dtype),
    )


def _refill(program: Program, table: _Table, width: int, queue: _Queue) -> _Queue:
    """Write down the cells that are done and load waiting ones, a batch at a time, while that is worth its price."""
    due = program.kernel(partial(_refill_due, program, table, width))
    exchange = program.kernel(partial(_exchange, program, table, width))

    def one_batch(queue: _Queue) -> _Queue:
        at, waiting, rows, found = exchange(queue.at, queue.waiting)
        return queue._replace(at=at, waiting=waiting, results=queue.results.at[rows].set(found, mode="drop"))

    return lax.while_loop(lambda queue: due(queue.at, queue.waiting), one_batch, queue)


def _free(program: Program, table: _Table, at: AtWork, waiting: Int[Array, ""]) -> Bool[Array, " lane"]:
    """Find the lanes whose cell is done, or that wait for their first."""
    return jnp.where(at.cell >= 0, program.done(at.carry), waiting < table.real)


def _refill_due(program: Program, table: _Table, width: int, at: AtWork, waiting: Int[Array, ""]) -> Bool[Array, ""]:
    # With cells waiting a refill is worth its price only for several lanes.
    enough = jnp.where(waiting < table.real, width, 1)
    return _free(program, table, at, waiting).sum() >= enough


def _exchange(program: Program, table: _Table, width: int, at: AtWork, waiting: Int[Array, ""]):
    """Give lanes with new cells, and rows of the result table for those that were done; no cell: past its end."""
    cells, count = table.cells, table.real
    batch = batch_of(_free(program, table, at, waiting), width)
    rows = at.cell[batch.members]
    rows = jnp.where((jnp.arange(width, dtype=jnp.int32) < batch.real) & (rows >= 0), rows, cells.shape[0])
    found = program.unload(take(at.carry, batch.members))
    start = waiting + jnp.arange(width, dtype=jnp.int32)
    fresh = AtWork(jnp.where(start < count, start, -1), program.load(cells[jnp.minimum(start, cells.shape[0] - 1)]))
    return put(at, fresh, batch.members, batch.real), waiting + batch.real, rows, found


def _held(program: Program, columns: int, kind: Any, lanes: int) -> tuple[Callable[..., Any], ...]:
    """Say how lanes are loaded, how a program knows them, and what a round is."""
    if on_cpu():
        return program.load, lambda carry: carry, partial(run_round, program)
    held = held_lanes.hold(program, columns, kind, lanes)

    def advance(width: int, at: AtWork) -> Any:
        return accelerator_lanes.run_round(program, held, width, at, accelerator_lanes.count(program, held, at))

    return held.load, held.record, advance


class _Chains(NamedTuple):
    """The loop's state: lanes, the link of its chain that each one works on (-1: none is left), the results."""

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
    """Run chains of cells, a lane each: every cell but the first begins where the last one ended.

    Args:
        program: What a cell is.
        succeed: What a cell hands on to the next.
        links: The rows of every chain in order.
        count, length: How many lanes and links are real; the others come back as zeros.
        outputs: Length of a result row.

    A lane whose link has ended waits for a few others at most, which are passed on with it: to load a cell costs as
    much as many steps.
    """
    lanes, most, columns = links.shape
    if on_cpu() and lanes <= few_lanes.LANES:
        return few_lanes.chain(program, succeed, links, count, length, outputs)
    width = _served(lanes)
    load, record, moved = _held(program, columns, links.dtype, lanes)
    enough = max(lanes // _SHARE, 1)
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def ended(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, "lane"]:
        return (link >= 0) & program.done(record(carry))

    def due(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, ""]:
        number = ended(carry, link).sum()
        return (number >= enough) | ((number > 0) & (number >= able(program, AtWork(link, record(carry)))))

    def exchange(carry: Carry, link: Int[Array, "lane"]):
        """Pass a batch on; give rows of the result table, and where they belong: no link, past the last one."""
        batch = batch_of(ended(carry, link), width)
        rows, some = batch.members, take(carry, batch.members)
        before = link[rows]
        goes_on = before + 1 < length
        fresh = load(succeed(record(some), links[rows, jnp.minimum(before + 1, most - 1)]))
        new = choose(goes_on, fresh, some), jnp.where(goes_on, before + 1, -1)
        place = jnp.where(jnp.arange(width, dtype=jnp.int32) < batch.real, before, most)
        return *put((carry, link), new, rows, batch.real), rows, place, program.unload(record(some))

    def pass_on(state: _Chains) -> _Chains:
        carry, link, rows, place, found = program.kernel(exchange)(state.carry, state.link)
        return _Chains(carry, link, state.results.at[rows, place].set(found, mode="drop"))

    def advance(state: _Chains) -> _Chains:
        is_due = program.kernel(due)
        state = lax.while_loop(lambda state: is_due(state.carry, state.link), pass_on, state)
        return state._replace(carry=moved(width, AtWork(state.link, state.carry)))

    start = _Chains(
        carry=load(links[:, 0]),
        link=jnp.where(lane < count, 0, -1).astype(jnp.int32),
        results=jnp.zeros((lanes, most, outputs), links.dtype),
    )
    return lax.while_loop(lambda state: (state.link >= 0).any(), advance, start).results
