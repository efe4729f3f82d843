"""Bifurcations and limits of an optimum in the plane of two constants, scaled by the tolerances of both.

The distance of a point is the factor on both tolerances that reaches it, the larger of |change| / (value * spread) of
the two constants.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS
from vijax.continuation.curves import curve_preparation
from vijax.continuation.curves.curves import BifurcationCurve
from vijax.continuation.curves.orbit_curves import curves_about
from vijax.continuation.limits import LIMITS
from vijax.design.optimum import Optimum
from vijax.design.robustness.tolerance import Tolerance, validate_tolerances
from vijax.model.device import with_constants
from vijax.model.quantities import QUANTITIES, without_wall
from vijax.model.records import Status
from vijax.model.walls.sides import field_of
from vijax.orbits import periodic
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

# Half width of the plane in units of the tolerances; at least `_LEAST_REACH` and at most `_LARGEST_REACH` of the
# values.
_TOLERANCE_FACTOR = 3.0
_LEAST_REACH, _LARGEST_REACH = 0.2, 0.9
# The orbit is solved for at these shares of the straight line from the optimum to a curve. Near a fold the orbit
# changes with the square root of the remaining distance, so the shares are dense near 1.
_SHARES = (*np.linspace(0.1, 0.9, 9), 0.97, 0.99, 0.997, 0.999, 0.9997, 0.9999)
# If the signatures of the followed orbit, at the last share, and of the curve's orbit differ by less than this value,
# they are the same orbit. At a fold the difference is sqrt(1e-4) times a curvature of order one. Distinct orbits differ
# by more.
_SAME_ORBIT = 0.1


class NearestPoint(NamedTuple):
    """The point nearest to an optimum on the curves of bifurcations, or on the curves of limits.

    Attributes:
        kind: Kind of the curve.
        values: Values of the two constants at the point.
        percent: Changes of the two constants from the optimum to the point, in percent.
        factor: Factor on both tolerances that reaches the point; below 1 the point lies within the tolerances.
    """

    kind: str
    values: tuple[float, float]
    percent: tuple[float, float]
    factor: float


class TolerancePlane(NamedTuple):
    """Curves in the plane of two constants with tolerances about an optimum.

    Attributes:
        tolerances: Tolerances of the two constants.
        centre: Values of the two constants at the optimum.
        bounds: Bounds of the plane, (low, high) by name of the constant.
        curves: Curves of bifurcations and limits of the optimum's orbit. Beyond a cusp a curve belongs to a coexisting
            orbit.
        nearest: Nearest bifurcation that the orbit reaches if the constants move straight to it; None if there is none
            in the plane.
        limit: Nearest point of the curves of the limits of penetration and energy, with the same condition.
    """

    tolerances: tuple[Tolerance, Tolerance]
    centre: tuple[float, float]
    bounds: dict[str, tuple[float, float]]
    curves: list[BifurcationCurve]
    nearest: NearestPoint | None
    limit: NearestPoint | None


@public_api
def tolerance_plane(optimum: Optimum, tolerances: Sequence[Tolerance]) -> TolerancePlane:
    """Compute the curves of bifurcations and limits in the plane of two tolerances about an optimum.

    Args:
        optimum: An optimum on an orbit, because only orbits can be continued.
        tolerances: Tolerances of two constants that affect the motion.

    Raises:
        ValueError: The number of tolerances is not two, or a constant does not affect the motion.
    """
    validation.validate_instance("optimum", optimum, Optimum, "vijax.optimise(...).best, an orbit")
    first, second = validate_tolerance_pair(tolerances)
    centre = float(field_of(optimum.device, first.name)), float(field_of(optimum.device, second.name))
    bounds = {t.name: _plane_bounds(t, x) for t, x in zip((first, second), centre, strict=True)}
    curves = curves_about(optimum.orbit, bounds, device=optimum.device)
    spread = first.spread, second.spread
    bifurcations = [curve for curve in curves if curve.kind not in LIMITS]
    limits = [curve for curve in curves if curve.kind in LIMITS]
    nearest_points = _nearest(bifurcations, optimum, spread), _nearest(limits, optimum, spread)
    return TolerancePlane((first, second), centre, bounds, curves, *nearest_points)


def validate_tolerance_pair(tolerances: Sequence[Tolerance]) -> tuple[Tolerance, Tolerance]:
    """Return two tolerances; raise ValueError if there are not two, or orbits cannot be continued in a constant."""
    pair = validate_tolerances(tolerances)
    if len(pair) != 2:
        raise ValueError(f"tolerances must be of two constants, the plane's; got {len(pair)}")
    for tolerance in pair:
        validation.validate_choice(
            "tolerances: name", tolerance.name, [name for name in AFFECTED_CONSTANTS if name in QUANTITIES]
        )
    return pair[0], pair[1]


def _plane_bounds(tolerance: Tolerance, x: float) -> tuple[float, float]:
    """Return the bounds of one constant of the plane about its value x."""
    # Restitution r is at most 1.
    reach = min(max(_TOLERANCE_FACTOR * tolerance.spread, _LEAST_REACH), _LARGEST_REACH)
    return x * (1 - reach), min(x * (1 + reach), 1.0) if without_wall(tolerance.name) == "r" else x * (1 + reach)


def _nearest(curves: list[BifurcationCurve], optimum: Optimum, spread: tuple[float, float]) -> NearestPoint | None:
    """Return the point of the curves nearest to the optimum at which the orbit of the optimum itself bifurcates.

    The distance is the larger of both coordinates' distances, in units of the tolerances. Each curve is divided at its
    cusps, because beyond a cusp it belongs to another orbit, which coexists with the orbit of the optimum. The nearest
    points of all pieces are tested in ascending order of distance; None if the orbit reaches no piece.
    """
    candidates = [candidate for curve in curves for candidate in _pieces(curve, optimum, spread)]
    for candidate in sorted(candidates, key=lambda piece: piece.point.factor):
        if _reaches_curve(optimum, candidate):
            return candidate.point
    return None


class _Piece(NamedTuple):
    """A curve, the nearest point of one piece between cusps, and the index `place` of the curve's orbit before it."""

    curve: BifurcationCurve
    place: int
    point: NearestPoint


def _pieces(curve: BifurcationCurve, optimum: Optimum, spread: tuple[float, float]) -> Iterator[_Piece]:
    """Yield the nearest point of each piece between cusps, on the segments where the curve bounds stable orbits."""
    centre = np.array([float(field_of(optimum.device, name)) for name in curve.along])
    unit = centre * spread
    # Coordinates relative to the optimum, in units of the tolerances.
    points = (curve.values - centre) / unit
    begin, step = points[:-1], np.diff(points, axis=0)
    # A segment between successive points counts only if stable orbits end at both points.
    is_stable = curve.stable[:-1] & curve.stable[1:]
    cusps = [np.array(point.values) for point in curve.points if point.kind == "cusp"]
    # The curve is cut at the computed point nearest to each cusp.
    cuts = sorted(int(np.abs((curve.values - cusp) / unit).max(axis=1).argmin()) for cusp in cusps)
    for first, last in pairwise([0, *cuts, len(begin)]):
        rows = np.arange(first, last)[is_stable[first:last]]
        if rows.size:
            nearest, factor, piece = _closest_point(begin[rows], step[rows])
            x, y = (float(value) for value in centre + nearest * unit)
            percent = 100 * (x / float(centre[0]) - 1), 100 * (y / float(centre[1]) - 1)
            yield _Piece(curve, int(rows[piece]), NearestPoint(curve.kind, (x, y), percent, factor))


def _reaches_curve(optimum: Optimum, piece: _Piece) -> bool:
    """Return True if the optimum's orbit, continued straight to the point, becomes the curve's orbit there."""
    along, orbit = piece.curve.along, optimum.orbit
    centre = [float(field_of(optimum.device, name)) for name in along]
    for share in _SHARES:
        constants = {name: a + share * (b - a) for name, a, b in zip(along, centre, piece.point.values, strict=True)}
        # `solve` takes arrays with a leading axis of orbits.
        pair = jax.tree.map(lambda x: jnp.asarray(x, float)[None], with_constants(optimum.device, **constants).pair())
        orbit = periodic.solve(pair, orbit.sequence, jnp.nan_to_num(orbit.impact_unknowns))
        if int(orbit.status[0]) == Status.NO_ORBIT:
            return False
    # The orbit or its mirror image must equal the curve's orbit at the computed point before or after the nearest
    # point.
    orbit_vectors = curve_preparation.curve_signatures(orbit, images=True)
    curve_vectors = curve_preparation.curve_signatures(piece.curve.orbit[piece.place : piece.place + 2])
    return bool(
        min(
            np.abs(orbit_vector - curve_vector).max()
            for orbit_vector in orbit_vectors
            for curve_vector in curve_vectors
        )
        < _SAME_ORBIT
    )


def _closest_point(begin: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Return the point with the smallest maximum norm on straight segments, this norm, and the index of the segment.

    Segment i is begin[i] + share * step[i] with a share from 0 to 1. On a segment the minimum lies at an end, at a zero
    of one coordinate, or where both coordinates have equal modulus.
    """
    (a, c), (b, d) = begin.T, step.T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Shares of the ends (0 and 1), of the zeros of each coordinate, and of the intersections with x = y and x = -y.
        shares = np.stack([0 * a, 0 * a + 1, -a / b, -c / d, (c - a) / (b - d), -(a + c) / (b + d)])
    shares = np.clip(np.nan_to_num(shares, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    points = begin + shares[..., None] * step
    size = np.abs(points).max(axis=-1)
    index = np.unravel_index(size.argmin(), size.shape)
    return points[index], float(size[index]), int(index[1])
