"""Pictures of orbit diagrams: a quantity of every impact over the swept axis."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vijax.model.quantities import POINT_QUANTITIES
from vijax.plots.figure import styled
from vijax.plots.style import FURTHER, QUANTITIES, axis_label, symbol, title, units
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr


_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#17a2b8", "#8c564b", "#e377c2", "black", "0.5")
_DIRECTION_TITLES = {"down": r"falling $\longleftarrow$", "up": r"rising $\longrightarrow$"}
_POINT: dict[str, Any] = {"linestyle": "none", "marker": ".", "mew": 0, "rasterized": True}
_OTHER_DIRECTION = "0.8"
# Quantities with a logarithmic axis, because their values at soft and at stiff walls lie decades apart. This axis shows
# `_DECADES` decades below the largest value, so that impacts near grazing are left out.
_LOGARITHMIC, _DECADES = ("depth", "E", "P"), 8


@styled
def orbit_diagram(dataset: "xr.Dataset", quantity: str = "v_in") -> Figure:
    """Draw a quantity of every recorded impact over the swept axis, with one colour per value of the other axis.

    A diagram in both directions has one panel per direction; the points of the other direction lie in grey behind.
    Visible grey points belong to another attractor.

    Args:
        dataset: Result of `vijax.orbit_diagram`, with at most one axis besides the swept one.
        quantity: A variable over impacts, strobes or points.

    Raises:
        ValueError: The quantity is invalid, or there are more axes or values than a picture can hold.
    """
    check_quantity(quantity)
    validation.validate_dataset("dataset", dataset, ("P", quantity), "orbit_diagram")
    along = dataset.attrs["along"]
    others = check_layout(along, {str(dim): dataset.sizes[dim] for dim in dataset["P"].dims})
    directions = (
        [str(direction) for direction in dataset["direction"].values]
        if "direction" in dataset.dims
        else [dataset.attrs["direction"]]
    )
    figure = Figure(figsize=(6.4, 1.4 + 2.9 * len(directions)), layout="constrained")
    panels = figure.subplots(len(directions), sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, direction in zip(panels, directions, strict=True):
        for other in directions:
            if other != direction:
                _draw_points(axes, _in_direction(dataset, other), quantity, others, _OTHER_DIRECTION)
        _draw_points(axes, _in_direction(dataset, direction), quantity, others)
        axes.set_title(f"{symbol(dataset[along])} {_DIRECTION_TITLES[direction]}", loc="left", fontsize="medium")
        axes.set_ylabel(QUANTITIES[quantity])
        axes.margins(x=0.01)
    if quantity in _LOGARITHMIC:
        largest = float(dataset[quantity].max())
        panels[0].set(yscale="log", ylim=(largest / 10**_DECADES, 2 * largest) if largest > 0 else None)
    panels[-1].set_xlabel(axis_label(dataset[along]))
    figure.suptitle(title(dataset, FURTHER), fontsize="medium")
    _explain(figure, dataset, others, directions)
    return figure


def check_quantity(quantity: str) -> None:
    """Raise ValueError unless the quantity is among the quantities of an orbit diagram."""
    validation.validate_choice("quantity", quantity, POINT_QUANTITIES)


def check_layout(along: str, sizes: Mapping[str, int]) -> list[str]:
    """Return the names of the axes that the colours represent: a list of one name, or of none.

    Raises:
        ValueError: There are several such axes, or more values than colours.
    """
    others = {dim: size for dim, size in sizes.items() if dim not in ("direction", along) and size > 1}
    if len(others) > 1:
        raise ValueError(f"plot must have at most one axis besides {along}; got {', '.join(others)}; keep one of them")
    for name, size in others.items():
        if size > len(_COLOURS):
            raise ValueError(f"plot must have at most {len(_COLOURS)} values of {name}, a colour each; got {size}")
    return list(others)


def _in_direction(dataset: "xr.Dataset", direction: str) -> "xr.Dataset":
    return dataset.sel(direction=direction) if "direction" in dataset.dims else dataset


def _draw_points(
    axes: Axes, dataset: "xr.Dataset", quantity: str, others: list[str], colour: str | None = None
) -> None:
    """Draw the points of one direction, in one colour or in the colours of the other axis."""
    along = dataset.attrs["along"]
    single = [dim for dim in dataset["P"].dims if dim != along and dim not in others]
    variable = dataset[quantity].squeeze(single).transpose(*others, along, ...)
    along_values = dataset[along]
    for values, series_colour in zip(variable.values if others else [variable.values], _COLOURS, strict=False):
        values = values.reshape(along_values.size, -1)
        x = np.broadcast_to(along_values.values[:, None], values.shape)
        finite = np.isfinite(values)
        axes.plot(
            x[finite], values[finite], color=colour or series_colour, markersize=_size(along_values.size), **_POINT
        )


def _size(columns: int) -> float:
    """Return the marker size of a point if the swept axis has this number of values."""
    return float(np.clip(300 / columns, 1.4, 2.8))


def _explain(figure: Figure, dataset: "xr.Dataset", others: list[str], directions: list[str]) -> None:
    """Write the meaning of the colours below the panels."""
    colours: list[str] = []
    texts: list[str] = []
    for name in others:
        coordinate = dataset[name]
        colours += _COLOURS[: coordinate.size]
        texts += [f"{symbol(coordinate)} = {value:.4g} {units(coordinate)}".strip() for value in coordinate.values]
    if len(directions) > 1:
        colours.append(_OTHER_DIRECTION)
        texts.append("the other direction")
    handles = [Line2D([], [], color=colour, **_POINT | {"markersize": 8}) for colour in colours]
    if handles:
        figure.legend(
            handles, texts, loc="outside lower center", ncols=min(len(texts), 6), frameon=False, handlelength=1
        )
