"""Cells of a map on axes: panels with their edges, veils, borders, and positions of marks."""

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.plots.figure import label_logs
from vijax.plots.style import axis_label, equations, layout

if TYPE_CHECKING:
    import xarray as xr

# Values count as evenly spaced if their steps differ by less than this fraction of their range.
_EVEN = 1e-6
# Maximum number of marks along a side; on a finer map, one mark stands for a block of cells.
MAX_SYMBOLS_PER_SIDE = 128
BARE: dict[str, Any] = {"color": "0.75"}
VEIL: dict[str, Any] = {"facecolor": (1, 1, 1, 0.55), "edgecolor": "0.3", "hatch": "/////", "linewidth": 0}


def panels(dataset: "xr.Dataset", dims: list[str]) -> "tuple[Figure, list[tuple[Axes, xr.Dataset]]]":
    """Return a figure of empty panels with titles and labels, and each panel's part of the dataset, [y, x]."""
    rows, columns = layout({dim: dataset.sizes[dim] for dim in dims})
    size = (5.2, 4.6) if rows * columns == 1 else (1.6 + 2.1 * columns, 1.6 + 1.9 * rows)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    # The grid of panels is [row, column] and cells are [y, x]: the dimensions in reverse order.
    dataset = dataset.sortby(dims[:2]).transpose(*dims[::-1], ...)
    outer = dims[:1:-1]
    filled = []
    for axes, index in itertools.zip_longest(grid.flat, np.ndindex(*(dataset.sizes[dim] for dim in outer))):
        if index is None:
            axes.set_visible(False)
            continue
        panel = dataset.isel(dict(zip(outer, index, strict=True)))
        (across, xscale), (up, yscale) = (edges(panel[dim].values) for dim in dims[:2])
        axes.set(xscale=xscale, yscale=yscale, xlim=across[[0, -1]], ylim=up[[0, -1]], facecolor=BARE["color"])
        label_logs(axes)
        axes.set_title(equations(panel, dims[2:]), fontsize="medium")
        filled.append((axes, panel))
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(dataset[dims[0]]))
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(dataset[dims[1]]))
    return figure, filled


def numbered(dataset: "xr.Dataset") -> "xr.Dataset":
    """Return the dataset with numbers 0, 1, ... in place of texts along a dimension, because axes need numbers."""
    texts = [dim for dim in dataset.dims if dim in dataset.coords and dataset[dim].dtype.kind not in "iuf"]
    return dataset.assign_coords({dim: np.arange(dataset.sizes[dim]) for dim in texts})


def edges(values: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the edges of the cells around ascending values, and the scale of the axis.

    The scale is "log" if the logarithms of the values are evenly spaced, else "linear".
    """
    log = values.size > 2 and values[0] > 0 and np.ptp(np.diff(np.log(values))) < _EVEN * np.log(values[-1] / values[0])
    points = np.log(values) if log else values
    midpoints = 0.5 * (points[1:] + points[:-1])
    # The outer edges extend half a step beyond the first and the last value.
    cell_edges = np.concatenate([[2 * points[0] - midpoints[0]], midpoints, [2 * points[-1] - midpoints[-1]]])
    return (np.exp(cell_edges), "log") if log else (cell_edges, "linear")


def veil(axes: Axes, across: np.ndarray, up: np.ndarray, mask: np.ndarray) -> None:
    """Veil and hatch the cells of the mask."""
    if not mask.any():
        return
    # Every cell is doubled, once per edge: the contour then follows the cells' sides instead of cutting their corners.
    stairs = np.repeat(np.repeat(mask.astype(float), 2, axis=0), 2, axis=1)
    corners = np.repeat(across, 2)[1:-1], np.repeat(up, 2)[1:-1]
    hatching = axes.contourf(*corners, stairs, levels=[0.5, 1.5], colors=[VEIL["facecolor"]], hatches=[VEIL["hatch"]])
    hatching.set(edgecolor=VEIL["edgecolor"], linewidth=0)


def borders(across: np.ndarray, up: np.ndarray, mask: np.ndarray) -> list[Any]:
    """Return the segments between the cells inside and the cells outside of the mask."""
    segments = []
    for i, j in np.argwhere(mask[:, 1:] != mask[:, :-1]):
        segments.append([(across[j + 1], up[i]), (across[j + 1], up[i + 1])])
    for i, j in np.argwhere(mask[1:] != mask[:-1]):
        segments.append([(across[j], up[i + 1]), (across[j + 1], up[i + 1])])
    return segments


def runs(mask: np.ndarray) -> np.ndarray:
    """Return the first index of every run of true values, and the index after its last one, [run, 2]."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def marked_places(mask: np.ndarray, x: np.ndarray, y: np.ndarray, *, most: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions x and y of marks on masked cells.

    A map with more than 128 cells along a side is divided into blocks of cells, with one mark at most per block. If
    `most` is True, a block has a mark if more than half of its cells are masked; otherwise if at least one cell is
    masked.
    """
    step = max(math.ceil(size / MAX_SYMBOLS_PER_SIDE) for size in mask.shape)
    starts = [np.arange(0, size, step) for size in mask.shape]
    masked_cells = np.add.reduceat(np.add.reduceat(mask.astype(int), starts[0], axis=0), starts[1], axis=1)
    rows, columns = np.nonzero(2 * masked_cells > step**2 if most else masked_cells)
    centre = [np.minimum(start + step // 2, size - 1) for start, size in zip(starts, mask.shape, strict=True)]
    return x[centre[1][columns]], y[centre[0][rows]]
