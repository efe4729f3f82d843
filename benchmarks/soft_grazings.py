"""Do branches go on through grazes at soft walls, and is what they find beyond what is there?

    python benchmarks/soft_grazings.py              # 56 grazings
    python benchmarks/soft_grazings.py --grazings 5

Attracting orbits of random soft pairs are followed along a random parameter, through the grazes that come. Beyond each
graze the same orbit is looked for by itself, half way to the next bifurcation, from random guesses with its impacts,
and followed without going through any graze: to the graze from the other side, and to the next bifurcation. One line a
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
from benchmarks.orbits import say
from vijax.model.records import Status
from vijax.orbits import orbit_properties, symmetry
from vijax.orbits.continuation import Branch
from vijax.orbits.events import Point
from vijax.orbits.periodic import Orbit

BOUNDS = {"d": (0.02, 0.3), "kappa": (3.0, 200.0), "r": (0.3, 0.9)}
MOST_IMPACTS = 6  # of the orbit beyond a graze in full: random guesses find longer ones rarely
GRAZINGS_EACH = 2  # that one orbit gives at most, each way
BESIDE = 5  # orbits on either side whose residuals are told
SAME = 1e-6  # an orbit found twice
NEAR = 1e-3  # in which part of its range the parameter of another bifurcation of the kind would lie
BIFURCATIONS = ("fold", "flip", "pitchfork")
PLAIN = vijax.ContinuationSettings(max_grazings=0)


class Beyond(NamedTuple):
    """A branch beyond a graze: the graze, the bifurcation after it, and an orbit between."""

    graze: Point
    next: Point
    orbit: Orbit


@dataclass
class Figures:
    """What was measured at every graze.

    Attributes:
        residual: Largest of the orbits beside it, on both sides.
        virtual: How many of these the impact map does not verify.
        graze, next: How far off the graze and the next bifurcation are on the branch of the orbit found beyond.
        pairs: The same of pitchforks that mirror pairs come to: two branches cross there, and Newton is singular.
        kinds: What was passed.
        unfound: Grazes beyond which random guesses did not find the orbit.
        unmet: Grazes or bifurcations that its branch did not meet.
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
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--grazings", type=int, default=56)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    draw, found = np.random.default_rng(given.seed), Figures()
    while len(found.graze) < given.grazings:
        along = str(draw.choice(["d", "kappa"]))
        for branch in branches(draw, along):
            measure(branch, along, found)
    names, counts = np.unique(found.kinds, return_counts=True)
    passed = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    say("grazings with an orbit found beyond by itself", f"{len(found.graze)}: {passed}")
    say("grazings beyond which random guesses found none", f"{found.unfound}")
    say(f"largest residual of {BESIDE} orbits on either side", f"{max(found.residual):.1e}")
    say("of these not verified by the impact map", f"{found.virtual}")
    say("grazes and bifurcations that the branch of that orbit does not meet", f"{found.unmet}")
    say("the graze, met from the other side: largest difference", f"{max(found.graze):.1e}")
    for what, off in (("the next bifurcation", found.next), ("pitchfork of a mirror pair", found.pairs)):
        say(f"{what}, found from there: number, largest difference", f"{len(off)}, {max(off, default=0.0):.1e}")
    return 0


def branches(draw: np.random.Generator, along: str) -> list[Branch]:
    """Follow an attracting orbit of a random pair both ways, through a few grazes."""
    d, r = (float(draw.uniform(*BOUNDS[name])) for name in ("d", "r"))
    kappa = float(np.exp(draw.uniform(*np.log(BOUNDS["kappa"]))))
    pair = vijax.impact_pair(d, kappa, r, float(draw.choice([0.0, 0.05])))
    period = int(draw.integers(1, 3))
    orbit = vijax.orbits_from_states(pair, 0.0, float(draw.uniform(-1, 1)), period=period, settle=200)
    if int(orbit.status[0]) != Status.OK or int(orbit.count[0]) > MOST_IMPACTS:
        return []
    if int(orbit_properties.counts(orbit).period[0]) < period:
        return []  # It is run through twice, and grazes twice at once.
    if bool(symmetry.symmetric(orbit)[0]):
        orbit = symmetry.halved(orbit)
    settings = vijax.ContinuationSettings(max_grazings=GRAZINGS_EACH)
    followed = (
        vijax.follow_orbits(orbit, along, BOUNDS[along], direction=way, points=1500, settings=settings)
        for way in ("down", "up")
    )
    return [branch for way in followed for branch in way]


def measure(branch: Branch, along: str, found: Figures) -> None:
    """Measure every graze of a branch after which it bifurcates before it grazes again."""
    unit = BOUNDS[along][1] - BOUNDS[along][0]
    for beyond in places(branch):
        other = again(beyond.orbit)
        if other is None:
            found.unfound += 1
            continue
        met = [
            point
            for one in vijax.follow_orbits(other, along, BOUNDS[along], points=1500, settings=PLAIN)
            for point in one.points
        ]
        off = [distance(point, met) for point in (beyond.graze, beyond.next)]
        if max(off) > NEAR * unit:
            found.unmet += 1
            continue
        beside = np.flatnonzero(np.diff(np.asarray(branch.orbit.count)))
        at = beside[np.abs(branch.values[beside] - beyond.graze.value).argmin()]
        rows = slice(max(at - BESIDE + 1, 0), at + BESIDE + 1)
        found.residual.append(float(np.asarray(branch.orbit.residual)[rows].max()))
        found.virtual += int((np.asarray(branch.orbit.status)[rows] != Status.OK).sum())
        found.kinds.append(f"{beyond.graze.kind} ({'more' if beyond.graze.gained > 0 else 'fewer'})")
        found.graze.append(off[0])
        pair = beyond.next.kind == "pitchfork" and not bool(branch.orbit.sequence.mirrored[0])
        (found.pairs if pair else found.next).append(off[1])


def places(branch: Branch) -> list[Beyond]:
    """List the grazes of a branch that are followed by a bifurcation, with an orbit half way there."""
    found = []
    counts = np.asarray(branch.orbit.count)
    changes = np.flatnonzero(np.diff(counts))
    passed = [index for index, point in enumerate(branch.points) if point.gained]
    for change, index in zip(changes, passed, strict=False):
        if index + 1 == len(branch.points) or branch.points[index + 1].kind not in BIFURCATIONS:
            continue
        graze, following = branch.points[index], branch.points[index + 1]
        place = nearest(branch, following)
        full = counts[change + 1] * (2 if bool(branch.orbit.sequence.mirrored[0]) else 1)
        if place > change + 2 and full <= MOST_IMPACTS:
            middle = (change + 1 + place) // 2
            found.append(Beyond(graze, following, branch.orbit[middle : middle + 1]))
    return found


def nearest(branch: Branch, point: Point) -> int:
    """Find the orbit of a branch that is nearest to a point."""
    marks = np.column_stack([orbit_properties.marks(branch.orbit), branch.values])
    return int(np.abs(marks - np.append(orbit_properties.marks(point.orbit)[0], point.value)).sum(axis=1).argmin())


def again(orbit: Orbit) -> Orbit | None:
    """Find an orbit by itself: from random guesses with its impacts in their order."""
    full = symmetry.unfolded(orbit)
    side = np.asarray(full.sequence.side)[0]
    walls = "".join("R" if wall > 0 else "L" for wall in side if wall)
    period = round(float(full.sequence.span[0]) / 2)
    own = orbit.pair
    pair = vijax.impact_pair(*(float(np.asarray(x)[0]) for x in (own.d, own.kappa, own.r, own.gamma)))
    known = orbit_properties.marks(full)[0]
    for guesses in (1024, 8192):
        others = vijax.find_orbits(pair, walls, period, guesses=guesses)
        for index in range(len(others)):
            if np.abs(orbit_properties.marks(others[index : index + 1])[0] - known).max() < SAME:
                other = others[index : index + 1]
                return symmetry.halved(other) if bool(orbit.sequence.mirrored[0]) else other
    return None


def distance(point: Point, met: list[Point]) -> float:
    """Find how far the nearest of the same kind is."""
    return min((abs(point.value - other.value) for other in met if other.kind == point.kind), default=np.inf)


if __name__ == "__main__":
    sys.exit(main())
