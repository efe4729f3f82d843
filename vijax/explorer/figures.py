"""The figures of a page, empty at first, and the tables of numbers that they draw."""

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
from vijax.explorer.theme import AXIS, COLOURS, written
from vijax.plots.curve_lines import screen_style

_LEFT = 66  # pixels left of figures that share their axis of time
_EMPTY: dict[str, list[Any]] = {"x": [], "y": []}


@dataclass(frozen=True)
class PageFigures:
    """The figures by the names that the page places them by."""

    map: Plot
    phase: Plot
    course: Plot
    energy: Plot
    line: Plot
    basin: Plot
    branch: Plot

    def all(self) -> dict[str, Plot]:
        """Give every figure by its name."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


@dataclass(frozen=True)
class PageTables:
    """What figures draw: tables of columns, by what they hold."""

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
    refused: ColumnDataSource
    given: ColumnDataSource
    rising: ColumnDataSource
    falling: ColumnDataSource
    visited: ColumnDataSource
    basin: ColumnDataSource
    stable: ColumnDataSource
    unstable: ColumnDataSource
    met: ColumnDataSource


def tables() -> PageTables:
    """Make all tables, empty."""
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
        "met": ("x", "y", "kind"),
    }
    return PageTables(
        **{
            one.name: ColumnDataSource({name: [] for name in columns.get(one.name, tuple(_EMPTY))}, name=one.name)
            for one in fields(PageTables)
        }
    )


@dataclass(frozen=True)
class Walls:
    """Lines that stand at the walls and at the pick, moved as the cell changes."""

    phase: tuple[Span, Span]
    course: tuple[Span, Span]
    line: Span
    branch: Span
    across: Span
    up: Span


def _bare(name: str, **further: Any) -> Any:
    """Make an empty figure in the style of the page."""
    made = figure(
        name=name,
        sizing_mode="stretch_both",
        min_width=260,
        toolbar_location=None,
        tools="",
        output_backend="canvas",
        **further,
    )
    made.outline_line_color = AXIS["line"]
    made.background_fill_color = made.border_fill_color = "white"  # a clear one keeps the ticks of earlier ranges
    made.min_border_right = 14
    for axis in (*made.xaxis, *made.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
        axis.axis_label_text_color = axis.major_label_text_color = AXIS["text"]
        axis.axis_line_color = axis.major_tick_line_color = AXIS["line"]
        axis.minor_tick_line_color = None
        axis.axis_label_standoff = 4
    made.grid.grid_line_color = None
    return made


def _line(where: Any, dimension: Any, colour: str, width: float = 1.0, **style: Any) -> Span:
    span = Span(location=0, dimension=dimension, line_color=colour, line_width=width, level="underlay", **style)
    where.add_layout(span)
    return span


def figures(plane: ExploredPlane, of: PageTables, kinds: tuple[str, ...] = ()) -> tuple[PageFigures, Walls, ColorBar]:
    """Make the figures of a page, with the lines in them that move; `kinds` are those of the curves over its map."""
    shown_map, bar = _map(plane, of, kinds)
    across = Span(dimension="height", line_color="white", line_dash="dotted", level="overlay")
    up = Span(dimension="width", line_color="white", line_dash="dotted", level="overlay")
    shown_map.add_layout(across)
    shown_map.add_layout(up)
    # What moves with the pick is on the layer above: the map below is not painted again.
    for colour, width in (("black", 4), ("white", 2)):
        ring = {"fill_color": None, "line_color": colour, "line_width": width, "level": "overlay"}
        shown_map.scatter("x", "y", source=of.pick, size=13, **ring)
    phase, course, energy = _phase(of), _course(of), _energy(of)
    energy.x_range = course.x_range
    branch, basin = _branch(of), _basin(of)
    line = _diagram(of)
    walls = Walls(
        phase=(_line(phase, "height", COLOURS["wall"]), _line(phase, "height", COLOURS["wall"])),
        course=(_line(course, "width", COLOURS["wall"]), _line(course, "width", COLOURS["wall"])),
        line=_line(line, "height", COLOURS["pick"], line_dash="dotted"),
        branch=_line(branch, "height", COLOURS["pick"], line_dash="dotted"),
        across=across,
        up=up,
    )
    return PageFigures(shown_map, phase, course, energy, line, basin, branch), walls, bar


def scale(where: Any, axis: Axis, side: str = "below") -> None:
    """Put an axis of a figure on that of the map: its scale, ticks and words."""
    own = getattr(where, side)[0]
    log = axis.scale == "log"
    setattr(where, "x_scale" if side == "below" else "y_scale", LogScale() if log else LinearScale())
    ticks = _ticks(float(axis.edges[0]), float(axis.edges[-1])) if log else []
    own.ticker = FixedTicker(ticks=ticks) if ticks else BasicTicker(desired_num_ticks=5)
    own.formatter = BasicTickFormatter()
    own.axis_label = written(axis.name)


_FEW = 3.5  # decades up to which 1, 2 and 5 of each are written


def _ticks(low: float, high: float) -> list[float]:
    """Give 1, 2 and 5 of every decade of a logarithmic axis, or its powers of ten where these are many."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    parts = (1, 2, 5) if math.log10(high / low) <= _FEW else (1,)
    found = [part * 10.0**power for power in range(first, last + 1) for part in parts]
    return [one for one in found if low <= one <= high]


def ranged(axis: Axis) -> dict[str, Any]:
    """Give the range of an axis."""
    return {"start": float(axis.edges[0]), "end": float(axis.edges[-1])}


def _map(plane: ExploredPlane, of: PageTables, kinds: tuple[str, ...]) -> tuple[Any, ColorBar]:
    made = _bare(
        "map",
        x_range=Range1d(**ranged(plane.x)),
        y_range=Range1d(**ranged(plane.y)),
    )
    scale(made, plane.x)
    scale(made, plane.y, "left")
    made.image_rgba("image", "x", "y", "dw", "dh", source=of.cells)
    made.quad(
        "left",
        "right",
        "top",
        "bottom",
        source=of.veil,
        fill_color="white",
        fill_alpha=0.5,
        line_color=None,
        hatch_pattern="/",
        hatch_color="#4d4d4d",
        hatch_scale=7,
        hatch_weight=0.7,
    )
    for colour, width in (("black", 2.4), ("white", 1.2)):
        made.segment("x0", "y0", "x1", "y1", source=of.border, line_color=colour, line_width=width, line_cap="square")
    made.scatter("x", "y", source=of.dots, size=2, color="black")
    made.scatter("x", "y", source=of.crosses, marker="x", size=5, color="red")
    if kinds:
        _curves(made, of, kinds)
    made.scatter("x", "y", source=of.star, marker="star", size=15, fill_color="#d62728", line_color="white")
    made.scatter("x", "y", source=of.optima, marker="diamond", size=13, fill_color="#ff7f0e", line_color="white")
    bar = ColorBar(
        color_mapper=LinearColorMapper(palette="Viridis256", low=0, high=1),
        width=12,
        padding=6,
        major_label_text_font_size="12px",
        major_label_text_color=AXIS["text"],
        background_fill_color=None,
    )
    made.add_layout(bar, "right")
    return made, bar


def _curves(made: Any, of: PageTables, kinds: tuple[str, ...]) -> None:
    """Draw curves of bifurcations, a kind at a time, as dashes are of a kind; who points at one is told what it is."""
    made.multi_line("xs", "ys", source=of.curves, line_color="white", line_width=3.6, line_alpha="edge")
    lines = []
    for kind in kinds:
        colour, dashes = screen_style(kind)
        style = {"line_color": colour, "line_width": "width", "line_alpha": "alpha"}
        view = CDSView(filter=GroupFilter(column_name="kind", group=kind))
        dash = " ".join(str(round(_DASH * part)) for part in dashes) or "solid"
        lines.append(made.multi_line("xs", "ys", source=of.curves, view=view, line_dash=dash, **style))
    made.scatter("x", "y", source=of.points, size=6, fill_color="white", line_color="black")
    # The edge of letters is drawn over them, so that they are drawn once more.
    words = {"text_font_size": "12px", "x_offset": 5, "y_offset": -3}
    for edge in (
        {"text_color": "white", "text_outline_color": "white", "text_outline_width": 3},
        {"text_color": "black"},
    ):
        made.text("x", "y", "number", source=of.points, **words, **edge)
    made.add_tools(HoverTool(renderers=lines, tooltips=[("", "@kind of @label")], description="Curves"))


_DASH = 1.8  # pixels that a curve is wide


def mapper(span: tuple[float, float], log: bool, palette: tuple[str, ...]) -> Any:
    """Make what a bar of colours reads."""
    kind = LogColorMapper if log else LinearColorMapper
    return kind(palette=list(palette), low=span[0], high=span[1])


def _phase(of: PageTables) -> Any:
    made = _bare(
        "phase", x_range=Range1d(), y_range=Range1d(), x_axis_label="displacement u", y_axis_label="velocity u\u0307"
    )
    made.line("x", "v", source=of.course, line_color="black", line_width=1.2)
    made.scatter("x", "v", source=of.impacts, size=7, color=COLOURS["impact"])
    return made


def _course(of: PageTables) -> Any:
    made = _bare(
        "course",
        y_axis_label="displacement u",
        x_range=Range1d(start=0, end=2),
        y_range=Range1d(),
        min_border_left=_LEFT,
    )
    made.line("t", "x", source=of.course, line_color="black", line_width=1.2)
    for side in ("left", "right"):
        made.line("t", side, source=of.membranes, line_color=COLOURS["membrane"], line_width=2.5, line_alpha=0.8)
    made.scatter("t", "x", source=of.impacts, size=6, color=COLOURS["impact"])
    return made


def _energy(of: PageTables) -> Any:
    made = _bare(
        "energy",
        x_axis_label="t [half forcing periods]",
        y_axis_label="E [\u00b5J]",
        y_axis_type="log",
        y_range=Range1d(start=1, end=100),
        min_border_left=_LEFT,
    )
    made.left[0].ticker = FixedTicker(ticks=_ticks(1e-6, 1e9))
    made.left[0].formatter = BasicTickFormatter()
    made.scatter("x", "y", source=of.given, size=9, fill_color=None, line_color=COLOURS["given"], line_width=1.8)
    made.scatter("x", "y", source=of.harvested, size=7, color=COLOURS["harvested"])
    made.scatter("x", "y", source=of.refused, marker="x", size=11, color=COLOURS["refused"], line_width=2)
    return made


def _diagram(of: PageTables) -> Any:
    made = _bare("line", y_axis_label="impact velocity", x_range=Range1d(), y_range=Range1d())
    made.scatter("x", "y", source=of.falling, size=4, color=COLOURS["falling"])
    made.scatter("x", "y", source=of.rising, size=2.6, color=COLOURS["rising"])
    made.scatter(
        "x",
        "y",
        source=of.visited,
        marker="circle",
        size=8,
        fill_color=None,
        line_color=COLOURS["pick"],
        line_width=1.8,
    )
    return made


def _basin(of: PageTables) -> Any:
    made = _bare("basin", x_range=Range1d(), y_range=Range1d(), x_axis_label="u\u2080", y_axis_label="v\u2080")
    made.image_rgba("image", "x", "y", "dw", "dh", source=of.basin)
    return made


def _branch(of: PageTables) -> Any:
    made = _bare("branch", y_axis_label="impact velocity", x_range=Range1d(), y_range=Range1d())
    made.multi_line("xs", "ys", source=of.unstable, line_color=COLOURS["unstable"], line_width=1.1)
    made.multi_line("xs", "ys", source=of.stable, line_color="black", line_width=2)
    made.scatter(
        "x",
        "y",
        source=of.met,
        size=8,
        marker="circle",
        fill_color="white",
        line_color=COLOURS["rising"],
        line_width=1.6,
    )
    return made
