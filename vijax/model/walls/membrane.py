"""Membrane laws: the acceleration w'' that a wall gives to a ball at penetration w and rate z = w'.

A law is a `MembraneLaw`; `law.bind(pair)` binds it to the numbers of a pair and returns (w, z) -> acceleration. The
linear law of the paper, Eq. (38), is w'' = -(kappa^2 w + mu w') + forcing. Two walls may have laws of one class with
different numbers (`Sides`).
"""

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
from vijax.model.walls.sides import Sides, as_sides, map_walls
from vijax.runtime import tiles, validation
from vijax.runtime.arrays import Values
from vijax.runtime.doc_pages import see

# Nodes and weights of 32-point Gauss-Legendre quadrature, mapped from [-1, 1] to [0, 1].
_QUADRATURE = tuple(0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(32), (1, 0), strict=True))

Wall = Callable[[Values, Values], Values]
"""A law bound to the numbers of a pair: (w, w') -> acceleration."""


class MembraneLaw(eqx.Module):
    """Base class of membrane laws: the numbers of the law are fields, its acceleration is a method.

    ::

        class Cubic(vijax.MembraneLaw):
            beta: float

            def acceleration(self, pair, w, z):
                return -(pair.kappa**2 * (w + self.beta * w**3) + pair.mu * z)

        vijax.sweep(d=0.2, kappa=40.0, r=0.5, method="ode", membrane=Cubic(beta=500.0))

    The law must consist of functions that JAX differentiates, and must be defined slightly beyond the exit too: a stage
    of a Runge-Kutta step may evaluate it at w < 0. The contact ends when w returns to 0.

    Attributes:
        restitution: Class attribute: whether r is a number of the pair, as for the linear membrane, where r sets the
            damping `pair.mu`. If not, the restitution is a result of the law: the pair has r = None, and r is not an
            axis of a map.
        arithmetic: Class attribute: whether the law uses only arithmetic operations, so that rk4 may compile it into a
            kernel.
    """

    restitution: ClassVar[bool] = True
    arithmetic: ClassVar[bool] = False

    @property
    def in_si(self) -> bool:
        """Return whether a number has a unit or comes from the device; such a law is not valid with a pair."""
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
        """Return the law with constants of the device in place of missing numbers; unchanged if no number is missing.

        Args:
            device: The device; its walls are equal.
        """
        check_device(device)
        return self

    def in_units(self, length: Any, speed: Any) -> "MembraneLaw":
        """Return the law with its numbers in other units; itself unless the class overrides this method.

        A class with dimensional numbers overrides it, so that the law is the same membrane at every frequency and
        amplitude. Its numbers are then in SI if the law is used with a device.

        Args:
            length: The new unit of length, in old units.
            speed: The new unit of speed, in old units.
        """
        return self

    def nondimensional(self, device: Harvester) -> "MembraneLaw":
        """Convert the numbers of the law from SI to the units of the device's pair.

        Args:
            device: One device; its walls are equal.
        """
        return self.of_device(device).in_units(device.length_unit, device.speed_unit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Compute the energy stored at penetration w, per mass of the ball, in units of velocity squared.

        The default integrates the acceleration at rest by Gauss-Legendre quadrature; it is exact to rounding for a
        smooth law.

        Args:
            pair: One cell (scalars).
            w: Penetrations, in units of displacement, of any shape.
        """
        pair, w = checked_cell(pair, w)
        node, weight = (jnp.asarray(x) for x in _QUADRATURE)
        w = jnp.asarray(w)
        static_acceleration = jax.vmap(lambda x: self.acceleration(pair, x, jnp.zeros_like(x)))
        # Minus the integral of acceleration(x, 0) from 0 to w, with x = w node.
        along = w[..., None] * node
        return -w * (static_acceleration(along.ravel()).reshape(along.shape) * weight).sum(axis=-1)

    def bind(self, pair: ImpactPair) -> Wall:
        """Bind the law to the numbers of a pair."""
        # The numbers take the dtype of the pair, so that a float32 run stays in float32.
        return _BoundLaw(jax.tree.map(lambda x: jnp.asarray(x, pair.d.dtype), self), pair)

    def __str__(self) -> str:
        """Return the name of the law and its numbers, as the attributes of maps store them."""
        numbers = [f"{field.name} {_format_number(getattr(self, field.name))}" for field in dataclasses.fields(self)]
        return type(self).__name__ + (" with " + ", ".join(numbers) if numbers else "")


def checked_cell(pair: ImpactPair, w: Any = 0.0) -> tuple[ImpactPair, Any]:
    """Return a pair and penetrations; raise ValueError unless they are an `ImpactPair` and numbers."""
    validation.validate_instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")
    return pair, units.validate_quantity("displacement", w, "w")


def _format_number(value: Any) -> str:
    array = np.asarray(value)
    return f"{array.item():g}" if array.shape == () and array.dtype.kind in "iuf" else str(array.tolist())


class _BoundLaw(eqx.Module):
    """A law together with the pair that supplies its numbers."""

    law: MembraneLaw
    pair: ImpactPair

    def __call__(self, w: Values, z: Values) -> Values:
        return self.law.acceleration(self.pair, w, z)


class ShippedLaw(MembraneLaw):
    """A law of vijax; its `bind` computes the constants of a pair once instead of at every step."""

    arithmetic: ClassVar[bool] = True

    def acceleration(self, pair: ImpactPair, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        pair, w = checked_cell(pair, w)
        return self.bind(pair)(w, units.validate_quantity("velocity", z, "z"))

    @abstractmethod
    def bind(self, pair: ImpactPair) -> Wall:
        """Bind the law to the numbers of a pair."""


class Spring(eqx.Module):
    """Acceleration -(kappa^2 w + mu w') by a linear spring and damper."""

    square: Values
    mu: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        return -(self.square * w + self.mu * z)


class Linear(ShippedLaw):
    """The paper's membrane, Eq. (38): its damping gives a contact without forcing the restitution r, Eq. (19)."""

    def bind(self, pair: ImpactPair) -> Spring:
        """Bind the law to the numbers of a pair."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        return Spring(kappa * kappa, pair.mu)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Return the energy stored at penetration w, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        return 0.5 * pair._soft_kappa() ** 2 * jnp.asarray(w) ** 2

    def __str__(self) -> str:
        """Return the name that `--membrane` uses."""
        return "linear"


Laws = MembraneLaw | Sides[MembraneLaw]
"""One law for both walls, or `Sides` of two laws of one class with different numbers."""


def representative_law(law: Laws) -> MembraneLaw:
    """Return the law of both walls, or the left law; both laws have the same class, hence the same class attributes."""
    return law.left if isinstance(law, Sides) else law


def bind_laws(law: Laws, pair: ImpactPair) -> Wall | Sides:
    """Bind a law to the numbers of a pair; if the walls differ, bind one law for each wall."""
    if not (pair.has_unequal_walls or isinstance(law, Sides)):
        return law.bind(pair)
    both = as_sides(law)
    # Each law reads the kappa and mu of the same wall.
    return Sides(both.left.bind(pair.at(-1)), both.right.bind(pair.at(1)))


def describe_law(law: Laws) -> str:
    """Return a text with the name of a law and its numbers, or with both laws."""
    return f"left {law.left}, right {law.right}" if isinstance(law, Sides) else str(law)


def of_device(law: Laws, device: Harvester) -> Laws:
    """Return the laws of the walls of a device, in SI: see `MembraneLaw.of_device`."""
    if not (device.has_unequal_walls or isinstance(law, Sides)):
        return law.of_device(device)
    both = as_sides(law)
    return Sides(both.left.of_device(device.at(-1)), both.right.of_device(device.at(1)))


def in_units(law: Laws, length: Any, speed: Any) -> Laws:
    """Return the law of each wall in other units: see `MembraneLaw.in_units`."""
    return map_walls(lambda wall_law: wall_law.in_units(length, speed), law)


def nondimensional(law: Laws, device: Harvester) -> Laws:
    """Return the laws of the walls of a device in the units of its pair; their numbers are in SI."""
    return in_units(of_device(law, device), device.length_unit, device.speed_unit)


def has_units(law: Laws) -> bool:
    """Return whether numbers of a law have a dimension, so that they change with the units of a pair."""
    # A class without dimensional numbers does not override `in_units`.
    return type(representative_law(law)).in_units is not MembraneLaw.in_units


def check_pair_units(law: Laws) -> Laws:
    """Return a law for use with a pair; raise ValueError if its numbers are known to be in SI units."""
    if any(wall_law.in_si for wall_law in (as_sides(law).left, as_sides(law).right)):
        raise ValueError(
            see(
                "methods",
                f"membrane must be in the units of the pair; got {describe_law(law)} of a device; "
                "law.nondimensional(device) brings it into them",
            )
        )
    return law


# A custom law is tested at these penetrations, in the cell d, kappa, r, gamma.
_TEST_DEPTHS = np.geomspace(1e-6, 0.1, 6)
_TEST_CELL = (0.2, 40.0, 0.5, 0.0)


def with_law(pair: ImpactPair, law: Any) -> ImpactPair:
    """Return a pair with a membrane law, its numbers broadcast to all cells; None leaves the pair unchanged.

    Args:
        pair: A checked pair; r is None with a law without restitution.
        law: A law, `Sides` of two laws, or None.

    Raises:
        ValueError: If `law` is not a law, or the pair cannot have it.
    """
    law = check_pair_units(check_laws(Linear() if law is None else law))
    check_restitution(pair, law)
    if isinstance(representative_law(law), Linear):
        return pair
    if pair.rigid or pair.rigid_side:
        raise ValueError(see("methods", f"membrane must be left out with a rigid wall; got {describe_law(law)}"))
    # Each number of the law becomes an array of the shape of the cells, followed by its own shape.
    dtype, shape, array_library = jnp.result_type(float, pair.d), np.shape(pair.d), tiles.array_namespace((pair, law))
    broadcast_law = jax.tree.map(
        lambda x: array_library.broadcast_to(array_library.asarray(x, dtype), (*shape, *np.shape(x))), law
    )
    return dataclasses.replace(pair, law=broadcast_law)


def law_attributes(pair: ImpactPair) -> dict[str, str]:
    """Return the membrane of pairs that share one law, as attributes of a dataset; empty for the linear membrane."""
    if pair.law is None:
        return {}
    # All cells share one law, so that its numbers are read from the first cell.
    first: Any = jax.tree.map(lambda x: np.asarray(x)[(0,) * np.ndim(pair.d)], pair.law)
    return {"membrane": describe_law(first)}


def check_restitution(pair: ImpactPair, law: Laws) -> None:
    """Raise ValueError unless a pair has r for a law with restitution, and None for a law without."""
    # An r without effect would be silently ignored; a missing r would leave the damping undefined.
    if (pair.r is None) == representative_law(law).restitution:
        raise ValueError(
            "r must be None with a membrane that takes none, as HuntCrossley, and a number with others; "
            f"got {validation.value_text(pair.r)}"
        )


def check_laws(law: Any) -> Laws:
    """Return the law; raise ValueError unless it passes `check_law`, or is `Sides` of two such laws of one class."""
    if not isinstance(law, Sides):
        return check_law(law)
    left, right = check_law(law.left), check_law(law.right)
    # Both walls share one compiled program, which calls the methods of one class.
    if type(left) is not type(right):
        raise ValueError(
            see(
                "methods",
                f"membrane must be of one kind on both sides, with numbers of their own; got {describe_law(law)}",
            )
        )
    return law


def check_law(law: Any) -> MembraneLaw:
    """Return the law; raise ValueError unless it is a membrane law that pushes out a ball at rest.

    A custom law is evaluated at d 0.2, kappa 40, r 0.5, at w from 1e-6 to 0.1, where the acceleration must be negative,
    and at w = 0, where it must vanish.
    """
    if not isinstance(law, MembraneLaw):
        raise ValueError(
            see(
                "methods",
                "membrane must be a vijax.HuntCrossley, a vijax.Hyperelastic, a vijax.MembraneLaw of your own, "
                f"Sides of two of them, or left out for the linear one; got {validation.value_text(law)}",
            )
        )
    if isinstance(law, ShippedLaw):
        return law
    # A custom law has no known units, so its numbers must be pure.
    for number in jax.tree.leaves(law):
        validation.without_unit(f"a number of {type(law).__name__}", number)
    d, kappa, r, gamma = map(jnp.asarray, _TEST_CELL)
    nothing: Any = None
    wall = law.bind(ImpactPair(d, kappa, r if law.restitution else nothing, gamma))
    for w in (0.0, *_TEST_DEPTHS):
        push = wall(jnp.asarray(w), jnp.zeros(()))
        # Traced values are unknown and cannot be checked.
        if not validation.is_concrete(push):
            return law
        # acceleration < 0 points out of the wall; with forcing left out it must vanish at w = 0.
        good = not np.shape(push) and ((push < 0) & np.isfinite(push) if w else push == 0)
        if not good:
            must = "one finite number below 0, which pushes the ball out," if w else "0"
            got = validation.value_text(np.asarray(push).tolist())
            raise ValueError(see("methods", f"acceleration must be {must} at w = {w:.3g}, w' = 0; got {got} of {law}"))
    return law
