"""A confirmation reserves a margin for extremes that its samples have not reached, and its samples are distinct."""

import math

import jax
import numpy as np
import pytest

import vijax
from vijax.design.aperiodic import design_confirmation
from vijax.design.aperiodic.aperiodic_search import AscentPlace
from vijax.design.aperiodic.design_confirmation import reserved_margins, stagger_phases
from vijax.design.aperiodic.ensemble import DesignTask, Ensemble, repeat_starts, simulate_ensembles
from vijax.design.aperiodic.motion_averages import Averages
from vijax.design.aperiodic.response_surface import lowest_surface
from vijax.design.design_settings import DEFAULT
from vijax.model.records import Status
from vijax.simulation.simulate import Starts


def test_a_second_simulation_rarely_falls_below_the_reserved_margins():
    rng = np.random.default_rng(0)
    # Smallest margin of each sample, with an exponential tail: 64 samples, 2 limits, 2,000 repetitions.
    confirmations, others = 0.1 + 0.01 * np.log(rng.exponential(size=(2, 2000, 64, 2)))
    reserved = np.array([reserved_margins(margins, 1.0, confirms=True) for margins in confirmations])
    worse = (others.min(axis=1) < reserved).mean()
    assert 0.002 < worse < 0.02
    smallest = np.array([reserved_margins(margins, 1.0, confirms=False) for margins in confirmations])
    np.testing.assert_array_equal(smallest, confirmations.min(axis=1))
    # A sharp bound that most samples have reached needs no reserve.
    sharp = np.full((64, 2), 2e-4)
    sharp[:20] += 1e-3
    np.testing.assert_array_equal(reserved_margins(sharp, 1.0, confirms=True), [2e-4, 2e-4])


def test_a_share_of_the_samples_may_fall_below_the_margin():
    margins = np.arange(100.0)[:, None]
    assert reserved_margins(margins, 0.9, confirms=False) == 9


def test_confirmation_samples_are_staggered_over_the_bands_of_a_motion():
    # The orbit recurs after 4 periods. For the phases of its samples it is a motion of 4 bands.
    device = vijax.Harvester(s=0.12, omega0=40.0, r=0.5)
    wide = np.full((1, 2, 1), [[[-np.inf], [np.inf]]])
    task = DesignTask([device], ("kappa",), wide, "P", (), 1.0, DEFAULT)
    device_index, z = np.array([0]), np.array([[math.log(40.0)]])
    start = Starts(*(np.array([x]) for x in (0.0, 0.3, 0.0)))
    (settled,) = simulate_ensembles(task, device_index, z, np.zeros(1), [start], 400, 1)
    assert settled.averages.period == 4
    (starts,) = stagger_phases(task, device_index, z, [settled.averages.end])
    (staggered,) = simulate_ensembles(task, device_index, z, np.zeros(1), [starts], 400, DEFAULT.confirm_samples)
    assert (staggered.averages.period == 4).all()
    _, counts = np.unique(
        np.round(np.stack(jax.tree.leaves(staggered.averages.end)[:2]), 6), axis=1, return_counts=True
    )
    np.testing.assert_array_equal(counts, 4 * [DEFAULT.confirm_samples // 4])


def confirm_places(monkeypatch, motion, best_log=-math.inf, predicted=(1e-6,), box=(-np.inf, np.inf), **fitted):
    """Confirm places with limits above 0; return the simulated values, the design and the dropped candidates.

    Args:
        monkeypatch: Fixture of pytest.
        motion: Function of the variable in place of simulations; returns P [J], logarithmic margin, optional statuses.
        best_log: Logarithm of the best verified objective.
        predicted: Predicted objective of each place; the places are 1 apart.
        box: Bounds of the variable.
        fitted: Parts of the fitted surface that are replaced; the default slope is -2.5.
    """
    device, designs = vijax.Harvester(), []
    task = DesignTask([device], ("kappa",), np.array(box)[None, :, None], "P", (), 1.0, DEFAULT)

    def simulate(_task, _device_index, z, _radius, starts, _periods, samples):
        P, margin, *status = motion(float(z[0, 0]))
        ones, zero = np.ones(samples), np.zeros(samples, int)
        designs.append(float(z[0, 0]))
        end = repeat_starts(starts[0], samples)
        depth = device.depth_limit * math.exp(-margin) * ones
        depth_ratio = device.depth_limit / depth
        state = np.resize(status[0], samples) if status else zero
        power = np.where(state == Status.NO_IMPACT, 0.0, P * ones)
        still = np.where(state == Status.NO_IMPACT, 1, 0)
        averages = Averages(
            power, ones, depth, depth_ratio, 0.1 * ones, 10 * ones, ones, still, zero, zero, state, ones, end
        )
        return [Ensemble(np.zeros((samples, 1)), averages, device)]

    monkeypatch.setattr(design_confirmation, "simulate_ensembles", simulate)
    start = Starts(*(np.array([x]) for x in (0.0, 0.3, 0.0)))
    surface = lowest_surface(1)._replace(
        **{"gradient": np.array([-2.5]), "margins": np.zeros(2), "slopes": np.ones((2, 1))} | fitted
    )
    places = []
    for number, prediction in enumerate(predicted):
        place, log = np.array([float(number)]), np.float64(math.log(prediction))
        place_surface = surface._replace(value=log)
        places.append(
            AscentPlace(
                0,
                place,
                1e-3,
                start,
                place,
                place_surface,
                predicted_log=log,
                path=[(place, prediction)],
                stopped="maximum",
            )
        )
    (design,), (dropped,) = design_confirmation.confirm_designs(task, places, np.array([best_log]))
    return designs, design, dropped


def test_design_that_breaks_a_limit_moves_until_it_is_admissible(monkeypatch):
    further = 0.01  # beyond the limit of the surface and the spread of its samples
    assert further > DEFAULT.last_radius
    designs, design, _ = confirm_places(monkeypatch, lambda z: (1e-6, z - further))
    assert 0 < math.log(design.values["kappa"]) - further < 3 * DEFAULT.limit_reserve
    # Three simulations stagger the samples; the other simulations confirm the design.
    assert len(designs) <= 2 * (3 + 1) + 1


def test_design_near_the_window_of_a_lower_orbit_is_tried_again(monkeypatch):
    def motion(z):
        return (0.9e-6 if -4e-4 < z < 4e-4 else 0.99e-6), 1.0

    _, design, _ = confirm_places(monkeypatch, motion, best_log=math.log(0.9e-6))
    assert pytest.approx(0.99e-6) == design.P
    # If the orbit nearly reaches the predicted objective, one simulation suffices.
    designs, design, (dropped,) = confirm_places(monkeypatch, motion, best_log=math.log(0.995e-6))
    assert design is None
    assert (dropped.predicted, dropped.measured) == pytest.approx((1e-6, 0.9e-6))
    assert len(designs) == 3 + 1


def test_next_place_is_simulated_if_a_result_is_below_its_prediction(monkeypatch):
    # The place with the highest prediction is a transient: its long simulation yields almost no power.
    power = {2.0: 1e-12, 1.0: 0.5e-6, 0.0: 0.6e-6}
    _, design, dropped = confirm_places(
        monkeypatch, lambda z: (power[round(z)], 1.0), predicted=(0.7e-6, 0.65e-6, 3e-6)
    )
    assert pytest.approx(0.6e-6) == design.P
    assert design.predicted == pytest.approx(0.7e-6)
    measured = [(candidate.predicted, candidate.measured) for candidate in dropped]
    assert measured == [pytest.approx((3e-6, 1e-12)), pytest.approx((0.65e-6, 0.5e-6))]
    # A place is not simulated if its prediction does not exceed the verified objective.
    designs, design, _ = confirm_places(monkeypatch, lambda z: (power[round(z)], 1.0), predicted=(0.7e-6, 0.604e-6))
    assert pytest.approx(0.6e-6) == design.P
    assert {round(z) for z in designs} == {0}


def test_samples_without_impact_count_with_zero_power(monkeypatch):
    state = [Status.OK, Status.OK, Status.OK, Status.NO_IMPACT]
    _, design, _ = confirm_places(monkeypatch, lambda z: (1e-6, 1.0, state))
    assert pytest.approx(0.75e-6) == design.P
    assert design.label == "aperiodic"
    assert design.shares == {"aperiodic": 0.75, "no impact": 0.25}


@pytest.mark.parametrize(
    ("slope", "error", "stopped"), [(0.3, 0.2, "maximum"), (-20.0, 42.0, "noise"), (-24.0, 0.2, "slope")]
)
def test_stop_reason_depends_on_slope_and_noise(monkeypatch, slope, error, stopped):
    level = {"gradient": np.array([slope]), "gradient_error": np.array([error]), "slopes": np.zeros((2, 1))}
    _, design, _ = confirm_places(monkeypatch, lambda z: (1e-6, 1.0), margins=np.ones(2), **level)
    assert design.stopped == stopped


def test_design_is_compared_with_a_near_bound_if_noise_hides_the_slope(monkeypatch):
    level = {"margins": np.ones(2), "slopes": np.zeros((2, 1)), "gradient": np.array([0.0])}

    def motion(z):
        return (1.2e-6 if z <= -0.03 else 1e-6), 1.0

    for error, at in ((10.0, -0.03), (0.01, 0.0)):
        _, design, _ = confirm_places(monkeypatch, motion, box=(-0.03, 1.0), gradient_error=np.array([error]), **level)
        assert math.log(design.values["kappa"]) == pytest.approx(at, abs=DEFAULT.last_radius)
    assert design.active == ()


def test_repeated_starts_are_distinct():
    starts = Starts(*(np.array(x) for x in ([0.01, -0.02], [0.3, 0.2], [0.0, 0.0])))
    many = repeat_starts(starts, 7)
    assert len(np.unique(np.stack(jax.tree.leaves(many)), axis=1).T) == 7
    np.testing.assert_array_equal(many.v[:2], starts.v)
    np.testing.assert_allclose(many.v, np.resize(starts.v, 7), rtol=1e-3)
