"""Impact velocities along a line through the picked cell, in both directions: `vijax.orbit_diagram`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer.plane import Axis, ExploredCell
from vijax.planes.orbit_diagram import orbit_diagram

if TYPE_CHECKING:
    import xarray as xr

POINTS, PERIODS, RECORDED = 96, 200, 8
"""Values along the line, forcing periods of each, and how many of these are shown."""


@dataclass(frozen=True)
class CellLine:
    """Impacts along a line.

    Attributes:
        along: The axis.
        rising, falling: Value of the axis and impact velocity of every impact, [2, impact], as the axis rises or falls.
        dataset: What `orbit_diagram` returned.
    """

    along: str
    rising: np.ndarray
    falling: np.ndarray
    dataset: "xr.Dataset"


def values(axis: Axis) -> np.ndarray:
    """Give the values of the line: evenly spaced over the axis, on its scale."""
    space = np.geomspace if axis.scale == "log" else np.linspace
    return space(axis.values[0], axis.values[-1], POINTS)


def line(cell: ExploredCell, axis: Axis, tell: Callable[[int, int], None]) -> CellLine:
    """Follow the attractor along an axis through a cell, each point from where the last one ended.

    Raises:
        ValueError: An axis of starts, along which nothing can be followed.
    """
    found = orbit_diagram(
        values=values(axis),
        direction="both",
        periods=PERIODS,
        recorded_periods=RECORDED,
        progress=tell,
        **cell.off(axis.name),
    )
    rows = {}
    for way in ("up", "down"):
        speeds = found["v_in"].sel(direction=way)
        place = np.broadcast_to(speeds[axis.name].values[:, None], speeds.shape)
        there = np.isfinite(speeds.values)
        rows[way] = np.unique(np.round(np.stack([place[there], speeds.values[there]]), 12), axis=1)
    return CellLine(axis.name, rows["up"], rows["down"], found)
