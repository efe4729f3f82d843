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
from vijax.orbits import continuation, motion, orbit_properties, orbit_search, periodic, switching, symmetry

DEVICE = vijax.Harvester()
COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compilations() -> Iterator[list[str]]:
    """The programs that are compiled meanwhile."""
    found: list[str] = []

    def listen(event: str, seconds: float, **about: str) -> None:
        if event == COMPILED:
            found.append(f"{about.get('fun_name')}")

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def pair(i: int) -> vijax.ImpactPair:
    return vijax.impact_pair(0.2 + 0.001 * i, 40.0, 0.5)


@pytest.fixture(scope="module")
def known() -> periodic.Orbit:
    """One attracting orbit of the default device."""
    found = orbit_search.search(DEVICE.pair(), "RL", guesses=64)
    return found[np.abs(np.asarray(found.multipliers)).max(axis=1) < 1][:1]


def tuned(omega0) -> vijax.Harvester:
    return dataclasses.replace(DEVICE, omega0=omega0)


def power(known):
    # A new function at every call, as a notebook's closures are.
    return lambda omega0: vijax.steady(tuned(omega0), known[0]).P


def omega0(i: int) -> float:
    return DEVICE.omega0 * (1 + 1e-4 * i)


def many(known, i: int) -> periodic.Orbit:
    """Five orbits and some more."""
    return periodic.concatenate([known] * (5 + i))


def impacts(count: int) -> tuple[np.ndarray, ...]:
    """So many impacts, one after another on the right wall."""
    return np.arange(count) * 1.0, np.ones(count), np.full(count, 0.5), np.full(count, -0.3), np.full(count, 0.1)


# What is called for i = 0, then for 1 and 2.
CALLS = {
    "impact_pair": lambda i, known: vijax.impact_pair(np.full(5 + i, 0.2), 40.0, 0.5),
    "harvested_energy": lambda i, known: vijax.harvested_energy(DEVICE, np.linspace(0, 1e-3, 5 + i)),
    "steady": lambda i, known: vijax.steady(tuned(omega0(i)), known[0]),
    "steady, grad": lambda i, known: jax.grad(power(known))(omega0(i)),
    "steady, vmap": lambda i, known: jax.vmap(power(known))(jnp.full(3, omega0(i))),
    "trajectory, periods": lambda i, known: vijax.trajectory(pair(i), 0.02, 0.3, periods=5 + 20 * i),
    "trajectory, max_impacts": lambda i, known: vijax.trajectory(
        pair(i), 0.02, 0.3, periods=5 + 20 * i, max_impacts=9 + 40 * i
    ),
    "trajectory, starts": lambda i, known: vijax.trajectory(pair(i), np.full((2, 4 + i), 0.02), 0.3, periods=5),
    "trajectory, grad": lambda i, known: jax.grad(lambda v: vijax.trajectory(pair(i), 0.02, v, 5).states.u[-1])(0.3),
    "trajectory, rk4": lambda i, known: vijax.trajectory(
        pair(i), 0.02, 0.3, periods=5 + 20 * i, max_impacts=9 + 400 * i, method="rk4", steps=100
    ),
    "trajectory, rk4, many": lambda i, known: vijax.trajectory(
        pair(i), 0.02, np.full(70, 0.3), periods=6 + i, method="rk4", steps=100
    ),
    "orbit_search.search": lambda i, known: orbit_search.search(pair(i), "RL", guesses=60 + i),
    "orbit_search.from_state": lambda i, known: orbit_search.from_state(
        pair(0), np.full(5 + i, 0.02), 0.3, settle=20 + 40 * i
    ),
    "symmetry.doubled": lambda i, known: symmetry.doubled(many(known, i)),
    "orbit_properties.impacts": lambda i, known: orbit_properties.impacts(many(known, i)),
    "orbit_properties.labels": lambda i, known: orbit_properties.labels(many(known, i)),
    "orbit_properties.power": lambda i, known: orbit_properties.power(many(known, i), tuned(omega0(i))),
    "orbit_properties.path": lambda i, known: orbit_properties.path(many(known, i)),
    "continuation.follow": lambda i, known: continuation.follow(
        many(known, i), "omega", (1.0 + 0.01 * i, 9.0), points=20 + i
    ),
    "switching.family": lambda i, known: switching.family(known, "d", (0.1 + 0.001 * i, 0.3), points=20 + i),
    "curve": lambda i, known: motion.curve(pair(i), *impacts(5 + i)),
    "motion.states": lambda i, known: motion.states(pair(i), *impacts(5 + i), when=np.linspace(1, 3, 9 + i)),
    "sweep": lambda i, known: vijax.sweep(
        d=np.linspace(0.1, 0.2, 3 + i),
        kappa=40.0 + i,
        r=0.5,
        device=vijax.Harvester(penetration_limit=(None, 0.01, 0.02)[i]),
    ),
    "sweep, rigid": lambda i, known: vijax.sweep(d=0.2, kappa=np.linspace(40, 50, 5 + i), r=0.5, wall="rigid"),
    "basins": lambda i, known: vijax.basins(d=0.2, kappa=40.0 + i, v0=np.linspace(-0.5, 0.5, 3 + i)),
    "basin_fractions": lambda i, known: vijax.basin_fractions(d=0.2, kappa=40.0 + i, starts=5 + i),
    "lyapunov": lambda i, known: vijax.lyapunov(d=0.2, kappa=40.0 + i, periods=50 + i),
    "survival": lambda i, known: vijax.survival(d=0.2, kappa=40.0 + i, starts=5 + i, periods=8 + i),
    "compare": lambda i, known: vijax.compare(d=0.2, kappa=np.linspace(40, 50, 5 + i), r=0.5),
    "orbit_diagram": lambda i, known: vijax.orbit_diagram(
        along="d", values=np.linspace(0.2, 0.15, 5 + i), kappa=40.0, r=0.5, periods=30, recorded_periods=5
    ),
    "optimise": lambda i, known: vijax.optimise(
        tuned(omega0(i)), survey_points=8, starts=2, max_impacts=2, max_evaluations=6
    ),
}


# One of each kind: what is traced, stepped, searched for, followed, and run as a plane.
FEW = (
    "impact_pair",
    "steady",
    "trajectory, periods",
    "trajectory, starts",
    "orbit_search.search",
    "curve",
    "sweep, rigid",
)


@pytest.mark.parametrize("name", cases(CALLS, long=tuple(set(CALLS) - set(FEW))))
def test_other_numbers_compile_nothing(name, known):
    CALLS[name](0, known)
    with compilations() as programs:
        CALLS[name](1, known)
        CALLS[name](2, known)
    assert not programs


@pytest.mark.long
def test_derivatives_and_batches_of_other_periods_compile_slices_alone():
    def moved(periods):
        slope = jax.jvp(lambda v: vijax.trajectory(pair(0), 0.02, v, periods), (0.3,), (1.0,))
        return slope, jax.vmap(lambda v: vijax.trajectory(pair(0), 0.02, v, periods))(np.full(3, 0.3))

    # As many periods as in the next test, whose batch is of the same program.
    moved(40)
    with compilations() as programs:
        moved(41)
        moved(42)
    # What is traced can only be cut to size by JAX, which has a program for each shape.
    assert not set(programs) - {"jit(dynamic_slice)", "jit(broadcast_in_dim)"}


def test_what_is_traced_flies_the_same():
    starts = np.linspace(-0.3, 0.3, 3)
    # The motion by rk4 is aperiodic: within 40 periods it amplifies a difference in rounding to another impact.
    for wall, settings in ((40.0, {}), (40.0, {"method": "rk4", "steps": 100, "periods": 10})):
        flat = vijax.impact_pair(0.2, wall, 0.5, 0.05)
        fly = partial(vijax.trajectory, flat, 0.02, **{"periods": 40} | settings)
        plain, traced = fly(v0=starts), jax.vmap(lambda v, fly=fly: fly(v0=v))(starts)
        assert jax.tree.structure(plain) == jax.tree.structure(traced)
        for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(traced), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


@pytest.mark.long
def test_records_of_many_starts_are_those_of_few():
    starts = np.linspace(-0.3, 0.3, 70)
    many, few = (vijax.trajectory(pair(0), 0.02, some, 5, method="rk4", steps=100) for some in (starts, starts[:3]))
    assert jax.tree.map(lambda leaf: leaf[:3].shape, many) == jax.tree.map(lambda leaf: leaf.shape, few)
    for one, other in zip(jax.tree.leaves(many), jax.tree.leaves(few), strict=True):
        np.testing.assert_allclose(one[:3], other, rtol=0, atol=1e-12)


def test_a_compilation_is_seen():
    with compilations() as programs:
        jax.jit(lambda x: x + 1)(1.0)
    assert programs


def test_records_with_more_room_than_is_asked_for_are_those_of_their_own_size():
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
