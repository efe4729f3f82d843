"""Are curves of bifurcations where they are known to be, do they miss none, what do they cost and what do they explain?

    python benchmarks/curves.py               # all figures
    python benchmarks/curves.py --only known  # one part
    python benchmarks/curves.py --only limits
    python benchmarks/curves.py --only explained --charts .  # and pictures of both planes with their curves

One line a figure. Errors are against closed forms, against points that branches along random lines through a plane
locate by themselves, and against the product of both multipliers, which is known of every orbit.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import vijax
from benchmarks.orbits import say
from vijax.model import flow
from vijax.orbits.curves import BifurcationCurve
from vijax.orbits.events import Point
from vijax.orbits.limits import LIMITS, loads

R = (0.02, 0.98)
PLANE = {"d": (0.05, 0.32), "r": (0.15, 0.9)}
INNER = {"d": (0.15, 0.3), "r": (0.2, 0.85)}  # where lines lie
START = {"d": 0.2, "r": 0.5}  # and orbits on them begin
LINES = 200
SAME = 1e-6  # two crossings nearer than this are one
_FOLLOWED = ("fold", "flip", "pitchfork", "grazing flight", "grazing impact")


def pitchfork(r: Any) -> Any:
    """Give the gap at which the symmetric orbit of rigid walls breaks, level."""
    q = (1 + r) / (np.pi * (1 - r))
    return (1 - 4 / np.pi**2) * q / np.sqrt(1 + 4 * q * q)


def symmetric(d: float, r: float) -> vijax.Orbit:
    """Find the period-1 orbits of rigid walls with an impact on each."""
    return vijax.find_orbits(vijax.impact_pair(d, None, r), "RL", guesses=64)


def met(d: float, r: float, along: str, within: tuple[float, float]) -> list[Point]:
    """Find what these orbits, and those that bifurcate from them, meet along a line."""
    branches = vijax.follow_families(symmetric(d, r), along, within)
    return [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]


def curves_of(points: list[Point], along: str, plane: dict[str, tuple[float, float]]) -> list[BifurcationCurve]:
    """Follow points without a word about those from which nothing begins."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return vijax.follow_curves(points, along, plane)


def known() -> None:
    """Compare the pitchfork with its closed form, products of multipliers with theirs, and a cusp with its exponent."""
    points = met(0.2, 0.5, "d", (0.1, 0.32))
    curves = curves_of(points, "d", {"d": (0.02, 0.4), "r": R})
    (broken,) = (curve for curve in curves if curve.kind == "pitchfork")
    d, r = broken.values.T
    say("rigid 1:1, pitchfork: largest error of d", f"{np.abs(d - pitchfork(r)).max():.1e}")
    say("rigid 1:1, pitchfork: r from, to; ends", f"{r.min():.6f}, {r.max():.6f}; {broken.ends}")
    sides = {
        kind: [np.array(p.values) for c in curves if c.kind == kind for p in c.points if p.kind == "flip-graze"]
        for kind in ("flip", "grazing")
    }
    apart = min(np.abs(one - other).max() for one in sides["flip"] for other in sides["grazing"])
    say("flip-graze from either side: difference", f"{apart:.1e}")
    products("rigid", curves)
    soft = soft_curves()
    products("soft", soft)
    say("largest residual", f"{max(float(np.max(curve.orbit.residual)) for curve in (*curves, *soft)):.1e}")
    inner = [np.asarray(curve.orbit.status)[1:-1] for curve in (*curves, *soft)]
    say("points between the ends that the impact map does not verify", f"{sum(int((s != 0).sum()) for s in inner)}")
    cusp()


def soft_curves() -> list[BifurcationCurve]:
    """Follow curves of the default plane from the orbits of one cell."""
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (3.0, 400.0))
    points = [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]
    return curves_of(points, "kappa", {"d": (0.05, 0.3), "kappa": (3.0, 400.0)})


def products(what: str, curves: list[BifurcationCurve]) -> None:
    """Compare the product of both multipliers with what it must be, on every point."""
    worst = 0.0
    for curve in curves:
        orbit, pair = curve.orbit, curve.orbit.pair
        turns = np.where(np.asarray(orbit.sequence.mirrored), 2, 1)
        if pair.rigid:
            expected = np.asarray(pair.r) ** (2 * turns * np.asarray(orbit.count))
        else:
            stays = np.nansum(np.asarray(orbit.knots)[..., 2], axis=1)
            expected = np.exp(-np.asarray(flow.membrane(pair).mu) * turns * stays)
        worst = max(worst, float(np.abs(np.asarray(orbit.multipliers).prod(axis=1).real - expected).max()))
    say(f"{what} walls: largest error of the product of multipliers", f"{worst:.1e}")


def cusp() -> None:
    """Fit the exponent with which gravity unfolds the pitchfork."""
    plane = {"d": (0.25, 0.28), "gamma": (-2e-3, 2e-3)}
    start = vijax.find_orbits(vijax.impact_pair(0.262, None, 0.5, 1e-4), "RL", guesses=256)
    branches = vijax.follow_families(start, "d", (0.255, 0.268), max_switches=0)
    folds = [point for branch in branches for point in branch.points if point.kind == "fold"]
    fold = max(curves_of(folds, "d", plane), key=lambda curve: len(curve.values))
    (tip,) = (point for point in fold.points if point.kind == "cusp")
    say("cusp under gravity: error of d, and gamma", f"{tip.values[0] - pitchfork(0.5):.1e}, {tip.values[1]:.1e}")
    d, gamma = fold.values.T
    for side, sign in (("below", -1), ("above", 1)):
        near = (sign * gamma > 1e-8) & (sign * gamma < 1e-4)
        power = np.polyfit(np.log(pitchfork(0.5) - d[near]), np.log(np.abs(gamma[near])), 1)[0]
        say(f"exponent of gamma over the distance from it, gamma {side} 0", f"{power:.5f}")


def lines() -> None:
    """Follow branches along random lines through a plane, and compare what they locate with where curves cross."""
    draw = np.random.default_rng(0)
    seeds = [point for r in (0.3, 0.5, 0.7) for point in met(0.2, r, "d", PLANE["d"])]
    curves = curves_of(seeds, "d", PLANE)
    found, missing, extra, worst = 0, 0, 0, 0.0
    for index in range(LINES):
        along, still = ("d", "r") if index % 2 else ("r", "d")
        value = float(draw.uniform(*INNER[still]))
        start = {still: value, along: START[along]}
        located = {
            (point.kind.split()[0], round(point.value, 9)): point.value
            for point in met(start["d"], start["r"], along, PLANE[along])
        }
        crossings = [one for curve in curves for one in crossed(curve, still, value)]
        for (kind, _), x in located.items():
            off = [abs(x - y) for k, y in crossings if k == kind]
            found, missing = found + 1, missing + (min(off, default=1.0) > SAME)
            worst = max(worst, min((one for one in off if one <= SAME), default=0.0))
        for kind, y in crossings:
            extra += min((abs(x - y) for (k, _), x in located.items() if k == kind), default=1.0) > SAME
    say(f"points that branches locate along {LINES} lines", f"{found}")
    say("of these without a curve that crosses there; crossings without a point", f"{missing}; {extra}")
    say("largest distance between the two", f"{worst:.1e}")


def crossed(curve: BifurcationCurve, still: str, value: float) -> list[tuple[str, float]]:
    """Find where a curve crosses a line: from a point beside it the curve is followed to the line as its bound."""
    index = curve.along.index(still)
    across, along = curve.values[:, index] - value, curve.along[1 - index]
    found = []
    for place in np.flatnonzero(np.sign(across[:-1]) * np.sign(across[1:]) < 0):
        inside = place if across[place] > 0 else place + 1
        kind = "grazing flight" if curve.kind == "grazing" else curve.kind
        beside = Point(kind, float(curve.values[inside, 1 - index]), curve.orbit[inside : inside + 1])
        plane = {still: (value, PLANE[still][1]), along: PLANE[along]}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            followed = vijax.follow_curves([beside], along, plane, max_points=40)
        ends = [row for one in followed for row in one.values[[0, -1]] if abs(row[0] - value) < SAME**2]
        guess = curve.values[inside, 1 - index]
        found += [(curve.kind, float(min((row[1] for row in ends), key=lambda x: abs(x - guess))))] if ends else []
    return found


def speed() -> None:
    """Time the curves of a few orbits of the default plane, once compiled."""
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (3.0, 400.0))
    points = [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]
    plane, fine = {"d": (0.05, 0.3), "kappa": (3.0, 400.0)}, vijax.ContinuationSettings(max_step=1e-3)
    for _ in range(2):
        begun = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            curves = vijax.follow_curves(points, "kappa", plane, settings=fine)
        seconds = time.perf_counter() - begun
    count = sum(len(curve.values) for curve in curves)
    say(
        "curve points, seconds once compiled, seconds for 10,000",
        f"{count}, {seconds:.1f}, {1e4 * seconds / count:.1f}",
    )


def limits() -> None:
    """Compare impacts on curves of limits, as the impact map flies them, with the limits."""
    device = vijax.Harvester()
    pair = vijax.impact_pair(0.2, 60.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (20.0, 400.0))
    points = vijax.limit_points(branches, device=device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        plane = {"d": (0.05, 0.3), "kappa": (20.0, 400.0)}
        curves = vijax.follow_curves(points, "kappa", plane, device=device)
    for kind in LIMITS:
        mine = [curve for curve in curves if curve.kind == kind]
        if mine:
            flown = [curve.orbit[np.flatnonzero(np.asarray(curve.orbit.status) == vijax.Status.OK)] for curve in mine]
            off = [np.abs(loads(orbit, device)[kind].max(axis=1) - 1).max() for orbit in flown]
            count = sum(len(curve.values) for curve in mine)
            say(f"{kind}: curves, points, verified ones", f"{len(mine)}, {count}, {sum(map(len, flown))}")
            say(f"{kind}: largest error of these, relative to it", f"{max(off):.1e}")


def explained(charts: Path | None = None) -> None:
    """Count the borders between labels of periodic cells that lie within one cell of a curve, on two planes."""
    planes: dict[str, dict[str, Any]] = {
        "d x kappa, 256 x 256": {"d": np.linspace(0.05, 0.3, 256), "kappa": np.geomspace(3, 400, 256), "r": 0.5},
        "omega x omega0, 128 x 128": {
            "omega": np.linspace(3.0, 12.0, 128),
            "omega0": np.geomspace(20, 400, 128),
            "s": 0.2,
            "r": 0.5,
        },
    }
    for name, axes in planes.items():
        dataset = vijax.sweep(**axes)
        vijax.bifurcation_curves(dataset)  # compiles
        begun = time.perf_counter()
        found = vijax.bifurcation_curves(dataset)
        seconds = time.perf_counter() - begun
        share = found.explained / max(found.borders, 1)
        say(f"{name}: borders, share within a cell of a curve", f"{found.borders}, {share:.1%}")
        points = sum(len(curve.values) for curve in found.curves)
        say(f"{name}: curves, points, seconds once compiled", f"{len(found.curves)}, {points}, {seconds:.0f}")
        say(f"{name}: largest piece that no curve explains, in borders; ended", f"{len(found.largest)}; {found.ended}")
        if charts is not None:
            figure = vijax.plots.curves(vijax.curve_dataset(found), dataset)
            vijax.plots.save(figure, charts / f"curves_{'_'.join(found.along)}.png")


PARTS: dict[str, Callable[..., None]] = {
    "known": known,
    "lines": lines,
    "speed": speed,
    "limits": limits,
    "explained": explained,
}


def main() -> int:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--charts", type=Path, metavar="FOLDER", help="where to draw the planes that are explained")
    given = parser.parse_args()
    for name, part in PARTS.items():
        if given.only in (None, name):
            part(given.charts) if part is explained else part()
    return 0


if __name__ == "__main__":
    sys.exit(main())
