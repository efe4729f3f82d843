"""Impact velocities along a line through the picked cell, as the axis rises and falls: a `vijax.orbit_diagram`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer.plane import Axis, ExploredCell
from vijax.maps.orbit_diagram import orbit_diagram

if TYPE_CHECKING:
    import xarray as xr

POINTS, PERIODS, RECORDED = 96, 200, 8
"""Number of values along the line, of forcing periods run at each value, and of last periods with recorded impacts."""


@dataclass(frozen=True)
class CellLine:
    """Impacts along a line through a cell.

    Attributes:
        along: Name of the axis that varies along the line.
        rising, falling: Arrays [2, impact]: the axis value and the velocity of every impact, one array computed with
            rising, one with falling axis values.
        dataset: Result of `orbit_diagram`.
    """

    along: str
    rising: np.ndarray
    falling: np.ndarray
    dataset: "xr.Dataset"


def values(axis: Axis) -> np.ndarray:
    """Return the axis values of the line, evenly spaced on the scale of the axis (linear or logarithmic)."""
    space = np.geomspace if axis.scale == "log" else np.linspace
    return space(axis.values[0], axis.values[-1], POINTS)


def line(cell: ExploredCell, axis: Axis, progress: Callable[[int, int], None]) -> CellLine:
    """Compute the orbit diagram along an axis through a cell.

    Each axis value starts from the final state of the previous value.

    Raises:
        ValueError: The axis is u0 or v0, a start; a motion cannot be continued along a start.
    """
    dataset = orbit_diagram(
        values=values(axis),
        direction="both",
        periods=PERIODS,
        recorded_periods=RECORDED,
        progress=progress,
        **cell.diagram_arguments(axis.name),
    )
    rows = {}
    for direction in ("up", "down"):
        speeds = dataset["v_in"].sel(direction=direction)
        positions = np.broadcast_to(speeds[axis.name].values[:, None], speeds.shape)
        finite = np.isfinite(speeds.values)
        # Repeated impacts of a periodic motion differ by rounding errors only, so values rounded to 12 decimals are
        # equal, and `unique` keeps one of them.
        rows[direction] = np.unique(np.round(np.stack([positions[finite], speeds.values[finite]]), 12), axis=1)
    return CellLine(axis.name, rows["up"], rows["down"], dataset)
