"""Where orbits meet the limits of a device: an impact as deep, or one that harvests as much, as is admissible."""

from functools import reduce
from typing import Any

import jax
import numpy as np

from vijax.model.device import Harvester, depth_unit, one_device, with_constants
from vijax.model.energy import energy_ratio, harvested_energy
from vijax.model.records import Status
from vijax.model.sides import at
from vijax.orbits import symmetry
from vijax.orbits.continuation import Branch
from vijax.orbits.curve_starts import CurveStart
from vijax.orbits.events import Point
from vijax.orbits.parameter import of_pair, skews
from vijax.orbits.periodic import Orbit
from vijax.runtime import checks, tiles
from vijax.runtime.context import door

LIMITS = ("penetration limit", "energy limit")
"""Kinds of points and of curves."""

_ALIKE = 1e-9  # Loads of impacts that differ by less are the same: rounding is far below.


def loads(orbit: Orbit, device: Harvester) -> dict[str, np.ndarray]:
    """Compute how near each impact [orbit, impact] is to each limit: 1 there, less where admissible, 0 where padded.

    Args:
        orbit: Orbits; what is no orbit has NaN.
        device: Its constants are numbers, or [orbit, 1].
    """
    depth, work = np.asarray(orbit.depth), np.asarray(orbit.work)
    side, mirrored = np.asarray(orbit.sequence.side), np.asarray(orbit.sequence.mirrored)
    # An orbit closed half way is as deep at the other wall, too.
    walls = [side, np.where(mirrored[:, None], -side, side)] if device.unequal else [side]
    metres = depth * np.asarray(at(depth_unit(device, orbit.pair), side))
    most = reduce(np.maximum, [np.asarray(harvested_energy(device.at(wall), metres)) for wall in walls])
    least = reduce(np.minimum, [np.asarray(at(device.depth_limit, wall)) for wall in walls])
    energy, given = tiles.arrays((most, work * np.asarray(device.m_b * device.speed_unit**2)))
    found = {
        LIMITS[0]: metres / least,
        LIMITS[1]: np.asarray(energy_ratio(energy, given)) / np.asarray(device.energy_ratio_limit),
    }
    real = np.asarray(orbit.sequence.real)
    return {kind: np.where(real, load, 0.0) for kind, load in found.items()}


@door
def limit_points(branches: list[Branch], *, device: Harvester | None = None) -> list[Point]:
    """Find the orbits of branches next to which a limit of a device is met, for `follow_curves` to begin at.

    Limits are those of `admissible`: no impact is deeper than the penetration limit, and none harvests more than the
    part `energy_ratio_limit` of the energy that it gives to the membrane.

    Args:
        branches: As `vijax.follow_families` returns them.
        device: Whose limits they are, as the branches were told.

    Returns:
        For every crossing the nearer one of the two orbits between which it is, with `kind` "penetration limit" or
        "energy limit". A curve that begins there is on the limit exactly.
    """
    device = one_device(device)
    return [
        point
        for branch in checks.sequence("branches", branches, Branch, "branches, as vijax.follow_families returns them")
        for point in _crossings(branch, device)
    ]


def _crossings(branch: Branch, device: Harvester) -> list[Point]:
    found = []
    for kind, load in loads(branch.orbit, device_at(device, branch.along, branch.values[:, None])).items():
        over = load.max(axis=1) - 1
        for index in np.flatnonzero(over[:-1] * over[1:] < 0):
            nearer = int(index) + int(abs(over[index + 1]) < abs(over[index]))
            found.append(Point(kind, float(branch.values[nearer]), branch.orbit[nearer : nearer + 1]))
    return found


def device_at(device: Harvester, along: str, values: Any) -> Harvester:
    """Give the device where a parameter has other values, if it is the device's."""
    if of_pair(along):
        return device
    return with_constants(device, **{along: tiles.arrays(np.asarray(values, float))})


def limit_start(
    point: Point, place: tuple[float, float], plane: tuple[str, ...], device: Harvester, asymmetry: float
) -> CurveStart | str:
    """Make a start of an orbit near a limit, or say why no curve can be followed from there.

    Args:
        point: The orbit.
        place, plane: Both parameters of the plane there, and what they are.
        device, asymmetry: See `follow_curves`.
    """
    orbit = point.orbit
    if int(orbit.status[0]) != Status.OK:
        return "no ball flies its orbit"
    mirrored = bool(orbit.sequence.mirrored[0])
    if any(map(skews, plane)):
        orbit = symmetry.unfolded(orbit)
    elif not mirrored and bool(symmetry.symmetric(orbit, asymmetry)[0]):
        # Both of an impact and its mirror image are at the limit: half way there is one.
        orbit = symmetry.halved(orbit, asymmetry)
    for name, value in zip(plane, place, strict=True):
        device = device_at(device, name, value)
    return CurveStart(point.kind, orbit, place, int(loads(orbit, device)[point.kind][0].argmax()))


def alike(starts: list[CurveStart], orbit: Orbit, plane: tuple[str, ...], device: Harvester) -> np.ndarray:
    """Say which impacts [start, impact] are as hard as the one that is at its limit, itself and padding among them.

    Both of a 1:1 orbit of rigid walls are, also where it is no mirror image of itself. Under gravity none stay so.
    """
    for index, name in enumerate(plane):
        device = device_at(device, name, np.array([[start.place[index]] for start in starts]))
    load, rows = loads(orbit, device)[starts[0].kind], np.arange(len(starts))
    impact = np.array([start.impact for start in starts])
    close = np.abs(load - load[rows, impact][:, None]) < _ALIKE
    itself = np.arange(load.shape[1]) == impact[:, None]
    return itself | ~np.asarray(orbit.sequence.real) | (close & (not any(map(skews, plane))))


def near_limits(
    orbit: Orbit, device: Harvester, plane: tuple[str, ...], places: np.ndarray, within: float
) -> list[CurveStart]:
    """Make starts of the orbits that are near a limit.

    Args:
        orbit: Verified orbits, those closed half way that can be.
        device: Of the map.
        plane: Both parameters.
        places: Of these, a row an orbit.
        within: How near, in parts of the limit.
    """
    for index, name in enumerate(plane):
        device = device_at(device, name, places[:, index, None])
    found = []
    for kind, load in loads(orbit, device).items():
        for row in np.flatnonzero(np.abs(load.max(axis=1) - 1) < within):
            one = jax.tree.map(np.asarray, orbit[row : row + 1])
            x, other = map(float, places[row])
            found.append(CurveStart(kind, one, (x, other), int(load[row].argmax())))
    return found
