"""Points where the cubic coefficient of a flip or a pitchfork changes sign: their names and places.

`benchmarks/criticality.py` computes the sign from the normal form in 50 digits and shares no code with the curves.
"""

import jax
import numpy as np
import pytest

import vijax
from benchmarks import criticality
from tests.helpers import cases
from vijax.continuation.continuation_settings import DEFAULT
from vijax.continuation.curves import curve_events
from vijax.orbits import symmetry

# Kind of the curve -> kappa and gamma of an orbit near it, the plane, the name and the place of the point.
CASES = {
    "pitchfork": (30.0, 0.0, {"d": (0.06, 0.085), "kappa": (17.0, 40.0)}, "degenerate pitchfork", (0.068223, 20.0905)),
    "flip": (8.0, 0.1, {"d": (0.205, 0.23), "kappa": (5.3, 9.0)}, "generalised flip", (0.215180, 5.54506)),
}


@pytest.fixture(scope="module", params=cases(CASES, long=("flip",)))
def degenerate_point(request):
    """Follow a curve through its degenerate point; return the name and place of the point, and the curve."""
    kappa, gamma, plane, name, place = CASES[request.param]
    orbits = vijax.find_orbits(vijax.impact_pair(0.15, kappa, 0.3, gamma), "RL", guesses=256)
    branches = vijax.follow_families(orbits, "d", (0.03, 0.5), max_switches=int(request.param == "flip"))
    low, high = plane["d"]
    points = [
        point
        for branch in branches
        for point in branch.points
        if point.kind == request.param and low < point.value < high
    ]
    curves = vijax.follow_curves(points, "d", plane, max_switches=0)
    (curve,) = (curve for curve in curves if any(point.kind == name for point in curve.points))
    return name, place, curve


def normal_form(kind, orbit, row=0):
    """Compute the coefficient of the normal form of one orbit of a curve in 50 digits."""
    pair, side, span, mirrored, impact_unknowns = jax.tree.map(
        lambda leaf: np.asarray(leaf)[row],
        (orbit.pair, orbit.sequence.side, orbit.sequence.span, orbit.sequence.mirrored, orbit.impact_unknowns),
    )
    turns = (side != 0).sum()
    numbers = (float(getattr(pair, name)) for name in ("d", "kappa", "r", "gamma"))
    case = criticality.Case(
        kind, "d", *numbers, side[:turns].tolist(), float(span), bool(mirrored), impact_unknowns[:turns].tolist()
    )
    return criticality.normal_form(case)


def test_the_point_has_its_name_and_the_normal_form_changes_sign_there(degenerate_point):
    name, place, curve = degenerate_point
    (point,) = (point for point in curve.points if point.kind == name)
    assert point.values == pytest.approx(place, rel=1e-5)
    nearest = np.argsort(np.hypot(*(np.asarray(curve.values) / point.values - 1).T))[:6]
    before, after = nearest.min(), nearest.max()
    sides = [normal_form(curve.kind, curve.orbit, row) for row in (before, after)]
    assert np.prod(np.sign(sides)) == -1
    assert abs(normal_form(curve.kind, point.orbit)) < 1e-6 * max(map(abs, sides))


def test_folds_of_the_bifurcating_orbits_end_at_a_point_of_the_same_name(degenerate_point):
    name, _, curve = degenerate_point
    (point,) = (point for point in curve.points if point.kind == name)
    assert curve_events._turning_kind(symmetry.double(point.orbit), DEFAULT) == (name, True)
