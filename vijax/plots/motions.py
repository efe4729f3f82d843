"""Pictures of one motion: the ball between the walls, its phase plane, and the energies of its impacts."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.model.device import Harvester, depth_unit, scalar_device
from vijax.model.energy import admissible, harvested_energy
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import at_wall
from vijax.orbits.motion import Curve, curve
from vijax.plots.figure import styled
from vijax.runtime import tiles, validation
from vijax.simulation.run_records import Trajectory

_WALL: dict[str, Any] = {"color": "0.8", "linewidth": 0.8}
_BALL: dict[str, Any] = {"color": "black", "linewidth": 0.7}
_POINT: dict[str, Any] = {"marker": "o", "mew": 0, "linestyle": "none"}
_IMPACT: dict[str, Any] = {"color": "tab:red", "markersize": 2.4, **_POINT}
_STROBE: dict[str, Any] = {"color": "tab:blue", "markersize": 3.2, **_POINT}
_TRANSFERRED: dict[str, Any] = {"color": "tab:orange", "markersize": 4.0, **_POINT}
_HARVESTED: dict[str, Any] = {"color": "tab:green", "markersize": 4.0, **_POINT}
_REFUSED: dict[str, Any] = {"color": "red", "marker": "x", "markersize": 6.0, "mew": 0.9, "linestyle": "none"}
_TIME = "$t$ [half forcing periods]"


@styled
def trajectory(pair: ImpactPair, path: Trajectory) -> Figure:
    """Draw one motion from its first impact to its last: displacement over time, and velocity over displacement.

    The walls are grey lines, the onsets of impacts red points, and the states at phase 0 blue points in the phase
    plane.

    Args:
        pair: Impact pair of the motion, with scalar fields; its walls are linear membranes or rigid.
        path: Result of `vijax.trajectory` for this pair and a single start.

    Raises:
        ValueError: The path has several starts or no impact, or the membrane is not the linear one.
    """
    line, onset, is_impact = _motion_curve(pair, path)
    impacts, half = path.impacts, 0.5 * float(pair.d)
    side = np.asarray(impacts.side, float)
    figure = Figure(figsize=(6.4, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(line.t, line.u, **_BALL)
    left.plot(onset[is_impact], half * side[is_impact], **_IMPACT)
    left.set(xlabel=_TIME, ylabel="$u$")
    right.plot(line.u, line.v, **_BALL)
    right.plot(half * side[is_impact], np.asarray(impacts.v_in)[is_impact], label="impacts", **_IMPACT)
    right.plot(np.asarray(path.states.u), np.asarray(path.states.v), label="phase 0", **_STROBE)
    right.set(xlabel="$u$", ylabel=r"$\dot{u}$")
    for wall in (-half, half):
        left.axhline(wall, zorder=0, **_WALL)
        right.axvline(wall, zorder=0, **_WALL)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, handlelength=1.0)
    return figure


@styled
def energies(pair: ImpactPair, path: Trajectory, device: Harvester | None = None) -> Figure:
    """Draw the energy of one motion over time: the ball's kinetic energy, and the energies of each impact.

    The upper panel is the ball's kinetic energy relative to the capsule. The lower panel shows, per impact, the energy
    transferred to the membrane and the energy harvested from it. A cross marks an inadmissible impact: it exceeds the
    device's limit of the energy ratio or of the penetration.

    Args:
        pair, path: As in `trajectory`.
        device: Supplies A, omega (the units), omega0 if walls are rigid, and the electrical constants; by default
            Tables I and II. The motion depends on the pair alone.

    Raises:
        ValueError: As `trajectory`.
    """
    device = scalar_device(device)
    line, onset, is_impact = _motion_curve(pair, path)
    speed = float(device.speed_unit)
    side = np.asarray(path.impacts.side)[is_impact]
    depth = np.asarray(path.impacts.depth)[is_impact] * np.asarray(at_wall(depth_unit(device, pair), side))
    transferred = float(device.m_b) * speed**2 * np.asarray(path.impacts.work)[is_impact]
    harvested = np.asarray(harvested_energy(device.at(side), depth))
    refused = ~np.asarray(admissible(device.at(side), *tiles.arrays((harvested, transferred, depth))))
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    upper.plot(line.t, 0.5 * float(device.m_b) * (speed * line.v) ** 2, **_BALL)
    upper.set(ylabel="kinetic energy [J]", ylim=(0, None))
    upper.ticklabel_format(axis="y", scilimits=(0, 0))
    time = onset[is_impact]
    _on_log_axis(lower, time, transferred, "given to the membrane", _TRANSFERRED)
    _on_log_axis(lower, time, harvested, "harvested", _HARVESTED)
    if refused.any():
        _on_log_axis(lower, time[refused], harvested[refused], "inadmissible: beyond a limit of the device", _REFUSED)
    lower.set(xlabel=_TIME, ylabel="energy of an impact [J]", yscale="log")
    lower.margins(y=0.25)  # in decades; points of nearly equal height would otherwise lie at the edges
    figure.legend(loc="outside lower center", ncols=3, frameon=False, handlelength=1.0)
    return figure


def _on_log_axis(axes: Axes, time: np.ndarray, energy: np.ndarray, text: str, style: dict[str, Any]) -> None:
    """Draw the positive energies; an elastic wall receives zero, which a logarithmic axis cannot show."""
    positive = energy > 0
    axes.plot(time[positive], energy[positive], label=text, **style)


def _motion_curve(pair: ImpactPair, path: Trajectory) -> tuple[Curve, np.ndarray, np.ndarray]:
    """Return the curve of one motion, the onset times of its records, and a mask of the records that are impacts."""
    validation.validate_instance("path", path, Trajectory, "vijax.trajectory(...)")
    validation.validate_instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")
    impacts = path.impacts
    if np.ndim(impacts.t) != 1:
        raise ValueError(
            f"path must be of a single start; got impacts of shape {np.shape(impacts.t)}; take one of them"
        )
    if not int(path.filled):
        raise ValueError("path must hold an impact; got none; follow the motion for more periods")
    if pair.r is None:
        raise ValueError("pair must have r, a number, for the contacts to be drawn; got None, as other membranes take")
    onset, side = 2 * np.asarray(impacts.n) + np.asarray(impacts.t), np.asarray(impacts.side, float)
    line = curve(pair, onset, side, impacts.v_in, impacts.v_out, impacts.duration)
    return line, onset, side != 0
