"""Fills the tables of a page with results: a cell's motion, its line, its basins, its branch, the map."""

from typing import Any

import numpy as np

from vijax.explorer.analyses.basin import CellBasin
from vijax.explorer.analyses.branch import CellBranch
from vijax.explorer.analyses.line import CellLine
from vijax.explorer.analyses.motion import CellMotion
from vijax.explorer.figures import PageFigures, PageTables, Walls, mapper
from vijax.explorer.overlay import DrawnCurves
from vijax.explorer.plane import Axis, ExploredPlane
from vijax.plots.cell_colours import ColouredMap, attractor_colours
from vijax.plots.cells import runs
from vijax.plots.curve_lines import FAINT

MOST_PIXELS = 1024
"""Most pixels of a map along an axis; if a map has more cells, each pixel shows the cell at its position."""


class Drawing:
    """The tables and figures of one page; every method draws one result.

    Attributes:
        tables: Result of `figures.tables`.
        figures, walls, bar: Result of `figures.figures`: the figures, their movable lines and the colour bar.
    """

    def __init__(self, tables: PageTables, figures: PageFigures, walls: Walls, bar: Any) -> None:
        self.tables, self.figures, self.walls, self.bar = tables, figures, walls, bar

    def map(self, plane: ExploredPlane, coloured: ColouredMap) -> None:
        """Draw the colours of a map, its marks and its colour bar."""
        tables = self.tables
        tables.cells.data = _image(_pixels(plane, coloured.colours), plane.x, plane.y)
        tables.veil.data = _veil(plane, coloured.veiled)
        tables.border.data = dict(zip(("x0", "y0", "x1", "y1"), coloured.segments.T, strict=True))
        tables.dots.data = dict(zip("xy", coloured.dots, strict=True))
        tables.crosses.data = dict(zip("xy", coloured.crosses, strict=True))
        tables.star.data = _points([] if coloured.star is None else [coloured.star])
        self.bar.visible = coloured.span is not None
        if coloured.span is not None:
            self.bar.color_mapper = mapper(coloured.span, coloured.log, coloured.palette)

    def curves(self, curves: DrawnCurves) -> None:
        """Draw curves over the map; segments that only unstable orbits border are faint and have no white edge."""
        tables, pieces = self.tables, curves.pieces
        tables.curves.data = {
            "xs": [item.x for item in pieces],
            "ys": [item.y for item in pieces],
            "kind": [item.kind for item in pieces],
            "label": [item.label for item in pieces],
            "width": [_STRONG if item.stable else _WEAK for item in pieces],
            "alpha": [1.0 if item.stable else FAINT for item in pieces],
            "edge": [float(item.stable) for item in pieces],
        }
        tables.points.data = _points([item.parameters for item in curves.points]) | {
            "number": [str(item.number) for item in curves.points]
        }

    def pick(self, x: float, y: float) -> None:
        """Move the crosshair to a cell."""
        if self.tables.pick.data == {"x": [x], "y": [y]}:
            return  # the page's script has already moved the crosshair at the click
        self.tables.pick.data = {"x": [x], "y": [y]}
        self.walls.across.location, self.walls.up.location = x, y

    def stand(self, position: float) -> None:
        """Move the marks of the cell's axis value in the two figures of the line and of the branch."""
        self.walls.line.location = self.walls.branch.location = position

    def motion(self, motion: CellMotion) -> None:
        """Draw the phase plane, the displacement over time and the energies of the impacts."""
        tables, half = self.tables, motion.half
        tables.course.data = {"t": motion.t, "x": motion.u, "v": motion.v}
        # A membrane follows the ball while the ball touches it, and is drawn at rest at u = -d/2 or d/2 otherwise.
        tables.membranes.data = {
            "t": motion.t,
            "left": np.minimum(motion.u, -half),
            "right": np.maximum(motion.u, half),
        }
        impacts = motion.impacts
        tables.impacts.data = {"t": impacts["t"], "x": impacts["u"], "v": impacts["v"]}
        admissible, inadmissible = impacts["admissible"] == 1, impacts["admissible"] == 0
        energy_columns = {
            "transferred": (impacts["transferred"] > 0, "transferred"),
            "harvested": (admissible, "harvested"),
            "inadmissible": (inadmissible, "harvested"),
        }
        energies = np.concatenate([impacts["transferred"], impacts["harvested"]]) * _MICRO
        for name, (positive, column) in energy_columns.items():
            # The energy axis is logarithmic, so that only positive energies can be drawn.
            positive = positive & (impacts[column] > 0)
            getattr(tables, name).data = {"x": impacts["t"][positive], "y": _MICRO * impacts[column][positive]}
        for walls in (self.walls.phase, self.walls.course):
            walls[0].location, walls[1].location = -half, half
        figures = self.figures
        figures.course.x_range.update(start=0.0, end=motion.span)
        _span(figures.phase.x_range, [motion.u, [-half, half]])
        _span(figures.phase.y_range, [motion.v])
        _span(figures.course.y_range, [motion.u, [-half, half]])
        _decades(figures.energy.y_range, energies[energies > 0])

    def line(self, line: CellLine) -> None:
        """Draw the orbit diagram along the line through the cell."""
        tables = self.tables
        tables.rising.data = dict(zip("xy", line.rising, strict=True))
        tables.falling.data = dict(zip("xy", line.falling, strict=True))
        _span(self.figures.line.y_range, [line.rising[1], line.falling[1]])

    def visited(self, points: list[tuple[float, float]]) -> None:
        """Draw points (axis value, impact velocity): the impacts of the cells that a dragged pick has passed."""
        self.tables.visited.data = _points(points)

    def basin(self, basin: CellBasin | None) -> list[str]:
        """Draw the basins of a cell and return the colours of its attractors; for None, clear the figure."""
        if basin is None:
            self.tables.basin.data = {name: [] for name in ("image", "x", "y", "dw", "dh")}
            return []
        colours = attractor_colours(basin.labels)
        colour_bytes = np.array([[*bytes.fromhex(colour[1:]), 255] for colour in colours], np.uint8)
        # Bokeh expects each pixel as one 32-bit number: red, green, blue and opacity, a byte each.
        image = colour_bytes[basin.place].view(np.uint32)[..., 0]
        across, up = (float(axis[-1] - axis[0]) for axis in (basin.u0, basin.v0))
        self.figures.basin.x_range.update(start=float(basin.u0[0]), end=float(basin.u0[-1]))
        self.figures.basin.y_range.update(start=float(basin.v0[0]), end=float(basin.v0[-1]))
        corner = {"x": [float(basin.u0[0])], "y": [float(basin.v0[0])], "dw": [across], "dh": [up]}
        self.tables.basin.data = {"image": [image], **corner}
        return colours

    def branch(self, branch: CellBranch | None) -> None:
        """Draw branches and events, stable parts thick and black, unstable ones thin and red; for None, clear them."""
        tables = self.tables
        rows: dict[float, dict[str, list[Any]]] = {stability: {"xs": [], "ys": []} for stability in (0.0, 1.0)}
        for values, speeds, stable in () if branch is None else branch.lines:
            for stability, row in rows.items():
                # A segment has the colour of its last point, so that the lines of both colours meet without a gap.
                selected = (stable == stability) | np.append(stable[1:] == stability, False)
                row["xs"].append(np.where(selected, values, np.nan))
                row["ys"].append(np.where(selected, speeds, np.nan))
        tables.unstable.data, tables.stable.data = rows[0.0], rows[1.0]
        if branch is not None:
            _span(self.figures.branch.y_range, [speeds for _, speeds, _ in branch.lines])
        events = () if branch is None else branch.events
        kinds, x, y = zip(*events, strict=True) if events else ((), (), ())
        tables.events.data = {"x": list(x), "y": list(y), "kind": list(kinds)}

    def optima(self, places: list[tuple[float, float]]) -> None:
        """Mark optima on the map at the points (x, y)."""
        self.tables.optima.data = _points(places)


_STRONG, _WEAK = 1.8, 1.2  # widths in pixels of curves that stable and that only unstable orbits border
_MICRO = 1e6  # energies are drawn in microjoules


def _span(axis_range: Any, values: list[Any]) -> None:
    """Set a range of a figure to the finite values, with a margin of 7 % of their span at each end."""
    flat = np.concatenate([np.ravel(part) for part in values])
    flat = flat[np.isfinite(flat)]
    if flat.size:
        low, high = float(flat.min()), float(flat.max())
        margin = 0.07 * (high - low) or 0.1 * max(abs(high), 1e-3)
        axis_range.update(start=low - margin, end=high + margin)


def _decades(axis_range: Any, values: np.ndarray) -> None:
    """Set a logarithmic range to the values; each margin is 1/5 of their logarithmic span, at least a factor of 1.6."""
    if values.size:
        margin = max((float(values.max()) / float(values.min())) ** 0.2, 1.6)
        axis_range.update(start=float(values.min()) / margin, end=float(values.max()) * margin)


def _points(places: list[tuple[float, float]]) -> dict[str, list[Any]]:
    return {"x": [x for x, _ in places], "y": [y for _, y in places]}


def _places(axis: Axis) -> np.ndarray:
    """Return the index of the cell that each pixel shows along an axis.

    Pixels are evenly spaced on the scale of the axis; cells may be unevenly spaced, or more than `MOST_PIXELS`.
    """
    count = axis.values.size
    if axis.even and count <= MOST_PIXELS:
        return np.arange(count)
    low, high = axis.edges[0], axis.edges[-1]
    pixels = min(MOST_PIXELS, 8 * count)
    fractions = (np.arange(pixels) + 0.5) / pixels
    positions = low * (high / low) ** fractions if axis.scale == "log" else low + (high - low) * fractions
    return np.clip(np.searchsorted(axis.edges, positions) - 1, 0, count - 1)


def _pixels(plane: ExploredPlane, colours: np.ndarray) -> np.ndarray:
    sampled = np.ascontiguousarray(colours[np.ix_(_places(plane.y), _places(plane.x))])
    return sampled.view(np.uint32)[..., 0]


def _image(pixels: np.ndarray, x: Axis, y: Axis) -> dict[str, list[Any]]:
    low = {"x": [float(x.edges[0])], "y": [float(y.edges[0])]}
    spans = {"dw": [float(x.edges[-1] - x.edges[0])], "dh": [float(y.edges[-1] - y.edges[0])]}
    return {"image": [pixels], **low, **spans}


def _veil(plane: ExploredPlane, veiled: np.ndarray) -> dict[str, np.ndarray]:
    """Return rectangles that cover the veiled cells; equal runs of columns in successive rows share one rectangle."""
    # First row of every rectangle that may still grow, by (first column, column after the last).
    open_runs: dict[tuple[int, int], int] = {}
    rectangles = []
    for row in range(veiled.shape[0] + 1):
        current = {(int(a), int(b)) for a, b in runs(veiled[row])} if row < veiled.shape[0] else set()
        ended = [run for run in open_runs if run not in current]
        rectangles += [(*run, open_runs.pop(run), row) for run in ended]
        for run in current:
            open_runs.setdefault(run, row)
    table = np.array(rectangles, int).reshape(-1, 4)
    x, y = plane.x.edges, plane.y.edges
    return {"left": x[table[:, 0]], "right": x[table[:, 1]], "bottom": y[table[:, 2]], "top": y[table[:, 3]]}
