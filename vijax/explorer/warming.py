"""Compiles what a page will ask for before somebody asks, so that the first click answers as quickly as the others."""

import logging
from dataclasses import dataclass

import numpy as np

from vijax.explorer.basin import basin
from vijax.explorer.branch import branch
from vijax.explorer.jobs import Crew
from vijax.explorer.line import line
from vijax.explorer.motion import MOST_IMPACTS, motion
from vijax.explorer.plane import ExploredPlane, cell
from vijax.explorer.source import Source
from vijax.explorer.view import first_view
from vijax.runtime.tiles import padded

_LOG = logging.getLogger(__name__)


@dataclass
class Warmth:
    """What is being compiled, in words; "" when all is.

    Attributes:
        said: The words.
    """

    said: str = "compiling"


def warm(source: Source, crew: Crew, warmth: Warmth) -> None:
    """Run a cell of every size of orbit, then a line, a basin and a branch; whatever fails will tell its page."""
    try:
        plane = source.plane()
        picks = samples(plane)
        cells = [cell(plane, pick, {}) for pick in picks]
        motions = []
        for number, one in enumerate(cells):
            warmth.said = f"compiling: motions, {number} of {len(cells)}"
            motions.append(motion(one))
        given = [(one, found, plane.y) for one, found in zip(cells, motions, strict=True)]
        warmth.said = "compiling: lines"
        line(cells[0], plane.y, lambda done, total: None)
        warmth.said = "compiling: basins"
        basin(cells[0], lambda done, total: None)
        simple = next((i for i, found in enumerate(motions) if found.orbit is not None), None)
        if simple is not None:
            crew.submit("branch", lambda: crew.worker("branch").run(branch, given[simple], lambda done, total: None))
    except Exception:  # a page that asks for the same says it to whoever looks at it
        _LOG.debug("warming ended", exc_info=True)
    warmth.said = ""


def samples(plane: ExploredPlane) -> list[tuple[int, int]]:
    """Find a cell for every size that orbits are padded to, as each has programs of its own, and one that is flown."""
    names = ("period", "impacts_left", "impacts_right")
    if not set(names) <= set(map(str, plane.dataset.data_vars)):
        return [first_view(plane).pick]
    like = plane.sliced({}).transpose(plane.y.name, plane.x.name, ...)
    period, left, right = (like[name].broadcast_like(like["status"]).values for name in names)
    count = left + right
    solved = (period > 0) & (count > 0) & (count <= MOST_IMPACTS)
    sizes = np.where(solved, [[padded(int(one)) for one in row] for row in count], -1)
    found = []
    for size in np.unique(sizes):
        row, column = np.argwhere(sizes == size)[0][:2]
        found.append((int(column), int(row)))
    return found
