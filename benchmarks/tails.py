"""How large are each method's errors on the worst hundredth of a plane, how many labels are wrong, and at what cost?

    python benchmarks/tails.py           # both tables: rows/tails.csv, rows/labels.csv
    python benchmarks/tails.py --quick   # few cells, few methods, timings that mean nothing: does it run?

Errors: the default plane (d 0.05 to 0.3, kappa 3 to 400, r 0.5) on an even grid of 1,024 cells, from one start. The
error is the error of (u, v) after three periods, against 50-digit arithmetic, before chaos has amplified rounding to
order one. The cost is measured warm on the same plane, in microseconds of core time per cell-period, which other loads
on the machine hardly change. An error above 0.1 means another motion. The row "one rounding" is the limit of float64:
the distance of the exact state when d, kappa and the start are rounded.

Labels: the 112 periodic reference cells with a single attractor, their starts, 400 periods; a label is wrong if its
period or impacts differ from the reference. The cost is in microseconds of core time a cell.
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
from vijax.impact.method_choice import choose_method
from vijax.simulation import simulate

R, U0, V0 = speed.R, speed.U0, speed.V0
PERIODS = 3
CAPACITY = 256  # impacts
SIDE, QUICK_SIDE = 32, 6  # cells of the grid along an axis
NUDGE = 1e-9  # relative change that represents a rounding: small against the errors, large against rounding itself
OTHER = 0.1  # error above which a cell has another motion
SHARE = 0.99  # fraction of the cells below the reported error

# Cells along an axis for a timing.
TIMED = {"exact": 128, "exact float32": 128, "numba": 64, "diffrax": 8}
TIMED_ELSE = 45
LEAST_SECONDS, MOST_PERIODS = 0.2, 64  # of a timing


class Row(NamedTuple):
    """Errors of one method with one setting."""

    method: str
    setting: str
    us: float  # of core time per cell-period, warm; NaN for the row of one rounding
    cells: int
    lost: int  # cells without a number
    other: int  # cells with another motion, including the lost ones
    median: float
    quantile: float  # the error below which `SHARE` of the cells lie
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
    """A method with a setting: its result on cells (d, kappa), and a run of some periods and cells a side."""

    method: str
    setting: str
    answer: Callable[[np.ndarray, np.ndarray], States]
    timed: Callable[[int, int], Any]


# --- truth ------------------------------------------------------------------------------------------------------------


def truth(d: np.ndarray, kappa: np.ndarray) -> States:
    """Compute the states after `PERIODS` in 50 digits; the exact engine's events are the guesses."""
    # One period more, so that the last contact before the end is complete and its events are known.
    run = vijax.trajectory(vijax.impact_pair(d, kappa, R), U0, V0, PERIODS + 1, max_impacts=CAPACITY)
    impacts = jax.tree.map(np.asarray, run.impacts)
    onsets = impacts.t + 2 * impacts.n
    states = []
    for cell in range(d.size):
        is_impact = (impacts.side[cell] != 0) & (onsets[cell] < 2 * PERIODS)
        onset, contact_durations = onsets[cell, is_impact], impacts.duration[cell, is_impact]
        flights = np.diff(onset, prepend=0) - np.append(0, contact_durations[:-1])[: onset.size]
        guesses = [(flight, s, 0.5 * s) for flight, s in zip(flights, contact_durations, strict=True)]
        with mp.workdps(yardstick.DIGITS):
            states.append(_state_50(float(d[cell]), float(kappa[cell]), guesses))
    u, v = np.array(states, dtype=float).T
    return u, v


def _state_50(d: float, kappa: float, guesses: list[Any]) -> tuple[Any, Any]:
    end = 2 * PERIODS
    if not guesses:
        displacement, v = yardstick.mp_flight(mp.mpf(0), mp.mpf(0), mp.mpf(V0), end)
        return U0 + displacement, v
    rows, _ = yardstick.mp_march([d, kappa, R, 0.0, U0, V0], len(guesses), guesses)
    last, half = rows[-1], mp.mpf(d) / 2
    if last.t + last.duration > end:
        inside = end - last.t
        w, z, _ = yardstick.mp_contact(mp.mpf(kappa), mp.mpf(R), 0, last.side, last.t, last.side * last.v_in, inside)
        return last.side * (half + w), last.side * z
    exit_time = last.t + last.duration
    displacement, v = yardstick.mp_flight(mp.mpf(0), exit_time, last.v_out, end - exit_time)
    return last.side * half + displacement, v


def rounding_error(d: np.ndarray, kappa: np.ndarray, exact_states: States) -> np.ndarray:
    """Return the distance of the exact states when d, kappa, v0 and the states themselves are rounded."""
    moved = [
        deviation(exact(d * (1 + NUDGE), kappa), exact_states),
        deviation(exact(d, kappa * (1 + NUDGE)), exact_states),
        deviation(exact(d, kappa, V0 * (1 + NUDGE)), exact_states),
        NUDGE * np.hypot(*exact_states),
    ]
    return np.finfo(float).eps / 2 / NUDGE * np.sqrt(np.sum(np.square(moved), axis=0))


# --- the contenders ---------------------------------------------------------------------------------------------------


def exact(d: np.ndarray, kappa: np.ndarray, v0: float = V0, dtype: str = "float64", **options: Any) -> States:
    """Run by `vijax.trajectory`."""
    pair = vijax.ImpactPair(*(jnp.asarray(np.broadcast_to(x, d.shape), dtype) for x in (d, kappa, R, 0.0)))
    states = vijax.trajectory(pair, U0, v0, PERIODS, max_impacts=CAPACITY, **options).states
    return np.asarray(states.u)[:, -1], np.asarray(states.v)[:, -1]


def sweep(side: int, periods: int, **options: Any) -> Any:
    """Run a window of the plane by `vijax.sweep`."""
    d, kappa = speed.axes(side)
    settings: dict[str, Any] = {"until": "window", "periods": periods, "outputs": ("impacts_per_period",)} | options
    return vijax.sweep(d=d, kappa=kappa, r=R, u0=U0, v0=V0, **settings)


def peer_on_plane(solve: Callable[..., Any], side: int, periods: int, **options: Any) -> Any:
    """Run a peer on the plane."""
    return solve(*speed.cells(side), periods=periods, **options)


def fixed(d: np.ndarray, kappa: np.ndarray, periods: int = PERIODS, *, steps: int) -> States:
    """Run the peer without events."""
    _, u, v = peers.rk4(d, kappa, R, U0, V0, periods, steps)
    return u, v


def located(
    solve: Callable[..., Any], d: np.ndarray, kappa: np.ndarray, periods: int = PERIODS, **options: Any
) -> States:
    """Run a peer with events."""
    u, v = solve(d, kappa, R, 0.0, U0, V0, periods, **options)
    return u, v


def contenders() -> Iterator[Contender]:
    """Yield vijax by all its methods, then the peers."""
    for name, dtype in (("exact", "float64"), ("exact float32", "float32")):
        yield Contender(name, dtype, partial(exact, dtype=dtype), partial(sweep, dtype=dtype))
    for solver, exponents in SOLVERS.items():
        for setting, numbers in tolerances(*exponents):
            options: dict[str, Any] = {"method": "ode", "solver": solver} | numbers
            yield Contender(f"ode {solver}", setting, partial(exact, **options), partial(sweep, **options))
    for steps in (250, 1000, 4000):
        options = {"method": "rk4", "steps": steps}
        yield Contender("rk4", f"{steps}", partial(exact, **options), partial(sweep, **options))
    for steps in (250, 1000, 4000, 16000, 64000):
        run = partial(fixed, steps=steps)
        yield Contender("numba RK4", f"{steps}", run, partial(peer_on_plane, run))
    for setting, numbers in tolerances(4, 6, 8, 10, 12):
        run = partial(located, peers.dormand_prince, rtol=numbers["rtol"])
        yield Contender("numba DP5 + events", setting, run, partial(peer_on_plane, run))
    for setting, numbers in tolerances(6, 8, 10):
        run = partial(located, peers.diffrax_chain, rtol=numbers["rtol"])
        yield Contender("diffrax restarts", setting, run, partial(peer_on_plane, run))


QUICK = {"exact": "float64", "ode Tsit5": "1e-6", "numba RK4": "1000", "numba DP5 + events": "1e-8"}


# --- measuring --------------------------------------------------------------------------------------------------------


def errors(quick: bool) -> Iterator[Row]:
    """Measure the errors of every contender, and the effect of one rounding."""
    d, kappa = speed.cells(QUICK_SIDE if quick else SIDE)
    exact_states = truth(d, kappa)
    yield row("one rounding", "", math.nan, rounding_error(d, kappa, exact_states))
    for contender in contenders():
        if quick and QUICK.get(contender.method) != contender.setting:
            continue
        start = time.process_time()
        error = deviation(contender.answer(d, kappa), exact_states)
        us = 1e6 * (time.process_time() - start) / (d.size * PERIODS)
        if not quick:
            side = next((count for name, count in TIMED.items() if contender.method.startswith(name)), TIMED_ELSE)
            us = core_time(partial(contender.timed, side), side * side)
        yield row(contender.method, contender.setting, us, error)


def core_time(run: Callable[[int], Any], cells: int) -> float:
    """Return the microseconds of core time per cell-period of a warm call that is long enough to be timed."""
    periods = 1
    run(periods)  # compiles
    while (seconds := core_seconds(partial(run, periods))) < LEAST_SECONDS and periods < MOST_PERIODS:
        periods *= 4
    return 1e6 * min(seconds, core_seconds(partial(run, periods))) / (cells * periods)


def core_seconds(call: Callable[[], Any]) -> float:
    """Return the processor seconds of a call on all cores."""
    start = time.process_time()
    call()
    return time.process_time() - start


def row(method: str, setting: str, us: float, error: np.ndarray) -> Row:
    """Summarise errors in a row."""
    lost, other = np.isinf(error).sum(), (error > OTHER).sum()
    median, quantile = np.quantile(error, [0.5, SHARE], method="higher")
    return Row(
        method, setting, us, error.size, int(lost), int(other), float(median), float(quantile), float(error.max())
    )


def labels(quick: bool) -> Iterator[LabelRow]:
    """Count wrong labels of reference cells."""
    cells = failures.reference_cells(failures.LANES if quick else None)
    reference = np.stack([cells[name] for name in ("p", "left", "right")])
    for name, setting, options in () if quick else of_labels():
        computed, us = attractors(cells, **options)
        undecided = computed[0] < 0
        mirrored = computed[[0, 2, 1]]
        is_right = (computed == reference).all(axis=0) | (mirrored == reference).all(axis=0)
        yield LabelRow(name, setting, us, reference.shape[1], int((~is_right & ~undecided).sum()), int(undecided.sum()))
    for steps in (1000,) if quick else (250, 1000, 4000, 16000):
        yield sampled(cells, steps)


def of_labels() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the methods of vijax: names, settings, options."""
    yield "exact", "float64", {}
    yield "exact float32", "float32", {"dtype": "float32"}
    for setting, numbers in tolerances(4, 6, 8):
        yield "ode Tsit5", setting, {"method": "ode", "solver": "Tsit5"} | numbers
    for steps in (250, 1000):
        yield "rk4", f"{steps}", {"method": "rk4", "steps": steps}


def attractors(cells: dict[str, np.ndarray], dtype: str = "float64", **options: Any) -> tuple[np.ndarray, float]:
    """Return period and impacts on each wall of every cell by vijax, and the microseconds per cell."""
    method = None
    if options:
        method = choose_method(options.pop("method"), options, dtype=dtype)
    count = cells["d"].size
    values = (cells["d"], cells["kappa"], R, 0.0, 1.0, failures.U0, failures.V0)
    d, kappa, r, gamma, unit, u0, v0 = (jnp.asarray(np.broadcast_to(x, count), dtype) for x in values)
    pair = vijax.ImpactPair(d=d, kappa=kappa, r=r, gamma=gamma)
    scale = simulate.Scale(unit, unit, unit[:1], unit[:1])
    outputs = frozenset({"period", "impacts_left", "impacts_right"})
    run = partial(simulate.summarise, pair, u0, v0, scale, vijax.Harvester(), outputs=outputs, method=method)
    summary = run()
    us = 1e6 * core_seconds(run) / count
    return np.stack(
        [np.asarray(x).reshape(count) for x in (summary.period, summary.impacts_left, summary.impacts_right)]
    ), us


def sampled(cells: dict[str, np.ndarray], steps: int) -> LabelRow:
    """Count impacts of each cell's period by RK4 without events; cells that do not recur to 1e-4 are undecided."""
    d, kappa, period = cells["d"], cells["kappa"], cells["p"]
    run = partial(peers.rk4, d, kappa, R, failures.U0, failures.V0, failures.PERIODS, steps)
    before = run()
    us = 1e6 * core_seconds(run) / d.size
    recurs, counted = np.zeros(d.size, bool), np.zeros(d.size)
    for p in np.unique(period):
        rows = period == p
        after = peers.rk4(d[rows], kappa[rows], R, failures.U0, failures.V0, failures.PERIODS + int(p), steps)
        recurs[rows] = np.hypot(after[1] - before[1][rows], after[2] - before[2][rows]) < 1e-4
        counted[rows] = after[0] * (failures.PERIODS + p) - before[0][rows] * failures.PERIODS
    wrong = np.rint(counted) != cells["left"] + cells["right"]
    return LabelRow("numba RK4", f"{steps}", us, d.size, int(wrong.sum()), int((~recurs & ~wrong).sum()))


def print_rows(rows: Iterator[Any]) -> Iterator[Any]:
    """Print rows as they are measured."""
    for item in rows:
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in item), flush=True)
        yield item


def main() -> int:
    """Measure, print and store the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few cells and methods: does it run?")
    parser.add_argument("--only", choices=["tails", "labels"], help="one of the tables")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the rows")
    options = parser.parse_args()
    part = "_quick" if options.quick else ""
    print(tables.made_by())
    for name, kind, measure in (("tails", Row, errors), ("labels", LabelRow, labels)):
        if options.only in (None, name):
            tables.write(options.rows / f"{name}{part}.csv", kind._fields, print_rows(measure(options.quick)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
