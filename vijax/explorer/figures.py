"""Figures of a page, empty at first, and the tables of numbers that they draw."""

import math
from dataclasses import dataclass, fields
from typing import Any

from bokeh.models import (
    BasicTicker,
    BasicTickFormatter,
    CDSView,
    ColumnDataSource,
    FixedTicker,
    GroupFilter,
    HoverTool,
    LinearColorMapper,
    LinearScale,
    LogColorMapper,
    LogScale,
    Plot,
    Range1d,
)
from bokeh.models.annotations import ColorBar, Span
from bokeh.plotting import figure

from vijax.explorer.plane import Axis, ExploredPlane
from vijax.explorer.theme import AXIS, COLOURS, axis_text
from vijax.plots.curve_lines import screen_style

_LEFT_BORDER = 66  # equal left border in pixels of figures that share a time axis, so that their times align
_EMPTY: dict[str, list[Any]] = {"x": [], "y": []}


@dataclass(frozen=True)
class PageFigures:
    """The figures of a page; the name of a field is the figure's name in the template of the page."""

    map: Plot
    phase: Plot
    course: Plot
    energy: Plot
    line: Plot
    basin: Plot
    branch: Plot

    def all(self) -> dict[str, Plot]:
        """Return every figure by its name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


@dataclass(frozen=True)
class PageTables:
    """The tables (Bokeh data sources) that the figures draw; a field has the name of its table."""

    cells: ColumnDataSource
    veil: ColumnDataSource
    border: ColumnDataSource
    dots: ColumnDataSource
    crosses: ColumnDataSource
    curves: ColumnDataSource
    points: ColumnDataSource
    star: ColumnDataSource
    optima: ColumnDataSource
    pick: ColumnDataSource
    course: ColumnDataSource
    membranes: ColumnDataSource
    impacts: ColumnDataSource
    harvested: ColumnDataSource
    inadmissible: ColumnDataSource
    transferred: ColumnDataSource
    rising: ColumnDataSource
    falling: ColumnDataSource
    visited: ColumnDataSource
    basin: ColumnDataSource
    stable: ColumnDataSource
    unstable: ColumnDataSource
    events: ColumnDataSource


def tables() -> PageTables:
    """Return all tables, empty."""
    columns: dict[str, tuple[str, ...]] = {
        "cells": ("image", "x", "y", "dw", "dh"),
        "veil": ("left", "right", "bottom", "top"),
        "border": ("x0", "y0", "x1", "y1"),
        "curves": ("xs", "ys", "kind", "label", "width", "alpha", "edge"),
        "points": ("x", "y", "number"),
        "basin": ("image", "x", "y", "dw", "dh"),
        "course": ("t", "x", "v"),
        "membranes": ("t", "left", "right"),
        "impacts": ("t", "x", "v"),
        "stable": ("xs", "ys"),
        "unstable": ("xs", "ys"),
        "events": ("x", "y", "kind"),
    }
    return PageTables(
        **{
            item.name: ColumnDataSource({name: [] for name in columns.get(item.name, tuple(_EMPTY))}, name=item.name)
            for item in fields(PageTables)
        }
    )


@dataclass(frozen=True)
class Walls:
    """The movable lines of the figures: at the walls (u = -d/2 and d/2), and at the axis values of the picked cell."""

    phase: tuple[Span, Span]
    course: tuple[Span, Span]
    line: Span
    branch: Span
    across: Span
    up: Span


def _empty_figure(name: str, **further: Any) -> Any:
    """Return an empty figure in the style of the page."""
    plot = figure(
        name=name,
        sizing_mode="stretch_both",
        min_width=260,
        toolbar_location=None,
        tools="",
        output_backend="canvas",
        **further,
    )
    plot.outline_line_color = AXIS["line"]
    plot.background_fill_color = plot.border_fill_color = "white"  # if transparent, earlier ticks stay visible
    plot.min_border_right = 14
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
        axis.axis_label_text_color = axis.major_label_text_color = AXIS["text"]
        axis.axis_line_color = axis.major_tick_line_color = AXIS["line"]
        axis.minor_tick_line_color = None
        axis.axis_label_standoff = 4
    plot.grid.grid_line_color = None
    return plot


def _line(plot: Any, dimension: Any, colour: str, width: float = 1.0, **style: Any) -> Span:
    span = Span(location=0, dimension=dimension, line_color=colour, line_width=width, level="underlay", **style)
    plot.add_layout(span)
    return span


def figures(
    plane: ExploredPlane, tables: PageTables, kinds: tuple[str, ...] = ()
) -> tuple[PageFigures, Walls, ColorBar]:
    """Return the figures of a page, their movable lines and the colour bar; `kinds` are the kinds of its curves."""
    map_plot, bar = _map(plane, tables, kinds)
    across = Span(dimension="height", line_color="white", line_dash="dotted", level="overlay")
    up = Span(dimension="width", line_color="white", line_dash="dotted", level="overlay")
    map_plot.add_layout(across)
    map_plot.add_layout(up)
    # The marks of the picked cell are on Bokeh's overlay layer, so that moving them does not redraw the map.
    for colour, width in (("black", 4), ("white", 2)):
        ring = {"fill_color": None, "line_color": colour, "line_width": width, "level": "overlay"}
        map_plot.scatter("x", "y", source=tables.pick, size=13, **ring)
    phase, course, energy = _phase(tables), _course(tables), _energy(tables)
    energy.x_range = course.x_range
    branch, basin = _branch(tables), _basin(tables)
    line = _diagram(tables)
    walls = Walls(
        phase=(_line(phase, "height", COLOURS["wall"]), _line(phase, "height", COLOURS["wall"])),
        course=(_line(course, "width", COLOURS["wall"]), _line(course, "width", COLOURS["wall"])),
        line=_line(line, "height", COLOURS["pick"], line_dash="dotted"),
        branch=_line(branch, "height", COLOURS["pick"], line_dash="dotted"),
        across=across,
        up=up,
    )
    return PageFigures(map_plot, phase, course, energy, line, basin, branch), walls, bar


def scale(plot: Any, axis: Axis, side: str = "below") -> None:
    """Set the scale, ticks and label of one side of a figure so that it shows an axis of the map."""
    plot_axis = getattr(plot, side)[0]
    log = axis.scale == "log"
    setattr(plot, "x_scale" if side == "below" else "y_scale", LogScale() if log else LinearScale())
    ticks = _ticks(float(axis.edges[0]), float(axis.edges[-1])) if log else []
    plot_axis.ticker = FixedTicker(ticks=ticks) if ticks else BasicTicker(desired_num_ticks=5)
    plot_axis.formatter = BasicTickFormatter()
    plot_axis.axis_label = axis_text(axis.name)


_FEW_DECADES = 3.5  # an axis of at most this many decades has ticks at 1, 2 and 5 times each power of ten


def _ticks(low: float, high: float) -> list[float]:
    """Return ticks of a logarithmic axis: 1, 2, 5 times powers of ten or, over `_FEW_DECADES`, powers of ten only."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    multiples = (1, 2, 5) if math.log10(high / low) <= _FEW_DECADES else (1,)
    ticks = [multiple * 10.0**power for power in range(first, last + 1) for multiple in multiples]
    return [tick for tick in ticks if low <= tick <= high]


def range_limits(axis: Axis) -> dict[str, Any]:
    """Return the limits of an axis as arguments of a Bokeh range."""
    return {"start": float(axis.edges[0]), "end": float(axis.edges[-1])}


def _map(plane: ExploredPlane, tables: PageTables, kinds: tuple[str, ...]) -> tuple[Any, ColorBar]:
    plot = _empty_figure(
        "map",
        x_range=Range1d(**range_limits(plane.x)),
        y_range=Range1d(**range_limits(plane.y)),
    )
    scale(plot, plane.x)
    scale(plot, plane.y, "left")
    plot.image_rgba("image", "x", "y", "dw", "dh", source=tables.cells)
    plot.quad(
        "left",
        "right",
        "top",
        "bottom",
        source=tables.veil,
        fill_color="white",
        fill_alpha=0.5,
        line_color=None,
        hatch_pattern="/",
        hatch_color="#4d4d4d",
        hatch_scale=7,
        hatch_weight=0.7,
    )
    for colour, width in (("black", 2.4), ("white", 1.2)):
        plot.segment(
            "x0", "y0", "x1", "y1", source=tables.border, line_color=colour, line_width=width, line_cap="square"
        )
    plot.scatter("x", "y", source=tables.dots, size=2, color="black")
    plot.scatter("x", "y", source=tables.crosses, marker="x", size=5, color="red")
    if kinds:
        _curves(plot, tables, kinds)
    plot.scatter("x", "y", source=tables.star, marker="star", size=15, fill_color="#d62728", line_color="white")
    plot.scatter("x", "y", source=tables.optima, marker="diamond", size=13, fill_color="#ff7f0e", line_color="white")
    bar = ColorBar(
        color_mapper=LinearColorMapper(palette="Viridis256", low=0, high=1),
        width=12,
        padding=6,
        major_label_text_font_size="12px",
        major_label_text_color=AXIS["text"],
        background_fill_color=None,
    )
    plot.add_layout(bar, "right")
    return plot, bar


def _curves(plot: Any, tables: PageTables, kinds: tuple[str, ...]) -> None:
    """Draw bifurcation curves with a tooltip, by one line glyph per kind, because a glyph has one dash pattern."""
    plot.multi_line("xs", "ys", source=tables.curves, line_color="white", line_width=3.6, line_alpha="edge")
    lines = []
    for kind in kinds:
        colour, dashes = screen_style(kind)
        style = {"line_color": colour, "line_width": "width", "line_alpha": "alpha"}
        view = CDSView(filter=GroupFilter(column_name="kind", group=kind))
        dash = " ".join(str(round(_DASH * part)) for part in dashes) or "solid"
        lines.append(plot.multi_line("xs", "ys", source=tables.curves, view=view, line_dash=dash, **style))
    plot.scatter("x", "y", source=tables.points, size=6, fill_color="white", line_color="black")
    # Bokeh draws the outline of letters over their filling, so the letters are drawn again without outline on top.
    words = {"text_font_size": "12px", "x_offset": 5, "y_offset": -3}
    for edge in (
        {"text_color": "white", "text_outline_color": "white", "text_outline_width": 3},
        {"text_color": "black"},
    ):
        plot.text("x", "y", "number", source=tables.points, **words, **edge)
    plot.add_tools(HoverTool(renderers=lines, tooltips=[("", "@kind of @label")], description="Curves"))


_DASH = 1.8  # width of a curve in pixels; dash lengths are multiples of this width


def mapper(span: tuple[float, float], log: bool, palette: tuple[str, ...]) -> Any:
    """Return the Bokeh colour mapper of a colour bar from the lowest to the highest value, `span`."""
    kind = LogColorMapper if log else LinearColorMapper
    return kind(palette=list(palette), low=span[0], high=span[1])


def _phase(tables: PageTables) -> Any:
    plot = _empty_figure(
        "phase", x_range=Range1d(), y_range=Range1d(), x_axis_label="displacement u", y_axis_label="velocity u\u0307"
    )
    plot.line("x", "v", source=tables.course, line_color="black", line_width=1.2)
    plot.scatter("x", "v", source=tables.impacts, size=7, color=COLOURS["impact"])
    return plot


def _course(tables: PageTables) -> Any:
    plot = _empty_figure(
        "course",
        y_axis_label="displacement u",
        x_range=Range1d(start=0, end=2),
        y_range=Range1d(),
        min_border_left=_LEFT_BORDER,
    )
    plot.line("t", "x", source=tables.course, line_color="black", line_width=1.2)
    for side in ("left", "right"):
        plot.line("t", side, source=tables.membranes, line_color=COLOURS["membrane"], line_width=2.5, line_alpha=0.8)
    plot.scatter("t", "x", source=tables.impacts, size=6, color=COLOURS["impact"])
    return plot


def _energy(tables: PageTables) -> Any:
    plot = _empty_figure(
        "energy",
        x_axis_label="t [half forcing periods]",
        y_axis_label="E [\u00b5J]",
        y_axis_type="log",
        y_range=Range1d(start=1, end=100),
        min_border_left=_LEFT_BORDER,
    )
    plot.left[0].ticker = FixedTicker(ticks=_ticks(1e-6, 1e9))
    plot.left[0].formatter = BasicTickFormatter()
    plot.scatter(
        "x", "y", source=tables.transferred, size=9, fill_color=None, line_color=COLOURS["transferred"], line_width=1.8
    )
    plot.scatter("x", "y", source=tables.harvested, size=7, color=COLOURS["harvested"])
    plot.scatter("x", "y", source=tables.inadmissible, marker="x", size=11, color=COLOURS["inadmissible"], line_width=2)
    return plot


def _diagram(tables: PageTables) -> Any:
    plot = _empty_figure("line", y_axis_label="impact velocity", x_range=Range1d(), y_range=Range1d())
    plot.scatter("x", "y", source=tables.falling, size=4, color=COLOURS["falling"])
    plot.scatter("x", "y", source=tables.rising, size=2.6, color=COLOURS["rising"])
    plot.scatter(
        "x",
        "y",
        source=tables.visited,
        marker="circle",
        size=8,
        fill_color=None,
        line_color=COLOURS["pick"],
        line_width=1.8,
    )
    return plot


def _basin(tables: PageTables) -> Any:
    plot = _empty_figure("basin", x_range=Range1d(), y_range=Range1d(), x_axis_label="u\u2080", y_axis_label="v\u2080")
    plot.image_rgba("image", "x", "y", "dw", "dh", source=tables.basin)
    return plot


def _branch(tables: PageTables) -> Any:
    plot = _empty_figure("branch", y_axis_label="impact velocity", x_range=Range1d(), y_range=Range1d())
    plot.multi_line("xs", "ys", source=tables.unstable, line_color=COLOURS["unstable"], line_width=1.1)
    plot.multi_line("xs", "ys", source=tables.stable, line_color="black", line_width=2)
    plot.scatter(
        "x",
        "y",
        source=tables.events,
        size=8,
        marker="circle",
        fill_color="white",
        line_color=COLOURS["rising"],
        line_width=1.6,
    )
    return plot
