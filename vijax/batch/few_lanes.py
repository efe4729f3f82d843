"""Few cells, or chains of them, on a CPU: some abreast, all of them to their end, before the next ones begin.

No cell waits for a lane, so that none is taken out of many lanes or put back, which is a seventh of what a plane's
program is made of. It compiles a second sooner, and runs some tens of cells as fast: of a plane's lanes most stand idle
before the last of so few end. What becomes of a cell is the same, to the last bit. Begin with `run`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch.lane_rounds import AtWork, Carry, Program, Service, Succeed, asking, steps

# Twice the numbers of 64 bits that the widest vectors hold. With 8 lanes LLVM unrolls its loops, and takes longer; with
# one or two it fuses other multiplications and additions than in vectors, which would be other last bits.
LANES = 16


def run(
    program: Program, cells: Float[Array, "cell in"], count: Int[Array, ""], outputs: int
) -> Float[Array, "cell out"]:
    """Run the first `count` cells to their end; rows past `count` come back as zeros. Arguments as in `lanes.run`."""
    rows = _whole(cells)

    def some(k: Int[Array, ""], results: Float[Array, "row out"]) -> Float[Array, "row out"]:
        first = LANES * k
        there = first + _lane(count) < count
        end = _flown(program, there, lax.dynamic_slice_in_dim(rows, first, LANES))
        return lax.dynamic_update_slice_in_dim(results, _unloaded(program, there, end), first, 0)

    results = jnp.zeros((rows.shape[0], outputs), cells.dtype)
    return lax.fori_loop(0, (count + LANES - 1) // LANES, some, results)[: cells.shape[0]]


def chain(
    program: Program,
    succeed: Succeed,
    links: Float[Array, "lane link in"],
    count: Int[Array, ""],
    length: Int[Array, ""],
    outputs: int,
) -> Float[Array, "lane link out"]:
    """Run chains of cells, `LANES` of them at most, link by link. Arguments as in `lanes.chain`."""
    chains, most, _ = links.shape
    rows = _whole(links)
    there = _lane(count) < count

    def link(k: Int[Array, ""], state: tuple[Float[Array, "lane in"], Float[Array, "lane link out"]]):
        start, results = state
        end = _flown(program, there, start)
        found = _unloaded(program, there, end)[:, None]
        # After the last link nobody flies what it hands on.
        after = program.kernel(succeed)(end, rows[:, jnp.minimum(k + 1, most - 1)])
        return after, lax.dynamic_update_slice_in_dim(results, found, k, 1)

    results = jnp.zeros((LANES, most, outputs), links.dtype)
    return lax.fori_loop(0, length, link, (rows[:, 0], results))[1][:chains]


def _lane(count: Int[Array, ""]) -> Int[Array, " lane"]:
    return jnp.arange(LANES, dtype=count.dtype)


def _whole(rows: Float[Array, " row *column"]) -> Float[Array, " whole *column"]:
    """Repeat the last row until all lanes have one."""
    more = -rows.shape[0] % LANES
    return jnp.pad(rows, ((0, more), *((0, 0),) * (rows.ndim - 1)), mode="edge") if more else rows


def _unloaded(program: Program, there: Bool[Array, " lane"], end: Carry) -> Float[Array, "lane out"]:
    found = program.kernel(program.unload)(end)
    return jnp.where(there[:, None], found, jnp.zeros_like(found))


def _flown(program: Program, there: Bool[Array, " lane"], rows: Float[Array, "lane in"]) -> Carry:
    """Fly the cells of the lanes that have one to their end, in rounds as many lanes do: steps, answers, a review."""
    cell = jnp.where(there, 0, -1).astype(jnp.int32)

    def asked(carry: Carry) -> Bool[Array, ""]:
        easy, hard = asking(program, AtWork(cell, carry))
        return (easy | hard).any()

    def advance(carry: Carry) -> Carry:
        carry = program.kernel(partial(steps, program))(cell, carry)
        if service := program.service:
            carry = lax.while_loop(asked, partial(_serve, program, service, cell), carry)
        return program.kernel(program.review)(carry)

    start = program.kernel(program.load)(rows)
    return lax.while_loop(lambda carry: (there & ~program.done(carry)).any(), advance, start)


def _serve(program: Program, service: Service, cell: Int[Array, " lane"], carry: Carry) -> Carry:
    """Give all easy lanes their second try; if there is none, a hard one the careful try."""
    easy, hard = asking(program, AtWork(cell, carry))
    turn, first = easy.any(), jnp.argmax(hard)

    def careful(requests):
        answer = program.kernel(service.careful)(
            jax.tree.map(lambda leaf: lax.dynamic_slice_in_dim(leaf, first, 1), requests)
        )
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LANES, *leaf.shape[1:])), answer)

    answers = lax.cond(turn, program.kernel(service.second), careful, service.request(carry))
    served = jnp.where(turn, easy, jnp.arange(LANES) == first)
    return program.kernel(service.settle)(carry, answers, served)
