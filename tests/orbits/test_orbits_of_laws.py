"""Orbits, steady states and branches with membranes of any law, against the linear membrane and simulations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from tests.helpers import Cubic, Plain, refusals
from vijax.maps.sweep import plan
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.records import Status
from vijax.orbits import contacts, periodic, shooting

PAIR = vijax.impact_pair(0.2, 40.0, 0.5, 0.05)
PAIR_WITHOUT_R = vijax.impact_pair(0.2, 40.0, None, 0.05)
DEVICE = vijax.Harvester()
HERTZ = vijax.HuntCrossley(0.3)


@pytest.fixture(scope="module")
def linear_orbits():
    """Return the 1:1 orbit of the linear membrane by closed forms, and by time steps."""
    return [vijax.find_orbits(PAIR, "LR", guesses=64, membrane=law) for law in (None, Plain())]


@pytest.fixture(scope="module")
def hertz():
    """Return the 1:1 orbit of a membrane of Hunt and Crossley."""
    return vijax.find_orbits(PAIR_WITHOUT_R, "LR", guesses=64, membrane=HERTZ)


@pytest.fixture(scope="module")
def cubic():
    """Return the 1:1 orbit of a membrane with a cubic spring."""
    return vijax.find_orbits(PAIR, "LR", guesses=64, membrane=Cubic(500.0))


def test_user_defined_linear_law_has_the_orbits_of_the_linear_membrane(linear_orbits):
    closed, stepped = linear_orbits
    assert len(closed) == len(stepped) == 1
    for name in ("impact_unknowns", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(stepped, name), getattr(closed, name), rtol=0, atol=1e-11, err_msg=name)
    assert stepped.residual[0] < 1e-11
    assert vijax.orbit_labels(stepped) == vijax.orbit_labels(closed)
    np.testing.assert_allclose(vijax.orbit_power(stepped, DEVICE), vijax.orbit_power(closed, DEVICE), rtol=1e-11)
    for leaf, other_leaf in zip(vijax.orbit_path(stepped), vijax.orbit_path(closed), strict=True):
        np.testing.assert_allclose(leaf, other_leaf, rtol=0, atol=1e-11)
    for leaf, other_leaf in zip(*(jax.tree.leaves(vijax.orbit_impacts(orbit)) for orbit in linear_orbits), strict=True):
        np.testing.assert_allclose(leaf, other_leaf, rtol=0, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("transform", [jax.jacfwd, jax.grad])
def test_user_defined_linear_law_has_the_derivatives_of_the_linear_membrane(linear_orbits, transform):
    slopes = [
        transform(lambda pair, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=pair).P)(PAIR)
        for orbit in linear_orbits
    ]
    for name in ("d", "kappa", "r", "gamma"):
        assert float(getattr(slopes[1], name)) == pytest.approx(float(getattr(slopes[0], name)), rel=1e-10)


@pytest.mark.long
def test_user_defined_linear_law_has_the_same_second_derivatives(linear_orbits):
    second_derivatives = [
        jax.jacfwd(jax.jacfwd(lambda k, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=replace(PAIR, kappa=k)).P))(
            PAIR.kappa
        )
        for orbit in linear_orbits
    ]
    assert float(second_derivatives[1]) == pytest.approx(float(second_derivatives[0]), rel=1e-9)


@pytest.mark.long
def test_orbit_of_a_hertz_law_is_the_attractor_of_the_ode_method(hertz):
    assert len(hertz) == 1
    assert np.abs(hertz.multipliers).max() < 1
    fine = {"method": "ode", "solver": "Dopri8", "rtol": 1e-11, "atol": 1e-13}
    run = vijax.trajectory(PAIR_WITHOUT_R, 0.0, 0.1, 100, membrane=HERTZ, **fine)
    last = slice(int(run.filled) - 2, int(run.filled))
    impacts = vijax.orbit_impacts(hertz)
    for name in ("t", "v_in", "v_out", "depth", "work", "duration"):
        simulated, expected = (
            np.sort(np.asarray(getattr(record, name)).ravel()[index])
            for record, index in ((run.impacts, last), (impacts, ...))
        )
        np.testing.assert_allclose(simulated, expected, rtol=0, atol=2e-9, err_msg=name)


@pytest.mark.long
def test_simulation_from_a_start_converges_to_the_same_orbit(hertz):
    orbit = vijax.orbits_from_states(PAIR_WITHOUT_R, 0.0, 0.1, settle=100, membrane=HERTZ)
    np.testing.assert_array_equal(orbit.status, Status.OK)
    np.testing.assert_allclose(
        np.sort(orbit.impact_unknowns[..., 1]), np.sort(hertz.impact_unknowns[..., 1]), rtol=0, atol=1e-11
    )


def difference(function, x, h):
    """Return the derivative of a function by central differences of fourth order."""
    return float((8 * (function(x + h) - function(x - h)) - (function(x + 2 * h) - function(x - 2 * h))) / (12 * h))


def test_derivative_by_a_constant_of_the_law_matches_finite_differences(cubic):
    def power(beta):
        return vijax.steady(DEVICE, cubic[0], pair=PAIR, membrane=Cubic(beta)).P

    assert float(jax.grad(power)(500.0)) == pytest.approx(difference(power, 500.0, 20.0), rel=1e-7)
    # The default membrane is the membrane of the orbit.
    expected = power(500.0)
    for pair in (PAIR, cubic[0].pair):
        np.testing.assert_array_equal(vijax.steady(DEVICE, cubic[0], pair=pair).P, expected)


@pytest.mark.long
def test_derivatives_by_two_constants_of_the_law_match_finite_differences(hertz):
    def power(chi, exponent):
        return vijax.steady(DEVICE, hertz[0], pair=PAIR_WITHOUT_R, membrane=vijax.HuntCrossley(chi, exponent)).P

    by_chi, by_exponent = jax.grad(power, argnums=(0, 1))(0.3, 1.5)
    assert float(by_chi) == pytest.approx(difference(lambda x: power(x, 1.5), 0.3, 0.01), rel=1e-6)
    assert float(by_exponent) == pytest.approx(difference(lambda x: power(0.3, x), 1.5, 0.01), rel=1e-6)


@pytest.mark.long
def test_user_defined_law_applies_to_unequal_walls(linear_orbits):
    """One law applies to both walls, with the kappa and r of the wall."""
    uneven = vijax.impact_pair(0.25, vijax.Sides(30.0, 60.0), vijax.Sides(0.5, 0.4))
    closed, stepped = (vijax.find_orbits(uneven, "LR", guesses=32, membrane=law) for law in (None, Plain()))
    assert len(closed) == len(stepped) > 0
    np.testing.assert_allclose(stepped.impact_unknowns, closed.impact_unknowns, rtol=0, atol=1e-11)
    slopes = [
        jax.jacfwd(lambda pair, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=pair).P)(uneven)
        for orbit in (closed, stepped)
    ]
    for name in ("kappa", "r"):
        for side in ("left", "right"):
            expected, actual = (float(getattr(getattr(slope, name), side)) for slope in slopes)
            assert actual == pytest.approx(expected, rel=1e-9)


@pytest.mark.long
def test_contacts_that_time_steps_do_not_resolve_are_not_an_orbit():
    """The time steps are too few to resolve the 13 swings of this contact."""
    stiff = vijax.impact_pair(0.2, 40.0, 0.5, -0.9)
    side, impact_unknowns = np.array([[-1]], np.int32), np.array([[[0.5, 0.5, 1.0]]])
    sequence, near = periodic.make_guess(side, np.array([2.0]), np.array([False]), impact_unknowns)
    rows = jax.tree.map(lambda x: np.asarray(x)[None], replace(stiff, law=Plain()))
    assert float(np.asarray(periodic.verify_solutions(rows, sequence, near).residual)[0]) > 1e-7
    assert periodic.verify_solutions(rows, sequence, near).status[0] == Status.NO_ORBIT


def test_uncertainty_of_a_contact_is_part_of_the_residual(linear_orbits, monkeypatch):
    orbit = linear_orbits[1]
    unknowns = orbit.pair, orbit.sequence, orbit.impact_unknowns
    assert float(jax.jit(shooting.measure_residuals)(*unknowns)[0][0]) < 1e-11
    monkeypatch.setattr(contacts, "uncertainty", lambda *arguments: jnp.asarray(0.25))
    assert float(jax.jit(lambda *arguments: shooting.measure_residuals(*arguments))(*unknowns)[0][0]) == 0.25


@pytest.mark.long
def test_orbit_that_crosses_the_other_wall_is_virtual():
    """The equations of impacts on the left wall omit the right wall, which the ball reaches if the gap is narrow."""
    wide = vijax.find_orbits(vijax.impact_pair(0.9, 40.0, 0.5, 0.2), "L", guesses=64, membrane=Plain())
    assert len(wide) == 1
    narrow = replace(wide.pair, d=jnp.full(1, 0.02))
    for pair in (narrow, replace(narrow, law=None)):
        verified = periodic.verify_solutions(pair, wide.sequence, wide.impact_unknowns)
        assert verified.status[0] == Status.VIRTUAL
        assert verified.residual[0] < 1e-11


@pytest.mark.long
def test_branch_has_the_events_of_the_linear_membrane(linear_orbits):
    events = []
    for orbit in linear_orbits:
        (branch,) = vijax.follow_orbits(orbit, "d", (0.13, 0.25))
        events.append([(point.kind, float(point.value)) for point in branch.points])
    assert "flip" in dict(events[0])
    assert [kind for kind, _ in events[0]] == [kind for kind, _ in events[1]]
    np.testing.assert_allclose(*([value for _, value in branch_events] for branch_events in events), rtol=1e-9)


@pytest.mark.parametrize(
    ("membrane", "message"),
    [
        (vijax.Hyperelastic(1.5, 0.02), "membrane must be of the orbit's kind, Cubic; got Hyperelastic"),
        (2.0, "membrane must be a vijax.HuntCrossley"),
    ],
)
def test_membrane_of_another_kind_raises(cubic, membrane, message):
    with pytest.raises(ValueError, match=message):
        vijax.steady(DEVICE, cubic[0], membrane=membrane)


def test_functions_of_linear_membranes_reject_an_orbit_with_a_law(cubic):
    for error in refusals(cubic[0].pair):
        assert "pair must have linear membranes here; got Cubic" in error


UNEVEN = vijax.Sides(Cubic(100.0), Cubic(2000.0))


@pytest.fixture(scope="module")
def uneven():
    """Return the 1:1 orbit between two membranes with different cubic springs."""
    return vijax.find_orbits(PAIR, "LR", guesses=64, membrane=UNEVEN)


def test_orbit_between_two_laws_is_the_attractor_of_the_ode_method(uneven):
    fine = {"method": "ode", "solver": "Dopri8", "rtol": 1e-11, "atol": 1e-13}
    run = vijax.trajectory(PAIR, 0.0, 0.1, 60, membrane=UNEVEN, **fine)
    assert len(uneven) == 1
    last = slice(int(run.filled) - 2, int(run.filled))
    impacts = vijax.orbit_impacts(uneven)
    for name in ("v_in", "depth", "duration"):
        simulated, expected = (
            np.sort(np.ravel(leaf)) for leaf in (getattr(run.impacts, name)[last], getattr(impacts, name))
        )
        np.testing.assert_allclose(simulated, expected, rtol=0, atol=2e-9, err_msg=name)


def test_exchanged_laws_give_the_mirror_image_of_the_orbit(uneven):
    mirrored = vijax.find_orbits(
        vijax.impact_pair(0.2, 40.0, 0.5, -0.05), "LR", guesses=64, membrane=vijax.Sides(UNEVEN.right, UNEVEN.left)
    )
    depth, mirrored_depth = (np.asarray(vijax.orbit_impacts(orbit).depth)[0] for orbit in (uneven, mirrored))
    sides = [np.asarray(orbit.sequence.side)[0] for orbit in (uneven, mirrored)]
    np.testing.assert_allclose(depth[np.argsort(sides[0])], mirrored_depth[np.argsort(-sides[1])], rtol=1e-10)


@pytest.mark.long
def test_derivatives_by_the_laws_of_both_walls_match_finite_differences(uneven):
    def power(left, right):
        law = vijax.Sides(Cubic(left), Cubic(right))
        return vijax.steady(DEVICE, uneven[0], pair=PAIR, membrane=law).P

    by_left, by_right = jax.grad(power, argnums=(0, 1))(100.0, 2000.0)
    for derivative, direction in ((by_left, (1.0, 0.0)), (by_right, (0.0, 1.0))):
        h = 10.0
        high, low = (
            power(*(x + sign * h * component for x, component in zip((100.0, 2000.0), direction, strict=True)))
            for sign in (1, -1)
        )
        assert float(derivative) == pytest.approx(float((high - low) / (2 * h)), rel=1e-5)


@pytest.mark.long
def test_map_applies_and_records_the_laws_of_both_walls(uneven):
    dataset = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.05, method="ode", rtol=1e-10, atol=1e-12, membrane=UNEVEN)
    assert dataset.attrs["membrane"] == "left Cubic with beta 100, right Cubic with beta 2000"
    assert float(dataset.P) == pytest.approx(float(vijax.orbit_power(uneven, DEVICE)[0]), rel=1e-7)
    fixed_steps = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.05, method="rk4", steps=4000, membrane=UNEVEN)
    assert float(fixed_steps.P) == pytest.approx(float(dataset.P), rel=2e-3)


def test_mirror_images_are_merged_only_between_equal_laws(uneven):
    axes = {"d": [0.2, 0.3], "kappa": 40.0}
    for law, same in ((UNEVEN, False), (UNEVEN.left, True)):
        planned = plan(axes, None, DEVICE, SweepSettings(method="ode", membrane=law))
        assert planned.mirrored == same
    assert not bool(np.any(uneven.pair.symmetric))
    level = replace(uneven.pair, gamma=0 * uneven.pair.gamma)
    assert not bool(np.any(level.symmetric))
    assert bool(np.all(replace(level, law=None, kappa=level.kappa.left, r=level.r.left).symmetric))


def test_laws_of_two_kinds_raise():
    with pytest.raises(ValueError, match="membrane must be of one kind on both sides"):
        vijax.find_orbits(PAIR, "LR", membrane=vijax.Sides(Cubic(1.0), Plain()))


def test_tangent_determinant_of_a_contact_matches_its_formula():
    onset = [jnp.asarray(x) for x in (1.0, 0.3, 0.7, 0.08)]
    determinants = [
        float(jax.jit(contacts.tangent_determinant)(replace(PAIR, law=law), *onset)) for law in (None, Plain())
    ]
    assert determinants[1] == pytest.approx(determinants[0], rel=1e-10)
    assert determinants[0] == pytest.approx(float(jnp.exp(-PAIR.mu * 0.08)), rel=1e-14)
