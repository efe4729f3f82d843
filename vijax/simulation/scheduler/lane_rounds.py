"""Rounds of the lanes: some fast steps of all of them, then fallbacks for declined lanes, then a review.

The module is independent of the physics: a `Program` defines the cell, the fast step that advances all lanes at once,
and the fallbacks for the rare lanes without a certified result of this step (declined lanes). Begin with `run_round`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.compilation.xla import (
    bounded_while_loop,
    first_true_indices,
    in_blocks,
    kernel,
    materialised,
    replace_rows,
)

P = ParamSpec("P")
T = TypeVar("T")

Carry = Any
"""A pytree of arrays whose leading axis is the lane."""

Succeed = Callable[[Carry, Float[Array, "lane in"]], Float[Array, "lane in"]]
"""Finished carries, rows of the next cells -> the same rows, with the final states of the carries as starts."""

# Number of fast steps of a round, before its fallbacks, review and refill. With fewer, these cost more than the steps;
# with more, waiting lanes idle. No result depends on this number.
STEPS = 16


class Service(NamedTuple):
    """Fallbacks for lanes that declined a step; every function works on a whole batch of lanes, row by row.

    Attributes:
        declined, needs_robust: Carry -> mask of lanes without a certified result of their step; mask of the declined
            lanes that the fast fallback did not certify either.
        request: Carry -> the part of the carry that the fallbacks need.
        fast_fallback, robust_fallback: Requests -> answers. The robust fallback is used only for lanes without a
            certified answer of the fast one, because it is slow.
        settle: Carry, an answer for every lane, mask of the lanes in the batch -> carry. A lane in the batch without a
            certified answer needs the robust fallback next.
    """

    declined: Callable[[Carry], Bool[Array, " lane"]]
    needs_robust: Callable[[Carry], Bool[Array, " lane"]]
    request: Callable[[Carry], Any]
    fast_fallback: Callable[[Any], Any]
    robust_fallback: Callable[[Any], Any]
    settle: Callable[[Carry, Any, Bool[Array, " lane"]], Carry]


class Program(NamedTuple):
    """Definition of a cell for the lanes; every function works on a whole batch of lanes, row by row.

    Attributes:
        load: Rows of the cell table -> new carry.
        step: Carry -> carry after one step; the step may decline lanes if `service` is given.
        review: Carry -> carry after the decisions about stopped lanes, which are too slow for every step.
        stopped, done: Carry -> masks of lanes; a stopped lane awaits review.
        unload: Carry -> rows of the result table.
        service: Fallbacks for lanes that decline a step.
        steps: Number of steps between two rounds.
        arithmetic: True if all functions may be put in kernels, see `xla.kernel`.
        numbers: True if step and review are arithmetic of numbers that may stay in registers, and both fallbacks can be
            computed lane by lane; see `register_kernels`.
        fixed: Carry -> the part of the carry that does not change after loading.
    """

    load: Callable[[Float[Array, "row in"]], Carry]
    step: Callable[[Carry], Carry]
    review: Callable[[Carry], Carry]
    stopped: Callable[[Carry], Bool[Array, " lane"]]
    done: Callable[[Carry], Bool[Array, " lane"]]
    unload: Callable[[Carry], Float[Array, "row out"]]
    service: Service | None = None
    steps: int = STEPS
    arithmetic: bool = True
    numbers: bool = True
    fixed: Callable[[Carry], Any] = lambda carry: ()

    def kernel(self, work: Callable[P, T]) -> Callable[P, T]:
        """Return a function compiled as one kernel, if all of the program may be put in kernels."""
        return kernel(work) if self.arithmetic else work


class LaneBatch(NamedTuple):
    """A batch of selected lanes: their indices, the number of real ones, and a mask over all lanes."""

    members: Int[Array, " width"]
    real: Int[Array, ""]
    chosen: Bool[Array, " lane"]


@materialised
def batch_of(mask: Bool[Array, " lane"], width: int) -> LaneBatch:
    """Return the batch of the first `width` lanes of a mask."""
    members, chosen = first_true_indices(mask, width)
    return LaneBatch(members, chosen.sum(dtype=jnp.int32), chosen)


def take_lanes(carry: Carry, rows: Int[Array, " width"]) -> Carry:
    """Return the selected lanes of a carry."""
    return jax.tree.map(lambda leaf: leaf[rows], carry)


class LaneState(NamedTuple):
    """State of all lanes: the cell of each (-1: idle), and the carries of these cells."""

    cell: Int[Array, " lane"]
    carry: Carry


def declined(program: Program, at: LaneState) -> Bool[Array, " lane"]:
    """Return True for lanes that await a fallback."""
    return program.service.declined(at.carry) & (at.cell >= 0) if program.service else jnp.zeros_like(at.cell, bool)


def count_movable(program: Program, at: LaneState) -> Int[Array, ""]:
    """Count the lanes that the next step would advance."""
    return ((at.cell >= 0) & ~declined(program, at) & ~program.stopped(at.carry)).sum()


def run_round(program: Program, width: int, at: LaneState) -> Carry:
    """Run one round of all lanes on a CPU: steps, fallbacks, review.

    Args:
        program: Definition of a cell.
        width: Number of lanes of a batch for a fallback.
        at: The lanes.
    """
    carry = program.kernel(partial(steps, program))(*at)
    if service := program.service:
        due = program.kernel(partial(_service_due, program, width))
        serve = partial(_serve, program, service, width)
        carry = lax.while_loop(partial(due, at.cell), partial(serve, at.cell), carry)
    return program.kernel(program.review)(carry)


def steps(program: Program, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Take up to `program.steps` steps; end earlier if half of the initially movable lanes can no longer move."""

    def block_steps(at: LaneState) -> LaneState:
        return bounded_while_loop(
            partial(_step, program), program.steps, partial(_enough_movable, program, count_movable(program, at)), at
        )

    return in_blocks(block_steps, LaneState(cell, carry)).carry


def _step(program: Program, at: LaneState) -> LaneState:
    return at._replace(carry=program.step(at.carry))


def _enough_movable(program: Program, at_start: Int[Array, ""], at: LaneState) -> Bool[Array, ""]:
    return 2 * count_movable(program, at) > at_start


def _service_due(program: Program, width: int, cell: Int[Array, " lane"], carry: Carry) -> Bool[Array, ""]:
    """Return True if requests of one fallback fill a batch, or at least half of the lanes at work await a fallback."""
    at = LaneState(cell, carry)
    fast, robust = (lanes.sum() for lanes in waiting_lanes(program, at))
    return (fast >= width) | (robust >= width) | ((fast + robust > 0) & (fast + robust >= count_movable(program, at)))


def waiting_lanes(program: Program, at: LaneState) -> tuple[Bool[Array, " lane"], Bool[Array, " lane"]]:
    """Return the masks of lanes that await the fast fallback and the robust fallback."""
    waiting = declined(program, at)
    needs_robust = program.service.needs_robust(at.carry) if program.service else waiting
    return waiting & ~needs_robust, waiting & needs_robust


def _serve(program: Program, service: Service, width: int, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Compute and write the pending impacts of one batch of lanes, by the fast or by the robust fallback."""
    use_fast, batch, requests = program.kernel(partial(_collect_requests, program, service, width))(cell, carry)
    answers = lax.cond(
        use_fast, program.kernel(service.fast_fallback), program.kernel(service.robust_fallback), requests
    )
    return program.kernel(partial(_settle, service))(carry, answers, batch)


def _collect_requests(
    program: Program, service: Service, width: int, cell: Int[Array, " lane"], carry: Carry
) -> tuple[Bool[Array, ""], LaneBatch, Any]:
    """Return True to use the fast fallback (False: the robust one), the batch of lanes, and their requests."""
    fast, robust = waiting_lanes(program, LaneState(cell, carry))
    # The robust fallback waits until more lanes request it than the fast one, or until its requests fill a batch.
    use_fast = fast.sum() >= jnp.minimum(robust.sum(), width)
    batch = batch_of(jnp.where(use_fast, fast, robust), width)
    return use_fast, batch, take_lanes(service.request(carry), batch.members)


def _settle(service: Service, carry: Carry, answers: Any, batch: LaneBatch) -> Carry:
    """Write the answers of a batch into the carry of all lanes."""
    # `settle` needs answers in the shape of all lanes, and reads only the rows of the batch.
    blank = jax.tree.map(lambda leaf: jnp.zeros((batch.chosen.size, *leaf.shape[1:]), leaf.dtype), answers)
    return service.settle(carry, replace_rows(blank, answers, batch.members, batch.real), batch.chosen)
