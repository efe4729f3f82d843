"""Two walls that differ: 50-digit trajectories, and each impact equals the impact of a pair with two equal walls."""

import json

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import vijax
from benchmarks.yardstick import DATA, DIGITS, HORIZON, Row, mp_march
from vijax import Sides
from vijax.impact.exact import exact_step, sampled_step
from vijax.impact.fast import fast_step, fast_walls
from vijax.impact.gravity_regime import gravity_regime_of
from vijax.impact.impact import BallState
from vijax.model.records import State
from vijax.orbits import motion
from vijax.simulation.cell import chain

CASES = json.loads((DATA / "unequal_walls.json").read_text())
LANES = 256
# d, kappa, r, gamma, u0, v0 by the kind of the two walls; pairs of numbers have the left wall first.
CASES_BY_KIND = {
    "soft": [
        (0.2, (40.0, 9.0), (0.5, 0.8), 0.0, 0.02, 0.3),
        (0.25, (8.0, 80.0), (0.7, 0.3), 0.2, -0.05, -0.4),
        (0.15, (25.0, 25.0), (0.3, 0.6), -0.1, 0.01, 0.5),
    ],
    "rigid": [(0.3, None, (0.4, 0.7), 0.0, 0.02, 0.3), (0.25, None, (0.6, 0.5), 0.15, -0.05, -0.4)],
    "rigid_left": [(0.3, (None, 30.0), (0.6, 0.5), 0.1, 0.02, -0.3), (0.22, (None, 12.0), (0.3, 0.4), 0.0, 0.0, 0.4)],
}


def errors(case, rows):
    """Return relative errors of the results of the impacts of a start, against 50 digits."""
    *numbers, u0, v0 = case
    pair = vijax.impact_pair(*(Sides(*x) if isinstance(x, tuple) else x for x in numbers))
    impacts = vijax.trajectory(pair, u0, v0, 20).impacts
    rows_of_errors = []
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
            if not pair.rigid:  # the 50-digit motion has no depth at two rigid walls
                pairs.append((mp.mpf(float(hit.depth)), row.depth))
            rows_of_errors.append([float(abs(got / want - 1)) if want else float(abs(got)) for got, want in pairs])
    return np.array(rows_of_errors)


@pytest.mark.parametrize("case", CASES, ids=["soft", "one rigid"])
def test_reference_trajectories(case):
    of = case["case"]
    kappa, r = (tuple(None if x is None else float(x) for x in of[name]) for name in ("kappa", "r"))
    with mp.workdps(DIGITS):
        columns = (
            [mp.mpf(row[name]) for row in case["impacts"]] for name in ("t", "side", "vin", "vout", "dmax", "tc")
        )
        rows = [Row(*row) for row in zip(*columns, strict=True)]
        relative = errors((float(of["d"]), kappa, r, float(of["g"]), float(case["u0"]), float(case["v0"])), rows)
    assert relative[:4].max() < 1e-13
    assert relative.max() < 1e-11


@pytest.mark.parametrize("kind", CASES_BY_KIND)
def test_further_trajectories_in_fifty_digits(kind):
    for case in CASES_BY_KIND[kind]:
        with mp.workdps(DIGITS):
            rows, _ = mp_march(case, 8)
        relative = errors(case, rows)
        assert relative[:4].max() < 1e-13
        assert relative.max() < 1e-11


# --- an impact depends on its wall only ------------------------------------------------------------------------------


def drawn(walls):
    """Return cells with unequal walls and balls in them, and the pairs with two left walls and with two right walls."""
    rng = np.random.default_rng(3)
    d, gamma = rng.uniform(0.1, 0.3, LANES), np.where(np.arange(LANES) % 2, 0.3, 0.0)
    kappa = Sides(*(np.exp(rng.uniform(np.log(8), np.log(200), LANES)) for _ in range(2)))
    r = Sides(rng.uniform(0.3, 0.9, LANES), rng.uniform(0.3, 0.9, LANES))
    kappa = {"soft": kappa, "rigid": None, "rigid_right": Sides(kappa.left, None)}[walls]
    ball = BallState(
        jnp.asarray(rng.uniform(-0.45, 0.45, LANES) * d),
        jnp.asarray(rng.uniform(-0.7, 0.7, LANES)),
        jnp.asarray(rng.uniform(0, 2, LANES)),
        jnp.zeros(LANES),
    )
    pair = vijax.impact_pair(d, kappa, r, gamma)
    plain = kappa if kappa is not None else Sides(None, None)
    alike = [vijax.impact_pair(d, k, e, gamma) for k, e in ((plain.left, r.left), (plain.right, r.right))]
    return pair, alike, ball


def by_exact_step(pair, ball):
    state = State(ball.u, ball.v, ball.t, jnp.zeros(LANES, jnp.int32), jnp.zeros(LANES, jnp.int32))
    out = jax.vmap(lambda pair, state: exact_step.step(pair, state, jnp.asarray(HORIZON)))(pair, state)
    hit, tangent = out.impact, exact_step.tangent_map(pair, out)
    clock = 2 * hit.n.astype(float) + hit.t
    results = (clock, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *tangent.reshape(4, -1))
    return hit.side, results, hit.side != 0


def by_samples(pair, ball):
    hit, certified = sampled_step.sampled_step(pair, ball, deep=True, work=True, tangent=True)
    results = (2 * hit.onset_n + hit.onset_t, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *hit.tangent)
    return hit.side, results, certified


def by_fast_step(pair, ball):
    walls = fast_walls.prepare_walls(pair, gravity_regime=gravity_regime_of(0.3))
    hit, _, certified, _ = fast_step.fast_step(walls, pair.gamma, ball, deep=True, work=True, tangent=True)
    results = (2 * hit.onset_n + hit.onset_t, hit.v_in, hit.v_out, hit.duration, hit.depth, hit.work, *hit.tangent)
    return hit.side, results, certified


# One test for each step and each kind of wall; the other combinations are long tests.
FEW = [(by_exact_step, "soft"), (by_samples, "rigid"), (by_fast_step, "rigid_right")]
MORE = [
    (step, walls)
    for step in (by_exact_step, by_samples, by_fast_step)
    for walls in ("soft", "rigid", "rigid_right")
    if (step, walls) not in FEW
]


@pytest.mark.parametrize(("step", "walls"), [*FEW, *(pytest.param(*case, marks=pytest.mark.long) for case in MORE)])
def test_impacts_equal_those_of_a_pair_with_two_equal_walls(step, walls):
    pair, alike, ball = drawn(walls)
    side, results, certified = jax.tree.map(np.asarray, jax.jit(step)(pair, ball))
    assert certified.mean() > 0.6
    for wall, equal_pair in zip((-1, 1), alike, strict=True):
        theirs, expected, certain = jax.tree.map(np.asarray, jax.jit(step)(equal_pair, ball))
        here = certified & (side == wall)
        assert here.sum() > 50
        assert (theirs[here] == wall).all()
        np.testing.assert_array_equal(certified[theirs == wall], certain[theirs == wall])
        for index, (got, want) in enumerate(zip(results, expected, strict=True)):
            if index == 4 and walls == "rigid_right" and wall == 1:
                # Next to a membrane, a rigid wall has no calculated depth.
                assert (got[here] == 0).all()
                continue
            np.testing.assert_allclose(got[here], want[here], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("walls", ["soft", "rigid", "rigid_right"])
def test_tangent_maps_of_many_balls_equal_those_of_single_balls(walls):
    pair, _, ball = drawn(walls)

    def maps(pair, ball):
        states = State(ball.u, ball.v, ball.t, jnp.zeros(LANES, jnp.int32), jnp.zeros(LANES, jnp.int32))
        out = jax.vmap(lambda pair, state: exact_step.step(pair, state, jnp.asarray(HORIZON)))(pair, states)
        return exact_step.tangent_map(pair, out), jax.vmap(exact_step.tangent_map, out_axes=-1)(pair, out)

    at_once, single = jax.jit(maps)(pair, ball)
    assert np.ptp(np.asarray(single)[0, 0]) > 0.1
    np.testing.assert_allclose(at_once, single, rtol=1e-13, atol=1e-13)


def test_exchanged_walls_mirror_the_motion():
    """Gamma is reversed, too, half a period later. The shift rounds the phase, so the last bits may differ."""
    kappa, r, gamma = Sides(12.0, 60.0), Sides(0.5, 0.7), 0.125
    turned = vijax.impact_pair(0.25, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    original = vijax.trajectory(vijax.impact_pair(0.25, kappa, r, gamma), 0.03125, 0.25, 8, t0=0.25).impacts
    mirrored = vijax.trajectory(turned, -0.03125, -0.25, 8, t0=1.25).impacts
    count = int((np.asarray(original.side) != 0).sum()) - 2
    assert count > 8
    np.testing.assert_array_equal(original.side[:count], -np.asarray(mirrored.side)[:count])
    assert float(original.v_in[0]) == -float(mirrored.v_in[0])
    for name, sign in (("v_in", -1), ("v_out", -1), ("duration", 1), ("depth", 1), ("work", 1)):
        a, b = (np.asarray(getattr(x, name))[:count] for x in (original, mirrored))
        np.testing.assert_allclose(a, sign * b, rtol=1e-11, err_msg=name)


def test_a_start_that_moves_into_its_wall_is_an_impact_if_the_wall_is_rigid():
    """In a soft wall such a ball is in contact, without an onset."""
    for kappa in (None, Sides(20.0, None)):
        rigid = vijax.trajectory(vijax.impact_pair(0.25, kappa, 0.5), 0.125, 0.25, 2).impacts
        assert int(rigid.side[0]) == 1
        assert float(rigid.t[0]) == pytest.approx(0, abs=1e-15)
        assert float(rigid.v_out[0]) == -0.125
    soft = vijax.trajectory(vijax.impact_pair(0.15, Sides(20.0, None), 0.5), -0.075, -0.25, 12).impacts
    assert 2 * int(soft.n[0]) + float(soft.t[0]) > 0.01


@pytest.mark.parametrize("side", [-1, 1])
def test_a_contact_depends_on_its_wall_only(side):
    """Tested inside a wall at phase 0, and along the drawn curve of a contact."""
    pair = vijax.impact_pair(0.25, Sides(8.0, 20.0), Sides(0.5, 0.7))
    for name in ("u", "v"):
        mine, alike = (
            float(getattr(vijax.trajectory(walls, side * 0.13, 0.0, 1, t0=1.98).states, name)[0])
            for walls in (pair, pair.at(side))
        )
        assert abs(mine) > 0
        assert mine == pytest.approx(alike, rel=1e-13), name
    impact = np.array([0.3]), np.array([float(side)]), np.array([side * 0.5]), np.array([-side * 0.3]), np.array([0.1])
    mine, alike = (motion.curve(walls, *impact) for walls in (pair, pair.at(side)))
    np.testing.assert_allclose(mine.u, alike.u, rtol=1e-13)
    np.testing.assert_allclose(mine.v, alike.v, rtol=1e-13, atol=1e-15)


def test_gravity_above_the_forcing_leads_to_rest_on_the_lower_wall():
    pair = vijax.impact_pair([0.25, 0.25], Sides(8.0, 20.0), Sides(0.5, 0.7), [1.5, -1.5])
    mine = chain.resting(pair, jnp.zeros(2))
    for row, side in enumerate((-1, 1)):
        alike = chain.resting(pair.at(side), jnp.zeros(2))
        assert float(mine.u[row]) == pytest.approx(float(alike.u[row]), rel=1e-14)
        assert side * float(mine.u[row]) > 0.125
    mixed = chain.resting(vijax.impact_pair([0.25, 0.25], Sides(8.0, None), 0.5, [1.5, -1.5]), jnp.zeros(2))
    assert float(mixed.u[0]) == float(mine.u[0])
    assert float(mixed.u[1]) == 0.125


def test_exchanged_walls_and_opposite_harmonics_mirror_the_motion_exactly():
    """Opposite amplitudes of harmonics need no shift by half a period, so no phase is rounded."""
    kappa, r, gamma = Sides(12.0, 60.0), Sides(0.5, 0.7), 0.125
    turned = vijax.impact_pair(0.25, Sides(kappa.right, kappa.left), Sides(r.right, r.left), -gamma)
    shaken, opposite = (vijax.Harmonics([sign, 0.3 * sign], [0.0, 0.7]) for sign in (1.0, -1.0))
    original = vijax.trajectory(vijax.impact_pair(0.25, kappa, r, gamma), 0.03125, 0.25, 60, excitation=shaken).impacts
    mirrored = vijax.trajectory(turned, -0.03125, -0.25, 60, excitation=opposite).impacts
    assert int((np.asarray(original.side) != 0).sum()) > 100
    for name in ("side", "v_in", "v_out"):
        np.testing.assert_array_equal(getattr(original, name), -np.asarray(getattr(mirrored, name)), err_msg=name)
    for name in ("n", "t", "duration", "depth", "work"):
        np.testing.assert_array_equal(getattr(original, name), getattr(mirrored, name), err_msg=name)
