"""The basins of a picked cell: which attractor each start (u0, v0) ends on, by `vijax.basins`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer.plane import ExploredCell
from vijax.planes.basins import basins
from vijax.planes.sweep_settings import SPEED

if TYPE_CHECKING:
    import xarray as xr

SIDE = 100
"""Starts along either axis."""


@dataclass(frozen=True)
class CellBasin:
    """Basins of a cell, and a table of its attractors.

    Attributes:
        place: Of the attractor in the table, [v0, u0].
        u0, v0: Displacements and velocities of the starts.
        labels: Of the attractors, the commonest first.
        fractions: Of all starts that end on each.
        powers: P of each [J per half period].
        dataset: What `basins` returned.
    """

    place: np.ndarray
    u0: np.ndarray
    v0: np.ndarray
    labels: tuple[str, ...]
    fractions: tuple[float, ...]
    powers: tuple[float, ...]
    dataset: "xr.Dataset"


def basin(cell: ExploredCell, tell: Callable[[int, int], None]) -> CellBasin:
    """Find the attractors that coexist in a cell, and their basins."""
    others = {name: value for name, value in cell.arguments.items() if name not in ("u0", "v0")}
    found = basins(v0=np.linspace(-SPEED, SPEED, SIDE), device=cell.device, progress=tell, **cell.settings, **others)
    return CellBasin(
        place=found["basin"].transpose("v0", "u0").values,
        u0=found["u0"].values,
        v0=found["v0"].values,
        labels=tuple(map(str, found["label"].values)),
        fractions=tuple(map(float, found["fraction"].values)),
        powers=tuple(map(float, found["P"].values)),
        dataset=found,
    )
