"""Curves of bifurcations in numbers: their lines, points and kinds, independent of how they are drawn.

`curve_maps` draws them by matplotlib, and the explorer's page by Bokeh.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.colors import to_hex

from vijax.continuation.curves.curve_table import NumberedPoint, numbered_points

if TYPE_CHECKING:
    import xarray as xr

# Kinds of curves; dashes distinguish them in a black-and-white print as well.
KINDS: dict[str, dict[str, Any]] = {
    "fold": {"color": "tab:red"},
    "flip": {"color": "tab:blue", "dashes": (5, 1.2)},
    "pitchfork": {"color": "black"},
    "grazing": {"color": "tab:green", "dashes": (1.6, 1.0)},
    "grazing contact": {"color": "tab:olive", "dashes": (1.6, 1.0)},
    "penetration limit": {"color": "tab:purple", "dashes": (6, 1.2, 1.2, 1.2)},
    "energy limit": {"color": "tab:orange", "dashes": (6, 1.2, 1.2, 1.2)},
}
"""Style of each kind, as matplotlib's keyword arguments; dashes are in widths of the line."""

FAINT = 0.35
"""Opacity of parts that only unstable orbits border."""

_EQUAL = 1e-9  # constants with at most this relative difference are equal, because both were written from one number


class CurvePiece(NamedTuple):
    """Part of a curve in one style, with the index of the curve; x is NaN at points outside of the part."""

    curve: int
    kind: str
    label: str
    stable: bool
    x: np.ndarray
    y: np.ndarray


class CurveMisfit(NamedTuple):
    """A quantity in which the curves and a map differ, with both values as text."""

    name: str
    of_curves: str
    of_map: str


def curve_pieces(dataset: "xr.Dataset", x: str, y: str, unstable: bool) -> Iterator[CurvePiece]:
    """Yield the parts of every curve that bound regions of stable orbits; with `unstable`, all other parts too."""
    for index in range(dataset.sizes["curve"]):
        curve = dataset.isel(curve=index)
        kind, label, stable = str(curve["kind"].item()), str(curve["label"].item()), curve["stable"].values == 1
        across, up = curve[x].values, curve[y].values
        for selected, is_stable in ((stable, True), (~stable & unstable, False)):
            if (selected & np.isfinite(across)).any():
                yield CurvePiece(index, kind, label, is_stable, np.where(selected, across, np.nan), up)


def placed_points(dataset: "xr.Dataset", x: str, y: str) -> list[NumberedPoint]:
    """Return the points of codimension 2 of `numbered_points`, with the parameter of the horizontal axis first."""
    swapped = dataset.attrs["along"].split() != [x, y]
    return [
        point._replace(parameters=point.parameters[::-1]) if swapped else point for point in numbered_points(dataset)
    ]


def screen_style(kind: str) -> tuple[str, tuple[float, ...]]:
    """Return the colour of a kind as hexadecimal digits after a hash, and its dashes; no dashes mean a solid line."""
    return to_hex(KINDS[kind]["color"]), KINDS[kind].get("dashes", ())


def misfit(dataset: "xr.Dataset", over: "xr.Dataset", axes: tuple[str, ...]) -> CurveMisfit | None:
    """Return the first difference between the constants of curves and of a map; None if there is no difference.

    Args:
        dataset: Result of `vijax.curve_dataset`.
        over: The map. If it has a further axis, one of the axis' values must equal the value of the curves.
        axes: The axes over which the map is drawn.
    """
    along = dataset.attrs["along"].split()
    if set(along) != set(axes):
        return CurveMisfit("axes", " and ".join(along), " and ".join(axes))
    walls = [str(item.attrs.get("wall", "soft")) for item in (dataset, over)]
    if walls[0] != walls[1]:
        return CurveMisfit("wall", *walls)
    for name in ("d", "kappa", "r", "gamma"):
        # A constant that either dataset lacks cannot be compared.
        if name in along or name not in dataset.coords or name not in over:
            continue
        curve_value, values = float(dataset[name]), np.asarray(over[name].values, float)
        if not np.isclose(values, curve_value, rtol=_EQUAL, atol=_EQUAL).any():
            low, high = float(values.min()), float(values.max())
            return CurveMisfit(name, f"{curve_value:.6g}", f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}")
    return None
