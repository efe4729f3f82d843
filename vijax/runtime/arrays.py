"""What annotations call an array where it need not be JAX's.

Records of cells are made by NumPy on the host, as JAX would compile a program for every shape, are traced in programs,
and stand for their own shapes where a layout is asked for. `Float[AnyArray, ...]` says so, `Float[Array, ...]` of
jaxtyping that nothing but JAX comes there; both are checked when tests run.
"""

from typing import TYPE_CHECKING

import jax
import numpy as np

if TYPE_CHECKING:
    AnyArray = jax.Array  # else mypy asks of every operator and method what it does to each kind
else:
    AnyArray = jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct
