"""Branch switching: the branches that begin at flips and pitchforks, and all branches reached by successive switches.

At a flip of an orbit of period p a branch of period 2p begins; at a pitchfork of a symmetric orbit, a pair of mirror
images begins. Both are found on the doubled orbit: the stored orbit and its repetition, as one orbit. A symmetric orbit
is stored as half a period, so its doubled orbit is one full period. The shooting equations of the doubled orbit have a
singular Jacobian at the bifurcation. The null vector of this Jacobian is the tangent of the new branch; its second half
is the first half with the opposite sign.

Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10 (branch switching).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.continuation.arclength_step import PathPoints
from vijax.continuation.branch_continuation import (
    MOST_POINTS,
    Branch,
    follow_direction,
    follow_orbits,
    validated_branch_paths,
)
from vijax.continuation.branch_equations import BranchTests, orient, start_points
from vijax.continuation.branch_events import Point
from vijax.continuation.continuation_parameter import breaks_mirror_symmetry, check_bounds, with_separate_walls
from vijax.continuation.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.model.device import Harvester, scalar_device
from vijax.model.records import Status
from vijax.orbits import orbit_properties, shooting, symmetry
from vijax.orbits.periodic import Orbit, begin_compiling_verify_solutions, pad_orbits, to_least_period
from vijax.runtime import validation
from vijax.runtime.compilation.programs import jitted, start_compilation
from vijax.runtime.public_api import public_api

MOST_SWITCHES = 64  # largest number of successive switches; each one may multiply the number of branches


_linearise = jitted(shooting.linearise)


@public_api
def switch_branch(
    point: Point,
    along: str,
    within: tuple[float, float],
    *,
    device: Harvester | None = None,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow the branch that bifurcates at a flip (orbits of twice the period) or a pitchfork (mirror pairs of orbits).

    The start is the doubled orbit (the stored orbit and its repetition, as one orbit). The tangent is the null vector
    of the Jacobian of its shooting equations (`switch_direction`).

    Args:
        point: A flip, or a pitchfork on a branch of symmetric orbits stored as half a period
            (`symmetry.close_half_way`).
        along, within, device, points, settings: As in `follow_orbits`.

    Returns:
        Two branches, one per direction. At a pitchfork their orbits are mirror images of each other; at a flip they are
        the same orbits, shifted by a period.

    Raises:
        ValueError: A point without a bifurcating branch.
    """
    validation.validate_instance("point", point, Point, "continuation.follow_orbits")
    points, settings = validation.validate_integer("points", points, 2, MOST_POINTS), check_settings(settings)
    if not _can_switch(point):
        raise ValueError(
            f"point must be a flip, or a pitchfork of orbits closed half way (symmetry.close_half_way); "
            f"got a {point.kind} of "
            f"orbits closed {'half way' if point.orbit.sequence.mirrored[0] else 'in full'}"
        )
    # Raises an error unless the point lies within the bounds.
    check_bounds(point.orbit.pair, along, within, scalar_device(device))
    doubled, direction = switch_direction(point.orbit)
    paths, y = validated_branch_paths(doubled, along, within, device, settings)
    begin_compiling_verify_solutions(doubled.pair, doubled.sequence, doubled.impact_unknowns)
    tangent = np.append(direction, 0.0)[None]
    # The start is an event of the previous branch. Its test functions are set to NaN (unknown), so that it is not
    # reported as an event of the new branch, too.
    first = PathPoints(y, tangent, np.full((1, len(BranchTests._fields)), np.nan), np.full(1, True), np.zeros(1))
    return [follow_direction(doubled, paths, orient(first, sign), along, points, settings)[0] for sign in (1.0, -1.0)]


def switch_direction(orbit: Orbit) -> tuple[Orbit, np.ndarray]:
    """Return the doubled orbit, and the unit direction of its unknowns along the bifurcating branch.

    The doubled orbit is the stored orbit and its repetition, as one orbit.
    """
    twice = symmetry.double(orbit)
    pair, sequence, impact_unknowns = jax.tree.map(
        lambda leaf: np.asarray(leaf)[0], (twice.pair, twice.sequence, twice.impact_unknowns)
    )
    padded: Any = np.where(sequence.real[:, None], impact_unknowns, 0.0)
    # Right singular vector of the smallest singular value: the null vector of the Jacobian.
    return twice, np.linalg.svd(np.asarray(_linearise(pair, sequence, padded).slope))[2][-1]


def _can_switch(point: Point) -> bool:
    """Return True if another branch begins at a point that `switch_branch` can follow."""
    return point.kind == "flip" or (point.kind == "pitchfork" and bool(point.orbit.sequence.mirrored[0]))


def _is_verified(point: Point) -> bool:
    """Return True if the orbit of a point is verified; it may fail where impacts fade at a branch's end."""
    return bool(point.orbit.status[0] == Status.OK)


@public_api
def follow_families(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    device: Harvester | None = None,
    max_switches: int = 1,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow the branches of orbits, the branches that bifurcate from them at flips and pitchforks, and so on.

    Args:
        orbit, along, within, device, points, settings: As in `follow_orbits`. Symmetric orbits are reduced to half a
            period, unless the parameter breaks the mirror symmetry.
        max_switches: Number of successive switches from one branch to the next; 0 follows the given orbits alone.

    Raises:
        ValueError: As `follow_orbits`.
    """
    max_switches = validation.validate_integer("max_switches", max_switches, 0, MOST_SWITCHES)
    points, settings = validation.validate_integer("points", points, 2, MOST_POINTS), check_settings(settings)
    orbit = with_separate_walls(to_least_period(orbit), along)
    validated_branch_paths(orbit, along, within, device, settings)
    options: Any = {"device": device, "points": points, "settings": settings}
    branches: list[Branch] = []
    orbits = [orbit[index : index + 1] for index in range(len(orbit))]
    # An orbit is followed in full if it has no mirror symmetry, or if the parameter breaks this symmetry.
    symmetric = [not breaks_mirror_symmetry(along) and bool(symmetry.is_symmetric(item)[0]) for item in orbits]
    # A symmetric orbit, stored as half a period, is padded to the width of the others, so that all share one program.
    width = orbit.impact_unknowns.shape[1]

    def starts(close: Callable[[Orbit], Orbit]) -> list[Orbit]:
        return [pad_orbits(close(item), width) if half else item for item, half in zip(orbits, symmetric, strict=True)]

    # The slowest program starts to compile first, while symmetric orbits are reduced to half a period.
    for item in starts(symmetry.first_half):
        start_compilation(start_points, *validated_branch_paths(item, along, within, device, settings))
    for item in starts(symmetry.close_half_way):
        branches += _new_branches(follow_orbits(item, along, within, **options), branches, settings)
    newest = branches
    for _ in range(max_switches):
        existing = [event for branch in branches for event in _signatures(branch) if not event.simpler]
        events = [
            (event, point)
            for branch in newest
            for event, point in zip(_signatures(branch), branch.points, strict=True)
            if event.simpler and _can_switch(point) and _is_verified(point)
        ]
        # An existing branch of mirror pairs or doubled orbits through the event is the branch that begins there.
        new_points = [
            point for event, point in events if not _is_listed(event._replace(simpler=False), existing, settings)
        ]
        newest = []
        for point in new_points:
            switched = switch_branch(point, along, within, **options)
            # A branch of one point has no step before the next graze, and is dropped.
            newest += _new_branches([item for item in switched if len(item.values) > 1], branches + newest, settings)
        branches = branches + newest
    return branches


def _new_branches(candidates: list[Branch], existing: list[Branch], settings: ContinuationSettings) -> list[Branch]:
    """Return the branches that are new: they have an event that no existing branch has, or no event at all.

    Branches with the same events count as one branch.
    """
    listed_signatures = [signature for branch in existing for signature in _signatures(branch)]
    new_branches = []
    for branch in candidates:
        signatures = _signatures(branch)
        if not signatures or not all(_is_listed(signature, listed_signatures, settings) for signature in signatures):
            new_branches.append(branch)
            listed_signatures += signatures
    return new_branches


class _EventSignature(NamedTuple):
    """Signature of an event, which distinguishes it from other events.

    Attributes:
        kind: Kind of the event.
        simpler: True if the event was located on the branch of the simpler orbits (symmetric orbits at a pitchfork,
            orbits of half the period at a flip), False if it was located on the branch of mirror pairs or doubled
            orbits. A pitchfork or flip lies on both branches.
        numbers: Signature of the orbit, which does not depend on the impact stored first, and the value of the
            parameter.
    """

    kind: str
    simpler: bool
    numbers: np.ndarray


def _signatures(branch: Branch) -> list[_EventSignature]:
    return [_signature(point, float(branch.orbit.sequence.span[0])) for point in branch.points]


def _signature(point: Point, span: float) -> _EventSignature:
    """Return the signature of an event; `span` is the duration of the stored part of the orbits of its branch."""
    sequence = point.orbit.sequence
    # On a branch of doubled orbits, the orbit recorded at a flip has half the span of the branch.
    simpler = float(sequence.span[0]) == span if point.kind == "flip" else bool(sequence.mirrored[0])
    numbers = np.asarray(orbit_properties.orbit_signature(symmetry.unfold(point.orbit)))[0]
    return _EventSignature(point.kind, simpler, np.append(numbers, point.value))


def _is_listed(signature: _EventSignature, existing: list[_EventSignature], settings: ContinuationSettings) -> bool:
    """Return True if a signature is equal to one of a list, to within `asymmetry`."""
    same_kind = [other for other in existing if (other.kind, other.simpler) == (signature.kind, signature.simpler)]
    return any(np.allclose(signature.numbers, other.numbers, atol=settings.asymmetry) for other in same_kind)
