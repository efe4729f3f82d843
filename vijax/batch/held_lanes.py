"""How an accelerator holds lanes: as records, by XLA's kernels, or in tables that a GPU's kernels work on in place.

Of a GPU all steps of a round are one kernel, and the answers of a batch another (`registers`). Begin with `hold`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch.lane_rounds import AtWork, Carry, LaneBatch, Program, able, declined, take
from vijax.runtime import registers
from vijax.runtime.xla import put, up_to

# Steps of XLA's kernels at once: less of what the second reads of the first is stored, and a step of all lanes takes a
# sixth less time. Four would take twice as long to compile, for a twentieth more.
_UNROLLED = 2
# Steps of lanes that stay in registers between two reviews, each of which has two fifths of a step's instructions.
_UNREVIEWED = 4


class Hold(NamedTuple):
    """How lanes are held, and what is done to them as they are.

    Attributes:
        blank: Lanes that hold zeros.
        load: Rows of the cell table -> lanes.
        record: Lanes -> the record that a program knows them by.
        steps: Lanes at work -> lanes after up to so many steps, reviewed.
        answer: Lanes, a batch of them, whether its try is the careful one -> lanes.
        put: Lanes, others, a batch of the former -> lanes, the batch replaced by the others.
    """

    blank: Callable[[], Any]
    load: Callable[[Float[Array, "row in"]], Any]
    record: Callable[[Any], Carry]
    steps: Callable[[AtWork], Any]
    answer: Callable[[Any, LaneBatch, Bool[Array, ""]], Any]
    put: Callable[[Any, Any, LaneBatch], Any]


def hold(program: Program, columns: int, kind: Any, lanes: int) -> Hold:
    """Choose how lanes are held: in a GPU's registers if those can hold them.

    Args:
        program: What a cell is.
        columns: Of a row of the cell table.
        kind: Of its numbers.
        lanes: How many there are.
    """
    like = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, columns), kind))

    def zeros() -> Carry:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)

    if not (program.numbers and registers.used() and registers.fit(like, lanes)):
        return Hold(
            blank=zeros,
            load=program.load,
            record=lambda lanes: lanes,
            steps=partial(_steps, program),
            answer=partial(_answer, program),
            put=lambda lanes, others, batch: put(lanes, others, batch.members, batch.real),
        )
    laid = registers.layout(like, program.fixed)
    return Hold(
        blank=lambda: registers.pack(laid, zeros()),
        load=lambda rows: registers.pack(laid, program.load(rows)),
        record=partial(registers.unpack, laid),
        steps=partial(_held_steps, program, laid),
        answer=partial(_held_answer, program, laid),
        put=_written,
    )


def _steps(program: Program, at: AtWork) -> Carry:
    """Take so many steps, and review."""
    steps = lax.fori_loop(0, program.steps, lambda _, carry: program.step(carry), at.carry, unroll=_UNROLLED)
    return program.review(steps)


def _answer(program: Program, carry: Carry, batch: LaneBatch, hard: Bool[Array, ""]) -> Carry:
    """Give a batch of lanes its answers."""
    service: Any = program.service
    some = take(carry, batch.members)
    answers = lax.cond(hard, service.careful, service.second, service.request(some))
    some = service.settle(some, answers, jnp.ones(batch.members.size, bool))
    return put(carry, some, batch.members, batch.real)


def _held_steps(program: Program, laid: registers.Layout, at: AtWork) -> registers.Tables:
    """Do what `_steps` does, in registers; less of it once half the lanes of a block wait for something else."""

    def some_steps(at: AtWork) -> AtWork:
        half_of_them = able(program, at)
        at = up_to(partial(_step, program), _UNREVIEWED, lambda at: 2 * able(program, at) > half_of_them, at)
        return at._replace(carry=program.review(at.carry))

    def all_steps(cell: Int[Array, " lane"], carry: Carry, _: registers.Each) -> Carry:
        at = AtWork(cell, carry)
        first = _moving(program, at)
        return up_to(some_steps, program.steps // _UNREVIEWED, lambda at: 2 * _moving(program, at) > first, at).carry

    return registers.stay(all_steps, laid, at.cell, at.carry)


def _step(program: Program, at: AtWork) -> AtWork:
    return at._replace(carry=program.step(at.carry))


def _moving(program: Program, at: AtWork) -> Int[Array, ""]:
    """Count the lanes that the next steps or their review would move: one that an answer stopped is to be reviewed."""
    return ((at.cell >= 0) & ~program.done(at.carry) & ~declined(program, at)).sum()


def _held_answer(
    program: Program, laid: registers.Layout, tables: registers.Tables, batch: LaneBatch, hard: Bool[Array, ""]
) -> registers.Tables:
    """Do what `_answer` does, in one kernel."""
    service: Any = program.service

    def answered(attempt: Any, lane: Int[Array, " lane"], some: Carry, on_single_lanes: registers.Each) -> Carry:
        answers = on_single_lanes(attempt, service.request(some))
        return service.settle(some, answers, jnp.ones(lane.shape, bool))

    def with_answers(attempt: Any, some: registers.Tables) -> tuple[Any, ...]:
        return registers.stay(partial(answered, attempt), laid, batch.members, some, batch.real).changing

    tries = (partial(with_answers, attempt) for attempt in (service.careful, service.second))
    found = lax.cond(hard, *tries, take(tables, batch.members))
    return tables._replace(changing=_written(tables.changing, found, batch))


def _written(lanes: Any, some: Any, batch: LaneBatch) -> Any:
    """Write the lanes of a batch into few tables: a kernel each, in place."""
    order = jnp.arange(batch.members.size, dtype=jnp.int32)
    return jax.tree.map(
        lambda table, part: table.at[jnp.where(order < batch.real, batch.members, table.shape[0] + order)].set(
            part, mode="drop", unique_indices=True
        ),
        lanes,
        some,
    )
