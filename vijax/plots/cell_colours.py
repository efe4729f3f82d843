"""A map as colours of its cells, marks and a legend, in numbers: what a screen draws that is not matplotlib's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm, Normalize, to_hex, to_rgba, to_rgba_array

from vijax.model.records import Status
from vijax.planes.dataset import best
from vijax.plots.cells import BARE, borders, edges, marked_places
from vijax.plots.kind_maps import Category, of_flags, of_labels, table_colours
from vijax.plots.number_maps import POWER, Mark, has_colour, kind_of
from vijax.plots.style import NEEDS, is_kind

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class LegendEntry:
    """One line of a legend.

    Attributes:
        sign: "cell", "veil", "border", "dot", "cross" or "star".
        colour: As hexadecimal digits after a hash.
        text: What it means.
        count: Of cells.
    """

    sign: str
    colour: str
    text: str
    count: int


@dataclass(frozen=True)
class ColouredMap:
    """What a screen draws of a map.

    Attributes:
        colours: Red, green, blue and opacity of every cell, of bytes [y, x, 4].
        span: What the colours of numbers span; None of kinds.
        log: Whether these are logarithmic.
        title: What is coloured, with its unit.
        palette: Of numbers, as hexadecimal digits.
        veiled: Whether a cell is veiled, as its numbers are not to be believed, [y, x].
        segments: Of the border of period 1, [segment, (x0, y0, x1, y1)].
        dots, crosses: Places of aperiodic and of undecided cells, each [x or y, mark].
        star: Where the largest admissible P is.
        legend: Of all these.
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
    """Colour the cells of a map over two axes as the functions of this folder do.

    Args:
        dataset: Over x and y alone, ascending.
        name: Of the variable, or "label".
        x, y: Names of the axes.
        log: Whether colours of numbers are logarithmic; as the pictures have it unless given.
    """
    like = dataset["status"].transpose(y, x, ...) if name == "label" else dataset[name]
    cells = dataset["status"]
    dataset = dataset.assign({key: value.broadcast_like(cells).transpose(y, x) for key, value in dataset.items()})
    if name == "label" or is_kind(like):
        return _of_kinds(dataset, name, x, y)
    return _of_numbers(dataset, name, x, y, log)


def _of_kinds(dataset: "xr.Dataset", name: str, x: str, y: str) -> ColouredMap:
    drawn, categories = of_labels(dataset) if name == "label" else of_flags(dataset, name)
    codes = drawn["code"].transpose(y, x).values
    shades = to_rgba_array([one.colour for one in categories])
    counts = np.bincount(codes.ravel(), minlength=len(categories))
    legend = tuple(
        LegendEntry("cell", to_hex(one.colour), _without_share(one), int(count))
        for one, count in zip(categories, counts, strict=True)
    )
    nothing = np.zeros(codes.shape, bool)
    return ColouredMap(
        colours=_bytes(shades[codes]),
        span=None,
        log=False,
        title="label" if name == "label" else name.replace("_", " "),
        palette=(),
        veiled=nothing,
        segments=np.empty((0, 4)),
        dots=np.empty((2, 0)),
        crosses=np.empty((2, 0)),
        star=None,
        legend=legend,
    )


def _without_share(category: Category) -> str:
    """Leave out the share that stands before the name: here is a count."""
    return category.text.partition(" % ")[2]


def _of_numbers(dataset: "xr.Dataset", name: str, x: str, y: str, log: bool | None) -> ColouredMap:
    if dataset[name].dtype.kind == "i":
        dataset = dataset.assign({name: dataset[name].where(dataset[name] >= 0)})
    power = name == "P" and set(NEEDS) <= set(map(str, dataset.data_vars))
    kind = POWER if power else kind_of(dataset, name)
    norm = _scaled(kind.colours(dataset), log, dataset[name].values)
    values = np.minimum(dataset[name].values.astype(float), np.finfo(float).max)
    shown = has_colour(values, norm) & ~np.isnan(values)
    colours = np.asarray(mpl.colormaps["viridis"](norm(np.where(shown, values, norm.vmin))))
    colours[~shown] = to_rgba(BARE["color"])
    run = dataset["status"].values != Status.NOT_RUN
    marks = [mark._replace(mask=mark.mask & run) for mark in kind.marks(dataset)]
    found = _marked(marks, dataset, x, y)
    peak = best(dataset) if {"P", "admissible"} <= set(map(str, dataset.data_vars)) else None
    star = None if peak is None else (float(peak[x]), float(peak[y]))
    legend = [_entry(mark) for mark in marks if mark.mask.any()]
    if peak is not None:
        legend.append(LegendEntry("star", "#d62728", f"largest admissible P, {float(peak):.4g} J", 1))
    return replace(
        found,
        colours=_bytes(colours),
        span=(float(norm.vmin or 0.0), float(norm.vmax or 1.0)),
        log=isinstance(norm, LogNorm),
        title="P [J per half period]" if power else kind.label.replace("$", ""),
        palette=tuple(to_hex(shade) for shade in mpl.colormaps["viridis"](np.linspace(0, 1, 256))),
        star=star,
        legend=tuple(legend),
    )


def _scaled(norm: Normalize, log: bool | None, values: np.ndarray) -> Normalize:
    """Put a scale of colours in place of the picture's own, if another is wanted and can be."""
    if log is None or log == isinstance(norm, LogNorm):
        return norm
    if not log:
        return Normalize(0.0, norm.vmax)
    positive = values[np.isfinite(values) & (values > 0)]
    return LogNorm(positive.min(), max(positive.max(), 1.001 * positive.min())) if positive.size else norm


def _marked(marks: list[Mark], dataset: "xr.Dataset", x: str, y: str) -> ColouredMap:
    """Lay out the marks of a map of numbers; its colours are yet to come."""
    across, up = (dataset[name].values for name in (x, y))
    shape = (up.size, across.size)
    veiled, segments = np.zeros(shape, bool), np.empty((0, 4))
    places = {how: np.empty((2, 0)) for how in ("most", "any")}
    for mark in marks:
        if mark.how == "veil":
            veiled = mark.mask
        elif mark.how == "border":
            lines = borders(edges(across)[0], edges(up)[0], mark.mask)
            segments = np.array([(*one, *other) for one, other in lines]).reshape(-1, 4)
        elif mark.how in places:
            places[mark.how] = np.array(marked_places(mark.mask, across, up, most=mark.how == "most"))
    return ColouredMap(
        colours=np.empty((*shape, 4), np.uint8),
        span=None,
        log=False,
        title="",
        palette=(),
        veiled=veiled,
        segments=segments,
        dots=places["most"],
        crosses=places["any"],
        star=None,
        legend=(),
    )


_SIGNS = {"veil": "veil", "border": "border", "most": "dot", "any": "cross", "bare": "cell"}


def _entry(mark: Mark) -> LegendEntry:
    colour = {"veil": "#4d4d4d", "border": "#ffffff", "most": "#000000", "any": "#ff0000"}.get(
        mark.how, to_hex(BARE["color"])
    )
    return LegendEntry(_SIGNS[mark.how], colour, mark.text, int(mark.mask.sum()))


def _bytes(colours: np.ndarray) -> np.ndarray:
    return np.round(255 * np.asarray(colours)).astype(np.uint8)


def attractor_colours(labels: Sequence[str]) -> list[str]:
    """Give the colours of attractors by their place in a table, as `basins` draws them."""
    return [to_hex(colour) for colour in table_colours(labels)]
