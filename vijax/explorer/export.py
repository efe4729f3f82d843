"""Pictures of what a page shows, in the style of `vijax.plots`: PDF, SVG or PNG."""

import base64
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vijax.batch.trajectory import trajectory
from vijax.explorer.motion import CellMotion
from vijax.explorer.plane import ExploredCell
from vijax.plots.branch_diagrams import branches
from vijax.plots.curve_maps import curves
from vijax.plots.figure import save
from vijax.plots.kind_maps import basins, label_map
from vijax.plots.motions import trajectory as motion_figure
from vijax.plots.number_maps import power_map, variable_map
from vijax.plots.orbit_diagrams import orbit_diagram
from vijax.plots.style import NEEDS
from vijax.runtime import checks

FORMATS = ("pdf", "svg", "png")
_PERIODS = 4  # forcing periods of a motion in its picture, at least


def picture(what: str, found: Any, ending: str) -> str:
    """Draw what a page shows and give the file, in base 64.

    Args:
        what: "map", "motion", "line", "basin" or "branch".
        found: The map, what it shows and its curves, the cell and its motion, or what a panel was computed to.
        ending: Of `FORMATS`.

    Raises:
        ValueError: Another format, or what has no picture: a motion that meets no wall.
    """
    checks.choice("format", ending, FORMATS)
    draw: dict[str, Callable[[], Any]] = {
        "map": lambda: _map(*found),
        "motion": lambda: _motion(*found),
        "line": lambda: orbit_diagram(found.dataset),
        "basin": lambda: basins(found.dataset),
        "branch": lambda: branches(found.dataset),
    }
    checks.choice("what", what, tuple(draw))
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"{what}.{ending}"
        save(draw[what](), file)
        return base64.b64encode(file.read_bytes()).decode()


def map_function(dataset: Any, name: str) -> str:
    """Name the function of `vijax.plots` that draws a variable of a map."""
    if name == "label":
        return "label_map"
    return "power_map" if name == "P" and set(NEEDS) <= set(map(str, dataset.data_vars)) else "variable_map"


def _map(dataset: Any, name: str, over: Any, unstable: bool) -> Any:
    if over is not None:
        return curves(over, dataset, ground=name, unstable=unstable)
    drawn = map_function(dataset, name)
    if drawn == "variable_map":
        return variable_map(dataset, name)
    return label_map(dataset) if drawn == "label_map" else power_map(dataset)


def _motion(cell: ExploredCell, found: CellMotion) -> Any:
    periods = max(_PERIODS, int(found.span / 2))
    return motion_figure(cell.pair, trajectory(cell.pair, *found.end, periods=periods))
