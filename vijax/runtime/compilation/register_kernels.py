"""Lanes in a GPU's registers during a loop: one kernel of independent blocks, each of which ends by itself.

XLA makes a loop of kernels, and each kernel stores all values of a lane that the next one reads: eighty numbers per
step, which takes a GPU longer than to compute them. Here a thread has one lane, reads it once and writes it once, and a
block of lanes does not wait for the others.

The kernels use Pallas' Triton backend, as the Mosaic GPU backend has no float64. Between kernels lanes are stored in a
few tables [lane, column] instead of the eighty arrays of a record: Triton's compiler processes a whole kernel for each
of its loads and stores, and XLA would need one kernel for each array when lanes are gathered or scattered.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.runtime.compilation import xla
from vijax.runtime.compilation.lane_unrolling import unrolled

T = TypeVar("T")

# Lanes of a block, one thread each: a warp, which a GPU executes in lockstep.
LANES = 32

LaneMapper = Callable[[Callable[[Any], Any], Any], Any]
"""Applies a function to lanes one by one; see `apply_in_registers`."""


class Layout(NamedTuple):
    """Positions of the leaves of a record of lanes in tables.

    Attributes:
        like: The record, as shapes.
        fixed: For each leaf, in order, True if it never changes after packing.
    """

    like: Any
    fixed: tuple[bool, ...]


class Tables(NamedTuple):
    """A record of lanes as a few floating tables: tables that kernels write, and tables that they only read."""

    changing: tuple[Float[Array, "lane column"], ...]
    fixed: tuple[Float[Array, "lane column"], ...]


def registers_enabled() -> bool:
    """Return True if programs are compiled for a GPU and kernels are enabled."""
    return xla.KERNELS and xla.platform() == "gpu"


def fits_registers(like: Any, lanes: int) -> bool:
    """Return True if a kernel can process the lanes: they fill whole blocks, and all other axes are powers of two."""
    sizes = (size for leaf in jax.tree.leaves(like) for size in leaf.shape[1:])
    return lanes % LANES == 0 and all(size & (size - 1) == 0 for size in sizes)


def round_up_to_warps(lanes: int, parts: int) -> int:
    """Round a number of lanes up so that each of `parts` equal parts consists of whole blocks."""
    return -(-lanes // (parts * LANES)) * parts * LANES


def layout(like: Any, fixed: Callable[[Any], Any]) -> Layout:
    """Return the layout of a record.

    Args:
        like: The record, as shapes; its integers must be so small that floating numbers represent them exactly.
        fixed: Record -> the part of it that never changes after packing.
    """
    leaves, tree = jax.tree.flatten(like)
    # Apply `fixed` to a record of leaf numbers: the numbers that it returns are the numbers of the fixed leaves.
    fixed_leaves = set(jax.tree.leaves(fixed(jax.tree.unflatten(tree, range(len(leaves))))))
    return Layout(like, tuple(place in fixed_leaves for place in range(len(leaves))))


def pack(laid: Layout, record: Any) -> Tables:
    """Return lanes as tables."""
    return Tables(*(_laid_out(laid, record, fixed, partial(jnp.stack, axis=1)) for fixed in (False, True)))


def unpack(laid: Layout, tables: Tables) -> Any:
    """Return the record stored in tables."""
    columns = [_cut(tables.changing), _cut(tables.fixed)]
    leaves = [_read(columns[fixed], leaf) for leaf, fixed in _leaves(laid)]
    return jax.tree.unflatten(jax.tree.structure(laid.like), leaves)


def apply_in_registers(
    work: Callable[[Int[Array, " lane"], T, LaneMapper], T],
    laid: Layout,
    number: Int[Array, " lane"],
    tables: Tables,
    real: Int[Array, ""] | None = None,
    *,
    interpret: bool = False,
) -> Tables:
    """Apply `work` to lanes, block by block: on a CUDA GPU in one kernel, elsewhere as plain operations.

    Args:
        work: Function (number of each lane, record of the lanes, lane mapper) -> new record. The function consists of
            elementwise arithmetic, sums over lanes and loops only. For other operations it uses the lane mapper, which
            applies a function of a record of one-axis arrays lane by lane (`lane_unrolling`).
        laid: Layout of the record; `fits_registers` must hold.
        number: A number per lane, passed to `work`.
        tables: The lanes.
        real: Number of real lanes, which come first; None if all are real. The values of other lanes are undefined
            afterwards.
        interpret: True to run the kernel on any machine, operation by operation: for tests.

    Raises:
        ValueError: If the lanes are not whole blocks: a kernel would skip the remainder.
    """
    if number.size % LANES:
        raise ValueError(f"number must be of whole blocks of {LANES} lanes; got {number.size}; use round_up_to_warps")
    kernel = partial(_single_kernel, work, laid, interpret=interpret)

    def as_it_stands(number: Any, tables: Tables, real: Any) -> Tables:
        record = work(number, unpack(laid, tables), lambda function, arguments: function(arguments))
        return tables._replace(changing=pack(laid, record).changing)

    if interpret:
        return kernel(number, tables, real)
    return lax.platform_dependent(number, tables, real, cuda=kernel, default=as_it_stands)


def _on_single_lanes(function: Callable[[Any], Any], arguments: Any) -> Any:
    leaves, tree = jax.tree.flatten(arguments)
    results = jax.tree.structure(jax.eval_shape(function, arguments))
    return jax.tree.unflatten(results, unrolled(lambda leaves: function(jax.tree.unflatten(tree, leaves)), leaves))


def _single_kernel(
    work: Callable[[Any, T, LaneMapper], T], laid: Layout, number: Any, tables: Tables, real: Any, *, interpret: bool
) -> Tables:
    from jax.experimental import pallas

    number_block = jax.ShapeDtypeStruct((LANES,), number.dtype)
    block = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((LANES, *leaf.shape[1:]), leaf.dtype), laid.like)
    # Trace the work for one block. A kernel cannot capture arrays: the constants of the trace become arguments.
    traced = jax.make_jaxpr(lambda number, record: jax.tree.leaves(work(number, record, _on_single_lanes)))(
        number_block, block
    )
    # Values read by all blocks: the number of real lanes, and every constant of the work.
    read = [*([] if real is None else [real.reshape(1)]), *traced.consts]
    split_arrays = [number, *tables.changing, *tables.fixed]
    ends = [len(split_arrays), len(split_arrays) + len(read)]

    def on_refs(*refs: Any) -> None:
        number, *table_refs = refs[: ends[0]]
        consts, written = refs[ends[0] + (real is not None) : ends[1]], refs[ends[1] :]

        def on_a_block() -> None:
            block_tables = jax.tree.unflatten(jax.tree.structure(tables), [ref[...] for ref in table_refs])
            leaves = jax.tree.leaves(unpack(laid, block_tables))
            result_leaves = jax.core.eval_jaxpr(traced.jaxpr, [ref[...] for ref in consts], number[...], *leaves)
            record = jax.tree.unflatten(jax.tree.structure(laid.like), result_leaves)
            for ref, table in zip(written, _laid_out(laid, record, False, _joined), strict=True):
                ref[...] = table

        if real is None:
            on_a_block()
        else:
            # Blocks without a real lane are skipped.
            pallas.when(pallas.program_id(0) * LANES < refs[ends[0]][0])(on_a_block)

    return tables._replace(changing=_by_blocks(on_refs, split_arrays, read, tables.changing, interpret))


def _by_blocks(
    on_refs: Callable[..., None], split_arrays: list[Any], read: list[Any], written: tuple[Any, ...], interpret: bool
) -> tuple[Any, ...]:
    """Call a kernel on all blocks of lanes.

    Args:
        on_refs: Function of references to the block's parts, to the values read by all blocks, and to the block's
            results.
        split_arrays: Arrays split into blocks: the numbers of the lanes, the written tables, the read-only tables.
        read: Arrays read by all blocks.
        written: The items of `split_arrays` that are written, in place.
        interpret: As in `apply_in_registers`.
    """
    # Imported here: importing vijax on a CPU must not load it.
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    def part(array: Any) -> Any:
        return pallas.BlockSpec((LANES, *array.shape[1:]), lambda i: (i, *[0] * (array.ndim - 1)))

    def whole_array(array: Any) -> Any:
        return pallas.BlockSpec(array.shape, lambda _: (0,) * array.ndim)

    tables = pallas.pallas_call(
        on_refs,
        grid=(split_arrays[0].size // LANES,),
        in_specs=[*map(part, split_arrays), *map(whole_array, read)],
        out_specs=list(map(part, written)),
        out_shape=[jax.ShapeDtypeStruct(table.shape, table.dtype) for table in written],
        # Written tables are updated in place; input 0 is the lane numbers.
        input_output_aliases={1 + i: i for i in range(len(written))},
        compiler_params=triton.CompilerParams(num_warps=1),
        interpret=interpret,
    )(*split_arrays, *read)
    return tuple(tables)


# --- columns ---------------------------------------------------------------------------------------------------------


def _leaves(laid: Layout) -> Iterator[tuple[Any, bool]]:
    return zip(jax.tree.leaves(laid.like), laid.fixed, strict=True)


def _laid_out(laid: Layout, record: Any, fixed: bool, join: Callable[[list[Any]], Any]) -> tuple[Any, ...]:
    """Return the tables of the fixed leaves of a record, or of the changing ones; `join` makes a table of columns."""
    columns: list[Any] = []
    kind = next(leaf.dtype for leaf, _ in _leaves(laid) if jnp.issubdtype(leaf.dtype, jnp.floating))
    for value, is_fixed in zip(jax.tree.leaves(record), laid.fixed, strict=True):
        if is_fixed == fixed:
            # All leaves share one floating dtype in the tables; `unpack` restores their own.
            rows = value.reshape(value.shape[0], -1).astype(kind)
            columns += [part.reshape(-1) for part in lax.split(rows, (1,) * rows.shape[1], axis=1)]
    return tuple(map(join, _by_table(columns)))


def _sizes(columns: int) -> list[int]:
    """Return the widths of the tables for a number of columns.

    The widths are powers of two, because Triton requires it, and chosen so that there are few tables with at most a
    quarter of unused columns.
    """
    if not columns:
        return []
    size = 1 << (columns - 1).bit_length()
    return [size] if 4 * columns >= 3 * size else [size // 2, *_sizes(columns - size // 2)]


def _by_table(columns: list[Any]) -> Iterator[list[Any]]:
    """Yield the list of columns of each table, filled up to the width of the table with columns that are not read."""
    for size in _sizes(len(columns)):
        chosen, columns = columns[:size], columns[size:]
        # Unused columns repeat the first one.
        yield chosen + chosen[:1] * (size - len(chosen))


def _cut(tables: tuple[Any, ...]) -> Iterator[Any]:
    """Yield the columns of tables, one after another."""
    for table in tables:
        for part in lax.split(table, (1,) * table.shape[1], axis=1):
            yield part.reshape(-1)


def _read(columns: Iterator[Any], leaf: Any) -> Any:
    """Return a leaf from the next columns."""
    lanes = [next(columns) for _ in range(math.prod(leaf.shape[1:]))]
    return _joined(lanes).reshape(-1, *leaf.shape[1:]).astype(leaf.dtype)


def _joined(columns: list[Any]) -> Any:
    """Join columns to a table: Triton joins two arrays at a time, along a new last axis."""

    def joined(columns: list[Any]) -> Any:
        if len(columns) == 1:
            return columns[0]
        # Even and odd columns are joined recursively; the new last axis interleaves them in order.
        return jnp.concatenate([joined(columns[half::2])[..., None] for half in (0, 1)], axis=-1)

    return joined(columns).reshape(-1, len(columns))
