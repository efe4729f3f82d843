"""How long does a cell-period take, against fixed-step RK4 on the same plane in the same run, and for larger planes?

    python benchmarks/speed.py             # against the peer; the cost of P; compilation; import
    python benchmarks/speed.py --scaling   # cost per cell from 16,384 to 1,048,576 cells
    python benchmarks/speed.py --large     # 1024 x 1024 attractors with P: seconds and peak memory
    python benchmarks/speed.py --ode       # method="ode" against restarts of diffrax's own event solver

The plane: d 0.05..0.3, kappa 3..400 (log), r 0.5, start (0, 0.4), impacts per period over a window; an additional row
has d 0.03..10 (log). Warm times are of whole calls of `vijax.sweep`, axes to labelled dataset; the page on accuracy
and speed prints the rows.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import vijax
from benchmarks import tables

HERE = Path(__file__).parent
REFERENCE = HERE.parent / "tests" / "data" / "trajectories.json"

R, U0, V0 = 0.5, 0.0, 0.4
WIDE = 0.03, 10.0  # gaps of devices on a shaker reach 10
PEER_STEPS = 1000  # per period; explicit RK4 is stable from 273 at kappa 400
PEER_LIMIT = (
    1.1  # us per cell-period on two cores; a slower peer is a poor program or a busy machine, so the comparison is void
)
ACCURACY_PERIODS = 5  # later, chaotic cells turn any error into a difference of order one


class Row(NamedTuple):
    """One timed call, as stored in the CSV file."""

    contender: str
    cells: int
    periods: int
    repeat: int
    seconds: float
    impacts: float  # in all; NaN if the call does not count them

    @property
    def cell_period(self) -> float:
        """Return the microseconds per cell-period."""
        return 1e6 * self.seconds / (self.cells * self.periods)


def axes(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes d and kappa of the plane with side x side cells."""
    return np.linspace(0.05, 0.3, side), np.geomspace(3, 400, side)


def cells(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return d and kappa of every cell of the plane."""
    d, kappa = np.meshgrid(*axes(side), indexing="ij")
    return d.ravel(), kappa.ravel()


def sweep(side: int, periods: int, outputs: tuple[str, ...] = ("impacts_per_period",), wide: bool = False) -> Any:
    """Sweep the plane by vijax, or the plane of gaps from 0.03 to 10."""
    d, kappa = axes(side)
    d = np.geomspace(*WIDE, side) if wide else d
    return vijax.sweep(d=d, kappa=kappa, r=R, u0=U0, v0=V0, until="window", periods=periods, outputs=outputs)


def peer(side: int, periods: int) -> np.ndarray:
    """Count the plane's impacts per period by RK4."""
    from benchmarks.peers import (
        rk4_impacts_per_period,  # imported here: --scaling and --large work without numba
    )

    return rk4_impacts_per_period(*cells(side), R, U0, V0, periods, PEER_STEPS)


def timed(name: str, side: int, periods: int, repeat: int, call: Callable[[], Any]) -> Row:
    """Run a call that returns impacts per period in host memory, and time it."""
    start = time.perf_counter()
    result = call()
    seconds = time.perf_counter() - start
    impact_counts = result if isinstance(result, np.ndarray) else result.get("impacts_per_period")
    impacts = float("nan") if impact_counts is None else float(np.sum(impact_counts)) * periods
    if impact_counts is not None and not np.isfinite(impacts):
        raise SystemExit(f"{name}: {int(np.sum(~np.isfinite(impact_counts)))} cells without a number")
    return Row(name, side * side, periods, repeat, seconds, impacts)


def typical(rows: list[Row], name: str) -> Row:
    """Return the median of the repeats of one contender."""
    repeats = sorted((row for row in rows if row.contender == name), key=lambda row: row.seconds)
    return repeats[(len(repeats) - 1) // 2]


def against_peer(quick: bool) -> Iterator[Row]:
    """Time vijax, vijax with P, and the peer, warm, in alternation; also the compilation and the accuracy."""
    side, periods, repeats = (64, 20, 3) if quick else (128, 100, 5)
    contenders: dict[str, Callable[[], Any]] = {
        "vijax": partial(sweep, side, periods),
        "vijax with P": partial(sweep, side, periods, ("impacts_per_period", "P")),
        "peer": partial(peer, side, periods),
        "vijax, d to 10": partial(sweep, side, periods, wide=True),
    }
    rows = [timed(f"{name}, cold", side, periods, 0, call) for name, call in contenders.items()]
    for repeat in range(repeats):
        rows += [timed(name, side, periods, repeat, call) for name, call in contenders.items()]
    yield from rows

    for name in contenders:
        row = typical(rows, name)
        per_impact = 1e9 * row.seconds / row.impacts
        print(f"{name:14} {row.cell_period:7.4f} us per cell-period  {per_impact:6.1f} ns per impact", end="")
        cold = next(other.seconds for other in rows if other.contender == f"{name}, cold")
        print(f"  {row.seconds:6.3f} s warm  {cold - row.seconds:5.1f} s to compile")
    vijax_seconds, with_p, peer_seconds = (
        [row.seconds for row in rows if row.contender == name] for name in list(contenders)[:3]
    )
    ratios = [peer_time / vijax_time for vijax_time, peer_time in zip(vijax_seconds, peer_seconds, strict=True)]
    print(f"vijax is {statistics.median(ratios):.1f} times faster ({min(ratios):.1f} to {max(ratios):.1f})")
    added = statistics.median(more / vijax_time - 1 for vijax_time, more in zip(vijax_seconds, with_p, strict=True))
    print(f"additional time for P: {100 * added:.0f} %")
    if (slow := typical(rows, "peer").cell_period) > PEER_LIMIT:
        print(f"THE PEER DOES NOT COUNT: {slow:.2f} us per cell-period, above {PEER_LIMIT}: is the machine busy?")
    accuracy(side)
    print(f"import vijax  {import_seconds():.2f} s")


def accuracy(side: int) -> None:
    """Print the peer's error on the plane, and the error of vijax on the stored impacts of 50 digits."""
    from benchmarks.peers import rk4

    d, kappa = cells(side)
    _, u, v = rk4(d, kappa, R, U0, V0, ACCURACY_PERIODS, PEER_STEPS)
    run = vijax.trajectory(vijax.impact_pair(d, kappa, R, 0.0), U0, V0, ACCURACY_PERIODS, max_impacts=64)
    error = np.hypot(u - np.asarray(run.states.u)[:, -1], v - np.asarray(run.states.v)[:, -1])
    print(f"peer: error of the state after {ACCURACY_PERIODS} periods: median {np.median(error):.1e}")

    worst = 0.0
    for case in json.loads(REFERENCE.read_text())["cases"]:
        exact = np.array([float(impact["vin"]) for impact in case["impacts"][:4]])
        parameters = case["case"]
        kappa_or_rigid = None if parameters.get("hard") else parameters["kappa"]
        pair = vijax.impact_pair(parameters["d"], kappa_or_rigid, parameters["r"], parameters["gamma"])
        last = float(case["impacts"][3]["t"])
        run = vijax.trajectory(
            pair, float(case["u0"]), float(case["v0"]), int(last / 2) + 1, t0=float(case["t0"]), max_impacts=16
        )
        worst = max(worst, float(np.max(np.abs(np.asarray(run.impacts.v_in)[:4] / exact - 1))))
    print(f"vijax: error of the first 4 entry speeds of each reference case: worst {worst:.1e} relative")


def import_seconds() -> float:
    """Time `import vijax` and the first access to its names in a new process; return the least of three."""
    code = "import time; start = time.perf_counter(); import vijax.public; print(time.perf_counter() - start)"
    runs = (subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3))
    return min(float(run.stdout) for run in runs)


def scaling(quick: bool) -> Iterator[Row]:
    """Time warm cells for growing planes, in rounds over the sizes; the first round compiles and is dropped."""
    sides, periods, repeats = ((64, 128, 256), 20, 2) if quick else ((128, 256, 512, 1024), 100, 3)
    rows = []
    for repeat in range(repeats + 1):
        for side in sides:
            row = timed(f"{side * side} cells", side, periods, repeat, partial(sweep, side, periods))
            yield row
            rows += [row] if repeat else []
    base = typical(rows, f"{sides[0] ** 2} cells").cell_period
    for side in sides:
        row = typical(rows, f"{side * side} cells")
        print(f"{row.cells:9,} cells  {row.cell_period:.4f} us per cell-period  {row.cell_period / base - 1:+.0%}")


def large(quick: bool) -> Iterator[Row]:
    """Time one cold call for attractors and P of a large plane; print the largest memory of the process."""
    side, periods = (256 if quick else 1024), 400
    d, kappa = axes(side)
    start = time.perf_counter()
    dataset = vijax.sweep(d=d, kappa=kappa, r=R, until="attractor", periods=periods, outputs=("P", "period"))
    seconds = time.perf_counter() - start
    yield Row("attractors, cold", side * side, periods, 0, seconds, float("nan"))
    if missing := int(dataset["P"].isnull().sum()):
        raise SystemExit(f"attractors: {missing} cells without P")
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # KiB on Linux
    print(f"{side} x {side} attractors with P: {seconds:.1f} s with compilation, {resident:.2f} GiB resident at most")
    labels, counts = np.unique(dataset["period"], return_counts=True)
    shares = dict(zip(labels.tolist(), (counts / counts.sum()).tolist(), strict=True))
    undecided, aperiodic = shares.pop(-1, 0.0), shares.pop(0, 0.0)
    print(f"periodic {sum(shares.values()):.1%}  aperiodic {aperiodic:.1%}  undecided {undecided:.1%}")


def ode(quick: bool) -> Iterator[Row]:
    """Time the ode engine and a diffrax restart chain, warm, and print their errors after some periods."""
    from benchmarks.peers import diffrax_chain

    side, periods, chained, repeats = (24, 10, 2, 1) if quick else (64, 100, ACCURACY_PERIODS, 3)
    d, kappa = cells(side)
    pair, rtol = vijax.impact_pair(d, kappa, R, 0.0), 1e-8
    final_states: dict[str, Any] = {}

    def run_ode() -> Any:
        d_axis, kappa_axis = axes(side)
        return vijax.sweep(
            d=d_axis,
            kappa=kappa_axis,
            r=R,
            u0=U0,
            v0=V0,
            until="window",
            periods=periods,
            outputs=("impacts_per_period",),
            method="ode",
            rtol=rtol,
        )

    def run_chain() -> dict[str, Any]:
        final_states["chain"] = diffrax_chain(d, kappa, R, 0.0, U0, V0, chained, rtol)
        return {}

    contenders = (("ode", periods, run_ode), ("chain", chained, run_chain))
    rows = []
    for repeat in range(repeats + 1):  # the first round compiles
        for name, run, call in contenders:
            yield (row := timed(name, side, run, repeat, call))
            rows += [row] if repeat else []
    for name, _, _ in contenders:
        print(f"{name:6} {typical(rows, name).cell_period:7.1f} us per cell-period")
    ratio = typical(rows, "chain").cell_period / typical(rows, "ode").cell_period
    print(f"ode is {ratio:.1f} times faster")
    stepped = vijax.trajectory(pair, U0, V0, chained, max_impacts=64, method="ode", rtol=rtol).states
    final_states["ode"] = tuple(np.asarray(x)[:, -1] for x in (stepped.u, stepped.v))
    print_errors(final_states, pair, chained, rtol)


def print_errors(final_states: dict[str, Any], pair: Any, chained: int, rtol: float) -> None:
    """Print errors of final displacements and velocities, and their fraction beyond the cells' sensitivity."""
    exact = vijax.trajectory(pair, U0, V0, chained, max_impacts=64).states
    near = vijax.trajectory(pair, U0, V0 * (1 + 1e-9), chained, max_impacts=64).states
    exact_final = [np.asarray(x)[:, -1] for x in (exact.u, exact.v)]
    # The growth of a change of 1e-9 at the start measures a cell's sensitivity.
    growth = np.hypot(*(np.asarray(x)[:, -1] - y for x, y in zip((near.u, near.v), exact_final, strict=True))) / (
        1e-9 * V0
    )
    for name, (u, v) in final_states.items():
        error = np.hypot(u - exact_final[0], v - exact_final[1])
        unexplained = error > 1e3 * rtol * np.maximum(growth, 1)
        print(
            f"{name:6} after {chained} periods: median error {np.median(error):.1e}, largest {np.max(error):.1e}; "
            f"beyond 1e-3 {np.mean(error > 1e-3):.2%}, beyond what sensitivity explains {np.mean(unexplained):.2%}"
        )


def main() -> None:
    """Measure the parts that the command line selects, print them, and save the raw rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--scaling", action="store_const", const=scaling, dest="measure", help="cost per cell by size")
    group.add_argument(
        "--large", action="store_const", const=large, dest="measure", help="time and memory of 1024 x 1024"
    )
    group.add_argument("--ode", action="store_const", const=ode, dest="measure", help="the ode engine and its peer")
    parser.add_argument("--quick", action="store_true", help="small sizes, seconds in all: does it run?")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the raw rows")
    parser.set_defaults(measure=against_peer)
    options = parser.parse_args()

    jax.config.update("jax_enable_compilation_cache", False)  # cold times must not use stored programs
    print(f"{os.cpu_count()} cores, {jax.devices()[0].device_kind}, JAX {jax.__version__}")
    name = f"speed_{options.measure.__name__}{'_quick' if options.quick else ''}.csv"
    rows = ([*row, row.cell_period] for row in options.measure(options.quick))
    tables.write(options.rows / name, [*Row._fields, "us_per_cell_period"], rows)


if __name__ == "__main__":
    main()
