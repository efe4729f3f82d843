"""Derivatives of impacts against 50-digit differences, stroboscopic states, and validation."""

import math

import jax
import numpy as np
import pytest

import vijax
from benchmarks.derivatives import derivatives, differences, events, relative
from vijax import Sides
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.simulation import exact_run
from vijax.simulation.trajectory import complete_trajectory

OTHER = vijax.Harmonics([1.0, 0.3])
STIFF, SOFT = 40.0, 4.0


@pytest.fixture(scope="module", params=["soft", pytest.param("rigid", marks=pytest.mark.long)])
def jets(request):
    rigid = request.param == "rigid"
    return rigid, *derivatives(rigid)


def test_first_and_second_derivatives(jets):
    _, cases, directions, first, second, _ = jets
    for i, case in enumerate(cases):
        for j, direction in enumerate(directions):
            errors = relative((first[i, j], second[i, j]), differences(case, direction))
            assert errors[0] < 1e-9, (case, direction)
            assert errors[1] < 1e-6, (case, direction)


def test_derivatives_agree_in_forward_and_reverse_mode(jets):
    rigid, _, directions, first, _, points = jets
    reverse = jax.jit(jax.vmap(jax.jacrev(events(rigid))))(points)
    pushed = np.einsum("cinp,wp->cwin", reverse, directions)
    assert np.allclose(pushed, first, rtol=1e-11, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("kappa", [50.0, None])
def test_a_hessian_equals_nested_forward_derivatives(kappa):
    def place(x):
        return vijax.trajectory(impact_pair(x[0], kappa, x[1]), 0.02, 0.3, 2, max_impacts=4).states.u[-1]

    x = np.array([0.2, 0.5])
    forward = jax.jit(jax.jacfwd(jax.jacfwd(place)))(x)
    assert np.abs(forward).min() > 1e-3
    np.testing.assert_allclose(jax.jit(jax.hessian(place))(x), forward, rtol=1e-9)


@pytest.mark.parametrize("kappa", [pytest.param(50.0, marks=pytest.mark.long), None])
def test_derivatives_of_a_few_starts_agree_with_differences(kappa):
    def outputs(d, r, v):
        run = vijax.trajectory(impact_pair(d, kappa, r), 0.02, v, 4)
        return run.states.u[:, -1], run.impacts.v_in[:, 2]

    x = np.array([0.2, 0.25]), np.array([0.5, 0.6]), np.array([0.3, 0.31])
    h = 1e-5
    forward, reverse = (derivative(outputs, argnums=(0, 1, 2))(*x) for derivative in (jax.jacfwd, jax.jacrev))
    for which in range(3):
        near = [outputs(*(a + n * h * (k == which) for k, a in enumerate(x))) for n in (-2, -1, 1, 2)]
        for place, (far, close, on, away) in enumerate(zip(*near, strict=True)):
            differences = np.asarray(far - 8 * close + 8 * on - away) / (12 * h)
            for slopes in (forward, reverse):
                # A start does not depend on other starts.
                np.testing.assert_allclose(slopes[place][which], np.diag(differences), rtol=1e-7, atol=1e-9)


@pytest.mark.long
def test_sums_that_mask_the_padding_have_derivatives():
    """0 times NaN remains within the padding, in both modes."""

    def masked(v, transform=lambda f: f):
        def total(v):
            run = vijax.trajectory(impact_pair([0.2, 0.25], 50.0, [0.5, 0.6]), 0.02, v, 4, max_impacts=3)
            impacts, states = run.impacts, run.states
            squares = jax.numpy.where(impacts.side != 0, impacts.v_in**2, 0.0).sum()
            return squares + jax.numpy.where(jax.numpy.isfinite(states.u), states.u**2, 0.0).sum()

        return transform(total)(v)

    v, h = np.array([0.3, 0.31]), 1e-6
    assert np.isnan(vijax.trajectory(impact_pair(0.2, 50.0, 0.5), 0.02, 0.3, 4, max_impacts=3).states.u).any()
    quotient = [(masked(v + h * row) - masked(v - h * row)) / (2 * h) for row in np.eye(2)]
    np.testing.assert_allclose(masked(v, jax.grad), quotient, rtol=1e-6)


def test_a_restart_from_a_stroboscopic_state_continues_the_motion():
    pair = impact_pair([0.2, 0.2, 0.15], [4.0, 40.0, 12.0], [0.5, 0.5, 0.1], [0.0, 0.05, 0.1])
    complete = vijax.trajectory(pair, 0.02, 0.3, 6)
    in_flight = np.asarray(complete.states.mode[:, 2] == 0)
    # The same number of periods, so that one program serves both.
    again = vijax.trajectory(pair, complete.states.u[:, 2], complete.states.v[:, 2], 6)
    assert np.allclose(again.states.u[in_flight, :3], complete.states.u[in_flight, 3:], rtol=0, atol=1e-11)
    assert np.allclose(again.states.v[in_flight, :3], complete.states.v[in_flight, 3:], rtol=0, atol=1e-10)
    # In a contact, position and velocity also specify the state.
    assert np.allclose(again.states.u[:, :3], complete.states.u[:, 3:], rtol=0, atol=1e-10)
    assert np.all(np.asarray(complete.status) == Status.OK)


def test_starts_may_be_lists():
    pair = impact_pair(0.2, 12.0, 0.5)
    listed = vijax.trajectory(pair, [0.0, 0.01], (0.3, 0.4), 2, t0=[0.0, 0.5])
    arrays = vijax.trajectory(pair, np.array([0.0, 0.01]), np.array([0.3, 0.4]), 2, t0=np.array([0.0, 0.5]))
    jax.tree.map(np.testing.assert_array_equal, listed, arrays)
    with pytest.raises(ValueError, match="v0 must be a real number or an array of them; got"):
        vijax.trajectory(pair, 0.0, [0.3, "fast"], 2)


@pytest.mark.parametrize(
    ("kappa", "dtype", "periods"), [(40.0, "float64", 6), (None, "float32", 6), (40.0, "float64", 900)]
)
def test_the_program_compiled_in_the_background_is_the_required_program(monkeypatch, kappa, dtype, periods):
    compiled, needed, strobes = [], [], exact_run.balls_at
    monkeypatch.setattr(exact_run, "start_compilation", lambda work, rows: compiled.append(rows))
    monkeypatch.setattr(exact_run, "balls_at", lambda rows: needed.append(rows) or strobes(rows))
    pair = jax.tree.map(lambda x: np.asarray(x, dtype), impact_pair(0.2, kappa, 0.5))
    vijax.trajectory(pair, np.zeros(8, dtype), np.full(8, 0.3, dtype), periods)
    (rows,), first = compiled, needed[0]
    shapes = (jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), states) for states in (rows, first))
    assert next(shapes) == next(shapes)


def test_too_few_impacts_are_reported():
    pair = impact_pair(0.2, 40.0, 0.5)
    short = vijax.trajectory(pair, 0.02, 0.3, 4, max_impacts=2)
    assert int(short.status) == Status.EVENT_BUDGET
    assert int(short.filled) == 2
    assert np.isnan(np.asarray(short.states.u))[-1]


@pytest.mark.long
def test_complete_trajectories_record_all_impacts_of_a_chatter():
    pair = impact_pair(0.117, None, 0.676, 0.952)
    for excitation in (None, OTHER):
        assert int(vijax.trajectory(pair, 0.0, 0.3, 8, excitation=excitation).status) == Status.EVENT_BUDGET
        run = complete_trajectory(pair, 0.0, 0.3, 8, excitation=excitation)
        expected = vijax.trajectory(pair, 0.0, 0.3, 8, max_impacts=2000, excitation=excitation)
        assert int(run.status) == int(expected.status) == Status.OK
        assert int(run.filled) == int(expected.filled) > 16 * 8 + 16


@pytest.mark.parametrize("excitation", [None, OTHER], ids=["sine", "harmonics"])
@pytest.mark.parametrize(
    ("kappa", "u0", "v0"),
    [
        (None, 0.0, 0.9),
        (None, 0.05, 0.0),  # at rest on the wall
        (STIFF, 0.0, 0.9),
        (STIFF, 0.06, 0.1),  # in contact
        (SOFT, 0.0, 0.9),  # the last contact outlasts the run
    ],
)
def test_the_status_reports_unrecorded_impacts(kappa, u0, v0, excitation):
    """Tested for all numbers of recorded impacts, with the ball in flight or in contact at the start."""

    def run(most):
        return vijax.trajectory(impact_pair(0.1, kappa, 0.7), u0, v0, 2, max_impacts=most, excitation=excitation)

    complete = run(60)
    count = int(complete.filled)
    assert int(complete.status) == Status.OK
    for most in range(1, count + 2):
        cut = run(most)
        assert int(cut.filled) == min(most, count)
        assert int(cut.status) == (Status.EVENT_BUDGET if most < count else Status.OK)
        np.testing.assert_array_equal(cut.impacts.t[: int(cut.filled)], complete.impacts.t[: int(cut.filled)])


@pytest.mark.long
def test_a_contact_without_exit_does_not_count_as_no_impact():
    kappa, r = Sides(0.75266, 0.72614), Sides(0.0298176, 0.9945921)
    u0, v0, t0, gamma = 0.00223157, 0.72340384, 1.66827912, -1.245353
    pair = impact_pair(0.004022929988, kappa, r, gamma)
    image = impact_pair(0.004022929988, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    for excitation in (None, vijax.Harmonics([1.0, 0.0])):
        # The ball leaves after 4.3 periods.
        for periods in (1, 4):
            for run in (
                vijax.trajectory(pair, u0, v0, periods, t0, excitation=excitation),
                vijax.trajectory(image, -u0, -v0, periods, t0 - 1, excitation=excitation),
            ):
                assert int(run.filled) == 0
                assert int(run.status) == Status.OK


def test_the_status_no_impact_requires_a_ball_in_flight():
    """Unequal walls, gravity above the forcing, starts in both walls, and the mirror image of each case."""
    draw, count, periods = np.random.default_rng(3), 64, 2
    d = np.exp(draw.uniform(np.log(0.003), np.log(3.0), count))
    gamma = draw.uniform(1.0, 1.5, count) * draw.choice([-1, 1], count)
    a, b = (
        (np.exp(draw.uniform(np.log(0.2), np.log(10.0), count)), draw.uniform(0.02, 0.995, count)) for _ in range(2)
    )
    u0, v0 = draw.choice([-1, 0, 1], count) * (0.5 * d + draw.uniform(0, 0.01, count)), draw.uniform(-1, 1, count)
    pairs = [
        impact_pair(d, Sides(first[0], second[0]), Sides(first[1], second[1]), sign * gamma)
        for sign, first, second in ((1, a, b), (-1, b, a))
    ]
    for excitation in (None, vijax.Harmonics([1.0, 0.0])):
        runs = [
            vijax.trajectory(pair, sign * u0, sign * v0, periods, t0, excitation=excitation)
            for sign, t0, pair in zip((1, -1), (0.25, 1.25), pairs, strict=True)
        ]
        for run in runs:
            without_impact = (np.asarray(run.filled) == 0) & (np.asarray(run.states.mode)[:, -1] == 0)
            assert np.array_equal(np.asarray(run.status) == Status.NO_IMPACT, without_impact)
            in_contact = (np.asarray(run.filled) == 0) & (np.asarray(run.states.mode)[:, -1] != 0)
            assert (np.asarray(run.status)[in_contact] == Status.OK).any()
        # The mirror image starts half a period later, so that its last period ends half a period earlier.
        same = [np.asarray(run.impacts.v_in)[:, 0] for run in runs]
        both = np.isfinite(same).all(axis=0)
        assert both.sum() > count / 4
        np.testing.assert_allclose(same[1][both], -same[0][both], rtol=1e-9)


def test_a_ball_without_impact():
    run = vijax.trajectory(impact_pair(1.0, 40.0, 0.5), -1 / np.pi**2, 0.0, 4, max_impacts=2)
    assert int(run.status) == Status.NO_IMPACT
    assert int(run.filled) == 0
    assert np.allclose(run.states.u, -1 / np.pi**2, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"periods": 0}, "periods"),
        ({"max_impacts": 0}, "max_impacts"),
        ({"pair": ImpactPair(0.2, 40.0, 1.2, 0.0)}, "r must"),
        ({"pair": ImpactPair(-0.2, 40.0, 0.5, 0.0)}, "d must"),
        ({"pair": ImpactPair(0.2, np.inf, 0.5, 0.0)}, "kappa must"),
        ({"u0": np.nan}, "u0"),
        ({"pair": ImpactPair(0.2, None, 0.5, 0.0), "u0": 0.3}, "u0"),
    ],
)
def test_errors_name_the_invalid_argument(arguments, message):
    call = {"pair": ImpactPair(0.2, 40.0, 0.5, 0.0), "u0": 0.0, "v0": 0.3, "periods": 4} | arguments
    with pytest.raises(ValueError, match=message):
        vijax.trajectory(**call)


RELEASED = math.acos(0.196) / math.pi  # phase where the forcing equals gravity of 0.196


@pytest.mark.parametrize("kappa", [None, 3.0, math.pi * (1 - 1e-9), 40.0])
def test_a_start_at_rest_on_a_wall_is_not_an_impact(kappa):
    # If the force is zero at the start, its change decides; a flight of 1e-16 of a period is not a flight.
    phases = [0.0, 0.5, 1.0, 1.5, RELEASED, 2 - RELEASED]
    gamma, t0, r, side = (x.ravel() for x in np.meshgrid([-1.0, -0.196, 0.0, 0.196, 1.0], phases, [0.5, 1.0], [-1, 1]))
    released = (np.abs(gamma) < 1) | (r < 1)  # excluded: gravity presses the ball on an elastic wall for ever
    gamma, t0, r, side = (x[released] for x in (gamma, t0, r, side))
    pair = impact_pair(0.3, kappa, r, gamma)
    hits = vijax.trajectory(pair, 0.15 * side, 0.0, periods=1, t0=t0, max_impacts=2).impacts
    speed = np.abs(hits.v_in)
    assert np.isfinite(speed).any()
    assert not (speed < 1e-6).any()
