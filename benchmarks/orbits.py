"""Are periodic orbits found to the last digit, fast, and their bifurcations where they are? And attractors and basins?

    python benchmarks/orbits.py                    # all figures
    python benchmarks/orbits.py --only throughput  # one part

One line a figure. Errors are against 50-digit arithmetic; bifurcations against the figures of the issue's reference,
beside the multiplier that makes each one. Typical printout:

    four orbits of 50 digits: largest error of knots                         4.4e-16
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
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Status
from vijax.orbits import continuation, orbit_properties, orbit_search, periodic, switching, symmetry
from vijax.orbits.shooting import Sequence

DATA = Path(__file__).parent.parent / "tests" / "data"
ORBITS = 150_000
RUNS = 5


def say(what: str, value: str) -> None:
    """Print one figure."""
    print(f"{what:<72} {value}", flush=True)


def reference() -> None:
    """Find the 50-digit orbits, from guesses 2 % off."""
    worst = {"knots": 0.0, "penetrations": 0.0, "multipliers": 0.0, "P, relative": 0.0}
    for row in json.loads((DATA / "gradients.json").read_text())["orbits"]:
        t, v, stay, depth = (np.array([float(x) for x in row[name]]) for name in ("t_in", "v_in", "contact", "dmax"))
        order = np.argsort(t)
        knots = np.stack([t, np.abs(v), stay], axis=1)[order]
        pair = impact_pair(*([float(row[name])] for name in ("d", "kappa", "r", "gamma")))
        found = periodic.solve(
            pair, period_1(np.sign(v[order]), 1), jnp.asarray(knots * (1 + 0.02 * np.array([1, -1, 1])))[None]
        )
        multipliers = [complex(*map(float, parts)) for parts in row["multipliers_mp_contact_map"]]
        errors = {
            "knots": np.abs(found.knots[0] - knots).max(),
            "penetrations": np.abs(found.depth[0] - depth[order]).max(),
            "multipliers": min(
                np.abs(found.multipliers[0] - np.array(m)).max() for m in (multipliers, multipliers[::-1])
            ),
            "P, relative": abs(float(orbit_properties.power(found, Harvester())[0]) / float(row["P_J"]) - 1),
        }
        worst = {name: max(worst[name], float(error)) for name, error in errors.items()}
    for name, error in worst.items():
        say(f"four orbits of 50 digits: largest error of {name}", f"{error:.1e}")


def period_1(walls, count: int) -> Sequence:
    """Make sequences of period 1."""
    side = jnp.broadcast_to(jnp.asarray(walls, jnp.int32), (count, len(walls)))
    return Sequence(side, jnp.full(count, 2.0), jnp.zeros(count, bool))


def throughput() -> None:
    """Find symmetric 1:1 orbits of many kappa, closed half way, each from a neighbour's knots, all of them verified."""
    start = orbit_search.search(impact_pair(D, 40.0, 0.5), "RL", guesses=1024)
    start = symmetry.halved(start[np.flatnonzero(np.asarray(symmetry.symmetric(start)))])
    fast = start[jnp.argmax(start.knots[:, 0, 1], keepdims=True)]
    (along,) = continuation.follow(fast, "kappa", (3.0, 400.0))
    say("the branch they lie on: kappa from, to", f"{along.values.min():.4g}, {along.values.max():.4g}")
    kappa = np.geomspace(max(along.values.min(), 3.0), min(along.values.max(), 400.0), ORBITS)
    order = np.argsort(along.values)
    anchor = np.stack(
        [np.interp(kappa[:: STRIDES[0]], along.values[order], x[order]) for x in np.asarray(along.orbit.knots)[:, 0].T],
        axis=-1,
    )
    rates = []
    for _ in range(RUNS + 1):
        begun = time.perf_counter()
        found = solve_all(kappa, anchor)
        rates.append(ORBITS / (time.perf_counter() - begun))
    status, residual = found
    say(
        "orbits per second, verified; median and range of the warm runs",
        f"{np.median(rates[1:]):,.0f} ({min(rates[1:]):,.0f} to {max(rates[1:]):,.0f})",
    )
    say(
        "of these found; largest residual",
        f"{(status == Status.OK).mean():.4%}; {residual[status == Status.OK].max():.1e}",
    )


D = 0.16
STRIDES = (512, 16, 1)


def solve_all(kappa: np.ndarray, anchor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve every 512th from the branch, every 16th from those, the others from those."""
    knots, guess = np.full((kappa.size, 3), np.nan), anchor
    status, residual = np.full(kappa.size, -1), np.full(kappa.size, np.inf)
    for level, stride in enumerate(STRIDES):
        rows = np.arange(0, kappa.size, stride)
        if level:
            rows = rows[rows % STRIDES[level - 1] != 0]
            guess = knots[rows - rows % STRIDES[level - 1]]
        count = rows.size
        pair = ImpactPair(
            *(jnp.asarray(x) for x in (np.full(count, D), kappa[rows], np.full(count, 0.5), np.zeros(count)))
        )
        sequence = Sequence(jnp.ones((count, 1), jnp.int32), jnp.ones(count), jnp.ones(count, bool))
        found = jax.tree.map(np.asarray, periodic.solve(pair, sequence, jnp.asarray(guess)[:, None]))
        knots[rows], status[rows], residual[rows] = found.knots[:, 0], found.status, found.residual
    return status, residual


def bifurcations() -> None:
    """Find bifurcations where the issue's reference has them."""
    rigid = {"d": 0.2, "kappa": None, "r": 0.5}
    met("rigid 1:1 breaks symmetry, d", rigid, "RL", "d", (0.1, 0.3), "pitchfork", 0.2634316)
    met("rigid 1:1 flips, d", rigid, "RL", "d", (0.1, 0.3), "flip", 0.1870781)
    met("rigid 1:2 folds, d", {**rigid, "d": 0.19}, "RLL", "d", (0.1, 0.3), "fold", 0.20158)
    device = Harvester(s=0.2)
    for what, omega, impacts, kind, value in (
        ("soft 1:2 folds, omega", 3.0, "RLL", "fold", 3.13059),
        ("soft 1:1 folds, omega", 4.0, "RL", "fold", 6.8804),
        ("soft 1:1/3T folds, omega", 11.0, "1:1/3T", "fold", 11.8422),
        ("soft 1:1/3T flips, omega", 11.0, "1:1/3T", "flip", 10.3052),
    ):
        at = {"d": 0.2 * (omega / np.pi) ** 2, "kappa": 400 * np.pi / omega, "r": 0.5}
        met(what, at, impacts, "omega", (2.5, 13.0), kind, value, device)


def met(what: str, at: dict, impacts: str, along: str, within, kind: str, known: float, device=None) -> None:
    """Find the point of a kind nearest to the known one, on the branches from one orbit."""
    found = orbit_search.search(impact_pair(**at), impacts, guesses=1024)
    points = [point for one in switching.family(found, along, within, device=device) for point in one.points]
    point = min((point for point in points if point.kind == kind), key=lambda point: abs(point.value - known))
    value = {"flip": -1}.get(kind, 1)
    off = abs(complex(point.orbit.multipliers[0, 0]) - value)
    say(what, f"{point.value:.8f} (reference {known}); multiplier {value} to {off:.0e}")


def attractors() -> None:
    """Count shares of the attractors at d = 0.2, kappa = 3; compute Lyapunov exponents in chaos."""
    found = vijax.basin_fractions(d=0.2, kappa=3.0, r=0.5, starts=20_000, seed=1, merge_mirrors=True)
    for label, share in zip(found["label"].values.ravel(), found["fraction"].values.ravel(), strict=True):
        if share > 0:
            say(f"d 0.2, kappa 3, 20,000 starts: {label}", f"{share:.2%}")
    for wall in ("rigid", "soft"):
        found = vijax.lyapunov(d=0.12, kappa=400.0, r=0.5, wall=wall)
        say(
            f"{wall} d 0.12: Lyapunov exponent a period",
            f"{float(found['lyapunov']):.4f} +- {float(found['lyapunov_stderr']):.4f}",
        )


def diagram() -> None:
    """Compute Fig. 8's orbit diagram: 126 d, five kappa, both directions, 400 periods."""
    seconds = []
    for _ in range(RUNS + 1):
        begun = time.perf_counter()
        vijax.orbit_diagram(
            along="d",
            values=np.linspace(0.3, 0.05, 126),
            kappa=np.array([400, 126.5, 40, 12.65, 4]),
            r=0.5,
            direction="both",
        )
        seconds.append(time.perf_counter() - begun)
    say(
        "orbit diagram of 1,260 points: seconds, first (with compilation); median",
        f"{seconds[0]:.1f}; {np.median(seconds[1:]):.2f}",
    )


def main() -> int:
    """Print the figures."""
    parts = {part.__name__: part for part in (reference, throughput, bifurcations, attractors, diagram)}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=list(parts), help="one part")
    given = parser.parse_args()
    for name, part in parts.items():
        if given.only in (None, name):
            part()
    return 0


if __name__ == "__main__":
    sys.exit(main())
