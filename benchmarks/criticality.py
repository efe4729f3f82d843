"""Is a flip or pitchfork super- or subcritical, and how fast does the amplitude of the new orbits grow?

        python benchmarks/criticality.py          # draw 30 flips and 30 pitchforks
        python benchmarks/criticality.py --write  # and store them in tests/data/criticality.json
        python benchmarks/criticality.py --stored # verify the stored cases again

Newton finds orbits from random guesses at random pairs, soft and rigid, level and inclined. Orbits near a flip or a
pitchfork are moved onto the bifurcation along a random parameter. There the cubic coefficient of
`vijax.continuation.criticality` is compared with two results that share no code with it: the normal form of the map
from impact to impact, by finite differences in 50 digits, and trajectories of the exact engine from starts beside the
orbit, on either side of the bifurcation. If small distances from the orbit grow and large ones shrink, an attracting
orbit lies between them; if small ones shrink and large ones grow, a repelling orbit does. It prints one line a figure:

    flips, pitchforks; of them soft, rigid, inclined                         30, 30; 30, 30, 15
    draws that simulations did not decide, or with other bifurcations near   4
    balls: attracting orbits beyond, repelling ones before                   47, 13
    simulations that contradict the sign of the cubic coefficient            0
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
from benchmarks.orbits import print_figure
from benchmarks.yardstick import DIGITS, mp_contact, mp_flight, newton
from vijax.continuation.criticality import cubic_coefficient
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.multipliers import monodromy
from vijax.orbits.shooting import Sequence

DATA = Path(__file__).parents[1] / "tests" / "data" / "criticality.json"
NUMBER = 30  # number of flips, and of pitchforks
BOUNDS = {"d": (0.03, 3.0), "kappa": (3.0, 300.0), "r": (0.3, 0.97), "gamma": (-0.3, 0.3)}
MOST = {"r": 1.0}
WIDTH = 4  # most impacts of a turn; all are padded to this width
GUESSES = 4096
A_DRAW = 4  # most bifurcations of a kind from one draw
NEAR = 0.2  # distance of a multiplier from -1 that counts as near
CLOSE = 1e-11  # distance of a multiplier from -1 that counts as equal
# The multiplier is -1 -+ so much at the orbits from which balls are simulated.
EXCESS = (2e-3, 5e-4)
AMPLITUDES = np.geomspace(1e-5, 0.3, 60)  # relative perturbations of the first impact's speed
PERIODS = 256  # forcing periods of each simulation
EARLY = 1e-3  # half forcing periods between a ball's start and its first impact
DECAYED = 1e-7  # remaining share of the other multiplier's direction when a distance is first read


class Turn(NamedTuple):
    """Walls of one turn of an orbit, and the condition that closes it."""

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
        along: The parameter that crosses the bifurcation.
        d, kappa, r, gamma: Pair at the bifurcation; kappa is None for rigid walls.
        side: Walls of one turn.
        span, mirrored: Condition that closes the turn; see `shooting.Sequence`.
        impact_unknowns: Impact unknowns of one turn.
        coefficient: Cubic coefficient of the normal form, in 50 digits.
        supercritical: Whether the new orbits lie where this orbit repels.
        attracts: Whether the new orbits attract.
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
    impact_unknowns: list[list[float]]
    coefficient: float = float("nan")
    supercritical: bool = True
    attracts: bool = True

    @property
    def walls(self) -> str:
        """Return "rigid" or "soft"."""
        return "rigid" if self.kappa is None else "soft"


def stored_cases() -> list[Case]:
    """Read the stored cases."""
    return [Case(**row) for row in json.loads(DATA.read_text())]


# --- cases -----------------------------------------------------------------------------------------------------------


def drawn(walls: str, remaining: dict[str, int], draw: np.random.Generator) -> Iterator[Case]:
    """Draw pairs and guesses, and yield bifurcations of the wanted kinds near the orbits that Newton's method finds.

    From each draw, the few of each kind with the least cubic coefficient are used, as negative coefficients are rare.
    """
    while True:
        guesses = [_guessed(walls, TURNS[kind], draw) for kind in draw.integers(len(TURNS), size=GUESSES)]
        solutions = periodic.solve(*orbits(guesses))
        # Newton's method may converge to an orbit of a divisor of the period.
        has_full_period = np.asarray(solutions.sequence.span) == [guess.span for guess in guesses]
        large, _ = turning(solutions)
        near = np.flatnonzero(
            has_full_period & (np.asarray(solutions.status) == Status.OK) & (np.abs(large + 1) < NEAR)
        )
        impact_unknowns = np.where(np.asarray(solutions.sequence.real)[..., None], solutions.impact_unknowns, 0.0)
        coefficients_at = np.asarray(_coefficients(solutions.pair, solutions.sequence, impact_unknowns))
        for kind in remaining:
            rows = [row for row in near if guesses[row].kind == kind]
            for row in sorted(rows, key=lambda row: coefficients_at[row])[:A_DRAW]:
                if not remaining[kind]:
                    break
                along = str(draw.choice(["d", "r"] if walls == "rigid" else ["d", "kappa", "r"]))
                case = onto(
                    guesses[row]._replace(
                        impact_unknowns=impact_unknowns[row, : len(guesses[row].side)].tolist(), along=along
                    )
                )
                if case is not None:
                    yield case


def _guessed(walls: str, turn: Turn, draw: np.random.Generator) -> Case:
    """Draw a pair, and guess an orbit with the impacts of a turn."""
    parameters = {name: float(np.exp(draw.uniform(*np.log(BOUNDS[name])))) for name in ("d", "kappa")}
    r, count = float(draw.uniform(*BOUNDS["r"])), len(turn.side)
    gamma = float(draw.uniform(*BOUNDS["gamma"])) if draw.integers(2) and not turn.mirrored else 0.0
    intervals = draw.dirichlet(np.ones(count)) * turn.span
    t = draw.uniform(0, 2) + np.cumsum(intervals) - intervals[0]
    free_duration = np.sqrt(np.pi**2 + np.log(r) ** 2) / parameters["kappa"]
    contact_durations = 0 * intervals if walls == "rigid" else np.minimum(free_duration, 0.5 * intervals)
    impact_unknowns = np.stack([t, draw.uniform(0, 1.5, count), contact_durations], axis=1).tolist()
    kappa = None if walls == "rigid" else parameters["kappa"]
    kind = "pitchfork" if turn.mirrored else "flip"
    return Case(kind, "", parameters["d"], kappa, r, gamma, list(turn.side), turn.span, turn.mirrored, impact_unknowns)


def turning(orbit: vijax.Orbit) -> tuple[np.ndarray, np.ndarray]:
    """Return both multipliers of a turn, the larger modulus first; NaN for a complex pair."""
    impact_unknowns = np.where(np.asarray(orbit.sequence.real)[..., None], orbit.impact_unknowns, 0.0)
    values = np.linalg.eigvals(np.nan_to_num(_around(orbit.pair, orbit.sequence, impact_unknowns)))
    values = np.take_along_axis(values, np.argsort(-np.abs(values), axis=1), axis=1)
    return tuple(np.where(np.abs(values.imag).max(axis=1) > 0, np.nan, values.real.T))


_around = jax.jit(jax.vmap(monodromy))


def onto(case: Case) -> Case | None:
    """Move an orbit near a bifurcation onto it along its parameter; return None if the orbit is lost on the way."""
    at_bifurcation = orbit_near(case, 0.0)
    if at_bifurcation is None:
        return None
    numbers: dict[str, Any] = {
        name: None
        if getattr(at_bifurcation.pair, name) is None
        else float(np.asarray(getattr(at_bifurcation.pair, name))[0])
        for name in ("d", "kappa", "r", "gamma")
    }
    return case._replace(**numbers, impact_unknowns=at_bifurcation.impact_unknowns[: len(case.side)].tolist())


def orbits(cases: list[Case]) -> tuple[vijax.ImpactPair, Sequence, jax.Array]:
    """Return pairs, sequences and impact unknowns of cases with one kind of wall, padded to one width."""
    side, impact_unknowns = np.zeros((len(cases), WIDTH), np.int32), np.zeros((len(cases), WIDTH, 3))
    for row, case in enumerate(cases):
        side[row, : len(case.side)], impact_unknowns[row, : len(case.side)] = case.side, case.impact_unknowns
    columns = {name: np.array([getattr(case, name) for case in cases]) for name in ("d", "r", "gamma")}
    kappa = None if cases[0].kappa is None else np.array([case.kappa for case in cases])
    span, mirrored = jnp.array([case.span for case in cases]), jnp.array([case.mirrored for case in cases])
    pair = vijax.impact_pair(columns["d"], kappa, columns["r"], columns["gamma"])
    return pair, Sequence(jnp.asarray(side), span, mirrored), jnp.asarray(impact_unknowns)


def coefficients(cases: list[Case]) -> np.ndarray:
    """Compute the cubic coefficients of cases by vijax."""
    values = np.zeros(len(cases))
    for walls in ("soft", "rigid"):
        rows = [row for row, case in enumerate(cases) if case.walls == walls]
        if rows:
            values[rows] = _coefficients(*orbits([cases[row] for row in rows]))
    return values


_coefficients = jax.jit(jax.vmap(cubic_coefficient))

# --- the normal form in 50 digits ------------------------------------------------------------------------------------


def turned(case: Case, t: mp.mpf, v: mp.mpf) -> list[tuple[mp.mpf, mp.mpf, mp.mpf]]:
    """Simulate one turn from the first impact: onset, speed and contact duration of each impact, and of the next one.

    The next impact is returned a span earlier and, for an orbit closed halfway, as its mirror image.
    """
    d, r, gamma = mp.mpf(case.d), mp.mpf(case.r), mp.mpf(case.gamma)
    ends = [*case.side[1:], case.side[0] * (-1 if case.mirrored else 1)]
    onsets = [*(unknowns[0] for unknowns in case.impact_unknowns[1:]), case.impact_unknowns[0][0] + case.span]
    impacts = []
    for side, next_side, unknowns, onset in zip(case.side, ends, case.impact_unknowns, onsets, strict=True):
        if case.kappa is None:
            duration, out = mp.mpf(0), r * v
        else:
            kappa = mp.mpf(case.kappa)

            def contact(s, side=side, t=t, v=v, kappa=kappa):
                return mp_contact(kappa, r, gamma, side, t, v, s)[:2]

            duration = newton(contact, mp.mpf(unknowns[2]))
            out = -contact(duration)[1]
        impacts.append((t, v, duration))
        exit_time, exit_velocity = t + duration, -side * out

        def residual(s, side=side, next_side=next_side, exit_time=exit_time, exit_velocity=exit_velocity):
            displacement, speed = mp_flight(gamma, exit_time, exit_velocity, s)
            return next_side * (side * d / 2 + displacement) - d / 2, next_side * speed

        flight = newton(residual, mp.mpf(onset - unknowns[0] - unknowns[2]))
        t, v = exit_time + flight, residual(flight)[1]
    return [*impacts, (t - mp.mpf(case.span), v, mp.mpf(0))]


def normal_form(case: Case) -> float:
    """Return b of the normal form x -> -x + b x^3, by central differences of the map between first impacts.

    Source: Kuznetsov, Elements of Applied Bifurcation Theory, Eq. (5.45): with A q = -q, p A = -p, p q = 1 it is p C(q,
    q, q) / 6 - p B(q, (A - 1)^-1 B(q, q)) / 2. Here x is scaled so that all impact unknowns of a turn move by a vector
    of length x.
    """
    with mp.workdps(DIGITS):
        here, h = mp.matrix(case.impact_unknowns[0][:2]), mp.mpf(10) ** -9

        def after(*moves: tuple[mp.mpf, mp.matrix]) -> mp.matrix:
            point = here
            for factor, along in moves:
                point = point + factor * along
            return mp.matrix(turned(case, point[0], point[1])[-1][:2])

        unit = [mp.matrix([1, 0]), mp.matrix([0, 1])]
        A = mp.matrix(2, 2)
        for column, along in enumerate(unit):
            A[:, column] = (after((h, along)) - after((-h, along))) / (2 * h)
        q, p = _null(A + mp.eye(2)), _null((A + mp.eye(2)).T)
        ahead, behind = (turned(case, *(here + sign * h * q)) for sign in (1, -1))
        moved = [
            (a - b) / (2 * h)
            for impact_ahead, impact_behind in zip(ahead[:-1], behind[:-1], strict=True)
            for a, b in zip(impact_ahead, impact_behind, strict=True)
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
    """Return a null vector of a singular 2 x 2 matrix."""
    row = 0 if mp.norm(matrix[0, :]) > mp.norm(matrix[1, :]) else 1
    return mp.matrix([matrix[row, 1], -matrix[row, 0]])


# --- balls -----------------------------------------------------------------------------------------------------------


class PerturbedMotions(NamedTuple):
    """Distance from an orbit at which perturbed motions neither approach nor depart, and the behaviour below it.

    Attributes:
        distance: Difference of the first impact's speed from the orbit; NaN if there is no such distance.
        grows: Whether smaller distances grow.
    """

    distance: float
    grows: bool


class NearbyOrbit(NamedTuple):
    """An orbit near a bifurcation: its pair, its impact unknowns, and the smaller multiplier's modulus for one turn."""

    pair: vijax.ImpactPair
    impact_unknowns: np.ndarray
    small: float


def orbit_near(case: Case, excess: float) -> NearbyOrbit | None:
    """Return the orbit with the multiplier -1 - excess of one turn; None if the orbit is lost on the way."""
    pair, sequence, impact_unknowns = orbits([case])
    value = float(np.asarray(getattr(pair, case.along))[0])

    def orbit_at(x: float) -> tuple[NearbyOrbit, float]:
        moved: dict[str, Any] = {case.along: jnp.array([x])}
        solution = periodic.solve(dataclasses.replace(pair, **moved), sequence, impact_unknowns)
        (large,), (small,) = turning(solution)
        is_same_orbit = int(solution.status[0]) == Status.OK and float(solution.sequence.span[0]) == case.span
        return NearbyOrbit(solution.pair, np.asarray(solution.impact_unknowns)[0], abs(float(small))), float(
            large
        ) if is_same_orbit else np.nan

    step = 1e-6 * value
    slope = (orbit_at(value + step)[1] - orbit_at(value - step)[1]) / (2 * step)
    x, (orbit, large) = value, orbit_at(value)
    for _ in range(8):
        if abs(large + 1 + excess) < max(0.01 * abs(excess), CLOSE):
            return orbit
        change = -(large + 1 + excess) / slope
        if not abs(change) < 0.1 * value or not 0 < x + change < MOST.get(case.along, np.inf):
            return None
        before, x = large, x + change
        orbit, large = orbit_at(x)
        slope = (large - before) / change
    return None


def perturbed_motions(case: Case) -> dict[float, PerturbedMotions] | None:
    """Simulate perturbed motions at orbits that repel (excess > 0) and that attract; None if an orbit is lost."""
    excesses = [sign * size for sign in (1, -1) for size in EXCESS]
    nearby_orbits = [orbit for excess in excesses if (orbit := orbit_near(case, excess)) is not None]
    if len(nearby_orbits) < len(excesses):
        return None
    size = len(AMPLITUDES)
    pair = jax.tree.map(
        lambda *leaves: np.repeat(np.concatenate(leaves), size), *(pair for pair, _, _ in nearby_orbits)
    )
    t, speed = (np.repeat([impact_unknowns[0, i] for _, impact_unknowns, _ in nearby_orbits], size) for i in (0, 1))
    speed = speed * (1 + np.tile(AMPLITUDES, len(nearby_orbits)))
    # The start lies slightly before the first impact, so that this impact is the first record for soft walls as well.
    phase, side = np.mod(t, 2.0), case.side[0]
    displacement, v = np.array(
        [mp_flight(*row, -EARLY) for row in zip(pair.gamma, phase, side * speed, strict=True)], float
    ).T
    u = 0.5 * side * np.asarray(pair.d) + displacement
    start = {"u0": u, "v0": v, "t0": np.mod(phase - EARLY, 2.0)}
    path = vijax.trajectory(pair, **start, periods=PERIODS, max_impacts=4 * PERIODS)
    impacts = jax.tree.map(np.asarray, path.impacts)
    small = max(small for _, _, small in nearby_orbits)
    motions = {}
    for number, excess in enumerate(excesses):
        rows = slice(number * size, (number + 1) * size)
        motions[excess] = _threshold(*_growth(case, impacts.side[rows], impacts.v_in[rows], small))
    return motions


def _growth(case: Case, side: np.ndarray, v_in: np.ndarray, small: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distances, and the growth of each distance's logarithm per turn; NaN for motions with other walls."""
    count, turns = len(case.side), int(2 * PERIODS / case.span) - 2
    walls = np.array(case.side * turns)
    if case.mirrored:
        walls = walls * np.repeat((-1) ** np.arange(turns), count)
    same_walls = (side[:, : walls.size] == walls).all(axis=1)
    speed = np.abs(v_in[:, : walls.size : count])
    log_distance = np.log(0.5 * np.abs(np.diff(speed, axis=1)) + np.finfo(float).tiny)
    first_turn = int(np.ceil(np.log(DECAYED) / np.log(max(small, 1e-3)))) + 2
    if first_turn > turns // 2:
        same_walls = same_walls & False
    growth = (log_distance[:, -1] - log_distance[:, first_turn]) / (log_distance.shape[1] - 1 - first_turn)
    return np.where(same_walls, growth, np.nan), np.exp(log_distance[:, first_turn])


def _threshold(growth: np.ndarray, distance: np.ndarray) -> PerturbedMotions:
    """Return the first distance at which the growth changes its sign, among distances that keep the orbit's walls."""
    first_lost = np.flatnonzero(np.isnan(growth))
    valid = growth[: first_lost[0]] if first_lost.size else growth
    grows = bool(valid.size and valid[0] > 0)
    sign_changes = np.flatnonzero(np.sign(valid[:-1]) != np.sign(valid[1:]))
    if not sign_changes.size:
        return PerturbedMotions(np.nan, grows)
    low = sign_changes[0]
    fraction = valid[low] / (valid[low] - valid[low + 1])
    return PerturbedMotions(float(distance[low] + fraction * (distance[low + 1] - distance[low])), grows)


class SimulatedBifurcation(NamedTuple):
    """Result of the simulations: side of the new orbits, their stability, and the coefficient from their amplitude."""

    supercritical: bool
    attracts: bool
    coefficient: float


def simulated_bifurcation(case: Case) -> SimulatedBifurcation | None:
    """Return the result of the simulations; None if they are inconsistent, or distances do not follow a square root."""
    motions = perturbed_motions(case)
    if motions is None or any(motion.grows != (excess > 0) for excess, motion in motions.items()):
        return None
    large_excess, small_excess = EXCESS
    for sign in (1, -1):
        far_motion, near_motion, opposite = (
            motions[sign * large_excess],
            motions[sign * small_excess],
            motions[-sign * small_excess],
        )
        both_finite = np.isfinite(far_motion.distance) and np.isfinite(near_motion.distance)
        single_sided = not opposite.distance < 3 * near_motion.distance
        if both_finite and single_sided and 1.5 < far_motion.distance / near_motion.distance < 2.7:
            return SimulatedBifurcation(
                sign > 0, far_motion.grows, sign * small_excess / near_motion.distance**2 * _stretch(case) ** -2
            )
    return None


def _stretch(case: Case) -> float:
    """Return the ratio between the move of all impact unknowns of a turn and of the first impact's speed."""
    with mp.workdps(30):
        here, h = mp.matrix(case.impact_unknowns[0][:2]), mp.mpf(10) ** -9
        columns = []
        for along in (mp.matrix([1, 0]), mp.matrix([0, 1])):
            ahead, behind = (turned(case, *(here + sign * h * along)) for sign in (1, -1))
            columns.append(
                [
                    (a - b) / (2 * h)
                    for impact_ahead, impact_behind in zip(ahead, behind, strict=True)
                    for a, b in zip(impact_ahead, impact_behind, strict=True)
                ]
            )
        A = mp.matrix([[columns[j][len(columns[j]) - 3 + i] for j in (0, 1)] for i in (0, 1)])
        q = _null(A + mp.eye(2))
        q = q / q[1]
        moved = [q[0] * a + q[1] * b for a, b in zip(columns[0][:-3], columns[1][:-3], strict=True)]
        return float(mp.norm(moved))


# --- figures ---------------------------------------------------------------------------------------------------------


def collected(number: int, draw: np.random.Generator) -> tuple[list[Case], int]:
    """Draw flips and pitchforks that the simulations decide, half with soft walls, and count the undecided ones."""
    cases, undecided = list[Case](), 0
    for walls in ("soft", "rigid"):
        remaining = dict.fromkeys(("flip", "pitchfork"), number // 2)
        for case in drawn(walls, remaining, draw):
            result = simulated_bifurcation(case)
            if result is None:
                undecided += 1
                continue
            remaining[case.kind] -= 1
            cases.append(
                case._replace(
                    coefficient=normal_form(case), supercritical=result.supercritical, attracts=result.attracts
                )
            )
            print(cases[-1], result, file=sys.stderr, flush=True)
            if not any(remaining.values()):
                break
    return cases, undecided


def figures(cases: list[Case], results: list[SimulatedBifurcation]) -> None:
    """Print the figures."""
    kinds = [case.kind for case in cases]
    walls = [case.walls for case in cases]
    inclined = sum(case.gamma != 0 for case in cases)
    print_figure(
        "flips, pitchforks; of them soft, rigid, inclined",
        f"{kinds.count('flip')}, {kinds.count('pitchfork')}; {walls.count('soft')}, {walls.count('rigid')}, {inclined}",
    )
    computed, exact = coefficients(cases), np.array([case.coefficient for case in cases])
    outcomes = [(result.supercritical, result.attracts) for result in results]
    print_figure(
        "balls: attracting orbits beyond, repelling ones before, others",
        f"{outcomes.count((True, True))}, {outcomes.count((False, False))}, "
        f"{len(outcomes) - outcomes.count((True, True)) - outcomes.count((False, False))}",
    )
    wrong = sum(
        (b > 0) != result.attracts or (b > 0) != result.supercritical
        for b, result in zip(computed, results, strict=True)
    )
    print_figure("simulations that contradict the sign of the cubic coefficient", f"{wrong}")
    print_figure(
        "cubic coefficient, from, to", f"{computed.min():.4g}, {computed.max():.4g}; least {np.abs(computed).min():.2g}"
    )
    print_figure("cubic coefficient, largest error relative to 50 digits", f"{np.abs(computed / exact - 1).max():.1e}")
    relative_errors = np.array([result.coefficient for result in results]) / exact - 1
    print_figure(
        "cubic coefficient from balls: median and largest error, relative",
        f"{np.median(np.abs(relative_errors)):.1e}, {np.abs(relative_errors).max():.1e}",
    )


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="store the drawn cases")
    parser.add_argument("--stored", action="store_true", help="use the stored cases")
    parser.add_argument("--number", type=int, default=NUMBER, help="flips, and pitchforks, to draw")
    options = parser.parse_args()
    if options.stored:
        cases = stored_cases()
    else:
        cases, undecided = collected(options.number, np.random.default_rng(0))
        print_figure("draws that simulations did not decide", f"{undecided}")
    results = [simulated_bifurcation(case) for case in cases]
    figures(cases, [result for result in results if result is not None])
    if options.write:
        DATA.write_text("[\n" + ",\n".join(json.dumps(case._asdict()) for case in cases) + "\n]\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
