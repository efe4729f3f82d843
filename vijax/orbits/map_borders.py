"""Borders between differently labelled cells of a map, and which of them lie at a curve."""

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.model.label import label
from vijax.model.quantities import PARAMETERS
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

_NEEDED = ("period", "impacts_left", "impacts_right", "status")


@dataclass(frozen=True)
class LabelledPlane:
    """A map of labels over two parameters.

    Attributes:
        along: Both parameters, the first along rows.
        axes: Their values, ascending.
        names: Label of each cell; "" where the motion is not periodic, or has no impacts. Mirror images have one.
        period: Forcing periods of each cell's motion.
        cells: d, kappa (None at rigid walls), r, gamma, u0 and v0 of each cell.
    """

    along: tuple[str, str]
    axes: tuple[np.ndarray, np.ndarray]
    names: np.ndarray
    period: np.ndarray
    cells: dict[str, Any]

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Give the bounds of the plane."""
        return {name: (float(axis[0]), float(axis[-1])) for name, axis in zip(self.along, self.axes, strict=True)}


def labelled_plane(dataset: "xr.Dataset") -> LabelledPlane:
    """Read the labels of a map over two parameters.

    Raises:
        ValueError: No dataset with labels, other axes, or no periodic cell.
    """
    checks.variables("dataset", dataset, _NEEDED, "vijax.sweep", "ask for these outputs")
    period = dataset["period"]
    if len(period.dims) != 2 or not set(period.dims) <= set(PARAMETERS):
        raise ValueError(f"dataset must be a map over two parameters; got one over {', '.join(map(str, period.dims))}")
    ordered = dataset.sortby(list(period.dims))
    period = ordered["period"]
    like = {name: ordered[name].broadcast_like(period).transpose(*period.dims).values for name in _NEEDED}
    cells: dict[str, Any] = {"kappa": None}
    for name in ("d", "kappa", "r", "gamma", "u0", "v0"):
        if name in ordered.coords:
            cells[name] = ordered[name].broadcast_like(period).transpose(*period.dims).values
    merge = cells["gamma"] == 0
    names = label(*(like[name] for name in _NEEDED), merge_mirrors=merge)
    impacts = like["impacts_left"] + like["impacts_right"]
    names = np.where((like["period"] > 0) & (impacts > 0), names, "")
    if not (names != "").any():
        raise ValueError("dataset must have periodic cells with impacts, whose orbits curves begin at; got none")
    one, other = map(str, period.dims)
    axes = tuple(np.asarray(ordered[name].values, float) for name in (one, other))
    if min(map(len, axes)) < 2:
        raise ValueError(
            f"dataset must have at least two values along each axis; got {len(axes[0])} and {len(axes[1])}"
        )
    return LabelledPlane((one, other), (axes[0], axes[1]), names, like["period"], cells)


@dataclass(frozen=True)
class Borders:
    """Pairs of neighbouring periodic cells with different labels: where each is, and which axis leads across.

    Attributes:
        cell: Row and column of the cell before, a row a pair.
        axis: 0 where the other is in the next row, 1 in the next column.
    """

    cell: np.ndarray
    axis: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Give the places of the borders in cells, a row each."""
        return self.cell + 0.5 * np.eye(2)[self.axis]

    def __getitem__(self, index: Any) -> "Borders":
        """Pick some."""
        return Borders(self.cell[index], self.axis[index])

    def __len__(self) -> int:
        return len(self.axis)


def borders(plane: LabelledPlane) -> Borders:
    """Find every border between periodic cells."""
    cells, axes = [], []
    for axis in (0, 1):
        last = plane.names.shape[axis] - 1
        here, there = (plane.names.take(np.arange(last) + shift, axis=axis) for shift in (0, 1))
        found = np.argwhere((here != there) & (here != "") & (there != ""))
        cells.append(found)
        axes.append(np.full(len(found), axis))
    return Borders(np.concatenate(cells), np.concatenate(axes))


def near(found: Borders, curve: np.ndarray, plane: LabelledPlane, cells: float = 1.0) -> np.ndarray:
    """Say which borders lie within some cells of a curve, given by its values of both parameters, a row a point."""
    steps = [np.arange(len(axis), dtype=float) for axis in plane.axes]
    place = np.stack([np.interp(curve[:, i], plane.axes[i], steps[i]) for i in (0, 1)], axis=1)
    middle = found.middle
    met = np.zeros(len(found), bool)
    for begin, end in pairwise(place):
        # Only borders near this piece are looked at: a curve has hundreds of pieces, a map thousands of borders.
        low, high = np.minimum(begin, end) - cells, np.maximum(begin, end) + cells
        index = np.flatnonzero(~met & ((middle >= low) & (middle <= high)).all(axis=1))
        if not index.size:
            continue
        step = end - begin
        share = np.clip((middle[index] - begin) @ step / max(step @ step, np.finfo(float).tiny), 0.0, 1.0)
        met[index] = np.linalg.norm(begin + share[:, None] * step - middle[index], axis=1) <= cells
    return met
