"""Orbits, steady states and branches with membranes of any law: the linear one written as a user's, and attractors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from tests.helpers import Cubic, Plain, refusals
from vijax.model.records import Status
from vijax.orbits import contacts, periodic, shooting
from vijax.planes.sweep import plan
from vijax.planes.sweep_settings import SweepSettings

PAIR = vijax.impact_pair(0.2, 40.0, 0.5, 0.05)
LOSSY = vijax.impact_pair(0.2, 40.0, None, 0.05)
DEVICE = vijax.Harvester()
HERTZ = vijax.HuntCrossley(0.3)


@pytest.fixture(scope="module")
def springs():
    """The 1:1 orbit by closed forms, and by steps."""
    return [vijax.find_orbits(PAIR, "LR", guesses=64, membrane=law) for law in (None, Plain())]


@pytest.fixture(scope="module")
def hertz():
    """The 1:1 orbit of a membrane of Hunt and Crossley."""
    return vijax.find_orbits(LOSSY, "LR", guesses=64, membrane=HERTZ)


@pytest.fixture(scope="module")
def cubic():
    """The 1:1 orbit of a membrane that stiffens."""
    return vijax.find_orbits(PAIR, "LR", guesses=64, membrane=Cubic(500.0))


def test_a_spring_of_ones_own_has_the_orbits_of_the_linear_membrane(springs):
    closed, stepped = springs
    assert len(closed) == len(stepped) == 1
    for name in ("knots", "depth", "work", "multipliers"):
        np.testing.assert_allclose(getattr(stepped, name), getattr(closed, name), rtol=0, atol=1e-11, err_msg=name)
    assert stepped.residual[0] < 1e-11
    assert vijax.orbit_labels(stepped) == vijax.orbit_labels(closed)
    np.testing.assert_allclose(vijax.orbit_power(stepped, DEVICE), vijax.orbit_power(closed, DEVICE), rtol=1e-11)
    for one, other in zip(vijax.orbit_path(stepped), vijax.orbit_path(closed), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11)
    for one, other in zip(*(jax.tree.leaves(vijax.orbit_impacts(orbit)) for orbit in springs), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("transform", [jax.jacfwd, jax.grad])
def test_its_steady_state_has_the_derivatives_of_the_linear_one(springs, transform):
    slopes = [
        transform(lambda pair, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=pair).P)(PAIR) for orbit in springs
    ]
    for name in ("d", "kappa", "r", "gamma"):
        assert float(getattr(slopes[1], name)) == pytest.approx(float(getattr(slopes[0], name)), rel=1e-10)


@pytest.mark.long
def test_its_second_derivatives_are_those_of_the_linear_one(springs):
    curved = [
        jax.jacfwd(jax.jacfwd(lambda k, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=replace(PAIR, kappa=k)).P))(
            PAIR.kappa
        )
        for orbit in springs
    ]
    assert float(curved[1]) == pytest.approx(float(curved[0]), rel=1e-9)


@pytest.mark.long
def test_the_orbit_of_hertz_is_the_attractor_that_ode_finds(hertz):
    assert len(hertz) == 1
    assert np.abs(hertz.multipliers).max() < 1
    fine = {"method": "ode", "solver": "Dopri8", "rtol": 1e-11, "atol": 1e-13}
    run = vijax.trajectory(LOSSY, 0.0, 0.1, 100, membrane=HERTZ, **fine)
    last = slice(int(run.filled) - 2, int(run.filled))
    found = vijax.orbit_impacts(hertz)
    for name in ("t", "v_in", "v_out", "depth", "work", "duration"):
        ends, known = (
            np.sort(np.asarray(getattr(one, name)).ravel()[at]) for one, at in ((run.impacts, last), (found, ...))
        )
        np.testing.assert_allclose(ends, known, rtol=0, atol=2e-9, err_msg=name)


@pytest.mark.long
def test_a_state_leads_to_the_same_orbit(hertz):
    found = vijax.orbits_from_states(LOSSY, 0.0, 0.1, settle=100, membrane=HERTZ)
    np.testing.assert_array_equal(found.status, Status.OK)
    np.testing.assert_allclose(np.sort(found.knots[..., 1]), np.sort(hertz.knots[..., 1]), rtol=0, atol=1e-11)


def difference(of, x, h):
    """Return the derivative of a function by central differences of fourth order."""
    return float((8 * (of(x + h) - of(x - h)) - (of(x + 2 * h) - of(x - 2 * h))) / (12 * h))


def test_the_derivative_by_a_number_of_the_law_is_that_of_differences(cubic):
    def stiffer(beta):
        return vijax.steady(DEVICE, cubic[0], pair=PAIR, membrane=Cubic(beta)).P

    assert float(jax.grad(stiffer)(500.0)) == pytest.approx(difference(stiffer, 500.0, 20.0), rel=1e-7)
    # Left out, the membrane is the orbit's.
    known = stiffer(500.0)
    for pair in (PAIR, cubic[0].pair):
        np.testing.assert_array_equal(vijax.steady(DEVICE, cubic[0], pair=pair).P, known)


@pytest.mark.long
def test_derivatives_by_two_numbers_of_the_law_are_those_of_differences(hertz):
    def lossier(chi, exponent):
        return vijax.steady(DEVICE, hertz[0], pair=LOSSY, membrane=vijax.HuntCrossley(chi, exponent)).P

    by_chi, by_exponent = jax.grad(lossier, argnums=(0, 1))(0.3, 1.5)
    assert float(by_chi) == pytest.approx(difference(lambda x: lossier(x, 1.5), 0.3, 0.01), rel=1e-6)
    assert float(by_exponent) == pytest.approx(difference(lambda x: lossier(0.3, x), 1.5, 0.01), rel=1e-6)


@pytest.mark.long
def test_walls_that_differ_have_a_law_each(springs):
    """One law, whose kappa and r are those of either wall."""
    uneven = vijax.impact_pair(0.25, vijax.Sides(30.0, 60.0), vijax.Sides(0.5, 0.4))
    closed, stepped = (vijax.find_orbits(uneven, "LR", guesses=32, membrane=law) for law in (None, Plain()))
    assert len(closed) == len(stepped) > 0
    np.testing.assert_allclose(stepped.knots, closed.knots, rtol=0, atol=1e-11)
    slopes = [
        jax.jacfwd(lambda pair, orbit=orbit: vijax.steady(DEVICE, orbit[0], pair=pair).P)(uneven)
        for orbit in (closed, stepped)
    ]
    for name in ("kappa", "r"):
        for side in ("left", "right"):
            one, other = (float(getattr(getattr(slope, name), side)) for slope in slopes)
            assert other == pytest.approx(one, rel=1e-9)


@pytest.mark.long
def test_contacts_that_steps_do_not_resolve_make_no_orbit():
    """Of 13 swings in a contact of so few steps nothing is known."""
    stiff = vijax.impact_pair(0.2, 40.0, 0.5, -0.9)
    side, knots = np.array([[-1]], np.int32), np.array([[[0.5, 0.5, 1.0]]])
    sequence, near = periodic.guessed(side, np.array([2.0]), np.array([False]), knots)
    rows = jax.tree.map(lambda x: np.asarray(x)[None], replace(stiff, law=Plain()))
    assert float(np.asarray(periodic.proven(rows, sequence, near).residual)[0]) > 1e-7
    assert periodic.proven(rows, sequence, near).status[0] == Status.NO_ORBIT


def test_what_is_uncertain_of_a_contact_is_part_of_the_residual(springs, monkeypatch):
    orbit = springs[1]
    told = orbit.pair, orbit.sequence, orbit.knots
    assert float(jax.jit(shooting.measured)(*told)[0][0]) < 1e-11
    monkeypatch.setattr(contacts, "uncertainty", lambda *of: jnp.asarray(0.25))
    assert float(jax.jit(lambda *of: shooting.measured(*of))(*told)[0][0]) == 0.25


@pytest.mark.long
def test_a_ball_that_meets_a_wall_between_is_seen():
    """Impacts on one wall know nothing of the other, which stands in the way of a narrow gap."""
    wide = vijax.find_orbits(vijax.impact_pair(0.9, 40.0, 0.5, 0.2), "L", guesses=64, membrane=Plain())
    assert len(wide) == 1
    narrow = replace(wide.pair, d=jnp.full(1, 0.02))
    for pair in (narrow, replace(narrow, law=None)):
        again = periodic.proven(pair, wide.sequence, wide.knots)
        assert again.status[0] == Status.VIRTUAL
        assert again.residual[0] < 1e-11


@pytest.mark.long
def test_a_branch_meets_what_that_of_the_linear_membrane_meets(springs):
    met = []
    for orbit in springs:
        (branch,) = vijax.follow_orbits(orbit, "d", (0.13, 0.25))
        met.append([(point.kind, float(point.value)) for point in branch.points])
    assert "flip" in dict(met[0])
    assert [kind for kind, _ in met[0]] == [kind for kind, _ in met[1]]
    np.testing.assert_allclose(*([value for _, value in one] for one in met), rtol=1e-9)


@pytest.mark.parametrize(
    ("membrane", "said"),
    [
        (vijax.Hyperelastic(1.5, 0.02), "membrane must be of the orbit's kind, Cubic; got Hyperelastic"),
        (2.0, "membrane must be a vijax.HuntCrossley"),
    ],
)
def test_a_membrane_of_another_kind_is_refused(cubic, membrane, said):
    with pytest.raises(ValueError, match=said):
        vijax.steady(DEVICE, cubic[0], membrane=membrane)


def test_what_knows_linear_membranes_refuses_the_pair_of_an_orbit(cubic):
    for error in refusals(cubic[0].pair):
        assert "pair must have linear membranes here; got Cubic" in error


UNEVEN = vijax.Sides(Cubic(100.0), Cubic(2000.0))


@pytest.fixture(scope="module")
def uneven():
    """The 1:1 orbit between two membranes that stiffen, one more than the other."""
    return vijax.find_orbits(PAIR, "LR", guesses=64, membrane=UNEVEN)


def test_walls_have_a_law_each(uneven):
    fine = {"method": "ode", "solver": "Dopri8", "rtol": 1e-11, "atol": 1e-13}
    run = vijax.trajectory(PAIR, 0.0, 0.1, 60, membrane=UNEVEN, **fine)
    assert len(uneven) == 1
    last = slice(int(run.filled) - 2, int(run.filled))
    found = vijax.orbit_impacts(uneven)
    for name in ("v_in", "depth", "duration"):
        ends, known = (np.sort(np.ravel(leaf)) for leaf in (getattr(run.impacts, name)[last], getattr(found, name)))
        np.testing.assert_allclose(ends, known, rtol=0, atol=2e-9, err_msg=name)


def test_the_mirror_image_of_walls_with_laws_is_that_of_the_motion(uneven):
    turned = vijax.find_orbits(
        vijax.impact_pair(0.2, 40.0, 0.5, -0.05), "LR", guesses=64, membrane=vijax.Sides(UNEVEN.right, UNEVEN.left)
    )
    one, other = (np.asarray(vijax.orbit_impacts(orbit).depth)[0] for orbit in (uneven, turned))
    sides = [np.asarray(orbit.sequence.side)[0] for orbit in (uneven, turned)]
    np.testing.assert_allclose(one[np.argsort(sides[0])], other[np.argsort(-sides[1])], rtol=1e-10)


@pytest.mark.long
def test_each_wall_has_a_derivative(uneven):
    def power(left, right):
        law = vijax.Sides(Cubic(left), Cubic(right))
        return vijax.steady(DEVICE, uneven[0], pair=PAIR, membrane=law).P

    by_left, by_right = jax.grad(power, argnums=(0, 1))(100.0, 2000.0)
    for mine, off in ((by_left, (1.0, 0.0)), (by_right, (0.0, 1.0))):
        h = 10.0
        one, other = (
            power(*(x + sign * h * way for x, way in zip((100.0, 2000.0), off, strict=True))) for sign in (1, -1)
        )
        assert float(mine) == pytest.approx(float((one - other) / (2 * h)), rel=1e-5)


@pytest.mark.long
def test_a_map_knows_the_law_of_each_wall(uneven):
    found = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.05, method="ode", rtol=1e-10, atol=1e-12, membrane=UNEVEN)
    assert found.attrs["membrane"] == "left Cubic with beta 100, right Cubic with beta 2000"
    assert float(found.P) == pytest.approx(float(vijax.orbit_power(uneven, DEVICE)[0]), rel=1e-7)
    again = vijax.sweep(d=0.2, kappa=40.0, r=0.5, gamma=0.05, method="rk4", steps=4000, membrane=UNEVEN)
    assert float(again.P) == pytest.approx(float(found.P), rel=2e-3)


def test_mirror_images_are_not_merged_between_walls_with_laws_of_their_own(uneven):
    axes = {"d": [0.2, 0.3], "kappa": 40.0}
    for law, same in ((UNEVEN, False), (UNEVEN.left, True)):
        planned = plan(axes, None, DEVICE, SweepSettings(method="ode", membrane=law))
        assert planned.mirrored == same
    assert not bool(np.any(uneven.pair.symmetric))
    level = replace(uneven.pair, gamma=0 * uneven.pair.gamma)
    assert not bool(np.any(level.symmetric))
    assert bool(np.all(replace(level, law=None, kappa=level.kappa.left, r=level.r.left).symmetric))


def test_laws_of_two_kinds_are_refused():
    with pytest.raises(ValueError, match="membrane must be of one kind on both sides"):
        vijax.find_orbits(PAIR, "LR", membrane=vijax.Sides(Cubic(1.0), Plain()))


def test_what_a_contact_loses_is_the_determinant_of_its_tangent_map():
    onset = [jnp.asarray(x) for x in (1.0, 0.3, 0.7, 0.08)]
    lost = [float(jax.jit(contacts.loss)(replace(PAIR, law=law), *onset)) for law in (None, Plain())]
    assert lost[1] == pytest.approx(lost[0], rel=1e-10)
    assert lost[0] == pytest.approx(float(jnp.exp(-PAIR.mu * 0.08)), rel=1e-14)
