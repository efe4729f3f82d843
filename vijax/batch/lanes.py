"""Run N independent cells on L lanes in one compiled loop of fixed shape; finished lanes take waiting cells.

Knows no physics: a `Program` says what a cell is, what one quick step does to every lane at once, and what the rare
lane that declines it needs instead. Memory is set by L and by the rows that go in and come out.

Begin with `_run`: refill, round, until nothing is left. A round (`_round`) is some quick steps of all lanes (`_steps`),
then the service of those that declined one (`_serve`), then the review of those that have stopped.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch import rows
from vijax.runtime.arrays import choose
from vijax.runtime.xla import first, in_blocks, kernel, on_cpu, put, repeat, shared, whole_blocks

P = ParamSpec("P")
T = TypeVar("T")

Carry = Any
"""A pytree of arrays whose leading axis is the lane."""

# Quick steps between two rounds of serving, reviewing and refilling: with fewer, the rounds cost more than the steps,
# with more, lanes that wait stand idle. No result depends on it.
STEPS = 16
_SHARE, _FEWEST = 32, 4  # one lane in so many is served or refilled together: a larger batch keeps slow cells waiting


class Service(NamedTuple):
    """What becomes of lanes that declined a step; every function works on a whole batch of lanes, row by row.

    Attributes:
        declined, hard: Carry -> which lanes are; a hard lane needs the careful try.
        request: Carry -> the part of it that serving a lane needs.
        second, careful: Requests -> answers; what `second` is not sure of is left to `careful`, which would hold up a
            whole batch.
        settle: Carry, an answer for every lane, which lanes were served -> carry; unsure answers mark the lane hard.
    """

    declined: Callable[[Carry], Bool[Array, "lane"]]
    hard: Callable[[Carry], Bool[Array, "lane"]]
    request: Callable[[Carry], Any]
    second: Callable[[Any], Any]
    careful: Callable[[Any], Any]
    settle: Callable[[Carry, Any, Bool[Array, "lane"]], Carry]


class Program(NamedTuple):
    """What `run` is told about a cell; every function works on a whole batch of lanes, row by row.

    Attributes:
        load: Rows of the cell table -> fresh carry.
        step: Carry -> carry after one step; it may decline lanes where there is a service.
        review: Carry -> carry; what is too slow for every step: decisions, ends.
        stopped, done: Carry -> which lanes are; a stopped lane waits for review.
        unload: Carry -> rows of the result table.
        service: For the rare lane that declines a step.
        steps: How many are taken between two rounds.
        arithmetic: Whether all of it may be put in kernels, see `xla.kernel`.
    """

    load: Callable[[Float[Array, "row in"]], Carry]
    step: Callable[[Carry], Carry]
    review: Callable[[Carry], Carry]
    stopped: Callable[[Carry], Bool[Array, "lane"]]
    done: Callable[[Carry], Bool[Array, "lane"]]
    unload: Callable[[Carry], Float[Array, "row out"]]
    service: Service | None = None
    steps: int = STEPS
    arithmetic: bool = True

    def kernel(self, work: Callable[P, T]) -> Callable[P, T]:
        """Make one kernel of a function, if all of the program may be put in kernels."""
        return kernel(work) if self.arithmetic else work


class _Batch(NamedTuple):
    """A few lanes of many: which they are, how many are real, and for every lane whether it is among them."""

    members: Int[Array, "width"]
    real: Int[Array, ""]
    chosen: Bool[Array, "lane"]


@shared
def _first(mask: Bool[Array, "lane"], width: int) -> _Batch:
    """Find the first `width` lanes of a mask."""
    members, chosen = first(mask, width)
    return _Batch(members, chosen.sum(dtype=jnp.int32), chosen)


def _take(carry: Carry, rows: Int[Array, "width"]) -> Carry:
    return jax.tree.map(lambda leaf: leaf[rows], carry)


class _AtWork(NamedTuple):
    """The lanes: the cell each one works on (-1: idle), and where that cell is."""

    cell: Int[Array, "lane"]
    carry: Carry


def _declined(program: Program, at: _AtWork) -> Bool[Array, "lane"]:
    return program.service.declined(at.carry) & (at.cell >= 0) if program.service else jnp.zeros_like(at.cell, bool)


def _able(program: Program, at: _AtWork) -> Int[Array, ""]:
    """Count the lanes that the next step would move."""
    return ((at.cell >= 0) & ~_declined(program, at) & ~program.stopped(at.carry)).sum()


def _round(program: Program, width: int, at: _AtWork) -> Carry:
    """Run one round of the lanes that have a cell: steps, service, review.

    Args:
        program: What a cell is.
        width: How many lanes are served together.
        at: The lanes.
    """
    carry = program.kernel(partial(_steps, program))(*at)
    if service := program.service:
        due = program.kernel(partial(_service_due, program, service, width))
        serve = partial(_serve, program, service, width)
        carry = lax.while_loop(partial(due, at.cell), partial(serve, at.cell), carry)
    return program.kernel(program.review)(carry)


def _steps(program: Program, cell: Int[Array, "lane"], carry: Carry) -> Carry:
    """Take up to so many steps; fewer once half the lanes that set out wait for something else."""

    def some_steps(at: _AtWork) -> _AtWork:
        at_first = _able(program, at)

        def goes_on(at: _AtWork) -> Bool[Array, ""]:
            return 2 * _able(program, at) > at_first

        return repeat(lambda at: at._replace(carry=program.step(at.carry)), program.steps, goes_on, at)

    return in_blocks(some_steps, _AtWork(cell, carry)).carry


def _service_due(
    program: Program, service: Service, width: int, cell: Int[Array, "lane"], carry: Carry
) -> Bool[Array, ""]:
    """Say whether a batch of easy or of hard lanes is full, or half the lanes at work can go no further without one."""
    at = _AtWork(cell, carry)
    asking, hard = _declined(program, at), service.hard(carry)
    full = ((asking & ~hard).sum() >= width) | ((asking & hard).sum() >= width)
    return full | (asking.any() & (asking.sum() >= _able(program, at)))


def _serve(program: Program, service: Service, width: int, cell: Int[Array, "lane"], carry: Carry) -> Carry:
    """Give a batch of easy lanes their second try, or a batch of hard ones the careful try."""
    easy, batch, requests = program.kernel(partial(_ask, program, service, width))(cell, carry)
    answers = lax.cond(easy, program.kernel(service.second), program.kernel(service.careful), requests)
    return program.kernel(partial(_settle, service))(carry, answers, batch)


def _ask(
    program: Program, service: Service, width: int, cell: Int[Array, "lane"], carry: Carry
) -> tuple[Bool[Array, ""], _Batch, Any]:
    """Say whose turn it is, easy lanes or hard ones, and what they request."""
    asking, hard = _declined(program, _AtWork(cell, carry)), service.hard(carry)
    easy = (asking & ~hard).sum() >= jnp.minimum((asking & hard).sum(), width)
    batch = _first(asking & (hard != easy), width)
    return easy, batch, _take(service.request(carry), batch.members)


def _settle(service: Service, carry: Carry, answers: Any, batch: _Batch) -> Carry:
    """Give the lanes with the answers of those that were served."""
    blank = jax.tree.map(lambda leaf: jnp.zeros((batch.chosen.size, *leaf.shape[1:]), leaf.dtype), answers)
    return service.settle(carry, put(blank, answers, batch.members, batch.real), batch.chosen)


class _Queue(NamedTuple):
    """The loop's state: the lanes, the next cell to start, the results so far."""

    at: _AtWork
    waiting: Int[Array, ""]
    results: Float[Array, "cell out"]


class _Table(NamedTuple):
    """The cells of a run, one row of parameters each, and how many of them are real."""

    cells: Float[Array, "cell in"]
    real: Int[Array, ""]


def width_of(cells: int) -> int:
    """Choose the lanes of a tile: enough to fill vectors and hide loop overhead, few enough for cache and refilling.

    At the end of a tile they stand idle: 4,096 cells take half again as long with 512 lanes as with 64. An accelerator
    takes nearly as long for a step of 8,192 lanes as for one of 32,768, and beyond in proportion; at the end of a tile
    few lanes are left, and the steps of all are waited for.
    """
    if on_cpu():
        return max(min(cells // 64, 512), 64)
    return max(min(cells // 8, 131_072), min(cells, 8_192))


class Left(NamedTuple):
    """Cells that were not flown to their end: which (-1: none), and all that their lanes know of them, as rows."""

    cell: Int[Array, "few"]
    lanes: Float[Array, "few column"]


def run(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int, lanes: int
) -> Float[Array, "cell out"]:
    """Run the first `count` cells to their end; rows past `count` come back as zeros.

    Args:
        program: What a cell is.
        cells: One row of parameters a cell.
        count: How many are real; the table may be padded.
        outputs: Length of a result row.
        lanes: How many cells are worked on at once, at least.

    A cell's result depends on its row alone: lanes never exchange anything, and each is advanced by the same
    elementwise arithmetic wherever it sits. To the last bit only if what several results need is stored (`xla.share`):
    LLVM makes several loops of one, of whole vectors and of what is left, and fuses multiplications and additions in
    each as it sees fit.
    """
    return _run(program, _Table(cells, count), outputs, lanes, 0).results


def run_most(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int, lanes: int, few: int
) -> tuple[Float[Array, "cell out"], Left]:
    """Do what `run` does until so few cells are left, whose rows of results are zeros; `resumed` goes on with them."""
    queue = _run(program, _Table(cells, count), outputs, lanes, few)
    batch = _first(queue.at.cell >= 0, few)
    real = jnp.arange(few, dtype=jnp.int32) < batch.real
    cell = jnp.where(real, queue.at.cell[batch.members], -1)
    return queue.results, Left(cell, rows.pack(_take(queue.at.carry, batch.members)))


def resumed(program: Program, like: Float[Array, "row in"]) -> Program:
    """Make the program whose cells are rows of `Left`; `like` has the shape of rows of the one that left them."""
    lane = jax.eval_shape(program.load, like)
    return program._replace(load=partial(rows.unpack, like=lane))


def _run(program: Program, table: _Table, outputs: int, lanes: int, few: int) -> _Queue:
    """Run cells until none waits and no more than `few` are on a lane."""
    lanes = whole_blocks(lanes)
    width = min(max(lanes // _SHARE, _FEWEST), lanes)

    def refill_and_round(queue: _Queue) -> _Queue:
        queue = _refill(program, table, width, queue)
        return queue._replace(at=queue.at._replace(carry=_round(program, width, queue.at)))

    def goes_on(queue: _Queue) -> Bool[Array, ""]:
        busy = queue.at.cell >= 0
        return (busy.sum() > few if few else busy.any()) | (queue.waiting < table.real)

    return lax.while_loop(goes_on, refill_and_round, _all_waiting(program, table, outputs, lanes))


def _all_waiting(program: Program, table: _Table, outputs: int, lanes: int) -> _Queue:
    """Make the queue before any cell is loaded: `_refill` loads the first ones too, until then lanes hold zeros."""
    fresh = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, table.cells.shape[1]), table.cells.dtype))
    return _Queue(
        _AtWork(jnp.full(lanes, -1, jnp.int32), jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), fresh)),
        waiting=jnp.asarray(0, jnp.int32),
        results=jnp.zeros((table.cells.shape[0], outputs), table.cells.dtype),
    )


def _refill(program: Program, table: _Table, width: int, queue: _Queue) -> _Queue:
    """Write down the cells that are done and load waiting ones, a batch at a time, while that is worth its price."""
    due = program.kernel(partial(_refill_due, program, table, width))
    exchange = program.kernel(partial(_exchange, program, table, width))

    def one_batch(queue: _Queue) -> _Queue:
        at, waiting, rows, found = exchange(queue.at, queue.waiting)
        return _Queue(at, waiting, queue.results.at[rows].set(found, mode="drop"))

    return lax.while_loop(lambda queue: due(queue.at, queue.waiting), one_batch, queue)


def _free(program: Program, table: _Table, at: _AtWork, waiting: Int[Array, ""]) -> Bool[Array, "lane"]:
    """Find the lanes whose cell is done, or that wait for their first."""
    return jnp.where(at.cell >= 0, program.done(at.carry), waiting < table.real)


def _refill_due(program: Program, table: _Table, width: int, at: _AtWork, waiting: Int[Array, ""]) -> Bool[Array, ""]:
    # With cells waiting a refill is worth its price only for several lanes; at the end nobody waits for it.
    enough = jnp.where(waiting < table.real, width, 1)
    return _free(program, table, at, waiting).sum() >= enough


def _exchange(program: Program, table: _Table, width: int, at: _AtWork, waiting: Int[Array, ""]):
    """Give lanes with new cells, and rows of the result table for those that were done; no cell: past its end."""
    cells, count = table.cells, table.real
    batch = _first(_free(program, table, at, waiting), width)
    rows = at.cell[batch.members]
    rows = jnp.where((jnp.arange(width, dtype=jnp.int32) < batch.real) & (rows >= 0), rows, cells.shape[0])
    found = program.unload(_take(at.carry, batch.members))
    start = waiting + jnp.arange(width, dtype=jnp.int32)
    fresh = _AtWork(jnp.where(start < count, start, -1), program.load(cells[jnp.minimum(start, cells.shape[0] - 1)]))
    return put(at, fresh, batch.members, batch.real), waiting + batch.real, rows, found


class _Chains(NamedTuple):
    """The loop's state: lanes, the link of its chain that each one works on (-1: none is left), the results."""

    carry: Carry
    link: Int[Array, "lane"]
    results: Float[Array, "lane link out"]


def chain(
    program: Program,
    succeed: Callable[[Carry, Float[Array, "lane in"]], Float[Array, "lane in"]],
    links: Float[Array, "lane link in"],
    count: Int[Array, ""],
    length: Int[Array, ""],
    outputs: int,
) -> Float[Array, "lane link out"]:
    """Run chains of cells, a lane each: every cell but the first begins where the last one ended.

    Args:
        program: What a cell is.
        succeed: Carries that are done, and the rows of the next cells -> these rows, with what is handed on.
        links: The rows of every chain in order.
        count, length: How many lanes and links are real; the others come back as zeros.
        outputs: Length of a result row.

    A lane whose link has ended waits for a few others at most, which are passed on with it: to load a cell costs as
    much as many steps.
    """
    lanes, most, _ = links.shape
    width, enough = min(max(lanes // _SHARE, _FEWEST), lanes), max(lanes // _SHARE, 1)
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def ended(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, "lane"]:
        return (link >= 0) & program.done(carry)

    def due(carry: Carry, link: Int[Array, "lane"]) -> Bool[Array, ""]:
        number = ended(carry, link).sum()
        return (number >= enough) | ((number > 0) & (number >= _able(program, _AtWork(link, carry))))

    def exchange(carry: Carry, link: Int[Array, "lane"]):
        """Pass a batch on; give rows of the result table, and where they belong: no link, past the last one."""
        batch = _first(ended(carry, link), width)
        rows, some = batch.members, _take(carry, batch.members)
        before = link[rows]
        goes_on = before + 1 < length
        fresh = program.load(succeed(some, links[rows, jnp.minimum(before + 1, most - 1)]))
        new = choose(goes_on, fresh, some), jnp.where(goes_on, before + 1, -1)
        place = jnp.where(jnp.arange(width, dtype=jnp.int32) < batch.real, before, most)
        return *put((carry, link), new, rows, batch.real), rows, place, program.unload(some)

    def pass_on(state: _Chains) -> _Chains:
        carry, link, rows, place, found = program.kernel(exchange)(state.carry, state.link)
        return _Chains(carry, link, state.results.at[rows, place].set(found, mode="drop"))

    def advance(state: _Chains) -> _Chains:
        is_due = program.kernel(due)
        state = lax.while_loop(lambda state: is_due(state.carry, state.link), pass_on, state)
        return state._replace(carry=_round(program, width, _AtWork(state.link, state.carry)))

    start = _Chains(
        carry=program.load(links[:, 0]),
        link=jnp.where(lane < count, 0, -1).astype(jnp.int32),
        results=jnp.zeros((lanes, most, outputs), links.dtype),
    )
    return lax.while_loop(lambda state: (state.link >= 0).any(), advance, start).results
