"""Orbits between unequal walls: derivatives by wall, branches and curves along parameters of one wall, limits."""

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
from vijax.continuation import continuation_parameter, grazing_switch, limits
from vijax.continuation.branch_events import Point
from vijax.continuation.curves.curve_plane import check_plane
from vijax.continuation.curves.curve_starts import curve_start
from vijax.continuation.from_map.map_borders import device_of
from vijax.model.records import Status
from vijax.orbits import clearances, motion, multipliers, shooting, symmetry

DEVICE = vijax.Harvester(V=Sides(1500.0, 2000.0))
# d, kappa of the left and the right wall, r of the left and the right wall, gamma; their 1:1 orbits attract.
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
    """Return the attracting 1:1 orbit of every cell."""
    attractors = []
    for cell in CELLS:
        candidates = vijax.find_orbits(pair_of(*cell), "LR", guesses=64)
        size = np.abs(np.asarray(candidates.multipliers)).max(axis=1)
        assert size.min() < 1
        attractors.append(candidates[int(size.argmin())])
    return attractors


def mp_energy(depth, side):
    """Return the energy of an impact of a depth [m], by an independent implementation."""
    constants = (DEVICE.r_b, DEVICE.R0, DEVICE.eps_M, DEVICE.w0, DEVICE.C_T)
    ball, rim, eps_M, w0, C_T = map(mp.mpf, constants)
    V = mp.mpf(DEVICE.V.right if side > 0 else DEVICE.V.left)
    height = ball - depth
    tangent = mp.sqrt(rim**2 + height**2 - ball**2)
    cosine = (ball * height + rim * tangent) / (rim**2 + height**2)
    contact_radius = ball * mp.sqrt(1 - cosine**2)
    area = 2 * mp.pi * ball**2 * (1 - cosine) + (mp.pi * rim**2 - mp.pi * contact_radius**2) / cosine
    least, most = (eps_M * size**2 / (w0 * mp.pi * rim**2) for size in (mp.pi * rim**2, area))
    return (most + C_T) / (least + C_T) * (most - least) * V**2 / 2


def mp_power(cell, impact_unknowns, side):
    """Return P of the orbit near the impact unknowns of a 1:1 orbit, by an independent solution in 50 digits."""
    d, *walls, gamma = map(mp.mpf, cell)
    wall_constants = {-1: (walls[0], walls[2]), 1: (walls[1], walls[3])}

    def contact_exit(j, t, speed, duration):
        contact = partial(mp_contact, *wall_constants[side[j]], gamma, side[j], t, speed)
        return contact, *contact(duration)[:2]

    def residuals(*x):
        values = []
        for j in range(2):
            t, speed, duration = x[3 * j : 3 * j + 3]
            _, w, z = contact_exit(j, t, speed, duration)
            next_onset = x[3] if j == 0 else x[0] + 2
            rise, v = mp_flight(gamma, t + duration, side[j] * z, next_onset - t - duration)
            values += [w, side[j] * d / 2 + rise - side[1 - j] * d / 2, side[1 - j] * v - x[3 * (1 - j) + 1]]
        return values

    x = mp.findroot(
        residuals, [mp.mpf(float(value)) for value in np.ravel(impact_unknowns)], tol=mp.mpf(10) ** -80, maxsteps=20
    )
    total = mp.mpf(0)
    for j in range(2):
        contact, _, _ = contact_exit(j, *x[3 * j : 3 * j + 3])
        deepest = newton(lambda s, contact=contact: contact(s)[1:], x[3 * j + 2] / 2)
        total += mp_energy(contact(deepest)[0] * mp.mpf(1), side[j])
    return total / 2


def test_power_and_derivatives_by_wall_match_50_digits(orbits):
    """The unit of length is a metre because A = 1 and omega = pi."""
    slope = jax.jit(jax.value_and_grad(lambda pair, orbit: vijax.steady(DEVICE, orbit, pair=pair).P))
    step = mp.mpf(10) ** -12
    for cell, orbit in zip(CELLS, orbits, strict=True):
        P, grad = slope(pair_of(*cell), orbit)
        impact_unknowns, side = (
            np.asarray(orbit.impact_unknowns)[:2],
            [int(s) for s in np.asarray(orbit.sequence.side)[:2]],
        )
        with mp.workdps(DIGITS):
            assert float(P) == pytest.approx(float(mp_power(cell, impact_unknowns, side)), rel=1e-12)
            derivatives = [grad.kappa.left, grad.kappa.right, grad.r.left, grad.r.right]
            for place, derivative in enumerate(derivatives, start=1):
                moved = [list(map(mp.mpf, cell)) for _ in range(2)]
                moved[0][place] += step
                moved[1][place] -= step
                high, low = (mp_power(constants, impact_unknowns, side) for constants in moved)
                assert float(derivative) == pytest.approx(float((high - low) / (2 * step)), rel=1e-9)


@pytest.mark.long
def test_branch_along_one_wall_leads_from_equal_to_unequal_walls(orbits):
    """A direct search returns the orbit at the end of the branch. Unequal walls turn the pitchfork into a fold."""
    equal_wall_orbits = vijax.find_orbits(vijax.impact_pair(0.25, 30.0, 0.5), "LR", guesses=64)
    size = np.abs(np.asarray(equal_wall_orbits.multipliers)).max(axis=1)
    (branch,) = vijax.follow_orbits(
        equal_wall_orbits[int(size.argmin()) :][:1], "kappa_right", (30.0, 60.0), direction="up"
    )
    assert branch.ends[1] == "high"
    last = branch.orbit[-1:]
    assert float(last.pair.kappa.right[0]) == pytest.approx(60.0)
    assert float(last.pair.kappa.left[0]) == 30.0
    expected_orbits = vijax.find_orbits(vijax.impact_pair(0.25, Sides(30.0, 60.0), 0.5), "LR", guesses=64)
    distances = [
        np.abs(np.asarray(expected.impact_unknowns - last[0].impact_unknowns)).max()
        for expected in (expected_orbits[i] for i in range(len(expected_orbits)))
    ]
    assert min(distances) < 1e-9
    assert not symmetry.is_symmetric(last).any()
    dataset = vijax.branch_dataset([branch], DEVICE)
    assert float(dataset["kappa_left"]) == 30.0
    assert "kappa_right" in dataset.coords
    np.testing.assert_allclose(dataset["P"].values[0, -1], float(vijax.orbit_power(last, DEVICE)[0]), rtol=1e-12)


@pytest.mark.long
def test_curve_of_folds_along_the_stiffness_of_the_left_wall():
    pair = vijax.impact_pair(0.2, Sides(20.0, 40.0), 0.5)
    orbit = vijax.find_orbits(pair, "LR", guesses=64)
    index = int(np.abs(np.asarray(orbit.multipliers)).max(axis=1).argmin())
    settings = {"direction": "down"}
    (branch,) = vijax.follow_orbits(orbit[index : index + 1], "d", (0.13, 0.21), **settings)
    folds = [point for point in branch.points if point.kind == "fold"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (curve, *_) = vijax.follow_curves(folds[:1], "d", {"d": (0.1, 0.3), "kappa_left": (15.0, 30.0)})
    assert curve.kind == "fold"
    _, kappa = curve.values[-1]
    last = curve.orbit[-1:]
    assert float(last.pair.kappa.left[0]) == pytest.approx(kappa, rel=1e-12)
    assert float(last.pair.kappa.right[0]) == 40.0
    multipliers = np.asarray(last.multipliers)[0]
    assert np.abs(multipliers - 1).min() < 1e-6
    dataset = vijax.curve_dataset([curve])
    assert {"kappa_right", "r_left", "r_right"} < set(dataset.coords)
    assert dataset.attrs["wall"] == "soft"


@pytest.mark.parametrize("along", ["gamma", pytest.param("kappa_left", marks=pytest.mark.long)])
def test_pitchfork_starts_no_curve_along_a_parameter_that_breaks_symmetry(along):
    """Two folds meet at the pitchfork. The curve of a fold continues an orbit closed half way as the full orbit."""
    orbits = vijax.find_orbits(vijax.impact_pair(0.24, None if along == "gamma" else 40.0, 0.5), "LR", guesses=64)
    half = symmetry.close_half_way(orbits[symmetry.is_symmetric(orbits)][:1])
    kind, place = "pitchfork", (0.24, 0.0)
    message = curve_start(Point(kind, 0.24, half), place, 1e-4, ("d", along))
    assert "a pitchfork consists of two folds" in message
    assert curve_start(Point(kind, 0.24, half), place, 1e-4, ("d", "r")).orbit.sequence.mirrored.all()
    full = curve_start(Point("fold", 0.24, half), place, 1e-4, ("d", along)).orbit
    assert not np.asarray(full.sequence.mirrored).any()
    assert int(np.asarray(full.count)[0]) == 2


@pytest.mark.parametrize(
    "kappa",
    [pytest.param(None, marks=pytest.mark.long), Sides(50.0, 30.0), Sides(50.0, None)],
    ids=["rigid", "soft", "one rigid"],
)
def test_multiplier_conditions_match_the_monodromy_matrix(kappa):
    pair = vijax.impact_pair(0.3, kappa, Sides(0.4, 0.5))
    orbit = vijax.find_orbits(pair, "LR", guesses=64)[0]
    impact_unknowns = jnp.nan_to_num(orbit.impact_unknowns)
    conditions = multipliers.multiplier_conditions(pair, orbit.sequence, impact_unknowns)
    monodromy = np.asarray(multipliers.monodromy(pair, orbit.sequence, impact_unknowns))
    trace, product = np.trace(monodromy), np.linalg.det(monodromy)
    is_rigid = np.asarray(orbit.sequence.real & pair.is_rigid_at(orbit.sequence.side))
    speed = np.asarray(orbit.impact_unknowns)[is_rigid, 1]
    weight = np.prod(speed / (speed + 0.1))
    np.testing.assert_allclose(conditions.plus, weight * (1 - trace + product), rtol=1e-9)
    np.testing.assert_allclose(conditions.minus, weight * (1 + trace + product), rtol=1e-9)


def test_load_ratios_use_the_limits_of_the_impacted_wall(orbits):
    orbit = orbits[0]
    pair = jax.tree.map(lambda x: np.asarray(x)[None], orbit)
    depth, side = np.asarray(orbit.depth), np.asarray(orbit.sequence.side)
    real = side != 0
    device = vijax.Harvester(r_b=0.004, R0=Sides(0.005, 0.02))
    load = limits.load_ratios(pair, device)["penetration limit"][0]
    np.testing.assert_allclose(load[real], (depth / np.where(side > 0, 0.02, 0.005))[real], rtol=1e-14)


@pytest.mark.long
def test_orbit_closed_half_way_has_the_power_of_both_membranes():
    """Walls with equal dynamics may have different energies: the omitted half of the orbit is at the other wall."""
    pair = vijax.impact_pair(0.25, 30.0, 0.5)
    full = vijax.find_orbits(pair, "LR", guesses=64)
    full = full[symmetry.is_symmetric(full)][:1]
    half = symmetry.close_half_way(full)
    depth = float(np.asarray(full.depth)[0, 0])
    device = vijax.Harvester(V=Sides(2000.0, 500.0), R0=Sides(2 * depth, 0.9 * depth), r_b=0.5 * depth)
    expected = float(vijax.orbit_power(full, device)[0])
    assert float(vijax.orbit_power(half, device)[0]) == pytest.approx(expected, rel=1e-12)
    state = vijax.steady(device, half[0], pair=pair)
    assert float(state.P) == pytest.approx(expected, rel=1e-12)
    for kind, load in limits.load_ratios(half, device).items():
        assert load.max() == pytest.approx(limits.load_ratios(full, device)[kind].max(), rel=1e-9), kind


@pytest.mark.long
def test_branch_along_kappa_changes_both_walls_if_only_restitutions_differ():
    orbit = vijax.find_orbits(vijax.impact_pair(0.3, 50.0, Sides(0.4, 0.5)), "LR", guesses=64)
    index = int(np.abs(np.asarray(orbit.multipliers)).max(axis=1).argmin())
    (branch,) = vijax.follow_orbits(orbit[index : index + 1], "kappa", (45.0, 50.0), direction="down")
    last = branch.orbit[-1].pair
    assert float(last.kappa.left) == float(last.kappa.right) == pytest.approx(45.0)
    assert (float(last.r.left), float(last.r.right)) == (0.4, 0.5)


MIXED = vijax.impact_pair(0.3, Sides(30.0, None), Sides(0.5, 0.7))


def test_steady_state_between_a_rigid_wall_and_a_membrane_has_derivatives():
    orbits = vijax.find_orbits(MIXED, "LR", guesses=64)
    size = np.abs(np.asarray(orbits.multipliers)).max(axis=1)
    orbit = orbits[int(size.argmin())]
    device = vijax.Harvester()

    def P(pair):
        return vijax.steady(device, orbit, pair=pair)

    state = P(MIXED)
    assert int(state.status) == Status.OK
    assert float(state.P) == pytest.approx(float(vijax.orbit_power(orbits, device)[int(size.argmin())]), rel=1e-12)
    grad = jax.grad(lambda pair: P(pair).P)(MIXED)
    assert grad.kappa.right is None
    # Second derivatives use reverse mode through the residuals, where a rigid contact has duration zero.
    impact_unknowns = jnp.nan_to_num(orbit.impact_unknowns)
    gradient = jax.grad(lambda pair: shooting.residuals(pair, orbit.sequence, impact_unknowns).sum())(MIXED)
    assert np.isfinite(gradient.kappa.left)
    h = 1e-4

    def moved(**changes):
        constants = {"left": 30.0, "r_left": 0.5, "r_right": 0.7} | changes
        pair = vijax.impact_pair(0.3, Sides(constants["left"], None), Sides(constants["r_left"], constants["r_right"]))
        return float(P(pair).P)

    for name, derivative in (("left", grad.kappa.left), ("r_left", grad.r.left), ("r_right", grad.r.right)):
        value = {"left": 30.0, "r_left": 0.5, "r_right": 0.7}[name]
        difference = (moved(**{name: value + h}) - moved(**{name: value - h})) / (2 * h)
        assert float(derivative) == pytest.approx(difference, rel=1e-5)


BAD = [
    (lambda orbit: vijax.follow_orbits(orbit, "kappa", (10.0, 90.0)), "along must be kappa_left or kappa_right"),
    (lambda orbit: vijax.follow_orbits(orbit, "k", (10.0, 90.0)), "along must be k_left or k_right, of one wall"),
    (lambda orbit: vijax.follow_orbits(orbit, "r", (0.1, 0.9)), "along must be r_left or r_right"),
    (
        lambda orbit: check_plane(orbit.pair, {"kappa_left": (1.0, 2.0), "omega0_left": (1.0, 2.0)}),
        "kappa_left and omega0_left, which are the same parameter",
    ),
    (
        lambda orbit: continuation_parameter.check_along(MIXED, "kappa_right", (10.0, 90.0)),
        "a rigid wall has no kappa or omega0 or k",
    ),
    (
        lambda orbit: continuation_parameter.check_along(MIXED, "kappa", (10.0, 90.0)),
        "along must be kappa_left, of one wall",
    ),
    (
        lambda orbit: vijax.steady(DEVICE, orbit[0], pair=vijax.impact_pair(0.2, Sides(20.0, None), 0.5)),
        "pair must have walls of the orbit.s kinds",
    ),
]


@pytest.mark.parametrize(("act", "words"), BAD, ids=[words[:24] for _, words in BAD])
def test_unsupported_parameters_raise(orbits, act, words):
    orbit = jax.tree.map(lambda x: np.asarray(x)[None], orbits[0])
    with pytest.raises(ValueError, match=words):
        act(orbit)


def test_omega_changes_the_membrane_opposite_a_rigid_wall():
    omega = float(continuation_parameter.value_at(MIXED, "omega", DEVICE))
    moved = continuation_parameter.pair_at(MIXED, "omega", 2 * omega, DEVICE)
    assert float(moved.d) == pytest.approx(4 * 0.3)
    assert float(moved.kappa.left) == pytest.approx(30.0 / 2)
    assert moved.kappa.right is None


def follow_mixed_walls(right):
    """Return the branch of an attractor between a membrane and another wall, which grazes and flips."""
    pair = vijax.impact_pair(0.2, Sides(40.0, right), 0.5, 0.02)
    orbits = vijax.find_orbits(pair, "LR", guesses=256)
    size = np.abs(np.asarray(orbits.multipliers)).max(axis=1)
    index = int(np.flatnonzero((size > 0.35) & (size < 0.4))[0])
    (branch,) = vijax.follow_orbits(orbits[index : index + 1], "d", (0.16, 0.24))
    return branch


@pytest.fixture(scope="module")
def mixed_branch():
    """Return a branch between a membrane on the left and a rigid wall on the right."""
    return follow_mixed_walls(None)


def last_flip(branch):
    return [point for point in branch.points if point.kind == "flip"][-1]


@pytest.mark.long
def test_branch_of_mixed_walls_flips_where_simulations_double_their_period(mixed_branch):
    assert mixed_branch.ends == ("grazing flight", "high")
    graze, flip = mixed_branch.points
    assert (graze.kind, graze.impact_change, flip.kind) == ("grazing flight", 0, "flip")
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], vijax.orbit_impacts(flip.orbit))
    exit_phase, side = float(first.t[0] + first.duration[0]) % 2, int(first.side[0])
    distances = []
    for offset in (-2e-4, 2e-4):
        d = flip.value + offset
        pair = vijax.impact_pair(d, Sides(40.0, None), 0.5, 0.02)
        run = vijax.trajectory(pair, side * d / 2, float(first.v_out[0]), 2000, exit_phase)
        v = np.asarray(run.states.v)
        distances.append((abs(v[-1] - v[-2]), abs(v[-1] - v[-3])))
    (doubled, twice), (same, _) = distances
    assert doubled > 1e-3
    assert max(twice, same) < 1e-6


@pytest.mark.long
def test_branch_of_mixed_walls_is_the_limit_of_stiff_walls(mixed_branch):
    value, value_at_double_stiffness = (float(last_flip(follow_mixed_walls(stiff)).value) for stiff in (1e4, 2e4))
    rigid = float(last_flip(mixed_branch).value)
    assert abs(value_at_double_stiffness - rigid) < 0.6 * abs(value - rigid) < 1e-4
    assert 2 * value_at_double_stiffness - value == pytest.approx(rigid, abs=5e-7)


@pytest.mark.long
def test_displacement_after_return_matches_simulations_of_mixed_walls():
    orbits = vijax.find_orbits(MIXED, "LR", guesses=64)
    index = int(np.abs(np.asarray(orbits.multipliers)).max(axis=1).argmin())
    pair, sequence, impact_unknowns = jax.tree.map(
        lambda leaf: leaf[index], (orbits.pair, orbits.sequence, orbits.impact_unknowns)
    )
    hits = jax.tree.map(lambda leaf: np.asarray(leaf)[index], vijax.orbit_impacts(orbits))
    offsets, wait = np.array([1e-5, -1e-5]), 0.05
    for impact in (0, 1):
        onset, *_ = last_impact = [getattr(hits, name)[impact] for name in ("t", "side", "v_in", "v_out", "duration")]
        start = onset + last_impact[-1] + wait
        u, v = (
            x[0] for x in motion.states(MIXED, *(np.atleast_1d(float(x)) for x in last_impact), when=np.array([start]))
        )
        t0 = start % 2
        impacts = vijax.trajectory(MIXED, u, v + offsets, 4, t0).impacts
        ends = []
        for row in (0, 1):
            is_impact = np.asarray(impacts.side)[row] != 0
            columns = [
                np.asarray(x, float)[row][is_impact]
                for x in (
                    2.0 * np.asarray(impacts.n) + np.asarray(impacts.t),
                    impacts.side,
                    impacts.v_in,
                    impacts.v_out,
                )
            ]
            ends.append(
                motion.states(MIXED, *columns, np.asarray(impacts.duration)[row][is_impact], when=np.array([t0 + 2]))[
                    0
                ][0]
            )
        displacement = multipliers.displacement_after_return(pair, sequence, impact_unknowns, np.int32(impact), wait)
        assert float(displacement) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


@pytest.mark.long
def test_graze_at_the_rigid_wall_of_mixed_walls_has_no_grazing_switch(mixed_branch):
    graze = mixed_branch.points[0].orbit
    pair, sequence, impact_unknowns = jax.tree.map(
        lambda leaf: np.asarray(leaf)[0], (graze.pair, graze.sequence, graze.impact_unknowns)
    )
    assert grazing_switch.locate_grazing(pair, sequence, impact_unknowns, "flight") is None
    turns = jax.tree.map(np.asarray, clearances.flight_turning_points(pair, sequence, jnp.asarray(impact_unknowns)))
    assert abs(turns.clearance.min()) < 1e-12
    assert turns.wall[turns.clearance.argmin()] == 1.0


@pytest.mark.long
def test_graze_at_the_membrane_of_mixed_walls_has_a_grazing_switch():
    pair = vijax.impact_pair(0.2, Sides(40.0, None), 0.5, 0.02)
    orbits = vijax.find_orbits(pair, "LR", guesses=256)
    (branch,) = vijax.follow_orbits(orbits[:1], "d", (0.16, 0.24))
    (graze,) = [point for point in branch.points if point.kind == "grazing flight"]
    assert (graze.impact_change, graze.wall) in ((1, -1), (-1, -1))


@pytest.mark.long
def test_curves_of_mixed_walls_are_the_limit_of_stiff_walls(mixed_branch):
    def crossing(branch):
        (curve,) = vijax.follow_curves([last_flip(branch)], "d", {"d": (0.14, 0.25), "r_left": (0.45, 0.6)})
        d, r = curve.values.T
        order = np.argsort(r)
        return float(np.interp(0.53, r[order], d[order])), [point.kind for point in curve.points]

    (rigid, events), (stiff, stiff_events) = crossing(mixed_branch), crossing(follow_mixed_walls(1e4))
    assert events == stiff_events
    assert stiff == pytest.approx(rigid, abs=2e-4)


@pytest.mark.long
def test_curves_of_the_graze_and_the_flip_of_mixed_walls_meet(mixed_branch):
    curves = vijax.follow_curves(list(mixed_branch.points), "d", {"d": (0.14, 0.25), "r_left": (0.4, 0.6)})
    meeting_points = {curve.kind: [point for point in curve.points if point.kind == "flip-graze"] for curve in curves}
    assert set(meeting_points) == {"grazing", "flip"}
    np.testing.assert_allclose(meeting_points["grazing"][0].values, meeting_points["flip"][0].values, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def half_rigid():
    """Return a map of a membrane on the left and a rigid wall on the right."""
    axes = {"d": np.linspace(0.1, 0.3, 32), "kappa_left": np.geomspace(10, 100, 16)}
    return vijax.sweep(**axes, r=0.5, gamma=0.02, wall="rigid_right")


def test_device_of_a_map_with_a_rigid_wall_has_a_membrane():
    with no_cell_runs():
        device = device_of(vijax.sweep(d=[0.1, 0.3], kappa_left=[10.0, 100.0], wall="rigid_right"))
    assert float(device.omega0.left) == pytest.approx(10.0 * float(device.omega) / np.pi)
    assert np.isfinite(float(device.omega0.right))


@pytest.mark.long
def test_curves_explain_the_borders_of_a_map_with_a_rigid_wall(half_rigid):
    result = vijax.bifurcation_curves(half_rigid)
    assert result.explained == result.borders > 60
