"""Are curves of bifurcations accurate and complete, how long do they take, and how much of a map do they explain?

    python benchmarks/curves.py               # all figures
    python benchmarks/curves.py --only known  # one part
    python benchmarks/curves.py --only limits
    python benchmarks/curves.py --only explained --charts .  # and pictures of both planes with their curves

One line a figure. Errors are against closed forms, against points that branches along random lines through a plane
locate independently, and against the product of both multipliers, which has a closed form for every orbit.
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
from benchmarks.orbits import print_figure
from vijax.continuation import branch_switching
from vijax.continuation.branch_events import Point
from vijax.continuation.criticality import cubic_coefficient
from vijax.continuation.curves.curve_starts import curve_start
from vijax.continuation.curves.curves import BifurcationCurve, curves_from
from vijax.continuation.from_map.map_borders import labelled_plane
from vijax.continuation.limits import LIMITS, load_ratios
from vijax.model import flow
from vijax.orbits import periodic, symmetry

R = (0.02, 0.98)
PLANE = {"d": (0.05, 0.32), "r": (0.15, 0.9)}
INNER = {"d": (0.15, 0.3), "r": (0.2, 0.85)}  # range of the lines
START = {"d": 0.2, "r": 0.5}  # starts of the orbits on the lines
LINES = 200
SOFT = {"d": (0.05, 0.3), "kappa": (3.0, 400.0)}
DEVICE = vijax.Harvester(s=0.2)  # its omega moves d and kappa
PLAIN, FINE = vijax.ContinuationSettings(max_grazings=0), vijax.ContinuationSettings(max_step=1e-3)
SAME = 1e-6  # crossings nearer than this, as a fraction of the line, are equal
_FOLLOWED = ("fold", "flip", "pitchfork", "grazing flight", "grazing impact")


def pitchfork(r: Any) -> Any:
    """Return the gap at the symmetry breaking of the symmetric orbit, for rigid walls without gravity."""
    q = (1 + r) / (np.pi * (1 - r))
    return (1 - 4 / np.pi**2) * q / np.sqrt(1 + 4 * q * q)


def symmetric(d: float, r: float) -> vijax.Orbit:
    """Return the period-1 orbits of rigid walls with an impact on each wall."""
    return vijax.find_orbits(vijax.impact_pair(d, None, r), "RL", guesses=64)


def even(d: float, kappa: float) -> vijax.Orbit:
    """Return the symmetric period-1 orbits of soft walls with an impact on each wall."""
    orbits = vijax.find_orbits(vijax.impact_pair(d, kappa, 0.5), "1:1", guesses=64)
    return orbits[symmetry.is_symmetric(orbits)]


def events_along(start: vijax.Orbit, line: "Line", limits: tuple[float, float]) -> list[Point]:
    """Return the events of orbits, and of the orbits that bifurcate from them, along a line."""
    branches = vijax.follow_families(start, line.along, limits, device=line.device, settings=PLAIN)
    return [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]


def curves_of(
    points: list[Point],
    along: str,
    plane: dict[str, tuple[float, float]],
    settings: vijax.ContinuationSettings = PLAIN,
) -> list[BifurcationCurve]:
    """Continue curves from points, without warnings about points where no curve begins."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return vijax.follow_curves(points, along, plane, settings=settings)


def closed_forms() -> None:
    """Compare pitchforks and multiplier products with closed forms, and a cusp with its exponent."""
    points = events_along(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32))
    curves = curves_of(points, "d", {"d": (0.02, 0.4), "r": R})
    (pitchfork_curve,) = (curve for curve in curves if curve.kind == "pitchfork")
    d, r = pitchfork_curve.values.T
    print_figure("rigid 1:1, pitchfork: largest error of d", f"{np.abs(d - pitchfork(r)).max():.1e}")
    print_figure("rigid 1:1, pitchfork: r from, to; ends", f"{r.min():.6f}, {r.max():.6f}; {pitchfork_curve.ends}")
    sides = {
        kind: [np.array(p.values) for c in curves if c.kind == kind for p in c.points if p.kind == "flip-graze"]
        for kind in ("flip", "grazing")
    }
    difference = min(
        np.abs(flip_point - grazing_point).max() for flip_point in sides["flip"] for grazing_point in sides["grazing"]
    )
    print_figure("flip-graze from either side: difference", f"{difference:.1e}")
    products("rigid", curves)
    soft = soft_curves()
    products("soft", soft)
    print_figure("largest residual", f"{max(float(np.max(curve.orbit.residual)) for curve in (*curves, *soft)):.1e}")
    inner = [np.asarray(curve.orbit.status)[1:-1] for curve in (*curves, *soft)]
    print_figure(
        "points between the ends that the impact map does not verify", f"{sum(int((s != 0).sum()) for s in inner)}"
    )
    cusp()


def soft_curves() -> list[BifurcationCurve]:
    """Continue curves of the default plane from the orbits of one cell."""
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (3.0, 400.0))
    points = [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]
    return curves_of(points, "kappa", SOFT)


def products(walls: str, curves: list[BifurcationCurve]) -> None:
    """Compare the product of both multipliers with its closed form at every point."""
    worst = 0.0
    for curve in curves:
        orbit, pair = curve.orbit, curve.orbit.pair
        turns = np.where(np.asarray(orbit.sequence.mirrored), 2, 1)
        if pair.rigid:
            expected = np.asarray(pair.r) ** (2 * turns * np.asarray(orbit.count))
        else:
            contact_time = np.nansum(np.asarray(orbit.impact_unknowns)[..., 2], axis=1)
            expected = np.exp(-np.asarray(flow.membrane(pair).mu) * turns * contact_time)
        worst = max(worst, float(np.abs(np.asarray(orbit.multipliers).prod(axis=1).real - expected).max()))
    print_figure(f"{walls} walls: largest error of the product of multipliers", f"{worst:.1e}")


def cusp() -> None:
    """Fit the exponent with which gravity unfolds the pitchfork."""
    plane = {"d": (0.25, 0.28), "gamma": (-2e-3, 2e-3)}
    start = vijax.find_orbits(vijax.impact_pair(0.262, None, 0.5, 1e-4), "RL", guesses=256)
    branches = vijax.follow_families(start, "d", (0.255, 0.268), max_switches=0)
    folds = [point for branch in branches for point in branch.points if point.kind == "fold"]
    fold = max(curves_of(folds, "d", plane), key=lambda curve: len(curve.values))
    (tip,) = (point for point in fold.points if point.kind == "cusp")
    print_figure(
        "cusp under gravity: error of d, and gamma", f"{tip.values[0] - pitchfork(0.5):.1e}, {tip.values[1]:.1e}"
    )
    d, gamma = fold.values.T
    for side, sign in (("below", -1), ("above", 1)):
        close = (sign * gamma > 1e-8) & (sign * gamma < 1e-4)
        power = np.polyfit(np.log(pitchfork(0.5) - d[close]), np.log(np.abs(gamma[close])), 1)[0]
        print_figure(f"exponent of gamma over the distance from it, gamma {side} 0", f"{power:.5f}")
        fit_range = (sign * gamma > 1e-7) & (sign * gamma < 2e-4)
        distance = pitchfork(0.5) - d[fit_range]
        print_figure(
            f"coefficient of that power, gamma {side} 0",
            f"{at_zero(distance, np.abs(gamma[fit_range]) / distance**1.5):.8f}",
        )


def at_zero(x: np.ndarray, y: np.ndarray) -> float:
    """Extrapolate a smooth function to 0 by a polynomial, in x over its range."""
    return float(np.polyfit(x / x.max(), y, 4)[-1])


class Line(NamedTuple):
    """A line through a plane: the parameter that moves along it, the fixed parameter, and its value.

    For omega at a value of omega0 the line is slanted in the plane of d and kappa: d kappa^2 is constant.
    """

    along: str
    fixed: str
    value: float

    @property
    def device(self) -> vijax.Harvester:
        """Return the device with the omega that moves along the line."""
        return dataclasses.replace(DEVICE, omega0=self.value) if self.fixed == "omega0" else DEVICE

    def within(self, plane: dict[str, tuple[float, float]]) -> tuple[float, float]:
        """Return the bounds of the moving parameter."""
        if self.along in plane:
            return plane[self.along]
        by_d = np.pi * np.sqrt(np.array(plane["d"]) * DEVICE.A / DEVICE.s)
        by_kappa = np.pi * self.value / np.array(plane["kappa"])[::-1]
        return float(max(by_d[0], by_kappa[0])), float(min(by_d[1], by_kappa[1]))

    def distance_from(self, pair: vijax.ImpactPair) -> np.ndarray:
        """Return the distance of pairs from the line, in the fixed parameter."""
        if self.fixed != "omega0":
            return np.asarray(getattr(pair, self.fixed)) - self.value
        return np.asarray(pair.kappa * np.sqrt(pair.d * DEVICE.A / DEVICE.s)) - self.value

    def position(self, pair: vijax.ImpactPair) -> float:
        """Return the moving parameter of a single pair."""
        if self.along != "omega":
            return float(np.asarray(getattr(pair, self.along))[0])
        return float(np.pi * np.sqrt(np.asarray(pair.d)[0] * DEVICE.A / DEVICE.s))


class Crossing(NamedTuple):
    """A crossing of a curve and a line: kind of bifurcation, position on the line, orbit."""

    kind: str
    position: float
    orbit: vijax.Orbit


def cubic() -> None:
    """Compare the cubic coefficient of a flip with the amplitude of the doubled orbits near it.

    With the multiplier -1 - m of the simple orbit, orbits of x -> -(1 + m) x + b x^3 with two turns satisfy x^2 = m/b.
    """
    (point, *_) = (
        point for point in events_along(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32)) if point.kind == "flip"
    )
    impact_unknowns = jnp.where(point.orbit.sequence.real[..., None], point.orbit.impact_unknowns, 0.0)
    coefficient = float(jax.vmap(cubic_coefficient)(point.orbit.pair, point.orbit.sequence, impact_unknowns)[0])
    distances, ratios = [], []
    for branch in branch_switching.switch_branch(point, "d", (0.1, 0.32), settings=FINE, points=40):
        count, near = int(point.orbit.count[0]), np.abs(branch.values - point.value) < 2e-4
        for d, orbit in zip(branch.values[near], np.asarray(branch.orbit.impact_unknowns)[near], strict=True):
            pair = dataclasses.replace(point.orbit.pair, d=jnp.array([d]))
            simple = periodic.solve(pair, point.orbit.sequence, impact_unknowns)
            turns = np.stack([orbit[:count], orbit[count : 2 * count]])
            turns[1, :, 0] -= float(point.orbit.sequence.span[0])
            excess = -1 - float(np.asarray(simple.multipliers)[0, 0].real)
            if abs(d - point.value) > 1e-6:
                distances.append(abs(d - point.value))
                ratios.append(coefficient * float(((turns[0] - turns[1]) ** 2).sum()) / 4 / excess)
    order = np.argsort(distances)
    ratio_at_flip = at_zero(np.array(distances)[order], np.array(ratios)[order])
    print_figure("cubic coefficient of a rigid flip; doubled orbits beyond it", f"{coefficient:.6f}; {len(distances)}")
    print_figure("square of their amplitude over m/b, at the flip: off 1 by", f"{ratio_at_flip - 1:.1e}")


def resonant() -> None:
    """Compare the ends of a fold and of a flip at a resonant grazing, and the exponent of their departure from it.

    The distance grows as the square of the arc length (Simpson, Ghosh, arXiv 2602.22797).
    """
    points = events_along(symmetric(0.2, 0.5), Line("d", "r", 0.5), (0.1, 0.32))
    curves = vijax.follow_curves(points, "d", {"d": (0.02, 0.4), "r": R}, max_switches=1, settings=FINE)
    for graze in (curve for curve in curves if curve.kind == "grazing"):
        for position in (np.array(point.values) for point in graze.points if point.kind == "resonant graze"):
            ending = [
                (curve, point.values)
                for curve in curves
                for point in curve.points
                if point.test == "impact" and np.abs(position - point.values).max() < SAME
            ]
            if len(ending) == 2:
                name = f"resonant graze at d = {position[0]:.6f}, r = {position[1]:.6f}"
                sides = [position, *(np.array(values) for _, values in ending)]
                difference = max(
                    np.abs(np.subtract(first_end, second_end)).max() for first_end in sides for second_end in sides
                )
                print_figure(f"{name}: fold, flip and graze, largest difference", f"{difference:.1e}")
                for curve, _ in ending:
                    print_figure(
                        f"{name}: exponent, coefficient of the {curve.kind}", fit_deviation(graze, curve, position)
                    )


def fit_deviation(graze: BifurcationCurve, curve: BifurcationCurve, position: np.ndarray) -> str:
    """Fit the deviation of a curve from the grazing curve along r: the exponent, and the coefficient of the square."""

    def near(which_curve: BifurcationCurve, reach: float) -> np.ndarray:
        offsets = which_curve.values - position
        return offsets[(np.abs(offsets) < reach).all(axis=1) & (np.abs(offsets[:, 1]) > SAME)].T

    d_of_graze, r_of_graze = near(graze, 0.02)
    d, r = near(curve, 0.01)
    deviation_of_d = d - np.polyval(np.polyfit(r_of_graze / 0.02, d_of_graze, 10), r / 0.02)
    resolved = np.abs(deviation_of_d) > 1e-10  # smaller values consist of rounding in part
    power = np.diff(np.log(np.abs(deviation_of_d[resolved]))) / np.diff(np.log(np.abs(r[resolved])))
    middle = 0.5 * (np.abs(r[resolved])[1:] + np.abs(r[resolved])[:-1])
    return (
        f"{at_zero(middle, power):.4f}, {at_zero(np.abs(r[resolved]), deviation_of_d[resolved] / r[resolved] ** 2):.6f}"
    )


def lines(number: int = LINES) -> None:
    """Continue branches along random lines through planes, and compare their located points with crossings."""
    draw, half = np.random.default_rng(0), number // 2
    axes_pairs = [("d", "r") if index % 2 else ("r", "d") for index in range(half)]
    random_lines = [Line(*axes, float(draw.uniform(*INNER[axes[1]]))) for axes in axes_pairs]
    starts = [symmetric(**{line.fixed: line.value, line.along: START[line.along]}) for line in random_lines]
    compare_crossings("rigid, d x r", random_lines, starts, PLANE)
    d, kappa = draw.uniform(0.15, 0.25, number - half), np.exp(draw.uniform(np.log(20), np.log(100), number - half))
    omega0 = kappa * np.sqrt(d * DEVICE.A / DEVICE.s)
    random_lines = [
        (Line("d", "kappa", kappa[i]), Line("kappa", "d", d[i]), Line("omega", "omega0", omega0[i]))[i % 3]
        for i in range(number - half)
    ]
    starts = [even(*position) for position in zip(d, kappa, strict=True)]
    compare_crossings("soft, d x kappa, a third slanted", random_lines, starts, SOFT)


def compare_crossings(
    name: str, line_list: list[Line], starts: list[vijax.Orbit], plane: dict[str, tuple[float, float]]
) -> None:
    """Compare crossings with points that branches locate, from orbits on each line and from orbits near crossings.

    A located point on no curve begins a new curve. The curve then crosses its own line trivially, but must cross all
    other lines exactly where branches locate points.
    """
    located_points = [
        events_along(start, line, line.within(plane)) for line, start in zip(line_list, starts, strict=True)
    ]
    curves = curves_through([point for points in located_points for point in points], plane)
    indirect, unmatched, all_distances, faded_gaps = 0, 0, [], list[float]()
    for line, located in zip(line_list, located_points, strict=True):
        low, high = line.within(plane)
        crossings = [crossing for curve in curves for crossing in crossings_of(curve, line, plane)]
        for crossing in crossings:
            if nearest(crossing, located) > SAME * (high - low):
                # The branches from the start do not reach this point; an orbit that bifurcates near it must.
                indirect += 1
                located = located + events_near(crossing, line, (low, high))
            unmatched += nearest(crossing, located) > SAME * (high - low)
        faded_gaps += [float(np.asarray(point.orbit.pair.d)[0]) for point in located if fades(point)]
        located = [point for point in located if not fades(point)]
        distances = [min((nearest(crossing, [point]) for crossing in crossings), default=np.inf) for point in located]
        all_distances += [crossing / (high - low) for crossing in distances]
    distance_array = np.array(all_distances)
    print_figure(
        f"{name}: points that branches locate along {len(line_list)} lines; curves",
        f"{len(distance_array)}; {len(curves)}",
    )
    print_figure(
        f"{name}: points at which no curve crosses; crossings without a point",
        f"{(distance_array > SAME).sum()}; {unmatched}",
    )
    print_figure(f"{name}: crossings that only a branch from an orbit beside them locates", f"{indirect}")
    print_figure(
        f"{name}: largest distance between the two, in parts of a line",
        f"{distance_array[distance_array <= SAME].max():.1e}",
    )
    if faded_gaps:
        # A fading orbit is the motion that the excitation alone carries from wall to wall, without impact speed.
        print_figure(f"{name}: orbits that fade there, which begin no curve", f"{len(faded_gaps)}")
        print_figure(
            f"{name}: largest error of their d, 2/pi^2", f"{np.abs(np.array(faded_gaps) - 2 / np.pi**2).max():.1e}"
        )


def fades(point: Point) -> bool:
    """Return True if the speed of an orbit's only impact goes to zero, so that no orbit continues."""
    return point.kind == "grazing impact" and int(point.orbit.count[0]) == 1


def curves_through(points: list[Point], plane: dict[str, tuple[float, float]]) -> list[BifurcationCurve]:
    """Continue the points of several lines, each curve once."""
    x, y = ([float(getattr(point.orbit.pair, name)[0]) for point in points] for name in plane)
    places = zip(x, y, strict=True)
    candidates = [curve_start(point, place, PLAIN.asymmetry) for point, place in zip(points, places, strict=True)]
    starts = [start for start in candidates if not isinstance(start, str)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return [x for curve_list in curves_from(starts, plane, DEVICE, 4000, PLAIN) for x in curve_list]


def nearest(crossing: Crossing, points: list[Point]) -> float:
    """Return the distance of the nearest point of the same kind."""
    kind = crossing.kind
    return min((abs(p.value - crossing.position) for p in points if p.kind.split()[0] == kind), default=np.inf)


def events_near(crossing: Crossing, line: Line, limits: tuple[float, float]) -> list[Point]:
    """Return the events of branches that begin at orbits near a bifurcating one, and therefore cross it."""
    points = []
    settings: Any = {"device": line.device, "settings": PLAIN}
    for branch in vijax.follow_orbits(crossing.orbit, line.along, limits, points=12, **settings):
        for orbit in (branch.orbit[:1], branch.orbit[-1:]):
            if len(orbit) and np.asarray(orbit.status)[0] == 0:
                points += [
                    p
                    for branch_through in vijax.follow_orbits(orbit, line.along, limits, **settings)
                    for p in branch_through.points
                ]
    return [point for point in points if point.kind in _FOLLOWED]


def crossings_of(curve: BifurcationCurve, line: Line, plane: dict[str, tuple[float, float]]) -> list[Crossing]:
    """Return the crossings of a curve and a line: from a neighbouring point the curve is continued to the line."""
    distance, crossings = line.distance_from(curve.orbit.pair), []
    # The orbit at the start of a curve may lie on the line itself.
    above = distance >= 0
    for index in np.flatnonzero(above[:-1] != above[1:]):
        inside = index if above[index] else index + 1
        kind = "grazing flight" if curve.kind == "grazing" else curve.kind
        orbit = curve.orbit[inside : inside + 1]
        guess = line.position(orbit.pair)
        high = plane[line.fixed][1] if line.fixed in plane else 2 * line.value
        # A curve may end a rounding error outside of the bounds of its plane.
        low, top = plane.get(line.along, (guess / 2, guess * 2))
        bounds = {line.fixed: (line.value, high), line.along: (low - SAME**2, top + SAME**2)}
        line_device = (
            dataclasses.replace(line.device, omega0=line.value + float(distance[inside]))
            if line.fixed == "omega0"
            else line.device
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            pieces = vijax.follow_curves(
                [Point(kind, guess, orbit)], line.along, bounds, device=line_device, max_points=40
            )
        ends = [
            piece.orbit[end_index : end_index + 1] if end_index == 0 else piece.orbit[-1:]
            for piece in pieces
            for end_index in (0, -1)
        ] + [orbit]
        ends = [end for end in ends if abs(line.distance_from(end.pair)[0]) < SAME**2 * max(1.0, line.value)]
        if ends:
            orbit = min(ends, key=lambda end: abs(line.position(end.pair) - guess))
            crossings.append(Crossing(curve.kind, line.position(orbit.pair), orbit))
    return crossings


def speed() -> None:
    """Time the curves of a few orbits of the default plane, without compilation."""
    pair = vijax.impact_pair(0.2, 40.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (3.0, 400.0))
    points = [point for branch in branches for point in branch.points if point.kind in _FOLLOWED]
    for _ in range(2):
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            curves = vijax.follow_curves(points, "kappa", SOFT, settings=FINE)
        seconds = time.perf_counter() - start
    count = sum(len(curve.values) for curve in curves)
    print_figure(
        "curve points, seconds once compiled, seconds for 10,000",
        f"{count}, {seconds:.1f}, {1e4 * seconds / count:.1f}",
    )


def limits() -> None:
    """Compare impacts on curves of limits, computed by the impact map, with the limits."""
    device = vijax.Harvester()
    pair = vijax.impact_pair(0.2, 60.0, 0.5)
    branches = vijax.follow_families(vijax.find_orbits(pair, "1:1", guesses=512), "kappa", (20.0, 400.0))
    points = vijax.limit_points(branches, device=device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        plane = {"d": (0.05, 0.3), "kappa": (20.0, 400.0)}
        curves = vijax.follow_curves(points, "kappa", plane, device=device)
    for kind in LIMITS:
        curves_of_kind = [curve for curve in curves if curve.kind == kind]
        if curves_of_kind:
            verified = [
                curve.orbit[np.flatnonzero(np.asarray(curve.orbit.status) == vijax.Status.OK)]
                for curve in curves_of_kind
            ]
            errors = [np.abs(load_ratios(orbit, device)[kind].max(axis=1) - 1).max() for orbit in verified]
            count = sum(len(curve.values) for curve in curves_of_kind)
            print_figure(
                f"{kind}: curves, points, verified ones", f"{len(curves_of_kind)}, {count}, {sum(map(len, verified))}"
            )
            print_figure(f"{kind}: largest error of these, relative to it", f"{max(errors):.1e}")


def explained(charts: Path | None = None) -> None:
    """Count the borders between labels of periodic cells within one cell of a curve, on two planes."""
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
        start = time.perf_counter()
        result = vijax.bifurcation_curves(dataset)
        seconds = time.perf_counter() - start
        share = result.explained / max(result.borders, 1)
        print_figure(f"{name}: borders, share within a cell of a curve", f"{result.borders}, {share:.1%}")
        points = sum(len(curve.values) for curve in result.curves)
        print_figure(f"{name}: curves, points, seconds once compiled", f"{len(result.curves)}, {points}, {seconds:.0f}")
        print_figure(
            f"{name}: largest piece that no curve explains, in borders; ended",
            f"{len(result.largest_unexplained)}; {result.ended}",
        )
        print_figure(
            f"{name}: borders of basins among the others",
            f"{result.separates_basins.sum()} of {len(result.unexplained)}",
        )
        if len(result.largest_unexplained):
            print_figure(f"{name}: what that piece parts", describe_piece(result.largest_unexplained, dataset))
        if charts is not None:
            figure = vijax.plots.curves(vijax.curve_dataset(result), dataset)
            vijax.plots.save(figure, charts / f"curves_{'_'.join(result.along)}.png")


def describe_piece(positions: np.ndarray, dataset: Any) -> str:
    """Return the labels that most borders separate, and the position of the first border."""
    plane = labelled_plane(dataset)
    index = np.stack(
        [np.interp(x, axis, np.arange(len(axis))) for x, axis in zip(positions.T, plane.axes, strict=True)]
    )
    low, high = (np.round(index + shift).astype(int) for shift in (-0.25, 0.25))
    sides = zip(plane.labels[tuple(low)], plane.labels[tuple(high)], strict=True)
    (names, _), *_ = Counter(" | ".join(sorted(map(str, pair))) for pair in sides).most_common(1)
    text = ", ".join(f"{name} {x:.4g}" for name, x in zip(plane.along, positions[0], strict=True))
    return f"{names} near {text}"


PARTS: dict[str, Callable[..., None]] = {
    "known": closed_forms,
    "cubic": cubic,
    "resonant": resonant,
    "lines": lines,
    "speed": speed,
    "limits": limits,
    "explained": explained,
}


def main() -> int:
    """Print the parts that the command line selects."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--charts", type=Path, metavar="FOLDER", help="where to draw the planes that are explained")
    parser.add_argument("--lines", type=int, default=LINES, help="how many lines are drawn")
    options = parser.parse_args()
    for name, part in PARTS.items():
        if options.only in (None, name):
            arguments: dict[Callable[..., None], Any] = {explained: options.charts, lines: options.lines}
            part(*([arguments[part]] if part in arguments else []))
    return 0


if __name__ == "__main__":
    sys.exit(main())
