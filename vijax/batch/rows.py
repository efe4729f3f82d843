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

Record = TypeVar("Record")


def pack(record: Any, leading: int = 1) -> Float[Array, "... column"]:
    """Put the arrays of a record side by side, whole numbers and codes as floating point ones.

    Args:
        record: Arrays that share their first `leading` axes; all floating ones of one kind.
        leading: How many axes number the rows.
    """
    leaves = jax.tree.leaves(record)
    kind = next(leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))
    flat = [leaf.reshape(*leaf.shape[:leading], -1).astype(kind, copy=False) for leaf in map(_sent, leaves)]
    return jnp.concatenate(flat, axis=-1)


def _sent(leaf: Any) -> Any:
    """Send an accelerator one number for all rows where NumPy's array repeats it: the way there is narrow."""
    if xla.on_cpu() or not isinstance(leaf, np.ndarray) or leaf.size < 2 or any(leaf.strides):
        return leaf
    return jnp.broadcast_to(jnp.asarray(leaf.flat[0]), leaf.shape)


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
