"""Grazing switch of a curve: continuation of a curve of bifurcations through a graze at a soft wall.

Where orbits on a curve of folds, flips or pitchforks also graze, the curve meets the curve of that graze (codimension
2). The orbits with the additional impact, of speed v, have multipliers that differ by a multiple of v. So the curve of
orbits without this impact reaches the curve of the graze at an angle. The curve of orbits with this impact is tangent
to the curve of the graze, and departs from it as v^2.
"""

import numpy as np

from vijax.continuation.arclength_step import PathPoints, predict_and_correct
from vijax.continuation.branch_events import orbits_at
from vijax.continuation.curves.curve_equations import FIRST_CURVE_END_TEST, CurvePath
from vijax.continuation.grazing_switch import (
    GrazingOrbit,
    GrazingSwitch,
    insert_impacts,
    locate_grazing,
    make_grazing_switch,
    padded_unknowns,
    path_with_walls,
    with_leading_axis,
)

# Length of the first step with the new impact. All unknowns change at once at the graze, so that the tangent is unknown
# before this step. The first point of the next curve is displaced by this length. A shorter step would be lost in
# rounding, which leaves three digits of the square of the new impact's speed.
_FIRST_STEP = 1e-6
# Length of a trial step to find the side of the graze where the orbits with fewer impacts are real.
_TRIAL_STEP = 1e-5


def curve_grazing_switch(path: CurvePath, y: np.ndarray, test: str) -> GrazingSwitch | None:
    """Return the grazing switch at a graze on a curve of folds, flips or pitchforks.

    The result is None at a rigid wall, if no other impact would remain, on curves of grazings and of limits, and if no
    curve of real orbits is found after the graze.

    Args:
        path, y: The path that has reached the graze, and its unknowns there.
        test: Test function of the graze: flight, contact, impact or exit.
    """
    pair, impact_unknowns = path.pair_and_unknowns(y)
    if (
        path.condition != "multiplier"
        or (graze := locate_grazing(pair, path.sequence, np.asarray(impact_unknowns), test)) is None
    ):
        return None
    fewer_path = with_leading_axis(path_with_walls(path, graze.side))
    start = padded_unknowns(graze.impact_unknowns, y[-2:])
    # The orbit with fewer impacts is the same on both sides of the graze.
    orbit = orbits_at(path_with_walls(path, graze.side), start)
    # An impact appears at a graze in flight or in a contact; it fades at "impact" and "exit".
    appears = test in ("flight", "contact")
    next_path, point = _with_impact(path, graze, y) if appears else (fewer_path, _without_impact(fewer_path, start))
    if point is None or not point.converged[0]:
        return None
    return make_grazing_switch(graze, appears, orbit, next_path, point)


def _with_impact(path: CurvePath, graze: GrazingOrbit, y: np.ndarray) -> tuple[CurvePath, PathPoints]:
    """Return the path of orbits with the impacts that begin at a graze, and its first point."""
    pair, _ = path.pair_and_unknowns(y)
    insertion = insert_impacts(pair, graze)
    next_path = with_leading_axis(path_with_walls(path, insertion.side))
    growth = padded_unknowns(insertion.along, np.zeros(2))
    point = predict_and_correct(
        next_path, padded_unknowns(insertion.impact_unknowns, y[-2:]), growth, np.array([_FIRST_STEP])
    )
    # The new tangent must point towards growing speeds of the new impacts.
    return next_path, point._replace(tangent=np.sign((point.tangent * growth).sum()) * point.tangent)


def _without_impact(fewer_path: CurvePath, start: np.ndarray) -> PathPoints | None:
    """Return the first point of the curve of orbits without the impacts that have faded.

    Its tangent points to the side where these orbits are real. The result is None if they are real on neither side.
    """
    # A generic direction, as in `generic_direction`: Newton corrects normal to it.
    direction = np.cos(np.arange(start.size))[None]
    point = predict_and_correct(fewer_path, start, direction / np.linalg.norm(direction), np.zeros(1))
    for sign in (1.0, -1.0):
        trial = predict_and_correct(fewer_path, point.y, sign * point.tangent, np.full(1, _TRIAL_STEP))
        if (trial.tests[0, FIRST_CURVE_END_TEST:] > 0).all():
            tests = point.tests.copy()
            end_tests = tests[:, FIRST_CURVE_END_TEST:]
            # The test function of the graze is zero here, apart from rounding: its sign is unknown.
            end_tests[end_tests <= _TRIAL_STEP**2] = np.nan
            return point._replace(tangent=sign * point.tangent, tests=tests)
    return None
