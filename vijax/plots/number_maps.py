"""Maps coloured by a number, above all P, with marks that show where the number is admissible."""

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

from vijax.maps.compare import CheapestModel, LabelAgreement
from vijax.maps.map_dataset import best
from vijax.plots.cells import BARE, VEIL, borders, edges, marked_places, numbered, panels, runs, veil
from vijax.plots.figure import label_logs, styled
from vijax.plots.kind_maps import coded, of_flags
from vijax.plots.style import EXPECTED_NEEDS, NEEDS, QUANTITIES, axis_label, is_kind, layout, title, units
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# Decades of colours below the largest number: a wider scale would resolve the weakest cells, not the useful ones.
_DECADES = 4
_ALL_DECADES = 8  # decades if the colours span inadmissible cells too
_ENOUGH = 0.1  # least fraction of admissible cells if the colours are to span these cells alone
_WIDE = 30  # ratio of the largest to the smallest number above which their scale is logarithmic


_LINE: dict[str, Any] = {
    "color": "white",
    "linewidth": 0.8,
    "path_effects": [Stroke(linewidth=1.6, foreground="black"), Normal()],
}
_DOT: dict[str, Any] = {"marker": ".", "markersize": 1.3, "color": "black", "mew": 0, "linestyle": "none"}
_CROSS: dict[str, Any] = {"marker": "x", "markersize": 3.0, "color": "red", "mew": 0.7, "linestyle": "none"}
_OUTLINE: dict[str, Any] = _LINE | {"color": "red", "linewidth": 1.2}
_SINGLE = {"markersize": 4.0}  # larger size for a mark that is not one of thousands
_STAR: dict[str, Any] = {"marker": "*", "markersize": 11, "color": "red", "mec": "white", "linestyle": "none"}


class Marker(NamedTuple):
    """Cells of a map with a common mark.

    Attributes:
        mask: The marked cells, [y, x].
        how: Kind of mark: "veil" over the cells, "border" around them, points on blocks of cells with "most" or with
            "any" cells in the mask, or "bare" for cells that have no colour and get no mark.
        style: Keyword arguments of matplotlib.
        text: Text of the mark in the legend.
    """

    mask: np.ndarray
    how: Literal["veil", "border", "most", "any", "bare"]
    style: dict[str, Any]
    text: str


class MapKind(NamedTuple):
    """A kind of picture.

    Attributes:
        coloured: Name of the coloured variable.
        label: Label of the colour bar.
        producer: Function that makes such maps.
        needs: Required variables.
        optional: Variables of the marks, used if present.
        colours: Returns the colour scale of a dataset.
        markers: Returns the marks of a dataset.
    """

    coloured: str
    label: str
    producer: str
    needs: tuple[str, ...]
    optional: tuple[str, ...]
    colours: "Callable[[xr.Dataset], Normalize]"
    markers: "Callable[[xr.Dataset], list[Marker]]"


@styled
def power_map(dataset: "xr.Dataset") -> Figure:
    """Draw P on a logarithmic colour scale, with marks that show where P is admissible.

    Inadmissible cells are veiled and hatched, the border of the period-1 region is a line, aperiodic cells carry dots
    and undecided ones crosses, and a star stands on the largest admissible P. The colours span the admissible cells if
    they are at least a tenth of the drawn cells, otherwise all drawn cells.

    A map with several starts in every cell shows the expected P. A line then surrounds cells with more than one
    attractor, crosses stand where starts remained undecided, and cells that any start makes inadmissible are veiled.

    Args:
        dataset: A map with `P`, `period` and `admissible`. Its dimensions are, in order, x, y, columns and rows of
            panels; with one dimension a curve is drawn.

    Raises:
        ValueError: The map lacks a variable, or has more dimensions or panels than a picture can hold.
    """
    validation.validate_dataset("dataset", dataset, (), "sweep")
    return _picture(dataset, _EXPECTED if "starts" in dataset.attrs else POWER)


@styled
def variable_map(dataset: "xr.Dataset", name: str) -> Figure:
    """Draw any variable of a map, with the marks of `power_map` that the map's variables allow.

    Numbers are coloured, on a logarithmic scale if they are positive and span a factor of 30. A kind, such as `status`
    or `admissible`, has one colour per value. Cells without a value are grey.

    Args:
        dataset: Result of `sweep`; dimensions as in `power_map`, for kinds at least two.
        name: Name of the variable.

    Raises:
        ValueError: As `power_map`.
    """
    validation.validate_dataset("dataset", dataset, (), "sweep")
    validation.validate_choice("name", name, [str(variable_name) for variable_name in dataset])
    variable = dataset[name]
    if is_kind(variable):
        return coded(*of_flags(dataset, name))
    if variable.dtype.kind == "i":
        dataset = dataset.assign({name: variable.where(variable >= 0)})  # -1 means no value
    return _picture(dataset, kind_of(dataset, name))


def kind_of(dataset: "xr.Dataset", name: str) -> MapKind:
    """Return the colours and marks of a variable of numbers, as `variable_map` draws it."""
    variable = dataset[name]
    written = name.replace("_", " ") + (f" [{units(variable)}]" if units(variable) else "")
    return MapKind(
        name,
        written,
        "sweep",
        (name,),
        (*NEEDS, *EXPECTED_NEEDS),
        partial(_number_colours, name),
        partial(_number_markers, name),
    )


@styled
def difference_map(dataset: "xr.Dataset") -> Figure:
    """Draw the relative difference in P between rigid and soft walls on a logarithmic colour scale.

    A line separates cells with different labels from the others. If the comparison has a tolerance, a second line
    surrounds the cells where the rigid model is sufficient, and crosses stand on undecided cells.

    Args:
        dataset: Result of `compare`; dimensions as in `power_map`.

    Raises:
        ValueError: As `power_map`.
    """
    return _picture(dataset, _DIFFERENCE)


def _picture(dataset: "xr.Dataset", kind: MapKind) -> Figure:
    validation.validate_dataset(
        "dataset", dataset, kind.needs, kind.producer, "variable_map (--show NAME) draws any that there is"
    )
    coloured = dataset[kind.coloured]
    layout({str(dim): size for dim, size in coloured.sizes.items()})
    names = list(dict.fromkeys([*kind.needs, *(name for name in kind.optional if name in dataset)]))
    # A variable lacks the dimensions on which it does not depend; the picture requires all of them.
    full = {name: dataset[name].broadcast_like(coloured).transpose(*coloured.dims) for name in names}
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
    # matplotlib treats infinities as missing values.
    values = np.minimum(panel[kind.coloured].values, np.finfo(float).max)
    mesh = axes.pcolormesh(
        across, up, np.ma.masked_where(~has_colour(values, norm), values), norm=norm, rasterized=True
    )
    _mark_map(axes, kind.markers(panel), (panel[x].values, panel[y].values), (across, up))
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
    has_value = has_colour(values, norm) & np.isfinite(values)
    axes.plot(places, np.where(has_value, values, np.nan), color="tab:blue", linewidth=0.9, zorder=1)
    axes.margins(y=0.05)
    label_logs(axes)
    _mark_curve(axes, kind.markers(dataset), places, across, values)
    if peak is not None:
        axes.plot(peak[x], dataset[kind.coloured].sel({x: peak[x]}), **_STAR, zorder=5)
    _explain(figure, dataset, kind, peak)
    return figure


def _peak(dataset: "xr.Dataset") -> "xr.DataArray | None":
    return best(dataset) if {"P", "admissible"} <= set(dataset) else None


def _mark_map(
    axes: Axes, markers: list[Marker], places: tuple[np.ndarray, np.ndarray], cell_edges: tuple[np.ndarray, np.ndarray]
) -> None:
    for mask, how, style, _ in markers:
        if how == "veil":
            veil(axes, *cell_edges, mask)
        elif how == "border":
            axes.add_collection(LineCollection(borders(*cell_edges, mask), **style))
        elif how != "bare":
            axes.plot(*marked_places(mask, *places, most=how == "most"), **style)


def _mark_curve(axes: Axes, markers: list[Marker], places: np.ndarray, across: np.ndarray, values: np.ndarray) -> None:
    for mask, how, style, _ in markers:
        if how == "veil":
            for start, end in runs(mask):
                axes.axvspan(across[start], across[end], **style, zorder=0)
        elif how == "border":
            for edge in set(runs(mask).flat) - {0, places.size}:
                axes.axvline(across[edge], **style, zorder=0.5)
        elif how != "bare":
            axes.plot(places[mask], values[mask], **style | _SINGLE, zorder=2)


def has_colour(values: np.ndarray, norm: Normalize) -> np.ndarray:
    """Return True for values that have a colour."""
    return values > 0 if isinstance(norm, LogNorm) else ~np.isnan(values)


def _spanned(dataset: "xr.Dataset", values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the values that the colours span (admissible ones, or all if few are admissible), and the most decades.

    Outside of the admissible cells the formula of P may return any number. If admissible cells are few, colours that
    span them alone would show nothing of their surroundings.
    """
    finite = np.isfinite(values)
    admissible = finite & dataset["admissible"].values if "admissible" in dataset else finite
    return (
        (values[admissible], _DECADES) if admissible.sum() >= _ENOUGH * finite.sum() else (values[finite], _ALL_DECADES)
    )


def _log_colours(values: np.ndarray, decades: int) -> LogNorm:
    return LogNorm(max(values.min(), values.max() / 10**decades), values.max())


def _power_colours(dataset: "xr.Dataset") -> LogNorm:
    power = dataset["P"].values
    spanned, decades = _spanned(dataset, np.where(power > 0, power, np.nan))
    return _log_colours(spanned, decades) if spanned.size else LogNorm(1e-9, 1e-6)


def _common_markers(dataset: "xr.Dataset") -> list[Marker]:
    """Return the marks of `admissible`, `period`, `attractors` and `undecided`, if the map has these variables."""
    markers = []
    if "admissible" in dataset:
        markers.append(Marker(~dataset["admissible"].values, "veil", VEIL, "inadmissible"))
    if "period" in dataset:
        period = dataset["period"].values
        # With until="window" the period is not determined: it is undecided in every cell, and marks would show nothing.
        undecided = (period < 0) & (dataset.attrs.get("until") != "window")
        markers += [
            Marker(period == 1, "border", _LINE, "border of period 1"),
            Marker(period == 0, "most", _DOT, "aperiodic"),
            Marker(undecided, "any", _CROSS, "undecided"),
        ]
    if "attractors" in dataset:
        markers.append(Marker(dataset["attractors"].values > 1, "border", _LINE, "border of several attractors"))
    if "undecided" in dataset:
        markers.append(Marker(dataset["undecided"].values > 0, "any", _CROSS, "starts undecided"))
    return markers


def _power_markers(dataset: "xr.Dataset") -> list[Marker]:
    return [*_common_markers(dataset), Marker(dataset["P"].values == 0, "bare", BARE, "no impact")]


def _number_colours(name: str, dataset: "xr.Dataset") -> Normalize:
    spanned, decades = _spanned(dataset, dataset[name].values)
    positive = spanned[spanned > 0]
    if positive.size and spanned.min() >= 0 and positive.max() > _WIDE * positive.min():
        return _log_colours(positive, decades)
    return Normalize(spanned.min(), spanned.max()) if spanned.size else Normalize(0, 1)


def _number_markers(name: str, dataset: "xr.Dataset") -> list[Marker]:
    mark_variables = ("period", "attractors", "undecided")
    remaining = dataset.drop_vars(name) if name in mark_variables else dataset  # shown by colours already
    uncoloured = ~has_colour(dataset[name].values, _number_colours(name, dataset))
    has_zero = bool((dataset[name].values[uncoloured] == 0).any())
    return [
        *_common_markers(remaining),
        Marker(uncoloured, "bare", BARE, "zero, or no value" if has_zero else "no value"),
    ]


def _difference_colours(_: "xr.Dataset") -> LogNorm:
    """Return one scale for all maps, from 1e-4 to 1, because differences above 1 need no resolution."""
    return LogNorm(10.0**-_DECADES, 1.0)


def _difference_markers(dataset: "xr.Dataset") -> list[Marker]:
    differs = dataset["label"].values == LabelAgreement.DIFFERS
    markers = [Marker(differs, "border", _LINE, "border of other labels")]
    if "cheapest_model" in dataset:
        model = dataset["cheapest_model"]
        within = f"{100 * model.attrs['tolerance']:.4g} %"
        markers += [
            Marker(model.values == CheapestModel.RIGID, "border", _OUTLINE, f"rigid is enough within {within}"),
            Marker(model.values == CheapestModel.UNDECIDED, "any", _CROSS | {"color": "orange"}, "undecided"),
        ]
    bare = ~(dataset["relative_difference"].values > 0)
    return [*markers, Marker(bare, "bare", BARE, "no difference, or failed")]


POWER = MapKind("P", QUANTITIES["P"], "sweep", NEEDS, (), _power_colours, _power_markers)
_EXPECTED = POWER._replace(label=f"{QUANTITIES['P']}, mean over starts", needs=EXPECTED_NEEDS)
_DIFFERENCE = MapKind(
    "relative_difference",
    r"$|P_\mathrm{rigid} - P_\mathrm{soft}| / P_\mathrm{soft}$",
    "compare",
    ("relative_difference", "label"),
    ("cheapest_model",),
    _difference_colours,
    _difference_markers,
)


def _explain(figure: Figure, dataset: "xr.Dataset", kind: MapKind, peak: "xr.DataArray | None") -> None:
    """Write the map's constants above, and the meaning of the occurring marks below."""
    figure.suptitle(title(dataset), fontsize="medium")
    legend = [(_handle(marker), marker.text) for marker in kind.markers(dataset) if marker.mask.any()]
    if peak is not None:
        amount = EngFormatter("J", places=2)(float(peak))
        legend.append((Line2D([], [], **_STAR), f"largest admissible $P$, {amount}"))
    handles, texts = zip(*legend, strict=True) if legend else ((), ())
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, handlelength=1.6)


def _handle(marker: Marker) -> Patch | Line2D:
    if marker.how in ("veil", "bare"):
        return Patch(**marker.style)
    return Line2D([], [], **marker.style if marker.how == "border" else marker.style | _SINGLE)
