"""Dry friction: impacts against closed forms, sticking, tangent maps, labels, derivatives, invalid arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import vijax
from tests.impact.friction_reference import Law, follow
from vijax.impact.ode.dense_output import DenseOutput
from vijax.impact.ode.ode import Ode
from vijax.impact.ode.ode_events import detect_event
from vijax.impact.ode.ode_friction import sticking_from
from vijax.model.records import State, Status

# d, kappa, r, gamma, friction, u0, v0, and the turning points of the ball in 6 periods: reversal, or sticking.
CASES = {
    "sticks once": (0.2, 12.0, 0.5, 0.0, 0.1, 0.01, -0.4, 1),
    "from rest": (0.3, 40.0, 0.6, 0.2, 0.3, 0.0, 0.0, 0),
    "stiff": (0.25, 20.0, 0.7, 0.05, 0.5, 0.02, 0.3, 0),
    "sticks each time": (0.35, 30.0, 0.5, 0.0, 0.7, 0.05, 0.2, 11),
    "soft": (0.1, 4.0, 0.5, 0.0, 0.4, 0.02, 0.3, 0),
}
PERIODS = 6


def exactly(friction):
    return Ode("Dopri8", 1e-12, 1e-14, friction=friction)


def impacts_of(path):
    """Return impacts in the form of the reference."""
    i = jax.tree.map(lambda x: np.asarray(x)[: int(path.filled)], path.impacts)
    return np.stack([2 * i.n + i.t, i.side, i.v_in, i.v_out, i.depth, i.duration], axis=1)


@pytest.mark.parametrize("name", CASES)
def test_impacts_agree_with_closed_forms(name):
    d, kappa, r, gamma, friction, u0, v0, sticks = CASES[name]
    pair = vijax.impact_pair(d, kappa, r, gamma)
    reference = follow(Law(d, kappa, float(pair.mu), gamma, friction), u0, v0, 2 * PERIODS)
    assert reference.turnings.count(0) == sticks
    path = vijax.trajectory(pair, u0, v0, PERIODS, method=exactly(friction))
    assert path.status == Status.OK
    np.testing.assert_allclose(impacts_of(path), reference.impacts, atol=1e-11)


def test_a_ball_may_rest_within_a_membrane():
    """The spring force is 4w: friction 1.3 holds a ball up to w = 0.075; from greater depths it creeps there."""
    pair = vijax.impact_pair(0.2, 2.0, 0.5)
    shallow, deep = (vijax.trajectory(pair, u0, 0.0, 4, t0=0.5, method=exactly(1.3)) for u0 in (0.16, 0.25))
    np.testing.assert_array_equal(shallow.states.u, 0.16)
    assert (np.diff(deep.states.u) < 0).all()
    assert (np.asarray(deep.states.u) > 0.175).all()
    for path in (shallow, deep):
        assert path.status == Status.PERMANENT_CONTACT


@given(t=st.floats(0, 2), push=st.floats(-2.5, 2.5), friction=st.floats(0, 2.5))
def test_sticking_ends_when_the_drive_exceeds_friction(t, push, friction):
    drive = lambda s: np.cos(np.pi * s) + push  # noqa: E731
    assume(abs(drive(t)) <= friction)
    assume(abs(abs(push) + friction - 1) > 1e-6)  # excluded: the drive reaches the friction at its maximum only
    sticking = sticking_from(jnp.asarray(t), jnp.asarray(push), jnp.asarray(friction))
    until = min(float(sticking.duration), 2.0)
    inside = np.linspace(t, t + until, 400)[1:-1]
    assert (np.abs(drive(inside)) <= friction + 1e-12).all()
    if np.isinf(sticking.duration):
        assert (np.abs(drive(np.linspace(0, 2, 400))) <= friction + 1e-12).all()
    else:
        assert abs(drive(t + until + 1e-9)) > friction - 1e-12
        assert np.sign(drive(t + until)) == sticking.direction


def test_a_release_that_rounding_moves_into_the_past_is_immediate():
    level, friction = 0.37, 0.2
    past = np.nextafter(np.arccos(level) / np.pi, 1.0)
    sticking = sticking_from(jnp.asarray(past), jnp.asarray(-level - friction), jnp.asarray(friction))
    assert sticking.duration < 1e-15
    assert sticking.direction == -1


def test_a_ball_that_starts_and_turns_within_a_step_is_detected():
    unity = jnp.asarray(1.0)
    dense = DenseOutput(*(x * unity for x in (0.0, 0.0, 0.05, -0.05, 0.0, 0.0)))  # rest, motion, reversal at 2/3
    event = detect_event(dense, unity < 0, unity, False, unity < 0, unity)
    assert event.detected
    np.testing.assert_allclose(event.theta, 2 / 3, atol=1e-3)
    assert event.aim == 2.0


@pytest.mark.long
@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_two_solvers_record_the_same_impacts(friction):
    """Two solvers count the same impacts of 300 balls; a fifth of them start at rest."""
    rng, n = np.random.default_rng(3), 300
    d, kappa = rng.uniform(0.05, 0.4, n), np.exp(rng.uniform(1, 4.5, n))
    pair = vijax.impact_pair(d, kappa, rng.uniform(0.2, 0.9, n), rng.uniform(-0.3, 0.3, n))
    u0, v0 = rng.uniform(-0.45, 0.45, n) * d, rng.uniform(-0.6, 0.6, n)
    v0[::5] = 0
    rough, fine = (
        vijax.trajectory(pair, u0, v0, 6, method=method)
        for method in (Ode("Tsit5", 1e-8, 1e-10, friction=friction), exactly(friction))
    )
    np.testing.assert_array_equal(rough.status, fine.status)
    assert np.isin(fine.status, [Status.OK, Status.NO_IMPACT]).all()
    np.testing.assert_array_equal(rough.filled, fine.filled)
    assert np.asarray(fine.filled).sum() > 5 * n
    first = slice(0, 3)  # later impacts of chaotic motions differ
    np.testing.assert_allclose(rough.impacts.v_in[:, first], fine.impacts.v_in[:, first], atol=1e-5)


def impact_after(pair, friction, u, v, number):
    """Return the ball after a number of exits, with the tangent map to it."""
    method = exactly(friction)
    walls = method.walls(pair)
    integer_zero = jnp.asarray(0, jnp.int32)
    carry = method.start(
        pair,
        State(jnp.asarray(u), jnp.asarray(v), jnp.asarray(0.0), integer_zero, integer_zero),
        deep=True,
        tangent=True,
    )
    step = jax.jit(lambda carry: method.step(pair, walls, carry))
    total_map, stuck = np.eye(2), 0
    while number and carry.n < 10:
        before = carry
        carry, outcome, ended = step(carry)
        stuck += bool((before.slip != 0) & (carry.slip == 0))
        if ended:
            number -= 1
            total_map = np.reshape(outcome.tangent, (2, 2)) @ total_map
    return outcome.after, total_map, stuck


@pytest.mark.parametrize(
    ("d", "friction", "sticks"),
    [
        pytest.param(0.095, 0.05, 0, marks=pytest.mark.long),
        (0.095, 0.3, 2),
        pytest.param(0.2, 0.1, 1, marks=pytest.mark.long),
    ],
)
def test_tangent_maps_agree_with_differences_of_motions(d, friction, sticks):
    pair, start, h = vijax.impact_pair(d, 12.0, 0.5), np.array([0.01, -0.4]), 1e-6
    ball, tangent, stuck = impact_after(pair, friction, *start, 3)
    assert stuck == sticks
    columns = []
    for nudge in h * np.eye(2):
        ends = []
        for sign in (1, -1):
            after, _, _ = impact_after(pair, friction, *(start + sign * nudge), 3)
            # Flight back to the time at which the unperturbed ball leaves the wall.
            s = float(ball.t - after.t) + 2 * int(ball.n - after.n)
            gain = np.cos(np.pi * float(after.t)) - friction * np.sign(float(after.v))
            ends.append(np.array([after.u + after.v * s + gain * s * s / 2, after.v + gain * s]))
        columns.append((ends[0] - ends[1]) / (2 * h))
    np.testing.assert_allclose(tangent, np.stack(columns, axis=1), atol=2e-6 * np.abs(tangent).max() + 1e-8)


PLANE = {"d": [0.08, 0.2, 0.3], "kappa": [10.0, 60.0], "r": 0.5, "method": "ode"}


@pytest.mark.long
def test_orbits_of_a_sweep_agree_with_long_motions():
    plane = vijax.sweep(**PLANE, friction=0.3, outputs=("P", "period"))
    assert (plane.period == 1).all()
    later = vijax.sweep(**PLANE, friction=0.3, outputs=("P",), until="window", transient=600, periods=20)
    np.testing.assert_allclose(plane.P, later.P, rtol=1e-5)
    assert plane.attrs["friction"] == 0.3


@pytest.mark.long
def test_strong_friction_prevents_impacts_and_zero_friction_has_no_effect():
    sticking = vijax.sweep(**PLANE, friction=1.5, u0=0.0, v0=0.05, outputs=("P", "period"))
    assert (sticking.status == Status.NO_IMPACT).all()
    assert (sticking.P == 0).all()
    free, plain = (vijax.sweep(**PLANE, friction=friction, outputs=("P",)) for friction in (0.0, None))
    np.testing.assert_array_equal(free.P, plain.P)
    assert "friction" not in free.attrs


def test_a_ball_that_comes_to_rest_in_the_window_has_no_impact():
    """A fast ball between elastic walls comes to rest after five of eight periods; two of them are the transient."""
    start = {"d": 0.3, "kappa": 60.0, "r": 1.0, "u0": 0.0, "v0": 10.0, "periods": 8, "method": "ode"}
    result = vijax.sweep(**start, friction=1.05, outputs=("P", "period", "impacts_per_period"))
    assert result.status == Status.NO_IMPACT
    assert result.period == 1
    assert result.P == 0


def test_mirror_symmetry_holds_with_friction():
    pair = vijax.impact_pair(0.2, 12.0, 0.5, 0.1)
    original = vijax.trajectory(pair, 0.03, 0.2, PERIODS, method=exactly(0.2))
    mirrored = vijax.trajectory(
        vijax.impact_pair(0.2, 12.0, 0.5, -0.1), -0.03, -0.2, PERIODS, t0=1.0, method=exactly(0.2)
    )
    many = min(int(original.filled), int(mirrored.filled)) - 1
    assert many > 5
    a, b = impacts_of(original)[:many], impacts_of(mirrored)[:many]
    np.testing.assert_allclose(b, a * [1, -1, -1, -1, 1, 1] + [1, 0, 0, 0, 0, 0], atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("name", ["sticks once", pytest.param("sticks each time", marks=pytest.mark.long)])
def test_derivatives_agree_with_differences(name):
    d, kappa, r, gamma, friction, u0, v0, _ = CASES[name]

    def first(x):
        d, kappa, r, gamma, friction, u0, v0 = x
        path = vijax.trajectory(vijax.ImpactPair(d, kappa, r, gamma), u0, v0, 4, method=exactly(friction))
        last = 2 if name == "sticks once" else 0
        i = path.impacts
        return jnp.stack([i.t[last], i.v_in[last], i.depth[last], i.v_out[last]])

    x = jnp.array([d, kappa, r, gamma, friction, u0, v0])
    forward, reverse = (jax.jit(of(first))(x) for of in (jax.jacfwd, jax.jacrev))
    h, at = 1e-6, jax.jit(first)
    differences = np.stack([(at(x + h * e) - at(x - h * e)) / (2 * h) for e in np.eye(7)], axis=1)
    np.testing.assert_allclose(forward, differences, atol=1e-6 * np.abs(differences).max())
    np.testing.assert_allclose(reverse, forward, atol=1e-11 * np.abs(differences).max())


@pytest.mark.long
def test_friction_works_with_any_membrane_law():
    pair = vijax.impact_pair(0.2, 12.0, None)
    settings = {"method": "ode", "membrane": vijax.HuntCrossley(chi=0.3)}
    slow, fast = (vijax.trajectory(pair, 0.01, -0.4, 4, **settings, friction=friction) for friction in (0.2, None))
    assert int(slow.filled) > 3
    assert float(slow.impacts.v_in[0]) != float(fast.impacts.v_in[0])


def test_friction_from_a_coefficient_uses_the_normal_component_of_weight():
    device = vijax.Harvester(beta=0.3, A=5.0)
    np.testing.assert_allclose(device.friction(0.1), 0.1 * 9.8 * np.cos(0.3) / 5.0, rtol=1e-14)
    with pytest.raises(ValueError, match=r"coefficient must be finite and not negative; got -0\.1"):
        device.friction(-0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "exact", "friction": 0.1}, 'friction must be left out unless method is "ode"; got 0.1'),
        ({"method": "ode", "friction": -0.1}, "friction must be a finite number of at least 0; got -0.1"),
        ({"method": "ode", "friction": np.inf}, "friction must be a finite number of at least 0; got inf"),
    ],
)
def test_invalid_friction_is_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        vijax.sweep(d=0.2, kappa=12.0, **settings)
    with pytest.raises(ValueError, match=message):
        vijax.trajectory(vijax.impact_pair(0.2, 12.0, 0.5), 0.0, 0.3, 2, **settings)
