"""Branches of periodic orbits along a parameter, by pseudo-arclength continuation through folds, many at once.

All branches advance together (`path_following`), from graze to graze (`path_segments`). Events between the points of a
branch, such as folds and flips, are located afterwards (`branch_events`).
Source: Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10.
"""

from typing import Literal, NamedTuple

import jax
import numpy as np

from vijax.continuation.arclength_step import PathPoints, place_before_end, predict_and_correct
from vijax.continuation.branch_equations import FIRST_END_TEST, FOLD, BranchPath, BranchTests, orient, start_points
from vijax.continuation.branch_events import (
    BranchEvent,
    Point,
    classify_event,
    events,
    locate,
    merging_tolerance,
    orbits_at,
)
from vijax.continuation.continuation_parameter import (
    breaks_mirror_symmetry,
    check_along,
    check_bounds,
    with_separate_walls,
)
from vijax.continuation.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.continuation.grazing_switch import GrazingSwitch, branch_grazing_switch
from vijax.continuation.path_following import PathRecord
from vijax.continuation.path_segments import PathResult, PathSegment, follow_segments, join_directions
from vijax.model.device import Harvester, scalar_device
from vijax.model.records import Status
from vijax.orbits import periodic, repetition, symmetry
from vijax.orbits.periodic import Orbit, begin_compiling_verify_solutions, check_orbit, to_least_period
from vijax.runtime import tiles, validation
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api

MOST_POINTS = 10**6  # largest number of points of a branch; a larger one, likely a typing error, is refused at once
Direction = Literal["up", "down", "both"]
_LOCATE_REACH = 1e-4  # arclength on either side of a pitchfork or flip, searched on the branch of the simpler orbit
_SIGNS: dict[Direction, tuple[float, ...]] = {"up": (1.0,), "down": (-1.0,), "both": (-1.0, 1.0)}


class Branch(NamedTuple):
    """A branch of real orbits, in the order of their computation.

    Attributes:
        along: Name of the parameter.
        values: Values of the parameter, one per orbit.
        orbit: The orbits, with multipliers.
        points: Events on the branch (folds, flips, pitchforks, grazes), in order.
        ends: Reasons for which the branch ends at its first and at its last orbit: "start" (it was followed from there
            in one direction only); the kind of a `Point` (the branch cannot continue there, or the largest number of
            grazes is reached); "low" or "high" (bound of the parameter); "closed" (back at its start, or at its first
            graze); "points" (largest number of orbits); "lost" (no step was short enough).
    """

    along: str
    values: np.ndarray
    orbit: Orbit
    points: list[Point]
    ends: tuple[str, str]

    @property
    def stable(self) -> np.ndarray:
        """Return whether each orbit is stable, that is, both Floquet multipliers lie inside the unit circle."""
        return np.abs(np.asarray(self.orbit.multipliers)).max(axis=1) < 1


@public_api
def follow_orbits(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    direction: Direction = "both",
    device: Harvester | None = None,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow periodic orbits, stable or not, along one parameter, through folds, and through grazes at soft walls.

    Args:
        orbit: Orbits to start from, one per branch. An orbit that repeats within its period is replaced by one
            repetition.
        along: A constant of the pair, "d", "kappa", "r" or "gamma", or a quantity of the device, which may change
            several of these constants: "omega", "omega0" [rad/s], "s" [m], "A" [m/s^2], "beta" [rad] or "k" [N/m]. For
            one wall, "kappa", "r", "omega0" or "k" with the suffix "_left" or "_right".
        within: Bounds of the parameter, as numbers or quantities of pint; its value at each start must lie between
            them.
        direction: "up" or "down" in the parameter at the start, or "both".
        device: If `along` is a quantity of the device: the device with the other constants, which stay fixed; Tables I
            and II of the paper by default. The value of the quantity at the start follows from these constants and from
            the pair: omega, A and s from d, omega0 and k from kappa, beta from gamma.
        points: Largest number of orbits per branch and direction.
        settings: Settings of steps and events; see `ContinuationSettings`.

    Returns:
        One branch per orbit. At the grazing of a rigid wall a branch ends, because no real orbits exist after it; at a
        soft wall it continues with orbits that have an impact more or fewer. `Branch.ends` lists the other reasons for
        an end.

    Raises:
        ValueError: An unknown parameter or direction, bounds in the wrong order, a start outside of the bounds, or an
            orbit that is not verified.
    """
    validation.validate_choice("direction", direction, _SIGNS)
    points, settings = validation.validate_integer("points", points, 2, MOST_POINTS), check_settings(settings)
    orbit = with_separate_walls(to_least_period(orbit), along)
    paths, y = validated_branch_paths(orbit, along, within, device, settings)
    # The program of the verification compiles in the background from here on.
    begin_compiling_verify_solutions(orbit.pair, orbit.sequence, orbit.impact_unknowns)
    first = place_before_end(start_points(paths, y), FIRST_END_TEST)
    branches = [
        follow_direction(orbit, paths, orient(first, sign), along, points, settings) for sign in _SIGNS[direction]
    ]
    return branches[0] if len(branches) == 1 else [_join_branch(*both) for both in zip(*branches, strict=True)]


def validated_branch_paths(
    orbit: Orbit, along: str, within: tuple[float, float], device: Harvester | None, settings: ContinuationSettings
):
    """Validate orbits, and return the continuation problems of their branches and the unknowns at the starts, as rows.

    Raises:
        ValueError: An orbit that cannot be followed.
    """
    if not len(check_orbit(orbit)):
        raise ValueError(see("attractors", "orbit must hold an orbit to follow; got none; search with more guesses"))
    if (np.asarray(orbit.status) != Status.OK).any():
        index = int(np.argmax(np.asarray(orbit.status) != Status.OK))
        got = Status(int(orbit.status[index]))
        raise ValueError(see("status", f"orbit must hold orbits only; got {got.name} at index {index}; {got.advice}"))
    device = scalar_device(device)
    within = check_along(orbit.pair, along, within)
    x = check_bounds(orbit.pair, along, within, device)
    # An orbit stored as half a period (`mirrored`) has the mirror image as its second half, so the system must stay
    # symmetric along the branch.
    if breaks_mirror_symmetry(along) and bool(orbit.sequence.mirrored.any()):
        raise ValueError(
            f"orbit must be closed in full to be followed along {along}; got one closed half way; unfold it"
        )
    size, (low, high) = len(orbit), within
    vertical_gamma, low_end, high_end = (np.full(size, float(number)) for number in (device.g / device.A, low, high))
    return make_branch_paths(orbit, along, x, vertical_gamma, (low_end, high_end), settings)


def make_branch_paths(
    orbit: Orbit,
    along: str,
    x: np.ndarray,
    vertical_gamma: np.ndarray,
    within: tuple[np.ndarray, np.ndarray],
    settings: ContinuationSettings,
) -> tuple[BranchPath, np.ndarray]:
    """Return the continuation problems of branches and the unknowns at their starts, one row per orbit.

    Args:
        orbit: The orbits.
        along: Name of the parameter.
        x: Value of the parameter at each orbit.
        vertical_gamma: g/A of the device, for each orbit.
        within: Lower bounds and upper bounds of the parameter, one of each per orbit.
        settings: Settings of the steps.
    """
    # NumPy from here on, because the lengths of branches differ and JAX would compile a program for each length.
    low, high = within
    start, gravity, low_end, high_end = tiles.arrays((x, vertical_gamma, low, high))
    paths = BranchPath(
        pair=orbit.pair,
        sequence=orbit.sequence,
        start=start,
        vertical_gamma=gravity,
        low=low_end,
        high=high_end,
        along=along,
        newton_tolerance=settings.newton_tolerance,
        max_corrections=settings.max_corrections,
    )
    paths = jax.tree.map(np.asarray, paths)
    impact_unknowns = np.where(paths.sequence.real[..., None], orbit.impact_unknowns, 0.0).reshape(len(orbit), -1)
    return paths, np.concatenate([impact_unknowns, (x / (high - low))[:, None]], axis=1)


def follow_direction(
    starts: Orbit, paths: BranchPath, first: PathPoints, along: str, points: int, settings: ContinuationSettings
) -> list[Branch]:
    """Follow each branch in one direction from its start.

    At the graze of a soft wall a branch continues with orbits that have an impact more or fewer.
    """

    def build_segments(
        lanes: list[int], paths: BranchPath, records: list[PathRecord], is_first: list[bool]
    ) -> list[PathSegment]:
        lane_paths = [jax.tree.map(lambda leaf, i=row: leaf[i], paths) for row in range(len(records))]
        # The starts are verified already. At a graze, rounding could turn a second verification into a failure.
        first_orbits = [starts[lane : lane + 1] if first else None for lane, first in zip(lanes, is_first, strict=True)]
        return [
            _segment(path, record, settings, start)
            for path, record, start in zip(lane_paths, records, first_orbits, strict=True)
        ]

    return [Branch(along, *item) for item in follow_segments(paths, first, build_segments, points, settings)]


def _segment(path: BranchPath, record: PathRecord, settings: ContinuationSettings, start: Orbit | None) -> PathSegment:
    """Build a path segment from the points of a lane: its orbits, the events between them, and its end.

    The segment begins with `start` if that is given, otherwise with the first step after the graze; see
    `SegmentBuilder`.
    """
    y, tangent, tests, lengths, end = record
    # The parameter in y is divided by its range; `unit` converts it back.
    unit, count, values = float(path.high - path.low), len(y), y[:, -1]
    points: list[Point] = []
    last_orbit: list[Orbit] = []
    switch = None
    # Events come in order; only the last one can end the segment.
    for event in events(path, y, tangent, tests, lengths, settings):
        kind, orbit = (
            classify_event(path, event, y[event.point_index : event.point_index + 2], settings),
            orbits_at(path, event.y[None]),
        )
        ends = event.test in BranchTests._fields[FIRST_END_TEST:]
        if ends and kind not in ("low", "high"):
            switch = _grazing_switch(path, event, y, tests)
            kind, orbit = (kind, orbit) if switch is None else (f"grazing {switch.grazing_part}", switch.orbit)
        if kind not in ("low", "high"):
            points.append(_event_point(path, kind, event.y, orbit, settings))
        if ends:
            end, count, last_orbit = kind, event.point_index + 1, [orbit]
            values = np.append(y[:count, -1], event.y[-1])
            break
    orbits = ([] if start is None else [start]) + ([orbits_at(path, y[1:count])] if count > 1 else []) + last_orbit
    # At a bound the last orbit exists. At a grazing, rounding decides whether the impact map verifies it; if not, the
    # orbit is dropped.
    if orbits and int(np.asarray(orbits[-1].status)[-1]) != Status.OK:
        values, orbits = values[:-1], [*orbits[:-1], orbits[-1][:-1]]
    # The first point of a later segment is a graze, which belongs to the segment before.
    return PathSegment(values[start is None :] * unit, orbits, points, end, switch)


def _grazing_switch(path: BranchPath, event: BranchEvent, y: np.ndarray, tests: np.ndarray) -> GrazingSwitch | None:
    """Return the grazing switch at the end of a segment; None where the branch does not continue."""
    rises = tests[event.point_index, FOLD]
    # The fold test function has the sign of d(parameter)/ds. It is NaN at the first point of a branch that begins by
    # branch switching.
    if not np.abs(rises) > 0:
        rises = event.y[-1] - y[event.point_index, -1]
    return branch_grazing_switch(path, event.y, event.test, float(np.sign(rises)))


def _event_point(path: BranchPath, kind: str, y: np.ndarray, orbit: Orbit, settings: ContinuationSettings) -> Point:
    """Return the record of an event; a pitchfork or flip is located once more on the branch of the simpler orbits.

    A branch of mirror pairs ends on symmetric orbits at a pitchfork, and a branch of doubled orbits ends on orbits of
    half the period at a flip. Two branches cross there, so that the equations are singular and the place is accurate to
    1e-8 only. The simpler orbit is the symmetric orbit (stored as half a period) or the orbit of half the period.
    On its branch a multiplier passes -1 there, and the equations are regular.
    """
    value = float(y[-1] * (path.high - path.low))
    plain = Point(kind, value, orbit)
    if (simpler := _simpler_orbit(path, kind, orbit, settings)) is None:
        return plain
    row = jax.tree.map(np.atleast_1d, path)
    paths, unknowns = make_branch_paths(
        simpler, path.along, np.array([value]), row.vertical_gamma, (row.low, row.high), settings
    )
    # Search the same distance before and after the crossing along the branch of the simpler orbit.
    first, reach = start_points(paths, unknowns), np.array([_LOCATE_REACH])
    before = predict_and_correct(paths, first.y, first.tangent, -reach)
    test = np.array([BranchTests._fields.index("minus")])
    _, located, is_zero = locate(paths, before.y, before.tangent, 2 * reach, test, before.tests[0, test], settings)
    if not is_zero[0]:
        # If no multiplier of the simpler orbit passes -1 nearby, the event remains a pitchfork only if its own orbit is
        # symmetric to within `asymmetry`; otherwise it is a fold.
        exact = kind == "pitchfork" and bool(symmetry.is_symmetric(orbit, settings.asymmetry)[0])
        return plain if exact else plain._replace(kind="fold")
    path = jax.tree.map(lambda leaf: leaf[0], paths)
    full = symmetry.unfold(orbits_at(path, located))
    return Point(kind, float(located[0, -1] * (path.high - path.low)), full)


def _simpler_orbit(path: BranchPath, kind: str, orbit: Orbit, settings: ContinuationSettings) -> Orbit | None:
    """Return the simpler orbit into which a mirror pair or a doubled orbit merges; None for other orbits."""
    if kind == "pitchfork" and not (bool(path.sequence.mirrored) or breaks_mirror_symmetry(path.along)):
        return symmetry.close_half_way(orbit, merging_tolerance(settings))
    if kind == "flip":
        repetitions = repetition.count_repetitions(orbit.sequence, orbit.impact_unknowns, merging_tolerance(settings))
        return periodic.solve_mean_repetition(orbit, repetitions) if repetitions[0] > 1 else None
    return None


def _join_branch(down: Branch, up: Branch) -> Branch:
    """Join the two directions from one start to one branch."""
    return Branch(down.along, *join_directions(PathResult(*down[1:]), PathResult(*up[1:])))
