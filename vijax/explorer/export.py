"""Writes pictures of a page's contents in the style of `vijax.plots`: PDF, SVG or PNG."""

import base64
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vijax.explorer.analyses.motion import CellMotion
from vijax.explorer.plane import ExploredCell
from vijax.plots.branch_diagrams import branches
from vijax.plots.curve_maps import curves
from vijax.plots.figure import save
from vijax.plots.kind_maps import basins, label_map
from vijax.plots.motions import trajectory as motion_figure
from vijax.plots.number_maps import power_map, variable_map
from vijax.plots.orbit_diagrams import orbit_diagram
from vijax.plots.style import NEEDS
from vijax.runtime import validation
from vijax.simulation.trajectory import trajectory

FORMATS = ("pdf", "svg", "png")
_PERIODS = 4  # least number of forcing periods in the picture of a motion


def picture(panel: str, content: Any, extension: str) -> str:
    """Draw the contents of one panel, and return the file in base 64.

    Args:
        panel: "map", "motion", "line", "basin" or "branch".
        content: Result that is drawn. For "map": dataset, variable, curves or None, and whether unstable parts of
            curves are drawn. For "motion": the cell and its motion. For any other panel: the result of its computation.
        extension: One of `FORMATS`.

    Raises:
        ValueError: The extension is not among `FORMATS`, or the motion has no impact and therefore no picture.
    """
    validation.validate_choice("format", extension, FORMATS)
    draw: dict[str, Callable[[], Any]] = {
        "map": lambda: _map(*content),
        "motion": lambda: _motion(*content),
        "line": lambda: orbit_diagram(content.dataset),
        "basin": lambda: basins(content.dataset),
        "branch": lambda: branches(content.dataset),
    }
    validation.validate_choice("panel", panel, tuple(draw))
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"{panel}.{extension}"
        save(draw[panel](), file)
        return base64.b64encode(file.read_bytes()).decode()


def map_function(dataset: Any, name: str) -> str:
    """Return the name of the `vijax.plots` function that draws a variable of a map."""
    if name == "label":
        return "label_map"
    return "power_map" if name == "P" and set(NEEDS) <= set(map(str, dataset.data_vars)) else "variable_map"


def _map(dataset: Any, name: str, curve_dataset: Any, unstable: bool) -> Any:
    if curve_dataset is not None:
        return curves(curve_dataset, dataset, ground=name, unstable=unstable)
    function = map_function(dataset, name)
    if function == "variable_map":
        return variable_map(dataset, name)
    return label_map(dataset) if function == "label_map" else power_map(dataset)


def _motion(cell: ExploredCell, motion: CellMotion) -> Any:
    periods = max(_PERIODS, int(motion.span / 2))
    return motion_figure(cell.pair, trajectory(cell.pair, *motion.end, periods=periods))
