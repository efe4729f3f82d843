"""Are standard errors correct? Averages against runs with 16 times the periods, quantiles and slopes against others.

    python benchmarks/errors.py                  # all parts; rows are stored in rows/errors.csv
    python benchmarks/errors.py --only sweep     # one part: sweep, response, average
    python benchmarks/errors.py --quick          # fewer cells and runs: does it run?

Every row compares differences with their combined standard errors: z is the ratio. If errors are correct and normal,
the root mean square of z is 1 and 0.3 % of |z| exceed 3.

sweep: `P_stderr` of aperiodic cells, d log-uniform from 0.03 to 10, kappa from 3 to 400, r from 0.2 to 0.95, level and
inclined (gamma up to 0.2). P of the default horizon is compared with the motion over 16 times as many periods, in
a window after the first one. Cells without the status `ok` have their own row. So do cells that leave chaos before the
end of the longer run, for an orbit or for motions with rare impacts: no average exists for comparison.
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
from vijax.maps.sweep_settings import SPEED
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.tuned_quantities import value_of
from vijax.simulation.simulate import Scale, summarise
from vijax.simulation.summary import Summary

SEED = 1
CELLS, QUICK_CELLS = 6000, 600  # drawn, level and inclined each; two in five are aperiodic
LONGER = 16
NEUTRAL = 2 / np.pi**2  # gap above which a level motion without impacts exists
RARE, SLOW = 0.1, 0.025  # impacts a period, and d times that rate, below which chaos has ended; see `vijax.survival`
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
    """Accuracy of some standard errors.

    Attributes:
        part, scene: Compared quantity and system.
        quantity: Quantity with the standard error.
        number: Number of differences.
        rms: Root mean square of z.
        above_2, above_3: Fractions of |z| above 2 and 3.
        relative: Median of the relative error.
    """

    part: str
    scene: str
    quantity: str
    number: int
    rms: float
    above_2: float
    above_3: float
    relative: float


def row(part: str, scene: str, quantity: str, z: np.ndarray, relative: np.ndarray) -> Row:
    """Summarise differences over their standard errors; NaN counts as above 3."""
    absolute_z = np.where(np.isnan(z), np.inf, np.abs(z))
    numbers = [np.sqrt(np.nanmean(z * z)), (absolute_z > 2).mean(), (absolute_z > 3).mean(), np.nanmedian(relative)]
    return Row(part, scene, quantity, z.size, *(float(x) for x in (numbers if z.size else [np.nan] * 4)))


# --- P of a sweep -----------------------------------------------------------------------------------------------------


class Cells(NamedTuple):
    """Random cells and their starts, level where `tilt` is 0."""

    pair: ImpactPair
    u: np.ndarray
    v: np.ndarray

    def subset(self, index: np.ndarray) -> "Cells":
        """Return the cells with the given indices."""
        return jax.tree.map(lambda x: x[index], self)


def drawn(count: int, tilt: float) -> Cells:
    """Draw cells with gamma up to `tilt`."""
    draw = np.random.default_rng(SEED)
    d, kappa = (np.exp(draw.uniform(np.log(low), np.log(high), count)) for low, high in ((0.03, 10), (3, 400)))
    r, gamma = draw.uniform(0.2, 0.95, count), tilt * draw.uniform(-1, 1, count)
    u, v = draw.uniform(-0.5, 0.5, count) * d, 2 * SPEED * draw.uniform(-1, 1, count)
    return Cells(ImpactPair(*map(jnp.asarray, (d, kappa, r, gamma))), u, v)


def run(cells: Cells, periods: int, **print_rows: Any) -> Summary:
    """Run cells, by default until the attractor is certain or the average is converged."""
    device, unit = Harvester(), jnp.ones(cells.u.size)
    scale = Scale(unit * device.length_unit, unit * device.speed_unit, jnp.ones(1), jnp.ones(1))
    u, v = jnp.asarray(cells.u), jnp.asarray(cells.v)
    return summarise(cells.pair, u, v, scale, device, periods=periods, outputs=frozenset({"P"}), **print_rows)


class Longer(NamedTuple):
    """Results of longer runs: P with its error, and whether chaos has ended."""

    P: np.ndarray
    P_stderr: np.ndarray
    ended: np.ndarray


def longer(cells: Cells, periods: int) -> Longer:
    """Run cells for 16 times as many periods, and a window after them."""
    long_run = run(cells, LONGER * periods)
    after = run(cells, max(4 * periods, 1600), until="window", transient=LONGER * periods)
    rate = np.asarray(after.impacts_per_period)
    rare_impacts = (rate < RARE) & (rate * np.asarray(cells.pair.d) < SLOW)
    P, error = (np.asarray(x)[:, 0] for x in (long_run.P, long_run.P_stderr))
    return Longer(P, error, (long_run.period != 0) | rare_impacts)


def sweep(quick: bool) -> Iterator[Row]:
    """Compare P of aperiodic cells with P of longer runs of the same motion."""
    for scene, tilt in (("level", 0.0), ("gamma to 0.2", 0.2)):
        cells = drawn(QUICK_CELLS if quick else CELLS, tilt)
        first = run(cells, 400)
        index = np.flatnonzero(first.period == 0)
        horizon = np.round(np.asarray(first.periods_run)[index])
        P, error, status = (np.asarray(x)[index].ravel() for x in (first.P, first.P_stderr, first.status))
        longer_P, longer_error, ended = np.full((3, index.size), np.nan)
        for periods in np.unique(horizon):
            rows = np.flatnonzero(horizon == periods)
            longer_P[rows], longer_error[rows], ended[rows] = longer(cells.subset(index[rows]), int(periods))
        z, relative, d = (P - longer_P) / np.hypot(error, longer_error), error / P, np.asarray(cells.pair.d)[index]
        few_impacts, continues = status == Status.FEW_IMPACTS, ended == 0
        ok = ~few_impacts & continues
        groups = {
            "all": ok,
            "d below 2/pi^2": ok & (d < NEUTRAL),
            "d from 2/pi^2 to 1": ok & (d > NEUTRAL) & (d < 1),
            "d above 1": ok & (d > 1),
            "run on": ok & (horizon > 400),
            "status few_impacts": few_impacts & continues,
            "chaos that ends later": ~few_impacts & ~continues,
        }
        for name, selected in groups.items():
            yield row("sweep", f"{scene}, {name}", "P", z[selected], relative[selected])


# --- quantiles of a response ------------------------------------------------------------------------------------------


def device(d: float, kappa: float, r: float) -> Harvester:
    """Return a device with a gap, stiffness and restitution."""
    unit_device = Harvester(omega=5 * np.pi)
    return Harvester(omega=5 * np.pi, s=d * float(unit_device.length_unit), omega0=5 * kappa, r=r)


def response(quick: bool) -> Iterator[Row]:
    """Compare quantiles of the speed and depth of impacts with the mean over responses to other noise."""
    for scene, (d, kappa, r, level, rate) in SYSTEMS.items():
        system = device(d, kappa, r)
        seeds = range(1, 1 + (QUICK_RESPONSES if quick else RESPONSES))
        noisy = (vijax.Harmonics() + vijax.Noise(level, rate, seed) for seed in seeds)
        responses = [vijax.response(system, excitation, attractors=False, periods=200) for excitation in noisy]
        for name in ("speed", "penetration"):
            values, errors = (
                np.stack([single[f"{name}_quantile{kind}"].values for single in responses]) for kind in ("", "_stderr")
            )
            for quantile, value, error in zip(responses[0]["quantile"].values, values.T, errors.T, strict=True):
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
    for system in smooth_devices(2 if quick else DEVICES):
        averages = [vijax.average(system, seed=seed) for seed in range(count)]
        lattice_average = vijax.average(system)
        for name in names:
            slopes = np.array([float(getattr(single.by_pair, name)) for single in averages])
            errors = np.array([float(getattr(single.by_pair_stderr, name)) for single in averages])
            # Each seed is part of the mean, so its deviation is too small by sqrt((count - 1)/count).
            random[name].append((slopes - slopes.mean()) / errors * np.sqrt(count / (count - 1)))
            lattice_error = float(getattr(lattice_average.by_pair_stderr, name))
            spread = np.hypot(lattice_error, slopes.std(ddof=1) / np.sqrt(count))
            lattice[name].append((float(getattr(lattice_average.by_pair, name)) - slopes.mean()) / spread)
            size[name].append(errors * float(value_of(system, name) / lattice_average.P))
    for name in names:
        relative = np.concatenate(size[name])
        yield row("average", "random balls", f"dlnP/dln {name}", np.concatenate(random[name]), relative)
        yield row("average", "balls on a lattice", f"dlnP/dln {name}", np.array(lattice[name]), relative)


def smooth_devices(count: int) -> Iterator[Harvester]:
    """Yield chaotic devices with smooth averages."""
    for system in chaotic_cells(100 * count):
        if count and bool(vijax.average(system).smooth):
            yield system
            count -= 1
        if not count:
            return


PARTS: dict[str, Callable[[bool], Iterator[Row]]] = {"sweep": sweep, "response": response, "average": average}


def print_rows(rows: Iterator[Row]) -> Iterator[Row]:
    """Print rows as they are measured."""
    for item in rows:
        print(
            f"{item.part + ', ' + item.scene + ', ' + item.quantity:<72} {item.number:5d}  rms z {item.rms:.2f}, "
            f"above 2 {item.above_2:.1%}, above 3 {item.above_3:.1%}, relative error {item.relative:.2g}",
            flush=True,
        )
        yield item


def main() -> None:
    """Measure the selected parts, print and store their rows; stored rows of other parts remain."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="fewer cells and runs")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the rows")
    options = parser.parse_args()
    path = options.rows / ("errors_quick.csv" if options.quick else "errors.csv")
    other_rows = [item for item in tables.read(path) if item.part not in options.only]
    measured = (item for part in options.only for item in print_rows(partial(PARTS[part], options.quick)()))
    tables.write(path, Row._fields, measured, other_rows)


if __name__ == "__main__":
    main()
