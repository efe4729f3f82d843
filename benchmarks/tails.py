"""How wrong is each method on the worst hundredth of a plane, how often does it give another label, and at what cost?

    python benchmarks/tails.py           # both tables: rows/tails.csv, rows/labels.csv
    python benchmarks/tails.py --quick   # few cells, few methods, timings that mean nothing: does it run?

Errors: the default plane (d 0.05 to 0.3, kappa 3 to 400, r 0.5) on an even grid of 1,024 cells, from one start; the
error is that of (u, v) after three periods, against 50-digit arithmetic, so early that chaos has not made one of any
rounding. What a method costs is measured warm on the same plane, in microseconds of core time per cell-period, which
another load on the machine hardly changes. A cell that is off by more than 0.1 had another motion. The row of one
rounding says what float64 leaves: how far the true state moves when d, kappa and the start are rounded.

Labels: the 112 periodic reference cells with a single attractor, from their starts, 400 periods; the label is wrong
where period or impacts differ from those of the reference. The cost there is in microseconds of core time a cell.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vijax
from benchmarks import failures, peers, speed, tables, yardstick
from benchmarks.work_precision import SOLVERS, deviation, tolerances
from vijax.batch import simulate
from vijax.engine.method_choice import choose

R, U0, V0 = speed.R, speed.U0, speed.V0
PERIODS = 3
ROOM = 256  # impacts
SIDE, QUICK_SIDE = 32, 6  # cells of the grid along an axis
NUDGE = 1e-9  # relative, of what is rounded: small against the errors, large against rounding
OTHER = 0.1  # a cell further off than this had another motion
SHARE = 0.99  # of the cells, for the worst of which a method is judged

# Cells along an axis, of a timing.
TIMED = {"exact": 128, "exact float32": 128, "numba": 64, "diffrax": 8}
TIMED_ELSE = 45
LEAST_SECONDS, MOST_PERIODS = 0.2, 64  # of a timing


class Row(NamedTuple):
    """Errors of one method with one setting."""

    method: str
    setting: str
    us: float  # of core time per cell-period, warm; NaN for what is no method
    cells: int
    lost: int  # cells without a number
    other: int  # cells with another motion, those among them
    median: float
    most: float  # the error that `SHARE` of the cells keep
    worst: float


class LabelRow(NamedTuple):
    """Labels by one method with one setting."""

    method: str
    setting: str
    us: float  # of core time a cell, warm
    cells: int
    wrong: int
    undecided: int


States = tuple[np.ndarray, np.ndarray]


class Contender(NamedTuple):
    """A method with a setting: its answer on cells (d, kappa), and a run of so many periods of so many cells a side."""

    method: str
    setting: str
    answer: Callable[[np.ndarray, np.ndarray], States]
    timed: Callable[[int, int], Any]


# --- truth ------------------------------------------------------------------------------------------------------------


def truth(d: np.ndarray, kappa: np.ndarray) -> States:
    """Compute the states after `PERIODS` in 50 digits, each event from the exact engine's as a guess."""
    # One period more, so that the last contact before the end is finished and its events are known.
    run = vijax.trajectory(vijax.impact_pair(d, kappa, R), U0, V0, PERIODS + 1, max_impacts=ROOM)
    impacts = jax.tree.map(np.asarray, run.impacts)
    onsets = impacts.t + 2 * impacts.n
    found = []
    for cell in range(d.size):
        met = (impacts.side[cell] != 0) & (onsets[cell] < 2 * PERIODS)
        onset, stay = onsets[cell, met], impacts.duration[cell, met]
        flights = np.diff(onset, prepend=0) - np.append(0, stay[:-1])[: onset.size]
        guesses = [(flight, s, 0.5 * s) for flight, s in zip(flights, stay, strict=True)]
        with mp.workdps(yardstick.DIGITS):
            found.append(_state_50(float(d[cell]), float(kappa[cell]), guesses))
    u, v = np.array(found, dtype=float).T
    return u, v


def _state_50(d: float, kappa: float, guesses: list[Any]) -> tuple[Any, Any]:
    end = 2 * PERIODS
    if not guesses:
        rise, v = yardstick.mp_flight(mp.mpf(0), mp.mpf(0), mp.mpf(V0), end)
        return U0 + rise, v
    rows, _ = yardstick.mp_march([d, kappa, R, 0.0, U0, V0], len(guesses), guesses)
    last, half = rows[-1], mp.mpf(d) / 2
    if last.t + last.duration > end:
        inside = end - last.t
        w, z, _ = yardstick.mp_contact(mp.mpf(kappa), mp.mpf(R), 0, last.side, last.t, last.side * last.v_in, inside)
        return last.side * (half + w), last.side * z
    left = last.t + last.duration
    rise, v = yardstick.mp_flight(mp.mpf(0), left, last.v_out, end - left)
    return last.side * half + rise, v


def one_rounding(d: np.ndarray, kappa: np.ndarray, true: States) -> np.ndarray:
    """Find how far the true states move when d, kappa and v0 are rounded, and the states themselves."""
    moved = [
        deviation(exact(d * (1 + NUDGE), kappa), true),
        deviation(exact(d, kappa * (1 + NUDGE)), true),
        deviation(exact(d, kappa, V0 * (1 + NUDGE)), true),
        NUDGE * np.hypot(*true),
    ]
    return np.finfo(float).eps / 2 / NUDGE * np.sqrt(np.sum(np.square(moved), axis=0))


# --- the contenders ---------------------------------------------------------------------------------------------------


def exact(d: np.ndarray, kappa: np.ndarray, v0: float = V0, dtype: str = "float64", **options: Any) -> States:
    """Run by `vijax.trajectory`."""
    pair = vijax.ImpactPair(*(jnp.asarray(np.broadcast_to(x, d.shape), dtype) for x in (d, kappa, R, 0.0)))
    states = vijax.trajectory(pair, U0, v0, PERIODS, max_impacts=ROOM, **options).states
    return np.asarray(states.u)[:, -1], np.asarray(states.v)[:, -1]


def sweep(side: int, periods: int, **options: Any) -> Any:
    """Run a window of the plane by `vijax.sweep`."""
    d, kappa = speed.axes(side)
    told: dict[str, Any] = {"until": "window", "periods": periods, "outputs": ("impacts_per_period",)} | options
    return vijax.sweep(d=d, kappa=kappa, r=R, u0=U0, v0=V0, **told)


def theirs(solve: Callable[..., Any], side: int, periods: int, **told: Any) -> Any:
    """Run a peer on the plane."""
    return solve(*speed.cells(side), periods=periods, **told)


def fixed(d: np.ndarray, kappa: np.ndarray, periods: int = PERIODS, *, steps: int) -> States:
    """Run the peer without events."""
    _, u, v = peers.rk4(d, kappa, R, U0, V0, periods, steps)
    return u, v


def located(solve: Callable[..., Any], d: np.ndarray, kappa: np.ndarray, periods: int = PERIODS, **told: Any) -> States:
    """Run a peer with events."""
    u, v = solve(d, kappa, R, 0.0, U0, V0, periods, **told)
    return u, v


def contenders() -> Iterator[Contender]:
    """Yield vijax by all its methods, then the peers."""
    for name, dtype in (("exact", "float64"), ("exact float32", "float32")):
        yield Contender(name, dtype, partial(exact, dtype=dtype), partial(sweep, dtype=dtype))
    for solver, exponents in SOLVERS.items():
        for setting, numbers in tolerances(*exponents):
            told: dict[str, Any] = {"method": "ode", "solver": solver} | numbers
            yield Contender(f"ode {solver}", setting, partial(exact, **told), partial(sweep, **told))
    for steps in (250, 1000, 4000):
        told = {"method": "rk4", "steps": steps}
        yield Contender("rk4", f"{steps}", partial(exact, **told), partial(sweep, **told))
    for steps in (250, 1000, 4000, 16000, 64000):
        run = partial(fixed, steps=steps)
        yield Contender("numba RK4", f"{steps}", run, partial(theirs, run))
    for setting, numbers in tolerances(4, 6, 8, 10, 12):
        run = partial(located, peers.dormand_prince, rtol=numbers["rtol"])
        yield Contender("numba DP5 + events", setting, run, partial(theirs, run))
    for setting, numbers in tolerances(6, 8, 10):
        run = partial(located, peers.diffrax_chain, rtol=numbers["rtol"])
        yield Contender("diffrax restarts", setting, run, partial(theirs, run))


QUICK = {"exact": "float64", "ode Tsit5": "1e-6", "numba RK4": "1000", "numba DP5 + events": "1e-8"}


# --- measuring --------------------------------------------------------------------------------------------------------


def errors(quick: bool) -> Iterator[Row]:
    """Measure the errors of every contender, and what one rounding does."""
    d, kappa = speed.cells(QUICK_SIDE if quick else SIDE)
    true = truth(d, kappa)
    yield row("one rounding", "", math.nan, one_rounding(d, kappa, true))
    for one in contenders():
        if quick and QUICK.get(one.method) != one.setting:
            continue
        begun = time.process_time()
        error = deviation(one.answer(d, kappa), true)
        us = 1e6 * (time.process_time() - begun) / (d.size * PERIODS)
        if not quick:
            side = next((count for name, count in TIMED.items() if one.method.startswith(name)), TIMED_ELSE)
            us = pace(partial(one.timed, side), side * side)
        yield row(one.method, one.setting, us, error)


def pace(run: Callable[[int], Any], cells: int) -> float:
    """Find the microseconds of core time per cell-period of a warm call that is long enough to be timed."""
    periods = 1
    run(periods)  # compiles
    while (seconds := core_seconds(partial(run, periods))) < LEAST_SECONDS and periods < MOST_PERIODS:
        periods *= 4
    return 1e6 * min(seconds, core_seconds(partial(run, periods))) / (cells * periods)


def core_seconds(call: Callable[[], Any]) -> float:
    """Time a call by what it takes of all cores."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def row(method: str, setting: str, us: float, error: np.ndarray) -> Row:
    """Sum errors up."""
    lost, other = np.isinf(error).sum(), (error > OTHER).sum()
    median, most = np.quantile(error, [0.5, SHARE], method="higher")
    return Row(method, setting, us, error.size, int(lost), int(other), float(median), float(most), float(error.max()))


def labels(quick: bool) -> Iterator[LabelRow]:
    """Count wrong labels of reference cells."""
    cells = failures.reference_cells(failures.LANES if quick else None)
    truly = np.stack([cells[name] for name in ("p", "left", "right")])
    for name, setting, options in () if quick else of_labels():
        found, us = attractors(cells, **options)
        undecided = found[0] < 0
        mirrored = found[[0, 2, 1]]
        right = (found == truly).all(axis=0) | (mirrored == truly).all(axis=0)
        yield LabelRow(name, setting, us, truly.shape[1], int((~right & ~undecided).sum()), int(undecided.sum()))
    for steps in (1000,) if quick else (250, 1000, 4000, 16000):
        yield sampled(cells, steps)


def of_labels() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield vijax by its methods: names, settings, options."""
    yield "exact", "float64", {}
    yield "exact float32", "float32", {"dtype": "float32"}
    for setting, numbers in tolerances(4, 6, 8):
        yield "ode Tsit5", setting, {"method": "ode", "solver": "Tsit5"} | numbers
    for steps in (250, 1000):
        yield "rk4", f"{steps}", {"method": "rk4", "steps": steps}


def attractors(cells: dict[str, np.ndarray], dtype: str = "float64", **options: Any) -> tuple[np.ndarray, float]:
    """Find period and impacts on either wall of each cell by vijax, and the microseconds that a cell takes."""
    method = None
    if options:
        method = choose(options.pop("method"), options, dtype=dtype)
    count = cells["d"].size
    given = (cells["d"], cells["kappa"], R, 0.0, 1.0, failures.U0, failures.V0)
    d, kappa, r, gamma, one, u0, v0 = (jnp.asarray(np.broadcast_to(x, count), dtype) for x in given)
    pair = vijax.ImpactPair(d=d, kappa=kappa, r=r, gamma=gamma)
    scale = simulate.Scale(one, one, one[:1], one[:1])
    wanted = frozenset({"period", "impacts_left", "impacts_right"})
    run = partial(simulate.summarise, pair, u0, v0, scale, vijax.Harvester(), outputs=wanted, method=method)
    found = run()
    us = 1e6 * core_seconds(run) / count
    return np.stack([np.asarray(x).reshape(count) for x in (found.period, found.impacts_left, found.impacts_right)]), us


def sampled(cells: dict[str, np.ndarray], steps: int) -> LabelRow:
    """Count impacts of each cell's period by RK4 without events; undecided are those that do not recur to 1e-4 then."""
    d, kappa, period = cells["d"], cells["kappa"], cells["p"]
    run = partial(peers.rk4, d, kappa, R, failures.U0, failures.V0, failures.PERIODS, steps)
    before = run()
    us = 1e6 * core_seconds(run) / d.size
    recurs, counted = np.zeros(d.size, bool), np.zeros(d.size)
    for p in np.unique(period):
        here = period == p
        after = peers.rk4(d[here], kappa[here], R, failures.U0, failures.V0, failures.PERIODS + int(p), steps)
        recurs[here] = np.hypot(after[1] - before[1][here], after[2] - before[2][here]) < 1e-4
        counted[here] = after[0] * (failures.PERIODS + p) - before[0][here] * failures.PERIODS
    wrong = np.rint(counted) != cells["left"] + cells["right"]
    return LabelRow("numba RK4", f"{steps}", us, d.size, int(wrong.sum()), int((~recurs & ~wrong).sum()))


def told(rows: Iterator[Any]) -> Iterator[Any]:
    """Print rows as they come."""
    for one in rows:
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in one), flush=True)
        yield one


def main() -> int:
    """Measure, print, keep the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few cells and methods: does it run?")
    parser.add_argument("--only", choices=["tails", "labels"], help="one of the tables")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the rows")
    given = parser.parse_args()
    part = "_quick" if given.quick else ""
    print(tables.made_by())
    for name, kind, measure in (("tails", Row, errors), ("labels", LabelRow, labels)):
        if given.only in (None, name):
            tables.write(given.rows / f"{name}{part}.csv", kind._fields, told(measure(given.quick)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
