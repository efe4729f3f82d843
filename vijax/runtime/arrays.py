"""Array types for annotations, for arrays that need not be JAX's and for frequent shapes; small helpers on arrays.

Records of cells are made by NumPy on the host (JAX would compile a program for every shape), are traced in programs,
and appear as shapes where a layout is computed. `Float[AnyArray, ...]` permits all three, `Float[Array, ...]` of
jaxtyping only JAX's arrays; the tests check both at run time.
"""

from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

if TYPE_CHECKING:
    AnyArray = jax.Array  # for mypy: otherwise every operator and method must exist for each kind
else:
    AnyArray = jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct

# A scalar number or truth value of one ball; one value per lane; any number of values.
Scalar = Float[Array, ""]
Flag = Bool[Array, ""]
Lane = Float[AnyArray, "lane"]
Mask = Bool[AnyArray, "lane"]
Values = Float[AnyArray, "..."]
Flags = Bool[AnyArray, "..."]

T = TypeVar("T")


def not_none(value: T | None) -> T:
    """Return a field that is None only in programs that do not use it, in a program that uses it.

    A static choice, which a type checker cannot follow, decides whether the field is None.
    """
    assert value is not None
    return value


def select(mask: Bool[Array, "*lane"], new: T, old: T) -> T:
    """Return `new` where the mask is True, else `old`, leaf by leaf; the mask has an axis of lanes, or none."""
    # The mask is padded with trailing axes to broadcast over the leaf's further axes.
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def round_half_up(x: Values) -> Values:
    """Return the nearest integer, with ties rounded up: kernels for a GPU have no other rounding."""
    return jnp.floor(x + 0.5)
