"""Membrane laws: the acceleration that a wall gives to a ball which has entered it by w at rate w'."""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vijax.model.pair import ImpactPair, Real
from vijax.model.sides import Sides
from vijax.runtime import checks
from vijax.runtime.arrays import Values
from vijax.runtime.pages import see

Wall = Callable[[Values, Values], Values]
"""A law with the numbers of a pair: (w, w') -> acceleration."""


class MembraneLaw(eqx.Module):
    """A membrane's law, to be subclassed: its numbers are fields, its acceleration is a method.

    ::

        class Cubic(vijax.MembraneLaw):
            beta: float

            def acceleration(self, pair, w, z):
                return -(pair.kappa**2 * (w + self.beta * w**3) + pair.mu * z)

        vijax.sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Cubic(beta=500.0))

    The law must be defined, by functions that JAX differentiates, a little beyond the exit too: a stage of a step may
    look at w < 0. The contact ends when w is back at 0.

    Attributes:
        restitution: Of the class: whether r is a number of the pair, as for the linear membrane, whose damping
            `pair.mu` makes a free contact of it. If not, r comes out of the law: a pair has None, a map no axis of it.
        arithmetic: Of the class: whether the law calls nothing but arithmetic, so that rk4 may put it into a kernel.
    """

    restitution: ClassVar[bool] = True
    arithmetic: ClassVar[bool] = False

    @abstractmethod
    def acceleration(self, pair: ImpactPair, w: Any, z: Any) -> Any:
        """Compute the acceleration that the wall gives to the ball, positive into the wall.

        Args:
            pair: One cell (scalars).
            w: Penetration, in units of displacement.
            z: Its rate.
        """

    def wall(self, pair: ImpactPair) -> Wall:
        """Give the law the numbers of a pair."""
        return _Bound(jax.tree.map(lambda x: jnp.asarray(x, pair.d.dtype), self), pair)

    def walls(self, pair: ImpactPair) -> "Wall | Sides":
        """Give the law the numbers of a pair; for each wall where they differ."""
        return Sides(self.wall(pair.at(-1)), self.wall(pair.at(1))) if pair.unequal else self.wall(pair)

    def __str__(self) -> str:
        """Name the law and its numbers, as maps do in their attributes."""
        told = [f"{field.name} {_shown(getattr(self, field.name))}" for field in dataclasses.fields(self)]
        return type(self).__name__ + (" with " + ", ".join(told) if told else "")


def _shown(value: Any) -> str:
    array = np.asarray(value)
    return f"{array.item():g}" if array.shape == () and array.dtype.kind in "iuf" else str(array.tolist())


class _Bound(eqx.Module):
    """A law and the pair whose numbers it takes."""

    law: MembraneLaw
    pair: ImpactPair

    def __call__(self, w: Values, z: Values) -> Values:
        return self.law.acceleration(self.pair, w, z)


class _Shipped(MembraneLaw):
    """A law that vijax has: its `wall` computes once for a pair what need not be computed at every step."""

    arithmetic: ClassVar[bool] = True

    def acceleration(self, pair: ImpactPair, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        return self.wall(pair)(w, z)

    @abstractmethod
    def wall(self, pair: ImpactPair) -> Wall:
        """Give the law the numbers of a pair."""


class Spring(eqx.Module):
    """-(kappa^2 w + mu w'): a linear spring and damper."""

    square: Values
    mu: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        return -(self.square * w + self.mu * z)


class Linear(_Shipped):
    """The paper's membrane, Eq. (38): its damping is calibrated so that a free contact has restitution r, Eq. (19)."""

    def wall(self, pair: ImpactPair) -> Spring:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        return Spring(kappa * kappa, pair.mu)

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        return "linear"


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


class HuntCrossley(_Shipped):
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
    restitution: ClassVar[bool] = False

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

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        return f"hunt-crossley with chi {float(self.chi):g}, exponent {float(self.exponent):g}"


_INSIDE = np.geomspace(1e-6, 0.1, 6)
_NOMINAL = (0.2, 40.0, 0.5, 0.0)


def check_law(law: Any) -> MembraneLaw:
    """Raise ValueError unless it is a membrane that pushes out a ball which rests in it.

    Asked of d 0.2, kappa 40, r 0.5, at w from 1e-6 to 0.1; where the ball but touches, at w = 0, there is no push.
    """
    if not isinstance(law, MembraneLaw):
        raise ValueError(
            see(
                "methods",
                "membrane must be a vijax.HuntCrossley, or a vijax.MembraneLaw of your own, or left out for the linear "
                f"one; got {checks.shown(law)}",
            )
        )
    if isinstance(law, _Shipped):
        return law
    d, kappa, r, gamma = map(jnp.asarray, _NOMINAL)
    nothing: Any = None
    wall = law.wall(ImpactPair(d, kappa, r if law.restitution else nothing, gamma))
    for w in (0.0, *_INSIDE):
        push = wall(jnp.asarray(w), jnp.zeros(()))
        if not checks.is_concrete(push):
            return law
        good = not np.shape(push) and ((push < 0) & np.isfinite(push) if w else push == 0)
        if not good:
            must = "one finite number below 0, which pushes the ball out," if w else "0"
            got = checks.shown(np.asarray(push).tolist())
            raise ValueError(see("methods", f"acceleration must be {must} at w = {w:.3g}, w' = 0; got {got} of {law}"))
    return law
