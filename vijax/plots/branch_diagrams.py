"""Pictures of branches of periodic orbits: stable and unstable parts, with the events on the branches."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vijax.model.quantities import BRANCH_QUANTITIES
from vijax.plots.figure import styled
from vijax.plots.style import QUANTITIES, axis_label, title
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr


_EVENT_MARKERS = {"fold": "o", "flip": "s", "pitchfork": "^", "grazing": "x"}
_STABLE, _UNSTABLE = "black", "red"


@styled
def branches(dataset: "xr.Dataset", quantity: str = "v_in") -> Figure:
    """Draw branches of orbits over their parameter: stable parts black, unstable parts red, with their events.

    Args:
        dataset: Result of `vijax.branch_dataset`.
        quantity: A variable over impacts, or over points.

    Raises:
        ValueError: The quantity is not a branch quantity.
    """
    check_branch_quantity(quantity)
    validation.validate_dataset(
        "dataset", dataset, (quantity, "stable", "event", "side"), "vijax.continuation.branch_dataset.branch_dataset"
    )
    along = dataset[dataset.attrs["along"]]
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for index in range(dataset.sizes["branch"]):
        branch = dataset.isel(branch=index)
        for colour, width, stability in ((_UNSTABLE, 0.8, 0.0), (_STABLE, 1.4, 1.0)):
            # A segment has the stability of the point at its end, so that the two colours join without a hole.
            selected = (branch["stable"] == stability) | (branch["stable"].shift(point=-1) == stability)
            for piece in pieces(branch, quantity):
                lines = branch[quantity].where(selected).isel(point=piece)
                axes.plot(branch[along.name].isel(point=piece), lines, color=colour, linewidth=width)
        _mark_events(axes, branch, quantity)
    axes.set_xlabel(axis_label(along))
    axes.set_ylabel(QUANTITIES[quantity])
    axes.set_title(title(dataset), fontsize="medium")
    kinds = {str(kind).split()[0] for kind in dataset["event"].values.flat if kind}
    legend = [Line2D([], [], color=_STABLE, label="stable"), Line2D([], [], color=_UNSTABLE, label="unstable")]
    legend += [_event_marker(kind, label=kind) for kind in _EVENT_MARKERS if kind in kinds]
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    return figure


def pieces(branch: "xr.Dataset", quantity: str) -> list[np.ndarray]:
    """Split the points of a branch at grazings, because a gained or lost impact shifts the columns of other impacts."""
    if "impact" not in branch[quantity].dims:
        return [np.arange(branch.sizes["point"])]
    count = (np.abs(branch["side"].values) == 1).sum(axis=1)
    return np.split(np.arange(count.size), np.flatnonzero(np.diff(count)) + 1)


def check_branch_quantity(quantity: str) -> None:
    """Raise ValueError unless the quantity is a variable of branches."""
    validation.validate_choice("quantity", quantity, BRANCH_QUANTITIES)


def _event_marker(kind: str, label: str | None = None) -> Line2D:
    mark = Line2D([], [], linestyle="none", marker=_EVENT_MARKERS[kind], markersize=5, color="tab:blue", label=label)
    mark.set_markerfacecolor("white")
    return mark


def _mark_events(axes: Axes, branch: "xr.Dataset", quantity: str) -> None:
    """Mark the events of one branch on the curves of its quantity."""
    values = branch[quantity].values.reshape(branch.sizes["point"], -1)
    events = (branch["event"].values, branch["event_value"].values, branch["event_point"].values)
    for kind, value, point in zip(*events, strict=True):
        if kind:
            mark = _event_marker(str(kind).split()[0])
            mark.set_data(np.full(values.shape[1], value), values[int(point)])
            axes.add_line(mark)
