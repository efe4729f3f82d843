"""The exact step: 50-digit trajectories, impacts chosen in advance, invariants, and an audit for missed events."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from benchmarks.yardstick import (
    DIGITS,
    EPS,
    RIGID,
    SOFT,
    TILE,
    audit_contacts,
    audit_flights,
    compare,
    determinants,
    grazing_contacts,
    grazing_flights,
    long_contact,
    long_flight,
    march,
    mp_contact,
    newton,
    pairs,
    random_cells,
    sensitive,
    start,
)
from vijax.impact.exact import contact_search, exact_step
from vijax.model import flow
from vijax.model.pair import impact_pair
from vijax.model.records import State


@pytest.mark.parametrize("cases", [SOFT, RIGID], ids=["soft", "rigid"])
def test_reference_trajectories(cases):
    for case, errors in compare(cases):
        for name, error in errors.items():
            assert error[:4].max() < 1e-13, (case["case"], name)
            if not sensitive(case):
                assert error.max() < 1e-11, (case["case"], name)
            assert error.max() < 1e-9, (case["case"], name)


# --- impacts chosen in advance -------------------------------------------------------------------------------------


def starts_before_an_impact(rng, count, gamma_size):
    """Return impacts (side, phase, speed) and starts that reach them in a time s without a contact before."""
    many = 20 * count
    d = np.exp(rng.uniform(np.log(0.01), np.log(2), many))
    gamma = gamma_size * rng.uniform(-1, 1, many)
    side, t, s = rng.choice([-1.0, 1.0], many), rng.uniform(2, 4, many), rng.uniform(0.01, 1.5, many)
    v_in = side * 10.0 ** rng.uniform(-3, 0, many)
    back, v0 = long_flight(gamma, t, v_in, -s)
    u0 = side * d / 2 + back
    rise, _ = long_flight(*(x[:, None] for x in (gamma, t - s, v0)), s[:, None] * np.linspace(0, 1, 200)[:-1])
    good = np.nonzero((np.abs(u0[:, None] + rise) < d[:, None] / 2).all(axis=1))[0][:count]
    assert len(good) == count
    return tuple(np.asarray(x, float)[good] for x in (d, gamma, side, t, s, v_in, u0, v0))


@pytest.mark.parametrize("gamma_size", [0.0, 0.5, 2.0])
def test_impacts_chosen_in_advance_are_located(gamma_size):
    rng = np.random.default_rng(11)
    d, gamma, side, t, s, v_in, u0, v0 = starts_before_an_impact(rng, TILE, gamma_size)
    begin = np.mod(t - s, 2)
    for kappa in (np.full(TILE, 40.0), None):
        ran = march(pairs(d, kappa, 0.5, gamma), start(u0, v0, begin))
        assert np.array_equal(ran.out.impact.side[:, 0], side)
        # Rounding of the start moves the crossing by about eps over the speed.
        moved = 16 * EPS * (1 + np.abs(v0) + s) / np.abs(v_in)
        assert np.max(np.abs(ran.out.flight[:, 0] - s) / moved) < 1
        assert np.max(np.abs(ran.out.impact.v_in[:, 0] - v_in) / (moved * (1 + gamma_size))) < 1


def contact_errors(kappa, r, gamma, side, t, v, got) -> tuple[float, float, float]:
    """Return errors of duration, exit speed and depth (both relative) in 50 digits; assert w > 0 until the exit."""
    with mp.workdps(DIGITS):
        numbers = [mp.mpf(x) for x in (kappa, r, gamma, side, t, v)]
        course = lambda s: mp_contact(*numbers, s)  # noqa: E731  a function of one line, used below
        contact_duration = newton(lambda s: course(s)[:2], mp.mpf(got.duration))
        samples = int(200 + 40 * kappa * float(contact_duration) / np.pi)
        inside = [course(contact_duration * k / samples)[0] for k in range(1, samples)]
        assert min(inside) > 0, "w was back at zero before the reported exit"
        deepest = newton(lambda s: course(s)[1:], contact_duration * (inside.index(max(inside)) + 1) / samples)
        depth, v_out = course(deepest)[0], -course(contact_duration)[1]
        return (
            abs(float(got.duration / contact_duration - 1)),
            abs(float(-side * got.v_out / v_out - 1)),
            abs(float(got.depth / depth - 1)),
        )


# kappa, r, gamma, phase, speed: entries against the forcing and with it, slow and fast, at both ends of the range.
CONTACTS = [
    (400.0, 0.5, 0.0, 0.0, 1e-3),  # nine extrema
    (400.0, 0.9, 0.0, 0.0, 1e-3),
    (40.0, 0.8, 0.3, 1.9, 1e-2),
    (400.0, 0.5, 0.0, 0.3, 1e-8),
    (400.0, 0.5, 0.0, 0.9, 1e-8),
    (4.0, 0.1, 0.0, 0.7, 1e-8),
    (0.5, 0.5, 0.0, 0.3, 0.4),
    (0.5, 0.5, 0.0, 0.9, 1e-8),
    (0.5, 1.0, 0.2, 1.3, 0.2),
    (1e5, 0.5, 0.0, 0.3, 0.4),
    (1e5, 0.5, 0.0, 0.8, 1e-8),
    (1e5, 1.0, 0.2, 1.3, 0.2),
    (np.pi, 1.0, 0.0, 0.3, 0.4),
    (np.pi, 0.999, 0.0, 0.3, 0.4),
    (np.pi, 1.0, 0.0, 1.1, 1e-3),
    (12.0, 1e-8, 0.1, 0.4, 0.3),
    (12.0, 0.5, 1.4, 0.4, 0.3),  # |gamma| > 1: the ball is pushed back
]


@pytest.fixture(scope="module")
def contacts():
    """Contacts that start at their onset on the right wall."""
    kappa, r, gamma, t, v = np.array(CONTACTS).T
    return march(pairs(0.1, kappa, r, gamma), start(0.05, v, t, 1))


@pytest.mark.parametrize("k", range(len(CONTACTS)), ids=lambda k: " ".join(f"{x:g}" for x in CONTACTS[k]))
def test_contacts_against_fifty_digits(contacts, k):
    kappa, r, gamma, t, v = CONTACTS[k]
    impact = jax.tree.map(lambda x: x[k, 0], contacts.out.impact)
    assert impact.v_in == v
    errors = contact_errors(kappa, r, gamma, 1, t, v, impact)
    # After many half cycles omega1 s has lost digits, and the clock of the exact step has lost as many.
    limit = 1e-13 * max(1, 0.1 * kappa * impact.duration)
    assert errors[0] < limit
    assert errors[1] < 10 * limit
    assert errors[2] < limit


def test_a_slow_entry_at_the_top_of_the_forcing_lasts_sixty_times_longer(contacts):
    free = np.pi / (400 * np.pi / np.hypot(np.pi, np.log(0.5)))
    assert 50 < contacts.out.contact_duration[0, 0] / free < 70


def test_a_start_inside_a_soft_wall_is_not_an_impact(contacts):
    assert np.all(contacts.out.impact.side[:, 0] == 0)
    assert np.all(contacts.out.impact.side[:, 1] != 0)
    ran = march(pairs(0.2, 40.0, 0.5, 0.0), start([0.11, -0.13], [0.1, -0.2], 0.3, [1, -1]))
    assert np.all(ran.out.impact.side[:, 0] == 0)
    assert np.all(ran.out.contact_duration[:, 0] > 0)
    assert np.array_equal(ran.out.state.u[:, 0], [0.1, -0.1])


@pytest.mark.parametrize("speed", [1e-8, 1e-6, 1e-3])
def test_slow_bounces_return(speed):
    """A ball leaves a wall against the forcing: it returns at the same speed after 2 v/a, except for corrections."""
    count, side = 20, 1.0
    t = np.linspace(-0.3, 0.3, count) % 2
    for kappa in (40.0, None):
        ran = march(pairs(0.2, kappa, 0.5, 0.0), start(0.1, np.full(count, -speed), t))
        for k in range(count):
            with mp.workdps(DIGITS):
                phase, v0 = mp.mpf(t[k]), mp.mpf(-speed)
                s = mp.mpf(ran.out.flight[k, 0])

                def away(s, phase=phase, v0=v0):
                    rise = v0 * s + (mp.cospi(phase) - mp.cospi(phase + s) - mp.pi * s * mp.sinpi(phase)) / mp.pi**2
                    return rise, v0 + (mp.sinpi(phase + s) - mp.sinpi(phase)) / mp.pi

                true = newton(away, s)
                assert abs(float(s / true - 1)) < 1e-13
                assert abs(float(ran.out.impact.v_in[k, 0] / away(true)[1] - 1)) < 1e-12
        assert np.all(ran.out.impact.side[:, 0] == side)


# --- rigid walls: sticking -----------------------------------------------------------------------------------------


def test_a_chattering_ball_sticks_and_leaves_when_the_forcing_turns():
    """The ball is released from rest at cos(pi t) = gamma, at any arrival speed."""
    gamma = np.array([0.0, 0.2, -0.5, 0.0])
    side = np.array([1.0, 1.0, 1.0, -1.0])
    t = np.where(side > 0, 1.6, 0.6)
    ran = march(pairs(0.2, None, 0.3, gamma), start(side * 0.1, -side * 1e-4, t))
    for k in range(4):
        stuck = np.nonzero(ran.out.stuck[k])[0]
        assert len(stuck)
        first = stuck[0]
        release = np.arccos(side[k] * side[k] * gamma[k]) / np.pi
        release = release if side[k] > 0 else 2 - release
        assert ran.out.state.t[k, first] == pytest.approx(release, abs=4 * EPS * 2)
        assert ran.out.state.v[k, first] == 0
        assert ran.out.state.u[k, first] == side[k] * 0.1
        # After the release the next impact is at the other wall, or after a flight of finite length.
        assert ran.out.flight[k, first + 1] > 0.1
        onset = 2 * ran.out.impact.n[k, first] + ran.out.impact.t[k, first]
        assert 2 * ran.out.state.n[k, first] + ran.out.state.t[k, first] == pytest.approx(
            onset + ran.out.contact_duration[k, first], abs=1e-14
        )


def test_the_chatter_time_does_not_depend_on_the_sticking_rule():
    """The geometric series 2 v r/(a (1 - r)) of the last bounces is below the share of time that the rule neglects."""
    ran = march(pairs(0.2, None, 0.3, 0.0), start(0.1, -1e-4, 1.6))
    first = int(np.nonzero(ran.out.stuck[0])[0][0])
    speeds = np.abs(ran.out.impact.v_in[0, :first])
    assert np.allclose(speeds[1:] / speeds[:-1], 0.3, rtol=1e-2)
    assert np.abs(ran.out.impact.v_in[0, first]) * 0.3 < 1e-9


# --- gravity above the forcing -------------------------------------------------------------------------------------


def test_at_gravity_above_the_forcing_the_ball_falls_and_rests():
    """gamma 1.5 always pulls to the left: a ball at rest on the left wall stays; from the right wall it falls."""
    for kappa in (20.0, None):
        run = march(pairs(0.2, kappa, 0.5, 1.5), start(-0.1, 0.0, 0.4, -1))
        assert run.out.permanent[0, 0] or kappa is not None
        fall = march(pairs(0.2, kappa, 0.1, 1.5), start(0.1, 0.0, 0.4, 0))
        assert fall.out.impact.side[0, 0] == -1
        assert fall.out.impact.v_in[0, 0] < 0
        # The time of the fall satisfies d = distance fallen in flight.
        rise, _ = long_flight(1.5, 0.4, 0.0, fall.out.flight[0, 0])
        assert abs(float(rise) + 0.2) < 4 * EPS
        assert fall.out.permanent[0].any()
        assert not fall.out.no_impact[0].any()


def test_permanent_contact_is_reported_only_where_w_never_returns():
    kappa = np.array([20.0, 20.0, 3.0, 400.0])
    gamma = np.array([3.0, 1.2, 8.0, 1.01])
    ran = march(pairs(np.full(4, 0.2), kappa, 0.5, gamma), start(np.full(4, -0.1), -0.01, 0.4, -1))
    for k in range(4):
        end = np.inf if ran.out.permanent[k, 0] else ran.out.contact_duration[k, 0]
        s = np.linspace(0, min(30.0, end), 400001)[1:-1]
        w, _ = long_contact(kappa[k], 0.5, gamma[k], -1, 0.4, 0.0, 0.01, s)
        assert np.all(w > 0)
    assert ran.out.permanent[:, 0].any()


# --- invariants ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def soft_runs():
    pair, state = random_cells(np.random.default_rng(21), TILE, soft=True)
    return pair, march(pair, state)


@pytest.fixture(scope="module")
def rigid_runs():
    pair, state = random_cells(np.random.default_rng(22), 3 * TILE, soft=False)
    return pair, march(pair, state)


@pytest.mark.long
def test_second_derivatives_agree_in_forward_and_reverse_mode():
    def speed(x):
        zero = jnp.zeros((), jnp.int32)
        initial = State(jnp.asarray(0.02), x[1], jnp.asarray(0.3), zero, zero)
        return exact_step.step(impact_pair(0.2, x[0], 0.5), initial, jnp.asarray(6.0), deep=False, rolled=True).state.v

    x = jnp.array([50.0, 0.3])
    forward, reverse = (jax.jit(jax.jacfwd(way(speed)))(x) for way in (jax.jacfwd, jax.jacrev))
    assert np.abs(forward).min() > 1e-6
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_mirror_symmetry(soft_runs, rigid_runs):
    """Symmetry (u, t, gamma) -> (-u, t + 1, -gamma). The shift rounds the phase, so only first impacts agree."""
    for pair, ran in (soft_runs, rigid_runs):
        before = jax.tree.map(lambda x: x[:, 0], ran.before)
        # A phase on a coarse grid is exact after a shift by one.
        t = np.round(before.t * 2**40) / 2**40
        plain = march(pair, State(before.u, before.v, t, before.n, before.mode))
        turned = march(
            pairs(pair.d, pair.kappa, pair.r, -pair.gamma), start(-before.u, -before.v, np.mod(t + 1, 2), -before.mode)
        )
        original, mirrored = plain.out.impact, turned.out.impact
        distinct = np.abs(original.v_in[:, 0]) > 1e-3
        assert np.array_equal(original.side[distinct, 0], -mirrored.side[distinct, 0])
        for name in ("v_in", "v_out"):
            a, b = getattr(original, name)[distinct, 0], -getattr(mirrored, name)[distinct, 0]
            assert np.allclose(a, b, rtol=1e-11, atol=1e-12, equal_nan=True)
        for a, b in ((plain.out.flight, turned.out.flight), (plain.out.contact_duration, turned.out.contact_duration)):
            assert np.allclose(a[distinct, 0], b[distinct, 0], rtol=1e-11, atol=1e-11, equal_nan=True)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_determinant_of_the_monodromy(soft_runs, rigid_runs, steps):
    for pair, ran in (soft_runs, rigid_runs):
        with np.errstate(invalid="ignore", over="ignore"):
            error = determinants(pair, ran, steps)
        assert np.isfinite(error).sum() > TILE // 3
        assert np.nanmax(error) < 1e-11


def test_the_ball_remains_between_rigid_walls(rigid_runs):
    pair, ran = rigid_runs
    assert np.all(np.abs(ran.out.state.u) <= 0.5 * pair.d[:, None])


def test_energy_of_a_soft_contact_is_positive_and_balances(soft_runs):
    _, ran = soft_runs
    plain = (ran.out.impact.side != 0) & np.isfinite(ran.out.contact_duration)
    assert np.all(ran.out.impact.work[plain] >= 0)
    assert np.all(ran.out.impact.depth[plain] > 0)
    assert np.all(ran.out.impact.v_out[plain] * ran.out.impact.side[plain] <= 0)


# --- no missed event -----------------------------------------------------------------------------------------------


def test_no_wall_is_crossed_before_the_reported_impact(soft_runs, rigid_runs):
    for pair, ran in (soft_runs, rigid_runs):
        excursions = audit_flights(pair, ran)
        assert len(excursions) > 500
        assert np.max(excursions) < 4 * EPS


def test_no_contact_ends_before_the_exit_reported(soft_runs):
    below = audit_contacts(*soft_runs)
    assert len(below) > 500
    assert np.max(below) < 64 * EPS


@pytest.mark.parametrize("build", [grazing_flights, grazing_contacts])
def test_extrema_near_a_wall_fall_on_the_right_side(build):
    extrema = build(np.random.default_rng(31), 4 * TILE, steps=1)
    assert len(extrema.height) == 4 * TILE
    assert np.abs(extrema.height).min() < 1e-13
    assert extrema.wrong() == 0


def test_turning_points_agree_with_a_dense_scan():
    # Contacts at their exit and continued after it, also below zero: the equations of an orbit may evaluate both.
    rng = np.random.default_rng(37)
    r, gamma = rng.uniform(0.05, 0.97, TILE), rng.uniform(-1.2, 1.2, TILE)
    side, t, speed = rng.choice([-1.0, 1.0], TILE), rng.uniform(0, 2, TILE), 10.0 ** rng.uniform(-4, 0, TILE)
    length = rng.uniform(0.1, 6, TILE)
    kappa = np.minimum(10.0 ** rng.uniform(-0.3, 3.5, TILE), 250 / length)

    @jax.jit
    @jax.vmap
    def turns(pair, side, t, speed, length):
        wall, force = flow.membrane(pair), flow.contact_force(pair.gamma, side, t)
        return contact_search.turning_points(wall, force, 0 * t, speed, length > 0, contact_duration=length)

    got = jax.tree.map(np.asarray, turns(pairs(np.ones(TILE), kappa, r, gamma), side, t, speed, length))
    s = length * np.linspace(0, 1, 8192)[:, None] ** 2  # squared spacing: a slow impact turns soon after its onset
    w = long_contact(kappa, r, gamma, side, t, 0.0, speed, s)[0].astype(float)
    tops, bottoms = (way * np.where(_tops(way * w), way * w[1:-1], -np.inf).max(axis=0) for way in (1, -1))
    scale = np.abs(w).max(axis=0)
    assert not got.failed.any()
    assert (np.isfinite(tops) & np.isfinite(bottoms)).sum() > TILE // 3
    # The peaks of the scan have errors of the square of its spacing, and the scan has no peaks at its ends.
    for mine, when, expected in ((got.highest, got.crest, tops), (got.lowest, got.trough, bottoms)):
        there = np.isfinite(expected)
        assert (when[there] > 0).all()
        assert np.max(np.abs(mine[there] - expected[there]) / scale[there]) < 1e-3
        unseen = ~there & (when > 0)
        assert np.max(np.minimum(when, length - when)[unseen] / length[unseen], initial=0) < 4 / len(s)


def _tops(w):
    """Return True for the inner samples along the first axis that are higher than both neighbours."""
    return (w[1:-1] > w[:-2]) & (w[1:-1] >= w[2:])
