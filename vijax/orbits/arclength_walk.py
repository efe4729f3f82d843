"""Many paths of periodic orbits followed together, step by step, until each has ended."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from vijax.orbits.arclength_step import BranchPlace, Path, advance
from vijax.orbits.continuation_settings import ContinuationSettings


class Walked(NamedTuple):
    """The points of one path in order: unknowns, tangents, test functions, lengths of the steps to them.

    And why it goes no farther unless a test function says so: "closed", "points" or "lost".
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    lengths: np.ndarray
    end: str


class WalkRules(NamedTuple):
    """How paths of one kind are followed.

    Attributes:
        settings: Of the steps.
        happenings: Counts what happens between two rows of test functions.
        first_end: The column from which on test functions are positive on real orbits.
    """

    settings: ContinuationSettings
    happenings: Callable[[np.ndarray, np.ndarray], np.ndarray]
    first_end: int


def walk(paths: Path, first: BranchPlace, points: int | np.ndarray, rules: WalkRules) -> list[Walked]:
    """Follow one way from every start: all lanes together until none goes on; a step that does not do is halved.

    Args:
        paths, first: What is followed, a lane a row, and where from.
        points: Most points of a path, or of each.
        rules: Of steps, and what they may pass.
    """
    settings, happenings, first_end = rules
    lanes, bend = first.y.shape[0], 1 - settings.min_cosine
    passed = [[(first.y[lane], first.tangent[lane], first.tests[lane], 0.0)] for lane in range(lanes)]
    y, tangent, tests = first.y, first.tangent, first.tests
    length, going, closed = np.full(lanes, settings.first_step), np.full(lanes, True), np.full(lanes, False)
    while going.any():
        there = _stepped(paths, y, tangent, length, np.flatnonzero(going))
        straight = (there.tangent * tangent).sum(axis=1)
        # Newton may end on another path, or far along this one: neither its direction nor its distance fits then.
        near = np.linalg.norm(there.y - y, axis=1) < 2 * length
        # Of two things within a step one may hide the other's change of sign, so that each gets a step of its own.
        single = (happenings(tests, there.tests) <= 1) | (length < settings.crowded_step)
        # A path that sets out from a graze does not know yet what is clear: all must be after the first step.
        clear = ~(np.isnan(tests) & (there.tests <= 0))[:, first_end:].any(axis=1)
        good = going & (there.size <= settings.newton_tolerance) & (straight > settings.min_cosine)
        good &= near & single & clear
        for lane in np.flatnonzero(good):
            passed[lane].append((there.y[lane], there.tangent[lane], there.tests[lane], length[lane]))
        easy = (there.corrections <= settings.easy_corrections) & (straight > 1 - settings.easy_bend * bend)
        longer = np.where(easy, np.minimum(settings.growth * length, settings.max_step), length)
        new = (there.y, there.tangent, there.tests)
        y, tangent, tests = (np.where(good[:, None], *pair) for pair in zip(new, (y, tangent, tests), strict=True))
        length = np.where(good, longer, 0.5 * length)
        # Past a grazing or a bound there is no orbit. The first such point is kept: between it and the last is the end.
        real = (tests[:, first_end:] > 0).all(axis=1) | ~good
        short = np.array([len(lane) for lane in passed]) < points
        # A closed path comes by its start again, in the same direction.
        back = np.linalg.norm(y - first.y, axis=1) < settings.max_step
        along_start = (tangent * first.tangent).sum(axis=1) > settings.min_cosine
        home = back & along_start & np.array([len(lane) > settings.closing_steps for lane in passed])
        closed |= going & home
        going = going & (length > settings.min_step) & real & short & ~home
    full = np.array([len(rows) for rows in passed]) >= points
    ends = np.where(closed, "closed", np.where(full, "points", "lost"))
    walked = []
    for rows, end in zip(passed, ends, strict=True):
        ys, tangents, values, lengths = (np.array(column) for column in zip(*rows, strict=True))
        walked.append(Walked(ys, tangents, values, lengths, str(end)))
    return walked


def _stepped(paths: Path, y: np.ndarray, tangent: np.ndarray, length: np.ndarray, active: np.ndarray) -> BranchPlace:
    """Take a step with some of the lanes; the rows of the others hold what nobody reads."""
    some = jax.tree.map(lambda leaf: np.asarray(leaf)[active], (paths, y, tangent, length))
    found = advance(*some)
    rows = np.zeros(len(y), int)
    rows[active] = np.arange(active.size)
    return jax.tree.map(lambda leaf: leaf[rows], found)
