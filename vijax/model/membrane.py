"""Membrane laws: the acceleration that a wall gives to a ball which has entered it by w at rate w'."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.pair import ImpactPair
from vijax.model.sides import Sides, apart, each
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

    @property
    def in_si(self) -> bool:
        """Return whether a number of it was given with a unit, or is the device's: a pair cannot have it then."""
        return False

    @abstractmethod
    def acceleration(self, pair: ImpactPair, w: Any, z: Any) -> Any:
        """Compute the acceleration that the wall gives to the ball, positive into the wall.

        Args:
            pair: One cell (scalars).
            w: Penetration, in units of displacement.
            z: Its rate.
        """

    def of_device(self, device: Harvester) -> "MembraneLaw":
        """Return the law of a device, with constants of the device for numbers that were not given; itself unless so.

        Args:
            device: The device; its walls are equal.
        """
        check_device(device)
        return self

    def in_units(self, length: Any, speed: Any) -> "MembraneLaw":
        """Return the law with its numbers in other units; itself unless the law says which have a dimension.

        A law overrides it to be the same membrane at every frequency and amplitude: its numbers are in SI then, where
        it is given with a device.

        Args:
            length: The new unit of length, in old ones.
            speed: The new unit of speed, in old ones.
        """
        return self

    def nondimensional(self, device: Harvester) -> "MembraneLaw":
        """Return the law with its numbers in the units of the device's pair; they are in SI.

        Args:
            device: One device; its walls are equal.
        """
        return self.of_device(device).in_units(device.length_unit, device.speed_unit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball, in units of velocity squared.

        By quadrature of the acceleration at rest, to rounding where that is smooth, unless the law knows better.

        Args:
            pair: One cell (scalars).
            w: Penetrations, in units of displacement, of any shape.
        """
        pair, w = checked_cell(pair, w)
        share, weight = (jnp.asarray(x) for x in _QUADRATURE)
        w = jnp.asarray(w)
        push = jax.vmap(lambda x: self.acceleration(pair, x, jnp.zeros_like(x)))
        along = w[..., None] * share
        return -w * (push(along.ravel()).reshape(along.shape) * weight).sum(axis=-1)

    def wall(self, pair: ImpactPair) -> Wall:
        """Give the law the numbers of a pair."""
        return _Bound(jax.tree.map(lambda x: jnp.asarray(x, pair.d.dtype), self), pair)

    def __str__(self) -> str:
        """Name the law and its numbers, as maps do in their attributes."""
        told = [f"{field.name} {_shown(getattr(self, field.name))}" for field in dataclasses.fields(self)]
        return type(self).__name__ + (" with " + ", ".join(told) if told else "")


def checked_cell(pair: ImpactPair, w: Any = 0.0) -> tuple[ImpactPair, Any]:
    """Return a pair and penetrations; raise ValueError unless it is a pair and they are numbers."""
    checks.instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")
    return pair, units.given("displacement", w, "w")


def _shown(value: Any) -> str:
    array = np.asarray(value)
    return f"{array.item():g}" if array.shape == () and array.dtype.kind in "iuf" else str(array.tolist())


class _Bound(eqx.Module):
    """A law and the pair whose numbers it takes."""

    law: MembraneLaw
    pair: ImpactPair

    def __call__(self, w: Values, z: Values) -> Values:
        return self.law.acceleration(self.pair, w, z)


class ShippedLaw(MembraneLaw):
    """A law that vijax has: its `wall` computes once for a pair what need not be computed at every step."""

    arithmetic: ClassVar[bool] = True

    def acceleration(self, pair: ImpactPair, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        pair, w = checked_cell(pair, w)
        return self.wall(pair)(w, units.given("velocity", z, "z"))

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


class Linear(ShippedLaw):
    """The paper's membrane, Eq. (38): its damping is calibrated so that a free contact has restitution r, Eq. (19)."""

    def wall(self, pair: ImpactPair) -> Spring:
        """Give the law the numbers of a pair."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        return Spring(kappa * kappa, pair.mu)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Return the energy stored at penetration w, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        return 0.5 * pair._soft_kappa() ** 2 * jnp.asarray(w) ** 2

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        return "linear"


Laws = MembraneLaw | Sides[MembraneLaw]
"""The law of both walls, or that of either: of one kind, with numbers of their own."""


def one_of(law: Laws) -> MembraneLaw:
    """Give the law of both walls, or that of the left one: what the class says is the same of both."""
    return law.left if isinstance(law, Sides) else law


def walls(law: Laws, pair: ImpactPair) -> Wall | Sides:
    """Give a law the numbers of a pair; for each wall where the walls differ."""
    if not (pair.unequal or isinstance(law, Sides)):
        return law.wall(pair)
    both = apart(law)
    return Sides(both.left.wall(pair.at(-1)), both.right.wall(pair.at(1)))


def said(law: Laws) -> str:
    """Name a law and its numbers, or those of both walls."""
    return f"left {law.left}, right {law.right}" if isinstance(law, Sides) else str(law)


def of_device(law: Laws, device: Harvester) -> Laws:
    """Return the laws of the walls of a device, in SI: see `MembraneLaw.of_device`."""
    if not (device.unequal or isinstance(law, Sides)):
        return law.of_device(device)
    both = apart(law)
    return Sides(both.left.of_device(device.at(-1)), both.right.of_device(device.at(1)))


def in_units(law: Laws, length: Any, speed: Any) -> Laws:
    """Return a law, or that of either wall, in other units: see `MembraneLaw.in_units`."""
    return each(lambda one: one.in_units(length, speed), law)


def nondimensional(law: Laws, device: Harvester) -> Laws:
    """Return the laws of the walls of a device in the units of its pair; their numbers are in SI."""
    return in_units(of_device(law, device), device.length_unit, device.speed_unit)


def has_units(law: Laws) -> bool:
    """Return whether numbers of a law have a dimension, so that they change with the units of a pair."""
    return type(one_of(law)).in_units is not MembraneLaw.in_units


def of_pair(law: Laws) -> Laws:
    """Return a law that is given with a pair; raise ValueError if it is surely in SI units."""
    if any(one.in_si for one in (apart(law).left, apart(law).right)):
        raise ValueError(
            see(
                "methods",
                f"membrane must be in the units of the pair; got {said(law)} of a device; "
                "law.nondimensional(device) brings it into them",
            )
        )
    return law


_INSIDE = np.geomspace(1e-6, 0.1, 6)
_NOMINAL = (0.2, 40.0, 0.5, 0.0)


def with_law(pair: ImpactPair, law: Any) -> ImpactPair:
    """Give a pair its membrane, whose numbers become those of every cell; None leaves the pair as it is.

    Args:
        pair: A checked pair; r is None with a membrane that takes none.
        law: A membrane, that of either wall as `Sides`, or None.

    Raises:
        ValueError: No membrane, or one that the pair cannot have.
    """
    law = of_pair(check_laws(Linear() if law is None else law))
    check_restitution(pair, law)
    if isinstance(one_of(law), Linear):
        return pair
    if pair.rigid or pair.hard_wall:
        raise ValueError(see("methods", f"membrane must be left out with a rigid wall; got {said(law)}"))
    dtype, shape, own = jnp.result_type(float, pair.d), np.shape(pair.d), tiles.library((pair, law))
    wide = jax.tree.map(lambda x: own.broadcast_to(own.asarray(x, dtype), (*shape, *np.shape(x))), law)
    return dataclasses.replace(pair, law=wide)


def told(pair: ImpactPair) -> dict[str, str]:
    """Name the membrane of some pairs for attributes, one for all; nothing of the linear one."""
    if pair.law is None:
        return {}
    first: Any = jax.tree.map(lambda x: np.asarray(x)[(0,) * np.ndim(pair.d)], pair.law)
    return {"membrane": said(first)}


def check_restitution(pair: ImpactPair, law: Laws) -> None:
    """Raise ValueError unless a pair has r where its membrane takes one, and None where it takes none."""
    if (pair.r is None) == one_of(law).restitution:
        raise ValueError(
            "r must be None with a membrane that takes none, as HuntCrossley, and a number with others; "
            f"got {checks.shown(pair.r)}"
        )


def check_laws(law: Any) -> Laws:
    """Raise ValueError unless it is a membrane as `check_law` asks for, or `Sides` of two of one kind."""
    if not isinstance(law, Sides):
        return check_law(law)
    left, right = check_law(law.left), check_law(law.right)
    if type(left) is not type(right):
        raise ValueError(
            see(
                "methods",
                f"membrane must be of one kind on both sides, with numbers of their own; got {said(law)}",
            )
        )
    return law


def check_law(law: Any) -> MembraneLaw:
    """Raise ValueError unless it is a membrane that pushes out a ball which rests in it.

    Asked of d 0.2, kappa 40, r 0.5, at w from 1e-6 to 0.1; where the ball but touches, at w = 0, there is no push.
    """
    if not isinstance(law, MembraneLaw):
        raise ValueError(
            see(
                "methods",
                "membrane must be a vijax.HuntCrossley, a vijax.Hyperelastic, a vijax.MembraneLaw of your own, "
                f"Sides of two of them, or left out for the linear one; got {checks.shown(law)}",
            )
        )
    if isinstance(law, ShippedLaw):
        return law
    for number in jax.tree.leaves(law):
        checks.pure(f"a number of {type(law).__name__}", number)
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
