"""Averages with derivatives: an orbit, a known surface with right standard errors, and averages that are not smooth."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import reference_rows
from vijax.design.aperiodic.average import Smoothness, average
from vijax.impact.gravity_regime import GravityRegime
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.energy import harvested_energy
from vijax.model.walls.sides import Sides
from vijax.simulation import perturbed_averages, summary
from vijax.simulation.cell import cell_program
from vijax.simulation.scheduler import lane_scheduler, record_rows

DEVICE = Harvester(s=0.2, omega0=60.0, beta=0.02, penetration_limit=0.004)


def depth(pair):
    """Return the depth of all impacts of an artificial motion."""
    return 3e-3 * pair.d**0.3 * (pair.kappa / 60) ** -0.8 * pair.r**0.4 * jnp.exp(pair.gamma)


def closed_form(device):
    return harvested_energy(device, depth(device.pair()) * device.length_unit)


class SummaryFields(NamedTuple):
    """Fields of `Summary` that the averages read."""

    P: Any
    P_stderr: Any
    period: Any


def surface(monkeypatch, change=lambda pair: jnp.ones_like(pair.d), period=lambda pair: pair.d < 0, noise=0.0, seed=0):
    """Replace the engine by samples with a known P, times noise and the factor `change`."""

    def averages(pair, start, length, device, count, periods):
        P = harvested_energy(device, depth(pair)[:, None] * length)
        scatter = 1 + noise * np.random.default_rng(seed).standard_normal(pair.d.shape)
        P = P * (change(pair) * scatter)[:, None]
        sample_period = period(pair).astype(jnp.int32)
        return SummaryFields(P, noise * P, sample_period)

    monkeypatch.setattr(perturbed_averages, "averages", averages)


def test_orbit_derivatives_agree_with_the_50_digit_reference():
    row = reference_rows()[1]
    result = average(Harvester(s=0.2, omega0=40.0), samples=128, periods=400, spread=1e-3)
    assert bool(result.smooth)
    assert float(result.periodic) == 1
    assert float(result.P) == pytest.approx(float(row["P_J"]), rel=1e-8)
    assert float(result.by_pair.kappa) == pytest.approx(float(row["dP_dkappa"]), rel=3e-6)
    assert float(result.by_device.omega0) == pytest.approx(
        float(row["dP_dkappa"]), rel=3e-6
    )  # kappa is omega0 at omega = pi
    assert float(result.by_pair.gamma) == 0
    assert float(result.P_stderr) < 1e-8 * float(result.P)


def test_derivatives_of_a_known_surface_by_record_and_by_transformations(monkeypatch):
    surface(monkeypatch)
    expected = jax.grad(closed_form)(DEVICE)

    def P(device):
        return average(device, samples=256, spread=1e-3).P

    result = average(DEVICE, samples=256, spread=1e-3)
    assert float(result.P) == pytest.approx(float(closed_form(DEVICE)), rel=1e-9)
    assert float(result.power) == pytest.approx(float(result.P * DEVICE.omega / np.pi), rel=1e-12)
    float_device = jax.tree.map(lambda x: jnp.asarray(x, float), DEVICE)
    many = jax.tree.map(lambda x: jnp.stack([0.9 * x, x]), float_device)
    ways = {
        "record": result.by_device,
        "grad": jax.grad(P)(float_device),
        "jit of vmap of grad": jax.tree.map(lambda x: x[1], jax.jit(jax.vmap(jax.grad(P)))(many)),
    }
    for way, derivatives in ways.items():
        for name in CONSTANTS:
            ours, true = (float(getattr(gradient, name)) for gradient in (derivatives, expected))
            assert ours == pytest.approx(true, rel=1e-5, abs=1e-12), f"{name} by {way}"
    assert float(expected.C_T) != 0
    forward, second = jax.jvp(jax.grad(P), (float_device,), (float_device,))
    assert float(forward.omega0) == pytest.approx(float(expected.omega0), rel=1e-5)
    assert np.isnan(float(second.omega0))


def test_standard_errors_agree_with_the_actual_errors(monkeypatch):
    """Squares of errors in units of standard errors are 1 on average."""
    true, expected = float(closed_form(DEVICE)), jax.grad(closed_form)(DEVICE)
    names = ("s", "omega0", "r", "beta", "omega", "V")
    off = []
    for seed in range(100):
        surface(monkeypatch, noise=0.01, seed=seed)
        result = average(DEVICE, samples=512, seed=seed)
        by, error = result.by_device, result.by_device_stderr
        off.append([(float(result.P) - true) / float(result.P_stderr)])
        off[-1] += [float((getattr(by, x) - getattr(expected, x)) / getattr(error, x)) for x in names]
    size = (np.array(off) ** 2).mean(axis=0)
    assert ((size > 0.7) & (size < 1.35)).all(), dict(zip(("P", *names), size, strict=True))


KAPPA = float(DEVICE.pair().kappa)


STIFF = 1.009 * KAPPA


def never(pair):
    return pair.d < 0


@pytest.mark.parametrize(
    ("change", "period", "expected"),
    [
        (lambda pair: jnp.ones_like(pair.d), never, Smoothness.SMOOTH),
        (lambda pair: jnp.where(pair.kappa > STIFF, jnp.nan, 1.0), never, Smoothness.FAILED),
        (lambda pair: jnp.ones_like(pair.d), lambda pair: pair.kappa > STIFF, Smoothness.WINDOW),
        (lambda pair: jnp.where(pair.d * 1e5 % 1 > 0.5, 1.2, 1.0), never, Smoothness.ATTRACTORS),
        (lambda pair: jnp.where(pair.kappa > KAPPA, 1.004, 1.0), never, Smoothness.KINK),
    ],
)
def test_reason_for_a_non_smooth_average(monkeypatch, change, period, expected):
    surface(monkeypatch, change, period, noise=0.001)
    result = average(DEVICE, samples=1024)
    assert Smoothness(int(result.smoothness)) is expected
    assert bool(result.smooth) == (expected is Smoothness.SMOOTH)
    assert expected.advice


@pytest.fixture
def cleared_trace_cache():
    """Clear the cache of traced functions before and after the test."""
    perturbed_averages._traced.clear_cache()
    yield
    perturbed_averages._traced.clear_cache()


@pytest.mark.long
@pytest.mark.usefixtures("cleared_trace_cache")
@pytest.mark.parametrize("beta", [0.0, 0.02])
def test_traced_ensemble_runs_the_program_of_its_gravity_regime(monkeypatch, beta):
    """Use rows that are not simulated; their P depends on the program."""

    def run(program, table, count, outputs, width):
        plan = program.step.args[0]
        entry = record_rows.unpack(table, cell_program.entry_shapes(plan, table.dtype))
        like = summary.summary_shapes(plan, table.dtype)
        blank = record_rows.unpack(jnp.zeros((table.shape[0], outputs)), like)
        P = entry.pair.kappa[:, None] * jnp.where(plan.gravity_regime is GravityRegime.NONE, 1.0, 2.0) + jnp.zeros_like(
            blank.P
        )
        return record_rows.pack(dataclasses.replace(blank, P=P))

    monkeypatch.setattr(lane_scheduler, "run", run)
    device = dataclasses.replace(DEVICE, beta=beta)

    def P(device):
        return average(device, samples=100, spread=1e-3).P

    factor = 2.0 if beta else 1.0
    omega0 = jnp.array([50.0, 60.0])
    static_regime = jax.vmap(lambda omega0: P(dataclasses.replace(device, omega0=omega0)))(omega0)
    np.testing.assert_allclose(static_regime, factor * omega0 * (np.pi / device.omega), rtol=1e-9)
    # Here the gravity regime is not known before the program runs.
    traced_regime = jax.jit(jax.grad(P))(device)
    assert float(traced_regime.omega0) == pytest.approx(factor * np.pi / device.omega, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"device": 3.0}, "device must be"),
        ({"device": Harvester(s=np.array([0.1, 0.2]))}, r"device.s must be one number; got shape \(2,\); map devices"),
        ({"samples": 33}, "samples must be even, since they are simulated in pairs; got 33; take 34"),
        ({"samples": 2}, "samples must be a whole number of at least 32"),
        ({"periods": 0}, "periods must be a whole number of at least 8"),
        ({"spread": 0.5}, r"spread must be a number in \(0, 0.2\]; got 0.5"),
        ({"seed": -1}, "seed must be a whole number of at least 0"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        average(**{"device": DEVICE, **arguments})


@pytest.mark.long
def test_unequal_walls_have_separate_derivatives(monkeypatch):
    """Use a known surface; the derivatives are by stiffness, restitution and membrane voltage of each wall."""
    device = dataclasses.replace(DEVICE, omega0=Sides(50.0, 70.0), r=Sides(0.4, 0.6), V=Sides(1500.0, 2000.0))

    def P(pair, electric, length):
        deep = 3e-3 * pair.d**0.3 * (pair.kappa.left / 60) ** -0.5 * (pair.kappa.right / 60) ** -0.3
        deep = (deep * pair.r.left**0.4 * pair.r.right**0.1 * jnp.exp(pair.gamma))[..., None] * length
        return sum(harvested_energy(electric.at(side), deep) for side in (-1, 1))

    def averages(pair, start, length, electric, count, periods):
        sample_period = jnp.zeros(pair.d.shape, jnp.int32)
        value = P(pair, electric, length)
        return SummaryFields(value, 0.0 * value, sample_period)

    monkeypatch.setattr(perturbed_averages, "averages", averages)
    result = average(device, samples=512, spread=1e-3)
    exact = jax.grad(lambda device: P(device.pair(), device, device.length_unit)[0])(jax.tree.map(float, device))
    assert bool(result.smooth)
    for name in ("omega0", "r", "V"):
        for side in ("left", "right"):
            actual, expected = (float(getattr(getattr(of, name), side)) for of in (result.by_device, exact))
            assert actual == pytest.approx(expected, rel=1e-4), (name, side)
    assert float(result.by_device.s) == pytest.approx(float(exact.s), rel=1e-4)
    gradient = jax.grad(lambda device: average(device, samples=512, spread=1e-3).P)(jax.tree.map(float, device))
    assert float(gradient.omega0.left) == pytest.approx(float(result.by_device.omega0.left), rel=1e-12)
