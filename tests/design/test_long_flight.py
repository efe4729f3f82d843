"""A proof knows what its balls have not met, and its balls tell of more than one of them would."""

import math

import jax
import numpy as np
import pytest

import vijax
from vijax.batch.simulate import Starts
from vijax.design import long_flight
from vijax.design.aperiodic_search import Place
from vijax.design.averages import Averages
from vijax.design.design_settings import DEFAULT
from vijax.design.ensemble import Ensemble, Task, fly, on_motion
from vijax.design.long_flight import out_of_step, room_left
from vijax.design.response_surface import unknown
from vijax.model.records import Status


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


def proved(monkeypatch, motion, known=-math.inf, ahead=(1e-6,), box=(-np.inf, np.inf), **fitted):
    """Prove places whose limits are kept above 0; where flights went, the design, and the candidates dropped.

    Args:
        monkeypatch: Pytest's.
        motion: Of a variable P [J], the room there, as a logarithm, and periods by ball, in place of flights.
        known: Logarithm of the best that is verified.
        ahead: What each place promises; the places are 1 apart.
        box: Bounds of the variable.
        fitted: Other parts of the fitted surface than a slope of -2.5.
    """
    device, designs = vijax.Harvester(), []
    task = Task([device], ("kappa",), np.array(box)[None, :, None], "P", (), 1.0, DEFAULT)

    def flown(_task, _owner, z, _radius, starts, _periods, balls):
        P, room, *status = motion(float(z[0, 0]))
        one, zero = np.ones(balls), np.zeros(balls, int)
        designs.append(float(z[0, 0]))
        end = on_motion(starts[0], balls)
        depth = device.depth_limit * math.exp(-room) * one
        left = device.depth_limit / depth
        state = np.resize(status[0], balls) if status else zero
        given = np.where(state == Status.NO_IMPACT, 0.0, P * one)
        still = np.where(state == Status.NO_IMPACT, 1, 0)
        found = Averages(given, one, depth, left, 0.1 * one, 10 * one, one, still, zero, zero, state, one, end)
        return [Ensemble(np.zeros((balls, 1)), found, device)]

    monkeypatch.setattr(long_flight, "fly", flown)
    begun = Starts(*(np.array([x]) for x in (0.0, 0.3, 0.0)))
    surface = unknown(1)._replace(
        **{"gradient": np.array([-2.5]), "margins": np.zeros(2), "slopes": np.ones((2, 1))} | fitted
    )
    places = []
    for number, promised in enumerate(ahead):
        here, log = np.array([float(number)]), np.float64(math.log(promised))
        own = surface._replace(value=log)
        places.append(Place(0, here, 1e-3, begun, here, own, ahead=log, path=[(here, promised)], stopped="maximum"))
    (found,), (dropped,) = long_flight.prove(task, places, np.array([known]))
    return designs, found, dropped


def test_a_design_that_breaks_a_limit_moves_on_until_it_keeps_it(monkeypatch):
    further = 0.01  # than the surface says, and than its balls were spread
    assert further > DEFAULT.last_radius
    designs, found, _ = proved(monkeypatch, lambda z: (1e-6, z - further))
    assert 0 < math.log(found.values["kappa"]) - further < 3 * DEFAULT.limit_room
    # The three flights that set balls out of step, and those of the proof.
    assert len(designs) <= 2 * (3 + 1) + 1


def test_beside_the_window_of_a_lower_orbit_a_design_is_tried_for_once_more(monkeypatch):
    def motion(z):
        return (0.9e-6 if -4e-4 < z < 4e-4 else 0.99e-6), 1.0

    _, found, _ = proved(monkeypatch, motion, known=math.log(0.9e-6))
    assert pytest.approx(0.99e-6) == found.P
    # Where the orbit gives nearly what was promised, a single flight is enough.
    designs, found, (dropped,) = proved(monkeypatch, motion, known=math.log(0.995e-6))
    assert found is None
    assert (dropped.predicted, dropped.measured) == pytest.approx((1e-6, 0.9e-6))
    assert len(designs) == 3 + 1


def test_where_a_flight_measures_less_than_was_promised_the_next_place_is_flown(monkeypatch):
    # The first place by its promise is a transient: its long flight gives next to nothing.
    given = {2.0: 1e-12, 1.0: 0.5e-6, 0.0: 0.6e-6}
    _, found, dropped = proved(monkeypatch, lambda z: (given[round(z)], 1.0), ahead=(0.7e-6, 0.65e-6, 3e-6))
    assert pytest.approx(0.6e-6) == found.P
    assert found.predicted == pytest.approx(0.7e-6)
    measured = [(one.predicted, one.measured) for one in dropped]
    assert measured == [pytest.approx((3e-6, 1e-12)), pytest.approx((0.65e-6, 0.5e-6))]
    # A place that promises no more than was verified is not flown.
    designs, found, _ = proved(monkeypatch, lambda z: (given[round(z)], 1.0), ahead=(0.7e-6, 0.604e-6))
    assert pytest.approx(0.6e-6) == found.P
    assert {round(z) for z in designs} == {0}


def test_balls_without_an_impact_are_part_of_an_aperiodic_motion_and_give_nothing(monkeypatch):
    state = [Status.OK, Status.OK, Status.OK, Status.NO_IMPACT]
    _, found, _ = proved(monkeypatch, lambda z: (1e-6, 1.0, state))
    assert pytest.approx(0.75e-6) == found.P
    assert found.label == "aperiodic"
    assert found.shares == {"aperiodic": 0.75, "no impact": 0.25}


@pytest.mark.parametrize(
    ("slope", "error", "stopped"), [(0.3, 0.2, "maximum"), (-20.0, 42.0, "noise"), (-24.0, 0.2, "slope")]
)
def test_a_slope_that_noise_may_hide_is_no_maximum(monkeypatch, slope, error, stopped):
    level = {"gradient": np.array([slope]), "gradient_error": np.array([error]), "slopes": np.zeros((2, 1))}
    _, found, _ = proved(monkeypatch, lambda z: (1e-6, 1.0), margins=np.ones(2), **level)
    assert found.stopped == stopped


def test_a_design_near_a_bound_is_compared_with_the_bound_where_noise_hides_the_slope(monkeypatch):
    level = {"margins": np.ones(2), "slopes": np.zeros((2, 1)), "gradient": np.array([0.0])}

    def motion(z):
        return (1.2e-6 if z <= -0.03 else 1e-6), 1.0

    for error, at in ((10.0, -0.03), (0.01, 0.0)):
        _, found, _ = proved(monkeypatch, motion, box=(-0.03, 1.0), gradient_error=np.array([error]), **level)
        assert math.log(found.values["kappa"]) == pytest.approx(at, abs=DEFAULT.last_radius)
    assert found.active == ()


def test_balls_that_set_out_from_one_state_are_no_copies():
    known = Starts(*(np.array(x) for x in ([0.01, -0.02], [0.3, 0.2], [0.0, 0.0])))
    many = on_motion(known, 7)
    assert len(np.unique(np.stack(jax.tree.leaves(many)), axis=1).T) == 7
    np.testing.assert_array_equal(many.v[:2], known.v)
    np.testing.assert_allclose(many.v, np.resize(known.v, 7), rtol=1e-3)
