"""All panels except that of the motion: line, basin, branch and optima.

For each panel, functions compute its result, draw and describe it, and return the code that reproduces it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vijax.explorer.analyses import recipes, results
from vijax.explorer.analyses.basin import basin
from vijax.explorer.analyses.branch import branch
from vijax.explorer.analyses.line import line
from vijax.explorer.analyses.motion import CellMotion
from vijax.explorer.analyses.optimum import optima
from vijax.explorer.analyses.recipes import Recipe
from vijax.explorer.drawing import Drawing
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.server.worker import ProgressCallback, Worker


@dataclass(frozen=True)
class PanelRequest:
    """Input of a panel's computation.

    Attributes:
        plane, cell, motion: The map, the picked cell and its motion.
        axis: Axis along which the line, the branch and the optima are computed.
    """

    plane: ExploredPlane
    cell: ExploredCell
    motion: CellMotion
    axis: Axis


@dataclass(frozen=True)
class PanelKind:
    """One kind of panel.

    Attributes:
        work: Computes the result, in the calling thread or in the process of the given worker.
        recipe: Returns the code that reproduces the panel.
        show: Draws the result, and returns the panel's text and the rows of its table.
        clear: Removes the result from the figures.
    """

    work: Callable[[PanelRequest, Worker, ProgressCallback], Any]
    recipe: Callable[[PanelRequest], Recipe]
    show: Callable[[Drawing, PanelRequest, Any], tuple[str, results.Rows]]
    clear: Callable[[Drawing], Any]


def _show_line(drawing: Drawing, request: PanelRequest, diagram: Any) -> tuple[str, results.Rows]:
    drawing.line(diagram)
    return results.line_text(diagram), []


def _show_basin(drawing: Drawing, request: PanelRequest, cell_basin: Any) -> tuple[str, results.Rows]:
    return "", results.basin_rows(cell_basin, drawing.basin(cell_basin))


def _show_branch(drawing: Drawing, request: PanelRequest, cell_branch: Any) -> tuple[str, results.Rows]:
    drawing.branch(cell_branch)
    return results.branch_text(cell_branch), results.branch_rows(cell_branch)


def _show_optimum(drawing: Drawing, request: PanelRequest, optima_list: Any) -> tuple[str, results.Rows]:
    column, row = (request.cell.arguments[axis.name] for axis in (request.plane.x, request.plane.y))
    along_x = request.axis.name == request.plane.x.name
    drawing.optima([(item.value, row) if along_x else (column, item.value) for item in optima_list])
    if not optima_list:
        return "No admissible periodic motion was found along this axis.", []
    return "Orange diamonds on the map, the nearest first.", results.optimum_rows(request.axis, optima_list)


PANEL_KINDS = {
    "line": PanelKind(
        lambda request, worker, report: line(request.cell, request.axis, report),
        lambda request: recipes.of_line(request.cell, request.axis),
        _show_line,
        lambda drawing: None,  # the line stays while the user drags the pick along it; the next line replaces it
    ),
    "basin": PanelKind(
        lambda request, worker, report: basin(request.cell, report),
        lambda request: recipes.of_basin(request.cell),
        _show_basin,
        lambda drawing: drawing.basin(None),
    ),
    "branch": PanelKind(
        lambda request, worker, report: worker.run(branch, (request.cell, request.motion, request.axis), report),
        lambda request: recipes.of_branch(request.cell, request.motion, request.axis),
        _show_branch,
        lambda drawing: drawing.branch(None),
    ),
    "optimum": PanelKind(
        lambda request, worker, report: worker.run(optima, (request.cell, request.axis), report),
        lambda request: recipes.of_optimum(request.cell, request.axis),
        _show_optimum,
        lambda drawing: drawing.optima([]),
    ),
}
"""Kinds of panels by name, in the order of the page."""
