"""Records as rows of one table: a compiled call is given one array and returns one, and a cell is written at once.

Which column holds what follows from the record itself, and is written down nowhere.
"""

import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.runtime import xla
from vijax.runtime.arrays import AnyArray

Record = TypeVar("Record")


def pack(record: Any, leading: int = 1) -> Float[Array, "... column"]:
    """Put the arrays of a record side by side, whole numbers and codes as floating point ones.

    Args:
        record: Arrays that share their first `leading` axes; all floating ones of one kind.
        leading: How many axes number the rows.
    """
    leaves = jax.tree.leaves(record)
    kind = _kind(leaves)
    flat = [leaf.reshape(*leaf.shape[:leading], -1).astype(kind, copy=False) for leaf in leaves]
    return jnp.concatenate(flat, axis=-1)


def laid_out(record: Any, size: int) -> Float[AnyArray, "row column"]:
    """Put the arrays of a record side by side, as `pack` does, in a table of so many rows for a compiled call.

    For a CPU by NumPy, as what JAX does outside a program it compiles anew for every number of rows.

    Args:
        record: Arrays that share their first axis; all floating ones of one kind.
        size: How many rows the table has; those past the record's own hold anything.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(record)]
    if not xla.on_cpu():
        return pack([_sent(leaf, size) for leaf in leaves])
    table: Any = np.zeros((size, width(leaves)), _kind(leaves))
    columns = [leaf.reshape(leaf.shape[0], -1) for leaf in leaves]
    np.concatenate(columns, axis=1, out=table[: leaves[0].shape[0]], casting="unsafe")
    return table


def _kind(leaves: list[Any]) -> Any:
    """Find which floating numbers a record holds."""
    return next(leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))


def _sent(leaf: np.ndarray, size: int) -> Any:
    """Send an accelerator so many rows: one number for all where an array repeats it, as the way there is narrow."""
    if leaf.shape[0] == 1 or not any(leaf.strides):
        return jnp.broadcast_to(jnp.asarray(leaf[0]), (size, *leaf.shape[1:]))
    return jnp.asarray(np.resize(leaf, (size, *leaf.shape[1:])))


def unpack(table: Any, like: Record) -> Record:
    """Take the record out of its rows again.

    Args:
        table: What `pack` made, [row, column] or with more axes of rows; JAX's or NumPy's.
        like: The record with any one axis of rows, as arrays or as shapes.

    Returns:
        The record; a part of NumPy's table whose numbers may be written, and lie side by side, is not copied.
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
    """Count the columns of the rows of a record with one axis of rows."""
    return sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves(like))
