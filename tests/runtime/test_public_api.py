"""vijax inside other programs: their settings of JAX, threads, forks, and missing platforms."""

import dataclasses
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import vijax
from tests.helpers import cases
from vijax.continuation import continuation_parameter
from vijax.design import report
from vijax.design.robustness import tolerance
from vijax.model import device as devices
from vijax.model import energy, tuned_quantities
from vijax.model.walls import restitution
from vijax.orbits import motion, orbit_properties, orbit_search, periodic
from vijax.runtime import public_api, tiles
from vijax.runtime.compilation import xla

ROOT = Path(__file__).parents[2]
SETTINGS = {
    "jax_enable_x64": False,
    "jax_debug_nans": True,
    "jax_debug_infs": True,
    "jax_numpy_rank_promotion": "raise",
    "jax_numpy_dtype_promotion": "strict",
    "jax_check_tracer_leaks": True,
    "jax_transfer_guard": "disallow",
}
SECONDS = 120  # a process that takes so long hangs


@pytest.fixture(params=cases(SETTINGS, long=("jax_debug_infs", "jax_numpy_dtype_promotion", "jax_transfer_guard")))
def setting(request) -> Iterator[str]:
    """Apply a setting of JAX during a test, and yield its name."""
    name = request.param
    before = getattr(jax.config, name)
    jax.config.update(name, SETTINGS[name])
    yield name
    jax.config.update(name, before)


def public_results() -> Any:
    """Return results of maps on many threads, of Newton's method with starts that fail, and of closed forms."""
    device = vijax.Harvester()
    orbits = orbit_search.find_orbits(device.pair(), "RL", guesses=64)
    attracting = orbits[np.abs(np.asarray(orbits.multipliers)).max(axis=1) < 1]
    path = vijax.trajectory(vijax.impact_pair(0.2, 40.0, 0.5), 0.02, 0.3, periods=5)
    # Programs of rigid walls compile in a third of the time; with the asymmetry, `basins` uses the same program.
    plane = vijax.sweep(d=[0.12, 0.2], wall="rigid", r=0.5, outputs=["P", "period", "asymmetry"])
    basins = vijax.basins(d=0.2, wall="rigid", u0=0.02, v0=[0.1, 0.3])
    lost = vijax.steady(dataclasses.replace(device, omega0=3.0), attracting[0])
    results = plane.P, plane.period, basins.label, orbits, path, vijax.steady(device, attracting[0]), lost
    return jax.tree.map(np.asarray, results)


@pytest.fixture(scope="module")
def plain() -> Any:
    """The results in a program that changes no setting."""
    return public_results()


def assert_same(actual: Any, expected: Any) -> None:
    for leaf, expected_leaf in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert leaf.dtype == expected_leaf.dtype
        np.testing.assert_array_equal(leaf, expected_leaf)


def test_settings_of_a_program_change_no_result_and_are_restored(plain, setting):
    assert_same(public_results(), plain)
    assert getattr(jax.config, setting) == SETTINGS[setting]
    with pytest.raises(ValueError, match="r must"):
        vijax.impact_pair(0.2, 40.0, -1.0)
    assert getattr(jax.config, setting) == SETTINGS[setting]


def test_settings_change_no_result_in_the_threads_of_a_program(plain, setting):
    with ThreadPoolExecutor(1) as pool:
        assert_same(pool.submit(public_results).result(), plain)
        assert pool.submit(lambda: getattr(jax.config, setting)).result() == SETTINGS[setting]


def slopes() -> list[Any]:
    """Return derivatives of a steady state and of a trajectory, by closures of the program."""
    device = vijax.Harvester()
    orbit = orbit_search.find_orbits(device.pair(), "RL", guesses=64)
    orbit = orbit[np.abs(np.asarray(orbit.multipliers)).max(axis=1) < 1][0]
    pair = vijax.impact_pair(0.2, None, 0.5)
    return [
        jax.grad(lambda x: vijax.steady(dataclasses.replace(device, omega0=x), orbit).P)(device.omega0),
        jax.grad(lambda v: vijax.trajectory(pair, 0.02, v, periods=2).states.u[-1])(0.3),
    ]


@pytest.fixture(scope="module")
def plain_slopes() -> list[Any]:
    return slopes()


@pytest.mark.long
def test_settings_of_a_program_change_no_derivative(plain_slopes, setting):
    if setting == "jax_transfer_guard":
        pytest.skip("jax.grad itself transfers between host and device: jax.grad(jnp.sin)(0.3) raises, too")
    if setting == "jax_enable_x64":
        with pytest.raises(ValueError, match="jax_enable_x64 must be True where a program traces vijax"):
            slopes()
    else:
        np.testing.assert_array_equal(slopes(), plain_slopes)


def test_a_public_function_has_its_docstring_and_signature():
    assert vijax.steady.__doc__.startswith("Find the steady state of a device")
    assert list(inspect.signature(vijax.steady).parameters) == ["device", "orbit", "pair", "membrane"]


def test_an_orbit_in_single_precision_is_refused():
    orbit = orbit_search.find_orbits(vijax.Harvester().pair(), "RL", guesses=64)[0]
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf, orbit)
    with pytest.raises(ValueError, match="orbit must hold 64 bits; got float32"):
        vijax.steady(vijax.Harvester(), single)


def run(command: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    variables = os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=variables, timeout=SECONDS)


FORKED = """
import jax, multiprocessing, sys, vijax

def work(number):
    try:
        return float(vijax.harvested_energy(vijax.Harvester(), 1e-3 * number))
    except RuntimeError as error:
        return str(error)

if "warm" in sys.argv:
    jax.numpy.zeros(1)
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(*pool.map(work, [1, 2]), sep="\\n")
"""


def test_a_fork_after_the_start_of_jax_raises_and_a_fork_before_it_works():
    result = run([sys.executable, "-W", "ignore", "-c", FORKED, "warm"])
    assert result.stdout.count("vijax must not be called in a process that was forked after JAX had started") == 2
    result = run([sys.executable, "-W", "ignore", "-c", FORKED])
    device = vijax.Harvester()
    np.testing.assert_allclose(
        [float(line) for line in result.stdout.split()], [vijax.harvested_energy(device, 1e-3 * i) for i in (1, 2)]
    )


def test_the_default_device_decides_the_platform_of_programs(monkeypatch):
    """A CPU is preferred on a machine with a GPU: in this thread, and in the threads that run tiles."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert xla.platform() == "gpu"
    with jax.default_device(jax.devices()[0]):
        workers = public_api.pool(1)
        assert xla.platform() == workers.submit(xla.platform).result() == "cpu"
        assert tiles.workers() == os.cpu_count()
    with jax.default_device("cpu"):
        assert xla.on_cpu()


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="the test requires a platform that is missing")
def test_a_missing_platform_is_reported_in_a_single_line(tmp_path):
    line = "JAX_PLATFORMS must name a platform that this machine has; got 'cuda'"
    code = "import vijax; vijax.sweep(d=0.2, kappa=40.0, r=0.5)"
    result = run([sys.executable, "-c", code], JAX_PLATFORMS="cuda")
    assert result.stderr.strip().splitlines()[-1].startswith(f"OSError: {line}")
    command = [sys.executable, "scripts/grid.py", "--d", "0.2", "--kappa", "40", "--out", str(tmp_path / "one.zarr")]
    result = run(command, JAX_PLATFORMS="cuda")
    assert result.returncode != 0
    assert line in result.stderr
    assert "Traceback" not in result.stderr


PAIR = vijax.impact_pair([0.2, 0.3], 40.0, [0.5, 0.7])
DEVICES = jax.tree.map(lambda x: jax.device_put(np.array([x, 1.1 * x])), vijax.Harvester())
NUMBERS = np.array([1e-3, 2e-3])
CLOSED_FORMS = {
    "ImpactPair": lambda: (PAIR.mu, PAIR.zeta, PAIR.omega1),
    "Harvester": lambda: (DEVICES.k, DEVICES.length_unit, DEVICES.speed_unit, DEVICES.pair()),
    "pair.impact_pair": lambda: vijax.impact_pair([0.1, 0.2], 40.0, 0.3),
    "restitution.damping_ratio": lambda: restitution.damping_ratio(NUMBERS),
    "device.with_pair": lambda: devices.with_pair(vijax.Harvester(), PAIR),
    "device.depth_unit": lambda: devices.depth_unit(DEVICES, vijax.impact_pair(0.2, None, 0.5)),
    "device.with_constants": lambda: devices.with_constants(vijax.Harvester(), k=NUMBERS),
    "energy.stretch": lambda: energy.stretch(vijax.Harvester(), NUMBERS),
    "energy.capacitance": lambda: energy.capacitance(vijax.Harvester(), NUMBERS),
    "energy.harvested_energy": lambda: energy.harvested_energy(vijax.Harvester(), NUMBERS),
    "energy.rigid_penetration": lambda: energy.rigid_penetration(NUMBERS),
    "energy.membrane_work_rigid": lambda: energy.membrane_work_rigid(PAIR.d, PAIR.r),
    "energy.membrane_work": lambda: energy.membrane_work(40.0, 9.0, 0.1, 1.0, NUMBERS, 50 * NUMBERS, PAIR.d, -PAIR.d),
    "energy.energy_ratio": lambda: energy.energy_ratio(NUMBERS, 3 * NUMBERS),
    # The two displacements are equal in single precision, and admissible there.
    "energy.admissible": lambda: energy.admissible(vijax.Harvester(), PAIR.d, np.array([0.2, 0.3 * (1 - 1e-9)]), 0.0),
    "variables.values": lambda: tuned_quantities.to_values(("omega0", "beta"), np.array([[1.0, 2.0], [3.0, 4.0]])),
    "variables.tuned": lambda: tuned_quantities.tune_device(vijax.Harvester(), ("k", "d"), NUMBERS),
    "variables.value_of": lambda: [tuned_quantities.value_of(DEVICES, name) for name in tuned_quantities.NAMES],
    "variables.limits": lambda: tuned_quantities.bounds_of(("k", "d"), {}, vijax.Harvester()),
    "parameter.value_at": lambda: continuation_parameter.value_at(PAIR, "omega", vijax.Harvester()),
    "parameter.pair_at": lambda: continuation_parameter.pair_at(PAIR, "omega", 7.0, vijax.Harvester()),
    "orbit_properties.orbit_power": lambda: orbit_properties.orbit_power(two_orbits(), vijax.Harvester()),
    "Orbit": lambda: (two_orbits()[:1], two_orbits().count),
    "motion.curve": lambda: motion.curve(vijax.impact_pair(0.2, 40.0, 0.5), NUMBERS, [1, 1], NUMBERS, NUMBERS, NUMBERS),
    "report.describe": lambda: plain_numbers(report.describe(designed())),
    "tolerance.nodes": lambda: tolerance.nodes((tolerance.Tolerance("s", 0.1),))[1:],
}


@cache
def two_orbits() -> periodic.Orbit:
    return orbit_search.find_orbits(vijax.Harvester().pair(), "RL", guesses=64)[:2]


@cache
def designed() -> vijax.design.optimise.Design:
    # The default number of evaluations: other tests compile the same ascents.
    return vijax.optimise(vijax.Harvester(s=0.2), survey_points=8, starts=2, max_impacts=2)


def plain_numbers(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if not isinstance(leaf, str)]


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms_have_64_bits_in_a_program_of_32_bits(name):
    two_orbits(), designed()
    expected = jax.tree.map(np.asarray, CLOSED_FORMS[name]())
    with jax.enable_x64(False), jax.numpy_rank_promotion("raise"):
        assert_same(jax.tree.map(np.asarray, CLOSED_FORMS[name]()), expected)
