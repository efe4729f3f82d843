"""The coefficient of restitution: how a soft wall is calibrated so that a free contact has it, Eqs. (14)-(19).

A free contact is half a cycle of w'' + mu w' + kappa^2 w = 0, at whose end w' is -r times what it was. So, with the
damping ratio D = -ln r/sqrt(pi^2 + ln^2 r), mu = 2 zeta = 2 D kappa, and the contact lasts for pi/omega1.
"""

import math

import jax.numpy as jnp
from jaxtyping import Float

from vijax.runtime.arrays import AnyArray
from vijax.runtime.context import door
from vijax.runtime.tiles import library


@door
def damping_ratio(r: float | Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute the ratio c/(2 sqrt(k m_b)) = mu/(2 kappa) whose free contact has restitution r.

    -ln r/sqrt(pi^2 + ln^2 r), in [0, 1): every contact is underdamped.

    Source: Eqs. (14)-(19).
    """
    decrement = 0.0 - jnp.log(r)  # +0 at r = 1, where a bare minus leaves -0
    return decrement / jnp.sqrt(math.pi**2 + decrement * decrement)


def damped_frequency(kappa: Float[AnyArray, "..."], r: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute omega1 = sqrt(kappa^2 - zeta^2).

    It comes from r, as kappa pi/sqrt(pi^2 + ln^2 r): the difference would cancel.
    """
    own = library((kappa, r))
    kappa, r = own.asarray(kappa), own.asarray(r)
    return kappa * math.pi / own.sqrt(math.pi**2 + own.log(r) ** 2)


def calibrated(kappa: Float[AnyArray, "..."], r: Float[AnyArray, "..."]) -> tuple[Float[AnyArray, "..."], ...]:
    """Compute zeta and omega1 together, for compiled loops: one root, one division."""
    decrement = 0.0 - jnp.log(r)  # +0 at r = 1: a free half cycle that begins at -0 would be over at once
    scale = kappa / jnp.sqrt(math.pi**2 + decrement * decrement)
    return decrement * scale, math.pi * scale


def restitution(ratio: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute r from the damping ratio; the inverse of `damping_ratio` below 1."""
    return jnp.exp(-math.pi * ratio / jnp.sqrt((1 - ratio) * (1 + ratio)))
