"""Branch of periodic orbits through a picked cell, with its events, computed by `vijax.follow_families`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.continuation.branch_dataset import branch_dataset
from vijax.continuation.branch_switching import follow_families
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.explorer.analyses.motion import CellMotion
from vijax.explorer.plane import Axis, ExploredCell
from vijax.plots.branch_diagrams import pieces

if TYPE_CHECKING:
    import xarray as xr

MOST_POINTS, MOST_GRAZINGS = 600, 2
"""Most orbits of a branch in each direction, and most grazings that the continuation passes; few, to be quick."""

MOST_SWITCHES = 0
"""Number of branch switchings at flips and pitchforks: none, because `vijax branch` follows the branches there."""


@dataclass(frozen=True)
class CellBranch:
    """Branch of periodic orbits through the orbit of a cell, and the branches that begin on this branch.

    Attributes:
        along: Name of the axis.
        lines: One array [3, orbit] per smooth piece of a branch and per impact of its orbits. The rows are the axis
            values, the impact velocities, and 1 for a stable and 0 for an unstable orbit.
        events: One entry per event and per impact of the orbit there: kind, value of the axis, impact velocity.
        ends: Reasons why the branch through the cell ends, at its first and at its last orbit.
        dataset: Result of `branch_dataset`.
    """

    along: str
    lines: tuple[np.ndarray, ...]
    events: tuple[tuple[str, float, float], ...]
    ends: tuple[str, str]
    dataset: "xr.Dataset"

    @property
    def folds(self) -> tuple[float, ...]:
        """Return the axis values of the folds (points where a branch turns back along the axis), ascending."""
        return tuple(sorted({round(value, 10) for kind, value, _ in self.events if kind.startswith("fold")}))


def branch(cell: ExploredCell, motion: CellMotion, axis: Axis) -> CellBranch:
    """Continue the orbit of a cell along an axis of the map, between the ends of that axis.

    Raises:
        ValueError: The motion is no periodic orbit, or an orbit cannot be continued along the axis.
    """
    if motion.orbit is None:
        raise ValueError(f"cell must have a periodic orbit for a branch to begin at; got {motion.name}; pick another")
    limits = float(axis.values[0]), float(axis.values[-1])
    family_branches = follow_families(
        motion.orbit,
        axis.name,
        limits,
        device=cell.device,
        max_switches=MOST_SWITCHES,
        points=MOST_POINTS,
        settings=ContinuationSettings(max_grazings=MOST_GRAZINGS),
    )
    branches_dataset = branch_dataset(family_branches, cell.device)
    lines, events = [], []
    for index in range(branches_dataset.sizes["branch"]):
        single = branches_dataset.isel(branch=index)
        values, stable, speeds = single[axis.name].values, single["stable"].values, single["v_in"].values
        lines += [
            np.stack([values[piece], speeds[piece, impact], stable[piece]])
            for piece in pieces(single, "v_in")
            for impact in range(speeds.shape[1])
            if np.isfinite(speeds[piece, impact]).any()
        ]
        for kind, value, point in zip(*(single[name].values for name in _EVENT_VARIABLES), strict=True):
            if kind:
                impact_speeds = speeds[int(point)]
                events += [
                    (str(kind), float(value), float(speed)) for speed in impact_speeds[np.isfinite(impact_speeds)]
                ]
    ends = (str(branches_dataset["end_first"].values[0]), str(branches_dataset["end_last"].values[0]))
    return CellBranch(axis.name, tuple(lines), tuple(events), ends, branches_dataset)


# Variables of the dataset that describe an event: the kind, the value of the axis, the index of its orbit.
_EVENT_VARIABLES = ("event", "event_value", "event_point")
