"""Through a graze of codimension 2 at a soft wall: the curve of the same bifurcation of the orbits beyond.

A fold, flip or pitchfork of orbits that graze besides is where its curve meets the curve of that graze. Beyond, orbits
have an impact more, of speed v, and the multiplier differs by a multiple of v. So the curve comes to the graze at an
angle, and beyond it leaves along the curve of the graze, from which it departs as v^2.
"""

import numpy as np

from vijax.orbits.arclength_step import BranchPlace, advance
from vijax.orbits.curve_equations import FIRST_CURVE_END, CurvePath
from vijax.orbits.events import orbits_at
from vijax.orbits.soft_graze import Passage, Touching, alone, among, beyond, touching, unknowns, with_impact

# Length of the first step beyond. The place of the bifurcation moves by as much, and there all unknowns move at once:
# the tangent is not known before. Rounding leaves three digits of the square of the new impact's speed.
_BEGUN = 1e-6
# How far orbits with fewer impacts are looked at to see on which side they are real.
_LOOK = 1e-5


def curve_passage(path: CurvePath, y: np.ndarray, test: str) -> Passage | None:
    """Find what is beyond a graze that a curve of folds, flips or pitchforks has come to.

    None at a rigid wall, where no impact would be left, on curves of grazes and limits, and where no curve sets out.

    Args:
        path, y: The path that has come to the graze, and its unknowns there.
        test: What grazes: flight, contact, impact or exit.
    """
    pair, knots = path.pair_and_knots(y)
    if path.condition != "multiplier" or (found := touching(pair, path.sequence, np.asarray(knots), test)) is None:
        return None
    fewer = alone(among(path, found.side))
    start = unknowns(found.knots, y[-2:])
    orbit = orbits_at(among(path, found.side), start)
    appears = test in ("flight", "contact")
    on, place = _with_impact(path, found, y) if appears else (fewer, _without(fewer, start))
    if place is None or not place.arrived[0]:
        return None
    return beyond(found, appears, orbit, on, place)


def _with_impact(path: CurvePath, found: Touching, y: np.ndarray) -> tuple[CurvePath, BranchPlace]:
    """Set out with the impacts that begin at a graze."""
    pair, _ = path.pair_and_knots(y)
    begun = with_impact(pair, found)
    on = alone(among(path, begun.side))
    along = unknowns(begun.along, np.zeros(2))
    place = advance(on, unknowns(begun.knots, y[-2:]), along, np.array([_BEGUN]))
    return on, place._replace(tangent=np.sign((place.tangent * along).sum()) * place.tangent)


def _without(fewer: CurvePath, start: np.ndarray) -> BranchPlace | None:
    """Set out without the impacts that have ended, to the side on which orbits without them are real."""
    across = np.cos(np.arange(start.size))[None]
    place = advance(fewer, start, across / np.linalg.norm(across), np.zeros(1))
    for sign in (1.0, -1.0):
        there = advance(fewer, place.y, sign * place.tangent, np.full(1, _LOOK))
        if (there.tests[0, FIRST_CURVE_END:] > 0).all():
            tests = place.tests.copy()
            clear = tests[:, FIRST_CURVE_END:]
            # That of the graze is zero here, but for rounding.
            clear[clear <= _LOOK**2] = np.nan
            return place._replace(tangent=sign * place.tangent, tests=tests)
    return None
