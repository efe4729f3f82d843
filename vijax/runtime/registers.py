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
    from jax.experimental.pallas import triton

    leaves, tree = jax.tree.flatten(lanes)
    like = jax.eval_shape(work, lanes)

    def body(real, *refs):
        @pallas.when(pallas.program_id(0) * FEW < real[0])
        def _():
            lanes = [ref[...] for ref in refs[: len(leaves)]]
            found = unrolled(lambda lanes: work(jax.tree.unflatten(tree, lanes)), lanes)
            for ref, value in zip(refs[len(leaves) :], found, strict=True):
                ref[...] = value

    part = pallas.BlockSpec((FEW,), lambda i: (i,))
    found = pallas.pallas_call(
        body,
        grid=(leaves[0].size // FEW,),
        in_specs=[pallas.BlockSpec((1,), lambda _: (0,)), *(part for _ in leaves)],
        out_specs=[part for _ in jax.tree.leaves(like)],
        out_shape=[jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(like)],
        compiler_params=triton.CompilerParams(num_warps=FEW // _WARP),
        interpret=interpret,
    )(real.reshape(1), *leaves)
    return jax.tree.unflatten(jax.tree.structure(like), found)


def _fits(leaf: Any) -> bool:
    count, *more = leaf.shape
    return count % LANES == 0 and all(size & (size - 1) == 0 for size in more)


def _in_one_kernel(work: Callable[[T], T], lanes: T, interpret: bool = False) -> T:
    # Here, as importing vijax on a CPU must not load it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

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

    def part(leaf):
        return pallas.BlockSpec((LANES, *leaf.shape[1:]), lambda i: (i, *[0] * (leaf.ndim - 1)))

    def whole(leaf):
        return pallas.BlockSpec(leaf.shape, lambda _: (0,) * leaf.ndim)

    found = pallas.pallas_call(
        body,
        grid=(leaves[0].shape[0] // LANES,),
        in_specs=[*map(part, leaves), *map(whole, traced.consts)],
        out_specs=[part(leaves[i]) for i in moved],
        out_shape=[jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in moved],
        input_output_aliases={i: place for place, i in enumerate(moved)},
        compiler_params=triton.CompilerParams(num_warps=LANES // _WARP),
        interpret=interpret,
    )(*leaves, *traced.consts)
    for i, value in zip(moved, found, strict=True):
        leaves[i] = value
    return jax.tree.unflatten(tree, leaves)
