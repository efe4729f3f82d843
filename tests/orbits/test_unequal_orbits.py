"""Orbits between walls that differ: derivatives by wall, branches and curves along what one wall has, limits."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import vijax
from benchmarks.yardstick import DIGITS, mp_contact, mp_flight, newton
from tests.helpers import no_cell_runs
from vijax import Sides
from vijax.model.records import Status
from vijax.orbits import grazing, limits, motion, multipliers, parameter, shooting, soft_graze, symmetry
from vijax.orbits.curve_plane import check_plane
from vijax.orbits.curve_starts import curve_start
from vijax.orbits.events import Point
from vijax.orbits.map_borders import device_of

DEVICE = vijax.Harvester(V=Sides(1500.0, 2000.0))
# d, kappa and r of the left wall and of the right one, gamma: of 1:1 orbits that attract.
CELLS = [
    (0.25, 30.0, 60.0, 0.5, 0.4, 0.0),
    (0.3, 12.0, 20.0, 0.6, 0.4, 0.05),
    (0.28, 80.0, 25.0, 0.5, 0.5, -0.03),
    (0.35, 40.0, 40.0, 0.3, 0.6, 0.0),
    (0.22, 9.0, 14.0, 0.4, 0.45, 0.1),
]


def pair_of(d, left, right, r_left, r_right, gamma):
    return vijax.impact_pair(d, Sides(left, right), Sides(r_left, r_right), gamma)


@pytest.fixture(scope="module")
def orbits():
    """The attracting 1:1 orbit of every cell."""
    found = []
    for cell in CELLS:
        some = vijax.find_orbits(pair_of(*cell), "LR", guesses=64)
        size = np.abs(np.asarray(some.multipliers)).max(axis=1)
        assert size.min() < 1
        found.append(some[int(size.argmin())])
    return found


def mp_energy(depth, side):
    """The energy of an impact that goes so deep [m], written down anew."""
    constants = (DEVICE.r_b, DEVICE.R0, DEVICE.eps_M, DEVICE.w0, DEVICE.C_T)
    ball, rim, eps_M, w0, C_T = map(mp.mpf, constants)
    V = mp.mpf(DEVICE.V.right if side > 0 else DEVICE.V.left)
    height = ball - depth
    tangent = mp.sqrt(rim**2 + height**2 - ball**2)
    cosine = (ball * height + rim * tangent) / (rim**2 + height**2)
    touch = ball * mp.sqrt(1 - cosine**2)
    area = 2 * mp.pi * ball**2 * (1 - cosine) + (mp.pi * rim**2 - mp.pi * touch**2) / cosine
    least, most = (eps_M * size**2 / (w0 * mp.pi * rim**2) for size in (mp.pi * rim**2, area))
    return (most + C_T) / (least + C_T) * (most - least) * V**2 / 2


def mp_power(cell, knots, side):
    """P of the orbit near a 1:1 orbit's knots, solved anew in 50 digits."""
    d, *walls, gamma = map(mp.mpf, cell)
    own = {-1: (walls[0], walls[2]), 1: (walls[1], walls[3])}

    def ends(j, t, speed, stay):
        course = partial(mp_contact, *own[side[j]], gamma, side[j], t, speed)
        return course, *course(stay)[:2]

    def gaps(*x):
        out = []
        for j in range(2):
            t, speed, stay = x[3 * j : 3 * j + 3]
            _, w, z = ends(j, t, speed, stay)
            onward = x[3] if j == 0 else x[0] + 2
            rise, v = mp_flight(gamma, t + stay, side[j] * z, onward - t - stay)
            out += [w, side[j] * d / 2 + rise - side[1 - j] * d / 2, side[1 - j] * v - x[3 * (1 - j) + 1]]
        return out

    x = mp.findroot(gaps, [mp.mpf(float(value)) for value in np.ravel(knots)], tol=mp.mpf(10) ** -80, maxsteps=20)
    total = mp.mpf(0)
    for j in range(2):
        course, _, _ = ends(j, *x[3 * j : 3 * j + 3])
        deepest = newton(lambda s, course=course: course(s)[1:], x[3 * j + 2] / 2)
        total += mp_energy(course(deepest)[0] * mp.mpf(1), side[j])
    return total / 2


def test_powers_and_derivatives_by_wall_are_those_of_fifty_digits(orbits):
    """The unit of length of the device is a metre, as A is 1 and omega pi."""
    slope = jax.jit(jax.value_and_grad(lambda pair, orbit: vijax.steady(DEVICE, orbit, pair=pair).P))
    step = mp.mpf(10) ** -12
    for cell, orbit in zip(CELLS, orbits, strict=True):
        P, grad = slope(pair_of(*cell), orbit)
        knots, side = np.asarray(orbit.knots)[:2], [int(s) for s in np.asarray(orbit.sequence.side)[:2]]
        with mp.workdps(DIGITS):
            assert float(P) == pytest.approx(float(mp_power(cell, knots, side)), rel=1e-12)
            mine = [grad.kappa.left, grad.kappa.right, grad.r.left, grad.r.right]
            for place, got in enumerate(mine, start=1):
                moved = [list(map(mp.mpf, cell)) for _ in range(2)]
                moved[0][place] += step
                moved[1][place] -= step
                high, low = (mp_power(one, knots, side) for one in moved)
                assert float(got) == pytest.approx(float((high - low) / (2 * step)), rel=1e-9)


@pytest.mark.long
def test_a_branch_along_one_wall_leads_from_equal_walls_to_any_other(orbits):
    """Where it ends it has the orbit that is found there; what was a pitchfork of mirror images has become a fold."""
    begun = vijax.find_orbits(vijax.impact_pair(0.25, 30.0, 0.5), "LR", guesses=64)
    size = np.abs(np.asarray(begun.multipliers)).max(axis=1)
    (branch,) = vijax.follow_orbits(begun[int(size.argmin()) :][:1], "kappa_right", (30.0, 60.0), direction="up")
    assert branch.ends[1] == "high"
    last = branch.orbit[-1:]
    assert float(last.pair.kappa.right[0]) == pytest.approx(60.0)
    assert float(last.pair.kappa.left[0]) == 30.0
    there = vijax.find_orbits(vijax.impact_pair(0.25, Sides(30.0, 60.0), 0.5), "LR", guesses=64)
    off = [np.abs(np.asarray(one.knots - last[0].knots)).max() for one in (there[i] for i in range(len(there)))]
    assert min(off) < 1e-9
    assert not symmetry.symmetric(last).any()
    dataset = vijax.branch_dataset([branch], DEVICE)
    assert float(dataset["kappa_left"]) == 30.0
    assert "kappa_right" in dataset.coords
    np.testing.assert_allclose(dataset["P"].values[0, -1], float(vijax.orbit_power(last, DEVICE)[0]), rtol=1e-12)


@pytest.mark.long
def test_a_curve_in_the_plane_of_one_wall_passes_the_folds_of_branches_across_it():
    pair = vijax.impact_pair(0.2, Sides(20.0, 40.0), 0.5)
    orbit = vijax.find_orbits(pair, "LR", guesses=64)
    index = int(np.abs(np.asarray(orbit.multipliers)).max(axis=1).argmin())
    told = {"direction": "down"}
    (one,) = vijax.follow_orbits(orbit[index : index + 1], "d", (0.13, 0.21), **told)
    folds = [point for point in one.points if point.kind == "fold"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (curve, *_) = vijax.follow_curves(folds[:1], "d", {"d": (0.1, 0.3), "kappa_left": (15.0, 30.0)})
    assert curve.kind == "fold"
    _, kappa = curve.values[-1]
    near = curve.orbit[-1:]
    assert float(near.pair.kappa.left[0]) == pytest.approx(kappa, rel=1e-12)
    assert float(near.pair.kappa.right[0]) == 40.0
    multipliers = np.asarray(near.multipliers)[0]
    assert np.abs(multipliers - 1).min() < 1e-6
    dataset = vijax.curve_dataset([curve])
    assert {"kappa_right", "r_left", "r_right"} < set(dataset.coords)
    assert dataset.attrs["wall"] == "soft"


@pytest.mark.parametrize("along", ["gamma", pytest.param("kappa_left", marks=pytest.mark.long)])
def test_where_the_symmetry_of_walls_goes_a_pitchfork_begins_no_curve(along):
    """It is where folds meet; an orbit closed half way is followed in full."""
    begun = vijax.find_orbits(vijax.impact_pair(0.24, None if along == "gamma" else 40.0, 0.5), "LR", guesses=64)
    half = symmetry.halved(begun[symmetry.symmetric(begun)][:1])
    kind, place = "pitchfork", (0.24, 0.0)
    told = curve_start(Point(kind, 0.24, half), place, 1e-4, ("d", along))
    assert "two folds meet in a pitchfork" in told
    assert curve_start(Point(kind, 0.24, half), place, 1e-4, ("d", "r")).orbit.sequence.mirrored.all()
    whole = curve_start(Point("fold", 0.24, half), place, 1e-4, ("d", along)).orbit
    assert not np.asarray(whole.sequence.mirrored).any()
    assert int(np.asarray(whole.count)[0]) == 2


@pytest.mark.parametrize(
    "kappa",
    [pytest.param(None, marks=pytest.mark.long), Sides(50.0, 30.0), Sides(50.0, None)],
    ids=["rigid", "soft", "one rigid"],
)
def test_conditions_of_multipliers_are_those_of_the_map_once_around(kappa):
    pair = vijax.impact_pair(0.3, kappa, Sides(0.4, 0.5))
    one = vijax.find_orbits(pair, "LR", guesses=64)[0]
    knots = jnp.nan_to_num(one.knots)
    both = multipliers.multiplier_conditions(pair, one.sequence, knots)
    around = np.asarray(multipliers.monodromy(pair, one.sequence, knots))
    trace, product = np.trace(around), np.linalg.det(around)
    hard = np.asarray(one.sequence.real & pair.hard(one.sequence.side))
    speed = np.asarray(one.knots)[hard, 1]
    weight = np.prod(speed / (speed + 0.1))
    np.testing.assert_allclose(both.plus, weight * (1 - trace + product), rtol=1e-9)
    np.testing.assert_allclose(both.minus, weight * (1 + trace + product), rtol=1e-9)


def test_limits_are_those_of_the_wall_that_is_met(orbits):
    orbit = orbits[0]
    pair = jax.tree.map(lambda x: np.asarray(x)[None], orbit)
    depth, side = np.asarray(orbit.depth), np.asarray(orbit.sequence.side)
    real = side != 0
    device = vijax.Harvester(r_b=0.004, R0=Sides(0.005, 0.02))
    load = limits.loads(pair, device)["penetration limit"][0]
    np.testing.assert_allclose(load[real], (depth / np.where(side > 0, 0.02, 0.005))[real], rtol=1e-14)


@pytest.mark.long
def test_an_orbit_closed_half_way_yields_at_both_membranes():
    """Walls that move the ball alike may yield apart: what is not listed of the orbit is at the other wall."""
    pair = vijax.impact_pair(0.25, 30.0, 0.5)
    whole = vijax.find_orbits(pair, "LR", guesses=64)
    whole = whole[symmetry.symmetric(whole)][:1]
    half = symmetry.halved(whole)
    depth = float(np.asarray(whole.depth)[0, 0])
    device = vijax.Harvester(V=Sides(2000.0, 500.0), R0=Sides(2 * depth, 0.9 * depth), r_b=0.5 * depth)
    wanted = float(vijax.orbit_power(whole, device)[0])
    assert float(vijax.orbit_power(half, device)[0]) == pytest.approx(wanted, rel=1e-12)
    state = vijax.steady(device, half[0], pair=pair)
    assert float(state.P) == pytest.approx(wanted, rel=1e-12)
    for kind, load in limits.loads(half, device).items():
        assert load.max() == pytest.approx(limits.loads(whole, device)[kind].max(), rel=1e-9), kind


@pytest.mark.long
def test_walls_of_one_stiffness_move_together_where_something_else_differs():
    orbit = vijax.find_orbits(vijax.impact_pair(0.3, 50.0, Sides(0.4, 0.5)), "LR", guesses=64)
    index = int(np.abs(np.asarray(orbit.multipliers)).max(axis=1).argmin())
    (branch,) = vijax.follow_orbits(orbit[index : index + 1], "kappa", (45.0, 50.0), direction="down")
    last = branch.orbit[-1].pair
    assert float(last.kappa.left) == float(last.kappa.right) == pytest.approx(45.0)
    assert (float(last.r.left), float(last.r.right)) == (0.4, 0.5)


MIXED = vijax.impact_pair(0.3, Sides(30.0, None), Sides(0.5, 0.7))


def test_an_orbit_between_a_rigid_wall_and_a_membrane_is_steady_and_has_derivatives():
    some = vijax.find_orbits(MIXED, "LR", guesses=64)
    size = np.abs(np.asarray(some.multipliers)).max(axis=1)
    one = some[int(size.argmin())]
    device = vijax.Harvester()

    def P(pair):
        return vijax.steady(device, one, pair=pair)

    state = P(MIXED)
    assert int(state.status) == Status.OK
    assert float(state.P) == pytest.approx(float(vijax.orbit_power(some, device)[int(size.argmin())]), rel=1e-12)
    grad = jax.grad(lambda pair: P(pair).P)(MIXED)
    assert grad.kappa.right is None
    # Backwards through the equations themselves, too, as second derivatives go: a rigid contact has no length.
    knots = jnp.nan_to_num(one.knots)
    turned = jax.grad(lambda pair: shooting.gap(pair, one.sequence, knots).sum())(MIXED)
    assert np.isfinite(turned.kappa.left)
    h = 1e-4

    def moved(**by):
        given = {"left": 30.0, "r_left": 0.5, "r_right": 0.7} | by
        pair = vijax.impact_pair(0.3, Sides(given["left"], None), Sides(given["r_left"], given["r_right"]))
        return float(P(pair).P)

    for name, got in (("left", grad.kappa.left), ("r_left", grad.r.left), ("r_right", grad.r.right)):
        here = {"left": 30.0, "r_left": 0.5, "r_right": 0.7}[name]
        difference = (moved(**{name: here + h}) - moved(**{name: here - h})) / (2 * h)
        assert float(got) == pytest.approx(difference, rel=1e-5)


BAD = [
    (lambda orbit: vijax.follow_orbits(orbit, "kappa", (10.0, 90.0)), "along must be kappa_left or kappa_right"),
    (lambda orbit: vijax.follow_orbits(orbit, "k", (10.0, 90.0)), "along must be k_left or k_right, of one wall"),
    (lambda orbit: vijax.follow_orbits(orbit, "r", (0.1, 0.9)), "along must be r_left or r_right"),
    (
        lambda orbit: check_plane(orbit.pair, {"kappa_left": (1.0, 2.0), "omega0_left": (1.0, 2.0)}),
        "kappa_left and omega0_left, which say the same",
    ),
    (
        lambda orbit: parameter.check_along(MIXED, "kappa_right", (10.0, 90.0)),
        "a rigid wall has no kappa or omega0 or k",
    ),
    (lambda orbit: parameter.check_along(MIXED, "kappa", (10.0, 90.0)), "along must be kappa_left, of one wall"),
    (
        lambda orbit: vijax.steady(DEVICE, orbit[0], pair=vijax.impact_pair(0.2, Sides(20.0, None), 0.5)),
        "pair must have the walls of the orbit",
    ),
]


@pytest.mark.parametrize(("act", "words"), BAD, ids=[words[:24] for _, words in BAD])
def test_what_cannot_be_is_told(orbits, act, words):
    one = jax.tree.map(lambda x: np.asarray(x)[None], orbits[0])
    with pytest.raises(ValueError, match=words):
        act(one)


def test_omega_moves_the_membrane_beside_a_rigid_wall():
    begun = float(parameter.value_at(MIXED, "omega", DEVICE))
    moved = parameter.pair_at(MIXED, "omega", 2 * begun, DEVICE)
    assert float(moved.d) == pytest.approx(4 * 0.3)
    assert float(moved.kappa.left) == pytest.approx(30.0 / 2)
    assert moved.kappa.right is None


def followed(right):
    """Follow the attractor between a membrane and another wall, from where its branch grazes, or flips, on."""
    pair = vijax.impact_pair(0.2, Sides(40.0, right), 0.5, 0.02)
    some = vijax.find_orbits(pair, "LR", guesses=256)
    size = np.abs(np.asarray(some.multipliers)).max(axis=1)
    one = int(np.flatnonzero((size > 0.35) & (size < 0.4))[0])
    (branch,) = vijax.follow_orbits(some[one : one + 1], "d", (0.16, 0.24))
    return branch


@pytest.fixture(scope="module")
def beside_rigid():
    """A branch between a membrane on the left and a rigid wall on the right."""
    return followed(None)


def last_flip(branch):
    return [point for point in branch.points if point.kind == "flip"][-1]


@pytest.mark.long
def test_a_branch_beside_a_rigid_wall_flips_where_runs_double_their_period(beside_rigid):
    assert beside_rigid.ends == ("grazing flight", "high")
    graze, flip = beside_rigid.points
    assert (graze.kind, graze.gained, flip.kind) == ("grazing flight", 0, "flip")
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], vijax.orbit_impacts(flip.orbit))
    left, side = float(first.t[0] + first.duration[0]) % 2, int(first.side[0])
    apart = []
    for off in (-2e-4, 2e-4):
        d = flip.value + off
        pair = vijax.impact_pair(d, Sides(40.0, None), 0.5, 0.02)
        run = vijax.trajectory(pair, side * d / 2, float(first.v_out[0]), 2000, left)
        v = np.asarray(run.states.v)
        apart.append((abs(v[-1] - v[-2]), abs(v[-1] - v[-3])))
    (doubled, twice), (same, _) = apart
    assert doubled > 1e-3
    assert max(twice, same) < 1e-6


@pytest.mark.long
def test_a_branch_beside_a_rigid_wall_is_the_limit_of_those_beside_stiff_ones(beside_rigid):
    one, other = (float(last_flip(followed(stiff)).value) for stiff in (1e4, 2e4))
    rigid = float(last_flip(beside_rigid).value)
    assert abs(other - rigid) < 0.6 * abs(one - rigid) < 1e-4
    assert 2 * other - one == pytest.approx(rigid, abs=5e-7)


@pytest.mark.long
def test_what_decides_of_resonance_beside_a_rigid_wall_is_how_far_a_neighbour_returns():
    some = vijax.find_orbits(MIXED, "LR", guesses=64)
    one = int(np.abs(np.asarray(some.multipliers)).max(axis=1).argmin())
    pair, sequence, knots = jax.tree.map(lambda leaf: leaf[one], (some.pair, some.sequence, some.knots))
    hits = jax.tree.map(lambda leaf: np.asarray(leaf)[one], vijax.orbit_impacts(some))
    off, wait = np.array([1e-5, -1e-5]), 0.05
    for impact in (0, 1):
        onset, *_ = leaving = [getattr(hits, name)[impact] for name in ("t", "side", "v_in", "v_out", "duration")]
        begun = onset + leaving[-1] + wait
        u, v = (x[0] for x in motion.states(MIXED, *(np.atleast_1d(float(x)) for x in leaving), when=np.array([begun])))
        t0 = begun % 2
        found = vijax.trajectory(MIXED, u, v + off, 4, t0).impacts
        ends = []
        for row in (0, 1):
            there = np.asarray(found.side)[row] != 0
            own = [
                np.asarray(x, float)[row][there]
                for x in (2.0 * np.asarray(found.n) + np.asarray(found.t), found.side, found.v_in, found.v_out)
            ]
            ends.append(
                motion.states(MIXED, *own, np.asarray(found.duration)[row][there], when=np.array([t0 + 2]))[0][0]
            )
        got = multipliers.returned(pair, sequence, knots, np.int32(impact), wait)
        assert float(got) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


@pytest.mark.long
def test_what_touches_a_rigid_wall_beside_a_membrane_goes_nowhere(beside_rigid):
    graze = beside_rigid.points[0].orbit
    pair, sequence, knots = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (graze.pair, graze.sequence, graze.knots))
    assert soft_graze.touching(pair, sequence, knots, "flight") is None
    turns = jax.tree.map(np.asarray, grazing.flight_turns(pair, sequence, jnp.asarray(knots)))
    assert abs(turns.room.min()) < 1e-12
    assert turns.wall[turns.room.argmin()] == 1.0


@pytest.mark.long
def test_a_graze_at_the_membrane_beside_a_rigid_wall_leads_on():
    pair = vijax.impact_pair(0.2, Sides(40.0, None), 0.5, 0.02)
    some = vijax.find_orbits(pair, "LR", guesses=256)
    (branch,) = vijax.follow_orbits(some[:1], "d", (0.16, 0.24))
    (graze,) = [point for point in branch.points if point.kind == "grazing flight"]
    assert (graze.gained, graze.wall) in ((1, -1), (-1, -1))


@pytest.mark.long
def test_curves_beside_a_rigid_wall_are_the_limit_of_those_beside_stiff_ones(beside_rigid):
    def across(branch):
        (curve,) = vijax.follow_curves([last_flip(branch)], "d", {"d": (0.14, 0.25), "r_left": (0.45, 0.6)})
        d, r = curve.values.T
        order = np.argsort(r)
        return float(np.interp(0.53, r[order], d[order])), [point.kind for point in curve.points]

    (rigid, met), (one, also) = across(beside_rigid), across(followed(1e4))
    assert met == also
    assert one == pytest.approx(rigid, abs=2e-4)


@pytest.mark.long
def test_a_graze_at_a_rigid_wall_beside_a_membrane_begins_a_curve_that_meets_that_of_the_flip(beside_rigid):
    found = vijax.follow_curves(list(beside_rigid.points), "d", {"d": (0.14, 0.25), "r_left": (0.4, 0.6)})
    both = {curve.kind: [point for point in curve.points if point.kind == "flip-graze"] for curve in found}
    assert set(both) == {"grazing", "flip"}
    np.testing.assert_allclose(both["grazing"][0].values, both["flip"][0].values, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def half_rigid():
    """A map of a membrane on the left and a rigid wall on the right."""
    axes = {"d": np.linspace(0.1, 0.3, 32), "kappa_left": np.geomspace(10, 100, 16)}
    return vijax.sweep(**axes, r=0.5, gamma=0.02, wall="rigid_right")


def test_the_device_of_a_map_with_one_rigid_wall_has_a_membrane():
    with no_cell_runs():
        device = device_of(vijax.sweep(d=[0.1, 0.3], kappa_left=[10.0, 100.0], wall="rigid_right"))
    assert float(device.omega0.left) == pytest.approx(10.0 * float(device.omega) / np.pi)
    assert np.isfinite(float(device.omega0.right))


@pytest.mark.long
def test_curves_explain_the_borders_of_a_map_with_one_rigid_wall(half_rigid):
    found = vijax.bifurcation_curves(half_rigid)
    assert found.explained == found.borders > 60
