"""Pictures of curves of bifurcations in their plane, alone or over a map."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from vijax.continuation.curves.curve_table import CURVE_VARIABLES
from vijax.plots.curve_lines import FAINT, KINDS, curve_pieces, misfit, placed_points
from vijax.plots.figure import label_logs, styled
from vijax.plots.kind_maps import label_map
from vijax.plots.number_maps import power_map, variable_map
from vijax.plots.style import axis_label, title
from vijax.runtime import validation

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
# Candidate offsets of a number from the position that it marks, in pt. The offset with the largest clearance is chosen,
# or the first of several equal ones.
_NUMBER_OFFSETS = ((6, 5), (-6, 5), (6, -5), (-6, -5), (0, 8), (0, -8), (11, 0), (-11, 0))
_MOST_LISTED = 24  # most points in the legend; the dataset holds all of them
# Columns of the legend; the height of a line and the width of the list, in inches.
_COLUMNS, _LINE_HEIGHT, _LIST_WIDTH = 3, 0.17, 2.2


@styled
def curves(
    dataset: "xr.Dataset", over: "xr.Dataset | None" = None, *, ground: str = "label", unstable: bool = False
) -> Figure:
    """Draw curves of bifurcations in their plane, with numbered points of codimension 2, alone or over a map.

    Args:
        dataset: Result of `vijax.curve_dataset`.
        over: The map below the curves, with the same two axes and no others.
        ground: Coloured quantity of the map: "label", "P" as `power_map` draws it, or another variable.
        unstable: Whether the parts of curves that border on unstable orbits only are drawn too, faintly.

    Raises:
        ValueError: The map has other axes, walls or constants than the curves, or lacks the variable.
    """
    validation.validate_flag("unstable", unstable)
    if over is not None:
        validation.validate_dataset("over", over, ("period",) if ground == "label" else (), "vijax.sweep")
    validation.validate_choice("ground", ground, ["label"] if over is None else ["label", *map(str, over)])
    validation.validate_dataset("dataset", dataset, CURVE_VARIABLES, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    if over is None:
        figure, x, y = _empty_plane(dataset, names), names[0], names[1]
    else:
        figure, x, y = _ground(dataset, over, names, ground)
    axes = figure.axes[0]
    kinds = draw_curves(axes, dataset, x, y, unstable)
    handles = kind_handles(kinds)
    listed = _number(axes, dataset, x, y)
    handles += [Line2D([], [], label=text, **_point_style(number)) for number, text in listed[:_MOST_LISTED]]
    if len(listed) > _MOST_LISTED:
        handles.append(Line2D([], [], label=f"and {len(listed) - _MOST_LISTED} more", linestyle="none"))
    # A map of labels has its own legend at the side, a map of numbers below: the curves' legend takes the other place.
    legend_at_side = over is not None and ground != "label"
    columns = 1 if legend_at_side else _COLUMNS - (over is None)
    width, height = figure.get_size_inches()
    legend_height = _LINE_HEIGHT * -(-len(handles) // columns)
    figure.set_size_inches(
        (width + _LIST_WIDTH, max(height, legend_height)) if legend_at_side else (width, height + legend_height)
    )
    style: dict[str, Any] = {"ncols": columns, "frameon": False, "fontsize": "small", "handlelength": 2.4}
    figure.legend(handles=handles, loc="outside right upper" if legend_at_side else "outside lower center", **style)
    return figure


def _ground(dataset: "xr.Dataset", over: "xr.Dataset", names: list[str], ground: str) -> tuple[Figure, str, str]:
    """Draw the map below the curves; return the figure and the names of the axes across and up."""
    over = over.squeeze()
    dims = [str(dim) for dim in over["period" if ground == "label" else ground].dims]
    if set(dims) != set(names):
        got = ", ".join(dims) or "none"
        raise ValueError(f"over must be a map over {names[0]} and {names[1]} alone; got one over {got}")
    mismatch = misfit(dataset, over, (dims[0], dims[1]))
    if mismatch is not None:
        raise ValueError(
            f"over must be a map with the {mismatch.name} of the curves, {mismatch.of_curves}; got {mismatch.of_map}; "
            "vijax.bifurcation_curves finds those of this map"
        )
    if ground in ("label", "P"):
        return (label_map if ground == "label" else power_map)(over), dims[0], dims[1]
    return variable_map(over, ground), dims[0], dims[1]


def _empty_plane(dataset: "xr.Dataset", names: list[str]) -> Figure:
    """Return a figure of empty axes that span all curves."""
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
    """Return the legend entries of kinds of curves."""
    return [Line2D([], [], label=kind, **style) for kind, style in KINDS.items() if kind in kinds]


def draw_curves(axes: Axes, dataset: "xr.Dataset", x: str, y: str, unstable: bool) -> set[str]:
    """Draw every curve, and return the kinds that occur."""
    kinds = set()
    for piece in curve_pieces(dataset, x, y, unstable):
        width: dict[str, Any] = {"linewidth": 1.2} if piece.stable else {"linewidth": 0.8, "alpha": FAINT}
        if piece.stable:
            axes.plot(piece.x, piece.y, **_EDGE)
        axes.plot(piece.x, piece.y, **KINDS[piece.kind], **width)
        kinds.add(piece.kind)
    return kinds


def _number(axes: Axes, dataset: "xr.Dataset", x: str, y: str) -> list[tuple[int, str]]:
    """Mark and number the points of codimension 2; return their numbers and descriptions."""
    numbered = placed_points(dataset, x, y)
    occupied = [axes.transData.transform(point.parameters) * 72 / axes.figure.dpi for point in numbered]
    points = list(occupied)
    for point, position in zip(numbered, points, strict=True):
        axes.plot(*point.parameters, **_POINT, zorder=6)
        # Clearance of each offset: Chebyshev distance to the nearest marked position or number, in pt. Below,
        # clearances above 8 pt count as equal, so that the first of these offsets is chosen.
        clearances = [min(np.abs(position + offset - other).max() for other in occupied) for offset in _NUMBER_OFFSETS]
        best = _NUMBER_OFFSETS[int(np.argmax(np.minimum(clearances, 8)))]
        occupied.append(position + best)
        axes.annotate(str(point.number), point.parameters, xytext=best, **_NUMBER)
    return [
        (point.number, f"{point.kind} ({point.parameters[0]:.4g}, {point.parameters[1]:.4g})") for point in numbered
    ]


def _point_style(number: int) -> dict[str, Any]:
    """Return the legend style of a numbered point: its number as the marker."""
    size = 5.5 if number < 10 else 7.0
    return {"marker": f"${number}$", "markersize": size, "color": "black", "mew": 0, "linestyle": "none"}
