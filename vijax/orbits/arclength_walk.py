"""Many paths of periodic orbits followed together, step by step, until each has ended."""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.orbits.arclength_step import BranchPlace, Path, Strides, Walker, pace, stride
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.runtime import tiles


class Walked(NamedTuple):
    """The points of one path in order: unknowns, tangents, test functions, lengths of the steps to them.

    And why it goes no farther unless a test function says so: "closed", "points" or "lost".
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    lengths: np.ndarray
    end: str


def walk(paths: Path, first: BranchPlace, points: int | np.ndarray, settings: ContinuationSettings) -> list[Walked]:
    """Follow one way from every start: all lanes together until none goes on; a step that does not do is halved.

    Args:
        paths, first: What is followed, a lane a row, and where from.
        points: Most points of a path, or of each.
        settings: Of the steps.
    """
    lanes, rules = len(first.y), pace(settings)
    length, yes = np.full(lanes, settings.first_step), np.full(lanes, True)
    one, most = np.ones(lanes, np.int32), np.broadcast_to(np.asarray(points, np.int32), lanes)
    start: Any = first.y, first.tangent, first.tests, length, one, yes, ~yes, first.y, first.tangent, most
    at = Walker(*start)
    tried: list[list[Strides]] = [[] for _ in range(lanes)]
    while at.going.any():
        active = np.flatnonzero(at.going)
        some, there = jax.tree.map(lambda leaf, rows=active: np.asarray(leaf)[rows], (paths, at))
        moved, strides = stride(some, there, rules)
        at = jax.tree.map(lambda old, new, some=active: tiles.replaced(some, old, new), at, moved)
        for row, lane in enumerate(active):
            taken = strides.taken[row]
            tried[lane].append(jax.tree.map(lambda leaf, row=row, taken=taken: leaf[row][taken], strides))
    ends = np.where(at.closed, "closed", np.where(at.passed >= at.points, "points", "lost"))
    return [_joined(_start(first, lane), tried[lane], str(ends[lane])) for lane in range(lanes)]


def _start(first: BranchPlace, lane: int) -> Strides:
    """Give the first point of a lane as a step of no length."""
    place = jax.tree.map(lambda leaf: np.asarray(leaf)[lane : lane + 1], first)
    return Strides(place, np.zeros(1), np.full(1, True))


def _joined(start: Strides, taken: list[Strides], end: str) -> Walked:
    """Put the steps of a lane one after another."""
    place, length, _ = jax.tree.map(lambda *parts: np.concatenate(parts), start, *taken)
    return Walked(place.y, place.tangent, place.tests, length, end)
