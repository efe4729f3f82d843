"""Pictures of the response to a rough excitation: how deep impacts go, how fast they are, where the time is spent."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.plots.figure import styled
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

_NEEDS = ("speed_density", "speed_quantile", "penetration_density", "penetration_quantile")
_SIZES = {"penetration": (1e3, "greatest penetration [mm]"), "impact_speed": (1.0, "impact speed [m/s]")}
_MOST = 6  # attractors that are drawn, the ones visited longest


@styled
def response(dataset: "xr.Dataset") -> Figure:
    """Draw what `vijax.response` found: densities of penetration and impact speed, and the attractors visited.

    Densities are on a logarithmic scale, so that the tail is seen, with their standard errors; dotted lines are the
    quantiles, of which the last is passed by one impact in a thousand. Bars are the part of the time that is spent in
    each basin.

    Args:
        dataset: As `vijax.response` returns it.

    Raises:
        ValueError: Another dataset.
    """
    checks.variables("dataset", dataset, _NEEDS, "vijax.response")
    visited = "time_share" in dataset
    figure = Figure(figsize=(7.6 if visited else 5.4, 2.7), layout="constrained")
    axes = figure.subplots(1, 2 + visited, squeeze=False)[0]
    for where, (axis, (factor, text)) in zip(axes, _SIZES.items(), strict=False):
        _density(where, dataset, axis, factor, text)
    if visited:
        _attractors(axes[-1], dataset)
    return figure


def _density(axes: Axes, dataset: "xr.Dataset", axis: str, factor: float, text: str) -> None:
    of = axis.removeprefix("impact_")
    middle = dataset[axis].values * factor
    density, error = (dataset[f"{of}_density{end}"].values / factor for end in ("", "_stderr"))
    seen = density > 0
    axes.errorbar(middle[seen], density[seen], error[seen], fmt=".", color="black", markersize=3, elinewidth=0.6)
    for quantile, value in zip(dataset["quantile"].values, dataset[f"{of}_quantile"].values * factor, strict=True):
        if np.isnan(value):
            continue
        axes.axvline(value, color="tab:red", linestyle=":", linewidth=0.8)
        axes.annotate(
            f"{quantile:g}",
            (value, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(-1, -2),
            textcoords="offset points",
            rotation=90,
            ha="right",
            va="top",
            fontsize="x-small",
            color="tab:red",
        )
    axes.set(xlabel=text, ylabel="probability density", xlim=(0, None))
    if seen.any():
        axes.set(yscale="log", ylim=(density[seen].min() / 3, density[seen].max() * 10))
    else:
        axes.annotate("no impact", (0.5, 0.5), xycoords="axes fraction", ha="center", va="center")


def _attractors(axes: Axes, dataset: "xr.Dataset") -> None:
    first = dataset.isel(attractor=slice(_MOST))
    names = [str(name) or "undecided" for name in first["label"].values]
    place = np.arange(len(names))[::-1]
    axes.barh(place, first["time_share"].values, xerr=first["time_share_stderr"].values, color="0.75", height=0.6)
    for y, share, stay in zip(place, first["time_share"].values, first["time_until_lost"].values, strict=True):
        told = f"{stay:.3g} periods" if np.isfinite(stay) else "never left"
        axes.annotate(told, (share, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize="x-small")
    axes.set_yticks(place, names)
    axes.set(xlabel="part of the time", xlim=(0, 1.45 * float(first["time_share"].max())))
