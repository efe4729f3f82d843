"""The panels beside the motion: what each computes, and how it is drawn, told and reproduced."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vijax.explorer import answers, recipes
from vijax.explorer.basin import basin
from vijax.explorer.branch import branch
from vijax.explorer.drawing import Drawing
from vijax.explorer.line import line
from vijax.explorer.motion import CellMotion
from vijax.explorer.optimum import optima
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.recipes import Recipe
from vijax.explorer.worker import Tell, Worker


@dataclass(frozen=True)
class PanelRequest:
    """What a panel is computed from.

    Attributes:
        plane, cell, motion: The picked cell and what it does.
        axis: Along which line, branch and optimum go.
    """

    plane: ExploredPlane
    cell: ExploredCell
    motion: CellMotion
    axis: Axis


@dataclass(frozen=True)
class PanelKind:
    """One kind of panel.

    Attributes:
        work: Computes what it shows, in a thread or, by the worker that it is given, in a process.
        recipe: Says how that is had again.
        show: Draws it, and gives the text and the rows of its table.
        clear: Takes it off the figures.
    """

    work: Callable[[PanelRequest, Worker, Tell], Any]
    recipe: Callable[[PanelRequest], Recipe]
    show: Callable[[Drawing, PanelRequest, Any], tuple[str, answers.Rows]]
    clear: Callable[[Drawing], Any]


def _show_line(drawing: Drawing, asked: PanelRequest, found: Any) -> tuple[str, answers.Rows]:
    drawing.line(found)
    return answers.line_text(found), []


def _show_basin(drawing: Drawing, asked: PanelRequest, found: Any) -> tuple[str, answers.Rows]:
    return "", answers.basin_rows(found, drawing.basin(found))


def _show_branch(drawing: Drawing, asked: PanelRequest, found: Any) -> tuple[str, answers.Rows]:
    drawing.branch(found)
    return answers.branch_text(found), answers.branch_rows(found)


def _show_optimum(drawing: Drawing, asked: PanelRequest, found: Any) -> tuple[str, answers.Rows]:
    column, row = (asked.cell.arguments[axis.name] for axis in (asked.plane.x, asked.plane.y))
    along_x = asked.axis.name == asked.plane.x.name
    drawing.optima([(one.value, row) if along_x else (column, one.value) for one in found])
    if not found:
        return "No admissible periodic motion was found along this axis.", []
    return "Orange diamonds on the map, the nearest first.", answers.optimum_rows(asked.axis, found)


PANEL_KINDS = {
    "line": PanelKind(
        lambda asked, worker, tell: line(asked.cell, asked.axis, tell),
        lambda asked: recipes.of_line(asked.cell, asked.axis),
        _show_line,
        lambda drawing: None,  # it stays until the next one is there, as a pick that is dragged moves along it
    ),
    "basin": PanelKind(
        lambda asked, worker, tell: basin(asked.cell, tell),
        lambda asked: recipes.of_basin(asked.cell),
        _show_basin,
        lambda drawing: drawing.basin(None),
    ),
    "branch": PanelKind(
        lambda asked, worker, tell: worker.run(branch, (asked.cell, asked.motion, asked.axis), tell),
        lambda asked: recipes.of_branch(asked.cell, asked.motion, asked.axis),
        _show_branch,
        lambda drawing: drawing.branch(None),
    ),
    "optimum": PanelKind(
        lambda asked, worker, tell: worker.run(optima, (asked.cell, asked.axis), tell),
        lambda asked: recipes.of_optimum(asked.cell, asked.axis),
        _show_optimum,
        lambda drawing: drawing.optima([]),
    ),
}
"""The panels by their names, in the order of the page."""
