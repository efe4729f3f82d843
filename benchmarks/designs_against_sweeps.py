"""Are designs the best of their devices, in narrow and in wide gaps? Against plain sweeps of random devices.

    python benchmarks/designs_against_sweeps.py                       # 120 devices, an hour; rows/designs.csv
    python benchmarks/designs_against_sweeps.py --devices 30 --only attractor
    python benchmarks/designs_against_sweeps.py --sweeps sweeps.json  # sweeps are kept in a file, and made once

Devices: d log-uniform from 0.03 to 10, r 0.2 to 0.9, A 1 to 20 m/s^2, omega log-uniform from pi to 400 rad/s. The
radius of the membrane is log-uniform from 0.05 to 1 units of length, the voltage such that the undeformed membrane
stores 1e-3 to 0.1 of m_b (A pi/omega)^2, log-uniform; all else is of Tables I and II, in proportion.

The sweep of a device simulates 64 starts at 200 values of omega0, log-uniform over the bounds of the design, for 400
periods. Each of two measures is applied to both sides.

attractor: P of the best admissible attractor, compared with designs for "P". For an orbit that is its P; for aperiodic
motion the mean of all starts that end on no orbit, if all of them keep the limits. In the presence of other aperiodic
starts, a start without an impact in the window counts as aperiodic, with P = 0: in a wide gap impacts are rare.

expected: the mean P of all starts, if all of them keep the limits, compared with designs for "expected".

The eight best cells of the sweep are measured again, by 256 starts and 5,000 periods, and so is the design. If none of
these starts reaches the orbit of a design for "P" at its omega0, the orbit's own P counts.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import tables
from vijax.design.aperiodic.motion_averages import Averages, summary_averages
from vijax.design.optimise import Design, optimise
from vijax.design.survey.attractor_survey import simulate_survey
from vijax.maps.basins import SPEED
from vijax.maps.execution.start_lattice import unit_starts
from vijax.model.choices import Objective
from vijax.model.device import Harvester
from vijax.model.records import USABLE_STATUSES, Status
from vijax.model.tuned_quantities import bounds_of, to_variables, tuned_devices_and_pairs
from vijax.simulation.simulate import Starts

SEED = 70
D, RESTITUTION, A, OMEGA = (0.03, 10.0), (0.2, 0.9), (1.0, 20.0), (math.pi, 400.0)
RADIUS, STORED = (0.05, 1.0), (1e-3, 0.1)
POINTS, STARTS, PERIODS = 200, 64, 400
CONFIRMED, MORE_STARTS, MORE_PERIODS = 8, 256, 5000
SAME_DEPTH = 0.02  # aperiodic starts with a smaller difference of log depth share an attractor
SAME_P = 1e-6  # relative difference of P below which two starts share an orbit
ENOUGH, LEAST = 0.99, 0.9  # fractions of the sweep's best
CONFIDENCE = 2  # standard errors


def device(number: int) -> Harvester:
    """Draw a random device."""
    draw = np.random.default_rng([SEED, number])

    def log_uniform(low: float, high: float) -> float:
        return math.exp(draw.uniform(math.log(low), math.log(high)))

    d, omega = log_uniform(*D), log_uniform(*OMEGA)
    r, amplitude = draw.uniform(*RESTITUTION), draw.uniform(*A)
    paper = Harvester()
    unit = Harvester(A=amplitude, omega=omega)
    radius = log_uniform(*RADIUS) * float(unit.length_unit)
    scale = radius / float(np.asarray(paper.R0))
    thickness = scale * float(np.asarray(paper.w0))
    capacitance = float(np.asarray(paper.eps_M)) * math.pi * radius**2 / thickness
    voltage = math.sqrt(log_uniform(*STORED) * float(paper.m_b) * float(unit.speed_unit) ** 2 / capacitance)
    return Harvester(
        s=d * float(unit.length_unit),
        r=r,
        A=amplitude,
        omega=omega,
        R0=radius,
        w0=thickness,
        r_b=scale * float(paper.r_b),
        C_T=scale * float(paper.C_T),
        V=voltage,
    )


class Measured(NamedTuple):
    """Best admissible attractor of a device.

    Attributes:
        P, P_stderr: [J]; 0 if nothing is admissible.
        omega0: [rad/s].
        label: Label of the motion.
        share: Fraction of the starts that end on it.
    """

    P: float = 0.0
    P_stderr: float = 0.0
    omega0: float = math.nan
    label: str = ""
    share: float = 0.0


def simulate(system: Harvester, omega0: np.ndarray, starts: int, periods: int) -> Averages:
    """Simulate starts over the whole gap at several values of omega0, [value * start]."""
    z = np.repeat(np.log(omega0), starts)[:, None]
    systems = jax.tree.map(lambda x: np.full(len(z), float(x)), system)
    tuned_systems, pair = jax.tree.map(np.asarray, tuned_devices_and_pairs(systems, jnp.asarray(z), ("omega0",)))
    u, v = (np.tile(x, len(omega0)) for x in unit_starts(starts))
    initial = Starts(*map(jnp.asarray, (u * pair.d, 2 * SPEED * v, np.zeros(len(z)))))
    return summary_averages(
        tuned_systems, simulate_survey(pair, tuned_systems, initial, max_period=8, periods=periods).summary
    )


def attractors(averages_of_cell: Averages, omega0: float) -> list[Measured]:
    """Return the admissible attractors of the starts of one cell."""
    is_admissible = averages_of_cell.margins().min(axis=1) >= 0
    P, status, names = np.nan_to_num(averages_of_cell.P), averages_of_cell.status, averages_of_cell.labels()
    periodic = (averages_of_cell.period > 0) & np.isin(status, USABLE_STATUSES) & (P > 0)
    result = []
    for row in np.flatnonzero(periodic & is_admissible):
        same_orbit = periodic & (np.abs(P / P[row] - 1) < SAME_P)
        result.append(Measured(float(P[row]), 0.0, omega0, str(names[row]), float(same_orbit.mean())))
    no_impact = status == Status.NO_IMPACT
    moving = ~periodic & ~no_impact & (P > 0)
    with np.errstate(divide="ignore"):
        depth = np.log(averages_of_cell.depth)
    rows = np.flatnonzero(moving)
    rows = rows[np.argsort(depth[rows])]
    groups = np.split(rows, np.flatnonzero(np.diff(depth[rows]) > SAME_DEPTH) + 1) if rows.size else []
    if no_impact.any() or len(groups) > 4:
        # Long flights without an impact make depths differ on one attractor, so all starts form one group.
        groups = [np.flatnonzero(moving | no_impact)] if rows.size else []
    for group in groups:
        if is_admissible[group].all():
            error = float(P[group].std() / math.sqrt(group.size))
            result.append(Measured(float(P[group].mean()), error, omega0, "aperiodic", group.size / P.size))
    return result


def expected(averages_of_cell: Averages, omega0: float) -> list[Measured]:
    """Average all starts of one cell, if all of them keep the limits."""
    P = np.nan_to_num(averages_of_cell.P)
    if averages_of_cell.margins().min() < 0 or not P.any():
        return []
    names, counts = np.unique(averages_of_cell.labels(), return_counts=True)
    error = float(P.std() / math.sqrt(P.size))
    return [Measured(float(P.mean()), error, omega0, str(names[counts.argmax()]), float(counts.max() / P.size))]


MEASURES: dict[str, Callable[[Averages, float], list[Measured]]] = {"attractor": attractors, "expected": expected}
OBJECTIVES: dict[str, Objective] = {"attractor": "P", "expected": "expected"}


def best(measure: str, simulated: Averages, omega0: np.ndarray, starts: int) -> list[Measured]:
    """Return the best value of every cell by a measure; P = 0 if there is none."""
    rows = (simulated.select(slice(i * starts, (i + 1) * starts)) for i in range(len(omega0)))
    per_cell = (MEASURES[measure](candidates, float(x)) for candidates, x in zip(rows, omega0, strict=True))
    return [max(candidates, default=Measured()) for candidates in per_cell]


def measured(measure: str, system: Harvester, omega0: list[float]) -> list[Measured]:
    """Measure values of omega0 by many starts and long simulations."""
    values = np.array(omega0)
    return best(measure, simulate(system, values, MORE_STARTS, MORE_PERIODS), values, MORE_STARTS) if omega0 else []


def swept(system: Harvester) -> dict[str, Measured]:
    """Return the best value of a plain sweep by every measure."""
    low, high = np.exp(to_variables(("omega0",), bounds_of(("omega0",), {}, system)))[:, 0]
    omega0 = np.geomspace(low, high, POINTS)
    simulated, best_by_measure = simulate(system, omega0, STARTS, PERIODS), {}
    for measure in MEASURES:
        order = sorted(
            (candidate for candidate in best(measure, simulated, omega0, STARTS) if candidate.P > 0), reverse=True
        )
        confirmed = measured(measure, system, [candidate.omega0 for candidate in order[:CONFIRMED]])
        best_by_measure[measure] = max(confirmed, default=Measured())
    return best_by_measure


class Row(NamedTuple):
    """A device, its sweep and its design, by a measure."""

    measure: str
    number: int
    d: float
    r: float
    A: float
    omega: float
    sweep_P: float
    sweep_P_stderr: float
    sweep_omega0: float
    sweep_label: str
    sweep_share: float
    design_P: float
    design_P_stderr: float
    design_omega0: float
    design_label: str
    reported_P: float
    reported_P_stderr: float
    ratio: float
    noise: float
    seconds: float
    notes: str


def compared(measure: str, number: int, sweep: Measured) -> Row:
    """Design a device, and measure the design like the sweep."""
    system = device(number)
    start = time.perf_counter()
    result = optimise(system, objective=OBJECTIVES[measure])
    seconds = time.perf_counter() - start
    optimum = result.best
    confirmed = Measured()
    if optimum is not None:
        (confirmed,) = measured(measure, system, [optimum.values["omega0"]])
        if measure == "attractor" and optimum.label != "aperiodic" and optimum.P > confirmed.P:
            confirmed = Measured(optimum.P, 0.0, optimum.values["omega0"], optimum.label)
    return Row(
        measure,
        number,
        float(system.pair().d),
        float(np.asarray(system.r)),
        float(system.A),
        float(system.omega),
        *sweep,
        *confirmed[:4],
        optimum.P if optimum else 0.0,
        optimum.P_stderr if optimum else 0.0,
        confirmed.P / sweep.P if sweep.P else math.nan,
        math.hypot(confirmed.P_stderr, sweep.P_stderr) / sweep.P if sweep.P else math.nan,
        seconds,
        notes(result),
    )


def notes(result: Design) -> str:
    """Summarise the candidates of a design."""
    dropped = "; ".join(
        f"{candidate.values} {candidate.label} {candidate.predicted:.3g}: {candidate.reason}"
        for candidate in result.dropped[:3]
    )
    return (
        f"{result.ascents} orbits and {result.places} places climbed, {len(result.dropped)} dropped {dropped}".strip()
    )


def load_or_sweep(numbers: range, file: Path | None) -> dict[int, dict[str, Measured]]:
    """Sweep every device; sweeps stored in the file are not repeated."""
    stored = json.loads(file.read_text()) if file is not None and file.exists() else {}
    for number in numbers:
        if str(number) not in stored:
            stored[str(number)] = swept(device(number))
            if file is not None:
                file.write_text(json.dumps(stored))
    return {number: {name: Measured(*values) for name, values in stored[str(number)].items()} for number in numbers}


def print_figure(quantity: str, value: str) -> None:
    """Print one figure."""
    print(f"{quantity:<80} {value}", flush=True)


def report(measure: str, rows: list[Row]) -> None:
    """Print the figures of a measure: all devices, narrow gaps and wide gaps."""
    for name, selected in (
        ("all", rows),
        ("d below 0.3", [row for row in rows if row.d < 0.3]),
        ("d above 1", [row for row in rows if row.d > 1]),
    ):
        with_motion = [row for row in selected if row.sweep_P > 0]
        if not with_motion:
            continue
        ratio, noise = (np.array([getattr(row, field) for row in with_motion]) for field in ("ratio", "noise"))
        title, seconds = f"{measure}, {name}", [row.seconds for row in selected]
        print_figure(
            f"{title}: devices; with an admissible motion in the sweep", f"{len(selected)}; {len(with_motion)}"
        )
        print_figure(f"{title}: at least {ENOUGH} of the sweep's best", f"{(ratio >= ENOUGH).mean():.1%}")
        print_figure(
            f"{title}: at least that, or {CONFIDENCE} standard errors less",
            f"{(ratio + CONFIDENCE * noise >= ENOUGH).mean():.1%}",
        )
        print_figure(
            f"{title}: below {LEAST}; no design",
            f"{(ratio < LEAST).sum()}; {sum(not row.reported_P for row in with_motion)}",
        )
        print_figure(
            f"{title}: least, median, largest", f"{ratio.min():.4f}, {np.median(ratio):.4f}, {ratio.max():.4f}"
        )
        print_figure(f"{title}: seconds a design, median, most", f"{np.median(seconds):.2f}, {max(seconds):.1f}")


def measure_designs(measures: list[str], sweeps: dict[int, dict[str, Measured]]) -> Iterator[Row]:
    """Design every device by each measure, and print the misses and the figures."""
    for measure in measures:
        rows = []
        for number, sweep in sweeps.items():
            rows.append(compared(measure, number, sweep[measure]))
            if not rows[-1].ratio >= ENOUGH:
                print("   ", rows[-1], flush=True)
            yield rows[-1]
        report(measure, rows)


def main() -> int:
    """Print the figures and store the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--devices", type=int, default=120)
    parser.add_argument("--first", type=int, default=0, help="number of the first device")
    parser.add_argument("--only", choices=MEASURES, help="one measure")
    parser.add_argument("--sweeps", type=Path, help="file that keeps the sweeps")
    parser.add_argument("--rows", type=Path, default=tables.ROWS / "designs.csv")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    sweeps = load_or_sweep(range(options.first, options.first + options.devices), options.sweeps)
    measures = [options.only] if options.only else list(MEASURES)
    tables.write(options.rows, Row._fields, measure_designs(measures, sweeps))
    return 0


if __name__ == "__main__":
    sys.exit(main())
