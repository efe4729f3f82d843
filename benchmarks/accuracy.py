"""Does the engine reach its intended accuracy, and does it ever miss an impact?

    python benchmarks/accuracy.py           # all figures
    python benchmarks/accuracy.py --quick   # a twentieth of the drawn cases, 200 periods instead of 2000

One line a figure: quantity, value, limit, PASS or FAIL. Everything is measured against 50-digit arithmetic, long
double or the reference cells; nothing against the engine itself. Typical printout:

    PASS  reference trajectories, first 4 impacts, relative error          1.15e-15  (at most 1e-13)
    PASS  the same, all 16 of the non-chaotic cases                         1.1e-15  (at most 1e-11)
    PASS  periodic cells with another period or impact counts                     0  (at most 0) 120 periodic ce
    PASS  periodic cells called aperiodic                                         0  (at most 0)
    PASS  largest relative error of P in them                              6.53e-12  (at most 1e-09)
    PASS  the same of 1 slower ones, against 16,000 periods                1.78e-14  (at most 1e-09)
    PASS  aperiodic cells: largest |z|                                        0.868  (at most 4) 15 cells
    PASS  aperiodic cells: median |z|                                         0.374  (at most 1.2)
    PASS  aperiodic cells: largest relative standard error of P              0.0112  (at most 0.03)
    PASS  missed wall crossings                                                   0  (at most 0) 3,120 flights o
    PASS  missed exits                                                            0  (at most 0) 2,072 contacts
    PASS  constructed extrema on the wrong side                                   0  (at most 0) 500 from 1e-14
    PASS  |det - expected|/max(1, |M|^2) over four impacts                 3.94e-16  (at most 1e-11)

(with --quick)
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from benchmarks import derivatives, yardstick
from vijax.design.survey import attractor_survey
from vijax.impact.fast.fast_step import fast_step
from vijax.impact.fast.fast_walls import prepare_walls
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import BallState
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair, impact_pair
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.shooting import Sequence
from vijax.orbits.steady import Steady, solve_orbit, steady_on_orbit
from vijax.runtime import tiles
from vijax.simulation import simulate
from vijax.simulation.simulate import Starts

SLOPES = 1e-12, 0.01, 0.1, -0.1, 0.3, -0.3, 0.5, -0.5, 0.7, -0.9, 0.99, 1.0, -1.5  # gamma of the inclined flights
failures = 0


def print_figure(quantity: str, value: float, limit: float, note: str = "") -> None:
    """Print one figure against its upper limit."""
    global failures
    passed = bool(value <= limit)  # NaN fails
    failures += not passed
    print(f"{'PASS' if passed else 'FAIL'}  {quantity:<62} {value:10.3g}  (at most {limit:g}) {note}", flush=True)


def reference() -> None:
    """Compare impact sequences with sequences in 50 digits."""
    first_error, largest_error = 0.0, 0.0
    for cases in (yardstick.SOFT, yardstick.RIGID):
        for case, errors in yardstick.compare(cases):
            first_error = max(first_error, *(e[:4].max() for e in errors.values()))
            if not yardstick.sensitive(case):
                largest_error = max(largest_error, *(e.max() for e in errors.values()))
    print_figure("reference trajectories, first 4 impacts, relative error", first_error, 1e-13)
    print_figure("the same, all 16 of the non-chaotic cases", largest_error, 1e-11)


# A reference cell that converged only after so many periods was not fully converged at its end, at 2,000.
_SETTLED = 1000
_LONG_RUN = 16_000


def plane(periods: int) -> None:
    """Compare reference cells of the (d, kappa) plane."""
    cells = json.loads((yardstick.DATA / "plane_cells.json").read_text())["cells"]
    count = len(cells)
    pair = ImpactPair(*(jnp.asarray([c[k] for c in cells], float) for k in ("d", "kappa", "r", "gamma")))
    u0, v0 = (jnp.asarray([c[k] for c in cells], float) for k in ("u0", "v0"))
    unit = jnp.ones(count)
    scale = simulate.Scale(unit, unit, jnp.ones(1), jnp.ones(1))
    summary = simulate.summarise(pair, u0, v0, scale, Harvester(), periods=periods, outputs=frozenset({"P"}))
    summary = jax.tree.map(np.asarray, summary)
    wrong_labels = called_aperiodic = slow = 0
    worst, z, spread, late_rows = 0.0, [], [], []
    for k, cell in enumerate(cells):
        if not cell["p"]:
            error = np.hypot(summary.P_stderr[k, 0], 5e-4 * cell["P_J"])
            z.append(abs(summary.P[k, 0] - cell["P_J"]) / error)
            spread.append(summary.P_stderr[k, 0] / summary.P[k, 0])
        elif summary.status[k] == vijax.Status.SLOW:
            slow += 1
        else:
            labels = (int(summary.period[k]), int(summary.impacts_left[k]), int(summary.impacts_right[k]))
            called_aperiodic += labels[0] == 0
            wrong_labels += labels != (cell["p"], cell["left"], cell["right"])
            if cell["converged_after"] > _SETTLED:
                late_rows.append(k)
            else:
                worst = max(worst, abs(summary.P[k, 0] / cell["P_J"] - 1))
    note = f"{sum(c['p'] > 0 for c in cells)} periodic cells, {slow} flagged slow, {periods} periods"
    print_figure("periodic cells with another period or impact counts", wrong_labels, 0, note)
    print_figure("periodic cells called aperiodic", called_aperiodic, 0)
    print_figure("largest relative error of P in them", worst, 1e-9)
    if late_rows:
        # These cells had not converged when the reference ended: their P is compared with P of a longer run.
        rows = np.resize(late_rows, count)
        slower, u, v = jax.tree.map(lambda x: x[rows], (pair, u0, v0))
        window: Any = {"periods": 48, "transient": _LONG_RUN, "until": "window", "outputs": frozenset({"P"})}
        long_run = simulate.summarise(slower, u, v, scale, Harvester(), **window)
        relative_error = np.abs(np.asarray(long_run.P)[:, 0] / summary.P[rows, 0] - 1).max()
        print_figure(f"the same of {len(late_rows)} slower ones, against {_LONG_RUN:,} periods", relative_error, 1e-9)
    print_figure("aperiodic cells: largest |z|", max(z), 4, f"{len(z)} cells")
    print_figure("aperiodic cells: median |z|", float(np.median(z)), 1.2)
    print_figure("aperiodic cells: largest relative standard error of P", max(spread), 0.03)


def audit(share: float) -> None:
    """Verify random flights and contacts by a dense scan in long double, and constructed extrema."""
    flights, contacts, bad_flight, bad_contact, determinant, undecided = 0, 0, 0, 0, 0.0, 0
    for soft, seed, count in ((True, 101, int(2600 * share)), (False, 102, int(1300 * share))):
        pair, state = yardstick.random_cells(np.random.default_rng(seed), count, soft)
        march = yardstick.march(pair, state)
        undecided += int(np.isnan(march.out.contact_duration).sum())
        overshoot = yardstick.audit_flights(pair, march)
        flights += len(overshoot)
        bad_flight += int(np.sum(~(overshoot < 16 * yardstick.EPS)))
        if soft:
            undershoot = yardstick.audit_contacts(pair, march)
            contacts += len(undershoot)
            bad_contact += int(np.sum(~(undershoot < 64 * yardstick.EPS)))
        with np.errstate(invalid="ignore", over="ignore"):
            determinant = max(determinant, float(np.nanmax(yardstick.determinants(pair, march, 4))))
    print_figure("missed wall crossings", bad_flight, 0, f"{flights:,} flights over random parameters")
    print_figure("missed exits", bad_contact, 0, f"{contacts:,} contacts over random parameters, {undecided} undecided")
    wrong = extrema = 0
    nearest = np.inf
    for build, seed in ((yardstick.grazing_flights, 103), (yardstick.grazing_contacts, 104)):
        extrema_set = build(np.random.default_rng(seed), int(5000 * share))
        wrong += extrema_set.wrong()
        extrema += len(extrema_set.height)
        nearest = min(nearest, np.abs(extrema_set.height).min())
    print_figure(
        "constructed extrema on the wrong side", wrong, 0, f"{extrema:,} from {nearest:.0e} to 1e-3 off the wall"
    )
    print_figure("|det - expected|/max(1, |M|^2) over four impacts", determinant, 1e-11)


def certified_steps(share: float) -> None:
    """Verify the impacts that the fast step certifies, on as many inclined flights as level ones."""
    for name, regime, slopes, seed in (
        ("level", GravityRegime.NONE, [0.0], 105),
        ("inclined", GravityRegime.STRONG, SLOPES, 106),
    ):
        pair, ball = yardstick.after_impacts(np.random.default_rng(seed), int(31_200 * share), slopes)
        step = jax.jit(partial(_fast_step, regime))
        start: Any = *ball, np.zeros_like(ball[0])
        impact, arrival, certified = jax.tree.map(np.asarray, step(pair, BallState(*start)))
        overshoot = yardstick.certified_flight_violations(pair, ball, arrival)
        undershoot = yardstick.certified_contact_violations(pair, impact, certified)
        note = f"{overshoot.size:,} certified flights of {certified.size:,}"
        print_figure(
            f"quick step, {name}: missed wall crossings", int(np.sum(~(overshoot < 16 * yardstick.EPS))), 0, note
        )
        # The end of a slow hop is rounded more coarsely relative to its depth, so the bound is wider.
        print_figure(
            f"quick step, {name}: missed exits",
            int(np.sum(~(undershoot < 1e-9))),
            0,
            f"{undershoot.size:,} certified contacts",
        )


def _fast_step(regime: GravityRegime, pair: ImpactPair, ball: BallState) -> tuple[Any, Any, jax.Array]:
    step = fast_step(prepare_walls(pair, gravity_regime=regime), pair.gamma, ball)
    return step.impact, step.arrival, step.certified


def gradients() -> None:
    """Compare derivatives of impacts with differences in 50 digits."""
    worst = [0.0, 0.0]
    for rigid in (False, True):
        cases, directions, first, second, _ = derivatives.derivatives(rigid)
        for i, case in enumerate(cases):
            for j, direction in enumerate(directions):
                true = derivatives.differences(case, direction)
                errors = derivatives.relative((first[i, j], second[i, j]), true)
                worst = [max(a, b) for a, b in zip(worst, errors, strict=True)]
    print_figure("first derivatives of times, speeds, depths", worst[0], 1e-9)
    print_figure("second derivatives", worst[1], 1e-6)


MOVED = 0.8, 0.95, 1.0, 1.05  # factors of d, relative to the value at which each orbit was computed
WIDTH = 16  # most impacts of an orbit


def steady_states(count: int) -> None:
    """Compare steady states with the impact map on the same orbits: attractors of random cells, with d changed."""
    draw = np.random.default_rng(105)
    d = np.exp(draw.uniform(np.log(0.005), np.log(0.6), count))
    kappa = np.exp(draw.uniform(np.log(5), np.log(5e3), count))
    gamma = np.where(draw.random(count) < 0.5, 0.0, draw.uniform(-1, 1, count))
    pair = impact_pair(d, kappa, draw.uniform(0.05, 0.93, count), gamma)
    devices = jax.tree.map(lambda x: np.full(count, x), Harvester())
    starts = Starts(jnp.asarray(0.3 * d), jnp.full(count, -0.47), jnp.zeros(count))
    attractors = attractor_survey.simulate_survey(pair, devices, starts, max_period=1, periods=400).orbits(WIDTH)
    sequence, device = attractors.sequence(WIDTH), Harvester()
    total, wrong, lost, gravity_prolonged_states, worst = 0, 0, 0, 0, 0.0
    for factor in MOVED:
        moved_pair = dataclasses.replace(attractors.pair, d=factor * attractors.pair.d)
        state = _steady_states(device, moved_pair, sequence, attractors.impact_unknowns)
        verified = periodic.verify_solutions(moved_pair, sequence, jnp.asarray(state.impact_unknowns))
        P, verified_ok = (
            np.asarray(orbit_properties.orbit_power(verified, device)),
            np.asarray(verified.status) == vijax.Status.OK,
        )
        ok = state.status == vijax.Status.OK
        total += state.status.size
        wrong += int((ok & ~verified_ok).sum())
        lost += int(((state.status == vijax.Status.VIRTUAL) & verified_ok).sum())
        worst = max(worst, np.abs(state.P / P - 1)[ok & verified_ok].max())
        gravity_prolonged_states += int(
            (ok & (state.impact_unknowns[..., 2].max(axis=1) * np.asarray(moved_pair.kappa) > 20)).sum()
        )
    note = (
        f"{total:,} steady states, {gravity_prolonged_states:,} of them OK and pressed on a wall for more than 20/kappa"
    )
    print_figure("steady states called OK that the impact map does not fly", wrong, 0, note)
    print_figure("steady states called VIRTUAL that it flies", lost, 0)
    print_figure("largest relative difference of P from the simulated orbit's", worst, 1e-10)


def _steady_states(device: Harvester, pair: ImpactPair, sequence: Sequence, impact_unknowns: np.ndarray) -> Steady:
    """Compute steady states of many orbits, in tiles."""

    def steady_state(pair: ImpactPair, sequence: Sequence, impact_unknowns: Any) -> Steady:
        solution = solve_orbit(pair, sequence, impact_unknowns)
        return steady_on_orbit(device, pair, sequence, solution.impact_unknowns, solution.residual)

    batched = jax.jit(jax.vmap(steady_state))
    return tiles.map_tiles(lambda rows: batched(*rows), (pair, sequence, impact_unknowns), (512,))


LONG = 9  # least period of a long orbit, in forcing periods
LATE_PERIODS = 20_000  # forcing periods after which a label must still hold


def _drawn(draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw d, kappa and r of many cells."""
    d, kappa = (np.exp(draw.uniform(np.log(low), np.log(high), 65536)) for low, high in ((0.03, 10), (2, 1000)))
    return d, kappa, draw.uniform(0.2, 0.9, d.size)


def long_periods(count: int) -> None:
    """Compare labels of long periods with the motion of the same starts after many more periods."""
    draw, cells = np.random.default_rng(106), 0
    batches: list[list[Any]] = []
    while sum(d.size for d, *_ in batches) < count:
        d, kappa, r = _drawn(draw)
        labelled = _labelled(d, kappa, r, periods=400)
        selected = np.flatnonzero(labelled.period >= LONG)
        impacts = labelled.impacts_left + labelled.impacts_right
        batches.append([x[selected] for x in (d, kappa, r, labelled.period, impacts, labelled.fastest)])
        cells += d.size
    d, kappa, r, period, impacts_of_period, fastest = (np.concatenate(x)[:count] for x in zip(*batches, strict=True))
    is_confirmed = np.zeros(count, bool)
    for length in np.unique(period):
        rows = np.flatnonzero(period == length)
        # A window of one period holds all impacts of the orbit.
        later = _labelled(d[rows], kappa[rows], r[rows], periods=int(length), until="window", transient=LATE_PERIODS)
        same = np.abs(later.fastest / fastest[rows] - 1) < 1e-8
        is_confirmed[rows] = same & (np.round(later.impacts_per_period * length) == impacts_of_period[rows])
    print_figure(
        "labels of long periods that a flight does not keep",
        1 - is_confirmed.mean(),
        5e-3,
        f"{count:,} of {cells:,} cells",
    )
    wide = d > 1
    print_figure("the same where d is above 1", 1 - is_confirmed[wide].mean(), 5e-3, f"{wide.sum():,} cells")


def slow_cells(count: int) -> None:
    """Compare results of slowly converging cells with runs of many more periods."""
    draw, cells, undecided = np.random.default_rng(107), 0, 0
    batches: list[list[Any]] = []
    while sum(d.size for d, *_ in batches) < count:
        d, kappa, r = _drawn(draw)
        gamma = draw.uniform(-0.5, 0.5, d.size) * (draw.random(d.size) < 0.5)
        labelled = _labelled(d, kappa, r, gamma, periods=400)
        selected = np.flatnonzero(labelled.status == vijax.Status.CONVERGING)
        kinds = labelled.period, labelled.impacts_left, labelled.impacts_right, labelled.fastest
        batches.append([x[selected] for x in (d, kappa, r, gamma, *kinds)])
        cells, undecided = cells + d.size, undecided + int((labelled.status == vijax.Status.SLOW).sum())
    d, kappa, r, gamma, period, left, right, fastest = (np.concatenate(x)[:count] for x in zip(*batches, strict=True))
    slices = [slice(block, block + 8192) for block in range(0, count, 8192)]
    later = jax.tree.map(
        lambda *part: np.concatenate(part),
        *(_labelled(d[block], kappa[block], r[block], gamma[block], periods=LATE_PERIODS) for block in slices),
    )
    is_decided = later.status != vijax.Status.SLOW
    # Turns of an orbit that differ in the seventh digit alone may be counted as one turn or as two.
    same = (later.impacts_left * period == left * later.period) & (later.impacts_right * period == right * later.period)
    wrong = is_decided & ~(same & (np.abs(later.fastest / fastest - 1) < 1e-6))
    print_figure(
        "slow cells whose label counts other turns of the same",
        (is_decided & ~wrong & (later.period != period)).sum(),
        20,
    )
    print_figure(
        f"slow cells with another motion by {LATE_PERIODS:,} periods",
        wrong.sum(),
        0,
        f"{is_decided.sum():,} of {cells:,} cells",
    )
    print_figure("the same where d is above 1", (wrong & (d > 1)).sum(), 0, f"{(is_decided & (d > 1)).sum():,} cells")
    print_figure("cells undecided after 400 periods", undecided / cells, 1e-3)


def _labelled(
    d: np.ndarray, kappa: np.ndarray, r: np.ndarray, gamma: np.ndarray | None = None, **settings: Any
) -> simulate.Summary:
    """Summarise cells at the default start in a padded tile; gamma is 0 by default."""
    rows = np.resize(np.arange(d.size), max(1 << (d.size - 1).bit_length(), 512))
    gamma = np.zeros_like(d) if gamma is None else gamma
    pair = ImpactPair(*(jnp.asarray(x[rows]) for x in (d, kappa, r, gamma)))
    u0, v0, unit = jnp.minimum(0.05853, 0.49 * pair.d), jnp.full(rows.size, -0.47898), jnp.ones(rows.size)
    scale = simulate.Scale(unit, unit, jnp.ones(1), jnp.ones(1))
    summary = simulate.summarise(pair, u0, v0, scale, Harvester(), outputs=frozenset({"fastest"}), **settings)
    return jax.tree.map(lambda x: np.asarray(x)[: d.size], summary)


PARTS = "reference", "plane", "audit", "quick", "gradients", "steady", "labels", "slow"


def _parts(quick: bool) -> tuple[Callable[[], None], ...]:
    """Return the parts to run, in the order of `PARTS`."""
    return (
        reference,
        lambda: plane(200 if quick else 2000),
        lambda: audit(0.05 if quick else 1.0),
        lambda: certified_steps(0.05 if quick else 1.0),
        gradients,
        lambda: steady_states(350 if quick else 7000),
        lambda: long_periods(500 if quick else 10_000),
        lambda: slow_cells(500 if quick else 10_000),
    )


def main() -> int:
    """Print the figures; return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small version")
    parser.add_argument("--only", choices=PARTS, help="one part")
    options = parser.parse_args()
    parts = dict(zip(PARTS, _parts(options.quick), strict=True))
    for name, part in parts.items():
        if options.only in (None, name):
            start = time.perf_counter()
            part()
            print(f"      {name}: {time.perf_counter() - start:.0f} s", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
