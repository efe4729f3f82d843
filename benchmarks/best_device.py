"""Is a design the best motion of its device? Against dense scans and nested sweeps of random devices.

    python benchmarks/best_device.py                        # 200 devices with their scans, an hour
    python benchmarks/best_device.py --devices 40 --only two scan
    python benchmarks/best_device.py --only two-quantities --scans scans.json  # scans are kept, and made once

One line a figure, what is asked in brackets; every device below 99 % of its scan has a line of its own. A device's scan
is 1,024 kappa x 8 starts x 1,000 periods, and the neighbourhoods of its three best values at 10,000; the nested sweeps,
the peer in time, are 256 x 4 x 400, 64 x 4 x 2,000 about each of the three best, and 32 x 4 x 2,000 about the best.
Of designs in (kappa, d), of a quarter of the devices, the scan is 96 x 96 x 4 starts x 400 periods, its best cells
flown from 8 starts for 10,000.
"""

import argparse
import json
import math
import resource
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import vijax
from vijax.design.aperiodic_search import Task
from vijax.design.design_settings import DEFAULT
from vijax.design.ensemble import fly
from vijax.design.optimise import Design, optimise_all
from vijax.design.optimum import AperiodicOptimum
from vijax.model.device import Harvester
from vijax.model.variables import variables

SEED = 28
KAPPA, D = (3.0, 400.0), (0.03, 10.0)
WIDE = 1.0  # d above which devices are counted apart, too
SEARCH: dict[str, Any] = {"tune": ("kappa",), "bounds": {"kappa": KAPPA}}
SEARCH_TWO: dict[str, Any] = {"tune": ("kappa", "d"), "bounds": {"kappa": KAPPA}}  # d from half to twice the device's
WANTED = ("P", "admissible", "period", "max_penetration", "status")
_ROUNDS = 3  # of each in turn, where times are compared
_CONFIRMED = 6  # best cells of a plane that are flown for long
_BETTER = 1e-3  # an orbit that gives so much more is another one
SAME_DEPTH = 0.02  # aperiodic cells of one device whose depths differ by less, as logarithms, are one attractor
FLOWN = 16, 20_000  # balls and periods that an answer is flown again
# The first two devices of which designs once missed the chaos, and what a dense scan says of them.
TWO = (
    (Harvester(s=0.0483651114518, r=0.270293, A=1.99611, omega=5.98843806, V=1700.0), 23.599, 6.206e-5),
    (Harvester(s=0.2534491204682, r=0.799363, A=3.88253, omega=3.95449881, V=1000.0), 156.83, 1.215e-5),
)


def say(what: str, value: str) -> None:
    """Print one figure."""
    print(f"{what:<72} {value}", flush=True)


def device(number: int) -> Harvester:
    """Draw a device of the population: d 0.03 to 10 and A 1 to 5 log-uniform, r, omega and V at random."""
    draw = np.random.default_rng([SEED, number])
    d, A = (math.exp(draw.uniform(math.log(low), math.log(high))) for low, high in (D, (1.0, 5.0)))
    r, omega, V = draw.uniform(0.2, 0.85), draw.uniform(3, 8), float(draw.choice([1000, 1700, 2000]))
    return Harvester(s=d * A * math.pi**2 / omega**2, r=r, A=A, omega=omega, V=V)


class Peak(NamedTuple):
    """The best value of a sweep, and P there [J]; in a plane d besides."""

    P: float
    kappa: float
    d: float = math.nan


def swept(of: Harvester, starts: int, periods: int, **axes: Any) -> np.ndarray:
    """Find the best admissible P at all points: of an orbit, or the mean of chaos whose balls all keep the limits."""
    v0 = np.linspace(-0.5, 0.45, starts)
    found = vijax.sweep(v0=v0, device=of, periods=periods, outputs=WANTED, **axes).transpose(*axes, "v0")
    shape = -1, starts
    P, period = found.P.values.reshape(shape), found.period.values.reshape(shape)
    kept = found.admissible.values.astype(bool).reshape(shape)
    best = np.where(kept & (period > 0), P, 0.0).max(axis=1)
    with np.errstate(divide="ignore"):
        depth = np.log(found.max_penetration.values.reshape(shape))
    for row in np.flatnonzero((period <= 0).any(axis=1)):
        balls = np.flatnonzero((period[row] <= 0) & np.isfinite(depth[row]))
        order = balls[np.argsort(depth[row, balls])]
        for one in np.split(order, np.flatnonzero(np.diff(depth[row, order]) > SAME_DEPTH) + 1):
            if one.size and kept[row, one].all():
                best[row] = max(best[row], P[row, one].mean())
    return best


def peaks(of: Harvester, kappa: np.ndarray, starts: int, periods: int, apart: int) -> list[Peak]:
    """Find the three best values of a sweep, so many steps apart, the best first."""
    best = swept(of, starts, periods, kappa=kappa)
    chosen: list[int] = []
    for row in np.argsort(-best).tolist():
        if best[row] > 0 and len(chosen) < 3 and all(abs(row - other) > apart for other in chosen):
            chosen.append(row)
    return [Peak(float(best[row]), float(kappa[row])) for row in chosen]


def _about(peak: Peak, width: float, count: int) -> np.ndarray:
    return np.clip(peak.kappa * np.exp(np.linspace(-width, width, count)), *KAPPA)


def scanned(of: Harvester) -> Peak:
    """Find the best of a dense scan; P 0 where nothing is admissible."""
    kappa = np.geomspace(*KAPPA, 1024)
    width = 1.2 * math.log(kappa[1] / kappa[0])
    near = (peaks(of, _about(one, width, 33), 8, 10_000, 0)[:1] for one in peaks(of, kappa, 8, 1000, 2))
    return max((peak for some in near for peak in some), default=Peak(0.0, math.nan))


def plane(of: Harvester) -> Peak:
    """Find the best of a scan in (kappa, d); P 0 where nothing is admissible."""
    own = float(of.pair().d)
    d, kappa = np.geomspace(own / 2, 2 * own, 96), np.geomspace(*KAPPA, 96)
    best = swept(of, 4, 400, d=d, kappa=kappa)
    found = Peak(0.0, math.nan)
    for row in np.argsort(-best)[:_CONFIRMED]:
        # What a shorter run took for the motion may have been on its way.
        at = float(kappa[row % 96]), float(d[row // 96])
        found = max(found, Peak(float(swept(of, 8, 10_000, d=[at[1]], kappa=[at[0]])[0]), *at))
    return found


def nested(of: Harvester) -> Peak:
    """Find the best of three nested sweeps."""
    kappa = np.geomspace(*KAPPA, 256)
    width = math.log(kappa[1] / kappa[0])
    near = [peaks(of, _about(one, width, 64), 4, 2000, 0)[:1] for one in peaks(of, kappa, 4, 400, 0)]
    best = max((peak for some in near for peak in some), default=Peak(0.0, math.nan))
    return max([best, *peaks(of, _about(best, width / 32, 32), 4, 2000, 0)[:1]]) if best.P else best


def kept(part: str, numbers: range, work: Callable[[Harvester], Peak], file: Path | None) -> list[Peak]:
    """Find the best of a scan of every device; what a file holds of it is not sought again."""
    known = json.loads(file.read_text()) if file is not None and file.exists() else {}
    own = known.setdefault(part, {})
    for number in numbers:
        if str(number) not in own:
            own[str(number)] = work(device(number))
            if file is not None:
                file.write_text(json.dumps(known))
    return [Peak(*own[str(number)]) for number in numbers]


def two(_asked: argparse.Namespace) -> None:
    """Try the two devices to start with."""
    designs = optimise_all([of for of, *_ in TWO], **SEARCH)
    for (_, kappa, P), found in zip(TWO, designs, strict=True):
        best = found.best
        if best is None:
            say(f"two: kappa ({kappa}), P ({P})", "nothing found")
            continue
        say(f"two: kappa ({kappa} to 0.3 %)", f"{best.values['kappa']:.4f}, {best.values['kappa'] / kappa - 1:+.3%}")
        say(
            f"two: P ({1e6 * P} uJ to 0.5 %)", f"{1e6 * best.P:.4f} +- {1e6 * best.P_stderr:.4f}, {best.P / P - 1:+.2%}"
        )


def scan(asked: argparse.Namespace) -> None:
    """Compare random devices with scans of their own, and fly their answers again."""
    numbers = range(asked.devices)
    devices = [device(number) for number in numbers]
    _compared("scan", devices, optimise_all(devices, **SEARCH), kept("scan", numbers, scanned, asked.scans))


def two_quantities(asked: argparse.Namespace) -> None:
    """Compare designs in (kappa, d) with scans of their planes, and fly their answers again."""
    numbers = range(max(asked.devices // 4, 1))
    devices = [device(number) for number in numbers]
    _compared("plane", devices, optimise_all(devices, **SEARCH_TWO), kept("plane", numbers, plane, asked.scans))


def _compared(part: str, devices: list[Harvester], designs: list[Design], peaks_found: list[Peak]) -> None:
    """Print how designs compare with the best of scans, and what gives less."""
    ratios, gaps = [], []
    for number, (of, found, peak) in enumerate(zip(devices, designs, peaks_found, strict=True)):
        P = found.best.P if found.best else 0.0
        if peak.P:
            ratios.append(P / peak.P)
            gaps.append(float(of.pair().d))
        if P < 0.99 * peak.P:
            where = "nothing" if found.best is None else f"{found.best.values} {found.best.label}"
            print(f"    device {number}: {P / peak.P:.4f} of the scan's {peak}; found {where}", flush=True)
    say(f"{part}: devices; whose best motion is no orbit", f"{len(devices)}; {sum(map(_averaged, designs))}")
    for where, some in (("", np.array(gaps) > 0), (f", d above {WIDE:g}", np.array(gaps) > WIDE)):
        ratio = np.array(ratios)[some]
        if ratio.size:
            say(f"{part}{where}: P at least 99 % of the scan's (98 %)", f"{(ratio >= 0.99).mean():.1%}")
            say(f"{part}{where}: at least 97 % (all)", f"{(ratio >= 0.97).mean():.1%}")
            shown = f"{ratio.min():.4f}, {np.median(ratio):.4f}, {ratio.max():.4f}"
            say(f"{part}{where}: least, median, largest", shown)
    _again(part, devices, designs)


def _averaged(found: Design) -> bool:
    return isinstance(found.best, AperiodicOptimum)


def _again(part: str, devices: list[Harvester], designs: list[Design]) -> None:
    """Fly answers that are no orbit once more, from other states on the motion."""
    owner = [number for number, found in enumerate(designs) if _averaged(found)]
    best = [one for one in (designs[number].best for number in owner) if isinstance(one, AperiodicOptimum)]
    if not best:
        return
    names = designs[0].tune
    wide = np.full((len(devices), 2, len(names)), [[[-np.inf], [np.inf]]])
    task = Task(devices, names, wide, "P", (), 1.0, DEFAULT)
    z = np.array([variables(names, list(one.values.values())) for one in best])
    # Where the long flight left them: they go on from there.
    starts, (balls, periods) = [one.starts for one in best], FLOWN
    flown = fly(task, np.array(owner), z, np.zeros(len(owner)), starts, periods, balls)
    kept = [bool(one.found.margins().min() >= 0) for one in flown]
    off = []
    for one, again in zip(best, flown, strict=True):
        P = again.found.P
        noise = math.hypot(one.P_stderr, float(P.std(ddof=1)) / math.sqrt(balls))
        off.append(abs(float(P.mean()) - one.P) / noise if noise > 1e-9 * one.P else 0.0)
    say(
        f"{part}: answers in chaos flown again, {balls} x {periods:,} periods: within limits",
        f"{sum(kept)} of {len(kept)}",
    )
    say(f"{part}: P within 3 standard errors; largest", f"{sum(x <= 3 for x in off)} of {len(off)}; {max(off):.1f}")


def orbits(asked: argparse.Namespace) -> None:
    """Try devices whose best motion is an orbit: the same optimum as of orbits alone."""
    devices = [device(number) for number in range(asked.devices)]
    every = zip(optimise_all(devices, **SEARCH), optimise_all(devices, motion="periodic", **SEARCH), strict=True)
    moved, lost, better = [], 0.0, 0
    for found, alone in every:
        if alone.best is None or _averaged(found) or found.best is None:
            continue
        rise = found.best.height / alone.best.height - 1
        if rise > _BETTER:
            better += 1
            continue
        moved.append(abs(found.best.values["kappa"] / alone.best.values["kappa"] - 1))
        lost = max(lost, -rise)
    say(
        "orbits: devices whose best is one; of these a better one than orbits alone", f"{len(moved) + better}; {better}"
    )
    say("orbits: kappa to 1e-9 (all others); largest change", f"{sum(x <= 1e-9 for x in moved)}; {max(moved):.1e}")
    say("orbits: largest loss of height", f"{lost:.1e}")


def cost(asked: argparse.Namespace) -> None:
    """Measure the seconds a device of many in one call, beside the nested sweeps."""
    count = asked.devices
    devices = [device(number) for number in range(count)]
    optimise_all(devices, **SEARCH)
    nested(devices[0])
    # What nested sweeps cost depends on the device, from a fifth of the mean to four times: all are timed, or chance
    # decides. Of the first 60 every tenth takes 0.67 of the mean, every sixth 0.98.
    sweeps: list[Callable[[], Any]] = [partial(nested, of) for of in devices]
    took = [
        (_seconds([partial(optimise_all, devices, **SEARCH)]) / count, _seconds(sweeps) / count) for _ in range(_ROUNDS)
    ]
    own, peer = (statistics.median(column) for column in zip(*took, strict=True))
    ratios = sorted(own / peer for own, peer in took)
    say(f"cost: seconds a device, {count} in one call; of nested sweeps", f"{own:.3f}; {peer:.3f}")
    say(
        "cost: part of the nested sweeps' (at most 0.5), median; least, largest",
        f"{statistics.median(ratios):.2f}; {ratios[0]:.2f}, {ratios[-1]:.2f}",
    )


def _seconds(calls: list[Callable[[], Any]]) -> float:
    begun = time.perf_counter()
    for call in calls:
        call()
    return time.perf_counter() - begun


def many(asked: argparse.Namespace) -> None:
    """Measure seconds and memory of five times as many devices in one call."""
    devices = [device(number) for number in range(5 * asked.devices)]
    before = _memory()
    took = _seconds([partial(optimise_all, devices, **SEARCH)])
    say(f"many: {len(devices):,} devices in one call", f"{took:.0f} s")
    say("many: most memory of the process [GB], before and at last", f"{before:.2f}, {_memory():.2f}")


def _memory() -> float:
    """Give the most memory that this process has held so far [GB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


PARTS: dict[str, Callable[[argparse.Namespace], None]] = {
    "two": two,
    "scan": scan,
    "two-quantities": two_quantities,
    "orbits": orbits,
    "cost": cost,
    "many": many,
}


def main() -> int:
    """Print the figures that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=200, help="how many at random [200]")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="which parts [all]")
    parser.add_argument("--scans", type=Path, help="file that keeps the best of every scan [none]")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for run in (part for name, part in PARTS.items() if not asked.only or name in asked.only):
        run(asked)
    return 0


if __name__ == "__main__":
    sys.exit(main())
