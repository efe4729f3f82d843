"""Are curves of bifurcations where they are known to be, do they miss none, what do they cost and what do they explain?

    python benchmarks/curves.py               # all figures
    python benchmarks/curves.py --only known  # one part
    python benchmarks/curves.py --only limits
    python benchmarks/curves.py --only explained --charts .  # and pictures of both planes with their curves

One line a figure. Errors are against closed forms, against points that branches along random lines through a plane
locate by themselves, and against the product of both multipliers, which is known of every orbit.
"""

import argparse
import dataclasses
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from benchmarks.orbits import say
from vijax.model import flow
from vijax.orbits import periodic, switching, symmetry
from vijax.orbits.criticality import cubic_coefficient
from vijax.orbits.curve_starts import curve_start
from vijax.orbits.curves import BifurcationCurve, curves_from
from vijax.orbits.events import Point
from vijax.orbits.limits import LIMITS, loads
from vijax.orbits.map_borders import labelled_plane

R = (0.02, 0.98)
PLANE = {"d": (0.05, 0.32), "r": (0.15, 0.9)}
INNER = {"d": (0.15, 0.3), "r": (0.2, 0.85)}  # where lines lie
START = {"d": 0.2, "r": 0.5}  # and orbits on them begin
LINES = 200
SOFT = {"d": (0.05, 0.3), "kappa": (3.0, 400.0)}
DEVICE = vijax.Harvester(s=0.2)  # whose omega moves d and kappa
PLAIN, FINE = vijax.ContinuationSettings(max_grazings=0), vijax.ContinuationSettings(max_step=1e-3)
SAME = 1e-6  # Two crossings nearer than this, in parts of the line, are one.
_FOLLOWED = ("fold", "flip", "pitchfork", "grazing flight", "grazing impact")


def pitchfork(r: Any) -> Any:
    """Give the gap at which the symmetric orbit of rigid walls breaks, level."""
    q = (1 + r) / (np.pi * (1 - r))
    return (1 - 4 / np.pi**2) * q / np.sqrt(1 + 4 * q * q)


def symmetric(d: float, r: float) -> vijax.Orbit:
    """Find the period-1 orbits of rigid walls with an impact on each."""
    return vijax.find_orbits(vijax.impact_pair(d, None, r), "RL", guesses=64)


def even(d: float, kappa: float) -> vijax.Orbit:
    """Find the symmetric period-1 orbits of soft walls with an impact on each."""
    found = vijax.find_orbits(vijax.impact_pair(d, kappa, 0.5), "1:1", guesses=64)
    return found[symmetry.symmetric(found)]


def met(start: vijax.Orbit, line: "Line", within: tuple[float, float]) -> list[Point]:
    """Find what orbits, and those that bifurcate from them, meet along a line."""
    branches = vijax.follow_families(start, line.along, within, device=line.device, settings=PLAIN)
    return [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]


def curves_of(
    points: list[Point],
    along: str,
    plane: dict[str, tuple[float, float]],
    settings: vijax.ContinuationSettings = PLAIN,
) -> list[BifurcationCurve]:
    """Follow points without a word about those from which nothing begins."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return vijax.follow_curves(points, along, plane, settings=settings)


def known() -> None:
    """Compare the pitchfork with its closed form, products of multipliers with theirs, and a cusp with its exponent."""
    points = met(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32))
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
    return curves_of(points, "kappa", SOFT)


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
        inner = (sign * gamma > 1e-7) & (sign * gamma < 2e-4)
        away = pitchfork(0.5) - d[inner]
        say(f"coefficient of that power, gamma {side} 0", f"{at_zero(away, np.abs(gamma[inner]) / away**1.5):.8f}")


def at_zero(x: np.ndarray, y: np.ndarray) -> float:
    """Extrapolate a smooth function to 0 by a polynomial, in x over its range."""
    return float(np.polyfit(x / x.max(), y, 4)[-1])


class Line(NamedTuple):
    """A line through a plane: the parameter that moves along it, the one that stays, and its value.

    Of omega at a value of omega0 it is a slanted line through the plane of d and kappa: d kappa^2 stays.
    """

    along: str
    still: str
    value: float

    @property
    def device(self) -> vijax.Harvester:
        """Give the device whose omega moves along the line."""
        return dataclasses.replace(DEVICE, omega0=self.value) if self.still == "omega0" else DEVICE

    def within(self, plane: dict[str, tuple[float, float]]) -> tuple[float, float]:
        """Give the bounds of the parameter that moves."""
        if self.along in plane:
            return plane[self.along]
        by_d = np.pi * np.sqrt(np.array(plane["d"]) * DEVICE.A / DEVICE.s)
        by_kappa = np.pi * self.value / np.array(plane["kappa"])[::-1]
        return float(max(by_d[0], by_kappa[0])), float(min(by_d[1], by_kappa[1]))

    def off(self, pair: vijax.ImpactPair) -> np.ndarray:
        """Say how far pairs are from the line."""
        if self.still != "omega0":
            return np.asarray(getattr(pair, self.still)) - self.value
        return np.asarray(pair.kappa * np.sqrt(pair.d * DEVICE.A / DEVICE.s)) - self.value

    def place(self, pair: vijax.ImpactPair) -> float:
        """Give the parameter that moves, of a pair that is alone."""
        if self.along != "omega":
            return float(np.asarray(getattr(pair, self.along))[0])
        return float(np.pi * np.sqrt(np.asarray(pair.d)[0] * DEVICE.A / DEVICE.s))


class Crossing(NamedTuple):
    """Where a curve crosses a line: what bifurcates, the place on the line, the orbit."""

    kind: str
    place: float
    orbit: vijax.Orbit


def cubic() -> None:
    """Compare the cubic coefficient of a flip with how far apart the turns of doubled orbits are beyond it.

    With the multiplier -1 - m of the simple orbit, orbits of x -> -(1 + m) x + b x^3 with two turns have x^2 = m/b.
    """
    (point, *_) = (
        point for point in met(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32)) if point.kind == "flip"
    )
    knots = jnp.where(point.orbit.sequence.real[..., None], point.orbit.knots, 0.0)
    coefficient = float(jax.vmap(cubic_coefficient)(point.orbit.pair, point.orbit.sequence, knots)[0])
    away, ratio = [], []
    for branch in switching.switch(point, "d", (0.1, 0.32), settings=FINE, points=40):
        count, near = int(point.orbit.count[0]), np.abs(branch.values - point.value) < 2e-4
        for d, orbit in zip(branch.values[near], np.asarray(branch.orbit.knots)[near], strict=True):
            pair = dataclasses.replace(point.orbit.pair, d=jnp.array([d]))
            simple = periodic.solve(pair, point.orbit.sequence, knots)
            turns = np.stack([orbit[:count], orbit[count : 2 * count]])
            turns[1, :, 0] -= float(point.orbit.sequence.span[0])
            excess = -1 - float(np.asarray(simple.multipliers)[0, 0].real)
            if abs(d - point.value) > 1e-6:
                away.append(abs(d - point.value))
                ratio.append(coefficient * float(((turns[0] - turns[1]) ** 2).sum()) / 4 / excess)
    order = np.argsort(away)
    fitted = at_zero(np.array(away)[order], np.array(ratio)[order])
    say("cubic coefficient of a rigid flip; doubled orbits beyond it", f"{coefficient:.6f}; {len(away)}")
    say("square of their amplitude over m/b, at the flip: off 1 by", f"{fitted - 1:.1e}")


def resonant() -> None:
    """Compare where a fold and a flip begin at a resonant graze, and with what power they depart from the graze.

    They do so as the square of the way along it (Simpson, Ghosh, arXiv 2602.22797).
    """
    points = met(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32))
    curves = vijax.follow_curves(points, "d", {"d": (0.02, 0.4), "r": R}, max_switches=1, settings=FINE)
    for graze in (curve for curve in curves if curve.kind == "grazing"):
        for place in (np.array(point.values) for point in graze.points if point.kind == "resonant graze"):
            begun = [
                (curve, point.values)
                for curve in curves
                for point in curve.points
                if point.test == "impact" and np.abs(place - point.values).max() < SAME
            ]
            if len(begun) == 2:
                what = f"resonant graze at d = {place[0]:.6f}, r = {place[1]:.6f}"
                sides = [place, *(np.array(values) for _, values in begun)]
                apart = max(np.abs(np.subtract(one, other)).max() for one in sides for other in sides)
                say(f"{what}: fold, flip and graze, largest difference", f"{apart:.1e}")
                for curve, _ in begun:
                    say(f"{what}: exponent, coefficient of the {curve.kind}", departure(graze, curve, place))


def departure(graze: BifurcationCurve, curve: BifurcationCurve, place: np.ndarray) -> str:
    """Fit how a curve departs from that of a graze along r: the exponent, and the coefficient of the square."""

    def near(one: BifurcationCurve, reach: float) -> np.ndarray:
        away = one.values - place
        return away[(np.abs(away) < reach).all(axis=1) & (np.abs(away[:, 1]) > SAME)].T

    beside, along = near(graze, 0.02)
    d, r = near(curve, 0.01)
    off = d - np.polyval(np.polyfit(along / 0.02, beside, 10), r / 0.02)
    far = np.abs(off) > 1e-10  # Beyond that rounding is a part of it.
    power = np.diff(np.log(np.abs(off[far]))) / np.diff(np.log(np.abs(r[far])))
    middle = 0.5 * (np.abs(r[far])[1:] + np.abs(r[far])[:-1])
    return f"{at_zero(middle, power):.4f}, {at_zero(np.abs(r[far]), off[far] / r[far] ** 2):.6f}"


def lines(number: int = LINES) -> None:
    """Follow branches along random lines through planes, and compare what they locate with where curves cross."""
    draw, half = np.random.default_rng(0), number // 2
    ways = [("d", "r") if index % 2 else ("r", "d") for index in range(half)]
    told = [Line(*way, float(draw.uniform(*INNER[way[1]]))) for way in ways]
    starts = [symmetric(**{line.still: line.value, line.along: START[line.along]}) for line in told]
    compared("rigid, d x r", told, starts, PLANE)
    d, kappa = draw.uniform(0.15, 0.25, number - half), np.exp(draw.uniform(np.log(20), np.log(100), number - half))
    omega0 = kappa * np.sqrt(d * DEVICE.A / DEVICE.s)
    told = [
        (Line("d", "kappa", kappa[i]), Line("kappa", "d", d[i]), Line("omega", "omega0", omega0[i]))[i % 3]
        for i in range(number - half)
    ]
    starts = [even(*place) for place in zip(d, kappa, strict=True)]
    compared("soft, d x kappa, a third slanted", told, starts, SOFT)


def compared(what: str, told: list[Line], starts: list[vijax.Orbit], plane: dict[str, tuple[float, float]]) -> None:
    """Compare crossings with points that branches locate: from orbits on each line, and from those beside crossings.

    A located point that lies on no curve begins one. So it is crossed there of itself, but the curve must cross all
    other lines where branches locate something, and nowhere else.
    """
    each = [met(start, line, line.within(plane)) for line, start in zip(told, starts, strict=True)]
    curves = curves_through([point for points in each for point in points], plane)
    beyond, extra, off, faded = 0, 0, [], list[float]()
    for line, located in zip(told, each, strict=True):
        low, high = line.within(plane)
        crossings = [one for curve in curves for one in crossed(curve, line, plane)]
        for one in crossings:
            if nearest(one, located) > SAME * (high - low):
                # The branches from the start do not come there, but one of the orbits that bifurcate must.
                beyond += 1
                located = located + beside(one, line, (low, high))
            extra += nearest(one, located) > SAME * (high - low)
        faded += [float(np.asarray(point.orbit.pair.d)[0]) for point in located if fades(point)]
        located = [point for point in located if not fades(point)]
        apart = [min((nearest(one, [point]) for one in crossings), default=np.inf) for point in located]
        off += [one / (high - low) for one in apart]
    away = np.array(off)
    say(f"{what}: points that branches locate along {len(told)} lines; curves", f"{len(away)}; {len(curves)}")
    say(f"{what}: points at which no curve crosses; crossings without a point", f"{(away > SAME).sum()}; {extra}")
    say(f"{what}: crossings that only a branch from an orbit beside them locates", f"{beyond}")
    say(f"{what}: largest distance between the two, in parts of a line", f"{away[away <= SAME].max():.1e}")
    if faded:
        # An orbit that fades is that of a ball which the shaking alone carries from wall to wall.
        say(f"{what}: orbits that fade there, which begin no curve", f"{len(faded)}")
        say(f"{what}: largest error of their d, 2/pi^2", f"{np.abs(np.array(faded) - 2 / np.pi**2).max():.1e}")


def fades(point: Point) -> bool:
    """Say whether the speed of an orbit's only impact comes to zero, so that no orbit is beyond."""
    return point.kind == "grazing impact" and int(point.orbit.count[0]) == 1


def curves_through(points: list[Point], plane: dict[str, tuple[float, float]]) -> list[BifurcationCurve]:
    """Follow points of several lines, each curve once."""
    one, other = ([float(getattr(point.orbit.pair, name)[0]) for point in points] for name in plane)
    places = zip(one, other, strict=True)
    begun = [curve_start(point, place, PLAIN.asymmetry) for point, place in zip(points, places, strict=True)]
    starts = [start for start in begun if not isinstance(start, str)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return [one for some in curves_from(starts, plane, DEVICE, 4000, PLAIN) for one in some]


def nearest(crossing: Crossing, points: list[Point]) -> float:
    """Find how far the nearest point of the same kind is."""
    kind = crossing.kind
    return min((abs(p.value - crossing.place) for p in points if p.kind.split()[0] == kind), default=np.inf)


def beside(crossing: Crossing, line: Line, within: tuple[float, float]) -> list[Point]:
    """Find what a branch meets that begins at an orbit near one that bifurcates, and so passes that."""
    points = []
    told: Any = {"device": line.device, "settings": PLAIN}
    for branch in vijax.follow_orbits(crossing.orbit, line.along, within, points=12, **told):
        for orbit in (branch.orbit[:1], branch.orbit[-1:]):
            if len(orbit) and np.asarray(orbit.status)[0] == 0:
                points += [p for one in vijax.follow_orbits(orbit, line.along, within, **told) for p in one.points]
    return [point for point in points if point.kind in _FOLLOWED]


def crossed(curve: BifurcationCurve, line: Line, plane: dict[str, tuple[float, float]]) -> list[Crossing]:
    """Find where a curve crosses a line: from a point beside it the curve is followed to the line as its bound."""
    across, found = line.off(curve.orbit.pair), []
    # The orbit at which a curve begins may lie on the line itself.
    above = across >= 0
    for place in np.flatnonzero(above[:-1] != above[1:]):
        inside = place if above[place] else place + 1
        kind = "grazing flight" if curve.kind == "grazing" else curve.kind
        orbit = curve.orbit[inside : inside + 1]
        guess = line.place(orbit.pair)
        high = plane[line.still][1] if line.still in plane else 2 * line.value
        # A curve may end a rounding beyond the bound of its plane.
        low, top = plane.get(line.along, (guess / 2, guess * 2))
        bounds = {line.still: (line.value, high), line.along: (low - SAME**2, top + SAME**2)}
        there = (
            dataclasses.replace(line.device, omega0=line.value + float(across[inside]))
            if line.still == "omega0"
            else line.device
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            followed = vijax.follow_curves([Point(kind, guess, orbit)], line.along, bounds, device=there, max_points=40)
        ends = [one.orbit[at : at + 1] if at == 0 else one.orbit[-1:] for one in followed for at in (0, -1)] + [orbit]
        ends = [end for end in ends if abs(line.off(end.pair)[0]) < SAME**2 * max(1.0, line.value)]
        if ends:
            orbit = min(ends, key=lambda end: abs(line.place(end.pair) - guess))
            found.append(Crossing(curve.kind, line.place(orbit.pair), orbit))
    return found


def speed() -> None:
    """Time the curves of a few orbits of the default plane, once compiled."""
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (3.0, 400.0))
    points = [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]
    for _ in range(2):
        begun = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            curves = vijax.follow_curves(points, "kappa", SOFT, settings=FINE)
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
        say(f"{name}: borders of basins among the others", f"{found.basins.sum()} of {len(found.left)}")
        if len(found.largest):
            say(f"{name}: what that piece parts", described(found.largest, dataset))
        if charts is not None:
            figure = vijax.plots.curves(vijax.curve_dataset(found), dataset)
            vijax.plots.save(figure, charts / f"curves_{'_'.join(found.along)}.png")


def described(where: np.ndarray, dataset: Any) -> str:
    """Say which labels part most often at places half way between cells, and where the first of them is."""
    plane = labelled_plane(dataset)
    index = np.stack([np.interp(x, axis, np.arange(len(axis))) for x, axis in zip(where.T, plane.axes, strict=True)])
    low, high = (np.round(index + shift).astype(int) for shift in (-0.25, 0.25))
    sides = zip(plane.names[tuple(low)], plane.names[tuple(high)], strict=True)
    (names, _), *_ = Counter(" | ".join(sorted(map(str, pair))) for pair in sides).most_common(1)
    place = ", ".join(f"{name} {x:.4g}" for name, x in zip(plane.along, where[0], strict=True))
    return f"{names} near {place}"


PARTS: dict[str, Callable[..., None]] = {
    "known": known,
    "cubic": cubic,
    "resonant": resonant,
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
    parser.add_argument("--lines", type=int, default=LINES, help="how many lines are drawn")
    given = parser.parse_args()
    for name, part in PARTS.items():
        if given.only in (None, name):
            told: dict[Callable[..., None], Any] = {explained: given.charts, lines: given.lines}
            part(*([told[part]] if part in told else []))
    return 0


if __name__ == "__main__":
    sys.exit(main())
