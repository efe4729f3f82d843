"""Maps coloured by kinds: attractors and their number, basins, flags."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from vijax.model.label import label
from vijax.model.pair import has_mirror_symmetry
from vijax.plots.cells import edges, numbered, panels
from vijax.plots.figure import styled
from vijax.plots.style import LABEL_NEEDS, layout_of_kinds, title
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# Maximum number of kinds with a colour and a name of their own. COLOURS are the strong colours of tab20, then the pale
# ones, without greys.
MOST_NAMED = 12
COLOURS = [mpl.colormaps["tab20"](n) for n in (*range(0, 20, 2), *range(1, 20, 2)) if n not in (14, 15)]
OTHERS = "#fff3c4"
NO_ORBIT = {
    "no impact": "0.93",
    "permanent contact": "white",
    "aperiodic": "0.35",
    "undecided": "magenta",
    "failed": "red",
}
_GREYS = LinearSegmentedColormap.from_list("greys", ["0.8", "black"])


class Category(NamedTuple):
    """A colour of a map of kinds, and its text in the legend."""

    colour: Any
    text: str


@styled
def label_map(dataset: "xr.Dataset") -> Figure:
    """Draw the plane coloured by attractor, n:m/pT; aperiodic cells are shaded by their Lyapunov exponent.

    A label n:m/pT means n and m impacts on the two walls in p forcing periods. The 12 most frequent labels have a
    colour and a name each; the others form one group. Without gravity and with equal walls, mirror images have one
    label, with the smaller count first. Aperiodic means that no period was found within the simulated periods.

    Args:
        dataset: A map with `period`, `impacts_left`, `impacts_right` and `status`, and with `lyapunov` for shades;
            dimensions as in `power_map`, at least two.

    Raises:
        ValueError: As `power_map`.
    """
    validation.validate_dataset("dataset", dataset, LABEL_NEEDS, "sweep")
    return coded(*of_labels(dataset))


def of_labels(dataset: "xr.Dataset") -> "tuple[xr.Dataset, list[Category]]":
    """Return the map with a category index per cell, and the categories: frequent labels, other labels, no orbit."""
    period = dataset["period"]
    # Mirror images merge only under mirror symmetry: an excitation other than the sine, or unequal laws, may break it.
    symmetric_laws = "excitation" not in dataset.attrs and not dataset.attrs.get("membrane", "").startswith("left ")
    is_symmetric = (has_mirror_symmetry(dataset) & symmetric_laws).broadcast_like(period).transpose(*period.dims)
    words = label(*(dataset[name].values for name in LABEL_NEEDS), merge_mirrors=is_symmetric.values)
    codes, categories = _group_labels(words, int(dataset.attrs["periods"]))
    drawn = dataset[["lyapunov"] if "lyapunov" in dataset else []].assign(
        code=(period.dims, codes), aperiodic=period == 0
    )
    return drawn.assign_attrs(dataset.attrs), categories


@styled
def basin_map(dataset: "xr.Dataset") -> Figure:
    """Draw the (u0, v0) plane coloured by the attractor of each start, with a table of attractors beside it.

    Args:
        dataset: Result of `basins` for arrays u0 and v0; further axes make panels, each with its own table.

    Raises:
        ValueError: As `power_map`.
    """
    validation.validate_dataset("dataset", dataset, ("basin", "label", "fraction", "P"), "basins")
    further = [dim for dim in dataset["P"].dims if dim not in (*dataset["basin"].dims, "attractor")]
    dataset = dataset.isel(dict.fromkeys(further, 0))
    drawn = dataset.assign(code=dataset["basin"].clip(max=MOST_NAMED)).drop_vars("basin")
    return coded(drawn, None)


@styled
def multistability_map(dataset: "xr.Dataset") -> Figure:
    """Draw the plane of parameters coloured by the number of coexisting attractors.

    Args:
        dataset: Result of `basin_fractions`; dimensions as in `power_map`, at least two.

    Raises:
        ValueError: As `power_map`.
    """
    validation.validate_dataset("dataset", dataset, ("attractors",), "basin_fractions")
    number = dataset["attractors"]
    largest = int(number.max())
    shades = mpl.colormaps["viridis_r"](np.linspace(0, 1, largest + 1))
    shades[0] = to_rgba(NO_ORBIT["undecided"])
    texts = ["undecided", "1 attractor", *(f"{n} attractors" for n in range(2, largest + 1))]
    categories = [
        Category(tuple(shade), f"{_share((number == n).mean())} {text}")
        for n, (shade, text) in enumerate(zip(shades, texts[: largest + 1], strict=True))
    ]
    drawn = dataset[[]].assign(code=number).assign_attrs(dataset.attrs)
    return coded(drawn, categories)


def basins(dataset: "xr.Dataset") -> Figure:
    """Draw coexisting attractors: `basin_map` for a result of `basins`, `multistability_map` for `basin_fractions`.

    Raises:
        ValueError: As `power_map`.
    """
    validation.validate_dataset("dataset", dataset, ("attractors",), "basins")
    return (multistability_map if "start" in dataset.sizes else basin_map)(dataset)


def of_flags(dataset: "xr.Dataset", name: str) -> "tuple[xr.Dataset, list[Category]]":
    """Return the map with a category index per cell, and the categories of the flags that occur."""
    variable = dataset[name]
    if variable.dtype == bool:
        words = {0: "no", 1: "yes"}
    else:
        words = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    present = sorted(flag for flag in words if (variable == flag).any())
    codes = np.searchsorted(present, variable.values.astype(int))
    shares = [f"{_share((variable.values == flag).mean())} {words[flag].replace('_', ' ')}" for flag in present]
    categories = [Category(colour, text) for colour, text in zip(COLOURS, shares, strict=False)]
    return dataset[[]].assign(code=variable.copy(data=codes)).assign_attrs(dataset.attrs), categories


def coded(dataset: "xr.Dataset", categories: list[Category] | None) -> Figure:
    """Draw cells coloured by the variable `code`, an index into `categories`.

    Without categories, every panel lists its own table of attractors.

    Cells with `aperiodic` are shaded by their Lyapunov exponent.
    """
    layout_of_kinds({str(dim): size for dim, size in dataset["code"].sizes.items()})
    dataset = numbered(dataset).squeeze([dim for dim, size in dataset["code"].sizes.items() if size == 1])
    dims = [str(dim) for dim in dataset["code"].dims]
    figure, filled = panels(dataset, dims)
    figure.set_figwidth(figure.get_figwidth() + 1.5)
    for axes, panel in filled:
        kinds = _table_categories(panel) if categories is None else categories
        across, up = (edges(panel[dim].values)[0] for dim in dims[:2])
        colours = ListedColormap([kind.colour for kind in kinds])
        scale = BoundaryNorm(np.arange(len(kinds) + 1) - 0.5, len(kinds))
        axes.pcolormesh(across, up, panel["code"].values, cmap=colours, norm=scale, rasterized=True)
        if categories is None:
            _list_categories(axes, kinds, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    if {"lyapunov", "aperiodic"} <= set(dataset) and dataset["aperiodic"].any():
        _shade(figure, dataset, filled, dims)
    if categories is not None:
        _list_categories(figure, categories, loc="outside right upper")
    # A centred title would overlap a list of categories beside the map.
    place = {} if categories is None else {"x": 0.02, "ha": "left"}
    figure.suptitle(title(dataset), fontsize="medium", **place)
    return figure


def _shade(figure: Figure, dataset: "xr.Dataset", filled: "list[tuple[Axes, xr.Dataset]]", dims: list[str]) -> None:
    """Shade aperiodic cells in grey, darker for a larger Lyapunov exponent."""
    exponents = dataset["lyapunov"].where(dataset["aperiodic"])
    scale = Normalize(0.0, float(exponents.max()))
    for axes, panel in filled:
        across, up = (edges(panel[dim].values)[0] for dim in dims[:2])
        exponents_in_panel = np.ma.masked_invalid(panel["lyapunov"].where(panel["aperiodic"]).values)
        mesh = axes.pcolormesh(across, up, exponents_in_panel, cmap=_GREYS, norm=scale, rasterized=True)
    figure.colorbar(mesh, ax=figure.axes, location="bottom", aspect=40, label="Lyapunov exponent per forcing period")


def _group_labels(words: np.ndarray, periods: int) -> tuple[np.ndarray, list[Category]]:
    """Return the category index of every label, and the categories: frequent labels, other labels, no orbit."""
    kinds, kind_index, counts = np.unique(words, return_inverse=True, return_counts=True)
    orbits = [place for place in np.argsort(-counts, kind="stable") if kinds[place] not in NO_ORBIT]
    groups = [[place] for place in orbits[:MOST_NAMED]] + [orbits[MOST_NAMED:]]
    colours = [*COLOURS[: len(groups) - 1], OTHERS]
    texts = [str(kinds[place[0]]) for place in groups[:-1]] + [f"{len(groups[-1])} other labels"]
    for word, colour in NO_ORBIT.items():
        groups.append(list(np.flatnonzero(kinds == word)))
        colours.append(colour)
        texts.append(f"aperiodic within {periods} periods" if word == "aperiodic" else word)
    present = [n for n, places in enumerate(groups) if places]
    codes = np.empty(kinds.size, int)
    for code, n in enumerate(present):
        codes[groups[n]] = code
    categories = [Category(colours[n], f"{_share(counts[groups[n]].sum() / words.size)} {texts[n]}") for n in present]
    return codes[kind_index].reshape(words.shape), categories


def table_colours(labels: Sequence[str]) -> list[Any]:
    """Return the colours of attractors by their row in a table; rows beyond the first 12 share a colour."""
    colours = iter(COLOURS)
    named = [NO_ORBIT[word] if word in NO_ORBIT else next(colours) for word in labels[:MOST_NAMED]]
    return [*named, *[OTHERS] * (len(labels) - len(named))]


def _table_categories(panel: "xr.Dataset") -> list[Category]:
    """Return the categories of one panel's attractors, the most frequent by name."""
    occupied = panel.isel(attractor=panel["starts"].values > 0)
    words = [str(word) for word in occupied["label"].values]
    categories = []
    for n, colour in enumerate(table_colours(words)[:MOST_NAMED]):
        entry, word = occupied.isel(attractor=n), words[n]
        if word == "aperiodic":
            word += f" within {float(entry['periods_run']):g} periods"
        power = f", $P$ = {EngFormatter('J', places=2)(float(entry['P']))}" if entry["P"] > 0 else ""
        categories.append(Category(colour, f"{_share(entry['fraction'])} {word}{power}"))
    rest = occupied["fraction"].values[MOST_NAMED:]
    return [*categories, Category(OTHERS, f"{_share(rest.sum())} {rest.size} others")] if rest.size else categories


def _list_categories(where: Figure | Axes, categories: list[Category], **place: Any) -> None:
    handles = [Patch(facecolor=kind.colour, edgecolor="0.3", linewidth=0.4) for kind in categories]
    texts = [kind.text for kind in categories]
    where.legend(handles, texts, frameon=False, handlelength=1.2, fontsize="small", **place)


def _share(part: Any) -> str:
    return f"{100 * float(part):.3g} %"
