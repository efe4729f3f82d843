"""The map that a page shows: drawn axes, further axes, fixed values, and the `sweep` arguments of every cell."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.maps.cells import cells
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.device import Harvester, device_from_attributes, pair_and_device
from vijax.model.pair import ImpactPair
from vijax.model.quantities import AXES, START, START_REACH, both_walls_name, synonyms
from vijax.model.walls.sides import field_of
from vijax.plots.cells import edges
from vijax.plots.style import LABEL_NEEDS
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

if TYPE_CHECKING:
    import xarray as xr


# Names of a cell's parameters. If both walls of a map have equal kappa and r, their names have no suffix; otherwise
# there is one name per wall.
_PAIR = ("d", "kappa", "kappa_left", "kappa_right", "gamma", "r", "r_left", "r_right")
MOST_MAP_CELLS = 2**26
"""Most cells of a map, such as 8192 x 8192; one variable of so many cells takes half a gigabyte."""
MOST_PERIODS = 100_000
"""Most forcing periods per cell of a map, because a click runs the cell again for so many periods."""


@dataclass(frozen=True)
class Axis:
    """An axis of the map as it is drawn.

    Attributes:
        name: Name of the quantity.
        values: Values at the centres of the cells, ascending.
        edges: Edges of the cells, one more than values.
        scale: "log" if the values are evenly spaced on a logarithmic scale, otherwise "linear".
        even: Whether the values are evenly spaced on `scale`.
    """

    name: str
    values: np.ndarray
    edges: np.ndarray
    scale: str
    even: bool

    def nearest(self, value: float) -> int:
        """Return the index of the cell that contains a value; outside the axis, of the first or last cell."""
        return int(np.clip(np.searchsorted(self.edges, value) - 1, 0, self.values.size - 1))

    def fraction(self, value: float) -> float:
        """Return the position of a value between the first (0) and the last value (1), on the scale of the axis."""
        low, high = self.values[0], self.values[-1]
        if self.scale == "log":
            return float(np.log(value / low) / np.log(high / low))
        return float((value - low) / (high - low))


@dataclass(frozen=True)
class ExploredPlane:
    """A map that a page can explore.

    Attributes:
        dataset: Result of `sweep`, with its first two axes ascending.
        x, y: The drawn axes: the first two axes of `dataset`.
        further: Values of the other axes, by name; the page shows the map at one value of each.
        fixed: Values of the `sweep` axes that do not vary in the map, by name. They and the cell's values of the other
            axes determine the parameters of a cell.
        device: Device with the constants that are no axes.
        wall, periods: Arguments of `sweep` that the map was made with.
        variables: Variables that can be shown, with "label" if the map holds the variables that form labels.
    """

    dataset: "xr.Dataset"
    x: Axis
    y: Axis
    further: dict[str, np.ndarray]
    fixed: dict[str, float]
    device: Harvester
    wall: Any
    periods: int
    variables: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of columns (values of x) and of rows (values of y)."""
        return self.x.values.size, self.y.values.size

    def arguments(self, pick: tuple[int, int], values: Mapping[str, float]) -> dict[str, float]:
        """Return the `sweep` axes of a cell by name.

        Args:
            pick: Column and row of the cell.
            values: Values of moved sliders, by axis; they replace the map's further and fixed values.
        """
        column, row = pick
        position = {self.x.name: float(self.x.values[column]), self.y.name: float(self.y.values[row])}
        map_values = {name: float(x[0]) for name, x in self.further.items()} | self.fixed
        return position | map_values | {name: float(value) for name, value in values.items() if name not in position}

    def settings(self) -> dict[str, Any]:
        """Return the `sweep` settings of the map that differ from the defaults."""
        ran = {"wall": self.wall, "periods": self.periods}
        return {name: value for name, value in ran.items() if value != getattr(SweepSettings, name)}

    def stored(self, name: str, pick: tuple[int, int], values: Mapping[str, float]) -> Any:
        """Return the map's value of a variable in the cell `pick`, at the slider values of the further axes."""
        column, row = pick
        variable = self.dataset[name]
        position = {self.x.name: column, self.y.name: row} | self.slices(values)
        return variable.isel({dim: index for dim, index in position.items() if dim in variable.dims}).values[()]

    def slices(self, values: Mapping[str, float]) -> dict[str, int]:
        """Return, for each further axis, the index of its value nearest to the slider's value; by default 0."""
        return {name: int(np.abs(axis - values.get(name, axis[0])).argmin()) for name, axis in self.further.items()}

    def sliced(self, values: Mapping[str, float]) -> "xr.Dataset":
        """Return the map at the shown value of each further axis (see `slices`): a dataset over x and y."""
        return self.dataset.isel(self.slices(values))

    def differs(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return the names of the parameters, except u0 and v0, with slider values that the map does not contain."""
        map_values = {name: axis.tolist() for name, axis in self.further.items()}
        map_values |= {name: [value] for name, value in self.fixed.items()}
        start_names = ("u0", "v0")
        return tuple(
            name for name, value in values.items() if name not in start_names and value not in map_values.get(name, [])
        )


@public_api
def explored(dataset: "xr.Dataset") -> ExploredPlane:
    """Return a map as an `ExploredPlane`, after validation that the page can show it and run its cells.

    Args:
        dataset: Result of `sweep` over at least two axes, with method="exact" and until="attractor".

    Raises:
        ValueError: The dataset is unsuitable; the message states the requirement, the value and the remedy.
    """
    validation.validate_dataset("dataset", dataset, ("status",), "vijax.sweep")
    along = [str(dim) for dim in dataset.dims if dim in AXES and dataset.sizes[dim] > 1]
    single = [dim for dim in dataset.dims if dim not in along]
    if any(dim not in AXES for dim in single):
        raise ValueError(
            f"dataset must be a map that vijax.sweep made; got one over {validation.join_names(map(str, single))}"
        )
    if len(along) < 2:
        got = validation.join_names(along) or "none"
        raise ValueError(f"dataset must have two axes of more than one value; got {got}; plots draw what has fewer")
    count = math.prod(dataset.sizes[name] for name in along)
    if count > MOST_MAP_CELLS:
        raise ValueError(
            f"dataset must have at most {MOST_MAP_CELLS:,} cells to be shown in a browser; got {count:,}; select a part"
        )
    for name, needed in (("method", "exact"), ("until", "attractor"), ("excitation", "sine")):
        if (got := dataset.attrs.get(name, needed)) != needed:
            raise ValueError(
                f"dataset must be made with {name}={needed!r}, as the page runs its cells; got {got!r}; make it anew"
            )
    if (starts := int(dataset.attrs.get("starts", 1))) != 1:
        raise ValueError(
            f"dataset must have one start in every cell, from which the page runs it; got {starts}; make it with one"
        )
    periods = int(dataset.attrs.get("periods", SweepSettings.periods))
    if not 1 <= periods <= MOST_PERIODS:
        raise ValueError(
            f"dataset must be run for 1 to {MOST_PERIODS:,} periods, as the page runs its cells at a click; "
            f"got {periods:,}; make it anew with fewer"
        )
    dataset = dataset.squeeze([str(dim) for dim in single]).sortby(along[:2])
    x, y = (_axis(dataset, name) for name in along[:2])
    drawable = [str(name) for name in dataset.data_vars if {x.name, y.name} & set(map(str, dataset[name].dims))]
    labelled = ("label",) if set(LABEL_NEEDS) <= set(map(str, dataset.data_vars)) else ()
    return ExploredPlane(
        dataset=dataset,
        x=x,
        y=y,
        further={name: np.asarray(dataset[name].values, float) for name in along[2:]},
        fixed=_fixed(dataset, along),
        device=device_from_attributes(dataset.attrs),
        wall=str(dataset.attrs.get("wall", SweepSettings.wall)),
        periods=periods,
        variables=(*sorted(drawable, key=lambda name: name != "P"), *labelled),
    )


def _axis(dataset: "xr.Dataset", name: str) -> Axis:
    values = np.asarray(dataset[name].values, float)
    cell_edges, scale = edges(values)
    steps = np.diff(np.log(values) if scale == "log" else values)
    # The values count as equally spaced if their steps differ by less than the tolerance 1e-6 * largest step * number
    # of values. If all steps are 0, the floor 1e-300 keeps the tolerance above 0, so that `<` is true.
    return Axis(
        name, values, cell_edges, scale, bool(np.ptp(steps) < 1e-6 * max(abs(steps).max(), 1e-300) * values.size)
    )


def _fixed(dataset: "xr.Dataset", along: list[str]) -> dict[str, float]:
    """Return the single values of the `sweep` axes that do not vary in a map, by name.

    If d, kappa or gamma varies with omega or A, the constant of the device (s, omega0 or beta) takes its place. If the
    walls differ, kappa and r have one value per wall.
    """

    def first(name: str) -> float:
        return float(dataset[name].values.flat[0])

    wall = dataset.attrs.get("wall", SweepSettings.wall)
    present = [name for name in _PAIR if name in dataset.coords]
    # If the walls differ, a map may have a coordinate for both walls and one per wall: kappa, kappa_left, kappa_right.
    # In this case only the coordinates per wall are used.
    table_names = [name for name in present if f"{name}_left" not in dataset.coords]

    # Called only if a constant of the device is needed: some gamma have no inclination beta, so the conversion fails.
    def device() -> Harvester:
        table = {name: first(name) for name in (*table_names, "A", "omega")}
        return pair_and_device(device_from_attributes(dataset.attrs), table, wall)[1]

    fixed: dict[str, float] = {}
    axis_names = {f"{synonym}{end}" for name in along for synonym in synonyms(name) for end in ("", "_left", "_right")}
    for name in present:
        both = both_walls_name(name)
        # If both walls are rigid, both have the kappa of the membranes that they replace, which is a single value. If
        # one wall is soft, the rigid wall has no kappa.
        lent = both == "kappa" and wall == "rigid"
        if name in axis_names or (both in present and not lent) or not math.isfinite(first(name)):
            continue
        if dataset[name].ndim == 0 or name.startswith("r"):
            fixed[both if lent else name] = first(name)
        else:
            constant = {"d": "s", "gamma": "beta"}.get(name, (both if lent else name).replace("kappa", "omega0"))
            fixed[constant] = float(field_of(device(), constant))
    fixed |= {name: first(name) for name in ("omega", "A") if name not in along}
    starts = {name: dataset[name] for name in ("u0", "v0") if name not in along and dataset[name].ndim == 0}
    default_starts = {"u0": min(START[0], START_REACH * fixed["d"]) if "d" in fixed else None, "v0": START[1]}
    return fixed | {name: float(start) for name, start in starts.items() if float(start) != default_starts[name]}


@dataclass(frozen=True)
class ExploredCell:
    """The parameters of one cell: a cell of the map, or a cell with other slider values than the map's.

    Attributes:
        pair, device: The nondimensional pair, and the device that realises it.
        u0, v0: Start of the motion.
        arguments: `sweep` arguments of the cell.
        settings: Further `sweep` arguments that differ from the defaults.
    """

    pair: ImpactPair
    device: Harvester
    u0: float
    v0: float
    arguments: dict[str, Any]
    settings: dict[str, Any]

    @property
    def r(self) -> str:
        """Return the name of the axis r, which every cell has: "r" or, if the walls differ, "r_left"."""
        return "r" if "r" in self.arguments else "r_left"

    def diagram_arguments(self, along: str) -> dict[str, Any]:
        """Return the arguments of `orbit_diagram` along an axis through the cell, except `values` and run lengths."""
        others = {name: value for name, value in self.arguments.items() if name != along}
        wall = {name: value for name, value in self.settings.items() if name == "wall"}
        return {"along": along, "device": self.device} | wall | others


def cell(plane: ExploredPlane, pick: tuple[int, int], values: Mapping[str, float]) -> ExploredCell:
    """Return the picked cell; slider values, `values`, replace the map's values.

    Raises:
        ValueError: No cell can have these values.
    """
    arguments = plane.arguments(pick, values)
    quantities = {
        name: float(value.values) for name, value in cells(arguments, plane.device, plane.wall).quantities.items()
    }
    pair, device = pair_and_device(plane.device, quantities, plane.wall)
    return ExploredCell(pair, device, quantities["u0"], quantities["v0"], arguments, plane.settings())
