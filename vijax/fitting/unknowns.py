"""The unknowns of a fit: their names, the variables of the search, and their limits."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.model.quantities import QUANTITIES, without_wall
from vijax.model.tuned_quantities import (
    LINEAR,
    NAMES,
    affects_motion,
    check_names,
    to_values,
    to_variables,
    tune_device,
    value_of,
)
from vijax.model.walls.sides import Sides
from vijax.runtime import validation

DELAY = "delay"
"""The unknown that is not a constant of a device: the lag of the clock of the times behind the clock of the excitation.

It is the last of the names. Its variable is in half forcing periods of the specified device.
"""

UNKNOWN = (*(name for name in NAMES if affects_motion(name)), DELAY)
"""Permitted unknowns: all constants that the motion depends on, and the delay."""

# Largest change of a (logarithmic) variable from the start, a factor of 20 in the quantity; inclinations and delays
# have their own limits.
_FAR = 3.0
_LEAST_R = 1e-3


def half_period(device: Harvester) -> float:
    """Return half of a forcing period [s]."""
    return math.pi / float(device.omega)


def unit_of(name: str) -> str:
    """Return the SI unit of an unknown."""
    return "s" if name == DELAY else QUANTITIES[name].unit


def validate_names(unknown: str | Iterable[str], device: Harvester, wall: Walls) -> tuple[str, ...]:
    """Validate the names of the unknowns, and move the delay to the end.

    Raises:
        ValueError: With the name and the remedy.
    """
    unordered = validation.validate_choices("unknown", unknown, UNKNOWN)
    if unordered.count(DELAY) > 1:
        raise ValueError(f"unknown must name a quantity once; got {DELAY} and {DELAY}")
    names = constants(unordered)
    if names:
        check_names(names, "unknown")
    for name in names:
        is_rigid = wall == "rigid" or name.endswith(f"_{wall.removeprefix('rigid_')}")
        if is_rigid and without_wall(name) in ("kappa", "omega0", "k"):
            raise ValueError(f'unknown must have an effect at rigid walls; got {name}; wall="soft" has membranes')
        if isinstance(value_of(device, name), Sides):
            raise ValueError(f"unknown must name {name}_left or {name}_right, or both, as walls differ; got {name}")
    return names + (DELAY,) * (DELAY in unordered)


def constants(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the unknowns that are constants of the device."""
    return tuple(name for name in names if name != DELAY)


def device_with(device: Harvester, names: tuple[str, ...], z: Any) -> Harvester:
    """Return the device with the constants that the variables specify."""
    device_names = constants(names)
    return tune_device(device, device_names, z[: len(device_names)]) if device_names else device


def variables_of_device(device: Harvester, names: tuple[str, ...]) -> np.ndarray:
    """Return the variables of the specified device, with delay 0."""
    device_names = constants(names)
    z = (
        to_variables(device_names, [float(value_of(device, name)) for name in device_names])
        if device_names
        else np.zeros(0)
    )
    return np.append(z, [0.0] * (DELAY in names))


def limits(device: Harvester, names: tuple[str, ...]) -> np.ndarray:
    """Return the least and the largest variables of the search [2, unknown]."""
    # The limits of gamma and beta keep gravity along the axis below g: sin(beta) < 1.
    widths = {"beta": 0.49 * math.pi, "gamma": 0.99 * float(device.g / device.A), DELAY: 1.0}
    bounds = []
    for name, x in zip(names, variables_of_device(device, names), strict=True):
        if without_wall(name) == "r":
            # The variable of r is its logarithm: r from `_LEAST_R` to 1.
            bounds.append((math.log(_LEAST_R), 0.0))
        elif name in widths:
            bounds.append((-widths[name], widths[name]))
        else:
            bounds.append((x - _FAR, x + _FAR))
    return np.array(bounds).T


def si_values(device: Harvester, names: tuple[str, ...], z: np.ndarray) -> dict[str, float]:
    """Convert variables to values in SI units."""
    device_names = constants(names)
    si = (
        dict(zip(device_names, np.atleast_1d(to_values(device_names, z[: len(device_names)])).tolist(), strict=True))
        if device_names
        else {}
    )
    return si | ({DELAY: float(z[-1]) * half_period(device)} if DELAY in names else {})


def per_variable(device: Harvester, names: tuple[str, ...], z: np.ndarray) -> np.ndarray:
    """Return the derivative of each value by its variable."""
    # Logarithmic variables: d(value)/d(log value) = value.
    scales = {name: 1.0 if name in LINEAR else value for name, value in si_values(device, names, z).items()}
    return np.array([half_period(device) if name == DELAY else scales[name] for name in names])
