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
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from vijax import simulate
from vijax.model import Harvester, ImpactPair

TESTS = Path(__file__).parent.parent / "tests"
sys.path.insert(0, str(TESTS))

import helpers  # noqa: E402  the tests' arithmetic
import test_exact  # noqa: E402
import test_trajectory  # noqa: E402

failures = 0


def say(what: str, value: float, limit: float, note: str = "") -> None:
    """Print one figure against its upper limit."""
    global failures
    good = bool(value <= limit)  # NaN fails
    failures += not good
    print(f"{'PASS' if good else 'FAIL'}  {what:<62} {value:10.3g}  (at most {limit:g}) {note}", flush=True)


def reference() -> None:
    """Impact sequences of 50 digits."""
    first, all_of = 0.0, 0.0
    for cases in (test_exact.SOFT, test_exact.RIGID):
        for case, errors in test_exact.compare(cases):
            first = max(first, *(e[:4].max() for e in errors.values()))
            if not test_exact.sensitive(case):
                all_of = max(all_of, *(e.max() for e in errors.values()))
    say("reference trajectories, first 4 impacts, relative error", first, 1e-13)
    say("the same, all 16 of the non-chaotic cases", all_of, 1e-11)


def plane(periods: int) -> None:
    """Reference cells of the (d, kappa) plane."""
    cells = json.loads((TESTS / "data" / "plane_cells.json").read_text())["cells"]
    count = len(cells)
    pair = ImpactPair(*(jnp.asarray([c[k] for c in cells], float) for k in ("d", "kappa", "r", "gamma")))
    u0, v0 = (jnp.asarray([c[k] for c in cells], float) for k in ("u0", "v0"))
    one = jnp.ones(count)
    scale = simulate.Scale(one, one, jnp.ones(1), jnp.ones(1))
    got = simulate.summarise(pair, u0, v0, scale, Harvester(), periods=periods, outputs=frozenset({"P"}))
    got = jax.tree.map(np.asarray, got)
    wrong = called = slow = 0
    worst, z, spread = 0.0, [], []
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
            worst = max(worst, abs(got.P[k, 0] / cell["P_J"] - 1))
    note = f"{sum(c['p'] > 0 for c in cells)} periodic cells, {slow} flagged slow, {periods} periods"
    say("periodic cells with another period or impact counts", wrong, 0, note)
    say("periodic cells called aperiodic", called, 0)
    say("largest relative error of P in them", worst, 1e-9)
    say("aperiodic cells: largest |z|", max(z), 4, f"{len(z)} cells")
    say("aperiodic cells: median |z|", float(np.median(z)), 1.2)
    say("aperiodic cells: largest relative standard error of P", max(spread), 0.03)


def audit(share: float) -> None:
    """Drawn flights and contacts against a dense scan in long double, and constructed extrema."""
    flights, contacts, bad_flight, bad_contact, determinant, undecided = 0, 0, 0, 0, 0.0, 0
    for soft, seed, count in ((True, 101, int(2600 * share)), (False, 102, int(1300 * share))):
        pair, state = helpers.random_cells(np.random.default_rng(seed), count, soft)
        ran = helpers.march(pair, state)
        undecided += int(np.isnan(ran.out.stay).sum())
        beyond = helpers.audit_flights(pair, ran)
        flights += len(beyond)
        bad_flight += int(np.sum(~(beyond < 16 * helpers.EPS)))
        if soft:
            below = helpers.audit_contacts(pair, ran)
            contacts += len(below)
            bad_contact += int(np.sum(~(below < 64 * helpers.EPS)))
        with np.errstate(invalid="ignore", over="ignore"):
            determinant = max(determinant, float(np.nanmax(test_exact.determinants(pair, ran, 4))))
    say("missed wall crossings", bad_flight, 0, f"{flights:,} flights over random parameters")
    say("missed exits", bad_contact, 0, f"{contacts:,} contacts over random parameters, {undecided} undecided")
    wrong = extrema = 0
    nearest = np.inf
    for build, seed in ((helpers.grazing_flights, 103), (helpers.grazing_contacts, 104)):
        built = build(np.random.default_rng(seed), int(5000 * share))
        wrong += built.wrong()
        extrema += len(built.height)
        nearest = min(nearest, np.abs(built.height).min())
    say("constructed extrema on the wrong side", wrong, 0, f"{extrema:,} from {nearest:.0e} to 1e-3 off the wall")
    say("|det - expected|/max(1, |M|^2) over four impacts", determinant, 1e-11)


def gradients() -> None:
    """Derivatives of impacts against differences in 50 digits."""
    worst = [0.0, 0.0]
    for rigid in (False, True):
        cases, directions, first, second, _ = test_trajectory.derivatives(rigid)
        for i, case in enumerate(cases):
            for j, direction in enumerate(directions):
                true = test_trajectory.differences(case, direction)
                errors = test_trajectory.relative((first[i, j], second[i, j]), true)
                worst = [max(a, b) for a, b in zip(worst, errors, strict=True)]
    say("first derivatives of times, speeds, depths", worst[0], 1e-9)
    say("second derivatives", worst[1], 1e-6)


def main() -> int:
    """Print the figures; 1 if one is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small version")
    parser.add_argument("--only", choices=["reference", "plane", "audit", "gradients"], help="one part")
    given = parser.parse_args()
    parts = {
        "reference": reference,
        "plane": lambda: plane(200 if given.quick else 2000),
        "audit": lambda: audit(0.05 if given.quick else 1.0),
        "gradients": gradients,
    }
    for name, part in parts.items():
        if given.only in (None, name):
            begun = time.perf_counter()
            part()
            print(f"      {name}: {time.perf_counter() - begun:.0f} s", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
