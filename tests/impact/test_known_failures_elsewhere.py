"""Failures reported by users of other event-driven simulators, as tests of vijax.

- Order of two events in a step: diffrax #639.
- Several crossings in one step: CyRK #98.
- Underflow of the product f(a) f(b) in a test of its sign: sundials #57.
- Gradient where an event coincides with a sample or another event: SciMLSensitivity #1447.
- A restart on the surface of an event repeats it (diffrax), or repeats steps of length zero (SciPy).
"""

from functools import cache
from typing import NamedTuple

import jax
import numpy as np
import pytest

import vijax
from benchmarks.yardstick import long_contact, long_flight
from vijax.model.records import Status

R, PERIODS = 0.5, 2
END = 2.0 * PERIODS
# The exact method bisects the bracket of a crossing at most 120 times: shorter flights are not resolved.
SHORTEST = 1e-36


class Case(NamedTuple):
    """A kind of wall, a method, and the largest error of one flight or contact; measured: 6e-16, 4e-16, 4e-5."""

    kappa: float | None
    options: dict
    bound: float


CASES = {
    "rigid": Case(None, {}, 1e-14),
    "soft": Case(40.0, {}, 1e-14),
    # With such tolerances the steps grow to their maximum, 0.25.
    "ode": Case(40.0, {"method": "ode", "rtol": 1e-5, "atol": 1e-5}, 1e-4),
}
# d, u0, v0, t0
STARTS = {
    "fast in a narrow gap, to the right": (0.01, 0.0, 3.0, 0.0),
    "fast in a narrow gap, to the left": (0.01, 0.0, -3.0, 1.0),
    # In free flight u = u0 + 2 v0 at t = 2, to the last digit: the impact coincides with a sample.
    "meets the right wall at t = 2": (2.0, -0.5, 0.75, 0.0),
    "meets the left wall at t = 2": (2.0, 0.5, -0.75, 0.0),
    # A free flight would pass the wall by 1e-3 and return 0.1 later.
    "crosses the right wall and returns": (0.0512, 0.0, 0.2251, 1.0),
    "leaves the right wall": (0.1, 0.05, -0.4, 0.0),
    "at rest on the right wall, pushed away": (0.1, 0.05, 0.0, 1.0),
    "at rest on the left wall, pushed away": (0.1, -0.05, 0.0, 0.0),
}


@cache
def trajectories(name: str) -> vijax.Trajectory:
    """Simulate all starts in one call, by one program."""
    return follow(name, *np.array(list(STARTS.values())).T)


def follow(name: str, d, u0, v0, t0) -> vijax.Trajectory:
    case = CASES[name]
    return vijax.trajectory(vijax.impact_pair(d, case.kappa, R), u0, v0, PERIODS, t0, **case.options)


def impacts(run: vijax.Trajectory, row: int) -> np.ndarray:
    """Return onset since phase 0 of period 0, side, v_in, v_out and contact duration of each impact of a row."""
    hits = jax.tree.map(np.asarray, run.impacts)
    values = np.array([2 * hits.n + hits.t, hits.side, hits.v_in, hits.v_out, hits.duration], float)
    return values[:, row, : int(run.filled[row])].T


def largest_error(name: str, row: int, start: tuple) -> float:
    """Return the largest error of the equations of all flights and contacts of a motion.

    Each flight starts at the recorded exit, stays between the walls and ends at the recorded onset; each contact stays
    inside the wall until its exit. A missed, doubled or misplaced impact is an error of the size of the gap.
    """
    kappa, run = CASES[name].kappa, trajectories(name)
    states = np.asarray(run.states.u)[row], np.asarray(run.states.v)[row]
    # A chatter on a rigid wall may have more impacts than the record can hold.
    ends = [] if run.status[row] == Status.EVENT_BUDGET else [(END, 0, 0, 0, 0)]
    d, u, v, t = start
    errors, inside = [0.0], np.linspace(0, 1, 402)[1:-1]
    for onset, side, v_in, v_out, duration in [*impacts(run, row), *ends]:
        between, _ = long_flight(0.0, t, v, (onset - t) * inside)
        errors.append(np.max(np.abs(u + between)) - d / 2)
        rise, velocity = long_flight(0.0, t, v, onset - t)
        if not side:
            errors += abs(u + rise - states[0][-1]), abs(velocity - states[1][-1])
            break
        errors += abs(u + rise - side * d / 2), abs(velocity - v_in), t - onset
        u, v, t = side * d / 2, v_out, onset + duration
        if kappa is None:
            errors.append(min(abs(v_out + R * v_in), abs(v_out) if duration else np.inf))
            continue
        contact = kappa, R, 0.0, side, onset, 0.0, side * v_in
        deep, _ = long_contact(*contact, duration * inside)
        w, z = long_contact(*contact, duration)
        errors += -np.min(deep), abs(w), abs(side * z - v_out)
        if t >= END:
            break
    return float(max(errors))


@pytest.mark.parametrize("name", CASES)
def test_events_are_processed_in_order_without_omission(name):
    """Covers diffrax #639, CyRK #98, and starts on the surface of an event."""
    errors = {start: largest_error(name, row, of) for row, (start, of) in enumerate(STARTS.items())}
    assert max(errors.values()) < CASES[name].bound


@pytest.mark.parametrize("name", CASES)
def test_coincident_impacts_on_both_walls_are_mirror_images(name):
    run, rows = trajectories(name), list(STARTS)
    bound = CASES[name].bound
    # The push at t = 2 is to the right for both: the balls reach opposite walls at one time and speed, then separate.
    right, left = (impacts(run, rows.index(f"meets the {side} wall at t = 2"))[0] for side in ("right", "left"))
    np.testing.assert_allclose(right[:3], (2, 1, 0.75), atol=bound)
    np.testing.assert_allclose(left[:3], (2, -1, -0.75), atol=bound)
    # (u, t) -> (-u, t + 1) maps the motion onto itself.
    right, left = (impacts(run, rows.index(f"fast in a narrow gap, to the {side}")) for side in ("right", "left"))
    count = 6
    mirrored = right[:count] * (1, -1, -1, -1, 1) + (1, 0, 0, 0, 0)
    np.testing.assert_allclose(left[:count], mirrored, rtol=0, atol=100 * bound)


@pytest.mark.parametrize("name", CASES)
def test_a_restart_on_the_surface_continues_the_motion(name):
    """The motion restarts from the recorded onset and the recorded exit of its first impacts."""
    row, case = list(STARTS).index("leaves the right wall"), CASES[name]
    recorded = impacts(trajectories(name), row)
    count = 3
    assert len(recorded) > count
    onset, side, v_in, v_out, duration = recorded[:count].T
    d = STARTS["leaves the right wall"][0]
    starts = np.tile(side * d / 2, 2), np.concatenate([v_in, v_out]), np.concatenate([onset, onset + duration])
    again = follow(name, d, *starts)
    for k in range(2 * count):
        # A rigid wall reverses the velocity of an onset, so a restart has an impact at once. A soft wall has a contact.
        first = k % count + (case.kappa is not None or k >= count)
        expected = recorded[first:]
        restarted = impacts(again, k)
        assert restarted.shape == expected.shape
        np.testing.assert_allclose(restarted, expected, rtol=0, atol=1000 * case.bound)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_distances_whose_product_underflows_keep_their_sign(dtype):
    """Sundials #57. The ball leaves one wall and reaches the other at once: its speeds are v r^k."""
    gaps = {"float64": [1e-20, 1e-24, 1e-30, 1e-36, 1e-60, 1e-160, 1e-200, 1e-300]}
    gaps["float32"] = [1e-12, 1e-16, 1e-20, 1e-24, 1e-28, 1e-32, 1e-36, 1e-37]
    d, zero, unity, r = (np.asarray(x, dtype) for x in (gaps[dtype], 0, 1, R))
    eps, count = np.finfo(dtype).eps, 4
    run = vijax.trajectory(vijax.impact_pair(d, None, r, zero), zero, unity, 1, zero, max_impacts=count)
    assert (run.status == Status.EVENT_BUDGET).all()
    k = np.arange(count)
    np.testing.assert_array_equal(run.impacts.side, np.tile((-1) ** k, (8, 1)))
    np.testing.assert_allclose(run.impacts.v_in, np.tile((-R) ** k, (8, 1)), rtol=16 * eps)
    times = d[:, None].astype(float) * (np.cumsum(R**-k) - 0.5)
    np.testing.assert_allclose(run.impacts.t, times, rtol=16 * eps, atol=SHORTEST)

    # From the middle, a ball with 1.1 times the required speed reaches the right wall just before it turns back,
    # because the push at t = 1 is -1: the clearances at the start and at the turn have a product of about d^2/20.
    d = np.geomspace(1e-12, 1e-30, 8).astype(dtype)
    v0 = (1.1 * np.sqrt(d)).astype(dtype)
    first = vijax.trajectory(vijax.impact_pair(d, None, r, zero), zero, v0, 1, unity, max_impacts=count).impacts
    np.testing.assert_array_equal(first.side[:, 0], np.ones(8))
    speeds = np.sqrt(v0.astype(float) ** 2 - d.astype(float))
    # The speed is exact to a rounding of v0, and of d/v_in. The varying part of the push adds O(d).
    np.testing.assert_allclose(first.v_in[:, 0], speeds, rtol=64 * eps + 1e-11)


def test_speeds_whose_product_underflows_keep_their_sign():
    """Sundials #57. A ball that moves into the wall at its start has an impact at once, at any speed."""
    speeds = np.array([1e-8, 1e-30, 1e-100, 1e-162, 1e-200, 1e-300])
    d, side = 0.1, np.resize([1, -1], 6)
    # At t = 1 the push is to the left: on either wall it points towards the wall.
    t0 = np.where(side > 0, 0.0, 1.0)
    speeds, side, t0 = (np.resize(x, 8) for x in (speeds, side, t0))
    hits = follow("rigid", d, side * d / 2, side * speeds, t0).impacts
    np.testing.assert_array_equal(hits.side[:, 0], side)
    np.testing.assert_allclose(hits.t[:, 0], t0, rtol=0, atol=SHORTEST)
    np.testing.assert_allclose(hits.v_in[:, 0], side * speeds, rtol=1e-14, atol=SHORTEST)
    # A velocity that underflows in any product has the effect of velocity zero in flight.
    v0 = np.array([0.0, 1e-100, -1e-100, 1e-162, -1e-162, 1e-300, -1e-300, 5e-324])
    run = follow("rigid", d, 0.0, v0, 0.0)
    for values in (run.impacts.t, run.impacts.v_in, run.states.u):
        np.testing.assert_allclose(values, np.tile(values[0], (8, 1)), rtol=0, atol=1e-12)


def test_gradients_at_coincident_times_equal_saltation():
    """SciMLSensitivity #1447: impacts at the time of a sample, on both walls at once, and at the start.

    The third ball starts on the right wall and moves into it at t = 0: it has the impacts of the first ball, 2 earlier.
    """
    d, u0, v0 = np.array([2.0, 2.0, 2.0]), np.array([-0.5, 0.5, 1.0]), np.array([0.75, -0.75, 0.75])

    def displacement(d, u0, v0, r):
        return vijax.trajectory(vijax.impact_pair(d, None, r), u0, v0, PERIODS, max_impacts=4).states.u.sum(axis=0)

    _, pullback = jax.vjp(displacement, d, u0, v0, np.full(3, R))
    at_impact, later = (pullback(row) for row in jax.numpy.eye(2))
    path = trajectories("rigid")
    for row, when in enumerate([2.0, 2.0, 0.0]):
        name = "meets the {} wall at t = 2".format("left" if row == 1 else "right")
        hits = impacts(path, list(STARTS).index(name)) - (2.0 - when, 0, 0, 0, 0)
        derivative, by_r, t = np.eye(2), np.zeros(2), 0.0
        for onset, _, v_in, _, _ in hits[hits[:, 0] < END]:
            flight = np.array([[1, onset - t], [0, 1]])
            push = np.cos(np.pi * onset)
            saltation = np.array([[-R, 0], [(1 + R) * push / v_in, -R]])
            derivative, by_r, t = saltation @ flight @ derivative, saltation @ flight @ by_r - (0, v_in), onset
        flight = np.array([[1, END - t], [0, 1]])
        derivative, by_r = flight @ derivative, flight @ by_r
        derivatives = [float(by[row]) for by in later]
        side = np.sign(hits[0, 1])
        # A common shift of ball and wall shifts the motion.
        expected = (0.5 * side * (1 - derivative[0, 0]), *derivative[0], by_r[0])
        np.testing.assert_allclose(derivatives, expected, rtol=1e-10, err_msg=name)
    # At the sample there are two one-sided derivatives: of the motion before the impact and after it.
    for row in (0, 1):
        derivatives = [float(by[row]) for by in at_impact[1:3]]
        assert any(np.allclose(derivatives, values, rtol=1e-10) for values in ([1.0, 2.0], [-R, -2 * R]))
