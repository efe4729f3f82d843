"""Are periodic orbits accurate to the last digit, fast, and their bifurcations correct? And attractors and basins?

    python benchmarks/orbits.py                    # all figures
    python benchmarks/orbits.py --only throughput  # one part

One line a figure. Errors are against 50-digit arithmetic; bifurcations are compared with reference values, and with the
exact multiplier of their kind. Typical printout:

    four orbits of 50 digits: largest error of impact unknowns               4.4e-16
    four orbits of 50 digits: largest error of penetrations                  1.4e-17
    four orbits of 50 digits: largest error of multipliers                   7.0e-15
    four orbits of 50 digits: largest error of P, relative                   1.6e-15
    the branch they lie on: kappa from, to                                   3, 400
    orbits per second, verified; median and range of the warm runs           489,258 (397,017 to 584,986)
    of these found; largest residual                                         99.6587%; 1.4e-15

(the first two parts)
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
from vijax.continuation import branch_continuation, branch_switching
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.orbits import orbit_properties, orbit_search, periodic, symmetry
from vijax.orbits.shooting import Sequence

DATA = Path(__file__).parent.parent / "tests" / "data"
ORBITS = 150_000
RUNS = 5


def print_figure(quantity: str, value: str) -> None:
    """Print one figure."""
    print(f"{quantity:<72} {value}", flush=True)


def reference() -> None:
    """Solve for the 50-digit orbits, from guesses 2 % off."""
    worst = {"impact unknowns": 0.0, "penetrations": 0.0, "multipliers": 0.0, "P, relative": 0.0}
    for row in json.loads((DATA / "gradients.json").read_text())["orbits"]:
        t, v, contact_durations, depth = (
            np.array([float(x) for x in row[name]]) for name in ("t_in", "v_in", "contact", "dmax")
        )
        order = np.argsort(t)
        impact_unknowns = np.stack([t, np.abs(v), contact_durations], axis=1)[order]
        pair = impact_pair(*([float(row[name])] for name in ("d", "kappa", "r", "gamma")))
        solution = periodic.solve(
            pair, period_1(np.sign(v[order]), 1), jnp.asarray(impact_unknowns * (1 + 0.02 * np.array([1, -1, 1])))[None]
        )
        multipliers = [complex(*map(float, parts)) for parts in row["multipliers_mp_contact_map"]]
        errors = {
            "impact unknowns": np.abs(solution.impact_unknowns[0] - impact_unknowns).max(),
            "penetrations": np.abs(solution.depth[0] - depth[order]).max(),
            "multipliers": min(
                np.abs(solution.multipliers[0] - np.array(m)).max() for m in (multipliers, multipliers[::-1])
            ),
            "P, relative": abs(float(orbit_properties.orbit_power(solution, Harvester())[0]) / float(row["P_J"]) - 1),
        }
        worst = {name: max(worst[name], float(error)) for name, error in errors.items()}
    for name, error in worst.items():
        print_figure(f"four orbits of 50 digits: largest error of {name}", f"{error:.1e}")


def period_1(walls, count: int) -> Sequence:
    """Return sequences of period 1."""
    side = jnp.broadcast_to(jnp.asarray(walls, jnp.int32), (count, len(walls)))
    return Sequence(side, jnp.full(count, 2.0), jnp.zeros(count, bool))


def throughput() -> None:
    """Solve for symmetric 1:1 orbits at many kappa, closed halfway, each from a neighbour, and verify them."""
    start = orbit_search.find_orbits(impact_pair(D, 40.0, 0.5), "RL", guesses=1024)
    start = symmetry.close_half_way(start[np.flatnonzero(np.asarray(symmetry.is_symmetric(start)))])
    fastest = start[jnp.argmax(start.impact_unknowns[:, 0, 1], keepdims=True)]
    (branch,) = branch_continuation.follow_orbits(fastest, "kappa", (3.0, 400.0))
    print_figure("the branch they lie on: kappa from, to", f"{branch.values.min():.4g}, {branch.values.max():.4g}")
    kappa = np.geomspace(max(branch.values.min(), 3.0), min(branch.values.max(), 400.0), ORBITS)
    order = np.argsort(branch.values)
    anchor = np.stack(
        [
            np.interp(kappa[:: LEVELS[0]], branch.values[order], x[order])
            for x in np.asarray(branch.orbit.impact_unknowns)[:, 0].T
        ],
        axis=-1,
    )
    rates = []
    for _ in range(RUNS + 1):
        began = time.perf_counter()
        solutions = solve_all(kappa, anchor)
        rates.append(ORBITS / (time.perf_counter() - began))
    status, residual = solutions
    print_figure(
        "orbits per second, verified; median and range of the warm runs",
        f"{np.median(rates[1:]):,.0f} ({min(rates[1:]):,.0f} to {max(rates[1:]):,.0f})",
    )
    print_figure(
        "of these found; largest residual",
        f"{(status == Status.OK).mean():.4%}; {residual[status == Status.OK].max():.1e}",
    )


D = 0.16
LEVELS = (512, 16, 1)


def solve_all(kappa: np.ndarray, anchor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve every 512th orbit from the branch, every 16th from these, and the others from those."""
    impact_unknowns, guess = np.full((kappa.size, 3), np.nan), anchor
    status, residual = np.full(kappa.size, -1), np.full(kappa.size, np.inf)
    for level, spacing in enumerate(LEVELS):
        rows = np.arange(0, kappa.size, spacing)
        if level:
            rows = rows[rows % LEVELS[level - 1] != 0]
            guess = impact_unknowns[rows - rows % LEVELS[level - 1]]
        count = rows.size
        pair = ImpactPair(
            *(jnp.asarray(x) for x in (np.full(count, D), kappa[rows], np.full(count, 0.5), np.zeros(count)))
        )
        sequence = Sequence(jnp.ones((count, 1), jnp.int32), jnp.ones(count), jnp.ones(count, bool))
        solution = jax.tree.map(np.asarray, periodic.solve(pair, sequence, jnp.asarray(guess)[:, None]))
        impact_unknowns[rows], status[rows], residual[rows] = (
            solution.impact_unknowns[:, 0],
            solution.status,
            solution.residual,
        )
    return status, residual


def bifurcations() -> None:
    """Compare bifurcations with the reference values."""
    rigid = {"d": 0.2, "kappa": None, "r": 0.5}
    compare_bifurcation("rigid 1:1 breaks symmetry, d", rigid, "RL", "d", (0.1, 0.3), "pitchfork", 0.2634316)
    compare_bifurcation("rigid 1:1 flips, d", rigid, "RL", "d", (0.1, 0.3), "flip", 0.1870781)
    compare_bifurcation("rigid 1:2 folds, d", {**rigid, "d": 0.19}, "RLL", "d", (0.1, 0.3), "fold", 0.20158)
    device = Harvester(s=0.2)
    for title, omega, impacts, kind, value in (
        ("soft 1:2 folds, omega", 3.0, "RLL", "fold", 3.13059),
        ("soft 1:1 folds, omega", 4.0, "RL", "fold", 6.8804),
        ("soft 1:1/3T folds, omega", 11.0, "1:1/3T", "fold", 11.8422),
        ("soft 1:1/3T flips, omega", 11.0, "1:1/3T", "flip", 10.3052),
    ):
        parameters = {"d": 0.2 * (omega / np.pi) ** 2, "kappa": 400 * np.pi / omega, "r": 0.5}
        compare_bifurcation(title, parameters, impacts, "omega", (2.5, 13.0), kind, value, device)


def compare_bifurcation(
    title: str, parameters: dict, impacts: str, along: str, limits, kind: str, reference_value: float, device=None
) -> None:
    """Print the point of a kind nearest to the known one, on the branches from one orbit."""
    orbits = orbit_search.find_orbits(impact_pair(**parameters), impacts, guesses=1024)
    points = [
        point
        for branch in branch_switching.follow_families(orbits, along, limits, device=device)
        for point in branch.points
    ]
    point = min((point for point in points if point.kind == kind), key=lambda point: abs(point.value - reference_value))
    value = {"flip": -1}.get(kind, 1)
    multiplier_error = abs(complex(point.orbit.multipliers[0, 0]) - value)
    print_figure(
        title, f"{point.value:.8f} (reference {reference_value}); multiplier {value} to {multiplier_error:.0e}"
    )


def attractors() -> None:
    """Compute the attractors' shares at d = 0.2, kappa = 3, and Lyapunov exponents in chaos."""
    dataset = vijax.basin_fractions(d=0.2, kappa=3.0, r=0.5, starts=20_000, seed=1, merge_mirrors=True)
    for label, share in zip(dataset["label"].values.ravel(), dataset["fraction"].values.ravel(), strict=True):
        if share > 0:
            print_figure(f"d 0.2, kappa 3, 20,000 starts: {label}", f"{share:.2%}")
    for wall in ("rigid", "soft"):
        dataset = vijax.lyapunov(d=0.12, kappa=400.0, r=0.5, wall=wall)
        print_figure(
            f"{wall} d 0.12: Lyapunov exponent a period",
            f"{float(dataset['lyapunov']):.4f} +- {float(dataset['lyapunov_stderr']):.4f}",
        )


def diagram() -> None:
    """Compute Fig. 8's orbit diagram: 126 d, five kappa, both directions, 400 periods."""
    seconds = []
    for _ in range(RUNS + 1):
        start = time.perf_counter()
        vijax.orbit_diagram(
            along="d",
            values=np.linspace(0.3, 0.05, 126),
            kappa=np.array([400, 126.5, 40, 12.65, 4]),
            r=0.5,
            direction="both",
        )
        seconds.append(time.perf_counter() - start)
    print_figure(
        "orbit diagram of 1,260 points: seconds, first (with compilation); median",
        f"{seconds[0]:.1f}; {np.median(seconds[1:]):.2f}",
    )


def main() -> int:
    """Print the figures."""
    parts = {part.__name__: part for part in (reference, throughput, bifurcations, attractors, diagram)}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=list(parts), help="one part")
    options = parser.parse_args()
    for name, part in parts.items():
        if options.only in (None, name):
            part()
    return 0


if __name__ == "__main__":
    sys.exit(main())
