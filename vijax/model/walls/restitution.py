"""Calibration of the damping of a soft wall by the coefficient of restitution r, Eqs. (14)-(19).

A contact without forcing is half a cycle of w'' + mu w' + kappa^2 w = 0, until w' is -r times its initial value. With
the damping ratio D = -ln r/sqrt(pi^2 + ln^2 r) it follows that mu = 2 zeta = 2 D kappa, and the contact lasts
pi/omega1.
"""

import math

import jax.numpy as jnp
from jaxtyping import Float

from vijax.runtime.arrays import AnyArray
from vijax.runtime.public_api import public_api
from vijax.runtime.tiles import array_namespace


@public_api
def damping_ratio(r: float | Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute the damping ratio c/(2 sqrt(k m_b)) = mu/(2 kappa) of a wall with restitution r.

    -ln r/sqrt(pi^2 + ln^2 r), in [0, 1): every contact is underdamped.

    Source: Eqs. (14)-(19).
    """
    decrement = 0.0 - jnp.log(r)  # +0 at r = 1, where a bare minus leaves -0
    return decrement / jnp.sqrt(math.pi**2 + decrement * decrement)


def damped_frequency(kappa: Float[AnyArray, "..."], r: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute omega1 = sqrt(kappa^2 - zeta^2).

    The formula kappa pi/sqrt(pi^2 + ln^2 r) avoids the cancellation of the difference.
    """
    array_library = array_namespace((kappa, r))
    kappa, r = array_library.asarray(kappa), array_library.asarray(r)
    # NumPy computes concrete values, JAX computes traced values.
    return kappa * math.pi / array_library.sqrt(math.pi**2 + array_library.log(r) ** 2)


def calibrate_damping(kappa: Float[AnyArray, "..."], r: Float[AnyArray, "..."]) -> tuple[Float[AnyArray, "..."], ...]:
    """Compute zeta and omega1 with one root and one division, for compiled loops."""
    decrement = 0.0 - jnp.log(r)  # +0 at r = 1: with -0 a contact would end at its onset
    scale = kappa / jnp.sqrt(math.pi**2 + decrement * decrement)
    return decrement * scale, math.pi * scale


def restitution(ratio: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Compute r from the damping ratio, below 1; the inverse of `damping_ratio`."""
    # (1 - D)(1 + D) keeps the digits of 1 - D^2 near critical damping.
    return jnp.exp(-math.pi * ratio / jnp.sqrt((1 - ratio) * (1 + ratio)))
