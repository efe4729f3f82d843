"""Through a graze at a soft wall: the orbit on its other side, with an impact more or fewer.

The force of a soft wall grows from zero, so that the motion is continuous where it touches one. Where a flight touches
a wall an impact of speed v and contact time 2 v/a begins, a the acceleration away from it; where the penetration of a
contact comes back to zero it parts in two, with a flight of length 2 v/f between, f the acceleration into the wall. The
parameter moves by v^2, what is beyond differs by v^3 from the motion without the wall, multipliers by v.

With the new impact at v = 0 the equations of `shooting` hold at the graze and are regular there: of knots and parameter
v alone moves at first. So a branch of orbits with it begins at the graze, in that direction, and goes on.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from vijax.model import flow
from vijax.orbits import grazing
from vijax.orbits.arclength_step import FIRST_END, Arc, BranchPlace, Tests, advance
from vijax.orbits.events import orbits_at
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import Sequence
from vijax.runtime.programs import jitted

# Of two rooms, or speeds, that differ by less both vanish: at both walls of an orbit that is its own mirror image, but
# not closed half way. They agree to 1e-13 then; two grazes that merely are close differ by far more.
_ALIKE = 1e-10
_CLEARANCES = slice(FIRST_END, Tests._fields.index("low"))


class Passage(NamedTuple):
    """A graze at a soft wall, and the path of the orbits beyond.

    Attributes:
        kind: What touches, of the orbit with fewer impacts: "grazing flight" or "grazing contact".
        orbit: That orbit, along a leading axis of one.
        gained: Impacts that the orbits beyond have more; negative where they have fewer.
        wall: -1 or +1; 0 for both.
        arc, place: The path beyond, and where it begins.
    """

    kind: str
    orbit: Orbit
    gained: int
    wall: int
    arc: Arc
    place: BranchPlace


def passage(arc: Arc, y: np.ndarray, test: str, sign: float) -> Passage | None:
    """Find what is beyond a graze; None at a rigid wall, and where no impact would be left.

    Args:
        arc, y: The path that has come to the graze, and its unknowns there.
        test: The test function that vanishes.
        sign: Whether the parameter rises along the path, which it goes on to do.
    """
    if arc.pair.rigid:
        return None
    appears = test in ("flight", "contact")
    found = _Touching(arc, y, *_touched(arc, y, test)) if appears else _without_impact(arc, y)
    if found is None:
        return None
    # The orbit with fewer impacts is regular at the graze, and has the multipliers of both.
    ahead = np.zeros((1, found.y.size))
    ahead[0, -1] = 1.0
    place = advance(_alone(found.arc), found.y[None], ahead, np.zeros(1))
    tests = place.tests.copy()
    tests[:, Tests._fields.index("fold")] *= sign
    # Past the graze they are positive; here one of them is zero, or not defined.
    tests[:, _CLEARANCES] = np.nan
    place = place._replace(tangent=sign * place.tangent, tests=tests)
    beyond = found.arc
    if appears:
        beyond, start, tangent = _with_impact(found)
        place = place._replace(y=start[None], tangent=tangent[None])
    walls = {int(wall) for wall in found.wall}
    return Passage(
        f"grazing {'contact' if found.splits else 'flight'}",
        orbits_at(found.arc, found.y[None]),
        len(found.wall) if appears else -len(found.wall),
        walls.pop() if len(walls) == 1 and not arc.sequence.mirrored else 0,
        beyond,
        place,
    )


class _Touching(NamedTuple):
    """An orbit that touches a wall, without the impact there: after which onsets or ends of contact, how long after."""

    arc: Arc
    y: np.ndarray
    splits: bool
    index: np.ndarray
    wait: np.ndarray
    wall: np.ndarray


_flights, _contacts = jitted(grazing.flight_turns), jitted(grazing.contact_turns)


def _touched(arc: Arc, y: np.ndarray, test: str):
    """Find where an orbit touches: in which flights or contacts, how long after their beginning, and which walls."""
    pair, knots = arc.pair_and_knots(y)
    splits = test == "contact"
    turns = jax.tree.map(np.asarray, (_contacts if splits else _flights)(pair, arc.sequence, knots))
    index = np.flatnonzero(turns.room <= turns.room.min() + _ALIKE)
    return splits, index, turns.when[index], turns.wall[index]


def _with_impact(found: _Touching) -> tuple[Arc, np.ndarray, np.ndarray]:
    """Put an impact of speed 0 where an orbit touches; give the path, its unknowns and its tangent there."""
    pair, knots = found.arc.pair_and_knots(found.y)
    side, count = found.arc.sequence.side, int(found.arc.sequence.real.sum())
    knots, side = knots[:count], side[:count]
    along = np.zeros_like(knots)
    # Backwards, so that the places of those before stay what they are.
    for index, wait, wall in zip(found.index[::-1], found.wait[::-1], found.wall[::-1], strict=True):
        onset = knots[index, 0] + wait + (0.0 if found.splits else knots[index, 2])
        push = abs(float(flow.acceleration(pair.gamma, onset)))
        if found.splits:
            new, way = (onset, 0.0, knots[index, 2] - wait), (1 / push, 1.0, -1 / push)
            knots[index, 2], along[index, 2] = wait, along[index, 2] - 1 / push
        else:
            new, way = (onset, 0.0, 0.0), (-1 / push, 1.0, 2 / push)
        # Where several begin at once each is as deep as the others: its speed goes as the root of what pushes it back.
        knots = np.insert(knots, index + 1, new, axis=0)
        along = np.insert(along, index + 1, np.sqrt(push) * np.array(way), axis=0)
        side = np.insert(side, index + 1, int(wall))
    tangent = np.append(along.ravel(), 0.0)
    return _among(found.arc, side), np.append(knots.ravel(), found.y[-1]), tangent / np.linalg.norm(tangent)


def _without_impact(arc: Arc, y: np.ndarray) -> _Touching | None:
    """Leave out the impacts whose speed has come to zero; None where these are all.

    Where the acceleration is away from the wall the contact, too, has no length. Else it is the flight before it that
    has none, and the contact before goes on through it.
    """
    pair, knots = arc.pair_and_knots(y)
    sequence, count = arc.sequence, int(arc.sequence.real.sum())
    knots, side = knots[:count].copy(), sequence.side[:count]
    speed = np.abs(knots[:, 1])
    fading = np.flatnonzero(speed <= speed.min() + _ALIKE)
    if fading.size == count:
        return None
    push = np.asarray(flow.acceleration(pair.gamma, knots[fading, 0]))
    splits = bool((side[fading] * push > 0).all())
    for index in fading[::-1] if splits else ():
        end = knots[index, 0] + knots[index, 2] + (0.0 if index else float(sequence.span))
        knots[index - 1, 2] = end - knots[index - 1, 0]
    kept = np.delete(np.arange(count), fading)
    start = np.append(knots[kept].ravel(), y[-1])
    return _Touching(_among(arc, side[kept]), start, splits, fading, np.zeros(fading.size), side[fading])


def _among(arc: Arc, side: np.ndarray) -> Arc:
    """Give the path of orbits that meet other walls."""
    sequence = Sequence(side.astype(np.int32), arc.sequence.span, arc.sequence.mirrored)
    return eqx.tree_at(lambda arc: arc.sequence, arc, sequence)


def _alone(arc: Arc) -> Arc:
    """Give a path along a leading axis of one."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], arc)
