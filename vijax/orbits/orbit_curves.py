"""The curves that bound an orbit in a plane about it: of bifurcations, and of the limits of its device."""

import warnings
from collections.abc import Mapping

import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.model.records import Status
from vijax.orbits import continuation
from vijax.orbits.continuation import Branch
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.orbits.curve_plane import check_plane
from vijax.orbits.curve_starts import CurveStart, curve_start
from vijax.orbits.curves import BifurcationCurve, curves_from
from vijax.orbits.limits import LIMITS, device_at, limit_points, limit_start
from vijax.orbits.parameter import check_bounds
from vijax.orbits.periodic import Orbit, check_orbit
from vijax.runtime import checks
from vijax.runtime.context import door

# Parts of the way along a branch from which orbits are followed along the other parameter, too: a curve may lie in a
# corner of the plane that neither line through the orbit meets.
_ASIDE = (0.25, 0.75)
_BRANCH_POINTS = 1000


@door
def curves_about(
    orbit: Orbit,
    within: Mapping[str, tuple[float, float]],
    *,
    device: Harvester | None = None,
    max_points: int = 1000,
    settings: ContinuationSettings = DEFAULT,
) -> list[BifurcationCurve]:
    """Find the curves of bifurcations and limits that an orbit meets as two parameters change.

    The orbit is followed along both parameters, and from two places of each line along the other one; curves are
    followed from all that is met.

    Args:
        orbit: One orbit, verified.
        within: The two parameters with their bounds; the orbit lies between.
        device: That has the orbit, and whose limits they are.
        max_points: Most points of a curve each way.
        settings: Of steps and events.

    Raises:
        ValueError: No orbit, or a plane that does not hold it.
    """
    if len(check_orbit(orbit)) != 1:
        raise ValueError(f"orbit must be one; got {len(orbit)}; take [0:1]")
    max_points, settings = checks.whole("max_points", max_points, 2, continuation.MOST_POINTS), check_settings(settings)
    device, plane = one_device(device), check_plane(orbit.pair, within)
    here = {name: float(np.ravel(check_bounds(orbit.pair, name, plane[name], device))[0]) for name in plane}

    def followed(begin: Orbit, along: str, other: str, value: float) -> tuple[Branch, list[CurveStart]]:
        """Follow an orbit along one parameter, the other one having a value."""
        own = device_at(device, other, value)
        (branch,) = continuation.follow(
            begin, along, plane[along], device=own, points=_BRANCH_POINTS, settings=settings
        )
        met = [*branch.points, *limit_points([branch], device=own)]
        first = along == next(iter(plane))
        places = [(point.value, value) if first else (value, point.value) for point in met]
        starts = [
            limit_start(point, place, tuple(plane), device, settings.asymmetry)
            if point.kind in LIMITS
            else curve_start(point, place, settings.asymmetry, plane)
            for point, place in zip(met, places, strict=True)
        ]
        return branch, [start for start in starts if isinstance(start, CurveStart)]

    starts: list[CurveStart] = []
    for along, other in (tuple(plane), tuple(plane)[::-1]):
        branch, found = followed(orbit, along, other, here[other])
        starts += found
        for part in _ASIDE:
            index = int(part * (len(branch.values) - 1))
            aside = branch.orbit[index : index + 1]
            if int(aside.status[0]) == Status.OK:
                starts += followed(aside, other, along, float(branch.values[index]))[1]
    with warnings.catch_warnings():
        # Where a ball just no longer flies nothing begins.
        warnings.filterwarnings("ignore", message=".* begin no curve")
        return [one for some in curves_from(starts, plane, device, max_points, settings) for one in some]
