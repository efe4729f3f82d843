"""Storage of the lanes on an accelerator: records for XLA's kernels, or tables that GPU kernels update in place.

On a GPU all steps of a round are one kernel, and the answers of a batch are another (`register_kernels`). Begin with
`choose_storage`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.compilation import register_kernels
from vijax.runtime.compilation.xla import bounded_while_loop, replace_rows
from vijax.simulation.scheduler.lane_rounds import (
    Carry,
    LaneBatch,
    LaneState,
    Program,
    count_movable,
    declined,
    take_lanes,
)

# Steps unrolled in the body of XLA's loop. With two instead of one, fewer intermediate values are stored, and a step of
# all lanes takes a sixth less time. Four would take twice as long to compile as two, and gain a twentieth.
_UNROLLED = 2
# Steps in registers between two reviews; a review has two fifths of the instructions of a step.
_UNREVIEWED = 4


class LaneStorage(NamedTuple):
    """Storage of the lanes, and the operations on it.

    Attributes:
        blank: Returns lanes of zeros.
        load: Rows of the cell table -> lanes.
        record: Lanes -> the record that the program's functions take.
        steps: Lanes at work -> lanes after up to `program.steps` steps, reviewed.
        answer: Lanes, a batch of lanes, True for the robust fallback (False: the fast one) -> lanes with the answers.
        put: Lanes, new lanes, a batch of lanes -> lanes, with the batch replaced by the new ones.
    """

    blank: Callable[[], Any]
    load: Callable[[Float[Array, "row in"]], Any]
    record: Callable[[Any], Carry]
    steps: Callable[[LaneState], Any]
    answer: Callable[[Any, LaneBatch, Bool[Array, ""]], Any]
    put: Callable[[Any, Any, LaneBatch], Any]


def choose_storage(program: Program, columns: int, kind: Any, lanes: int) -> LaneStorage:
    """Return the storage of the lanes: tables for GPU kernels if a lane fits in registers, else records for XLA.

    Args:
        program: Definition of a cell.
        columns: Number of columns of the cell table.
        kind: Dtype of the cell table.
        lanes: Number of lanes.
    """
    like = jax.eval_shape(program.load, jax.ShapeDtypeStruct((lanes, columns), kind))

    def zeros() -> Carry:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)

    if not (program.numbers and register_kernels.registers_enabled() and register_kernels.fits_registers(like, lanes)):
        return LaneStorage(
            blank=zeros,
            load=program.load,
            record=lambda lanes: lanes,
            steps=partial(_steps, program),
            answer=partial(_answer, program),
            put=lambda lanes, others, batch: replace_rows(lanes, others, batch.members, batch.real),
        )
    laid = register_kernels.layout(like, program.fixed)
    return LaneStorage(
        blank=lambda: register_kernels.pack(laid, zeros()),
        load=lambda rows: register_kernels.pack(laid, program.load(rows)),
        record=partial(register_kernels.unpack, laid),
        steps=partial(_register_steps, program, laid),
        answer=partial(_register_answer, program, laid),
        put=_written,
    )


def _steps(program: Program, at: LaneState) -> Carry:
    """Take `program.steps` steps, then review."""
    steps = lax.fori_loop(0, program.steps, lambda _, carry: program.step(carry), at.carry, unroll=_UNROLLED)
    return program.review(steps)


def _answer(program: Program, carry: Carry, batch: LaneBatch, use_robust: Bool[Array, ""]) -> Carry:
    """Compute and write the answers of a batch of lanes."""
    service: Any = program.service
    batch_carry = take_lanes(carry, batch.members)
    answers = lax.cond(use_robust, service.robust_fallback, service.fast_fallback, service.request(batch_carry))
    batch_carry = service.settle(batch_carry, answers, jnp.ones(batch.members.size, bool))
    return replace_rows(carry, batch_carry, batch.members, batch.real)


def _register_steps(program: Program, laid: register_kernels.Layout, at: LaneState) -> register_kernels.Tables:
    """Do the work of `_steps` in registers; a block of lanes stops early if half of its lanes can no longer move."""

    def few_steps(at: LaneState) -> LaneState:
        movable_at_start = count_movable(program, at)
        at = bounded_while_loop(
            partial(_step, program), _UNREVIEWED, lambda at: 2 * count_movable(program, at) > movable_at_start, at
        )
        return at._replace(carry=program.review(at.carry))

    def all_steps(cell: Int[Array, " lane"], carry: Carry, _: register_kernels.LaneMapper) -> Carry:
        at = LaneState(cell, carry)
        moving_at_start = _moving(program, at)
        return bounded_while_loop(
            few_steps, program.steps // _UNREVIEWED, lambda at: 2 * _moving(program, at) > moving_at_start, at
        ).carry

    return register_kernels.apply_in_registers(all_steps, laid, at.cell, at.carry)


def _step(program: Program, at: LaneState) -> LaneState:
    return at._replace(carry=program.step(at.carry))


def _moving(program: Program, at: LaneState) -> Int[Array, ""]:
    """Count the lanes that the next steps or their review would change, including lanes stopped by an answer."""
    return ((at.cell >= 0) & ~program.done(at.carry) & ~declined(program, at)).sum()


def _register_answer(
    program: Program,
    laid: register_kernels.Layout,
    tables: register_kernels.Tables,
    batch: LaneBatch,
    use_robust: Bool[Array, ""],
) -> register_kernels.Tables:
    """Do the work of `_answer` in one kernel."""
    service: Any = program.service

    def answered(
        fallback: Any, lane: Int[Array, " lane"], batch_rows: Carry, on_single_lanes: register_kernels.LaneMapper
    ) -> Carry:
        answers = on_single_lanes(fallback, service.request(batch_rows))
        return service.settle(batch_rows, answers, jnp.ones(lane.shape, bool))

    def with_answers(fallback: Any, batch_rows: register_kernels.Tables) -> tuple[Any, ...]:
        return register_kernels.apply_in_registers(
            partial(answered, fallback), laid, batch.members, batch_rows, batch.real
        ).changing

    tries = (partial(with_answers, fallback) for fallback in (service.robust_fallback, service.fast_fallback))
    answered_tables = lax.cond(use_robust, *tries, take_lanes(tables, batch.members))
    return tables._replace(changing=_written(tables.changing, answered_tables, batch))


def _written(lanes: Any, batch_lanes: Any, batch: LaneBatch) -> Any:
    """Write the lanes of a batch into a few tables in place, with one kernel per table."""
    order = jnp.arange(batch.members.size, dtype=jnp.int32)
    return jax.tree.map(
        # Padding of the batch points past the table and is dropped.
        lambda table, part: table.at[jnp.where(order < batch.real, batch.members, table.shape[0] + order)].set(
            part, mode="drop", unique_indices=True
        ),
        lanes,
        batch_lanes,
    )
