"""Are designs on orbits optimal? Compared with a dense scan and exact gradients, timed, and tested at cliffs.

    python benchmarks/design.py                # all figures
    python benchmarks/design.py --only scan    # one part

One line a figure, requirements in brackets; every miss of the scan has a line of its own, which defines the device.
Random devices have d from 0.03 to 10; the printout is of ones with d from 0.05 to 0.3:

    gradients: dP/dkappa of four orbits of 50 digits, forward: largest error 1.8e-15
    gradients: dP/dkappa of four orbits of 50 digits, reverse: largest error 8.9e-16
    gradients: attractors of random cells; regular ones looked at            2122; 1000
    gradients: dP/dd: median, largest error against differences; above 1e-06 5.1e-13, 3.0e-09; 0
    gradients: dP/dkappa: median, largest error against differences; above 1e-06 4.5e-13, 3.0e-10; 0
    gradients: dP/dr: median, largest error against differences; above 1e-06 9.6e-13, 1.8e-09; 0
    gradients: d2P/dkappa2: median, largest error against differences; above 1e-05 4.9e-13, 5.2e-09; 0
    gradients: d2P/dkappa dr: median, largest error against differences; above 1e-05 1.2e-12, 1.2e-09; 0
    reference: small fast device, kappa (4.00713)                            4.00713
    reference: P, microjoule (57.75761)                                      57.75761
    reference: penetration, mm (6.026)                                       6.0266
    reference: largest multiplier (0.533)                                    0.5335
    scan: devices from the whole box; left out, their best being aperiodic   130; 8
    scan: small and fast devices added, to have half of them interior; left out 72; 44
    scan: best points of the scans clear of constraints                      101 of 202
    scan: interior optima of all                                             94 of 202
    scan: why the ascents stopped                                            maximum 200, stalled 2
    scan: largest excess over a constraint, relative                         -1.7e-09
    scan: most evaluations of a start that won; median                       53; 31
    scan: optimum over the scan's best: least, median, largest               1.00000, 1.00015, 1.72807
    scan: misses, below 0.999                                                0 of 202
    speed: parameters; starts                                                124; 1540
    speed: seconds, first (with compilation or its cache); again             71.6; 41.3
    speed: seconds a 1,000 parameters; a 1,000 starts                        332.8; 26.8
    speed: evaluations of the starts that became optima: median, most        38, 60
    speed: microseconds of P alone, from a neighbour's orbit                 78.58 (1544 orbits)
    speed: P with dP/dkappa, forward, over P alone                           0.88
    speed: P with dP/d(d, kappa, r), reverse, over P alone                   0.86
    cliffs: small fast device, kappa 3.69 to 3.72: optima; with a NaN; with no attracting orbit 1; 0; 0
    cliffs: beside 20 orbits that nearly graze: optima; with a NaN; with no attracting orbit 15; 0; 0

(parts of it; the scan with --devices 130, a quarter of an hour)
"""

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vijax
from vijax.design import optimise
from vijax.design.optimise import Design
from vijax.design.optimum import Optimum
from vijax.design.survey.attractor_survey import gap_time_factor, simulate_survey
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.orbits import periodic
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import Sequence
from vijax.orbits.steady import steady
from vijax.simulation.simulate import Starts

DATA = Path(__file__).parent.parent / "tests" / "data"
SEED = 5
KAPPA = (2.0, 400.0)
GAPS = (0.03, 10.0)  # d of random devices, log-uniform
NARROW, WIDE = 0.3, 1.0  # bounds of d for the groups of narrow and wide gaps


def print_figure(quantity: str, value: str) -> None:
    """Print one figure."""
    print(f"{quantity:<72} {value}", flush=True)


# --- gradients ----------------------------------------------------------------------------------------------------

CELLS = 1000
DRAWN = 10240  # random cells, enough for the number of regular ones
# A cell is regular if difference quotients are reliable there: well-conditioned, contracting, no impact near grazing.
MOST_CONDITION, MOST_MULTIPLIER, LEAST_CLEARANCE = 1e3, 0.9, 0.02
NAMES = ("d", "kappa", "r")
STEPS = (1e-3, 3e-4, 1e-4, 3e-5, 1e-5)  # relative, of difference quotients; the step with the smallest error counts


def harvested(orbit: Orbit, gamma: Any, x: Any) -> Any:
    """Compute P of the paper's device as a function of d, kappa, r."""
    return steady(Harvester(), orbit, pair=ImpactPair(x[0], x[1], x[2], gamma)).P


def reference_orbits() -> list[tuple[dict, Orbit]]:
    """Read the rows in 50 digits, and solve for the orbit of each."""
    rows = []
    for row in json.loads((DATA / "gradients.json").read_text())["orbits"]:
        t, v, contact_durations = (np.array([float(x) for x in row[name]]) for name in ("t_in", "v_in", "contact"))
        order = np.argsort(t)
        pair = impact_pair(*([float(row[name])] for name in ("d", "kappa", "r", "gamma")))
        side = jnp.asarray(np.sign(v[order])[None], jnp.int32)
        impact_unknowns = jnp.asarray(np.stack([t, np.abs(v), contact_durations], axis=1)[order])[None]
        rows.append(
            (row, periodic.solve(pair, Sequence(side, jnp.full(1, 2.0), jnp.zeros(1, bool)), impact_unknowns)[0])
        )
    return rows


def random_cells() -> Orbit:
    """Return periodic attractors of random cells, half of them inclined."""
    draw = np.random.default_rng(SEED)
    shape = (DRAWN,)
    tilt = np.where(np.arange(DRAWN) % 2 == 0, 0.0, draw.uniform(-0.05, 0.05, shape))
    kappa = np.exp(draw.uniform(math.log(3), math.log(400), shape))
    d = np.exp(draw.uniform(math.log(GAPS[0]), math.log(GAPS[1]), shape))
    columns = d, kappa, draw.uniform(0.2, 0.9, shape), tilt
    device = jax.tree.map(lambda x: np.full(shape, x), Harvester())
    starts = Starts(jnp.zeros(shape), jnp.full(shape, 0.25), jnp.zeros(shape))
    longest, periods = 4 * gap_time_factor(d), 400 * gap_time_factor(d)
    pair = ImpactPair(*map(jnp.asarray, columns))
    attractors = simulate_survey(pair, device, starts, max_period=longest, periods=periods).orbits(8)
    orbits = periodic.solve(
        jax.tree.map(jnp.asarray, attractors.pair), attractors.sequence(8), jnp.asarray(attractors.impact_unknowns)
    )
    return orbits[np.asarray(orbits.status) == Status.OK]


def differences(function: Callable[[Any], Any], x: np.ndarray, axis: int) -> np.ndarray:
    """Compute central differences of fourth order in a column of x, for each of the steps, [step, ...]."""

    def of_step(step: float) -> np.ndarray:
        length = step * x[:, axis]

        def value_at(times: int) -> np.ndarray:
            moved = x.copy()
            moved[:, axis] += times * length
            return np.asarray(function(jnp.asarray(moved)))

        return ((8 * (value_at(1) - value_at(-1)) - (value_at(2) - value_at(-2))).T / (12 * length)).T

    return np.stack([of_step(step) for step in STEPS])


def error(exact: np.ndarray, by_difference: np.ndarray) -> np.ndarray:
    """Compute the relative error of each cell, for the best of the steps."""
    return np.nanmin(np.abs(by_difference / exact - 1), axis=0)


def gradients() -> None:
    """Compare gradients with references in 50 digits, and with difference quotients."""
    worst = {"forward": 0.0, "reverse": 0.0}
    for row, orbit in reference_orbits():
        point, gamma = jnp.array([float(row[name]) for name in NAMES]), float(row["gamma"])
        for name, slope in (("forward", jax.jacfwd), ("reverse", jax.grad)):
            derivative = jax.jit(slope(lambda x, o=orbit, g=gamma: harvested(o, g, x)))(point)[1]
            worst[name] = max(worst[name], abs(float(derivative) / float(row["dP_dkappa"]) - 1))
    for name, largest in worst.items():
        print_figure(f"gradients: dP/dkappa of four orbits of 50 digits, {name}: largest error", f"{largest:.1e}")
    orbits = random_cells()
    selected = orbits[np.flatnonzero(regular(orbits))[:CELLS]]
    print_figure("gradients: attractors of random cells; regular ones looked at", f"{len(orbits)}; {len(selected)}")
    by_differences(selected)


def conditions(orbit: Orbit) -> tuple[np.ndarray, ...]:
    """Return status, condition number, multiplier and least clearance of every orbit."""
    state = jax.jit(jax.vmap(lambda o: steady(Harvester(), o, pair=o.pair)))(orbit)
    parts = state.status, state.condition, state.multiplier, jnp.stack(state.clearance).min(axis=0)
    return tuple(map(np.asarray, parts))


def regular(orbit: Orbit) -> np.ndarray:
    """Return True for orbits far from every bifurcation."""
    status, condition, multiplier, clearance = conditions(orbit)
    is_conditioned = (condition < MOST_CONDITION) & (multiplier < MOST_MULTIPLIER)
    return (status == Status.OK) & is_conditioned & (clearance > LEAST_CLEARANCE)


def by_differences(orbits: Orbit) -> None:
    """Compare first and second derivatives of every cell with difference quotients."""
    x = np.stack([np.asarray(getattr(orbits.pair, name)) for name in NAMES], axis=1)
    value = partial(jax.jit(jax.vmap(harvested)), orbits, orbits.pair.gamma)
    slope = partial(jax.jit(jax.vmap(jax.grad(harvested, argnums=2))), orbits, orbits.pair.gamma)
    curve = jax.jit(jax.vmap(jax.jacfwd(jax.grad(harvested, argnums=2), argnums=2)))
    exact, exact_second = np.asarray(slope(x)), np.asarray(curve(orbits, orbits.pair.gamma, x))
    for axis, name in enumerate(NAMES):
        compared(f"dP/d{name}", exact[:, axis], differences(value, x, axis), 1e-6)
    second_differences = differences(slope, x, 1)
    compared("d2P/dkappa2", exact_second[:, 1, 1], second_differences[..., 1], 1e-5)
    compared("d2P/dkappa dr", exact_second[:, 2, 1], second_differences[..., 2], 1e-5)


def compared(name: str, exact: np.ndarray, by_difference: np.ndarray, limit: float) -> None:
    """Print the errors of one derivative."""
    errors = error(exact, by_difference)
    value = f"{np.median(errors):.1e}, {errors.max():.1e}; {(errors > limit).sum()}"
    print_figure(f"gradients: {name}: median, largest error against differences; above {limit:.0e}", value)


# --- the reference ----------------------------------------------------------------------------------------


def small_and_fast(d: float = 0.2) -> Harvester:
    """Return the example with an interior optimum beside a cliff."""
    A, omega = 3.0, 10 * math.pi
    return Harvester(s=d * A * (math.pi / omega) ** 2, r=0.5, A=A, omega=omega, V=1700.0)


def speed_mp(d: float, kappa: Any, guess: tuple[float, float, float]) -> Any:
    """Return the speed of a symmetric 1:1 orbit at r = 1/2 in mpmath's precision, from (onset, speed, contact)."""
    half, square = mp.mpf(str(d)) / 2, mp.mpf(kappa) ** 2
    zeta = -mp.mpf(kappa) * mp.log(0.5) / mp.sqrt(mp.pi**2 + mp.log(0.5) ** 2)
    omega1 = mp.sqrt(square - zeta**2)
    gain = 1 / (square - mp.pi**2 + 2 * zeta * mp.pi * 1j)

    def equations(t, v, contact_duration):
        steady_part = lambda s: gain * mp.mpc(mp.cospi(t + s), mp.sinpi(t + s))  # noqa: E731
        begin, rate = -mp.re(steady_part(0)), v - mp.re(1j * mp.pi * steady_part(0))
        cos, sin, decay = (
            mp.cos(omega1 * contact_duration),
            mp.sin(omega1 * contact_duration),
            mp.exp(-zeta * contact_duration),
        )
        other = (rate + zeta * begin) / omega1
        w = decay * (begin * cos + other * sin) + mp.re(steady_part(contact_duration))
        slope = decay * ((other * omega1 - zeta * begin) * cos - (begin * omega1 + zeta * other) * sin)
        out = slope + mp.re(1j * mp.pi * steady_part(contact_duration))
        exit_time, flight_duration = t + contact_duration, 1 - contact_duration
        drift = out - mp.sinpi(exit_time) / mp.pi
        place = (
            half + drift * flight_duration + (mp.cospi(exit_time) - mp.cospi(exit_time + flight_duration)) / mp.pi**2
        )
        return w / contact_duration, place + half, drift + mp.sinpi(exit_time + flight_duration) / mp.pi + v

    return mp.findroot(equations, guess, tol=mp.mpf(10) ** (-2 * mp.mp.dps + 10))[1]


AROUND, STEP = 1e-4, 1e-12  # in kappa: half width of the search for a maximum, and step of the compared speeds


def rise_mp(d: float, near: tuple[float, float, float], kappa: Any) -> Any:
    """Return the slope of the speed in kappa, in mpmath's precision."""
    ahead, behind = (speed_mp(d, kappa + step, near) for step in (STEP, -STEP))
    return (ahead - behind) / (2 * mp.mpf(STEP))


def reference() -> None:
    """Design the small fast device, for P and for speed."""
    settings: dict[str, Any] = {"tune": ("kappa",), "bounds": {"kappa": KAPPA}, "motion": "periodic"}
    best = optimise.optimise(small_and_fast(), **settings).orbits[0]
    print_figure("reference: small fast device, kappa (4.00713)", f"{best.values['kappa']:.5f}")
    print_figure("reference: P, microjoule (57.75761)", f"{1e6 * best.objective_value:.5f}")
    print_figure("reference: penetration, mm (6.026)", f"{1e3 * best.state.depth.max():.4f}")
    print_figure("reference: largest multiplier (0.533)", f"{best.state.multiplier:.4f}")
    for d, kappa, speed in ((0.2, "4.0182", "-"), (0.16, "3.7820", "0.92524")):
        device = small_and_fast(d)
        best = optimise.optimise(device, objective="speed", **settings).orbits[0]
        print_figure(f"reference: speed, d {d}: kappa ({kappa})", f"{best.values['kappa']:.6f}")
        print_figure(
            f"reference: speed, d {d}: in units of A pi/omega ({speed})",
            f"{best.objective_value / float(device.speed_unit):.6f}",
        )
        with mp.workdps(40):
            guess = tuple(
                np.asarray(best.orbit.impact_unknowns)[0, int(np.asarray(best.orbit.sequence.side)[0, 0] < 0)].tolist()
            )
            start = mp.mpf(best.values["kappa"])
            peak = mp.findroot(partial(rise_mp, d, guess), (start - AROUND, start + AROUND), tol=mp.mpf(10) ** -40)
            largest = speed_mp(d, peak, guess)
            losses = [(speed_mp(d, mp.mpf(k), guess) / largest - 1) for k in (kappa, repr(best.values["kappa"]))]
        print_figure(
            f"reference: speed, d {d}: kappa and speed of the maximum, 40 digits",
            f"{mp.nstr(peak, 10)}; {mp.nstr(largest, 10)}",
        )
        print_figure(
            "reference: relative loss of speed at the issue's kappa; at ours",
            f"{mp.nstr(-losses[0], 2)}; {mp.nstr(-losses[1], 2)}",
        )


# --- against a dense scan -----------------------------------------------------------------------------------------

ANYWHERE = {"r": (0.2, 0.9), "A": (1.0, 5.0), "omega": (math.pi, 12 * math.pi)}
SMALL_AND_FAST = {"r": (0.2, 0.9), "A": (2.0, 4.0), "omega": (10 * math.pi, 12 * math.pi)}
STARTS = ((0.0, 0.45), (-0.48, 0.25))  # displacements as fractions of the gap, and velocities; all pairs
ENOUGH = 0.999  # of the scan's best
FREE = 0.99  # fraction of a constraint; a scan's best point below it for both constraints counts as unconstrained


class Best(NamedTuple):
    """Best admissible point of a device's scan."""

    P: float
    kappa: float
    period: int
    impacts: str
    free: bool  # clear of both constraints


def drawn(draw: np.random.Generator, within: dict, count: int) -> list[Harvester]:
    """Draw random devices: Tables I and II with random gap, r, A and omega."""
    devices = []
    for _ in range(count):
        d = math.exp(draw.uniform(*np.log(GAPS)))
        x = {name: draw.uniform(*ends) for name, ends in within.items()}
        devices.append(Harvester(s=d * x["A"] * (math.pi / x["omega"]) ** 2, **x))
    return devices


def gap(device: Harvester) -> float:
    """Return d."""
    return float(device.pair().d)


def scanned(device: Harvester, points: int) -> Best | None:
    """Scan by the exact engine from several starts at each of many kappa; return None if nothing is admissible."""
    d, (parts, speeds) = float(device.pair().d), STARTS
    dataset = vijax.sweep(
        kappa=np.geomspace(*KAPPA, points),
        u0=d * np.array(parts),
        v0=np.array(speeds),
        device=device,
        outputs=("P", "admissible", "period", "impacts_left", "impacts_right", "max_penetration", "energy_ratio"),
    )
    P = dataset["P"].where(dataset["admissible"] & (dataset["status"] == 0))
    if not bool((P > 0).any()):
        return None
    best = dataset.isel(P.argmax(...))
    left, right, period = (int(best[name]) for name in ("impacts_left", "impacts_right", "period"))
    used = max(float(best["max_penetration"]) / float(np.asarray(device.depth_limit)), float(best["energy_ratio"]))
    return Best(float(best["P"]), float(best["kappa"]), period, f"{left}:{right}/{period}T", used < FREE)


class Case(NamedTuple):
    """A device, the best of its scan, and its design."""

    device: Harvester
    best: Best
    design: Design


def cases(draw: np.random.Generator, within: dict, count: int, points: int, free: bool) -> tuple[list[Case], int]:
    """Draw devices with a periodic best admissible point in the scan, and count the rejected ones.

    Args:
        free: Whether that point must also be clear of the constraints.
    """
    devices: list[Harvester] = []
    bests: list[Best] = []
    rejected = 0
    while len(devices) < count:
        (device,) = drawn(draw, within, 1)
        best = scanned(device, points)
        if best is None or best.period < 1 or (free and not best.free):
            rejected += 1
            continue
        devices.append(device)
        bests.append(best)
    designs = (
        optimise.optimise_all(devices, tune=("kappa",), bounds={"kappa": KAPPA}, motion="periodic") if devices else []
    )
    return [Case(*case) for case in zip(devices, bests, designs, strict=True)], rejected


def interior(case: Case) -> bool:
    """Return True if the objective alone determines the optimum."""
    best = next(iter(case.design.orbits), None)
    return best is not None and not best.active and best.stopped == "maximum"


def ratio(case: Case) -> float:
    """Return the ratio of the optimum to the scan's best."""
    return 0.0 if not case.design.orbits else case.design.orbits[0].objective_value / case.best.P


def excess(optimum: Optimum) -> float:
    """Return the relative violation of the constraints by the worst impact, by the exact impact map."""
    device, orbit = optimum.device, optimum.orbit
    deep: Any = np.asarray(orbit.depth) * float(device.length_unit)
    transferred = np.asarray(orbit.work) * float(device.m_b * device.speed_unit**2)
    harvested = np.asarray(harvested_energy(device, deep))
    return float(max(np.nanmax(deep) / float(np.asarray(device.depth_limit)), np.nanmax(harvested / transferred)) - 1)


def scan(devices: int, points: int) -> None:
    """Design random devices, then small fast ones until half of the scans' best points are clear of the constraints."""
    draw = np.random.default_rng(SEED)
    case_list, rejected = cases(draw, ANYWHERE, devices, points, free=False)
    print_figure(
        "scan: devices from the whole box; left out, their best being aperiodic", f"{len(case_list)}; {rejected}"
    )
    missing = len(case_list) - 2 * sum(case.best.free for case in case_list)
    if missing > 0:
        more, others = cases(draw, SMALL_AND_FAST, missing, points, free=True)
        case_list += more
        print_figure(
            "scan: small and fast devices added, to have half of them interior; left out", f"{len(more)}; {others}"
        )
    report(case_list)


def report(case_list: list[Case]) -> None:
    """Print the figures of the designs, and every miss."""
    ratios = np.array([ratio(case) for case in case_list])
    bests = [case.design.orbits[0] for case in case_list if case.design.orbits]
    kinds = Counter("interior" if not optimum.active else optimum.active[0].split(" at")[0] for optimum in bests)
    print_figure(
        "scan: best points of the scans clear of constraints",
        f"{sum(case.best.free for case in case_list)} of {len(case_list)}",
    )
    print_figure("scan: interior optima of all", f"{sum(map(interior, case_list))} of {len(case_list)}")
    print_figure("scan: what holds the optima", ", ".join(f"{kind} {count}" for kind, count in kinds.most_common()))
    print_figure(
        "scan: why the ascents stopped",
        ", ".join(f"{k} {n}" for k, n in Counter(optimum.stopped for optimum in bests).items()),
    )
    print_figure("scan: largest excess over a constraint, relative", f"{max(map(excess, bests)):.1e}")
    print_figure(
        "scan: most evaluations of a start that won; median",
        f"{max(b.evaluations for b in bests)}; {np.median([b.evaluations for b in bests]):.0f}",
    )
    d = np.array([gap(case.device) for case in case_list])
    for group, selected in (("", d > 0), (f" of d above {WIDE:g}", d > WIDE)):
        print_figure(
            f"scan: optimum{group} over the scan's best: devices; least, median, largest",
            f"{selected.sum()}; " + ", ".join(f"{f(ratios[selected]):.5f}" for f in (np.min, np.median, np.max)),
        )
    misses = [case for case in case_list if ratio(case) < ENOUGH]
    print_figure(f"scan: misses, below {ENOUGH}", f"{len(misses)} of {len(case_list)}")
    for case in sorted(misses, key=ratio):
        pair, best = case.device.pair(), case.design.best
        device_text = f"d {float(pair.d):.6f} r {case.device.r:.6f} A {case.device.A:.6f} omega {case.device.omega:.6f}"
        scan_text = f"scan {case.best.P:.5e} at kappa {case.best.kappa:.5f}, {case.best.impacts}"
        design_text = (
            "none"
            if best is None
            else f"{best.objective_value:.5e} at {best.values['kappa']:.5f}, {best.label}, {best.stopped}"
        )
        print(f"    {ratio(case):.5f}  {device_text}; {scan_text}; design {design_text}", flush=True)


# --- the clock ----------------------------------------------------------------------------------------------------

RUNS = 5
AWAY = 1.01  # factor of kappa: Newton's method starts from the orbit of a neighbour


def speed(designs: int) -> None:
    """Measure the seconds of many designs, and the relative cost of a gradient."""
    devices = drawn(np.random.default_rng(SEED), ANYWHERE, designs)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        results = optimise.optimise_all(devices, motion="periodic")
        seconds.append(time.perf_counter() - start)
    starts = sum(result.ascents for result in results)
    for group, selected in (
        (f"below {NARROW:g}", [result for result in devices if gap(result) < NARROW]),
        (f"above {WIDE:g}", [result for result in devices if gap(result) > WIDE]),
    ):
        start = time.perf_counter()
        optimise.optimise_all(selected, motion="periodic")
        duration = time.perf_counter() - start
        print_figure(f"speed: d {group}: devices; seconds a device", f"{len(selected)}; {duration / len(selected):.3f}")
    evaluations = [optimum.evaluations for result in results for optimum in result.orbits]
    print_figure("speed: parameters; starts", f"{len(devices)}; {starts}")
    print_figure("speed: seconds, first (with compilation or its cache); again", f"{seconds[0]:.1f}; {seconds[1]:.1f}")
    print_figure(
        "speed: seconds a 1,000 parameters; a 1,000 starts",
        f"{1e3 * seconds[1] / designs:.1f}; {1e3 * seconds[1] / starts:.1f}",
    )
    print_figure(
        "speed: evaluations of the starts that became optima: median, most",
        f"{np.median(evaluations):.0f}, {max(evaluations)}",
    )
    row = random_cells()
    row = row[np.flatnonzero(np.asarray(row.count) <= 2)]
    row = jax.tree.map(lambda leaf: leaf[:, :2] if leaf.ndim > 1 and leaf.shape[1] > 2 else leaf, row)
    x = jnp.stack([row.pair.d, AWAY * row.pair.kappa, row.pair.r], axis=1)
    plain = median_seconds(jax.jit(jax.vmap(harvested)), row, row.pair.gamma, x)
    print_figure(
        "speed: microseconds of P alone, from a neighbour's orbit", f"{1e6 * plain / len(row):.2f} ({len(row)} orbits)"
    )
    unit = jnp.array([0.0, 1.0, 0.0])
    with_derivative = lambda o, g, x: jax.jvp(lambda x: harvested(o, g, x), (x,), (unit,))  # noqa: E731
    for name, work in (
        ("dP/dkappa, forward", with_derivative),
        ("dP/d(d, kappa, r), reverse", jax.value_and_grad(harvested, argnums=2)),
    ):
        both = median_seconds(jax.jit(jax.vmap(work)), row, row.pair.gamma, x)
        print_figure(f"speed: P with {name}, over P alone", f"{both / plain:.2f}")


def median_seconds(work: Callable[..., Any], *args: Any) -> float:
    """Measure the median seconds of several runs after compilation."""
    jax.block_until_ready(work(*args))
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        jax.block_until_ready(work(*args))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


# --- cliffs -------------------------------------------------------------------------------------------------------

FOLDS = ((3.685, 3.70), (3.69, 3.72), (3.60, 3.695), (3.5, 4.5))
GRAZES = 1e-3  # clearance of an orbit near grazing
BOUND_WIDTH = 0.02  # relative half width of kappa's bounds


def cliffs() -> None:
    """Design in small ranges about the fold at kappa 3.69 and about grazing."""
    for low, high in FOLDS:
        result = optimise.optimise(small_and_fast(), tune=("kappa",), bounds={"kappa": (low, high)}, motion="periodic")
        print_optima(f"cliffs: small fast device, kappa {low} to {high}", [result])
        for best in result.orbits:
            print(
                f"    {best.values['kappa']:.6f} {1e6 * best.objective_value:.5f} "
                f"{best.label} {best.stopped} {best.active}",
                flush=True,
            )
    orbits = random_cells()
    *_, clearance = conditions(orbits)
    d, kappa, r, gamma = (np.asarray(x) for x in jax.tree.leaves(orbits.pair))
    designs = []
    for i in np.flatnonzero((clearance < GRAZES) & (gamma == 0)):
        bounds = {"kappa": (kappa[i] * (1 - BOUND_WIDTH), kappa[i] * (1 + BOUND_WIDTH))}
        designs.append(optimise.optimise(Harvester(s=d[i], r=r[i]), tune=("kappa",), bounds=bounds, motion="periodic"))
    print_optima(f"cliffs: beside {len(designs)} orbits that nearly graze", designs)


def print_optima(title: str, designs: list[Design]) -> None:
    """Print the number of optima, and the number of invalid ones among them."""
    optima = [optimum for result in designs for optimum in result.orbits]
    numbers = [
        np.array(
            [*optimum.values.values(), optimum.objective_value, *optimum.gradient.values(), *optimum.path_objective]
        )
        for optimum in optima
    ]
    nans = sum(not np.isfinite(x).all() for x in numbers)
    lost = sum(int(optimum.orbit.status[0]) != Status.OK or not optimum.state.multiplier < 1 for optimum in optima)
    print_figure(f"{title}: optima; with a NaN; with no attracting orbit", f"{len(optima)}; {nans}; {lost}")


def main() -> int:
    """Print the figures."""
    parts = {part.__name__: part for part in (gradients, reference, scan, speed, cliffs)}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=list(parts), help="one part")
    parser.add_argument("--devices", type=int, default=200, help="of the scan")
    parser.add_argument("--points", type=int, default=10_000, help="kappa of each device's scan")
    parser.add_argument("--designs", type=int, default=124, help="devices that are timed; 124 have some 1,500 starts")
    arguments = parser.parse_args()
    options = {"scan": (arguments.devices, arguments.points), "speed": (arguments.designs,)}
    for name, part in parts.items():
        if arguments.only in (None, name):
            part(*options.get(name, ()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
