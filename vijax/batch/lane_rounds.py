"""A round of lanes: some quick steps of all of them, then the service of those that declined one, then a review.

Knows no physics: a `Program` says what a cell is, what one quick step does to every lane at once, and what the rare
lane that declines it needs instead. Begin with `run_round`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.runtime.xla import first, in_blocks, kernel, put, shared, up_to

P = ParamSpec("P")
T = TypeVar("T")

Carry = Any
"""A pytree of arrays whose leading axis is the lane."""

Succeed = Callable[[Carry, Float[Array, "lane in"]], Float[Array, "lane in"]]
"""Carries that are done, and the rows of the next cells -> these rows, with what is handed on."""

# Quick steps between two rounds of serving, reviewing and refilling: with fewer, the rounds cost more than the steps,
# with more, lanes that wait stand idle. No result depends on it.
STEPS = 16


class Service(NamedTuple):
    """What becomes of lanes that declined a step; every function works on a whole batch of lanes, row by row.

    Attributes:
        declined, hard: Carry -> which lanes are; a hard lane needs the careful try.
        request: Carry -> the part of it that serving a lane needs.
        second, careful: Requests -> answers; what `second` is not sure of is left to `careful`, which would hold up a
            whole batch.
        settle: Carry, an answer for every lane, which lanes were served -> carry; unsure answers mark the lane hard.
    """

    declined: Callable[[Carry], Bool[Array, " lane"]]
    hard: Callable[[Carry], Bool[Array, " lane"]]
    request: Callable[[Carry], Any]
    second: Callable[[Any], Any]
    careful: Callable[[Any], Any]
    settle: Callable[[Carry, Any, Bool[Array, " lane"]], Carry]


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
        numbers: Whether step and review are arithmetic of numbers, which may stay in registers, and both tries what
            they can do of each lane; see `registers`.
        fixed: Carry -> what of it stays as it was loaded.
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
        """Make one kernel of a function, if all of the program may be put in kernels."""
        return kernel(work) if self.arithmetic else work


class LaneBatch(NamedTuple):
    """A few lanes of many: which they are, how many are real, and for every lane whether it is among them."""

    members: Int[Array, " width"]
    real: Int[Array, ""]
    chosen: Bool[Array, " lane"]


@shared
def batch_of(mask: Bool[Array, " lane"], width: int) -> LaneBatch:
    """Find the first `width` lanes of a mask."""
    members, chosen = first(mask, width)
    return LaneBatch(members, chosen.sum(dtype=jnp.int32), chosen)


def take(carry: Carry, rows: Int[Array, " width"]) -> Carry:
    """Take some lanes."""
    return jax.tree.map(lambda leaf: leaf[rows], carry)


class AtWork(NamedTuple):
    """The lanes: the cell each one works on (-1: idle), and where that cell is."""

    cell: Int[Array, " lane"]
    carry: Carry


def declined(program: Program, at: AtWork) -> Bool[Array, " lane"]:
    """Find the lanes that wait for an answer."""
    return program.service.declined(at.carry) & (at.cell >= 0) if program.service else jnp.zeros_like(at.cell, bool)


def able(program: Program, at: AtWork) -> Int[Array, ""]:
    """Count the lanes that the next step would move."""
    return ((at.cell >= 0) & ~declined(program, at) & ~program.stopped(at.carry)).sum()


def run_round(program: Program, width: int, at: AtWork) -> Carry:
    """Run one round of the lanes that have a cell on a CPU: steps, service, review.

    Args:
        program: What a cell is.
        width: How many lanes are served together.
        at: The lanes.
    """
    carry = program.kernel(partial(steps, program))(*at)
    if service := program.service:
        due = program.kernel(partial(_service_due, program, width))
        serve = partial(_serve, program, service, width)
        carry = lax.while_loop(partial(due, at.cell), partial(serve, at.cell), carry)
    return program.kernel(program.review)(carry)


def steps(program: Program, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Take up to so many steps; fewer once half the lanes that set out wait for something else."""

    def some_steps(at: AtWork) -> AtWork:
        return up_to(partial(_step, program), program.steps, partial(_goes_on, program, able(program, at)), at)

    return in_blocks(some_steps, AtWork(cell, carry)).carry


def _step(program: Program, at: AtWork) -> AtWork:
    return at._replace(carry=program.step(at.carry))


def _goes_on(program: Program, at_first: Int[Array, ""], at: AtWork) -> Bool[Array, ""]:
    return 2 * able(program, at) > at_first


def _service_due(program: Program, width: int, cell: Int[Array, " lane"], carry: Carry) -> Bool[Array, ""]:
    """Say whether a batch of easy or of hard lanes is full, or half the lanes at work can go no further without one."""
    at = AtWork(cell, carry)
    easy, hard = (lanes.sum() for lanes in asking(program, at))
    return (easy >= width) | (hard >= width) | ((easy + hard > 0) & (easy + hard >= able(program, at)))


def asking(program: Program, at: AtWork) -> tuple[Bool[Array, " lane"], Bool[Array, " lane"]]:
    """Find the lanes that wait for their second try, and those that wait for the careful one."""
    waits = declined(program, at)
    hard = program.service.hard(at.carry) if program.service else waits
    return waits & ~hard, waits & hard


def _serve(program: Program, service: Service, width: int, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Give a batch of easy lanes their second try, or a batch of hard ones the careful try."""
    easy, batch, requests = program.kernel(partial(_ask, program, service, width))(cell, carry)
    answers = lax.cond(easy, program.kernel(service.second), program.kernel(service.careful), requests)
    return program.kernel(partial(_settle, service))(carry, answers, batch)


def _ask(
    program: Program, service: Service, width: int, cell: Int[Array, " lane"], carry: Carry
) -> tuple[Bool[Array, ""], LaneBatch, Any]:
    """Say whose turn it is, easy lanes or hard ones, and what they request."""
    easy, hard = asking(program, AtWork(cell, carry))
    turn = easy.sum() >= jnp.minimum(hard.sum(), width)
    batch = batch_of(jnp.where(turn, easy, hard), width)
    return turn, batch, take(service.request(carry), batch.members)


def _settle(service: Service, carry: Carry, answers: Any, batch: LaneBatch) -> Carry:
    """Give the lanes with the answers of those that were served."""
    blank = jax.tree.map(lambda leaf: jnp.zeros((batch.chosen.size, *leaf.shape[1:]), leaf.dtype), answers)
    return service.settle(carry, put(blank, answers, batch.members, batch.real), batch.chosen)
