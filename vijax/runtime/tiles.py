"""Calls of few sizes over any number of rows: padded tiles, on every device and core."""

import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.runtime import xla


def workers() -> int:
    """Count the threads that call programs on different tiles: one a core of a CPU, one for an accelerator."""
    return (os.cpu_count() or 1) if xla.on_cpu() else 1


def places() -> list[jax.Device]:
    """List a device for every tile that is run at once: all of this process, a CPU's as often as its cores want.

    If one was chosen as JAX's default, that one alone. No tile is spread over several devices: XLA parts such a program
    before it optimises, and rounds otherwise than on one.
    """
    chosen = jax.default_device.value is not None
    devices = [jnp.zeros(()).device] if chosen else jax.local_devices()
    return devices * max(workers() // len(devices), 1)


class Tile(NamedTuple):
    """Rows of one compiled call, padded by the last one; how many come first that are no padding."""

    rows: np.ndarray
    real: int


def tiles(count: int, sizes: tuple[int, ...]) -> list[Tile]:
    """Cut `count` rows into calls of few sizes, ascending, so that few programs are compiled for every number of rows.

    The largest size at which at most every other row is padding, which costs as much as any.
    """
    size = max((size for size in sizes if -(-count // size) * size <= 2 * count), default=sizes[0])
    starts = range(0, count, size)
    return [Tile(np.minimum(np.arange(start, start + size), count - 1), min(size, count - start)) for start in starts]


def padded(count: int) -> int:
    """Round up to the next power of two, so that few programs are compiled for every number."""
    return 1 << max(count - 1, 0).bit_length()


def replaced(rows: np.ndarray, table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Copy a table with other values in some rows, given by index or mask."""
    table = table.copy()
    table[rows] = values
    return table


def library(tree: Any) -> Any:
    """Choose what cuts and joins arrays: NumPy, as JAX compiles for every size; JAX where something is traced."""
    return jnp if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)) else np


def arrays(tree: Any) -> Any:
    """Turn NumPy's arrays into JAX's: not by `jnp.asarray`, which compiles a program for every shape."""
    return tree if library(tree) is jnp else jax.device_put(tree)


def map_tiles(work: Callable[[Any], Any], rows: Any, sizes: tuple[int, ...]) -> Any:
    """Do the work on any number of rows, in padded tiles of few sizes; in one call where they are traced."""
    if library(rows) is jnp:
        return work(rows)
    parts = []
    for tile in tiles(jax.tree.leaves(rows)[0].shape[0], sizes):
        found = work(jax.tree.map(lambda leaf, some=tile.rows: np.asarray(leaf)[some], rows))
        own = library(found)
        parts.append(jax.tree.map(lambda leaf, real=tile.real, own=own: own.asarray(leaf)[:real], found))
    return jax.tree.map(lambda *leaves: library(leaves).concatenate(leaves), *parts)


def elementwise(work: Callable[..., Any], *args: Any) -> Any:
    """Do the work on arrays that broadcast, padded to a power of two; in their shape where they are traced."""
    shape = np.broadcast_shapes(*(np.shape(leaf) for leaf in jax.tree.leaves(args)))
    if not shape or library(args) is jnp:
        return work(*args)
    count = math.prod(shape)

    def row(leaf):
        return np.resize(np.broadcast_to(np.asarray(leaf), shape), padded(count)) if np.ndim(leaf) else leaf

    found = work(*jax.tree.map(row, args))
    return arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[:count].reshape(shape), found))
