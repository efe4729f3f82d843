"""Lanes that stay in a GPU's registers while a loop goes on: one kernel of blocks, each of which ends by itself.

XLA makes a loop of kernels, and each stores all that the next one reads of a lane: eighty numbers a step, which takes a
GPU longer than to compute them. Here a thread has a lane, reads it once and writes it once, and a block of lanes does
not wait for the others.

By Pallas' way to Triton, as the way to Mosaic GPU knows no float64. A kernel reads and writes a few tables, not the
eighty arrays that lanes are: Triton's compiler looks at all of a kernel for each of its loads and stores, and was done
in 32 seconds where it now is in 4.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.runtime import xla
from vijax.runtime.unrolled import unrolled

T = TypeVar("T")

# Lanes of a block, a thread each: those that a GPU runs in step anyway.
LANES = 32


def used() -> bool:
    """Say whether programs are made for a GPU and kernels are wanted there."""
    return xla.KERNELS and xla.platform() == "gpu"


def stay(work: Callable[[T], T], lanes: T, *, interpret: bool = False) -> T:
    """Do `work` on all lanes, block by block: on a CUDA GPU in one kernel, elsewhere as it stands.

    Args:
        work: On lanes, arrays of one leading axis; elementwise arithmetic, sums over lanes and loops, nothing else.
            Where further axes are not of a power of two, or lanes are not whole blocks, it is not in one kernel.
            Whole numbers pass as floating ones, and must be so small that these hold them.
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
    if any(leaf.ndim != 1 or leaf.size % LANES for leaf in leaves):
        return work(lanes)
    if interpret:
        return _of_each(work, lanes, real, interpret=True)
    return lax.platform_dependent(lanes, real, cuda=partial(_of_each, work), default=lambda lanes, _: work(lanes))


def whole_blocks(lanes: int, parts: int) -> int:
    """Round lanes up so that each of so many parts of them is of whole blocks."""
    return -(-lanes // (parts * LANES)) * parts * LANES


def _fits(leaf: Any) -> bool:
    count, *more = leaf.shape
    return count % LANES == 0 and all(size & (size - 1) == 0 for size in more)


def _in_one_kernel(work: Callable[[T], T], lanes: T, interpret: bool = False) -> T:
    leaves, tree = jax.tree.flatten(lanes)
    block = [jax.ShapeDtypeStruct((LANES, *leaf.shape[1:]), leaf.dtype) for leaf in leaves]
    traced = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(work(jax.tree.unflatten(tree, leaves))))(*block)
    # What comes out as it went in is not written.
    pairs = zip(traced.jaxpr.invars, traced.jaxpr.outvars, strict=True)
    moved = [i for i, (old, new) in enumerate(pairs) if old is not new]
    like = [leaves[i] for i in moved]

    def body(given: list[Any], read: list[Any], written: list[Any]) -> None:
        found = jax.core.eval_jaxpr(traced.jaxpr, [ref[...] for ref in read], *_columns(given, block))
        _write([found[i] for i in moved], written)

    kind = _kind(leaves)
    found = _by_blocks(body, (_tables(leaves, kind), traced.consts, _shapes(like, kind)), interpret)
    for i, value in zip(moved, _apart(found, like, interpret), strict=True):
        leaves[i] = value
    return jax.tree.unflatten(tree, leaves)


def _of_each(work: Callable[[Any], T], lanes: Any, real: Int[Array, ""], interpret: bool = False) -> T:
    from jax.experimental import pallas

    leaves, tree = jax.tree.flatten(lanes)
    block = [jax.ShapeDtypeStruct((LANES,), leaf.dtype) for leaf in leaves]
    like, results = jax.tree.flatten(jax.eval_shape(work, lanes))

    def body(given: list[Any], read: list[Any], written: list[Any]) -> None:
        @pallas.when(pallas.program_id(0) * LANES < read[0][0])
        def _():
            _write(unrolled(lambda some: work(jax.tree.unflatten(tree, some)), _columns(given, block)), written)

    kind = _kind(leaves)
    found = _by_blocks(body, (_tables(leaves, kind), [real.reshape(1)], _shapes(like, kind)), interpret)
    return jax.tree.unflatten(results, _apart(found, like, interpret))


def _by_blocks(
    body: Callable[[list[Any], list[Any], list[Any]], None],
    arrays: tuple[list[Any], list[Any], list[Any]],
    interpret: bool,
) -> list[Any]:
    """Call a kernel on all blocks of lanes.

    Args:
        body: On references to what a block is given, to what all blocks read, and to what a block writes.
        arrays: Those that blocks have parts of, by their last axis; what all blocks read; and the shapes of what is
            written.
        interpret: As in `stay`.
    """
    # Here, as importing vijax on a CPU must not load it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    given, read, written = arrays

    def part(array: Any) -> Any:
        return pallas.BlockSpec((*array.shape[:-1], LANES), lambda i: (*[0] * (array.ndim - 1), i))

    def whole(array: Any) -> Any:
        return pallas.BlockSpec(array.shape, lambda _: (0,) * array.ndim)

    def on_refs(*refs: Any) -> None:
        first, second = len(given), len(given) + len(read)
        body(list(refs[:first]), list(refs[first:second]), list(refs[second:]))

    return pallas.pallas_call(
        on_refs,
        grid=(given[0].shape[-1] // LANES,),
        in_specs=[*map(part, given), *map(whole, read)],
        out_specs=list(map(part, written)),
        out_shape=[jax.ShapeDtypeStruct(array.shape, array.dtype) for array in written],
        compiler_params=triton.CompilerParams(num_warps=1),
        interpret=interpret,
    )(*given, *read)


# --- tables [column, lane] -------------------------------------------------------------------------------------------


def _kind(leaves: list[Any]) -> Any:
    """Find which floating numbers lanes hold."""
    return next(leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))


def _sizes(columns: int) -> list[int]:
    """Cut columns into tables, each of a power of two of them, as Triton wants it: few tables, and few void columns."""
    if not columns:
        return []
    size = 1 << (columns - 1).bit_length()
    return [size] if 4 * columns >= 3 * size else [size // 2, *_sizes(columns - size // 2)]


def _shapes(leaves: list[Any], kind: Any) -> list[Any]:
    """Give the shapes of the tables of lanes."""
    lanes = leaves[0].shape[0]
    columns = sum(leaf.size for leaf in leaves) // lanes
    return [jax.ShapeDtypeStruct((size, lanes), kind) for size in _sizes(columns)]


def _tables(leaves: list[Any], kind: Any) -> list[Any]:
    """Lay lanes out as few tables of floating numbers of a kind."""
    rows = [leaf.reshape(leaf.shape[0], -1).astype(kind) for leaf in leaves]
    return list(map(jnp.stack, _by_table([some[:, i] for some in rows for i in range(some.shape[1])])))


def _by_table(columns: list[Any]) -> Iterator[list[Any]]:
    """Give the columns of each table, void ones too."""
    for size in _sizes(len(columns)):
        some, columns = columns[:size], columns[size:]
        yield some + some[:1] * (size - len(some))


def _by_leaf(columns: list[Any], like: list[Any]) -> Iterator[tuple[list[Any], Any]]:
    """Give the columns of each leaf, with the leaf."""
    for leaf in like:
        width = leaf.size // leaf.shape[0]
        some, columns = columns[:width], columns[width:]
        yield some, leaf


def _columns(refs: list[Any], like: list[Any]) -> list[Any]:
    """Read the leaves of a block."""
    columns: list[Any] = []
    for ref in refs:
        table = ref[...]
        parts = lax.split(table, (1,) * len(table)) if len(table) > 1 else [table]
        columns += [part.reshape(LANES) for part in parts]
    return [_joined(some).reshape(leaf.shape).astype(leaf.dtype) for some, leaf in _by_leaf(columns, like)]


def _write(values: list[Any], refs: list[Any]) -> None:
    """Write the leaves of a block."""
    columns: list[Any] = []
    for value in values:
        rows = value.reshape(LANES, -1).astype(refs[0].dtype)
        parts = lax.split(rows, (1,) * rows.shape[1], axis=1) if rows.shape[1] > 1 else [rows]
        columns += [part.reshape(LANES) for part in parts]
    for ref, some in zip(refs, _by_table(columns), strict=True):
        ref[...] = lax.transpose(_joined(some).reshape(LANES, len(some)), (1, 0))


def _joined(columns: list[Any]) -> Any:
    """Join columns to an array [lane, 2, ..., 2]: Triton joins two at a time, along a new last axis."""
    if len(columns) == 1:
        return columns[0]
    return jnp.concatenate([_joined(columns[half::2])[..., None] for half in (0, 1)], axis=-1)


def _apart(tables: list[Any], like: list[Any], interpret: bool) -> list[Any]:
    """Make arrays of the columns of tables, in one kernel: XLA would copy them one by one."""
    flat = [
        jax.ShapeDtypeStruct(leaf.shape[:1], leaf.dtype) for leaf in like for _ in range(leaf.size // leaf.shape[0])
    ]

    def body(given: list[Any], read: list[Any], written: list[Any]) -> None:
        rows = [(ref, i) for ref in given for i in range(ref.shape[0])]
        for (ref, i), out in zip(rows, written, strict=False):
            out[...] = ref[i, :].astype(out.dtype)

    columns = _by_blocks(body, (tables, [], flat), interpret)
    return [jnp.stack(some, axis=-1).reshape(leaf.shape) for some, leaf in _by_leaf(columns, like)]
