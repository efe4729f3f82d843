"""The parameter plane of curves: two parameters with bounds, their validation, and their units."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from vijax.continuation.branch_events import Point
from vijax.continuation.continuation_parameter import check_along, is_pair_parameter, set_parameters, value_at
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.quantities import both_walls_name, synonyms
from vijax.model.walls.sides import field_of
from vijax.runtime import validation

# Ratio of the bounds above which the logarithm of a parameter is scaled to the unit square.
_DECADE = 10.0

Plane = dict[str, tuple[float, float]]


def check_plane(pair: Any, within: Any) -> Plane:
    """Return the bounds of two parameters, if curves of such a pair can be followed between them."""
    if not isinstance(within, Mapping) or len(within) != 2:
        raise ValueError(f"within must specify bounds of two parameters; got {validation.value_text(within)}")
    plane = {name: check_along(pair, name, bounds) for name, bounds in within.items()}
    first_name, second_name = plane
    if {second_name, both_walls_name(second_name)} & {
        *synonyms(first_name),
        *(synonyms(both_walls_name(first_name)) if both_walls_name(first_name) else ()),
    }:
        raise ValueError(
            f"within must name two parameters; got {first_name} and {second_name}, "
            "which are the same parameter; keep one"
        )
    for name, (low, high) in plane.items():
        # A parameter that changes nothing in the pair at its two bounds has no effect on the orbits.
        ends = [_pair_at_bound(pair, plane, name, value) for value in (low, high)]
        if all(np.array_equal(*both) for both in zip(*map(jax.tree.leaves, ends), strict=True)):
            raise ValueError(
                f"within must name parameters that the orbits depend on; got {name}, which changes none of d, kappa, r "
                f"and gamma where {first_name if name == second_name else second_name} is given"
            )
    return plane


def _pair_at_bound(pair: Any, plane: Plane, name: str, value: float) -> ImpactPair:
    """Return the pair with one parameter of a plane at a value, and the other one at its lower bound."""
    pair_host = jax.tree.map(np.asarray, pair)
    lower_bounds: Any = tuple(np.asarray(bound) for bound, _ in plane.values())
    values: Any = tuple(
        np.asarray(value) if item == name else bound for item, bound in zip(plane, lower_bounds, strict=True)
    )
    # Any positive value is suitable, because only the dependence on the parameter is tested.
    vertical_gamma: Any = np.asarray(1.0)
    return set_parameters(pair_host, tuple(plane), values, lower_bounds, vertical_gamma)


def point_parameters(point: Point, along: str, plane: Plane, device: Harvester) -> tuple[float, float]:
    """Return both parameters at a point of a branch.

    Raises:
        ValueError: The point lies outside of the plane, or the branch is along another parameter.
    """
    pair = point.orbit.pair
    parameters = []
    for name, (low, high) in plane.items():
        if name == along:
            value = point.value
        # The other parameter: if it belongs to the pair, it is read from the orbit; otherwise it is a constant of the
        # device.
        elif is_pair_parameter(name):
            value = float(np.asarray(value_at(pair, name, device))[0])
        elif along in plane:
            value = float(field_of(device, name))
        else:
            raise ValueError(f"along must be in the plane of {' and '.join(plane)}; got branches along {along}")
        if not low <= value <= high:
            raise ValueError(f"within must hold the points; got {(low, high)} and {name} = {value:.6g}")
        parameters.append(value)
    return parameters[0], parameters[1]


def logarithmic(plane: Plane) -> tuple[bool, ...]:
    """Return for each parameter whether its logarithm, not its value, is scaled to the unit square."""
    return tuple(low > 0 and high > _DECADE * low for low, high in plane.values())


def to_unit_square(values: np.ndarray, plane: Plane) -> np.ndarray:
    """Return parameters in units of the plane: 0 at the lower bound, 1 at the upper one."""
    values = np.asarray(values, float)
    columns = []
    for index, ((low, high), is_logarithmic) in enumerate(zip(plane.values(), logarithmic(plane), strict=True)):
        x = values[..., index]
        columns.append(np.log(x / low) / np.log(high / low) if is_logarithmic else (x - low) / (high - low))
    return np.stack(columns, axis=-1)
