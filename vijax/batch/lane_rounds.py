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

from vijax.runtime import registers
from vijax.runtime.xla import first, in_blocks, kernel, on_cpu, put, repeat, shared, up_to

P = ParamSpec("P")
T = TypeVar("T")

Carry = Any
"""A pytree of arrays whose leading axis is the lane."""

# Quick steps between two rounds of serving, reviewing and refilling: with fewer, the rounds cost more than the steps,
# with more, lanes that wait stand idle. No result depends on it.
STEPS = 16
# Steps of lanes that stay in registers between two reviews, each of which has two fifths of a step's instructions.
_UNREVIEWED = 4


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
        numbers: Whether step and review are arithmetic of numbers, which may stay in registers, and both tries what
            they can do of each lane; see `registers`.
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
    numbers: bool = True

    def kernel(self, work: Callable[P, T]) -> Callable[P, T]:
        """Make one kernel of a function, if all of the program may be put in kernels."""
        return kernel(work) if self.arithmetic else work


class LaneBatch(NamedTuple):
    """A few lanes of many: which they are, how many are real, and for every lane whether it is among them."""

    members: Int[Array, "width"]
    real: Int[Array, ""]
    chosen: Bool[Array, "lane"]


@shared
def batch_of(mask: Bool[Array, "lane"], width: int) -> LaneBatch:
    """Find the first `width` lanes of a mask."""
    members, chosen = first(mask, width)
    return LaneBatch(members, chosen.sum(dtype=jnp.int32), chosen)


def take(carry: Carry, rows: Int[Array, "width"]) -> Carry:
    """Take some lanes."""
    return jax.tree.map(lambda leaf: leaf[rows], carry)


class AtWork(NamedTuple):
    """The lanes: the cell each one works on (-1: idle), and where that cell is."""

    cell: Int[Array, "lane"]
    carry: Carry


def _declined(program: Program, at: AtWork) -> Bool[Array, "lane"]:
    return program.service.declined(at.carry) & (at.cell >= 0) if program.service else jnp.zeros_like(at.cell, bool)


def able(program: Program, at: AtWork) -> Int[Array, ""]:
    """Count the lanes that the next step would move."""
    return ((at.cell >= 0) & ~_declined(program, at) & ~program.stopped(at.carry)).sum()


def run_round(program: Program, width: int, at: AtWork) -> Carry:
    """Run one round of the lanes that have a cell: steps, service, review.

    Args:
        program: What a cell is.
        width: How many lanes are served together.
        at: The lanes.
    """
    held = program.numbers and registers.used()
    carry = _held_steps(program, *at) if held else program.kernel(partial(_steps, program))(*at)
    if service := program.service:
        due = program.kernel(partial(_service_due, program, service, width))
        serve = partial(_serve, program, service, width, held)
        carry = lax.while_loop(partial(due, at.cell), partial(serve, at.cell), carry)
    return carry if held else program.kernel(program.review)(carry)


def _steps(program: Program, cell: Int[Array, "lane"], carry: Carry) -> Carry:
    """Take up to so many steps; fewer once half the lanes that set out wait for something else."""

    def some_steps(at: AtWork) -> AtWork:
        return repeat(partial(_step, program), program.steps, partial(_goes_on, program, able(program, at)), at)

    return in_blocks(some_steps, AtWork(cell, carry)).carry


def _held_steps(program: Program, cell: Int[Array, "lane"], carry: Carry) -> Carry:
    """Do what `_steps` does, and review, in a GPU's registers: there stopped lanes soon go on."""

    def some_steps(at: AtWork) -> AtWork:
        at = up_to(partial(_step, program), _UNREVIEWED, partial(_goes_on, program, able(program, at)), at)
        return at._replace(carry=program.review(at.carry))

    def all_steps(at: AtWork) -> AtWork:
        first = _moving(program, at)
        return up_to(some_steps, program.steps // _UNREVIEWED, lambda at: 2 * _moving(program, at) > first, at)

    return registers.stay(all_steps, AtWork(cell, carry)).carry


def _moving(program: Program, at: AtWork) -> Int[Array, ""]:
    """Count the lanes that the next steps or their review would move: one that an answer stopped is to be reviewed."""
    return ((at.cell >= 0) & ~_declined(program, at) & ~program.done(at.carry)).sum()


def _step(program: Program, at: AtWork) -> AtWork:
    return at._replace(carry=program.step(at.carry))


def _goes_on(program: Program, at_first: Int[Array, ""], at: AtWork) -> Bool[Array, ""]:
    return 2 * able(program, at) > at_first


def _service_due(
    program: Program, service: Service, width: int, cell: Int[Array, "lane"], carry: Carry
) -> Bool[Array, ""]:
    """Say whether a batch of easy or of hard lanes is full, or half the lanes at work can go no further without one.

    On an accelerator a careful try takes as long however many lanes have one: those who need it wait for many others,
    or until nobody else goes on.
    """
    at = AtWork(cell, carry)
    easy, hard = (lanes.sum() for lanes in asking(program, at))
    full, going = (easy >= width) | (hard >= _many(width)), able(program, at)
    if on_cpu():
        return full | ((easy + hard > 0) & (easy + hard >= going))
    return full | jnp.where(easy > 0, easy >= going, (hard > 0) & (going == 0))


def _many(width: int) -> int:
    """Say how many hard lanes are not to wait for others."""
    return width if on_cpu() else max(width // 16, 1)


def asking(program: Program, at: AtWork) -> tuple[Bool[Array, "lane"], Bool[Array, "lane"]]:
    """Find the lanes that wait for their second try, and those that wait for the careful one."""
    declined = _declined(program, at)
    hard = program.service.hard(at.carry) if program.service else declined
    return declined & ~hard, declined & hard


def _serve(program: Program, service: Service, width: int, held: bool, cell: Int[Array, "lane"], carry: Carry) -> Carry:
    """Give a batch of easy lanes their second try, or a batch of hard ones the careful try."""
    easy, batch, requests = program.kernel(partial(_ask, program, service, width))(cell, carry)
    second, careful = (
        partial(registers.each, work, real=batch.real) if held else program.kernel(work)
        for work in (service.second, service.careful)
    )
    answers = lax.cond(easy, second, careful, requests)
    return program.kernel(partial(_settle, service))(carry, answers, batch)


def _ask(
    program: Program, service: Service, width: int, cell: Int[Array, "lane"], carry: Carry
) -> tuple[Bool[Array, ""], LaneBatch, Any]:
    """Say whose turn it is, easy lanes or hard ones, and what they request."""
    easy, hard = asking(program, AtWork(cell, carry))
    some, others = easy.sum(), hard.sum()
    turn = some >= jnp.minimum(others, width)
    if not on_cpu():
        turn = (some > 0) & (others < _many(width))
    batch = batch_of(jnp.where(turn, easy, hard), width)
    return turn, batch, take(service.request(carry), batch.members)


def _settle(service: Service, carry: Carry, answers: Any, batch: LaneBatch) -> Carry:
    """Give the lanes with the answers of those that were served."""
    blank = jax.tree.map(lambda leaf: jnp.zeros((batch.chosen.size, *leaf.shape[1:]), leaf.dtype), answers)
    return service.settle(carry, put(blank, answers, batch.members, batch.real), batch.chosen)
