"""The vibro-impact pair in nondimensional form, Eqs. (37)-(38), and the checks of its arguments.

    flight   |u| <  d/2 :  u'' = -gamma + cos(pi t)
    contact  |u| >= d/2 :  w'' + mu w' + kappa^2 w = side (-gamma + cos(pi t)),   w = side u - d/2
    rigid wall          :  u' -> -r u'  at |u| = d/2

side is -1 for the left wall and +1 for the right wall. mu follows from kappa and r, see `restitution`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from operator import and_
from typing import Any, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vijax.model import units
from vijax.model.choices import Walls
from vijax.model.quantities import SIDES, check, without_wall
from vijax.model.units import QuantityLike
from vijax.model.walls.restitution import damped_frequency, damping_ratio
from vijax.model.walls.sides import Sides, as_sides, at_wall, map_walls, values_by_name
from vijax.runtime import validation
from vijax.runtime.arrays import AnyArray, select
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api
from vijax.runtime.record_text import PrintedRecord
from vijax.runtime.validation import is_concrete

Real = float | Float[AnyArray, "..."]
T = TypeVar("T")


class ImpactPair(PrintedRecord):
    """Nondimensional impact pair, Eqs. (37)-(38); every field is a scalar or an array of one common shape.

    Fields are not checked, so that the record can be traced; `impact_pair` makes a checked pair.

    Attributes:
        d: Free travel of the ball between the walls in units of A pi^2/omega^2, > 0; the ball is a point at u.
        kappa: Natural frequency of the soft walls, omega0 pi/omega > 0; None for rigid walls.
        r: Coefficient of restitution of a contact without forcing, in (0, 1].
        gamma: Gravity along the axis divided by the forcing amplitude, g sin(beta)/A.
        law: Membrane law, a `MembraneLaw`; None for the linear law. Only functions of periodic orbits accept a law
            here; all others require None, and receive a law as an argument of their own.
        waves: Harmonics of the excitation, `vijax.model.forcing.waves.Waves`; None for the sine. Only functions of
            periodic orbits accept harmonics here; all others require None, and receive an excitation as an argument of
            their own.

    If the walls differ in kappa, r or law, these fields are `Sides` with one value per wall; kappa of a rigid wall next
    to a soft wall is None. A rigid wall has no membrane: its impacts have depth 0 and harvest nothing.
    """

    d: Float[AnyArray, "..."]
    # Annotated with the types that they have after `at`, which is the form that functions of one wall read.
    kappa: Float[AnyArray, "..."] | None
    r: Float[AnyArray, "..."]
    gamma: Float[AnyArray, "..."]
    law: eqx.Module | None = eqx.field(default=None, kw_only=True)
    waves: tuple[Any, ...] | None = eqx.field(default=None, kw_only=True)

    def __post_init__(self):
        # Both kappa and r become `Sides`, or neither, so that programs are compiled for two tree structures, not four.
        if self.kappa is not None and self.r is not None and self.has_unequal_walls:
            self.kappa, self.r = as_sides(self.kappa), as_sides(self.r)

    @property
    def has_unequal_walls(self) -> bool:
        """Return whether the two walls may differ; a static property of the tree structure, as `rigid` is."""
        return any(isinstance(field, Sides) for field in (self.kappa, self.r, self.law))

    @property
    def symmetric(self) -> Any:
        """Return True for cells where the mirror image of every motion is a motion, that is, gamma = 0 and equal walls.

        The excitation must also change sign after half a period, so that all its harmonics are odd.
        """
        differ = self.rigid_side or isinstance(self.law, Sides) or any(wave.order % 2 == 0 for wave in self.waves or ())
        # `& False` keeps the shape of the cells.
        return (self.gamma == 0) & False if differ else has_mirror_symmetry(pair_quantities(self))

    def with_sides(self) -> "ImpactPair":
        """Return the pair with kappa and r as `Sides`."""
        # Two rigid walls keep kappa None, because they can differ in r only.
        kappa: Any = None if self.rigid else as_sides(self.kappa)
        r: Any = as_sides(self.r)
        return replace(self, kappa=kappa, r=r)

    def at(self, side: Any) -> "ImpactPair":
        """Return the pair with the wall of one side, +1 right or -1 left, at both sides; itself for equal walls."""
        if not self.has_unequal_walls:
            return self
        kappa: Any = self.kappa
        if self.rigid_side:
            # The kappa of the soft wall replaces the None of the rigid wall, which the rigid formula does not read; see
            # `by_wall_kind`.
            kappa = kappa.left if self.rigid_side > 0 else kappa.right
        return replace(self, kappa=at_wall(kappa, side), r=at_wall(self.r, side), law=self._law_at(side))

    def _law_at(self, side: Any) -> Any:
        """Return the law of the wall on a side; its numbers may have dimensions beyond the shape of the cells."""
        law: Any = self.law
        if not isinstance(law, Sides):
            return law

        def of_wall(left: Any, right: Any) -> Any:
            # Append axes to `side`, so that it broadcasts against the extra dimensions of the number.
            extra = np.ndim(left) - np.ndim(self.d)
            return jnp.where(jnp.reshape(side, np.shape(side) + (1,) * extra) > 0, right, left)

        return jax.tree.map(of_wall, law.left, law.right)

    @property
    def rigid_side(self) -> int:
        """Return the side of the rigid wall next to a soft wall, -1 left or 1 right; 0 if both are of one kind."""
        kappa: Any = self.kappa
        # kappa None marks the rigid wall.
        return int(kappa.right is None) - int(kappa.left is None) if isinstance(kappa, Sides) else 0

    @property
    def walls(self) -> Walls:
        """Return the kind of the walls, the `wall` argument of `Harvester.pair`."""
        if self.rigid_side:
            return "rigid_left" if self.rigid_side < 0 else "rigid_right"
        return "rigid" if self.rigid else "soft"

    def is_rigid_at(self, side: Any) -> Any:
        """Return whether the wall on a side is rigid: elementwise if only one wall is rigid, else one value for all."""
        return side * self.rigid_side > 0 if self.rigid_side else np.bool_(self.rigid)

    def by_wall_kind(self, side: Any, rigid: Callable[["ImpactPair"], T], soft: Callable[["ImpactPair"], T]) -> T:
        """Compute a result at the wall on a side, by `rigid` for rigid walls or by `soft` for soft walls.

        Both functions receive the pair of that wall (`at`). If only one wall is rigid, both functions are computed, and
        every element selects the result of its wall.
        """
        wall_pair = self.at(side)
        if not self.rigid_side:
            return (rigid if self.rigid else soft)(wall_pair)
        # The kinds of the walls are static, but the side of each element is not. Therefore both formulas are evaluated.
        return select(self.is_rigid_at(side), rigid(wall_pair), soft(wall_pair))

    @property
    def rigid(self) -> bool:
        """Return whether both walls are rigid; a static property, so compiled programs contain no branch for it."""
        return self.kappa is None

    @property
    @public_api
    def mu(self) -> Float[AnyArray, "..."]:
        """Compute the damping of w'' + mu w' + kappa^2 w = f, as `restitution` calibrates it."""
        return map_walls(lambda zeta: 2 * zeta, self.zeta)

    @property
    @public_api
    def zeta(self) -> Float[AnyArray, "..."]:
        """Compute the decay rate mu/2 of a contact without forcing."""
        return map_walls(lambda kappa, r: kappa * damping_ratio(r), self._soft_kappa(), self.r)

    @property
    @public_api
    def omega1(self) -> Float[AnyArray, "..."]:
        """Compute the damped frequency sqrt(kappa^2 - zeta^2)."""
        return map_walls(damped_frequency, self._soft_kappa(), self.r)

    def _soft_kappa(self) -> Any:
        if self.kappa is None or self.rigid_side:
            raise ValueError("kappa must be a number for a membrane's damping and frequency; got None (a rigid wall)")
        return self.kappa


WALLS: tuple[Walls, ...] = get_args(Walls)
ONE_RIGID_WALL = tuple(wall for wall in WALLS if wall.startswith("rigid_"))
"""Kinds of walls with exactly one rigid wall."""


def check_pair(pair: Any, *, of_orbit: bool = False) -> ImpactPair:
    """Return the pair if its fields are valid; traced values are not checked.

    Args:
        pair: The argument to check.
        of_orbit: Whether a nonlinear membrane and an excitation other than the sine are allowed, as in an orbit.

    Raises:
        ValueError: If `pair` is not an `ImpactPair`, a field is out of its range, or fields do not broadcast.
    """
    members = dict(vars(validation.validate_instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")))
    law, waves = members.pop("law"), members.pop("waves")
    if law is not None and not of_orbit:
        raise ValueError(see("methods", f"pair must have linear membranes here; got {type(law).__name__}"))
    if waves is not None and not of_orbit:
        raise ValueError(see("excitation", "pair must know of no harmonics here; got some; give them as excitation="))
    fields: dict[str, Any] = {}
    for name, value in members.items():
        for argument, number in values_by_name(name, value).items():
            if number is not None or argument not in _MAY_BE_NONE:
                check(name, number, argument)
                fields[argument] = number
    # Raises ValueError if the fields do not broadcast.
    validation.broadcast_shape(**fields)
    return pair


def check_single_cell(pair: Any, remedy: str, *, most: int = 0, of_orbit: bool = False) -> ImpactPair:
    """Return the pair if it is valid and has at most `most` dimensions; traced values are checked for their shape.

    Args:
        pair: The argument to check.
        remedy: Advice of the error for several cells.
        most: Largest number of dimensions of its fields: 0 for one cell, 1 for one cell per state.
        of_orbit: See `check_pair`.

    Raises:
        ValueError: "pair must be one cell; got d of shape (2, 2); search each".
    """
    for name, value in pair_quantities(check_pair(pair, of_orbit=of_orbit)).items():
        if np.ndim(value) > most:
            must = "one cell" if most == 0 else "one cell, or one a state"
            raise ValueError(f"pair must be {must}; got {name} of shape {np.shape(value)}; {remedy}")
    return pair


def check_start(pair: ImpactPair, name: str, u: Any) -> None:
    """Raise ValueError if a start lies inside a rigid wall.

    A start inside a soft wall is valid, and traced values are not checked.
    """
    if not (pair.rigid or pair.rigid_side) or not is_concrete(pair.d, u):
        return
    u, half = np.broadcast_arrays(np.asarray(u), 0.5 * np.asarray(pair.d))
    # A rigid wall cannot be penetrated; a start inside a soft wall begins in contact.
    good = (np.abs(u) <= half) | ~pair.is_rigid_at(u)
    if not good.all():
        raise ValueError(
            f"{name} must lie within the gap of a rigid wall, |{name}| <= d/2; "
            f"got {name} = {validation.first_invalid(u, good)} "
            f"at d = {2 * half[~good].flat[0]:g}"
        )


# kappa is None for a rigid wall; r is None with a membrane law that has no restitution.
_MAY_BE_NONE = "kappa", "kappa_left", "kappa_right", "r"


@public_api
def impact_pair(
    d: QuantityLike,
    kappa: QuantityLike | Sides[QuantityLike | None] | None,
    r: QuantityLike | Sides[QuantityLike] | None,
    gamma: QuantityLike = 0.0,
) -> ImpactPair:
    """Make a checked `ImpactPair`, its fields broadcast to one shape.

    Args:
        d: Free travel of the ball between the walls, > 0, any shape.
        kappa: Natural frequency of the soft walls, > 0 and finite; None for rigid walls.
        r: Coefficient of restitution, in (0, 1]; None with a membrane law that has no restitution, such as
            `HuntCrossley`.
        gamma: Gravity along the axis divided by the forcing amplitude, finite.

    kappa and r may be `Sides(left, right)` for walls that differ; `Sides(25.0, None)` has a rigid wall on the right.

    Raises:
        ValueError: If a value is out of its range, or shapes do not broadcast (traced values are not checked).
    """
    arguments = {"d": d, **values_by_name("kappa", kappa), **values_by_name("r", r), "gamma": gamma}
    arguments = {name: value for name, value in arguments.items() if value is not None or name not in _MAY_BE_NONE}
    arguments = {name: units.validate_quantity(without_wall(name), value, name) for name, value in arguments.items()}
    arrays = list(arguments.values())
    dtype = jnp.result_type(float, *arrays)  # float64, or float32 if all arrays are float32
    # NumPy broadcasts concrete values: JAX would compile a program for every shape.
    array_library = np if validation.is_concrete(*arrays) else jnp
    arrays = [array_library.asarray(array, dtype) for array in arrays]
    shape = validation.broadcast_shape(**dict(zip(arguments, arrays, strict=True)))
    fields = {name: array_library.broadcast_to(array, shape) for name, array in zip(arguments, arrays, strict=True)}
    pair = ImpactPair(fields["d"], _joined("kappa", fields), _joined("r", fields), fields["gamma"])
    # One transfer to the memory of the device for all fields.
    return jax.device_put(pair) if array_library is np else pair


def pair_of(table: Mapping[Any, Any], wall: Walls) -> ImpactPair:
    """Make the pair of a table of d, kappa, r and gamma, or per-wall entries such as kappa_left and kappa_right.

    Args:
        table: Values by name, not checked; other entries are ignored.
        wall: Kind of the walls; kappa of a rigid wall is ignored.
    """
    kappa: Any = None if wall == "rigid" else _joined("kappa", table)
    if wall in ONE_RIGID_WALL:
        # The rigid wall of the pair has kappa None, even if the table contains a value for it.
        left, right = (None if wall == f"rigid_{side}" else getattr(as_sides(kappa), side) for side in SIDES)
        kappa = Sides(left, right)
    return ImpactPair(table["d"], kappa, _joined("r", table), table["gamma"])


def pair_quantities(pair: ImpactPair) -> dict[str, Any]:
    """Return the quantities of a pair by name, in the form that `pair_of` reads; rigid walls have no kappa."""
    fields = {name: getattr(pair, name) for name in ("d", "kappa", "r", "gamma")}
    listed = {
        argument: number for name, value in fields.items() for argument, number in values_by_name(name, value).items()
    }
    return {name: value for name, value in listed.items() if value is not None}


def has_mirror_symmetry(table: Mapping[Any, Any]) -> Any:
    """Return `ImpactPair.symmetric` for a table that `pair_of` reads; kappa of a rigid wall may be infinite."""
    # Equal values at both walls count as equal walls, cell by cell.
    equal_values = [
        table[f"{name}_left"] == table[f"{name}_right"] for name in ("kappa", "r") if f"{name}_left" in table
    ]
    return reduce(and_, equal_values, table["gamma"] == 0)


def _joined(name: str, fields: Mapping[Any, Any]) -> Any:
    """Return a quantity from entries of `values_by_name`, as `Sides` if it is per wall; None if it is absent."""
    sides = [fields.get(f"{name}_{side}") for side in SIDES]
    return fields.get(name) if all(value is None for value in sides) else Sides(*sides)
