"""Are the standard errors of `vijax.fit` correct, and does it identify the device from faulty measurements?

    python benchmarks/fitting.py                          # both parts; rows are stored
    python benchmarks/fitting.py --only faults --devices 30
    python benchmarks/fitting.py --print                  # figures of the stored rows

clean: 100 random devices with d from 0.12 to 0.6, 202 impacts each. The search for kappa and r starts off by a tenth
(kappa by a factor, r by a tenth of 1, one standard deviation). Times are off by 1e-3 of a forcing period.

faults: 200 random devices with d log-uniform from 0.03 to 10, up to 170 impacts each, timed to 1e-4 of a forcing
period. Up to three impacts are false and up to three are missed. Two to four of omega0, r, s and beta are unknown; the
search starts 5 % off. A device is drawn again if it has fewer than 120 impacts in 4000 periods, too few for a fit, or
if impacts follow each other within 20 timing errors, which no bench resolves; the printout has the number of draws.

For each part the printout has: the number of converged fits; for values with a standard error, the number within two
standard errors (95 of 100 are expected) and the worst deviation; the number of values without a standard error; the
number of slopes of the test of constancy within two standard errors; and seconds.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import vijax
from benchmarks import tables
from benchmarks.orbits import print_figure
from vijax.model.device import Harvester, with_pair

ROWS = tables.ROWS / "fitting.csv"
UNKNOWN = "omega0", "r", "s", "beta"
PERIODS, MOST, IMPACTS, FEWEST = 4000, 460, 170, 120
TIMING, RESOLVED = 2e-4, 20  # error of a time in half forcing periods; least interval in such errors
FAULTS = 3
OFF = 0.05  # relative offset of the search's start
WIDE = 1.0  # gap above which devices have an additional row


class Row(NamedTuple):
    """One unknown of one fit.

    Attributes:
        part, seed: Part and number of the device.
        d, kappa, r, gamma: Parameters of the device.
        impacts, false, missed: Number of impacts that the bench prints, of false ones among them, and of missed ones.
        classified_false: Number of impacts that the fit classifies as false.
        drawn: Number of draws until this device.
        name: The unknown.
        truth, value, stderr: True value, fitted value and standard error.
        converged, alternatives, p_value: As in the fit.
        pull: (value - truth) / stderr.
        slope: Slope of r over the speed, in standard errors; the true slope is 0.
        seconds: Processor time.
    """

    part: str
    seed: int
    d: float
    kappa: float
    r: float
    gamma: float
    impacts: int
    false: int
    missed: int
    classified_false: int
    drawn: int
    name: str
    truth: float
    value: float
    stderr: float
    pull: float
    converged: bool
    alternatives: int
    p_value: float
    slope: float
    seconds: float


class Bench(NamedTuple):
    """A device, the impacts that a bench prints, and the prior knowledge of the device.

    Attributes:
        device: The true device.
        times, sides: Impacts [s].
        false: Which impacts are false.
        missed: Number of missing impacts.
        timing_error: Standard error of a time [s].
        guess: Start of the search.
        unknown: Names of the unknowns.
        drawn: Number of draws.
    """

    device: Harvester
    times: np.ndarray
    sides: np.ndarray
    false: np.ndarray
    missed: int
    timing_error: float
    guess: Harvester
    unknown: tuple[str, ...]
    drawn: int


def clean_bench(seed: int) -> Bench:
    """Draw a device and time its impacts without faults; a half period of the default device is one second."""
    rng, drawn, error, impacts, transient = np.random.default_rng(seed), 0, 2e-3, 202, 60
    while True:
        drawn += 1
        truth = {
            "d": float(np.exp(rng.uniform(np.log(0.12), np.log(0.6)))),
            "kappa": float(np.exp(rng.uniform(np.log(5), np.log(80)))),
            "r": float(rng.uniform(0.3, 0.85)),
            "gamma": float(rng.uniform(-0.15, 0.15)),
        }
        run = vijax.trajectory(vijax.impact_pair(**truth), 0.01, -0.4, 150, max_impacts=1000)
        recorded = slice(transient, min(int(run.filled), transient + impacts))
        n, t, side = (np.asarray(getattr(run.impacts, name))[recorded] for name in ("n", "t", "side"))
        if n.size >= FEWEST:
            break
    times = 2.0 * n + t + error * rng.standard_normal(n.size)
    device, guess = (_with_numbers(numbers) for numbers in (truth, _off(rng, truth)))
    none = np.zeros(n.size, bool)
    return Bench(device, times, side.astype(float), none, 0, error, guess, ("kappa", "r"), drawn)


def _off(rng: np.random.Generator, truth: dict[str, float]) -> dict[str, float]:
    kappa = truth["kappa"] * float(np.exp(0.1 * rng.standard_normal()))
    return truth | {"kappa": kappa, "r": float(np.clip(truth["r"] + 0.1 * rng.standard_normal(), 0.1, 0.95))}


def _with_numbers(numbers: dict[str, float]) -> Harvester:
    return jax.tree.map(float, with_pair(vijax.Harvester(), vijax.impact_pair(**numbers)))


def faulty_bench(seed: int) -> Bench:
    """Draw a device, time its impacts, and add and remove some impacts."""
    rng = np.random.default_rng([7, seed])
    device, times, sides, drawn = _device(rng)
    selected = set(rng.choice(UNKNOWN, int(rng.integers(2, 5)), replace=False))
    unknown = tuple(name for name in UNKNOWN if name in selected)
    extra, missed = (int(count) for count in rng.integers(0, FAULTS + 1, 2))
    noise = TIMING * rng.standard_normal(times.size)
    guess = {name: getattr(device, name) * float(np.exp(OFF * rng.standard_normal())) for name in unknown}
    if "r" in guess:
        guess["r"] = min(guess["r"], 0.98)
    times, sides, false = _spoiled(rng, times + noise, sides, extra, missed)
    half = np.pi / float(device.omega)
    start_device = dataclasses.replace(device, **guess)
    return Bench(device, half * times, sides, false, missed, half * TIMING, start_device, unknown, drawn)


def _device(rng: np.random.Generator) -> tuple[Harvester, np.ndarray, np.ndarray, int]:
    """Draw devices until a bench can time one; return it with onsets in half periods and walls of its impacts."""
    drawn = 0
    while True:
        drawn += 1
        A, omega = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((1, 10), (5, 50)))
        d, kappa = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((0.03, 10), (5, 80)))
        r, gamma = float(rng.uniform(0.3, 0.85)), float(rng.uniform(-0.15, 0.15))
        skipped = int(rng.choice([10, 60, 200]))
        start = rng.uniform(-0.45, 0.45) * d, float(rng.uniform(-0.5, 0.5))
        base_device = vijax.Harvester(A=A, omega=omega, r=r)
        device = dataclasses.replace(
            base_device,
            s=d * A * np.pi**2 / omega**2,
            omega0=kappa * omega / np.pi,
            beta=float(np.arcsin(gamma * A / base_device.g)),
        )
        run = vijax.trajectory(device.pair(), *start, PERIODS, max_impacts=MOST)
        recorded = slice(skipped, min(int(run.filled), skipped + IMPACTS))
        n, t, side = (np.asarray(getattr(run.impacts, name))[recorded] for name in ("n", "t", "side"))
        times = 2.0 * n + t
        if times.size >= FEWEST and np.diff(times).min() >= RESOLVED * TIMING:
            return device, times, side.astype(float), drawn


def _spoiled(
    rng: np.random.Generator, times: np.ndarray, sides: np.ndarray, extra: int, missed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Remove impacts, and add false ones; return times, walls, and which impacts are false."""
    removed = rng.choice(np.arange(1, times.size - 1), missed, replace=False)
    times, sides = np.delete(times, removed), np.delete(sides, removed)
    before = rng.choice(times.size - 1, extra, replace=False)
    fraction = rng.uniform(0.1, 0.9, extra)
    added = times[before] + fraction * (times[before + 1] - times[before])
    walls = rng.choice([-1.0, 1.0], extra)
    order = np.argsort(np.append(times, added), kind="stable")
    false = np.append(np.zeros(times.size, bool), np.ones(extra, bool))
    return np.append(times, added)[order], np.append(sides, walls)[order], false[order]


PARTS: dict[str, tuple[Callable[[int], Bench], int]] = {"clean": (clean_bench, 100), "faults": (faulty_bench, 200)}


def fitted(part: str, seed: int) -> list[Row]:
    """Fit a device; return one row per unknown."""
    bench = PARTS[part][0](seed)
    start = time.process_time()
    result = vijax.fit(
        bench.times, bench.sides, timing_error=bench.timing_error, device=bench.guess, unknown=bench.unknown
    )
    seconds = time.process_time() - start
    pair = bench.device.pair()
    d, kappa, r, gamma = (float(getattr(pair, name)) for name in ("d", "kappa", "r", "gamma"))
    counts = bench.times.size, int(bench.false.sum()), bench.missed, int(result.false.sum()), bench.drawn
    slope = result.constancy.slope / result.constancy.stderr
    rows = []
    for name in bench.unknown:
        truth = kappa if name == "kappa" else float(getattr(bench.device, name))
        value, stderr = result.values[name], result.stderr[name]
        estimate = truth, value, stderr, (value - truth) / stderr
        quality = result.converged, len(result.alternatives), result.misfit.p_value
        rows.append(Row(part, seed, d, kappa, r, gamma, *counts, name, *estimate, *quality, slope, seconds))
    return rows


def measured(parts: list[str], devices: int | None, first: int) -> Iterator[Row]:
    """Fit the devices of several parts."""
    for part in parts:
        count = devices or PARTS[part][1]
        for seed in range(first, first + count):
            yield from fitted(part, seed)


def print_figures(rows: list[Any]) -> None:
    """Print the figures of rows."""
    for part in PARTS:
        rows_of_part = [row for row in rows if row.part == part]
        _print_part(part, rows_of_part)
        if part == "faults":
            _print_part(f"{part}, d above {WIDE:g}", [row for row in rows_of_part if row.d > WIDE])


def _print_part(title: str, rows: list[Any]) -> None:
    if not rows:
        return
    fits = list({row.seed: row for row in rows}.values())
    converged = [row for row in fits if str(row.converged) == "True"]
    print_figure(
        f"{title}: fits that converge",
        f"{len(converged)} of {len(fits)}, of {sum(row.drawn for row in fits):.0f} drawn",
    )
    estimated = [row for row in rows if str(row.converged) == "True" and np.isfinite(row.stderr)]
    pulls = np.abs([row.pull for row in estimated])
    print_figure(
        f"{title}: values within two standard errors",
        f"{(pulls <= 2).sum()} of {pulls.size}, {(pulls <= 2).mean():.1%}",
    )
    worst = max(estimated, key=lambda row: abs(row.pull))
    print_figure(
        f"{title}: root of the mean square error, worst value", f"{np.sqrt(np.mean(pulls**2)):.2f}, {worst.pull:.1f}"
    )
    print_figure(f"{title}: device and unknown of the worst value", f"{worst.seed:.0f}, {worst.name}")
    print_figure(
        f"{title}: values of these fits that are not stated", str(sum(not np.isfinite(row.stderr) for row in rows))
    )
    print_figure(f"{title}: fits that name others as good", str(sum(row.alternatives > 0 for row in converged)))
    print_figure(f"{title}: devices not found", str([int(row.seed) for row in fits if row not in converged]))
    slopes = np.abs([row.slope for row in converged])
    print_figure(
        f"{title}: slopes of r over speed within two standard errors", f"{(slopes <= 2).sum()} of {slopes.size}"
    )
    right = sum(row.false == row.classified_false for row in fits)
    print_figure(f"{title}: fits with the right number of false impacts", f"{right} of {len(fits)}")
    seconds = [row.seconds for row in fits]
    print_figure(
        f"{title}: processor seconds of a fit, median, most", f"{statistics.median(seconds):.2f}, {max(seconds):.1f}"
    )


def main() -> None:
    """Fit the devices that the command line selects, store the rows, and print their figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=list(PARTS), action="append", help="one part; may be given again")
    parser.add_argument("--devices", type=int, help="how many devices of each part, all unless given")
    parser.add_argument("--first", type=int, default=0, help="the first device")
    parser.add_argument("--rows", type=Path, default=ROWS, help="file for the rows")
    parser.add_argument("--print", action="store_true", help="print the rows that are there, and fit nothing")
    options = parser.parse_args()
    if not options.print:
        parts = options.only or list(PARTS)
        others = [row for row in tables.read(options.rows) if row.part not in parts]
        tables.write(options.rows, Row._fields, measured(parts, options.devices, options.first), earlier=others)
    print_figures(tables.read(options.rows))


if __name__ == "__main__":
    main()
