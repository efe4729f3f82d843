"""Do the standard errors hold? Averages against runs of 16 times as many periods, quantiles and slopes against others.

    python benchmarks/errors.py                  # all parts; rows are kept in rows/errors.csv
    python benchmarks/errors.py --only sweep     # one part: sweep, response, average
    python benchmarks/errors.py --quick          # fewer cells and runs: does it run?

Every row compares differences with their combined standard errors: z is the difference over them. Its root mean square
is 1 and 0.3 % of it lie beyond 3 where errors hold and are normal.

sweep: `P_stderr` of aperiodic cells, d log-uniform from 0.03 to 10, kappa from 3 to 400, r from 0.2 to 0.95, level and
inclined (gamma up to 0.2). P of the default horizon is set against the same motion over 16 times as many periods, whose
window begins after the first one has ended. Cells that have lost the status `ok` have a row of their own. So have
cells whose chaos has ended by the end of the longer run, on an orbit or in motions that hardly touch a wall: they have
no average to compare with.
response: errors of quantiles, 200 responses with other seeds of the noise, against the quantile of all their impacts.
average: errors of slopes, 40 seeds of random balls and the default lattice against the mean over the seeds.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vijax
from benchmarks import tables
from benchmarks.averages import chaotic_cells
from vijax.batch.simulate import Scale, summarise
from vijax.batch.summary import Summary
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.variables import value_of
from vijax.planes.sweep_settings import SPEED

SEED = 1
CELLS, QUICK_CELLS = 6000, 600  # drawn, level and inclined each; two in five are aperiodic
LONGER = 16
NEUTRAL = 2 / np.pi**2  # gap above which a level ball may fly for ever
RARE, SLOW = 0.1, 0.025  # impacts a period, and d times that, below which chaos has ended; see `vijax.survival`
RESPONSES, QUICK_RESPONSES = 200, 20
SEEDS, QUICK_SEEDS, DEVICES = 40, 6, 8
# d, kappa, r, level and rate of the noise.
SYSTEMS = {
    "d 0.2, kappa 30": (0.2, 30.0, 0.5, 0.05, 16),
    "d 0.12, kappa 80": (0.12, 80.0, 0.5, 0.05, 32),
    "d 0.06, kappa 12": (0.06, 12.0, 0.8, 0.05, 16),
    "d 0.2, kappa 3, two attractors": (0.2, 3.0, 0.5, 0.03, 8),
    "d 2, kappa 20": (2.0, 20.0, 0.6, 0.1, 16),
}


class Row(NamedTuple):
    """How well some standard errors hold.

    Attributes:
        part, scene: What was compared, and where.
        quantity: Of what the error is.
        number: How many differences.
        rms: Root mean square of z.
        beyond_2, beyond_3: Shares of |z| above.
        relative: The median of the error over the value.
    """

    part: str
    scene: str
    quantity: str
    number: int
    rms: float
    beyond_2: float
    beyond_3: float
    relative: float


def row(part: str, scene: str, quantity: str, z: np.ndarray, relative: np.ndarray) -> Row:
    """Sum up differences over their standard errors; a NaN counts as beyond 3."""
    off = np.where(np.isnan(z), np.inf, np.abs(z))
    numbers = [np.sqrt(np.nanmean(z * z)), (off > 2).mean(), (off > 3).mean(), np.nanmedian(relative)]
    return Row(part, scene, quantity, z.size, *(float(x) for x in (numbers if z.size else [np.nan] * 4)))


# --- P of a sweep -----------------------------------------------------------------------------------------------------


class Cells(NamedTuple):
    """Random cells and their starts, level where `tilt` is 0."""

    pair: ImpactPair
    u: np.ndarray
    v: np.ndarray

    def some(self, index: np.ndarray) -> "Cells":
        """Return those with the given indices."""
        return jax.tree.map(lambda x: x[index], self)


def drawn(count: int, tilt: float) -> Cells:
    """Draw cells with gamma up to `tilt`."""
    draw = np.random.default_rng(SEED)
    d, kappa = (np.exp(draw.uniform(np.log(low), np.log(high), count)) for low, high in ((0.03, 10), (3, 400)))
    r, gamma = draw.uniform(0.2, 0.95, count), tilt * draw.uniform(-1, 1, count)
    u, v = draw.uniform(-0.5, 0.5, count) * d, 2 * SPEED * draw.uniform(-1, 1, count)
    return Cells(ImpactPair(*map(jnp.asarray, (d, kappa, r, gamma))), u, v)


def run(cells: Cells, periods: int, **told: Any) -> Summary:
    """Run cells, each until its attractor is certain or its average is found unless told otherwise."""
    device, one = Harvester(), jnp.ones(cells.u.size)
    scale = Scale(one * device.length_unit, one * device.speed_unit, jnp.ones(1), jnp.ones(1))
    u, v = jnp.asarray(cells.u), jnp.asarray(cells.v)
    return summarise(cells.pair, u, v, scale, device, periods=periods, outputs=frozenset({"P"}), **told)


class Longer(NamedTuple):
    """What became of motions in runs that are longer: P with its error, and whether chaos had ended."""

    P: np.ndarray
    P_stderr: np.ndarray
    ended: np.ndarray


def longer(cells: Cells, periods: int) -> Longer:
    """Run cells for 16 times as many periods, and watch what follows."""
    found = run(cells, LONGER * periods)
    after = run(cells, max(4 * periods, 1600), until="window", transient=LONGER * periods)
    rate = np.asarray(after.impacts_per_period)
    creeps = (rate < RARE) & (rate * np.asarray(cells.pair.d) < SLOW)
    P, error = (np.asarray(x)[:, 0] for x in (found.P, found.P_stderr))
    return Longer(P, error, (found.period != 0) | creeps)


def sweep(quick: bool) -> Iterator[Row]:
    """Compare P of aperiodic cells with that of longer runs of the same motion."""
    for scene, tilt in (("level", 0.0), ("gamma to 0.2", 0.2)):
        cells = drawn(QUICK_CELLS if quick else CELLS, tilt)
        first = run(cells, 400)
        index = np.flatnonzero(first.period == 0)
        horizon = np.round(np.asarray(first.periods_run)[index])
        P, error, status = (np.asarray(x)[index].ravel() for x in (first.P, first.P_stderr, first.status))
        far, far_error, ended = np.full((3, index.size), np.nan)
        for periods in np.unique(horizon):
            here = np.flatnonzero(horizon == periods)
            far[here], far_error[here], ended[here] = longer(cells.some(index[here]), int(periods))
        z, relative, d = (P - far) / np.hypot(error, far_error), error / P, np.asarray(cells.pair.d)[index]
        few, goes_on = status == Status.FEW_IMPACTS, ended == 0
        ok = ~few & goes_on
        groups = {
            "all": ok,
            "d below 2/pi^2": ok & (d < NEUTRAL),
            "d from 2/pi^2 to 1": ok & (d > NEUTRAL) & (d < 1),
            "d above 1": ok & (d > 1),
            "run on": ok & (horizon > 400),
            "status few_impacts": few & goes_on,
            "chaos that ends later": ~few & ~goes_on,
        }
        for name, some in groups.items():
            yield row("sweep", f"{scene}, {name}", "P", z[some], relative[some])


# --- quantiles of a response ------------------------------------------------------------------------------------------


def device(d: float, kappa: float, r: float) -> Harvester:
    """Make a device of the given gap, stiffness and restitution."""
    one = Harvester(omega=5 * np.pi)
    return Harvester(omega=5 * np.pi, s=d * float(one.length_unit), omega0=5 * kappa, r=r)


def response(quick: bool) -> Iterator[Row]:
    """Compare quantiles of the speed and depth of impacts with the mean over responses to other noise."""
    for scene, (d, kappa, r, level, rate) in SYSTEMS.items():
        of = device(d, kappa, r)
        seeds = range(1, 1 + (QUICK_RESPONSES if quick else RESPONSES))
        noisy = (vijax.Harmonics() + vijax.Noise(level, rate, seed) for seed in seeds)
        found = [vijax.response(of, excitation, attractors=False, periods=200) for excitation in noisy]
        for name in ("speed", "penetration"):
            values, errors = (
                np.stack([one[f"{name}_quantile{kind}"].values for one in found]) for kind in ("", "_stderr")
            )
            for quantile, value, error in zip(found[0]["quantile"].values, values.T, errors.T, strict=True):
                z = (value - value.mean()) / error
                yield row("response", scene, f"{quantile:g} quantile of {name}", z, error / value)


# --- slopes of an average ---------------------------------------------------------------------------------------------


def average(quick: bool) -> Iterator[Row]:
    """Compare slopes of averages of smooth chaotic devices with the mean over many seeds."""
    count = QUICK_SEEDS if quick else SEEDS
    names = "d", "kappa", "r"
    random: dict[str, list[np.ndarray]] = {name: [] for name in names}
    lattice: dict[str, list[float]] = {name: [] for name in names}
    size: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for of in smooth_devices(2 if quick else DEVICES):
        found = [vijax.average(of, seed=seed) for seed in range(count)]
        even = vijax.average(of)
        for name in names:
            slopes = np.array([float(getattr(one.by_pair, name)) for one in found])
            errors = np.array([float(getattr(one.by_pair_stderr, name)) for one in found])
            # Each is a part of the mean.
            random[name].append((slopes - slopes.mean()) / errors * np.sqrt(count / (count - 1)))
            own = float(getattr(even.by_pair_stderr, name))
            spread = np.hypot(own, slopes.std(ddof=1) / np.sqrt(count))
            lattice[name].append((float(getattr(even.by_pair, name)) - slopes.mean()) / spread)
            size[name].append(errors * float(value_of(of, name) / even.P))
    for name in names:
        relative = np.concatenate(size[name])
        yield row("average", "random balls", f"dlnP/dln {name}", np.concatenate(random[name]), relative)
        yield row("average", "balls on a lattice", f"dlnP/dln {name}", np.array(lattice[name]), relative)


def smooth_devices(count: int) -> Iterator[Harvester]:
    """Find chaotic devices whose averages are smooth."""
    for of in chaotic_cells(100 * count):
        if count and bool(vijax.average(of).smooth):
            yield of
            count -= 1
        if not count:
            return


PARTS: dict[str, Callable[[bool], Iterator[Row]]] = {"sweep": sweep, "response": response, "average": average}


def told(rows: Iterator[Row]) -> Iterator[Row]:
    """Print rows as they come."""
    for one in rows:
        print(
            f"{one.part + ', ' + one.scene + ', ' + one.quantity:<72} {one.number:5d}  rms z {one.rms:.2f}, "
            f"beyond 2 {one.beyond_2:.1%}, beyond 3 {one.beyond_3:.1%}, relative error {one.relative:.2g}",
            flush=True,
        )
        yield one


def main() -> None:
    """Measure, print, keep the rows; of parts that are not measured the rows that are there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="fewer cells and runs")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the rows")
    given = parser.parse_args()
    path = given.rows / ("errors_quick.csv" if given.quick else "errors.csv")
    kept = [one for one in tables.read(path) if one.part not in given.only]
    measured = (one for part in given.only for one in told(partial(PARTS[part], given.quick)()))
    tables.write(path, Row._fields, measured, kept)


if __name__ == "__main__":
    main()
