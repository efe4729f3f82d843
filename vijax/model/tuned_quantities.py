"""Tuned quantities of a device: their names, the variables z of an optimiser, and their bounds.

The variable of a positive quantity is its logarithm, z = ln x; quantities in `LINEAR` are their own variables.
"""

import math
import operator
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.model import units
from vijax.model.device import CONSTANTS, Harvester, with_fields
from vijax.model.pair import ImpactPair
from vijax.model.quantities import PARAMETERS, SIDES, both_walls_name, check, without_wall
from vijax.model.walls.sides import Sides, field_of, map_walls
from vijax.runtime import validation
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.public_api import public_api

ALIASES = {name: axis.alias_of for name, axis in PARAMETERS.items() if axis.alias_of and not axis.input_only}
"""Tunable names that are not constants, each with the constant it determines; set after the constants."""
LINEAR = ("beta", "gamma")  # zero or negative values are possible, hence no logarithm
# Default bounds. kappa, and its synonyms: the range of the maps of the README. r: away from 0, where an impact takes
# all speed, and from 1, where it takes none. Inclination [rad]: both sides of level ground.
_LEAST_KAPPA, _MOST_KAPPA = 2.0, 400.0
_LEAST_R, _MOST_R = 0.05, 0.95
_TILT = 0.1
_PER_WALL_NAMES = tuple(name for name in PARAMETERS if both_walls_name(name) and name not in ALIASES)
NAMES = CONSTANTS + _PER_WALL_NAMES + tuple(ALIASES)


def constant(name: str) -> str:
    """Return the constant of the device that a name determines."""
    return ALIASES.get(name, name)


def affects_motion(name: str) -> bool:
    """Return True if the motion depends on the quantity, False if only the energies depend on it."""
    return constant(name) in PARAMETERS


@public_api
def to_values(names: tuple[str, ...], z: Any) -> Any:
    """Convert variables to values of the quantities, [..., quantity]."""
    linear = np.array([name in LINEAR for name in names])
    # exp gets 0 in linear components, so that large values there cannot overflow and make the gradient NaN.
    return jnp.where(linear, z, jnp.exp(jnp.where(linear, 0.0, z)))


def to_variables(names: tuple[str, ...], x: Any) -> np.ndarray:
    """Convert values of the quantities to variables, [..., quantity]; the inverse of `to_values`."""
    linear, x = np.array([name in LINEAR for name in names]), np.asarray(x, float)
    return np.where(linear, x, np.log(np.where(linear, 1.0, x)))


@public_api
def tune_device(device: Harvester, names: tuple[str, ...], z: Any) -> Harvester:
    """Return the device with the quantities `names` set by the variables z."""
    quantities = dict(zip(names, to_values(names, z), strict=True))
    device = with_fields(device, {name: x for name, x in quantities.items() if name not in ALIASES})
    # Aliases are set last, because their constants depend on m_b, A, omega and g, which may be tuned in the same call.
    for name in ALIASES:
        if name in quantities:
            device = _with_alias(device, name, quantities[name])
    return device


@partial(jitted, static=("names",))
def tuned_devices_and_pairs(
    devices: Harvester, z: Float[Array, "cell variable"], names: tuple[str, ...]
) -> tuple[Harvester, ImpactPair]:
    """Return the devices [cell] with the quantities `names` set by the variables, and their pairs."""
    tuned_devices = jax.vmap(lambda device, z: tune_device(device, names, z))(devices, z)
    return tuned_devices, jax.vmap(lambda device: device.pair())(tuned_devices)


def _with_alias(device: Harvester, name: str, x: Any) -> Harvester:
    """Return the device with the value x of a quantity that is not a constant, such as kappa."""
    value = {
        # Inverses of k = m_b omega0^2, kappa = omega0 pi/omega, d = s/length_unit and gamma = g sin(beta)/A.
        "k": lambda: jnp.sqrt(x / device.m_b),
        "kappa": lambda: x * device.omega / math.pi,
        "d": lambda: x * device.length_unit,
        "gamma": lambda: jnp.arcsin(x * device.A / device.g),
    }[without_wall(name)]()
    return with_fields(device, {ALIASES[name]: value})


def with_factors(device: Harvester, names: tuple[str, ...], factors: Any) -> Harvester:
    """Return the device with some quantities, of both walls or of one wall, multiplied by factors."""
    for name, factor in zip(names, factors, strict=True):
        # Every name is proportional to its constant, except k, which is proportional to omega0 squared.
        constant_name, factor = constant(name), jnp.sqrt(factor) if without_wall(name) == "k" else factor
        perturbed = map_walls(partial(operator.mul, factor), field_of(device, constant_name))
        device = with_fields(device, {constant_name: perturbed}, checked=False)
    return device


def value_of(device: Harvester, name: str) -> Any:
    """Return the value of the quantity in a device."""
    if name not in ALIASES or without_wall(name) == "k":
        return field_of(device, name)
    return field_of(device.pair(), name)


def check_names(names: tuple[str, ...], argument: str = "tune") -> None:
    """Raise ValueError unless the quantities can be tuned together, or used together in `argument`."""
    if not names:
        raise ValueError(f"{argument} must name at least one quantity; got none; omega0 is the membrane's")
    for name in names:
        validation.validate_choice(argument, name, NAMES)
        # kappa conflicts with omega0, and also with omega0_left: both determine the same constant of a wall.
        conflicts = [other for other in names if constant(other) in (constant(name), both_walls_name(constant(name)))]
        if len(conflicts) > 1:
            raise ValueError(f"{argument} must name a quantity once; got {' and '.join(conflicts)}")


def bounds_of(names: tuple[str, ...], bounds: Mapping[str, tuple[float, float]], device: Harvester) -> np.ndarray:
    """Return lower and upper bounds [2, quantity] of the tuned quantities of a device.

    Args:
        names: Names, checked by `check_names`.
        bounds: Bounds of some quantities. The default bounds are kappa 2 to 400, r 0.05 to 0.95, inclinations +-0.1
            rad, and for any other quantity half to twice its value in the device.
        device: The device.

    Raises:
        ValueError: If bounds are specified for a quantity that is not tuned, or are out of its range.
    """
    if not isinstance(bounds, Mapping):
        raise ValueError(
            f"bounds must be two numbers by name, as in {{'r': (0.1, 0.9)}}; got {validation.value_text(bounds)}"
        )
    for name in bounds:
        if name not in names:
            raise ValueError(f"bounds must be of a tuned quantity; got {name!r}, not among {', '.join(names)}")
    pairs = [_checked(name, bounds[name], device) if name in bounds else _default(name, device) for name in names]
    return np.array(pairs).T


def _checked(name: str, bounds: tuple[float, float], device: Harvester) -> tuple[float, float]:
    argument = f"bounds of {name}"
    low, high = validation.validate_bounds(argument, units.plain_number(name, bounds, argument))
    check(name, (low, high), argument)
    # gamma = g sin(beta)/A is at most g/A.
    steepest = float(device.g) / float(device.A)
    if name == "gamma" and max(abs(low), abs(high)) > steepest:
        raise ValueError(f"bounds of gamma must lie in [-g/A, g/A], here +-{steepest:g}; got {low, high}")
    return low, high


def _default(name: str, device: Harvester) -> tuple[float, float]:
    kappa = np.array([_LEAST_KAPPA, _MOST_KAPPA])
    omega0 = kappa * float(device.omega) / math.pi
    # No single default exists for two different values; the caller must name the walls.
    if isinstance(now := value_of(device, name), Sides):
        per_wall = [f"{name}_{side}" for side in SIDES if f"{name}_{side}" in NAMES]
        advice = (
            f"{' and '.join(per_wall)}, each or both, where walls differ" if per_wall else "what both walls have alike"
        )
        raise ValueError(f"tune must name {advice}; got {name}")
    special: dict[str, Any] = {
        "kappa": kappa,
        "omega0": omega0,
        "k": float(device.m_b) * omega0**2,
        "r": (_LEAST_R, _MOST_R),
        "beta": (-_TILT, _TILT),
        "gamma": np.array([-1, 1]) * math.sin(_TILT) * float(device.g) / float(device.A),
    }
    # Every other quantity: half to twice its present value.
    low, high = special.get(without_wall(name), (0.5 * float(now), 2 * float(now)))
    return float(low), float(high)
