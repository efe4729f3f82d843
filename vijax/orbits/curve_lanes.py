"""Lanes: starts of curves brought onto them, ready to be followed."""

import dataclasses
import warnings
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.model.device import Harvester
from vijax.model.sides import Sides
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.arclength_step import BranchPlace, across, advance, settled
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.curve_equations import CONDITIONS, FIRST_CURVE_END, Condition, CurvePath, Touch
from vijax.orbits.curve_plane import Plane, logarithmic, units
from vijax.orbits.curve_starts import CurveStart
from vijax.orbits.events import orbits_at
from vijax.orbits.limits import alike
from vijax.orbits.parameter import able
from vijax.orbits.periodic import Orbit
from vijax.runtime import context, tiles

# How far from a limit an orbit may be from which Newton is to find it: a cell of a map with few of them.
_BESIDE = 0.2


Traits = np.ndarray
"""What tells an orbit from others, and its mirror image, a row each."""


class Lane(NamedTuple):
    """A start on its curve, ready to be followed: what it is told apart by, the path, the first point."""

    start: CurveStart
    traits: Traits
    path: CurvePath
    first: BranchPlace


class Offshoot(NamedTuple):
    """A start at a point of codimension 2, where other curves meet its own.

    Attributes:
        start: The bifurcation.
        ahead: How its knots move along the curve at first, where several that are alike cross there.
    """

    start: CurveStart
    ahead: np.ndarray | None = None


def lanes(starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings) -> list[Lane]:
    """Bring starts onto their curves; those are left out, with a warning, at which no real orbit is."""
    batches: dict[tuple, list[CurveStart]] = {}
    for start in starts:
        batches.setdefault((CONDITIONS.get(start.kind), start.orbit.knots.shape[1]), []).append(start)

    def begun(batch: list[CurveStart]) -> tuple[CurvePath, np.ndarray, BranchPlace]:
        paths, y = _set_out(batch, plane, device, settings)
        return paths, y, settled(on_curve(paths, y) if paths.device is None else _beside(paths, y), FIRST_CURVE_END)

    # Every batch has a program of its own, and what compiles one keeps a single core busy.
    with context.pool(tiles.workers()) as pool:
        brought = list(pool.map(begun, batches.values()))
    found, lost = [], []
    for batch, (paths, y, first) in zip(batches.values(), brought, strict=True):
        limit = paths.device is not None
        near = np.abs(first.y - y).max(axis=1) < (_BESIDE if limit else settings.max_step)
        real = (first.tests[:, FIRST_CURVE_END:] > 0).all(axis=1) & near
        for index, good in enumerate(real & first.arrived):
            path, place = jax.tree.map(lambda leaf, i=index: leaf[i], (paths, first))
            if good:
                start = _moved(batch[index], path, place.y) if limit else batch[index]
                found.append(Lane(start, traits(start.orbit, images=True), path, place))
            else:
                lost.append(batch[index])
    if lost:
        told = ", ".join(f"{start.kind} at ({start.place[0]:.6g}, {start.place[1]:.6g})" for start in lost[:3])
        warnings.warn(
            f"{len(lost)} of {len(starts)} points begin no curve, as no ball flies the orbits around: {told}",
            stacklevel=2,
        )
    return found


# How far from a point of codimension 2 a curve that begins there is taken up: where a ball flies its orbits.
_ASIDE = 1e-3


def lanes_aside(begun: list[Offshoot], plane: Plane, device: Harvester, settings: ContinuationSettings) -> list[Lane]:
    """Take up curves that begin at points of codimension 2; those are left out of whose orbits no ball flies any."""
    found = []
    for start, ahead in begun:
        paths, y = _set_out([start], plane, device, settings)
        if ahead is None:
            place = on_curve(paths, y)
            y, tangent = place.y, place.tangent
        else:
            tangent = np.pad(ahead, (0, y.size - ahead.size))[None]
        for sign in (1.0, -1.0):
            there = advance(paths, y, sign * tangent, np.full(1, _ASIDE))
            near = there.arrived[0] and np.abs(there.y - y).max() < settings.max_step
            if near and (there.tests[:, FIRST_CURVE_END:] > 0).all():
                path, first = jax.tree.map(lambda leaf: leaf[0], (paths, there))
                moved = _moved(start, path, first.y)
                found.append(Lane(moved, traits(moved.orbit, images=True), path, first))
                break
    return found


def on_curve(paths: CurvePath, y: np.ndarray) -> BranchPlace:
    """Correct points that lie on their curves already, to find the tangents there."""
    return advance(paths, y, across(y), np.zeros(len(y)))


def _beside(paths: CurvePath, y: np.ndarray) -> BranchPlace:
    """Bring orbits that are near a limit onto its curve: by either parameter alone, whichever has less to move."""
    still = np.eye(y.shape[1])[[-2, -1]]
    tries = [advance(paths, y, np.broadcast_to(one, y.shape), np.zeros(len(y))) for one in still]
    far = [np.where(one.arrived, np.abs(one.y - y).max(axis=1), np.inf) for one in tries]
    first = far[0] <= far[1]

    def chosen(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.where(first.reshape(-1, *(1,) * (one.ndim - 1)), one, other)

    return jax.tree.map(chosen, *tries)


def _moved(start: CurveStart, path: CurvePath, y: np.ndarray) -> CurveStart:
    """Move a start that lay beside its curve onto it."""
    x, other = map(float, path.places(y))
    return start._replace(place=(x, other), orbit=orbits_at(path, y[None]))


def traits(orbit: Orbit, images: bool = False) -> Traits:
    """Give numbers that tell orbits apart, whichever impact they begin with; those of their mirror images, too.

    They are sums over the impacts of a forcing period, the same for an orbit that is run through several times.
    """
    host = jax.tree.map(np.asarray, orbit)
    side, knots = host.sequence.side, host.knots

    def summed(side: Any, knots: Any) -> np.ndarray:
        return orbit_properties.marks_of_knots(side, knots) / (0.5 * host.sequence.span[:, None])

    def later(wait: Any) -> np.ndarray:
        return knots + np.array([1.0, 0.0, 0.0]) * np.broadcast_to(wait, host.sequence.span.shape)[:, None, None]

    # An orbit closed half way goes on as its own mirror image.
    half, again = summed(side, knots), summed(-side, later(host.sequence.span))
    own = np.where(host.sequence.mirrored[:, None], 0.5 * (half + again), half)
    if not images or not np.all(host.pair.symmetric) or host.sequence.mirrored.any():
        return own
    return np.concatenate([own, summed(-side, later(1.0))])


def _set_out(starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings):
    """Make paths and unknowns of starts with as many impacts."""
    orbit = periodic.concatenate([able(start.orbit, *plane) for start in starts])
    size, (one, other), logarithms = len(starts), plane, logarithmic(plane)
    place = np.array([start.place for start in starts], float)
    condition: Condition = CONDITIONS.get(starts[0].kind, "multiplier")
    rows = tiles.arrays(
        {
            "start": place,
            "steepest": np.full(size, float(device.g / device.A)),
            "low": np.tile(np.array([low for low, _ in plane.values()]), (size, 1)),
            "high": np.tile(np.array([high for _, high in plane.values()]), (size, 1)),
            "multiplier": np.array([1.0 if start.kind == "fold" else -1.0 for start in starts]),
        }
    )
    limit = condition in ("depth", "energy")
    impact, wall = np.array([start.impact for start in starts], np.int32), np.array([start.wall for start in starts])
    same = alike(starts, orbit, (one, other), device) if limit else None
    paths = CurvePath(
        pair=orbit.pair,
        sequence=orbit.sequence,
        touch=Touch(*tiles.arrays((impact, wall, same))),
        device=_broadcast(device, size) if limit else None,
        along=(one, other),
        logarithmic=(logarithms[0], logarithms[1]),
        condition=condition,
        newton_tolerance=settings.newton_tolerance,
        max_corrections=settings.max_corrections,
        **rows,
    )
    paths = jax.tree.map(np.asarray, paths)
    knots = np.where(paths.sequence.real[..., None], orbit.knots, 0.0).reshape(size, -1)
    waits = np.array([[start.wait] for start in starts])[:, : int(condition in ("touch", "split"))]
    return paths, np.concatenate([knots, waits, units(place, plane)], axis=1)


def _broadcast(device: Harvester, size: int) -> Harvester:
    """Give every lane the constants of the device, its penetration limit among them."""
    limit = device.depth_limit
    # Limits that differ are the radii of the membranes, which every lane has besides.
    whole = device if isinstance(limit, Sides) else dataclasses.replace(device, penetration_limit=limit)
    return jax.tree.map(lambda x: np.full(size, float(x)), whole)
