"""The motion of a picked cell: what it is called and yields, its phase plane, its course in time, its impacts.

`vijax.sweep` says what it is, `vijax.orbit_diagram` of one point where the ball is once `SETTLE` forcing periods are
over; on a periodic orbit `vijax.orbits_from_states` gives its course and its multipliers from there, on any other
motion `vijax.trajectory` what comes next.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.batch.trajectory import trajectory
from vijax.explorer.plane import ExploredCell
from vijax.model.device import depth_unit
from vijax.model.energy import admissible, harvested_energy
from vijax.model.label import label
from vijax.model.records import Impact, Status
from vijax.model.sides import at
from vijax.orbits import orbit_properties
from vijax.orbits.motion import curve
from vijax.orbits.orbit_search import from_state
from vijax.orbits.periodic import Orbit
from vijax.planes.orbit_diagram import orbit_diagram
from vijax.planes.sweep import sweep
from vijax.runtime import tiles

if TYPE_CHECKING:
    import xarray as xr

SETTLE = 400
"""Forcing periods that a ball is flown before its motion is looked at."""

MOST_IMPACTS = 24
"""Of an orbit that is solved for. Newton's equations of 36 take a second, of 82 ten; longer ones are flown."""

_SHOWN = 16  # forcing periods that are shown of a motion that is no orbit
_LONGEST = 64  # forcing periods that are shown of a longer orbit
_SAMPLES = 32  # instants of each contact and of each flight


@dataclass(frozen=True)
class CellMotion:
    """What a picked cell does.

    Attributes:
        name: The label, n:m/pT, or "aperiodic", "no impact" and the like.
        numbers: Of the variables of `sweep` in this cell.
        status: How it ended.
        multipliers: Floquet multipliers of its orbit; none where there is no orbit.
        orbit: The orbit, along a leading axis of one, where one was found.
        t, u, v: The course, NaN where pieces do not join; time in half forcing periods from a period's begin on.
        span: Half forcing periods that are shown.
        impacts: Those in that time, a column each: t, u, v, harvested [J], given [J], depth [m], admissible (1 or 0).
        half: Half the gap.
        end: Displacement and velocity at phase 0, after all that was flown.
    """

    name: str
    numbers: dict[str, float]
    status: Status
    multipliers: tuple[complex, ...]
    orbit: Orbit | None
    t: np.ndarray
    u: np.ndarray
    v: np.ndarray
    span: float
    impacts: dict[str, np.ndarray]
    half: float
    end: tuple[float, float]


def motion(cell: ExploredCell) -> CellMotion:
    """Find what a cell does.

    Raises:
        ValueError: As `sweep` and `trajectory` do, for a cell that cannot be.
    """
    found = sweep(device=cell.device, **cell.settings, **cell.arguments)
    numbers = {str(name): float(variable.values) for name, variable in found.data_vars.items()}
    period, status = int(numbers["period"]), Status(int(numbers["status"]))
    name = str(_name(found))
    end = _settled(cell)
    short = 0 < numbers["impacts_left"] + numbers["impacts_right"] <= MOST_IMPACTS
    orbit = _orbit(cell, end, period, name) if short and period > 0 and np.isfinite(end).all() else None
    if orbit is not None:
        course, hits, span = _of_orbit(cell, orbit)
    else:
        course, hits, span = _of_flight(cell, end, min(period, _LONGEST) if period > 0 else _SHOWN)
    return CellMotion(
        name=name,
        numbers=numbers,
        status=status,
        multipliers=() if orbit is None else tuple(complex(x) for x in np.asarray(orbit.multipliers)[0]),
        orbit=orbit,
        t=course[0],
        u=course[1],
        v=course[2],
        span=span,
        impacts=_impacts(cell, hits, span),
        half=0.5 * float(cell.pair.d),
        end=end,
    )


def _settled(cell: ExploredCell) -> tuple[float, float]:
    """Fly the ball until it has settled: by a diagram of one point, in a third of the time that a trajectory takes."""
    # Any axis would do, as it has one value.
    found = orbit_diagram(
        values=[cell.arguments[cell.r]],
        direction="up",
        periods=SETTLE,
        recorded_periods=1,
        **cell.off(cell.r),
    )
    return float(found["u_strobe"].values[0, -1]), float(found["v_strobe"].values[0, -1])


def _name(found: "xr.Dataset") -> Any:
    return label(*(found[name].values for name in ("period", "impacts_left", "impacts_right", "status")))


def _orbit(cell: ExploredCell, end: tuple[float, float], period: int, name: str) -> Orbit | None:
    """Find the orbit that the ball has come to, if it is the one that the sweep has named."""
    orbit = from_state(cell.pair, *end, period=period)
    if int(orbit.status[0]) != Status.OK or str(orbit_properties.labels(orbit)[0]) != name:
        return None
    return orbit


def _of_orbit(cell: ExploredCell, orbit: Orbit) -> tuple[list[np.ndarray], Impact, float]:
    """Lay an orbit on its course; what goes beyond its last period is put at the begin of the first."""
    hits = orbit_properties.impacts(orbit)
    rows: Any = [np.asarray(row)[0] for row in (hits.n, hits.t, hits.side, hits.v_in, hits.v_out, hits.depth)]
    there = rows[2] != 0
    n, t, side, v_in, v_out, depth = (row[there] for row in rows)
    duration, work = np.asarray(hits.duration)[0][there], np.asarray(hits.work)[0][there]
    span = 2.0 * int(orbit_properties.counts(orbit).period[0])
    one = Impact(n=n, t=t, side=side, v_in=v_in, v_out=v_out, depth=depth, duration=duration, work=work)
    onset = 2 * n + t
    # Twice around, so that every instant of one turn is on it.
    twice = [np.concatenate([onset, onset + span, onset[:1] + 2 * span])]
    twice += [np.concatenate([row, row, row[:1]]) for row in (side.astype(float), v_in, v_out, duration)]
    line = curve(cell.pair, *twice, samples=_SAMPLES)
    first = span * math.ceil(onset[0] / span)
    return _window(line, first, span), one, span


def _of_flight(cell: ExploredCell, end: tuple[float, float], periods: int) -> tuple[list[np.ndarray], Impact, float]:
    """Fly on from where the ball has come to; where it meets no wall there is no course to draw."""
    if not np.isfinite(end).all():
        return [np.empty(0)] * 3, _no_impacts(), 2.0 * periods
    # A period before and one after, so that the window is full.
    path = trajectory(cell.pair, *end, periods=periods + 2)
    hits = _some(path.impacts, np.asarray(path.impacts.side) != 0)
    onset = 2 * hits.n + hits.t
    line = curve(cell.pair, onset, hits.side.astype(float), hits.v_in, hits.v_out, hits.duration, samples=_SAMPLES)
    begin = 2.0 if onset.size and onset[0] < 2.0 else 0.0
    inside = (onset >= begin) & (onset < begin + 2.0 * periods)
    own = _some(hits, inside)
    own = replace(own, n=own.n - int(begin / 2))
    return _window(line, begin, 2.0 * periods), own, 2.0 * periods


def _some(hits: Impact, which: Any) -> Impact:
    """Pick some impacts, by NumPy: JAX would compile a program for every number of them."""
    rows: dict[str, Any] = {name: np.asarray(row)[which] for name, row in vars(hits).items()}
    return Impact(**rows)


def _no_impacts() -> Impact:
    rows: dict[str, Any] = {name: np.empty(0) for name in Impact.__dataclass_fields__}
    return Impact(**rows)


def _window(line: Any, first: float, span: float) -> list[np.ndarray]:
    """Cut so much time out of a course, its begin at zero; between two instants of it a straight line will do."""
    t = line.t - first
    inside = (t > 0) & (t < span)
    ends = [(low, high) for low, high in ((0.0, 0), (span, -1)) if t.size and t[0] <= low <= t[-1]]
    rows = [t, np.asarray(line.u), np.asarray(line.v)]
    cut = [row[inside] for row in rows]
    for end, last in ends:
        values = (end, *(float(np.interp(end, t, row)) for row in rows[1:]))
        cut = [np.insert(row, row.size if last else 0, value) for row, value in zip(cut, values, strict=True)]
    return cut


def _impacts(cell: ExploredCell, hits: Impact, span: float) -> dict[str, np.ndarray]:
    """Lay out where impacts are on the course, and what each gives and yields."""
    device, speed = cell.device, float(cell.device.speed_unit)
    side = np.asarray(hits.side)
    depth = np.asarray(hits.depth) * np.asarray(at(depth_unit(device, cell.pair), side))
    given = float(device.m_b) * speed**2 * np.asarray(hits.work)
    harvested = np.asarray(harvested_energy(device.at(side), depth))
    good = np.asarray(admissible(device.at(side), *tiles.arrays((harvested, given, depth))))
    return {
        "t": np.mod(2 * np.asarray(hits.n) + np.asarray(hits.t), span),
        "u": 0.5 * float(cell.pair.d) * np.asarray(hits.side, float),
        "v": np.asarray(hits.v_in, float),
        "harvested": harvested.astype(float),
        "given": given,
        "depth": depth,
        "admissible": good.astype(int),
    }
