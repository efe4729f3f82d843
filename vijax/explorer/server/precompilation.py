"""Compiles the programs of a page ahead of the first request, so that the first click is as fast as later ones."""

import logging
from dataclasses import dataclass

import numpy as np

from vijax.explorer.analyses.basin import basin
from vijax.explorer.analyses.branch import branch
from vijax.explorer.analyses.line import line
from vijax.explorer.analyses.motion import MOST_IMPACTS, motion
from vijax.explorer.plane import ExploredPlane, cell
from vijax.explorer.server.jobs import JobThreads
from vijax.explorer.source import Source
from vijax.explorer.view import first_view
from vijax.runtime.tiles import padded

_LOG = logging.getLogger(__name__)


@dataclass
class CompilationState:
    """State of the precompilation.

    Attributes:
        text: The current stage, in words for the page; "" when the precompilation has ended.
    """

    text: str = "compiling"


def precompile(source: Source, threads: JobThreads, compilation: CompilationState) -> None:
    """Compile the programs of a page by running them: a cell per padded number of impacts, a line, a basin, a branch.

    Errors are ignored, because a page that requests the same computation shows the error.
    """
    try:
        plane = source.plane()
        picks = sample_picks(plane)
        cells = [cell(plane, pick, {}) for pick in picks]
        motions = []
        for number, picked_cell in enumerate(cells):
            compilation.text = f"compiling: motions, {number} of {len(cells)}"
            motions.append(motion(picked_cell))
        branch_arguments = [
            (picked_cell, cell_motion, plane.y) for picked_cell, cell_motion in zip(cells, motions, strict=True)
        ]
        compilation.text = "compiling: lines"
        line(cells[0], plane.y, lambda done, total: None)
        compilation.text = "compiling: basins"
        basin(cells[0], lambda done, total: None)
        simple = next((i for i, cell_motion in enumerate(motions) if cell_motion.orbit is not None), None)
        if simple is not None:
            threads.submit(
                "branch",
                lambda: threads.worker("branch").run(branch, branch_arguments[simple], lambda done, total: None),
            )
    except Exception:  # a page that requests the same computation shows the error
        _LOG.debug("precompilation ended", exc_info=True)
    compilation.text = ""


def sample_picks(plane: ExploredPlane) -> list[tuple[int, int]]:
    """Return (column, row) of one cell for every program of motions that the map needs.

    Orbits are padded to a few sizes, and every padded number of impacts has its own programs. One more cell, if the map
    has any, has a motion that is simulated because it is not periodic, has no impact or has too many impacts.
    """
    names = ("period", "impacts_left", "impacts_right")
    if not set(names) <= set(map(str, plane.dataset.data_vars)):
        return [first_view(plane).pick]
    map_part = plane.sliced({}).transpose(plane.y.name, plane.x.name, ...)
    period, left, right = (map_part[name].broadcast_like(map_part["status"]).values for name in names)
    count = left + right
    solved = (period > 0) & (count > 0) & (count <= MOST_IMPACTS)
    sizes = np.where(solved, [[padded(int(impacts)) for impacts in row] for row in count], -1)
    picks = []
    for size in np.unique(sizes):
        row, column = np.argwhere(sizes == size)[0][:2]
        picks.append((int(column), int(row)))
    return picks
