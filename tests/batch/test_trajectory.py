"""Derivatives of impacts against 50-digit differences, stroboscopic states, and errors at the door."""

import math

import jax
import numpy as np
import pytest

import vijax
from benchmarks.derivatives import derivatives, differences, events, relative
from vijax import Sides
from vijax.batch import exact_run
from vijax.batch.trajectory import complete_trajectory
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status

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


def test_reverse_is_forward(jets):
    rigid, _, directions, first, _, points = jets
    reverse = jax.jit(jax.vmap(jax.jacrev(events(rigid))))(points)
    pushed = np.einsum("cinp,wp->cwin", reverse, directions)
    assert np.allclose(pushed, first, rtol=1e-11, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("kappa", [50.0, None])
def test_a_hessian_is_forward_derivatives_of_forward_ones(kappa):
    def place(x):
        return vijax.trajectory(impact_pair(x[0], kappa, x[1]), 0.02, 0.3, 2, max_impacts=4).states.u[-1]

    x = np.array([0.2, 0.5])
    forward = jax.jit(jax.jacfwd(jax.jacfwd(place)))(x)
    assert np.abs(forward).min() > 1e-3
    np.testing.assert_allclose(jax.jit(jax.hessian(place))(x), forward, rtol=1e-9)


@pytest.mark.parametrize("kappa", [pytest.param(50.0, marks=pytest.mark.long), None])
def test_derivatives_of_a_few_starts_at_numbers_are_those_of_differences(kappa):
    def told(d, r, v):
        run = vijax.trajectory(impact_pair(d, kappa, r), 0.02, v, 4)
        return run.states.u[:, -1], run.impacts.v_in[:, 2]

    x = np.array([0.2, 0.25]), np.array([0.5, 0.6]), np.array([0.3, 0.31])
    h = 1e-5
    forward, reverse = (derivative(told, argnums=(0, 1, 2))(*x) for derivative in (jax.jacfwd, jax.jacrev))
    for which in range(3):
        near = [told(*(a + n * h * (k == which) for k, a in enumerate(x))) for n in (-2, -1, 1, 2)]
        for place, (far, close, on, away) in enumerate(zip(*near, strict=True)):
            known = np.asarray(far - 8 * close + 8 * on - away) / (12 * h)
            for slopes in (forward, reverse):
                # No start hangs on another.
                np.testing.assert_allclose(slopes[place][which], np.diag(known), rtol=1e-7, atol=1e-9)


@pytest.mark.long
def test_sums_that_mask_the_padding_have_derivatives():
    """0 times NaN stays within the padding; both ways."""

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


def test_restarting_from_a_stroboscopic_state_goes_on_the_same():
    pair = impact_pair([0.2, 0.2, 0.15], [4.0, 40.0, 12.0], [0.5, 0.5, 0.1], [0.0, 0.05, 0.1])
    whole = vijax.trajectory(pair, 0.02, 0.3, 6)
    flying = np.asarray(whole.states.mode[:, 2] == 0)
    # Of as many periods, so that one program is compiled.
    again = vijax.trajectory(pair, whole.states.u[:, 2], whole.states.v[:, 2], 6)
    assert np.allclose(again.states.u[flying, :3], whole.states.u[flying, 3:], rtol=0, atol=1e-11)
    assert np.allclose(again.states.v[flying, :3], whole.states.v[flying, 3:], rtol=0, atol=1e-10)
    # In a contact the position and the velocity are the state as well.
    assert np.allclose(again.states.u[:, :3], whole.states.u[:, 3:], rtol=0, atol=1e-10)
    assert np.all(np.asarray(whole.status) == Status.OK)


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
def test_the_program_that_is_begun_beside_is_the_one_that_is_needed(monkeypatch, kappa, dtype, periods):
    begun, needed, strobes = [], [], exact_run.balls_at
    monkeypatch.setattr(exact_run, "begin", lambda work, rows: begun.append(rows))
    monkeypatch.setattr(exact_run, "balls_at", lambda rows: needed.append(rows) or strobes(rows))
    pair = jax.tree.map(lambda x: np.asarray(x, dtype), impact_pair(0.2, kappa, 0.5))
    vijax.trajectory(pair, np.zeros(8, dtype), np.full(8, 0.3, dtype), periods)
    (rows,), first = begun, needed[0]
    shapes = (jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), each) for each in (rows, first))
    assert next(shapes) == next(shapes)


def test_too_few_impacts_are_said():
    pair = impact_pair(0.2, 40.0, 0.5)
    short = vijax.trajectory(pair, 0.02, 0.3, 4, max_impacts=2)
    assert int(short.status) == Status.EVENT_BUDGET
    assert int(short.filled) == 2
    assert np.isnan(np.asarray(short.states.u))[-1]


@pytest.mark.long
def test_all_impacts_of_a_chatter_are_recorded_where_all_are_wanted():
    pair = impact_pair(0.117, None, 0.676, 0.952)
    for excitation in (None, OTHER):
        assert int(vijax.trajectory(pair, 0.0, 0.3, 8, excitation=excitation).status) == Status.EVENT_BUDGET
        run = complete_trajectory(pair, 0.0, 0.3, 8, excitation=excitation)
        known = vijax.trajectory(pair, 0.0, 0.3, 8, max_impacts=2000, excitation=excitation)
        assert int(run.status) == int(known.status) == Status.OK
        assert int(run.filled) == int(known.filled) > 16 * 8 + 16


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
def test_an_impact_that_is_not_recorded_is_in_the_status(kappa, u0, v0, excitation):
    """For every number of recorded impacts, the ball in flight or in contact at the start."""

    def run(most):
        return vijax.trajectory(impact_pair(0.1, kappa, 0.7), u0, v0, 2, max_impacts=most, excitation=excitation)

    whole = run(60)
    count = int(whole.filled)
    assert int(whole.status) == Status.OK
    for most in range(1, count + 2):
        cut = run(most)
        assert int(cut.filled) == min(most, count)
        assert int(cut.status) == (Status.EVENT_BUDGET if most < count else Status.OK)
        np.testing.assert_array_equal(cut.impacts.t[: int(cut.filled)], whole.impacts.t[: int(cut.filled)])


@pytest.mark.long
def test_a_ball_that_stays_in_contact_from_the_start_has_met_a_wall():
    kappa, r = Sides(0.75266, 0.72614), Sides(0.0298176, 0.9945921)
    u0, v0, t0, gamma = 0.00223157, 0.72340384, 1.66827912, -1.245353
    pair = impact_pair(0.004022929988, kappa, r, gamma)
    image = impact_pair(0.004022929988, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    for excitation in (None, vijax.Harmonics([1.0, 0.0])):
        # It leaves after 4.3 periods.
        for periods in (1, 4):
            for run in (
                vijax.trajectory(pair, u0, v0, periods, t0, excitation=excitation),
                vijax.trajectory(image, -u0, -v0, periods, t0 - 1, excitation=excitation),
            ):
                assert int(run.filled) == 0
                assert int(run.status) == Status.OK


def test_no_impact_is_that_of_balls_in_flight_however_they_are_pressed():
    """Unequal walls, a push beyond the forcing, starts in either wall: of each case its mirror image, too."""
    draw, count, periods = np.random.default_rng(3), 64, 2
    d = np.exp(draw.uniform(np.log(0.003), np.log(3.0), count))
    gamma = draw.uniform(1.0, 1.5, count) * draw.choice([-1, 1], count)
    left, right = (
        (np.exp(draw.uniform(np.log(0.2), np.log(10.0), count)), draw.uniform(0.02, 0.995, count)) for _ in range(2)
    )
    u0, v0 = draw.choice([-1, 0, 1], count) * (0.5 * d + draw.uniform(0, 0.01, count)), draw.uniform(-1, 1, count)
    pairs = [
        impact_pair(d, Sides(one[0], other[0]), Sides(one[1], other[1]), sign * gamma)
        for sign, one, other in ((1, left, right), (-1, right, left))
    ]
    for excitation in (None, vijax.Harmonics([1.0, 0.0])):
        runs = [
            vijax.trajectory(pair, sign * u0, sign * v0, periods, t0, excitation=excitation)
            for sign, t0, pair in zip((1, -1), (0.25, 1.25), pairs, strict=True)
        ]
        for run in runs:
            silent = (np.asarray(run.filled) == 0) & (np.asarray(run.states.mode)[:, -1] == 0)
            assert np.array_equal(np.asarray(run.status) == Status.NO_IMPACT, silent)
            held = (np.asarray(run.filled) == 0) & (np.asarray(run.states.mode)[:, -1] != 0)
            assert (np.asarray(run.status)[held] == Status.OK).any()
        # The mirror image begins half a period later, so that its last period ends half a period sooner.
        same = [np.asarray(run.impacts.v_in)[:, 0] for run in runs]
        both = np.isfinite(same).all(axis=0)
        assert both.sum() > count / 4
        np.testing.assert_allclose(same[1][both], -same[0][both], rtol=1e-9)


def test_a_ball_that_touches_nothing():
    quiet = vijax.trajectory(impact_pair(1.0, 40.0, 0.5), -1 / np.pi**2, 0.0, 4, max_impacts=2)
    assert int(quiet.status) == Status.NO_IMPACT
    assert int(quiet.filled) == 0
    assert np.allclose(quiet.states.u, -1 / np.pi**2, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "says"),
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
def test_bad_input_is_named(arguments, says):
    given = {"pair": ImpactPair(0.2, 40.0, 0.5, 0.0), "u0": 0.0, "v0": 0.3, "periods": 4} | arguments
    with pytest.raises(ValueError, match=says):
        vijax.trajectory(**given)


RELEASED = math.acos(0.196) / math.pi  # where gravity of 0.196 is all that acts


@pytest.mark.parametrize("kappa", [None, 3.0, math.pi * (1 - 1e-9), 40.0])
def test_a_start_at_rest_on_a_wall_is_no_impact(kappa):
    # Where the force is zero at the start, what it is about to do decides: 1e-16 of a period of flight is none.
    phases = [0.0, 0.5, 1.0, 1.5, RELEASED, 2 - RELEASED]
    gamma, t0, r, side = (x.ravel() for x in np.meshgrid([-1.0, -0.196, 0.0, 0.196, 1.0], phases, [0.5, 1.0], [-1, 1]))
    some = (np.abs(gamma) < 1) | (r < 1)  # an elastic wall that holds the ball for ever is never left
    gamma, t0, r, side = (x[some] for x in (gamma, t0, r, side))
    pair = impact_pair(0.3, kappa, r, gamma)
    hits = vijax.trajectory(pair, 0.15 * side, 0.0, periods=1, t0=t0, max_impacts=2).impacts
    speed = np.abs(hits.v_in)
    assert np.isfinite(speed).any()
    assert not (speed < 1e-6).any()
