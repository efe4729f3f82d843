"""Programs are compiled once for a shape: other numbers compile nothing, nor do other sizes up to a power of two."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from tests.helpers import cases
from vijax.continuation import branch_continuation, branch_switching
from vijax.orbits import motion, orbit_properties, orbit_search, periodic, symmetry

DEVICE = vijax.Harvester()
COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Yield the list of programs that are compiled in the context."""
    names: list[str] = []

    def listen(event: str, seconds: float, **about: str) -> None:
        if event == COMPILED:
            names.append(f"{about.get('fun_name')}")

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def pair(i: int) -> vijax.ImpactPair:
    return vijax.impact_pair(0.2 + 0.001 * i, 40.0, 0.5)


@pytest.fixture(scope="module")
def attracting_orbit() -> periodic.Orbit:
    """An attracting orbit of the default device."""
    orbits = orbit_search.find_orbits(DEVICE.pair(), "RL", guesses=64)
    return orbits[np.abs(np.asarray(orbits.multipliers)).max(axis=1) < 1][:1]


def tuned(omega0) -> vijax.Harvester:
    return dataclasses.replace(DEVICE, omega0=omega0)


def power(attracting_orbit):
    # A new function at every call, as a notebook's closures are.
    return lambda omega0: vijax.steady(tuned(omega0), attracting_orbit[0]).P


def omega0(i: int) -> float:
    return DEVICE.omega0 * (1 + 1e-4 * i)


def many(attracting_orbit, i: int) -> periodic.Orbit:
    """Return 5 + i equal orbits."""
    return periodic.concatenate([attracting_orbit] * (5 + i))


def impacts(count: int) -> tuple[np.ndarray, ...]:
    """Return a number of impacts on the right wall, one after another."""
    return np.arange(count) * 1.0, np.ones(count), np.full(count, 0.5), np.full(count, -0.3), np.full(count, 0.1)


# Functions that are called for i = 0, then for 1 and 2.
CALLS = {
    "impact_pair": lambda i, attracting_orbit: vijax.impact_pair(np.full(5 + i, 0.2), 40.0, 0.5),
    "harvested_energy": lambda i, attracting_orbit: vijax.harvested_energy(DEVICE, np.linspace(0, 1e-3, 5 + i)),
    "steady": lambda i, attracting_orbit: vijax.steady(tuned(omega0(i)), attracting_orbit[0]),
    "steady, grad": lambda i, attracting_orbit: jax.grad(power(attracting_orbit))(omega0(i)),
    "steady, vmap": lambda i, attracting_orbit: jax.vmap(power(attracting_orbit))(jnp.full(3, omega0(i))),
    "trajectory, periods": lambda i, attracting_orbit: vijax.trajectory(pair(i), 0.02, 0.3, periods=5 + 20 * i),
    "trajectory, max_impacts": lambda i, attracting_orbit: vijax.trajectory(
        pair(i), 0.02, 0.3, periods=5 + 20 * i, max_impacts=9 + 40 * i
    ),
    "trajectory, starts": lambda i, attracting_orbit: vijax.trajectory(
        pair(i), np.full((2, 4 + i), 0.02), 0.3, periods=5
    ),
    "trajectory, grad": lambda i, attracting_orbit: jax.grad(
        lambda v: vijax.trajectory(pair(i), 0.02, v, 5).states.u[-1]
    )(0.3),
    "trajectory, rk4": lambda i, attracting_orbit: vijax.trajectory(
        pair(i), 0.02, 0.3, periods=5 + 20 * i, max_impacts=9 + 400 * i, method="rk4", steps=100
    ),
    "trajectory, rk4, many": lambda i, attracting_orbit: vijax.trajectory(
        pair(i), 0.02, np.full(70, 0.3), periods=6 + i, method="rk4", steps=100
    ),
    "orbit_search.find_orbits": lambda i, attracting_orbit: orbit_search.find_orbits(pair(i), "RL", guesses=60 + i),
    "orbit_search.orbits_from_states": lambda i, attracting_orbit: orbit_search.orbits_from_states(
        pair(0), np.full(5 + i, 0.02), 0.3, settle=20 + 40 * i
    ),
    "symmetry.double": lambda i, attracting_orbit: symmetry.double(many(attracting_orbit, i)),
    "orbit_properties.orbit_impacts": lambda i, attracting_orbit: orbit_properties.orbit_impacts(
        many(attracting_orbit, i)
    ),
    "orbit_properties.orbit_labels": lambda i, attracting_orbit: orbit_properties.orbit_labels(
        many(attracting_orbit, i)
    ),
    "orbit_properties.orbit_power": lambda i, attracting_orbit: orbit_properties.orbit_power(
        many(attracting_orbit, i), tuned(omega0(i))
    ),
    "orbit_properties.orbit_path": lambda i, attracting_orbit: orbit_properties.orbit_path(many(attracting_orbit, i)),
    "continuation.follow_orbits": lambda i, attracting_orbit: branch_continuation.follow_orbits(
        many(attracting_orbit, i), "omega", (1.0 + 0.01 * i, 9.0), points=20 + i
    ),
    "switching.follow_families": lambda i, attracting_orbit: branch_switching.follow_families(
        attracting_orbit, "d", (0.1 + 0.001 * i, 0.3), points=20 + i
    ),
    "curve": lambda i, attracting_orbit: motion.curve(pair(i), *impacts(5 + i)),
    "motion.states": lambda i, attracting_orbit: motion.states(pair(i), *impacts(5 + i), when=np.linspace(1, 3, 9 + i)),
    "sweep": lambda i, attracting_orbit: vijax.sweep(
        d=np.linspace(0.1, 0.2, 3 + i),
        kappa=40.0 + i,
        r=0.5,
        device=vijax.Harvester(penetration_limit=(None, 0.01, 0.02)[i]),
    ),
    "sweep, rigid": lambda i, attracting_orbit: vijax.sweep(
        d=0.2, kappa=np.linspace(40, 50, 5 + i), r=0.5, wall="rigid"
    ),
    "basins": lambda i, attracting_orbit: vijax.basins(d=0.2, kappa=40.0 + i, v0=np.linspace(-0.5, 0.5, 3 + i)),
    "basin_fractions": lambda i, attracting_orbit: vijax.basin_fractions(d=0.2, kappa=40.0 + i, starts=5 + i),
    "lyapunov": lambda i, attracting_orbit: vijax.lyapunov(d=0.2, kappa=40.0 + i, periods=50 + i),
    "survival": lambda i, attracting_orbit: vijax.survival(d=0.2, kappa=40.0 + i, starts=5 + i, periods=8 + i),
    "compare": lambda i, attracting_orbit: vijax.compare(d=0.2, kappa=np.linspace(40, 50, 5 + i), r=0.5),
    "orbit_diagram": lambda i, attracting_orbit: vijax.orbit_diagram(
        along="d", values=np.linspace(0.2, 0.15, 5 + i), kappa=40.0, r=0.5, periods=30, recorded_periods=5
    ),
    "optimise": lambda i, attracting_orbit: vijax.optimise(
        tuned(omega0(i)), survey_points=8, starts=2, max_impacts=2, max_evaluations=6
    ),
}


# Names of CALLS that are not marked long: one of each kind of program.
FEW = (
    "impact_pair",
    "steady",
    "trajectory, periods",
    "trajectory, starts",
    "orbit_search.find_orbits",
    "curve",
    "sweep, rigid",
)


@pytest.mark.parametrize("name", cases(CALLS, long=tuple(set(CALLS) - set(FEW))))
def test_other_numbers_compile_nothing(name, attracting_orbit):
    CALLS[name](0, attracting_orbit)
    with compilations() as programs:
        CALLS[name](1, attracting_orbit)
        CALLS[name](2, attracting_orbit)
    assert not programs


@pytest.mark.long
def test_derivatives_and_batches_of_other_periods_compile_slices_alone():
    def moved(periods):
        slope = jax.jvp(lambda v: vijax.trajectory(pair(0), 0.02, v, periods), (0.3,), (1.0,))
        return slope, jax.vmap(lambda v: vijax.trajectory(pair(0), 0.02, v, periods))(np.full(3, 0.3))

    # As many periods as in the next test; its batch uses the same program.
    moved(40)
    with compilations() as programs:
        moved(41)
        moved(42)
    # Only JAX can slice traced values, and it compiles a program for each shape.
    assert not set(programs) - {"jit(dynamic_slice)", "jit(broadcast_in_dim)"}


def test_traced_starts_have_the_same_motion():
    starts = np.linspace(-0.3, 0.3, 3)
    # The motion by rk4 is aperiodic: within 40 periods it amplifies a difference in rounding to another impact.
    for wall, settings in ((40.0, {}), (40.0, {"method": "rk4", "steps": 100, "periods": 10})):
        flat = vijax.impact_pair(0.2, wall, 0.5, 0.05)
        simulate = partial(vijax.trajectory, flat, 0.02, **{"periods": 40} | settings)
        plain, traced = simulate(v0=starts), jax.vmap(lambda v, simulate=simulate: simulate(v0=v))(starts)
        assert jax.tree.structure(plain) == jax.tree.structure(traced)
        for expected, actual in zip(jax.tree.leaves(plain), jax.tree.leaves(traced), strict=True):
            assert expected.dtype == actual.dtype
            np.testing.assert_allclose(expected, actual, rtol=0, atol=1e-9)


@pytest.mark.long
def test_records_of_many_starts_equal_records_of_few():
    starts = np.linspace(-0.3, 0.3, 70)
    many, few = (vijax.trajectory(pair(0), 0.02, v0, 5, method="rk4", steps=100) for v0 in (starts, starts[:3]))
    assert jax.tree.map(lambda leaf: leaf[:3].shape, many) == jax.tree.map(lambda leaf: leaf.shape, few)
    for longer, shorter in zip(jax.tree.leaves(many), jax.tree.leaves(few), strict=True):
        np.testing.assert_allclose(longer[:3], shorter, rtol=0, atol=1e-12)


def test_a_compilation_is_counted():
    with compilations() as programs:
        jax.jit(lambda x: x + 1)(1.0)
    assert programs


def test_records_do_not_depend_on_the_capacity_of_the_program():
    for settings in ({}, {"max_impacts": 6}, {"method": "rk4", "steps": 100}):
        short, long = (vijax.trajectory(pair(0), 0.02, 0.3, periods, **settings) for periods in (5, 8))
        assert short.states.u.shape == (5,)
        np.testing.assert_array_equal(short.states.u, long.states.u[:5])
        most = settings.get("max_impacts", 96)
        assert short.impacts.t.shape == (most,)
        count = int(short.filled)
        np.testing.assert_array_equal(short.impacts.t[:count], long.impacts.t[:count])
        assert np.isnan(np.asarray(short.impacts.t[count:])).all()
        assert count == most or int((np.asarray(long.impacts.n) < 5)[: int(long.filled)].sum()) == count
