"""Run N independent cells on the lanes of an accelerator; where few are left, others may fly them to their end.

Between two kernels an accelerator stands still for as long as a small one takes. So a round counts its lanes once, and
what is due by that count is done once: lanes that are done take waiting cells, or a batch of lanes is served, and then
all take their steps. Begin with `run_most`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch import rows
from vijax.batch.held_lanes import Hold, hold
from vijax.batch.lane_rounds import AtWork, Program, asking, batch_of, take
from vijax.runtime import registers

T = TypeVar("T")

# One lane in so many is served or refilled together. A larger batch keeps slow cells waiting; but to serve 16,384 lanes
# takes no longer than to serve 4,096.
_SHARE = 8
# Batches of lanes that one refill may load: where many cells end early, no lane waits for the next one.
_REFILLED = 2
# Of a batch, the share that is enough for careful tries: one takes as long however many lanes have it.
_HARD = 1 / 16
_NOBODY, _EASY_ONES, _HARD_ONES = range(3)
# It goes on with as few cells as it may leave while such a share of them ends in a round, on the average of so many:
# others, who fly side by side, take as long for these as it does for a round.
_SHARE_OF_A_ROUND, _ROUNDS = 1 / 256, 16


def width_of(cells: int) -> int:
    """Choose the lanes of a tile.

    A step of 8,192 lanes takes nearly as long as one of 32,768, and beyond in proportion; at the end of a tile few
    lanes are left, and the steps of all are waited for.
    """
    return registers.whole_blocks(max(min(cells // 8, 131_072), min(cells, 8_192)), _SHARE)


def served(lanes: int) -> int:
    """Choose how many lanes are served together, and are enough for a refill: whole blocks, where there are so many."""
    return min(registers.whole_blocks(-(-lanes // _SHARE), 1), lanes)


class Left(NamedTuple):
    """Cells that were not flown to their end: which (-1: none), and all that their lanes know of them, as rows."""

    cell: Int[Array, " few"]
    lanes: Float[Array, "few column"]


def resumed(program: Program, like: Float[Array, "row in"]) -> Program:
    """Make the program whose cells are rows of `Left`; `like` has the shape of rows of the one that left them."""
    lane = jax.eval_shape(program.load, like)
    return program._replace(load=partial(rows.unpack, like=lane))


# --- rounds ----------------------------------------------------------------------------------------------------------


class Counted(NamedTuple):
    """How many lanes ask for an easy or for a hard answer, a step would move, fly a cell, are done with one."""

    easy: Int[Array, ""]
    hard: Int[Array, ""]
    going: Int[Array, ""]
    flying: Int[Array, ""]
    done: Int[Array, ""]


def count(program: Program, held: Hold, at: AtWork) -> Counted:
    """Count the lanes, in one pass."""
    at = at._replace(carry=held.record(at.carry))
    done, there = program.done(at.carry), at.cell >= 0
    easy, hard = asking(program, at)
    going = there & ~easy & ~hard & ~program.stopped(at.carry)
    masks = [mask.astype(jnp.int32) for mask in (easy, hard, going, there & ~done, there & done)]
    zeros = [jnp.int32(0)] * len(masks)
    sums = lax.reduce(masks, zeros, lambda some, others: [a + b for a, b in zip(some, others, strict=True)], (0,))
    return Counted(*sums)


def run_round(program: Program, held: Hold, width: int, at: AtWork, counted: Counted) -> Any:
    """Serve a batch of lanes if that is due, and take steps with all."""
    if program.service:
        turn = _turn(counted, width)
        serve = partial(_serve, program, held, width, turn == _HARD_ONES, at.cell)
        at = at._replace(carry=_if(turn != _NOBODY, serve, at.carry))
    return held.steps(at)


def _if(due: Bool[Array, ""], work: Callable[[T], T], state: T) -> T:
    """Do `work` if it is due: as a loop, which works in place where XLA's conditional copies what it may change."""
    return lax.while_loop(lambda left: left[0], lambda left: (jnp.zeros_like(due), work(left[1])), (due, state))[1]


def _turn(counted: Counted, width: int) -> Int[Array, ""]:
    """Say who is served.

    A batch, once it is full or half the lanes at work can go no further without; a hard one waits for others until
    nobody else goes on, or they are many.
    """
    easy, hard, going = counted.easy, counted.hard, counted.going
    many = hard >= max(int(width * _HARD), 1)
    due = (easy >= width) | many | jnp.where(easy > 0, easy >= going, (hard > 0) & (going == 0))
    return jnp.where(due, jnp.where((easy > 0) & ~many, _EASY_ONES, _HARD_ONES), _NOBODY)


def _serve(
    program: Program, held: Hold, width: int, hard: Bool[Array, ""], cell: Int[Array, " lane"], carry: Any
) -> Any:
    """Give a batch of lanes a try: the first ones that ask for a hard one, or for an easy one."""
    easy_ones, hard_ones = asking(program, AtWork(cell, held.record(carry)))
    return held.answer(carry, batch_of(jnp.where(hard, hard_ones, easy_ones), width), hard)


# --- the loop --------------------------------------------------------------------------------------------------------


class _UnderWay(NamedTuple):
    """The loop's state.

    Attributes:
        at: The lanes.
        counted: What they are at.
        waiting: The next cell to start.
        results: Of cells that ended, so far.
        pace: How many cells end in a round.
    """

    at: AtWork
    counted: Counted
    waiting: Int[Array, ""]
    results: Float[Array, "cell out"]
    pace: Float[Array, ""]


class _Mission(NamedTuple):
    """What the loop is told: the program, how lanes are held, the table of cells and how many are real, how few rest.

    Attributes:
        width: How many lanes are served together, or are enough for a refill.
        few: How many cells may be left.
    """

    program: Program
    held: Hold
    cells: Float[Array, "cell in"]
    real: Int[Array, ""]
    width: int
    few: int


def run(
    program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], outputs: int, lanes: int
) -> Float[Array, "cell out"]:
    """Run the first `real` cells to their end; rows past them come back as zeros. Arguments as in `lanes.run`."""
    return _run(_asked(program, cells, real, lanes, 0), outputs, lanes).results


def run_most(
    program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], outputs: int, lanes: int, few: int
) -> tuple[Float[Array, "cell out"], Left]:
    """Do what `run` does until few cells are left, whose rows of results are zeros; `resumed` goes on with them.

    At most `few`, and fewer where those end quickly: what is left in the end asks again and again to be served, and
    takes the accelerator longer than it takes others.
    """
    asked = _asked(program, cells, real, lanes, few)
    under_way = _run(asked, outputs, lanes)
    at = under_way.at
    batch = batch_of(at.cell >= 0, few)
    there = jnp.arange(few, dtype=jnp.int32) < batch.real
    cell = jnp.where(there, at.cell[batch.members], -1)
    return under_way.results, Left(cell, rows.pack(asked.held.record(take(at.carry, batch.members))))


def _asked(program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], lanes: int, few: int) -> _Mission:
    held = hold(program, cells.shape[1], cells.dtype, lanes)
    return _Mission(program, held, cells, real, served(lanes), few)


def _run(asked: _Mission, outputs: int, lanes: int) -> _UnderWay:
    """Run cells until none waits and no more than few are on their way."""
    zero, kind = jnp.asarray(0, jnp.int32), asked.cells.dtype
    start = _UnderWay(
        AtWork(jnp.full(lanes, -1, jnp.int32), asked.held.blank()),
        Counted(*[zero] * len(Counted._fields)),
        waiting=zero,
        results=jnp.zeros((asked.cells.shape[0], outputs), kind),
        pace=jnp.asarray(0.0, kind),
    )
    return lax.while_loop(partial(_goes_on, asked), partial(_refilled_and_moved, asked), start)


def _refilled_and_moved(asked: _Mission, state: _UnderWay) -> _UnderWay:
    before = state.counted.flying - jnp.minimum(state.waiting, asked.real)
    state = _if(_refill_due(asked, state), partial(_refilled, asked), state)
    at = state.at._replace(carry=run_round(asked.program, asked.held, asked.width, state.at, state.counted))
    counted = count(asked.program, asked.held, at)
    ended = before + jnp.minimum(state.waiting, asked.real) - counted.flying
    pace = state.pace + (ended.astype(state.pace.dtype) - state.pace) / _ROUNDS
    return state._replace(at=at, counted=counted, pace=pace)


def _many(asked: _Mission, state: _UnderWay) -> Bool[Array, ""]:
    """Say whether too many cells fly to be left, or end too quickly for that."""
    flying = state.counted.flying
    if not asked.few:
        return flying > 0
    return (flying > asked.few) | (state.pace > max(asked.few * _SHARE_OF_A_ROUND, 1.0))


def _goes_on(asked: _Mission, state: _UnderWay) -> Bool[Array, ""]:
    # Of those that are left hardly one is done: to write it down would take a round.
    flying, done = state.counted.flying, state.counted.done
    crowded = (flying + done > asked.few) | (done > asked.few // 16)
    return (state.waiting < asked.real) | _many(asked, state) | crowded


def _refill_due(asked: _Mission, state: _UnderWay) -> Bool[Array, ""]:
    """Say whether a refill is worth its price: for several lanes, or in the end."""
    flying, done = state.counted.flying, state.counted.done
    free = state.at.cell.size - flying
    return jnp.where(
        state.waiting < asked.real, free >= asked.width, (done >= asked.width) | ((done > 0) & ~_many(asked, state))
    )


def _refilled(asked: _Mission, state: _UnderWay) -> _UnderWay:
    """Write down cells that are done, and load waiting ones: a batch of lanes."""
    at, waiting, size = state.at, state.waiting, asked.cells.shape[0]
    free = jnp.where(at.cell >= 0, asked.program.done(asked.held.record(at.carry)), waiting < asked.real)
    most = min(_REFILLED * asked.width, at.cell.size)
    batch, order = batch_of(free, most), jnp.arange(most, dtype=jnp.int32)
    ended = at.cell[batch.members]
    ended = jnp.where((order < batch.real) & (ended >= 0), ended, size)
    found = asked.program.unload(asked.held.record(take(at.carry, batch.members)))
    new = waiting + order
    fresh = AtWork(jnp.where(new < asked.real, new, -1), asked.held.load(asked.cells[jnp.minimum(new, size - 1)]))
    return state._replace(
        at=asked.held.put(at, fresh, batch),
        waiting=waiting + batch.real,
        results=state.results.at[ended].set(found, mode="drop"),
    )
