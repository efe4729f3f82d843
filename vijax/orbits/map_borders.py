"""Borders between differently labelled cells of a map, and which of them lie at a curve."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import Harvester, told_device, with_constants
from vijax.model.label import label
from vijax.model.pair import ImpactPair, pair_of, symmetric
from vijax.model.quantities import whole
from vijax.orbits.curve_plane import check_plane
from vijax.orbits.parameter import MOVED
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# Constants of the device that a map has as coordinates.
_MOVED = ("A", "omega", "s", "beta")
_NEEDED = ("period", "impacts_left", "impacts_right", "status")


@dataclass(frozen=True)
class LabelledPlane:
    """A map of labels over two parameters.

    Attributes:
        along: Both parameters, the first along rows.
        axes: Their values, ascending.
        names: Label of each cell; "" where the motion is not periodic, or has no impacts. Mirror images have one.
        period: Forcing periods of each cell's motion.
        cells: What the pair of each cell is made of, by name, and u0 and v0.
        wall: What the walls are.
        admissible: Whether each cell is, where the map tells.
    """

    along: tuple[str, str]
    axes: tuple[np.ndarray, np.ndarray]
    names: np.ndarray
    period: np.ndarray
    cells: dict[str, Any]
    wall: Walls
    admissible: np.ndarray | None

    def pairs(self, cells: np.ndarray) -> ImpactPair:
        """Give the pairs of some cells, whose rows and columns stand along the last axis."""
        index = tuple(np.moveaxis(cells, -1, 0))
        return pair_of({name: values[index] for name, values in self.cells.items()}, self.wall)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Give the bounds of the plane."""
        return {name: (float(axis[0]), float(axis[-1])) for name, axis in zip(self.along, self.axes, strict=True)}


def device_of(dataset: "xr.Dataset") -> Harvester:
    """Read the device of a map, as far as the map says; along its axes it is that of the first cell."""
    names = map(str, dataset.coords)
    # Where walls may differ what was given for both stands in what each has.
    walls = [name for name in names if whole(name) in ("kappa", "r") and f"{name}_left" not in dataset.coords]
    first = {str(name): float(dataset[name].values.flat[0]) for name in (*_MOVED, *walls) if name in dataset.coords}
    device = replace(told_device(dataset.attrs), **{name: first.pop(name) for name in _MOVED if name in first})
    natural = device.omega / math.pi
    # The kappa of a rigid wall beside a membrane is infinite in a map, and no constant of a device.
    finite = {name: value for name, value in first.items() if math.isfinite(value)}
    return with_constants(
        device,
        **{
            name.replace("kappa", "omega0"): value * natural if name.startswith("kappa") else value
            for name, value in finite.items()
        },
    )


def labelled_plane(dataset: "xr.Dataset") -> LabelledPlane:
    """Read the labels of a map over two parameters.

    Raises:
        ValueError: No dataset with labels, axes along which curves cannot be followed, or no periodic cell.
    """
    checks.variables("dataset", dataset, _NEEDED, "vijax.sweep", "ask for these outputs")
    along = check_map(dataset, tuple(map(str, dataset["period"].dims)))
    ordered = dataset.sortby(list(along))
    period = ordered["period"]
    like = {name: ordered[name].broadcast_like(period).transpose(*period.dims).values for name in _NEEDED}
    cells = _cells(ordered, period)
    names = label(*(like[name] for name in _NEEDED), merge_mirrors=symmetric(cells))
    impacts = like["impacts_left"] + like["impacts_right"]
    names = np.where((like["period"] > 0) & (impacts > 0), names, "")
    if not (names != "").any():
        raise ValueError("dataset must have periodic cells with impacts, whose orbits curves begin at; got none")
    axes = tuple(np.asarray(ordered[name].values, float) for name in along)
    told = ordered.get("admissible")
    # Along an axis that the motion does not depend on there may be several verdicts a cell.
    kept = None if told is None or set(told.dims) != set(along) else told.transpose(*along).values.astype(bool)
    wall = dataset.attrs.get("wall", "soft")
    return LabelledPlane(along, (axes[0], axes[1]), names, like["period"], cells, wall, kept)


# What a map may say of its making, without it, and what curves over it know.
_ALONE = ("membrane", "linear", "linear membranes"), ("excitation", "sine", "the sine"), ("friction", 0, "no friction")


def check_map(dataset: "xr.Dataset", dims: tuple[str, ...]) -> tuple[str, str]:
    """Give the two axes of a map, if curves can be followed in their plane; what its cells do is not looked at.

    Args:
        dataset: The map, or its coordinates and attributes alone.
        dims: What its motion depends on.
    """
    if len(dims) != 2 or not set(dims) <= set(MOVED):
        idle = [str(dim) for dim in dataset.sizes if dim not in dims]
        hint = f"; its motion does not depend on {checks.joined(idle)}" if idle else ""
        raise ValueError(f"dataset must be a map over two parameters; got one over {', '.join(dims) or 'none'}{hint}")
    one, other = dims
    if min(dataset.sizes[one], dataset.sizes[other]) < 2:
        got = f"{dataset.sizes[one]} and {dataset.sizes[other]}"
        raise ValueError(f"dataset must have at least two values along each axis; got {got}")
    for name, plain, needed in _ALONE:
        if (got := dataset.attrs.get(name, plain)) != plain:
            raise ValueError(f"dataset must be of {needed}; got one of {name} {got}")
    first = {name: x.flat[0] for name, x in _cells(dataset).items()}
    pair = pair_of(first, dataset.attrs.get("wall", "soft"))
    check_plane(pair, {name: (float(dataset[name].min()), float(dataset[name].max())) for name in dims})
    return one, other


def _cells(dataset: "xr.Dataset", like: "xr.DataArray | None" = None) -> dict[str, Any]:
    """Give what the pairs of the cells of a map are made of, and u0 and v0."""
    cells: dict[str, Any] = {}
    for name in map(str, dataset.coords):
        if whole(name) in ("d", "kappa", "r", "gamma", "u0", "v0"):
            values = dataset[name]
            cells[name] = (values if like is None else values.broadcast_like(like).transpose(*like.dims)).values
    return cells


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

    @property
    def beyond(self) -> np.ndarray:
        """Give the cells behind the borders, a row each."""
        return self.cell + np.eye(2, dtype=int)[self.axis]

    @property
    def number(self) -> np.ndarray:
        """Number the borders of a map: no two have one number."""
        return (self.cell[:, 0] << 32) + 2 * self.cell[:, 1] + self.axis

    def places(self, plane: LabelledPlane) -> np.ndarray:
        """Give both parameters half way between the cells, a row each."""
        middle = self.middle
        return np.stack([np.interp(middle[:, i], np.arange(len(x)), x) for i, x in enumerate(plane.axes)], axis=1)

    def __getitem__(self, index: Any) -> "Borders":
        """Pick some."""
        return Borders(self.cell[index], self.axis[index])

    def __len__(self) -> int:
        return len(self.axis)


def borders(plane: LabelledPlane) -> Borders:
    """Find every border between periodic cells with different labels."""
    return _parted(plane, plane.names)


def limit_borders(plane: LabelledPlane) -> Borders:
    """Find every border between periodic cells of which one is admissible and the other is not.

    Raises:
        ValueError: The map does not tell.
    """
    if plane.admissible is None:
        raise ValueError("limits must be those of a map with admissible, over its two axes alone; got one without it")
    return _parted(plane, plane.admissible)


def _parted(plane: LabelledPlane, by: np.ndarray) -> Borders:
    """Find the pairs of neighbouring periodic cells in which something differs."""
    cells, axes, periodic = [], [], plane.names != ""
    for axis in (0, 1):
        last = plane.names.shape[axis] - 1
        (here, there), both = (
            [values.take(np.arange(last) + shift, axis=axis) for shift in (0, 1)] for values in (by, periodic)
        )
        found = np.argwhere((here != there) & both[0] & both[1])
        cells.append(found)
        axes.append(np.full(len(found), axis))
    return Borders(np.concatenate(cells), np.concatenate(axes))


def largest_piece(found: Borders) -> Borders:
    """Find the longest chain of borders of which each is next to another one."""
    from scipy.sparse import csr_array  # here, as importing vijax must not load it
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(found):
        return found
    rows, columns = cKDTree(found.middle).query_pairs(1.0, output_type="ndarray").T
    _, piece = connected_components(csr_array((np.ones(len(rows)), (rows, columns)), shape=2 * (len(found),)))
    return found[piece == np.bincount(piece).argmax()]


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
