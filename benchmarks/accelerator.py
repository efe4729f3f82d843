"""Are planes correct on an accelerator, how long does an impact take there, and how much time does a map cost?

    python benchmarks/accelerator.py                     # on the accelerator that JAX finds, else on the CPU
    python benchmarks/accelerator.py --wheels FOLDER     # on a machine without a network: install from wheels
    python benchmarks/accelerator.py --only right plane  # some parts
    python benchmarks/accelerator.py --reference         # on a CPU: renew the reference of the comparison

One line a figure, each also written at once to `rows/accelerator.csv`. A part starts while there is time left for it
(`--seconds`, by default 540); tests come last and use the rest. Seconds are medians of runs that compile nothing: all
programs are compiled ahead, side by side.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

_HERE = Path(__file__).parents[1]
_ROWS = _HERE / "benchmarks" / "rows"
_REFERENCE = _ROWS / "accelerator.npz"
_FIELDS = ("part", "quantity", "value", "unit", "device")
_SIDES = (32, 100, 316, 1024, 3163)
_PEAK = {"flops": (34e12, "34 TFLOP/s"), "bytes accessed": (3.35e12, "3.35 TB/s")}
"""Peak rates of an H100 by its data sheet: float64 without tensor cores, and memory."""

Figure = tuple[str, float, str]
"""Measured quantity, its value, and the unit of the value."""


def plane(side: int, **others: Any) -> dict[str, Any]:
    """Return the arguments of `vijax.sweep` for the default plane with a number of cells along each axis."""
    return {"d": np.linspace(0.05, 0.3, side), "kappa": np.geomspace(3, 400, side), "r": 0.5} | others


COMPARED: dict[str, dict[str, Any]] = {
    "level": plane(128),
    "gamma 0.5": plane(64, gamma=0.5),
    "rigid": {"d": np.linspace(0.05, 0.6, 64), "r": np.linspace(0.2, 0.9, 64), "wall": "rigid"},
}


def timed(work: Callable[[], Any], runs: int = 3) -> float:
    """Measure the median seconds of several calls; their programs must be compiled."""
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def ahead(parts: list[str]) -> float:
    """Compile the programs of the parts side by side; return the seconds spent."""
    import vijax

    start = time.perf_counter()
    planes_by_part: dict[str, dict[Any, dict[str, Any]]] = {"right": COMPARED, "impacts": WINDOWS, "maps": MAPS}
    planes = [plane_arguments for part in parts for plane_arguments in planes_by_part.get(part, {}).values()]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        work = [pool.submit(vijax.sweep, **plane_arguments) for plane_arguments in planes]
        if "basins" in parts:
            work.append(pool.submit(vijax.basins, **STARTS))
        wait(work)  # an error here occurs again in the measurement
    return time.perf_counter() - start


# --- measurements ----------------------------------------------------------------------------------------------------


def right() -> Iterator[Figure]:
    """Compare labels and powers with a CPU's results, cell by cell."""
    import vijax

    reference = np.load(_REFERENCE)
    for name, arguments in COMPARED.items():
        dataset = vijax.sweep(**arguments)
        period, power = reference[f"{name}, period"], reference[f"{name}, P"]
        regular = period > 0
        same = regular & (dataset.period.values == period)
        relative_error = np.abs(dataset.P.values - power)[same] / np.abs(power[same])
        yield f"{name}: cells on an orbit on the CPU", int(regular.sum()), "cells"
        yield f"{name}: of these, with another label", int((regular & ~same).sum()), "cells"
        yield f"{name}: of the others, P away by more than 1e-9 of it", int((relative_error > 1e-9).sum()), "cells"
        yield f"{name}: largest difference of P", relative_error.max(), "of P"
        yield (
            f"{name}: undecided or chaos on one of them alone",
            int(((period > 0) != (dataset.period > 0)).sum()),
            "cells",
        )


WINDOWS: dict[int, dict[str, Any]] = {
    side: plane(side, until="window", periods=100, outputs=("impacts_per_period",)) for side in _SIDES
}
MAPS: dict[str, dict[str, Any]] = {
    "1024 x 1024": plane(1024),
    "2048 x 2048": plane(2048),
    "512 x 512, gamma 0.5": plane(512, gamma=0.5),
    "512 x 512, float32": plane(512, dtype="float32"),
}


STARTS: dict[str, Any] = {"d": 0.2, "kappa": 3.0, "r": 0.5, "v0": np.linspace(-0.6, 0.6, 1000)}


def impacts() -> Iterator[Figure]:
    """Measure the cost of an impact as the number of lanes grows: windows that compute impact counts alone.

    The second figure is the cost of each additional impact of a longer window, without the cost per cell or per tile.
    """
    import vijax

    def run(arguments: dict[str, Any]) -> tuple[float, float]:
        number = arguments["periods"] * float(vijax.sweep(**arguments).impacts_per_period.sum())
        return number, timed(partial(vijax.sweep, **arguments), runs=2)

    for side, arguments in WINDOWS.items():
        number, seconds = run(arguments)
        yield f"{side * side:,} cells, {number:.2g} impacts", 1e9 * seconds / number, "ns an impact"
        more, longer = run(arguments | {"periods": 1100 if side <= 1024 else 200})
        rate = 1e9 * (longer - seconds) / (more - number)
        yield f"{side * side:,} cells, each of {more - number:.2g} impacts more", rate, "ns an impact"


def maps() -> Iterator[Figure]:
    """Measure maps of attractors with P."""
    import vijax

    for name, arguments in MAPS.items():
        yield name, timed(partial(vijax.sweep, **arguments), runs=2), "s"


def basins() -> Iterator[Figure]:
    """Measure the basins of a million starts."""
    import vijax

    yield "1,000 x 1,000 starts", timed(partial(vijax.basins, **STARTS), runs=2), "s"


def orbits() -> Iterator[Figure]:
    """Measure orbits a second, each verified: `orbits.py --only throughput`."""
    process = subprocess.run(
        [sys.executable, "benchmarks/orbits.py", "--only", "throughput"], cwd=_HERE, capture_output=True, text=True
    )
    rate = re.search(r"orbits per second.*?\s\s+([\d,]+)", process.stdout)
    if rate is None:
        raise RuntimeError(
            f"benchmarks/orbits.py must print a rate; it printed: {(process.stdout + process.stderr)[-2000:]}"
        )
    yield "150,000 symmetric orbits 1:1", float(rate[1].replace(",", "")), "a second"


def kernels() -> Iterator[Figure]:
    """Measure the compilation of a level plane, its memory, and the traffic and operations of one step."""
    import jax

    from vijax.model.device import Harvester, electrical_device
    from vijax.runtime.compilation import xla
    from vijax.simulation import simulate
    from vijax.simulation.cell import cell_program
    from vijax.simulation.cell.cell import Plan, Settings
    from vijax.simulation.scheduler import lane_scheduler, record_rows

    plan, cells = Plan(deep=True, work=True, energies=True), 1 << 20
    kind = np.dtype("float64")
    scalar: Any = jax.ShapeDtypeStruct((), kind)
    device = jax.tree.map(lambda x: scalar, electrical_device(Harvester()))
    variant: Any = jax.ShapeDtypeStruct((1,), kind)
    settings = Settings(scalar, scalar, device, None, variant, variant)
    table = jax.ShapeDtypeStruct((cells, record_rows.width(cell_program.entry_shapes(plan, kind))), kind)
    width = lane_scheduler.width_of(cells)

    def tile(table, count, settings):
        outputs = record_rows.width(simulate.summary_shapes(plan, kind))
        return lane_scheduler.run(cell_program.program(plan, settings), table, count, outputs, width)

    start = time.perf_counter()
    lowered = jax.jit(tile).lower(table, jax.ShapeDtypeStruct((), np.int32), settings)
    traced = time.perf_counter()
    compiled: Any = lowered.compile(compiler_options=xla.compiler_options())
    yield "tracing a plane", traced - start, "s"
    yield "compiling it", time.perf_counter() - traced, "s"
    memory = compiled.memory_analysis()
    value = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    yield f"memory of a tile of {cells:,} cells", value / 2**20, "MiB"
    value = compiled.as_text().count('custom_call_target="__gpu$xla.gpu.triton"')
    yield "kernels in which lanes stay in registers", value, "kernels"
    first = jax.ShapeDtypeStruct((width, table.shape[1]), kind)
    lane = jax.eval_shape(lambda first, settings: cell_program.program(plan, settings).load(first), first, settings)
    advance_lane = jax.jit(lambda cell, settings: cell_program.program(plan, settings).step(cell))
    costs: Any = advance_lane.lower(lane, settings).compile().cost_analysis() or {}  # not every platform reports costs
    for name in _PEAK.keys() & costs.keys():
        peak, peak_text = _PEAK[name]
        yield f"{name} of a step of a lane, by XLA", costs[name] / width, "a step"
        yield f"time of a step of a lane at {peak_text}", 1e9 * costs[name] / width / peak, "ns"


def tests(seconds: float) -> Iterator[Figure]:
    """Run the tests of engine and batch within the given time."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "8",
        "-p",
        "no:cacheprovider",
        "tests/impact",
        "tests/simulation",
        "tests/runtime/test_xla.py",
    ]
    try:
        done = subprocess.run(command, cwd=_HERE, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired as late:
        print(late.stdout[-2000:] if late.stdout else "", file=sys.stderr)
        yield "tests of engine and batch did not end within", seconds, "s"
        return
    print(done.stdout[-3000:], file=sys.stderr)
    for number, outcome in re.findall(r"(\d+) (passed|failed|errors?)", done.stdout.splitlines()[-1]):
        yield f"tests of engine and batch that {outcome}", int(number), "tests"


PARTS: dict[str, Callable[[], Iterator[Figure]]] = {
    "right": right,
    "kernels": kernels,
    "maps": maps,
    "impacts": impacts,
    "basins": basins,
    "orbits": orbits,
}


# --- the command -----------------------------------------------------------------------------------------------------


def record_rows(parts: list[str], seconds: float, device: str) -> Iterator[tuple[Any, ...]]:
    """Measure part by part; a part that fails prints its error, and the next one follows."""
    start = time.perf_counter()
    yield from print_figures("ahead", [("compiling what will be run, side by side", ahead(parts), "s")], device)
    for part in parts:
        remaining = seconds - (time.perf_counter() - start)
        if remaining < 20:
            print(f"{part}: no time is left", flush=True)
            continue
        try:
            yield from print_figures(part, tests(remaining) if part == "tests" else PARTS[part](), device)
        except Exception as error:
            print(f"{part}: {type(error).__name__}: {str(error)[:600]}", flush=True)


def print_figures(part: str, figures: Iterable[Figure], device: str) -> Iterator[tuple[Any, ...]]:
    """Print figures as they are measured, and yield rows of them."""
    for quantity, value, unit in figures:
        print(f"{part:<8} {quantity:<64} {value:.4g} {unit}", flush=True)
        yield part, quantity, f"{value:.6g}", unit, device


def renew_reference() -> None:
    """Store labels and powers of the compared planes as this CPU computes them."""
    import vijax

    reference: dict[str, Any] = {}
    for name, arguments in COMPARED.items():
        dataset = vijax.sweep(**arguments)
        reference |= {f"{name}, period": dataset.period.values.astype(np.int16), f"{name}, P": dataset.P.values}
    np.savez_compressed(_REFERENCE, **reference)


def bring(wheels: Path) -> None:
    """Restart the command with a folder's wheels installed for this run alone."""
    site = tempfile.mkdtemp()
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--no-compile", "--target", site]
    subprocess.run([*pip, *map(str, wheels.glob("*.whl"))], check=True)
    path = os.pathsep.join([str(_HERE), site, os.environ.get("PYTHONPATH", "")])
    rest = [word for word in sys.argv if word != "--wheels" and word != str(wheels)]
    os.execve(sys.executable, [sys.executable, *rest], os.environ | {"PYTHONPATH": path})


def main() -> int:
    """Measure the parts that the command line selects."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=[*PARTS, "tests"], default=[*PARTS, "tests"], metavar="PART")
    parser.add_argument("--seconds", type=float, default=540.0)
    parser.add_argument("--wheels", type=Path, help="a folder of wheels to install before")
    parser.add_argument("--reference", action="store_true", help="renew what results are compared with, and end")
    options = parser.parse_args()
    if options.wheels:
        bring(options.wheels)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # otherwise the tests' processes find no memory
    import jax

    from benchmarks import tables

    if options.reference:
        renew_reference()
        return 0
    device = f"{jax.devices()[0].device_kind} of {jax.device_count()}"
    print(f"{device}, JAX {jax.__version__}, {os.cpu_count()} cores beside it", flush=True)
    tables.write(_ROWS / "accelerator.csv", _FIELDS, record_rows(options.only, options.seconds, device))
    return 0


if __name__ == "__main__":
    sys.exit(main())
