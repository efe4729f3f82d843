"""How much time does each output cost, and is an output that is not requested free?

    python benchmarks/cost.py           # 128 x 128 cells, 100 periods
    python benchmarks/cost.py --quick   # 32 x 32 cells, 10 periods: does it run?

The planes: d 0.05..0.3 by kappa 3..400 (log), and d by v0 -0.6..0.6 at kappa 400, where rigid walls have as many cells
to simulate as soft ones; r 0.5, start (0, 0.4), over a window. Microseconds are of whole warm calls of `vijax.sweep`
for each cell of the plane and period, medians; ratios are against another row of the same round, median and range.
Printout for 128 x 128 cells and 100 periods, two quiet cores with 512-bit registers:

    counts             0.0475 us per cell-period
    counts, again      0.0501 us per cell-period     1.04 times counts (0.99 to 1.17)
    lyapunov           0.0556 us per cell-period     1.17 times counts (1.15 to 1.18)
    P                  0.0569 us per cell-period     1.22 times counts (1.16 to 1.29)
    P at 8 omega       0.0684 us per cell-period     1.19 times P (1.11 to 1.23)
    gamma = 0 given    0.0474 us per cell-period     1.01 times counts (0.99 to 1.06)
    gamma = 0.1        0.0712 us per cell-period     1.48 times counts (1.46 to 1.57)
    gamma = 0.5        0.0963 us per cell-period     2.04 times counts (2.01 to 2.06)
    P, gamma = 0.1     0.0847 us per cell-period     1.48 times P (1.43 to 1.56)
    P, gamma = 0.5     0.1352 us per cell-period     2.40 times P (2.27 to 2.42)
    P, ode            10.2080 us per cell-period   179.49 times P (165.87 to 184.33)
    P, ode, friction  12.0100 us per cell-period     1.18 times P, ode (1.16 to 1.20)
    soft, starts       0.0627 us per cell-period
    rigid, starts      0.0622 us per cell-period     1.01 times soft, starts (0.96 to 1.07)
    rigid map          0.0072 us per cell-period     0.12 times P (0.12 to 0.17)
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import vijax
from benchmarks import tables
from benchmarks.speed import HERE, U0, V0, R, Row, axes

FREQUENCIES = 8
LEVEL, INCLINED = 0.0, (0.1, 0.5)
STIFF = 400.0
FRICTION = 0.1
SPEEDS = 0.6  # starts of the second plane reach from minus to plus this speed


class Contender(NamedTuple):
    """A sweep, and the name of the contender for its time ratio."""

    call: Callable[[], Any]
    against: str | None


def contenders(side: int, periods: int) -> dict[str, Contender]:
    """Return the timed sweeps by name."""
    d, kappa = axes(side)
    sweep = partial(vijax.sweep, d=d, r=R, u0=U0, until="window", periods=periods)
    plane = partial(sweep, kappa=kappa, v0=V0)
    starts = partial(sweep, kappa=STIFF, v0=np.linspace(-SPEEDS, SPEEDS, side))
    counts, power = ("impacts_per_period",), ("impacts_per_period", "P")
    omega = np.pi * np.geomspace(1, 12, FREQUENCIES)
    return {
        "counts": Contender(partial(plane, outputs=counts), None),
        "counts, again": Contender(partial(plane, outputs=counts), "counts"),
        "lyapunov": Contender(partial(plane, outputs=("impacts_per_period", "lyapunov")), "counts"),
        "P": Contender(partial(plane, outputs=power), "counts"),
        f"P at {FREQUENCIES} omega": Contender(partial(plane, omega=omega, outputs=power), "P"),
        "gamma = 0 given": Contender(partial(plane, gamma=LEVEL, outputs=counts), "counts"),
        **{f"gamma = {slope}": Contender(partial(plane, gamma=slope, outputs=counts), "counts") for slope in INCLINED},
        **{f"P, gamma = {slope}": Contender(partial(plane, gamma=slope, outputs=power), "P") for slope in INCLINED},
        "P, ode": Contender(partial(plane, method="ode", outputs=power), "P"),
        "P, ode, friction": Contender(partial(plane, method="ode", friction=FRICTION, outputs=power), "P, ode"),
        "soft, starts": Contender(partial(starts, outputs=power), None),
        "rigid, starts": Contender(partial(starts, wall="rigid", outputs=power), "soft, starts"),
        # A rigid wall's motion does not depend on kappa, so the whole map needs one simulation per d.
        "rigid map": Contender(partial(plane, wall="rigid", outputs=power), "P"),
    }


def timed(name: str, call: Callable[[], Any], side: int, periods: int, repeat: int) -> Row:
    """Run a sweep and time it; every cell must have a number."""
    start = time.perf_counter()
    dataset = call()
    seconds = time.perf_counter() - start
    impacts = dataset["impacts_per_period"]
    if missing := int(impacts.isnull().sum()):
        raise SystemExit(f"{name}: {missing} cells without a number")
    return Row(name, side * side, periods, repeat, seconds, float(impacts.sum()) * periods)


def measure(side: int, periods: int, repeats: int) -> Iterator[Row]:
    """Time all sweeps in rounds, so that a ratio compares neighbouring calls; the first round compiles only."""
    sweeps = contenders(side, periods)
    rows: dict[str, list[Row]] = {name: [] for name in sweeps}
    for name, contender in sweeps.items():
        timed(name, contender.call, side, periods, -1)
    for repeat in range(repeats):
        for name, contender in sweeps.items():
            rows[name].append(timed(name, contender.call, side, periods, repeat))
            yield rows[name][-1]
    for name, contender in sweeps.items():
        typical = statistics.median(row.cell_period for row in rows[name])
        print(f"{name:16} {typical:8.4f} us per cell-period", end="")
        if contender.against is not None:
            pairs = zip(rows[name], rows[contender.against], strict=True)
            ratios = [row.seconds / other.seconds for row, other in pairs]
            print(f"   {statistics.median(ratios):6.2f} times {contender.against}", end="")
            print(f" ({min(ratios):.2f} to {max(ratios):.2f})", end="")
        print()


def main() -> None:
    """Measure, print, and save the raw rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes: does it run?")
    parser.add_argument("--rows", type=Path, default=HERE / "rows", help="folder for the raw rows")
    options = parser.parse_args()

    print(f"{os.cpu_count()} cores, {jax.devices()[0].device_kind}, JAX {jax.__version__}")
    rows = measure(32, 10, 3) if options.quick else measure(128, 100, 5)
    table_rows = ([*row, row.cell_period] for row in rows)
    tables.write(
        options.rows / f"cost{'_quick' if options.quick else ''}.csv", [*Row._fields, "us_per_cell_period"], table_rows
    )


if __name__ == "__main__":
    main()
