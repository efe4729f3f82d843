"""Does a plain loop of calls compile anything after the first, and does a long one grow?

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
    """Count memory mappings of this process: 65,530 is where Linux ends it."""
    return Path("/proc/self/maps").read_text(encoding="ascii").count("\n")


def memory() -> float:
    """Measure the most memory that the process has held [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def device(number: float | jax.Array) -> vijax.Harvester:
    """Make the default device with another stiffness."""
    return dataclasses.replace(DEVICE, omega0=number)


def works() -> dict[str, Callable[[int], object]]:
    """List what is called; each takes the number of the call."""
    found = orbit_search.search(DEVICE.pair(), "RL", guesses=256)
    known = found[np.abs(np.asarray(found.multipliers)).max(axis=1) < 1][0]
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    return {
        "steady": lambda i: vijax.steady(device(DEVICE.omega0 * (1 + 1e-6 * i)), known).P,
        "grad": lambda i: jax.grad(lambda x: vijax.steady(device(x), known).P)(DEVICE.omega0 * (1 + 1e-6 * i)),
        "trajectory": lambda i: vijax.trajectory(pair, 0.02, 0.3, periods=1 + i).filled,
    }


def main() -> None:
    """Call each as often as asked, and print what a call cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, default=1.0, help="of all calls")
    share = parser.parse_args().share
    print(f"{'':12}{'calls':>8}{'first, s':>10}{'then, ms':>10}{'mappings':>10}{'more MB':>9}")
    for name, work in works().items():
        count = max(2, round(share * CALLS[name]))
        began = time.perf_counter()
        jax.block_until_ready(work(0))
        first, before, held = time.perf_counter() - began, mappings(), memory()
        began = time.perf_counter()
        for i in range(1, count):
            jax.block_until_ready(work(i))
        each = (time.perf_counter() - began) / (count - 1) * 1e3
        print(f"{name:12}{count:8,}{first:10.2f}{each:10.2f}{mappings() - before:+10,}{memory() - held:+9.0f}")


if __name__ == "__main__":
    main()
