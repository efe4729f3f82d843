"""The map that a page shows: its two axes, further ones, what it holds fixed, and the arguments of any cell of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.model.device import Harvester, realised, told_device
from vijax.model.pair import ImpactPair
from vijax.model.quantities import AXES, START, START_REACH, of_both_walls, synonyms
from vijax.model.sides import field_of
from vijax.planes.cells import cells
from vijax.planes.sweep_settings import SweepSettings
from vijax.plots.cells import edges
from vijax.plots.style import LABEL_NEEDS
from vijax.runtime import checks
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr


# Of a map of equal walls those without an end; of others those of each wall.
_PAIR = ("d", "kappa", "kappa_left", "kappa_right", "gamma", "r", "r_left", "r_right")
MOST_SHOWN = 2**26
"""Cells of a map, at most: 8192 x 8192, of which a variable takes half a gigabyte."""
MOST_PERIODS = 100_000
"""Forcing periods of a cell, at most: what a store says must not keep a page busy without an end."""


@dataclass(frozen=True)
class Axis:
    """An axis of the map as it is drawn: ascending.

    Attributes:
        name: Of the quantity.
        values: Ascending.
        edges: Of the cells around them.
        scale: "log" or "linear": that on which the values are evenly spaced, "linear" where they are on neither.
        even: Whether they are evenly spaced on it.
    """

    name: str
    values: np.ndarray
    edges: np.ndarray
    scale: str
    even: bool

    def nearest(self, value: float) -> int:
        """Find the cell that holds a value, or the nearest to it."""
        return int(np.clip(np.searchsorted(self.edges, value) - 1, 0, self.values.size - 1))

    def part(self, value: float) -> float:
        """Say which part of the way along the axis a value lies, on its scale."""
        low, high = self.values[0], self.values[-1]
        if self.scale == "log":
            return float(np.log(value / low) / np.log(high / low))
        return float((value - low) / (high - low))


@dataclass(frozen=True)
class ExploredPlane:
    """A map that can be looked into.

    Attributes:
        dataset: What `sweep` returned, its first two axes ascending.
        x, y: The axes that are drawn.
        further: Values of its other axes, of which one value at a time is shown.
        fixed: Axes of `sweep` by which every other cell of this device could be run, each one number.
        device: Its constants that are no axes.
        wall, periods: As in `sweep`.
        variables: What can be shown, "label" among them where the map holds what makes one.
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
        """Count the columns and rows."""
        return self.x.values.size, self.y.values.size

    def arguments(self, pick: tuple[int, int], values: Mapping[str, float]) -> dict[str, float]:
        """Give the axes of `sweep` at a cell, what was moved in place of what the map holds."""
        column, row = pick
        place = {self.x.name: float(self.x.values[column]), self.y.name: float(self.y.values[row])}
        known = {name: float(x[0]) for name, x in self.further.items()} | self.fixed
        return place | known | {name: float(value) for name, value in values.items() if name not in place}

    def settings(self) -> dict[str, Any]:
        """Give the arguments of `sweep` that say how the map was run, where they are not its defaults."""
        ran = {"wall": self.wall, "periods": self.periods}
        return {name: value for name, value in ran.items() if value != getattr(SweepSettings, name)}

    def stored(self, name: str, pick: tuple[int, int], values: Mapping[str, float]) -> Any:
        """Read what the map holds of a cell, at the values of its further axes that are nearest to those shown."""
        column, row = pick
        variable = self.dataset[name]
        place = {self.x.name: column, self.y.name: row} | self.slices(values)
        return variable.isel({dim: index for dim, index in place.items() if dim in variable.dims}).values[()]

    def slices(self, values: Mapping[str, float]) -> dict[str, int]:
        """Find which value of each further axis is shown."""
        return {name: int(np.abs(axis - values.get(name, axis[0])).argmin()) for name, axis in self.further.items()}

    def sliced(self, values: Mapping[str, float]) -> "xr.Dataset":
        """Cut out the part of the map that is shown."""
        return self.dataset.isel(self.slices(values))

    def differs(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Name the values that are none of this map's."""
        held = {name: axis.tolist() for name, axis in self.further.items()}
        held |= {name: [value] for name, value in self.fixed.items()}
        started = ("u0", "v0")
        return tuple(name for name, value in values.items() if name not in started and value not in held.get(name, []))


@door
def explored(dataset: "xr.Dataset") -> ExploredPlane:
    """Take a map to be looked into.

    Args:
        dataset: What `sweep` returned, over two axes at least, by the exact method until attractors.

    Raises:
        ValueError: What must hold of it, what came, what to do.
    """
    checks.variables("dataset", dataset, ("status",), "vijax.sweep")
    along = [str(dim) for dim in dataset.dims if dim in AXES and dataset.sizes[dim] > 1]
    single = [dim for dim in dataset.dims if dim not in along]
    if any(dim not in AXES for dim in single):
        raise ValueError(f"dataset must be a map that vijax.sweep made; got one over {checks.joined(map(str, single))}")
    if len(along) < 2:
        got = checks.joined(along) or "none"
        raise ValueError(f"dataset must have two axes of more than one value; got {got}; plots draw what has fewer")
    count = math.prod(dataset.sizes[name] for name in along)
    if count > MOST_SHOWN:
        raise ValueError(
            f"dataset must have at most {MOST_SHOWN:,} cells to be shown in a browser; got {count:,}; select a part"
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
    shown = [str(name) for name in dataset.data_vars if {x.name, y.name} & set(map(str, dataset[name].dims))]
    labelled = ("label",) if set(LABEL_NEEDS) <= set(map(str, dataset.data_vars)) else ()
    return ExploredPlane(
        dataset=dataset,
        x=x,
        y=y,
        further={name: np.asarray(dataset[name].values, float) for name in along[2:]},
        fixed=_fixed(dataset, along),
        device=told_device(dataset.attrs),
        wall=str(dataset.attrs.get("wall", SweepSettings.wall)),
        periods=periods,
        variables=(*sorted(shown, key=lambda name: name != "P"), *labelled),
    )


def _axis(dataset: "xr.Dataset", name: str) -> Axis:
    values = np.asarray(dataset[name].values, float)
    around, scale = edges(values)
    steps = np.diff(np.log(values) if scale == "log" else values)
    return Axis(name, values, around, scale, bool(np.ptp(steps) < 1e-6 * max(abs(steps).max(), 1e-300) * values.size))


def _fixed(dataset: "xr.Dataset", along: list[str]) -> dict[str, float]:
    """Find what the map holds fixed: as d, kappa and gamma or, where these vary with omega or A, as s, omega0, beta.

    Of walls that differ kappa and r are those of each.
    """

    def first(name: str) -> float:
        return float(dataset[name].values.flat[0])

    wall = dataset.attrs.get("wall", SweepSettings.wall)
    there = [name for name in _PAIR if name in dataset.coords]
    # Of walls that differ a map has what each has, besides what was given for both.
    table_names = [name for name in there if f"{name}_left" not in dataset.coords]

    # Read where it is needed: no inclination gives some gamma of a plane.
    def device() -> Harvester:
        table = {name: first(name) for name in (*table_names, "A", "omega")}
        return realised(told_device(dataset.attrs), table, wall)[1]

    found: dict[str, float] = {}
    taken = {f"{one}{end}" for name in along for one in synonyms(name) for end in ("", "_left", "_right")}
    for name in there:
        both = of_both_walls(name)
        # Of rigid walls kappa is that of the one membrane which they are lent; that of one beside a soft one is none.
        lent = both == "kappa" and wall == "rigid"
        if name in taken or (both in there and not lent) or not math.isfinite(first(name)):
            continue
        if dataset[name].ndim == 0 or name.startswith("r"):
            found[both if lent else name] = first(name)
        else:
            constant = {"d": "s", "gamma": "beta"}.get(name, (both if lent else name).replace("kappa", "omega0"))
            found[constant] = float(field_of(device(), constant))
    found |= {name: first(name) for name in ("omega", "A") if name not in along}
    starts = {name: dataset[name] for name in ("u0", "v0") if name not in along and dataset[name].ndim == 0}
    usual = {"u0": min(START[0], START_REACH * found["d"]) if "d" in found else None, "v0": START[1]}
    return found | {name: float(start) for name, start in starts.items() if float(start) != usual[name]}


@dataclass(frozen=True)
class ExploredCell:
    """One cell of a map, or beside it: what its motion depends on.

    Attributes:
        pair, device: The nondimensional cell, and the device that has it.
        u0, v0: Where its motion begins.
        arguments: Of `sweep`, by which it is run.
        settings: Further arguments of `sweep`, where they are not its defaults.
    """

    pair: ImpactPair
    device: Harvester
    u0: float
    v0: float
    arguments: dict[str, Any]
    settings: dict[str, Any]

    @property
    def r(self) -> str:
        """Name an axis that every cell has: r, or where the walls differ that of the left one."""
        return "r" if "r" in self.arguments else "r_left"

    def off(self, along: str) -> dict[str, Any]:
        """Give the arguments of `orbit_diagram` along an axis through the cell, but for what is on that axis."""
        others = {name: value for name, value in self.arguments.items() if name != along}
        wall = {name: value for name, value in self.settings.items() if name == "wall"}
        return {"along": along, "device": self.device} | wall | others


def cell(plane: ExploredPlane, pick: tuple[int, int], values: Mapping[str, float]) -> ExploredCell:
    """Find what a picked cell is, with values of sliders in place of the map's.

    Raises:
        ValueError: Values that no cell can have.
    """
    arguments = plane.arguments(pick, values)
    found = {name: float(value.values) for name, value in cells(arguments, plane.device, plane.wall).quantities.items()}
    pair, device = realised(plane.device, found, plane.wall)
    return ExploredCell(pair, device, found["u0"], found["v0"], arguments, plane.settings())
