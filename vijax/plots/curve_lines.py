"""Curves of bifurcations in numbers: their lines, their points and their kinds, for whatever draws them.

`curve_maps` draws them by matplotlib, a page in the browser by itself.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.colors import to_hex

from vijax.orbits.curve_rows import NumberedPoint, numbered_points

if TYPE_CHECKING:
    import xarray as xr

# Kinds of curves: told apart by their dashes too, as a paper may be printed in black.
KINDS: dict[str, dict[str, Any]] = {
    "fold": {"color": "tab:red"},
    "flip": {"color": "tab:blue", "dashes": (5, 1.2)},
    "pitchfork": {"color": "black"},
    "grazing": {"color": "tab:green", "dashes": (1.6, 1.0)},
    "grazing contact": {"color": "tab:olive", "dashes": (1.6, 1.0)},
    "penetration limit": {"color": "tab:purple", "dashes": (6, 1.2, 1.2, 1.2)},
    "energy limit": {"color": "tab:orange", "dashes": (6, 1.2, 1.2, 1.2)},
}
"""How each is drawn, in the words of matplotlib; dashes in widths of the line."""

FAINT = 0.35
"""Opacity of what is met by unstable orbits alone."""

_EQUAL = 1e-9  # parts within which a constant of two datasets is the same: both were written from one number


class CurvePiece(NamedTuple):
    """What is drawn alike of a curve, by its number: points across and up, NaN across where it is drawn otherwise."""

    curve: int
    kind: str
    label: str
    stable: bool
    x: np.ndarray
    y: np.ndarray


class CurveMisfit(NamedTuple):
    """In what curves are not of a map, and what either has of it."""

    what: str
    of_curves: str
    of_map: str


def curve_pieces(dataset: "xr.Dataset", x: str, y: str, unstable: bool) -> Iterator[CurvePiece]:
    """Yield every curve: where stable orbits border on it and, if wanted, where only unstable ones do."""
    for index in range(dataset.sizes["curve"]):
        one = dataset.isel(curve=index)
        kind, label, stable = str(one["kind"].item()), str(one["label"].item()), one["stable"].values == 1
        across, up = one[x].values, one[y].values
        for shown, strong in ((stable, True), (~stable & unstable, False)):
            if (shown & np.isfinite(across)).any():
                yield CurvePiece(index, kind, label, strong, np.where(shown, across, np.nan), up)


def placed_points(dataset: "xr.Dataset", x: str, y: str) -> list[NumberedPoint]:
    """List the points of codimension 2 as `numbered_points` does, each place across first."""
    turned = dataset.attrs["along"].split() != [x, y]
    return [one._replace(place=one.place[::-1]) if turned else one for one in numbered_points(dataset)]


def screen_style(kind: str) -> tuple[str, tuple[float, ...]]:
    """Give the colour of a kind as hexadecimal digits after a hash, and its dashes; none is a solid line."""
    return to_hex(KINDS[kind]["color"]), KINDS[kind].get("dashes", ())


def misfit(dataset: "xr.Dataset", over: "xr.Dataset", axes: tuple[str, ...]) -> CurveMisfit | None:
    """Find in what curves are not of a map; None where they are, as far as both tell.

    Args:
        dataset: What `vijax.curve_dataset` returned.
        over: The map. Of an axis that curves do not go along, one of its values has to be that of the curves.
        axes: That the map is drawn over.
    """
    along = dataset.attrs["along"].split()
    if set(along) != set(axes):
        return CurveMisfit("axes", " and ".join(along), " and ".join(axes))
    walls = [str(one.attrs.get("wall", "soft")) for one in (dataset, over)]
    if walls[0] != walls[1]:
        return CurveMisfit("wall", *walls)
    for name in ("d", "kappa", "r", "gamma"):
        if name in along or name not in dataset.coords or name not in over:
            continue
        own, values = float(dataset[name]), np.asarray(over[name].values, float)
        if not np.isclose(values, own, rtol=_EQUAL, atol=_EQUAL).any():
            low, high = float(values.min()), float(values.max())
            return CurveMisfit(name, f"{own:.6g}", f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}")
    return None
