"""What happens between two points of a branch: where exactly, and what it is.

A sign change of a test function is located on the arc, and says what it was: a bifurcation, or why the branch ends.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from vijax.orbits import periodic, repetition, symmetry
from vijax.orbits.arclength_step import BranchPlace, Path, advance
from vijax.orbits.branch_path import FIRST_END, FOLD, PLUS, Arc, Tests
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.periodic import Orbit

_ROUNDING = 4 * np.finfo(float).eps
# So little arclength before a branch ends its end alone is met. Where an orbit fades, its multipliers come to 1 or -1
# at the very place at which its speeds come to 0.
_AT_THE_END = 1e-12
_GRAZING = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


class Point(NamedTuple):
    """What a branch met: fold, flip, pitchfork, grazing (and of what), or a bound of the parameter.

    Attributes:
        kind: "fold", "flip" (a multiplier is -1), "pitchfork" (mirror symmetry breaks), "grazing flight" (an impact
            appears), "grazing impact" (one vanishes), "grazing contact" (one splits), "grazing exit" (the ball stays).
            A graze at a soft wall has the name that fits the orbit with fewer impacts, from whichever side it is met:
            "grazing flight" or "grazing contact", unless none would be left.
        value: Of the parameter.
        orbit: The orbit there, along a leading axis of one. At a flip that a branch of doubled orbits meets it is the
            orbit of half the period, which has the multiplier -1.
        gained: Impacts with which the branch goes on through a graze: more where positive, fewer where negative; 0
            where it does not.
        wall: Where those are, -1 or +1; 0 at both.
    """

    kind: str
    value: float
    orbit: Orbit
    gained: int = 0
    wall: int = 0

    @property
    def onward(self) -> str:
        """Say how the branch goes on through a graze; nothing elsewhere."""
        return onward(self.gained, self.wall)


def onward(gained: int, wall: int) -> str:
    """Say in words how a path goes on; see `Point`."""
    if not gained:
        return ""
    where = {-1: "the left wall", 0: "each wall", 1: "the right wall"}[wall]
    number = abs(gained) if wall else max(abs(gained) // 2, 1)
    return f"{'one impact' if number == 1 else f'{number} impacts'} {'more' if gained > 0 else 'fewer'} at {where}"


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Say which test functions change sign."""
    return np.sign(before) * np.sign(after) < 0


class BranchEvent(NamedTuple):
    """A sign change: the point before it, the arclength from there, of which test function, the point itself."""

    place: int
    s: float
    test: str
    y: np.ndarray


def events(arc: Arc, y, tangent, tests, lengths, settings: ContinuationSettings) -> list[BranchEvent]:
    """Find what happens between neighbours in order, up to the first thing that ends the branch."""
    index, test = np.nonzero(changed(tests[:-1], tests[1:]))
    if not index.size:
        return []
    before = (y[index], tangent[index], lengths[index + 1])
    arcs = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (test.size, *leaf.shape)), arc)
    s, there, zero = locate(arcs, *before, test, tests[index, test], settings)
    found = [
        BranchEvent(int(i), float(at), Tests._fields[t], y)
        for i, at, t, y, sure in zip(index, s, test, there, zero, strict=True)
        # A multiplier that passes +1 at a fold is no second event.
        if sure and not (t == PLUS and ((index == i) & (test == FOLD)).any())
    ]
    found.sort(key=lambda event: (event.place, event.s))
    end = next((event for event in found if event.test in Tests._fields[FIRST_END:]), None)
    if end is None:
        return found
    return [event for event in found if event.place < end.place or event.s < end.s - _AT_THE_END] + [end]


# `scipy.optimize.elementwise.find_root` locates a fold, a flip or a grazing to the same digit in two thirds of the
# time. That is a tenth of a second in a family of branches, and importing it takes 0.3 s; and a pitchfork, which is no
# simple root, it leaves at a multiplier up to 2e-9 off, where this one comes to 4e-10.
def locate(
    paths: Path,
    y: np.ndarray,
    tangent: np.ndarray,
    length: np.ndarray,
    test: np.ndarray,
    low_f: np.ndarray,
    settings: ContinuationSettings,
    read: Callable[[np.ndarray, BranchPlace], np.ndarray] | None = None,
):
    """Find arclengths from points of paths at which test functions vanish, the points, and which are no poles.

    Args:
        paths, y, tangent, length: Where the steps begin, and how long they are, a row each.
        test: Column of the test function.
        low_f: Its value there.
        settings: Of events.
        read: Takes its value from places of some of the rows, where that is no column.
    """

    def look(rows, s):
        at = advance(*jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (paths, y, tangent)), s)
        return (at.tests[np.arange(rows.size), test[rows]] if read is None else read(rows, at)), at.y

    low, high = np.zeros_like(length), length.copy()
    high_f, best_y = look(np.arange(test.size), high)
    low_f = low_f.copy()
    scale, best, best_f = np.abs(low_f) + np.abs(high_f), high.copy(), high_f.copy()
    for iteration in range(settings.max_narrowings):
        # Where rounding leaves nothing between both ends there is nothing more to be found.
        rows = np.flatnonzero((high - low > _ROUNDING * high) & (best_f != 0))
        if not rows.size:
            break
        begin, end, begin_f, end_f = low[rows], high[rows], low_f[rows], high_f[rows]
        chord = begin - begin_f * (end - begin) / np.where(end_f == begin_f, 1.0, end_f - begin_f)
        inside = (chord > begin) & (chord < end) & (iteration % 3 != 2)
        s = np.where(inside, chord, 0.5 * (begin + end))
        f, there = look(rows, s)
        closer = np.abs(f) < np.abs(best_f[rows])
        best[rows[closer]], best_f[rows[closer]], best_y[rows[closer]] = s[closer], f[closer], there[closer]
        left = np.sign(f) == np.sign(begin_f)
        # Illinois: the value at the end that stays counts half.
        low[rows], high[rows] = np.where(left, s, begin), np.where(left, end, s)
        low_f[rows], high_f[rows] = np.where(left, f, 0.5 * begin_f), np.where(left, 0.5 * end_f, f)
    return best, best_y, np.abs(best_f) <= settings.zero_share * scale


def kind_of(arc: Arc, event: BranchEvent, neighbours: np.ndarray, settings: ContinuationSettings) -> str:
    """Say what a sign change means for this orbit."""
    test, half = event.test, bool(arc.sequence.mirrored)
    if test in _GRAZING:
        return f"grazing {_GRAZING[test]}"
    if test in ("low", "high"):
        return test
    if test == "minus":
        return "pitchfork" if half else "flip"
    if half:
        return "fold"
    # A branch of mirror pairs turns where the two of a pair meet; a symmetric one passes +1 there without turning. So
    # does a branch of doubled orbits where both turns become one; one of two equal turns passes without turning.
    around = orbits_at(arc, np.concatenate([event.y[None], neighbours]))
    for kind, is_simpler in (("pitchfork", symmetry.symmetric), ("flip", _repeats)):
        meets, stays = is_simpler(around[:1], blur(settings))[0], is_simpler(around[1:], settings.asymmetry).all()
        if meets and (test == "fold") != stays:
            return kind
    return "fold"


def _repeats(orbit: Orbit, tolerance: float) -> Bool[np.ndarray, " orbit"]:
    """Return True for orbits that consist of several turns."""
    return repetition.turns(orbit.sequence, orbit.knots, tolerance) > 1


def blur(settings: ContinuationSettings) -> float:
    """Say how far from its mirror image an orbit may come out at a pitchfork that a branch of mirror pairs meets.

    The two turns of a doubled orbit may come out as far apart at its flip. Newton's equations are singular there: what
    they miss grows as the third power of the distance only, so that with a tolerance of 1e-11 it may be a few times
    1e-4.
    """
    return 5 * settings.asymmetry


def orbits_at(path: Path, ys: np.ndarray) -> Orbit:
    """Make orbits of points of a path, verified."""
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(ys), *leaf.shape)), path)
    pair, knots = wide.pair_and_knots(ys)
    return periodic.proven(pair, wide.sequence, knots)
