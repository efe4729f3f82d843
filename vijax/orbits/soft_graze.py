"""Through a graze at a soft wall: the orbit on its other side, with an impact more or fewer.

The force of a soft wall grows from zero, so that the motion is continuous where it touches one. Where a flight touches
a wall an impact of speed v and contact time 2 v/a begins, a the acceleration away from it; where the penetration of a
contact comes back to zero it parts in two, with a flight of length 2 v/f between, f the acceleration into the wall. The
parameter moves by v^2, what is beyond differs by v^3 from the motion without the wall, multipliers by v.

With the new impact at v = 0 the equations of `shooting` hold at the graze and are regular there: of knots and parameter
v alone moves at first. So a branch of orbits with it begins at the graze, in that direction, and goes on.
"""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np

from vijax.model.pair import ImpactPair
from vijax.orbits import flights, grazing
from vijax.orbits.arclength_step import BranchPlace, Path, advance
from vijax.orbits.branch_path import FIRST_END, Arc, Tests, heading
from vijax.orbits.events import orbits_at
from vijax.orbits.orbit_properties import counts
from vijax.orbits.periodic import SAME, Orbit
from vijax.orbits.shooting import Sequence
from vijax.orbits.symmetry import symmetric, unfolded
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

# Of two speeds, or rooms, that differ by less both vanish: at both walls of an orbit that is its own mirror image, but
# not closed half way. They agree to 1e-14 then. A room is as small as the square of a speed.
_SAME_SPEED, _SAME_ROOM = 1e-10, 1e-13
# How far an orbit may move as its impact is left out or put in. It solves the equations already; where it moves a
# bifurcation is so near that it is another orbit.
_STAYS = 1e-9
P = TypeVar("P", bound=Path)
_CLEARANCES = slice(FIRST_END, Tests._fields.index("low"))


class Passage(NamedTuple):
    """A graze at a soft wall, and the path of the orbits beyond.

    Attributes:
        touches: What touches a wall, of the orbit with fewer impacts: "flight" or "contact".
        orbit: That orbit, along a leading axis of one.
        gained: Impacts that the orbits beyond have more; negative where they have fewer.
        wall: -1 or +1; 0 for both.
        path, place: Of the orbits beyond, and where it begins; neither has a leading axis.
    """

    touches: str
    orbit: Orbit
    gained: int
    wall: int
    path: Path
    place: BranchPlace


class Touching(NamedTuple):
    """An orbit that touches walls, without the impacts there.

    Attributes:
        side, knots: Of its impacts.
        splits: Whether contacts touch from inside; else flights do.
        after: Of each touch, the impact in whose contact, or in the flight after which, it is.
        wait: How long after the beginning of that contact or flight; of no meaning where an impact has faded.
        wall: Which wall.
    """

    side: np.ndarray
    knots: np.ndarray
    splits: bool
    after: np.ndarray
    wait: np.ndarray
    wall: np.ndarray


_flights, _contacts = jitted(grazing.flight_turns), jitted(grazing.contact_turns)


def touching(pair: ImpactPair, sequence: Sequence, knots: np.ndarray, test: str) -> Touching | None:
    """Find what touches a soft wall at a graze; None at a rigid one, and where no impact would be left.

    Args:
        pair, sequence, knots: Of the orbit that has come to it, alone.
        test: Which clearance is zero: of `flight` or `contact` where impacts begin, of `speed` (impact) or `exit` where
            they end.
    """
    if pair.rigid:
        return None
    if test not in ("flight", "contact"):
        return _without_impact(pair, sequence, knots)
    splits, count = test == "contact", int(sequence.real.sum())
    turns = jax.tree.map(np.asarray, (_contacts if splits else _flights)(pair, sequence, tiles.arrays(knots)))
    after = np.flatnonzero(turns.room <= turns.room.min() + _SAME_ROOM)
    if np.any(pair.hard(turns.wall[after])):
        return None
    side = np.asarray(sequence.side)[:count]
    return Touching(side, knots[:count], splits, after, turns.when[after], turns.wall[after])


def _without_impact(pair: ImpactPair, sequence: Sequence, knots: np.ndarray) -> Touching | None:
    """Leave out the impacts whose speed has come to zero; None where these are all, or are at a rigid wall.

    Where the acceleration is away from the wall the contact, too, has no length. Else it is the flight before it that
    has none, and the contact before goes on through it.
    """
    count = int(sequence.real.sum())
    knots, side = knots[:count].copy(), np.asarray(sequence.side)[:count]
    speed = np.abs(knots[:, 1])
    fading = np.flatnonzero(speed <= speed.min() + _SAME_SPEED)
    if fading.size == count or np.any(pair.hard(side[fading])):
        return None
    push = np.asarray(flights.acceleration(pair, knots[fading, 0]))
    splits = bool((side[fading] * push > 0).all())
    for index in fading[::-1] if splits else ():
        end = knots[index, 0] + knots[index, 2] + (0.0 if index else float(sequence.span))
        knots[index - 1, 2] = end - knots[index - 1, 0]
    kept = np.delete(np.arange(count), fading)
    return Touching(side[kept], knots[kept], splits, fading - 1, np.zeros(fading.size), side[fading])


class Insertion(NamedTuple):
    """An orbit with impacts of speed 0 where it touches walls, and how its knots move as their speed grows."""

    side: np.ndarray
    knots: np.ndarray
    along: np.ndarray


def with_impact(pair: ImpactPair, found: Touching) -> Insertion:
    """Put an impact of speed 0 wherever an orbit touches."""
    knots, side = found.knots.copy(), found.side
    along = np.zeros_like(knots)
    # Backwards, so that the places of those before stay what they are.
    for after, wait, wall in zip(found.after[::-1], found.wait[::-1], found.wall[::-1], strict=True):
        onset = knots[after, 0] + wait + (0.0 if found.splits else knots[after, 2])
        push = abs(float(flights.acceleration(pair, onset)))
        if found.splits:
            new, way = (onset, 0.0, knots[after, 2] - wait), (1 / push, 1.0, -1 / push)
            knots[after, 2], along[after, 2] = wait, -np.sqrt(push) / push
        else:
            new, way = (onset, 0.0, 0.0), (-1 / push, 1.0, 2 / push)
        # Where several begin at once each is as deep as the others: its speed goes as the root of what pushes it back.
        knots = np.insert(knots, after + 1, new, axis=0)
        along = np.insert(along, after + 1, np.sqrt(push) * np.array(way), axis=0)
        side = np.insert(side, after + 1, int(wall))
    return Insertion(side, knots, along / np.linalg.norm(along))


def among(path: P, side: np.ndarray) -> P:
    """Give the path of orbits that meet other walls, padded so that few programs are compiled; see `unknowns`."""
    wide = np.pad(side.astype(np.int32), (0, tiles.padded(len(side)) - len(side)))
    return eqx.tree_at(lambda path: path.sequence.side, path, wide)


def unknowns(knots: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Give the unknowns of such a path: knots and what follows them, along a leading axis of one."""
    more = tiles.padded(len(knots)) - len(knots)
    return np.append(np.pad(knots, ((0, more), (0, 0))).ravel(), others)[None]


def beyond(found: Touching, appears: bool, orbit: Orbit, path: Path, place: BranchPlace) -> Passage | None:
    """Make the record of a graze; None where impacts begin or end in some only of the equal parts of an orbit.

    No orbit comes to a graze of such a one, at which all parts touch, but where they bifurcate: both are too near then
    for rounding to tell them apart.

    Args:
        found: What touches.
        appears: Whether impacts begin there; else they have ended.
        orbit: The one with fewer.
        path, place: Of the orbits beyond, along a leading axis of one.
    """
    walls, number = {int(wall) for wall in found.wall}, len(found.wall)
    label = counts(orbit)
    parts = int(unfolded(orbit).count[0]) // int(label.left[0] + label.right[0])
    mirrored = bool(orbit.sequence.mirrored[0])
    halves = 2 if not mirrored and bool(symmetric(orbit, SAME)[0]) else 1
    if number % halves or (number * (1 + mirrored)) % parts:
        return None
    one = walls.pop() if len(walls) == 1 and not mirrored else 0
    path, place = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (path, place))
    return Passage("contact" if found.splits else "flight", orbit, number if appears else -number, one, path, place)


def alone(path: P) -> P:
    """Give a path a leading axis of one."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], path)


def branch_passage(arc: Arc, y: np.ndarray, test: str, sign: float) -> Passage | None:
    """Find what is beyond a graze of a branch.

    None at a rigid wall, where no impact would be left, and where rounding does not tell it from what bifurcates there.

    Args:
        arc, y: The path that has come to the graze, and its unknowns there.
        test: The test function that vanishes.
        sign: Whether the parameter rises along the path, which it goes on to do.
    """
    pair, knots = arc.pair_and_knots(y)
    if (found := touching(pair, arc.sequence, np.asarray(knots), test)) is None:
        return None
    # The orbit with fewer impacts is regular at the graze, and has the multipliers of both. It is to have the parameter
    # of the graze: at a fold there, where none has, the sign of the parameter says nothing of the way on.
    fewer, start = alone(among(arc, found.side)), unknowns(found.knots, y[-1:])
    ahead = np.zeros_like(start)
    ahead[:, -1] = 1.0
    place = advance(fewer, start, ahead, np.zeros(1))
    if not np.abs(place.y - start).max() < _STAYS:
        return None
    place = heading(place, sign)
    # Past the graze they are positive; here one of them is zero, or not defined.
    place.tests[:, _CLEARANCES] = np.nan
    orbit = orbits_at(jax.tree.map(lambda leaf: leaf[0], fewer), start)
    appears = test in ("flight", "contact")
    if not appears:
        return beyond(found, appears, orbit, fewer, place)
    begun = with_impact(pair, found)
    start, tangent = unknowns(begun.knots, y[-1:]), unknowns(begun.along, np.zeros(1))
    place = place._replace(y=start, tangent=tangent)
    return beyond(found, appears, orbit, alone(among(arc, begun.side)), place)
