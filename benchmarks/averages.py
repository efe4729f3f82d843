"""How good are derivatives of averages, and which method fails where?

    python benchmarks/averages.py                    # all parts, half an hour on two cores; rows and chart
    python benchmarks/averages.py --only missed      # one part: cells, growth, edge, crisis, missed
    python benchmarks/averages.py --cells 20         # fewer chaotic cells
    python benchmarks/averages.py --chart averages.png  # draws the rows that are there

cells: derivatives of `vijax.average` in chaotic cells against local fits of ten times as many balls drawn at random.
growth: error of dP/dln kappa by automatic differentiation through n periods, by the orbit's implicit rule (`steady`),
and by the ensemble, on one orbit and in chaos. edge: where averages have no derivative, and what the record says
there. crisis: chaos grows all at once; the largest depth, which limits are about, jumps by 9 %, while P goes on within
its noise. missed: what no standard error knows of, an attractor that few starts meet.

Of the rows that are kept the printout says

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
from vijax.batch.simulate import Starts
from vijax.design.survey import survey
from vijax.model.device import Harvester
from vijax.model.variables import tuned, value_of
from vijax.planes.basins import SPEED
from vijax.runtime import context, tiles
from vijax.runtime.arrays import present

HERE = Path(__file__).parent
MOVING = "d", "kappa", "r"
CELLS, TIMES, SEED = 200, 10, 1
DRAWN = 100  # devices at a time, of which one in five is chaotic
SCANNED = 16  # starts that must all be chaotic


class Row(NamedTuple):
    """One figure.

    Attributes:
        part, scene, method: Of what, where, how.
        quantity: "kappa" for dlnP/dln kappa; "P"; "depth", the largest of all balls [m].
        at: Balls, periods, or kappa.
        value, stderr: As the method has it.
        reference, reference_stderr: What it should be.
        verdict: Of `Average`.
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
    verdict: str


def device(kappa: float, **constants: float) -> Harvester:
    """Make a device with the given stiffness."""
    return tuned(Harvester(**constants), ("kappa",), jnp.log(jnp.asarray([kappa])))


def elasticity(found: vijax.Average, of: Harvester, name: str) -> tuple[float, float]:
    """Compute the derivative dlnP/dln of d, kappa or r, and its standard error."""
    scale = float(value_of(of, name) / found.P)
    return float(getattr(found.by_pair, name)) * scale, float(getattr(found.by_pair_stderr, name)) * abs(scale)


def verdict(found: vijax.Average) -> str:
    """Say in a word."""
    return vijax.Smoothness(int(found.verdict)).name.lower()


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
    """Say which are certainly chaotic from every start."""
    row = np.repeat(np.arange(len(devices)), SCANNED)
    every = jax.tree.map(lambda *x: np.array(x, float)[row], *devices)
    pair = jax.tree.map(np.asarray, jax.vmap(Harvester.pair)(every))
    u, v = np.random.default_rng(SEED).uniform(-0.5, 0.5, (2, row.size))
    starts = Starts(*map(jnp.asarray, (u * pair.d, 2 * SPEED * v, np.zeros(row.size))))
    found = survey(pair, every, starts, longest=1, periods=400)
    return (np.asarray(found.ended.period) == 0).reshape(-1, SCANNED).all(axis=1)


def chaotic_cells(count: int) -> Iterator[Harvester]:
    """Find so many of them."""
    seed = SEED
    while count > 0:
        drawn = population(seed)
        some = [one for one, kept in zip(drawn, chaotic(drawn), strict=True) if kept][:count]
        yield from some
        count, seed = count - len(some), seed + 1


def cells(count: int) -> Iterator[Row]:
    """Compare derivatives with local fits of ten times as many balls."""

    def one(numbered: tuple[int, Harvester]) -> list[Row]:
        index, of = numbered
        found, fit = vijax.average(of), vijax.average(of, balls=TIMES * 4096, seed=SEED)
        pair = of.pair()
        where = f"{index}: d {float(pair.d):.4g}, kappa {float(present(pair.kappa)):.4g}, r {float(pair.r):.3g}"
        return [
            Row(
                "cells",
                where,
                "ensemble",
                name,
                4096,
                *elasticity(found, of, name),
                *elasticity(fit, of, name),
                verdict(found),
            )
            for name in MOVING
        ]

    with context.pool(tiles.workers()) as pool:
        for rows in pool.map(one, enumerate(chaotic_cells(count))):
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
FLOWN = 32  # starts that are differentiated through


def through_flights(of: Harvester) -> np.ndarray:
    """Give dlnP/dln kappa [start, length] by automatic differentiation through so many periods from the attractor."""
    pair = of.pair()
    draw = np.random.default_rng(SEED).uniform(-0.5, 0.5, (2, FLOWN))
    settled = vijax.trajectory(pair, draw[0] * pair.d, 2 * SPEED * draw[1], 200).states
    u, v = settled.u[:, -1], settled.v[:, -1]

    def means(z):
        moved = dataclasses.replace(pair, kappa=pair.kappa * jnp.exp(z))
        flown = vijax.trajectory(moved, u, v, LENGTHS[-1], max_impacts=6 * LENGTHS[-1]).impacts
        real = flown.side != 0
        energy = vijax.harvested_energy(of, jnp.where(real, flown.depth, 0.0) * of.length_unit)
        return jnp.stack([jnp.where(real & (flown.n < n), energy, 0.0).sum(axis=1) / (2 * n) for n in LENGTHS], axis=1)

    value, slope = jax.jit(lambda z: jax.jvp(means, (z,), (jnp.ones_like(z),)))(jnp.zeros(()))
    return np.asarray(slope / value)


def by_the_orbit(of: Harvester) -> float:
    """Give dlnP/dln kappa of the attracting orbit with an impact on either wall."""
    found = vijax.find_orbits(of.pair(), "RL")
    states = [vijax.steady(of, found[index]) for index in range(len(found.status))]
    best = int(np.nanargmax([float(one.P) for one in states]))

    def log_P(z):
        return jnp.log(vijax.steady(tuned(of, ("kappa",), z[None]), found[best]).P)

    return float(jax.grad(log_P)(jnp.log(present(of.pair().kappa))))


def growth(_: int) -> Iterator[Row]:
    """Measure the error of dP/dln kappa against periods flown."""
    for scene, (kappa, constants) in SCENES.items():
        of = device(kappa, **constants)
        fine = vijax.average(of, balls=TIMES * 4096, seed=SEED)
        truth = elasticity(fine, of, "kappa")
        if scene.startswith("orbit"):
            truth = by_the_orbit(of), 0.0
            yield Row("growth", scene, "implicit rule of the orbit", "kappa", 1, *truth, *truth, "")
        slopes = through_flights(of)
        for n, column in zip(LENGTHS, slopes.T, strict=True):
            typical = float(np.median(np.abs(column - truth[0])))
            yield Row("growth", scene, "automatic differentiation", "kappa", n, truth[0] + typical, 0.0, *truth, "")
        for n in LENGTHS[4:]:
            found = vijax.average(of, periods=n)
            yield Row("growth", scene, "ensemble", "kappa", n, *elasticity(found, of, "kappa"), *truth, verdict(found))


# --- where there is no derivative, and what an error does not know ----------------------------------------------------

EDGE = np.linspace(26.7, 28.5, 37)  # where chaos ends in a cascade of orbits
NEAR = 2e-3
# A device whose chaos grows between kappa 35.2 and 35.225.
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
}  # of which the orbit takes 99.5 % of the starts
BALLS = 32, 64, 128, 256, 512, 1024, 4096


def edge(_: int) -> Iterator[Row]:
    """Measure P and its slope through the end of chaos; the reference is the difference of the neighbours' P."""
    found = [(of, vijax.average(of, balls=1024, spread=NEAR)) for of in (device(kappa, **FIRST) for kappa in EDGE)]
    P = np.array([float(one.P) for _, one in found])
    error = np.array([float(one.P_stderr) for _, one in found])
    slopes = np.gradient(np.log(P), np.log(EDGE))
    for kappa, slope, (of, one) in zip(EDGE, slopes, found, strict=True):
        yield Row(
            "edge",
            "chaos to orbits",
            "ensemble",
            "kappa",
            kappa,
            *elasticity(one, of, "kappa"),
            slope,
            0.0,
            verdict(one),
        )
    averages = (one for _, one in found)
    for kappa, value, near, one in zip(EDGE, P, error, averages, strict=True):
        yield Row("edge", "chaos to orbits", "ensemble", "P", kappa, value, near, value, 0.0, verdict(one))


def crisis(_: int) -> Iterator[Row]:
    """Measure P, its slope and the largest depth through a crisis."""
    flown = vijax.sweep(
        kappa=GROWING,
        v0=np.linspace(-SPEED, SPEED, FLOWN),
        device=device(float(GROWING[0]), **THIRD),
        periods=2000,
        outputs=["max_penetration"],
    )
    deepest = flown.max_penetration.max("v0").values
    for kappa, depth in zip(GROWING.tolist(), deepest.tolist(), strict=True):
        of = device(kappa, **THIRD)
        one = vijax.average(of, balls=1024, spread=NEAR)
        P, slope = (float(one.P), float(one.P_stderr)), elasticity(one, of, "kappa")
        yield Row("crisis", "chaos grows", "ensemble", "depth", kappa, depth, 0.0, depth, 0.0, verdict(one))
        yield Row("crisis", "chaos grows", "ensemble", "P", kappa, *P, P[0], 0.0, verdict(one))
        yield Row("crisis", "chaos grows", "ensemble", "kappa", kappa, *slope, slope[0], 0.0, verdict(one))


def missed(_: int) -> Iterator[Row]:
    """Measure P beside two attractors, one of which few starts end on."""
    of = device(4.00713, **SMALL)
    truth = vijax.average(of, balls=2**14, spread=NEAR, seed=SEED)
    for balls in BALLS:
        one = vijax.average(of, balls=balls, spread=NEAR)
        P = (float(one.P), float(one.P_stderr), float(truth.P), float(truth.P_stderr))
        yield Row("missed", "99.5 % of the starts", "ensemble", "P", balls, *P, verdict(one))


# --- rows and printout ------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[int], Iterator[Row]]] = {
    "cells": cells,
    "growth": growth,
    "edge": edge,
    "crisis": crisis,
    "missed": missed,
}


def told(parts: list[str], count: int) -> Iterator[Row]:
    """Measure parts, and print the figures of each."""
    for part in parts:
        rows = list(PARTS[part](count))
        printed(rows)
        yield from rows


def say(what: str, value: str) -> None:
    """Print one figure."""
    print(f"{what:<84} {value}", flush=True)


def gap(row: Row) -> float:
    """Read d of the scene of a cell; NaN of other scenes."""
    found = re.search(r"d ([\d.e-]+),", row.scene)
    return float(found[1]) if found else math.nan


def printed(rows: list[Row]) -> None:
    """Print the figures that the rows hold."""
    groups: dict[str, Callable[[Row], bool]] = {
        "smooth": lambda row: row.verdict == "smooth",
        "all": lambda row: True,
        "d above 1": lambda row: gap(row) > 1,
    }
    for group, belongs in groups.items():
        for name in MOVING:
            ours = [row for row in rows if row.part == "cells" and row.quantity == name and belongs(row)]
            if not ours:
                continue
            off = np.array([abs(r.value - r.reference) / math.hypot(r.stderr, r.reference_stderr) for r in ours])
            relative = np.array([r.stderr / abs(r.reference) for r in ours])
            missed_by = np.array([abs(r.value / r.reference - 1) for r in ours])
            what = f"dP/d{name}, {len(ours)} chaotic cells, {group}"
            say(f"{what}: within 2 standard errors", f"{(off < 2).mean():.1%}")
            say(
                f"{what}: relative standard error, median and largest",
                f"{np.median(relative):.2%}, {relative.max():.2%}",
            )
            say(f"{what}: relative error above 1 % in", f"{(missed_by > 0.01).mean():.1%}")
    for r in rows:
        if r.part == "growth":
            say(
                f"{r.scene}, {r.method}, {r.at:.0f} periods: error of dlnP/dln kappa",
                f"{abs(r.value - r.reference):.1e}",
            )
        elif r.part == "missed":
            far = abs(r.value / r.reference - 1)
            say(
                f"{r.at:.0f} balls, {r.scene} on one orbit: error of P, standard error, verdict",
                f"{far:.1e}, {r.stderr / r.value:.1e}, {r.verdict}",
            )
        elif r.part == "crisis":
            what = {"kappa": "dlnP/dln kappa", "P": "P [J]", "depth": "largest depth [m]"}[r.quantity]
            say(f"kappa {r.at:.3f}, through a crisis: {what}, standard error", f"{r.value:.6g}, {r.stderr:.2g}")
        elif r.part == "edge" and r.quantity == "kappa":
            say(
                f"kappa {r.at:.2f}: slope, standard error, between neighbours, verdict",
                f"{r.value:.3f}, {r.stderr:.3f}, {r.reference:.3f}, {r.verdict}",
            )


def main() -> None:
    """Measure what the command line asks for, print it, keep the rows, and draw them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=list(PARTS), action="append", help="one part; may be given again")
    parser.add_argument("--cells", type=int, default=CELLS, help="how many chaotic cells")
    parser.add_argument("--rows", type=Path, default=HERE / "rows", help="folder for the figures")
    parser.add_argument("--chart", type=Path, help="draw the rows that are there, and measure nothing")
    given = parser.parse_args()
    path = given.rows / "averages.csv"
    if given.chart:
        charts.averages(tables.read(path), given.chart)
        return
    asked = given.only or list(PARTS)
    others = [row for row in tables.read(path) if row.part not in asked]
    tables.write(path, Row._fields, told(asked, given.cells), kept=others)


if __name__ == "__main__":
    main()
