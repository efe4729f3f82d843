"""Curves around an orbit in a plane of two parameters: its bifurcations, and the limits of its device."""

import warnings
from collections.abc import Mapping

import numpy as np

from vijax.continuation import branch_continuation
from vijax.continuation.branch_continuation import Branch
from vijax.continuation.continuation_parameter import check_bounds
from vijax.continuation.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.continuation.curves.curve_plane import check_plane
from vijax.continuation.curves.curve_starts import CurveStart, curve_start
from vijax.continuation.curves.curves import BifurcationCurve, curves_from
from vijax.continuation.limits import LIMITS, device_with_value, limit_points, limit_start
from vijax.model.device import Harvester, scalar_device
from vijax.model.records import Status
from vijax.orbits.periodic import Orbit, check_orbit
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

# Places on a branch, as fractions of its orbits, from where orbits are followed along the other parameter too, because
# a curve may lie in a corner of the plane that neither line through the given orbit meets.
_SIDE_FRACTIONS = (0.25, 0.75)
_BRANCH_POINTS = 1000


@public_api
def curves_about(
    orbit: Orbit,
    within: Mapping[str, tuple[float, float]],
    *,
    device: Harvester | None = None,
    max_points: int = 1000,
    settings: ContinuationSettings = DEFAULT,
) -> list[BifurcationCurve]:
    """Compute the curves of bifurcations and limits that an orbit meets as two parameters change.

    The orbit is followed along each parameter. From two points of each of these two branches, orbits are followed along
    the other parameter. A curve is followed from every event on these branches, unless the event lies on another curve.

    Args:
        orbit: One orbit, verified.
        within: The two parameters with their bounds; the orbit lies between them.
        device: Device of the orbit and of the limits.
        max_points: Largest number of points of a curve in each direction.
        settings: Settings of steps and events.

    Raises:
        ValueError: No orbit, or a plane that does not contain it.
    """
    if len(check_orbit(orbit)) != 1:
        raise ValueError(f"orbit must be one; got {len(orbit)}; take [0:1]")
    max_points, settings = (
        validation.validate_integer("max_points", max_points, 2, branch_continuation.MOST_POINTS),
        check_settings(settings),
    )
    device, plane = scalar_device(device), check_plane(orbit.pair, within)
    orbit_values = {name: float(np.ravel(check_bounds(orbit.pair, name, plane[name], device))[0]) for name in plane}

    def follow_line(start_orbit: Orbit, along: str, other: str, value: float) -> tuple[Branch, list[CurveStart]]:
        """Return the branch of an orbit along one parameter, and starts at its events; `other` is fixed at `value`."""
        # The limits depend on the device at the fixed value of the other parameter.
        line_device = device_with_value(device, other, value)
        (branch,) = branch_continuation.follow_orbits(
            start_orbit, along, plane[along], device=line_device, points=_BRANCH_POINTS, settings=settings
        )
        events = [*branch.points, *limit_points([branch], device=line_device)]
        along_first = along == next(iter(plane))
        parameters = [(point.value, value) if along_first else (value, point.value) for point in events]
        starts = [
            limit_start(point, point_parameters, tuple(plane), device, settings.asymmetry)
            if point.kind in LIMITS
            else curve_start(point, point_parameters, settings.asymmetry, plane)
            for point, point_parameters in zip(events, parameters, strict=True)
        ]
        return branch, [start for start in starts if isinstance(start, CurveStart)]

    starts: list[CurveStart] = []
    # Follow the orbit along each parameter in turn, with the other one fixed.
    for along, other in (tuple(plane), tuple(plane)[::-1]):
        branch, line_starts = follow_line(orbit, along, other, orbit_values[other])
        starts += line_starts
        for fraction in _SIDE_FRACTIONS:
            # Index of the orbit at this fraction of the branch, rounded down.
            index = int(fraction * (len(branch.values) - 1))
            side_orbit = branch.orbit[index : index + 1]
            if int(side_orbit.status[0]) == Status.OK:
                starts += follow_line(side_orbit, other, along, float(branch.values[index]))[1]
    with warnings.catch_warnings():
        # A start without a real orbit next to it begins no curve; the warning is suppressed.
        warnings.filterwarnings("ignore", message=".* begin no curve")
        return [curve for batch in curves_from(starts, plane, device, max_points, settings) for curve in batch]
