"""Where do the usual methods fail on this problem, by how much, and how does vijax avoid it?

    python benchmarks/failures.py                     # the whole table
    python benchmarks/failures.py --quick             # small settings, under a minute
    python benchmarks/failures.py --only grazing      # one scene
    python benchmarks/failures.py --plot stability.png  # the stability map as a picture

One block a scene: the failure, each figure by the usual method and by vijax, and vijax' solution. The test of a scene
has the scene's name: tests/benchmarks/test_failures.py::test_stability asserts on the quick figures that the usual
method fails and vijax does not. Figures are measured by this command alone; timings are not among them. Printout for
two scenes, usual method and vijax side by side:

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
from vijax.impact.exact import exact_step
from vijax.impact.ode.ode import Ode
from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.walls.restitution import damping_ratio
from vijax.simulation.run_records import Trajectory

HERE = Path(__file__).parent
REFERENCE = HERE.parent / "tests" / "data" / "plane_cells.json"
NONE = float("nan")

R, U0, V0 = 0.5, 0.0, 0.4
D_REGULAR = 0.2
LANES, PERIODS, CAPACITY = 64, 400, 1500  # the single shape for which long exact runs are compiled
SHORT, SHORT_CAPACITY = 3, 120  # the shape of short runs that are differentiated
LONGEST_PERIOD = 32
RECURRENCE = {"float64": 1e-6, "float32": 1e-3}  # tolerance of a recurrence of the stroboscopic state
SEED = 7
D_SLOW, SLOW_WINDOW = 0.2 / 9, (20, 50)  # s 0.2 at A 1, omega pi/3; first and last counted period
D_CHAOS = 0.12


class Figure(NamedTuple):
    """One measured figure, as stored in the CSV file."""

    quantity: str
    usual: Any  # a number of any type; NaN if there is none
    vijax: Any


class Scene(NamedTuple):
    """A failure: its measurement (in a small setting or not), a description, and vijax' solution."""

    measure: Callable[[bool], Iterator[Figure]]
    wrong: str
    answer: str


# --- runs -----------------------------------------------------------------------------------------


def run(d: Any, kappa: Any, u0: Any = U0, v0: Any = V0, dtype: str = "float64") -> Trajectory:
    """Simulate N soft cells exactly over `PERIODS` periods; leaves in numpy."""
    columns = [np.asarray(x, dtype) for x in np.broadcast_arrays(d, kappa, np.asarray(R), u0, v0)]
    count = columns[0].size
    parts = []
    for first in range(0, count, LANES):
        gap, stiffness, r, u, v = (jnp.asarray(np.resize(x[first : first + LANES], LANES)) for x in columns)
        pair = vijax.impact_pair(gap, stiffness, r, jnp.zeros(LANES, dtype))
        motion = vijax.trajectory(pair, u, v, PERIODS, max_impacts=CAPACITY)
        parts.append(jax.tree.map(np.asarray, motion))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def impacts_in(motion: Trajectory, first: int, last: int) -> np.ndarray:
    """Count impacts of each cell with onset in periods first ... last - 1; -1 if the run ended earlier."""
    n, side = motion.impacts.n, motion.impacts.side
    counts = ((side != 0) & (n >= first) & (n < last)).sum(axis=1)
    return np.where(np.isfinite(motion.states.u[:, last - 1]), counts, -1)


class Label(NamedTuple):
    """Period of the final motion of a run (0: none up to 32) and its number of impacts, each [N]."""

    period: Any
    impacts: Any


def label(motion: Trajectory, dtype: str = "float64") -> Label:
    """Return the least recurrence of the last stroboscopic state, and the impacts within it."""
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
    """Run exactly for a short time, with the derivative along (d pair, d u0)."""

    def motion(pair, u0):
        return vijax.trajectory(pair, u0, v0, SHORT, t0, max_impacts=SHORT_CAPACITY)

    return jax.jvp(motion, (pair, u0), along)


def by_kappa(kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return displacement after a short run of the regular cell, and its exact derivative by kappa."""
    pair = vijax.impact_pair(D_REGULAR, kappa, R)
    zeros = jnp.zeros(kappa.shape)
    along = ImpactPair(zeros, zeros + 1, zeros, zeros)
    motion, rate = derivative(pair, zeros + U0, zeros + V0, zeros, (along, zeros))
    return np.asarray(motion.states.u)[:, -1], np.asarray(rate.states.u)[:, -1]


@lru_cache
def located(solver: str) -> Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]]:
    """Return a function of kappa and steps per period with the same results, by a solver with located events."""

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
    """Return the displacement alone."""
    return located(solver)(kappa, steps)[0]


def slope(x: Any, y: Any) -> float:
    """Fit the exponent of a power law by least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def plane(side: int, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cells of the benchmarks' (d, kappa) plane up to a stiffness, [side^2] each."""
    d, kappa = np.meshgrid(np.linspace(0.08, 0.3, side), np.geomspace(4, largest, side), indexing="ij")
    return d.ravel(), kappa.ravel()


# --- scenes ---------------------------------------------------------------------------------------


class StabilityMap(NamedTuple):
    """Stability of RK4: stable[i, j] at steps[i] and kappa[j], and the least steps by theory."""

    kappa: np.ndarray
    steps: np.ndarray
    stable: np.ndarray
    least_steps: np.ndarray


STABILITY_SIDES = {True: 24, False: 96}


def stability_limit(r: float) -> float:
    """Return the largest kappa h for which RK4 damps w'' + mu w' + kappa^2 w = 0."""
    ratio = float(damping_ratio(r))
    direction = complex(-ratio, np.sqrt(1 - ratio**2))
    z = np.linspace(0, 4, 40_001)[1:] * direction
    growth = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4))))
    return float(np.abs(z[np.argmax(growth > 1 + 1e-12)]))  # at r = 1 rounding errors alone grow


def stability_map(side: int) -> StabilityMap:
    """Run RK4 for 50 periods; a run has blown up if it reaches 20 times the speed of the exact motion."""
    kappa, steps = np.geomspace(20, 4000, side), np.unique(np.geomspace(16, 4096, side).astype(int))
    stable = []
    for count in steps:
        _, u, v = rk4(np.full(side, D_REGULAR), kappa, R, U0, V0, 50, int(count))
        stable.append(np.hypot(u, v) < 20)  # NaN is unstable
    return StabilityMap(kappa, steps, np.array(stable), 2 * kappa / stability_limit(R))


def stability(quick: bool) -> Iterator[Figure]:
    """Take explicit steps on a stiff wall."""
    stability_data = stability_map(STABILITY_SIDES[quick])
    below = stability_data.steps[:, None] < 0.9 * stability_data.least_steps
    above = stability_data.steps[:, None] > 1.1 * stability_data.least_steps
    bounded = np.mean(np.abs(run(D_REGULAR, stability_data.kappa).states.v[:, 49]) < 2)
    yield Figure("kappa h where RK4 of the oscillator itself ends (theory)", stability_limit(R), NONE)
    first_stable = stability_data.stable.argmax(axis=0)  # first number of steps at which a column is bounded
    limit = np.median((2 * stability_data.kappa / stability_data.steps[first_stable])[first_stable > 0])
    yield Figure("kappa h from which on runs blow up, median", limit, NONE)
    yield Figure(
        "cells bounded, 10 % and more below the steps of theory", float(stability_data.stable[below].mean()), bounded
    )
    yield Figure("cells bounded, 10 % and more above", float(stability_data.stable[above].mean()), bounded)


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
    exact, _ = by_kappa(kappa)

    def rate(last: Callable[[int], np.ndarray], low: int, high: int) -> float:
        steps = np.geomspace(low, high, 5).astype(int)
        return -slope(steps, [np.sqrt(np.mean((last(int(n)) - exact) ** 2)) for n in steps])

    sampled_order = rate(lambda n: rk4(np.full(16, D_REGULAR), kappa, R, U0, V0, SHORT, n)[1], 500, 16_000)
    yield Figure("fitted order of RK4 (4)", sampled_order, NONE)
    for name, nominal in _LOCATED.items():
        if quick and name != "Tsit5":
            continue
        unlocated_order = NONE
        if not quick and name in _UNLOCATED:
            unlocated_order = rate(naive.where_solver(name, D_REGULAR, kappa, R, U0, V0, SHORT), 500, 8000)
        located_order = rate(partial(located_place, name, kappa), *_ORDER_STEPS[name])
        yield Figure(
            f"fitted order of {name} ({nominal}), events not located and located", unlocated_order, located_order
        )


def speeds(quick: bool) -> Iterator[Figure]:
    """Measure entry speeds of the first impacts at kappa 400 by 1024 samples a period, over 64 starts."""
    v0 = np.linspace(0.2, 0.6, LANES)
    exact = run(D_REGULAR, 400.0, U0, v0).impacts
    formula = v0 + np.sin(np.pi * exact.t[:, 0]) / np.pi
    pair = vijax.impact_pair(np.full(LANES, D_REGULAR), 400.0, R)
    stepped = vijax.trajectory(pair, U0, jnp.asarray(v0), 1, max_impacts=4, method="rk4", steps=1024).impacts
    sampled, exact_errors = (np.abs(np.asarray(v_in)[:, 0] / formula - 1) for v_in in (stepped.v_in, exact.v_in))
    for name, statistic in (("median", np.median), ("worst", np.max)):
        yield Figure(f"entry speed wrong by, {name}", float(statistic(sampled)), float(statistic(exact_errors)))


def reference_cells(count: int | None = None) -> dict[str, np.ndarray]:
    """Read periodic cells with one attractor for all starts: d, kappa, period p, impacts left and right."""
    stored = json.loads(REFERENCE.read_text())["cells"]
    cells = [cell for cell in stored if cell["p"] and cell["attractors_found"] == 1][:count]
    return {name: np.array([cell[name] for cell in cells]) for name in ("d", "kappa", "p", "left", "right")}


def labels(quick: bool) -> Iterator[Figure]:
    """Count periodic reference cells that RK4 does not repeat, or repeats with another number of impacts."""
    cells = reference_cells(LANES if quick else None)
    d, kappa, period = cells["d"], cells["kappa"], cells["p"]
    impacts = cells["left"] + cells["right"]
    exact_labels = label(run(d, kappa))
    is_periodic = exact_labels.period > 0
    no_label, miscounted = np.mean(~is_periodic), np.mean((exact_labels.impacts != impacts)[is_periodic])
    for steps in (500, 2000) if quick else (500, 1000, 4000, 16_000):
        before = rk4(d, kappa, R, U0, V0, PERIODS, steps)
        recurs, more = np.zeros(d.size, bool), np.zeros(d.size)
        for p in np.unique(period):
            rows = period == p
            after = rk4(d[rows], kappa[rows], R, U0, V0, PERIODS + int(p), steps)
            recurs[rows] = np.hypot(after[1] - before[1][rows], after[2] - before[2][rows]) < 1e-4
            more[rows] = after[0] * (PERIODS + p) - before[0][rows] * PERIODS
        miscounts = np.mean(np.rint(more) != impacts)
        yield Figure(f"cells with another number of impacts, {steps} steps a period", miscounts, miscounted)
        yield Figure(f"cells that do not recur to 1e-4, {steps} steps a period", np.mean(~recurs), no_label)


def gradients(quick: bool) -> Iterator[Figure]:
    """Measure the derivative of displacement after three periods by kappa: median relative error over kappa."""
    kappa = np.linspace(20, 40, 16)
    _, exact = by_kappa(kappa)
    h = 1e-5
    neighbours = [by_kappa(kappa + step * h)[0] for step in (-2, -1, 1, 2)]
    quotient = (neighbours[0] - 8 * neighbours[1] + 8 * neighbours[2] - neighbours[3]) / (12 * h)
    steps = (500, 2000, 8000, 32_000)
    d, r, u0, v0 = (jnp.asarray(x) for x in (D_REGULAR, R, U0, V0))
    for count, fewer in zip(steps, (60, 120, 240, 480), strict=True):
        _, unlocated = naive.where_rk4(d, jnp.asarray(kappa), r, u0, v0, SHORT, count)
        _, located_slope = located("Tsit5")(kappa, fewer)
        errors = [float(np.median(np.abs(np.asarray(x) / exact - 1))) for x in (unlocated, located_slope)]
        yield Figure(f"error of the gradient: {count} steps through `where`, {fewer} of Tsit5 located", *errors)
    yield Figure(
        "the same of the exact engine, against differences", NONE, float(np.median(np.abs(exact / quotient - 1)))
    )


@jax.jit
@jax.vmap
def impact_of_start(pair: ImpactPair, state: State) -> tuple[exact_step.ExactResult, Any]:
    """Return the first impact of each start, and its tangent map."""
    out = exact_step.step(pair, state, jnp.asarray(4.0), deep=False)
    return out, exact_step.tangent_map(pair, out)


def first_impact(
    d: Any, kappa: float | None, u0: Any, v0: Any, t0: Any = 0.0
) -> tuple[exact_step.ExactResult, np.ndarray]:
    """Return `impact_of_start` of starts in flight, leaves in numpy."""
    d, u0, v0, t0 = (jnp.asarray(x) for x in np.broadcast_arrays(d, u0, v0, t0))
    zeros = jnp.zeros(d.shape, jnp.int32)
    pair = vijax.impact_pair(d, kappa, R)
    return jax.tree.map(np.asarray, impact_of_start(pair, State(u0, v0, t0, zeros, zeros)))


def flight(u0: Any, v0: Any, t: Any) -> Any:
    """Compute displacement in flight at time t after a start at phase 0."""
    return u0 + v0 * t + (1 - np.cos(np.pi * t)) / np.pi**2


def roots(quick: bool) -> Iterator[Figure]:
    """Compute first impacts: of random flights by an event solver; of grazing flights by samples as well."""
    rng = np.random.default_rng(SEED)
    count = 1024 if quick else 16_384
    d = rng.uniform(0.05, 0.3, count)
    u0, v0 = d * rng.uniform(-0.49, 0.49, count), rng.uniform(-0.6, 0.6, count)
    first, solved = first_impact(d, None, u0, v0)[0], naive.event_solver(*map(jnp.asarray, (d, u0, v0)))
    times = np.linspace(0, 1, 2000)[:-1] * first.flight[:, None]
    before = np.abs(flight(u0[:, None], v0[:, None], times)).max(axis=1) - d / 2
    residual = np.abs(np.abs(flight(u0, v0, first.flight)) - d / 2)
    is_impact = first.impact.side != 0
    wrong = ~(np.abs(np.asarray(solved) - first.flight) < 1e-3)
    wrong_exact = (before > 1e-12) | (residual > 1e-12)
    yield Figure(
        "first impacts wrong, Newton in an event solver", wrong[is_impact].mean(), wrong_exact[is_impact].mean()
    )

    # Flights with their turning point at time `top`, slightly beyond the right wall, and rising until then.
    top, height = rng.uniform(1, 1.4, count), 10 ** rng.uniform(-8, -4, count)
    v0 = -np.sin(np.pi * top) / np.pi
    rise = flight(0.0, v0, top)
    d = 1.2 * rise
    u0 = d / 2 + height - rise
    first, solved = first_impact(d, None, u0, v0)[0], naive.event_solver(*map(jnp.asarray, (d, u0, v0)))
    missed = ~((first.impact.side == 1) & (first.flight < top))
    h = 2 / 1000
    samples = h * (np.floor(top / h)[:, None] + np.arange(2))
    missed_by_samples = (flight(u0[:, None], v0[:, None], samples) < d[:, None] / 2).all(axis=1)
    yield Figure("shallow impacts missed by 1000 samples a period", missed_by_samples.mean(), missed.mean())
    yield Figure("shallow impacts missed by signs at an event solver's steps", np.mean(~(solved < top)), missed.mean())


def chatter_restarts(quick: bool) -> Iterator[Figure]:
    """Chain SciPy restarts over two periods between rigid walls at d 0.0222 (omega pi/3, s 0.2)."""
    restarts = 500 if quick else 5000
    chain = naive.restart_chain(D_SLOW, R, 0.0, 0.1, 2, restarts)
    motion = vijax.trajectory(vijax.impact_pair(D_SLOW, None, R), 0.0, 0.1, SHORT, max_impacts=SHORT_CAPACITY * 2)
    onsets = np.asarray(motion.impacts.t) + 2 * np.asarray(motion.impacts.n)
    stuck = np.max(np.diff(onsets[: int(motion.filled)]))
    end_time = float(np.isfinite(np.asarray(motion.states.u)).sum()) * 2
    yield Figure(f"time reached of 4 in {restarts} restarts, of 6 in {int(motion.filled)} impacts", chain.t, end_time)
    yield Figure("restarts that did not advance time", float(chain.still), 0.0)
    yield Figure("longest stay at a wall in chatter", NONE, stuck)


def grazing(quick: bool) -> Iterator[Figure]:
    """Differentiate the velocity after one impact by the start, for decreasing impact speed."""
    speed, start, end = np.geomspace(1e-6, 1e-2, 9), 0.6, 2.0
    # Backwards from an impact at phase 1, where the excitation turns the ball around.
    start_angle, span = np.pi * start, 1 - start
    v0 = speed + np.sin(start_angle) / np.pi
    rise = v0 * span + (np.cos(start_angle) + 1 - np.pi * span * np.sin(start_angle)) / np.pi**2
    d = 0.3
    for name, kappa in (("rigid", None), ("soft, kappa 40", 40.0)):

        def velocity(shift: Any, kappa: float | None = kappa) -> tuple[np.ndarray, np.ndarray]:
            outcome, tangent = first_impact(d, kappa, d / 2 - rise + shift, v0, start)
            # If the ball misses the wall, its flight continues from the start.
            after = outcome.state
            return after.v + (np.sin(np.pi * end) - np.sin(np.pi * after.t)) / np.pi, tangent

        tangent = velocity(0.0)[1]
        size = np.abs(tangent).max((1, 2))
        for k in (0, -1):
            yield Figure(f"sensitivity at impact speed {speed[k]:.0e}, {name}", NONE, size[k])
        if kappa is not None:
            continue
        yield Figure("exponent of the sensitivity in the speed, rigid", NONE, slope(speed, size))
        exact, slow_index, errors = tangent[:, 1, 0], int(np.argmin(np.abs(speed - 1e-4))), []
        for h in (1e-6, 1e-3 * speed**2):
            quotient = (velocity(h)[0] - velocity(-h)[0]) / (2 * h)
            errors.append(abs((quotient / exact)[slow_index] - 1))
        yield Figure("rigid, speed 1e-4: differences of 1e-6 against the tangent map; of 1e-11", *errors)


def chatter(quick: bool) -> Iterator[Figure]:
    """Count impacts per period at d 0.0222 against kappa, periods 20 to 50, by RK4 and exactly."""
    kappa = np.array([12.0, 40.0, 120.0, 400.0, 1200.0]) if quick else np.geomspace(6, 4000, 24)
    exact = impacts_in(run(D_SLOW, kappa, 0.0, 0.1), *SLOW_WINDOW) / np.ptp(SLOW_WINDOW)
    for steps in (1000, 4000):
        early, late = (rk4(np.full(kappa.size, D_SLOW), kappa, R, 0.0, 0.1, n, steps)[0] * n for n in SLOW_WINDOW)
        counted = (late - early) / np.ptp(SLOW_WINDOW)
        for stiffness, stepped, exact_count in zip(kappa, counted, exact, strict=True):
            yield Figure(f"impacts per period at kappa {stiffness:.4g}, {steps} steps", stepped, exact_count)


def chaos(quick: bool) -> Iterator[Figure]:
    """Follow a perturbation of 2e-16 at d 0.12, kappa 400: its growth, and its effect on averages."""
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
        selected = np.flatnonzero(cells["p"] > 1)[: LANES // starts]
        d, kappa = cells["d"][selected], cells["kappa"][selected]
    u0, v0 = np.repeat(d, starts) * rng.uniform(-0.4, 0.4, d.size * starts), rng.uniform(-0.6, 0.6, d.size * starts)
    motion = run(np.repeat(d, starts), np.repeat(kappa, starts), u0, v0)
    motion_labels = label(motion)
    n, is_impact = motion.impacts.n, motion.impacts.side != 0
    energy = np.where(
        is_impact,
        np.asarray(
            vijax.harvested_energy(vijax.Harvester(), jnp.asarray(np.where(is_impact, motion.impacts.depth, 0.0)))
        ),
        0.0,
    )
    spans = np.full(motion_labels.period.size, 25), np.where(motion_labels.period > 0, motion_labels.period, 1)
    cut, full = (
        ((n >= PERIODS - span[:, None]) * energy).sum(axis=1).reshape(-1, starts) / span.reshape(-1, starts)
        for span in spans
    )
    settled = (motion_labels.period.reshape(-1, starts) > 0).all(axis=1) & (full.min(axis=1) > 0)
    share = [np.mean(np.ptp(power[settled], axis=1) > 1e-3 * power[settled].mean(axis=1)) for power in (cut, full)]
    yield Figure("settled cells called multistable", *map(float, share))
    yield Figure("settled cells", float(settled.sum()), float(settled.sum()))


def resonance(quick: bool) -> Iterator[Figure]:
    """Compare penetration of an elastic wall at the resonance, kappa = pi (1 + e), r = 1 - e, with 50 digits."""
    for power in (4, 8, 12):
        kappa, r, speed, s = np.pi * (1 + 10.0**-power), 1 - 10.0**-power, 0.3, 0.7
        with mpmath.workdps(50):
            numbers = [mpmath.mpf(x) for x in (kappa, r, speed, s)]
            exact = partial(naive.contact, xp=mpmath.mp)(*numbers)
        pair = vijax.impact_pair(D_REGULAR, kappa, r)
        zero, unit = jnp.zeros(()), jnp.ones(())
        w, _ = flow.oscillate(flow.membrane(pair), flow.contact_force(zero, unit, zero), zero, speed * unit, s * unit)
        errors = (abs(float(value / exact - 1)) for value in (naive.contact(kappa, r, speed, s), mpmath.mpf(float(w))))
        yield Figure(f"error of the penetration, e = 1e-{power}", *errors)


def single_precision(quick: bool) -> Iterator[Figure]:
    """Compare float32 with float64 on a plane: entry speeds of the first impacts, and labels."""
    cells = reference_cells(LANES)
    d, kappa = (cells["d"], cells["kappa"]) if quick else plane(24, 400)
    double, single = (run(d, kappa, dtype=dtype) for dtype in RECURRENCE)
    error = np.abs(single.impacts.v_in.astype(float) / double.impacts.v_in - 1)
    double_labels, single_labels = label(double), label(single, "float32")
    is_periodic = double_labels.period > 0
    differs = (single_labels.period != double_labels.period) | (single_labels.impacts != double_labels.impacts)
    for nth in (1, 8, 32):
        yield Figure(f"error of entry speed number {nth}, median", float(np.nanmedian(error[:, nth - 1])), NONE)
    formula = V0 + np.sin(np.pi * double.impacts.t[:, 0]) / np.pi
    exact_errors = np.abs(double.impacts.v_in[:, 0] / formula - 1)
    yield Figure("error of entry speed number 1, worst; of float64", np.nanmax(error[:, 0]), np.nanmax(exact_errors))
    yield Figure("periodic cells labelled otherwise", float(differs[is_periodic].mean()), NONE)


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
        'float64 by default; `dtype="float32"` widens its tolerances',
    ),
}


def main() -> None:
    """Measure the scenes that the command line selects, print and save the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small settings")
    parser.add_argument("--only", choices=list(SCENES), action="append", help="one scene; may be given again")
    parser.add_argument("--plot", type=Path, help="draw the stability map there, and measure nothing else")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the figures")
    options = parser.parse_args()

    if options.plot:
        charts.stability_map(stability_map(STABILITY_SIDES[options.quick]), options.plot)
        return
    part = "_quick" if options.quick or options.only else ""
    rows = measured(options.only or list(SCENES), options.quick)
    tables.write(options.rows / f"failures{part}.csv", ["scene", *Figure._fields], rows)


def measured(names: list[str], quick: bool) -> Iterator[list[Any]]:
    """Measure scenes, print each figure, and yield it with its scene."""
    for name in names:
        scene = SCENES[name]
        print(f"{name}: {scene.wrong}")
        for figure in scene.measure(quick):
            usual_text, exact_text = ("-" if x != x else f"{x:.3g}" for x in figure[1:])
            print(f"    {figure.quantity:74} {usual_text:>9} {exact_text:>9}", flush=True)
            yield [name, *figure]
        print(f"    vijax: {scene.answer}")


if __name__ == "__main__":
    main()
