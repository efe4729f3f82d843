"""Pictures of maps, for print."""

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import EngFormatter

from vijax.model.label import label
from vijax.planes.compare import Label, Model
from vijax.planes.dataset import best
from vijax.plots.figure import styled
from vijax.plots.style import (
    LABEL_NEEDS,
    NEEDS,
    axis_label,
    equations,
    is_kind,
    layout,
    layout_of_kinds,
    title,
    units,
)
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# A wider scale would say more about its faintest cells than about those worth building.
_DECADES = 4
_ALL_DECADES = 8  # where inadmissible cells are shown too
_ENOUGH = 0.1  # of the cells shown: fewer admissible ones do not choose the colours
_WIDE = 30  # ratio of the largest to the smallest number from which on their scale is logarithmic
# Values count as evenly spaced if their steps differ by less than this part of their range.
_EVEN = 1e-6
# At most so many marks to a side, whatever the resolution of the map.
_MARKS = 128

_LINE: dict[str, Any] = {
    "color": "white",
    "linewidth": 0.8,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}
_DOT: dict[str, Any] = {"marker": ".", "markersize": 1.3, "color": "black", "mew": 0, "linestyle": "none"}
_CROSS: dict[str, Any] = {"marker": "x", "markersize": 3.0, "color": "red", "mew": 0.7, "linestyle": "none"}
_OUTLINE: dict[str, Any] = _LINE | {"color": "red", "linewidth": 1.2}
_SINGLE = {"markersize": 4.0}  # of a mark that is not one of thousands
_STAR: dict[str, Any] = {"marker": "*", "markersize": 11, "color": "red", "mec": "white", "linestyle": "none"}
_BARE: dict[str, Any] = {"color": "0.75"}
# Of kinds: so many by name, in these colours; strong ones first, their pale sisters after them, without the greys.
_MOST_NAMED = 12
_COLOURS = [mpl.colormaps["tab20"](n) for n in (*range(0, 20, 2), *range(1, 20, 2)) if n not in (14, 15)]
_OTHERS = "#fff3c4"
_NO_ORBIT = {
    "no impact": "0.93",
    "permanent contact": "white",
    "aperiodic": "0.35",
    "undecided": "magenta",
    "failed": "red",
}
_GREYS = LinearSegmentedColormap.from_list("greys", ["0.8", "black"])
_VEIL: dict[str, Any] = {"facecolor": (1, 1, 1, 0.55), "edgecolor": "0.3", "hatch": "/////", "linewidth": 0}


class _Mark(NamedTuple):
    """Cells that carry a mark, and what it means: a veil, the border around them, a point on most or any, or none."""

    mask: np.ndarray
    how: Literal["veil", "border", "most", "any", "bare"]
    style: dict[str, Any]
    text: str


class _Kind(NamedTuple):
    """A kind of picture: what it colours and how, which function makes such maps, the variables that it needs.

    And those that it can do without, its marks.
    """

    coloured: str
    label: str
    made: str
    needs: tuple[str, ...]
    optional: tuple[str, ...]
    colours: "Callable[[xr.Dataset], Normalize]"
    marks: "Callable[[xr.Dataset], list[_Mark]]"


@styled
def power_map(dataset: "xr.Dataset") -> Figure:
    """P on a log colour scale, with all that tells where to believe it.

    Inadmissible cells are veiled and hatched, the border of the period-1 region is a line, aperiodic cells carry dots
    and undecided ones crosses, and a star stands on the largest admissible P. The colours span the admissible cells if
    these are a tenth of those shown, and otherwise all.

    Args:
        dataset: A map with `P`, `period` and `admissible`. Its dimensions are, in order, x, y, columns and rows of
            panels; of one dimension a curve is drawn.

    Raises:
        ValueError: If the map lacks a variable, or has more dimensions or panels than a picture can hold.
    """
    return _picture(dataset, _POWER)


@styled
def variable_map(dataset: "xr.Dataset", name: str) -> Figure:
    """Any variable of a map, with the marks of `power_map` for as much as the map holds.

    Numbers are coloured, on a log scale where they are positive and span a factor of 30; what is a kind, such as
    `status` or `admissible`, has a colour each. Cells without a value are grey.

    Args:
        dataset: What `sweep` returned; dimensions as in `power_map`, for kinds two at least.
        name: Of the variable.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, (), "sweep")
    checks.choice("name", name, [str(one) for one in dataset])
    variable = dataset[name]
    if is_kind(variable):
        return _coded(*_kinds(dataset, name))
    if variable.dtype.kind == "i":
        dataset = dataset.assign({name: variable.where(variable >= 0)})  # -1 is none
    written = name.replace("_", " ") + (f" [{units(variable)}]" if units(variable) else "")
    kind = _Kind(
        name, written, "sweep", (name,), (*NEEDS,), partial(_number_colours, name), partial(_number_marks, name)
    )
    return _picture(dataset, kind)


@styled
def label_map(dataset: "xr.Dataset") -> Figure:
    """The plane coloured by attractor, n:m/pT; aperiodic cells are shaded by their Lyapunov exponent.

    The commonest labels have a colour and a name each, the others are one group. Without gravity mirror images count as
    one, by the smaller count first. Aperiodic means: without a period within the periods that were run.

    Args:
        dataset: A map with `period`, `impacts_left`, `impacts_right` and `status`, and with `lyapunov` for shades;
            dimensions as in `power_map`, two at least.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, LABEL_NEEDS, "sweep")
    period = dataset["period"]
    level = (dataset["gamma"] == 0).broadcast_like(period).transpose(*period.dims)
    words = label(*(dataset[name].values for name in LABEL_NEEDS), merge_mirrors=level.values)
    codes, categories = _named(words, int(dataset.attrs["periods"]))
    drawn = dataset[["lyapunov"] if "lyapunov" in dataset else []].assign(
        code=(period.dims, codes), aperiodic=period == 0
    )
    return _coded(drawn.assign_attrs(dataset.attrs), categories)


@styled
def basin_map(dataset: "xr.Dataset") -> Figure:
    """The (u0, v0) plane coloured by the attractor on which each start ends, with a table of them beside it.

    Args:
        dataset: What `basins` returned for arrays u0 and v0; further axes make panels, each with a table of its own.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("basin", "label", "fraction", "P"), "basins")
    further = [dim for dim in dataset["P"].dims if dim not in (*dataset["basin"].dims, "attractor")]
    dataset = dataset.isel(dict.fromkeys(further, 0))
    drawn = dataset.assign(code=dataset["basin"].clip(max=_MOST_NAMED)).drop_vars("basin")
    return _coded(drawn, None)


@styled
def multistability_map(dataset: "xr.Dataset") -> Figure:
    """The plane of parameters coloured by the number of coexisting attractors.

    Args:
        dataset: What `basin_fractions` returned; dimensions as in `power_map`, two at least.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("attractors",), "basin_fractions")
    number = dataset["attractors"]
    most = int(number.max())
    shades = mpl.colormaps["viridis_r"](np.linspace(0, 1, most + 1))
    shades[0] = to_rgba(_NO_ORBIT["undecided"])
    texts = ["undecided", "1 attractor", *(f"{n} attractors" for n in range(2, most + 1))]
    categories = [
        _Category(tuple(shade), f"{_share((number == n).mean())} {text}")
        for n, (shade, text) in enumerate(zip(shades, texts[: most + 1], strict=True))
    ]
    drawn = dataset[[]].assign(code=number).assign_attrs(dataset.attrs)
    return _coded(drawn, categories)


@styled
def difference_map(dataset: "xr.Dataset") -> Figure:
    """The relative difference in P between rigid and soft walls on a log colour scale.

    A line parts cells whose labels differ from the others; another one, where the comparison was given a tolerance,
    goes around the cells where the rigid model is enough, and crosses stand on those without a verdict.

    Args:
        dataset: What `compare` returned; dimensions as in `power_map`.

    Raises:
        ValueError: As `power_map`.
    """
    return _picture(dataset, _DIFFERENCE)


def basins(dataset: "xr.Dataset") -> Figure:
    """Draw coexisting attractors: `basin_map` of what `basins` returned, `multistability_map` of `basin_fractions`.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("attractors",), "basins")
    return (multistability_map if "start" in dataset.sizes else basin_map)(dataset)


def _picture(dataset: "xr.Dataset", kind: _Kind) -> Figure:
    checks.variables("dataset", dataset, kind.needs, kind.made, "variable_map (--show NAME) draws any that there is")
    whole = dataset[kind.coloured]
    layout({str(dim): size for dim, size in whole.sizes.items()})
    names = list(dict.fromkeys([*kind.needs, *(name for name in kind.optional if name in dataset)]))
    # A variable lacks the dimensions that it does not depend on; the picture wants them all.
    full = {name: dataset[name].broadcast_like(whole).transpose(*whole.dims) for name in names}
    dataset = dataset.assign(full)[names].squeeze()
    dims = [str(dim) for dim in dataset[kind.coloured].dims]
    figure = _curve(dataset, kind) if len(dims) == 1 else _maps(dataset, kind, dims)
    return figure


def _maps(dataset: "xr.Dataset", kind: _Kind, dims: list[str]) -> Figure:
    figure, panels = _panels(dataset, dims)
    norm, peak = kind.colours(dataset), _peak(dataset)
    for axes, panel in panels:
        mesh = _panel(axes, panel, kind, dims[0], dims[1], norm)
        if peak is not None and all(peak[dim] == panel[dim] for dim in dims[2:]):
            axes.plot(peak[dims[0]], peak[dims[1]], **_STAR, clip_on=False, zorder=5)
    figure.colorbar(mesh, ax=figure.axes, extend="both", label=kind.label)
    _explain(figure, dataset, kind, peak)
    return figure


def _panels(dataset: "xr.Dataset", dims: list[str]) -> "tuple[Figure, list[tuple[Axes, xr.Dataset]]]":
    """A figure of empty panels with titles and labels, and what belongs into each, ascending and [y, x]."""
    rows, columns = layout({dim: dataset.sizes[dim] for dim in dims})
    size = (5.2, 4.6) if rows * columns == 1 else (1.6 + 2.1 * columns, 1.6 + 1.9 * rows)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    # Panels by rows, cells by y: the dimensions backwards.
    dataset = dataset.sortby(dims[:2]).transpose(*dims[::-1], ...)
    outer = dims[:1:-1]
    panels = []
    for axes, index in itertools.zip_longest(grid.flat, np.ndindex(*(dataset.sizes[dim] for dim in outer))):
        if index is None:
            axes.set_visible(False)
            continue
        panel = dataset.isel(dict(zip(outer, index, strict=True)))
        (across, xscale), (up, yscale) = (_edges(panel[dim].values) for dim in dims[:2])
        axes.set(xscale=xscale, yscale=yscale, xlim=across[[0, -1]], ylim=up[[0, -1]], facecolor=_BARE["color"])
        axes.set_title(equations(panel, dims[2:]), fontsize="medium")
        panels.append((axes, panel))
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(dataset[dims[0]]))
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(dataset[dims[1]]))
    return figure, panels


def _panel(axes: Axes, panel: "xr.Dataset", kind: _Kind, x: str, y: str, norm: Normalize) -> QuadMesh:
    across, up = (_edges(panel[dim].values)[0] for dim in (x, y))
    # matplotlib takes infinities for missing.
    values = np.minimum(panel[kind.coloured].values, np.finfo(float).max)
    mesh = axes.pcolormesh(across, up, np.ma.masked_where(~_drawn(values, norm), values), norm=norm, rasterized=True)
    _mark_map(axes, kind.marks(panel), (panel[x].values, panel[y].values), (across, up))
    return mesh


def _curve(dataset: "xr.Dataset", kind: _Kind) -> Figure:
    """The coloured variable over a single axis, with the marks of a map."""
    (x,) = (str(dim) for dim in dataset[kind.coloured].dims)
    dataset = dataset.sortby(x)
    places, values = dataset[x].values, dataset[kind.coloured].values
    figure = Figure(figsize=(5.2, 3.8), layout="constrained")
    axes, peak = figure.subplots(), _peak(dataset)
    across, xscale = _edges(places)
    norm = kind.colours(dataset)
    yscale = "log" if isinstance(norm, LogNorm) else "linear"
    axes.set(xscale=xscale, yscale=yscale, xlim=across[[0, -1]], xlabel=axis_label(dataset[x]), ylabel=kind.label)
    drawn = _drawn(values, norm) & np.isfinite(values)
    axes.plot(places, np.where(drawn, values, np.nan), color="tab:blue", linewidth=0.9, zorder=1)
    axes.margins(y=0.05)
    _mark_curve(axes, kind.marks(dataset), places, across, values)
    if peak is not None:
        axes.plot(peak[x], dataset[kind.coloured].sel({x: peak[x]}), **_STAR, zorder=5)
    _explain(figure, dataset, kind, peak)
    return figure


def _peak(dataset: "xr.Dataset") -> "xr.DataArray | None":
    return best(dataset) if {"P", "admissible"} <= set(dataset) else None


def _mark_map(
    axes: Axes, marks: list[_Mark], places: tuple[np.ndarray, np.ndarray], edges: tuple[np.ndarray, np.ndarray]
) -> None:
    for mask, how, style, _ in marks:
        if how == "veil":
            _hatch(axes, *edges, mask)
        elif how == "border":
            axes.add_collection(LineCollection(_borders(*edges, mask), **style))
        elif how != "bare":
            axes.plot(*_marks(mask, *places, most=how == "most"), **style)


def _mark_curve(axes: Axes, marks: list[_Mark], places: np.ndarray, across: np.ndarray, values: np.ndarray) -> None:
    for mask, how, style, _ in marks:
        if how == "veil":
            for start, end in _runs(mask):
                axes.axvspan(across[start], across[end], **style, zorder=0)
        elif how == "border":
            for edge in set(_runs(mask).flat) - {0, places.size}:
                axes.axvline(across[edge], **style, zorder=0.5)
        elif how != "bare":
            axes.plot(places[mask], values[mask], **style | _SINGLE, zorder=2)


def _drawn(values: np.ndarray, norm: Normalize) -> np.ndarray:
    """Which values have a colour."""
    return values > 0 if isinstance(norm, LogNorm) else ~np.isnan(values)


def _spanned(dataset: "xr.Dataset", values: np.ndarray) -> tuple[np.ndarray, int]:
    """What colours span, over how many decades at most: admissible cells, outside which formulas may give any number.

    Where these are few, all that is shown: or the colours would tell nothing of what is around them.
    """
    drawn = np.isfinite(values)
    trusted = drawn & dataset["admissible"].values if "admissible" in dataset else drawn
    return (values[trusted], _DECADES) if trusted.sum() >= _ENOUGH * drawn.sum() else (values[drawn], _ALL_DECADES)


def _log_colours(values: np.ndarray, decades: int) -> LogNorm:
    return LogNorm(max(values.min(), values.max() / 10**decades), values.max())


def _power_colours(dataset: "xr.Dataset") -> LogNorm:
    power = dataset["P"].values
    shown, decades = _spanned(dataset, np.where(power > 0, power, np.nan))
    return _log_colours(shown, decades) if shown.size else LogNorm(1e-9, 1e-6)


def _common_marks(dataset: "xr.Dataset") -> list[_Mark]:
    """Marks of what a map holds besides what is coloured."""
    marks = []
    if "admissible" in dataset:
        marks.append(_Mark(~dataset["admissible"].values, "veil", _VEIL, "inadmissible"))
    if "period" in dataset:
        period = dataset["period"].values
        marks += [
            _Mark(period == 1, "border", _LINE, "border of period 1"),
            _Mark(period == 0, "most", _DOT, "aperiodic"),
            _Mark(period < 0, "any", _CROSS, "undecided"),
        ]
    return marks


def _power_marks(dataset: "xr.Dataset") -> list[_Mark]:
    return [*_common_marks(dataset), _Mark(dataset["P"].values == 0, "bare", _BARE, "no impact")]


def _number_colours(name: str, dataset: "xr.Dataset") -> Normalize:
    shown, decades = _spanned(dataset, dataset[name].values)
    positive = shown[shown > 0]
    if positive.size and shown.min() >= 0 and positive.max() > _WIDE * positive.min():
        return _log_colours(positive, decades)
    return Normalize(shown.min(), shown.max()) if shown.size else Normalize(0, 1)


def _number_marks(name: str, dataset: "xr.Dataset") -> list[_Mark]:
    others = dataset.drop_vars(name) if name == "period" else dataset  # its own colours say it
    none = ~_drawn(dataset[name].values, _number_colours(name, dataset))
    zero = bool((dataset[name].values[none] == 0).any())
    return [*_common_marks(others), _Mark(none, "bare", _BARE, "zero, or no value" if zero else "no value")]


def _kinds(dataset: "xr.Dataset", name: str) -> "tuple[xr.Dataset, list[_Category]]":
    """A variable of flags as places among categories, those that occur."""
    variable = dataset[name]
    if variable.dtype == bool:
        words = {0: "no", 1: "yes"}
    else:
        words = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    found = sorted(flag for flag in words if (variable == flag).any())
    codes = np.searchsorted(found, variable.values.astype(int))
    shares = [f"{_share((variable.values == flag).mean())} {words[flag].replace('_', ' ')}" for flag in found]
    categories = [_Category(colour, text) for colour, text in zip(_COLOURS, shares, strict=False)]
    return dataset[[]].assign(code=variable.copy(data=codes)).assign_attrs(dataset.attrs), categories


def _difference_colours(_: "xr.Dataset") -> LogNorm:
    """One scale for all maps: beyond 1 it matters no more by how much."""
    return LogNorm(10.0**-_DECADES, 1.0)


def _difference_marks(dataset: "xr.Dataset") -> list[_Mark]:
    differs = dataset["label"].values == Label.DIFFERS
    marks = [_Mark(differs, "border", _LINE, "border of other labels")]
    if "cheapest_model" in dataset:
        verdict = dataset["cheapest_model"]
        within = f"{100 * verdict.attrs['tolerance']:.4g} %"
        marks += [
            _Mark(verdict.values == Model.RIGID, "border", _OUTLINE, f"rigid is enough within {within}"),
            _Mark(verdict.values == Model.UNDECIDED, "any", _CROSS | {"color": "orange"}, "undecided"),
        ]
    bare = ~(dataset["relative_difference"].values > 0)
    return [*marks, _Mark(bare, "bare", _BARE, "no difference, or failed")]


_POWER = _Kind("P", "$P$ [J per half period]", "sweep", NEEDS, (), _power_colours, _power_marks)
_DIFFERENCE = _Kind(
    "relative_difference",
    r"$|P_\mathrm{rigid} - P_\mathrm{soft}| / P_\mathrm{soft}$",
    "compare",
    ("relative_difference", "label"),
    ("cheapest_model",),
    _difference_colours,
    _difference_marks,
)


class _Category(NamedTuple):
    """One colour of a map of kinds, and what it means."""

    colour: Any
    text: str


def _coded(dataset: "xr.Dataset", categories: list[_Category] | None) -> Figure:
    """A map of kinds, by their places `code` among the categories; those of every panel's own table if there are none.

    Where it is `aperiodic`, the Lyapunov exponent shades it.
    """
    layout_of_kinds({str(dim): size for dim, size in dataset["code"].sizes.items()})
    dataset = dataset.squeeze([dim for dim, size in dataset["code"].sizes.items() if size == 1])
    dims = [str(dim) for dim in dataset["code"].dims]
    figure, panels = _panels(dataset, dims)
    figure.set_figwidth(figure.get_figwidth() + 1.5)
    for axes, panel in panels:
        kinds = _table_categories(panel) if categories is None else categories
        across, up = (_edges(panel[dim].values)[0] for dim in dims[:2])
        colours = ListedColormap([kind.colour for kind in kinds])
        scale = BoundaryNorm(np.arange(len(kinds) + 1) - 0.5, len(kinds))
        axes.pcolormesh(across, up, panel["code"].values, cmap=colours, norm=scale, rasterized=True)
        if categories is None:
            _list_categories(axes, kinds, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    if {"lyapunov", "aperiodic"} <= set(dataset) and dataset["aperiodic"].any():
        _shade(figure, dataset, panels, dims)
    if categories is not None:
        _list_categories(figure, categories, loc="outside right upper")
    figure.suptitle(title(dataset), fontsize="medium")
    return figure


def _shade(figure: Figure, dataset: "xr.Dataset", panels: "list[tuple[Axes, xr.Dataset]]", dims: list[str]) -> None:
    """Aperiodic cells in greys, the darker the faster they forget their start."""
    exponents = dataset["lyapunov"].where(dataset["aperiodic"])
    scale = Normalize(0.0, float(exponents.max()))
    for axes, panel in panels:
        across, up = (_edges(panel[dim].values)[0] for dim in dims[:2])
        shown = np.ma.masked_invalid(panel["lyapunov"].where(panel["aperiodic"]).values)
        mesh = axes.pcolormesh(across, up, shown, cmap=_GREYS, norm=scale, rasterized=True)
    figure.colorbar(mesh, ax=figure.axes, location="bottom", aspect=40, label="Lyapunov exponent per forcing period")


def _named(words: np.ndarray, periods: int) -> tuple[np.ndarray, list[_Category]]:
    """Every word's place among the categories, and these: the commonest labels, the others, and what is no orbit."""
    kinds, which, counts = np.unique(words, return_inverse=True, return_counts=True)
    orbits = [place for place in np.argsort(-counts, kind="stable") if kinds[place] not in _NO_ORBIT]
    ranked = [[place] for place in orbits[:_MOST_NAMED]] + [orbits[_MOST_NAMED:]]
    colours = [*_COLOURS[: len(ranked) - 1], _OTHERS]
    texts = [str(kinds[place[0]]) for place in ranked[:-1]] + [f"{len(ranked[-1])} other labels"]
    for word, colour in _NO_ORBIT.items():
        ranked.append(list(np.flatnonzero(kinds == word)))
        colours.append(colour)
        texts.append(f"aperiodic within {periods} periods" if word == "aperiodic" else word)
    shown = [n for n, places in enumerate(ranked) if places]
    codes = np.empty(kinds.size, int)
    for code, n in enumerate(shown):
        codes[ranked[n]] = code
    categories = [_Category(colours[n], f"{_share(counts[ranked[n]].sum() / words.size)} {texts[n]}") for n in shown]
    return codes[which].reshape(words.shape), categories


def _table_categories(panel: "xr.Dataset") -> list[_Category]:
    """The attractors of one table, the commonest by name."""
    found = panel.isel(attractor=panel["starts"].values > 0)
    colours = iter(_COLOURS)
    categories = []
    for n in range(min(found.sizes["attractor"], _MOST_NAMED)):
        entry = found.isel(attractor=n)
        word = str(entry["label"].values)
        colour = _NO_ORBIT[word] if word in _NO_ORBIT else next(colours)
        if word == "aperiodic":
            word += f" within {float(entry['periods_run']):g} periods"
        power = f", $P$ = {EngFormatter('J', places=2)(float(entry['P']))}" if entry["P"] > 0 else ""
        categories.append(_Category(colour, f"{_share(entry['fraction'])} {word}{power}"))
    rest = found["fraction"].values[_MOST_NAMED:]
    return [*categories, _Category(_OTHERS, f"{_share(rest.sum())} {rest.size} others")] if rest.size else categories


def _list_categories(where: Figure | Axes, categories: list[_Category], **place: Any) -> None:
    handles = [Patch(facecolor=kind.colour, edgecolor="0.3", linewidth=0.4) for kind in categories]
    texts = [kind.text for kind in categories]
    where.legend(handles, texts, frameon=False, handlelength=1.2, fontsize="small", **place)


def _share(part: Any) -> str:
    return f"{100 * float(part):.3g} %"


def _explain(figure: Figure, dataset: "xr.Dataset", kind: _Kind, peak: "xr.DataArray | None") -> None:
    """What the map holds constant above it, what its marks mean below; only the marks that it has."""
    figure.suptitle(title(dataset), fontsize="medium")
    shown = [(_handle(mark), mark.text) for mark in kind.marks(dataset) if mark.mask.any()]
    if peak is not None:
        amount = EngFormatter("J", places=2)(float(peak))
        shown.append((Line2D([], [], **_STAR), f"largest admissible $P$, {amount}"))
    handles, texts = zip(*shown, strict=True) if shown else ((), ())
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)


def _handle(mark: _Mark) -> Patch | Line2D:
    if mark.how in ("veil", "bare"):
        return Patch(**mark.style)
    return Line2D([], [], **mark.style if mark.how == "border" else mark.style | _SINGLE)


def _edges(values: np.ndarray) -> tuple[np.ndarray, str]:
    """Edges of the cells around ascending values, and the scale on which these are evenly spaced."""
    log = values.size > 2 and values[0] > 0 and np.ptp(np.diff(np.log(values))) < _EVEN * np.log(values[-1] / values[0])
    points = np.log(values) if log else values
    middle = 0.5 * (points[1:] + points[:-1])
    edges = np.concatenate([[2 * points[0] - middle[0]], middle, [2 * points[-1] - middle[-1]]])
    return (np.exp(edges), "log") if log else (edges, "linear")


def _hatch(axes: Axes, across: np.ndarray, up: np.ndarray, mask: np.ndarray) -> None:
    if not mask.any():
        return
    # Every cell twice, at both its edges: the contour then follows the cells instead of cutting their corners.
    stairs = np.repeat(np.repeat(mask.astype(float), 2, axis=0), 2, axis=1)
    corners = np.repeat(across, 2)[1:-1], np.repeat(up, 2)[1:-1]
    veil = axes.contourf(*corners, stairs, levels=[0.5, 1.5], colors=[_VEIL["facecolor"]], hatches=[_VEIL["hatch"]])
    veil.set(edgecolor=_VEIL["edgecolor"], linewidth=0)


def _borders(across: np.ndarray, up: np.ndarray, mask: np.ndarray) -> list[Any]:
    """The edges between cells in the mask and cells outside it."""
    segments = []
    for i, j in np.argwhere(mask[:, 1:] != mask[:, :-1]):
        segments.append([(across[j + 1], up[i]), (across[j + 1], up[i + 1])])
    for i, j in np.argwhere(mask[1:] != mask[:-1]):
        segments.append([(across[j], up[i + 1]), (across[j + 1], up[i + 1])])
    return segments


def _runs(mask: np.ndarray) -> np.ndarray:
    """First and one past the last index of every run of true values."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def _marks(mask: np.ndarray, x: np.ndarray, y: np.ndarray, *, most: bool) -> tuple[np.ndarray, np.ndarray]:
    """Places of the cells in the mask; on a fine map, of the blocks of which most cells, or any, are in it."""
    step = max(math.ceil(size / _MARKS) for size in mask.shape)
    starts = [np.arange(0, size, step) for size in mask.shape]
    share = np.add.reduceat(np.add.reduceat(mask.astype(int), starts[0], axis=0), starts[1], axis=1)
    rows, columns = np.nonzero(2 * share > step**2 if most else share)
    centre = [np.minimum(start + step // 2, size - 1) for start, size in zip(starts, mask.shape, strict=True)]
    return x[centre[1][columns]], y[centre[0][rows]]
