"""Response of a device to a non-periodic excitation: harvest, impact distributions, and visited attractors.

Many realisations, each with its own start and noise, are simulated. The average over one realisation is one sample, so
the n samples are independent. Standard errors are std/sqrt(n) of the samples, so they include the correlation of the
impacts within a realisation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from vijax.maps import sweep
from vijax.maps.basins import match_attractors, plan_starts, with_starts
from vijax.maps.execution.start_lattice import unit_starts
from vijax.maps.sweep_settings import MOST_STARTS, SPEED, SweepSettings
from vijax.model import energy
from vijax.model.choices import Periods, Walls
from vijax.model.device import Harvester, depth_unit, scalar_device
from vijax.model.forcing.excitation import (
    Excitation,
    Noise,
    Sum,
    check_run_excitation,
    count_periods,
    validate_excitation,
)
from vijax.model.pair import WALLS
from vijax.model.quantities import RESULT_QUANTITIES
from vijax.model.records import State, Status
from vijax.model.walls.sides import as_sides, at_wall
from vijax.runtime import validation
from vijax.runtime.public_api import public_api
from vijax.simulation.trajectory import complete_trajectory

if TYPE_CHECKING:
    import xarray as xr

# Levels of the quantiles, over the impacts of all realisations; one impact in a thousand exceeds the last one.
_QUANTILES = (0.5, 0.9, 0.99, 0.999)
# Least number of impacts above and below a quantile that a standard error requires. With fewer impacts the standard
# error itself is uncertain by more than a third.
_MIN_TAIL_IMPACTS = 10
_FAILED = Status.EVENT_BUDGET, Status.NONFINITE
# Variables of the result -> variables of the table of attractors.
_ATTRACTOR_VARIABLES = {"label": "label", "period": "period", "P_attractor": "P", "admissible": "admissible"}


@public_api
def response(
    device: Harvester | None = None,
    excitation: Excitation | None = None,
    *,
    wall: Walls = "soft",
    realisations: int = 64,
    periods: Periods = 400,
    transient: int = 100,
    bins: int = 50,
    attractors: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> "xr.Dataset":
    """Measure the statistics of a device under a non-periodic excitation, over many realisations.

    ::

        device = vijax.Harvester(omega=5 * np.pi, omega0=150.0, s=0.008)
        found = vijax.response(device, vijax.Harmonics() + vijax.Noise(0.05, 32))
        found.P.item(), found.P_stderr.item(), found.penetration_quantile.sel(quantile=0.999).item()

    Each realisation has its own noise and its own start; the starts are spread over the gap and over velocities as in
    `basin_fractions`. All errors are standard errors over realisations, so they include the correlation within one.

    Args:
        device: One device; Tables I and II by default.
        excitation: Excitation of the capsule; a `Record` is scaled by A and omega of the device. The sine by default.
        wall: "soft", "rigid", "rigid_left" or "rigid_right", as in `sweep`.
        realisations: Number of realisations, at least 2.
        periods: Forcing periods that are measured, after `transient` of them; "all" for the whole length of a record
            that ends.
        transient: Forcing periods to drop first.
        bins: Number of bins of the distributions.
        attractors: Whether to compute the attractors under the excitation without its noise, and the time in their
            basins. Ignored unless the excitation has noise and its other parts repeat every period.
        progress: Called with (stages done, stages in all).

    Returns:
        A dataset of `P` [J per half period] and `power` [W] with `P_stderr` and `power_stderr`, and `P_realisation`;
        `impacts_per_period`; `speed_density` over `impact_speed` [m/s] and `penetration_density` over `penetration` [m]
        (middles of bins) with errors; `speed_quantile`, `penetration_quantile` over `quantile` with errors, which are
        NaN where fewer than 10 impacts lie above or below the quantile; `max_penetration`, `max_impact_speed` over all
        impacts; `beyond_limit`, the fraction of impacts that pass the penetration limit, with its error; `status` of
        every realisation. Failed realisations are excluded from all statistics. Over `attractor`, the most visited
        first: `label`, `period`, `P_attractor` [J per half period] and `admissible` of the noiseless motion;
        `time_share`, the fraction of the periods that begin in its basin, with its error; `losses`, the number of
        departures from the basin; `time_until_lost` [periods], the time in the basin divided by `losses`, infinite
        without a departure, with the error of a Poisson count.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.
    """
    import xarray as xr  # here, as importing vijax must not load it

    device = scalar_device(device)
    validation.validate_choice("wall", wall, WALLS)
    scaled = None if excitation is None else validate_excitation(excitation).nondimensional(device)
    transient = validation.validate_integer("transient", transient, 0)
    task = _ResponseTask(
        device,
        scaled,
        wall,
        validation.validate_integer("realisations", realisations, 2, MOST_STARTS),
        count_periods(periods, scaled, transient),
        transient,
        validation.validate_integer("bins", bins, 1, 10_000),
    )
    check_run_excitation(task.excitation, task.periods + task.transient)
    noiseless = _without_noise(task.excitation) if validation.validate_flag("attractors", attractors) else None
    notify, stages = (
        validation.validate_callable("progress", progress) or (lambda done, total: None),
        1 + (noiseless is not None),
    )
    notify(0, stages)
    impacts = _simulate(task)
    notify(1, stages)
    variables = _harvest_variables(task, impacts) | _distributions(task, impacts)
    if noiseless is not None:
        variables |= _visits(task, noiseless, impacts)
        notify(2, stages)
    attributes = {
        "title": "Response of a vibro-impact pair",
        "excitation": "sine" if excitation is None else f"{excitation}",
    }
    attributes |= {name: getattr(task, name) for name in ("wall", "realisations", "periods", "transient")}
    return xr.Dataset(variables, attrs=attributes)


@dataclass(frozen=True)
class _ResponseTask:
    """The validated arguments of `response`; the excitation is dimensionless."""

    device: Harvester
    excitation: Excitation | None
    wall: Walls
    realisations: int
    periods: int
    transient: int
    bins: int


def _without_noise(excitation: Excitation | None) -> Excitation | None:
    """Return an excitation without its noise; None if it has no noise, or if the rest does not repeat every period."""
    if excitation is None or not excitation.of(Noise):
        return None
    parts = tuple(part for part in excitation.parts if not isinstance(part, Noise))
    noiseless = parts[0] if len(parts) == 1 else Sum(parts)
    return noiseless if parts and noiseless.is_periodic else None


class _Hits(NamedTuple):
    """Every impact of the measured periods, over all realisations that completed.

    Attributes:
        states: State at the beginning of every period, [realisation, period].
        status: Status of every realisation.
        realisation: Realisation of each impact.
        n: Number of the forcing period of each impact, 0 for the first measured period.
        side: Wall of each impact, -1 left or 1 right.
        speed: Speed at the onset of each impact [m/s].
        depth: Greatest penetration of each impact [m].
    """

    states: State
    status: np.ndarray
    realisation: np.ndarray
    n: np.ndarray
    side: np.ndarray
    speed: np.ndarray
    depth: np.ndarray


def _simulate(task: _ResponseTask) -> _Hits:
    """Simulate all realisations, and return their impacts."""
    pair, device = task.device.pair(task.wall), task.device
    unit_gap, unit_speed = unit_starts(task.realisations)
    start = unit_gap * float(pair.d), 2 * SPEED * unit_speed
    run = complete_trajectory(pair, *start, task.transient + task.periods, excitation=task.excitation)
    impacts, states, status = (jax.tree.map(np.asarray, part) for part in (run.impacts, run.states, run.status))
    # A failed realisation is excluded entirely, because the impacts before its failure are a biased sample.
    real = (np.arange(impacts.n.shape[1]) < np.asarray(run.filled)[:, None]) & ~np.isin(status, _FAILED)[:, None]
    # The arrays are padded to the realisation with most impacts and include the transient; both are removed here.
    realisation, index = np.nonzero(real & (impacts.n >= task.transient))
    speed = np.abs(impacts.v_in[realisation, index]) * float(device.speed_unit)
    length = np.asarray(at_wall(depth_unit(device, pair), impacts.side[realisation, index]))
    depth = impacts.depth[realisation, index] * length
    return _Hits(
        states,
        status,
        realisation,
        impacts.n[realisation, index] - task.transient,
        impacts.side[realisation, index],
        speed,
        depth,
    )


def _harvest_variables(task: _ResponseTask, impacts: _Hits) -> dict[str, Any]:
    """Return the variables of harvested energy and of the impact rate."""
    device, periods = task.device, task.periods
    energies = np.asarray(energy.harvested_energy(device.at(impacts.side), impacts.depth))
    count, completed = task.realisations, ~np.isin(impacts.status, _FAILED)
    # Energy per half forcing period, Eq. (36): the sum of E_j over twice the number of periods.
    P = np.where(completed, np.bincount(impacts.realisation, energies, count) / (2 * periods), np.nan)
    rates = (np.bincount(impacts.realisation, minlength=count) / periods)[completed]
    # Half a forcing period lasts pi/omega seconds.
    watts = float(device.omega) / math.pi
    rows = {
        "P": ((), mean := _mean(P[completed]), "J", RESULT_QUANTITIES["P"].text),
        "P_stderr": ((), error := _error(P[completed]), "J", "standard error of P over the realisations"),
        "power": ((), mean * watts, "W", "harvested power, P omega / pi"),
        "power_stderr": ((), error * watts, "W", "standard error of power"),
        "P_realisation": ("realisation", P, "J", "harvested energy per half period of every realisation"),
        "impacts_per_period": ((), _mean(rates), "1", "impacts on both walls per forcing period"),
        "impacts_per_period_stderr": ((), _error(rates), "1", "standard error of impacts_per_period"),
        "status": ("realisation", impacts.status, "1", "how every realisation ended"),
    }
    return {name: _variable(*row) for name, row in rows.items()}


def _distributions(task: _ResponseTask, impacts: _Hits) -> dict[str, Any]:
    """Return the distributions of speeds and penetrations, and the fraction of impacts beyond the penetration limit."""
    limits = as_sides(task.device.depth_limit)
    limit = np.where(impacts.side < 0, float(limits.left), float(limits.right))
    limit_share = _fraction(task, impacts.realisation, (impacts.depth > limit)[None])
    rows: dict[str, tuple[Any, Any, str, str]] = {
        "beyond_limit": ((), limit_share[0][0], "1", "part of the impacts that pass the penetration limit"),
        "beyond_limit_stderr": ((), limit_share[1][0], "1", "standard error of beyond_limit"),
    }
    kinds = (
        ("impact_speed", impacts.speed, "m s-1", "speed at the onset of an impact"),
        ("penetration", impacts.depth, "m", "greatest penetration of an impact"),
    )
    for name, values, unit, text in kinds:
        greatest = values.max(initial=0.0)
        # Without impacts the bins still need a width: 1.
        edges = np.linspace(0, greatest or 1.0, task.bins + 1)
        # The greatest value lies on the last edge, and belongs to the last bin.
        bin_of_impact = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, task.bins - 1)
        fraction, error = _fraction(task, impacts.realisation, bin_of_impact == np.arange(task.bins)[:, None])
        short_name, width = name.removeprefix("impact_"), edges[1]
        quantiles, errors = _quantiles(task, impacts.realisation, values)
        rows_of_kind: dict[str, tuple[Any, Any, str, str]] = {
            name: (name, (edges[1:] + edges[:-1]) / 2, unit, f"{text}, middle of a bin"),
            f"{short_name}_density": (name, fraction / width, f"({unit})-1", f"probability density of the {text}"),
            f"{short_name}_density_stderr": (
                name,
                error / width,
                f"({unit})-1",
                f"standard error of {short_name}_density",
            ),
            "quantile": ("quantile", np.array(_QUANTILES), "1", "part of the impacts that stay below"),
            f"{short_name}_quantile": ("quantile", quantiles, unit, f"quantiles of the {text}"),
            f"{short_name}_quantile_stderr": ("quantile", errors, unit, f"standard error of {short_name}_quantile"),
            f"max_{name}": ((), greatest, unit, f"{text}, the greatest of all"),
        }
        rows |= rows_of_kind
    return {name: _variable(*rows_of_kind) for name, rows_of_kind in rows.items()}


def _fraction(task: _ResponseTask, realisation: np.ndarray, hits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of impacts that are marked in `hits` [row, impact], and its standard error, each [row].

    The fraction is a ratio of sums over realisations; its error is the first-order error of such a ratio.
    """
    count = np.bincount(realisation, minlength=task.realisations)
    if not count.sum():
        return np.full(len(hits), np.nan), np.full(len(hits), np.nan)
    marked = np.stack([np.bincount(realisation, row, task.realisations) for row in hits])
    fraction = marked.sum(axis=1) / count.sum()
    # Linearised ratio estimator: residuals per realisation have mean 0. Their root sum of squares, corrected for n - 1,
    # over the total count is the standard error.
    residual = marked - fraction[:, None] * count
    return fraction, np.sqrt((residual**2).sum(axis=1) * count.size / (count.size - 1)) / count.sum()


def _quantiles(task: _ResponseTask, realisation: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quantiles and their standard errors.

    The fraction of impacts above a quantile has a standard error e over the realisations. The error of the quantile is
    e times the slope d(quantile)/d(level) between the levels 2 e below and 2 e above. The error is NaN if fewer than
    `_MIN_TAIL_IMPACTS` impacts lie above or below the quantile.
    """
    if not values.size:
        none = np.full(len(_QUANTILES), np.nan)
        return none, none
    quantiles = np.quantile(values, _QUANTILES)
    exceeds = values > quantiles[:, None]
    _, error = _fraction(task, realisation, exceeds)
    # The slope is a finite difference over 4 e, because the density at a quantile in the tail is too noisy.
    levels = np.clip(np.array(_QUANTILES) + np.multiply.outer((-2.0, 2.0), error), 0, 1)
    rise, width = np.diff(np.quantile(values, levels), axis=0)[0], np.diff(levels, axis=0)[0]
    above = exceeds.sum(axis=1)
    has_error = np.minimum(above, values.size - above) >= _MIN_TAIL_IMPACTS
    return quantiles, np.where(has_error, error * rise / np.where(width > 0, width, 1.0), np.nan)


def _visits(task: _ResponseTask, noiseless: Excitation, impacts: _Hits) -> dict[str, Any]:
    """Return the fraction of periods in the basin of each noiseless attractor, and the mean time until it is left."""
    # Each state at the beginning of a period is used as a start without noise. The attractor that it reaches identifies
    # the basin that contains the state.
    plan = plan_starts({}, task.device, SweepSettings(wall=task.wall, excitation=noiseless))
    u, v = (x[:, task.transient :] for x in (impacts.states.u, impacts.states.v))
    table = match_attractors(sweep.run(with_starts(plan, *(_starts(x.ravel()) for x in (u, v)))))
    basin = table["basin"].values.reshape(u.shape)
    # [attractor, realisation, period]: whether a period begins in the basin of an attractor.
    inside = basin == np.arange(table.sizes["attractor"])[:, None, None]
    fraction = inside.mean(axis=(1, 2))
    # A departure is a period that begins inside the basin, followed by one that begins outside. The last period is left
    # out, because it has no successor.
    losses = (inside[:, :, :-1] & ~inside[:, :, 1:]).sum(axis=(1, 2))
    residence = np.where(losses > 0, inside[:, :, :-1].sum(axis=(1, 2)) / np.maximum(losses, 1), np.inf)
    # Departures are counted as Poisson events, with the relative error 1/sqrt(losses).
    error = np.where(losses > 0, residence / np.sqrt(np.maximum(losses, 1)), np.inf)
    rows = {
        "time_share": (fraction, "part of the periods that begin in the basin"),
        "time_share_stderr": (_error(inside.mean(axis=2), axis=1), "standard error of time_share"),
        "losses": (losses, "how often the basin was left"),
        "time_until_lost": (residence, "mean time in the basin until it is left, forcing periods"),
        "time_until_lost_stderr": (error, "standard error of time_until_lost, of a count"),
    }
    attractors = {name: table[of].variable for name, of in _ATTRACTOR_VARIABLES.items()}
    return attractors | {name: _variable("attractor", values, "1", text) for name, (values, text) in rows.items()}


def _mean(values: np.ndarray) -> float:
    """Return a mean; NaN for no values."""
    return float(values.mean()) if values.size else math.nan


def _error(values: np.ndarray, axis: int = 0) -> Any:
    """Return the standard error of a mean; NaN for fewer than two values."""
    count = values.shape[axis]
    return values.std(axis=axis, ddof=1) / math.sqrt(count) if count > 1 else math.nan


def _variable(dims: Any, values: Any, unit: str, text: str) -> Any:
    """Return a variable with a unit and a description."""
    import xarray as xr

    return xr.Variable(dims, values, {"units": unit, "long_name": text})


def _starts(values: Any) -> Any:
    """Return values as a variable along the dimension `start`."""
    return _variable("start", values, "1", "of a start")
