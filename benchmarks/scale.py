"""How many hours and gigabytes does a plane beyond this machine's size take, and which limit is reached first?

    python benchmarks/scale.py            # everything; planes of 10^3 to 10^6 cells
    python benchmarks/scale.py --most     # and of 10^7
    python benchmarks/scale.py --quick    # small planes: does it run?

Every measurement is a study of the (d, kappa) plane in a separate process, on a number of cores, compiled beforehand:
with default settings; with cheap ones (5 periods), to show the cost besides simulation; and with an engine that does
nothing, which leaves that cost alone. The table follows from these: the cost on two cores is measured up to 10^6 cells
and proportional to the cells beyond; the cost on a GPU is the time of 2048 x 2048 cells on one (`accelerator.py`).
"""

import argparse
import json
import os
import pickle
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "cheap": {"until": "window", "periods": 5},
}
_WARM = 363  # least side with tiles of full size; smaller planes run twice, so that their programs are compiled
_GPU = ("one H200 with 16 cores, 1.28 s for 4,194,304 cells, compiled", 1.28 / (1 << 22))
_LARGE = (1e8, 1e10, 1e12)
_THREADS = 128  # threads of workers that take empty tasks: enough that no task waits
_TILE = 32768  # most cells of a tile of a large plane
_GIB = 2**30


class Run(NamedTuple):
    """Cost of a study.

    Attributes:
        cells, tiles: Their numbers.
        seconds: For all cells, without compilation.
        busy: Seconds of all cores, including workers.
        resident: Largest memory of a process in bytes.
        size, files: Bytes and number of the store's files.
        records: Bytes of the records among them.
    """

    cells: int
    tiles: int
    seconds: float
    busy: float
    resident: int
    size: int
    files: int
    records: int

    @property
    def us_per_cell(self) -> float:
        """Return the microseconds per cell."""
        return 1e6 * self.seconds / self.cells


# --- in a separate process -------------------------------------------------------------------------------------------


def study(side: int, settings: str, cores: int, workers: int | None = None, engine: bool = True) -> Run:
    """Run one study on a number of cores of this machine."""
    confine(cores)
    from vijax.simulation import simulate

    if not engine:
        simulate.summarise = idle
    with tempfile.TemporaryDirectory() as folder:
        if workers is None:
            sweep(min(side, _WARM), settings, Path(folder) / "warm.zarr")
        out, progress_log = Path(folder) / "plane.zarr", []
        before, start_time = busy(), time.perf_counter()

        def report(done: int, total: int) -> None:
            progress_log.append((time.perf_counter(), done))

        sweep(side, settings, out, workers, report)
        seconds = time.perf_counter() - start_time
        if workers is not None:  # workers compile, or load stored programs, before their first tiles
            (start, done), (end, total) = progress_log[workers], progress_log[-1]
            seconds = (end - start) * total / (total - done)
        return Run(side * side, len(progress_log) - 1, seconds, busy() - before, resident(), *inventory(out))


def confine(cores: int) -> None:
    """Restrict this process and its children to a number of cores."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    os.cpu_count = lambda: cores


def sweep(
    side: int, settings: str, out: Path, workers: int | None = None, progress: Callable[[int, int], None] | None = None
) -> None:
    """Sweep the plane into a store."""
    import vijax

    d, kappa = np.linspace(0.05, 0.3, side), np.geomspace(3, 400, side)
    vijax.sweep(d=d, kappa=kappa, out=out, workers=workers, progress=progress, **SETTINGS[settings])


def idle(pair: Any, u0: Any, v0: Any, scale: Any, device: Any, **settings: Any) -> Any:
    """Replace the engine: return random numbers at once, the worst case for compression."""
    return _numbers(pair.d.size, scale.length_variant.size)


@cache
def _numbers(cells: int, variants: int) -> Any:
    import jax

    from vijax.simulation import simulate

    blank = simulate.blank(cells, variants, "float64")
    return jax.tree.map(lambda x: np.random.default_rng(0).random(x.shape).astype(x.dtype), blank)


def busy() -> float:
    """Return the seconds of all cores so far, of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def resident() -> int:
    """Return the largest memory so far of this process or a finished child, in bytes."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(usage.ru_maxrss for usage in used) * 1024  # KiB on Linux


def inventory(out: Path) -> tuple[int, int, int]:
    """Return bytes and number of the files of a store, and bytes of its records."""
    sizes = {file: file.stat().st_size for file in out.rglob("*") if file.is_file()}
    records = sum(size for file, size in sizes.items() if file.parent.name == "tiles")
    return sum(sizes.values()), len(sizes), records


def resume(side: int) -> float:
    """Measure the seconds per tile to verify that a finished store is complete."""
    confine(1)
    from vijax.simulation import simulate

    simulate.summarise = idle
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "plane.zarr"
        sweep(side, "default", out)
        start = time.perf_counter()
        sweep(side, "default", out)
        seconds = time.perf_counter() - start
        return seconds / len(list(out.glob("status/tiles/[0-9]*.json")))


def dealing(tasks: int) -> float:
    """Measure the tasks per second of one driver and its scheduler with workers that do nothing."""
    from vijax.maps.execution import cluster

    os.cpu_count = lambda: _THREADS
    done = cluster.run_tasks(nothing, range(tasks + 1), 2)
    next(done)
    start = time.perf_counter()
    return sum(1 for _ in done) / (time.perf_counter() - start)


def nothing(task: int) -> None:
    """Do an empty task."""


def weights(side: int) -> tuple[int, float]:
    """Return bytes of a task, and bytes per cell in a driver for a plane with kappa from two axes."""
    from vijax.maps import sweep as sweeps
    from vijax.maps.storage import tiled_store as studies

    plan_of_axes = sweeps.plan({"d": np.linspace(0.05, 0.3, side), "kappa": np.geomspace(3, 400, side)})
    physical_plan = sweeps.plan({"omega": np.linspace(3, 9, side), "omega0": np.linspace(50, 400, side)})
    with (
        tempfile.TemporaryDirectory() as folder,
        studies.open_study(plan_of_axes, Path(folder) / "plane.zarr") as plane,
    ):
        return len(pickle.dumps(plane.tile(0))), len(pickle.dumps(physical_plan)) / physical_plan.count


SEPARATE: dict[str, Callable[..., Any]] = {
    "study": study,
    "resume": resume,
    "dealing": dealing,
    "weights": weights,
}


def in_separate_process(name: str, **arguments: Any) -> Any:
    """Run a measurement in a separate process; return its result."""
    command = [sys.executable, __file__, "--apart", json.dumps([name, arguments])]
    output = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    return json.loads(output.splitlines()[-1])


# --- measurements ----------------------------------------------------------------------------------------------------


def growth(settings: str, sides: tuple[int, ...], repeats: int) -> Run:
    """Measure cost and memory for growing planes, all on two cores; return the largest run."""
    print(f"\n{settings} settings, two cores")
    print("       cells  tiles  us/cell  busy us/cell  bytes/cell  files  resident GiB")
    for side in sides:
        runs = [Run(*in_separate_process("study", side=side, settings=settings, cores=2)) for _ in range(repeats)]
        run = statistics.median_low(sorted(runs, key=lambda run: run.seconds))
        print(
            f"{run.cells:12,} {run.tiles:6,} {run.us_per_cell:8.2f} {1e6 * run.busy / run.cells:13.2f} "
            f"{run.size / run.cells:11.1f} {run.files:6,} {run.resident / _GIB:13.2f}",
            flush=True,
        )
    return run


def bookkeeping(side: int, complete: Run) -> None:
    """Measure the cost besides simulation: busy time of a run with an idle engine, relative to a complete run."""
    without_engine = Run(*in_separate_process("study", side=side, settings="default", cores=2, engine=False))
    idle, full = (1e6 * run.busy / run.cells for run in (without_engine, complete))
    print(
        f"\ntiles without simulating: {idle:.2f} us/cell of core time, {idle / full:.2%} of the {full:.1f} by default"
    )


def scaling(side: int, repeats: int) -> None:
    """Compare one core with two, and one worker with two, in turn."""
    alternatives = {"cores": [{"cores": 1}, {"cores": 2}], "workers": [{"cores": n, "workers": n} for n in (1, 2)]}
    print()
    for name, both in alternatives.items():
        ratios, rates = [], []
        for _ in range(repeats):
            single, double = (
                Run(*in_separate_process("study", side=side, settings="default", **arguments)) for arguments in both
            )
            ratios.append(single.seconds / double.seconds)
            rates.append(1e6 / double.us_per_cell)
        spread = f" ({min(ratios):.2f} to {max(ratios):.2f})" if repeats > 1 else ""
        print(
            f"two {name} against one: {statistics.median(ratios):.2f} times{spread}, {statistics.median(rates):,.0f} "
            f"cells/s on {side} x {side}",
            flush=True,
        )


def table(run: Run) -> None:
    """Print hours and gigabytes of large planes."""
    print("\n       cells   2 cores [h]   one GPU [h]  100 GPUs [h]    store [GB]  files")
    for cells in _LARGE:
        hours, gpu = (seconds * cells / 3600 for seconds in (run.seconds / run.cells, _GPU[1]))
        print(
            f"{cells:12.0e} {hours:13,.1f} {gpu:13,.2f} {gpu / 100:13,.3f} "
            f"{run.size / run.cells * cells / 1e9:13,.1f}  {run.files / run.tiles * cells / _TILE:.1e}"
        )
    print(
        f"2 cores: in proportion to the {run.cells:,} cells measured, as is the store. GPU: {_GPU[0]},"
        "\nand in proportion to that; 100: 100 times as fast."
    )


def limits(run: Run, quick: bool) -> None:
    """Print which limit is reached first."""
    rate = in_separate_process("dealing", tasks=200 if quick else 2000)
    task, size = in_separate_process("weights", side=300 if quick else 3000)
    repeat = in_separate_process("resume", side=300 if quick else 1000)
    gpus = 100 / _GPU[1] / _TILE
    record = run.records / run.tiles
    print(
        f"\nmeasured: {rate:,.0f} tasks/s through one driver; {task / 1e3:.1f} kB a task; {record:,.0f} bytes a record;"
    )
    print(
        f"{1e3 * repeat:.1f} ms a tile to find a store whole; {size:.1f} bytes a cell in the driver where kappa follows"
    )
    print("from two axes (omega, omega0), none where every quantity has an axis of its own (d, kappa)")
    print("\n       cells      tiles  records [GB]  look over [h]  axes of (omega, omega0) [GB]")
    for cells in _LARGE:
        tiles = cells / _TILE
        print(
            f"{cells:12.0e} {tiles:10,.0f} {tiles * record / 1e9:13.3f} {tiles * repeat / 3600:14.2f} "
            f"{size * cells / 1e9:29,.1f}"
        )
    ratio = gpus / rate
    print(
        f"100 such GPUs would finish {gpus:,.0f} tiles/s of {_TILE:,} cells, {ratio:.2g} of what one driver hands out"
    )


# --- the command -----------------------------------------------------------------------------------------------------


def main() -> None:
    """Measure and print all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--most", action="store_true", help="planes of 10^7 cells too, with cheap settings")
    parser.add_argument("--quick", action="store_true", help="small planes: does it run?")
    parser.add_argument("--repeats", type=int, default=1, help="of each measurement [1]")
    parser.add_argument("--apart", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.apart:
        name, arguments = json.loads(options.apart)
        print(json.dumps(SEPARATE[name](**arguments)))
        return

    with tempfile.TemporaryDirectory() as cache:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        print(f"{os.cpu_count()} cores, {os.getloadavg()[0]:.1f} processes waiting or running beside this")
        small = (32, 100, 317)
        cheap = small if options.quick else (*small, 1000, *((3163,) if options.most else ()))
        growth("cheap", cheap, options.repeats)
        largest = growth("default", small if options.quick else (*small, 1000), options.repeats)
        bookkeeping(317 if options.quick else 1000, largest)
        scaling(256 if options.quick else 512, options.repeats)
        table(largest)
        limits(largest, options.quick)


if __name__ == "__main__":
    main()
