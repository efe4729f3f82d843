"""Pictures of orbit diagrams: a quantity of every impact over the axis that is swept."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vijax.model.quantities import POINT_QUANTITIES
from vijax.plots.figure import styled
from vijax.plots.style import FURTHER, QUANTITIES, axis_label, symbol, title, units
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr


_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#17a2b8", "#8c564b", "#e377c2", "black", "0.5")
_WAYS = {"down": r"falling $\longleftarrow$", "up": r"rising $\longrightarrow$"}
_POINT: dict[str, Any] = {"linestyle": "none", "marker": ".", "mew": 0, "rasterized": True}
_OTHER_WAY = "0.8"
# Energies of soft and stiff walls lie decades apart; grazing impacts so far below the greatest are left out.
_LOGARITHMIC, _DECADES = ("depth", "E", "P"), 8


@styled
def orbit_diagram(dataset: "xr.Dataset", quantity: str = "v_in") -> Figure:
    """Draw a quantity of every kept impact against the axis swept, a colour for each value of the other axis.

    Of a diagram in both directions each has its panel, the other one's points in grey behind its own: grey that shows
    is another attractor.

    Args:
        dataset: What `vijax.orbit_diagram` returned, with at most one axis besides the one swept.
        quantity: A variable over impacts, strobes or points.

    Raises:
        ValueError: A quantity that is none, more axes or values than a picture can hold.
    """
    check_quantity(quantity)
    checks.variables("dataset", dataset, ("P", quantity), "orbit_diagram")
    along = dataset.attrs["along"]
    others = check_layout(along, {str(dim): dataset.sizes[dim] for dim in dataset["P"].dims})
    ways = (
        [str(way) for way in dataset["direction"].values]
        if "direction" in dataset.dims
        else [dataset.attrs["direction"]]
    )
    figure = Figure(figsize=(6.4, 1.4 + 2.9 * len(ways)), layout="constrained")
    panels = figure.subplots(len(ways), sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, way in zip(panels, ways, strict=True):
        for other in ways:
            if other != way:
                _cloud(axes, _way(dataset, other), quantity, others, _OTHER_WAY)
        _cloud(axes, _way(dataset, way), quantity, others)
        axes.set_title(f"{symbol(dataset[along])} {_WAYS[way]}", loc="left", fontsize="medium")
        axes.set_ylabel(QUANTITIES[quantity])
        axes.margins(x=0.01)
    if quantity in _LOGARITHMIC:
        most = float(dataset[quantity].max())
        panels[0].set(yscale="log", ylim=(most / 10**_DECADES, 2 * most) if most > 0 else None)
    panels[-1].set_xlabel(axis_label(dataset[along]))
    figure.suptitle(title(dataset, FURTHER), fontsize="medium")
    _explain(figure, dataset, others, ways)
    return figure


def check_quantity(quantity: str) -> None:
    """Raise ValueError unless an orbit diagram can be drawn of it."""
    checks.choice("quantity", quantity, POINT_QUANTITIES)


def check_layout(along: str, sizes: Mapping[str, int]) -> list[str]:
    """Find the axis that colours stand for, if there is one.

    Raises:
        ValueError: If there are several, or more values than colours.
    """
    others = {dim: size for dim, size in sizes.items() if dim not in ("direction", along) and size > 1}
    if len(others) > 1:
        raise ValueError(f"plot must have at most one axis besides {along}; got {', '.join(others)}; keep one of them")
    for name, size in others.items():
        if size > len(_COLOURS):
            raise ValueError(f"plot must have at most {len(_COLOURS)} values of {name}, a colour each; got {size}")
    return list(others)


def _way(dataset: "xr.Dataset", way: str) -> "xr.Dataset":
    return dataset.sel(direction=way) if "direction" in dataset.dims else dataset


def _cloud(axes: Axes, dataset: "xr.Dataset", quantity: str, others: list[str], colour: str | None = None) -> None:
    """Draw the points of one direction, in one colour or in those of the other axis."""
    along = dataset.attrs["along"]
    single = [dim for dim in dataset["P"].dims if dim != along and dim not in others]
    found = dataset[quantity].squeeze(single).transpose(*others, along, ...)
    places = dataset[along]
    for values, own in zip(found.values if others else [found.values], _COLOURS, strict=False):
        values = values.reshape(places.size, -1)
        x = np.broadcast_to(places.values[:, None], values.shape)
        there = np.isfinite(values)
        axes.plot(x[there], values[there], color=colour or own, markersize=_size(places.size), **_POINT)


def _size(columns: int) -> float:
    """Choose the size of a point among so many columns of points."""
    return float(np.clip(300 / columns, 1.4, 2.8))


def _explain(figure: Figure, dataset: "xr.Dataset", others: list[str], ways: list[str]) -> None:
    """Explain which colour stands for what, below the panels."""
    colours: list[str] = []
    texts: list[str] = []
    for name in others:
        of = dataset[name]
        colours += _COLOURS[: of.size]
        texts += [f"{symbol(of)} = {value:.4g} {units(of)}".strip() for value in of.values]
    if len(ways) > 1:
        colours.append(_OTHER_WAY)
        texts.append("the other direction")
    handles = [Line2D([], [], color=colour, **_POINT | {"markersize": 8}) for colour in colours]
    if handles:
        figure.legend(
            handles, texts, loc="outside lower center", ncols=min(len(texts), 6), frameon=False, handlelength=1
        )
