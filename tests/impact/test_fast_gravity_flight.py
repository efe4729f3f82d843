"""The fast step with gravity: its certified results are right at any gamma, and on planes most steps are certified."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from benchmarks import yardstick
from benchmarks.yardstick import (
    EPS,
    certified_contact_violations,
    certified_flight_violations,
    long_contact,
    long_flight,
    mp_flight,
    pairs,
)
from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.gravity_regime import GravityRegime, gravity_regime_of
from vijax.impact.impact import BallState

COUNT = 4096
SLOPES = [0.0, 1e-12, -1e-12, 0.01, 0.1, -0.3, 0.5, -0.7, 0.9, -0.99, 1.0, -1.5]
# Least share of certified steps of balls on planes, slightly below the measured share.
MIN_CERTIFIED = {0.0: 0.97, 0.1: 0.98, -0.3: 0.975, 0.5: 0.965}


@jax.jit
def step_at_strong_gravity(pair, ball):
    wall = fast_walls.prepare_walls(pair, gravity_regime=GravityRegime.STRONG)
    outcome = fast_step.fast_step(wall, pair.gamma, ball, tangent=True)
    return outcome.impact, outcome.arrival, outcome.certified


@jax.jit
def step_without_gravity(pair, ball):
    outcome = fast_step.fast_step(fast_walls.prepare_walls(pair), pair.gamma, ball)
    return outcome.impact, outcome.arrival, outcome.certified


@jax.jit
def deep_step(pair, ball):
    wall = fast_walls.prepare_walls(pair, gravity_regime=GravityRegime.STRONG)
    outcome = fast_step.fast_step(wall, pair.gamma, ball, deep=True, work=True)
    return outcome.impact, outcome.arrival, outcome.certified


def balls(u, v, t):
    return BallState(*(jnp.asarray(np.resize(x, COUNT), float) for x in (u, v, t, 0.0)))


def take_step(pair, u, v, t, step=step_at_strong_gravity):
    """Return impacts, arrivals and certificates of starts, in the one shape that is compiled."""
    assert np.size(u) == COUNT
    return jax.tree.map(np.asarray, step(jax.tree.map(jnp.asarray, pair), balls(u, v, t)))


def after_impacts(rng):
    pair, ball = yardstick.after_impacts(rng, COUNT, SLOPES)
    return pair, *ball


def near_grazes(rng):
    """Return flights with a turning point 1e-14 to 1e-2 on either side of a wall, constructed backwards in time."""
    gamma, turn = rng.choice(SLOPES, 4 * COUNT), rng.uniform(2, 4, 4 * COUNT)
    reach = rng.uniform(0.02, 1.8, gamma.size)
    back, v = (x.astype(float) for x in long_flight(gamma, turn, 0.0, -reach))
    off = rng.choice([-1, 1], gamma.size) * 10 ** rng.uniform(-14, -2, gamma.size)
    wall = rng.choice([-1, 1], gamma.size)
    across = rng.random(gamma.size) < 0.5
    d = np.where(across, np.abs(back) - off, rng.uniform(0.05, 0.5, gamma.size))
    u = np.where(across, 0.5 * d * np.sign(back), wall * (0.5 * d + off) + back)
    good = np.flatnonzero((d > 1e-2) & (np.abs(u) <= 0.5 * d))[:COUNT]
    d, gamma, u, v, t = (x[good] for x in (d, gamma, u, v, (turn - reach) % 2))
    return pairs(d, np.full(COUNT, 40.0), 0.5, gamma), u, v, t


@pytest.fixture(scope="module", params=[after_impacts, near_grazes])
def steps(request):
    """Starts and the results of the fast step."""
    start = request.param(np.random.default_rng(3))
    return request.param, *start, *take_step(*start)


def test_no_crossing_precedes_a_certified_crossing(steps):
    kind, pair, u, v, t, _, arrival, _ = steps
    certified = arrival.certified
    assert certified.mean() > {after_impacts: 0.8, near_grazes: 0.3}[kind]
    assert np.max(certified_flight_violations(pair, (u, v, t), arrival)) < 16 * EPS


def test_a_certified_flight_ends_at_the_wall_with_the_speed_there(steps):
    _, pair, u, v, t, _, arrival, _ = steps
    certified = arrival.certified
    rise, speed = long_flight(pair.gamma[certified], t[certified], v[certified], arrival.flight[certified])
    place = arrival.side[certified] * (u[certified] + rise)
    assert np.max(np.abs(place - pair.d[certified] / 2)) < 1e-14
    assert np.max(np.abs(arrival.side[certified] * speed - arrival.speed[certified])) < 1e-14
    assert np.all(arrival.speed[certified] > 0)


def test_no_exit_precedes_a_certified_exit(steps):
    kind, pair, _, _, _, hit, _, certified = steps
    if kind is near_grazes:
        certified = certified & (np.arange(COUNT) < 512)
    assert certified.mean() > (0.03 if kind is near_grazes else 0.5)
    # Relative to the small depth of a slow hop, the rounding of its end is larger.
    assert np.max(certified_contact_violations(pair, hit, certified)) < 1e-9
    cell, hit = jax.tree.map(lambda x: x[certified], (pair, hit))
    state = (cell.kappa, cell.r, cell.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, hit.duration)
    w, rate = long_contact(*state)
    assert np.max(np.abs(w)) < 1e-14
    assert np.max(np.abs(rate - hit.side * hit.v_out)) < 1e-12


def test_gravity_prolonged_contacts_are_certified():
    """Gravity presses a slow ball on a stiff membrane; the ball leaves when the forcing exceeds gravity."""
    rng = np.random.default_rng(4)
    kappa, gamma = rng.uniform(30, 300, COUNT), rng.uniform(0.3, 0.9, COUNT)
    pair = pairs(np.full(COUNT, 0.2), kappa, 0.5, gamma)
    u, v, t = np.full(COUNT, -0.1), rng.uniform(0.05, 0.9, COUNT) / kappa, rng.uniform(0.5, 1.2, COUNT)
    hit, _, certified = take_step(pair, u, v, t)
    long = hit.duration * kappa > 12
    assert (certified & long).mean() > 0.1
    cell, late = jax.tree.map(lambda x: x[certified & long][:256], (pair, hit))
    decay = np.log(2) / np.hypot(np.pi, np.log(2)) * cell.kappa
    omega1 = np.sqrt(cell.kappa**2 - decay**2)
    h = np.exp(-decay * late.duration) * np.sin(omega1 * late.duration) / omega1
    assert np.max(np.abs(late.tangent[2] + cell.kappa**2 * h)) < 1e-10
    assert np.max(certified_contact_violations(cell, late, np.ones(late.side.size, bool))) < 1e-9


# Gap, stiffness, restitution, slope, speed off the wall and phase of slow hops. The next contact ends early, although
# the steady response alone would extend it tenfold. The early turn of the forcing distinguishes it from a long contact.
NEARLY_LONG = [
    (
        0.09769151101812427,
        8.983241475600678,
        0.4774772566022934,
        -0.9504588500865234,
        0.00464474098489999,
        0.801595990986,
    ),
    (0.18499865226534512, 17.887727440505305, 0.5850326532550695, 0.9448425881764022, 0.01871693440651, 1.718001376041),
    (0.059136088117309124, 7.066155106384688, 0.5049333049239175, 0.9608683519930614, 0.00639741025976, 1.788136555970),
    (0.12047851446010861, 7.700194743124476, 0.37310926302323405, -0.911603259236315, 0.00706358916863, 0.757377278949),
    (
        0.14461671539316412,
        6.345877364379319,
        0.22732226554070195,
        0.740580223108932,
        0.2443496757864018,
        1.2840452909820,
    ),
    (
        0.09382196747766709,
        14.34812188056068,
        0.24696775025768763,
        -0.8758107850090455,
        0.08954656383757936,
        0.5228460582,
    ),
]


# The same for soft walls that return a fifteenth of the speed: the contact ends early. Beyond its first minimum it
# would last three times as long.
NEARLY_THROUGH = [
    (0.1806364603711412, 1.753245446030099, 0.06515900264725029, 0.2503359712573118, 0.00119832823709, 1.8480344756086),
    (
        0.1741111303055059,
        1.649148763962492,
        0.05699372768707366,
        -0.2379354556810591,
        0.02451526696121,
        0.7437774940658,
    ),
    (
        0.1482849772290655,
        1.840305057433640,
        0.07000360978359962,
        -0.3267056297901997,
        0.00251900292992,
        0.7678838675564,
    ),
    (
        0.1370349825961795,
        1.694805573084724,
        0.07641313428401897,
        -0.2197116578437022,
        0.00708611996220,
        0.7664016963788,
    ),
    (
        0.2359122956262592,
        1.744218917399056,
        0.06856935377344796,
        -0.2574120859016283,
        0.27017760699591,
        0.9386880826061,
    ),
    (
        0.2919486893086132,
        1.514772938110213,
        0.07535951967645819,
        0.24765181935945250,
        0.05165070101440,
        1.6060727886461,
    ),
    (
        0.1173583211072449,
        1.534176200389585,
        0.06838918483132826,
        0.21239559057598150,
        0.01171436966984,
        1.7073110606103,
    ),
    (
        0.2051868072250058,
        1.627288021978345,
        0.05918528492203827,
        0.26792674408244520,
        0.00102540081111,
        1.7280903879169,
    ),
]


def test_a_contact_that_gravity_nearly_prolongs_is_not_certified_as_long():
    rng = np.random.default_rng(5)
    d, r, t = rng.uniform(0.05, 0.3, COUNT), rng.uniform(0.05, 0.98, COUNT), rng.uniform(0, 2, COUNT)
    kappa, speed = np.exp(rng.uniform(np.log(3.2), np.log(60), COUNT)), np.exp(rng.uniform(-7, -1.2, COUNT))
    gamma = rng.uniform(0.2, 1.5, COUNT) * rng.choice([-1, 1], COUNT)
    for column, values in zip((d, kappa, r, gamma, speed, t), np.transpose(NEARLY_LONG + NEARLY_THROUGH), strict=True):
        column[: values.size] = values
    pair, side = pairs(d, kappa, r, gamma), -np.sign(gamma)
    hit, _, certified = take_step(pair, 0.5 * side * d, -side * speed, t)
    assert certified.mean() > 0.3
    assert (certified & (hit.duration * kappa > 5)).mean() > 0.05
    assert np.max(certified_contact_violations(pair, hit, certified)) < 1e-9


@pytest.mark.parametrize("gamma", MIN_CERTIFIED)
def test_most_steps_on_planes_are_certified(gamma):
    rng = np.random.default_rng(5)
    kappa = np.exp(rng.uniform(np.log(3), np.log(400), COUNT))
    pair = pairs(rng.uniform(0.05, 0.3, COUNT), kappa, 0.5, gamma)
    u, v, t = np.zeros(COUNT), np.full(COUNT, 0.4), np.zeros(COUNT)
    shares = []
    for _ in range(12):
        hit, _, certified = take_step(pair, u, v, t)
        shares.append(certified.mean())
        # A rejected step restarts at another place.
        u, v, t = (
            np.where(certified, x, y) for x, y in zip((hit.after.u, hit.after.v, hit.after.t), (0.0, v, t), strict=True)
        )
    assert np.mean(shares[4:]) > MIN_CERTIFIED[gamma]


def gravity_contacts(rng):
    """Return slow balls that gravity presses on a membrane, in contact for up to dozens of swings."""
    kappa, r = np.exp(rng.uniform(np.log(5), np.log(300), COUNT)), rng.uniform(0.1, 0.95, COUNT)
    pair = pairs(np.full(COUNT, 0.2), kappa, r, rng.uniform(0.2, 1.2, COUNT))
    return pair, np.full(COUNT, -0.1), np.exp(rng.uniform(-7, 0, COUNT)) / np.sqrt(kappa), rng.uniform(0, 2, COUNT)


@pytest.mark.parametrize(("kind", "least", "tolerance"), [(after_impacts, 0.45, 1e-6), (gravity_contacts, 0.25, 1e-3)])
def test_depth_and_work_of_certified_contacts(kind, least, tolerance):
    """Samples miss depth and work between them, more so for a contact of dozens of swings than for one swing."""
    pair, u, v, t = kind(np.random.default_rng(6))
    hit, _, certified = take_step(pair, u, v, t, deep_step)
    assert certified.mean() > least
    if kind is gravity_contacts:
        certified = certified & (hit.duration * pair.kappa > 9)
        assert certified.mean() > 0.03
    few = np.flatnonzero(certified)[: 64 if kind is after_impacts else 512]
    cell, hit = jax.tree.map(lambda x: x[few, None], (pair, hit))
    # Some contacts after impacts and all gravity-prolonged contacts swing dozens of times.
    s = hit.duration * np.linspace(0, 1, 20001 if kind is after_impacts else 4001)
    state = (cell.kappa, cell.r, cell.gamma, hit.side, hit.onset_t, 0.0, hit.side * hit.v_in, s)
    w, rate = long_contact(*state)
    assert np.max(np.abs(w.max(axis=1) / hit.depth[:, 0] - 1)) < tolerance
    mu = 2 * -np.log(cell.r) / np.hypot(np.pi, np.log(cell.r)) * cell.kappa
    loss = (mu * np.trapezoid(rate**2, s, axis=1)[:, None] / hit.work).astype(float)
    assert np.max(np.abs(loss - 1)) < 10 * tolerance


def test_against_fifty_digits():
    pair, u, v, t = after_impacts(np.random.default_rng(7))
    _, arrival, _ = take_step(pair, u, v, t)
    with mp.workdps(50):
        for k in np.flatnonzero(arrival.certified)[:24]:
            gamma, t0, v0, u0 = (mp.mpf(float(x[k])) for x in (pair.gamma, t, v, u))
            wall, flight = mp.mpf(float(arrival.side[k] * pair.d[k])) / 2, mp.mpf(float(arrival.flight[k]))
            rise, speed = mp_flight(gamma, t0, v0, flight)
            # One Newton step from an error of 1e-15 is exact to 1e-30.
            assert abs((u0 + rise - wall) / speed) * min(1, abs(speed)) < 4e-15
            assert abs(abs(speed) - float(arrival.speed[k])) < 4e-15


def test_rigid_walls_and_single_precision_agree():
    rng = np.random.default_rng(8)
    pair, u, v, t = after_impacts(rng)
    pair = pairs(pair.d, None, pair.r, pair.gamma)
    hit, _, certified = take_step(pair, u, v, t, deep_step)
    assert certified.mean() > 0.75
    np.testing.assert_allclose(hit.v_out[certified], -(pair.r * hit.v_in)[certified], rtol=1e-14)
    arguments = jax.tree.map(lambda x: x.astype(np.float32), (pair, balls(u, v, t)))
    single, _, certain = jax.tree.map(np.asarray, deep_step(*arguments))
    both = certified & certain
    assert single.v_in.dtype == np.float32
    assert both.mean() > 0.65
    assert np.array_equal(single.side[both], hit.side[both])
    assert np.max((np.abs(single.flight - hit.flight) * np.minimum(np.abs(hit.v_in), 1))[both]) < 2e-5


def test_the_gravity_regime_follows_from_the_largest_gamma():
    assert gravity_regime_of([0.0, -0.0]) is GravityRegime.NONE
    assert gravity_regime_of([0.0, -1e-300]) is GravityRegime.WEAK
    assert gravity_regime_of([0.0, -0.9]) is GravityRegime.STRONG


def test_a_plane_along_gamma_contains_gamma_zero():
    """Cells of gamma 0 among others agree with cells of a program without gravity, except for the last digits."""
    pair, u, v, t = after_impacts(np.random.default_rng(9))
    pair = pairs(pair.d, pair.kappa, pair.r, np.where(np.arange(COUNT) % 2 == 0, 0.0, 1e-9 * pair.gamma))
    hit, _, certified = take_step(pair, u, v, t)
    level, _, certain = take_step(pairs(pair.d, pair.kappa, pair.r, 0.0), u, v, t, step_without_gravity)
    both = certified & certain
    assert both.mean() > 0.8 * certain.mean()
    assert np.array_equal(hit.side[both], level.side[both])
    for name in ("flight", "duration", "v_out"):
        difference = np.abs(getattr(hit, name) - getattr(level, name)) * np.minimum(np.abs(level.v_in), 1)
        assert np.max(difference[both & (pair.gamma == 0)]) < 1e-13, name
        assert np.max(difference[both]) < 1e-7, name
