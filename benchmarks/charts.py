"""Charts that benchmarks draw: work against precision, limits of stability."""

import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from vijax.plots.style import STYLE, check_format, save_figure

_OUTLINE: dict[str, Any] = {
    "color": "red",
    "linewidth": 1.2,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}


def stability_map(found: Any, path: str | Path | None = None) -> Figure:
    """Where an explicit method stays bounded over stiffness and steps per period, under the boundary of theory.

    Args:
        found: A record with `kappa` [K] and `steps` [S], both ascending, `stable` [S, K], and `least_steps` [K], the
            boundary.
        path: Where to write it, if anywhere; the ending chooses the format.

    Raises:
        ValueError: If the path does not end as a picture does.
    """
    if path is not None:
        check_format(path)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.8), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", yscale="log", xlabel=r"$\kappa$", ylabel="RK4 steps per period")
        axes.pcolormesh(found.kappa, found.steps, found.stable, cmap="Blues_r", vmin=-1, vmax=1.5, rasterized=True)
        axes.plot(found.kappa, found.least_steps, **_OUTLINE)
        axes.set(xlim=found.kappa[[0, -1]], ylim=found.steps[[0, -1]])
        shades = (Patch(color=mpl.colormaps["Blues_r"](shade)) for shade in (0.8, 0.4))
        handles = [*shades, Line2D([], [], **_OUTLINE)]
        texts = ["bounded", "blown up within 50 periods", "theory"]
        figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)
        if path is not None:
            save_figure(figure, path)
    return figure


# The same colour for a method everywhere: vijax in strong colours and whole lines, its peers dashed.
_METHODS: dict[str, tuple[str, str]] = {
    "exact": ("#d62728", "-"),
    "exact float32": ("#ff7f0e", "-"),
    "ode Tsit5": ("#1f77b4", "-"),
    "ode Dopri8": ("#17a2b8", "-"),
    "ode Kvaerno5": ("#7b5fc7", "-"),
    "rk4": ("#8c564b", "-"),
    "numba RK4": ("#c49a6c", "--"),
    "numba DP5 + events": ("#2ca02c", "--"),
    "diffrax restarts": ("#6baed6", "--"),
    "SciPy DOP853": ("0.35", "--"),
    "SciPy Radau": ("0.6", "--"),
}
_MEASURES = {
    "state": "error of the state",
    "power": "bias of mean $P$ / standard error",
    "gradient": "relative error of the gradient",
}
_HOW_TO_READ = (
    "down and to the left is better; the grey stairs are the best there is at each cost\n"
    "whole lines: vijax; dashed: its peers; crosses: no result"
)
_COLUMNS = 3
_ROUNDING = 1e-16  # an error below is drawn there
_NOISE = 2.0  # standard errors that mean nothing
_LEAST = 1.0  # fewer are drawn as so many: there is no better and worse among them
_LABEL_GAP = 0.052  # between labels, of the height of a panel


def work_precision(rows: Iterable[Any], path: str | Path | None = None) -> Figure:
    """Error against cost, a panel a scene: down and to the left is better, and the grey stairs are what can be had.

    Args:
        rows: Records with scene, measure ("state", "power", "gradient"), method, us (microseconds per cell-period),
            error and noise (its standard error, of averages), in the order of panels and of settings. An infinite
            error is drawn as a cross on the upper edge.
        path: Picture to write.

    Raises:
        ValueError: A format that is none.
    """
    if path is not None:
        check_format(path)
    scenes: dict[str, list[Any]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    columns = min(_COLUMNS, len(scenes))
    lines = math.ceil(len(scenes) / columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.4 * columns, 3.0 * lines + 0.3), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False)
        span = _decades([row.us for panel in scenes.values() for row in panel])
        for axes, panel in itertools.zip_longest(grid.flat, scenes.items()):
            if panel is None:
                axes.set_visible(False)
            else:
                axes.set_xlim(span)
                _work_panel(axes, *panel)
        figure.suptitle(_HOW_TO_READ, fontsize="medium")
        figure.supxlabel("microseconds per cell-period, warm", fontsize="medium")
        if path is not None:
            save_figure(figure, path)
    return figure


def _decades(values: list[float]) -> tuple[float, float]:
    """Limits of a logarithmic axis, with room for labels to the right."""
    return min(values) / 2, max(values) * 20


def _work_panel(axes: Axes, title: str, rows: list[Any]) -> None:
    measure = rows[0].measure
    errors = [row.error / row.noise if row.noise else row.error for row in rows]
    finite = [error for error in errors if math.isfinite(error)] or [1.0]
    low, high = (_LEAST if measure == "power" else _ROUNDING), max(10.0, 10 * max(finite))
    errors = [max(error, low) for error in errors]
    axes.set(title=title, xscale="log", yscale="log", ylim=(low / 3, high), ylabel=_MEASURES[measure])
    if measure == "power":
        axes.axhspan(low / 3, _NOISE, color="0.94", zorder=0)
        axes.text(0.98, 0.02, "noise", transform=axes.transAxes, ha="right", color="0.5", fontsize=7, in_layout=False)
    axes.grid(color="0.9", linewidth=0.4)
    axes.set_axisbelow(True)
    points = [(row.us, error) for row, error in zip(rows, errors, strict=True) if math.isfinite(error)]
    across, up = _stairs(points, axes.get_xlim()[1], high)
    axes.plot(across, up, color="0.8", linewidth=4, solid_joinstyle="miter", zorder=1)
    ends = []
    for method in dict.fromkeys(row.method for row in rows):
        colour, style = _METHODS[method]
        chosen = [(row.us, error) for row, error in zip(rows, errors, strict=True) if row.method == method]
        good = [(x, y) for x, y in chosen if math.isfinite(y)]
        bad = [x for x, y in chosen if not math.isfinite(y)]
        if good:
            line: dict[str, Any] = {
                "color": colour,
                "linestyle": style,
                "linewidth": 1.1,
                "marker": "o",
                "markersize": 2.5,
            }
            axes.plot(*zip(*good, strict=True), **line)
            ends.append((*min(good, key=lambda point: point[1]), method, colour))
        if bad:  # a line without points and clipping would count as one at the picture's corner
            axes.plot(bad, [high] * len(bad), color=colour, marker="x", linestyle="none", clip_on=False)
    _label_ends(axes, ends)


def _stairs(points: list[tuple[float, float]], right: float, top: float) -> tuple[list[float], list[float]]:
    """The least error that each cost buys."""
    across, up, best_yet = [], [], top
    for x, y in sorted(points):
        if y < best_yet:
            across += [x, x]
            up += [best_yet, y]
            best_yet = y
    return [*across, right], [*up, best_yet]


def _label_ends(axes: Axes, ends: list[tuple[float, float, str, str]]) -> None:
    """Name each line at its most accurate point; names that would collide give way downwards or upwards."""
    (left, right), (low, high) = np.log(axes.get_xlim()), np.log(axes.get_ylim())
    taken: list[tuple[float, float, float]] = []
    for x, y, method, colour in sorted(ends, key=lambda end: end[1]):
        place, height = (np.log(x) - left) / (right - left), (np.log(y) - low) / (high - low)
        width = 0.02 * len(method)
        begin = place + 0.015 if place + width < 1 else place - width - 0.015
        height -= 0.03
        while any(
            abs(height - other) < _LABEL_GAP and begin < end and start < begin + width for start, end, other in taken
        ):
            height += 0.01
        taken.append((begin, begin + width, height))
        style: Any = {
            "fontsize": 7,
            "in_layout": False,
            "path_effects": [Stroke(linewidth=2, foreground="white"), Normal()],
        }
        axes.text(begin, max(height, 0.01), method, transform=axes.transAxes, color=colour, **style)
