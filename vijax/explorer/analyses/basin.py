"""Basins of a picked cell: the attractor of each start (u0, v0), computed by `vijax.basins`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer.plane import ExploredCell
from vijax.maps.basins import basins
from vijax.maps.sweep_settings import SPEED

if TYPE_CHECKING:
    import xarray as xr

SIDE = 100
"""Number of starts along each of the axes u0 and v0, so 10,000 starts."""


@dataclass(frozen=True)
class CellBasin:
    """Basins of a cell, and the table of its attractors.

    Attributes:
        place: Index of each start's attractor in `labels`, [v0, u0].
        u0, v0: Displacements and velocities of the starts.
        labels: Labels of the attractors, the most frequent first.
        fractions: Fraction of all starts that end on each attractor.
        powers: P of each attractor [J per half period].
        dataset: Result of `basins`.
    """

    place: np.ndarray
    u0: np.ndarray
    v0: np.ndarray
    labels: tuple[str, ...]
    fractions: tuple[float, ...]
    powers: tuple[float, ...]
    dataset: "xr.Dataset"


def basin(cell: ExploredCell, progress: Callable[[int, int], None]) -> CellBasin:
    """Compute the coexisting attractors of a cell and their basins."""
    others = {name: value for name, value in cell.arguments.items() if name not in ("u0", "v0")}
    dataset = basins(
        v0=np.linspace(-SPEED, SPEED, SIDE), device=cell.device, progress=progress, **cell.settings, **others
    )
    return CellBasin(
        place=dataset["basin"].transpose("v0", "u0").values,
        u0=dataset["u0"].values,
        v0=dataset["v0"].values,
        labels=tuple(map(str, dataset["label"].values)),
        fractions=tuple(map(float, dataset["fraction"].values)),
        powers=tuple(map(float, dataset["P"].values)),
        dataset=dataset,
    )
