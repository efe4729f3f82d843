"""Does the engine reach the digits it is meant to, and does it ever miss an impact?

    python benchmarks/accuracy.py           # all figures
    python benchmarks/accuracy.py --quick   # a twentieth of the drawn cases, 200 periods instead of 2000

One line a figure: what, the value, the limit, PASS or FAIL. Everything is measured against 50-digit arithmetic, long
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
from vijax.batch import simulate
from vijax.batch.simulate import Starts
from vijax.design import survey
from vijax.engine.ground import Ground
from vijax.engine.impact import Ball
from vijax.engine.quick import quick_step
from vijax.engine.quick_wall import prepare
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair, impact_pair
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.shooting import Sequence
from vijax.orbits.steady import Steady, find, response
from vijax.runtime import tiles

SLOPES = 1e-12, 0.01, 0.1, -0.1, 0.3, -0.3, 0.5, -0.5, 0.7, -0.9, 0.99, 1.0, -1.5  # gamma of the inclined flights
failures = 0


def say(what: str, value: float, limit: float, note: str = "") -> None:
    """Print one figure against its upper limit."""
    global failures
    good = bool(value <= limit)  # NaN fails
    failures += not good
    print(f"{'PASS' if good else 'FAIL'}  {what:<62} {value:10.3g}  (at most {limit:g}) {note}", flush=True)


def reference() -> None:
    """Compare impact sequences with those of 50 digits."""
    first, all_of = 0.0, 0.0
    for cases in (yardstick.SOFT, yardstick.RIGID):
        for case, errors in yardstick.compare(cases):
            first = max(first, *(e[:4].max() for e in errors.values()))
            if not yardstick.sensitive(case):
                all_of = max(all_of, *(e.max() for e in errors.values()))
    say("reference trajectories, first 4 impacts, relative error", first, 1e-13)
    say("the same, all 16 of the non-chaotic cases", all_of, 1e-11)


# Periods after which a reference cell that had not settled before was as good as on its way when it ended, at 2,000.
_SETTLED = 1000
_LONG_RUN = 16_000


def plane(periods: int) -> None:
    """Compare reference cells of the (d, kappa) plane."""
    cells = json.loads((yardstick.DATA / "plane_cells.json").read_text())["cells"]
    count = len(cells)
    pair = ImpactPair(*(jnp.asarray([c[k] for c in cells], float) for k in ("d", "kappa", "r", "gamma")))
    u0, v0 = (jnp.asarray([c[k] for c in cells], float) for k in ("u0", "v0"))
    one = jnp.ones(count)
    scale = simulate.Scale(one, one, jnp.ones(1), jnp.ones(1))
    got = simulate.summarise(pair, u0, v0, scale, Harvester(), periods=periods, outputs=frozenset({"P"}))
    got = jax.tree.map(np.asarray, got)
    wrong = called = slow = 0
    worst, z, spread, late = 0.0, [], [], []
    for k, cell in enumerate(cells):
        if not cell["p"]:
            error = np.hypot(got.P_stderr[k, 0], 5e-4 * cell["P_J"])
            z.append(abs(got.P[k, 0] - cell["P_J"]) / error)
            spread.append(got.P_stderr[k, 0] / got.P[k, 0])
        elif got.status[k] == vijax.Status.SLOW:
            slow += 1
        else:
            labels = (int(got.period[k]), int(got.impacts_left[k]), int(got.impacts_right[k]))
            called += labels[0] == 0
            wrong += labels != (cell["p"], cell["left"], cell["right"])
            if cell["converged_after"] > _SETTLED:
                late.append(k)
            else:
                worst = max(worst, abs(got.P[k, 0] / cell["P_J"] - 1))
    note = f"{sum(c['p'] > 0 for c in cells)} periodic cells, {slow} flagged slow, {periods} periods"
    say("periodic cells with another period or impact counts", wrong, 0, note)
    say("periodic cells called aperiodic", called, 0)
    say("largest relative error of P in them", worst, 1e-9)
    if late:
        # These cells were still on their way when the reference ended: their P is compared with that of a longer run.
        rows = np.resize(late, count)
        slower, u, v = jax.tree.map(lambda x: x[rows], (pair, u0, v0))
        window: Any = {"periods": 48, "transient": _LONG_RUN, "until": "window", "outputs": frozenset({"P"})}
        ran = simulate.summarise(slower, u, v, scale, Harvester(), **window)
        away = np.abs(np.asarray(ran.P)[:, 0] / got.P[rows, 0] - 1).max()
        say(f"the same of {len(late)} slower ones, against {_LONG_RUN:,} periods", away, 1e-9)
    say("aperiodic cells: largest |z|", max(z), 4, f"{len(z)} cells")
    say("aperiodic cells: median |z|", float(np.median(z)), 1.2)
    say("aperiodic cells: largest relative standard error of P", max(spread), 0.03)


def audit(share: float) -> None:
    """Audit drawn flights and contacts by a dense scan in long double, and constructed extrema."""
    flights, contacts, bad_flight, bad_contact, determinant, undecided = 0, 0, 0, 0, 0.0, 0
    for soft, seed, count in ((True, 101, int(2600 * share)), (False, 102, int(1300 * share))):
        pair, state = yardstick.random_cells(np.random.default_rng(seed), count, soft)
        ran = yardstick.march(pair, state)
        undecided += int(np.isnan(ran.out.stay).sum())
        beyond = yardstick.audit_flights(pair, ran)
        flights += len(beyond)
        bad_flight += int(np.sum(~(beyond < 16 * yardstick.EPS)))
        if soft:
            below = yardstick.audit_contacts(pair, ran)
            contacts += len(below)
            bad_contact += int(np.sum(~(below < 64 * yardstick.EPS)))
        with np.errstate(invalid="ignore", over="ignore"):
            determinant = max(determinant, float(np.nanmax(yardstick.determinants(pair, ran, 4))))
    say("missed wall crossings", bad_flight, 0, f"{flights:,} flights over random parameters")
    say("missed exits", bad_contact, 0, f"{contacts:,} contacts over random parameters, {undecided} undecided")
    wrong = extrema = 0
    nearest = np.inf
    for build, seed in ((yardstick.grazing_flights, 103), (yardstick.grazing_contacts, 104)):
        built = build(np.random.default_rng(seed), int(5000 * share))
        wrong += built.wrong()
        extrema += len(built.height)
        nearest = min(nearest, np.abs(built.height).min())
    say("constructed extrema on the wrong side", wrong, 0, f"{extrema:,} from {nearest:.0e} to 1e-3 off the wall")
    say("|det - expected|/max(1, |M|^2) over four impacts", determinant, 1e-11)


def sure_steps(share: float) -> None:
    """Audit what the quick step is sure of, as many inclined flights as level ones."""
    for name, ground, slopes, seed in (("level", Ground.LEVEL, [0.0], 105), ("inclined", Ground.STEEP, SLOPES, 106)):
        pair, ball = yardstick.after_impacts(np.random.default_rng(seed), int(31_200 * share), slopes)
        step = jax.jit(partial(_quickly, ground))
        start: Any = *ball, np.zeros_like(ball[0])
        hit, arrival, sure = jax.tree.map(np.asarray, step(pair, Ball(*start)))
        beyond = yardstick.beyond_sure_flights(pair, ball, arrival)
        below = yardstick.below_sure_contacts(pair, hit, sure)
        note = f"{beyond.size:,} sure flights of {sure.size:,}"
        say(f"quick step, {name}: missed wall crossings", int(np.sum(~(beyond < 16 * yardstick.EPS))), 0, note)
        # Of a slow hop's depth the rounding of its end is more than of others.
        say(f"quick step, {name}: missed exits", int(np.sum(~(below < 1e-9))), 0, f"{below.size:,} sure contacts")


def _quickly(ground: Ground, pair: ImpactPair, ball: Ball) -> tuple[Any, Any, jax.Array]:
    found = quick_step(prepare(pair, ground=ground), pair.gamma, ball)
    return found.impact, found.arrival, found.sure


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
    say("first derivatives of times, speeds, depths", worst[0], 1e-9)
    say("second derivatives", worst[1], 1e-6)


MOVED = 0.8, 0.95, 1.0, 1.05  # of d, from where each orbit was met
WIDTH = 16  # impacts of an orbit at most


def steady_states(count: int) -> None:
    """Compare steady states with the impact map's flight of the same orbits, from drawn cells' attractors, d moved."""
    draw = np.random.default_rng(105)
    d = np.exp(draw.uniform(np.log(0.005), np.log(0.6), count))
    kappa = np.exp(draw.uniform(np.log(5), np.log(5e3), count))
    gamma = np.where(draw.random(count) < 0.5, 0.0, draw.uniform(-1, 1, count))
    pair = impact_pair(d, kappa, draw.uniform(0.05, 0.93, count), gamma)
    every = jax.tree.map(lambda x: np.full(count, x), Harvester())
    starts = Starts(jnp.asarray(0.3 * d), jnp.full(count, -0.47), jnp.zeros(count))
    met = survey.survey(pair, every, starts, longest=1, periods=400).orbits(WIDTH)
    sequence, device = met.sequence(WIDTH), Harvester()
    said, wrong, lost, pressed, worst = 0, 0, 0, 0, 0.0
    for moved in MOVED:
        there = dataclasses.replace(met.pair, d=moved * met.pair.d)
        state = _steadily(device, there, sequence, met.knots)
        flown = periodic.proven(there, sequence, jnp.asarray(state.knots))
        P, fine = np.asarray(orbit_properties.power(flown, device)), np.asarray(flown.status) == vijax.Status.OK
        ok = state.status == vijax.Status.OK
        said += state.status.size
        wrong += int((ok & ~fine).sum())
        lost += int(((state.status == vijax.Status.VIRTUAL) & fine).sum())
        worst = max(worst, np.abs(state.P / P - 1)[ok & fine].max())
        pressed += int((ok & (state.knots[..., 2].max(axis=1) * np.asarray(there.kappa) > 20)).sum())
    note = f"{said:,} steady states, {pressed:,} of them OK and pressed on a wall for more than 20/kappa"
    say("steady states called OK that the impact map does not fly", wrong, 0, note)
    say("steady states called VIRTUAL that it flies", lost, 0)
    say("largest relative difference of P from the flown orbit's", worst, 1e-10)


def _steadily(device: Harvester, pair: ImpactPair, sequence: Sequence, knots: np.ndarray) -> Steady:
    """Compute steady states of many orbits, in tiles."""

    def one_of(pair: ImpactPair, sequence: Sequence, knots: Any) -> Steady:
        found = find(pair, sequence, knots)
        return response(device, pair, sequence, found.knots, found.residual)

    one = jax.jit(jax.vmap(one_of))
    return tiles.map_tiles(lambda rows: one(*rows), (pair, sequence, knots), (512,))


LONG = 9  # forcing periods of an orbit that counts as long
FLOWN = 20_000  # forcing periods that a label must outlast


def _drawn(draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw d, kappa and r of many cells."""
    d, kappa = (np.exp(draw.uniform(np.log(low), np.log(high), 65536)) for low, high in ((0.03, 10), (2, 1000)))
    return d, kappa, draw.uniform(0.2, 0.9, d.size)


def long_periods(count: int) -> None:
    """Compare labels of long periods with the motion that the same starts have come to after many periods more."""
    draw, cells = np.random.default_rng(106), 0
    met: list[list[Any]] = []
    while sum(d.size for d, *_ in met) < count:
        d, kappa, r = _drawn(draw)
        found = _labelled(d, kappa, r, periods=400)
        some = np.flatnonzero(found.period >= LONG)
        struck = found.impacts_left + found.impacts_right
        met.append([x[some] for x in (d, kappa, r, found.period, struck, found.fastest)])
        cells += d.size
    d, kappa, r, period, hits, fastest = (np.concatenate(x)[:count] for x in zip(*met, strict=True))
    kept = np.zeros(count, bool)
    for each in np.unique(period):
        of = np.flatnonzero(period == each)
        # A window of one period sees what the whole orbit has.
        later = _labelled(d[of], kappa[of], r[of], periods=int(each), until="window", transient=FLOWN)
        same = np.abs(later.fastest / fastest[of] - 1) < 1e-8
        kept[of] = same & (np.round(later.impacts_per_period * each) == hits[of])
    say("labels of long periods that a flight does not keep", 1 - kept.mean(), 5e-3, f"{count:,} of {cells:,} cells")
    wide = d > 1
    say("the same where d is above 1", 1 - kept[wide].mean(), 5e-3, f"{wide.sum():,} cells")


def slow_cells(count: int) -> None:
    """Compare verdicts on cells that are slow to converge with those of searches for many more periods."""
    draw, cells, undecided = np.random.default_rng(107), 0, 0
    met: list[list[Any]] = []
    while sum(d.size for d, *_ in met) < count:
        d, kappa, r = _drawn(draw)
        gamma = draw.uniform(-0.5, 0.5, d.size) * (draw.random(d.size) < 0.5)
        found = _labelled(d, kappa, r, gamma, periods=400)
        some = np.flatnonzero(found.status == vijax.Status.CONVERGING)
        kinds = found.period, found.impacts_left, found.impacts_right, found.fastest
        met.append([x[some] for x in (d, kappa, r, gamma, *kinds)])
        cells, undecided = cells + d.size, undecided + int((found.status == vijax.Status.SLOW).sum())
    d, kappa, r, gamma, period, left, right, fastest = (np.concatenate(x)[:count] for x in zip(*met, strict=True))
    parts = [slice(at, at + 8192) for at in range(0, count, 8192)]
    later = jax.tree.map(
        lambda *part: np.concatenate(part),
        *(_labelled(d[at], kappa[at], r[at], gamma[at], periods=FLOWN) for at in parts),
    )
    known = later.status != vijax.Status.SLOW
    # Turns of an orbit that differ in the seventh digit alone may be counted as one or as two.
    same = (later.impacts_left * period == left * later.period) & (later.impacts_right * period == right * later.period)
    wrong = known & ~(same & (np.abs(later.fastest / fastest - 1) < 1e-6))
    say("slow cells whose label counts other turns of the same", (known & ~wrong & (later.period != period)).sum(), 20)
    say(f"slow cells with another motion by {FLOWN:,} periods", wrong.sum(), 0, f"{known.sum():,} of {cells:,} cells")
    say("the same where d is above 1", (wrong & (d > 1)).sum(), 0, f"{(known & (d > 1)).sum():,} cells")
    say("cells undecided after 400 periods", undecided / cells, 1e-3)


def _labelled(
    d: np.ndarray, kappa: np.ndarray, r: np.ndarray, gamma: np.ndarray | None = None, **settings: Any
) -> simulate.Summary:
    """Summarise cells, level ones unless gamma is given, at the default start, in a padded tile."""
    rows = np.resize(np.arange(d.size), max(1 << (d.size - 1).bit_length(), 512))
    gamma = np.zeros_like(d) if gamma is None else gamma
    pair = ImpactPair(*(jnp.asarray(x[rows]) for x in (d, kappa, r, gamma)))
    u0, v0, one = jnp.minimum(0.05853, 0.49 * pair.d), jnp.full(rows.size, -0.47898), jnp.ones(rows.size)
    scale = simulate.Scale(one, one, jnp.ones(1), jnp.ones(1))
    found = simulate.summarise(pair, u0, v0, scale, Harvester(), outputs=frozenset({"fastest"}), **settings)
    return jax.tree.map(lambda x: np.asarray(x)[: d.size], found)


PARTS = "reference", "plane", "audit", "quick", "gradients", "steady", "labels", "slow"


def _parts(quick: bool) -> tuple[Callable[[], None], ...]:
    """List what is run, in the order of `PARTS`."""
    return (
        reference,
        lambda: plane(200 if quick else 2000),
        lambda: audit(0.05 if quick else 1.0),
        lambda: sure_steps(0.05 if quick else 1.0),
        gradients,
        lambda: steady_states(350 if quick else 7000),
        lambda: long_periods(500 if quick else 10_000),
        lambda: slow_cells(500 if quick else 10_000),
    )


def main() -> int:
    """Print the figures; 1 if one is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small version")
    parser.add_argument("--only", choices=PARTS, help="one part")
    given = parser.parse_args()
    parts = dict(zip(PARTS, _parts(given.quick), strict=True))
    for name, part in parts.items():
        if given.only in (None, name):
            begun = time.perf_counter()
            part()
            print(f"      {name}: {time.perf_counter() - begun:.0f} s", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
