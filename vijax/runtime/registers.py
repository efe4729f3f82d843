"""Lanes that stay in a GPU's registers while a loop goes on: one kernel of blocks, each of which ends by itself.

XLA makes a loop of kernels, and each stores all that the next one reads of a lane: eighty numbers a step, which takes a
GPU longer than to compute them. Here a thread has a lane, reads it once and writes it once, and a block of lanes does
not wait for the others.

By Pallas' way to Triton, as the way to Mosaic GPU knows no float64. Between kernels lanes lie in a few tables [lane,
column], not in the eighty arrays that a record has: Triton's compiler looks at all of a kernel for each of its loads
and stores, and XLA would need a kernel for each array that a few lanes are taken from, or put into.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.runtime import xla
from vijax.runtime.unrolled import unrolled

T = TypeVar("T")

# Lanes of a block, a thread each: those that a GPU runs in step anyway.
LANES = 32

Each = Callable[[Callable[[Any], Any], Any], Any]
"""Does some work on lanes as on single ones; see `stay`."""


class Layout(NamedTuple):
    """Where the leaves of a record of lanes lie in tables.

    Attributes:
        like: The record, as shapes.
        fixed: Of each leaf, in their order, whether it stays as it was laid out.
    """

    like: Any
    fixed: tuple[bool, ...]


class Tables(NamedTuple):
    """A record of lanes as few tables of floating numbers, those that kernels write apart from those that they read."""

    changing: tuple[Float[Array, "lane column"], ...]
    fixed: tuple[Float[Array, "lane column"], ...]


def used() -> bool:
    """Say whether programs are made for a GPU and kernels are wanted there."""
    return xla.KERNELS and xla.platform() == "gpu"


def fit(like: Any, lanes: int) -> bool:
    """Say whether a kernel can hold lanes: whole blocks of them, with no axis but that which is not a power of two."""
    sizes = (size for leaf in jax.tree.leaves(like) for size in leaf.shape[1:])
    return lanes % LANES == 0 and all(size & (size - 1) == 0 for size in sizes)


def whole_blocks(lanes: int, parts: int) -> int:
    """Round lanes up so that each of so many parts of them is of whole blocks."""
    return -(-lanes // (parts * LANES)) * parts * LANES


def layout(like: Any, fixed: Callable[[Any], Any]) -> Layout:
    """Lay out a record.

    Args:
        like: The record, as shapes; whole numbers in it must be so small that floating ones hold them.
        fixed: A record -> what of it stays as it was laid out.
    """
    leaves, tree = jax.tree.flatten(like)
    stays = set(jax.tree.leaves(fixed(jax.tree.unflatten(tree, range(len(leaves))))))
    return Layout(like, tuple(place in stays for place in range(len(leaves))))


def pack(laid: Layout, record: Any) -> Tables:
    """Lay lanes out as tables."""
    return Tables(*(_laid_out(laid, record, fixed, partial(jnp.stack, axis=1)) for fixed in (False, True)))


def unpack(laid: Layout, tables: Tables) -> Any:
    """Take the record out of its tables again."""
    columns = [_cut(tables.changing), _cut(tables.fixed)]
    leaves = [_read(columns[fixed], leaf) for leaf, fixed in _leaves(laid)]
    return jax.tree.unflatten(jax.tree.structure(laid.like), leaves)


def stay(
    work: Callable[[Int[Array, " lane"], T, Each], T],
    laid: Layout,
    number: Int[Array, " lane"],
    tables: Tables,
    real: Int[Array, ""] | None = None,
    *,
    interpret: bool = False,
) -> Tables:
    """Do `work` on lanes, block by block: on a CUDA GPU in one kernel, elsewhere as it stands.

    Args:
        work: A number of each lane, and their record -> the record; elementwise arithmetic, sums over lanes and loops,
            nothing else. What does more goes through its third argument, which does some work on a record of arrays of
            one axis as on single lanes (`unrolled`).
        laid: How the record lies in the tables; `fit` must hold.
        number: Whatever a lane is told besides.
        tables: What it is done on.
        real: How many lanes count, the first ones, if not all; what becomes of the others may be anything.
        interpret: Whether to run the kernel here whatever this machine is, operation by operation: for tests.

    Raises:
        ValueError: Lanes are no whole blocks: a kernel would leave out what is left of them.
    """
    if number.size % LANES:
        raise ValueError(f"number must be of whole blocks of {LANES} lanes; got {number.size}; whole_blocks rounds up")
    kernel = partial(_in_one_kernel, work, laid, interpret=interpret)

    def as_it_stands(number: Any, tables: Tables, real: Any) -> Tables:
        record = work(number, unpack(laid, tables), lambda some, given: some(given))
        return tables._replace(changing=pack(laid, record).changing)

    if interpret:
        return kernel(number, tables, real)
    return lax.platform_dependent(number, tables, real, cuda=kernel, default=as_it_stands)


def _on_single_lanes(some: Callable[[Any], Any], given: Any) -> Any:
    leaves, tree = jax.tree.flatten(given)
    results = jax.tree.structure(jax.eval_shape(some, given))
    return jax.tree.unflatten(results, unrolled(lambda leaves: some(jax.tree.unflatten(tree, leaves)), leaves))


def _in_one_kernel(
    work: Callable[[Any, T, Each], T], laid: Layout, number: Any, tables: Tables, real: Any, *, interpret: bool
) -> Tables:
    from jax.experimental import pallas

    first = jax.ShapeDtypeStruct((LANES,), number.dtype)
    block = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((LANES, *leaf.shape[1:]), leaf.dtype), laid.like)
    traced = jax.make_jaxpr(lambda number, record: jax.tree.leaves(work(number, record, _on_single_lanes)))(
        first, block
    )
    # What all blocks read: how many lanes count, and every number that the work knows from elsewhere.
    read = [*([] if real is None else [real.reshape(1)]), *traced.consts]
    given = [number, *tables.changing, *tables.fixed]
    ends = [len(given), len(given) + len(read)]

    def on_refs(*refs: Any) -> None:
        number, *held = refs[: ends[0]]
        consts, written = refs[ends[0] + (real is not None) : ends[1]], refs[ends[1] :]

        def on_a_block() -> None:
            some = jax.tree.unflatten(jax.tree.structure(tables), [ref[...] for ref in held])
            leaves = jax.tree.leaves(unpack(laid, some))
            found = jax.core.eval_jaxpr(traced.jaxpr, [ref[...] for ref in consts], number[...], *leaves)
            record = jax.tree.unflatten(jax.tree.structure(laid.like), found)
            for ref, table in zip(written, _laid_out(laid, record, False, _joined), strict=True):
                ref[...] = table

        if real is None:
            on_a_block()
        else:
            pallas.when(pallas.program_id(0) * LANES < refs[ends[0]][0])(on_a_block)

    return tables._replace(changing=_by_blocks(on_refs, given, read, tables.changing, interpret))


def _by_blocks(
    on_refs: Callable[..., None], given: list[Any], read: list[Any], written: tuple[Any, ...], interpret: bool
) -> tuple[Any, ...]:
    """Call a kernel on all blocks of lanes.

    Args:
        on_refs: On references to what a block is given, to what all blocks read, and to what a block writes.
        given: Arrays that blocks have parts of: the numbers of the lanes, what is written, what is not.
        read: What all blocks read.
        written: Those of `given` that are written, in place.
        interpret: As in `stay`.
    """
    # Here, as importing vijax on a CPU must not load it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    def part(array: Any) -> Any:
        return pallas.BlockSpec((LANES, *array.shape[1:]), lambda i: (i, *[0] * (array.ndim - 1)))

    def whole(array: Any) -> Any:
        return pallas.BlockSpec(array.shape, lambda _: (0,) * array.ndim)

    found = pallas.pallas_call(
        on_refs,
        grid=(given[0].size // LANES,),
        in_specs=[*map(part, given), *map(whole, read)],
        out_specs=list(map(part, written)),
        out_shape=[jax.ShapeDtypeStruct(table.shape, table.dtype) for table in written],
        input_output_aliases={1 + i: i for i in range(len(written))},
        compiler_params=triton.CompilerParams(num_warps=1),
        interpret=interpret,
    )(*given, *read)
    return tuple(found)


# --- columns ---------------------------------------------------------------------------------------------------------


def _leaves(laid: Layout) -> Iterator[tuple[Any, bool]]:
    return zip(jax.tree.leaves(laid.like), laid.fixed, strict=True)


def _laid_out(laid: Layout, record: Any, fixed: bool, join: Callable[[list[Any]], Any]) -> tuple[Any, ...]:
    """Make the tables of what is fixed in a record, or of what is not, joining columns in some way."""
    columns: list[Any] = []
    kind = next(leaf.dtype for leaf, _ in _leaves(laid) if jnp.issubdtype(leaf.dtype, jnp.floating))
    for value, stays in zip(jax.tree.leaves(record), laid.fixed, strict=True):
        if stays == fixed:
            rows = value.reshape(value.shape[0], -1).astype(kind)
            columns += [part.reshape(-1) for part in lax.split(rows, (1,) * rows.shape[1], axis=1)]
    return tuple(map(join, _by_table(columns)))


def _sizes(columns: int) -> list[int]:
    """Cut columns into tables, each of a power of two of them, as Triton wants it: few tables, and few void columns."""
    if not columns:
        return []
    size = 1 << (columns - 1).bit_length()
    return [size] if 4 * columns >= 3 * size else [size // 2, *_sizes(columns - size // 2)]


def _by_table(columns: list[Any]) -> Iterator[list[Any]]:
    """Give the columns of each table, void ones too."""
    for size in _sizes(len(columns)):
        some, columns = columns[:size], columns[size:]
        yield some + some[:1] * (size - len(some))


def _cut(tables: tuple[Any, ...]) -> Iterator[Any]:
    """Give one column of tables after another."""
    for table in tables:
        for part in lax.split(table, (1,) * table.shape[1], axis=1):
            yield part.reshape(-1)


def _read(columns: Iterator[Any], leaf: Any) -> Any:
    """Read a leaf from the columns that come next."""
    lanes = [next(columns) for _ in range(math.prod(leaf.shape[1:]))]
    return _joined(lanes).reshape(-1, *leaf.shape[1:]).astype(leaf.dtype)


def _joined(columns: list[Any]) -> Any:
    """Join columns to a table: Triton joins two at a time, along a new last axis."""

    def joined(columns: list[Any]) -> Any:
        if len(columns) == 1:
            return columns[0]
        return jnp.concatenate([joined(columns[half::2])[..., None] for half in (0, 1)], axis=-1)

    return joined(columns).reshape(-1, len(columns))
