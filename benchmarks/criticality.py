"""On which side of a flip or a pitchfork do the orbits that begin there lie, do they attract, how fast do they part?

    python benchmarks/criticality.py          # draw 30 flips and 30 pitchforks
    python benchmarks/criticality.py --write  # and keep them in tests/data/criticality.json
    python benchmarks/criticality.py --kept   # look at those again that are kept

Newton finds orbits from random guesses at random pairs, soft and rigid, level and inclined. Orbits near a flip or a
pitchfork are moved onto the bifurcation along a random parameter. There the cubic coefficient of
`vijax.orbits.criticality` is compared with two results that share no code with it: the normal form of the map from
impact to impact, by finite differences in 50 digits, and trajectories of the exact engine from starts beside the orbit,
on either side of the bifurcation. If small distances from the orbit grow and large ones shrink, an attracting orbit
lies between them; if small ones shrink and large ones grow, a repelling orbit does. It prints one line a figure:

    flips, pitchforks; of them soft, rigid, inclined                         30, 30; 30, 30, 15
    draws at which balls did not decide, or with other bifurcations near     4
    balls: attracting orbits beyond, repelling ones before                   47, 13
    sign of the cubic coefficient that does not say so                       0
    cubic coefficient, largest error relative to 50 digits                   1e-09
    cubic coefficient from balls, m/x^2: largest error relative              0.1
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vijax
from benchmarks.orbits import say
from benchmarks.yardstick import DIGITS, mp_contact, mp_flight, newton
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.criticality import cubic_coefficient
from vijax.orbits.multipliers import monodromy
from vijax.orbits.shooting import Sequence

DATA = Path(__file__).parents[1] / "tests" / "data" / "criticality.json"
EACH = 30  # flips, and pitchforks
BOUNDS = {"d": (0.03, 3.0), "kappa": (3.0, 300.0), "r": (0.3, 0.97), "gamma": (-0.3, 0.3)}
MOST = {"r": 1.0}
WIDTH = 4  # impacts that a turn has at most; all are padded to so many
GUESSES = 4096
A_DRAW = 4  # bifurcations of a kind that are taken of one draw
NEAR = 0.2  # of a multiplier that is nearly -1
CLOSE = 1e-11  # of one that is -1
# The multiplier is -1 -+ so much where balls are flown.
EXCESS = (2e-3, 5e-4)
AMPLITUDES = np.geomspace(1e-5, 0.3, 60)  # of the speed of the first impact, in parts of it
PERIODS = 256  # forcing periods that a ball is flown
EARLY = 1e-3  # half forcing periods before its first impact at which a ball starts
FORGOTTEN = 1e-7  # part of the other multiplier's share that is left when a distance is first read


class Turn(NamedTuple):
    """Walls of a turn, and how it closes."""

    side: tuple[int, ...]
    span: float
    mirrored: bool


TURNS = (
    Turn((1,), 1.0, True),
    Turn((1, 1), 1.0, True),
    Turn((1,), 3.0, True),
    Turn((1, -1, 1), 3.0, True),
    Turn((1,), 2.0, False),
    Turn((1, -1), 2.0, False),
    Turn((1, 1), 2.0, False),
    Turn((1, -1, -1), 2.0, False),
    Turn((1, -1), 4.0, False),
)


class Case(NamedTuple):
    """A flip or a pitchfork.

    Attributes:
        kind: "flip" or "pitchfork".
        along: The parameter that passes it.
        d, kappa, r, gamma: Of the pair there; kappa is None of rigid walls.
        side: Walls of one turn.
        span, mirrored: How it closes; see `shooting.Sequence`.
        knots: Of one turn.
        coefficient: Of the normal form, in 50 digits.
        beyond: Whether the orbits that begin there lie where this one repels.
        attracts: Whether they attract.
    """

    kind: str
    along: str
    d: float
    kappa: float | None
    r: float
    gamma: float
    side: list[int]
    span: float
    mirrored: bool
    knots: list[list[float]]
    coefficient: float = float("nan")
    beyond: bool = True
    attracts: bool = True

    @property
    def walls(self) -> str:
        """Say which kind of walls they are."""
        return "rigid" if self.kappa is None else "soft"


def kept() -> list[Case]:
    """Read the kept cases."""
    return [Case(**row) for row in json.loads(DATA.read_text())]


# --- cases -----------------------------------------------------------------------------------------------------------


def drawn(walls: str, wanted: dict[str, int], draw: np.random.Generator) -> Iterator[Case]:
    """Draw pairs and guesses, and yield bifurcations of wanted kinds that are near the orbits which Newton finds.

    Of each draw a few of each kind are taken, those with the least cubic coefficient, as negative ones are rare.
    """
    while True:
        own = [_guessed(walls, TURNS[kind], draw) for kind in draw.integers(len(TURNS), size=GUESSES)]
        found = periodic.solve(*orbits(own))
        # Not those that Newton found at a lesser period.
        kept = np.asarray(found.sequence.span) == [one.span for one in own]
        large, _ = turning(found)
        near = np.flatnonzero(kept & (np.asarray(found.status) == Status.OK) & (np.abs(large + 1) < NEAR))
        knots = np.where(np.asarray(found.sequence.real)[..., None], found.knots, 0.0)
        about = np.asarray(_coefficients(found.pair, found.sequence, knots))
        for kind in wanted:
            rows = [row for row in near if own[row].kind == kind]
            for row in sorted(rows, key=lambda row: about[row])[:A_DRAW]:
                if not wanted[kind]:
                    break
                along = str(draw.choice(["d", "r"] if walls == "rigid" else ["d", "kappa", "r"]))
                there = onto(own[row]._replace(knots=knots[row, : len(own[row].side)].tolist(), along=along))
                if there is not None:
                    yield there


def _guessed(walls: str, turn: Turn, draw: np.random.Generator) -> Case:
    """Draw a pair, and guess an orbit with the impacts of a turn."""
    own = {name: float(np.exp(draw.uniform(*np.log(BOUNDS[name])))) for name in ("d", "kappa")}
    r, count = float(draw.uniform(*BOUNDS["r"])), len(turn.side)
    gamma = float(draw.uniform(*BOUNDS["gamma"])) if draw.integers(2) and not turn.mirrored else 0.0
    gaps = draw.dirichlet(np.ones(count)) * turn.span
    t = draw.uniform(0, 2) + np.cumsum(gaps) - gaps[0]
    free = np.sqrt(np.pi**2 + np.log(r) ** 2) / own["kappa"]
    stay = 0 * gaps if walls == "rigid" else np.minimum(free, 0.5 * gaps)
    knots = np.stack([t, draw.uniform(0, 1.5, count), stay], axis=1).tolist()
    kappa = None if walls == "rigid" else own["kappa"]
    kind = "pitchfork" if turn.mirrored else "flip"
    return Case(kind, "", own["d"], kappa, r, gamma, list(turn.side), turn.span, turn.mirrored, knots)


def turning(orbit: vijax.Orbit) -> tuple[np.ndarray, np.ndarray]:
    """Compute both multipliers of a turn, the larger modulus first; NaN where they are complex."""
    knots = np.where(np.asarray(orbit.sequence.real)[..., None], orbit.knots, 0.0)
    values = np.linalg.eigvals(np.nan_to_num(_around(orbit.pair, orbit.sequence, knots)))
    values = np.take_along_axis(values, np.argsort(-np.abs(values), axis=1), axis=1)
    return tuple(np.where(np.abs(values.imag).max(axis=1) > 0, np.nan, values.real.T))


_around = jax.jit(jax.vmap(monodromy))


def onto(case: Case) -> Case | None:
    """Bring an orbit near a bifurcation onto it, along its parameter; None where it is lost before that."""
    found = beside(case, 0.0)
    if found is None:
        return None
    numbers: dict[str, Any] = {
        name: None if getattr(found.pair, name) is None else float(np.asarray(getattr(found.pair, name))[0])
        for name in ("d", "kappa", "r", "gamma")
    }
    return case._replace(**numbers, knots=found.knots[: len(case.side)].tolist())


def orbits(cases: list[Case]) -> tuple[vijax.ImpactPair, Sequence, jax.Array]:
    """Give pairs, sequences and knots of cases of one kind of wall, padded to one width."""
    side, knots = np.zeros((len(cases), WIDTH), np.int32), np.zeros((len(cases), WIDTH, 3))
    for row, case in enumerate(cases):
        side[row, : len(case.side)], knots[row, : len(case.side)] = case.side, case.knots
    columns = {name: np.array([getattr(case, name) for case in cases]) for name in ("d", "r", "gamma")}
    kappa = None if cases[0].kappa is None else np.array([case.kappa for case in cases])
    span, mirrored = jnp.array([case.span for case in cases]), jnp.array([case.mirrored for case in cases])
    pair = vijax.impact_pair(columns["d"], kappa, columns["r"], columns["gamma"])
    return pair, Sequence(jnp.asarray(side), span, mirrored), jnp.asarray(knots)


def coefficients(cases: list[Case]) -> np.ndarray:
    """Compute the cubic coefficients of cases as vijax does."""
    found = np.zeros(len(cases))
    for walls in ("soft", "rigid"):
        rows = [row for row, case in enumerate(cases) if case.walls == walls]
        if rows:
            found[rows] = _coefficients(*orbits([cases[row] for row in rows]))
    return found


_coefficients = jax.jit(jax.vmap(cubic_coefficient))

# --- the normal form in 50 digits ------------------------------------------------------------------------------------


def turned(case: Case, t: mp.mpf, v: mp.mpf) -> list[tuple[mp.mpf, mp.mpf, mp.mpf]]:
    """Fly one turn from the first impact: onset, speed and contact time of each of its impacts, and of the next one.

    The next one is told a span earlier, and of an orbit closed half way as its mirror image.
    """
    d, r, gamma = mp.mpf(case.d), mp.mpf(case.r), mp.mpf(case.gamma)
    ends = [*case.side[1:], case.side[0] * (-1 if case.mirrored else 1)]
    onsets = [*(knot[0] for knot in case.knots[1:]), case.knots[0][0] + case.span]
    found = []
    for side, end, knot, onset in zip(case.side, ends, case.knots, onsets, strict=True):
        if case.kappa is None:
            stay, out = mp.mpf(0), r * v
        else:
            kappa = mp.mpf(case.kappa)

            def contact(s, side=side, t=t, v=v, kappa=kappa):
                return mp_contact(kappa, r, gamma, side, t, v, s)[:2]

            stay = newton(contact, mp.mpf(knot[2]))
            out = -contact(stay)[1]
        found.append((t, v, stay))
        leave, back = t + stay, -side * out

        def gap(s, side=side, end=end, leave=leave, back=back):
            rise, speed = mp_flight(gamma, leave, back, s)
            return end * (side * d / 2 + rise) - d / 2, end * speed

        flight = newton(gap, mp.mpf(onset - knot[0] - knot[2]))
        t, v = leave + flight, gap(flight)[1]
    return [*found, (t - mp.mpf(case.span), v, mp.mpf(0))]


def normal_form(case: Case) -> float:
    """Compute the coefficient b of x -> -x + b x^3 by central differences of the map from first impact to first impact.

    Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45): with A q = -q, p A = -p, p q = 1 it is
    p C(q, q, q) / 6 - p B(q, (A - 1)^-1 B(q, q)) / 2. Here x is measured so that all knots of a turn move by a vector
    of length x.
    """
    with mp.workdps(DIGITS):
        here, h = mp.matrix(case.knots[0][:2]), mp.mpf(10) ** -9

        def after(*moves: tuple[mp.mpf, mp.matrix]) -> mp.matrix:
            place = here
            for share, along in moves:
                place = place + share * along
            return mp.matrix(turned(case, place[0], place[1])[-1][:2])

        unit = [mp.matrix([1, 0]), mp.matrix([0, 1])]
        A = mp.matrix(2, 2)
        for column, along in enumerate(unit):
            A[:, column] = (after((h, along)) - after((-h, along))) / (2 * h)
        q, p = _null(A + mp.eye(2)), _null((A + mp.eye(2)).T)
        far, near = (turned(case, *(here + sign * h * q)) for sign in (1, -1))
        moved = [
            (a - b) / (2 * h)
            for one, other in zip(far[:-1], near[:-1], strict=True)
            for a, b in zip(one, other, strict=True)
        ]
        q = q / mp.norm(moved)
        p = p / (p.T * q)[0]
        second = (after((h, q)) - 2 * after() + after((-h, q))) / h**2
        third = (after((2 * h, q)) - 2 * after((h, q)) + 2 * after((-h, q)) - after((-2 * h, q))) / (2 * h**3)
        bent = mp.lu_solve(A - mp.eye(2), second)
        mixed = sum((i * j * after((i * h, q), (j * h, bent)) for i in (1, -1) for j in (1, -1)), mp.matrix([0, 0])) / (
            4 * h**2
        )
        return float((p.T * (third / 6 - mixed / 2))[0])


def _null(matrix: mp.matrix) -> mp.matrix:
    """Give a null vector of a singular matrix of two rows."""
    row = 0 if mp.norm(matrix[0, :]) > mp.norm(matrix[1, :]) else 1
    return mp.matrix([matrix[row, 1], -matrix[row, 0]])


# --- balls -----------------------------------------------------------------------------------------------------------


class Flown(NamedTuple):
    """What balls beside an orbit did: where their distance neither grows nor shrinks, and which way below that.

    Attributes:
        distance: Of the speed of the first impact from that on the orbit; NaN where there is no such distance.
        grows: Whether distances below grow.
    """

    distance: float
    grows: bool


class Place(NamedTuple):
    """An orbit beside a bifurcation: its pair and knots, and the size of the other multiplier of one turn."""

    pair: vijax.ImpactPair
    knots: np.ndarray
    small: float


def beside(case: Case, excess: float) -> Place | None:
    """Find the orbit where the multiplier of one turn is -1 - excess; None where it is lost before that."""
    pair, sequence, knots = orbits([case])
    value = float(np.asarray(getattr(pair, case.along))[0])

    def at(x: float) -> tuple[Place, float]:
        moved: dict[str, Any] = {case.along: jnp.array([x])}
        found = periodic.solve(dataclasses.replace(pair, **moved), sequence, knots)
        (large,), (small,) = turning(found)
        real = int(found.status[0]) == Status.OK and float(found.sequence.span[0]) == case.span
        return Place(found.pair, np.asarray(found.knots)[0], abs(float(small))), float(large) if real else np.nan

    step = 1e-6 * value
    slope = (at(value + step)[1] - at(value - step)[1]) / (2 * step)
    x, (place, large) = value, at(value)
    for _ in range(8):
        if abs(large + 1 + excess) < max(0.01 * abs(excess), CLOSE):
            return place
        change = -(large + 1 + excess) / slope
        if not abs(change) < 0.1 * value or not 0 < x + change < MOST.get(case.along, np.inf):
            return None
        before, x = large, x + change
        place, large = at(x)
        slope = (large - before) / change
    return None


def flown(case: Case) -> dict[float, Flown] | None:
    """Fly balls from beside the orbit, where it repels (excess > 0) and where it attracts; None where it is lost."""
    excesses = [sign * size for sign in (1, -1) for size in EXCESS]
    places = [place for excess in excesses if (place := beside(case, excess)) is not None]
    if len(places) < len(excesses):
        return None
    size = len(AMPLITUDES)
    pair = jax.tree.map(lambda *leaves: np.repeat(np.concatenate(leaves), size), *(pair for pair, _, _ in places))
    t, speed = (np.repeat([knots[0, i] for _, knots, _ in places], size) for i in (0, 1))
    speed = speed * (1 + np.tile(AMPLITUDES, len(places)))
    # A little before the first impact, so that it is the first of the record at soft walls, too.
    phase, side = np.mod(t, 2.0), case.side[0]
    rise, v = np.array([mp_flight(*row, -EARLY) for row in zip(pair.gamma, phase, side * speed, strict=True)], float).T
    u = 0.5 * side * np.asarray(pair.d) + rise
    start = {"u0": u, "v0": v, "t0": np.mod(phase - EARLY, 2.0)}
    path = vijax.trajectory(pair, **start, periods=PERIODS, max_impacts=4 * PERIODS)
    hits = jax.tree.map(np.asarray, path.impacts)
    small = max(small for _, _, small in places)
    found = {}
    for number, excess in enumerate(excesses):
        rows = slice(number * size, (number + 1) * size)
        found[excess] = _read(*_growth(case, hits.side[rows], hits.v_in[rows], small))
    return found


def _growth(case: Case, side: np.ndarray, v_in: np.ndarray, small: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute distances, and by how much the logarithm of each grows a turn; NaN of balls that met other walls."""
    count, turns = len(case.side), int(2 * PERIODS / case.span) - 2
    walls = np.array(case.side * turns)
    if case.mirrored:
        walls = walls * np.repeat((-1) ** np.arange(turns), count)
    kept = (side[:, : walls.size] == walls).all(axis=1)
    speed = np.abs(v_in[:, : walls.size : count])
    apart = np.log(0.5 * np.abs(np.diff(speed, axis=1)) + np.finfo(float).tiny)
    first = int(np.ceil(np.log(FORGOTTEN) / np.log(max(small, 1e-3)))) + 2
    if first > turns // 2:
        kept = kept & False
    growth = (apart[:, -1] - apart[:, first]) / (apart.shape[1] - 1 - first)
    return np.where(kept, growth, np.nan), np.exp(apart[:, first])


def _read(growth: np.ndarray, distance: np.ndarray) -> Flown:
    """Find the first distance at which growth changes its sign; no farther than balls kept to their walls."""
    lost = np.flatnonzero(np.isnan(growth))
    known = growth[: lost[0]] if lost.size else growth
    grows = bool(known.size and known[0] > 0)
    change = np.flatnonzero(np.sign(known[:-1]) != np.sign(known[1:]))
    if not change.size:
        return Flown(np.nan, grows)
    low = change[0]
    share = known[low] / (known[low] - known[low + 1])
    return Flown(float(distance[low] + share * (distance[low + 1] - distance[low])), grows)


class Verdict(NamedTuple):
    """What balls say: on which side there are other orbits, whether they attract, and the coefficient from these."""

    beyond: bool
    attracts: bool
    coefficient: float


def verdict(case: Case) -> Verdict | None:
    """Judge by balls; None where they disagree with each other, or their distances do not go as a root."""
    found = flown(case)
    if found is None or any(one.grows != (excess > 0) for excess, one in found.items()):
        return None
    wide, near = EXCESS
    for sign in (1, -1):
        there, here, other = found[sign * wide], found[sign * near], found[-sign * near]
        apart = np.isfinite(there.distance) and np.isfinite(here.distance)
        alone = not other.distance < 3 * here.distance
        if apart and alone and 1.5 < there.distance / here.distance < 2.7:
            return Verdict(sign > 0, there.grows, sign * near / here.distance**2 * _stretch(case) ** -2)
    return None


def _stretch(case: Case) -> float:
    """Say by how much all knots of a turn move as the speed of the first impact does, along the bifurcation."""
    with mp.workdps(30):
        here, h = mp.matrix(case.knots[0][:2]), mp.mpf(10) ** -9
        columns = []
        for along in (mp.matrix([1, 0]), mp.matrix([0, 1])):
            far, near = (turned(case, *(here + sign * h * along)) for sign in (1, -1))
            columns.append(
                [
                    (a - b) / (2 * h)
                    for one, other in zip(far, near, strict=True)
                    for a, b in zip(one, other, strict=True)
                ]
            )
        A = mp.matrix([[columns[j][len(columns[j]) - 3 + i] for j in (0, 1)] for i in (0, 1)])
        q = _null(A + mp.eye(2))
        q = q / q[1]
        moved = [q[0] * a + q[1] * b for a, b in zip(columns[0][:-3], columns[1][:-3], strict=True)]
        return float(mp.norm(moved))


# --- figures ---------------------------------------------------------------------------------------------------------


def collected(each: int, draw: np.random.Generator) -> tuple[list[Case], int]:
    """Draw so many flips and so many pitchforks at which balls decide, half of them of soft walls, and count others."""
    kept, undecided = list[Case](), 0
    for walls in ("soft", "rigid"):
        wanted = dict.fromkeys(("flip", "pitchfork"), each // 2)
        for case in drawn(walls, wanted, draw):
            told = verdict(case)
            if told is None:
                undecided += 1
                continue
            wanted[case.kind] -= 1
            kept.append(case._replace(coefficient=normal_form(case), beyond=told.beyond, attracts=told.attracts))
            print(kept[-1], told, file=sys.stderr, flush=True)
            if not any(wanted.values()):
                break
    return kept, undecided


def figures(cases: list[Case], told: list[Verdict]) -> None:
    """Print what was found."""
    kinds = [case.kind for case in cases]
    walls = [case.walls for case in cases]
    inclined = sum(case.gamma != 0 for case in cases)
    say(
        "flips, pitchforks; of them soft, rigid, inclined",
        f"{kinds.count('flip')}, {kinds.count('pitchfork')}; {walls.count('soft')}, {walls.count('rigid')}, {inclined}",
    )
    own, known = coefficients(cases), np.array([case.coefficient for case in cases])
    outcomes = [(one.beyond, one.attracts) for one in told]
    say(
        "balls: attracting orbits beyond, repelling ones before, others",
        f"{outcomes.count((True, True))}, {outcomes.count((False, False))}, "
        f"{len(outcomes) - outcomes.count((True, True)) - outcomes.count((False, False))}",
    )
    wrong = sum((b > 0) != one.attracts or (b > 0) != one.beyond for b, one in zip(own, told, strict=True))
    say("sign of the cubic coefficient that does not say so", f"{wrong}")
    say("cubic coefficient, from, to", f"{own.min():.4g}, {own.max():.4g}; least {np.abs(own).min():.2g}")
    say("cubic coefficient, largest error relative to 50 digits", f"{np.abs(own / known - 1).max():.1e}")
    off = np.array([one.coefficient for one in told]) / known - 1
    say(
        "cubic coefficient from balls: median and largest error, relative",
        f"{np.median(np.abs(off)):.1e}, {np.abs(off).max():.1e}",
    )


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="keep what was drawn")
    parser.add_argument("--kept", action="store_true", help="take the kept cases")
    parser.add_argument("--each", type=int, default=EACH, help="flips, and pitchforks, to draw")
    given = parser.parse_args()
    if given.kept:
        cases = kept()
    else:
        cases, undecided = collected(given.each, np.random.default_rng(0))
        say("draws at which balls did not decide", f"{undecided}")
    told = [verdict(case) for case in cases]
    figures(cases, [one for one in told if one is not None])
    if given.write:
        DATA.write_text("[\n" + ",\n".join(json.dumps(case._asdict()) for case in cases) + "\n]\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
