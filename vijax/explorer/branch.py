"""The branch through the orbit of a picked cell, with what it meets: `vijax.follow_families`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer.motion import CellMotion
from vijax.explorer.plane import Axis, ExploredCell
from vijax.orbits.branch_dataset import dataset
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.switching import family
from vijax.plots.branch_diagrams import pieces

if TYPE_CHECKING:
    import xarray as xr

MOST_POINTS, MOST_GRAZINGS = 600, 2
"""Orbits of a branch each way, and grazes that it goes through: a page shows what is near, and at once."""

MOST_SWITCHES = 0
"""How often a branch is left for another, at flips and pitchforks: those have branches of their own, a command away."""


@dataclass(frozen=True)
class CellBranch:
    """Branches through a cell and those that begin on them.

    Attributes:
        along: The axis.
        lines: Of each piece of each impact: values, impact velocities and whether it attracts, a row each.
        met: Kind of what was met, value of the axis there, impact velocity there.
        ends: Where and how the branch through the cell ends.
        dataset: What `branch_dataset` made of them.
    """

    along: str
    lines: tuple[np.ndarray, ...]
    met: tuple[tuple[str, float, float], ...]
    ends: tuple[str, str]
    dataset: "xr.Dataset"

    @property
    def folds(self) -> tuple[float, ...]:
        """Give the values at which a branch turns back."""
        return tuple(sorted({round(value, 10) for kind, value, _ in self.met if kind.startswith("fold")}))


def branch(cell: ExploredCell, motion: CellMotion, axis: Axis) -> CellBranch:
    """Follow the orbit of a cell along an axis of the map, between the ends of that axis.

    Raises:
        ValueError: A motion that is no orbit, or an axis along which no orbit can be followed.
    """
    if motion.orbit is None:
        raise ValueError(f"cell must have a periodic orbit for a branch to begin at; got {motion.name}; pick another")
    within = float(axis.values[0]), float(axis.values[-1])
    followed = family(
        motion.orbit,
        axis.name,
        within,
        device=cell.device,
        max_switches=MOST_SWITCHES,
        points=MOST_POINTS,
        settings=ContinuationSettings(max_grazings=MOST_GRAZINGS),
    )
    found = dataset(followed, cell.device)
    lines, met = [], []
    for index in range(found.sizes["branch"]):
        one = found.isel(branch=index)
        values, stable, speeds = one[axis.name].values, one["stable"].values, one["v_in"].values
        lines += [
            np.stack([values[piece], speeds[piece, hit], stable[piece]])
            for piece in pieces(one, "v_in")
            for hit in range(speeds.shape[1])
            if np.isfinite(speeds[piece, hit]).any()
        ]
        for kind, value, place in zip(*(one[name].values for name in _MET), strict=True):
            if kind:
                own = speeds[int(place)]
                met += [(str(kind), float(value), float(speed)) for speed in own[np.isfinite(own)]]
    ends = (str(found["end_first"].values[0]), str(found["end_last"].values[0]))
    return CellBranch(axis.name, tuple(lines), tuple(met), ends, found)


_MET = ("event", "event_value", "event_point")
