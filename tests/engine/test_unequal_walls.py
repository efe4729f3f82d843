"""Two walls that differ: 50-digit sequences, and every impact that of a pair whose walls are as the one that is met."""

import json

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import vijax
from benchmarks.yardstick import DATA, DIGITS, HORIZON, Row, mp_march
from vijax import Sides
from vijax.batch import chain
from vijax.engine import exact, quick, quick_wall, sampled
from vijax.engine.ground import ground_of
from vijax.engine.impact import Ball
from vijax.model.records import State
from vijax.orbits import motion

CASES = json.loads((DATA / "unequal_walls.json").read_text())
LANES = 256
# Of both kinds of wall and of one each, d, kappa, r, gamma, u0, v0; the left wall first.
OWN = {
    "soft": [
        (0.2, (40.0, 9.0), (0.5, 0.8), 0.0, 0.02, 0.3),
        (0.25, (8.0, 80.0), (0.7, 0.3), 0.2, -0.05, -0.4),
        (0.15, (25.0, 25.0), (0.3, 0.6), -0.1, 0.01, 0.5),
    ],
    "rigid": [(0.3, None, (0.4, 0.7), 0.0, 0.02, 0.3), (0.25, None, (0.6, 0.5), 0.15, -0.05, -0.4)],
    "rigid_left": [(0.3, (None, 30.0), (0.6, 0.5), 0.1, 0.02, -0.3), (0.22, (None, 12.0), (0.3, 0.4), 0.0, 0.0, 0.4)],
}


def errors(case, rows):
    """Relative errors of everything that 50 digits know of the impacts of a start."""
    *numbers, u0, v0 = case
    pair = vijax.impact_pair(*(Sides(*x) if isinstance(x, tuple) else x for x in numbers))
    impacts = vijax.trajectory(pair, u0, v0, 20).impacts
    found = []
    with mp.workdps(DIGITS):
        for k, row in enumerate(rows):
            hit = jax.tree.map(lambda x, k=k: x[k], impacts)
            assert int(hit.side) == row.side
            pairs = [
                (2 * int(hit.n) + mp.mpf(float(hit.t)), row.t),
                (mp.mpf(float(hit.v_in)), row.v_in),
                (mp.mpf(float(hit.v_out)), row.v_out),
                (mp.mpf(float(hit.duration)), row.duration),
            ]
            if not pair.rigid:  # two rigid walls are lent a depth that no digits know
                pairs.append((mp.mpf(float(hit.depth)), row.depth))
            found.append([float(abs(got / want - 1)) if want else float(abs(got)) for got, want in pairs])
    return np.array(found)


@pytest.mark.parametrize("case", CASES, ids=["soft", "one rigid"])
def test_reference_trajectories(case):
    of = case["case"]
    kappa, r = (tuple(None if x is None else float(x) for x in of[name]) for name in ("kappa", "r"))
    with mp.workdps(DIGITS):
        columns = (
            [mp.mpf(row[name]) for row in case["impacts"]] for name in ("t", "side", "vin", "vout", "dmax", "tc")
        )
        rows = [Row(*row) for row in zip(*columns, strict=True)]
        found = errors((float(of["d"]), kappa, r, float(of["g"]), float(case["u0"]), float(case["v0"])), rows)
    assert found[:4].max() < 1e-13
    assert found.max() < 1e-11


@pytest.mark.parametrize("kind", OWN)
def test_own_trajectories_in_fifty_digits(kind):
    for case in OWN[kind]:
        with mp.workdps(DIGITS):
            rows, _ = mp_march(case, 8)
        found = errors(case, rows)
        assert found[:4].max() < 1e-13
        assert found.max() < 1e-11


# --- each impact is that of its wall ---------------------------------------------------------------------------------


def drawn(walls):
    """Cells whose walls differ and balls in them; the pairs whose two walls are as the left and as the right one."""
    rng = np.random.default_rng(3)
    d, gamma = rng.uniform(0.1, 0.3, LANES), np.where(np.arange(LANES) % 2, 0.3, 0.0)
    kappa = Sides(*(np.exp(rng.uniform(np.log(8), np.log(200), LANES)) for _ in range(2)))
    r = Sides(rng.uniform(0.3, 0.9, LANES), rng.uniform(0.3, 0.9, LANES))
    kappa = {"soft": kappa, "rigid": None, "rigid_right": Sides(kappa.left, None)}[walls]
    ball = Ball(
        jnp.asarray(rng.uniform(-0.45, 0.45, LANES) * d),
        jnp.asarray(rng.uniform(-0.7, 0.7, LANES)),
        jnp.asarray(rng.uniform(0, 2, LANES)),
        jnp.zeros(LANES),
    )
    pair = vijax.impact_pair(d, kappa, r, gamma)
    plain = kappa if kappa is not None else Sides(None, None)
    alike = [vijax.impact_pair(d, k, e, gamma) for k, e in ((plain.left, r.left), (plain.right, r.right))]
    return pair, alike, ball


def careful(pair, ball):
    state = State(ball.u, ball.v, ball.t, jnp.zeros(LANES, jnp.int32), jnp.zeros(LANES, jnp.int32))
    out = jax.vmap(lambda pair, state: exact.step(pair, state, jnp.asarray(HORIZON)))(pair, state)
    hit, tangent = out.impact, exact.tangent(pair, out)
    clock = 2 * hit.n.astype(float) + hit.t
    told = (clock, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *tangent.reshape(4, -1))
    return hit.side, told, hit.side != 0


def by_samples(pair, ball):
    hit, sure = sampled.sampled_step(pair, ball, deep=True, work=True, tangent=True)
    told = (2 * hit.onset_n + hit.onset_t, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *hit.tangent)
    return hit.side, told, sure


def quickly(pair, ball):
    walls = quick_wall.prepare(pair, ground=ground_of(0.3))
    hit, _, sure, _ = quick.quick_step(walls, pair.gamma, ball, deep=True, work=True, tangent=True)
    told = (2 * hit.onset_n + hit.onset_t, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *hit.tangent)
    return hit.side, told, sure


# Each step once, and each kind of wall; the other pairs are long tests.
FEW = [(careful, "soft"), (by_samples, "rigid"), (quickly, "rigid_right")]
MORE = [
    (step, walls)
    for step in (careful, by_samples, quickly)
    for walls in ("soft", "rigid", "rigid_right")
    if (step, walls) not in FEW
]


@pytest.mark.parametrize(("step", "walls"), [*FEW, *(pytest.param(*one, marks=pytest.mark.long) for one in MORE)])
def test_every_impact_is_that_of_a_pair_with_two_such_walls(step, walls):
    pair, alike, ball = drawn(walls)
    side, found, sure = jax.tree.map(np.asarray, jax.jit(step)(pair, ball))
    assert sure.mean() > 0.6
    for wall, one in zip((-1, 1), alike, strict=True):
        theirs, wanted, certain = jax.tree.map(np.asarray, jax.jit(step)(one, ball))
        here = sure & (side == wall)
        assert here.sum() > 50
        assert (theirs[here] == wall).all()
        np.testing.assert_array_equal(sure[theirs == wall], certain[theirs == wall])
        for index, (got, want) in enumerate(zip(found, wanted, strict=True)):
            if index == 4 and walls == "rigid_right" and wall == 1:
                # Beside a membrane a rigid wall lends no depth.
                assert (got[here] == 0).all()
                continue
            np.testing.assert_allclose(got[here], want[here], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("walls", ["soft", "rigid", "rigid_right"])
def test_tangent_maps_of_many_balls_at_once_are_those_of_each(walls):
    pair, _, ball = drawn(walls)

    def maps(pair, ball):
        states = State(ball.u, ball.v, ball.t, jnp.zeros(LANES, jnp.int32), jnp.zeros(LANES, jnp.int32))
        out = jax.vmap(lambda pair, state: exact.step(pair, state, jnp.asarray(HORIZON)))(pair, states)
        return exact.tangent(pair, out), jax.vmap(exact.tangent, out_axes=-1)(pair, out)

    at_once, each = jax.jit(maps)(pair, ball)
    assert np.ptp(np.asarray(each)[0, 0]) > 0.1
    np.testing.assert_allclose(at_once, each, rtol=1e-13, atol=1e-13)


def test_walls_that_are_exchanged_mirror_the_motion():
    """With gamma turned, too; half a period later. A phase that is rounded anew is not mirrored to the last bit."""
    kappa, r, gamma = Sides(12.0, 60.0), Sides(0.5, 0.7), 0.125
    turned = vijax.impact_pair(0.25, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    one = vijax.trajectory(vijax.impact_pair(0.25, kappa, r, gamma), 0.03125, 0.25, 8, t0=0.25).impacts
    other = vijax.trajectory(turned, -0.03125, -0.25, 8, t0=1.25).impacts
    count = int((np.asarray(one.side) != 0).sum()) - 2
    assert count > 8
    np.testing.assert_array_equal(one.side[:count], -np.asarray(other.side)[:count])
    assert float(one.v_in[0]) == -float(other.v_in[0])
    for name, sign in (("v_in", -1), ("v_out", -1), ("duration", 1), ("depth", 1), ("work", 1)):
        a, b = (np.asarray(getattr(x, name))[:count] for x in (one, other))
        np.testing.assert_allclose(a, sign * b, rtol=1e-11, err_msg=name)


def test_a_start_on_a_wall_that_moves_into_it_is_an_impact_where_the_wall_is_rigid():
    """A soft wall holds such a ball, in a contact that had no onset."""
    for kappa in (None, Sides(20.0, None)):
        rigid = vijax.trajectory(vijax.impact_pair(0.25, kappa, 0.5), 0.125, 0.25, 2).impacts
        assert int(rigid.side[0]) == 1
        assert float(rigid.t[0]) == pytest.approx(0, abs=1e-15)
        assert float(rigid.v_out[0]) == -0.125
    soft = vijax.trajectory(vijax.impact_pair(0.15, Sides(20.0, None), 0.5), -0.075, -0.25, 12).impacts
    assert 2 * int(soft.n[0]) + float(soft.t[0]) > 0.01


@pytest.mark.parametrize("side", [-1, 1])
def test_between_its_events_a_motion_is_that_of_the_wall_that_is_met(side):
    """Inside a wall at phase 0, and along the curve that is drawn of a contact."""
    pair = vijax.impact_pair(0.25, Sides(8.0, 20.0), Sides(0.5, 0.7))
    for name in ("u", "v"):
        mine, alike = (
            float(getattr(vijax.trajectory(one, side * 0.13, 0.0, 1, t0=1.98).states, name)[0])
            for one in (pair, pair.at(side))
        )
        assert abs(mine) > 0
        assert mine == pytest.approx(alike, rel=1e-13), name
    impact = np.array([0.3]), np.array([float(side)]), np.array([side * 0.5]), np.array([-side * 0.3]), np.array([0.1])
    mine, alike = (motion.curve(one, *impact) for one in (pair, pair.at(side)))
    np.testing.assert_allclose(mine.u, alike.u, rtol=1e-13)
    np.testing.assert_allclose(mine.v, alike.v, rtol=1e-13, atol=1e-15)


def test_a_ball_that_gravity_holds_rests_on_the_wall_below():
    pair = vijax.impact_pair([0.25, 0.25], Sides(8.0, 20.0), Sides(0.5, 0.7), [1.5, -1.5])
    mine = chain.resting(pair, jnp.zeros(2))
    for row, side in enumerate((-1, 1)):
        alike = chain.resting(pair.at(side), jnp.zeros(2))
        assert float(mine.u[row]) == pytest.approx(float(alike.u[row]), rel=1e-14)
        assert side * float(mine.u[row]) > 0.125
    hard = chain.resting(vijax.impact_pair([0.25, 0.25], Sides(8.0, None), 0.5, [1.5, -1.5]), jnp.zeros(2))
    assert float(hard.u[0]) == float(mine.u[0])
    assert float(hard.u[1]) == 0.125


def test_walls_that_are_exchanged_mirror_the_motion_to_the_last_bit_where_the_forcing_is_turned_too():
    """Of harmonics whose amplitudes change sign no phase is rounded anew, as half a period of the sine does it."""
    kappa, r, gamma = Sides(12.0, 60.0), Sides(0.5, 0.7), 0.125
    turned = vijax.impact_pair(0.25, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    shaken, opposite = (vijax.Harmonics([sign, 0.3 * sign], [0.0, 0.7]) for sign in (1.0, -1.0))
    one = vijax.trajectory(vijax.impact_pair(0.25, kappa, r, gamma), 0.03125, 0.25, 60, excitation=shaken).impacts
    other = vijax.trajectory(turned, -0.03125, -0.25, 60, excitation=opposite).impacts
    assert int((np.asarray(one.side) != 0).sum()) > 100
    for name in ("side", "v_in", "v_out"):
        np.testing.assert_array_equal(getattr(one, name), -np.asarray(getattr(other, name)), err_msg=name)
    for name in ("n", "t", "duration", "depth", "work"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
