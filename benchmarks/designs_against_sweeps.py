"""Are designs the best of their devices, in narrow and in wide gaps? Against plain sweeps of random devices.

    python benchmarks/designs_against_sweeps.py                       # 120 devices, an hour; rows/designs.csv
    python benchmarks/designs_against_sweeps.py --devices 30 --only attractor
    python benchmarks/designs_against_sweeps.py --sweeps sweeps.json  # sweeps are kept in a file, and made once

Devices: d log-uniform from 0.03 to 10, r 0.2 to 0.9, A 1 to 20 m/s^2, omega log-uniform from pi to 400 rad/s. The
radius of the membrane is log-uniform from 0.05 to 1 units of length, the voltage such that the undeformed membrane
stores 1e-3 to 0.1 of m_b (A pi/omega)^2, log-uniform; all else is of Tables I and II, in proportion.

The sweep of a device flies 64 starts at 200 values of omega0, log-uniform over the bounds of the design, for 400
periods. Each of two measures serves both sides.

attractor: P of the best admissible attractor, beside designs for "P". Of an orbit that is its P; of aperiodic motion
the mean of all starts that end on no orbit, if all of these keep the limits. Starts without an impact in the window
count as aperiodic, with P = 0, where others are: in a wide gap the ball is without an impact for long, and comes back.

expected: the mean P of all starts, if all of them keep the limits, beside designs for "expected".

The eight best cells of the sweep are measured again, by 256 starts and 5,000 periods, and so is the design. An orbit
that none of these starts meets at the omega0 of a design for "P" has its own P.
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
from vijax.batch.simulate import Starts
from vijax.design.averages import Averages, averages
from vijax.design.optimise import Design, optimise
from vijax.design.survey import survey
from vijax.model.choices import Objective
from vijax.model.device import Harvester
from vijax.model.records import SETTLED, Status
from vijax.model.variables import cells, limits, variables
from vijax.planes.basins import SPEED
from vijax.planes.start_places import start_places

SEED = 70
D, RESTITUTION, A, OMEGA = (0.03, 10.0), (0.2, 0.9), (1.0, 20.0), (math.pi, 400.0)
RADIUS, STORED = (0.05, 1.0), (1e-3, 0.1)
POINTS, STARTS, PERIODS = 200, 64, 400
CONFIRMED, MORE_STARTS, MORE_PERIODS = 8, 256, 5000
SAME_DEPTH = 0.02  # aperiodic starts whose depths differ by less, as logarithms, are on one attractor
SAME_P = 1e-6  # relative difference of P below which two starts are on one orbit
ENOUGH, LEAST = 0.99, 0.9  # of the sweep's best
SURE = 2  # standard errors


def device(number: int) -> Harvester:
    """Draw a device of the population."""
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
    """The best admissible attractor of a device.

    Attributes:
        P, P_stderr: [J]; 0 where nothing is admissible.
        omega0: [rad/s].
        label: Of its motion.
        share: Of the starts that end on it.
    """

    P: float = 0.0
    P_stderr: float = 0.0
    omega0: float = math.nan
    label: str = ""
    share: float = 0.0


def fly(of: Harvester, omega0: np.ndarray, starts: int, periods: int) -> Averages:
    """Fly starts all over the gap at some values of omega0, [value * start]."""
    z = np.repeat(np.log(omega0), starts)[:, None]
    given = jax.tree.map(lambda x: np.full(len(z), float(x)), of)
    every, pair = jax.tree.map(np.asarray, cells(given, jnp.asarray(z), ("omega0",)))
    u, v = (np.tile(x, len(omega0)) for x in start_places(starts))
    begun = Starts(*map(jnp.asarray, (u * pair.d, 2 * SPEED * v, np.zeros(len(z)))))
    return averages(every, survey(pair, every, begun, longest=8, periods=periods).ended)


def attractors(found: Averages, omega0: float) -> list[Measured]:
    """Find the admissible attractors that the starts of one cell ended on."""
    kept = found.margins().min(axis=1) >= 0
    P, status, names = np.nan_to_num(found.P), found.status, found.labels()
    periodic = (found.period > 0) & np.isin(status, SETTLED) & (P > 0)
    some = []
    for row in np.flatnonzero(periodic & kept):
        alike = periodic & (np.abs(P / P[row] - 1) < SAME_P)
        some.append(Measured(float(P[row]), 0.0, omega0, str(names[row]), float(alike.mean())))
    silent = status == Status.NO_IMPACT
    moving = ~periodic & ~silent & (P > 0)
    with np.errstate(divide="ignore"):
        depth = np.log(found.depth)
    rows = np.flatnonzero(moving)
    rows = rows[np.argsort(depth[rows])]
    groups = np.split(rows, np.flatnonzero(np.diff(depth[rows]) > SAME_DEPTH) + 1) if rows.size else []
    if silent.any() or len(groups) > 4:
        # Long flights without an impact make depths differ on one attractor.
        groups = [np.flatnonzero(moving | silent)] if rows.size else []
    for group in groups:
        if kept[group].all():
            error = float(P[group].std() / math.sqrt(group.size))
            some.append(Measured(float(P[group].mean()), error, omega0, "aperiodic", group.size / P.size))
    return some


def expected(found: Averages, omega0: float) -> list[Measured]:
    """Average all starts of one cell, if all of them keep the limits."""
    P = np.nan_to_num(found.P)
    if found.margins().min() < 0 or not P.any():
        return []
    names, counts = np.unique(found.labels(), return_counts=True)
    error = float(P.std() / math.sqrt(P.size))
    return [Measured(float(P.mean()), error, omega0, str(names[counts.argmax()]), float(counts.max() / P.size))]


MEASURES: dict[str, Callable[[Averages, float], list[Measured]]] = {"attractor": attractors, "expected": expected}
OBJECTIVES: dict[str, Objective] = {"attractor": "P", "expected": "expected"}


def best(measure: str, found: Averages, omega0: np.ndarray, starts: int) -> list[Measured]:
    """Find the best value of every cell by a measure; P = 0 where there is none."""
    rows = (found.some(slice(i * starts, (i + 1) * starts)) for i in range(len(omega0)))
    each = (MEASURES[measure](some, float(x)) for some, x in zip(rows, omega0, strict=True))
    return [max(some, default=Measured()) for some in each]


def measured(measure: str, of: Harvester, omega0: list[float]) -> list[Measured]:
    """Measure values of omega0 by many starts and long flights."""
    values = np.array(omega0)
    return best(measure, fly(of, values, MORE_STARTS, MORE_PERIODS), values, MORE_STARTS) if omega0 else []


def swept(of: Harvester) -> dict[str, Measured]:
    """Find the best of a plain sweep by every measure."""
    low, high = np.exp(variables(("omega0",), limits(("omega0",), {}, of)))[:, 0]
    omega0 = np.geomspace(low, high, POINTS)
    found, known = fly(of, omega0, STARTS, PERIODS), {}
    for measure in MEASURES:
        order = sorted((one for one in best(measure, found, omega0, STARTS) if one.P > 0), reverse=True)
        again = measured(measure, of, [one.omega0 for one in order[:CONFIRMED]])
        known[measure] = max(again, default=Measured())
    return known


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
    """Design a device and measure the design as the sweep was."""
    of = device(number)
    begun = time.perf_counter()
    found = optimise(of, objective=OBJECTIVES[measure])
    seconds = time.perf_counter() - begun
    one = found.best
    own = Measured()
    if one is not None:
        (own,) = measured(measure, of, [one.values["omega0"]])
        if measure == "attractor" and one.label != "aperiodic" and one.P > own.P:
            own = Measured(one.P, 0.0, one.values["omega0"], one.label)
    return Row(
        measure,
        number,
        float(of.pair().d),
        float(np.asarray(of.r)),
        float(of.A),
        float(of.omega),
        *sweep,
        *own[:4],
        one.P if one else 0.0,
        one.P_stderr if one else 0.0,
        own.P / sweep.P if sweep.P else math.nan,
        math.hypot(own.P_stderr, sweep.P_stderr) / sweep.P if sweep.P else math.nan,
        seconds,
        notes(found),
    )


def notes(found: Design) -> str:
    """Sum up the candidates of a design."""
    lost = "; ".join(f"{one.values} {one.label} {one.predicted:.3g}: {one.reason}" for one in found.dropped[:3])
    return f"{found.ascents} orbits and {found.places} places climbed, {len(found.dropped)} dropped {lost}".strip()


def kept(numbers: range, file: Path | None) -> dict[int, dict[str, Measured]]:
    """Sweep every device; what a file holds is not swept again."""
    known = json.loads(file.read_text()) if file is not None and file.exists() else {}
    for number in numbers:
        if str(number) not in known:
            known[str(number)] = swept(device(number))
            if file is not None:
                file.write_text(json.dumps(known))
    return {number: {name: Measured(*one) for name, one in known[str(number)].items()} for number in numbers}


def say(what: str, value: str) -> None:
    """Print one figure."""
    print(f"{what:<80} {value}", flush=True)


def report(measure: str, rows: list[Row]) -> None:
    """Print what the rows of a measure hold, for all devices, narrow gaps and wide gaps."""
    for name, some in (
        ("all", rows),
        ("d below 0.3", [row for row in rows if row.d < 0.3]),
        ("d above 1", [row for row in rows if row.d > 1]),
    ):
        there = [row for row in some if row.sweep_P > 0]
        if not there:
            continue
        ratio, noise = (np.array([getattr(row, field) for row in there]) for field in ("ratio", "noise"))
        what, seconds = f"{measure}, {name}", [row.seconds for row in some]
        say(f"{what}: devices; with an admissible motion in the sweep", f"{len(some)}; {len(there)}")
        say(f"{what}: at least {ENOUGH} of the sweep's best", f"{(ratio >= ENOUGH).mean():.1%}")
        say(f"{what}: at least that, or {SURE} standard errors less", f"{(ratio + SURE * noise >= ENOUGH).mean():.1%}")
        say(f"{what}: below {LEAST}; no design", f"{(ratio < LEAST).sum()}; {sum(not row.reported_P for row in there)}")
        say(f"{what}: least, median, largest", f"{ratio.min():.4f}, {np.median(ratio):.4f}, {ratio.max():.4f}")
        say(f"{what}: seconds a design, median, most", f"{np.median(seconds):.2f}, {max(seconds):.1f}")


def told(measures: list[str], sweeps: dict[int, dict[str, Measured]]) -> Iterator[Row]:
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
    """Print the figures and keep the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--devices", type=int, default=120)
    parser.add_argument("--first", type=int, default=0, help="number of the first device")
    parser.add_argument("--only", choices=MEASURES, help="one measure")
    parser.add_argument("--sweeps", type=Path, help="file that keeps the sweeps")
    parser.add_argument("--rows", type=Path, default=tables.ROWS / "designs.csv")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    sweeps = kept(range(asked.first, asked.first + asked.devices), asked.sweeps)
    measures = [asked.only] if asked.only else list(MEASURES)
    tables.write(asked.rows, Row._fields, told(measures, sweeps))
    return 0


if __name__ == "__main__":
    sys.exit(main())
