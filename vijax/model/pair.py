"""The vibro-impact pair in its nondimensional scaling, and the checks of its arguments."""

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
from vijax.model.quantities import SIDES, check, whole
from vijax.model.restitution import damped_frequency, damping_ratio
from vijax.model.sides import Sides, apart, at, each, named
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.arrays import AnyArray, choose
from vijax.runtime.checks import is_concrete
from vijax.runtime.context import door
from vijax.runtime.pages import see
from vijax.runtime.printed import PrintedRecord

Real = float | Float[AnyArray, "..."]
T = TypeVar("T")


class ImpactPair(PrintedRecord):
    """Nondimensional impact pair, Eqs. (37)-(38); every field a scalar or an array of one common shape.

    Fields are not checked, so that the record can be traced; `impact_pair` is the door that checks.

    Attributes:
        d: Free travel of the ball between the walls in units of A pi^2/omega^2, > 0; the ball is a point at u.
        kappa: Natural frequency of the soft walls, omega0 pi/omega > 0; None for rigid walls.
        r: Coefficient of restitution of a free contact, in (0, 1].
        gamma: Gravity along the axis over the forcing amplitude, g sin(beta)/A.
        law: The membrane of a periodic orbit, a `MembraneLaw`; None for the linear one, and wherever a method of its
            own knows it.
        waves: What shakes a periodic orbit from phase 0 on, `vijax.model.waves.Waves`; likewise None for the sine.

    Of walls that differ in kappa, r or law these are `Sides`, of what each wall has; kappa of a rigid one beside a soft
    one is None. It has no membrane: the depth of its impacts is 0, and nothing is harvested from them.
    """

    d: Float[AnyArray, "..."]
    # Of type as they are for the rooms of one wall, which read them after `at`.
    kappa: Float[AnyArray, "..."] | None
    r: Float[AnyArray, "..."]
    gamma: Float[AnyArray, "..."]
    law: eqx.Module | None = eqx.field(default=None, kw_only=True)
    waves: tuple[Any, ...] | None = eqx.field(default=None, kw_only=True)

    def __post_init__(self):
        # One of two forms, so that no program need be compiled for walls that differ in one of both alone.
        if self.kappa is not None and self.r is not None and self.unequal:
            self.kappa, self.r = apart(self.kappa), apart(self.r)

    @property
    def unequal(self) -> bool:
        """Say whether the two walls may differ, which is a static choice as `rigid` is."""
        return any(isinstance(own, Sides) for own in (self.kappa, self.r, self.law))

    @property
    def symmetric(self) -> Any:
        """Say in which cells the mirror image of a motion is one too, as gamma is 0 and the walls are equal.

        What shakes the ball is its own opposite half a period later, then, by odd harmonics alone.
        """
        differ = self.hard_wall or isinstance(self.law, Sides) or any(wave.order % 2 == 0 for wave in self.waves or ())
        return (self.gamma == 0) & False if differ else symmetric(quantities(self))

    def apart(self) -> "ImpactPair":
        """Give the pair in the form of walls that differ."""
        kappa: Any = None if self.rigid else apart(self.kappa)
        r: Any = apart(self.r)
        return replace(self, kappa=kappa, r=r)

    def at(self, side: Any) -> "ImpactPair":
        """Give the pair whose walls are both as that on a side is, +1 right or -1 left; itself unless they differ."""
        if not self.unequal:
            return self
        kappa: Any = self.kappa
        if self.hard_wall:
            # A number stands in for that of the rigid wall, whose form does not read it; see `met`.
            kappa = kappa.left if self.hard_wall > 0 else kappa.right
        return replace(self, kappa=at(kappa, side), r=at(self.r, side), law=self._law_at(side))

    def _law_at(self, side: Any) -> Any:
        """Give the law that the wall on a side has; its numbers may be arrays besides those of the cells."""
        law: Any = self.law
        if not isinstance(law, Sides):
            return law

        def of_wall(left: Any, right: Any) -> Any:
            own = np.ndim(left) - np.ndim(self.d)
            return jnp.where(jnp.reshape(side, np.shape(side) + (1,) * own) > 0, right, left)

        return jax.tree.map(of_wall, law.left, law.right)

    @property
    def hard_wall(self) -> int:
        """Say which wall is rigid beside a soft one, -1 left or 1 right; 0 where both are of one kind."""
        kappa: Any = self.kappa
        return int(kappa.right is None) - int(kappa.left is None) if isinstance(kappa, Sides) else 0

    @property
    def walls(self) -> Walls:
        """Say what the walls are, as `Harvester.pair` is told."""
        if self.hard_wall:
            return "rigid_left" if self.hard_wall < 0 else "rigid_right"
        return "rigid" if self.rigid else "soft"

    def hard(self, side: Any) -> Any:
        """Say whether the wall on a side is rigid: elementwise where one wall of each kind is there, else for all."""
        return side * self.hard_wall > 0 if self.hard_wall else np.bool_(self.rigid)

    def met(self, side: Any, rigid: Callable[["ImpactPair"], T], soft: Callable[["ImpactPair"], T]) -> T:
        """Compute what the wall on a side does, by the form of rigid walls or by that of soft ones.

        Both forms are given the pair as that wall has it. Where one wall of each kind is there both are computed, and
        every ball takes that of its wall.
        """
        here = self.at(side)
        if not self.hard_wall:
            return (rigid if self.rigid else soft)(here)
        return choose(self.hard(side), rigid(here), soft(here))

    @property
    def rigid(self) -> bool:
        """Say whether both walls are rigid, which is a static choice that no compiled program asks twice."""
        return self.kappa is None

    @property
    @door
    def mu(self) -> Float[AnyArray, "..."]:
        """Compute the damping of w'' + mu w' + kappa^2 w = f, as `restitution` calibrates it."""
        return each(lambda zeta: 2 * zeta, self.zeta)

    @property
    @door
    def zeta(self) -> Float[AnyArray, "..."]:
        """Compute the decay rate mu/2 of a free contact."""
        return each(lambda kappa, r: kappa * damping_ratio(r), self._soft_kappa(), self.r)

    @property
    @door
    def omega1(self) -> Float[AnyArray, "..."]:
        """Compute the damped frequency sqrt(kappa^2 - zeta^2)."""
        return each(damped_frequency, self._soft_kappa(), self.r)

    def _soft_kappa(self) -> Any:
        if self.kappa is None or self.hard_wall:
            raise ValueError("kappa must be a number for a membrane's damping and frequency; got None (a rigid wall)")
        return self.kappa


WALLS: tuple[Walls, ...] = get_args(Walls)
RIGID_ON = tuple(wall for wall in WALLS if wall.startswith("rigid_"))
"""Walls of which one alone is rigid."""


def check_pair(pair: Any, *, of_orbit: bool = False) -> ImpactPair:
    """Return the pair, if its fields may be; those of traced values pass unseen.

    Args:
        pair: What came.
        of_orbit: Whether it may be that of an orbit, whose membranes need not be linear, nor its shaking the sine.

    Raises:
        ValueError: No pair, a field that cannot be, or fields that do not broadcast.
    """
    given = dict(vars(checks.instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")))
    law, waves = given.pop("law"), given.pop("waves")
    if law is not None and not of_orbit:
        raise ValueError(see("methods", f"pair must have linear membranes here; got {type(law).__name__}"))
    if waves is not None and not of_orbit:
        raise ValueError(see("excitation", "pair must know of no harmonics here; got some; give them as excitation="))
    fields: dict[str, Any] = {}
    for name, value in given.items():
        for argument, one in named(name, value).items():
            if one is not None or argument not in _MAY_BE_NONE:
                check(name, one, argument)
                fields[argument] = one
    checks.shapes(**fields)
    return pair


def check_one_pair(pair: Any, remedy: str, *, most: int = 0, of_orbit: bool = False) -> ImpactPair:
    """Return the pair, if it may be and has no more dimensions than the function takes; traced values count too.

    Args:
        pair: What came.
        remedy: What to do about several cells, for the error.
        most: Dimensions that its fields may have: 0 for one cell, 1 for one a state.
        of_orbit: See `check_pair`.

    Raises:
        ValueError: "pair must be one cell; got d of shape (2, 2); search each".
    """
    for name, value in quantities(check_pair(pair, of_orbit=of_orbit)).items():
        if np.ndim(value) > most:
            must = "one cell" if most == 0 else "one cell, or one a state"
            raise ValueError(f"pair must be {must}; got {name} of shape {np.shape(value)}; {remedy}")
    return pair


def check_start(pair: ImpactPair, name: str, u: Any) -> None:
    """Raise ValueError unless a displacement lies between rigid walls; soft ones may be entered, traced ones pass."""
    if not (pair.rigid or pair.hard_wall) or not is_concrete(pair.d, u):
        return
    u, half = np.broadcast_arrays(np.asarray(u), 0.5 * np.asarray(pair.d))
    good = (np.abs(u) <= half) | ~pair.hard(u)
    if not good.all():
        raise ValueError(
            f"{name} must lie within the gap of a rigid wall, |{name}| <= d/2; got {name} = {checks.first(u, good)} "
            f"at d = {2 * half[~good].flat[0]:g}"
        )


_MAY_BE_NONE = "kappa", "kappa_left", "kappa_right", "r"


@door
def impact_pair(
    d: Given, kappa: Given | Sides[Given | None] | None, r: Given | Sides[Given] | None, gamma: Given = 0.0
) -> ImpactPair:
    """Make a checked `ImpactPair`, its fields broadcast to one shape.

    Args:
        d: Free travel of the ball between the walls, > 0, any shape.
        kappa: Natural frequency of the soft walls, > 0 and finite; None for rigid walls.
        r: Coefficient of restitution, in (0, 1]; None with a membrane that takes none, as `HuntCrossley`.
        gamma: Gravity over forcing amplitude, finite.

    kappa and r may be `Sides(left, right)`, of walls that differ; `Sides(25.0, None)` has a rigid wall on the right.

    Raises:
        ValueError: A value that cannot be, or shapes that do not broadcast (traced values are not looked at).
    """
    given = {"d": d, **named("kappa", kappa), **named("r", r), "gamma": gamma}
    given = {name: value for name, value in given.items() if value is not None or name not in _MAY_BE_NONE}
    given = {name: units.given(whole(name), value, name) for name, value in given.items()}
    arrays = list(given.values())
    dtype = jnp.result_type(float, *arrays)  # float64, or float32 where all arrays are
    # By NumPy where it can: JAX would compile a program for every shape.
    own = np if checks.is_concrete(*arrays) else jnp
    arrays = [own.asarray(array, dtype) for array in arrays]
    shape = checks.shapes(**dict(zip(given, arrays, strict=True)))
    fields = {name: own.broadcast_to(array, shape) for name, array in zip(given, arrays, strict=True)}
    pair = ImpactPair(fields["d"], _joined("kappa", fields), _joined("r", fields), fields["gamma"])
    return jax.device_put(pair) if own is np else pair


def pair_of(table: Mapping[Any, Any], wall: Walls) -> ImpactPair:
    """Make the pair of a table of d, kappa, r and gamma, of what walls have of their own as kappa_left and so on.

    Args:
        table: Values by name, not checked; others than the pair's are not read.
        wall: What the walls are: kappa of a rigid one is not read either.
    """
    kappa: Any = None if wall == "rigid" else _joined("kappa", table)
    if wall in RIGID_ON:
        left, right = (None if wall == f"rigid_{side}" else getattr(apart(kappa), side) for side in SIDES)
        kappa = Sides(left, right)
    return ImpactPair(table["d"], kappa, _joined("r", table), table["gamma"])


def quantities(pair: ImpactPair) -> dict[str, Any]:
    """List what a pair is made of by name, as `pair_of` reads it; rigid walls have no kappa."""
    fields = {name: getattr(pair, name) for name in ("d", "kappa", "r", "gamma")}
    listed = {argument: one for name, value in fields.items() for argument, one in named(name, value).items()}
    return {name: value for name, value in listed.items() if value is not None}


def symmetric(table: Mapping[Any, Any]) -> Any:
    """Do what `ImpactPair.symmetric` does, of a table as `pair_of` reads it; kappa of a rigid wall may be infinite."""
    alike = [table[f"{name}_left"] == table[f"{name}_right"] for name in ("kappa", "r") if f"{name}_left" in table]
    return reduce(and_, alike, table["gamma"] == 0)


def _joined(name: str, fields: Mapping[Any, Any]) -> Any:
    """Take a quantity out of what `named` lists; None if it is not there."""
    sides = [fields.get(f"{name}_{side}") for side in SIDES]
    return fields.get(name) if all(one is None for one in sides) else Sides(*sides)
