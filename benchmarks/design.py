"""Are designs the best there are? Against a dense scan, exact gradients, the clock, and cliffs.

    python benchmarks/design.py                # all figures
    python benchmarks/design.py --only scan    # one part
"""

import argparse
import math
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import vijax
from vijax import design
from vijax.design import Design, Optimum
from vijax.energy import harvested_energy
from vijax.model import Harvester

DATA = Path(__file__).parent.parent / "tests" / "data"
SEED = 5
KAPPA = (2.0, 400.0)


def say(what: str, value: str) -> None:
    """Print one figure."""
    print(f"{what:<72} {value}", flush=True)


# --- against a dense scan -----------------------------------------------------------------------------------------

ANYWHERE = {"d": (0.05, 0.3), "r": (0.2, 0.9), "A": (1.0, 5.0), "omega": (math.pi, 12 * math.pi)}
SMALL_AND_FAST = {"d": (0.12, 0.3), "r": (0.2, 0.9), "A": (2.0, 4.0), "omega": (8 * math.pi, 12 * math.pi)}
STARTS = ((0.0, 0.45), (-0.48, 0.25))  # displacements in parts of the gap and velocities, all pairs
ENOUGH = 0.999  # of the scan's best
CLOSE = 1e-9  # what rounding may add to a constraint


class Best(NamedTuple):
    """The best admissible point of a device's scan."""

    P: float
    kappa: float
    period: int
    impacts: str


def drawn(draw: np.random.Generator, within: dict, count: int) -> list[Harvester]:
    """Random devices: Tables I and II but for the gap, r, A and omega."""
    rows = [{name: draw.uniform(*ends) for name, ends in within.items()} for _ in range(count)]
    return [Harvester(s=x["d"] * x["A"] * (math.pi / x["omega"]) ** 2, r=x["r"], A=x["A"], omega=x["omega"]) for x in rows]


def scanned(device: Harvester, points: int) -> Best | None:
    """By the exact engine from several starts at each of many kappa; None where nothing is admissible."""
    d, (parts, speeds) = float(device.pair().d), STARTS
    found = vijax.sweep(
        kappa=np.geomspace(*KAPPA, points),
        u0=d * np.array(parts),
        v0=np.array(speeds),
        device=device,
        outputs=("P", "admissible", "period", "impacts_left", "impacts_right"),
    )
    P = found["P"].where(found["admissible"] & (found["status"] == 0))
    if not bool((P > 0).any()):
        return None
    best = found.isel(P.argmax(...))
    left, right, period = (int(best[name]) for name in ("impacts_left", "impacts_right", "period"))
    return Best(float(best["P"]), float(best["kappa"]), period, f"{left}:{right}/{period}T")


class Case(NamedTuple):
    """A device, the best of its scan, and its design."""

    device: Harvester
    best: Best
    found: Design


def cases(draw: np.random.Generator, within: dict, count: int, points: int) -> tuple[list[Case], int]:
    """So many devices whose best admissible point in the scan is periodic, and how many others were left out."""
    devices: list[Harvester] = []
    bests: list[Best] = []
    left_out = 0
    while len(devices) < count:
        (device,) = drawn(draw, within, 1)
        best = scanned(device, points)
        if best is None or best.period < 1:
            left_out += 1
            continue
        devices.append(device)
        bests.append(best)
    designs = design.optimise_all(devices, tune=("kappa",), bounds={"kappa": KAPPA}) if devices else []
    return [Case(*case) for case in zip(devices, bests, designs, strict=True)], left_out


def interior(case: Case) -> bool:
    """Whether nothing but the objective holds the optimum where it is."""
    best = case.found.best
    return best is not None and not best.active and best.stopped == "maximum"


def ratio(case: Case) -> float:
    """Of the optimum to the scan's best."""
    return 0.0 if case.found.best is None else case.found.best.height / case.best.P


def excess(optimum: Optimum) -> float:
    """How far the worst impact is beyond its constraint, relative, by the exact impact map."""
    device, orbit = optimum.device, optimum.orbit
    deep = np.asarray(orbit.depth) * float(device.length_unit)
    given = np.asarray(orbit.work) * float(device.m_b * device.speed_unit**2)
    gained = np.asarray(harvested_energy(device, deep))
    return float(max(np.nanmax(deep) / float(device.depth_limit), np.nanmax(gained / given)) - 1)


def scan(devices: int, points: int) -> None:
    """Random devices, half of them interior at least: more are drawn small and fast until that is so."""
    draw = np.random.default_rng(SEED)
    every, left_out = cases(draw, ANYWHERE, devices, points)
    say("scan: devices from the whole box; left out, their best being aperiodic", f"{len(every)}; {left_out}")
    lack = len(every) - 2 * sum(map(interior, every))
    if lack > 0:
        more, others = cases(draw, SMALL_AND_FAST, 2 * lack, points)
        every += more
        say("scan: devices added from the small and fast corner; left out", f"{len(more)}; {others}")
    report(every)


def report(every: list[Case]) -> None:
    """What came of the designs, and every miss."""
    ratios = np.array([ratio(case) for case in every])
    bests = [case.found.best for case in every if case.found.best is not None]
    kinds = Counter("interior" if not one.active else one.active[0].split(" at")[0] for one in bests)
    say("scan: interior optima of all", f"{sum(map(interior, every))} of {len(every)}")
    say("scan: what holds the optima", ", ".join(f"{kind} {count}" for kind, count in kinds.most_common()))
    say("scan: why the ascents stopped", ", ".join(f"{k} {n}" for k, n in Counter(one.stopped for one in bests).items()))
    say("scan: largest excess over a constraint, relative", f"{max(map(excess, bests)):.1e}")
    say("scan: most evaluations of a start that won; median", f"{max(b.looks for b in bests)}; {np.median([b.looks for b in bests]):.0f}")
    say("scan: optimum over the scan's best: least, median, largest", ", ".join(f"{f(ratios):.5f}" for f in (np.min, np.median, np.max)))
    misses = [case for case in every if ratio(case) < ENOUGH]
    say(f"scan: misses, below {ENOUGH}", f"{len(misses)} of {len(every)}")
    for case in sorted(misses, key=ratio):
        pair, best = case.device.pair(), case.found.best
        what = f"d {float(pair.d):.6f} r {case.device.r:.6f} A {case.device.A:.6f} omega {case.device.omega:.6f}"
        theirs = f"scan {case.best.P:.5e} at kappa {case.best.kappa:.5f}, {case.best.impacts}"
        ours = "none" if best is None else f"{best.height:.5e} at {best.values['kappa']:.5f}, {best.label}, {best.stopped}"
        print(f"    {ratio(case):.5f}  {what}; {theirs}; design {ours}", flush=True)


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", type=int, default=200, help="of the scan")
    parser.add_argument("--points", type=int, default=10_000, help="kappa of each device's scan")
    given = parser.parse_args()
    scan(given.devices, given.points)
    return 0


if __name__ == "__main__":
    sys.exit(main())
