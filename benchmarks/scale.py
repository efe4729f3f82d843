"""What does a plane cost that outgrows this machine, in hours and gigabytes, and what breaks first?

    python benchmarks/scale.py            # everything; planes of 10^3 to 10^6 cells
    python benchmarks/scale.py --most     # and of 10^7
    python benchmarks/scale.py --quick    # small planes: does it run?

Every measurement is a study of the (d, kappa) plane in a process of its own, on so many cores, compiled beforehand:
with default settings; with cheap ones (5 periods), where what is done besides simulating shows; and with an engine that
does nothing, where nothing else is left. From these the table: its cost on two cores is measured up to 10^6 cells and
in proportion to the cells beyond; that on a GPU is what 2048 x 2048 cells took on one (`accelerator.py`).
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
_WARM = 363  # the least side whose tiles are compiled as those of any larger plane; smaller planes are run twice
_GPU = ("one H200 with 16 cores, 1.28 s for 4,194,304 cells, compiled", 1.28 / (1 << 22))
_LARGE = (1e8, 1e10, 1e12)
_THREADS = 128  # of workers that take empty tasks: so many that no turn is waited for
_TILE = 32768  # cells of the tiles of large planes, at most
_GIB = 2**30


class Run(NamedTuple):
    """What a study took.

    Attributes:
        cells, tiles: How many.
        seconds: For all cells, nothing compiling.
        busy: Seconds of all cores, with those of workers.
        resident: Bytes that the largest of its processes held at most.
        size, files: Of the store, in bytes and as a number.
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
    def each(self) -> float:
        """Give the microseconds a cell."""
        return 1e6 * self.seconds / self.cells


# --- in a process of its own -----------------------------------------------------------------------------------------


def study(side: int, settings: str, cores: int, workers: int | None = None, engine: bool = True) -> Run:
    """Run one study, on so many cores of this machine."""
    confine(cores)
    from vijax.batch import simulate

    if not engine:
        simulate.summarise = idle
    with tempfile.TemporaryDirectory() as folder:
        if workers is None:
            sweep(min(side, _WARM), settings, Path(folder) / "warm.zarr")
        out, told = Path(folder) / "plane.zarr", []
        before, began = busy(), time.perf_counter()

        def tell(done: int, total: int) -> None:
            told.append((time.perf_counter(), done))

        sweep(side, settings, out, workers, tell)
        seconds = time.perf_counter() - began
        if workers is not None:  # which compile, or load what was compiled, before their first tiles
            (start, done), (end, total) = told[workers], told[-1]
            seconds = (end - start) * total / (total - done)
        return Run(side * side, len(told) - 1, seconds, busy() - before, resident(), *inventory(out))


def confine(cores: int) -> None:
    """Leave this process, and those that it starts, so many cores."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    os.cpu_count = lambda: cores


def sweep(
    side: int, settings: str, out: Path, workers: int | None = None, tell: Callable[[int, int], None] | None = None
) -> None:
    """Sweep the plane into a store."""
    import vijax

    d, kappa = np.linspace(0.05, 0.3, side), np.geomspace(3, 400, side)
    vijax.sweep(d=d, kappa=kappa, out=out, workers=workers, progress=tell, **SETTINGS[settings])


def idle(pair: Any, u0: Any, v0: Any, scale: Any, device: Any, **settings: Any) -> Any:
    """Stand in for the engine: numbers at once, which compress as badly as any."""
    return _numbers(pair.d.size, scale.length_variant.size)


@cache
def _numbers(cells: int, variants: int) -> Any:
    import jax

    from vijax.batch import simulate

    blank = simulate.blank(cells, variants, "float64")
    return jax.tree.map(lambda x: np.random.default_rng(0).random(x.shape).astype(x.dtype), blank)


def busy() -> float:
    """Count seconds of all cores so far, of this process and of those that it started and that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def resident() -> int:
    """Count the bytes that the largest of these processes held at most."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(one.ru_maxrss for one in used) * 1024  # KiB on Linux


def inventory(out: Path) -> tuple[int, int, int]:
    """Count bytes and number of the files of a store, and bytes of its records."""
    sizes = {file: file.stat().st_size for file in out.rglob("*") if file.is_file()}
    records = sum(size for file, size in sizes.items() if file.parent.name == "tiles")
    return sum(sizes.values()), len(sizes), records


def resume(side: int) -> float:
    """Measure the seconds a tile to find that a finished store is whole."""
    confine(1)
    from vijax.batch import simulate

    simulate.summarise = idle
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "plane.zarr"
        sweep(side, "default", out)
        began = time.perf_counter()
        sweep(side, "default", out)
        seconds = time.perf_counter() - began
        return seconds / len(list(out.glob("status/tiles/[0-9]*.json")))


def dealing(tasks: int) -> float:
    """Measure the tasks a second that one driver and its scheduler come to, when workers do nothing but take them."""
    from vijax.planes import cluster

    os.cpu_count = lambda: _THREADS
    done = cluster.done(nothing, range(tasks + 1), 2)
    next(done)
    began = time.perf_counter()
    return sum(1 for _ in done) / (time.perf_counter() - began)


def nothing(task: int) -> None:
    """Do an empty task."""


def weights(side: int) -> tuple[int, float]:
    """Measure bytes of a task, and bytes a cell that a driver holds of a plane whose kappa follows from two axes."""
    from vijax.planes import sweep as sweeps
    from vijax.planes import tiled_store as studies

    plain = sweeps.plan({"d": np.linspace(0.05, 0.3, side), "kappa": np.geomspace(3, 400, side)})
    physical = sweeps.plan({"omega": np.linspace(3, 9, side), "omega0": np.linspace(50, 400, side)})
    with tempfile.TemporaryDirectory() as folder, studies.opened(plain, Path(folder) / "plane.zarr") as plane:
        return len(pickle.dumps(plane.tile(0))), len(pickle.dumps(physical)) / physical.count


APART: dict[str, Callable[..., Any]] = {
    "study": study,
    "resume": resume,
    "dealing": dealing,
    "weights": weights,
}


def apart(what: str, **arguments: Any) -> Any:
    """Run one of these in a process of its own; give its result."""
    command = [sys.executable, __file__, "--apart", json.dumps([what, arguments])]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    return json.loads(said.splitlines()[-1])


# --- what is measured ------------------------------------------------------------------------------------------------


def growth(settings: str, sides: tuple[int, ...], repeats: int) -> Run:
    """Measure cost and memory as the plane grows, all on two cores; return the largest."""
    print(f"\n{settings} settings, two cores")
    print("       cells  tiles  us/cell  busy us/cell  bytes/cell  files  resident GiB")
    for side in sides:
        runs = [Run(*apart("study", side=side, settings=settings, cores=2)) for _ in range(repeats)]
        run = statistics.median_low(sorted(runs, key=lambda run: run.seconds))
        print(
            f"{run.cells:12,} {run.tiles:6,} {run.each:8.2f} {1e6 * run.busy / run.cells:13.2f} "
            f"{run.size / run.cells:11.1f} {run.files:6,} {run.resident / _GIB:13.2f}",
            flush=True,
        )
    return run


def bookkeeping(side: int, whole: Run) -> None:
    """Measure all besides simulating: the busy time of a run whose engine does nothing, in that of a whole one."""
    bare = Run(*apart("study", side=side, settings="default", cores=2, engine=False))
    idle, full = (1e6 * run.busy / run.cells for run in (bare, whole))
    print(
        f"\ntiles without simulating: {idle:.2f} us/cell of core time, {idle / full:.2%} of the {full:.1f} by default"
    )


def scaling(side: int, repeats: int) -> None:
    """Compare one core with two, and one worker of a core with two, in turn."""
    ways = {"cores": [{"cores": 1}, {"cores": 2}], "workers": [{"cores": n, "workers": n} for n in (1, 2)]}
    print()
    for name, both in ways.items():
        ratios, rates = [], []
        for _ in range(repeats):
            one, two = (Run(*apart("study", side=side, settings="default", **way)) for way in both)
            ratios.append(one.seconds / two.seconds)
            rates.append(1e6 / two.each)
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
    """Print what breaks first."""
    rate = apart("dealing", tasks=200 if quick else 2000)
    task, held = apart("weights", side=300 if quick else 3000)
    again = apart("resume", side=300 if quick else 1000)
    gpus = 100 / _GPU[1] / _TILE
    record = run.records / run.tiles
    print(
        f"\nmeasured: {rate:,.0f} tasks/s through one driver; {task / 1e3:.1f} kB a task; {record:,.0f} bytes a record;"
    )
    print(
        f"{1e3 * again:.1f} ms a tile to find a store whole; {held:.1f} bytes a cell in the driver where kappa follows"
    )
    print("from two axes (omega, omega0), none where every quantity has an axis of its own (d, kappa)")
    print("\n       cells      tiles  records [GB]  look over [h]  axes of (omega, omega0) [GB]")
    for cells in _LARGE:
        tiles = cells / _TILE
        print(
            f"{cells:12.0e} {tiles:10,.0f} {tiles * record / 1e9:13.3f} {tiles * again / 3600:14.2f} "
            f"{held * cells / 1e9:29,.1f}"
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
    given = parser.parse_args()
    if given.apart:
        what, arguments = json.loads(given.apart)
        print(json.dumps(APART[what](**arguments)))
        return

    with tempfile.TemporaryDirectory() as cache:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        print(f"{os.cpu_count()} cores, {os.getloadavg()[0]:.1f} processes waiting or running beside this")
        small = (32, 100, 317)
        cheap = small if given.quick else (*small, 1000, *((3163,) if given.most else ()))
        growth("cheap", cheap, given.repeats)
        whole = growth("default", small if given.quick else (*small, 1000), given.repeats)
        bookkeeping(317 if given.quick else 1000, whole)
        scaling(256 if given.quick else 512, given.repeats)
        table(whole)
        limits(whole, given.quick)


if __name__ == "__main__":
    main()
