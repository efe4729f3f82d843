"""The harvester in SI units (`Harvester`), and its conversion to and from the nondimensional pair, Eqs. (37)-(38).

The motion depends on d, kappa, r and gamma alone. A, omega, the mass and the electrical constants enter the energy.
"""

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
from vijax.model.quantities import AXES, SIDES, without_wall
from vijax.model.walls.sides import Sides, as_sides, at_wall, map_walls, values_by_name, with_wall_values
from vijax.runtime import validation
from vijax.runtime.public_api import public_api
from vijax.runtime.record_text import PrintedRecord
from vijax.runtime.tiles import array_namespace
from vijax.runtime.validation import is_concrete

PerWall = Real | Sides[Real]
"""A number or array, or a `Sides` with one value per wall."""

# Advice for names that are not constants but determine a constant; the text continues an error message.
_DERIVED_NAMES = {
    "k": "; a membrane of stiffness k has omega0 = sqrt(k/m_b)",
    "distance": "; membranes a distance D apart have s = D - 2 r_b, the free travel of the ball",
}


class Harvester(PrintedRecord):
    """The device in SI units; the defaults are Tables I and II of the paper.

    Every field is a number or an array, traced and never static; quantities of pint become plain numbers. A membrane of
    known stiffness k = m_b omega0^2 has omega0 = sqrt(k/m_b); `sweep` also accepts k as an axis. The constants of a
    wall, omega0, r, w0, R0, eps_M and V, may be a `Sides` of two values.

    Attributes:
        m_b: Mass of the ball [kg].
        s: Free travel of the ball [m], from touching one membrane to touching the other: the membranes are a distance s
            + 2 r_b apart.
        omega0: Natural frequency of ball and membrane [rad/s].
        r: Coefficient of restitution of a contact without forcing, in (0, 1].
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
            the membrane, E_j/W_j, in (0, 1]. The formula of E_j omits the electrostatic force on the ball, which
            changes the motion where the ratio is not small.

    Raises:
        TypeError: If a name is not a constant; the message lists the constants.
        ValueError: If a constant is out of its range (traced values are not checked).
    """

    m_b: Real = 0.0035
    s: Real = 0.3
    omega0: PerWall = 400.0
    r: PerWall = 0.5
    A: Real = 1.0
    omega: Real = math.pi
    beta: Real = 0.0
    g: Real = 9.8
    w0: PerWall = 0.00025
    R0: PerWall = 0.0063
    eps_M: PerWall = 4.15e-11
    C_T: Real = 99.35e-9
    V: PerWall = 2000.0
    r_b: Real = 0.0050
    penetration_limit: Real | None = None
    energy_ratio_limit: Real = 1.0

    def __new__(cls, *constants: Any, **named: Any):
        """Raise TypeError for a name that is not a constant; unlike the message of Python, it lists the constants."""
        constant_names = [field.name for field in dataclasses.fields(cls)]
        for name in named:
            if name not in constant_names:
                advice = _DERIVED_NAMES.get(name, "")
                raise TypeError(
                    f"{name} must be a constant of the device; known are {', '.join(constant_names)}{advice}"
                )
        return super().__new__(cls)

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "penetration_limit" or value is not None:
                # None is kept, so that the limit equals R0 even if R0 is replaced later.
                setattr(self, field.name, units.validate_per_wall(field.name, value))

    def __check_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Sides) and field.name not in PER_WALL_CONSTANTS:
                raise ValueError(
                    f"{field.name} must be equal at both walls; only {', '.join(PER_WALL_CONSTANTS)} may differ; "
                    f"got {validation.value_text(value)}"
                )
        # The ball must fit through the rim of the membrane, or `energy.stretch` has no tangent from rim to ball.
        for argument, R0 in values_by_name("R0", self.R0).items():
            if is_concrete(self.r_b, R0) and not np.all(np.asarray(self.r_b) < np.asarray(R0)):
                raise ValueError(
                    f"r_b must be smaller than {argument}, the radius of the membrane that the ball sinks into; "
                    f"got r_b = {validation.value_text(self.r_b)}, {argument} = {validation.value_text(R0)}"
                )

    @property
    def has_unequal_walls(self) -> bool:
        """Return whether the two walls may differ in any constant."""
        return any(isinstance(getattr(self, name), Sides) for name in PER_WALL_CONSTANTS)

    @property
    def has_equal_membranes(self) -> bool:
        """Return whether equal penetrations of both membranes yield equal harvested energies."""
        # omega0 and r act on the motion only; the energy of an impact of known depth does not depend on them.
        constants = [getattr(self, name) for name in PER_WALL_CONSTANTS if name not in ("omega0", "r")]
        differ = [value for value in constants if isinstance(value, Sides)]
        return all(is_concrete(value.left, value.right) and np.array_equal(value.left, value.right) for value in differ)

    def at(self, side: Any) -> "Harvester":
        """Return the device with the constants of one wall at both walls; the device itself if its walls are equal.

        Args:
            side: +1 right, -1 left; with an array the fields become arrays that broadcast against it.
        """
        return jax.tree.map(lambda x: at_wall(x, side), self, is_leaf=lambda x: isinstance(x, Sides))

    @property
    @public_api
    def k(self) -> PerWall:
        """Compute the stiffness of the membrane, m_b omega0^2 [N/m]."""
        return map_walls(lambda omega0: self.m_b * omega0**2, self.omega0)

    @property
    @public_api
    def distance(self) -> Real:
        """Compute the distance of the membranes [m], s + 2 r_b, the free travel plus the diameter of the ball."""
        return self.s + 2 * self.r_b

    @property
    @public_api
    def length_unit(self) -> Real:
        """Compute metres per unit of u, A pi^2/omega^2."""
        return self.A * (math.pi / self.omega) ** 2

    @property
    @public_api
    def speed_unit(self) -> Real:
        """Compute metres per second per unit of u', A pi/omega."""
        return self.A * (math.pi / self.omega)

    @public_api
    def friction(self, coefficient: Real) -> Real:
        """Compute the nondimensional dry friction of the ball on the capsule, f g cos(beta)/A.

        Args:
            coefficient: f, for static and sliding friction, at least 0.
        """
        coefficient = units.validate_quantity("friction_coefficient", coefficient, "coefficient")
        return coefficient * self.g * jnp.cos(self.beta) / self.A

    @property
    def depth_limit(self) -> PerWall:
        """Compute the largest admissible penetration [m]."""
        return self.R0 if self.penetration_limit is None else self.penetration_limit

    @public_api
    def pair(self, wall: Walls = "soft") -> ImpactPair:
        """Convert the device to nondimensional form, Eqs. (37)-(38).

        d = s omega^2/(A pi^2), kappa = omega0 pi/omega, gamma = g sin(beta)/A.

        Args:
            wall: "soft" for the membranes, "rigid" for their limit as omega0 grows (kappa = None); "rigid_left" or
                "rigid_right" makes one wall rigid.
        """
        validation.validate_choice("wall", wall, WALLS)
        d, gamma = self.s / self.length_unit, self.g * array_namespace(self.beta).sin(self.beta) / self.A
        kappa = map_walls(lambda omega0: omega0 * (math.pi / self.omega), self.omega0)
        quantities = {"d": d, **values_by_name("kappa", kappa), **values_by_name("r", self.r), "gamma": gamma}
        pair = pair_of(quantities, wall)
        fields, tree = jax.tree.flatten(pair.with_sides() if self.has_unequal_walls else pair)
        return jax.tree.unflatten(tree, jnp.broadcast_arrays(*fields))


PER_WALL_CONSTANTS = "omega0", "r", "w0", "R0", "eps_M", "V"
"""Constants that may differ between the walls."""

LIMITS = "penetration_limit", "energy_ratio_limit"
"""Limits of admissible impacts: requirements of the designer, not constants of the device."""

CONSTANTS = tuple(field.name for field in dataclasses.fields(Harvester) if field.name not in LIMITS)
"""Constants of the device, without the limits of admissible impacts."""


def device_from_attributes(attributes: Mapping[Any, Any]) -> Harvester:
    """Read a device from the attributes of a map; other constants have the values of Tables I and II."""
    constants: dict[str, Any] = {}
    for name in (*CONSTANTS, *LIMITS):
        both, sides = f"harvester_{name}", [f"harvester_{name}_{side}" for side in SIDES]
        if both in attributes:
            constants[name] = float(attributes[both])
        elif sides[0] in attributes:
            constants[name] = Sides(*(float(attributes[key]) for key in sides))
    # Attributes store the limit as a number even if it is the radius of the membrane, which a device expresses by None.
    if constants.get("penetration_limit") == constants.get("R0"):
        constants.pop("penetration_limit", None)
    return Harvester(**constants)


@public_api
def with_pair(device: Harvester, pair: ImpactPair) -> Harvester:
    """Return the device with changed s, omega0, r, beta that has the form `pair`; the inverse of `Harvester.pair`.

    Args:
        device: Source of all other constants; also of omega0 where a wall of `pair` is rigid.
        pair: A pair that an inclination can produce: |gamma| <= g/A.

    Raises:
        ValueError: If no inclination gives gamma (traced values give beta = NaN), or a field is out of its range.
    """
    check_pair(pair)
    # gamma = g sin(beta)/A, hence sin(beta) = gamma A/g, which must lie in [-1, 1].
    sine = pair.gamma * check_device(device).A / device.g
    if is_concrete(sine) and np.any(np.abs(sine) > 1):
        raise ValueError(
            f"gamma must lie in [-g/A, g/A] for an inclination to give it; "
            f"got {validation.first_invalid(sine, np.abs(sine) <= 1)} for gamma A/g; lower A or raise g"
        )
    omega0 = map_walls(
        lambda kappa, omega0: omega0 if kappa is None else kappa * device.omega / math.pi, pair.kappa, device.omega0
    )
    return dataclasses.replace(device, s=pair.d * device.length_unit, omega0=omega0, r=pair.r, beta=jnp.arcsin(sine))


@public_api
def with_constants(device: Harvester, **constants: PerWall) -> Harvester:
    """Return a device with changed constants; `k` [N/m] sets omega0 = sqrt(k/m_b), `distance` [m] sets s.

    Names such as omega0_left and V_right set the constant of one wall.

    Raises:
        ValueError: If a name is not a constant, k and omega0 are both specified, or a value is out of its range.
    """
    names = ["k", "distance", *(field.name for field in dataclasses.fields(check_device(device)))]
    walls = [f"{name}_{side}" for name in ("k", *PER_WALL_CONSTANTS) for side in SIDES]
    for name in constants:
        if name not in (*names, *walls):
            raise ValueError(
                f"{name} must be a constant of the device; got {name!r}; known are {', '.join(names)}; names of one "
                f"wall's k, {', '.join(PER_WALL_CONSTANTS)} end in _left or _right"
            )
    m_b = units.validate_quantity("m_b", constants.get("m_b", device.m_b))
    fields: dict[str, Any] = {}
    for name, value in constants.items():
        value = units.validate_per_wall(without_wall(name), value, name)
        if without_wall(name) == "k":
            name, value = name.replace("k", "omega0", 1), map_walls(lambda k: jnp.sqrt(k / m_b), value)
        elif name == "distance":
            r_b = units.validate_quantity("r_b", constants.get("r_b", device.r_b))
            check_fits(value, r_b)
            name, value = "s", value - 2 * r_b
        # Checked after the conversion, so that k conflicts with omega0 and distance with s.
        _check_conflicts(name, fields)
        fields[name] = value
    return with_fields(device, fields)


def check_fits(distance: Any, r_b: Any) -> None:
    """Raise ValueError unless a ball of radius r_b fits between membranes a distance apart; traced values pass."""
    if is_concrete(distance, r_b) and not np.all(good := np.asarray(distance) > 2 * np.asarray(r_b)):
        raise ValueError(
            f"distance must exceed the diameter of the ball, 2 r_b = {2 * float(np.max(r_b)):g} m; "
            f"got {validation.first_invalid(distance, good)}; give s, the free travel of the ball, or lower r_b"
        )


def _check_conflicts(name: str, fields: Mapping[str, Any]) -> None:
    """Raise ValueError if a constant is specified twice: by k and omega0, or for both walls and for one wall."""
    if name in fields:
        both = "distance and s" if name == "s" else "k and omega0"
        raise ValueError(f"{both} must not both be given, as one follows from the other; got both; leave one out")
    of_walls = [f"{name}_{side}" for side in SIDES]
    conflicts = [other for other in fields if other in of_walls or name in [f"{other}_{side}" for side in SIDES]]
    if conflicts:
        raise ValueError(f"{conflicts[0]} and {name} give the same constant; give one for both walls, or one for each")


def pair_and_device(device: Harvester, table: Mapping[Any, Any], wall: Walls) -> tuple[ImpactPair, Harvester]:
    """Return the pair of a table of quantities, and the device with this pair and the A and omega of the table.

    Args:
        device: Source of all constants that the table does not contain.
        table: The quantities that `pair_of` reads, and A and omega; for rigid walls kappa is the frequency of the
            membrane that sets the depth and the energy of their impacts.
        wall: Kind of the walls.
    """
    fields = pair_of(table, wall)
    pair = impact_pair(fields.d, fields.kappa, fields.r, fields.gamma)
    if wall == "rigid" and "kappa_left" in table:
        # Two rigid walls share one fictitious membrane, so that kappa_left is used for both.
        table = {name: value for name, value in table.items() if name != "kappa_right"}
        table["kappa"] = table.pop("kappa_left")
    kappas = {name.replace("kappa", "omega0"): value for name, value in table.items() if name.startswith("kappa")}
    # An infinite kappa marks a rigid wall; the device keeps its omega0.
    omega0s = {name: value * table["omega"] / math.pi for name, value in kappas.items() if math.isfinite(value)}
    forced = with_constants(device, A=table["A"], omega=table["omega"], **omega0s)
    return pair, with_pair(forced, pair)


def with_fields(device: Harvester, constants: Mapping[str, Any], *, checked: bool = True) -> Harvester:
    """Return a device with changed constants; names such as omega0_left change the constant of one wall.

    Args:
        constants: New values by name.
        checked: Whether to validate the values; False for large arrays of devices, because the checks are slow.
    """
    fields = with_wall_values(device, constants)
    if checked:
        return dataclasses.replace(device, **fields)
    return eqx.tree_at(
        lambda tree: [getattr(tree, name) for name in fields],
        device,
        list(fields.values()),
        is_leaf=lambda leaf: leaf is None,
    )


@public_api
def depth_unit(device: Harvester, pair: ImpactPair) -> PerWall:
    """Compute metres per unit of the recorded depth of an impact, which is for kappa = 1 if both walls are rigid."""
    if pair.rigid:
        return map_walls(lambda omega0: device.length_unit * device.omega / (math.pi * omega0), device.omega0)
    return device.length_unit


def electrical_device(device: Harvester, *, has_unequal_walls: bool = False) -> Harvester:
    """Return a device with only the constants that set the energy of an impact of known depth; other fields are None.

    With `has_unequal_walls`, all remaining per-wall constants are `Sides`, so that all devices have one tree structure.
    """
    if has_unequal_walls:
        names = [name for name in PER_WALL_CONSTANTS if name not in ("omega0", "r")]
        device = with_fields(device, {name: as_sides(getattr(device, name)) for name in names}, checked=False)
    return eqx.tree_at(
        lambda tree: [getattr(tree, name) for name in ("s", "omega0", "r", "A", "omega", "beta", "g", *LIMITS)],
        device,
        [None] * 9,
        is_leaf=lambda leaf: leaf is None,
    )


def check_device(device: Any) -> Harvester:
    """Return the device; raise ValueError if it is not a `Harvester`."""
    return validation.validate_instance("device", device, Harvester, "vijax.Harvester(...)")


def scalar_device(device: Any) -> Harvester:
    """Return a device with scalar constants that are not traced; None gives the device of Tables I and II."""
    if device is None:
        return Harvester()
    check_scalar_constants(validation.validate_untraced("device", check_device(device)), _advice)
    return device


def check_scalar_constants(device: Any, remedy: str | Callable[[str], str]) -> Harvester:
    """Return the device if each of its constants is one number, traced or not.

    Args:
        device: The argument to check.
        remedy: Advice of the error for several devices; or a function that maps the name of a constant to this advice.

    Raises:
        ValueError: "device.s must be one number; got shape (2,); map devices by jax.vmap".
    """
    for name, value in vars(check_device(device)).items():
        for argument, number in values_by_name(name, value).items():
            if number is not None and np.ndim(number):
                advice = remedy if isinstance(remedy, str) else remedy(argument)
                raise ValueError(f"device.{argument} must be one number; got shape {np.shape(number)}; {advice}")
    return device


def _advice(name: str) -> str:
    """Return the remedy for a constant of several numbers where a scalar device is required."""
    return f"{f'give {name} as an axis' if name in AXES else f'{name} is no axis'}, or make a call for each device"
