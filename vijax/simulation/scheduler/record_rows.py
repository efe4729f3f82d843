"""Records packed into the rows of one table: a compiled call takes one array and returns one, and a cell is one row.

The column layout follows from the record's structure alone; it is stored nowhere.
"""

import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation import xla

Record = TypeVar("Record")


def pack(record: Any, leading: int = 1) -> Float[Array, "... column"]:
    """Return the arrays of a record side by side, with integers and codes converted to floating point.

    Args:
        record: Arrays that share their first `leading` axes; all floating ones have one dtype.
        leading: Number of leading axes, which index the rows.
    """
    leaves = jax.tree.leaves(record)
    kind = _kind(leaves)
    flat = [leaf.reshape(*leaf.shape[:leading], -1).astype(kind, copy=False) for leaf in leaves]
    return jnp.concatenate(flat, axis=-1)


def laid_out(record: Any, size: int) -> Float[AnyArray, "row column"]:
    """Return a table of a compiled call: the arrays of a record side by side, as in `pack`, padded to `size` rows.

    For a CPU the table is made by NumPy, because JAX would compile a program for every number of rows.

    Args:
        record: Arrays that share their first axis; all floating ones have one dtype.
        size: Number of rows of the table; rows past the record's own have arbitrary values.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(record)]
    if not xla.on_cpu():
        return pack([_sent(leaf, size) for leaf in leaves])
    table: Any = np.zeros((size, width(leaves)), _kind(leaves))
    columns = [leaf.reshape(leaf.shape[0], -1) for leaf in leaves]
    np.concatenate(columns, axis=1, out=table[: leaves[0].shape[0]], casting="unsafe")
    return table


def _kind(leaves: list[Any]) -> Any:
    """Return the floating dtype of a record."""
    return next(leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))


def _sent(leaf: np.ndarray, size: int) -> Any:
    """Return an array on the accelerator, with `size` rows; a repeated value is sent once, as the transfer is slow."""
    if leaf.shape[0] == 1 or not any(leaf.strides):
        return jnp.broadcast_to(jnp.asarray(leaf[0]), (size, *leaf.shape[1:]))
    return jnp.asarray(np.resize(leaf, (size, *leaf.shape[1:])))


def unpack(table: Any, like: Record) -> Record:
    """Return the record stored in the rows of a table.

    Args:
        table: Result of `pack`, [row, column] or with more axes of rows; an array of JAX or NumPy.
        like: The record with one axis of rows of any length, as arrays or as shapes.

    Returns:
        The record. If the table is NumPy's, a field that is writable and contiguous there is a view, not a copy.
    """
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([math.prod(leaf.shape[1:]) for leaf in leaves]).tolist()
    columns = (table[..., start:end] for start, end in zip([0, *ends], ends, strict=False))
    shapes = (table.shape[:-1] + leaf.shape[1:] for leaf in leaves)
    parts = zip(columns, shapes, leaves, strict=True)
    return jax.tree.unflatten(tree, [_typed(part.reshape(shape), leaf.dtype) for part, shape, leaf in parts])


def _typed(part: Any, kind: Any) -> Any:
    return np.require(part, kind, ("C", "W")) if isinstance(part, np.ndarray) else part.astype(kind)


def width(like: Any) -> int:
    """Return the number of columns of a record with one axis of rows."""
    return sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves(like))
