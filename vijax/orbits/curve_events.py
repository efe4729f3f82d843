"""What a curve of bifurcations meets: where exactly, what it is called, and whether the curve ends there.

The product of an orbit's two multipliers is exp(-mu contact time) or r^(2 impacts), between 0 and 1. So they can be 1
or -1 one at a time only, and never be a pair on the unit circle: there is no Neimark-Sacker bifurcation, no fold-flip
and no resonance 1:1 or 1:2 to be looked for.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.orbits import orbit_properties, symmetry
from vijax.orbits.arclength_step import BranchPlace, advance
from vijax.orbits.arclength_walk import Walked
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.criticality import cubic_coefficient
from vijax.orbits.curve_equations import CUBIC, TURN, CurvePath, CurveTests, passed
from vijax.orbits.curve_merging import merged
from vijax.orbits.events import locate, onward, orbits_at
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

# Part of a tangent that lies in the plane at which a curve stands still there: beside a cusp it is the distance from
# it, along a curve that only bends it is what it was.
_STILL = 1e-4
# Cubic coefficients are computed of so many orbits at once, however many there are: a program of third derivatives
# takes seconds to compile, for few orbits as for many.
_AT_ONCE = (64,)
_MERGED = {"flip-graze": "flip", "pitchfork-graze": "pitchfork"}
_TEST = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


class CurvePoint(NamedTuple):
    """What a curve met: a point of codimension 2.

    Attributes:
        kind: "cusp", "generalised flip", "degenerate pitchfork", "fold-graze", "flip-graze", "pitchfork-graze", "double
            graze", "degenerate graze" (no acceleration where the ball touches), "resonant graze" (at a rigid wall: no
            root of the parameter's change is in the orbits with an impact there, whose folds and flips begin); on a
            limit "fold", "flip", "pitchfork" and "graze at a limit", "double limit" (another impact is there, too).
        test: What grazes besides, where orbits cease to be real: flight, impact, contact or exit; else "". At soft
            walls it has the name that fits the orbit with fewer impacts, as with a branch's `Point`.
        values: Of both parameters.
        orbit: The orbit there, alone.
        gained: Impacts with which the curve goes on; more where positive, fewer where negative; 0 where it does not.
        wall: Where those are, -1 or +1; 0 at both.
    """

    kind: str
    test: str
    values: tuple[float, float]
    orbit: Orbit
    gained: int = 0
    wall: int = 0

    @property
    def onward(self) -> str:
        """Say how the curve goes on through a graze; nothing elsewhere."""
        return onward(self.gained, self.wall)


class CurveEvent(NamedTuple):
    """A sign change: the point before it, the arclength from there, what it is, the point itself, whether it ends."""

    place: int
    s: float
    kind: str
    test: str
    y: np.ndarray
    ends: bool


def curve_events(
    paths: CurvePath, walked: list[Walked], kinds: list[str], settings: ContinuationSettings
) -> list[list[CurveEvent]]:
    """Find what happens between neighbours of curves in order, up to the first thing that ends each; all at once."""
    tests = _with_cubics(paths, walked)
    steps = [passed(one[:-1], one[1:]) for one in tests]
    lane = np.repeat(np.arange(len(walked)), [len(one) for one in steps])
    place = np.concatenate([np.arange(len(one)) for one in steps])
    step, test = np.nonzero(np.concatenate(steps))
    lane, place = lane[step], place[step]
    found: list[list[CurveEvent]] = [[] for _ in walked]
    if not step.size:
        return found
    y, tangent, length, begun = (
        np.array([rows[i][k + shift] for i, k in zip(lane, place, strict=True)])
        for rows, shift in (
            ([one.y for one in walked], 0),
            ([one.tangent for one in walked], 0),
            ([one.lengths for one in walked], 1),
            (tests, 0),
        )
    )
    begun = np.where(test == TURN, np.linalg.norm(tangent[:, -2:], axis=1), begun[np.arange(test.size), test])
    own = jax.tree.map(lambda leaf: np.asarray(leaf)[lane], paths)

    def read(rows: np.ndarray, at: BranchPlace) -> np.ndarray:
        values = at.tests[np.arange(rows.size), test[rows]].copy()
        if (asked := np.flatnonzero(test[rows] == CUBIC)).size:
            values[asked] = _cubics(jax.tree.map(lambda leaf: leaf[rows[asked]], own), at.y[asked])
        return values

    s, there, zero = locate(own, y, tangent, length, test, begun, settings, read)
    still = np.linalg.norm(advance(own, y, tangent, s).tangent[:, -2:], axis=1) < _STILL
    for number in np.lexsort((s, place, lane)):
        which, events = int(test[number]), found[lane[number]]
        if not zero[number] or (which == TURN and not still[number]) or (events and events[-1].ends):
            continue
        path = jax.tree.map(lambda leaf, i=number: leaf[i], own)
        name, ends = _named(path, which, there[number], kinds[lane[number]], settings)
        what, at = _TEST.get(CurveTests._fields[which], ""), there[number]
        if path.condition in ("touch", "split") and name in _MERGED and what:
            at = merged(path, at, _MERGED[name], settings)
        events.append(CurveEvent(int(place[number]), float(s[number]), name, what, at, ends))
    return found


@jitted
def _coefficients(
    pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]
) -> Float[Array, " orbit"]:
    return jax.vmap(cubic_coefficient)(pair, sequence, knots)


def _cubics(paths: CurvePath, ys: np.ndarray) -> np.ndarray:
    """Compute the cubic coefficients of points of flips, a path each."""
    pair, knots = paths.pair_and_knots(ys)
    return tiles.map_tiles(lambda rows: _coefficients(*rows), (pair, paths.sequence, knots), _AT_ONCE)


def _with_cubics(paths: CurvePath, walked: list[Walked]) -> list[np.ndarray]:
    """Give the test functions of all points, with the coefficients of flips, which no step needs to know."""
    tests = [one.tests for one in walked]
    flips = np.flatnonzero(paths.multiplier < 0) if paths.condition == "multiplier" else np.zeros(0, int)
    if flips.size:
        sizes = [len(tests[lane]) for lane in flips]
        rows = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[flips], sizes, axis=0), paths)
        values = np.split(_cubics(rows, np.concatenate([walked[lane].y for lane in flips])), np.cumsum(sizes)[:-1])
        for lane, cubics in zip(flips, values, strict=True):
            tests[lane] = tests[lane].copy()
            tests[lane][:, CUBIC] = cubics
    return tests


def _named(path: CurvePath, test: int, y: np.ndarray, kind: str, settings: ContinuationSettings) -> tuple[str, bool]:
    """Name what a sign change means on a curve of a kind, and say whether the curve ends there."""
    name = CurveTests._fields[test]
    if test == TURN:
        return _turning(orbits_at(path, y[None]), settings)
    if test == CUBIC:
        return ("degenerate pitchfork" if kind == "pitchfork" else "generalised flip"), False
    limit = path.device is not None
    if name in ("plus", "minus"):
        flip = "pitchfork" if bool(path.sequence.mirrored) else "flip"
        return f"{'fold' if name == 'plus' else flip}{' at a limit' if limit else '-graze'}", False
    if name == "resonance":
        return "resonant graze", False
    if name == "push":
        return ("double limit" if limit else "degenerate graze"), True
    if name in _TEST and limit:
        return "graze at a limit", True
    if name in _TEST and kind.startswith("grazing"):
        # Where a simpler orbit touches, its mirror pair or doubled orbits touch twice.
        simple = _bifurcated(orbits_at(path, y[None]), settings)
        return (f"{simple}-graze" if simple else "double graze"), True
    if name in _TEST:
        return f"{kind}-graze", True
    bound, _, which = name.partition("_")
    return f"{path.along[which == 'second']} {bound}", True


def _turning(orbit: Orbit, settings: ContinuationSettings) -> tuple[str, bool]:
    """Tell a cusp of folds from where folds of a mirror pair, or of doubled orbits, meet what these bifurcate from.

    There the curve goes on with the other one of the pair, or with the same orbit shifted, over the same places.
    """
    simple = _bifurcated(orbit, settings)
    return {"pitchfork": "degenerate pitchfork", "flip": "generalised flip"}.get(simple, "cusp"), bool(simple)


def _bifurcated(orbit: Orbit, settings: ContinuationSettings) -> str:
    """Say what a mirror pair, or doubled orbits, have come back to where they are a simpler orbit; else nothing."""
    if not bool(orbit.sequence.mirrored[0]) and bool(symmetry.symmetric(orbit, settings.asymmetry)[0]):
        return "pitchfork"
    period = int(orbit_properties.counts(orbit, settings.asymmetry).period[0])
    return "flip" if period < 0.5 * float(orbit.sequence.span[0]) else ""
