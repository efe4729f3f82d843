"""The response of a device to a rough excitation: what it harvests, how hard it is hit, which attractors it visits."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from vijax.batch.trajectory import complete_trajectory
from vijax.model import energy
from vijax.model.choices import Periods, Walls
from vijax.model.device import Harvester, depth_unit, one_device
from vijax.model.excitation import Excitation, Noise, Sum, check_excitation, counted, instance
from vijax.model.pair import WALLS
from vijax.model.quantities import MEASURED
from vijax.model.records import State, Status
from vijax.model.sides import apart, at
from vijax.planes import sweep
from vijax.planes.basins import matched, plan_starts, started
from vijax.planes.start_places import start_places
from vijax.planes.sweep_settings import MOST_STARTS, SPEED, SweepSettings
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

# Of the impacts of all realisations; the last one is exceeded by one impact in a thousand.
_QUANTILES = (0.5, 0.9, 0.99, 0.999)
# With fewer impacts above a quantile, or below it, its error is not known to a third.
_FEWEST = 10
_FAILED = Status.EVENT_BUDGET, Status.NONFINITE
# Of an attractor's table: what is wanted of it besides the time that is spent there.
_KEPT = {"label": "label", "period": "period", "P_attractor": "P", "admissible": "admissible"}


@door
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
    """Measure what a device does under an excitation that is not periodic, over many realisations.

    ::

        device = vijax.Harvester(omega=5 * np.pi, omega0=150.0, s=0.008)
        found = vijax.response(device, vijax.Harmonics() + vijax.Noise(0.05, 32))
        found.P.item(), found.P_stderr.item(), found.penetration_quantile.sel(quantile=0.999).item()

    A realisation is a start, spread over the gap and over velocities as those of `basin_fractions`, with noise of its
    own. All errors are standard errors, from how realisations differ: they hold correlation within one.

    Args:
        device: One device; Tables I and II unless given.
        excitation: What shakes it; a `Record` is told in the device's units. The sine unless given.
        wall: "soft", "rigid", "rigid_left" or "rigid_right", as in `sweep`.
        realisations: How many, at least 2.
        periods: Forcing periods that are measured, after `transient` of them; "all" of a record that ends.
        transient: Forcing periods to drop first.
        bins: Of the distributions.
        attractors: Whether to find the attractors that the excitation has without its noise, where it has noise, and
            what is left of it repeats every period.
        progress: Called with (stages done, stages in all).

    Returns:
        A dataset of `P` [J per half period] and `power` [W] with `P_stderr` and `power_stderr`, and `P_realisation`;
        `impacts_per_period`; `speed_density` over `impact_speed` [m/s] and `penetration_density` over `penetration` [m]
        (middles of bins) with errors; `speed_quantile`, `penetration_quantile` over `quantile` with errors, NaN where
        fewer than 10 impacts lie beyond; `max_penetration`, `max_impact_speed` of all; `beyond_limit`, the part of
        impacts that pass the penetration limit, with its error; `status` of every realisation, of which those that
        failed count nowhere.
        Over `attractor`, the ones visited longest first: `label`, `period`, `P_attractor` [J per half period] and
        `admissible` of the noiseless motion; `time_share`, the part of the periods that begin in its basin, with its
        error; `losses`, how often it was left; `time_until_lost` [periods], the time there over that, with the
        error of its count; infinite where it never was.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
    """
    import xarray as xr  # here, as importing vijax must not load it

    device = one_device(device)
    checks.choice("wall", wall, WALLS)
    scaled = None if excitation is None else instance(excitation).scaled(device)
    transient = checks.whole("transient", transient, 0)
    asked = _Asked(
        device,
        scaled,
        wall,
        checks.whole("realisations", realisations, 2, MOST_STARTS),
        counted(periods, scaled, transient),
        transient,
        checks.whole("bins", bins, 1, 10_000),
    )
    check_excitation(asked.excitation, asked.periods + asked.transient)
    quiet = _quiet(asked.excitation) if checks.flag("attractors", attractors) else None
    tell, stages = checks.function("progress", progress) or (lambda done, total: None), 1 + (quiet is not None)
    tell(0, stages)
    flown = _fly(asked)
    tell(1, stages)
    found = _harvest(asked, flown) | _distributions(asked, flown)
    if quiet is not None:
        found |= _visits(asked, quiet, flown)
        tell(2, stages)
    attributes = {
        "title": "Response of a vibro-impact pair",
        "excitation": "sine" if excitation is None else f"{excitation}",
    }
    attributes |= {name: getattr(asked, name) for name in ("wall", "realisations", "periods", "transient")}
    return xr.Dataset(found, attrs=attributes)


@dataclass(frozen=True)
class _Asked:
    """What a response was asked for, past the door; the excitation in the units of the device."""

    device: Harvester
    excitation: Excitation | None
    wall: Walls
    realisations: int
    periods: int
    transient: int
    bins: int


def _quiet(excitation: Excitation | None) -> Excitation | None:
    """Give an excitation without its noise, if it has some, and if what is left repeats every period."""
    if excitation is None or not excitation.of(Noise):
        return None
    left = tuple(part for part in excitation.parts if not isinstance(part, Noise))
    rest = left[0] if len(left) == 1 else Sum(left)
    return rest if left and rest.periodic else None


class _Hits(NamedTuple):
    """Every impact of the periods that are measured: whose realisation, on which wall, how fast [m/s], how deep [m]."""

    states: State
    status: np.ndarray
    of: np.ndarray
    n: np.ndarray
    side: np.ndarray
    speed: np.ndarray
    depth: np.ndarray


def _fly(asked: _Asked) -> _Hits:
    """Fly all realisations."""
    pair, device = asked.device.pair(asked.wall), asked.device
    across, fast = start_places(asked.realisations)
    start = across * float(pair.d), 2 * SPEED * fast
    run = complete_trajectory(pair, *start, asked.transient + asked.periods, excitation=asked.excitation)
    impacts, states, status = (jax.tree.map(np.asarray, part) for part in (run.impacts, run.states, run.status))
    # Of a realisation that came to no end what it saw until then says nothing.
    real = (np.arange(impacts.n.shape[1]) < np.asarray(run.filled)[:, None]) & ~np.isin(status, _FAILED)[:, None]
    of, index = np.nonzero(real & (impacts.n >= asked.transient))
    speed = np.abs(impacts.v_in[of, index]) * float(device.speed_unit)
    length = np.asarray(at(depth_unit(device, pair), impacts.side[of, index]))
    depth = impacts.depth[of, index] * length
    return _Hits(states, status, of, impacts.n[of, index] - asked.transient, impacts.side[of, index], speed, depth)


def _harvest(asked: _Asked, flown: _Hits) -> dict[str, Any]:
    """Find what is harvested, and how often the walls are met."""
    device, periods = asked.device, asked.periods
    energies = np.asarray(energy.harvested_energy(device.at(flown.side), flown.depth))
    every, ended = asked.realisations, ~np.isin(flown.status, _FAILED)
    P = np.where(ended, np.bincount(flown.of, energies, every) / (2 * periods), np.nan)
    hits = (np.bincount(flown.of, minlength=every) / periods)[ended]
    watts = float(device.omega) / math.pi
    found = {
        "P": ((), mean := _mean(P[ended]), "J", MEASURED["P"].text),
        "P_stderr": ((), error := _error(P[ended]), "J", "standard error of P over the realisations"),
        "power": ((), mean * watts, "W", "harvested power, P omega / pi"),
        "power_stderr": ((), error * watts, "W", "standard error of power"),
        "P_realisation": ("realisation", P, "J", "harvested energy per half period of every realisation"),
        "impacts_per_period": ((), _mean(hits), "1", "impacts on both walls per forcing period"),
        "impacts_per_period_stderr": ((), _error(hits), "1", "standard error of impacts_per_period"),
        "status": ("realisation", flown.status, "1", "how every realisation ended"),
    }
    return {name: _variable(*told) for name, told in found.items()}


def _distributions(asked: _Asked, flown: _Hits) -> dict[str, Any]:
    """Find how speeds and penetrations are distributed, and what part of the impacts passes the penetration limit."""
    limits = apart(asked.device.depth_limit)
    limit = np.where(flown.side < 0, float(limits.left), float(limits.right))
    beyond = _share(asked, flown.of, (flown.depth > limit)[None])
    found: dict[str, tuple[Any, Any, str, str]] = {
        "beyond_limit": ((), beyond[0][0], "1", "part of the impacts that pass the penetration limit"),
        "beyond_limit_stderr": ((), beyond[1][0], "1", "standard error of beyond_limit"),
    }
    kinds = (
        ("impact_speed", flown.speed, "m s-1", "speed at the onset of an impact"),
        ("penetration", flown.depth, "m", "greatest penetration of an impact"),
    )
    for name, values, unit, text in kinds:
        most = values.max(initial=0.0)
        edges = np.linspace(0, most or 1.0, asked.bins + 1)
        place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, asked.bins - 1)
        share, error = _share(asked, flown.of, place == np.arange(asked.bins)[:, None])
        of, width = name.removeprefix("impact_"), edges[1]
        quantiles, errors = _quantiles(asked, flown.of, values)
        told: dict[str, tuple[Any, Any, str, str]] = {
            name: (name, (edges[1:] + edges[:-1]) / 2, unit, f"{text}, middle of a bin"),
            f"{of}_density": (name, share / width, f"({unit})-1", f"probability density of the {text}"),
            f"{of}_density_stderr": (name, error / width, f"({unit})-1", f"standard error of {of}_density"),
            "quantile": ("quantile", np.array(_QUANTILES), "1", "part of the impacts that stay below"),
            f"{of}_quantile": ("quantile", quantiles, unit, f"quantiles of the {text}"),
            f"{of}_quantile_stderr": ("quantile", errors, unit, f"standard error of {of}_quantile"),
            f"max_{name}": ((), most, unit, f"{text}, the greatest of all"),
        }
        found |= told
    return {name: _variable(*told) for name, told in found.items()}


def _share(asked: _Asked, of: np.ndarray, hits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find what part of the impacts is hit [row, impact], and its standard error as a ratio over realisations."""
    count = np.bincount(of, minlength=asked.realisations)
    if not count.sum():
        return np.full(len(hits), np.nan), np.full(len(hits), np.nan)
    each = np.stack([np.bincount(of, row, asked.realisations) for row in hits])
    share = each.sum(axis=1) / count.sum()
    off = each - share[:, None] * count
    return share, np.sqrt((off**2).sum(axis=1) * count.size / (count.size - 1)) / count.sum()


def _quantiles(asked: _Asked, of: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute quantiles and their standard errors.

    The share of the impacts above a quantile has a standard error e over the realisations. It is multiplied by the
    slope of the quantile between the levels 2 e below and 2 e above. A quantile beyond which too few impacts lie has no
    error, NaN.
    """
    if not values.size:
        none = np.full(len(_QUANTILES), np.nan)
        return none, none
    found = np.quantile(values, _QUANTILES)
    beyond = values > found[:, None]
    _, error = _share(asked, of, beyond)
    levels = np.clip(np.array(_QUANTILES) + np.multiply.outer((-2.0, 2.0), error), 0, 1)
    rise, run = np.diff(np.quantile(values, levels), axis=0)[0], np.diff(levels, axis=0)[0]
    above = beyond.sum(axis=1)
    known = np.minimum(above, values.size - above) >= _FEWEST
    return found, np.where(known, error * rise / np.where(run > 0, run, 1.0), np.nan)


def _visits(asked: _Asked, quiet: Excitation, flown: _Hits) -> dict[str, Any]:
    """Find in which basin of the noiseless device each period begins, and how long a basin is kept to."""
    planned = plan_starts({}, asked.device, SweepSettings(wall=asked.wall, excitation=quiet))
    u, v = (x[:, asked.transient :] for x in (flown.states.u, flown.states.v))
    table = matched(sweep.run(started(planned, *(_starts(x.ravel()) for x in (u, v)))))
    basin = table["basin"].values.reshape(u.shape)
    inside = basin == np.arange(table.sizes["attractor"])[:, None, None]
    share = inside.mean(axis=(1, 2))
    losses = (inside[:, :, :-1] & ~inside[:, :, 1:]).sum(axis=(1, 2))
    stay = np.where(losses > 0, inside[:, :, :-1].sum(axis=(1, 2)) / np.maximum(losses, 1), np.inf)
    error = np.where(losses > 0, stay / np.sqrt(np.maximum(losses, 1)), np.inf)
    found = {
        "time_share": (share, "part of the periods that begin in the basin"),
        "time_share_stderr": (_error(inside.mean(axis=2), axis=1), "standard error of time_share"),
        "losses": (losses, "how often the basin was left"),
        "time_until_lost": (stay, "mean time in the basin until it is left, forcing periods"),
        "time_until_lost_stderr": (error, "standard error of time_until_lost, of a count"),
    }
    kept = {name: table[of].variable for name, of in _KEPT.items()}
    return kept | {name: _variable("attractor", values, "1", text) for name, (values, text) in found.items()}


def _mean(values: np.ndarray) -> float:
    """Compute a mean; NaN of none."""
    return float(values.mean()) if values.size else math.nan


def _error(values: np.ndarray, axis: int = 0) -> Any:
    """Compute the standard error of a mean; NaN of fewer than two."""
    count = values.shape[axis]
    return values.std(axis=axis, ddof=1) / math.sqrt(count) if count > 1 else math.nan


def _variable(dims: Any, values: Any, unit: str, text: str) -> Any:
    import xarray as xr

    return xr.Variable(dims, values, {"units": unit, "long_name": text})


def _starts(values: Any) -> Any:
    """Lay values along the dimension of starts."""
    return _variable("start", values, "1", "of a start")
