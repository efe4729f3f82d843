"""How good are derivatives of averages, and which method fails where?

    python benchmarks/averages.py                    # all parts, half an hour on two cores; rows and chart
    python benchmarks/averages.py --only missed      # one part: cells, growth, edge, crisis, missed
    python benchmarks/averages.py --cells 20         # fewer chaotic cells
    python benchmarks/averages.py --chart averages.png  # draws the rows that are there

cells: derivatives of `vijax.average` in chaotic cells against local fits with ten times as many random balls.
growth: error of dP/dln kappa by automatic differentiation through n periods, by the orbit's implicit rule (`steady`),
and by the ensemble, on one orbit and in chaos. edge: parameters where averages have no derivative, and the record's
verdict there. crisis: chaos grows at once; the largest depth, which limits depend on, jumps by 9 %, while P continues
within its noise. missed: an error outside of all standard errors, as few starts reach one of the attractors.

From the stored rows, the printout is

    dP/dkappa, 200 chaotic cells, all: within 2 standard errors                          99.0%
    dP/dkappa, 200 chaotic cells, all: relative standard error, median and largest       0.30%, 5.53%
    dP/dkappa, 200 chaotic cells, all: relative error above 1 % in                       5.5%
    dP/dkappa, 54 chaotic cells, smooth: within 2 standard errors                        98.1%
    dP/dkappa, 54 chaotic cells, smooth: relative standard error, median and largest     0.26%, 1.09%
    dP/dr, 54 chaotic cells, smooth: within 2 standard errors                            98.1%
    dP/dr, 54 chaotic cells, smooth: relative standard error, median and largest         1.86%, 1041.78%

Errors of dlnP/dln d, kappa and r are alike in size, 0.003 to 0.004 in the median; derivatives in d and r are small, in
some cells next to nothing.
"""

import argparse
import dataclasses
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from benchmarks import charts, tables
from vijax.design.survey.attractor_survey import simulate_survey
from vijax.maps.basins import SPEED
from vijax.model.device import Harvester
from vijax.model.tuned_quantities import tune_device, value_of
from vijax.runtime import public_api, tiles
from vijax.runtime.arrays import not_none
from vijax.simulation.simulate import Starts

HERE = Path(__file__).parent
MOVING = "d", "kappa", "r"
CELLS, TIMES, SEED = 200, 10, 1
DRAWN = 100  # devices drawn at a time; one in five is chaotic
SCANNED = 16  # starts of a device; it counts as chaotic if all of them are


class Row(NamedTuple):
    """One figure.

    Attributes:
        part, scene, method: Part of the benchmark, system, and method.
        quantity: "kappa" for dlnP/dln kappa; "P"; "depth", the largest penetration of all balls [m].
        at: Number of balls, number of periods, or kappa.
        value, stderr: Result of the method.
        reference, reference_stderr: Reference value.
        smoothness: Smoothness of `Average`.
    """

    part: str
    scene: str
    method: str
    quantity: str
    at: float
    value: float
    stderr: float
    reference: float
    reference_stderr: float
    smoothness: str


def device(kappa: float, **constants: float) -> Harvester:
    """Make a device with the given stiffness."""
    return tune_device(Harvester(**constants), ("kappa",), jnp.log(jnp.asarray([kappa])))


def elasticity(result: vijax.Average, system: Harvester, name: str) -> tuple[float, float]:
    """Compute the derivative dlnP/dln of d, kappa or r, and its standard error."""
    scale = float(value_of(system, name) / result.P)
    return float(getattr(result.by_pair, name)) * scale, float(getattr(result.by_pair_stderr, name)) * abs(scale)


def smoothness_name(result: vijax.Average) -> str:
    """Return the smoothness of an average in a word."""
    return vijax.Smoothness(int(result.smoothness)).name.lower()


# --- chaotic cells ----------------------------------------------------------------------------------------------------


def population(seed: int) -> list[Harvester]:
    """Draw devices at random."""
    draw = np.random.default_rng(seed)

    def even(low: float, high: float) -> np.ndarray:
        return np.exp(draw.uniform(math.log(low), math.log(high), DRAWN))

    d, A, kappa = even(0.03, 10), even(1, 5), even(3, 400)
    r, omega, V = (
        draw.uniform(0.2, 0.85, DRAWN),
        draw.uniform(3, 8, DRAWN),
        draw.choice([1000.0, 1700.0, 2000.0], DRAWN),
    )
    rows = zip(d, A, kappa, r, omega, V, strict=True)
    return [
        Harvester(s=d * A * (math.pi / omega) ** 2, omega0=kappa * omega / math.pi, r=r, A=A, omega=omega, V=V)
        for d, A, kappa, r, omega, V in rows
    ]


def chaotic(devices: list[Harvester]) -> np.ndarray:
    """Return whether every start of a device is chaotic, for each device."""
    row = np.repeat(np.arange(len(devices)), SCANNED)
    devices_of_starts = jax.tree.map(lambda *x: np.array(x, float)[row], *devices)
    pair = jax.tree.map(np.asarray, jax.vmap(Harvester.pair)(devices_of_starts))
    u, v = np.random.default_rng(SEED).uniform(-0.5, 0.5, (2, row.size))
    starts = Starts(*map(jnp.asarray, (u * pair.d, 2 * SPEED * v, np.zeros(row.size))))
    result = simulate_survey(pair, devices_of_starts, starts, max_period=1, periods=400)
    return (np.asarray(result.summary.period) == 0).reshape(-1, SCANNED).all(axis=1)


def chaotic_cells(count: int) -> Iterator[Harvester]:
    """Yield a number of chaotic devices."""
    seed = SEED
    while count > 0:
        devices = population(seed)
        selected = [device for device, is_chaotic in zip(devices, chaotic(devices), strict=True) if is_chaotic][:count]
        yield from selected
        count, seed = count - len(selected), seed + 1


def cells(count: int) -> Iterator[Row]:
    """Compare derivatives with local fits with ten times as many balls."""

    def rows_of(item: tuple[int, Harvester]) -> list[Row]:
        index, system = item
        result, fit = vijax.average(system), vijax.average(system, samples=TIMES * 4096, seed=SEED)
        pair = system.pair()
        text = f"{index}: d {float(pair.d):.4g}, kappa {float(not_none(pair.kappa)):.4g}, r {float(pair.r):.3g}"
        return [
            Row(
                "cells",
                text,
                "ensemble",
                name,
                4096,
                *elasticity(result, system, name),
                *elasticity(fit, system, name),
                smoothness_name(result),
            )
            for name in MOVING
        ]

    with public_api.pool(tiles.workers()) as pool:
        for rows in pool.map(rows_of, enumerate(chaotic_cells(count))):
            yield from rows


# --- which method fails where -----------------------------------------------------------------------------------------

FIRST = {"s": 0.0483651114518, "r": 0.270293, "A": 1.99611, "omega": 5.98843806, "V": 1700.0}
SECOND = {"s": 0.2534491204682, "r": 0.799363, "A": 3.88253, "omega": 3.95449881, "V": 1000.0}
PERIODIC = {"s": 0.2, "r": 0.5}
SCENES = {
    "orbit, kappa 60": (60.0, PERIODIC),
    "chaos, kappa 24": (24.0, FIRST),
    "chaos, kappa 250": (250.0, SECOND),
}
LENGTHS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 400)
DIFFERENTIATED_STARTS = 32  # starts that are differentiated through


def through_flights(system: Harvester) -> np.ndarray:
    """Return dlnP/dln kappa, [start, length], by automatic differentiation through several numbers of periods."""
    pair = system.pair()
    draw = np.random.default_rng(SEED).uniform(-0.5, 0.5, (2, DIFFERENTIATED_STARTS))
    settled = vijax.trajectory(pair, draw[0] * pair.d, 2 * SPEED * draw[1], 200).states
    u, v = settled.u[:, -1], settled.v[:, -1]

    def means(z):
        moved = dataclasses.replace(pair, kappa=pair.kappa * jnp.exp(z))
        impacts = vijax.trajectory(moved, u, v, LENGTHS[-1], max_impacts=6 * LENGTHS[-1]).impacts
        is_impact = impacts.side != 0
        energy = vijax.harvested_energy(system, jnp.where(is_impact, impacts.depth, 0.0) * system.length_unit)
        return jnp.stack(
            [jnp.where(is_impact & (impacts.n < n), energy, 0.0).sum(axis=1) / (2 * n) for n in LENGTHS], axis=1
        )

    value, slope = jax.jit(lambda z: jax.jvp(means, (z,), (jnp.ones_like(z),)))(jnp.zeros(()))
    return np.asarray(slope / value)


def by_the_orbit(system: Harvester) -> float:
    """Return dlnP/dln kappa of the attracting orbit with one impact on each wall."""
    orbits = vijax.find_orbits(system.pair(), "RL")
    states = [vijax.steady(system, orbits[index]) for index in range(len(orbits.status))]
    best = int(np.nanargmax([float(state.P) for state in states]))

    def log_P(z):
        return jnp.log(vijax.steady(tune_device(system, ("kappa",), z[None]), orbits[best]).P)

    return float(jax.grad(log_P)(jnp.log(not_none(system.pair().kappa))))


def growth(_: int) -> Iterator[Row]:
    """Measure the error of dP/dln kappa against the number of periods."""
    for scene, (kappa, constants) in SCENES.items():
        system = device(kappa, **constants)
        reference = vijax.average(system, samples=TIMES * 4096, seed=SEED)
        true_slope = elasticity(reference, system, "kappa")
        if scene.startswith("orbit"):
            true_slope = by_the_orbit(system), 0.0
            yield Row("growth", scene, "implicit rule of the orbit", "kappa", 1, *true_slope, *true_slope, "")
        slopes = through_flights(system)
        for n, column in zip(LENGTHS, slopes.T, strict=True):
            typical = float(np.median(np.abs(column - true_slope[0])))
            yield Row(
                "growth", scene, "automatic differentiation", "kappa", n, true_slope[0] + typical, 0.0, *true_slope, ""
            )
        for n in LENGTHS[4:]:
            result = vijax.average(system, periods=n)
            yield Row(
                "growth",
                scene,
                "ensemble",
                "kappa",
                n,
                *elasticity(result, system, "kappa"),
                *true_slope,
                smoothness_name(result),
            )


# --- where no derivative exists, and errors outside of the standard error ---------------------------------------------

EDGE = np.linspace(26.7, 28.5, 37)  # chaos ends here in a cascade of orbits
NEAR = 2e-3
# The chaotic attractor of this device grows between kappa 35.2 and 35.225.
THIRD = {
    "s": 0.07367718041928888,
    "r": 0.6174064604744505,
    "A": 3.4272553674608117,
    "omega": 6.370025058816405,
    "V": 1000.0,
}
GROWING = np.linspace(35.0, 35.45, 19)
SMALL = {
    "s": 0.006,
    "r": 0.5,
    "A": 3.0,
    "omega": 10 * math.pi,
    "V": 1700.0,
}  # one orbit attracts 99.5 % of the starts
BALLS = 32, 64, 128, 256, 512, 1024, 4096


def edge(_: int) -> Iterator[Row]:
    """Measure P and its slope through the end of chaos; the reference is the slope between neighbours."""
    results = [
        (system, vijax.average(system, samples=1024, spread=NEAR))
        for system in (device(kappa, **FIRST) for kappa in EDGE)
    ]
    P = np.array([float(result.P) for _, result in results])
    error = np.array([float(result.P_stderr) for _, result in results])
    slopes = np.gradient(np.log(P), np.log(EDGE))
    for kappa, slope, (system, result) in zip(EDGE, slopes, results, strict=True):
        yield Row(
            "edge",
            "chaos to orbits",
            "ensemble",
            "kappa",
            kappa,
            *elasticity(result, system, "kappa"),
            slope,
            0.0,
            smoothness_name(result),
        )
    averages = (result for _, result in results)
    for kappa, value, stderr, result in zip(EDGE, P, error, averages, strict=True):
        yield Row("edge", "chaos to orbits", "ensemble", "P", kappa, value, stderr, value, 0.0, smoothness_name(result))


def crisis(_: int) -> Iterator[Row]:
    """Measure P, its slope and the largest depth through a crisis."""
    dataset = vijax.sweep(
        kappa=GROWING,
        v0=np.linspace(-SPEED, SPEED, DIFFERENTIATED_STARTS),
        device=device(float(GROWING[0]), **THIRD),
        periods=2000,
        outputs=["max_penetration"],
    )
    deepest = dataset.max_penetration.max("v0").values
    for kappa, depth in zip(GROWING.tolist(), deepest.tolist(), strict=True):
        system = device(kappa, **THIRD)
        result = vijax.average(system, samples=1024, spread=NEAR)
        P, slope = (float(result.P), float(result.P_stderr)), elasticity(result, system, "kappa")
        yield Row("crisis", "chaos grows", "ensemble", "depth", kappa, depth, 0.0, depth, 0.0, smoothness_name(result))
        yield Row("crisis", "chaos grows", "ensemble", "P", kappa, *P, P[0], 0.0, smoothness_name(result))
        yield Row("crisis", "chaos grows", "ensemble", "kappa", kappa, *slope, slope[0], 0.0, smoothness_name(result))


def missed(_: int) -> Iterator[Row]:
    """Measure P in the presence of two attractors, with few starts on one of them."""
    system = device(4.00713, **SMALL)
    reference = vijax.average(system, samples=2**14, spread=NEAR, seed=SEED)
    for balls in BALLS:
        result = vijax.average(system, samples=balls, spread=NEAR)
        P = (float(result.P), float(result.P_stderr), float(reference.P), float(reference.P_stderr))
        yield Row("missed", "99.5 % of the starts", "ensemble", "P", balls, *P, smoothness_name(result))


# --- rows and printout ------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[int], Iterator[Row]]] = {
    "cells": cells,
    "growth": growth,
    "edge": edge,
    "crisis": crisis,
    "missed": missed,
}


def measured(parts: list[str], count: int) -> Iterator[Row]:
    """Measure parts, and print the figures of each."""
    for part in parts:
        rows = list(PARTS[part](count))
        printed(rows)
        yield from rows


def print_figure(quantity: str, value: str) -> None:
    """Print one figure."""
    print(f"{quantity:<84} {value}", flush=True)


def gap(row: Row) -> float:
    """Return d from the scene of a cell; NaN for other scenes."""
    match = re.search(r"d ([\d.e-]+),", row.scene)
    return float(match[1]) if match else math.nan


def printed(rows: list[Row]) -> None:
    """Print the figures of the rows."""
    groups: dict[str, Callable[[Row], bool]] = {
        "smooth": lambda row: row.smoothness == "smooth",
        "all": lambda row: True,
        "d above 1": lambda row: gap(row) > 1,
    }
    for group, is_in_group in groups.items():
        for name in MOVING:
            selected = [row for row in rows if row.part == "cells" and row.quantity == name and is_in_group(row)]
            if not selected:
                continue
            z = np.array([abs(r.value - r.reference) / math.hypot(r.stderr, r.reference_stderr) for r in selected])
            relative = np.array([r.stderr / abs(r.reference) for r in selected])
            relative_error = np.array([abs(r.value / r.reference - 1) for r in selected])
            quantity = f"dP/d{name}, {len(selected)} chaotic cells, {group}"
            print_figure(f"{quantity}: within 2 standard errors", f"{(z < 2).mean():.1%}")
            print_figure(
                f"{quantity}: relative standard error, median and largest",
                f"{np.median(relative):.2%}, {relative.max():.2%}",
            )
            print_figure(f"{quantity}: relative error above 1 % in", f"{(relative_error > 0.01).mean():.1%}")
    for r in rows:
        if r.part == "growth":
            print_figure(
                f"{r.scene}, {r.method}, {r.at:.0f} periods: error of dlnP/dln kappa",
                f"{abs(r.value - r.reference):.1e}",
            )
        elif r.part == "missed":
            error_of_P = abs(r.value / r.reference - 1)
            print_figure(
                f"{r.at:.0f} balls, {r.scene} on one orbit: error of P, standard error, smoothness",
                f"{error_of_P:.1e}, {r.stderr / r.value:.1e}, {r.smoothness}",
            )
        elif r.part == "crisis":
            quantity = {"kappa": "dlnP/dln kappa", "P": "P [J]", "depth": "largest depth [m]"}[r.quantity]
            print_figure(
                f"kappa {r.at:.3f}, through a crisis: {quantity}, standard error", f"{r.value:.6g}, {r.stderr:.2g}"
            )
        elif r.part == "edge" and r.quantity == "kappa":
            print_figure(
                f"kappa {r.at:.2f}: slope, standard error, between neighbours, smoothness",
                f"{r.value:.3f}, {r.stderr:.3f}, {r.reference:.3f}, {r.smoothness}",
            )


def main() -> None:
    """Measure the parts that the command line selects, print and store the rows, or draw the stored ones."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=list(PARTS), action="append", help="one part; may be given again")
    parser.add_argument("--cells", type=int, default=CELLS, help="how many chaotic cells")
    parser.add_argument("--rows", type=Path, default=HERE / "rows", help="folder for the figures")
    parser.add_argument("--chart", type=Path, help="draw the rows that are there, and measure nothing")
    options = parser.parse_args()
    path = options.rows / "averages.csv"
    if options.chart:
        charts.averages(tables.read(path), options.chart)
        return
    selected = options.only or list(PARTS)
    others = [row for row in tables.read(path) if row.part not in selected]
    tables.write(path, Row._fields, measured(selected, options.cells), earlier=others)


if __name__ == "__main__":
    main()
