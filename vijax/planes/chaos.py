"""Chaos, and what only looks like it: Lyapunov exponents of ensembles, and how long chaos survives."""

from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate
from operator import or_
from typing import TYPE_CHECKING, Unpack

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import Harvester
from vijax.planes import sweep
from vijax.planes.axes import Axes, Parameters
from vijax.planes.basins import check_starts, described, plan_fractions, spread, started
from vijax.planes.dataset import SweepPlan
from vijax.planes.sweep_settings import MOST_STARTS, SPEED, STARTS, SweepSettings
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["lyapunov", "survival"]

# Forcing periods in which the tangent map turns from the identity to the most unstable direction. What it grows by
# meanwhile is no stretching along the motion: only what it grows by in a longer window beyond that is.
_WARM_UP = 100
# Survival is measured at eight instants. Fewer resolve the exponential law less well, more cost a run each.
_INSTANTS = 8
# At an instant a motion is chaotic if its tangent map grows by this power of e in a window of so many forcing periods.
# Chaos of an exponent below 7/200 = 0.035 is not counted.
_WINDOW, _GROWTH = 200, 7.0
# A ball creeps towards motions without impacts, which is not chaos, if both its impacts per forcing period and their
# product with d, the distance that it travels in a period, are below these. In a wide gap chaos has few impacts too.
_RARE, _SLOW = 0.1, 0.025
_SURVIVAL = (
    "share of all starts whose chaos has not ended",
    "mean lifetime of chaos, forcing periods",
    "its standard error",
)
_SPREADS = ("its standard error", "the lowest of the ensemble", "the highest of the ensemble")
# Spread of an ensemble around its start, in parts of the start's displacement and of the unit of velocity. A wider one
# reaches more easily into another basin.
_NEAR = 0.01


@door
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
    """Measure the largest Lyapunov exponent per forcing period of the motion from a start, and its standard error.

    The exact tangent map is multiplied up along an ensemble of motions from starts around the given one, u0 up to 1 %
    nearer to the middle and v0 up to 0.005 off. The map starts from the identity, which biases the exponent of a window
    by some 1.7/periods: the growth in 100 periods before the window, when it turns to the most unstable direction, is
    taken off.

    Args:
        starts: Size of the ensemble, at least 2.
        periods: Forcing periods over which the growth is measured, for every start.
        transient: Forcing periods to drop first: long enough to reach the attractor, and for the starts to part.
        wall, device, progress, axes: As in `sweep`.

    Returns:
        Over the axes `lyapunov` [per forcing period], `lyapunov_stderr`, and `lyapunov_lowest` and `lyapunov_highest`
        of the ensemble: where these lie many standard errors times sqrt(starts) apart, the starts have ended on
        different attractors. NaN where the motion leaves the walls for ever.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.
    """
    import xarray as xr  # here, as importing vijax must not load it

    periods = checks.whole("periods", periods, 1)
    place = spread(checks.whole("starts", starts, 2, MOST_STARTS), None)
    growths = []
    for done, window in enumerate((_WARM_UP, _WARM_UP + periods)):
        settings = SweepSettings(periods=window, until="window", transient=transient, wall=wall)
        planned = sweep.plan(axes, ("lyapunov",), device, settings)
        of = planned.cells.quantities
        check_starts(planned, starts)
        near = started(planned, of["u0"] * (1 - _NEAR * (0.5 + place[0])), of["v0"] + _NEAR * place[1])
        tell = _share_of(progress, done, 2)
        run = sweep.run(near, tell)
        growths.append(run["lyapunov"] * window)
    first, last = growths
    # What sticks to a wall forgets its start altogether.
    exponent = ((last - first) / periods).where(last > -np.inf, -np.inf).where(last.notnull())
    error = exponent.std("start", ddof=1) / starts**0.5
    found = {
        "lyapunov": exponent.mean("start"),
        "lyapunov_stderr": error,
        "lyapunov_lowest": exponent.min("start", skipna=False),
        "lyapunov_highest": exponent.max("start", skipna=False),
    }
    for values, text in zip(found.values(), ("largest Lyapunov exponent per forcing period", *_SPREADS), strict=True):
        values.attrs = described(text)
    return xr.Dataset(found, attrs=run.attrs | {"title": "Largest Lyapunov exponents", "periods": periods})


def _share_of(progress: Callable[[int, int], None] | None, done: int, runs: int) -> Callable[[int, int], None] | None:
    """Pass on the progress of one of several equal runs, `done` of them over, as that of all."""
    tell = checks.function("progress", progress)
    return tell and (lambda now, total: tell(done * total + now, runs * total))


@door
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
    """Measure how long chaos lasts: chaos that ends is a transient, however much it looked like an attractor.

    The chaos of a motion has ended at an instant if the motion is chaotic at no later one: intermittent chaos pauses
    and resumes. So the share of survivors never rises. There are eight instants up to `periods`, and one longer window
    after the last of them. A motion is chaotic at an instant if, in the 200 periods that follow, its tangent map grows
    by e^7 and the ball does not creep. A ball creeps, towards motions without impacts, if it has less than one impact
    in ten periods and travels less than 0.025 units of length in a period. Chaos of an exponent below 0.035 is not
    counted. The share of the motions that survive from one instant to the next gives the mean lifetime, by an
    exponential law.

    Args:
        starts, speed, seed, axes: As in `basin_fractions`.
        periods: The last instant, in forcing periods, at least 8.
        wall, device, progress: As in `sweep`.

    Returns:
        Over the axes, `survival` over `after` [forcing periods], the share of all starts whose chaos has not ended;
        `lifetime` [forcing periods] and `lifetime_stderr`, infinite where no chaos ended, NaN where there was none.

    Raises:
        ValueError, TypeError: Which argument, what must hold, what came. Nothing was run then.

    Source: `tests/planes/test_chaos.py` recovers a known lifetime.
    """
    import xarray as xr  # here, as importing vijax must not load it

    step = checks.whole("periods", periods, _INSTANTS) // _INSTANTS
    after = step * np.arange(1, _INSTANTS + 1)
    planned = plan_fractions(
        axes, device, SweepSettings(periods=_WINDOW, wall=wall), starts=starts, speed=speed, seed=seed
    )
    # The window after the last instant is longer: a motion whose chaos pauses there has time to resume it.
    lengths = [_WINDOW] * _INSTANTS + [max(step, _WINDOW)]
    instants = [*after.tolist(), int(after[-1])]
    chaotic = []
    for done, (instant, length) in enumerate(zip(instants, lengths, strict=True)):
        settings = replace(planned.settings, until="window", transient=instant, periods=length)
        watched = replace(planned, settings=settings, outputs=("impacts_per_period", "lyapunov", "status"))
        found = sweep.run(watched, _share_of(progress, done, len(instants)))
        chaotic.append((found["lyapunov"] * length > _GROWTH) & ~_creeps(found, planned))
    # Chaotic at an instant or at any later one.
    latest = list(accumulate(reversed(chaotic), or_))[:0:-1]
    alive = xr.concat(latest, xr.Variable("after", after, described("forcing periods")))
    before, still = alive.isel(after=slice(None, -1)).values, alive.isel(after=slice(1, None)).values
    result = _lifetime(before.sum((0, -1)), still.sum((0, -1)), step)
    cells = [dim for dim in alive.dims if dim not in ("after", "start")]
    variables = {"survival": alive.mean("start").transpose(..., "after")}
    variables |= {name: xr.DataArray(values, dims=cells) for name, values in result.items()}
    for values, text in zip(variables.values(), _SURVIVAL, strict=True):
        values.attrs = described(text)
    return xr.Dataset(variables, attrs=found.attrs | {"title": "Survival of chaos"})


def _creeps(found: "xr.Dataset", planned: SweepPlan) -> "xr.DataArray":
    """Return where a ball creeps towards motions without impacts."""
    rate = found["impacts_per_period"]
    return (rate <= _RARE) & (rate * planned.cells.quantities["d"] <= _SLOW)


def _lifetime(before: np.ndarray, still: np.ndarray, step: int) -> dict[str, np.ndarray]:
    """Estimate the mean lifetime and its standard error from the numbers of survivors before and after a step."""
    with np.errstate(divide="ignore", invalid="ignore"):
        part = still / before
        rate = abs(np.log(part)) / step
        error = np.sqrt((1 - part) / (part * before)) / (rate * rate * step)
        lifetime = 1 / rate
    return {"lifetime": lifetime, "lifetime_stderr": np.where(part == 1, np.inf, error)}
