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
from vijax.runtime import checks, tiles
from vijax.runtime.arrays import Values
from vijax.runtime.pages import see

# Nodes and weights of Gauss and Legendre between 0 and 1.
_QUADRATURE = tuple(0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(32), (1, 0), strict=True))

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

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball, in units of velocity squared.

        By quadrature of the acceleration at rest, to rounding where that is smooth, unless the law knows better.

        Args:
            pair: One cell (scalars).
            w: Penetrations, in units of displacement, of any shape.
        """
        share, weight = (jnp.asarray(x) for x in _QUADRATURE)
        w = jnp.asarray(w)
        push = jax.vmap(lambda x: self.acceleration(pair, x, jnp.zeros_like(x)))
        along = w[..., None] * share
        return -w * (push(along.ravel()).reshape(along.shape) * weight).sum(axis=-1)

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

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball."""
        return 0.5 * pair._soft_kappa() ** 2 * jnp.asarray(w) ** 2

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

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w >= 0, per mass of the ball."""
        return pair._soft_kappa() ** 2 * jnp.asarray(w) ** (self.exponent + 1) / (self.exponent + 1)

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        return f"hunt-crossley with chi {float(self.chi):g}, exponent {float(self.exponent):g}"


_STRAIGHT = 1e-9  # the least part of their limit that is left to chains: beyond, the push is held there


class Cone(eqx.Module):
    """The wall of a `Hyperelastic` membrane, a cone: -(kappa^2 w f(w) + mu w'), where f(0) = 1.

    Attributes:
        square, mu: Of the pair.
        radius: Of the membrane.
        rest: What is left at prestretch of how far the chains stretch, as a part of that.
        slack: prestretch^-6, the part of the tension that thinning takes at w = 0.
        spread: How much faster than (w/radius)^2 the chains are stretched, as a part of how far they do.
    """

    square: Values
    mu: Values
    radius: Values
    rest: Values
    slack: Values
    spread: Values

    def _stretched(self, w: Values) -> tuple[Values, Values]:
        """Compute (w/radius)^2, and how far the chains are stretched beyond prestretch, as a part of what is left."""
        more = (w / self.radius) ** 2
        return more, self.spread * more * (1 - self.slack / (1 + more)) / self.rest

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        more, used = self._stretched(w)
        tension = (1 - self.slack / (1 + more) ** 2) / (1 - self.slack)
        # Beyond the limit nothing goes: a stage of a step that looks there is thrown back.
        return -(self.square * w * tension / jnp.maximum(1 - used, _STRAIGHT) + self.mu * z)

    def energy(self, w: Values) -> Values:
        """Compute the stored energy, per mass of the ball."""
        more, used = self._stretched(w)
        some = used > 0
        part = jnp.where(some, used, 0.5)
        # -log(1 - x)/x, which is 1 without a limit.
        growth = jnp.where(some, -jnp.log1p(-part) / part, 1.0)
        linear = more * (1 - self.slack / (1 + more)) / (1 - self.slack)
        return 0.5 * self.square * self.radius**2 * linear * growth


class Hyperelastic(_Shipped):
    """A stretched circular membrane of rubber, which the ball makes a cone of; a spring at small w, stiffer at large.

    Its points move along the capsule alone, so that the hoops keep their prestretch L and the stretch along the cone is
    L sqrt(1 + (w/radius)^2); the volume stays. The force is the derivative of the elastic energy. With that of Mooney
    and Rivlin (Treloar, The Physics of Rubber Elasticity, 1975), of any ratio of its two constants,

        w'' = -kappa^2 w (1 - L^-6 (1 + (w/radius)^2)^-2) / (1 - L^-6) - mu w' + forcing,

    and with that of Gent (Rubber Chem. Technol. 69, 1996, 59-61) more, as its chains come to their limit:
    J = L^2 (1 + (w/radius)^2) + L^2 + L^-4/(1 + (w/radius)^2) - 3 stays below `stretch_limit`.

    kappa is the frequency at small w, and r the restitution of a free contact there. The ball is taken for a point.

    Attributes:
        prestretch: L > 1, of both directions, without the ball.
        radius: Of the membrane, > 0, in units of displacement.
        stretch_limit: Gent's J_m, > J at w = 0; inf for Mooney and Rivlin.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    prestretch: Real
    radius: Real
    stretch_limit: Real = math.inf

    def __check_init__(self):
        for name, least in (("prestretch", 1), ("radius", 0)):
            value = getattr(self, name)
            if checks.is_concrete(value):
                must = f"one finite number above {least}"
                checks.real(name, value, must, lambda x, least=least: least < x < math.inf)
        if checks.is_concrete((self.prestretch, self.stretch_limit)):
            least = 2 * float(self.prestretch) ** 2 + float(self.prestretch) ** -4 - 3
            must = f"one number above {least:.4g}, which this prestretch takes"
            checks.real("stretch_limit", self.stretch_limit, must, lambda x: x > least)

    def wall(self, pair: ImpactPair) -> Cone:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        square, radius, limit = (
            jnp.asarray(x, kappa.dtype) for x in (self.prestretch**2, self.radius, self.stretch_limit)
        )
        slack = square**-3
        rest = 1 - (2 * square + 1 / (square * square) - 3) / limit
        return Cone(kappa * kappa, pair.mu, radius, rest, slack, square / limit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball."""
        return self.wall(pair).energy(jnp.asarray(w))

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        limit = f", stretch_limit {float(self.stretch_limit):g}" if self.stretch_limit != math.inf else ""
        return f"hyperelastic with prestretch {float(self.prestretch):g}, radius {float(self.radius):g}{limit}"


_INSIDE = np.geomspace(1e-6, 0.1, 6)
_NOMINAL = (0.2, 40.0, 0.5, 0.0)


def with_law(pair: ImpactPair, law: Any) -> ImpactPair:
    """Give a pair its membrane, whose numbers become those of every cell; None leaves the pair as it is.

    Args:
        pair: A checked pair; r is None with a membrane that takes none.
        law: A membrane, or None.

    Raises:
        ValueError: No membrane, or one that the pair cannot have.
    """
    law = check_law(Linear() if law is None else law)
    check_restitution(pair, law)
    if isinstance(law, Linear):
        return pair
    if pair.rigid or pair.hard_wall:
        raise ValueError(see("methods", f"membrane must be left out with a rigid wall; got {law}"))
    dtype, shape, own = jnp.result_type(float, pair.d), np.shape(pair.d), tiles.library((pair, law))
    wide = jax.tree.map(lambda x: own.broadcast_to(own.asarray(x, dtype), (*shape, *np.shape(x))), law)
    return dataclasses.replace(pair, law=wide)


def told(pair: ImpactPair) -> dict[str, str]:
    """Name the membrane of some pairs for attributes, one for all; nothing of the linear one."""
    if pair.law is None:
        return {}
    return {"membrane": str(jax.tree.map(lambda x: np.asarray(x)[(0,) * np.ndim(pair.d)], pair.law))}


def check_restitution(pair: ImpactPair, law: MembraneLaw) -> None:
    """Raise ValueError unless a pair has r where its membrane takes one, and None where it takes none."""
    if (pair.r is None) == law.restitution:
        raise ValueError(
            "r must be None with a membrane that takes none, as HuntCrossley, and a number with others; "
            f"got {checks.shown(pair.r)}"
        )


def check_law(law: Any) -> MembraneLaw:
    """Raise ValueError unless it is a membrane that pushes out a ball which rests in it.

    Asked of d 0.2, kappa 40, r 0.5, at w from 1e-6 to 0.1; where the ball but touches, at w = 0, there is no push.
    """
    if not isinstance(law, MembraneLaw):
        raise ValueError(
            see(
                "methods",
                "membrane must be a vijax.HuntCrossley, a vijax.Hyperelastic, a vijax.MembraneLaw of your own, or left "
                f"out for the linear one; got {checks.shown(law)}",
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
