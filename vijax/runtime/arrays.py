"""What annotations call arrays: where one need not be JAX's, and the shapes that occur everywhere.

Records of cells are made by NumPy on the host, as JAX would compile a program for every shape, are traced in programs,
and stand for their own shapes where a layout is asked for. `Float[AnyArray, ...]` says so, `Float[Array, ...]` of
jaxtyping that nothing but JAX comes there; both are checked when tests run.
"""

from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

if TYPE_CHECKING:
    AnyArray = jax.Array  # else mypy asks of every operator and method what it does to each kind
else:
    AnyArray = jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct

# One number or truth of one ball; one a lane; any number of them.
Scalar = Float[Array, ""]
Flag = Bool[Array, ""]
Lane = Float[AnyArray, "lane"]
Mask = Bool[AnyArray, "lane"]
Values = Float[AnyArray, "..."]
Flags = Bool[AnyArray, "..."]

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return a field that is None in programs that do not need it, where a program is made that does.

    Which one it is, is a static choice made elsewhere, which a type checker cannot follow.
    """
    assert value is not None
    return value


def choose(mask: Bool[Array, "*lane"], new: T, old: T) -> T:
    """Take `new` where the mask is true, else `old`, leaf by leaf and lane by lane; there may be one ball alone."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def nearest(x: Values) -> Values:
    """Find the nearest whole number, the one above where two are as near: kernels for a GPU know no other rounding."""
    return jnp.floor(x + 0.5)
