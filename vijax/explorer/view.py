"""What a page shows, as a frozen record, and how it stands in the address: a view is restored by its address alone."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

from vijax.explorer.overlay import CURVES
from vijax.explorer.plane import ExploredPlane
from vijax.model.quantities import AXES
from vijax.planes.dataset import best
from vijax.runtime import checks

SCALES = ("auto", "log", "linear")
PANELS = ("basin", "branch", "optimum")
"""What is computed on demand, and opened again by the address of a view."""

_KNOWN = ("variable", "scale", "cell", "along", "open", "follow", "curves", "token")
# Speed of a start in units of A pi/omega, and inclination in radians, up to which sliders go.
_MOST_SPEED, _MOST_TILT = 1.5, 0.35


@dataclass(frozen=True)
class View:
    """All that a page shows of a map.

    Attributes:
        variable: What is coloured, a variable of the map or "label".
        scale: Of its colours, one of `SCALES`.
        pick: Column and row of the cell.
        values: Of sliders that were moved, and of further axes, by the names of axes.
        along: The axis of the map along which line and branch go.
        panels: Of `PANELS`, those that are open.
        follow: Whether a picked motion starts where the last one ended.
        curves: What is shown of curves, one of `CURVES`.
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
    """Give the view that a page opens with: P, and the cell that yields most of it or, without, the middle one."""
    columns, rows = plane.shape
    pick = columns // 2, rows // 2
    shown = plane.sliced({})
    if {"P", "admissible"} <= set(map(str, shown.data_vars)):
        peak = best(shown)
        if peak is not None:
            pick = plane.x.nearest(float(peak[plane.x.name])), plane.y.nearest(float(peak[plane.y.name]))
    return View(plane.variables[0], "auto", pick, along=_along(plane)[-1])


def _along(plane: ExploredPlane) -> tuple[str, str]:
    return plane.x.name, plane.y.name


def bounds(plane: ExploredPlane) -> dict[str, tuple[float, float]]:
    """Give the bounds of every value that can be moved: a view is never of a run without an end."""
    found = {}
    for name, value in plane.fixed.items():
        if name == "r":
            found[name] = (0.05, 1.0)
        elif name in ("gamma", "beta"):
            found[name] = (min(-_MOST_TILT, value), max(_MOST_TILT, value))
        elif name not in ("u0", "v0"):
            found[name] = (0.5 * value, 2.0 * value)
    half = 0.5 * float(plane.dataset["d"].max())
    starts = {"u0": (-half, half), "v0": (-_MOST_SPEED, _MOST_SPEED)}
    found |= {name: limits for name, limits in starts.items() if name not in _along(plane)}
    return found | {name: (float(axis.min()), float(axis.max())) for name, axis in plane.further.items()}


def query(view: View) -> str:
    """Write a view as the query of an address."""
    told = {"variable": view.variable, "scale": view.scale, "cell": f"{view.pick[0]},{view.pick[1]}"}
    told |= {"along": view.along, "open": ",".join(view.panels), "follow": "1" if view.follow else ""}
    told |= {"curves": "" if view.curves == CURVES[0] else view.curves}
    numbers = {name: repr(float(value)) for name, value in view.values.items()}
    return urlencode({name: text for name, text in (told | numbers).items() if text})


def from_query(plane: ExploredPlane, arguments: Mapping[str, str]) -> View:
    """Read a view from the query of an address; what it does not say is as `first_view` has it.

    Raises:
        ValueError: What an address cannot say.
    """
    start = first_view(plane)
    for name in arguments:
        if name not in _KNOWN and name not in bounds(plane):
            raise ValueError(f"address must name what this map has; got {checks.shown(name)}")
    return View(
        variable=checks.choice("variable", arguments.get("variable", start.variable), plane.variables),
        scale=checks.choice("scale", arguments.get("scale", start.scale), SCALES),
        pick=_pick(plane, arguments["cell"]) if "cell" in arguments else start.pick,
        values=checked(plane, {name: text for name, text in arguments.items() if name in AXES}),
        along=checks.choice("along", arguments.get("along", start.along), _along(plane)),
        panels=tuple(checks.choice("open", one, PANELS) for one in arguments.get("open", "").split(",") if one),
        follow=arguments.get("follow") == "1",
        curves=checks.choice("curves", arguments.get("curves", start.curves), CURVES),
    )


def checked(plane: ExploredPlane, values: Mapping[str, Any]) -> dict[str, float]:
    """Take values of sliders, each within its bounds, as `bounds` gives them.

    Raises:
        ValueError: A value beyond, or no number.
    """
    found = {}
    for name, (low, high) in bounds(plane).items():
        if name in values:
            try:
                number = float(values[name])
            except (OverflowError, TypeError, ValueError):
                number = math.nan
            if not low <= number <= high:
                got = checks.shown(values[name])
                raise ValueError(f"{name} must lie between {low:.6g} and {high:.6g} on this page; got {got}")
            found[name] = number
    return found


def _pick(plane: ExploredPlane, text: str) -> tuple[int, int]:
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        column = row = -1
    columns, rows = plane.shape
    if not (0 <= column < columns and 0 <= row < rows):
        raise ValueError(f"cell must be column,row of a map of {columns} x {rows} cells; got {checks.shown(text)}")
    return column, row


def whole(message: Mapping[str, Any], name: str) -> int:
    """Return a whole number of a message; 0 if it is left out.

    Raises:
        ValueError: Another number, or no number.
    """
    given = message.get(name, 0)
    if isinstance(given, float) and given.is_integer():
        return int(given)
    if not isinstance(given, int):
        raise ValueError(f"{name} must be a whole number; got {checks.shown(given)}")
    return given
