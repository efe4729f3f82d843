"""Grazing switch at a soft wall: from an orbit that grazes onto the orbit with one impact more or fewer.

The force of a soft wall grows from zero, so that the motion is continuous at a grazing. If a flight touches a wall, an
impact of speed v and contact duration 2 v/a begins, with a the acceleration away from the wall. If the penetration of a
contact returns to zero, the contact splits in two, with a flight of duration 2 v/f in between, with f the acceleration
into the wall. The parameter changes by O(v^2), the orbit with the impact differs by O(v^3) from the motion without the
wall, and the multipliers by O(v).

With the new impact at v = 0 the equations of `shooting` hold at the grazing and are regular there: to first order only
the unknowns of the new impact and of its neighbour change, in proportion to v. So the branch of orbits with the impact
starts at the grazing, in that direction.
"""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np

from vijax.continuation.arclength_step import Path, PathPoints, predict_and_correct
from vijax.continuation.branch_equations import FIRST_END_TEST, BranchPath, BranchTests, orient
from vijax.continuation.branch_events import orbits_at
from vijax.model.pair import ImpactPair
from vijax.orbits import clearances, flights
from vijax.orbits.orbit_properties import counts
from vijax.orbits.periodic import VERIFICATION_TOLERANCE, Orbit
from vijax.orbits.shooting import Sequence
from vijax.orbits.symmetry import is_symmetric, unfold
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted

# Two speeds, or two clearances, that differ by less vanish together. At the two walls of a symmetric orbit that is
# stored in full they agree to 1e-14. A clearance is of the order of the square of a speed.
_SAME_SPEED, _SAME_CLEARANCE = 1e-10, 1e-13
# Largest change of an orbit when its impact is removed or inserted. The orbit solves the equations already; if it moves
# further, a bifurcation is so near that Newton's method has converged to another orbit.
_LARGEST_CHANGE = 1e-9
P = TypeVar("P", bound=Path)
_CLEARANCES = slice(FIRST_END_TEST, BranchTests._fields.index("low"))


class GrazingSwitch(NamedTuple):
    """A grazing at a soft wall, and the path of the orbits after the switch.

    Attributes:
        grazing_part: The part of the orbit with fewer impacts that touches a wall: "flight" or "contact".
        orbit: That orbit, along a leading axis of one.
        impact_change: Number of additional impacts after the switch; negative if there are fewer.
        wall: Wall of these impacts: -1 (left), +1 (right) or 0 (both).
        path, first: The path of the orbits after the switch, and its first point; neither has a leading axis.
    """

    grazing_part: str
    orbit: Orbit
    impact_change: int
    wall: int
    path: Path
    first: PathPoints


class GrazingOrbit(NamedTuple):
    """An orbit that grazes walls, without impacts of speed zero at the grazings.

    Attributes:
        side, impact_unknowns: Walls and unknowns of its impacts.
        splits: True if the penetration of contacts returns to zero, so that they are about to split in two; False if
            flights touch a wall.
        after: For each grazing, the index of the impact with that contact, or before that flight.
        delay: Time from the beginning of that contact or flight to the grazing; not used if an impact was removed.
        wall: The wall of each grazing.
    """

    side: np.ndarray
    impact_unknowns: np.ndarray
    splits: bool
    after: np.ndarray
    delay: np.ndarray
    wall: np.ndarray


_flights, _contacts = jitted(clearances.flight_turning_points), jitted(clearances.contact_minima)


def locate_grazing(pair: ImpactPair, sequence: Sequence, impact_unknowns: np.ndarray, test: str) -> GrazingOrbit | None:
    """Locate the grazings at soft walls; None at a rigid wall, or if no other impact would remain.

    Args:
        pair, sequence, impact_unknowns: The orbit at the grazing, without a leading axis.
        test: The clearance that is zero: `flight` or `contact` if impacts begin, `speed` (of an impact) or `exit` if
            they end.
    """
    if pair.rigid:
        return None
    if test not in ("flight", "contact"):
        return _without_impact(pair, sequence, impact_unknowns)
    splits, count = test == "contact", int(sequence.real.sum())
    turns = jax.tree.map(np.asarray, (_contacts if splits else _flights)(pair, sequence, tiles.arrays(impact_unknowns)))
    after = np.flatnonzero(turns.clearance <= turns.clearance.min() + _SAME_CLEARANCE)
    if np.any(pair.is_rigid_at(turns.wall[after])):
        return None
    side = np.asarray(sequence.side)[:count]
    return GrazingOrbit(side, impact_unknowns[:count], splits, after, turns.time[after], turns.wall[after])


def _without_impact(pair: ImpactPair, sequence: Sequence, impact_unknowns: np.ndarray) -> GrazingOrbit | None:
    """Remove the impacts with vanishing speed; None if these are all impacts, or are at a rigid wall.

    If the acceleration at such an impact points away from the wall, its contact has duration zero. Otherwise the flight
    before the impact has duration zero, and the contact before is extended to the end of this impact's contact.
    """
    count = int(sequence.real.sum())
    impact_unknowns, side = impact_unknowns[:count].copy(), np.asarray(sequence.side)[:count]
    speed = np.abs(impact_unknowns[:, 1])
    vanishing = np.flatnonzero(speed <= speed.min() + _SAME_SPEED)
    if vanishing.size == count or np.any(pair.is_rigid_at(side[vanishing])):
        return None
    push = np.asarray(flights.acceleration(pair, impact_unknowns[vanishing, 0]))
    splits = bool((side[vanishing] * push > 0).all())
    for index in vanishing[::-1] if splits else ():
        # Extend the contact before it to the end of this one; index -1 is the last impact, one span earlier.
        end = impact_unknowns[index, 0] + impact_unknowns[index, 2] + (0.0 if index else float(sequence.span))
        impact_unknowns[index - 1, 2] = end - impact_unknowns[index - 1, 0]
    remaining = np.delete(np.arange(count), vanishing)
    return GrazingOrbit(
        side[remaining], impact_unknowns[remaining], splits, vanishing - 1, np.zeros(vanishing.size), side[vanishing]
    )


class Insertion(NamedTuple):
    """An orbit with impacts of speed 0 where it touches walls.

    Attributes:
        side, impact_unknowns: Walls and unknowns of its impacts.
        along: Unit direction of the impact unknowns as the speeds grow.
    """

    side: np.ndarray
    impact_unknowns: np.ndarray
    along: np.ndarray


def insert_impacts(pair: ImpactPair, grazing_orbit: GrazingOrbit) -> Insertion:
    """Insert an impact of speed 0 at every grazing of an orbit."""
    impact_unknowns, side = grazing_orbit.impact_unknowns.copy(), grazing_orbit.side
    along = np.zeros_like(impact_unknowns)
    # From the last to the first, so that insertions do not change the indices of earlier impacts.
    for after, delay, wall in zip(
        grazing_orbit.after[::-1], grazing_orbit.delay[::-1], grazing_orbit.wall[::-1], strict=True
    ):
        onset = impact_unknowns[after, 0] + delay + (0.0 if grazing_orbit.splits else impact_unknowns[after, 2])
        push = abs(float(flights.acceleration(pair, onset)))
        if grazing_orbit.splits:
            # Changes in proportion to the speed v of the new impact: its onset is v/push later and its contact v/push
            # shorter; the contact before it ends v/push earlier.
            inserted, direction = (onset, 0.0, impact_unknowns[after, 2] - delay), (1 / push, 1.0, -1 / push)
            impact_unknowns[after, 2], along[after, 2] = delay, -np.sqrt(push) / push
        else:
            # The new impact begins v/push before the turning point and has contact duration 2 v/push.
            inserted, direction = (onset, 0.0, 0.0), (-1 / push, 1.0, 2 / push)
        # If several impacts begin at once, they are equally deep: v^2/(2 push) is the same, so that each speed is in
        # proportion to the root of its push.
        impact_unknowns = np.insert(impact_unknowns, after + 1, inserted, axis=0)
        along = np.insert(along, after + 1, np.sqrt(push) * np.array(direction), axis=0)
        side = np.insert(side, after + 1, int(wall))
    return Insertion(side, impact_unknowns, along / np.linalg.norm(along))


def path_with_walls(path: P, side: np.ndarray) -> P:
    """Return the path for another sequence of walls, padded to one of few lengths so that few programs are compiled."""
    wide = np.pad(side.astype(np.int32), (0, tiles.padded(len(side)) - len(side)))
    return eqx.tree_at(lambda path: path.sequence.side, path, wide)


def padded_unknowns(impact_unknowns: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the unknowns of a path of `path_with_walls`: padded impact unknowns, then `others`, as one row."""
    more = tiles.padded(len(impact_unknowns)) - len(impact_unknowns)
    return np.append(np.pad(impact_unknowns, ((0, more), (0, 0))).ravel(), others)[None]


def make_grazing_switch(
    grazing_orbit: GrazingOrbit, appears: bool, orbit: Orbit, path: Path, first: PathPoints
) -> GrazingSwitch | None:
    """Make the record of a grazing switch; None if only some of the equal repetitions of an orbit graze.

    An orbit with equal repetitions grazes in all of them. If only some of them graze, a bifurcation is so near that
    rounding does not distinguish this orbit from the bifurcating orbit.

    Args:
        grazing_orbit: The orbit that grazes, without the impacts there.
        appears: True if impacts begin there, False if they end.
        orbit: The orbit with fewer impacts.
        path, first: The path of the orbits after the switch, along a leading axis of one.
    """
    walls, number = {int(wall) for wall in grazing_orbit.wall}, len(grazing_orbit.wall)
    label = counts(orbit)
    repetitions = int(unfold(orbit).count[0]) // int(label.left[0] + label.right[0])
    mirrored = bool(orbit.sequence.mirrored[0])
    halves = 2 if not mirrored and bool(is_symmetric(orbit, VERIFICATION_TOLERANCE)[0]) else 1
    if number % halves or (number * (1 + mirrored)) % repetitions:
        return None
    single_wall = walls.pop() if len(walls) == 1 and not mirrored else 0
    path, first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (path, first))
    return GrazingSwitch(
        "contact" if grazing_orbit.splits else "flight", orbit, number if appears else -number, single_wall, path, first
    )


def with_leading_axis(path: P) -> P:
    """Add a leading axis of one to a path."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], path)


def branch_grazing_switch(path: BranchPath, y: np.ndarray, test: str, sign: float) -> GrazingSwitch | None:
    """Compute the grazing switch at a grazing of a branch.

    The result is None at a rigid wall, if no other impact would remain, and if rounding does not distinguish the new
    orbit from a bifurcating orbit.

    Args:
        path, y: The path at the grazing, and its unknowns there.
        test: The test function that vanishes.
        sign: +1 if the parameter rises along the path, -1 if it falls; the direction is kept after the grazing.
    """
    pair, impact_unknowns = path.pair_and_unknowns(y)
    if (grazing_orbit := locate_grazing(pair, path.sequence, np.asarray(impact_unknowns), test)) is None:
        return None
    # The equations of the orbit with fewer impacts are regular at the grazing, where both orbits have the same
    # multipliers. The orbit with fewer impacts is corrected at the fixed parameter of the grazing. This fails if the
    # grazing is a fold as well, where the sign of the parameter would not determine the direction.
    fewer, start = (
        with_leading_axis(path_with_walls(path, grazing_orbit.side)),
        padded_unknowns(grazing_orbit.impact_unknowns, y[-1:]),
    )
    tangent_guess = np.zeros_like(start)
    tangent_guess[:, -1] = 1.0
    first = predict_and_correct(fewer, start, tangent_guess, np.zeros(1))
    if not np.abs(first.y - start).max() < _LARGEST_CHANGE:
        return None
    first = orient(first, sign)
    # After the grazing the clearances are positive. At the grazing one of them is zero or undefined, so that all become
    # NaN (unknown).
    first.tests[:, _CLEARANCES] = np.nan
    orbit = orbits_at(jax.tree.map(lambda leaf: leaf[0], fewer), start)
    appears = test in ("flight", "contact")
    if not appears:
        return make_grazing_switch(grazing_orbit, appears, orbit, fewer, first)
    insertion = insert_impacts(pair, grazing_orbit)
    start, tangent = padded_unknowns(insertion.impact_unknowns, y[-1:]), padded_unknowns(insertion.along, np.zeros(1))
    first = first._replace(y=start, tangent=tangent)
    return make_grazing_switch(
        grazing_orbit, appears, orbit, with_leading_axis(path_with_walls(path, insertion.side)), first
    )
