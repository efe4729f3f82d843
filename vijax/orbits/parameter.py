"""The quantity that a branch is followed along: which constants move with it, and between which bounds.

Of the pair itself it moves alone; of the device it moves several of the pair's constants together.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vijax.model import units
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.quantities import check
from vijax.runtime import checks, tiles
from vijax.runtime.arrays import Values
from vijax.runtime.context import door

# Powers with which d, kappa and gamma go in a quantity of the device, by Eqs. (37)-(38).
_POWERS: dict[str, dict[str, float]] = {
    "omega": {"d": 2, "kappa": -1},
    "omega0": {"kappa": 1},
    "k": {"kappa": 0.5},
    "s": {"d": 1},
    "A": {"d": -1, "gamma": -1},
}
# What moves with each quantity that a branch can be followed along: of the pair itself alone, of the device several.
MOVED: dict[str, tuple[str, ...]] = {name: (name,) for name in ("d", "kappa", "r", "gamma")}
MOVED |= {name: tuple(powers) for name, powers in _POWERS.items()} | {"beta": ("gamma",)}
# When each is moved, of several: the inclination sets gamma, which other quantities of the device change then.
_TURN = {"beta": 0} | {name: 2 for name in ("d", "kappa", "r", "gamma")}


def moved(pair: ImpactPair, along: str, x: Values, start: Values, steepest: Values) -> ImpactPair:
    """Move a parameter of a pair from `start` to x; `steepest` is g/A, gamma of a vertical tube."""
    fields = {name: getattr(pair, name) for name in ("d", "kappa", "r", "gamma")}
    if along == "beta":
        fields["gamma"] = steepest * tiles.library((pair, x)).sin(x)
    elif along not in _POWERS:
        fields[along] = x
    for name, power in _POWERS.get(along, {}).items():
        if fields[name] is not None:  # a rigid wall has no kappa
            fields[name] = fields[name] * (x / start) ** power
    return ImpactPair(**fields)


def moved_together(
    pair: ImpactPair, along: tuple[str, ...], x: tuple[Values, ...], start: tuple[Values, ...], steepest: Values
) -> ImpactPair:
    """Move several parameters of a pair at once; of the pair itself they are last, for what is given stays given."""
    for index in sorted(range(len(along)), key=lambda i: _TURN.get(along[i], 1)):
        pair = moved(pair, along[index], x[index], start[index], steepest)
    return pair


def value_at(pair: ImpactPair, along: str, device: Harvester) -> np.ndarray:
    """Find the parameter's value where a device, by that parameter, has a pair."""
    of, by = jax.tree.map(np.asarray, (pair, device))

    def omega0() -> np.ndarray:
        return of.kappa * by.omega / math.pi

    known: dict[str, Callable[[], Any]] = {
        "omega": lambda: math.pi * np.sqrt(of.d * by.A / by.s),
        "omega0": omega0,
        "k": lambda: by.m_b * omega0() ** 2,
        "s": lambda: of.d * by.length_unit,
        "A": lambda: by.s * (by.omega / math.pi) ** 2 / of.d,
        "beta": lambda: np.arcsin(of.gamma * by.A / by.g),
    }
    return known[along]() if along in known else getattr(of, along)


@door
def pair_at(pair: ImpactPair, along: str, value: float, device: Harvester) -> ImpactPair:
    """Give the pair where the parameter has another value, all else of the device as it is."""
    pair, x, steepest = tiles.arrays(jax.tree.map(np.asarray, (pair, value, device.g / device.A)))
    begun: Any = value_at(pair, along, device)
    return moved(pair, along, x, begun, steepest)


def check_bounds(pair: ImpactPair, along: str, within: tuple[float, float], device: Harvester) -> np.ndarray:
    """Find the parameter's value at a pair; raise ValueError unless it can be followed from there within the bounds."""
    low, high = bounds = check_along(pair, along, within)
    x = value_at(pair, along, device)
    if not ((x >= low) & (x <= high)).all():
        raise ValueError(f"within must hold the start; got {bounds} and {along} = {np.ravel(x)[0]:.6g}")
    return x


def check_along(pair: ImpactPair, along: str, within: tuple[float, float]) -> tuple[float, float]:
    """Take the bounds of a parameter; raise ValueError unless branches of such a pair can be followed between them."""
    stiff = [name for name, several in MOVED.items() if several == ("kappa",) and pair.rigid]
    hint = f"a rigid wall has no {' or '.join(stiff)}" if stiff else ""
    checks.choice("along", along, [name for name in MOVED if name not in stiff], hint)
    bounds = checks.bounds("within", units.plain(along, within))
    for bound in bounds:
        check(along, bound, "within")
    return bounds


def tilts(along: str) -> bool:
    """Say whether gravity along the axis moves alone, and with it the symmetry of the walls goes."""
    return along in ("gamma", "beta")
