"""Membrane laws: the acceleration that a wall gives to a ball which has entered it by w at rate w'."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from vijax.model.pair import ImpactPair, Real
from vijax.runtime import checks
from vijax.runtime.arrays import Values


class Spring(eqx.Module):
    """-(kappa^2 w + mu w'): a linear spring and damper."""

    square: Values
    mu: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        return -(self.square * w + self.mu * z)


class Linear(eqx.Module):
    """The paper's membrane, Eq. (38): its damping is calibrated so that a free contact has restitution r, Eq. (19)."""

    def wall(self, pair: ImpactPair) -> Spring:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        return Spring(kappa * kappa, pair.mu)


class Hertz(eqx.Module):
    """-kappa^2 w^n (1 + chi w') for w > 0, else 0."""

    square: Values
    chi: Values
    exponent: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        inside = w > 0  # a stage of a step may look beyond the exit
        spring = jnp.where(inside, jnp.where(inside, w, 1.0) ** self.exponent, 0.0)
        return -self.square * spring * (1 + self.chi * z)


class HuntCrossley(eqx.Module):
    """Hunt and Crossley's membrane, w'' = -kappa^2 w^n (1 + chi w') + forcing: no restitution r is given to it.

    The loss grows with the speed, so that the restitution is a result: -v_out/v_in is near 1 - 2 chi v_in/3 for slow
    impacts, whatever n is.

    Attributes:
        chi: Damping over stiffness, in units of time over length (1/u'), >= 0.
        exponent: n >= 1; 1.5 is Hertz's contact of a sphere.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    chi: Real
    exponent: Real = 1.5

    def __check_init__(self):
        for name, least in (("chi", 0), ("exponent", 1)):
            value = getattr(self, name)
            if checks.is_concrete(value):
                must = f"one finite number of at least {least}"
                checks.real(name, value, must, lambda x, least=least: least <= x < math.inf)

    def wall(self, pair: ImpactPair) -> Hertz:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        return Hertz(kappa * kappa, jnp.asarray(self.chi, kappa.dtype), jnp.asarray(self.exponent, kappa.dtype))


Law = Linear | HuntCrossley
Wall = Callable[[Values, Values], Values]
"""A law with the numbers of a pair: (w, w') -> acceleration."""
