"""The curves of bifurcations over the map of a page: whether they are of it, what is drawn, what lies in a cell."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.explorer.plane import Axis, ExploredPlane
from vijax.orbits.curve_rows import NEEDED, NumberedPoint
from vijax.planes.store import load
from vijax.plots.curve_lines import KINDS, CurvePiece, curve_pieces, misfit, placed_points
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

CURVES = ("shown", "unstable", "hidden")
"""What a page shows of curves: those on which stable orbits border, those of unstable orbits too, none."""


@dataclass(frozen=True)
class ExploredCurves:
    """Curves that are laid over a map.

    Attributes:
        dataset: What `curve_dataset` returned.
        path: Of its store, where it came from one.
    """

    dataset: "xr.Dataset"
    path: Path | None

    @property
    def kinds(self) -> tuple[str, ...]:
        """Name the kinds that there are."""
        there = set(map(str, self.dataset["kind"].values))
        return tuple(kind for kind in KINDS if kind in there)


@dataclass(frozen=True)
class LaidCurves:
    """What a page draws of curves, and says of them.

    Attributes:
        pieces, points: Across and up as the map has it.
        said: Why nothing is drawn of curves that are wanted; "" where they are of the map.
    """

    pieces: tuple[CurvePiece, ...] = ()
    points: tuple[NumberedPoint, ...] = ()
    said: str = ""


def taken(given: Any) -> ExploredCurves:
    """Take curves: what `curve_dataset` returned, or the path of a store of it.

    Raises:
        ValueError, OSError: What is wrong with them.
    """
    path = Path(given) if isinstance(given, str | Path) and str(given) else None
    try:
        dataset = given if path is None else load(path)
    except (ValueError, OSError) as error:
        hint = "; give the store that vijax curves wrote beside it" if path and path.suffix == ".csv" else ""
        raise type(error)(f"curves: {error}{hint}") from None
    checks.variables("curves", dataset, NEEDED, "vijax.curve_dataset")
    if len(str(dataset.attrs.get("along", "")).split()) != 2:
        raise ValueError("curves must say along which two axes they go, as vijax.curve_dataset does; got none")
    for kind in map(str, dataset["kind"].values):
        checks.choice("curves", kind, tuple(KINDS), "these are the kinds that this version draws")
    return ExploredCurves(dataset, path)


def check(curves: ExploredCurves, plane: ExploredPlane, store: Path | None) -> None:
    """Raise ValueError unless curves are of a map, which came from a store or not."""
    other = misfit(curves.dataset, plane.dataset, (plane.x.name, plane.y.name))
    if other is not None:
        how = f"vijax curves --map {store}" if store else "vijax.bifurcation_curves"
        raise ValueError(
            f"curves must have the {other.what} of the map, {other.of_map}; got {other.of_curves}; "
            f"its own are found by {how}"
        )


def laid(curves: ExploredCurves, plane: ExploredPlane, shown: "xr.Dataset", how: str) -> LaidCurves:
    """Lay curves over what a page shows of its map, where they are of that.

    Args:
        curves: All of them.
        plane: The map.
        shown: The part of it that is shown.
        how: One of `CURVES`.
    """
    axes = plane.x.name, plane.y.name
    other = misfit(curves.dataset, shown, axes)
    if other is not None:
        return LaidCurves(
            said=f"The curves are not drawn: their {other.what} is {other.of_curves}, here it is {other.of_map}."
        )
    if how == "hidden":
        return LaidCurves()
    points = [one for one in placed_points(curves.dataset, *axes) if _within(one.place, plane)]
    return LaidCurves(tuple(curve_pieces(curves.dataset, *axes, how == "unstable")), tuple(points))


def through(found: LaidCurves, plane: ExploredPlane, pick: tuple[int, int]) -> list[str]:
    """Name what passes through a cell: "fold of 1:1"."""
    sides = [_scaled(axis, axis.edges[at : at + 2]) for axis, at in zip((plane.x, plane.y), pick, strict=True)]
    named = {
        f"{one.kind} of {one.label}": None
        for one in found.pieces
        if _crosses(_scaled(plane.x, one.x), _scaled(plane.y, one.y), *sides)
    }
    return list(named)


def _within(place: tuple[float, float], plane: ExploredPlane) -> bool:
    return all(axis.edges[0] <= value <= axis.edges[-1] for axis, value in zip((plane.x, plane.y), place, strict=True))


def _scaled(axis: Axis, values: np.ndarray) -> np.ndarray:
    """Put values on the scale of an axis, where cells and pieces of curves are straight."""
    return np.log(values) if axis.scale == "log" else values


def _crosses(x: np.ndarray, y: np.ndarray, across: np.ndarray, up: np.ndarray) -> bool:
    """Tell whether a line of points enters a rectangle: each piece is cut off at its four sides (Liang and Barsky)."""
    begin, end = np.zeros(x.size - 1), np.ones(x.size - 1)
    for place, (low, high) in ((x, across), (y, up)):
        step = np.diff(place)
        for towards, room in ((-step, place[:-1] - low), (step, high - place[:-1])):
            with np.errstate(divide="ignore", invalid="ignore"):
                part = room / towards
            begin = np.where(towards < 0, np.maximum(begin, part), begin)
            end = np.where(towards > 0, np.minimum(end, part), end)
            # A piece along a side never comes nearer to it; what is NaN is no piece.
            end = np.where(((towards == 0) & (room < 0)) | np.isnan(room + towards), -1.0, end)
    return bool((begin <= end).any())
