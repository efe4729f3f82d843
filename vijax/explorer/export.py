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
        found: The map and the variable that it shows, the cell and its motion, or what a panel was computed to.
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


def _map(dataset: Any, name: str) -> Any:
    if name == "label":
        return label_map(dataset)
    if name == "P" and set(NEEDS) <= set(map(str, dataset.data_vars)):
        return power_map(dataset)
    return variable_map(dataset, name)


def _motion(cell: ExploredCell, found: CellMotion) -> Any:
    periods = max(_PERIODS, int(found.span / 2))
    return motion_figure(cell.pair, trajectory(cell.pair, *found.end, periods=periods))
