"""The view of a page (variable, cell, sliders, panels), and the query string of an address that restores the view."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

from vijax.explorer.overlay import CURVES
from vijax.explorer.plane import ExploredPlane
from vijax.maps.map_dataset import best
from vijax.model.quantities import AXES
from vijax.runtime import validation

SCALES = ("auto", "log", "linear")
PANELS = ("basin", "branch", "optimum")
"""Panels that are computed when the user opens them; the address of the page contains the open panels."""

_QUERY_NAMES = ("variable", "scale", "cell", "along", "open", "follow", "curves", "token")
# Bounds of the sliders: |v0| in units of A pi/omega, and |gamma| or |beta| (in rad), unless the map's value is larger.
_MOST_SPEED, _MOST_TILT = 1.5, 0.35


@dataclass(frozen=True)
class View:
    """The view of a map on a page.

    Attributes:
        variable: The coloured variable of the map, or "label".
        scale: Scale of its colours, one of `SCALES`.
        pick: Column and row of the picked cell.
        values: Values of the sliders that the user has moved, by axis name; an axis of the map other than the two drawn
            ones has a slider too.
        along: The map's axis along which the line and the branch are computed.
        panels: The open panels among `PANELS`.
        follow: Whether the motion of a newly picked cell starts from the final state of the previous cell's motion.
        curves: Display of curves, one of `CURVES`.
    """

    variable: str
    scale: str
    pick: tuple[int, int]
    values: Mapping[str, float] = field(default_factory=dict)
    along: str = ""
    panels: tuple[str, ...] = ()
    follow: bool = False
    curves: str = CURVES[0]


def first_view(plane: ExploredPlane) -> View:
    """Return the first view of a page: the first variable, P if the map has it, and a picked cell.

    The cell is that with the largest admissible P or, if no cell is admissible, the cell in the middle.
    """
    columns, rows = plane.shape
    pick = columns // 2, rows // 2
    map_part = plane.sliced({})
    if {"P", "admissible"} <= set(map(str, map_part.data_vars)):
        peak = best(map_part)
        if peak is not None:
            pick = plane.x.nearest(float(peak[plane.x.name])), plane.y.nearest(float(peak[plane.y.name]))
    return View(plane.variables[0], "auto", pick, along=_axis_names(plane)[-1])


def _axis_names(plane: ExploredPlane) -> tuple[str, str]:
    return plane.x.name, plane.y.name


def bounds(plane: ExploredPlane) -> dict[str, tuple[float, float]]:
    """Return the bounds of every slider, by axis name. They prevent views with parameters that run without end."""
    limits_by_name = {}
    for name, value in plane.fixed.items():
        if name == "r":
            limits_by_name[name] = (0.05, 1.0)
        elif name in ("gamma", "beta"):
            limits_by_name[name] = (min(-_MOST_TILT, value), max(_MOST_TILT, value))
        elif name not in ("u0", "v0"):
            limits_by_name[name] = (0.5 * value, 2.0 * value)
    half = 0.5 * float(plane.dataset["d"].max())
    starts = {"u0": (-half, half), "v0": (-_MOST_SPEED, _MOST_SPEED)}
    limits_by_name |= {name: limits for name, limits in starts.items() if name not in _axis_names(plane)}
    return limits_by_name | {name: (float(axis.min()), float(axis.max())) for name, axis in plane.further.items()}


def query(view: View) -> str:
    """Return the query string of a view."""
    parts = {"variable": view.variable, "scale": view.scale, "cell": f"{view.pick[0]},{view.pick[1]}"}
    parts |= {"along": view.along, "open": ",".join(view.panels), "follow": "1" if view.follow else ""}
    parts |= {"curves": "" if view.curves == CURVES[0] else view.curves}
    numbers = {name: repr(float(value)) for name, value in view.values.items()}
    return urlencode({name: text for name, text in (parts | numbers).items() if text})


def from_query(plane: ExploredPlane, arguments: Mapping[str, str]) -> View:
    """Return the view that the query of an address specifies; entries that are missing are taken from `first_view`.

    Raises:
        ValueError: An entry of the query is invalid for this map.
    """
    start = first_view(plane)
    for name in arguments:
        if name not in _QUERY_NAMES and name not in bounds(plane):
            raise ValueError(f"address must name what this map has; got {validation.value_text(name)}")
    return View(
        variable=validation.validate_choice("variable", arguments.get("variable", start.variable), plane.variables),
        scale=validation.validate_choice("scale", arguments.get("scale", start.scale), SCALES),
        pick=_pick(plane, arguments["cell"]) if "cell" in arguments else start.pick,
        values=validated_values(plane, {name: text for name, text in arguments.items() if name in AXES}),
        along=validation.validate_choice("along", arguments.get("along", start.along), _axis_names(plane)),
        panels=tuple(
            validation.validate_choice("open", panel, PANELS) for panel in arguments.get("open", "").split(",") if panel
        ),
        follow=arguments.get("follow") == "1",
        curves=validation.validate_choice("curves", arguments.get("curves", start.curves), CURVES),
    )


def validated_values(plane: ExploredPlane, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of sliders as floats, after validation that each lies within its `bounds`.

    Raises:
        ValueError: A value is outside its bounds, or no number.
    """
    numbers = {}
    for name, (low, high) in bounds(plane).items():
        if name in values:
            try:
                number = float(values[name])
            except (OverflowError, TypeError, ValueError):
                number = math.nan
            if not low <= number <= high:
                got = validation.value_text(values[name])
                raise ValueError(f"{name} must lie between {low:.6g} and {high:.6g} on this page; got {got}")
            numbers[name] = number
    return numbers


def _pick(plane: ExploredPlane, text: str) -> tuple[int, int]:
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        column = row = -1
    columns, rows = plane.shape
    if not (0 <= column < columns and 0 <= row < rows):
        raise ValueError(
            f"cell must be column,row of a map of {columns} x {rows} cells; got {validation.value_text(text)}"
        )
    return column, row


def read_integer(message: Mapping[str, Any], name: str) -> int:
    """Return an integer entry of a message of the browser's script; 0 if the entry is absent.

    Raises:
        ValueError: The entry is not an integer.
    """
    entry = message.get(name, 0)
    if isinstance(entry, float) and entry.is_integer():
        return int(entry)
    if not isinstance(entry, int):
        raise ValueError(f"{name} must be a whole number; got {validation.value_text(entry)}")
    return entry
