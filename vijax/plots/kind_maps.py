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
from vijax.model.pair import symmetric
from vijax.plots.cells import edges, numbered, panels
from vijax.plots.figure import styled
from vijax.plots.style import LABEL_NEEDS, layout_of_kinds, title
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# Of kinds: so many by name, in these colours; strong ones first, their pale sisters after them, without the greys.
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
    """One colour of a map of kinds, and what it means."""

    colour: Any
    text: str


@styled
def label_map(dataset: "xr.Dataset") -> Figure:
    """Draw the plane coloured by attractor, n:m/pT; aperiodic cells are shaded by their Lyapunov exponent.

    The commonest labels have a colour and a name each, the others are one group. Without gravity mirror images count as
    one, by the smaller count first. Aperiodic means: without a period within the periods that were run.

    Args:
        dataset: A map with `period`, `impacts_left`, `impacts_right` and `status`, and with `lyapunov` for shades;
            dimensions as in `power_map`, two at least.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, LABEL_NEEDS, "sweep")
    return coded(*of_labels(dataset))


def of_labels(dataset: "xr.Dataset") -> "tuple[xr.Dataset, list[Category]]":
    """Turn labels into places among categories: the commonest by name, the others, and what is no orbit."""
    period = dataset["period"]
    # Another excitation than the sine need not be its own opposite half a period later; walls may have laws each.
    alike = "excitation" not in dataset.attrs and not dataset.attrs.get("membrane", "").startswith("left ")
    level = (symmetric(dataset) & alike).broadcast_like(period).transpose(*period.dims)
    words = label(*(dataset[name].values for name in LABEL_NEEDS), merge_mirrors=level.values)
    codes, categories = _named(words, int(dataset.attrs["periods"]))
    drawn = dataset[["lyapunov"] if "lyapunov" in dataset else []].assign(
        code=(period.dims, codes), aperiodic=period == 0
    )
    return drawn.assign_attrs(dataset.attrs), categories


@styled
def basin_map(dataset: "xr.Dataset") -> Figure:
    """Draw the (u0, v0) plane coloured by the attractor on which each start ends, with a table of them beside it.

    Args:
        dataset: What `basins` returned for arrays u0 and v0; further axes make panels, each with a table of its own.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("basin", "label", "fraction", "P"), "basins")
    further = [dim for dim in dataset["P"].dims if dim not in (*dataset["basin"].dims, "attractor")]
    dataset = dataset.isel(dict.fromkeys(further, 0))
    drawn = dataset.assign(code=dataset["basin"].clip(max=MOST_NAMED)).drop_vars("basin")
    return coded(drawn, None)


@styled
def multistability_map(dataset: "xr.Dataset") -> Figure:
    """Draw the plane of parameters coloured by the number of coexisting attractors.

    Args:
        dataset: What `basin_fractions` returned; dimensions as in `power_map`, two at least.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("attractors",), "basin_fractions")
    number = dataset["attractors"]
    most = int(number.max())
    shades = mpl.colormaps["viridis_r"](np.linspace(0, 1, most + 1))
    shades[0] = to_rgba(NO_ORBIT["undecided"])
    texts = ["undecided", "1 attractor", *(f"{n} attractors" for n in range(2, most + 1))]
    categories = [
        Category(tuple(shade), f"{_share((number == n).mean())} {text}")
        for n, (shade, text) in enumerate(zip(shades, texts[: most + 1], strict=True))
    ]
    drawn = dataset[[]].assign(code=number).assign_attrs(dataset.attrs)
    return coded(drawn, categories)


def basins(dataset: "xr.Dataset") -> Figure:
    """Draw coexisting attractors: `basin_map` of what `basins` returned, `multistability_map` of `basin_fractions`.

    Raises:
        ValueError: As `power_map`.
    """
    checks.variables("dataset", dataset, ("attractors",), "basins")
    return (multistability_map if "start" in dataset.sizes else basin_map)(dataset)


def of_flags(dataset: "xr.Dataset", name: str) -> "tuple[xr.Dataset, list[Category]]":
    """Turn a variable of flags into places among categories, those that occur."""
    variable = dataset[name]
    if variable.dtype == bool:
        words = {0: "no", 1: "yes"}
    else:
        words = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    found = sorted(flag for flag in words if (variable == flag).any())
    codes = np.searchsorted(found, variable.values.astype(int))
    shares = [f"{_share((variable.values == flag).mean())} {words[flag].replace('_', ' ')}" for flag in found]
    categories = [Category(colour, text) for colour, text in zip(COLOURS, shares, strict=False)]
    return dataset[[]].assign(code=variable.copy(data=codes)).assign_attrs(dataset.attrs), categories


def coded(dataset: "xr.Dataset", categories: list[Category] | None) -> Figure:
    """Draw kinds by their places `code` among the categories; those of every panel's own table if there are none.

    Where it is `aperiodic`, the Lyapunov exponent shades it.
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
    # Centred it would run into a list of categories beside the map.
    place = {} if categories is None else {"x": 0.02, "ha": "left"}
    figure.suptitle(title(dataset), fontsize="medium", **place)
    return figure


def _shade(figure: Figure, dataset: "xr.Dataset", filled: "list[tuple[Axes, xr.Dataset]]", dims: list[str]) -> None:
    """Shade aperiodic cells in greys, the darker the faster they forget their start."""
    exponents = dataset["lyapunov"].where(dataset["aperiodic"])
    scale = Normalize(0.0, float(exponents.max()))
    for axes, panel in filled:
        across, up = (edges(panel[dim].values)[0] for dim in dims[:2])
        shown = np.ma.masked_invalid(panel["lyapunov"].where(panel["aperiodic"]).values)
        mesh = axes.pcolormesh(across, up, shown, cmap=_GREYS, norm=scale, rasterized=True)
    figure.colorbar(mesh, ax=figure.axes, location="bottom", aspect=40, label="Lyapunov exponent per forcing period")


def _named(words: np.ndarray, periods: int) -> tuple[np.ndarray, list[Category]]:
    """Place every word among the categories, and name these: the commonest labels, the others, and what is no orbit."""
    kinds, which, counts = np.unique(words, return_inverse=True, return_counts=True)
    orbits = [place for place in np.argsort(-counts, kind="stable") if kinds[place] not in NO_ORBIT]
    ranked = [[place] for place in orbits[:MOST_NAMED]] + [orbits[MOST_NAMED:]]
    colours = [*COLOURS[: len(ranked) - 1], OTHERS]
    texts = [str(kinds[place[0]]) for place in ranked[:-1]] + [f"{len(ranked[-1])} other labels"]
    for word, colour in NO_ORBIT.items():
        ranked.append(list(np.flatnonzero(kinds == word)))
        colours.append(colour)
        texts.append(f"aperiodic within {periods} periods" if word == "aperiodic" else word)
    shown = [n for n, places in enumerate(ranked) if places]
    codes = np.empty(kinds.size, int)
    for code, n in enumerate(shown):
        codes[ranked[n]] = code
    categories = [Category(colours[n], f"{_share(counts[ranked[n]].sum() / words.size)} {texts[n]}") for n in shown]
    return codes[which].reshape(words.shape), categories


def table_colours(labels: Sequence[str]) -> list[Any]:
    """Give the colours of attractors by their place in a table; those beyond the named ones have one."""
    strong = iter(COLOURS)
    named = [NO_ORBIT[word] if word in NO_ORBIT else next(strong) for word in labels[:MOST_NAMED]]
    return [*named, *[OTHERS] * (len(labels) - len(named))]


def _table_categories(panel: "xr.Dataset") -> list[Category]:
    """Name the attractors of one table, the commonest by name."""
    found = panel.isel(attractor=panel["starts"].values > 0)
    words = [str(word) for word in found["label"].values]
    categories = []
    for n, colour in enumerate(table_colours(words)[:MOST_NAMED]):
        entry, word = found.isel(attractor=n), words[n]
        if word == "aperiodic":
            word += f" within {float(entry['periods_run']):g} periods"
        power = f", $P$ = {EngFormatter('J', places=2)(float(entry['P']))}" if entry["P"] > 0 else ""
        categories.append(Category(colour, f"{_share(entry['fraction'])} {word}{power}"))
    rest = found["fraction"].values[MOST_NAMED:]
    return [*categories, Category(OTHERS, f"{_share(rest.sum())} {rest.size} others")] if rest.size else categories


def _list_categories(where: Figure | Axes, categories: list[Category], **place: Any) -> None:
    handles = [Patch(facecolor=kind.colour, edgecolor="0.3", linewidth=0.4) for kind in categories]
    texts = [kind.text for kind in categories]
    where.legend(handles, texts, frameon=False, handlelength=1.2, fontsize="small", **place)


def _share(part: Any) -> str:
    return f"{100 * float(part):.3g} %"
