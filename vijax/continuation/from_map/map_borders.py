"""Borders between cells of a map with different labels, and their distances from curves of bifurcations.

A border is a pair of neighbouring cells with periodic motions of different labels. If a curve of bifurcations passes
within one cell of the border, the curve explains it.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.continuation.continuation_parameter import AFFECTED_CONSTANTS
from vijax.continuation.curves.curve_plane import check_plane
from vijax.model.choices import Walls
from vijax.model.device import Harvester, device_from_attributes, with_constants
from vijax.model.label import label
from vijax.model.pair import ImpactPair, has_mirror_symmetry, pair_of
from vijax.model.quantities import without_wall
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# Constants of the device that a map has as coordinates.
_DEVICE_COORDINATES = ("A", "omega", "s", "beta")
_REQUIRED = ("period", "impacts_left", "impacts_right", "status")


@dataclass(frozen=True)
class LabelledPlane:
    """A map of labels over two parameters.

    Attributes:
        along: Both parameters, the first along rows.
        axes: Their values, ascending.
        labels: Label of each cell; "" where the motion is not periodic, or has no impacts. Mirror images have one
            label.
        period: Forcing periods of each cell's motion.
        cells: Constants of each cell's pair by name, and u0 and v0.
        wall: Kind of the walls.
        admissible: Whether each cell is admissible; None if the map does not contain it.
    """

    along: tuple[str, str]
    axes: tuple[np.ndarray, np.ndarray]
    labels: np.ndarray
    period: np.ndarray
    cells: dict[str, Any]
    wall: Walls
    admissible: np.ndarray | None

    def pairs(self, cells: np.ndarray) -> ImpactPair:
        """Return the pairs of some cells, given by rows and columns along the last axis."""
        index = tuple(np.moveaxis(cells, -1, 0))
        return pair_of({name: values[index] for name, values in self.cells.items()}, self.wall)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the bounds of the plane."""
        return {name: (float(axis[0]), float(axis[-1])) for name, axis in zip(self.along, self.axes, strict=True)}


def device_of(dataset: "xr.Dataset") -> Harvester:
    """Return the device of a map, as far as the map specifies it.

    A constant that is an axis of the map has the value of the first cell.
    """
    names = map(str, dataset.coords)
    # If the walls may differ, each wall has a coordinate of its own, and the value for both is not needed.
    walls = [name for name in names if without_wall(name) in ("kappa", "r") and f"{name}_left" not in dataset.coords]
    first = {
        str(name): float(dataset[name].values.flat[0])
        for name in (*_DEVICE_COORDINATES, *walls)
        if name in dataset.coords
    }
    device = replace(
        device_from_attributes(dataset.attrs),
        **{name: first.pop(name) for name in _DEVICE_COORDINATES if name in first},
    )
    # kappa = omega0 pi/omega: this factor converts kappa to omega0.
    natural = device.omega / math.pi
    # The kappa of a rigid wall opposite a membrane is infinite in a map, and no constant of a device.
    finite = {name: value for name, value in first.items() if math.isfinite(value)}
    return with_constants(
        device,
        **{
            name.replace("kappa", "omega0"): value * natural if name.startswith("kappa") else value
            for name, value in finite.items()
        },
    )


def labelled_plane(dataset: "xr.Dataset") -> LabelledPlane:
    """Return the labels of a map over two parameters.

    Raises:
        ValueError: No dataset with labels, axes along which curves cannot be followed, or no periodic cell.
    """
    validation.validate_dataset("dataset", dataset, _REQUIRED, "vijax.sweep", "ask for these outputs")
    along = check_map(dataset, tuple(map(str, dataset["period"].dims)))
    # Ascending axes, as the interpolation between cells needs them.
    ordered = dataset.sortby(list(along))
    period = ordered["period"]
    arrays = {name: ordered[name].broadcast_like(period).transpose(*period.dims).values for name in _REQUIRED}
    cells = _cell_constants(ordered, period)
    labels = label(*(arrays[name] for name in _REQUIRED), merge_mirrors=has_mirror_symmetry(cells))
    impacts = arrays["impacts_left"] + arrays["impacts_right"]
    labels = np.where((arrays["period"] > 0) & (impacts > 0), labels, "")
    if not (labels != "").any():
        raise ValueError("dataset must have periodic cells with impacts, from which curves start; got none")
    axes = tuple(np.asarray(ordered[name].values, float) for name in along)
    admissible = ordered.get("admissible")
    # If the map has a further axis that the motion does not depend on, a cell may have several values; then none is
    # used.
    admissible_cells = (
        None
        if admissible is None or set(admissible.dims) != set(along)
        else admissible.transpose(*along).values.astype(bool)
    )
    wall = dataset.attrs.get("wall", "soft")
    return LabelledPlane(along, (axes[0], axes[1]), labels, arrays["period"], cells, wall, admissible_cells)


# Attributes that a map must have for curves to be followed: name, required value (also the default), its description.
_PLAIN_ATTRIBUTES = (
    ("membrane", "linear", "linear membranes"),
    ("excitation", "sine", "the sine"),
    ("friction", 0, "no friction"),
)


def check_map(dataset: "xr.Dataset", dims: tuple[str, ...]) -> tuple[str, str]:
    """Return the two axes of a map, if curves can be followed in their plane; the motions of its cells are not read.

    Args:
        dataset: The map, or its coordinates and attributes alone.
        dims: Dimensions that its motion depends on.
    """
    if len(dims) != 2 or not set(dims) <= set(AFFECTED_CONSTANTS):
        unused = [str(dim) for dim in dataset.sizes if dim not in dims]
        hint = f"; its motion does not depend on {validation.join_names(unused)}" if unused else ""
        raise ValueError(f"dataset must be a map over two parameters; got one over {', '.join(dims) or 'none'}{hint}")
    first_name, second_name = dims
    if min(dataset.sizes[first_name], dataset.sizes[second_name]) < 2:
        got = f"{dataset.sizes[first_name]} and {dataset.sizes[second_name]}"
        raise ValueError(f"dataset must have at least two values along each axis; got {got}")
    for name, default, requirement in _PLAIN_ATTRIBUTES:
        if (got := dataset.attrs.get(name, default)) != default:
            raise ValueError(f"dataset must be of {requirement}; got one of {name} {got}")
    # The first cell stands for all: the plane is validated for one pair.
    first = {name: x.flat[0] for name, x in _cell_constants(dataset).items()}
    pair = pair_of(first, dataset.attrs.get("wall", "soft"))
    check_plane(pair, {name: (float(dataset[name].min()), float(dataset[name].max())) for name in dims})
    return first_name, second_name


def _cell_constants(dataset: "xr.Dataset", like: "xr.DataArray | None" = None) -> dict[str, Any]:
    """Return the constants of the pairs of the cells of a map by name, and u0 and v0."""
    constants: dict[str, Any] = {}
    for name in map(str, dataset.coords):
        if without_wall(name) in ("d", "kappa", "r", "gamma", "u0", "v0"):
            values = dataset[name]
            constants[name] = (values if like is None else values.broadcast_like(like).transpose(*like.dims)).values
    return constants


@dataclass(frozen=True)
class Borders:
    """Pairs of neighbouring periodic cells with different labels.

    Attributes:
        cell: Row and column of the first cell of each pair, one row per pair.
        axis: 0 where the other cell is in the next row, 1 where it is in the next column.
    """

    cell: np.ndarray
    axis: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Return the places of the borders in units of cells, one row per border."""
        return self.cell + 0.5 * np.eye(2)[self.axis]

    @property
    def other_cell(self) -> np.ndarray:
        """Return the other cells of the borders, one row each."""
        return self.cell + np.eye(2, dtype=int)[self.axis]

    @property
    def number(self) -> np.ndarray:
        """Return a number for each border, different for all borders of a map."""
        # Row in the upper 32 bits; twice the column, plus the axis, in the lower ones.
        return (self.cell[:, 0] << 32) + 2 * self.cell[:, 1] + self.axis

    def parameters(self, plane: LabelledPlane) -> np.ndarray:
        """Return both parameters half way between the two cells, one row per border."""
        middle = self.middle
        return np.stack([np.interp(middle[:, i], np.arange(len(x)), x) for i, x in enumerate(plane.axes)], axis=1)

    def __getitem__(self, index: Any) -> "Borders":
        """Return some of the borders."""
        return Borders(self.cell[index], self.axis[index])

    def __len__(self) -> int:
        return len(self.axis)


def borders(plane: LabelledPlane) -> Borders:
    """Return every border between periodic cells with different labels."""
    return _borders_where_different(plane, plane.labels)


def limit_borders(plane: LabelledPlane) -> Borders:
    """Return every border between an admissible and an inadmissible periodic cell.

    Raises:
        ValueError: The map does not contain `admissible`.
    """
    if plane.admissible is None:
        raise ValueError("limits must be those of a map with admissible, over its two axes alone; got one without it")
    return _borders_where_different(plane, plane.admissible)


def _borders_where_different(plane: LabelledPlane, by: np.ndarray) -> Borders:
    """Return the pairs of neighbouring periodic cells that differ in the values `by`."""
    cells, axes, periodic = [], [], plane.labels != ""
    for axis in (0, 1):
        # All neighbours along one axis: cells 0..n-2 against cells 1..n-1.
        last = plane.labels.shape[axis] - 1
        (values_here, next_values), both_periodic = (
            [values.take(np.arange(last) + shift, axis=axis) for shift in (0, 1)] for values in (by, periodic)
        )
        different = np.argwhere((values_here != next_values) & both_periodic[0] & both_periodic[1])
        cells.append(different)
        axes.append(np.full(len(different), axis))
    return Borders(np.concatenate(cells), np.concatenate(axes))


def largest_chain(borders: Borders) -> Borders:
    """Return the largest chain of borders: each border is next to another one of the chain."""
    from scipy.sparse import csr_array  # here, because `import vijax` must not load it
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(borders):
        return borders
    # Borders are neighbours if their midpoints are at most one cell apart.
    rows, columns = cKDTree(borders.middle).query_pairs(1.0, output_type="ndarray").T
    _, chain = connected_components(csr_array((np.ones(len(rows)), (rows, columns)), shape=2 * (len(borders),)))
    return borders[chain == np.bincount(chain).argmax()]


def near_curve(borders: Borders, curve: np.ndarray, plane: LabelledPlane, cells: float = 1.0) -> np.ndarray:
    """Return which borders lie within a distance from a curve, in cells.

    Args:
        borders: The borders.
        curve: Values of both parameters, one row per point.
        plane: The map.
        cells: The distance in cells.
    """
    steps = [np.arange(len(axis), dtype=float) for axis in plane.axes]
    points = np.stack([np.interp(curve[:, i], plane.axes[i], steps[i]) for i in (0, 1)], axis=1)
    middle = borders.middle
    is_near = np.zeros(len(borders), bool)
    for begin, end in pairwise(points):
        # Only borders in the bounding box of this segment are tested, because a curve has hundreds of segments and a
        # map thousands of borders.
        low, high = np.minimum(begin, end) - cells, np.maximum(begin, end) + cells
        index = np.flatnonzero(~is_near & ((middle >= low) & (middle <= high)).all(axis=1))
        if not index.size:
            continue
        step = end - begin
        # Distance to the nearest point of the segment; the smallest positive number avoids a division by zero at a
        # segment of length zero.
        share = np.clip((middle[index] - begin) @ step / max(step @ step, np.finfo(float).tiny), 0.0, 1.0)
        is_near[index] = np.linalg.norm(begin + share[:, None] * step - middle[index], axis=1) <= cells
    return is_near
