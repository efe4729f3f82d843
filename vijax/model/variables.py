"""What of a device is tuned: quantities by name, the variables that an optimiser sees, and their bounds."""

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
from vijax.model.device import CONSTANTS, Harvester, changed
from vijax.model.pair import ImpactPair
from vijax.model.quantities import PARAMETERS, SIDES, check, of_both_walls, whole
from vijax.model.sides import Sides, each, field_of
from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.programs import jitted

ALIASES = {name: axis.alias_of for name, axis in PARAMETERS.items() if axis.alias_of and not axis.given_only}
"""Other names of constants that are tuned, each with its constant: they are set after the constants."""
LINEAR = ("beta", "gamma")  # may be zero or negative: their variable is the value, that of others its logarithm
# Bounds unless given: of kappa, and so of what decides it, the range of README's planes; of r what keeps clear of 0,
# where no speed is left, and of 1, where nothing is lost; of inclinations [rad] to either side of level ground.
_LEAST_KAPPA, _MOST_KAPPA = 2.0, 400.0
_LEAST_R, _MOST_R = 0.05, 0.95
_TILT = 0.1
_OF_ONE_WALL = tuple(name for name in PARAMETERS if of_both_walls(name) and name not in ALIASES)
NAMES = CONSTANTS + _OF_ONE_WALL + tuple(ALIASES)


def constant(name: str) -> str:
    """Name the constant of the device that a name decides."""
    return ALIASES.get(name, name)


def moving(name: str) -> bool:
    """Say whether the motion depends on it, and not the energies alone."""
    return constant(name) in PARAMETERS


@door
def values(names: tuple[str, ...], z: Any) -> Any:
    """Turn variables into values of the quantities, [..., quantity]."""
    plain = np.array([name in LINEAR for name in names])
    return jnp.where(plain, z, jnp.exp(jnp.where(plain, 0.0, z)))


def variables(names: tuple[str, ...], x: Any) -> np.ndarray:
    """Turn values of the quantities into variables, [..., quantity]; the inverse of `values`."""
    plain, x = np.array([name in LINEAR for name in names]), np.asarray(x, float)
    return np.where(plain, x, np.log(np.where(plain, 1.0, x)))


@door
def tuned(device: Harvester, names: tuple[str, ...], z: Any) -> Harvester:
    """Make the device with the quantities that the variables say."""
    given = dict(zip(names, values(names, z), strict=True))
    device = changed(device, {name: x for name, x in given.items() if name not in ALIASES})
    for name in ALIASES:
        if name in given:
            device = _decided(device, name, given[name])
    return device


@partial(jitted, static=("names",))
def cells(devices: Harvester, z: Float[Array, "cell variable"], names: tuple[str, ...]) -> tuple[Harvester, ImpactPair]:
    """Give devices [cell] with the quantities that the variables say, and their pairs."""
    every = jax.vmap(lambda device, z: tuned(device, names, z))(devices, z)
    return every, jax.vmap(lambda device: device.pair())(every)


def _decided(device: Harvester, name: str, x: Any) -> Harvester:
    """Make the device in which a quantity that is no constant has the given value."""
    value = {
        "k": lambda: jnp.sqrt(x / device.m_b),
        "kappa": lambda: x * device.omega / math.pi,
        "d": lambda: x * device.length_unit,
        "gamma": lambda: jnp.arcsin(x * device.A / device.g),
    }[whole(name)]()
    return changed(device, {ALIASES[name]: value})


def scattered(device: Harvester, names: tuple[str, ...], factors: Any) -> Harvester:
    """Return the device in which some quantities are off by factors; those of both walls, or of one."""
    for name, factor in zip(names, factors, strict=True):
        # Each other name is in proportion to its constant, but for k, which goes with the square.
        own, factor = constant(name), jnp.sqrt(factor) if whole(name) == "k" else factor
        off = each(partial(operator.mul, factor), field_of(device, own))
        device = changed(device, {own: off}, checked=False)
    return device


def value_of(device: Harvester, name: str) -> Any:
    """Find the quantity's value in a device."""
    if name not in ALIASES or whole(name) == "k":
        return field_of(device, name)
    return field_of(device.pair(), name)


def check_names(names: tuple[str, ...], argument: str = "tune") -> None:
    """Raise ValueError unless these can be tuned together, or what else they are named for."""
    if not names:
        raise ValueError(f"{argument} must name at least one quantity; got none; omega0 is the membrane's")
    for name in names:
        checks.choice(argument, name, NAMES)
        rivals = [one for one in names if constant(one) in (constant(name), of_both_walls(constant(name)))]
        if len(rivals) > 1:
            raise ValueError(f"{argument} must name a quantity once; got {' and '.join(rivals)}")


def limits(names: tuple[str, ...], bounds: Mapping[str, tuple[float, float]], device: Harvester) -> np.ndarray:
    """Give lower and upper bounds [2, quantity] of the quantities of a device.

    Args:
        names: Checked by `check_names`.
        bounds: Of some; the others are: kappa 2 to 400, r 0.05 to 0.95, inclinations +-0.1 rad, all else half to twice
            what the device has.

    Raises:
        ValueError: Bounds of what is not tuned, or that cannot be.
    """
    if not isinstance(bounds, Mapping):
        raise ValueError(f"bounds must be two numbers by name, as in {{'r': (0.1, 0.9)}}; got {checks.shown(bounds)}")
    for name in bounds:
        if name not in names:
            raise ValueError(f"bounds must be those of a tuned quantity; got {name!r}, not among {', '.join(names)}")
    pairs = [_checked(name, bounds[name], device) if name in bounds else _default(name, device) for name in names]
    return np.array(pairs).T


def _checked(name: str, bounds: tuple[float, float], device: Harvester) -> tuple[float, float]:
    argument = f"bounds of {name}"
    low, high = checks.bounds(argument, units.plain(name, bounds, argument))
    check(name, (low, high), argument)
    steepest = float(device.g) / float(device.A)
    if name == "gamma" and max(abs(low), abs(high)) > steepest:
        raise ValueError(f"bounds of gamma must lie in [-g/A, g/A], here +-{steepest:g}; got {low, high}")
    return low, high


def _default(name: str, device: Harvester) -> tuple[float, float]:
    kappa = np.array([_LEAST_KAPPA, _MOST_KAPPA])
    omega0 = kappa * float(device.omega) / math.pi
    if isinstance(now := value_of(device, name), Sides):
        own = [f"{name}_{side}" for side in SIDES if f"{name}_{side}" in NAMES]
        told = f"{' and '.join(own)}, each or both, where walls differ" if own else "what both walls have alike"
        raise ValueError(f"tune must name {told}; got {name}")
    known: dict[str, Any] = {
        "kappa": kappa,
        "omega0": omega0,
        "k": float(device.m_b) * omega0**2,
        "r": (_LEAST_R, _MOST_R),
        "beta": (-_TILT, _TILT),
        "gamma": np.array([-1, 1]) * math.sin(_TILT) * float(device.g) / float(device.A),
    }
    low, high = known.get(whole(name), (0.5 * float(now), 2 * float(now)))
    return float(low), float(high)
