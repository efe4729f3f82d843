"""What does an accelerator make of planes: are they right there, how long does an impact take, what does a map cost?

    python benchmarks/accelerator.py                     # on the accelerator that JAX finds, else on the CPU
    python benchmarks/accelerator.py --wheels FOLDER     # on a machine without a network: what it lacks is carried
    python benchmarks/accelerator.py --only right plane  # some parts
    python benchmarks/accelerator.py --reference         # on a CPU: renew what results are compared with

One line a figure, each also written at once to `rows/accelerator.csv`. A part is begun while there is time left for it
(`--seconds`, 540 unless given); tests come last and take what is left. Seconds are medians of runs that compile
nothing: what they need is compiled ahead, side by side.
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
_FIELDS = ("part", "what", "value", "unit", "device")
_SIDES = (32, 100, 316, 1024, 3163)
_PEAK = {"flops": (34e12, "34 TFLOP/s"), "bytes accessed": (3.35e12, "3.35 TB/s")}
"""Of an H100 by its data sheet: float64 without tensor cores, and memory."""

Figure = tuple[str, float, str]
"""What was measured, its value, and the unit of that."""


def plane(side: int, **others: Any) -> dict[str, Any]:
    """Give what `vijax.sweep` is told of the default plane with so many cells along each axis."""
    return {"d": np.linspace(0.05, 0.3, side), "kappa": np.geomspace(3, 400, side), "r": 0.5} | others


COMPARED: dict[str, dict[str, Any]] = {
    "level": plane(128),
    "gamma 0.5": plane(64, gamma=0.5),
    "rigid": {"d": np.linspace(0.05, 0.6, 64), "r": np.linspace(0.2, 0.9, 64), "wall": "rigid"},
}


def timed(work: Callable[[], Any], runs: int = 3) -> float:
    """Measure the median seconds of some calls; what they compile is compiled."""
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds)


def ahead(parts: list[str]) -> float:
    """Compile what the parts will run, side by side; return the seconds that it takes."""
    import vijax

    begun = time.perf_counter()
    asked: dict[str, dict[Any, dict[str, Any]]] = {"right": COMPARED, "impacts": WINDOWS, "maps": MAPS}
    planes = [one for part in parts for one in asked.get(part, {}).values()]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        work = [pool.submit(vijax.sweep, **one) for one in planes]
        if "basins" in parts:
            work.append(pool.submit(vijax.basins, **STARTS))
        wait(work)  # what fails here fails again where it is measured
    return time.perf_counter() - begun


# --- what is measured ------------------------------------------------------------------------------------------------


def right() -> Iterator[Figure]:
    """Compare labels and powers with those of a CPU, cell by cell."""
    import vijax

    kept = np.load(_REFERENCE)
    for name, asked in COMPARED.items():
        found = vijax.sweep(**asked)
        period, power = kept[f"{name}, period"], kept[f"{name}, P"]
        regular = period > 0
        same = regular & (found.period.values == period)
        away = np.abs(found.P.values - power)[same] / np.abs(power[same])
        yield f"{name}: cells on an orbit on the CPU", int(regular.sum()), "cells"
        yield f"{name}: of these, with another label", int((regular & ~same).sum()), "cells"
        yield f"{name}: of the others, P away by more than 1e-9 of it", int((away > 1e-9).sum()), "cells"
        yield f"{name}: largest difference of P", away.max(), "of P"
        yield (
            f"{name}: undecided or chaos on one of them alone",
            int(((period > 0) != (found.period > 0)).sum()),
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
    """Measure what an impact costs as lanes become many: windows, nothing but counts asked for.

    And what each costs that a longer window has more: without what is done once for each cell, or each tile.
    """
    import vijax

    def run(asked: dict[str, Any]) -> tuple[float, float]:
        number = asked["periods"] * float(vijax.sweep(**asked).impacts_per_period.sum())
        return number, timed(partial(vijax.sweep, **asked), runs=2)

    for side, asked in WINDOWS.items():
        number, seconds = run(asked)
        yield f"{side * side:,} cells, {number:.2g} impacts", 1e9 * seconds / number, "ns an impact"
        more, longer = run(asked | {"periods": 1100 if side <= 1024 else 200})
        rate = 1e9 * (longer - seconds) / (more - number)
        yield f"{side * side:,} cells, each of {more - number:.2g} impacts more", rate, "ns an impact"


def maps() -> Iterator[Figure]:
    """Measure maps of attractors with P."""
    import vijax

    for name, asked in MAPS.items():
        yield name, timed(partial(vijax.sweep, **asked), runs=2), "s"


def basins() -> Iterator[Figure]:
    """Measure the basins of a million starts."""
    import vijax

    yield "1,000 x 1,000 starts", timed(partial(vijax.basins, **STARTS), runs=2), "s"


def orbits() -> Iterator[Figure]:
    """Measure orbits a second, each verified: `orbits.py --only throughput`."""
    told = subprocess.run(
        [sys.executable, "benchmarks/orbits.py", "--only", "throughput"], cwd=_HERE, capture_output=True, text=True
    )
    rate = re.search(r"orbits per second.*?\s\s+([\d,]+)", told.stdout)
    if rate is None:
        raise RuntimeError(f"benchmarks/orbits.py must tell a rate; it said: {(told.stdout + told.stderr)[-2000:]}")
    yield "150,000 symmetric orbits 1:1", float(rate[1].replace(",", "")), "a second"


def kernels() -> Iterator[Figure]:
    """Say how a level plane is compiled, what it holds, and what a step moves and computes if it is stored."""
    import jax

    from vijax.batch import cell_program, lanes, rows, simulate
    from vijax.batch.cell import Plan, Settings
    from vijax.model.device import Harvester, electrical
    from vijax.runtime import xla

    plan, cells = Plan(deep=True, work=True, energies=True), 1 << 20
    kind = np.dtype("float64")
    one: Any = jax.ShapeDtypeStruct((), kind)
    device = jax.tree.map(lambda x: one, electrical(Harvester()))
    variant: Any = jax.ShapeDtypeStruct((1,), kind)
    settings = Settings(one, one, device, None, variant, variant)
    table = jax.ShapeDtypeStruct((cells, rows.width(cell_program.entry_shapes(plan, kind))), kind)
    width = lanes.width_of(cells)

    def tile(table, count, settings):
        outputs = rows.width(simulate.shapes(plan, kind))
        return lanes.run(cell_program.program(plan, settings), table, count, outputs, width)

    begun = time.perf_counter()
    lowered = jax.jit(tile).lower(table, jax.ShapeDtypeStruct((), np.int32), settings)
    traced = time.perf_counter()
    made: Any = lowered.compile(compiler_options=xla.compiler_options())
    yield "tracing a plane", traced - begun, "s"
    yield "compiling it", time.perf_counter() - traced, "s"
    memory = made.memory_analysis()
    held = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    yield f"memory of a tile of {cells:,} cells", held / 2**20, "MiB"
    held = made.as_text().count('custom_call_target="__gpu$xla.gpu.triton"')
    yield "kernels in which lanes stay in registers", held, "kernels"
    first = jax.ShapeDtypeStruct((width, table.shape[1]), kind)
    lane = jax.eval_shape(lambda first, settings: cell_program.program(plan, settings).load(first), first, settings)
    one_step = jax.jit(lambda cell, settings: cell_program.program(plan, settings).step(cell))
    costs: Any = one_step.lower(lane, settings).compile().cost_analysis() or {}  # not every platform tells
    for name in _PEAK.keys() & costs.keys():
        most, told = _PEAK[name]
        yield f"{name} of a step of a lane, by XLA", costs[name] / width, "a step"
        yield f"time of a step of a lane at {told}", 1e9 * costs[name] / width / most, "ns"


def tests(seconds: float) -> Iterator[Figure]:
    """Run the tests of engine and batch, as long as there is time."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "8",
        "-p",
        "no:cacheprovider",
        "tests/engine",
        "tests/batch",
        "tests/runtime/test_xla.py",
    ]
    try:
        done = subprocess.run(command, cwd=_HERE, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired as late:
        print(late.stdout[-2000:] if late.stdout else "", file=sys.stderr)
        yield "tests of engine and batch did not end within", seconds, "s"
        return
    print(done.stdout[-3000:], file=sys.stderr)
    for number, what in re.findall(r"(\d+) (passed|failed|errors?)", done.stdout.splitlines()[-1]):
        yield f"tests of engine and batch that {what}", int(number), "tests"


PARTS: dict[str, Callable[[], Iterator[Figure]]] = {
    "right": right,
    "kernels": kernels,
    "maps": maps,
    "impacts": impacts,
    "basins": basins,
    "orbits": orbits,
}


# --- the command -----------------------------------------------------------------------------------------------------


def rows(parts: list[str], seconds: float, device: str) -> Iterator[tuple[Any, ...]]:
    """Measure part by part; one that fails says why, and the next one follows."""
    begun = time.perf_counter()
    yield from shown("ahead", [("compiling what will be run, side by side", ahead(parts), "s")], device)
    for part in parts:
        left = seconds - (time.perf_counter() - begun)
        if left < 20:
            print(f"{part}: no time is left", flush=True)
            continue
        try:
            yield from shown(part, tests(left) if part == "tests" else PARTS[part](), device)
        except Exception as error:
            print(f"{part}: {type(error).__name__}: {str(error)[:600]}", flush=True)


def shown(part: str, figures: Iterable[Figure], device: str) -> Iterator[tuple[Any, ...]]:
    """Print figures as they come, and make rows of them."""
    for what, value, unit in figures:
        print(f"{part:<8} {what:<64} {value:.4g} {unit}", flush=True)
        yield part, what, f"{value:.6g}", unit, device


def renew_reference() -> None:
    """Keep labels and powers of the planes that are compared, as this CPU finds them."""
    import vijax

    kept: dict[str, Any] = {}
    for name, asked in COMPARED.items():
        found = vijax.sweep(**asked)
        kept |= {f"{name}, period": found.period.values.astype(np.int16), f"{name}, P": found.P.values}
    np.savez_compressed(_REFERENCE, **kept)


def bring(wheels: Path) -> None:
    """Start again with the wheels of a folder installed for this run alone."""
    site = tempfile.mkdtemp()
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--no-compile", "--target", site]
    subprocess.run([*pip, *map(str, wheels.glob("*.whl"))], check=True)
    path = os.pathsep.join([str(_HERE), site, os.environ.get("PYTHONPATH", "")])
    rest = [word for word in sys.argv if word != "--wheels" and word != str(wheels)]
    os.execve(sys.executable, [sys.executable, *rest], os.environ | {"PYTHONPATH": path})


def main() -> int:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=[*PARTS, "tests"], default=[*PARTS, "tests"], metavar="PART")
    parser.add_argument("--seconds", type=float, default=540.0)
    parser.add_argument("--wheels", type=Path, help="a folder of wheels to install before")
    parser.add_argument("--reference", action="store_true", help="renew what results are compared with, and end")
    asked = parser.parse_args()
    if asked.wheels:
        bring(asked.wheels)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # or the tests' processes find no memory
    import jax

    from benchmarks import tables

    if asked.reference:
        renew_reference()
        return 0
    device = f"{jax.devices()[0].device_kind} of {jax.device_count()}"
    print(f"{device}, JAX {jax.__version__}, {os.cpu_count()} cores beside it", flush=True)
    tables.write(_ROWS / "accelerator.csv", _FIELDS, rows(asked.only, asked.seconds, device))
    return 0


if __name__ == "__main__":
    sys.exit(main())
