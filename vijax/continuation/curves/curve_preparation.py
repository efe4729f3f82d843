"""Start points of curves of bifurcations, corrected onto their curves and ready to be followed."""

import dataclasses
import warnings
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.continuation.arclength_step import PathPoints, generic_direction, place_before_end, predict_and_correct
from vijax.continuation.branch_events import orbits_at
from vijax.continuation.continuation_parameter import with_separate_walls
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.curves.curve_equations import (
    CONDITIONS,
    FIRST_CURVE_END_TEST,
    Condition,
    CurvePath,
    EventLocation,
)
from vijax.continuation.curves.curve_plane import Plane, logarithmic, to_unit_square
from vijax.continuation.curves.curve_starts import CurveStart
from vijax.continuation.limits import impacts_with_equal_load
from vijax.model.device import Harvester
from vijax.model.walls.sides import Sides
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.periodic import Orbit
from vijax.runtime import public_api, tiles

# Largest change of an unknown in the first correction onto a limit. In sides of the plane, it is a cell of a coarse
# map.
_LIMIT_REACH = 0.2


Signatures = np.ndarray
"""Signatures of an orbit and of its mirror image, one row each: numbers that distinguish orbits."""


class PreparedStart(NamedTuple):
    """A start point on its curve.

    Attributes:
        start: The bifurcation.
        signatures: Signature of the orbit, and of its mirror image.
        path: Continuation problem of the curve.
        first: First point of the path.
    """

    start: CurveStart
    signatures: Signatures
    path: CurvePath
    first: PathPoints


class SwitchStart(NamedTuple):
    """A start at a point of codimension 2, where other curves meet the curve that has reached it.

    Attributes:
        start: The bifurcation.
        direction: Direction of the impact unknowns along the new curve; None if the equations determine it, because no
            similar curve crosses there.
    """

    start: CurveStart
    direction: np.ndarray | None = None


def prepare_starts(
    starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings
) -> list[PreparedStart]:
    """Correct start points onto their curves; a start without a real orbit is left out, with a warning."""
    batches: dict[tuple, list[CurveStart]] = {}
    for start in starts:
        # Starts with the same condition and number of unknowns share one program.
        batches.setdefault((CONDITIONS.get(start.kind), start.orbit.impact_unknowns.shape[1]), []).append(start)

    def prepare(batch: list[CurveStart]) -> tuple[CurvePath, np.ndarray, PathPoints]:
        paths, y = _paths_and_unknowns(batch, plane, device, settings)
        return (
            paths,
            y,
            place_before_end(
                correct_onto_curve(paths, y) if paths.device is None else _correct_onto_limit(paths, y),
                FIRST_CURVE_END_TEST,
            ),
        )

    # Use threads, because every batch has a program of its own and its compilation uses a single core.
    with public_api.pool(tiles.workers()) as pool:
        prepared = list(pool.map(prepare, batches.values()))
    ready, lost = [], []
    for batch, (paths, y, first) in zip(batches.values(), prepared, strict=True):
        limit = paths.device is not None
        # A correction farther than this has reached another curve.
        near = np.abs(first.y - y).max(axis=1) < (_LIMIT_REACH if limit else settings.max_step)
        real = (first.tests[:, FIRST_CURVE_END_TEST:] > 0).all(axis=1) & near
        for index, is_real in enumerate(real & first.converged):
            path, point = jax.tree.map(lambda leaf, i=index: leaf[i], (paths, first))
            if is_real:
                start = _start_at(batch[index], path, point.y) if limit else batch[index]
                ready.append(PreparedStart(start, curve_signatures(start.orbit, images=True), path, point))
            else:
                lost.append(batch[index])
    if lost:
        examples = ", ".join(
            f"{start.kind} at ({start.parameters[0]:.6g}, {start.parameters[1]:.6g})" for start in lost[:3]
        )
        warnings.warn(
            f"{len(lost)} of {len(starts)} points begin no curve, because no orbit near them is real: {examples}",
            stacklevel=2,
        )
    return ready


# Arclength between a point of codimension 2 and the first point of a curve that begins there; its orbits are real at
# this distance.
_OFFSET = 1e-3


def prepare_switch_starts(
    switch_starts: list[SwitchStart], plane: Plane, device: Harvester, settings: ContinuationSettings
) -> list[PreparedStart]:
    """Return start points of curves that begin at points of codimension 2.

    A start is left out if no orbit next to it is real.
    """
    ready = []
    for start, direction in switch_starts:
        paths, y = _paths_and_unknowns([start], plane, device, settings)
        if direction is None:
            point = correct_onto_curve(paths, y)
            y, tangent = point.y, point.tangent
        else:
            tangent = np.pad(direction, (0, y.size - direction.size))[None]
        # In general the new orbits are real on one side only. Take the first side with real orbits.
        for sign in (1.0, -1.0):
            trial = predict_and_correct(paths, y, sign * tangent, np.full(1, _OFFSET))
            near = trial.converged[0] and np.abs(trial.y - y).max() < settings.max_step
            if near and (trial.tests[:, FIRST_CURVE_END_TEST:] > 0).all():
                path, first = jax.tree.map(lambda leaf: leaf[0], (paths, trial))
                moved_start = _start_at(start, path, first.y)
                ready.append(PreparedStart(moved_start, curve_signatures(moved_start.orbit, images=True), path, first))
                break
    return ready


def correct_onto_curve(paths: CurvePath, y: np.ndarray) -> PathPoints:
    """Return points that lie on their curves already, with the tangents and test functions there."""
    return predict_and_correct(paths, y, generic_direction(y), np.zeros(len(y)))


def _correct_onto_limit(paths: CurvePath, y: np.ndarray) -> PathPoints:
    """Correct orbits near a limit onto its curve, by a change of one parameter: the one that changes less."""
    # A correction normal to the unit vector of a parameter keeps that parameter and changes the other one.
    directions = np.eye(y.shape[1])[[-2, -1]]
    corrected = [predict_and_correct(paths, y, np.broadcast_to(item, y.shape), np.zeros(len(y))) for item in directions]
    distances = [np.where(item.converged, np.abs(item.y - y).max(axis=1), np.inf) for item in corrected]
    # The parameter that changes less leads to the nearest point of the curve.
    first = distances[0] <= distances[1]

    def choose(leaf: np.ndarray, other_leaf: np.ndarray) -> np.ndarray:
        return np.where(first.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, other_leaf)

    return jax.tree.map(choose, *corrected)


def _start_at(start: CurveStart, path: CurvePath, y: np.ndarray) -> CurveStart:
    """Return a start, with its parameters and its orbit at a point of the path."""
    x_parameter, y_parameter = map(float, path.parameters(y))
    return start._replace(parameters=(x_parameter, y_parameter), orbit=orbits_at(path, y[None]))


def curve_signatures(orbit: Orbit, images: bool = False) -> Signatures:
    """Return numbers that distinguish orbits, whichever impact they begin with; also of their mirror images on request.

    They are sums over the impacts, divided by the number of forcing periods, so that they are the same for an orbit
    that is run through several times.

    Args:
        orbit: Orbits.
        images: Whether to append the signatures of the mirror images.
    """
    orbit_host = jax.tree.map(np.asarray, orbit)
    side, impact_unknowns = orbit_host.sequence.side, orbit_host.impact_unknowns

    def signature(side: Any, impact_unknowns: Any) -> np.ndarray:
        return orbit_properties.signature_sums(side, impact_unknowns) / (0.5 * orbit_host.sequence.span[:, None])

    def shifted(delay: Any) -> np.ndarray:
        return (
            impact_unknowns
            + np.array([1.0, 0.0, 0.0]) * np.broadcast_to(delay, orbit_host.sequence.span.shape)[:, None, None]
        )

    # Of a symmetric orbit stored as half a period (`mirrored`) the second half is the mirror image of the stored half,
    # half a period later.
    first_half, second_half = signature(side, impact_unknowns), signature(-side, shifted(orbit_host.sequence.span))
    signatures = np.where(orbit_host.sequence.mirrored[:, None], 0.5 * (first_half + second_half), first_half)
    if not images or not np.all(orbit_host.pair.symmetric) or orbit_host.sequence.mirrored.any():
        return signatures
    return np.concatenate([signatures, signature(-side, shifted(1.0))])


def _paths_and_unknowns(starts: list[CurveStart], plane: Plane, device: Harvester, settings: ContinuationSettings):
    """Return the paths and the unknowns of starts with the same number of impacts."""
    orbit = periodic.concatenate([with_separate_walls(start.orbit, *plane) for start in starts])
    size, (first_name, second_name), is_logarithmic = len(starts), plane, logarithmic(plane)
    parameters = np.array([start.parameters for start in starts], float)
    condition: Condition = CONDITIONS.get(starts[0].kind, "multiplier")
    rows = tiles.arrays(
        {
            "start": parameters,
            "vertical_gamma": np.full(size, float(device.g / device.A)),
            "low": np.tile(np.array([low for low, _ in plane.values()]), (size, 1)),
            "high": np.tile(np.array([high for _, high in plane.values()]), (size, 1)),
            "multiplier": np.array([1.0 if start.kind == "fold" else -1.0 for start in starts]),
        }
    )
    limit = condition in ("depth", "energy")
    impact, wall = np.array([start.impact for start in starts], np.int32), np.array([start.wall for start in starts])
    equal_load = impacts_with_equal_load(starts, orbit, (first_name, second_name), device) if limit else None
    paths = CurvePath(
        pair=orbit.pair,
        sequence=orbit.sequence,
        location=EventLocation(*tiles.arrays((impact, wall, equal_load))),
        device=_broadcast(device, size) if limit else None,
        along=(first_name, second_name),
        logarithmic=(is_logarithmic[0], is_logarithmic[1]),
        condition=condition,
        newton_tolerance=settings.newton_tolerance,
        max_corrections=settings.max_corrections,
        **rows,
    )
    paths = jax.tree.map(np.asarray, paths)
    impact_unknowns = np.where(paths.sequence.real[..., None], orbit.impact_unknowns, 0.0).reshape(size, -1)
    # The unknown time of the graze, only on curves of grazing.
    delays = np.array([[start.delay] for start in starts])[:, : int(condition in ("flight_graze", "contact_graze"))]
    return paths, np.concatenate([impact_unknowns, delays, to_unit_square(parameters, plane)], axis=1)


def _broadcast(device: Harvester, size: int) -> Harvester:
    """Return the device with every constant repeated for each lane, its penetration limit included."""
    limit = device.depth_limit
    # If the limits of the walls differ, they are the radii of the membranes, which are already fields of the device.
    complete = device if isinstance(limit, Sides) else dataclasses.replace(device, penetration_limit=limit)
    return jax.tree.map(lambda x: np.full(size, float(x)), complete)
