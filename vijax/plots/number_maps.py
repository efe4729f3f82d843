"""Maps coloured by a number, P before all, with what tells where to believe it."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import EngFormatter

from vijax.planes.compare import Label, Model
from vijax.planes.dataset import best
from vijax.plots.cells import BARE, VEIL, borders, edges, marked_places, numbered, panels, runs, veil
from vijax.plots.figure import label_logs, styled
from vijax.plots.kind_maps import coded, of_flags
from vijax.plots.style import EXPECTED_NEEDS, NEEDS, QUANTITIES, axis_label, is_kind, layout, title, units
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# A wider scale would say more about its faintest cells than about those worth building.
_DECADES = 4
_ALL_DECADES = 8  # where inadmissible cells are shown too
_ENOUGH = 0.1  # a smaller share of admissible cells among those shown does not choose the colours
_WIDE = 30  # ratio of the largest to the smallest number from which on their scale is logarithmic


_LINE: dict[str, Any] = {
    "color": "white",
    "linewidth": 0.8,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}
_DOT: dict[str, Any] = {"marker": ".", "markersize": 1.3, "color": "black", "mew": 0, "linestyle": "none"}
_CROSS: dict[str, Any] = {"marker": "x", "markersize": 3.0, "color": "red", "mew": 0.7, "linestyle": "none"}
_OUTLINE: dict[str, Any] = _LINE | {"color": "red", "linewidth": 1.2}
_SINGLE = {"markersize": 4.0}  # a mark that is not one of thousands may be larger
_STAR: dict[str, Any] = {"marker": "*", "markersize": 11, "color": "red", "mec": "white", "linestyle": "none"}


class Mark(NamedTuple):
    """Cells that carry a mark, and what it means: a veil, the border around them, a point on most or any, or none."""

    mask: np.ndarray
    how: Literal["veil", "border", "most", "any", "bare"]
    style: dict[str, Any]
    text: str


class MapKind(NamedTuple):
    """A kind of picture: what it colours and how, which function makes such maps, the variables that it needs.

    And those that it can do without, its marks.
    """

    coloured: str
    label: str
    made: str
    needs: tuple[str, ...]
    optional: tuple[str, ...]
    colours: "Callable[[xr.Dataset], Normalize]"
    marks: "Callable[[xr.Dataset], list[Mark]]"


@styled
def power_map(dataset: "xr.Dataset") -> Figure:
    """Draw P on a log colour scale, with all that tells where to believe it.

    Inadmissible cells are veiled and hatched, the border of the period-1 region is a line, aperiodic cells carry dots
    and undecided ones crosses, and a star stands on the largest admissible P. The colours span the admissible cells if
    these are a tenth of those shown, and otherwise all.

    Of a map with several starts in every cell it is the P expected of them; a line then goes around cells of more than
    one attractor, crosses stand where starts were left undecided, and cells are veiled that any start makes
    inadmissible.

    Args:
        dataset: A map with `P`, `period` and `admissible`. Its dimensions are, in order, x, y, columns and rows of
            panels; of one dimension a curve is drawn.

    Raises:
        ValueError: If the map lacks a variable, or has more dimensions or panels than a picture can hold.
    """
    checks.variables("dataset", dataset, (), "sweep")
    return _picture(dataset, _EXPECTED if "starts" in dataset.attrs else POWER)


@styled
def variable_map(dataset: "xr.Dataset", name: str) -> Figure:
    """Draw any variable of a map, with the marks of `power_map` for as much as the map holds.

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
        return coded(*of_flags(dataset, name))
    if variable.dtype.kind == "i":
        dataset = dataset.assign({name: variable.where(variable >= 0)})  # -1 is none
    return _picture(dataset, kind_of(dataset, name))


def kind_of(dataset: "xr.Dataset", name: str) -> MapKind:
    """Say how a variable of numbers is coloured and what marks it has, as `variable_map` draws it."""
    variable = dataset[name]
    written = name.replace("_", " ") + (f" [{units(variable)}]" if units(variable) else "")
    return MapKind(
        name,
        written,
        "sweep",
        (name,),
        (*NEEDS, *EXPECTED_NEEDS),
        partial(_number_colours, name),
        partial(_number_marks, name),
    )


@styled
def difference_map(dataset: "xr.Dataset") -> Figure:
    """Draw the relative difference in P between rigid and soft walls on a log colour scale.

    A line parts cells whose labels differ from the others; another one, where the comparison was given a tolerance,
    goes around the cells where the rigid model is enough, and crosses stand on those without a verdict.

    Args:
        dataset: What `compare` returned; dimensions as in `power_map`.

    Raises:
        ValueError: As `power_map`.
    """
    return _picture(dataset, _DIFFERENCE)


def _picture(dataset: "xr.Dataset", kind: MapKind) -> Figure:
    checks.variables("dataset", dataset, kind.needs, kind.made, "variable_map (--show NAME) draws any that there is")
    whole = dataset[kind.coloured]
    layout({str(dim): size for dim, size in whole.sizes.items()})
    names = list(dict.fromkeys([*kind.needs, *(name for name in kind.optional if name in dataset)]))
    # A variable lacks the dimensions that it does not depend on; the picture wants them all.
    full = {name: dataset[name].broadcast_like(whole).transpose(*whole.dims) for name in names}
    dataset = numbered(dataset.assign(full)[names]).squeeze()
    dims = [str(dim) for dim in dataset[kind.coloured].dims]
    figure = _curve(dataset, kind) if len(dims) == 1 else _maps(dataset, kind, dims)
    return figure


def _maps(dataset: "xr.Dataset", kind: MapKind, dims: list[str]) -> Figure:
    figure, filled = panels(dataset, dims)
    norm, peak = kind.colours(dataset), _peak(dataset)
    for axes, panel in filled:
        mesh = _panel(axes, panel, kind, dims[0], dims[1], norm)
        if peak is not None and all(peak[dim] == panel[dim] for dim in dims[2:]):
            axes.plot(peak[dims[0]], peak[dims[1]], **_STAR, clip_on=False, zorder=5)
    figure.colorbar(mesh, ax=figure.axes, extend="both", label=kind.label)
    _explain(figure, dataset, kind, peak)
    return figure


def _panel(axes: Axes, panel: "xr.Dataset", kind: MapKind, x: str, y: str, norm: Normalize) -> QuadMesh:
    across, up = (edges(panel[dim].values)[0] for dim in (x, y))
    # matplotlib takes infinities for missing.
    values = np.minimum(panel[kind.coloured].values, np.finfo(float).max)
    mesh = axes.pcolormesh(
        across, up, np.ma.masked_where(~has_colour(values, norm), values), norm=norm, rasterized=True
    )
    _mark_map(axes, kind.marks(panel), (panel[x].values, panel[y].values), (across, up))
    return mesh


def _curve(dataset: "xr.Dataset", kind: MapKind) -> Figure:
    """Draw the coloured variable over a single axis, with the marks of a map."""
    (x,) = (str(dim) for dim in dataset[kind.coloured].dims)
    dataset = dataset.sortby(x)
    places, values = dataset[x].values, dataset[kind.coloured].values
    figure = Figure(figsize=(5.2, 3.8), layout="constrained")
    axes, peak = figure.subplots(), _peak(dataset)
    across, xscale = edges(places)
    norm = kind.colours(dataset)
    yscale = "log" if isinstance(norm, LogNorm) else "linear"
    axes.set(xscale=xscale, yscale=yscale, xlim=across[[0, -1]], xlabel=axis_label(dataset[x]), ylabel=kind.label)
    drawn = has_colour(values, norm) & np.isfinite(values)
    axes.plot(places, np.where(drawn, values, np.nan), color="tab:blue", linewidth=0.9, zorder=1)
    axes.margins(y=0.05)
    label_logs(axes)
    _mark_curve(axes, kind.marks(dataset), places, across, values)
    if peak is not None:
        axes.plot(peak[x], dataset[kind.coloured].sel({x: peak[x]}), **_STAR, zorder=5)
    _explain(figure, dataset, kind, peak)
    return figure


def _peak(dataset: "xr.Dataset") -> "xr.DataArray | None":
    return best(dataset) if {"P", "admissible"} <= set(dataset) else None


def _mark_map(
    axes: Axes, marks: list[Mark], places: tuple[np.ndarray, np.ndarray], around: tuple[np.ndarray, np.ndarray]
) -> None:
    for mask, how, style, _ in marks:
        if how == "veil":
            veil(axes, *around, mask)
        elif how == "border":
            axes.add_collection(LineCollection(borders(*around, mask), **style))
        elif how != "bare":
            axes.plot(*marked_places(mask, *places, most=how == "most"), **style)


def _mark_curve(axes: Axes, marks: list[Mark], places: np.ndarray, across: np.ndarray, values: np.ndarray) -> None:
    for mask, how, style, _ in marks:
        if how == "veil":
            for start, end in runs(mask):
                axes.axvspan(across[start], across[end], **style, zorder=0)
        elif how == "border":
            for edge in set(runs(mask).flat) - {0, places.size}:
                axes.axvline(across[edge], **style, zorder=0.5)
        elif how != "bare":
            axes.plot(places[mask], values[mask], **style | _SINGLE, zorder=2)


def has_colour(values: np.ndarray, norm: Normalize) -> np.ndarray:
    """Say which values have a colour."""
    return values > 0 if isinstance(norm, LogNorm) else ~np.isnan(values)


def _spanned(dataset: "xr.Dataset", values: np.ndarray) -> tuple[np.ndarray, int]:
    """Find what colours span, over how many decades at most: admissible cells, as outside formulas may give any number.

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


def _common_marks(dataset: "xr.Dataset") -> list[Mark]:
    """Make marks of what a map holds besides what is coloured."""
    marks = []
    if "admissible" in dataset:
        marks.append(Mark(~dataset["admissible"].values, "veil", VEIL, "inadmissible"))
    if "period" in dataset:
        period = dataset["period"].values
        # Of a window nobody asked what the motion is: it is left undecided everywhere.
        unknown = (period < 0) & (dataset.attrs.get("until") != "window")
        marks += [
            Mark(period == 1, "border", _LINE, "border of period 1"),
            Mark(period == 0, "most", _DOT, "aperiodic"),
            Mark(unknown, "any", _CROSS, "undecided"),
        ]
    if "attractors" in dataset:
        marks.append(Mark(dataset["attractors"].values > 1, "border", _LINE, "border of several attractors"))
    if "undecided" in dataset:
        marks.append(Mark(dataset["undecided"].values > 0, "any", _CROSS, "starts undecided"))
    return marks


def _power_marks(dataset: "xr.Dataset") -> list[Mark]:
    return [*_common_marks(dataset), Mark(dataset["P"].values == 0, "bare", BARE, "no impact")]


def _number_colours(name: str, dataset: "xr.Dataset") -> Normalize:
    shown, decades = _spanned(dataset, dataset[name].values)
    positive = shown[shown > 0]
    if positive.size and shown.min() >= 0 and positive.max() > _WIDE * positive.min():
        return _log_colours(positive, decades)
    return Normalize(shown.min(), shown.max()) if shown.size else Normalize(0, 1)


def _number_marks(name: str, dataset: "xr.Dataset") -> list[Mark]:
    own = ("period", "attractors", "undecided")
    others = dataset.drop_vars(name) if name in own else dataset  # its own colours say it
    none = ~has_colour(dataset[name].values, _number_colours(name, dataset))
    zero = bool((dataset[name].values[none] == 0).any())
    return [*_common_marks(others), Mark(none, "bare", BARE, "zero, or no value" if zero else "no value")]


def _difference_colours(_: "xr.Dataset") -> LogNorm:
    """Set one scale for all maps: beyond 1 it matters no more by how much."""
    return LogNorm(10.0**-_DECADES, 1.0)


def _difference_marks(dataset: "xr.Dataset") -> list[Mark]:
    differs = dataset["label"].values == Label.DIFFERS
    marks = [Mark(differs, "border", _LINE, "border of other labels")]
    if "cheapest_model" in dataset:
        verdict = dataset["cheapest_model"]
        within = f"{100 * verdict.attrs['tolerance']:.4g} %"
        marks += [
            Mark(verdict.values == Model.RIGID, "border", _OUTLINE, f"rigid is enough within {within}"),
            Mark(verdict.values == Model.UNDECIDED, "any", _CROSS | {"color": "orange"}, "undecided"),
        ]
    bare = ~(dataset["relative_difference"].values > 0)
    return [*marks, Mark(bare, "bare", BARE, "no difference, or failed")]


POWER = MapKind("P", QUANTITIES["P"], "sweep", NEEDS, (), _power_colours, _power_marks)
_EXPECTED = POWER._replace(label=f"{QUANTITIES['P']}, mean over starts", needs=EXPECTED_NEEDS)
_DIFFERENCE = MapKind(
    "relative_difference",
    r"$|P_\mathrm{rigid} - P_\mathrm{soft}| / P_\mathrm{soft}$",
    "compare",
    ("relative_difference", "label"),
    ("cheapest_model",),
    _difference_colours,
    _difference_marks,
)


def _explain(figure: Figure, dataset: "xr.Dataset", kind: MapKind, peak: "xr.DataArray | None") -> None:
    """Explain above what the map holds constant, below what its marks mean; only the marks that it has."""
    figure.suptitle(title(dataset), fontsize="medium")
    shown = [(_handle(mark), mark.text) for mark in kind.marks(dataset) if mark.mask.any()]
    if peak is not None:
        amount = EngFormatter("J", places=2)(float(peak))
        shown.append((Line2D([], [], **_STAR), f"largest admissible $P$, {amount}"))
    handles, texts = zip(*shown, strict=True) if shown else ((), ())
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)


def _handle(mark: Mark) -> Patch | Line2D:
    if mark.how in ("veil", "bare"):
        return Patch(**mark.style)
    return Line2D([], [], **mark.style if mark.how == "border" else mark.style | _SINGLE)
