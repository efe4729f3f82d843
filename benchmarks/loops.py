"""Does a plain loop of calls compile anything after its first call, and does its memory grow?

    python benchmarks/loops.py
    python benchmarks/loops.py --share 0.01

`steady`, its gradient by a new closure a call, and `trajectory` of as many different numbers of periods, without `jit`,
in one process.
"""

import argparse
import dataclasses
import resource
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import vijax
from vijax.orbits import orbit_search

DEVICE = vijax.Harvester()
CALLS = {"steady": 10_000, "grad": 1_000, "trajectory": 500}


def mappings() -> int:
    """Count memory mappings of this process; Linux ends a process at 65,530."""
    return Path("/proc/self/maps").read_text(encoding="ascii").count("\n")


def memory() -> float:
    """Return the largest memory of the process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def device(number: float | jax.Array) -> vijax.Harvester:
    """Make the default device with another stiffness."""
    return dataclasses.replace(DEVICE, omega0=number)


def works() -> dict[str, Callable[[int], object]]:
    """Return the measured calls by name; each takes the number of the call."""
    orbits = orbit_search.find_orbits(DEVICE.pair(), "RL", guesses=256)
    attracting = orbits[np.abs(np.asarray(orbits.multipliers)).max(axis=1) < 1][0]
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    return {
        "steady": lambda i: vijax.steady(device(DEVICE.omega0 * (1 + 1e-6 * i)), attracting).P,
        "grad": lambda i: jax.grad(lambda x: vijax.steady(device(x), attracting).P)(DEVICE.omega0 * (1 + 1e-6 * i)),
        "trajectory": lambda i: vijax.trajectory(pair, 0.02, 0.3, periods=1 + i).filled,
    }


def main() -> None:
    """Run every call repeatedly, and print its time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, default=1.0, help="of all calls")
    share = parser.parse_args().share
    print(f"{'':12}{'calls':>8}{'first, s':>10}{'then, ms':>10}{'mappings':>10}{'more MB':>9}")
    for name, work in works().items():
        count = max(2, round(share * CALLS[name]))
        start = time.perf_counter()
        jax.block_until_ready(work(0))
        first, before, memory_0 = time.perf_counter() - start, mappings(), memory()
        start = time.perf_counter()
        for i in range(1, count):
            jax.block_until_ready(work(i))
        milliseconds = (time.perf_counter() - start) / (count - 1) * 1e3
        print(
            f"{name:12}{count:8,}{first:10.2f}{milliseconds:10.2f}{mappings() - before:+10,}{memory() - memory_0:+9.0f}"
        )


if __name__ == "__main__":
    main()
