"""Arclength continuation of many paths of periodic orbits, all lanes together, until each path ends.

Each call of `arclength_step` tries a few steps with the lanes that are still active; their accepted points are
collected per lane. Events between the points are located afterwards (`branch_events`, `curve_events`).
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.continuation.arclength_step import (
    AttemptedSteps,
    ContinuationState,
    Path,
    PathPoints,
    step_controller,
    try_steps,
)
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.runtime import tiles


class PathRecord(NamedTuple):
    """The points of one path in order.

    Attributes:
        y: Unknowns, one row per point.
        tangent: Unit tangents.
        tests: Test functions.
        lengths: Arclength of the step to each point; 0 at the first.
        end: Reason for which no further step was tried: "closed", "points" (the largest number is reached) or "lost"
            (no step was short enough). It has no meaning if the path ends at a zero of an end test.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    lengths: np.ndarray
    end: str


def follow_paths(
    paths: Path, first: PathPoints, points: int | np.ndarray, settings: ContinuationSettings
) -> list[PathRecord]:
    """Follow each path in one direction from its start; all lanes advance together until none is active.

    Args:
        paths, first: The paths, one lane per row, and their first points with the direction as tangent.
        points: Largest number of points: one number for all paths, or one per path.
        settings: Settings of the steps.

    Returns:
        The record of each path.
    """
    lanes, controller = len(first.y), step_controller(settings)
    length, true = np.full(lanes, settings.first_step), np.full(lanes, True)
    # The start of a path counts as its first point.
    initial_count, max_points = np.ones(lanes, np.int32), np.broadcast_to(np.asarray(points, np.int32), lanes)
    fields: Any = (
        first.y,
        first.tangent,
        first.tests,
        length,
        initial_count,
        true,
        ~true,
        first.y,
        first.tangent,
        max_points,
    )
    state = ContinuationState(*fields)
    accepted_steps: list[list[AttemptedSteps]] = [[] for _ in range(lanes)]
    while state.active.any():
        # Only active lanes are advanced: paths end after very different numbers of points.
        active = np.flatnonzero(state.active)
        active_paths, active_states = jax.tree.map(lambda leaf, rows=active: np.asarray(leaf)[rows], (paths, state))
        advanced, steps = try_steps(active_paths, active_states, controller)
        state = jax.tree.map(lambda old, new, rows=active: tiles.with_replaced_rows(rows, old, new), state, advanced)
        for row, lane in enumerate(active):
            # Rejected trials, and trials after the end of the lane, are dropped.
            accepted = steps.accepted[row]
            accepted_steps[lane].append(
                jax.tree.map(lambda leaf, row=row, accepted=accepted: leaf[row][accepted], steps)
            )
    # A closed path counts as closed even if it has also reached its largest number of points.
    ends = np.where(state.closed, "closed", np.where(state.point_count >= state.max_points, "points", "lost"))
    return [_path_record(_first_step(first, lane), accepted_steps[lane], str(ends[lane])) for lane in range(lanes)]


def _first_step(first: PathPoints, lane: int) -> AttemptedSteps:
    """Return the first point of a lane as a step of length zero."""
    point = jax.tree.map(lambda leaf: np.asarray(leaf)[lane : lane + 1], first)
    return AttemptedSteps(point, np.zeros(1), np.full(1, True))


def _path_record(start: AttemptedSteps, accepted: list[AttemptedSteps], end: str) -> PathRecord:
    """Concatenate the first point and the accepted steps of a lane."""
    points, length, _ = jax.tree.map(lambda *parts: np.concatenate(parts), start, *accepted)
    return PathRecord(points.y, points.tangent, points.tests, length, end)
