"""Run N independent cells on L lanes in one compiled loop of fixed shape; finished lanes take waiting cells.

Knows no physics: a `Program` says what a cell is, what one quick trip does to every lane at once, and what the rare
lane that declines needs instead. Memory is set by L and by the rows that go in and come out.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.xla import in_blocks, kernel, put, share, whole_blocks

Carry = Any
"""A pytree of arrays whose leading axis is the lane."""

Step = Callable[..., Any]
"""A function of the loop, on arrays."""

TRIPS = 8  # quick trips between two rounds of serving, reviewing and refilling
_CHAIN_TRIPS = 4  # likewise, where lanes are few and a lane that waits holds up its chain
_SHARE, _FEWEST = 32, 16  # one lane in so many is served or refilled together: a larger batch keeps slow cells waiting


class Service(NamedTuple):
    """What becomes of lanes that a trip declined; every function works on a whole batch of lanes, row by row.

    Attributes:
        declined, hard: Carry -> which lanes are; a hard lane needs the careful try.
        request: Carry -> the part of it that serving a lane needs.
        second, careful: Requests -> answers; what `second` is not sure of is left to `careful`, which would hold up a
            whole batch. None: every declined lane is hard.
        settle: Carry, an answer for every lane, which lanes were served -> carry; unsure answers mark the lane hard.
    """

    declined: Callable[[Carry], Bool[Array, "lane"]]
    hard: Callable[[Carry], Bool[Array, "lane"]]
    request: Callable[[Carry], Any]
    second: Callable[[Any], Any] | None
    careful: Callable[[Any], Any]
    settle: Callable[[Carry, Any, Bool[Array, "lane"]], Carry]


class Program(NamedTuple):
    """What `run` is told about a cell; every function works on a whole batch of lanes, row by row.

    Attributes:
        load: Rows of the cell table -> fresh carry.
        trip: Carry -> carry after one trip; it may decline lanes where there is a service.
        review: Carry -> carry; what is too slow for every trip: decisions, ends.
        stopped, done: Carry -> which lanes are; a stopped lane waits for review.
        unload: Carry -> rows of the result table.
        service: For the rare lane that a trip declines.
        arithmetic: Whether all of it may be put in kernels, see `xla.kernel`.
    """

    load: Callable[[Float[Array, "row in"]], Carry]
    trip: Callable[[Carry], Carry]
    review: Callable[[Carry], Carry]
    stopped: Callable[[Carry], Bool[Array, "lane"]]
    done: Callable[[Carry], Bool[Array, "lane"]]
    unload: Callable[[Carry], Float[Array, "row out"]]
    service: Service | None = None
    arithmetic: bool = True


class _Queue(NamedTuple):
    """The loop's state: lanes, the cell each one works on (-1: idle), the next cell to start."""

    carry: Carry
    cell: Int[Array, "lane"]
    waiting: Int[Array, ""]


class _Batch(NamedTuple):
    """A few lanes of many: which they are, how many are real, and for every lane whether it is among them."""

    members: Int[Array, "width"]
    real: Int[Array, ""]
    chosen: Bool[Array, "lane"]


def _cumulative(count: Int[Array, "lane"]) -> Int[Array, "lane"]:
    """Running sum by doubling: on CPU ten times faster than XLA's."""
    reach = 1
    while reach < count.size:
        count = count + jnp.pad(count[:-reach], (reach, 0))
        reach *= 2
    return count


def _first(mask: Bool[Array, "lane"], width: int) -> _Batch:
    """The first `width` lanes of a mask.

    By rank and binary search: gathers run at memory speed on every backend, scatters do not.
    """
    rank = _cumulative(mask.astype(jnp.int32))
    members = jnp.searchsorted(rank, jnp.arange(1, width + 1, dtype=jnp.int32))
    chosen = mask & (rank <= width)
    return share(_Batch(jnp.minimum(members, mask.size - 1), chosen.sum(dtype=jnp.int32), chosen))


def _take(carry: Carry, rows: Int[Array, "width"]) -> Carry:
    return jax.tree.map(lambda leaf: leaf[rows], carry)


def choose(mask: Bool[Array, "lane"], new: Carry, old: Carry) -> Carry:
    """`new` where the mask is true, else `old`, leaf by leaf and lane by lane."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def _maker(program: Program) -> Callable[[Step], Step]:
    """What every step of the loop goes through before it is called."""
    return kernel if program.arithmetic else lambda step: step


def _worker(program: Program, width: int, trips: int) -> Callable[[Int[Array, "lane"], Carry], Carry]:
    """One round of trips, service and review, of the lanes that have a cell.

    Args:
        program: What a cell is.
        width: How many lanes are served together.
        trips: Most trips of a round.
    """
    service, made = program.service, _maker(program)

    def declined(cell, carry):
        return service.declined(carry) & (cell >= 0) if service else jnp.zeros_like(cell, bool)

    def able(cell, carry):
        return ((cell >= 0) & ~declined(cell, carry) & ~program.stopped(carry)).sum()

    @made
    def to_serve(cell, carry):
        """Whether a batch of easy or of hard lanes is full, or half the lanes at work can go no further without one."""
        asking, hard = declined(cell, carry), service.hard(carry)
        full = ((asking & ~hard).sum() >= width) | ((asking & hard).sum() >= width)
        return full | (asking.any() & (asking.sum() >= able(cell, carry)))

    @made
    def ask(cell, carry):
        """Whose turn it is, easy lanes or hard ones, and their requests."""
        asking, hard = declined(cell, carry), service.hard(carry)
        easy = (asking & ~hard).sum() >= jnp.minimum((asking & hard).sum(), width)
        batch = _first(asking & (hard != easy), width)
        return easy, batch, _take(service.request(carry), batch.members)

    @made
    def settle(carry, answers, batch):
        blank = jax.tree.map(lambda leaf: jnp.zeros((batch.chosen.size, *leaf.shape[1:]), leaf.dtype), answers)
        return service.settle(carry, put(blank, answers, batch.members, batch.real), batch.chosen)

    def serve(cell, carry):
        """A second try for easy lanes together, or the careful one for hard lanes."""
        easy, batch, requests = ask(cell, carry)
        if service.second is None:
            answers = made(service.careful)(requests)
        else:
            answers = lax.cond(easy, made(service.second), made(service.careful), requests)
        return settle(carry, answers, batch)

    def keeps_on(at_first, state):
        """Up to so many trips, fewer once half the lanes that set out wait for something else."""
        trip, (cell, carry) = state
        return (trip < trips) & (2 * able(cell, carry) > at_first)

    def one_trip(state):
        trip, (cell, carry) = state
        return trip + 1, (cell, program.trip(carry))

    def some_trips(at_work):
        going = partial(keeps_on, able(*at_work))
        return lax.while_loop(going, one_trip, (0, at_work))[1]

    @made
    def all_trips(cell, carry):
        return in_blocks(some_trips, (cell, carry))[1]

    def round_trip(cell, carry):
        carry = all_trips(cell, carry)
        if service:
            carry = lax.while_loop(partial(to_serve, cell), partial(serve, cell), carry)
        return made(program.review)(carry)

    return round_trip


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
    lanes, made = whole_blocks(lanes), _maker(program)
    width = min(max(lanes // _SHARE, _FEWEST), lanes)
    round_trip = _worker(program, width, TRIPS)

    def free(queue: _Queue) -> Bool[Array, "lane"]:
        """Lanes whose cell is done, or that wait for their first."""
        return jnp.where(queue.cell >= 0, program.done(queue.carry), queue.waiting < count)

    @made
    def exchange(queue: _Queue) -> tuple[_Queue, Int[Array, "width"], Float[Array, "width out"]]:
        """Lanes with new cells, and rows of the result table for those that were done; no cell: past its end."""
        batch = _first(free(queue), width)
        rows = queue.cell[batch.members]
        rows = jnp.where((jnp.arange(width, dtype=jnp.int32) < batch.real) & (rows >= 0), rows, cells.shape[0])
        found = program.unload(_take(queue.carry, batch.members))
        start = queue.waiting + jnp.arange(width, dtype=jnp.int32)
        fresh = program.load(cells[jnp.minimum(start, cells.shape[0] - 1)]), jnp.where(start < count, start, -1)
        carry, cell = put((queue.carry, queue.cell), fresh, batch.members, batch.real)
        return _Queue(carry, cell, queue.waiting + batch.real), rows, found

    def refill(state: tuple[_Queue, Float[Array, "cell out"]]) -> tuple[_Queue, Float[Array, "cell out"]]:
        queue, results = state
        queue, rows, found = exchange(queue)
        return queue, results.at[rows].set(found, mode="drop")

    @made
    def to_refill(queue: _Queue) -> Bool[Array, ""]:
        # With cells waiting a refill is worth its price only for several lanes; at the end nobody waits for it.
        enough = jnp.where(queue.waiting < count, width, 1)
        return free(queue).sum() >= enough

    def advance(state: tuple[_Queue, Float[Array, "cell out"]]) -> tuple[_Queue, Float[Array, "cell out"]]:
        queue, results = lax.while_loop(lambda s: to_refill(s[0]), refill, state)
        return queue._replace(carry=round_trip(queue.cell, queue.carry)), results

    def goes_on(state):
        queue, _ = state
        return (queue.cell >= 0).any() | (queue.waiting < count)

    # Every cell is loaded by `refill`, the first ones too; until then its lane holds zeros.
    fresh = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, cells.shape[1]), cells.dtype))
    queue = _Queue(
        carry=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), fresh),
        cell=jnp.full(lanes, -1, jnp.int32),
        waiting=jnp.asarray(0, jnp.int32),
    )
    return lax.while_loop(goes_on, advance, (queue, jnp.zeros((cells.shape[0], outputs), cells.dtype)))[1]


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

    No lane waits for another's link to end. Lanes being few, what an operation costs hardly depends on how many work
    at it: all that decline are served together, and at once.
    """
    lanes, most, _ = links.shape
    round_trip = _worker(program, lanes, _CHAIN_TRIPS)
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def ended(state: _Chains) -> Bool[Array, "lane"]:
        return (state.link >= 0) & program.done(state.carry)

    def pass_on(state: _Chains) -> _Chains:
        done = ended(state)
        results = state.results.at[lane, jnp.where(done, state.link, most)].set(
            program.unload(state.carry), mode="drop"
        )
        after = state.link + 1
        goes_on = done & (after < length)
        fresh = program.load(succeed(state.carry, links[lane, jnp.minimum(after, most - 1)]))
        carry = choose(goes_on, fresh, state.carry)
        return _Chains(carry, jnp.where(goes_on, after, jnp.where(done, -1, state.link)), results)

    def advance(state: _Chains) -> _Chains:
        due = ended(state).any()
        state = lax.cond(due, pass_on, lambda state: state, state)
        return state._replace(carry=round_trip(state.link, state.carry))

    start = _Chains(
        carry=program.load(links[:, 0]),
        link=jnp.where(lane < count, 0, -1).astype(jnp.int32),
        results=jnp.zeros((lanes, most, outputs), links.dtype),
    )
    return lax.while_loop(lambda state: (state.link >= 0).any(), advance, start).results
