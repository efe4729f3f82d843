"""Pictures of curves of bifurcations in their plane, alone or over a map."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vijax.orbits.curve_rows import NEEDED
from vijax.plots.curve_lines import FAINT, KINDS, curve_pieces, misfit, placed_points
from vijax.plots.figure import label_logs, styled
from vijax.plots.kind_maps import label_map
from vijax.plots.number_maps import power_map, variable_map
from vijax.plots.style import axis_label, title
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

_EDGE: dict[str, Any] = {"color": "white", "linewidth": 2.4, "solid_capstyle": "butt"}
_POINT: dict[str, Any] = {"marker": "o", "markersize": 3.6, "color": "white", "mec": "black", "linestyle": "none"}
_NUMBER: dict[str, Any] = {
    "textcoords": "offset points",
    "ha": "center",
    "va": "center",
    "fontsize": "small",
    "path_effects": [Stroke(linewidth=1.8, foreground="white"), Normal()],
    "zorder": 7,
}
# Where a number may stand beside its point, in points: where there is most room, the first of these at equal room.
_BESIDE = ((6, 5), (-6, 5), (6, -5), (-6, -5), (0, 8), (0, -8), (11, 0), (-11, 0))
_MOST_LISTED = 24  # points beside a picture; all of them stand in the dataset
# Columns of the legend; the height of a line and the width of the list, in inches.
_COLUMNS, _LINE_HEIGHT, _LIST_WIDTH = 3, 0.17, 2.2


@styled
def curves(
    dataset: "xr.Dataset", over: "xr.Dataset | None" = None, *, ground: str = "label", unstable: bool = False
) -> Figure:
    """Draw curves of bifurcations in their plane, with numbered points of codimension 2, alone or over a map.

    Args:
        dataset: What `vijax.curve_dataset` returned.
        over: The map that they are drawn over, with the same two axes and no others.
        ground: What the map shows: "label", "P" as `power_map` draws it, or another variable of it.
        unstable: Whether what is met by unstable orbits alone is drawn too, faintly: grazings and limits.

    Raises:
        ValueError: A map with other axes, with other walls or constants than the curves, or without such a variable.
    """
    checks.flag("unstable", unstable)
    if over is not None:
        checks.variables("over", over, ("period",) if ground == "label" else (), "vijax.sweep")
    checks.choice("ground", ground, ["label"] if over is None else ["label", *map(str, over)])
    checks.variables("dataset", dataset, NEEDED, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    if over is None:
        figure, x, y = _bare(dataset, names), names[0], names[1]
    else:
        figure, x, y = _ground(dataset, over, names, ground)
    axes = figure.axes[0]
    kinds = draw_curves(axes, dataset, x, y, unstable)
    handles = kind_handles(kinds)
    listed = _number(axes, dataset, x, y)
    handles += [Line2D([], [], label=text, **_listed(number)) for number, text in listed[:_MOST_LISTED]]
    if len(listed) > _MOST_LISTED:
        handles.append(Line2D([], [], label=f"and {len(listed) - _MOST_LISTED} more", linestyle="none"))
    # A map of labels has its legend beside it, one of numbers below.
    beside = over is not None and ground != "label"
    columns = 1 if beside else _COLUMNS - (over is None)
    width, height = figure.get_size_inches()
    more = _LINE_HEIGHT * -(-len(handles) // columns)
    figure.set_size_inches((width + _LIST_WIDTH, max(height, more)) if beside else (width, height + more))
    style: dict[str, Any] = {"ncols": columns, "frameon": False, "fontsize": "small", "handlelength": 2.4}
    figure.legend(handles=handles, loc="outside right upper" if beside else "outside lower center", **style)
    return figure


def _ground(dataset: "xr.Dataset", over: "xr.Dataset", names: list[str], ground: str) -> tuple[Figure, str, str]:
    """Draw the map below curves in a plane of two parameters, and say which of them is across, which is up."""
    over = over.squeeze()
    dims = [str(dim) for dim in over["period" if ground == "label" else ground].dims]
    if set(dims) != set(names):
        got = ", ".join(dims) or "none"
        raise ValueError(f"over must be a map over {names[0]} and {names[1]} alone; got one over {got}")
    other = misfit(dataset, over, (dims[0], dims[1]))
    if other is not None:
        raise ValueError(
            f"over must be a map with the {other.what} of the curves, {other.of_curves}; got {other.of_map}; "
            "vijax.bifurcation_curves finds those of this map"
        )
    if ground in ("label", "P"):
        return (label_map if ground == "label" else power_map)(over), dims[0], dims[1]
    return variable_map(over, ground), dims[0], dims[1]


def _bare(dataset: "xr.Dataset", names: list[str]) -> Figure:
    """Make a figure of empty axes that hold all curves."""
    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    axes = figure.subplots()
    limits = [(float(dataset[name].min()), float(dataset[name].max())) for name in names]
    scales = ["log" if low > 0 and high > 10 * low else "linear" for low, high in limits]
    axes.set(xscale=scales[0], yscale=scales[1], xlim=limits[0], ylim=limits[1])
    axes.set(xlabel=axis_label(dataset[names[0]]), ylabel=axis_label(dataset[names[1]]))
    label_logs(axes)
    figure.suptitle(title(dataset), fontsize="medium")
    return figure


def kind_handles(kinds: Collection[str]) -> list[Line2D]:
    """Give the entries of a legend for kinds of curves."""
    return [Line2D([], [], label=kind, **style) for kind, style in KINDS.items() if kind in kinds]


def draw_curves(axes: Axes, dataset: "xr.Dataset", x: str, y: str, unstable: bool) -> set[str]:
    """Draw every curve, and say which kinds there are."""
    drawn = set()
    for one in curve_pieces(dataset, x, y, unstable):
        width: dict[str, Any] = {"linewidth": 1.2} if one.stable else {"linewidth": 0.8, "alpha": FAINT}
        if one.stable:
            axes.plot(one.x, one.y, **_EDGE)
        axes.plot(one.x, one.y, **KINDS[one.kind], **width)
        drawn.add(one.kind)
    return drawn


def _number(axes: Axes, dataset: "xr.Dataset", x: str, y: str) -> list[tuple[int, str]]:
    """Mark and number the points of codimension 2, each place once, and tell what they are."""
    numbered = placed_points(dataset, x, y)
    taken = [axes.transData.transform(one.place) * 72 / axes.figure.dpi for one in numbered]
    points = list(taken)
    for one, at in zip(numbered, points, strict=True):
        axes.plot(*one.place, **_POINT, zorder=6)
        room = [min(np.abs(at + beside - other).max() for other in taken) for beside in _BESIDE]
        best = _BESIDE[int(np.argmax(np.minimum(room, 8)))]
        taken.append(at + best)
        axes.annotate(str(one.number), one.place, xytext=best, **_NUMBER)
    return [(one.number, f"{one.kind} ({one.place[0]:.4g}, {one.place[1]:.4g})") for one in numbered]


def _listed(number: int) -> dict[str, Any]:
    """Give the handle of a point in the legend: its number."""
    size = 5.5 if number < 10 else 7.0
    return {"marker": f"${number}$", "markersize": size, "color": "black", "mew": 0, "linestyle": "none"}
