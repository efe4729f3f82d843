"""Lanes that stay in a GPU's registers while a loop goes on: one kernel of blocks, each of which ends by itself.

XLA makes a loop of kernels, and each stores all that the next one reads of a lane: eighty numbers a step, which takes a
GPU longer than to compute them. Here a thread has a lane, reads it once and writes it once, and a block of lanes does
not wait for the others.

By Pallas' way to Triton, as the way to Mosaic GPU knows no float64.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
from jax import lax
from jaxtyping import Array, Int

from vijax.runtime import xla
from vijax.runtime.unrolled import unrolled

T = TypeVar("T")

# Lanes of a block, a thread each. A power of two, as all of Triton's blocks are.
LANES = 128
_WARP = 32  # threads that a GPU runs in step
# Lanes of a block where each is worked on once: as few as may be, as blocks are not many for all of a GPU's parts.
FEW = _WARP


def used() -> bool:
    """Say whether programs are made for a GPU and kernels are wanted there."""
    return xla.KERNELS and xla.platform() == "gpu"


def stay(work: Callable[[T], T], lanes: T, *, interpret: bool = False) -> T:
    """Do `work` on all lanes, block by block: on a CUDA GPU in one kernel, elsewhere as it stands.

    Args:
        work: On lanes, arrays of one leading axis; elementwise arithmetic, sums over lanes and loops, nothing else.
            Where further axes are not of a power of two, or lanes are not whole blocks, it is not in one kernel.
        lanes: What it is done on.
        interpret: Whether to run the kernel here whatever this machine is, operation by operation: for tests.
    """
    if not all(map(_fits, jax.tree.leaves(lanes))):
        return work(lanes)
    if interpret:
        return _in_one_kernel(work, lanes, interpret=True)
    return lax.platform_dependent(lanes, cuda=partial(_in_one_kernel, work), default=work)


def each(work: Callable[[Any], T], lanes: Any, real: Int[Array, ""], *, interpret: bool = False) -> T:
    """Make of the first `real` lanes what `work` makes of each: on a CUDA GPU in one kernel, elsewhere as it stands.

    Args:
        work: On lanes, arrays of one axis; what `unrolled` can follow, whose results are such arrays.
            Where lanes are not whole blocks, it is not in one kernel.
        lanes: What it is done on.
        real: How many count; what becomes of the others may be anything.
        interpret: As in `stay`.
    """
    leaves = jax.tree.leaves(lanes)
    if any(leaf.ndim != 1 or leaf.size % FEW for leaf in leaves):
        return work(lanes)
    if interpret:
        return _of_each(work, lanes, real, interpret=True)
    return lax.platform_dependent(lanes, real, cuda=partial(_of_each, work), default=lambda lanes, _: work(lanes))


def _of_each(work: Callable[[Any], T], lanes: Any, real: Int[Array, ""], interpret: bool = False) -> T:
    from jax.experimental import pallas

    leaves, tree = jax.tree.flatten(lanes)
    like, results = jax.tree.flatten(jax.eval_shape(work, lanes))

    def body(*refs):
        given, (count, *written) = refs[: len(leaves)], refs[len(leaves) :]

        @pallas.when(pallas.program_id(0) * FEW < count[0])
        def _():
            found = unrolled(lambda some: work(jax.tree.unflatten(tree, some)), [ref[...] for ref in given])
            for ref, value in zip(written, found, strict=True):
                ref[...] = value

    return jax.tree.unflatten(results, _by_blocks(body, FEW, (leaves, [real.reshape(1)], like), interpret))


def _fits(leaf: Any) -> bool:
    count, *more = leaf.shape
    return count % LANES == 0 and all(size & (size - 1) == 0 for size in more)


def _in_one_kernel(work: Callable[[T], T], lanes: T, interpret: bool = False) -> T:
    leaves, tree = jax.tree.flatten(lanes)
    block = [jax.ShapeDtypeStruct((LANES, *leaf.shape[1:]), leaf.dtype) for leaf in leaves]
    traced = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(work(jax.tree.unflatten(tree, leaves))))(*block)
    # What comes out as it went in is not written.
    moved = [
        i for i, (old, new) in enumerate(zip(traced.jaxpr.invars, traced.jaxpr.outvars, strict=True)) if old is not new
    ]

    def body(*refs):
        given, written = refs[: len(leaves) + len(traced.consts)], refs[len(leaves) + len(traced.consts) :]
        values = [ref[...] for ref in given]
        found = jax.core.eval_jaxpr(traced.jaxpr, values[len(leaves) :], *values[: len(leaves)])
        for ref, i in zip(written, moved, strict=True):
            ref[...] = found[i]

    kept = {i: place for place, i in enumerate(moved)}
    found = _by_blocks(body, LANES, (leaves, traced.consts, [leaves[i] for i in moved]), interpret, kept)
    for i, value in zip(moved, found, strict=True):
        leaves[i] = value
    return jax.tree.unflatten(tree, leaves)


def _by_blocks(
    body: Callable[..., None],
    block: int,
    arrays: tuple[list[Any], list[Any], list[Any]],
    interpret: bool,
    kept: dict[int, int] | None = None,
) -> list[Any]:
    """Call a kernel on all blocks of lanes.

    Args:
        body: Its references are to a block of lanes, to what all blocks read, and to what a block writes.
        block: Lanes of a block.
        arrays: All lanes, what all blocks read, and what is written, which may be shapes.
        interpret: As in `stay`.
        kept: Which lanes are written over, and by which result.
    """
    # Here, as importing vijax on a CPU must not load it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    lanes, read, written = arrays

    def part(leaf: Any) -> Any:
        return pallas.BlockSpec((block, *leaf.shape[1:]), lambda i: (i, *[0] * (leaf.ndim - 1)))

    def whole(leaf: Any) -> Any:
        return pallas.BlockSpec(leaf.shape, lambda _: (0,) * leaf.ndim)

    return pallas.pallas_call(
        body,
        grid=(lanes[0].shape[0] // block,),
        in_specs=[*map(part, lanes), *map(whole, read)],
        out_specs=list(map(part, written)),
        out_shape=[jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in written],
        input_output_aliases=kept or {},
        compiler_params=triton.CompilerParams(num_warps=block // _WARP),
        interpret=interpret,
    )(*lanes, *read)
