"""The motion of a picked cell: its label and results, phase plane, course (u and v over time) and impacts.

`vijax.sweep` computes the label and the results. `vijax.orbit_diagram` at one point computes the state of the ball
after `SETTLE` forcing periods. From this state, `vijax.orbits_from_states` solves for a periodic orbit, with its course
and multipliers. If the motion is no such orbit, `vijax.trajectory` simulates the motion from this state.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.explorer.plane import ExploredCell
from vijax.maps.orbit_diagram import orbit_diagram
from vijax.maps.sweep import sweep
from vijax.model.device import depth_unit
from vijax.model.energy import admissible, harvested_energy
from vijax.model.label import label
from vijax.model.records import Impact, Status
from vijax.model.walls.sides import at_wall
from vijax.orbits import orbit_properties
from vijax.orbits.motion import curve
from vijax.orbits.orbit_search import orbits_from_states
from vijax.orbits.periodic import Orbit
from vijax.runtime import tiles
from vijax.simulation.trajectory import trajectory

if TYPE_CHECKING:
    import xarray as xr

SETTLE = 400
"""Forcing periods that are simulated before the motion is shown, so that transients decay."""

MOST_IMPACTS = 24
"""Most impacts of an orbit computed by Newton's method (1 s at 36 impacts, 10 s at 82); longer orbits are simulated."""

_APERIODIC_PERIODS = 16  # forcing periods shown of a motion that is not periodic
_LONGEST = 64  # most forcing periods shown of a periodic motion that is simulated, not solved by Newton's method
_SAMPLES = 32  # samples of each contact and of each flight


@dataclass(frozen=True)
class CellMotion:
    """The motion of a picked cell.

    Attributes:
        name: Label n:m/pT, or "aperiodic", "no impact" and similar.
        numbers: Variables of `sweep` in this cell.
        status: How the simulation ended.
        multipliers: Floquet multipliers of the orbit; empty without an orbit.
        orbit: The orbit, with a leading axis of length one; None if no orbit was computed.
        t, u, v: Times, displacements and velocities of the ball, NaN between disjoint pieces. The time is in half
            forcing periods; 0 is the start of a forcing period.
        span: Length of the shown time interval in half forcing periods.
        impacts: One array over the impacts of the shown interval per name: t, u, v, harvested [J], transferred [J],
            depth [m], admissible (1 or 0).
        half: Half the gap.
        end: Displacement and velocity at phase 0 after `SETTLE` periods; the shown motion is computed from this state.
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
    """Compute the motion of a cell.

    Raises:
        ValueError: The cell's parameters are invalid, as in `sweep` and `trajectory`.
    """
    dataset = sweep(device=cell.device, **cell.settings, **cell.arguments)
    numbers = {str(name): float(variable.values) for name, variable in dataset.data_vars.items()}
    period, status = int(numbers["period"]), Status(int(numbers["status"]))
    name = str(_name(dataset))
    end = _state_after_transient(cell)
    few_impacts = 0 < numbers["impacts_left"] + numbers["impacts_right"] <= MOST_IMPACTS
    orbit = _orbit(cell, end, period, name) if few_impacts and period > 0 and np.isfinite(end).all() else None
    if orbit is not None:
        course, impacts, span = _orbit_course(cell, orbit)
    else:
        course, impacts, span = _simulated_course(
            cell, end, min(period, _LONGEST) if period > 0 else _APERIODIC_PERIODS
        )
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
        impacts=_impacts(cell, impacts, span),
        half=0.5 * float(cell.pair.d),
        end=end,
    )


def _state_after_transient(cell: ExploredCell) -> tuple[float, float]:
    """Return u and v after `SETTLE` periods, by `orbit_diagram`, which takes a third of the time of `trajectory`."""
    # The diagram has a single value, so its axis does not matter; r is an axis that every cell has.
    dataset = orbit_diagram(
        values=[cell.arguments[cell.r]],
        direction="up",
        periods=SETTLE,
        recorded_periods=1,
        **cell.diagram_arguments(cell.r),
    )
    return float(dataset["u_strobe"].values[0, -1]), float(dataset["v_strobe"].values[0, -1])


def _name(dataset: "xr.Dataset") -> Any:
    return label(*(dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status")))


def _orbit(cell: ExploredCell, state: tuple[float, float], period: int, name: str) -> Orbit | None:
    """Return the orbit that Newton's method finds from a state; None if it fails or finds an orbit of another label.

    `name` is the label that `sweep` has computed.
    """
    orbit = orbits_from_states(cell.pair, *state, period=period)
    if int(orbit.status[0]) != Status.OK or str(orbit_properties.orbit_labels(orbit)[0]) != name:
        return None
    return orbit


def _orbit_course(cell: ExploredCell, orbit: Orbit) -> tuple[list[np.ndarray], Impact, float]:
    """Return the course [t, u, v], the impacts and the period of an orbit; the course is one period from phase 0."""
    orbit_impacts = orbit_properties.orbit_impacts(orbit)
    rows: Any = [
        np.asarray(row)[0]
        for row in (
            orbit_impacts.n,
            orbit_impacts.t,
            orbit_impacts.side,
            orbit_impacts.v_in,
            orbit_impacts.v_out,
            orbit_impacts.depth,
        )
    ]
    is_impact = rows[2] != 0
    n, t, side, v_in, v_out, depth = (row[is_impact] for row in rows)
    duration, work = np.asarray(orbit_impacts.duration)[0][is_impact], np.asarray(orbit_impacts.work)[0][is_impact]
    span = 2.0 * int(orbit_properties.counts(orbit).period[0])
    impact = Impact(n=n, t=t, side=side, v_in=v_in, v_out=v_out, depth=depth, duration=duration, work=work)
    onset = 2 * n + t
    # The impacts of two periods, so that the curve contains one whole period that begins at phase 0.
    twice = [np.concatenate([onset, onset + span, onset[:1] + 2 * span])]
    twice += [np.concatenate([row, row, row[:1]]) for row in (side.astype(float), v_in, v_out, duration)]
    line = curve(cell.pair, *twice, samples=_SAMPLES)
    begin = span * math.ceil(onset[0] / span)
    return _window(line, begin, span), impact, span


def _simulated_course(
    cell: ExploredCell, end: tuple[float, float], periods: int
) -> tuple[list[np.ndarray], Impact, float]:
    """Return the course [t, u, v], the impacts and the time interval of a simulated motion.

    The course is empty if the motion has no impact or the state `end` is not finite.
    """
    if not np.isfinite(end).all():
        return [np.empty(0)] * 3, _empty_impacts(), 2.0 * periods
    # Two periods more than shown: the course begins at an impact and ends at one, and must cover all shown periods.
    path = trajectory(cell.pair, *end, periods=periods + 2)
    impacts = _select_impacts(path.impacts, np.asarray(path.impacts.side) != 0)
    onset = 2 * impacts.n + impacts.t
    line = curve(
        cell.pair, onset, impacts.side.astype(float), impacts.v_in, impacts.v_out, impacts.duration, samples=_SAMPLES
    )
    begin = 2.0 if onset.size and onset[0] < 2.0 else 0.0
    inside = (onset >= begin) & (onset < begin + 2.0 * periods)
    in_window = _select_impacts(impacts, inside)
    in_window = replace(in_window, n=in_window.n - int(begin / 2))
    return _window(line, begin, 2.0 * periods), in_window, 2.0 * periods


def _select_impacts(impacts: Impact, selection: Any) -> Impact:
    """Select impacts by NumPy, because JAX would compile one program for every number of selected impacts."""
    rows: dict[str, Any] = {name: np.asarray(row)[selection] for name, row in vars(impacts).items()}
    return Impact(**rows)


def _empty_impacts() -> Impact:
    rows: dict[str, Any] = {name: np.empty(0) for name in Impact.__dataclass_fields__}
    return Impact(**rows)


def _window(line: Any, begin: float, span: float) -> list[np.ndarray]:
    """Return the part [t, u, v] of a course with times `begin` to `begin + span`; the new time is 0 at `begin`.

    States at the two ends are interpolated linearly.
    """
    t = line.t - begin
    inside = (t > 0) & (t < span)
    ends = [(low, high) for low, high in ((0.0, 0), (span, -1)) if t.size and t[0] <= low <= t[-1]]
    rows = [t, np.asarray(line.u), np.asarray(line.v)]
    cut = [row[inside] for row in rows]
    for end, last in ends:
        values = (end, *(float(np.interp(end, t, row)) for row in rows[1:]))
        cut = [np.insert(row, row.size if last else 0, value) for row, value in zip(cut, values, strict=True)]
    return cut


def _impacts(cell: ExploredCell, records: Impact, span: float) -> dict[str, np.ndarray]:
    """Return arrays over the impacts by name: t, u, v, harvested and transferred energy [J], depth [m], admissible."""
    device, speed = cell.device, float(cell.device.speed_unit)
    side = np.asarray(records.side)
    depth = np.asarray(records.depth) * np.asarray(at_wall(depth_unit(device, cell.pair), side))
    transferred = float(device.m_b) * speed**2 * np.asarray(records.work)
    harvested = np.asarray(harvested_energy(device.at(side), depth))
    is_admissible = np.asarray(admissible(device.at(side), *tiles.arrays((harvested, transferred, depth))))
    return {
        "t": np.mod(2 * np.asarray(records.n) + np.asarray(records.t), span),
        "u": 0.5 * float(cell.pair.d) * np.asarray(records.side, float),
        "v": np.asarray(records.v_in, float),
        "harvested": harvested.astype(float),
        "transferred": transferred,
        "depth": depth,
        "admissible": is_admissible.astype(int),
    }
