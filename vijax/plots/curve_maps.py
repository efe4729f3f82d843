"""Pictures of curves of bifurcations in their plane, alone or over a map."""

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vijax.plots.figure import styled
from vijax.plots.kind_maps import label_map
from vijax.plots.number_maps import power_map
from vijax.plots.style import axis_label, title
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

Ground = Literal["label", "P"]
_NEEDED = ("kind", "stable", "event", "end_first")
_COLOURS = {"fold": "tab:red", "flip": "tab:blue", "pitchfork": "black", "grazing": "tab:green"}
_EDGE: list[Any] = [Stroke(linewidth=2.6, foreground="white"), Normal()]
_POINT: dict[str, Any] = {"marker": "o", "markersize": 4, "color": "white", "mec": "black", "linestyle": "none"}
_MOST_LISTED = 24  # points beside a picture; all of them stand in the dataset
_FAINT = 0.25
# Columns of the legend; the height of a line and the width of the list, in inches.
_COLUMNS, _LINE_HEIGHT, _LIST_WIDTH = 3, 0.17, 2.2


@styled
def curves(
    dataset: "xr.Dataset", over: "xr.Dataset | None" = None, *, ground: Ground = "label", unstable: bool = False
) -> Figure:
    """Draw curves of bifurcations in their plane, with numbered points of codimension 2, alone or over a map.

    Args:
        dataset: What `vijax.curve_dataset` returned.
        over: The map that they are drawn over, with the same two axes and no others.
        ground: What the map shows: its labels, or P as `power_map` does.
        unstable: Whether grazings of unstable orbits are drawn too, faintly.

    Raises:
        ValueError: A map with other axes.
    """
    checks.variables("dataset", dataset, _NEEDED, "vijax.curve_dataset")
    checks.choice("ground", ground, ("label", "P"))
    names = dataset.attrs["along"].split()
    if over is None:
        figure, x, y = _bare(dataset, names), names[0], names[1]
    else:
        checks.variables("over", over, ("period",), "vijax.sweep")
        x, y = map(str, over["period"].dims) if over["period"].ndim == 2 else ("", "")
        if {x, y} != set(names):
            got = ", ".join(map(str, over["period"].dims))
            raise ValueError(f"over must be a map over {names[0]} and {names[1]} alone; got one over {got}")
        figure = label_map(over) if ground == "label" else power_map(over)
    axes = figure.axes[0]
    kinds = _draw(axes, dataset, x, y, unstable)
    handles = [Line2D([], [], color=_COLOURS[kind], label=kind) for kind in _COLOURS if kind in kinds]
    handles += [Line2D([], [], **_POINT, label=text) for text in _number(axes, dataset, x, y)]
    # A map of labels has its legend beside it, one of P below.
    beside = over is not None and ground == "P"
    columns = 1 if beside else _COLUMNS
    width, height = figure.get_size_inches()
    more = _LINE_HEIGHT * -(-len(handles) // columns)
    figure.set_size_inches((width + _LIST_WIDTH, max(height, more)) if beside else (width, height + more))
    style: dict[str, Any] = {"ncols": columns, "frameon": False, "fontsize": "x-small"}
    figure.legend(handles=handles, loc="outside right upper" if beside else "outside lower center", **style)
    return figure


def _bare(dataset: "xr.Dataset", names: list[str]) -> Figure:
    """Make a figure of empty axes that hold all curves."""
    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    axes = figure.subplots()
    limits = [(float(dataset[name].min()), float(dataset[name].max())) for name in names]
    scales = ["log" if low > 0 and high > 10 * low else "linear" for low, high in limits]
    axes.set(xscale=scales[0], yscale=scales[1], xlim=limits[0], ylim=limits[1])
    axes.set(xlabel=axis_label(dataset[names[0]]), ylabel=axis_label(dataset[names[1]]))
    figure.suptitle(title(dataset), fontsize="medium")
    return figure


def _draw(axes: Axes, dataset: "xr.Dataset", x: str, y: str, unstable: bool) -> set[str]:
    """Draw every curve, and say which kinds there are."""
    drawn = set()
    for index in range(dataset.sizes["curve"]):
        one = dataset.isel(curve=index)
        kind, stable = str(one["kind"].item()), one["stable"].values == 1
        across, up = one[x].values, one[y].values
        parts: list[tuple[np.ndarray, dict[str, Any]]] = [(stable, {"path_effects": _EDGE, "linewidth": 1.2})]
        if unstable:
            parts.append((~stable, {"alpha": _FAINT, "linewidth": 0.8}))
        for shown, style in parts:
            if (shown & np.isfinite(across)).any():
                axes.plot(np.where(shown, across, np.nan), up, color=_COLOURS[kind], **style)
                drawn.add(kind)
    return drawn


def _number(axes: Axes, dataset: "xr.Dataset", x: str, y: str) -> list[str]:
    """Mark and number the points of codimension 2, each place once, and tell what they are."""
    rows = zip(
        dataset["event"].values.flat,
        dataset[f"event_{x}"].values.flat,
        dataset[f"event_{y}"].values.flat,
        strict=True,
    )
    listed: list[str] = []
    for kind, across, up in rows:
        text = f"{kind} ({across:.4g}, {up:.4g})"
        if not kind or any(text == known.partition(" ")[2] for known in listed):
            continue
        listed.append(f"{len(listed) + 1} {text}")
        axes.plot(across, up, **_POINT, zorder=6)
        axes.annotate(str(len(listed)), (across, up), xytext=(3, 3), textcoords="offset points", fontsize="x-small")
    return listed[:_MOST_LISTED] + ([f"and {len(listed) - _MOST_LISTED} more"] if len(listed) > _MOST_LISTED else [])
