"""The harvester in SI units, and how it becomes a nondimensional pair and comes back from one."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vijax.model import units
from vijax.model.choices import Walls
from vijax.model.pair import WALLS, ImpactPair, Real, check_pair, impact_pair, pair_of
from vijax.model.quantities import AXES, SIDES, whole
from vijax.model.sides import Sides, apart, at, each, named, with_own
from vijax.runtime import checks
from vijax.runtime.checks import is_concrete
from vijax.runtime.context import door
from vijax.runtime.printed import PrintedRecord
from vijax.runtime.tiles import library

Own = Real | Sides[Real]
"""A number, or the `Sides` of what the two walls have of their own."""


_NO_CONSTANTS = {
    "k": "; a membrane of stiffness k has omega0 = sqrt(k/m_b)",
    "distance": "; membranes a distance D apart have s = D - 2 r_b, the free travel of the ball",
}


class Harvester(PrintedRecord):
    """The device in SI units; the defaults are Tables I and II of the paper.

    Every field is a number or an array, traced and never static; quantities of pint become plain numbers. The stiffness
    k is m_b omega0^2, so a membrane of known k has omega0 = sqrt(k/m_b); `sweep` takes k as an axis, too. What walls
    have, omega0, r, w0, R0, eps_M and V, may be a `Sides` of the two.

    Attributes:
        m_b: Mass of the ball [kg].
        s: Free travel of the ball [m], from touching one membrane to touching the other: the membranes are a distance
            s + 2 r_b apart.
        omega0: Natural frequency of ball and membrane [rad/s].
        r: Coefficient of restitution of a free contact, in (0, 1].
        A: Amplitude of the forcing acceleration [m/s^2].
        omega: Frequency of the forcing [rad/s].
        beta: Inclination [rad].
        g: Acceleration of gravity [m/s^2].
        w0: Thickness of the undeformed membrane [m].
        R0: Radius of the membrane [m].
        eps_M: Permittivity of the membrane [F/m].
        C_T: Transfer capacitance [F].
        V: Voltage [V].
        r_b: Radius of the ball [m], below R0.
        penetration_limit: Largest admissible penetration [m]; None for R0.
        energy_ratio_limit: Largest admissible ratio of the energy that an impact yields to the energy that it gives to
            the membrane, E_j/W_j, in (0, 1]. The formula of E_j leaves out the force of the charge on the ball, which
            changes the motion where the ratio is not small.

    Raises:
        TypeError: A name that is no constant; it says which there are.
        ValueError: A constant that cannot be (traced values are not looked at).
    """

    m_b: Real = 0.0035
    s: Real = 0.3
    omega0: Own = 400.0
    r: Own = 0.5
    A: Real = 1.0
    omega: Real = math.pi
    beta: Real = 0.0
    g: Real = 9.8
    w0: Own = 0.00025
    R0: Own = 0.0063
    eps_M: Own = 4.15e-11
    C_T: Real = 99.35e-9
    V: Own = 2000.0
    r_b: Real = 0.0050
    penetration_limit: Real | None = None
    energy_ratio_limit: Real = 1.0

    def __new__(cls, *constants: Any, **named: Any):
        """Refuse a name that is no constant, with the names that there are, which Python would not say."""
        known = [field.name for field in dataclasses.fields(cls)]
        for name in named:
            if name not in known:
                advice = _NO_CONSTANTS.get(name, "")
                raise TypeError(f"{name} must be a constant of the device; known are {', '.join(known)}{advice}")
        return super().__new__(cls)

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "penetration_limit" or value is not None:
                setattr(self, field.name, units.given_each(field.name, value))

    def __check_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Sides) and field.name not in WALLS_OWN:
                raise ValueError(
                    f"{field.name} must be of the whole device, as only {', '.join(WALLS_OWN)} are a wall's own; "
                    f"got {checks.shown(value)}"
                )
        for argument, R0 in named("R0", self.R0).items():
            if is_concrete(self.r_b, R0) and not np.all(np.asarray(self.r_b) < np.asarray(R0)):
                raise ValueError(
                    f"r_b must be smaller than {argument}, the radius of the membrane that the ball sinks into; "
                    f"got r_b = {checks.shown(self.r_b)}, {argument} = {checks.shown(R0)}"
                )

    @property
    def unequal(self) -> bool:
        """Say whether the two walls may differ in anything."""
        return any(isinstance(getattr(self, name), Sides) for name in WALLS_OWN)

    @property
    def alike(self) -> bool:
        """Say whether both membranes yield alike where they are entered alike, whatever the motion is."""
        own = [getattr(self, name) for name in WALLS_OWN if name not in ("omega0", "r")]
        differ = [one for one in own if isinstance(one, Sides)]
        return all(is_concrete(one.left, one.right) and np.array_equal(one.left, one.right) for one in differ)

    def at(self, side: Any) -> "Harvester":
        """Give the device whose walls are both as the one on a side is, +1 right or -1 left: itself if they are equal.

        Args:
            side: A number, or an array of them; fields become arrays that broadcast against it.
        """
        return jax.tree.map(lambda x: at(x, side), self, is_leaf=lambda x: isinstance(x, Sides))

    @property
    @door
    def k(self) -> Own:
        """Compute the stiffness of the membrane, m_b omega0^2 [N/m]."""
        return each(lambda omega0: self.m_b * omega0**2, self.omega0)

    @property
    @door
    def distance(self) -> Real:
        """Compute the distance of the membranes [m], the sum of the free travel s and the diameter of the ball."""
        return self.s + 2 * self.r_b

    @property
    @door
    def length_unit(self) -> Real:
        """Compute metres per unit of u, A pi^2/omega^2."""
        return self.A * (math.pi / self.omega) ** 2

    @property
    @door
    def speed_unit(self) -> Real:
        """Compute metres per second per unit of u', A pi/omega."""
        return self.A * (math.pi / self.omega)

    @door
    def friction(self, coefficient: Real) -> Real:
        """Compute the dry friction of the ball on the capsule over the forcing's amplitude, f g cos(beta)/A.

        Args:
            coefficient: f, of friction at rest and sliding, at least 0.
        """
        coefficient = units.given("friction_coefficient", coefficient, "coefficient")
        return coefficient * self.g * jnp.cos(self.beta) / self.A

    @property
    def depth_limit(self) -> Own:
        """Compute the largest admissible penetration [m]."""
        return self.R0 if self.penetration_limit is None else self.penetration_limit

    @door
    def pair(self, wall: Walls = "soft") -> ImpactPair:
        """Bring the device into nondimensional form, Eqs. (37)-(38).

        d = s omega^2/(A pi^2), kappa = omega0 pi/omega, gamma = g sin(beta)/A.

        Args:
            wall: "soft" for the membranes, "rigid" for the walls that they become as omega0 grows (kappa = None);
                "rigid_left" or "rigid_right" where one of them alone is rigid, and is no membrane.
        """
        checks.choice("wall", wall, WALLS)
        d, gamma = self.s / self.length_unit, self.g * library(self.beta).sin(self.beta) / self.A
        kappa = each(lambda omega0: omega0 * (math.pi / self.omega), self.omega0)
        given = {"d": d, **named("kappa", kappa), **named("r", self.r), "gamma": gamma}
        pair = pair_of(given, wall)
        fields, tree = jax.tree.flatten(pair.apart() if self.unequal else pair)
        return jax.tree.unflatten(tree, jnp.broadcast_arrays(*fields))


WALLS_OWN = "omega0", "r", "w0", "R0", "eps_M", "V"
"""Constants that each wall may have of its own."""

LIMITS = "penetration_limit", "energy_ratio_limit"
"""Limits of admissible impacts: requirements of the designer, not constants of the device."""

CONSTANTS = tuple(field.name for field in dataclasses.fields(Harvester) if field.name not in LIMITS)
"""Constants of the device, without the limits of admissible impacts."""


def told_device(attributes: Mapping[Any, Any]) -> Harvester:
    """Read the device that a map's attributes tell; what they do not tell, as its axes, is that of Tables I and II."""
    told: dict[str, Any] = {}
    for name in (*CONSTANTS, *LIMITS):
        both, sides = f"harvester_{name}", [f"harvester_{name}_{side}" for side in SIDES]
        if both in attributes:
            told[name] = float(attributes[both])
        elif sides[0] in attributes:
            told[name] = Sides(*(float(attributes[one]) for one in sides))
    # The limit is told as a number even where it is the radius of the membrane, as a device says by None.
    if told.get("penetration_limit") == told.get("R0"):
        told.pop("penetration_limit", None)
    return Harvester(**told)


@door
def with_pair(device: Harvester, pair: ImpactPair) -> Harvester:
    """Give a device the given nondimensional form, by its s, omega0, r and beta; the inverse of `Harvester.pair`.

    Args:
        device: Gives A, omega, g and everything electrical; and omega0 where a wall of `pair` is rigid.
        pair: A pair that an inclination can give: |gamma| <= g/A.

    Raises:
        ValueError: No inclination gives gamma, or a field that cannot be (traced values leave beta = NaN instead).
    """
    check_pair(pair)
    sine = pair.gamma * check_device(device).A / device.g
    if is_concrete(sine) and np.any(np.abs(sine) > 1):
        raise ValueError(
            f"gamma must lie in [-g/A, g/A] for an inclination to give it; got {checks.first(sine, np.abs(sine) <= 1)} "
            f"for gamma A/g; lower A or raise g"
        )
    omega0 = each(
        lambda kappa, own: own if kappa is None else kappa * device.omega / math.pi, pair.kappa, device.omega0
    )
    return dataclasses.replace(device, s=pair.d * device.length_unit, omega0=omega0, r=pair.r, beta=jnp.arcsin(sine))


@door
def with_constants(device: Harvester, **constants: Own) -> Harvester:
    """Change some constants of a device, checked by name; `k` [N/m] sets omega0 = sqrt(k/m_b), `distance` [m] sets s.

    What one wall alone is to have is given as omega0_left, V_right and so on.

    Raises:
        ValueError: An unknown constant, both k and omega0, or a value that cannot be.
    """
    known = ["k", "distance", *(field.name for field in dataclasses.fields(check_device(device)))]
    walls = [f"{name}_{side}" for name in ("k", *WALLS_OWN) for side in SIDES]
    for name in constants:
        if name not in (*known, *walls):
            raise ValueError(
                f"{name} must be a constant of the device; got {name!r}; known are {', '.join(known)}; what one wall "
                f"has of k, {', '.join(WALLS_OWN)} ends in _left or _right"
            )
    m_b = units.given("m_b", constants.get("m_b", device.m_b))
    given: dict[str, Any] = {}
    for name, value in constants.items():
        value = units.given_each(whole(name), value, name)
        if whole(name) == "k":
            name, value = name.replace("k", "omega0", 1), each(lambda k: jnp.sqrt(k / m_b), value)
        elif name == "distance":
            r_b = units.given("r_b", constants.get("r_b", device.r_b))
            check_fits(value, r_b)
            name, value = "s", value - 2 * r_b
        _check_rivals(name, given)
        given[name] = value
    return changed(device, given)


def check_fits(distance: Any, r_b: Any) -> None:
    """Raise ValueError unless a ball of radius r_b fits between membranes a distance apart; traced values pass."""
    if is_concrete(distance, r_b) and not np.all(good := np.asarray(distance) > 2 * np.asarray(r_b)):
        raise ValueError(
            f"distance must exceed the diameter of the ball, 2 r_b = {2 * float(np.max(r_b)):g} m; "
            f"got {checks.first(distance, good)}; give s, the free travel of the ball, or lower r_b"
        )


def _check_rivals(name: str, given: Mapping[str, Any]) -> None:
    """Raise ValueError where a constant is given twice: by k and omega0, or for both walls and for one of them."""
    if name in given:
        both = "distance and s" if name == "s" else "k and omega0"
        raise ValueError(f"{both} must not both be given, as one follows from the other; got both; leave one out")
    of_walls = [f"{name}_{side}" for side in SIDES]
    rivals = [other for other in given if other in of_walls or name in [f"{other}_{side}" for side in SIDES]]
    if rivals:
        raise ValueError(f"{rivals[0]} and {name} give the same constant; give one for both walls, or one for each")


def realised(device: Harvester, table: Mapping[Any, Any], wall: Walls) -> tuple[ImpactPair, Harvester]:
    """Give the pair of a table of numbers by name, and the device that has it with the table's A and omega.

    Args:
        device: Gives all that the table does not.
        table: What `pair_of` reads, A and omega; of rigid walls kappa says how deep a membrane they are lent.
        wall: What the walls are.
    """
    fields = pair_of(table, wall)
    pair = impact_pair(fields.d, fields.kappa, fields.r, fields.gamma)
    if wall == "rigid" and "kappa_left" in table:
        # Both are of the one membrane that rigid walls are lent.
        table = {name: value for name, value in table.items() if name != "kappa_right"}
        table["kappa"] = table.pop("kappa_left")
    natural = {name.replace("kappa", "omega0"): value for name, value in table.items() if name.startswith("kappa")}
    held = {name: value * table["omega"] / math.pi for name, value in natural.items() if math.isfinite(value)}
    moved = with_constants(device, A=table["A"], omega=table["omega"], **held)
    return pair, with_pair(moved, pair)


def changed(device: Harvester, constants: Mapping[str, Any], *, checked: bool = True) -> Harvester:
    """Change constants of a device, or under names such as omega0_left what one wall has of them.

    Args:
        checked: Whether to look whether they may be, for which arrays of many devices take long.
    """
    fields = with_own(device, constants)
    if checked:
        return dataclasses.replace(device, **fields)
    return eqx.tree_at(
        lambda one: [getattr(one, name) for name in fields],
        device,
        list(fields.values()),
        is_leaf=lambda leaf: leaf is None,
    )


@door
def depth_unit(device: Harvester, pair: ImpactPair) -> Own:
    """Compute metres per unit of an impact's depth; a rigid wall's depth is recorded as that of kappa = 1."""
    if pair.rigid:
        return each(lambda omega0: device.length_unit * device.omega / (math.pi * omega0), device.omega0)
    return device.length_unit


def electrical(device: Harvester, *, unequal: bool = False) -> Harvester:
    """Leave out of a device what the energy of an impact of known depth does not depend on: those fields are None.

    Args:
        unequal: Whether to give each wall its own of all that is left and may differ: one form for many devices.
    """
    if unequal:
        names = [name for name in WALLS_OWN if name not in ("omega0", "r")]
        device = changed(device, {name: apart(getattr(device, name)) for name in names}, checked=False)
    return eqx.tree_at(
        lambda one: [getattr(one, name) for name in ("s", "omega0", "r", "A", "omega", "beta", "g", *LIMITS)],
        device,
        [None] * 9,
        is_leaf=lambda leaf: leaf is None,
    )


def check_device(device: Any) -> Harvester:
    """Return the device, if it is one."""
    return checks.instance("device", device, Harvester, "vijax.Harvester(...)")


def one_device(device: Any) -> Harvester:
    """Return the device, each constant one number that is not traced; that of Tables I and II where none is given."""
    if device is None:
        return Harvester()
    check_each_constant(checks.known("device", check_device(device)), _advice)
    return device


def check_each_constant(device: Any, remedy: str | Callable[[str], str]) -> Harvester:
    """Return the device, if it is one whose constants are one number each, also where they are traced.

    Args:
        device: What came.
        remedy: What to do about several devices, for the error; or a function of the constant that is no number.

    Raises:
        ValueError: "device.s must be one number; got shape (2,); map devices by jax.vmap".
    """
    for name, value in vars(check_device(device)).items():
        for argument, one in named(name, value).items():
            if one is not None and np.ndim(one):
                advice = remedy if isinstance(remedy, str) else remedy(argument)
                raise ValueError(f"device.{argument} must be one number; got shape {np.shape(one)}; {advice}")
    return device


def _advice(name: str) -> str:
    """Return what to do about a constant of several numbers where a device must be one."""
    return f"{f'give {name} as an axis' if name in AXES else f'{name} is no axis'}, or make a call for each device"
