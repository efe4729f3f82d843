"""What bounds an optimum in the plane of two tolerances: the curves there, and how far the nearest of them is."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design.optimum import Optimum
from vijax.design.tolerance import Tolerance, check_tolerances
from vijax.model.device import with_constants
from vijax.model.quantities import QUANTITIES, whole
from vijax.model.records import Status
from vijax.model.sides import field_of
from vijax.orbits import curve_lanes, periodic
from vijax.orbits.curves import BifurcationCurve
from vijax.orbits.limits import LIMITS
from vijax.orbits.orbit_curves import curves_about
from vijax.orbits.parameter import MOVED
from vijax.runtime import checks
from vijax.runtime.context import door

_TIMES = 3.0  # The plane reaches so many times the tolerances to either side, and at least `_REACH` of the values.
_REACH, _MOST = 0.2, 0.9
# Parts of the way to a curve by which an orbit goes there: beside a fold it moves by the root of what is left.
_SHARES = (*np.linspace(0.1, 0.9, 9), 0.97, 0.99, 0.997, 0.999, 0.9997, 0.9999)
# How near its traits then are to those of the curve's orbit, at whose fold it would be: the root of 1e-4 times a bend
# of order one. Another orbit's differ by as much as the two are apart.
_ALIKE = 0.1


class NearestPoint(NamedTuple):
    """The point of some curves that is nearest to an optimum.

    Attributes:
        kind: Of the curve.
        values: Both constants there.
        percent: How far off each is, in percent of the optimum's.
        times: By which factor both tolerances may grow together until they reach it; below 1 it lies within them.
    """

    kind: str
    values: tuple[float, float]
    percent: tuple[float, float]
    times: float


class TolerancePlane(NamedTuple):
    """The plane of two tolerances about an optimum.

    Attributes:
        tolerances: Both.
        here: The optimum's constants.
        within: Bounds of the plane.
        curves: Of bifurcations and limits of its orbit, beyond their cusps of others that coexist.
        nearest: Of all bifurcations that it meets on the straight way there; None where there is none in the plane.
        limit: Of the limits of penetration and energy.
    """

    tolerances: tuple[Tolerance, Tolerance]
    here: tuple[float, float]
    within: dict[str, tuple[float, float]]
    curves: list[BifurcationCurve]
    nearest: NearestPoint | None
    limit: NearestPoint | None


@door
def tolerance_plane(optimum: Optimum, tolerances: Sequence[Tolerance]) -> TolerancePlane:
    """Find the curves of bifurcations and limits in the plane of two tolerances about an optimum.

    Args:
        optimum: An orbit: what is none has no bifurcations of its own.
        tolerances: Of two constants that the motion depends on.

    Raises:
        ValueError: Not two tolerances, or of a constant that no orbit depends on.
    """
    checks.instance("optimum", optimum, Optimum, "vijax.optimise(...).best, an orbit")
    one, other = check_pair(tolerances)
    here = float(field_of(optimum.device, one.name)), float(field_of(optimum.device, other.name))
    within = {t.name: _about(t, x) for t, x in zip((one, other), here, strict=True)}
    found = curves_about(optimum.orbit, within, device=optimum.device)
    spread = one.spread, other.spread
    bifurcations = [curve for curve in found if curve.kind not in LIMITS]
    limits = [curve for curve in found if curve.kind in LIMITS]
    found_of = _nearest(bifurcations, optimum, spread), _nearest(limits, optimum, spread)
    return TolerancePlane((one, other), here, within, found, *found_of)


def check_pair(tolerances: Sequence[Tolerance]) -> tuple[Tolerance, Tolerance]:
    """Take two tolerances whose constants make a plane in which orbits can be followed."""
    found = check_tolerances(tolerances)
    if len(found) != 2:
        raise ValueError(f"tolerances must be of two constants, the plane's; got {len(found)}")
    for one in found:
        checks.choice("tolerances: name", one.name, [name for name in MOVED if name in QUANTITIES])
    return found[0], found[1]


def _about(of: Tolerance, x: float) -> tuple[float, float]:
    """Give the bounds of the plane about a value."""
    reach = min(max(_TIMES * of.spread, _REACH), _MOST)
    return x * (1 - reach), min(x * (1 + reach), 1.0) if whole(of.name) == "r" else x * (1 + reach)


def _nearest(found: list[BifurcationCurve], optimum: Optimum, spread: tuple[float, float]) -> NearestPoint | None:
    """Find the point that the box of the tolerances reaches first as it grows, of those that the optimum's orbit meets.

    Past a cusp a curve is that of another orbit, which coexists with the optimum's.
    """
    candidates = [piece for curve in found for piece in _pieces(curve, optimum, spread)]
    for piece in sorted(candidates, key=lambda one: one.point.times):
        if _meets(optimum, piece):
            return piece.point
    return None


class _Piece(NamedTuple):
    """A curve between two of its cusps: its point that is nearest, and its orbit next to there."""

    curve: BifurcationCurve
    place: int
    point: NearestPoint


def _pieces(curve: BifurcationCurve, optimum: Optimum, spread: tuple[float, float]) -> Iterator[_Piece]:
    """Find the nearest point of every piece of a curve on which stable orbits border."""
    here = np.array([float(field_of(optimum.device, name)) for name in curve.along])
    unit = here * spread
    place = (curve.values - here) / unit
    begin, step = place[:-1], np.diff(place, axis=0)
    kept = curve.stable[:-1] & curve.stable[1:]
    cusps = [np.array(point.values) for point in curve.points if point.kind == "cusp"]
    cuts = sorted(int(np.abs((curve.values - cusp) / unit).max(axis=1).argmin()) for cusp in cusps)
    for first, last in pairwise([0, *cuts, len(begin)]):
        mine = np.arange(first, last)[kept[first:last]]
        if mine.size:
            at, times, which = _closest(begin[mine], step[mine])
            x, y = (float(value) for value in here + at * unit)
            percent = 100 * (x / float(here[0]) - 1), 100 * (y / float(here[1]) - 1)
            yield _Piece(curve, int(mine[which]), NearestPoint(curve.kind, (x, y), percent, times))


def _meets(optimum: Optimum, piece: _Piece) -> bool:
    """Say whether the optimum's orbit, as its device moves straight to a point of a curve, becomes that curve's."""
    along, orbit = piece.curve.along, optimum.orbit
    here = [float(field_of(optimum.device, name)) for name in along]
    for share in _SHARES:
        moved = {name: a + share * (b - a) for name, a, b in zip(along, here, piece.point.values, strict=True)}
        pair = jax.tree.map(lambda x: jnp.asarray(x, float)[None], with_constants(optimum.device, **moved).pair())
        orbit = periodic.solve(pair, orbit.sequence, jnp.nan_to_num(orbit.knots))
        if int(orbit.status[0]) == Status.NO_ORBIT:
            return False
    mine = curve_lanes.traits(orbit, images=True)
    theirs = curve_lanes.traits(piece.curve.orbit[piece.place : piece.place + 2])
    return bool(min(np.abs(one - other).max() for one in mine for other in theirs) < _ALIKE)


def _closest(begin: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Find the place on straight pieces whose larger coordinate is least, that coordinate, and on which piece it is.

    On a piece it is at an end, where a coordinate is zero, or where both are as large.
    """
    (a, c), (b, d) = begin.T, step.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.stack([0 * a, 0 * a + 1, -a / b, -c / d, (c - a) / (b - d), -(a + c) / (b + d)])
    shares = np.clip(np.nan_to_num(shares, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    places = begin + shares[..., None] * step
    size = np.abs(places).max(axis=-1)
    which = np.unravel_index(size.argmin(), size.shape)
    return places[which], float(size[which]), int(which[1])
