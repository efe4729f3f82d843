"""Time-stepping methods on the cases of the exact method: accuracy, orders, events, interface, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from benchmarks.yardstick import reference_trajectories
from tests.helpers import cases
from vijax.impact.ode.ode import Ode
from vijax.impact.rk4 import Rk4
from vijax.model import flow
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import State, Status

LANES, PERIODS, MAX_IMPACTS = 8, 6, 48  # the shape of all compiled trajectories
FIELDS = ("t", "v_in", "v_out", "depth", "duration", "work")
FINE = Ode("Dopri8", 1e-10, 1e-12)
# Largest error of the first 8 impacts of the reference trajectories, about ten times the measured errors.
METHODS = {
    "exact": (None, 1e-12),
    "Dopri8": (FINE, 2e-10),
    "Tsit5": (Ode("Tsit5", 1e-8, 1e-10), 2e-6),
    "Kvaerno5": (Ode("Kvaerno5", 1e-8, 1e-10), 1e-5),
}


def follow(cases, method, t0=0.0):
    """Return trajectories of (d, kappa, r, gamma, u0, v0), padded to one shape."""
    table = np.array([[np.nan if x is None else x for x in case] for case in cases], float)
    table = np.resize(table, (LANES, 6))
    d, kappa, r, gamma, u, v = table.T
    pair = impact_pair(d, kappa, r, gamma)
    if np.isnan(r).any():
        pair = ImpactPair(pair.d, pair.kappa, None, pair.gamma)
    ran = vijax.trajectory(
        pair, u, v, PERIODS, t0, max_impacts=MAX_IMPACTS, method="exact" if method is None else method
    )
    return jax.tree.map(lambda x: np.asarray(x)[: len(cases)], ran)


def time(impacts):
    return 2 * impacts.n.astype(impacts.t.dtype) + impacts.t


@pytest.mark.parametrize("name", METHODS)
def test_first_impacts_of_the_reference_trajectories(name):
    method, tolerance = METHODS[name]
    soft = [case for case in reference_trajectories() if "tc" in case["impacts"][0]]
    cases = [[*(case["case"][key] for key in ("d", "kappa", "r", "gamma")), case["u0"], case["v0"]] for case in soft]
    ran = follow([[float(x) for x in case] for case in cases], method)
    impacts = [
        np.stack([time(ran.impacts), *(getattr(ran.impacts, name) for name in FIELDS[1:5])], axis=-1)[lane, :8]
        for lane in range(len(soft))
    ]
    for got, case in zip(impacts, soft, strict=True):
        true = np.array(
            [[float(hit[key]) for key in ("t", "vin", "vout", "dmax", "tc")] for hit in case["impacts"][:8]]
        )
        assert np.abs(got[: len(true)] - true).max() < tolerance, case["case"]


REGULAR = [(0.2, 4.0, 0.5, 0.0, 0.02, 0.3), (0.3, 8.0, 0.5, 0.05, 0.02, 0.3), (0.25, 12.0, 0.3, 0.0, 0.02, 0.3)]
# Steps per period over which the error falls from coarse values to well above rounding.
LADDERS = {
    "Bosh3": (64, 96, 144, 216),
    "Tsit5": (40, 60, 90, 135),
    "Dopri8": (20, 25, 32, 40),
    "Kvaerno5": (48, 72, 108),
}
ORDERS = {"Bosh3": 3, "Tsit5": 5, "Dopri8": 8, "Kvaerno5": 5}


def errors(method):
    """Return mean errors of the impacts against the exact method, per lane and field."""
    exact, ran = follow(REGULAR, None), follow(REGULAR, method)
    assert np.array_equal(ran.impacts.side, exact.impacts.side)
    return np.mean(
        [np.nanmean(np.abs(getattr(ran.impacts, x) - getattr(exact.impacts, x))) for x in ("t", "v_in", "v_out")]
    )


def slope(steps, sizes):
    return -np.polyfit(np.log(steps), np.log(sizes), 1)[0]


@pytest.mark.parametrize("solver", cases(LADDERS, long=("Bosh3", "Tsit5")))
def test_located_events_keep_the_order_of_the_solver(solver):
    sizes = [errors(Ode(solver, 1e-11, 1e-11, dt=2.0 / steps)) for steps in LADDERS[solver]]
    assert slope(LADDERS[solver], sizes) > ORDERS[solver] - 0.3, sizes


def test_samples_without_events_are_of_first_order():
    steps = (200, 400, 800, 1600)
    assert abs(slope(steps, [errors(Rk4(count)) for count in steps]) - 1) < 0.3


def test_samples_are_of_fourth_order_away_from_the_walls():
    steps = 64
    free = follow([(1.0, 8.0, 0.5, 0.0, -1 / np.pi**2, 0.0)], Rk4(steps))
    assert np.abs(free.states.u + 1 / np.pi**2).max() < 1e-7
    hits = follow(REGULAR, Rk4(steps)).impacts
    for time_of in (hits.t, hits.duration):
        samples = time_of[np.isfinite(time_of)] * steps / 2
        assert np.abs(samples - np.round(samples)).max() < 1e-9


# --- events -----------------------------------------------------------------------------------------------------------

COARSE = Ode("Tsit5", 1e-3, 1e-5)  # steps long enough to contain several events


def assert_agreement(cases, method, tolerance, t0=0.0, count=6):
    """Assert that the first impacts agree with the exact method, on the same walls."""
    exact, ran = follow(cases, None, t0), follow(cases, method, t0)
    for lane, case in enumerate(cases):
        assert np.array_equal(ran.impacts.side[lane, :count], exact.impacts.side[lane, :count]), case
        for name in ("t", "v_in", "v_out", "duration"):
            wrong = np.abs(getattr(ran.impacts, name) - getattr(exact.impacts, name))[lane, :count]
            assert wrong.max() < tolerance, (case, name)


def test_the_earlier_of_two_wall_crossings_in_a_step_is_located():
    # The ball crosses the gap in a fraction of the longest step.
    assert_agreement(
        [(0.01, 30.0, 0.5, 0.0, 0.004, -0.6), (0.02, 300.0, 0.9, 0.0, 0.0, 0.9), (0.005, 9.0, 0.7, 0.1, 0.0, 0.5)],
        COARSE,
        2e-2,
        count=3,
    )


@pytest.mark.parametrize("method", [FINE, METHODS["Tsit5"][0]], ids=lambda method: method.solver)
def test_turning_points_within_a_step_of_the_wall(method):
    # The ball is thrown at the right wall from a distance, so that it turns just before or just behind the wall.
    cases, t0 = [], 0.9
    for offset in (-1e-3, -1e-5, -1e-6, 1e-6, 1e-5, 1e-3):
        s, v = 0.1, 0.1  # close to v/|a|, the time of the turn
        turn = s
        for _ in range(50):
            turn -= (v + (np.sin(np.pi * (t0 + turn)) - np.sin(np.pi * t0)) / np.pi) / np.cos(np.pi * (t0 + turn))
        rise = (
            v * turn + (np.cos(np.pi * t0) - np.cos(np.pi * (t0 + turn)) - np.pi * turn * np.sin(np.pi * t0)) / np.pi**2
        )
        cases.append((0.2, 40.0, 0.5, 0.0, 0.1 - rise + offset, v))
    ran, exact = follow(cases, method, t0), follow(cases, None, t0)
    hit = ran.impacts.t[:, 0] < t0 + 2 * turn
    assert np.array_equal(hit, [False] * 3 + [True] * 3)
    assert np.allclose(time(ran.impacts)[:, 0], time(exact.impacts)[:, 0], rtol=0, atol=1e-5)


def test_two_velocity_sign_changes_in_a_step_are_detected():
    # Around t = 0.5 the acceleration changes its sign: the ball turns, enters the wall and turns again.
    cases = [(0.2, 40.0, 0.5, 0.0, 0.1 - gap, -0.004) for gap in (2e-5, 1e-4)]
    exact = follow(cases, None, 0.38)
    assert np.all(time(exact.impacts)[:, 0] < 0.7)
    ran = follow(cases, Ode("Tsit5", 1e-8, 1e-10, dt=0.25), 0.38)
    assert np.abs(ran.impacts.t[:, 0] - exact.impacts.t[:, 0]).max() < 1e-3


def test_slow_bounces_shorter_than_a_step_do_not_stop_time():
    assert_agreement([(0.2, 40.0, 0.5, 0.0, 0.1, -v) for v in (1e-3, 1e-6, 1e-9)], FINE, 1e-8, t0=1.3, count=4)
    # The forcing presses the ball against a wall; the ball leaves it slowly.
    assert_agreement([(0.2, 40.0, 0.5, 0.0, 0.1 - 1e-9, v) for v in (1e-3, 1e-6, 1e-9)], FINE, 1e-8, t0=0.1, count=4)


def test_a_start_inside_a_wall_is_a_contact_without_onset():
    cases = [(0.2, 8.0, 0.5, 0.0, 0.15, 0.1), (0.2, 8.0, 0.5, 0.0, -0.15, 0.1), (0.2, 8.0, 0.5, 0.0, 0.1, 0.2)]
    assert_agreement(cases, FINE, 1e-9)


def test_contacts_and_flights_without_end_are_reported():
    cases = [(0.2, 8.0, 0.5, 1.5, 0.0, 0.3), (1.0, 8.0, 0.5, 0.0, -1 / np.pi**2, 0.0)]
    ran, exact = follow(cases, FINE), follow(cases, None)
    assert ran.status.tolist() == exact.status.tolist() == [Status.PERMANENT_CONTACT, Status.NO_IMPACT]
    assert np.allclose(ran.states.u, exact.states.u, rtol=0, atol=1e-8)


def test_stroboscopic_states():
    ran, exact = follow(REGULAR, FINE), follow(REGULAR, None)
    assert np.array_equal(ran.states.mode, exact.states.mode)
    assert np.abs(ran.states.u - exact.states.u).max() < 1e-9
    assert np.abs(ran.states.v - exact.states.v).max() < 1e-9
    assert np.all(ran.states.t == 0)


def test_too_few_impacts_are_reported():
    pair = impact_pair(0.2, 40.0, 0.5)
    short = vijax.trajectory(pair, 0.02, 0.3, 4, max_impacts=2, method=FINE)
    assert int(short.status) == Status.EVENT_BUDGET
    assert int(short.filled) == 2
    assert np.isnan(np.asarray(short.states.u))[-1]


# --- interface of a method, step by step ------------------------------------------------------------------------------


def outcomes(method, case, count, **requested):
    """Return the first finished impacts of one start, by `start` and `step` alone."""
    d, kappa, r, gamma, u, v = (jnp.asarray(x) for x in case)
    pair, integer_zero = ImpactPair(d, kappa, r, gamma), jnp.int32(0)
    m = method.start(pair, State(u, v, jnp.zeros_like(u), integer_zero, integer_zero), **requested)
    wall = method.law.bind(pair)
    step = jax.jit(lambda m: method.step(pair, wall, m))
    results = []
    while len(results) < count:
        m, outcome, finished = step(m)
        if finished:
            results.append(outcome)
    return pair, results


def test_tangent_maps_include_flight_contact_and_saltation():
    pair, results = outcomes(FINE, (0.2, 40.0, 0.5, 0.05, 0.02, 0.3), 4, deep=True, tangent=True)
    for outcome in results:
        contact = flow.contact_matrix(flow.membrane(pair), outcome.impact.duration)
        matrix = np.asarray(contact @ flow.flight_matrix(outcome.flight))
        assert np.allclose(np.reshape(outcome.tangent, (2, 2)), matrix, rtol=0, atol=1e-9 * np.abs(matrix).max())


@pytest.mark.long
def test_requested_outputs_do_not_change_the_steps():
    case = (0.2, 40.0, 0.5, 0.05, 0.02, 0.3)
    _, plain = outcomes(FINE, case, 3, deep=False, tangent=False)
    _, rich = outcomes(FINE, case, 3, deep=False, tangent=True)
    assert [float(p.after.v) for p in plain] == [float(p.after.v) for p in rich]


# --- derivatives ------------------------------------------------------------------------------------------------------

IMPACTS = 20


def vector(method):
    """Return a function from (d, kappa, r, gamma, u0, v0) to impacts [impact, field]."""

    def run(x):
        hits = vijax.trajectory(
            ImpactPair(*x[:4]), x[4], x[5], 14, max_impacts=IMPACTS, method="exact" if method is None else method
        ).impacts
        return jnp.stack([time(hits), hits.v_in, hits.v_out, hits.depth, hits.duration, hits.work], axis=-1)

    return run


@pytest.mark.long
def test_derivatives_forward_and_reverse_over_twenty_impacts():
    x = jnp.asarray([0.2, 40.0, 0.5, 0.05, 0.02, 0.3])
    directions = jnp.eye(6)

    def forward(method):
        return np.asarray(jax.jit(jax.vmap(lambda w: jax.jvp(vector(method), (x,), (w,))[1]))(directions))

    exact, adaptive = forward(None), forward(Ode("Dopri8", 1e-11, 1e-13))
    size = np.abs(exact).max(axis=(0, 1), keepdims=True)
    assert np.isfinite(exact).all()
    assert (np.abs(adaptive - exact) / size).max() < 1e-6
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(IMPACTS, len(FIELDS))))
    tight = Ode("Dopri8", 1e-11, 1e-13)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(vector(tight)(x) * weights)))(x)
    assert np.allclose(gradient, np.einsum("wif,if->w", adaptive, weights), rtol=1e-9)
