"""Scheduler for few cells, or chains, on a CPU: groups of LANES cells, run to their end one after another.

No cell waits for a lane, so the program contains no gather and scatter of lanes, a seventh of a plane's program. It
compiles one second faster, and runs some tens of cells as fast: with few cells most lanes of a plane idle before the
last cell ends. The result of a cell is bit-identical to the result of `lane_scheduler`. Begin with `run`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.simulation.scheduler.lane_rounds import Carry, LaneState, Program, Service, Succeed, steps, waiting_lanes

# Twice as many float64 numbers as the widest vectors hold. With 8 lanes LLVM unrolls its loops and compiles longer;
# with one or two it fuses other multiplications and additions than in vectors, which changes the last bits.
LANES = 16


def run(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int
) -> Float[Array, "cell out"]:
    """Run the first `count` cells to their end; rows past `count` are zeros. Arguments as in `lane_scheduler.run`."""
    rows = _padded_rows(cells)

    def run_group(k: Int[Array, ""], results: Float[Array, "row out"]) -> Float[Array, "row out"]:
        first = LANES * k
        there = first + _lane(count) < count
        end = _run_cells(program, there, lax.dynamic_slice_in_dim(rows, first, LANES))
        return lax.dynamic_update_slice_in_dim(results, _unloaded(program, there, end), first, 0)

    results = jnp.zeros((rows.shape[0], outputs), cells.dtype)
    return lax.fori_loop(0, (count + LANES - 1) // LANES, run_group, results)[: cells.shape[0]]


def chain(
    program: Program,
    succeed: Succeed,
    links: Float[Array, "lane link in"],
    count: Int[Array, ""],
    length: Int[Array, ""],
    outputs: int,
) -> Float[Array, "lane link out"]:
    """Run chains of cells, `LANES` of them at most, link by link. Arguments as in `lane_scheduler.chain`."""
    chains, most, _ = links.shape
    rows = _padded_rows(links)
    is_real = _lane(count) < count

    def link(k: Int[Array, ""], state: tuple[Float[Array, "lane in"], Float[Array, "lane link out"]]):
        start, results = state
        end = _run_cells(program, is_real, start)
        result_rows = _unloaded(program, is_real, end)[:, None]
        # The start computed after the last link is not used.
        after = program.kernel(succeed)(end, rows[:, jnp.minimum(k + 1, most - 1)])
        return after, lax.dynamic_update_slice_in_dim(results, result_rows, k, 1)

    results = jnp.zeros((LANES, most, outputs), links.dtype)
    return lax.fori_loop(0, length, link, (rows[:, 0], results))[1][:chains]


def _lane(count: Int[Array, ""]) -> Int[Array, " lane"]:
    return jnp.arange(LANES, dtype=count.dtype)


def _padded_rows(rows: Float[Array, " row *column"]) -> Float[Array, " whole *column"]:
    """Return the rows, with the last one repeated until every lane has one."""
    more = -rows.shape[0] % LANES
    return jnp.pad(rows, ((0, more), *((0, 0),) * (rows.ndim - 1)), mode="edge") if more else rows


def _unloaded(program: Program, is_real: Bool[Array, " lane"], end: Carry) -> Float[Array, "lane out"]:
    result_rows = program.kernel(program.unload)(end)
    return jnp.where(is_real[:, None], result_rows, jnp.zeros_like(result_rows))


def _run_cells(program: Program, is_real: Bool[Array, " lane"], rows: Float[Array, "lane in"]) -> Carry:
    """Run the cells of the occupied lanes to their end, in rounds of steps, fallbacks and a review."""
    cell = jnp.where(is_real, 0, -1).astype(jnp.int32)

    def is_waiting(carry: Carry) -> Bool[Array, ""]:
        fast, robust = waiting_lanes(program, LaneState(cell, carry))
        return (fast | robust).any()

    def advance(carry: Carry) -> Carry:
        carry = program.kernel(partial(steps, program))(cell, carry)
        if service := program.service:
            # Apply fallbacks until no lane waits for one: unlike in `lane_scheduler`, there is no other cell to work on
            # in the meantime.
            carry = lax.while_loop(is_waiting, partial(_serve, program, service, cell), carry)
        return program.kernel(program.review)(carry)

    start = program.kernel(program.load)(rows)
    return lax.while_loop(lambda carry: (is_real & ~program.done(carry)).any(), advance, start)


def _serve(program: Program, service: Service, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Apply the fast fallback to all lanes that await it; if there are none, apply the robust fallback to one lane."""
    fast, robust = waiting_lanes(program, LaneState(cell, carry))
    # The robust fallback computes one lane at a time, because a batch would take as long as its slowest lane.
    use_fast, first = fast.any(), jnp.argmax(robust)

    def robust_answers(requests):
        answer = program.kernel(service.robust_fallback)(
            jax.tree.map(lambda leaf: lax.dynamic_slice_in_dim(leaf, first, 1), requests)
        )
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LANES, *leaf.shape[1:])), answer)

    answers = lax.cond(use_fast, program.kernel(service.fast_fallback), robust_answers, service.request(carry))
    in_batch = jnp.where(use_fast, fast, jnp.arange(LANES) == first)
    return program.kernel(service.settle)(carry, answers, in_batch)
