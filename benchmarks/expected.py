"""What does a map of many starts in every cell cost beside one of a single start, and does it say what basins say?

    python benchmarks/expected.py             # 64 starts, the default plane of 128 x 128 cells
    python benchmarks/expected.py --cells 32  # along each axis, of the costs
    python benchmarks/expected.py --starts 16

One line a figure. Seconds and memory are those of processes of their own, programs compiled before: three pairs, one
start and many in turn, medians. The table of `basin_fractions`, whose starts are the same, is that of 200 random cells.
"""

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import vijax
from benchmarks.accelerator import plane
from benchmarks.orbits import say
from vijax.planes.sweep_settings import STARTS

_HERE = Path(__file__).parents[1]
_CELLS = 128
_COMPARED = 200
_PAIRS = 3


def costs(cells: int, starts: int) -> None:
    """Compare seconds and memory of both maps."""
    seconds: dict[int, list[float]] = {1: [], starts: []}
    peaks: dict[int, list[float]] = {1: [], starts: []}
    for _ in range(_PAIRS):
        for number in seconds:
            code = f"from benchmarks.expected import one; one({cells}, {number})"
            told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=_HERE)
            took, peak = map(float, told.stdout.split())
            seconds[number].append(took)
            peaks[number].append(peak)
    single, many = (statistics.median(seconds[number]) for number in (1, starts))
    ratio = f"{single:.2f}, {many:.1f}, {many / single:.1f}"
    say(f"{cells} x {cells} cells, seconds of one start, of {starts}, ratio", ratio)
    single, many = (statistics.median(peaks[number]) for number in (1, starts))
    say("peak memory of the process, MB, ratio", f"{single:.0f}, {many:.0f}, {many / single:.2f}")


def one(cells: int, starts: int) -> None:
    """Print the seconds of a map, programs compiled, and the peak memory of the process in megabytes."""
    axes = plane(cells)
    vijax.sweep(**axes, starts=min(starts, 2))
    begun = time.perf_counter()
    vijax.sweep(**axes, starts=starts)
    print(time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)


def agreement(starts: int) -> None:
    """Compare the map of random cells with what their basins say."""
    draw = np.random.default_rng(0)
    off, apart = [], []
    places = np.exp(draw.uniform(np.log((0.03, 3)), np.log((10, 400)), (_COMPARED, 2)))
    for d, kappa in places:
        axes: dict[str, Any] = {"d": d, "kappa": kappa, "r": 0.5}
        expected = vijax.sweep(**axes, starts=starts)
        table = vijax.basin_fractions(**axes, starts=starts, seed=1, merge_mirrors=True)
        share, power = table.fraction.values, table.P.fillna(0.0).values
        other = (share * power).sum()
        error = np.hypot(float(expected.P_stderr), np.sqrt(max((share * power**2).sum() - other**2, 0.0) / starts))
        away = abs(float(expected.P) - other)
        apart.append(int(expected.attractors) != int(table.attractors))
        off.append(away / max(error, 1e-9 * other))
    for group, some in (("", places[:, 0] > 0), (", d above 1", places[:, 0] > 1)):
        z, other_number = np.array(off)[some], np.array(apart)[some]
        what = f"{some.sum()} random cells{group}"
        say(f"{what}, P of a lattice and of random starts: more than 3 errors apart", str((z > 3).sum()))
        say(f"{what}: root mean square of the difference over its error", f"{np.sqrt(np.mean(z**2)):.2f}")
        say(f"{what}: where the other starts find another number of attractors", str(other_number.sum()))


def main() -> int:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cells", type=int, default=_CELLS)
    parser.add_argument("--starts", type=int, default=STARTS)
    asked = parser.parse_args()
    costs(asked.cells, asked.starts)
    agreement(asked.starts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
