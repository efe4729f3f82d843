"""A proof knows what its balls have not met, and its balls tell of more than one of them would."""

import math

import jax
import numpy as np

import vijax
from vijax.batch.simulate import Starts
from vijax.design.design_settings import DEFAULT
from vijax.design.ensemble import Task, fly, on_motion
from vijax.design.long_flight import out_of_step, room_left


def test_another_flight_as_long_seldom_leaves_less_room_than_a_proof_says():
    rng = np.random.default_rng(0)
    # The worst of what each ball meets, with an exponential tail: of 64 balls, 2 limits, 2,000 times.
    proofs, others = 0.1 + 0.01 * np.log(rng.exponential(size=(2, 2000, 64, 2)))
    left = np.array([room_left(one, 1.0, proves=True) for one in proofs])
    worse = (others.min(axis=1) < left).mean()
    assert 0.002 < worse < 0.02
    met = np.array([room_left(one, 1.0, proves=False) for one in proofs])
    np.testing.assert_array_equal(met, proofs.min(axis=1))
    # A sharp bound that most balls have met takes nothing away.
    sharp = np.full((64, 2), 2e-4)
    sharp[:20] += 1e-3
    np.testing.assert_array_equal(room_left(sharp, 1.0, proves=True), [2e-4, 2e-4])


def test_a_share_of_the_balls_may_have_less_room():
    margins = np.arange(100.0)[:, None]
    assert room_left(margins, 0.9, proves=False) == 9


def test_balls_of_a_proof_visit_the_bands_of_their_motion_out_of_step():
    # The orbit recurs after 4 periods: a motion of 4 bands, as far as the steps of its balls go.
    device = vijax.Harvester(s=0.12, omega0=40.0, r=0.5)
    wide = np.full((1, 2, 1), [[[-np.inf], [np.inf]]])
    task = Task([device], ("kappa",), wide, "P", (), 1.0, DEFAULT)
    owner, z = np.array([0]), np.array([[math.log(40.0)]])
    begun = Starts(*(np.array([x]) for x in (0.0, 0.3, 0.0)))
    (settled,) = fly(task, owner, z, np.zeros(1), [begun], 400, 1)
    assert settled.found.period == 4
    (starts,) = out_of_step(task, owner, z, [settled.found.end])
    (flown,) = fly(task, owner, z, np.zeros(1), [starts], 400, DEFAULT.confirm_balls)
    assert (flown.found.period == 4).all()
    _, counts = np.unique(np.round(np.stack(jax.tree.leaves(flown.found.end)[:2]), 6), axis=1, return_counts=True)
    np.testing.assert_array_equal(counts, 4 * [DEFAULT.confirm_balls // 4])


def test_balls_that_set_out_from_one_state_are_no_copies():
    known = Starts(*(np.array(x) for x in ([0.01, -0.02], [0.3, 0.2], [0.0, 0.0])))
    many = on_motion(known, 7)
    assert len(np.unique(np.stack(jax.tree.leaves(many)), axis=1).T) == 7
    np.testing.assert_array_equal(many.v[:2], known.v)
    np.testing.assert_allclose(many.v, np.resize(known.v, 7), rtol=1e-3)
