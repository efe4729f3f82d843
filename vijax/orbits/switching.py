"""Switching: the branches that begin at flips and pitchforks, and the family of all that begin on these in turn."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.model.records import Status
from vijax.orbits import orbit_properties, shooting, symmetry
from vijax.orbits.arclength_step import BranchPlace
from vijax.orbits.branch_path import Tests, heading, upwards
from vijax.orbits.continuation import MOST_POINTS, Branch, follow, follow_arcs, set_out
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.orbits.events import Point
from vijax.orbits.parameter import able, check_bounds, skews
from vijax.orbits.periodic import Orbit, begin_proofs, to_least_period, widened
from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.programs import begin, jitted

MOST_SWITCHES = 64  # So many switches in a row at most: each may find several branches from every one before.


_linearised = jitted(shooting.linearise)


@door
def switch(
    point: Point,
    along: str,
    within: tuple[float, float],
    *,
    device: Harvester | None = None,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow the branch that bifurcates at a flip (twice the period) or at a pitchfork of an orbit closed half way.

    The doubled orbit is the same one run through twice, and what leaves it there is the null vector that changes sign
    from one half to the other (`leaving`).

    Args:
        point: A flip, or a pitchfork on a branch of orbits closed half way (`symmetry.halved`).
        along, within, device, points, settings: As in `follow`.

    Returns:
        The two ways out: mirror images of each other at a pitchfork, shifted by a period at a flip.

    Raises:
        ValueError: A point at which nothing of the kind begins.
    """
    checks.instance("point", point, Point, "continuation.follow")
    points, settings = checks.whole("points", points, 2, MOST_POINTS), check_settings(settings)
    if not _begins(point):
        raise ValueError(
            f"point must be a flip, or a pitchfork of orbits closed half way (symmetry.halved); got a {point.kind} of "
            f"orbits closed {'half way' if point.orbit.sequence.mirrored[0] else 'in full'}"
        )
    check_bounds(point.orbit.pair, along, within, one_device(device))
    doubled, ahead = leaving(point.orbit)
    arcs, y = set_out(doubled, along, within, device, settings)
    begin_proofs(doubled.pair, doubled.sequence, doubled.knots)
    away = np.append(ahead, 0.0)[None]
    # Test functions that vanish here would be met again at once.
    first = BranchPlace(y, away, np.full((1, len(Tests._fields)), np.nan), np.full(1, True), np.zeros(1))
    return [follow_arcs(doubled, arcs, heading(first, sign), along, points, settings)[0] for sign in (1.0, -1.0)]


def leaving(orbit: Orbit) -> tuple[Orbit, np.ndarray]:
    """Run through an orbit twice, and find how the knots of what bifurcates from it there leave it at first."""
    twice = symmetry.doubled(orbit)
    pair, sequence, knots = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (twice.pair, twice.sequence, twice.knots))
    padded: Any = np.where(sequence.real[:, None], knots, 0.0)
    return twice, np.linalg.svd(np.asarray(_linearised(pair, sequence, padded).slope))[2][-1]


def _begins(point: Point) -> bool:
    """Say whether another branch begins there that `switch` can find."""
    return point.kind == "flip" or (point.kind == "pitchfork" and bool(point.orbit.sequence.mirrored[0]))


def _real(point: Point) -> bool:
    """Say whether a ball flies the orbit of a point: at the very end of a branch, where impacts fade, none may."""
    return bool(point.orbit.status[0] == Status.OK)


@door
def family(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    device: Harvester | None = None,
    max_switches: int = 1,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow the branches of some orbits, and those that bifurcate from them at flips and pitchforks, and so on.

    Args:
        orbit, along, within, device, points, settings: As in `follow`; symmetric orbits are closed half way.
        max_switches: How often a branch may lead to another; 0 follows the given orbits alone.

    Raises:
        ValueError: As `follow`.
    """
    max_switches = checks.whole("max_switches", max_switches, 0, MOST_SWITCHES)
    points, settings = checks.whole("points", points, 2, MOST_POINTS), check_settings(settings)
    orbit = able(to_least_period(orbit), along)
    set_out(orbit, along, within, device, settings)
    # What follow and switch are told alike.
    told: Any = {"device": device, "points": points, "settings": settings}
    grown: list[Branch] = []
    alone = [orbit[index : index + 1] for index in range(len(orbit))]
    half = [not skews(along) and bool(symmetry.symmetric(one)[0]) for one in alone]
    # Closed half way an orbit is as wide as the others, for one program: a place without an impact costs little.
    width = orbit.knots.shape[1]

    def starts(close: Callable[[Orbit], Orbit]) -> list[Orbit]:
        return [widened(close(one), width) if symmetric else one for one, symmetric in zip(alone, half, strict=True)]

    # What takes longest to compile begins first, while orbits that are closed half way are solved.
    for one in starts(symmetry.cut):
        begin(upwards, *set_out(one, along, within, device, settings))
    for one in starts(symmetry.halved):
        grown += _new(follow(one, along, within, **told), grown, settings)
    youngest = grown
    for _ in range(max_switches):
        known = [mark for branch in grown for mark in _marks(branch) if not mark.simpler]
        met = [
            (mark, point)
            for branch in youngest
            for mark, point in zip(_marks(branch), branch.points, strict=True)
            if mark.simpler and _begins(point) and _real(point)
        ]
        # A known branch of mirror pairs, or of doubled orbits, that comes by is the one which begins there.
        where = [point for mark, point in met if not _among(mark._replace(simpler=False), known, settings)]
        youngest = []
        for point in where:
            begun = switch(point, along, within, **told)
            # Where a graze is too near for a step there is nothing to tell but that something begins.
            youngest += _new([one for one in begun if len(one.values) > 1], grown + youngest, settings)
        grown = grown + youngest
    return grown


def _new(found: list[Branch], known: list[Branch], settings: ContinuationSettings) -> list[Branch]:
    """Keep branches that met something which no known one has met: the same points lie on the same branch."""
    old = [mark for branch in known for mark in _marks(branch)]
    new = []
    for branch in found:
        met = _marks(branch)
        if not met or not all(_among(mark, old, settings) for mark in met):
            new.append(branch)
            old += met
    return new


class _Mark(NamedTuple):
    """What tells points apart.

    Attributes:
        kind: Of the point.
        simpler: Whether it is on the branch of the simpler orbits: of a pitchfork those closed half way, of a flip
            those of half the period. Both are on another branch, too.
        traits: Numbers that tell orbits apart, whichever impact they begin with, and the place of the point.
    """

    kind: str
    simpler: bool
    traits: np.ndarray


def _marks(branch: Branch) -> list[_Mark]:
    return [_mark(point, float(branch.orbit.sequence.span[0])) for point in branch.points]


def _mark(point: Point, span: float) -> _Mark:
    """Make the mark of a point on a branch of orbits with a span."""
    sequence = point.orbit.sequence
    simpler = float(sequence.span[0]) == span if point.kind == "flip" else bool(sequence.mirrored[0])
    numbers = np.asarray(orbit_properties.marks(symmetry.unfolded(point.orbit)))[0]
    return _Mark(point.kind, simpler, np.append(numbers, point.value))


def _among(mark: _Mark, known: list[_Mark], settings: ContinuationSettings) -> bool:
    """Say whether a mark is one of those known."""
    alike = [other for other in known if (other.kind, other.simpler) == (mark.kind, mark.simpler)]
    return any(np.allclose(mark.traits, other.traits, atol=settings.asymmetry) for other in alike)
