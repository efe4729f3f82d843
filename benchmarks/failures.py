"""Where do the usual methods fail on this problem, by how much, and what does vijax do about it?

    python benchmarks/failures.py                     # the whole table
    python benchmarks/failures.py --quick             # small settings, under a minute
    python benchmarks/failures.py --only grazing      # one scene
    python benchmarks/failures.py --plot stability.png  # the stability map as a picture

One block a scene: what goes wrong, each figure by the usual method and by vijax, and the answer. The test of a scene
has its name: tests/benchmarks/test_failures.py::test_stability asserts of the quick figures that the usual method fails
there and that vijax does not. Figures are measured by this command and by nothing else; timings are not among them.
Printout for two scenes, usual method and vijax side by side:

    gradients: differentiating through `where` drops the jump: the error stays at any step
        error of the gradient: 500 steps through `where`, 60 of Tsit5 located           1.08   0.00316
        error of the gradient: 2000 steps through `where`, 120 of Tsit5 located        0.636  7.13e-05
        error of the gradient: 8000 steps through `where`, 240 of Tsit5 located        0.706  1.05e-06
        error of the gradient: 32000 steps through `where`, 480 of Tsit5 located       0.742  1.59e-08
        the same of the exact engine, against differences                                  -  2.59e-09
        vijax: implicit derivatives of event times, in `exact` and in `ode`
    windows: a window that cuts the orbit differs from start to start: false multistability
        settled cells called multistable                                                0.16    0.0566
        settled cells                                                                    212       212
        vijax: P over whole periods of the confirmed orbit
"""

import argparse
import json
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import vijax
from benchmarks import charts, naive, tables
from benchmarks.peers import rk4
from vijax.batch.run_records import Trajectory
from vijax.engine import exact
from vijax.engine.ode import Ode
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.restitution import damping_ratio

HERE = Path(__file__).parent
REFERENCE = HERE.parent / "tests" / "data" / "plane_cells.json"
NONE = float("nan")

R, U0, V0 = 0.5, 0.0, 0.4
D_REGULAR = 0.2
LANES, PERIODS, ROOM = 64, 400, 1500  # the one shape in which long exact runs are compiled
SHORT, SHORT_ROOM = 3, 120  # and that of short ones that are differentiated
LONGEST_PERIOD = 32
RECURRENCE = {"float64": 1e-6, "float32": 1e-3}  # how closely a stroboscopic state must recur
SEED = 7
D_SLOW, SLOW_WINDOW = 0.2 / 9, (20, 50)  # s 0.2 at A 1, omega pi/3; periods that are counted
D_CHAOS = 0.12


class Figure(NamedTuple):
    """One measured figure, as it goes to the CSV file."""

    what: str
    usual: Any  # a number of any make; NaN: there is none
    vijax: Any


class Scene(NamedTuple):
    """A way to fail: how it is measured (in a small setting or not), what goes wrong, and what vijax does about it."""

    measure: Callable[[bool], Iterator[Figure]]
    wrong: str
    answer: str


# --- runs -----------------------------------------------------------------------------------------


def run(d: Any, kappa: Any, u0: Any = U0, v0: Any = V0, dtype: str = "float64") -> Trajectory:
    """Find the exact motion of N soft cells over `PERIODS` periods; leaves in numpy."""
    given = [np.asarray(x, dtype) for x in np.broadcast_arrays(d, kappa, np.asarray(R), u0, v0)]
    count = given[0].size
    parts = []
    for first in range(0, count, LANES):
        gap, stiffness, r, u, v = (jnp.asarray(np.resize(x[first : first + LANES], LANES)) for x in given)
        pair = vijax.impact_pair(gap, stiffness, r, jnp.zeros(LANES, dtype))
        found = vijax.trajectory(pair, u, v, PERIODS, max_impacts=ROOM)
        parts.append(jax.tree.map(np.asarray, found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def impacts_in(motion: Trajectory, first: int, last: int) -> np.ndarray:
    """Count impacts of each cell with onset in periods first ... last - 1; -1 where the run did not get there."""
    n, side = motion.impacts.n, motion.impacts.side
    counts = ((side != 0) & (n >= first) & (n < last)).sum(axis=1)
    return np.where(np.isfinite(motion.states.u[:, last - 1]), counts, -1)


class Label(NamedTuple):
    """Period of the motion that a run ends in (0: none up to 32) and its number of impacts, each [N]."""

    period: Any
    impacts: Any


def label(motion: Trajectory, dtype: str = "float64") -> Label:
    """Find the least recurrence of the last stroboscopic state, and the impacts in the periods that it spans."""
    u, v = motion.states.u, motion.states.v
    recurs = np.stack(
        [
            np.hypot(u[:, -1] - u[:, -1 - p], v[:, -1] - v[:, -1 - p]) < RECURRENCE[dtype]
            for p in range(1, LONGEST_PERIOD + 1)
        ]
    )
    period = np.where(recurs.any(axis=0), recurs.argmax(axis=0) + 1, 0)
    first = PERIODS - period[:, None]
    n, side = motion.impacts.n, motion.impacts.side
    return Label(period, ((side != 0) & (n >= first)).sum(axis=1))


@jax.jit
def derivative(pair: ImpactPair, u0: Any, v0: Any, t0: Any, along: tuple[Any, Any]) -> tuple[Any, Any]:
    """Run exactly for a short while, with the derivative along (d pair, d u0)."""

    def motion(pair, u0):
        return vijax.trajectory(pair, u0, v0, SHORT, t0, max_impacts=SHORT_ROOM)

    return jax.jvp(motion, (pair, u0), along)


def by_kappa(kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute displacement after a short run of the regular cell, and its derivative by kappa, exact."""
    pair = vijax.impact_pair(D_REGULAR, kappa, R)
    still = jnp.zeros(kappa.shape)
    along = ImpactPair(still, still + 1, still, still)
    motion, rate = derivative(pair, still + U0, still + V0, still, (along, still))
    return np.asarray(motion.states.u)[:, -1], np.asarray(rate.states.u)[:, -1]


@lru_cache
def located(solver: str) -> Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]]:
    """Compute the same by steps of a solver with located events, as a function of kappa and steps per period."""

    @jax.jit
    def both(kappa, dt):
        method = Ode(solver, jnp.asarray(1e-10), jnp.asarray(1e-12), dt)

        def last(kappa):
            pair = vijax.impact_pair(D_REGULAR, kappa, R)
            return vijax.trajectory(pair, U0, V0, SHORT, max_impacts=12, method=method).states.u[:, -1]

        return jax.jvp(last, (kappa,), (jnp.ones_like(kappa),))

    def at(kappa, steps):
        u, rate = both(jnp.asarray(kappa), jnp.asarray(2 / steps))
        return np.asarray(u), np.asarray(rate)

    return at


def located_place(solver: str, kappa: np.ndarray, steps: int) -> np.ndarray:
    """Compute the displacement alone."""
    return located(solver)(kappa, steps)[0]


def slope(x: Any, y: Any) -> float:
    """Fit the exponent of a power law by least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def plane(side: int, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Lay out cells of the (d, kappa) plane of the benchmarks, up to a stiffness, [side^2] each."""
    d, kappa = np.meshgrid(np.linspace(0.08, 0.3, side), np.geomspace(4, most, side), indexing="ij")
    return d.ravel(), kappa.ravel()


# --- scenes ---------------------------------------------------------------------------------------


class StabilityMap(NamedTuple):
    """Where RK4 stays bounded: stable[i, j] at steps[i] and kappa[j], and the least steps that theory asks for."""

    kappa: np.ndarray
    steps: np.ndarray
    stable: np.ndarray
    least_steps: np.ndarray


STABILITY_SIDES = {True: 24, False: 96}


def stability_limit(r: float) -> float:
    """Find the largest kappa h at which RK4 damps w'' + mu w' + kappa^2 w = 0."""
    ratio = float(damping_ratio(r))
    direction = complex(-ratio, np.sqrt(1 - ratio**2))
    z = np.linspace(0, 4, 40_001)[1:] * direction
    growth = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4))))
    return float(np.abs(z[np.argmax(growth > 1 + 1e-12)]))  # at r = 1 rounding alone grows


def stability_map(side: int) -> StabilityMap:
    """Run RK4 for 50 periods; what ever reaches 20 times the speed of the true motion has blown up."""
    kappa, steps = np.geomspace(20, 4000, side), np.unique(np.geomspace(16, 4096, side).astype(int))
    stable = []
    for count in steps:
        _, u, v = rk4(np.full(side, D_REGULAR), kappa, R, U0, V0, 50, int(count))
        stable.append(np.hypot(u, v) < 20)  # NaN is unstable
    return StabilityMap(kappa, steps, np.array(stable), 2 * kappa / stability_limit(R))


def stability(quick: bool) -> Iterator[Figure]:
    """Take explicit steps on a stiff wall."""
    found = stability_map(STABILITY_SIDES[quick])
    short = found.steps[:, None] < 0.9 * found.least_steps
    ample = found.steps[:, None] > 1.1 * found.least_steps
    bounded = np.mean(np.abs(run(D_REGULAR, found.kappa).states.v[:, 49]) < 2)
    yield Figure("kappa h where RK4 of the oscillator itself ends (theory)", stability_limit(R), NONE)
    first = found.stable.argmax(axis=0)  # steps from which on a column is bounded
    blown = np.median((2 * found.kappa / found.steps[first])[first > 0])
    yield Figure("kappa h from which on runs blow up, median", blown, NONE)
    yield Figure("cells bounded, 10 % and more below the steps of theory", float(found.stable[short].mean()), bounded)
    yield Figure("cells bounded, 10 % and more above", float(found.stable[ample].mean()), bounded)


_UNLOCATED = ("Tsit5", "Dopri8")
_LOCATED = {"Bosh3": 3, "Tsit5": 5, "Dopri5": 5, "Dopri8": 8, "Kvaerno5": 5}
_ORDER_STEPS = {
    "Bosh3": (250, 1000),
    "Tsit5": (300, 1200),
    "Dopri5": (300, 1200),
    "Dopri8": (160, 250),
    "Kvaerno5": (100, 500),
}


def order(quick: bool) -> Iterator[Figure]:
    """Measure convergence of the state after three periods, root of the mean square over kappa."""
    kappa = np.linspace(20, 40, 16)
    true, _ = by_kappa(kappa)

    def rate(last: Callable[[int], np.ndarray], low: int, high: int) -> float:
        steps = np.geomspace(low, high, 5).astype(int)
        return -slope(steps, [np.sqrt(np.mean((last(int(n)) - true) ** 2)) for n in steps])

    by_samples = rate(lambda n: rk4(np.full(16, D_REGULAR), kappa, R, U0, V0, SHORT, n)[1], 500, 16_000)
    yield Figure("fitted order of RK4 (4)", by_samples, NONE)
    for name, nominal in _LOCATED.items():
        if quick and name != "Tsit5":
            continue
        blind = NONE
        if not quick and name in _UNLOCATED:
            blind = rate(naive.where_solver(name, D_REGULAR, kappa, R, U0, V0, SHORT), 500, 8000)
        seen = rate(partial(located_place, name, kappa), *_ORDER_STEPS[name])
        yield Figure(f"fitted order of {name} ({nominal}), events not located and located", blind, seen)


def speeds(quick: bool) -> Iterator[Figure]:
    """Measure entry speeds of the first impacts at kappa 400 by 1024 samples a period, over 64 starts."""
    v0 = np.linspace(0.2, 0.6, LANES)
    true = run(D_REGULAR, 400.0, U0, v0).impacts
    formula = v0 + np.sin(np.pi * true.t[:, 0]) / np.pi
    pair = vijax.impact_pair(np.full(LANES, D_REGULAR), 400.0, R)
    got = vijax.trajectory(pair, U0, jnp.asarray(v0), 1, max_impacts=4, method="rk4", steps=1024).impacts
    sampled, ours = (np.abs(np.asarray(v_in)[:, 0] / formula - 1) for v_in in (got.v_in, true.v_in))
    for how, of in (("median", np.median), ("worst", np.max)):
        yield Figure(f"entry speed wrong by, {how}", float(of(sampled)), float(of(ours)))


def reference_cells(count: int | None = None) -> dict[str, np.ndarray]:
    """Read periodic cells with one attractor, wherever they start: d, kappa, period p, impacts left and right."""
    stored = json.loads(REFERENCE.read_text())["cells"]
    cells = [cell for cell in stored if cell["p"] and cell["attractors_found"] == 1][:count]
    return {name: np.array([cell[name] for cell in cells]) for name in ("d", "kappa", "p", "left", "right")}


def labels(quick: bool) -> Iterator[Figure]:
    """Count periodic reference cells whose motion RK4 does not repeat, or repeats with another number of impacts."""
    cells = reference_cells(LANES if quick else None)
    d, kappa, period = cells["d"], cells["kappa"], cells["p"]
    impacts = cells["left"] + cells["right"]
    found = label(run(d, kappa))
    known = found.period > 0
    restless, miscounted = np.mean(~known), np.mean((found.impacts != impacts)[known])
    for steps in (500, 2000) if quick else (500, 1000, 4000, 16_000):
        before = rk4(d, kappa, R, U0, V0, PERIODS, steps)
        recurs, more = np.zeros(d.size, bool), np.zeros(d.size)
        for p in np.unique(period):
            here = period == p
            after = rk4(d[here], kappa[here], R, U0, V0, PERIODS + int(p), steps)
            recurs[here] = np.hypot(after[1] - before[1][here], after[2] - before[2][here]) < 1e-4
            more[here] = after[0] * (PERIODS + p) - before[0][here] * PERIODS
        miscounts = np.mean(np.rint(more) != impacts)
        yield Figure(f"cells with another number of impacts, {steps} steps a period", miscounts, miscounted)
        yield Figure(f"cells that do not recur to 1e-4, {steps} steps a period", np.mean(~recurs), restless)


def gradients(quick: bool) -> Iterator[Figure]:
    """Measure the derivative of displacement after three periods by kappa, median relative error over kappa."""
    kappa = np.linspace(20, 40, 16)
    _, true = by_kappa(kappa)
    h = 1e-5
    around = [by_kappa(kappa + step * h)[0] for step in (-2, -1, 1, 2)]
    quotient = (around[0] - 8 * around[1] + 8 * around[2] - around[3]) / (12 * h)
    steps = (500, 2000, 8000, 32_000)
    d, r, u0, v0 = (jnp.asarray(x) for x in (D_REGULAR, R, U0, V0))
    for count, fewer in zip(steps, (60, 120, 240, 480), strict=True):
        _, blind = naive.where_rk4(d, jnp.asarray(kappa), r, u0, v0, SHORT, count)
        _, seen = located("Tsit5")(kappa, fewer)
        errors = [float(np.median(np.abs(np.asarray(x) / true - 1))) for x in (blind, seen)]
        yield Figure(f"error of the gradient: {count} steps through `where`, {fewer} of Tsit5 located", *errors)
    yield Figure(
        "the same of the exact engine, against differences", NONE, float(np.median(np.abs(true / quotient - 1)))
    )


@jax.jit
@jax.vmap
def one_impact(pair: ImpactPair, state: State) -> tuple[exact.Outcome, Any]:
    """Find the first impact of each start, and its tangent map."""
    out = exact.step(pair, state, jnp.asarray(4.0), deep=False)
    return out, exact.tangent(pair, out)


def first_impact(d: Any, kappa: float | None, u0: Any, v0: Any, t0: Any = 0.0) -> tuple[exact.Outcome, np.ndarray]:
    """Find `one_impact` of starts in flight, leaves in numpy."""
    d, u0, v0, t0 = (jnp.asarray(x) for x in np.broadcast_arrays(d, u0, v0, t0))
    whole = jnp.zeros(d.shape, jnp.int32)
    pair = vijax.impact_pair(d, kappa, R)
    return jax.tree.map(np.asarray, one_impact(pair, State(u0, v0, t0, whole, whole)))


def flight(u0: Any, v0: Any, t: Any) -> Any:
    """Compute displacement in flight at time t after a start at phase 0."""
    return u0 + v0 * t + (1 - np.cos(np.pi * t)) / np.pi**2


def roots(quick: bool) -> Iterator[Figure]:
    """Find first impacts: of drawn flights by an event solver; of flights that just reach a wall, by samples too."""
    rng = np.random.default_rng(SEED)
    count = 1024 if quick else 16_384
    d = rng.uniform(0.05, 0.3, count)
    u0, v0 = d * rng.uniform(-0.49, 0.49, count), rng.uniform(-0.6, 0.6, count)
    meets, solved = first_impact(d, None, u0, v0)[0], naive.event_solver(*map(jnp.asarray, (d, u0, v0)))
    times = np.linspace(0, 1, 2000)[:-1] * meets.flight[:, None]
    before = np.abs(flight(u0[:, None], v0[:, None], times)).max(axis=1) - d / 2
    at = np.abs(np.abs(flight(u0, v0, meets.flight)) - d / 2)
    hit = meets.impact.side != 0
    wrong = ~(np.abs(np.asarray(solved) - meets.flight) < 1e-3)
    astray = (before > 1e-12) | (at > 1e-12)
    yield Figure("first impacts wrong, Newton in an event solver", wrong[hit].mean(), astray[hit].mean())

    # Flights that turn at a time `top`, so far beyond the right wall; rising all the way there.
    top, height = rng.uniform(1, 1.4, count), 10 ** rng.uniform(-8, -4, count)
    v0 = -np.sin(np.pi * top) / np.pi
    rise = flight(0.0, v0, top)
    d = 1.2 * rise
    u0 = d / 2 + height - rise
    meets, solved = first_impact(d, None, u0, v0)[0], naive.event_solver(*map(jnp.asarray, (d, u0, v0)))
    missed = ~((meets.impact.side == 1) & (meets.flight < top))
    h = 2 / 1000
    samples = h * (np.floor(top / h)[:, None] + np.arange(2))
    unseen = (flight(u0[:, None], v0[:, None], samples) < d[:, None] / 2).all(axis=1)
    yield Figure("shallow impacts missed by 1000 samples a period", unseen.mean(), missed.mean())
    yield Figure("shallow impacts missed by signs at an event solver's steps", np.mean(~(solved < top)), missed.mean())


def chatter_restarts(quick: bool) -> Iterator[Figure]:
    """Chain SciPy restarts over two periods between rigid walls at d 0.0222 (omega pi/3, s 0.2)."""
    restarts = 500 if quick else 5000
    chain = naive.restart_chain(D_SLOW, R, 0.0, 0.1, 2, restarts)
    motion = vijax.trajectory(vijax.impact_pair(D_SLOW, None, R), 0.0, 0.1, SHORT, max_impacts=SHORT_ROOM * 2)
    onsets = np.asarray(motion.impacts.t) + 2 * np.asarray(motion.impacts.n)
    stuck = np.max(np.diff(onsets[: int(motion.filled)]))
    reached = float(np.isfinite(np.asarray(motion.states.u)).sum()) * 2
    yield Figure(f"time reached of 4 in {restarts} restarts, of 6 in {int(motion.filled)} impacts", chain.t, reached)
    yield Figure("restarts that did not advance time", float(chain.still), 0.0)
    yield Figure("longest stay at a wall in chatter", NONE, stuck)


def grazing(quick: bool) -> Iterator[Figure]:
    """Differentiate the velocity after one impact by the start, as the impact becomes slow."""
    speed, start, end = np.geomspace(1e-6, 1e-2, 9), 0.6, 2.0
    # Backwards from an impact at phase 1, where the ball is turned back by the forcing.
    turned, span = np.pi * start, 1 - start
    v0 = speed + np.sin(turned) / np.pi
    rise = v0 * span + (np.cos(turned) + 1 - np.pi * span * np.sin(turned)) / np.pi**2
    d = 0.3
    for name, kappa in (("rigid", None), ("soft, kappa 40", 40.0)):

        def velocity(shift: Any, kappa: float | None = kappa) -> tuple[np.ndarray, np.ndarray]:
            out, tangent = first_impact(d, kappa, d / 2 - rise + shift, v0, start)
            # A ball that missed the wall has flown on from where it was.
            after = out.state
            return after.v + (np.sin(np.pi * end) - np.sin(np.pi * after.t)) / np.pi, tangent

        tangent = velocity(0.0)[1]
        size = np.abs(tangent).max((1, 2))
        for k in (0, -1):
            yield Figure(f"sensitivity at impact speed {speed[k]:.0e}, {name}", NONE, size[k])
        if kappa is not None:
            continue
        yield Figure("exponent of the sensitivity in the speed, rigid", NONE, slope(speed, size))
        true, slow, errors = tangent[:, 1, 0], int(np.argmin(np.abs(speed - 1e-4))), []
        for h in (1e-6, 1e-3 * speed**2):
            quotient = (velocity(h)[0] - velocity(-h)[0]) / (2 * h)
            errors.append(abs((quotient / true)[slow] - 1))
        yield Figure("rigid, speed 1e-4: differences of 1e-6 against the tangent map; of 1e-11", *errors)


def chatter(quick: bool) -> Iterator[Figure]:
    """Count impacts per period at d 0.0222 against kappa, periods 20 to 50, by RK4 and exactly."""
    kappa = np.array([12.0, 40.0, 120.0, 400.0, 1200.0]) if quick else np.geomspace(6, 4000, 24)
    true = impacts_in(run(D_SLOW, kappa, 0.0, 0.1), *SLOW_WINDOW) / np.ptp(SLOW_WINDOW)
    for steps in (1000, 4000):
        early, late = (rk4(np.full(kappa.size, D_SLOW), kappa, R, 0.0, 0.1, n, steps)[0] * n for n in SLOW_WINDOW)
        counted = (late - early) / np.ptp(SLOW_WINDOW)
        for at, got, want in zip(kappa, counted, true, strict=True):
            yield Figure(f"impacts per period at kappa {at:.4g}, {steps} steps", got, want)


def chaos(quick: bool) -> Iterator[Figure]:
    """Follow a perturbation of 2e-16 at d 0.12, kappa 400: when it matters, and what it leaves alone."""
    v0 = np.linspace(0.3, 0.5, 32)
    motion = run(D_CHAOS, 400.0, np.repeat([U0, U0 + 2.2e-16], 32), np.tile(v0, 2))
    u, v = (x.reshape(2, 32, PERIODS) for x in (motion.states.u, motion.states.v))
    distance = np.hypot(u[1] - u[0], v[1] - v[0])
    when = (distance > 1e-2).argmax(axis=1) + 1
    work = np.nansum(np.where(motion.impacts.side != 0, motion.impacts.work, 0.0), axis=1) / PERIODS
    mean = work.reshape(2, 32).mean(axis=1)
    yield Figure("periods until 2e-16 is 1e-2, median", float(np.median(when)), NONE)
    late = float(np.median(distance[:, 2 * int(np.median(when)) :]))
    yield Figure("effect on states after twice that, on the mean power", late, abs(mean[1] / mean[0] - 1))


def windows(quick: bool) -> Iterator[Figure]:
    """Count cells called multistable from 8 starts: by P over the last 25 periods, and by P over whole periods."""
    rng = np.random.default_rng(SEED)
    starts = 8
    d, kappa = plane(16, 400)
    if quick:
        cells = reference_cells()
        some = np.flatnonzero(cells["p"] > 1)[: LANES // starts]
        d, kappa = cells["d"][some], cells["kappa"][some]
    u0, v0 = np.repeat(d, starts) * rng.uniform(-0.4, 0.4, d.size * starts), rng.uniform(-0.6, 0.6, d.size * starts)
    motion = run(np.repeat(d, starts), np.repeat(kappa, starts), u0, v0)
    found = label(motion)
    n, there = motion.impacts.n, motion.impacts.side != 0
    energy = np.where(
        there,
        np.asarray(vijax.harvested_energy(vijax.Harvester(), jnp.asarray(np.where(there, motion.impacts.depth, 0.0)))),
        0.0,
    )
    spans = np.full(found.period.size, 25), np.where(found.period > 0, found.period, 1)
    cut, whole = (
        ((n >= PERIODS - span[:, None]) * energy).sum(axis=1).reshape(-1, starts) / span.reshape(-1, starts)
        for span in spans
    )
    settled = (found.period.reshape(-1, starts) > 0).all(axis=1) & (whole.min(axis=1) > 0)
    many = [np.mean(np.ptp(power[settled], axis=1) > 1e-3 * power[settled].mean(axis=1)) for power in (cut, whole)]
    yield Figure("settled cells called multistable", *map(float, many))
    yield Figure("settled cells", float(settled.sum()), float(settled.sum()))


def resonance(quick: bool) -> Iterator[Figure]:
    """Compare penetration of an elastic wall at the resonance, kappa = pi (1 + e), r = 1 - e, with 50 digits."""
    for power in (4, 8, 12):
        kappa, r, speed, s = np.pi * (1 + 10.0**-power), 1 - 10.0**-power, 0.3, 0.7
        with mpmath.workdps(50):
            exactly = [mpmath.mpf(x) for x in (kappa, r, speed, s)]
            true = partial(naive.contact, xp=mpmath.mp)(*exactly)
        pair = vijax.impact_pair(D_REGULAR, kappa, r)
        zero, one = jnp.zeros(()), jnp.ones(())
        w, _ = flow.oscillate(flow.membrane(pair), flow.contact_force(zero, one, zero), zero, speed * one, s * one)
        errors = (abs(float(got / true - 1)) for got in (naive.contact(kappa, r, speed, s), mpmath.mpf(float(w))))
        yield Figure(f"error of the penetration, e = 1e-{power}", *errors)


def single_precision(quick: bool) -> Iterator[Figure]:
    """Compare float32 with float64 on a plane: entry speeds of the first impacts, and labels."""
    cells = reference_cells(LANES)
    d, kappa = (cells["d"], cells["kappa"]) if quick else plane(24, 400)
    double, single = (run(d, kappa, dtype=dtype) for dtype in RECURRENCE)
    error = np.abs(single.impacts.v_in.astype(float) / double.impacts.v_in - 1)
    known, got = label(double), label(single, "float32")
    sure = known.period > 0
    other = (got.period != known.period) | (got.impacts != known.impacts)
    for nth in (1, 8, 32):
        yield Figure(f"error of entry speed number {nth}, median", float(np.nanmedian(error[:, nth - 1])), NONE)
    formula = V0 + np.sin(np.pi * double.impacts.t[:, 0]) / np.pi
    ours = np.abs(double.impacts.v_in[:, 0] / formula - 1)
    yield Figure("error of entry speed number 1, worst; of float64", np.nanmax(error[:, 0]), np.nanmax(ours))
    yield Figure("periodic cells labelled otherwise", float(other[sure].mean()), NONE)


SCENES = {
    "stability": Scene(
        stability,
        "explicit steps blow up on a stiff wall",
        'no step in `exact`; method="rk4" flags the cell nonfinite',
    ),
    "order": Scene(
        order,
        "the jump of the force at the wall costs every method its order",
        '"ode" ends a step at the event, closed to second order on the repeated step',
    ),
    "speeds": Scene(
        speeds,
        "the first sample inside a stiff wall has lost speed already",
        "the onset is a root; rk4.py says what its samples cannot know",
    ),
    "labels": Scene(
        labels,
        "RK4 miscounts impacts and never quite repeats",
        "labels from exact impacts and a Newton-confirmed orbit",
    ),
    "gradients": Scene(
        gradients,
        "differentiating through `where` drops the jump: the error stays at any step",
        "implicit derivatives of event times, in `exact` and in `ode`",
    ),
    "roots": Scene(
        roots,
        "Newton leaves its bracket; a sign at step ends misses pairs of roots",
        "every crossing bracketed between analytic extrema before any iteration",
    ),
    "chatter_restarts": Scene(
        chatter_restarts,
        "a bounce shorter than the solver's first step repeats at zero length for ever",
        "one impact is one step, however short; what is left of a chatter is a sticking phase",
    ),
    "grazing": Scene(
        grazing,
        "at a rigid wall the derivative grows as 1/speed, and differences step over it",
        "saltation matrices; a soft wall's is regular",
    ),
    "chatter": Scene(
        chatter,
        "slow shaking: more bounces per period than steps resolve",
        "the count does not depend on any step",
    ),
    "chaos": Scene(
        chaos,
        "rounding decides single trajectories within tens of periods",
        "averages, with a standard error, and period 0 instead of a label",
    ),
    "windows": Scene(
        windows,
        "a window that cuts the orbit differs from start to start: false multistability",
        "P over whole periods of the confirmed orbit",
    ),
    "resonance": Scene(
        resonance,
        "steady and free oscillation cancel at kappa = pi, r near 1",
        "their divided difference, in secular form",
    ),
    "single_precision": Scene(
        single_precision,
        "seven digits: errors grow from impact to impact, some cells change their label",
        'float64 unless asked; `dtype="float32"` widens its tolerances',
    ),
}


def main() -> None:
    """Measure what the command line asks for, print it, and save the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small settings")
    parser.add_argument("--only", choices=list(SCENES), action="append", help="one scene; may be given again")
    parser.add_argument("--plot", type=Path, help="draw the stability map there, and measure nothing else")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the figures")
    given = parser.parse_args()

    if given.plot:
        charts.stability_map(stability_map(STABILITY_SIDES[given.quick]), given.plot)
        return
    part = "_quick" if given.quick or given.only else ""
    rows = measured(given.only or list(SCENES), given.quick)
    tables.write(given.rows / f"failures{part}.csv", ["scene", *Figure._fields], rows)


def measured(names: list[str], quick: bool) -> Iterator[list[Any]]:
    """Measure scenes, print each figure, and give it with its scene."""
    for name in names:
        scene = SCENES[name]
        print(f"{name}: {scene.wrong}")
        for figure in scene.measure(quick):
            usual, ours = ("-" if x != x else f"{x:.3g}" for x in figure[1:])
            print(f"    {figure.what:74} {usual:>9} {ours:>9}", flush=True)
            yield [name, *figure]
        print(f"    vijax: {scene.answer}")


if __name__ == "__main__":
    main()
