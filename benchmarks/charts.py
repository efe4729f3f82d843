"""Charts that benchmarks draw: work against precision, limits of stability, derivatives of averages."""

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from vijax.plots.figure import save, styled
from vijax.plots.style import check_format


def _chart(draw: Callable[[Any], Figure]) -> Callable[..., Figure]:
    """Decorate a function that draws rows: it draws in the common style, and saves the picture if given a path."""
    styled_draw = styled(draw)

    @functools.wraps(draw)
    def draw_and_save(rows: Any, path: str | Path | None = None) -> Figure:
        if path is not None:
            check_format(path)
        figure = styled_draw(rows)
        if path is not None:
            save(figure, path)
        return figure

    return draw_and_save


def _by(rows: Iterable[Any], field: str) -> dict[str, list[Any]]:
    """Group rows by a field, in the order of their first occurrence."""
    parts: dict[str, list[Any]] = {}
    for row in rows:
        parts.setdefault(getattr(row, field), []).append(row)
    return parts


_OUTLINE: dict[str, Any] = {
    "color": "red",
    "linewidth": 1.2,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}


@_chart
def stability_map(result: Any) -> Figure:
    """Draw the stable region of an explicit method over stiffness and steps per period, with the safe bound.

    Args:
        result: A record with `kappa` [K] and `steps` [S], both ascending, `stable` [S, K], and `least_steps` [K], the
            boundary.
    """
    figure = Figure(figsize=(5.2, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlabel=r"$\kappa$", ylabel="RK4 steps per period")
    axes.pcolormesh(result.kappa, result.steps, result.stable, cmap="Blues_r", vmin=-1, vmax=1.5, rasterized=True)
    axes.plot(result.kappa, result.least_steps, **_OUTLINE)
    axes.set(xlim=result.kappa[[0, -1]], ylim=result.steps[[0, -1]])
    shades = (Patch(color=mpl.colormaps["Blues_r"](shade)) for shade in (0.8, 0.4))
    handles = [*shades, Line2D([], [], **_OUTLINE)]
    texts = ["bounded", "blown up within 50 periods", "safe bound"]
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)
    return figure


# Each method has one colour in all charts: vijax in strong colours and solid lines, its peers dashed.
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
_ROUNDING = 1e-16  # smaller errors are drawn here
_NOISE = 2.0  # standard errors that are not significant
_LEAST = 1.0  # smaller ratios are drawn here, as they do not differ significantly


@_chart
def work_precision(rows: Iterable[Any]) -> Figure:
    """Draw error against cost, a panel a scene; the grey stairs are the least error of all methods at each cost.

    Args:
        rows: Records with scene, measure ("state", "power", "gradient"), method, us (microseconds per cell-period),
            error and noise (its standard error, of averages), in the order of panels and of settings. An infinite error
            is drawn as a cross on the upper edge.
    """
    scenes = _by(rows, "scene")
    columns = min(_COLUMNS, len(scenes))
    lines = math.ceil(len(scenes) / columns)
    figure = Figure(figsize=(2.9 * columns, 2.6 * lines + 1.0), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False)
    span = _decades([row.us for panel in scenes.values() for row in panel])
    for axes, panel in itertools.zip_longest(grid.flat, scenes.items()):
        if panel is None:
            axes.set_visible(False)
        else:
            axes.set_xlim(span)
            _work_panel(axes, *panel)
    figure.suptitle(_HOW_TO_READ, fontsize="medium")
    grid[-1, columns // 2].set_xlabel("microseconds per cell-period, warm")  # a common label would overlap the legend
    methods = [method for method in _METHODS if any(row.method == method for panel in scenes.values() for row in panel)]
    styles: list[dict[str, Any]] = [dict(zip(("color", "linestyle"), _METHODS[name], strict=True)) for name in methods]
    handles = [Line2D([], [], marker="o", **style) for style in styles]
    figure.legend(
        handles, methods, loc="outside lower center", ncols=min(2 * columns, 6), frameon=False, markerscale=0.5
    )
    return figure


def _decades(values: list[float]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis."""
    return min(values) / 2, max(values) * 2


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
    for method in dict.fromkeys(row.method for row in rows):
        colour, style = _METHODS[method]
        points_of_method = [(row.us, error) for row, error in zip(rows, errors, strict=True) if row.method == method]
        finite_points = [(x, y) for x, y in points_of_method if math.isfinite(y)]
        infinite_costs = [x for x, y in points_of_method if not math.isfinite(y)]
        if finite_points:
            line: dict[str, Any] = {
                "color": colour,
                "linestyle": style,
                "linewidth": 1.1,
                "marker": "o",
                "markersize": 2.5,
            }
            axes.plot(*zip(*finite_points, strict=True), **line)
        if infinite_costs:  # a line without points and clipping would count as one at the picture's corner
            axes.plot(
                infinite_costs, [high] * len(infinite_costs), color=colour, marker="x", linestyle="none", clip_on=False
            )


def _stairs(points: list[tuple[float, float]], right: float, top: float) -> tuple[list[float], list[float]]:
    """Return the least error at each cost as a step line."""
    across, up, best_yet = [], [], top
    for x, y in sorted(points):
        if y < best_yet:
            across += [x, x]
            up += [best_yet, y]
            best_yet = y
    return [*across, right], [*up, best_yet]


_TAILS_COLUMNS = 4


@_chart
def tails(rows: Iterable[Any]) -> Figure:
    """Draw the errors of each method over the cells of a plane against its cost: a panel a method, others in grey.

    Args:
        rows: Rows of `tails.Row`, in the order of settings; the row "one rounding" is the least level that float64 can
            reach.
    """
    methods = _by(rows, "method")
    (rounding,) = methods.pop("one rounding")
    lines = math.ceil(len(methods) / _TAILS_COLUMNS)
    figure = Figure(figsize=(9.6, 2.3 * lines + 0.3), layout="constrained")
    grid = figure.subplots(lines, _TAILS_COLUMNS, sharex=True, sharey=True, squeeze=False)
    costs = [row.us for group in methods.values() for row in group]
    grid[0, 0].set(xscale="log", yscale="log", xlim=(min(costs) / 2, max(costs) * 2), ylim=(_ROUNDING, 30))
    for axes, panel in itertools.zip_longest(grid.flat, methods.items()):
        if panel is None:
            axes.set_visible(False)
            continue
        for other, group in methods.items():
            if other != panel[0]:
                _tail(axes, group, "0.85", 0.0)
        axes.axhline(rounding.quantile, color="0.4", linewidth=0.7, linestyle=":")
        _tail(axes, panel[1], _METHODS[panel[0]][0], 0.25)
        axes.set_title(panel[0], fontsize=9)
    figure.supxlabel("microseconds of core time per cell-period, warm", fontsize="medium")
    figure.supylabel("error of the state after 3 periods", fontsize="medium")
    return figure


def _tail(axes: Axes, rows: list[Any], colour: str, shade: float) -> None:
    """Draw the median and the 99 % quantile of the errors; a cross and its share mark cells with other motions."""
    cost = [row.us for row in rows]
    median, quantile = ([max(getattr(row, name), _ROUNDING) for row in rows] for name in ("median", "quantile"))
    if not shade:
        axes.plot(cost, quantile, color=colour, linewidth=0.6, marker="o", markersize=1, zorder=1)
        return
    axes.fill_between(cost, median, quantile, color=colour, alpha=shade, linewidth=0)
    axes.plot(cost, median, color=colour, linewidth=0.8, linestyle="--", marker="o", markersize=2, fillstyle="none")
    axes.plot(cost, quantile, color=colour, linewidth=1.3, marker="o", markersize=2.5)
    for row, height in zip(rows, quantile, strict=True):
        if row.other:
            axes.plot(row.us, min(height, 10), color=colour, marker="x", markersize=5, linestyle="none")
            share_text = f"{100 * row.other / row.cells:.2g} %"
            axes.annotate(
                share_text, (row.us, min(height, 10)), (0, 4), textcoords="offset points", ha="center", fontsize=6
            )


@_chart
def labels(rows: Iterable[Any]) -> Figure:
    """Draw the share of cells with a wrong label, or none, against the cost of a cell.

    Args:
        rows: Rows of `tails.LabelRow`, in the order of settings.
    """
    methods = _by(rows, "method")
    figure = Figure(figsize=(5.6, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", xlabel="microseconds of core time a cell, warm", ylabel="cells, %", ylim=(-3, 103))
    axes.grid(color="0.9", linewidth=0.4)
    for method, group in methods.items():
        colour, style = _METHODS[method]
        cost = [row.us for row in group]
        wrong = [100 * row.wrong / row.cells for row in group]
        either = [100 * (row.wrong + row.undecided) / row.cells for row in group]
        axes.plot(cost, wrong, color=colour, linestyle=style, marker="o", markersize=4, linewidth=1, label=method)
        axes.plot(cost, either, color=colour, marker="o", markersize=5, linestyle="none", fillstyle="none")
    axes.plot([], [], color="0.3", marker="o", markersize=4, linestyle="none", label="another label")
    axes.plot([], [], color="0.3", marker="o", markersize=5, linestyle="none", fillstyle="none", label="or none")
    axes.legend(fontsize=7, frameon=False)
    return figure


_DERIVATIVES = {
    "automatic differentiation": ("#d62728", "x", "--"),
    "ensemble": ("#1f77b4", "o", "-"),
    "implicit rule of the orbit": ("#2ca02c", "", ":"),
}
_WIDTHS = 0.8, 1.4, 2.2
_SMOOTHNESS_COLOURS = {
    "smooth": "#1f77b4",
    "window": "#ff7f0e",
    "attractors": "#9467bd",
    "kink": "#d62728",
    "failed": "black",
}
_BEST, _WORST = 1e-5, 1e7  # derivative errors below the first are drawn at the edge, above the second are not drawn


@_chart
def averages(rows: Iterable[Any]) -> Figure:
    """Draw five panels: errors by method, cells against larger fits, the edge of chaos, a crisis, missed attractors.

    Args:
        rows: Rows of `averages.Row`.
    """
    parts: dict[str, list[Any]] = {part: [] for part in _PANELS}
    for row in rows:
        parts[row.part].append(row)
    figure = Figure(figsize=(8.2, 9.6), layout="constrained")
    axes_list = [figure.add_subplot(3, 2, number) for number in range(1, len(_PANELS) + 1)]
    for axes, (part, draw) in zip(axes_list, _PANELS.items(), strict=True):
        axes.grid(color="0.9", linewidth=0.4)
        axes.set_axisbelow(True)
        if parts[part]:
            draw(axes, parts[part])
    return figure


def _by_length(axes: Axes, rows: list[Any]) -> None:
    axes.set(xscale="log", yscale="log", ylim=(_BEST, _WORST), xlabel="forcing periods flown")
    axes.set(title="which method fails where", ylabel=r"error of $d\ln P/d\ln\kappa$")
    scenes = list(dict.fromkeys(row.scene for row in rows))
    for method, (colour, marker, style) in _DERIVATIVES.items():
        for scene, width in zip(scenes, _WIDTHS, strict=False):
            selected = [row for row in rows if (row.method, row.scene) == (method, scene)]
            errors = np.maximum([abs(row.value - row.reference) for row in selected], _BEST)
            periods = [row.at for row in selected]
            if len(selected) == 1:  # the orbit's rule needs no periods
                axes.axhline(errors[0], color=colour, linestyle=style, label=method)
            elif selected:
                line: dict[str, Any] = {"linewidth": width, "markersize": 3, "linestyle": style}
                axes.plot(periods, errors, color=colour, marker=marker, label=f"{method}, {scene}", **line)
    axes.legend(fontsize=6, loc="upper right")


def _against_fits(axes: Axes, rows: list[Any]) -> None:
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="both standard errors, of the derivative",
        ylabel="difference, of the derivative",
    )
    axes.set(title="chaotic cells against ten times as many balls")
    for smoothness, colour in _SMOOTHNESS_COLOURS.items():
        selected = [row for row in rows if row.smoothness == smoothness]
        error = [np.hypot(row.stderr, row.reference_stderr) / abs(row.reference) for row in selected]
        relative_error = [max(abs(row.value / row.reference - 1), _BEST) for row in selected]
        if selected:
            axes.plot(error, relative_error, ".", color=colour, markersize=3, label=smoothness)
    edge = np.array(axes.get_xlim())
    axes.plot(edge, 2 * edge, color="0.5", linewidth=0.8, label="2 standard errors")
    axes.set_xlim(*edge)
    axes.legend(fontsize=7, loc="upper left")


def _edge_of_chaos(axes: Axes, rows: list[Any]) -> None:
    axes.set(title="the edge of chaos", xlabel=r"$\kappa$", ylabel=r"$d\ln P/d\ln\kappa$")
    selected = [row for row in rows if row.quantity == "kappa"]
    axes.plot(
        [row.at for row in selected],
        [row.reference for row in selected],
        color="0.6",
        label="differences of neighbours",
    )
    for smoothness, colour in _SMOOTHNESS_COLOURS.items():
        rows_of_smoothness = [row for row in selected if row.smoothness == smoothness]
        if rows_of_smoothness:
            kappa, value, error = (
                [getattr(row, name) for row in rows_of_smoothness] for name in ("at", "value", "stderr")
            )
            axes.errorbar(kappa, value, error, fmt="o", color=colour, markersize=3, linewidth=0.8, label=smoothness)
    axes.legend(fontsize=7)


def _crisis(axes: Axes, rows: list[Any]) -> None:
    axes.set(title="a crisis: chaos grows", xlabel=r"$\kappa$", ylabel="over its first value")
    for quantity, name, colour in (("depth", "largest depth", "#d62728"), ("P", r"$P$", "#1f77b4")):
        selected = [row for row in rows if row.quantity == quantity]
        kappa, value = [row.at for row in selected], np.array([row.value for row in selected])
        axes.plot(kappa, value / value[0], "o-", color=colour, markersize=3, linewidth=0.8, label=name)
    axes.legend(fontsize=7)


def _missed_attractor(axes: Axes, rows: list[Any]) -> None:
    axes.set(xscale="log", yscale="log", ylim=(1e-10, 1), xlabel="balls", ylabel="of P")
    axes.set(title="0.5 % of the starts end on another attractor")
    balls = [row.at for row in rows]
    axes.plot(
        balls, [abs(row.value / row.reference - 1) for row in rows], "o-", color="#d62728", label="error", markersize=3
    )
    axes.plot(balls, [row.stderr / row.value for row in rows], "o-", color="0.4", label="standard error", markersize=3)
    for row in rows:
        text_style: dict[str, Any] = {"fontsize": 6, "rotation": 90, "ha": "center", "va": "bottom", "in_layout": False}
        axes.text(row.at, 0.013, row.smoothness, color=_SMOOTHNESS_COLOURS[row.smoothness], **text_style)
    axes.legend(fontsize=7, loc="lower left")


_PANELS = {
    "growth": _by_length,
    "cells": _against_fits,
    "edge": _edge_of_chaos,
    "crisis": _crisis,
    "missed": _missed_attractor,
}
