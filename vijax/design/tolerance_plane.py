"""What bounds an optimum in the plane of two tolerances: the curves there, and how far the nearest of them is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vijax.design.optimum import Optimum
from vijax.design.tolerance import Tolerance, check_tolerances
from vijax.model.quantities import QUANTITIES
from vijax.orbits.curves import BifurcationCurve
from vijax.orbits.limits import LIMITS
from vijax.orbits.orbit_curves import curves_about
from vijax.orbits.parameter import MOVED
from vijax.runtime import checks
from vijax.runtime.context import door

_TIMES = 3.0  # The plane reaches so many times the tolerances to either side, and at least `_REACH` of the values.
_REACH, _MOST = 0.2, 0.9


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
        curves: Of bifurcations and limits of its orbit.
        nearest: Of all bifurcations that a stable orbit meets; None where there is none in the plane.
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
    here = float(getattr(optimum.device, one.name)), float(getattr(optimum.device, other.name))
    within = {t.name: _about(t, x) for t, x in zip((one, other), here, strict=True)}
    curves = curves_about(optimum.orbit, within, device=optimum.device)
    spread = one.spread, other.spread
    bifurcations = [curve for curve in curves if curve.kind not in LIMITS]
    limits = [curve for curve in curves if curve.kind in LIMITS]
    found = _nearest(bifurcations, here, spread), _nearest(limits, here, spread)
    return TolerancePlane((one, other), here, within, curves, *found)


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
    return x * (1 - reach), min(x * (1 + reach), 1.0) if of.name == "r" else x * (1 + reach)


def _nearest(
    curves: list[BifurcationCurve], here: tuple[float, float], spread: tuple[float, float]
) -> NearestPoint | None:
    """Find the point that the box of the tolerances reaches first as it grows."""
    best: NearestPoint | None = None
    middle, unit = np.array(here), np.array(here) * spread
    for curve in curves:
        place = (curve.values - middle) / unit
        begin, step = place[:-1], np.diff(place, axis=0)
        kept = curve.stable[:-1] & curve.stable[1:]
        if not kept.any():
            continue
        at, times = _closest(begin[kept], step[kept])
        if best is None or times < best.times:
            x, y = (float(value) for value in middle + at * unit)
            percent = 100 * (x / here[0] - 1), 100 * (y / here[1] - 1)
            best = NearestPoint(curve.kind, (x, y), percent, times)
    return best


def _closest(begin: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, float]:
    """Find the place on straight pieces whose larger coordinate is least, and that coordinate.

    On a piece it is at an end, where a coordinate is zero, or where both are as large.
    """
    (a, c), (b, d) = begin.T, step.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.stack([0 * a, 0 * a + 1, -a / b, -c / d, (c - a) / (b - d), -(a + c) / (b + d)])
    shares = np.clip(np.nan_to_num(shares, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    places = begin + shares[..., None] * step
    size = np.abs(places).max(axis=-1)
    which = np.unravel_index(size.argmin(), size.shape)
    return places[which], float(size[which])
