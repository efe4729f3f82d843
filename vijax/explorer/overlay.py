"""Curves of bifurcations over the map of a page: validation, the drawn parts, and the curves that cross a cell."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.continuation.curves.curve_table import CURVE_VARIABLES, NumberedPoint
from vijax.explorer.plane import Axis, ExploredPlane
from vijax.maps.storage.store import load
from vijax.plots.curve_lines import KINDS, CurvePiece, curve_pieces, misfit, placed_points
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

CURVES = ("shown", "unstable", "hidden")
"""Choices of displayed curves: "shown", only parts that border stable orbits; "unstable", all parts; "hidden", none."""


@dataclass(frozen=True)
class ExploredCurves:
    """Curves that are drawn over a map.

    Attributes:
        dataset: Result of `curve_dataset`.
        path: Path of the store of the curves; None if the user passed a dataset.
    """

    dataset: "xr.Dataset"
    path: Path | None

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of curves in the dataset, in the order of `KINDS`."""
        present = set(map(str, self.dataset["kind"].values))
        return tuple(kind for kind in KINDS if kind in present)


@dataclass(frozen=True)
class DrawnCurves:
    """Curves that a page draws, and a note about curves that it cannot draw.

    Attributes:
        pieces, points: Pieces of curves and codimension-2 points; their coordinates are the map's x and y axes.
        note: Reason why the curves do not belong to the shown part of the map and are not drawn; "" if they do.
    """

    pieces: tuple[CurvePiece, ...] = ()
    points: tuple[NumberedPoint, ...] = ()
    note: str = ""


def read_curves(curves: Any) -> ExploredCurves:
    """Return curves from the result of `curve_dataset` or from the path of its store.

    Raises:
        ValueError, OSError: The curves cannot be read or are invalid.
    """
    path = Path(curves) if isinstance(curves, str | Path) and str(curves) else None
    try:
        dataset = curves if path is None else load(path)
    except (ValueError, OSError) as error:
        hint = "; give the store that vijax curves wrote beside it" if path and path.suffix == ".csv" else ""
        raise type(error)(f"curves: {error}{hint}") from None
    validation.validate_dataset("curves", dataset, CURVE_VARIABLES, "vijax.curve_dataset")
    if len(str(dataset.attrs.get("along", "")).split()) != 2:
        raise ValueError(
            "curves must have the attribute along with two axes, as vijax.curve_dataset writes it; got none"
        )
    for kind in map(str, dataset["kind"].values):
        validation.validate_choice("curves", kind, tuple(KINDS), "these are the kinds that this version draws")
    return ExploredCurves(dataset, path)


def check(curves: ExploredCurves, plane: ExploredPlane, store: Path | None) -> None:
    """Raise ValueError unless the curves have the axes and constants of the map; `store` is the map's path or None."""
    unequal = misfit(curves.dataset, plane.dataset, (plane.x.name, plane.y.name))
    if unequal is not None:
        command = f"vijax curves --map {store}" if store else "vijax.bifurcation_curves"
        raise ValueError(
            f"curves must have the {unequal.name} of the map, {unequal.of_map}; got {unequal.of_curves}; "
            f"compute them with {command}"
        )


def select_curves(curves: ExploredCurves, plane: ExploredPlane, map_part: "xr.Dataset", display: str) -> DrawnCurves:
    """Return the curves to draw over the shown part of a map; only a note if the curves have other constants.

    Args:
        curves: All curves.
        plane: The map.
        map_part: The map at the shown values of its further axes.
        display: One of `CURVES`.
    """
    axes = plane.x.name, plane.y.name
    unequal = misfit(curves.dataset, map_part, axes)
    if unequal is not None:
        return DrawnCurves(
            note=f"The curves are not drawn: their {unequal.name} is {unequal.of_curves}, here it is {unequal.of_map}."
        )
    if display == "hidden":
        return DrawnCurves()
    points = [point for point in placed_points(curves.dataset, *axes) if _within(point.parameters, plane)]
    return DrawnCurves(tuple(curve_pieces(curves.dataset, *axes, display == "unstable")), tuple(points))


def through(curves: DrawnCurves, plane: ExploredPlane, pick: tuple[int, int]) -> list[str]:
    """Return the names of the curves that cross a cell, such as "fold of 1:1"."""
    sides = [_scaled(axis, axis.edges[index : index + 2]) for axis, index in zip((plane.x, plane.y), pick, strict=True)]
    names = {
        f"{piece.kind} of {piece.label}": None
        for piece in curves.pieces
        if _crosses(_scaled(plane.x, piece.x), _scaled(plane.y, piece.y), *sides)
    }
    return list(names)


def _within(point: tuple[float, float], plane: ExploredPlane) -> bool:
    return all(axis.edges[0] <= value <= axis.edges[-1] for axis, value in zip((plane.x, plane.y), point, strict=True))


def _scaled(axis: Axis, values: np.ndarray) -> np.ndarray:
    """Return values on the scale of an axis; there, cells are rectangles and pieces of curves are polylines."""
    return np.log(values) if axis.scale == "log" else values


def _crosses(x: np.ndarray, y: np.ndarray, across: np.ndarray, up: np.ndarray) -> bool:
    """Return True if a polyline enters a rectangle.

    Every segment is clipped at the four sides of the rectangle, by the algorithm of Liang and Barsky.

    Args:
        x, y: Points of the polyline.
        across, up: Lowest and highest x, and lowest and highest y, of the rectangle.
    """
    # Points of a segment are start + fraction * step with fraction in [0, 1]. For each side, `margin` is the distance
    # of the segment's start from the side, positive inside; `outward` is the step's component along the outer normal.
    # The fractions from `begin` to `end` lie inside all sides.
    begin, end = np.zeros(x.size - 1), np.ones(x.size - 1)
    for coordinate, (low, high) in ((x, across), (y, up)):
        step = np.diff(coordinate)
        for outward, margin in ((-step, coordinate[:-1] - low), (step, high - coordinate[:-1])):
            with np.errstate(divide="ignore", invalid="ignore"):
                fraction = margin / outward
            begin = np.where(outward < 0, np.maximum(begin, fraction), begin)
            end = np.where(outward > 0, np.minimum(end, fraction), end)
            # `end` = -1 marks a segment as outside: it is parallel to this side and outside of it, or a point is NaN.
            end = np.where(((outward == 0) & (margin < 0)) | np.isnan(margin + outward), -1.0, end)
    return bool((begin <= end).any())
