"""The parameter along which a branch is followed: the constants of the pair that change with it, and its bounds.

A parameter of the pair itself (d, kappa, r, gamma) changes alone. A quantity q of the device changes several constants
together, as powers of q, by Eqs. (37)-(38) of the paper:

    d ~ s omega^2/A,  kappa ~ omega0/omega,  omega0 ~ sqrt(k),  gamma = g sin(beta)/A.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from vijax.model import units
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.quantities import SIDES, both_walls_name, check, without_wall
from vijax.model.walls.membrane import in_units
from vijax.model.walls.sides import Sides, field_of, map_walls, with_wall_values
from vijax.runtime import tiles, validation
from vijax.runtime.arrays import Values
from vijax.runtime.public_api import public_api

# Exponent of a quantity of the device in d, kappa and gamma, by Eqs. (37)-(38).
_POWERS: dict[str, dict[str, float]] = {
    "omega": {"d": 2, "kappa": -1},
    "omega0": {"kappa": 1},
    "k": {"kappa": 0.5},
    "s": {"d": 1},
    "A": {"d": -1, "gamma": -1},
}
# Exponents of a quantity in the units of length and speed; the constants of a nonlinear membrane law are in these
# units.
_UNIT_POWERS = {"omega": (-2, -1), "A": (1, 1)}
_POWERS |= {f"{name}_{side}": {f"kappa_{side}": _POWERS[name]["kappa"]} for name in ("omega0", "k") for side in SIDES}
_PAIR_PARAMETERS = "d", "kappa", "r", "gamma", "kappa_left", "kappa_right", "r_left", "r_right"
# Constants of the pair that change with each quantity along which a branch can be followed.
AFFECTED_CONSTANTS: dict[str, tuple[str, ...]] = {name: (name,) for name in _PAIR_PARAMETERS}
AFFECTED_CONSTANTS |= {name: tuple(powers) for name, powers in _POWERS.items()} | {"beta": ("gamma",)}
# Order of the changes of several parameters, smallest first (1 by default): the inclination must come first, because it
# sets gamma, which other quantities then scale.
_ORDER = {"beta": 0} | {name: 2 for name in _PAIR_PARAMETERS}


def set_parameter(pair: ImpactPair, along: str, x: Values, start: Values, vertical_gamma: Values) -> ImpactPair:
    """Return a pair with a parameter changed from `start` to `x`.

    A parameter of both walls is set at both of them; a power law scales both walls by the same factor.

    Args:
        pair: The pair at `start`.
        along: Name of the parameter.
        x, start: New and old value.
        vertical_gamma: g/A, which is gamma of a vertical tube (used along "beta" only).
    """
    if along == "beta":
        return _replace_fields(pair, gamma=vertical_gamma * tiles.array_namespace((pair, x)).sin(x))
    if along in _PAIR_PARAMETERS:
        return _replace_fields(pair, **{along: x})
    fields: dict[str, Any] = {}
    # Constants that follow a power law scale by (x / start)^power.
    for name, power in _POWERS[along].items():
        fields[name] = map_walls(partial(_times, (x / start) ** power), field_of(pair, name))
    # A nonlinear law is expressed in the units of length and speed, which change with omega and A.
    if pair.law is not None and along in _UNIT_POWERS:
        law: Any = pair.law
        fields["law"] = in_units(law, *((x / start) ** power for power in _UNIT_POWERS[along]))
    return _replace_fields(pair, **fields)


def _times(factor: Values, value: Any) -> Any:
    """Multiply a quantity of a wall by a factor; rigid walls have no kappa."""
    return None if value is None else factor * value


def _common_value(value: Any) -> Any:
    """Return the value that both walls have."""
    return value.left if isinstance(value, Sides) else value


def _replace_fields(pair: ImpactPair, **values: Any) -> ImpactPair:
    """Return a pair with replaced fields; a name such as "kappa_left" replaces the value of one wall."""
    return replace(pair, **with_wall_values(pair, values))


def set_parameters(
    pair: ImpactPair, along: tuple[str, ...], x: tuple[Values, ...], start: tuple[Values, ...], vertical_gamma: Values
) -> ImpactPair:
    """Return a pair with several parameters changed at once.

    Parameters of the pair itself are set last, so that a specified value is not scaled by another parameter.
    """
    for index in sorted(range(len(along)), key=lambda i: _ORDER.get(along[i], 1)):
        pair = set_parameter(pair, along[index], x[index], start[index], vertical_gamma)
    return pair


def value_at(pair: ImpactPair, along: str, device: Harvester) -> np.ndarray:
    """Return the value of the parameter at a pair; a quantity of the device follows from its other constants."""
    pair_host, device_host = jax.tree.map(np.asarray, (pair, device))

    wall_suffix = along.removeprefix(without_wall(along))

    def omega0() -> np.ndarray:
        return _common_value(field_of(pair_host, f"kappa{wall_suffix}")) * device_host.omega / math.pi

    values: dict[str, Callable[[], Any]] = {
        "omega": lambda: math.pi * np.sqrt(pair_host.d * device_host.A / device_host.s),
        "omega0": omega0,
        "k": lambda: device_host.m_b * omega0() ** 2,
        "s": lambda: pair_host.d * device_host.length_unit,
        "A": lambda: device_host.s * (device_host.omega / math.pi) ** 2 / pair_host.d,
        "beta": lambda: np.arcsin(pair_host.gamma * device_host.A / device_host.g),
    }
    return values[without_wall(along)]() if without_wall(along) in values else _common_value(field_of(pair_host, along))


@public_api
def pair_at(pair: ImpactPair, along: str, value: float, device: Harvester) -> ImpactPair:
    """Return the pair at another value of the parameter, with all other constants of the device unchanged."""
    pair, x, vertical_gamma = tiles.arrays(jax.tree.map(np.asarray, (pair, value, device.g / device.A)))
    start: Any = value_at(pair, along, device)
    return set_parameter(pair, along, x, start, vertical_gamma)


def with_separate_walls(orbit: Any, *along: str) -> Any:
    """Return an orbit with a pair that has separate values per wall, if one of the parameters belongs to one wall."""
    pair = orbit.pair
    if not any(both_walls_name(name) for name in along if isinstance(name, str)) or pair.has_unequal_walls:
        return orbit
    return replace(orbit, pair=pair.with_sides())


def check_bounds(pair: ImpactPair, along: str, within: tuple[float, float], device: Harvester) -> np.ndarray:
    """Return the value of the parameter at a pair.

    Raises:
        ValueError: The parameter cannot be followed, or the value lies outside the bounds.
    """
    low, high = bounds = check_along(pair, along, within)
    x = value_at(pair, along, device)
    if not ((x >= low) & (x <= high)).all():
        raise ValueError(f"within must hold the start; got {bounds} and {along} = {np.ravel(x)[0]:.6g}")
    return x


def check_along(pair: ImpactPair, along: str, within: tuple[float, float]) -> tuple[float, float]:
    """Return the bounds of a parameter as numbers.

    Raises:
        ValueError: The pair does not have the parameter, its two walls have different values of it, or a bound is
            invalid.
    """
    # A rigid wall has no kappa; a nonlinear membrane may have its own loss in place of r.
    missing_kappas = [
        name
        for name, (first, *_) in AFFECTED_CONSTANTS.items()
        if without_wall(first) == "kappa" and field_of(pair, first) is None
    ]
    hint = (
        f"a rigid wall has no {' or '.join(dict.fromkeys(map(without_wall, missing_kappas)))}" if missing_kappas else ""
    )
    missing_r = [name for name in AFFECTED_CONSTANTS if without_wall(name) == "r" and pair.r is None]
    hint = "the law of this membrane specifies its loss, not r" if missing_r else hint
    validation.validate_choice(
        "along", along, [name for name in AFFECTED_CONSTANTS if name not in (*missing_kappas, *missing_r)], hint
    )
    (first, *others) = AFFECTED_CONSTANTS[along]
    per_wall = getattr(pair, first, None)
    if not others and isinstance(per_wall, Sides) and not np.array_equal(per_wall.left, per_wall.right):
        wall_names = " or ".join(f"{along}_{side}" for side in SIDES if f"{along}_{side}" not in missing_kappas)
        raise ValueError(f"along must be {wall_names}, of one wall, where walls differ; got {along!r}")
    # Quantities of pint become numbers.
    bounds = validation.validate_bounds("within", units.plain_number(along, within, "within"))
    check(along, bounds, "within")
    return bounds


def is_pair_parameter(along: str) -> bool:
    """Return True if a parameter belongs to the pair, False if it is a quantity of the device."""
    return along in _PAIR_PARAMETERS


def breaks_mirror_symmetry(along: str) -> bool:
    """Return True if a change of the parameter breaks the mirror symmetry: only gravity or one wall changes."""
    return along in ("gamma", "beta") or bool(both_walls_name(along))
