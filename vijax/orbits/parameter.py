"""The quantity that a branch is followed along: which constants move with it, and between which bounds.

Of the pair itself it moves alone; of the device it moves several of the pair's constants together.
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
from vijax.model.membrane import in_units
from vijax.model.pair import ImpactPair
from vijax.model.quantities import SIDES, check, of_both_walls, whole
from vijax.model.sides import Sides, each, field_of, with_own
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
# Powers with which the units of length and speed go in it; the numbers of a membrane of some law are in these.
_UNIT_POWERS = {"omega": (-2, -1), "A": (1, 1)}
_POWERS |= {f"{name}_{side}": {f"kappa_{side}": _POWERS[name]["kappa"]} for name in ("omega0", "k") for side in SIDES}
_OWN = "d", "kappa", "r", "gamma", "kappa_left", "kappa_right", "r_left", "r_right"
# What moves with each quantity that a branch can be followed along: of the pair itself alone, of the device several.
MOVED: dict[str, tuple[str, ...]] = {name: (name,) for name in _OWN}
MOVED |= {name: tuple(powers) for name, powers in _POWERS.items()} | {"beta": ("gamma",)}
# When each is moved, of several: the inclination sets gamma, which other quantities of the device change then.
_TURN = {"beta": 0} | {name: 2 for name in _OWN}


def moved(pair: ImpactPair, along: str, x: Values, start: Values, steepest: Values) -> ImpactPair:
    """Move a parameter of a pair from `start` to x; `steepest` is g/A, gamma of a vertical tube.

    What both walls have is set at both of them, or goes at both in one proportion.
    """
    if along == "beta":
        return _with(pair, gamma=steepest * tiles.library((pair, x)).sin(x))
    if along in _OWN:
        return _with(pair, **{along: x})
    fields: dict[str, Any] = {}
    for name, power in _POWERS[along].items():
        fields[name] = each(partial(_times, (x / start) ** power), field_of(pair, name))
    if pair.law is not None and along in _UNIT_POWERS:
        law: Any = pair.law
        fields["law"] = in_units(law, *((x / start) ** power for power in _UNIT_POWERS[along]))
    return _with(pair, **fields)


def _times(factor: Values, value: Any) -> Any:
    """Multiply a quantity of a wall; rigid ones have no kappa."""
    return None if value is None else factor * value


def _shared(value: Any) -> Any:
    """Take what both walls have alike."""
    return value.left if isinstance(value, Sides) else value


def _with(pair: ImpactPair, **values: Any) -> ImpactPair:
    """Change fields of a pair, or what one wall has of them."""
    return replace(pair, **with_own(pair, values))


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

    end = along.removeprefix(whole(along))

    def omega0() -> np.ndarray:
        return _shared(field_of(of, f"kappa{end}")) * by.omega / math.pi

    known: dict[str, Callable[[], Any]] = {
        "omega": lambda: math.pi * np.sqrt(of.d * by.A / by.s),
        "omega0": omega0,
        "k": lambda: by.m_b * omega0() ** 2,
        "s": lambda: of.d * by.length_unit,
        "A": lambda: by.s * (by.omega / math.pi) ** 2 / of.d,
        "beta": lambda: np.arcsin(of.gamma * by.A / by.g),
    }
    return known[whole(along)]() if whole(along) in known else _shared(field_of(of, along))


@door
def pair_at(pair: ImpactPair, along: str, value: float, device: Harvester) -> ImpactPair:
    """Give the pair where the parameter has another value, all else of the device as it is."""
    pair, x, steepest = tiles.arrays(jax.tree.map(np.asarray, (pair, value, device.g / device.A)))
    begun: Any = value_at(pair, along, device)
    return moved(pair, along, x, begun, steepest)


def able(orbit: Any, *along: str) -> Any:
    """Give an orbit whose pair can be moved along parameters: with walls of their own where one moves one wall."""
    pair = orbit.pair
    if not any(of_both_walls(name) for name in along if isinstance(name, str)) or pair.unequal:
        return orbit
    return replace(orbit, pair=pair.apart())


def check_bounds(pair: ImpactPair, along: str, within: tuple[float, float], device: Harvester) -> np.ndarray:
    """Find the parameter's value at a pair; raise ValueError unless it can be followed from there within the bounds."""
    low, high = bounds = check_along(pair, along, within)
    x = value_at(pair, along, device)
    if not ((x >= low) & (x <= high)).all():
        raise ValueError(f"within must hold the start; got {bounds} and {along} = {np.ravel(x)[0]:.6g}")
    return x


def check_along(pair: ImpactPair, along: str, within: tuple[float, float]) -> tuple[float, float]:
    """Take the bounds of a parameter; raise ValueError unless branches of such a pair can be followed between them."""
    stiff = [name for name, (first, *_) in MOVED.items() if whole(first) == "kappa" and field_of(pair, first) is None]
    hint = f"a rigid wall has no {' or '.join(dict.fromkeys(map(whole, stiff)))}" if stiff else ""
    lossless = [name for name in MOVED if whole(name) == "r" and pair.r is None]
    hint = "the loss of this membrane is told by its law, not by r" if lossless else hint
    checks.choice("along", along, [name for name in MOVED if name not in (*stiff, *lossless)], hint)
    (first, *more) = MOVED[along]
    both = getattr(pair, first, None)
    if not more and isinstance(both, Sides) and not np.array_equal(both.left, both.right):
        of_walls = " or ".join(f"{along}_{side}" for side in SIDES if f"{along}_{side}" not in stiff)
        raise ValueError(f"along must be {of_walls}, of one wall, where walls differ; got {along!r}")
    bounds = checks.bounds("within", units.plain(along, within, "within"))
    check(along, bounds, "within")
    return bounds


def of_pair(along: str) -> bool:
    """Say whether a parameter is the pair's own, and not the device's."""
    return along in _OWN


def skews(along: str) -> bool:
    """Say whether the symmetry of the walls goes along a parameter: gravity moves alone, or one wall does."""
    return along in ("gamma", "beta") or bool(of_both_walls(along))
