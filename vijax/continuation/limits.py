"""Orbits at a limit of a device: an impact has the largest admissible penetration or harvested energy.

The formula of the power P is admissible if no impact j is deeper than the penetration limit, and if its harvested
energy E_j is at most `energy_ratio_limit` times the work W_j that the ball does on the membrane. `limit_points` locates
orbits near a limit on branches; curves of such orbits in two parameters start there.
"""

from functools import reduce
from typing import Any

import jax
import numpy as np

from vijax.continuation.branch_continuation import Branch
from vijax.continuation.branch_events import Point
from vijax.continuation.continuation_parameter import breaks_mirror_symmetry, is_pair_parameter
from vijax.continuation.curves.curve_starts import CurveStart
from vijax.model.device import Harvester, depth_unit, scalar_device, with_constants
from vijax.model.energy import energy_ratio, harvested_energy
from vijax.model.records import Status
from vijax.model.walls.sides import at_wall
from vijax.orbits import symmetry
from vijax.orbits.periodic import Orbit
from vijax.runtime import tiles, validation
from vijax.runtime.public_api import public_api

LIMITS = ("penetration limit", "energy limit")
"""Kinds of points and of curves at a limit."""

_ALIKE = 1e-9  # Impacts with load ratios that differ by less have equal load; rounding errors are far smaller.


def load_ratios(orbit: Orbit, device: Harvester) -> dict[str, np.ndarray]:
    """Compute the depth and energy of each impact, divided by its limit, [orbit, impact]; 0 for padding.

    Args:
        orbit: Orbits; NaN where the status is not OK.
        device: The device; its constants are numbers, or have shape [orbit, 1].

    Returns:
        The ratios by the names in `LIMITS`: depth over the penetration limit, and E_j / W_j over `energy_ratio_limit`.
    """
    depth, work = np.asarray(orbit.depth), np.asarray(orbit.work)
    side, mirrored = np.asarray(orbit.sequence.side), np.asarray(orbit.sequence.mirrored)
    # Of a symmetric orbit stored as half a period (`mirrored`) the other half is the mirror image, so each stored
    # impact also occurs at the other wall. If the walls differ, the larger ratio counts.
    impact_walls = [side, np.where(mirrored[:, None], -side, side)] if device.has_unequal_walls else [side]
    # Nondimensional depth to metres; for rigid walls the unit of the depth includes omega0 of the wall.
    metres = depth * np.asarray(at_wall(depth_unit(device, orbit.pair), side))
    largest_energy = reduce(
        np.maximum, [np.asarray(harvested_energy(device.at(wall), metres)) for wall in impact_walls]
    )
    least_depth_limit = reduce(np.minimum, [np.asarray(at_wall(device.depth_limit, wall)) for wall in impact_walls])
    energy, work_joule = tiles.arrays((largest_energy, work * np.asarray(device.m_b * device.speed_unit**2)))
    ratios = {
        LIMITS[0]: metres / least_depth_limit,
        LIMITS[1]: np.asarray(energy_ratio(energy, work_joule)) / np.asarray(device.energy_ratio_limit),
    }
    real = np.asarray(orbit.sequence.real)
    # Padding is NaN in depth and work; 0 keeps the largest ratio of an orbit valid.
    return {kind: np.where(real, load, 0.0) for kind, load in ratios.items()}


@public_api
def limit_points(branches: list[Branch], *, device: Harvester | None = None) -> list[Point]:
    """Find the orbits of branches next to a crossing of a limit of a device, as starts for `follow_curves`.

    The limits are the conditions of `admissible`: no impact is deeper than the penetration limit, and none harvests
    more than the fraction `energy_ratio_limit` of the energy that it gives to the membrane.

    Args:
        branches: As `vijax.follow_families` returns them.
        device: The device with the limits; the same as for the branches.

    Returns:
        For every crossing the nearer one of the two orbits on either side of it, with `kind` "penetration limit" or
        "energy limit". `follow_curves` corrects this orbit onto the limit.
    """
    device = scalar_device(device)
    return [
        point
        for branch in validation.validate_records(
            "branches", branches, Branch, "branches, as vijax.follow_families returns them"
        )
        for point in _crossings(branch, device)
    ]


def _crossings(branch: Branch, device: Harvester) -> list[Point]:
    points = []
    for kind, load in load_ratios(
        branch.orbit, device_with_value(device, branch.along, branch.values[:, None])
    ).items():
        over = load.max(axis=1) - 1
        # A sign change between neighbours on the branch marks a crossing. A product with NaN is not negative.
        for index in np.flatnonzero(over[:-1] * over[1:] < 0):
            nearer = int(index) + int(abs(over[index + 1]) < abs(over[index]))
            points.append(Point(kind, float(branch.values[nearer]), branch.orbit[nearer : nearer + 1]))
    return points


def device_with_value(device: Harvester, along: str, values: Any) -> Harvester:
    """Return the device with other values of a parameter, or the device itself if the parameter belongs to the pair."""
    if is_pair_parameter(along):
        return device
    return with_constants(device, **{along: tiles.arrays(np.asarray(values, float))})


def limit_start(
    point: Point, parameters: tuple[float, float], plane: tuple[str, ...], device: Harvester, asymmetry: float
) -> CurveStart | str:
    """Return a start of a curve from an orbit near a limit, or a text with the reason why no curve can start there.

    Args:
        point: The orbit.
        parameters, plane: The values of the two parameters there, and their names.
        device, asymmetry: See `follow_curves`.
    """
    orbit = point.orbit
    if int(orbit.status[0]) != Status.OK:
        return "its orbit is not verified"
    mirrored = bool(orbit.sequence.mirrored[0])
    if any(map(breaks_mirror_symmetry, plane)):
        orbit = symmetry.unfold(orbit)
    elif not mirrored and bool(symmetry.is_symmetric(orbit, asymmetry)[0]):
        # An impact and its mirror image reach the limit together. If only half of the orbit is stored, just one of the
        # two remains.
        orbit = symmetry.close_half_way(orbit, asymmetry)
    for name, value in zip(plane, parameters, strict=True):
        # The ratio is evaluated with the device's own values of both parameters.
        device = device_with_value(device, name, value)
    return CurveStart(point.kind, orbit, parameters, int(load_ratios(orbit, device)[point.kind][0].argmax()))


def impacts_with_equal_load(
    starts: list[CurveStart], orbit: Orbit, plane: tuple[str, ...], device: Harvester
) -> np.ndarray:
    """Return which impacts [start, impact] have the same load ratio as the start's impact at the limit.

    The impact itself and padding are True. In a 1:1 orbit between rigid walls both impacts have the same ratio, even if
    the orbit is not symmetric. If a parameter of the plane breaks the mirror symmetry, no two ratios remain equal along
    a curve, so that all other impacts are False.
    """
    for index, name in enumerate(plane):
        device = device_with_value(device, name, np.array([[start.parameters[index]] for start in starts]))
    # All starts of a batch belong to one kind of limit.
    load, rows = load_ratios(orbit, device)[starts[0].kind], np.arange(len(starts))
    impact = np.array([start.impact for start in starts])
    is_close = np.abs(load - load[rows, impact][:, None]) < _ALIKE
    is_itself = np.arange(load.shape[1]) == impact[:, None]
    return is_itself | ~np.asarray(orbit.sequence.real) | (is_close & (not any(map(breaks_mirror_symmetry, plane))))


def starts_near_limits(
    orbit: Orbit, device: Harvester, plane: tuple[str, ...], parameters: np.ndarray, within: float
) -> list[CurveStart]:
    """Return curve starts from the orbits that are near a limit.

    Args:
        orbit: Verified orbits; symmetric orbits are reduced to half a period (`symmetry.close_half_way`).
        device: The device of the map.
        plane: Names of both parameters.
        parameters: Their values, one row for each orbit.
        within: Largest distance, as a fraction of the limit.
    """
    for index, name in enumerate(plane):
        device = device_with_value(device, name, parameters[:, index, None])
    starts = []
    for kind, load in load_ratios(orbit, device).items():
        for row in np.flatnonzero(np.abs(load.max(axis=1) - 1) < within):
            start = jax.tree.map(np.asarray, orbit[row : row + 1])
            x, other = map(float, parameters[row])
            starts.append(CurveStart(kind, start, (x, other), int(load[row].argmax())))
    return starts
