"""Pictures of the response to a non-periodic excitation: penetrations, impact speeds, and the time in each basin."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.plots.figure import styled
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

_NEEDS = ("speed_density", "speed_quantile", "penetration_density", "penetration_quantile")
_SIZES = {"penetration": (1e3, "greatest penetration [mm]"), "impact_speed": (1.0, "impact speed [m/s]")}
_MOST = 6  # most attractors drawn, in the order of the time spent on them


@styled
def response(dataset: "xr.Dataset") -> Figure:
    """Draw the result of `vijax.response`: densities of penetration and impact speed, and the visited attractors.

    Densities have a logarithmic scale, so that the tail is visible, and their standard errors. Dotted lines are the
    quantiles; one impact in a thousand exceeds the last quantile. Bars are the fraction of time in each basin.

    Args:
        dataset: Result of `vijax.response`.

    Raises:
        ValueError: The argument is another dataset.
    """
    validation.validate_dataset("dataset", dataset, _NEEDS, "vijax.response")
    visited = "time_share" in dataset
    figure = Figure(figsize=(7.6 if visited else 5.4, 2.7), layout="constrained")
    axes = figure.subplots(1, 2 + visited, squeeze=False)[0]
    for panel, (axis, (factor, text)) in zip(axes, _SIZES.items(), strict=False):
        _density(panel, dataset, axis, factor, text)
    if visited:
        _attractors(axes[-1], dataset)
    return figure


def _density(axes: Axes, dataset: "xr.Dataset", axis: str, factor: float, text: str) -> None:
    quantity = axis.removeprefix("impact_")
    middle = dataset[axis].values * factor
    density, error = (dataset[f"{quantity}_density{end}"].values / factor for end in ("", "_stderr"))
    positive = density > 0
    axes.errorbar(
        middle[positive], density[positive], error[positive], fmt=".", color="black", markersize=3, elinewidth=0.6
    )
    for quantile, value in zip(
        dataset["quantile"].values, dataset[f"{quantity}_quantile"].values * factor, strict=True
    ):
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
    if positive.any():
        axes.set(yscale="log", ylim=(density[positive].min() / 3, density[positive].max() * 10))
    else:
        axes.annotate("no impact", (0.5, 0.5), xycoords="axes fraction", ha="center", va="center")


def _attractors(axes: Axes, dataset: "xr.Dataset") -> None:
    longest = dataset.isel(attractor=slice(_MOST))
    names = [str(name) or "undecided" for name in longest["label"].values]
    place = np.arange(len(names))[::-1]
    axes.barh(place, longest["time_share"].values, xerr=longest["time_share_stderr"].values, color="0.75", height=0.6)
    for y, share, residence_time in zip(
        place, longest["time_share"].values, longest["time_until_lost"].values, strict=True
    ):
        residence_text = f"{residence_time:.3g} periods" if np.isfinite(residence_time) else "never left"
        axes.annotate(
            residence_text, (share, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize="x-small"
        )
    axes.set_yticks(place, names)
    axes.set(xlabel="part of the time", xlim=(0, 1.45 * float(longest["time_share"].max())))
