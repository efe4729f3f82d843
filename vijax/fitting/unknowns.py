"""What is looked for: its names, the variables that a search sees, and their limits."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.model.quantities import QUANTITIES, whole
from vijax.model.sides import Sides
from vijax.model.variables import LINEAR, NAMES, check_names, moving, tuned, value_of, values, variables
from vijax.runtime import checks

DELAY = "delay"
"""The unknown that is no constant of a device: by how much the clock of the times is behind that of the excitation.

Among names it comes last. Its variable is in half forcing periods of the device as it is known.
"""

UNKNOWN = (*(name for name in NAMES if moving(name)), DELAY)
"""What may be unknown: all that the motion depends on, and the clock."""

# Variables may move by so much from where they begin, a factor of 20; those of inclinations and delays need not.
_FAR = 3.0
_LEAST_R = 1e-3


def half_period(device: Harvester) -> float:
    """Compute half of a forcing period [s]."""
    return math.pi / float(device.omega)


def unit_of(name: str) -> str:
    """Name the SI unit of an unknown."""
    return "s" if name == DELAY else QUANTITIES[name].unit


def take_names(unknown: str | Iterable[str], device: Harvester, wall: Walls) -> tuple[str, ...]:
    """Check the names of the unknowns, and put the delay last.

    Raises:
        ValueError: Which, and what to do.
    """
    given = checks.words("unknown", unknown, UNKNOWN)
    if given.count(DELAY) > 1:
        raise ValueError(f"unknown must name a quantity once; got {DELAY} and {DELAY}")
    names = constants(given)
    if names:
        check_names(names, "unknown")
    for name in names:
        hard = wall == "rigid" or name.endswith(f"_{wall.removeprefix('rigid_')}")
        if hard and whole(name) in ("kappa", "omega0", "k"):
            raise ValueError(f'unknown must be told by rigid walls; got {name}; wall="soft" has membranes')
        if isinstance(value_of(device, name), Sides):
            raise ValueError(f"unknown must name {name}_left or {name}_right, or both, as walls differ; got {name}")
    return names + (DELAY,) * (DELAY in given)


def constants(names: tuple[str, ...]) -> tuple[str, ...]:
    """List the unknowns that are constants of the device."""
    return tuple(name for name in names if name != DELAY)


def made(device: Harvester, names: tuple[str, ...], z: Any) -> Harvester:
    """Make the device that the variables say."""
    own = constants(names)
    return tuned(device, own, z[: len(own)]) if own else device


def known(device: Harvester, names: tuple[str, ...]) -> np.ndarray:
    """Give the variables of a device as it is known, whose clock is right."""
    own = constants(names)
    z = variables(own, [float(value_of(device, name)) for name in own]) if own else np.zeros(0)
    return np.append(z, [0.0] * (DELAY in names))


def limits(device: Harvester, names: tuple[str, ...]) -> np.ndarray:
    """Give the least and the largest variables that are looked at [2, unknown]."""
    widths = {"beta": 0.49 * math.pi, "gamma": 0.99 * float(device.g / device.A), DELAY: 1.0}
    found = []
    for name, x in zip(names, known(device, names), strict=True):
        if whole(name) == "r":
            found.append((math.log(_LEAST_R), 0.0))
        elif name in widths:
            found.append((-widths[name], widths[name]))
        else:
            found.append((x - _FAR, x + _FAR))
    return np.array(found).T


def natural(device: Harvester, names: tuple[str, ...], z: np.ndarray) -> dict[str, float]:
    """Turn variables into values in SI units."""
    own = constants(names)
    found = dict(zip(own, np.atleast_1d(values(own, z[: len(own)])).tolist(), strict=True)) if own else {}
    return found | ({DELAY: float(z[-1]) * half_period(device)} if DELAY in names else {})


def per_variable(device: Harvester, names: tuple[str, ...], z: np.ndarray) -> np.ndarray:
    """Compute how much each value changes with its variable."""
    scales = {name: 1.0 if name in LINEAR else value for name, value in natural(device, names, z).items()}
    return np.array([half_period(device) if name == DELAY else scales[name] for name in names])
