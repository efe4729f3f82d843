"""Cell colours, marks and legend of a map as plain numbers, for a page that does not draw with matplotlib."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm, Normalize, to_hex, to_rgba, to_rgba_array

from vijax.maps.map_dataset import best
from vijax.model.records import Status
from vijax.plots.cells import BARE, borders, edges, marked_places
from vijax.plots.kind_maps import Category, of_flags, of_labels, table_colours
from vijax.plots.number_maps import POWER, Marker, has_colour, kind_of
from vijax.plots.style import NEEDS, is_kind

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class LegendEntry:
    """One line of a legend.

    Attributes:
        sign: "cell", "veil", "border", "dot", "cross" or "star".
        colour: Hexadecimal digits after a hash.
        text: Meaning of the sign.
        count: Number of cells.
    """

    sign: str
    colour: str
    text: str
    count: int


@dataclass(frozen=True)
class ColouredMap:
    """The parts of a map that a screen draws.

    Attributes:
        colours: Red, green, blue and opacity of every cell as bytes, [y, x, 4].
        span: Least and largest number of the colour scale; None for a map of kinds (labels or flags).
        log: Whether the colour scale is logarithmic.
        title: Coloured quantity with its unit.
        palette: Colours of the scale as hexadecimal digits.
        veiled: Whether a cell is veiled, because its numbers are not admissible, [y, x].
        segments: Border of the cells of period 1, [segment, (x0, y0, x1, y1)].
        dots, crosses: Positions of aperiodic and of undecided cells, each [x or y, mark].
        star: Position of the largest admissible P.
        legend: Lines of the legend.
    """

    colours: np.ndarray
    span: tuple[float, float] | None
    log: bool
    title: str
    palette: tuple[str, ...]
    veiled: np.ndarray
    segments: np.ndarray
    dots: np.ndarray
    crosses: np.ndarray
    star: tuple[float, float] | None
    legend: tuple[LegendEntry, ...]


def coloured(dataset: "xr.Dataset", name: str, x: str, y: str, log: bool | None = None) -> ColouredMap:
    """Return the coloured cells of a map over two axes, with the colours that the pictures of this folder have.

    Args:
        dataset: Map over x and y alone, ascending.
        name: Name of the variable, or "label".
        x, y: Names of the axes.
        log: Whether the colour scale is logarithmic; by default as in the pictures by matplotlib.
    """
    variable = dataset["status"].transpose(y, x, ...) if name == "label" else dataset[name]
    cells = dataset["status"]
    dataset = dataset.assign({key: value.broadcast_like(cells).transpose(y, x) for key, value in dataset.items()})
    if name == "label" or is_kind(variable):
        return _of_kinds(dataset, name, x, y)
    return _of_numbers(dataset, name, x, y, log)


def _of_kinds(dataset: "xr.Dataset", name: str, x: str, y: str) -> ColouredMap:
    drawn, categories = of_labels(dataset) if name == "label" else of_flags(dataset, name)
    codes = drawn["code"].transpose(y, x).values
    shades = to_rgba_array([category.colour for category in categories])
    counts = np.bincount(codes.ravel(), minlength=len(categories))
    legend = tuple(
        LegendEntry("cell", to_hex(category.colour), _without_share(category), int(count))
        for category, count in zip(categories, counts, strict=True)
    )
    no_veil = np.zeros(codes.shape, bool)
    return ColouredMap(
        colours=_bytes(shades[codes]),
        span=None,
        log=False,
        title="label" if name == "label" else name.replace("_", " "),
        palette=(),
        veiled=no_veil,
        segments=np.empty((0, 4)),
        dots=np.empty((2, 0)),
        crosses=np.empty((2, 0)),
        star=None,
        legend=legend,
    )


def _without_share(category: Category) -> str:
    """Return a category's name without its leading share; a legend entry has the count instead."""
    return category.text.partition(" % ")[2]


def _of_numbers(dataset: "xr.Dataset", name: str, x: str, y: str, log: bool | None) -> ColouredMap:
    if dataset[name].dtype.kind == "i":
        dataset = dataset.assign({name: dataset[name].where(dataset[name] >= 0)})
    power = name == "P" and set(NEEDS) <= set(map(str, dataset.data_vars))
    kind = POWER if power else kind_of(dataset, name)
    norm = _scaled(kind.colours(dataset), log, dataset[name].values)
    # Infinities become the largest number, which takes the top colour instead of the colour of missing values.
    values = np.minimum(dataset[name].values.astype(float), np.finfo(float).max)
    visible = has_colour(values, norm) & ~np.isnan(values)
    colours = np.asarray(mpl.colormaps["viridis"](norm(np.where(visible, values, norm.vmin))))
    colours[~visible] = to_rgba(BARE["color"])
    was_run = dataset["status"].values != Status.NOT_RUN
    markers = [marker._replace(mask=marker.mask & was_run) for marker in kind.markers(dataset)]
    layout = _marked(markers, dataset, x, y)
    peak = best(dataset) if {"P", "admissible"} <= set(map(str, dataset.data_vars)) else None
    star = None if peak is None else (float(peak[x]), float(peak[y]))
    legend = [_entry(marker) for marker in markers if marker.mask.any()]
    if peak is not None:
        legend.append(LegendEntry("star", "#d62728", f"largest admissible P, {float(peak):.4g} J", 1))
    return replace(
        layout,
        colours=_bytes(colours),
        span=(float(norm.vmin or 0.0), float(norm.vmax or 1.0)),
        log=isinstance(norm, LogNorm),
        title="P [J per half period]" if power else kind.label.replace("$", ""),
        palette=tuple(to_hex(shade) for shade in mpl.colormaps["viridis"](np.linspace(0, 1, 256))),
        star=star,
        legend=tuple(legend),
    )


def _scaled(norm: Normalize, log: bool | None, values: np.ndarray) -> Normalize:
    """Replace a colour scale by a logarithmic or a linear one, if one is requested and possible."""
    if log is None or log == isinstance(norm, LogNorm):
        return norm
    if not log:
        return Normalize(0.0, norm.vmax)
    positive = values[np.isfinite(values) & (values > 0)]
    return LogNorm(positive.min(), max(positive.max(), 1.001 * positive.min())) if positive.size else norm


def _marked(markers: list[Marker], dataset: "xr.Dataset", x: str, y: str) -> ColouredMap:
    """Return a `ColouredMap` that holds the marks of a map of numbers; its colours are still empty."""
    across, up = (dataset[name].values for name in (x, y))
    shape = (up.size, across.size)
    veiled, segments = np.zeros(shape, bool), np.empty((0, 4))
    positions = {how: np.empty((2, 0)) for how in ("most", "any")}
    for marker in markers:
        if marker.how == "veil":
            veiled = marker.mask
        elif marker.how == "border":
            lines = borders(edges(across)[0], edges(up)[0], marker.mask)
            segments = np.array([(*begin, *end) for begin, end in lines]).reshape(-1, 4)
        elif marker.how in positions:
            positions[marker.how] = np.array(marked_places(marker.mask, across, up, most=marker.how == "most"))
    return ColouredMap(
        colours=np.empty((*shape, 4), np.uint8),
        span=None,
        log=False,
        title="",
        palette=(),
        veiled=veiled,
        segments=segments,
        dots=positions["most"],
        crosses=positions["any"],
        star=None,
        legend=(),
    )


_SIGNS = {"veil": "veil", "border": "border", "most": "dot", "any": "cross", "bare": "cell"}


def _entry(marker: Marker) -> LegendEntry:
    colour = {"veil": "#4d4d4d", "border": "#ffffff", "most": "#000000", "any": "#ff0000"}.get(
        marker.how, to_hex(BARE["color"])
    )
    return LegendEntry(_SIGNS[marker.how], colour, marker.text, int(marker.mask.sum()))


def _bytes(colours: np.ndarray) -> np.ndarray:
    return np.round(255 * np.asarray(colours)).astype(np.uint8)


def attractor_colours(labels: Sequence[str]) -> list[str]:
    """Return the colours of attractors by their row in a table, as `basins` draws them."""
    return [to_hex(colour) for colour in table_colours(labels)]
