"""The plane in which curves are followed: two parameters between bounds, what is asked of them, and its units."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.quantities import of_both_walls, synonyms
from vijax.model.sides import field_of
from vijax.orbits.events import Point
from vijax.orbits.parameter import check_along, moved_together, of_pair, value_at
from vijax.runtime import checks

# A quantity whose bounds are farther apart than this counts in its logarithm.
_DECADE = 10.0

Plane = dict[str, tuple[float, float]]


def check_plane(pair: Any, within: Any) -> Plane:
    """Take the bounds of two parameters in which curves of such a pair can be followed."""
    if not isinstance(within, Mapping) or len(within) != 2:
        raise ValueError(f"within must give two parameters their bounds; got {checks.shown(within)}")
    plane = {name: check_along(pair, name, bounds) for name, bounds in within.items()}
    one, other = plane
    if {other, of_both_walls(other)} & {*synonyms(one), *(synonyms(of_both_walls(one)) if of_both_walls(one) else ())}:
        raise ValueError(f"within must name two parameters; got {one} and {other}, which say the same; keep one")
    for name, (low, high) in plane.items():
        ends = [_moved(pair, plane, name, value) for value in (low, high)]
        if all(np.array_equal(*both) for both in zip(*map(jax.tree.leaves, ends), strict=True)):
            raise ValueError(
                f"within must name parameters that the orbits depend on; got {name}, which changes none of d, kappa, r "
                f"and gamma where {one if name == other else other} is given"
            )
    return plane


def _moved(pair: Any, plane: Plane, name: str, value: float) -> ImpactPair:
    """Move one parameter of a plane from its lower bound, the other one staying there."""
    host = jax.tree.map(np.asarray, pair)
    low: Any = tuple(np.asarray(bound) for bound, _ in plane.values())
    there: Any = tuple(np.asarray(value) if one == name else bound for one, bound in zip(plane, low, strict=True))
    steepest: Any = np.asarray(1.0)
    return moved_together(host, tuple(plane), there, low, steepest)


def place_of(point: Point, along: str, plane: Plane, device: Harvester) -> tuple[float, float]:
    """Find both parameters at a point of a branch; raise ValueError where the plane does not hold it."""
    pair = point.orbit.pair
    place = []
    for name, (low, high) in plane.items():
        if name == along:
            value = point.value
        elif of_pair(name):
            value = float(np.asarray(value_at(pair, name, device))[0])
        elif along in plane:
            value = float(field_of(device, name))
        else:
            raise ValueError(f"along must be in the plane of {' and '.join(plane)}; got branches along {along}")
        if not low <= value <= high:
            raise ValueError(f"within must hold the points; got {(low, high)} and {name} = {value:.6g}")
        place.append(value)
    return place[0], place[1]


def logarithmic(plane: Plane) -> tuple[bool, ...]:
    """Say which parameters count in their logarithms."""
    return tuple(low > 0 and high > _DECADE * low for low, high in plane.values())


def units(values: np.ndarray, plane: Plane) -> np.ndarray:
    """Measure places in the plane in its sides, from its lower corner."""
    values = np.asarray(values, float)
    columns = []
    for index, ((low, high), logarithm) in enumerate(zip(plane.values(), logarithmic(plane), strict=True)):
        x = values[..., index]
        columns.append(np.log(x / low) / np.log(high / low) if logarithm else (x - low) / (high - low))
    return np.stack(columns, axis=-1)
