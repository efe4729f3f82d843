"""Pictures of one motion: where the ball is between the walls, and its phase plane."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vijax.batch.run_records import Trajectory
from vijax.model.pair import ImpactPair
from vijax.orbits.motion import curve
from vijax.plots.figure import styled
from vijax.runtime import checks

_WALL: dict[str, Any] = {"color": "0.8", "linewidth": 0.8}
_BALL: dict[str, Any] = {"color": "black", "linewidth": 0.7}
_IMPACT: dict[str, Any] = {"color": "tab:red", "marker": "o", "markersize": 2.4, "mew": 0, "linestyle": "none"}
_STROBE: dict[str, Any] = {"color": "tab:blue", "marker": "o", "markersize": 3.2, "mew": 0, "linestyle": "none"}


@styled
def trajectory(pair: ImpactPair, path: Trajectory) -> Figure:
    """Draw one motion from its first impact to its last: displacement over time, and velocity over displacement.

    The walls are grey lines, the onsets of impacts red points, the states at phase 0 blue ones in the phase plane.

    Args:
        pair: The cell, every field a scalar; between impacts the ball moves as linear membranes or rigid walls let it.
        path: What `vijax.trajectory` returned for it, of a single start.

    Raises:
        ValueError: Several starts, or no impact.
    """
    checks.instance("path", path, Trajectory, "vijax.trajectory(...)")
    hits = path.impacts
    if np.ndim(hits.t) != 1:
        raise ValueError(f"path must be of a single start; got impacts of shape {np.shape(hits.t)}; take one of them")
    if not int(path.filled):
        raise ValueError("path must hold an impact; got none; follow the motion for more periods")
    onset, side = 2 * np.asarray(hits.n) + np.asarray(hits.t), np.asarray(hits.side, float)
    line = curve(pair, onset, side, hits.v_in, hits.v_out, hits.duration)
    half, there = 0.5 * float(pair.d), side != 0
    figure = Figure(figsize=(6.4, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(line.t, line.u, **_BALL)
    left.plot(onset[there], half * side[there], **_IMPACT)
    left.set(xlabel="$t$ [half forcing periods]", ylabel="$u$")
    right.plot(line.u, line.v, **_BALL)
    right.plot(half * side[there], np.asarray(hits.v_in)[there], label="impacts", **_IMPACT)
    right.plot(np.asarray(path.states.u), np.asarray(path.states.v), label="phase 0", **_STROBE)
    right.set(xlabel="$u$", ylabel=r"$\dot{u}$")
    for wall in (-half, half):
        left.axhline(wall, zorder=0, **_WALL)
        right.axvline(wall, zorder=0, **_WALL)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, handlelength=1.0)
    return figure
