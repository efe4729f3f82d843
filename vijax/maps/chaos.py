"""Chaos and transient chaos: Lyapunov exponents of ensembles, and the lifetime of chaos that ends.

The exponent is the growth rate of the exact tangent map, (ln growth over n periods)/n, averaged over starts around one
start. Survival is the fraction of starts with chaos that has not ended at each of several instants; the exponential law
exp(-t/lifetime), fitted to the survival, gives the mean lifetime.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate
from operator import or_
from typing import TYPE_CHECKING, Unpack

import numpy as np

from vijax.maps import sweep
from vijax.maps.axes import Axes, Parameters
from vijax.maps.basins import check_starts_fit, plan_fractions, start_variables, unitless_attributes, with_starts
from vijax.maps.map_dataset import SweepPlan
from vijax.maps.sweep_settings import MOST_STARTS, SPEED, STARTS, SweepSettings
from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["lyapunov", "survival"]

# Forcing periods after which a tangent map that started from the identity points in the most unstable direction. Growth
# during this time does not measure stretching along the motion; only the additional growth of a longer window does.
_WARM_UP = 100
# Number of instants of `survival`, each with a test for chaos. Fewer resolve the exponential law less well; each
# instant costs a run of all starts.
_INSTANTS = 8
# A motion is chaotic at an instant if its tangent map grows by more than exp(_GROWTH) in the next _WINDOW forcing
# periods. Chaos with an exponent below 7/200 = 0.035 is not counted.
_WINDOW, _GROWTH = 200, 7.0
# A ball that creeps towards motions without impacts is not chaotic. It creeps if its impacts per forcing period are at
# most _RARE_IMPACTS, and their product with d, the distance travelled in a period, is at most _SLOW_TRAVEL. The second
# test is needed because chaos in a wide gap has few impacts too.
_RARE_IMPACTS, _SLOW_TRAVEL = 0.1, 0.025
_SURVIVAL = (
    "fraction of all starts with chaos that has not ended",
    "mean lifetime of chaos, forcing periods",
    "its standard error",
)
_SPREADS = ("its standard error", "the lowest of the ensemble", "the highest of the ensemble")
# Spread of an ensemble around its start, relative to the start's displacement and to the unit of velocity. A wider
# ensemble reaches more easily into another basin.
_ENSEMBLE_SPREAD = 0.01


@public_api
def lyapunov(
    *,
    starts: int = STARTS,
    periods: int = 2000,
    transient: int = 500,
    wall: Walls = SweepSettings.wall,
    device: Harvester | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Axes],
) -> "xr.Dataset":
    """Compute the largest Lyapunov exponent per forcing period of the motion from a start, and its standard error.

    The exact tangent maps are multiplied along an ensemble of motions from starts around the specified one, with u0 up
    to 1 % nearer to the middle and v0 changed by up to 0.005. The product starts from the identity, which would bias
    the exponent by some 1.7/periods. Therefore it starts 100 periods before the measured periods, so that it turns to
    the most unstable direction, and its growth in these 100 periods is subtracted.

    Args:
        starts: Size of the ensemble, at least 2.
        periods: Forcing periods over which the growth is measured, for every start.
        transient: Forcing periods to drop first: long enough to reach the attractor, and for the starts to separate.
        wall, device, progress, axes: As in `sweep`.

    Returns:
        Over the axes `lyapunov` [per forcing period], `lyapunov_stderr`, and `lyapunov_lowest` and `lyapunov_highest`
        of the ensemble. If lowest and highest differ by many standard deviations, `lyapunov_stderr` times sqrt(starts),
        the starts have ended on different attractors. NaN where the ball never impacts again.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.
    """
    import xarray as xr  # here, as importing vijax must not load it

    periods = validation.validate_integer("periods", periods, 1)
    offsets = start_variables(validation.validate_integer("starts", starts, 2, MOST_STARTS), None)
    # The growth over the warm-up alone is subtracted from the growth over warm-up and window.
    growths = []
    for done, window in enumerate((_WARM_UP, _WARM_UP + periods)):
        settings = SweepSettings(periods=window, until="window", transient=transient, wall=wall)
        plan = sweep.plan(axes, ("lyapunov",), device, settings)
        quantities = plan.cells.quantities
        check_starts_fit(plan, starts)
        # u0 is moved towards the middle only, so that no start lies beyond a rigid wall.
        ensemble = with_starts(
            plan,
            quantities["u0"] * (1 - _ENSEMBLE_SPREAD * (0.5 + offsets[0])),
            quantities["v0"] + _ENSEMBLE_SPREAD * offsets[1],
        )
        notify = _progress_of_all(progress, done, 2)
        run = sweep.run(ensemble, notify)
        # Exponent times window is the logarithm of the total growth.
        growths.append(run["lyapunov"] * window)
    first, last = growths
    # A ball that sticks to a wall forgets its start: its tangent map is 0 and its exponent -inf.
    exponent = ((last - first) / periods).where(last > -np.inf, -np.inf).where(last.notnull())
    error = exponent.std("start", ddof=1) / starts**0.5
    statistics = {
        "lyapunov": exponent.mean("start"),
        "lyapunov_stderr": error,
        "lyapunov_lowest": exponent.min("start", skipna=False),
        "lyapunov_highest": exponent.max("start", skipna=False),
    }
    for values, text in zip(
        statistics.values(), ("largest Lyapunov exponent per forcing period", *_SPREADS), strict=True
    ):
        values.attrs = unitless_attributes(text)
    return xr.Dataset(statistics, attrs=run.attrs | {"title": "Largest Lyapunov exponents", "periods": periods})


def _progress_of_all(
    progress: Callable[[int, int], None] | None, done: int, runs: int
) -> Callable[[int, int], None] | None:
    """Return a callback that converts the progress of the run after `done` of `runs` equal runs to overall progress."""
    notify = validation.validate_callable("progress", progress)
    return notify and (lambda now, total: notify(done * total + now, runs * total))


@public_api
def survival(
    *,
    starts: int = 1000,
    speed: float = SPEED,
    seed: int | None = None,
    periods: int = 10_000,
    wall: Walls = SweepSettings.wall,
    device: Harvester | None = None,
    progress: Callable[[int, int], None] | None = None,
    **axes: Unpack[Parameters],
) -> "xr.Dataset":
    """Measure the lifetime of chaos: chaos that ends is a transient, even if it looked like an attractor for long.

    The chaos of a motion has ended at an instant if the motion is chaotic neither then nor at a later instant; so chaos
    that pauses and resumes has not ended, and the fraction of survivors never rises. There are eight instants up to
    `periods`, and one longer window after the last of them. A motion is chaotic at an instant if, in the 200 periods
    that follow, its tangent map grows by e^7 and the ball does not creep. A ball creeps, towards motions without
    impacts, if it has less than one impact in ten periods and travels less than 0.025 units of length in a period.
    Chaos of an exponent below 0.035 is not counted. The fraction of the motions that survive from one instant to the
    next gives the mean lifetime, by an exponential law.

    Args:
        starts, speed, seed, axes: As in `basin_fractions`.
        periods: The last instant, in forcing periods, at least 8.
        wall, device, progress: As in `sweep`.

    Returns:
        Over the axes, `survival` over `after` [forcing periods], the fraction of all starts with chaos that has not
        ended; `lifetime` [forcing periods] and `lifetime_stderr`, infinite where no chaos ended, NaN where there was
        none.

    Raises:
        ValueError, TypeError: If an argument is invalid, before anything is simulated; states requirement and value.

    Source: `tests/maps/test_chaos.py` recovers a known lifetime.
    """
    import xarray as xr  # here, as importing vijax must not load it

    step = validation.validate_integer("periods", periods, _INSTANTS) // _INSTANTS
    after = step * np.arange(1, _INSTANTS + 1)
    plan = plan_fractions(
        axes, device, SweepSettings(periods=_WINDOW, wall=wall), starts=starts, speed=speed, seed=seed
    )
    # The window after the last instant is longer, so that a chaotic motion that pauses there has time to resume.
    lengths = [_WINDOW] * _INSTANTS + [max(step, _WINDOW)]
    instants = [*after.tolist(), int(after[-1])]
    chaotic = []
    for done, (instant, length) in enumerate(zip(instants, lengths, strict=True)):
        settings = replace(plan.settings, until="window", transient=instant, periods=length)
        window_plan = replace(plan, settings=settings, outputs=("impacts_per_period", "lyapunov", "status"))
        measured = sweep.run(window_plan, _progress_of_all(progress, done, len(instants)))
        chaotic.append((measured["lyapunov"] * length > _GROWTH) & ~_creeps(measured, plan))
    # True if chaotic at the instant or at any later one: a running OR from the end. The last window only decides
    # survival at the last instant.
    latest = list(accumulate(reversed(chaotic), or_))[:0:-1]
    alive = xr.concat(latest, xr.Variable("after", after, unitless_attributes("forcing periods")))
    # Motions with chaos at an instant, and motions with chaos still at the next instant. For a constant rate, the ratio
    # of their numbers over all starts and instants is the maximum-likelihood survival per step.
    before, survivors = alive.isel(after=slice(None, -1)).values, alive.isel(after=slice(1, None)).values
    result = _lifetime(before.sum((0, -1)), survivors.sum((0, -1)), step)
    cells = [dim for dim in alive.dims if dim not in ("after", "start")]
    variables = {"survival": alive.mean("start").transpose(..., "after")}
    variables |= {name: xr.DataArray(values, dims=cells) for name, values in result.items()}
    for values, text in zip(variables.values(), _SURVIVAL, strict=True):
        values.attrs = unitless_attributes(text)
    return xr.Dataset(variables, attrs=measured.attrs | {"title": "Survival of chaos"})


def _creeps(measured: "xr.Dataset", plan: SweepPlan) -> "xr.DataArray":
    """Return True where a ball creeps towards motions without impacts."""
    rate = measured["impacts_per_period"]
    return (rate <= _RARE_IMPACTS) & (rate * plan.cells.quantities["d"] <= _SLOW_TRAVEL)


def _lifetime(before: np.ndarray, survivors: np.ndarray, step: int) -> dict[str, np.ndarray]:
    """Estimate the mean lifetime of chaos and its standard error, in forcing periods, per cell.

    With the fraction p = survivors/before that survives a step: lifetime = -step/ln p. The binomial variance p (1 -
    p)/before of p gives the error to first order.

    Args:
        before: Survivors at all instants but the last, summed, per cell.
        survivors: Survivors at all instants but the first, summed, per cell.
        step: Forcing periods between two instants.
    """
    # before = 0 (no chaos) gives NaN; survival_rate = 1 (no chaos ended) gives an infinite lifetime. |d lifetime/d p| =
    # step/(p ln^2 p), times the binomial standard error sqrt(p (1 - p)/before), is the error.
    with np.errstate(divide="ignore", invalid="ignore"):
        survival_rate = survivors / before
        rate = abs(np.log(survival_rate)) / step
        error = np.sqrt((1 - survival_rate) / (survival_rate * before)) / (rate * rate * step)
        lifetime = 1 / rate
    return {"lifetime": lifetime, "lifetime_stderr": np.where(survival_rate == 1, np.inf, error)}
