"""Do branches continue past grazings at soft walls, and are the orbits beyond correct?

    python benchmarks/soft_grazings.py              # 56 grazings
    python benchmarks/soft_grazings.py --grazings 5
Attracting orbits of random soft pairs are continued along a random parameter, past all grazings. Beyond each grazing,
halfway to the next bifurcation, the same orbit is searched independently from random guesses with its impacts. It is
continued without passing a grazing: to the grazing from the other side, and to the next bifurcation. One line a
figure. Typical printout:

    grazings with an orbit found beyond by itself                            56: 4 grazing contact (fewer), ...
    grazings beyond which random guesses found none                          0
    largest residual of 5 orbits on either side                              1.6e-15
    of these not verified by the impact map                                  0
    grazes and bifurcations that the branch of that orbit does not meet      0
    the graze, met from the other side: largest difference                   3.4e-11
    the next bifurcation, found from there: number, largest difference       50, 3.6e-13
    pitchfork of a mirror pair, found from there: number, largest difference 6, 1.4e-13
"""

import argparse
import sys
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

import vijax
from benchmarks.orbits import print_figure
from vijax.continuation.branch_continuation import Branch
from vijax.continuation.branch_events import Point
from vijax.model.records import Status
from vijax.orbits import orbit_properties, symmetry
from vijax.orbits.periodic import Orbit

BOUNDS = {"d": (0.02, 0.3), "kappa": (3.0, 200.0), "r": (0.3, 0.9)}
MOST_IMPACTS = 6  # of the full orbit beyond a grazing; random guesses rarely converge to longer ones
GRAZINGS = 2  # most grazings of one orbit in each direction
NEIGHBOURS = 5  # orbits on either side with printed residuals
SAME = 1e-6  # difference up to which two results are one orbit
NEAR = 1e-3  # fraction of the parameter's range; a farther bifurcation is another one
BIFURCATIONS = ("fold", "flip", "pitchfork")
PLAIN = vijax.ContinuationSettings(max_grazings=0)


class PassedGrazing(NamedTuple):
    """A branch past a grazing: the grazing, the next bifurcation, and an orbit between them."""

    graze: Point
    next: Point
    orbit: Orbit


@dataclass
class Figures:
    """Results at all grazings.

    Attributes:
        residual: Largest residual of the neighbouring orbits on both sides.
        virtual: Number of these that the impact map does not verify.
        graze, next: Differences of the grazing and of the next bifurcation on the independently computed branch.
        pairs: The same for pitchforks of mirror pairs, where two branches cross and Newton's matrix is singular.
        kinds: Kinds of the passed grazings.
        unfound: Number of grazings without a result from random guesses.
        unmet: Number of grazings or bifurcations that the independent branch does not reach.
    """

    residual: list[float] = field(default_factory=list)
    virtual: int = 0
    graze: list[float] = field(default_factory=list)
    next: list[float] = field(default_factory=list)
    pairs: list[float] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    unfound: int = 0
    unmet: int = 0


def main() -> int:
    """Print the figures that the command line selects."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--grazings", type=int, default=56)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw, figures = np.random.default_rng(options.seed), Figures()
    while len(figures.graze) < options.grazings:
        along = str(draw.choice(["d", "kappa"]))
        for branch in branches(draw, along):
            measure(branch, along, figures)
    names, counts = np.unique(figures.kinds, return_counts=True)
    passed = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    print_figure("grazings with an orbit found beyond by itself", f"{len(figures.graze)}: {passed}")
    print_figure("grazings beyond which random guesses found none", f"{figures.unfound}")
    print_figure(f"largest residual of {NEIGHBOURS} orbits on either side", f"{max(figures.residual):.1e}")
    print_figure("of these not verified by the impact map", f"{figures.virtual}")
    print_figure("grazes and bifurcations that the branch of that orbit does not meet", f"{figures.unmet}")
    print_figure("the graze, met from the other side: largest difference", f"{max(figures.graze):.1e}")
    for title, differences in (("the next bifurcation", figures.next), ("pitchfork of a mirror pair", figures.pairs)):
        print_figure(
            f"{title}, found from there: number, largest difference",
            f"{len(differences)}, {max(differences, default=0.0):.1e}",
        )
    return 0


def branches(draw: np.random.Generator, along: str) -> list[Branch]:
    """Continue an attracting orbit of a random pair in both directions, past a few grazings."""
    d, r = (float(draw.uniform(*BOUNDS[name])) for name in ("d", "r"))
    kappa = float(np.exp(draw.uniform(*np.log(BOUNDS["kappa"]))))
    pair = vijax.impact_pair(d, kappa, r, float(draw.choice([0.0, 0.05])))
    period = int(draw.integers(1, 3))
    orbit = vijax.orbits_from_states(pair, 0.0, float(draw.uniform(-1, 1)), period=period, settle=200)
    if int(orbit.status[0]) != Status.OK or int(orbit.count[0]) > MOST_IMPACTS:
        return []
    if int(orbit_properties.counts(orbit).period[0]) < period:
        return []  # a doubled orbit, with two grazings at once
    if bool(symmetry.is_symmetric(orbit)[0]):
        orbit = symmetry.close_half_way(orbit)
    settings = vijax.ContinuationSettings(max_grazings=GRAZINGS)
    both_directions = (
        vijax.follow_orbits(orbit, along, BOUNDS[along], direction=direction, points=1500, settings=settings)
        for direction in ("down", "up")
    )
    return [branch for direction in both_directions for branch in direction]


def measure(branch: Branch, along: str, figures: Figures) -> None:
    """Measure every grazing of a branch that a bifurcation follows before the next grazing."""
    unit = BOUNDS[along][1] - BOUNDS[along][0]
    for passed in passed_grazings(branch):
        other = search_again(passed.orbit)
        if other is None:
            figures.unfound += 1
            continue
        points = [
            point
            for branch_of_other in vijax.follow_orbits(other, along, BOUNDS[along], points=1500, settings=PLAIN)
            for point in branch_of_other.points
        ]
        differences = [distance(point, points) for point in (passed.graze, passed.next)]
        if max(differences) > NEAR * unit:
            figures.unmet += 1
            continue
        changes = np.flatnonzero(np.diff(np.asarray(branch.orbit.count)))
        change = changes[np.abs(branch.values[changes] - passed.graze.value).argmin()]
        rows = slice(max(change - NEIGHBOURS + 1, 0), change + NEIGHBOURS + 1)
        figures.residual.append(float(np.asarray(branch.orbit.residual)[rows].max()))
        figures.virtual += int((np.asarray(branch.orbit.status)[rows] != Status.OK).sum())
        figures.kinds.append(f"{passed.graze.kind} ({'more' if passed.graze.impact_change > 0 else 'fewer'})")
        figures.graze.append(differences[0])
        pair = passed.next.kind == "pitchfork" and not bool(branch.orbit.sequence.mirrored[0])
        (figures.pairs if pair else figures.next).append(differences[1])


def passed_grazings(branch: Branch) -> list[PassedGrazing]:
    """Return the grazings of a branch that precede a bifurcation, with an orbit halfway."""
    passed_list = []
    counts = np.asarray(branch.orbit.count)
    changes = np.flatnonzero(np.diff(counts))
    passed = [index for index, point in enumerate(branch.points) if point.impact_change]
    for change, index in zip(changes, passed, strict=False):
        if index + 1 == len(branch.points) or branch.points[index + 1].kind not in BIFURCATIONS:
            continue
        graze, following = branch.points[index], branch.points[index + 1]
        last = nearest(branch, following)
        full = counts[change + 1] * (2 if bool(branch.orbit.sequence.mirrored[0]) else 1)
        if last > change + 2 and full <= MOST_IMPACTS:
            middle = (change + 1 + last) // 2
            passed_list.append(PassedGrazing(graze, following, branch.orbit[middle : middle + 1]))
    return passed_list


def nearest(branch: Branch, point: Point) -> int:
    """Return the index of the branch's orbit nearest to a point."""
    features = np.column_stack([orbit_properties.orbit_signature(branch.orbit), branch.values])
    return int(
        np.abs(features - np.append(orbit_properties.orbit_signature(point.orbit)[0], point.value)).sum(axis=1).argmin()
    )


def search_again(orbit: Orbit) -> Orbit | None:
    """Search an orbit independently: from random guesses with its impacts in their order."""
    full = symmetry.unfold(orbit)
    side = np.asarray(full.sequence.side)[0]
    walls = "".join("R" if wall > 0 else "L" for wall in side if wall)
    period = round(float(full.sequence.span[0]) / 2)
    parameters = orbit.pair
    pair = vijax.impact_pair(
        *(float(np.asarray(x)[0]) for x in (parameters.d, parameters.kappa, parameters.r, parameters.gamma))
    )
    features = orbit_properties.orbit_signature(full)[0]
    for guesses in (1024, 8192):
        others = vijax.find_orbits(pair, walls, period, guesses=guesses)
        for index in range(len(others)):
            if np.abs(orbit_properties.orbit_signature(others[index : index + 1])[0] - features).max() < SAME:
                other = others[index : index + 1]
                return symmetry.close_half_way(other) if bool(orbit.sequence.mirrored[0]) else other
    return None


def distance(point: Point, points: list[Point]) -> float:
    """Return the distance of the nearest point of the same kind."""
    return min((abs(point.value - other.value) for other in points if other.kind == point.kind), default=np.inf)


if __name__ == "__main__":
    sys.exit(main())
