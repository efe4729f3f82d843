"""Are the standard errors of `vijax.fit` right, and does it find the device where the bench makes errors?

    python benchmarks/fitting.py                          # both parts; rows are kept
    python benchmarks/fitting.py --only faults --devices 30
    python benchmarks/fitting.py --print                  # figures of the rows that are kept

clean: 100 random devices with d from 0.12 to 0.6, 202 impacts each. The search for kappa and r begins a tenth off
(kappa by a factor, r by a tenth of 1, one standard deviation). Times are off by 1e-3 of a forcing period.

faults: 200 random devices with d log-uniform from 0.03 to 10, up to 170 impacts each, timed to 1e-4 of a forcing
period. Up to three impacts are false and up to three are missed. Two to four of omega0, r, s and beta are unknown; the
search begins 5 % off. A device is drawn again if it has fewer than 120 impacts in 4000 periods, which do not suffice,
or if impacts follow each other within 20 timing errors, which no bench resolves; the printout has how many.

Of each part the printout has: how many fits converge; of the values that these fits state, how many are within two
standard errors (95 of 100 are expected) and how far off the worst one is; how many values are not stated; how many
slopes of the test of constancy are within two standard errors; and seconds.
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
from benchmarks.orbits import say
from vijax.model.device import Harvester, with_pair

ROWS = tables.ROWS / "fitting.csv"
UNKNOWN = "omega0", "r", "s", "beta"
PERIODS, MOST, IMPACTS, FEWEST = 4000, 460, 170, 120
TIMING, RESOLVED = 2e-4, 20  # error of a time in half forcing periods; gaps of fewer errors are not resolved
FAULTS = 3
OFF = 0.05  # where the search begins, in relative terms
WIDE = 1.0  # the gap from which on a row of its own is printed


class Row(NamedTuple):
    """One unknown of one fit.

    Attributes:
        part, seed: Which device.
        d, kappa, r, gamma: Its numbers.
        impacts, false, missed: How many impacts the bench prints, how many of them are false, how many it missed.
        found_false: How many impacts the fit takes as false.
        drawn: How many devices were drawn until this one.
        name: The unknown.
        truth, value, stderr: Its true value, the fitted one and its standard error.
        converged, alternatives, p_value: As the fit has them.
        pull: (value - truth) / stderr.
        slope: Slope of r over the speed, in standard errors; it is 0.
        seconds: Of processor time.
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
    found_false: int
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
    """A device, the impacts that a bench prints, and what is known of the device.

    Attributes:
        device: The true one.
        times, sides: Impacts [s].
        false: Which of them are false.
        missed: How many are missing.
        timing_error: Standard error of a time [s].
        guess: Where the search begins.
        unknown: Names of the unknowns.
        drawn: How many devices were drawn.
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
        kept = slice(transient, min(int(run.filled), transient + impacts))
        n, t, side = (np.asarray(getattr(run.impacts, name))[kept] for name in ("n", "t", "side"))
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
    """Draw a device, time its impacts, and add and remove some."""
    rng = np.random.default_rng([7, seed])
    device, times, sides, drawn = _device(rng)
    chosen = set(rng.choice(UNKNOWN, int(rng.integers(2, 5)), replace=False))
    unknown = tuple(name for name in UNKNOWN if name in chosen)
    extra, missed = (int(count) for count in rng.integers(0, FAULTS + 1, 2))
    noise = TIMING * rng.standard_normal(times.size)
    guess = {name: getattr(device, name) * float(np.exp(OFF * rng.standard_normal())) for name in unknown}
    if "r" in guess:
        guess["r"] = min(guess["r"], 0.98)
    times, sides, false = _spoiled(rng, times + noise, sides, extra, missed)
    half = np.pi / float(device.omega)
    begin = dataclasses.replace(device, **guess)
    return Bench(device, half * times, sides, false, missed, half * TIMING, begin, unknown, drawn)


def _device(rng: np.random.Generator) -> tuple[Harvester, np.ndarray, np.ndarray, int]:
    """Draw a device, and onsets in half periods and walls of its impacts, until a bench can time them."""
    drawn = 0
    while True:
        drawn += 1
        A, omega = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((1, 10), (5, 50)))
        d, kappa = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((0.03, 10), (5, 80)))
        r, gamma = float(rng.uniform(0.3, 0.85)), float(rng.uniform(-0.15, 0.15))
        skipped = int(rng.choice([10, 60, 200]))
        start = rng.uniform(-0.45, 0.45) * d, float(rng.uniform(-0.5, 0.5))
        plain = vijax.Harvester(A=A, omega=omega, r=r)
        device = dataclasses.replace(
            plain,
            s=d * A * np.pi**2 / omega**2,
            omega0=kappa * omega / np.pi,
            beta=float(np.arcsin(gamma * A / plain.g)),
        )
        run = vijax.trajectory(device.pair(), *start, PERIODS, max_impacts=MOST)
        kept = slice(skipped, min(int(run.filled), skipped + IMPACTS))
        n, t, side = (np.asarray(getattr(run.impacts, name))[kept] for name in ("n", "t", "side"))
        times = 2.0 * n + t
        if times.size >= FEWEST and np.diff(times).min() >= RESOLVED * TIMING:
            return device, times, side.astype(float), drawn


def _spoiled(
    rng: np.random.Generator, times: np.ndarray, sides: np.ndarray, extra: int, missed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Remove impacts, and add false ones: times, walls, and which are false."""
    lost = rng.choice(np.arange(1, times.size - 1), missed, replace=False)
    times, sides = np.delete(times, lost), np.delete(sides, lost)
    before = rng.choice(times.size - 1, extra, replace=False)
    part = rng.uniform(0.1, 0.9, extra)
    added = times[before] + part * (times[before + 1] - times[before])
    walls = rng.choice([-1.0, 1.0], extra)
    order = np.argsort(np.append(times, added), kind="stable")
    false = np.append(np.zeros(times.size, bool), np.ones(extra, bool))
    return np.append(times, added)[order], np.append(sides, walls)[order], false[order]


PARTS: dict[str, tuple[Callable[[int], Bench], int]] = {"clean": (clean_bench, 100), "faults": (faulty_bench, 200)}


def fitted(part: str, seed: int) -> list[Row]:
    """Fit a device: a row an unknown."""
    bench = PARTS[part][0](seed)
    begun = time.process_time()
    found = vijax.fit(
        bench.times, bench.sides, timing_error=bench.timing_error, device=bench.guess, unknown=bench.unknown
    )
    seconds = time.process_time() - begun
    pair = bench.device.pair()
    d, kappa, r, gamma = (float(getattr(pair, name)) for name in ("d", "kappa", "r", "gamma"))
    counts = bench.times.size, int(bench.false.sum()), bench.missed, int(found.false.sum()), bench.drawn
    slope = found.constancy.slope / found.constancy.stderr
    rows = []
    for name in bench.unknown:
        truth = kappa if name == "kappa" else float(getattr(bench.device, name))
        value, stderr = found.values[name], found.stderr[name]
        stated = truth, value, stderr, (value - truth) / stderr
        verdict = found.converged, len(found.alternatives), found.misfit.p_value
        rows.append(Row(part, seed, d, kappa, r, gamma, *counts, name, *stated, *verdict, slope, seconds))
    return rows


def measured(parts: list[str], devices: int | None, first: int) -> Iterator[Row]:
    """Fit the devices of some parts."""
    for part in parts:
        count = devices or PARTS[part][1]
        for seed in range(first, first + count):
            yield from fitted(part, seed)


def print_figures(rows: list[Any]) -> None:
    """Print the figures of rows."""
    for part in PARTS:
        every = [row for row in rows if row.part == part]
        _print_part(part, every)
        if part == "faults":
            _print_part(f"{part}, d above {WIDE:g}", [row for row in every if row.d > WIDE])


def _print_part(title: str, rows: list[Any]) -> None:
    if not rows:
        return
    fits = list({row.seed: row for row in rows}.values())
    converged = [row for row in fits if str(row.converged) == "True"]
    say(
        f"{title}: fits that converge",
        f"{len(converged)} of {len(fits)}, of {sum(row.drawn for row in fits):.0f} drawn",
    )
    stated = [row for row in rows if str(row.converged) == "True" and np.isfinite(row.stderr)]
    pulls = np.abs([row.pull for row in stated])
    say(
        f"{title}: values within two standard errors",
        f"{(pulls <= 2).sum()} of {pulls.size}, {(pulls <= 2).mean():.1%}",
    )
    worst = max(stated, key=lambda row: abs(row.pull))
    say(f"{title}: root of the mean square error, worst value", f"{np.sqrt(np.mean(pulls**2)):.2f}, {worst.pull:.1f}")
    say(f"{title}: device and unknown of the worst value", f"{worst.seed:.0f}, {worst.name}")
    say(f"{title}: values of these fits that are not stated", str(sum(not np.isfinite(row.stderr) for row in rows)))
    say(f"{title}: fits that name others as good", str(sum(row.alternatives > 0 for row in converged)))
    say(f"{title}: devices not found", str([int(row.seed) for row in fits if row not in converged]))
    slopes = np.abs([row.slope for row in converged])
    say(f"{title}: slopes of r over speed within two standard errors", f"{(slopes <= 2).sum()} of {slopes.size}")
    right = sum(row.false == row.found_false for row in fits)
    say(f"{title}: fits with the right number of false impacts", f"{right} of {len(fits)}")
    seconds = [row.seconds for row in fits]
    say(f"{title}: processor seconds of a fit, median, most", f"{statistics.median(seconds):.2f}, {max(seconds):.1f}")


def main() -> None:
    """Fit what the command line asks for, keep the rows, and print their figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=list(PARTS), action="append", help="one part; may be given again")
    parser.add_argument("--devices", type=int, help="how many devices of each part, all unless given")
    parser.add_argument("--first", type=int, default=0, help="the first device")
    parser.add_argument("--rows", type=Path, default=ROWS, help="file for the rows")
    parser.add_argument("--print", action="store_true", help="print the rows that are there, and fit nothing")
    given = parser.parse_args()
    if not given.print:
        parts = given.only or list(PARTS)
        others = [row for row in tables.read(given.rows) if row.part not in parts]
        tables.write(given.rows, Row._fields, measured(parts, given.devices, given.first), kept=others)
    print_figures(tables.read(given.rows))


if __name__ == "__main__":
    main()
