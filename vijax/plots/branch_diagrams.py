"""Pictures of branches of periodic orbits: stable, unstable, and what they met on the way."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vijax.model.quantities import BRANCH_QUANTITIES
from vijax.plots.figure import styled
from vijax.plots.style import QUANTITIES, axis_label, title
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr


_MARKS = {"fold": "o", "flip": "s", "pitchfork": "^", "grazing": "x"}
_STABLE, _UNSTABLE = "black", "red"


@styled
def branches(dataset: "xr.Dataset", quantity: str = "v_in") -> Figure:
    """Draw branches of orbits over their parameter: stable black, unstable red, with what they met on the way.

    Args:
        dataset: What `vijax.branch_dataset` returned.
        quantity: A variable over impacts, or over points.

    Raises:
        ValueError: A quantity that is none.
    """
    check_branch_quantity(quantity)
    checks.variables("dataset", dataset, (quantity, "stable", "event", "side"), "vijax.orbits.branch_dataset.dataset")
    along = dataset[dataset.attrs["along"]]
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for index in range(dataset.sizes["branch"]):
        one = dataset.isel(branch=index)
        for colour, width, kept in ((_UNSTABLE, 0.8, 0.0), (_STABLE, 1.4, 1.0)):
            # A segment belongs to the point it leads to, so that the two colours join.
            shown = (one["stable"] == kept) | (one["stable"].shift(point=-1) == kept)
            for piece in pieces(one, quantity):
                lines = one[quantity].where(shown).isel(point=piece)
                axes.plot(one[along.name].isel(point=piece), lines, color=colour, linewidth=width)
        _mark_events(axes, one, quantity)
    axes.set_xlabel(axis_label(along))
    axes.set_ylabel(QUANTITIES[quantity])
    axes.set_title(title(dataset), fontsize="medium")
    kinds = {str(kind).split()[0] for kind in dataset["event"].values.flat if kind}
    legend = [Line2D([], [], color=_STABLE, label="stable"), Line2D([], [], color=_UNSTABLE, label="unstable")]
    legend += [_mark(kind, label=kind) for kind in _MARKS if kind in kinds]
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    return figure


def pieces(one: "xr.Dataset", quantity: str) -> list[np.ndarray]:
    """Part the points of a branch at grazes, where an impact more or fewer moves the others to other columns."""
    if "impact" not in one[quantity].dims:
        return [np.arange(one.sizes["point"])]
    count = (np.abs(one["side"].values) == 1).sum(axis=1)
    return np.split(np.arange(count.size), np.flatnonzero(np.diff(count)) + 1)


def check_branch_quantity(quantity: str) -> None:
    """Raise ValueError unless branches have the quantity."""
    checks.choice("quantity", quantity, BRANCH_QUANTITIES)


def _mark(kind: str, label: str | None = None) -> Line2D:
    mark = Line2D([], [], linestyle="none", marker=_MARKS[kind], markersize=5, color="tab:blue", label=label)
    mark.set_markerfacecolor("white")
    return mark


def _mark_events(axes: Axes, one: "xr.Dataset", quantity: str) -> None:
    """Mark what one branch met, on the curves of its quantity."""
    values = one[quantity].values.reshape(one.sizes["point"], -1)
    events = (one["event"].values, one["event_value"].values, one["event_point"].values)
    for kind, value, place in zip(*events, strict=True):
        if kind:
            mark = _mark(str(kind).split()[0])
            mark.set_data(np.full(values.shape[1], value), values[int(place)])
            axes.add_line(mark)
