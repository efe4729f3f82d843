"""Pictures of one motion: where the ball is between the walls, its phase plane, and what its impacts give."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.batch.run_records import Trajectory
from vijax.model.device import Harvester, depth_unit, one_device
from vijax.model.energy import admissible, harvested_energy
from vijax.model.pair import ImpactPair
from vijax.model.sides import at
from vijax.orbits.motion import Curve, curve
from vijax.plots.figure import styled
from vijax.runtime import checks, tiles

_WALL: dict[str, Any] = {"color": "0.8", "linewidth": 0.8}
_BALL: dict[str, Any] = {"color": "black", "linewidth": 0.7}
_POINT: dict[str, Any] = {"marker": "o", "mew": 0, "linestyle": "none"}
_IMPACT: dict[str, Any] = {"color": "tab:red", "markersize": 2.4, **_POINT}
_STROBE: dict[str, Any] = {"color": "tab:blue", "markersize": 3.2, **_POINT}
_GIVEN: dict[str, Any] = {"color": "tab:orange", "markersize": 4.0, **_POINT}
_HARVESTED: dict[str, Any] = {"color": "tab:green", "markersize": 4.0, **_POINT}
_REFUSED: dict[str, Any] = {"color": "red", "marker": "x", "markersize": 6.0, "mew": 0.9, "linestyle": "none"}
_TIME = "$t$ [half forcing periods]"


@styled
def trajectory(pair: ImpactPair, path: Trajectory) -> Figure:
    """Draw one motion from its first impact to its last: displacement over time, and velocity over displacement.

    The walls are grey lines, the onsets of impacts red points, the states at phase 0 blue ones in the phase plane.

    Args:
        pair: The cell, every field a scalar; between impacts the ball moves as linear membranes or rigid walls let it.
        path: What `vijax.trajectory` returned for it, of a single start.

    Raises:
        ValueError: Several starts, no impact, or another membrane than the linear one.
    """
    line, onset, there = _followed(pair, path)
    hits, half = path.impacts, 0.5 * float(pair.d)
    side = np.asarray(hits.side, float)
    figure = Figure(figsize=(6.4, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(line.t, line.u, **_BALL)
    left.plot(onset[there], half * side[there], **_IMPACT)
    left.set(xlabel=_TIME, ylabel="$u$")
    right.plot(line.u, line.v, **_BALL)
    right.plot(half * side[there], np.asarray(hits.v_in)[there], label="impacts", **_IMPACT)
    right.plot(np.asarray(path.states.u), np.asarray(path.states.v), label="phase 0", **_STROBE)
    right.set(xlabel="$u$", ylabel=r"$\dot{u}$")
    for wall in (-half, half):
        left.axhline(wall, zorder=0, **_WALL)
        right.axvline(wall, zorder=0, **_WALL)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, handlelength=1.0)
    return figure


@styled
def energies(pair: ImpactPair, path: Trajectory, device: Harvester | None = None) -> Figure:
    """Draw the energy of one motion over time: that of the moving ball, and what each impact gives and yields.

    Above is the kinetic energy of the ball as the capsule sees it. Below, each impact has the energy that it gives to
    the membrane and the energy harvested from it. A cross marks an inadmissible impact: it breaks a limit of the
    device, that of the energy ratio or that of the penetration.

    Args:
        pair, path: As in `trajectory`.
        device: Gives A, omega (the units), omega0 where walls are rigid, and the electrical constants; Tables I and II
            unless given. The pair is what counts for the motion.

    Raises:
        ValueError: As `trajectory`.
    """
    device = one_device(device)
    line, onset, there = _followed(pair, path)
    speed = float(device.speed_unit)
    side = np.asarray(path.impacts.side)[there]
    depth = np.asarray(path.impacts.depth)[there] * np.asarray(at(depth_unit(device, pair), side))
    given = float(device.m_b) * speed**2 * np.asarray(path.impacts.work)[there]
    harvested = np.asarray(harvested_energy(device.at(side), depth))
    refused = ~np.asarray(admissible(device.at(side), *tiles.arrays((harvested, given, depth))))
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    upper, lower = figure.subplots(2, sharex=True)
    upper.plot(line.t, 0.5 * float(device.m_b) * (speed * line.v) ** 2, **_BALL)
    upper.set(ylabel="kinetic energy [J]", ylim=(0, None))
    upper.ticklabel_format(axis="y", scilimits=(0, 0))
    time = onset[there]
    _on_log_axis(lower, time, given, "given to the membrane", _GIVEN)
    _on_log_axis(lower, time, harvested, "harvested", _HARVESTED)
    if refused.any():
        _on_log_axis(lower, time[refused], harvested[refused], "inadmissible: beyond a limit of the device", _REFUSED)
    lower.set(xlabel=_TIME, ylabel="energy of an impact [J]", yscale="log")
    lower.margins(y=0.25)  # of decades: points of nearly one height would else stand at its edges
    figure.legend(loc="outside lower center", ncols=3, frameon=False, handlelength=1.0)
    return figure


def _on_log_axis(axes: Axes, time: np.ndarray, energy: np.ndarray, text: str, style: dict[str, Any]) -> None:
    """Draw energies, all that are more than nothing: an elastic wall is given none."""
    shown = energy > 0
    axes.plot(time[shown], energy[shown], label=text, **style)


def _followed(pair: ImpactPair, path: Trajectory) -> tuple[Curve, np.ndarray, np.ndarray]:
    """Lay one motion on a curve; give it, the onsets of impacts on its clock, and which records hold an impact."""
    checks.instance("path", path, Trajectory, "vijax.trajectory(...)")
    checks.instance("pair", pair, ImpactPair, "vijax.impact_pair(...)")
    hits = path.impacts
    if np.ndim(hits.t) != 1:
        raise ValueError(f"path must be of a single start; got impacts of shape {np.shape(hits.t)}; take one of them")
    if not int(path.filled):
        raise ValueError("path must hold an impact; got none; follow the motion for more periods")
    if pair.r is None:
        raise ValueError("pair must have r, a number, for the contacts to be drawn; got None, as other membranes take")
    onset, side = 2 * np.asarray(hits.n) + np.asarray(hits.t), np.asarray(hits.side, float)
    line = curve(pair, onset, side, hits.v_in, hits.v_out, hits.duration)
    return line, onset, side != 0
