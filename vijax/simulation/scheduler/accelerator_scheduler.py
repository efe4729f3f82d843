"""Scheduler for an accelerator: run N independent cells on its lanes; CPU cores may finish the last few cells.

Between two kernels an accelerator idles for as long as a small kernel takes. Therefore each round counts the lanes by
state once, decides from the counts which actions are needed, and performs each of these at most once: refill of
finished lanes, fallback for one batch of declined lanes, steps of all lanes. Begin with `run_until_few`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.compilation import register_kernels
from vijax.simulation.scheduler import record_rows
from vijax.simulation.scheduler.lane_rounds import LaneState, Program, batch_of, take_lanes, waiting_lanes
from vijax.simulation.scheduler.lane_storage import LaneStorage, choose_storage

T = TypeVar("T")

# A batch of lanes, for a fallback or a refill, is one in _SHARE lanes. With a larger batch slow cells wait longer. A
# small batch gains nothing: a fallback takes no longer for 16,384 lanes than for 4,096.
_SHARE = 8
# Greatest number of batches that one refill loads. It is above 1 so that no lane waits for the next refill if many
# cells end early.
_REFILLED = 2
# The robust fallback runs as soon as its requests reach this share of a batch. It takes equally long for any number of
# lanes.
_ROBUST_SHARE = 1 / 16
_NO_FALLBACK, _FAST_FALLBACK, _ROBUST_FALLBACK = range(3)
# The accelerator may pass the remaining cells to CPU cores when `few` are left. It continues as long as more than the
# share _ENDING_SHARE of `few` ends per round (running mean over _ROUNDS rounds), because CPU cores would take at least
# as long for the cells that end as the accelerator takes for the round.
_ENDING_SHARE, _ROUNDS = 1 / 256, 16


def width_of(cells: int) -> int:
    """Return the number of lanes for a tile of `cells` cells.

    A step of 8,192 lanes takes nearly as long as a step of 32,768, and for more lanes the time is proportional to their
    number. At the end of a tile few lanes are at work, but every step computes all of them.
    """
    return register_kernels.round_up_to_warps(max(min(cells // 8, 131_072), min(cells, 8_192)), _SHARE)


def batch_width(lanes: int) -> int:
    """Return the number of lanes of a batch, in whole blocks of 32 if possible; so many free lanes trigger a refill."""
    return min(register_kernels.round_up_to_warps(-(-lanes // _SHARE), 1), lanes)


class RemainingCells(NamedTuple):
    """Unfinished cells: their indices (-1: none), and the complete state of their lanes, as rows."""

    cell: Int[Array, " few"]
    lanes: Float[Array, "few column"]


def resume_program(program: Program, like: Float[Array, "row in"]) -> Program:
    """Return the program for rows of `RemainingCells` as cells; `like` has the shape of the program's own cell rows."""
    lane = jax.eval_shape(program.load, like)
    return program._replace(load=partial(record_rows.unpack, like=lane))


# --- rounds ----------------------------------------------------------------------------------------------------------


class LaneCounts(NamedTuple):
    """Numbers of lanes by their state.

    Attributes:
        fast, robust: Lanes that request the fast fallback, and the robust fallback.
        movable: Lanes that a step would advance.
        active: Lanes with an unfinished cell.
        done: Lanes with a finished cell.
    """

    fast: Int[Array, ""]
    robust: Int[Array, ""]
    movable: Int[Array, ""]
    active: Int[Array, ""]
    done: Int[Array, ""]


def count(program: Program, storage: LaneStorage, at: LaneState) -> LaneCounts:
    """Return the counts of the lanes, in one pass."""
    at = at._replace(carry=storage.record(at.carry))
    done, has_cell = program.done(at.carry), at.cell >= 0
    fast, robust = waiting_lanes(program, at)
    movable = has_cell & ~fast & ~robust & ~program.stopped(at.carry)
    masks = [mask.astype(jnp.int32) for mask in (fast, robust, movable, has_cell & ~done, has_cell & done)]
    zeros = [jnp.int32(0)] * len(masks)
    # One reduction of five masks is one kernel.
    sums = lax.reduce(masks, zeros, lambda counts, others: [a + b for a, b in zip(counts, others, strict=True)], (0,))
    return LaneCounts(*sums)


def run_round(program: Program, storage: LaneStorage, width: int, at: LaneState, counted: LaneCounts) -> Any:
    """Run a fallback for one batch of lanes if enough lanes wait for it; then advance all lanes that do not wait.

    A lane waits if the fast step could not certify its pending impact; a fallback computes this impact more slowly.
    """
    if program.service:
        fallback = _due_fallback(counted, width)
        serve = partial(_serve, program, storage, width, fallback == _ROBUST_FALLBACK, at.cell)
        at = at._replace(carry=_apply_if(fallback != _NO_FALLBACK, serve, at.carry))
    return storage.steps(at)


def _apply_if(due: Bool[Array, ""], work: Callable[[T], T], state: T) -> T:
    """Apply `work` if `due`, by a loop of one trip, because XLA's conditional would copy the state."""
    return lax.while_loop(lambda pair: pair[0], lambda pair: (jnp.zeros_like(due), work(pair[1])), (due, state))[1]


def _due_fallback(counted: LaneCounts, width: int) -> Int[Array, ""]:
    """Return the fallback to run in this round: 0 none, 1 fast, 2 robust.

    The fast fallback runs if its requests fill a batch, or if at least as many lanes request it as can continue without
    a fallback. The robust fallback waits until no other lane can continue, or until its requests reach the share
    _ROBUST_SHARE of a batch.
    """
    fast, robust, movable = counted.fast, counted.robust, counted.movable
    many_robust = robust >= max(int(width * _ROBUST_SHARE), 1)
    due = (fast >= width) | many_robust | jnp.where(fast > 0, fast >= movable, (robust > 0) & (movable == 0))
    return jnp.where(due, jnp.where((fast > 0) & ~many_robust, _FAST_FALLBACK, _ROBUST_FALLBACK), _NO_FALLBACK)


def _serve(
    program: Program,
    storage: LaneStorage,
    width: int,
    use_robust: Bool[Array, ""],
    cell: Int[Array, " lane"],
    carry: Any,
) -> Any:
    """Compute the pending impacts of a batch: of the first lanes that request the selected fallback."""
    fast_lanes, robust_lanes = waiting_lanes(program, LaneState(cell, storage.record(carry)))
    return storage.answer(carry, batch_of(jnp.where(use_robust, robust_lanes, fast_lanes), width), use_robust)


# --- the loop --------------------------------------------------------------------------------------------------------


class _LoopState(NamedTuple):
    """State of the loop.

    Attributes:
        at: The lanes.
        counted: Counts of the lanes.
        waiting: Index of the next cell to start.
        results: Rows of the finished cells so far.
        end_rate: Running mean of the number of cells that end per round.
    """

    at: LaneState
    counted: LaneCounts
    waiting: Int[Array, ""]
    results: Float[Array, "cell out"]
    end_rate: Float[Array, ""]


class _RunInputs(NamedTuple):
    """Inputs of the loop: program, storage of the lanes, table of cells and number of real ones.

    Attributes:
        width: Number of lanes of a batch; so many free lanes trigger a refill.
        few: Number of cells that may remain unfinished.
    """

    program: Program
    storage: LaneStorage
    cells: Float[Array, "cell in"]
    real: Int[Array, ""]
    width: int
    few: int


def run(
    program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], outputs: int, lanes: int
) -> Float[Array, "cell out"]:
    """Run the first `real` cells to their end; other rows return zeros. Arguments as in `lane_scheduler.run`."""
    return _run(_run_inputs(program, cells, real, lanes, 0), outputs, lanes).results


def run_until_few(
    program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], outputs: int, lanes: int, few: int
) -> tuple[Float[Array, "cell out"], RemainingCells]:
    """Run cells as `run` does until few are left unfinished; `resume_program` continues the unfinished cells.

    The result rows of unfinished cells are zeros. At most `few` cells are left. As long as these end quickly, the run
    continues and leaves fewer. The last cells are left because they need the fallbacks again and again, and are slower
    on the accelerator than on CPU cores.
    """
    inputs = _run_inputs(program, cells, real, lanes, few)
    loop_state = _run(inputs, outputs, lanes)
    at = loop_state.at
    batch = batch_of(at.cell >= 0, few)
    is_real = jnp.arange(few, dtype=jnp.int32) < batch.real
    cell = jnp.where(is_real, at.cell[batch.members], -1)
    return loop_state.results, RemainingCells(
        cell, record_rows.pack(inputs.storage.record(take_lanes(at.carry, batch.members)))
    )


def _run_inputs(
    program: Program, cells: Float[Array, "cell in"], real: Int[Array, ""], lanes: int, few: int
) -> _RunInputs:
    storage = choose_storage(program, cells.shape[1], cells.dtype, lanes)
    return _RunInputs(program, storage, cells, real, batch_width(lanes), few)


def _run(inputs: _RunInputs, outputs: int, lanes: int) -> _LoopState:
    """Run cells until none waits and no more than `few` are at work."""
    zero, kind = jnp.asarray(0, jnp.int32), inputs.cells.dtype
    start = _LoopState(
        LaneState(jnp.full(lanes, -1, jnp.int32), inputs.storage.blank()),
        LaneCounts(*[zero] * len(LaneCounts._fields)),
        waiting=zero,
        results=jnp.zeros((inputs.cells.shape[0], outputs), kind),
        end_rate=jnp.asarray(0.0, kind),
    )
    return lax.while_loop(partial(_unfinished, inputs), partial(_refill_and_advance, inputs), start)


def _refill_and_advance(inputs: _RunInputs, state: _LoopState) -> _LoopState:
    # Number of unfinished cells (at work or waiting) minus the constant number of real cells.
    unfinished_before = state.counted.active - jnp.minimum(state.waiting, inputs.real)
    state = _apply_if(_refill_due(inputs, state), partial(_refill, inputs), state)
    at = state.at._replace(carry=run_round(inputs.program, inputs.storage, inputs.width, state.at, state.counted))
    counted = count(inputs.program, inputs.storage, at)
    ended = unfinished_before + jnp.minimum(state.waiting, inputs.real) - counted.active
    end_rate = state.end_rate + (ended.astype(state.end_rate.dtype) - state.end_rate) / _ROUNDS
    return state._replace(at=at, counted=counted, end_rate=end_rate)


def _too_many_remain(inputs: _RunInputs, state: _LoopState) -> Bool[Array, ""]:
    """Return True if more than `few` cells are at work, or if they end so quickly that the run must continue."""
    active = state.counted.active
    if not inputs.few:
        return active > 0
    return (active > inputs.few) | (state.end_rate > max(inputs.few * _ENDING_SHARE, 1.0))


def _unfinished(inputs: _RunInputs, state: _LoopState) -> Bool[Array, ""]:
    # Nearly all remaining cells are unfinished: a round only to write the results of a few finished ones does not pay.
    active, done = state.counted.active, state.counted.done
    results_pending = (active + done > inputs.few) | (done > inputs.few // 16)
    return (state.waiting < inputs.real) | _too_many_remain(inputs, state) | results_pending


def _refill_due(inputs: _RunInputs, state: _LoopState) -> Bool[Array, ""]:
    """Return True if a refill pays: if a batch of lanes is free, or at the end of the run."""
    active, done = state.counted.active, state.counted.done
    free = state.at.cell.size - active
    return jnp.where(
        state.waiting < inputs.real,
        free >= inputs.width,
        (done >= inputs.width) | ((done > 0) & ~_too_many_remain(inputs, state)),
    )


def _refill(inputs: _RunInputs, state: _LoopState) -> _LoopState:
    """Write the results of finished cells and load waiting cells, for up to _REFILLED batches of lanes."""
    at, waiting, size = state.at, state.waiting, inputs.cells.shape[0]
    free = jnp.where(at.cell >= 0, inputs.program.done(inputs.storage.record(at.carry)), waiting < inputs.real)
    most = min(_REFILLED * inputs.width, at.cell.size)
    batch, order = batch_of(free, most), jnp.arange(most, dtype=jnp.int32)
    ended = at.cell[batch.members]
    # Rows without a finished cell point past the table and are dropped.
    ended = jnp.where((order < batch.real) & (ended >= 0), ended, size)
    result_rows = inputs.program.unload(inputs.storage.record(take_lanes(at.carry, batch.members)))
    new = waiting + order
    fresh = LaneState(
        jnp.where(new < inputs.real, new, -1), inputs.storage.load(inputs.cells[jnp.minimum(new, size - 1)])
    )
    return state._replace(
        at=inputs.storage.put(at, fresh, batch),
        waiting=waiting + batch.real,
        results=state.results.at[ended].set(result_rows, mode="drop"),
    )
