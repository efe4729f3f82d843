"""Averages with derivatives: an orbit's own, a known surface recovered with honest errors, and what is not smooth."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.yardstick import reference_rows
from vijax.batch import cell_program, lanes, perturbed, rows, summary
from vijax.design.average import Smoothness, average
from vijax.engine.ground import Ground
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.energy import harvested_energy
from vijax.model.sides import Sides

DEVICE = Harvester(s=0.2, omega0=60.0, beta=0.02, penetration_limit=0.004)


def depth(pair):
    """Of every impact of a motion that is made up."""
    return 3e-3 * pair.d**0.3 * (pair.kappa / 60) ** -0.8 * pair.r**0.4 * jnp.exp(pair.gamma)


def closed_form(device):
    return harvested_energy(device, depth(device.pair()) * device.length_unit)


class Ended(NamedTuple):
    """What is asked of a `Summary`."""

    P: Any
    P_stderr: Any
    period: Any


def surface(monkeypatch, change=lambda pair: jnp.ones_like(pair.d), period=lambda pair: pair.d < 0, noise=0.0, seed=0):
    """In place of the engine: balls that give a known P, with noise, times what a change of it makes."""

    def flown(pair, start, length, device, count, periods):
        P = harvested_energy(device, depth(pair)[:, None] * length)
        scatter = 1 + noise * np.random.default_rng(seed).standard_normal(pair.d.shape)
        P = P * (change(pair) * scatter)[:, None]
        every = period(pair).astype(jnp.int32)
        return Ended(P, noise * P, every)

    monkeypatch.setattr(perturbed, "averages", flown)


def test_an_orbit_has_the_derivative_of_50_digits():
    row = reference_rows()[1]
    found = average(Harvester(s=0.2, omega0=40.0), balls=128, periods=400, spread=1e-3)
    assert bool(found.smooth)
    assert float(found.periodic) == 1
    assert float(found.P) == pytest.approx(float(row["P_J"]), rel=1e-8)
    assert float(found.by_pair.kappa) == pytest.approx(float(row["dP_dkappa"]), rel=3e-6)
    assert float(found.by_device.omega0) == pytest.approx(
        float(row["dP_dkappa"]), rel=3e-6
    )  # kappa is omega0 at omega = pi
    assert float(found.by_pair.gamma) == 0
    assert float(found.P_stderr) < 1e-8 * float(found.P)


def test_derivatives_of_a_known_surface_come_by_the_record_and_by_every_transformation(monkeypatch):
    surface(monkeypatch)
    wanted = jax.grad(closed_form)(DEVICE)

    def P(device):
        return average(device, balls=256, spread=1e-3).P

    found = average(DEVICE, balls=256, spread=1e-3)
    assert float(found.P) == pytest.approx(float(closed_form(DEVICE)), rel=1e-9)
    assert float(found.power) == pytest.approx(float(found.P * DEVICE.omega / np.pi), rel=1e-12)
    every = jax.tree.map(lambda x: jnp.asarray(x, float), DEVICE)
    many = jax.tree.map(lambda x: jnp.stack([0.9 * x, x]), every)
    ways = {
        "record": found.by_device,
        "grad": jax.grad(P)(every),
        "jit of vmap of grad": jax.tree.map(lambda x: x[1], jax.jit(jax.vmap(jax.grad(P)))(many)),
    }
    for way, derivatives in ways.items():
        for name in CONSTANTS:
            ours, true = (float(getattr(one, name)) for one in (derivatives, wanted))
            assert ours == pytest.approx(true, rel=1e-5, abs=1e-12), f"{name} by {way}"
    assert float(wanted.C_T) != 0
    forward, second = jax.jvp(jax.grad(P), (every,), (every,))
    assert float(forward.omega0) == pytest.approx(float(wanted.omega0), rel=1e-5)
    assert np.isnan(float(second.omega0))


def test_errors_are_those_that_are_made(monkeypatch):
    """Squares of errors in units of standard errors are 1 on average."""
    true, wanted = float(closed_form(DEVICE)), jax.grad(closed_form)(DEVICE)
    names = ("s", "omega0", "r", "beta", "omega", "V")
    off = []
    for seed in range(100):
        surface(monkeypatch, noise=0.01, seed=seed)
        found = average(DEVICE, balls=512, seed=seed)
        by, error = found.by_device, found.by_device_stderr
        off.append([(float(found.P) - true) / float(found.P_stderr)])
        off[-1] += [float((getattr(by, x) - getattr(wanted, x)) / getattr(error, x)) for x in names]
    size = (np.array(off) ** 2).mean(axis=0)
    assert ((size > 0.7) & (size < 1.35)).all(), dict(zip(("P", *names), size, strict=True))


KAPPA = float(DEVICE.pair().kappa)


STIFF = 1.009 * KAPPA


def never(pair):
    return pair.d < 0


@pytest.mark.parametrize(
    ("change", "period", "wanted"),
    [
        (lambda pair: jnp.ones_like(pair.d), never, Smoothness.SMOOTH),
        (lambda pair: jnp.where(pair.kappa > STIFF, jnp.nan, 1.0), never, Smoothness.FAILED),
        (lambda pair: jnp.ones_like(pair.d), lambda pair: pair.kappa > STIFF, Smoothness.WINDOW),
        (lambda pair: jnp.where(pair.d * 1e5 % 1 > 0.5, 1.2, 1.0), never, Smoothness.ATTRACTORS),
        (lambda pair: jnp.where(pair.kappa > KAPPA, 1.004, 1.0), never, Smoothness.KINK),
    ],
)
def test_what_is_not_smooth_says_why(monkeypatch, change, period, wanted):
    surface(monkeypatch, change, period, noise=0.001)
    found = average(DEVICE, balls=1024)
    assert Smoothness(int(found.verdict)) is wanted
    assert bool(found.smooth) == (wanted is Smoothness.SMOOTH)
    assert wanted.advice


@pytest.fixture
def traced_anew():
    """What is traced here is of no use to others, nor theirs here."""
    perturbed._traced.clear_cache()
    yield
    perturbed._traced.clear_cache()


@pytest.mark.long
@pytest.mark.usefixtures("traced_anew")
@pytest.mark.parametrize("beta", [0.0, 0.02])
def test_a_traced_ensemble_runs_the_program_of_its_ground(monkeypatch, beta):
    """Of rows that no ball has flown; they say which program has run."""

    def run(program, table, count, outputs, width):
        plan = program.step.args[0]
        entry = rows.unpack(table, cell_program.entry_shapes(plan, table.dtype))
        like = summary.shapes(plan, table.dtype)
        blank = rows.unpack(jnp.zeros((table.shape[0], outputs)), like)
        P = entry.pair.kappa[:, None] * jnp.where(plan.ground is Ground.LEVEL, 1.0, 2.0) + jnp.zeros_like(blank.P)
        return rows.pack(dataclasses.replace(blank, P=P))

    monkeypatch.setattr(lanes, "run", run)
    device = dataclasses.replace(DEVICE, beta=beta)

    def P(device):
        return average(device, balls=100, spread=1e-3).P

    factor = 2.0 if beta else 1.0
    omega0 = jnp.array([50.0, 60.0])
    one_level = jax.vmap(lambda omega0: P(dataclasses.replace(device, omega0=omega0)))(omega0)
    np.testing.assert_allclose(one_level, factor * omega0 * (np.pi / device.omega), rtol=1e-9)
    # Here it is not known before it runs whether the ground is level.
    either = jax.jit(jax.grad(P))(device)
    assert float(either.omega0) == pytest.approx(factor * np.pi / device.omega, rel=1e-6)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"device": 3.0}, "device must be"),
        ({"device": Harvester(s=np.array([0.1, 0.2]))}, r"device.s must be one number; got shape \(2,\); map devices"),
        ({"balls": 33}, "balls must be even, as they fly in pairs; got 33; take 34"),
        ({"balls": 2}, "balls must be a whole number of at least 32"),
        ({"periods": 0}, "periods must be a whole number of at least 8"),
        ({"spread": 0.5}, r"spread must be a number in \(0, 0.2\]; got 0.5"),
        ({"seed": -1}, "seed must be a whole number of at least 0"),
    ],
)
def test_what_cannot_be_is_said_at_the_door(given, said):
    with pytest.raises(ValueError, match=said):
        average(**{"device": DEVICE, **given})


@pytest.mark.long
def test_walls_that_differ_have_derivatives_of_their_own(monkeypatch):
    """Of a surface that is known: each wall's stiffness and restitution, and what its membrane is made of."""
    device = dataclasses.replace(DEVICE, omega0=Sides(50.0, 70.0), r=Sides(0.4, 0.6), V=Sides(1500.0, 2000.0))

    def P(pair, electric, length):
        deep = 3e-3 * pair.d**0.3 * (pair.kappa.left / 60) ** -0.5 * (pair.kappa.right / 60) ** -0.3
        deep = (deep * pair.r.left**0.4 * pair.r.right**0.1 * jnp.exp(pair.gamma))[..., None] * length
        return sum(harvested_energy(electric.at(side), deep) for side in (-1, 1))

    def flown(pair, start, length, electric, count, periods):
        every = jnp.zeros(pair.d.shape, jnp.int32)
        value = P(pair, electric, length)
        return Ended(value, 0.0 * value, every)

    monkeypatch.setattr(perturbed, "averages", flown)
    found = average(device, balls=512, spread=1e-3)
    exact = jax.grad(lambda device: P(device.pair(), device, device.length_unit)[0])(jax.tree.map(float, device))
    assert bool(found.smooth)
    for name in ("omega0", "r", "V"):
        for side in ("left", "right"):
            mine, wanted = (float(getattr(getattr(of, name), side)) for of in (found.by_device, exact))
            assert mine == pytest.approx(wanted, rel=1e-4), (name, side)
    assert float(found.by_device.s) == pytest.approx(float(exact.s), rel=1e-4)
    turned = jax.grad(lambda device: average(device, balls=512, spread=1e-3).P)(jax.tree.map(float, device))
    assert float(turned.omega0.left) == pytest.approx(float(found.by_device.omega0.left), rel=1e-12)
