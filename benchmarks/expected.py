"""How much time does a map of many starts per cell take, and does it agree with basins?

    python benchmarks/expected.py             # 64 starts, the default plane of 128 x 128 cells
    python benchmarks/expected.py --cells 32  # along each axis, of the costs
    python benchmarks/expected.py --starts 16

One line a figure. Seconds and memory are of separate processes with compiled programs: three pairs, one start and many
in turn, medians. The compared table is from `basin_fractions` with the same number of starts, for 200 random cells.
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
from benchmarks.orbits import print_figure
from vijax.maps.sweep_settings import STARTS

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
            code = f"from benchmarks.expected import print_cost; print_cost({cells}, {number})"
            process = subprocess.run(
                [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=_HERE
            )
            duration, peak = map(float, process.stdout.split())
            seconds[number].append(duration)
            peaks[number].append(peak)
    single, many = (statistics.median(seconds[number]) for number in (1, starts))
    ratio = f"{single:.2f}, {many:.1f}, {many / single:.1f}"
    print_figure(f"{cells} x {cells} cells, seconds of one start, of {starts}, ratio", ratio)
    single, many = (statistics.median(peaks[number]) for number in (1, starts))
    print_figure("peak memory of the process, MB, ratio", f"{single:.0f}, {many:.0f}, {many / single:.2f}")


def print_cost(cells: int, starts: int) -> None:
    """Print the seconds of a map with compiled programs, and the peak memory of the process in megabytes."""
    axes = plane(cells)
    vijax.sweep(**axes, starts=min(starts, 2))
    start = time.perf_counter()
    vijax.sweep(**axes, starts=starts)
    print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)


def agreement(starts: int) -> None:
    """Compare the map of random cells with their basins."""
    draw = np.random.default_rng(0)
    z_values, different_counts = [], []
    places = np.exp(draw.uniform(np.log((0.03, 3)), np.log((10, 400)), (_COMPARED, 2)))
    for d, kappa in places:
        axes: dict[str, Any] = {"d": d, "kappa": kappa, "r": 0.5}
        expected = vijax.sweep(**axes, starts=starts)
        table = vijax.basin_fractions(**axes, starts=starts, seed=1, merge_mirrors=True)
        share, power = table.fraction.values, table.P.fillna(0.0).values
        table_power = (share * power).sum()
        error = np.hypot(
            float(expected.P_stderr), np.sqrt(max((share * power**2).sum() - table_power**2, 0.0) / starts)
        )
        difference = abs(float(expected.P) - table_power)
        different_counts.append(int(expected.attractors) != int(table.attractors))
        z_values.append(difference / max(error, 1e-9 * table_power))
    for group, selected in (("", places[:, 0] > 0), (", d above 1", places[:, 0] > 1)):
        z, other_number = np.array(z_values)[selected], np.array(different_counts)[selected]
        title = f"{selected.sum()} random cells{group}"
        print_figure(f"{title}, P of a lattice and of random starts: more than 3 errors apart", str((z > 3).sum()))
        print_figure(f"{title}: root mean square of the difference over its error", f"{np.sqrt(np.mean(z**2)):.2f}")
        print_figure(f"{title}: where the other starts find another number of attractors", str(other_number.sum()))


def main() -> int:
    """Print the parts that the command line selects."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cells", type=int, default=_CELLS)
    parser.add_argument("--starts", type=int, default=STARTS)
    options = parser.parse_args()
    costs(options.cells, options.starts)
    agreement(options.starts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
