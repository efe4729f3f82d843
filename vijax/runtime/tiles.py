"""Compiled calls of few sizes for any number of rows: padded tiles, on all devices and cores."""

import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.runtime.compilation import xla


def workers() -> int:
    """Return the number of threads that call programs on different tiles: one per CPU core, one for an accelerator."""
    return (os.cpu_count() or 1) if xla.on_cpu() else 1


def tile_devices() -> list[jax.Device]:
    """Return one device per concurrent tile: all devices of this process, a CPU repeated for its cores.

    If the program has set JAX's default device, this device only. A tile is never split over several devices: XLA
    partitions such a program before it optimises it, and the rounding differs from a single device.
    """
    chosen = jax.default_device.value is not None
    devices = [jnp.zeros(()).device] if chosen else jax.local_devices()
    return devices * max(workers() // len(devices), 1)


class Tile(NamedTuple):
    """Row indices of one compiled call, padded with the last row; `real` is the number of rows before the padding."""

    rows: np.ndarray
    real: int


def tiles(count: int, sizes: tuple[int, ...]) -> list[Tile]:
    """Split `count` rows into calls of one of `sizes` (ascending), so that few programs serve every number of rows.

    All calls have one size: the largest at which the padding rows of all calls are not more than the real rows, or else
    the smallest size. The padding is limited because a padding row costs as much time as a real row.
    """
    size = max((size for size in sizes if -(-count // size) * size <= 2 * count), default=sizes[0])
    starts = range(0, count, size)
    return [Tile(np.minimum(np.arange(start, start + size), count - 1), min(size, count - start)) for start in starts]


def padded(count: int) -> int:
    """Round up to the next power of two, so that few programs serve every number."""
    return 1 << max(count - 1, 0).bit_length()


def with_replaced_rows(rows: np.ndarray, table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a copy of a table with new values in some rows, selected by index or mask."""
    table = table.copy()
    table[rows] = values
    return table


def array_namespace(tree: Any) -> Any:
    """Return the library for splits and joins: JAX if a leaf is traced, else NumPy, as JAX compiles for every size."""
    return jnp if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)) else np


def arrays(tree: Any) -> Any:
    """Convert NumPy's arrays to JAX's: not by `jnp.asarray`, which compiles a program for every shape."""
    return tree if array_namespace(tree) is jnp else jax.device_put(tree)


def map_tiles(work: Callable[[Any], Any], rows: Any, sizes: tuple[int, ...]) -> Any:
    """Apply `work` to any number of rows, in padded tiles of few sizes; in one call if they are traced."""
    if array_namespace(rows) is jnp:
        return work(rows)
    parts = []
    for tile in tiles(jax.tree.leaves(rows)[0].shape[0], sizes):
        result = work(jax.tree.map(lambda leaf, indices=tile.rows: np.asarray(leaf)[indices], rows))
        array_module = array_namespace(result)
        parts.append(
            jax.tree.map(
                lambda leaf, real=tile.real, array_module=array_module: array_module.asarray(leaf)[:real], result
            )
        )
    # Parts may be JAX's arrays where a result is traced.
    return jax.tree.map(lambda *leaves: array_namespace(leaves).concatenate(leaves), *parts)


def elementwise(work: Callable[..., Any], *args: Any) -> Any:
    """Apply `work` to arrays that broadcast, padded to a power of two; in their own shape if they are traced."""
    shape = np.broadcast_shapes(*(np.shape(leaf) for leaf in jax.tree.leaves(args)))
    if not shape or array_namespace(args) is jnp:
        return work(*args)
    count = math.prod(shape)

    def row(leaf):
        return np.resize(np.broadcast_to(np.asarray(leaf), shape), padded(count)) if np.ndim(leaf) else leaf

    result = work(*jax.tree.map(row, args))
    return arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(shape), result))
