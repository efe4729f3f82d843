"""Events between two points of a branch: their exact place, and their kind.

A test function that changes sign between two points of a branch is driven to zero along the arc between them. Its name
and the orbit at the zero decide the kind: a bifurcation, or the end of the branch.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from vijax.continuation.arclength_step import Path, PathPoints, predict_and_correct
from vijax.continuation.branch_equations import FIRST_END_TEST, FOLD, PLUS, BranchPath, BranchTests
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.orbits import periodic, repetition, symmetry
from vijax.orbits.periodic import Orbit

_ROUNDING = 4 * np.finfo(float).eps
# Arclength before the end of a branch within which other events are dropped, because the multipliers of an orbit with
# fading impacts reach 1 or -1 exactly at the end, where the speeds reach 0.
_AT_THE_END = 1e-12
_GRAZING = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


class Point(NamedTuple):
    """An event on a branch: a fold, flip, pitchfork, grazing, or a limit of the device.

    Attributes:
        kind: "fold"; "flip" (a multiplier is -1); "pitchfork" (mirror symmetry breaks); "grazing flight" (an impact
            appears); "grazing impact" (one vanishes); "grazing contact" (one splits in two); "grazing exit" (the ball
            stays in contact). In both directions, a graze at a soft wall is named after the part that touches the wall
            in the orbit with fewer impacts: "grazing flight" or "grazing contact", unless that orbit would have no
            impact.
        value: Value of the parameter.
        orbit: The orbit at the event, along a leading axis of one. At a flip on a branch of doubled orbits it is the
            orbit of half the period, which has the multiplier -1.
        impact_change: Number of impacts after a graze minus the number before it, in the order of the branch; 0 at
            other events, and where the branch does not continue.
        wall: Wall of these impacts: -1 (left), +1 (right) or 0 (both).
    """

    kind: str
    value: float
    orbit: Orbit
    impact_change: int = 0
    wall: int = 0

    @property
    def impact_change_text(self) -> str:
        """Return how the branch continues through a graze, in words; empty at other events."""
        return impact_change_text(self.impact_change, self.wall)


def impact_change_text(impact_change: int, wall: int) -> str:
    """Return the change in the number of impacts in words, such as "one impact more at the left wall"."""
    if not impact_change:
        return ""
    wall_name = {-1: "the left wall", 0: "each wall", 1: "the right wall"}[wall]
    number = abs(impact_change) if wall else max(abs(impact_change) // 2, 1)
    return (
        f"{'one impact' if number == 1 else f'{number} impacts'} "
        f"{'more' if impact_change > 0 else 'fewer'} at {wall_name}"
    )


def sign_changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return which test functions change sign."""
    return np.sign(before) * np.sign(after) < 0


class BranchEvent(NamedTuple):
    """A change of sign between two points of a branch.

    Attributes:
        point_index: Index of the point before the event.
        s: Arclength from that point.
        test: Name of the test function.
        y: Unknowns at the event.
    """

    point_index: int
    s: float
    test: str
    y: np.ndarray


def events(path: BranchPath, y, tangent, tests, lengths, settings: ContinuationSettings) -> list[BranchEvent]:
    """Locate all events between the points of a branch, in order, up to the first event that ends the branch."""
    index, test = np.nonzero(sign_changed(tests[:-1], tests[1:]))
    if not index.size:
        return []
    before = (y[index], tangent[index], lengths[index + 1])
    paths = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (test.size, *leaf.shape)), path)
    s, points, are_zeros = locate(paths, *before, test, tests[index, test], settings)
    located = [
        BranchEvent(int(i), float(arclength), BranchTests._fields[t], y)
        for i, arclength, t, y, is_zero in zip(index, s, test, points, are_zeros, strict=True)
        # A multiplier that passes +1 at a fold is the same event.
        if is_zero and not (t == PLUS and ((index == i) & (test == FOLD)).any())
    ]
    located.sort(key=lambda event: (event.point_index, event.s))
    end = next((event for event in located if event.test in BranchTests._fields[FIRST_END_TEST:]), None)
    if end is None:
        return located
    return [event for event in located if event.point_index < end.point_index or event.s < end.s - _AT_THE_END] + [end]


# `scipy.optimize.elementwise.find_root` is not used: it locates a fold, flip or grazing equally well in two thirds of
# the time, which saves 0.1 s for a family of branches, but its import takes 0.3 s. At a pitchfork, which is no simple
# root, its error in the multiplier is up to 2e-9; the error of this method is 4e-10.
def locate(
    paths: Path,
    y: np.ndarray,
    tangent: np.ndarray,
    length: np.ndarray,
    test: np.ndarray,
    low_f: np.ndarray,
    settings: ContinuationSettings,
    read_values: Callable[[np.ndarray, PathPoints], np.ndarray] | None = None,
):
    """Locate zeros of test functions along paths, by false position (Illinois) with a bisection every third time.

    Each evaluation is a predictor-corrector step of the trial arclength from the point before the zero. So the located
    point is on the path to the tolerance of Newton's method.

    Args:
        paths, y, tangent, length: Points before the zeros and the lengths of the steps, one row per zero.
        test: Column of the test function of each zero.
        low_f: Value of that test function at the point before.
        settings: Settings of events.
        read_values: Function that computes the test functions from row numbers of zeros and their trial points; by
            default they are read from the columns of the points.

    Returns:
        Arclengths of the zeros from the points before them, the unknowns at the zeros, and whether each is a zero and
        not a pole.
    """

    def evaluate(rows, s):
        points = predict_and_correct(*jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (paths, y, tangent)), s)
        return (
            points.tests[np.arange(rows.size), test[rows]] if read_values is None else read_values(rows, points)
        ), points.y

    low, high = np.zeros_like(length), length.copy()
    # The value at the far end is evaluated again, because the recorded one may differ in the last digit.
    high_f, best_y = evaluate(np.arange(test.size), high)
    low_f = low_f.copy()
    # A zero becomes small compared with this scale, a pole does not.
    scale, best, best_f = np.abs(low_f) + np.abs(high_f), high.copy(), high_f.copy()
    for iteration in range(settings.max_narrowings):
        # Narrow an interval until it is as short as the rounding of its ends, or its zero is found exactly.
        rows = np.flatnonzero((high - low > _ROUNDING * high) & (best_f != 0))
        if not rows.size:
            break
        begin, end, begin_f, end_f = low[rows], high[rows], low_f[rows], high_f[rows]
        # False position; bisect where the chord leaves the interval, and every third time in any case.
        chord = begin - begin_f * (end - begin) / np.where(end_f == begin_f, 1.0, end_f - begin_f)
        inside = (chord > begin) & (chord < end) & (iteration % 3 != 2)
        s = np.where(inside, chord, 0.5 * (begin + end))
        f, there = evaluate(rows, s)
        # Keep the point with the smallest absolute value so far, because the last point may have a larger one.
        closer = np.abs(f) < np.abs(best_f[rows])
        best[rows[closer]], best_f[rows[closer]], best_y[rows[closer]] = s[closer], f[closer], there[closer]
        same_side = np.sign(f) == np.sign(begin_f)
        # Illinois rule: halve the value at the end of the interval that does not move.
        low[rows], high[rows] = np.where(same_side, s, begin), np.where(same_side, end, s)
        low_f[rows], high_f[rows] = np.where(same_side, f, 0.5 * begin_f), np.where(same_side, 0.5 * end_f, f)
    return best, best_y, np.abs(best_f) <= settings.zero_share * scale


def classify_event(path: BranchPath, event: BranchEvent, neighbours: np.ndarray, settings: ContinuationSettings) -> str:
    """Return the kind of an event, which depends on the test function that changes sign and on the orbit.

    Args:
        path: The branch problem.
        event: The event.
        neighbours: Unknowns of the points before and after it.
        settings: Settings of events.
    """
    test, closed_half_way = event.test, bool(path.sequence.mirrored)
    if test in _GRAZING:
        return f"grazing {_GRAZING[test]}"
    if test in ("low", "high"):
        return test
    if test == "minus":
        return "pitchfork" if closed_half_way else "flip"
    if closed_half_way:
        return "fold"
    # A branch of mirror pairs turns back where the pair merges into a symmetric orbit. On the branch of symmetric
    # orbits a multiplier passes +1 there, without a turn. Likewise, a branch of doubled orbits turns back where both
    # periods become equal, and on the branch of repeated orbits a multiplier passes +1 without a turn.
    orbits = orbits_at(path, np.concatenate([event.y[None], neighbours]))
    for kind, is_simpler in (("pitchfork", symmetry.is_symmetric), ("flip", _repeats)):
        is_merged, neighbours_simpler = (
            is_simpler(orbits[:1], merging_tolerance(settings))[0],
            is_simpler(orbits[1:], settings.asymmetry).all(),
        )
        if is_merged and (test == "fold") != neighbours_simpler:
            return kind
    return "fold"


def _repeats(orbit: Orbit, tolerance: float) -> Bool[np.ndarray, " orbit"]:
    """Return True for orbits that consist of several equal periods."""
    return repetition.count_repetitions(orbit.sequence, orbit.impact_unknowns, tolerance) > 1


def merging_tolerance(settings: ContinuationSettings) -> float:
    """Return the largest distance from mirror symmetry, or from equal periods, of an orbit merged into a simpler one.

    At a pitchfork on a branch of mirror pairs, and at a flip on a branch of doubled orbits, the equations of Newton's
    method are singular. The residual grows only as the third power of the distance, so that a tolerance of 1e-11 leaves
    a distance of a few times 1e-4.
    """
    return 5 * settings.asymmetry


def orbits_at(path: Path, ys: np.ndarray) -> Orbit:
    """Return the orbits at points of a path, verified by the impact map; `status` holds the result."""
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(ys), *leaf.shape)), path)
    pair, impact_unknowns = wide.pair_and_unknowns(ys)
    return periodic.verify_solutions(pair, wide.sequence, impact_unknowns)
