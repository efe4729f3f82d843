"""The root iteration that all quick steps share: of fourth order, all but its last round in single precision."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.runtime.xla import share

Lane = Float[Array, "lane"]


def converged_step(eps: Any) -> float:
    """Largest last step, times the stiffness, after which a fourth-order iteration is off by eps."""
    return float(eps) ** 0.25


def householder(f: Lane, f1: Lane, f2: Lane, f3: Lane) -> Lane:
    """Step of the fourth-order root iteration from f and its first three derivatives; one division."""
    slope, bent = f1 * f1, f * f2
    return -f * (6 * slope - 3 * bent) / (6 * f1 * (slope - bent) + f * f * f3)


def single(tree: Any) -> Any:
    """Floating leaves in single precision.

    An iteration of fourth order needs double precision in its last trip alone: the others cost a quarter as much.
    """
    return share(jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != jnp.bool_ else x, tree))
