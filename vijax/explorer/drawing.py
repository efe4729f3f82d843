"""Fills the tables of a page with what was computed: a cell's motion, its line, its basins, its branch, the map."""

from typing import Any

import numpy as np

from vijax.explorer.basin import CellBasin
from vijax.explorer.branch import CellBranch
from vijax.explorer.figures import PageFigures, PageTables, Walls, mapper
from vijax.explorer.line import CellLine
from vijax.explorer.motion import CellMotion
from vijax.explorer.overlay import LaidCurves
from vijax.explorer.plane import Axis, ExploredPlane
from vijax.plots.cell_colours import ColouredMap, attractor_colours
from vijax.plots.cells import runs
from vijax.plots.curve_lines import FAINT

MOST_PIXELS = 1024
"""Colours of a map along an axis, at most: a larger map is shown by every so many-th cell."""


class Drawing:
    """The tables and figures of one page, and how each is filled.

    Attributes:
        tables, figures, walls, bar: As `figures.figures` made them.
    """

    def __init__(self, tables: PageTables, figures: PageFigures, walls: Walls, bar: Any) -> None:
        self.tables, self.figures, self.walls, self.bar = tables, figures, walls, bar

    def map(self, plane: ExploredPlane, found: ColouredMap) -> None:
        """Draw the colours and marks of a map."""
        of = self.tables
        of.cells.data = _image(_pixels(plane, found.colours), plane.x, plane.y)
        of.veil.data = _veil(plane, found.veiled)
        of.border.data = dict(zip(("x0", "y0", "x1", "y1"), found.segments.T, strict=True))
        of.dots.data = dict(zip("xy", found.dots, strict=True))
        of.crosses.data = dict(zip("xy", found.crosses, strict=True))
        of.star.data = _points([] if found.star is None else [found.star])
        self.bar.visible = found.span is not None
        if found.span is not None:
            self.bar.color_mapper = mapper(found.span, found.log, found.palette)

    def curves(self, found: LaidCurves) -> None:
        """Draw curves over the map: those of unstable orbits alone faintly, and without an edge."""
        of, pieces = self.tables, found.pieces
        of.curves.data = {
            "xs": [one.x for one in pieces],
            "ys": [one.y for one in pieces],
            "kind": [one.kind for one in pieces],
            "label": [one.label for one in pieces],
            "width": [_STRONG if one.stable else _WEAK for one in pieces],
            "alpha": [1.0 if one.stable else FAINT for one in pieces],
            "edge": [float(one.stable) for one in pieces],
        }
        of.points.data = _points([one.place for one in found.points]) | {
            "number": [str(one.number) for one in found.points]
        }

    def pick(self, x: float, y: float) -> None:
        """Move the crosshair."""
        if self.tables.pick.data == {"x": [x], "y": [y]}:
            return  # the page's script has moved it already
        self.tables.pick.data = {"x": [x], "y": [y]}
        self.walls.across.location, self.walls.up.location = x, y

    def stand(self, place: float) -> None:
        """Put the lines that say where the cell is on the axis of line and branch."""
        self.walls.line.location = self.walls.branch.location = place

    def motion(self, found: CellMotion) -> None:
        """Draw the phase plane, the course in time and the energies of impacts."""
        of, half = self.tables, found.half
        of.course.data = {"t": found.t, "x": found.u, "v": found.v}
        of.membranes.data = {"t": found.t, "left": np.minimum(found.u, -half), "right": np.maximum(found.u, half)}
        hits = found.impacts
        of.impacts.data = {"t": hits["t"], "x": hits["u"], "v": hits["v"]}
        good, bad = hits["admissible"] == 1, hits["admissible"] == 0
        shown = {"given": (hits["given"] > 0, "given"), "harvested": (good, "harvested"), "refused": (bad, "harvested")}
        energies = np.concatenate([hits["given"], hits["harvested"]]) * _MICRO
        for name, (there, column) in shown.items():
            there = there & (hits[column] > 0)
            getattr(of, name).data = {"x": hits["t"][there], "y": _MICRO * hits[column][there]}
        for walls in (self.walls.phase, self.walls.course):
            walls[0].location, walls[1].location = -half, half
        at = self.figures
        at.course.x_range.update(start=0.0, end=found.span)
        _span(at.phase.x_range, [found.u, [-half, half]])
        _span(at.phase.y_range, [found.v])
        _span(at.course.y_range, [found.u, [-half, half]])
        _decades(at.energy.y_range, energies[energies > 0])

    def line(self, found: CellLine) -> None:
        """Draw the line through the cell."""
        of = self.tables
        of.rising.data = dict(zip("xy", found.rising, strict=True))
        of.falling.data = dict(zip("xy", found.falling, strict=True))
        _span(self.figures.line.y_range, [found.rising[1], found.falling[1]])

    def visited(self, points: list[tuple[float, float]]) -> None:
        """Draw the impacts of the picks that were dragged along."""
        self.tables.visited.data = _points(points)

    def basin(self, found: CellBasin | None) -> list[str]:
        """Draw basins, and give the colours of the attractors."""
        if found is None:
            self.tables.basin.data = {name: [] for name in ("image", "x", "y", "dw", "dh")}
            return []
        colours = attractor_colours(found.labels)
        shades = np.array([[*bytes.fromhex(colour[1:]), 255] for colour in colours], np.uint8)
        image = shades[found.place].view(np.uint32)[..., 0]
        across, up = (float(axis[-1] - axis[0]) for axis in (found.u0, found.v0))
        self.figures.basin.x_range.update(start=float(found.u0[0]), end=float(found.u0[-1]))
        self.figures.basin.y_range.update(start=float(found.v0[0]), end=float(found.v0[-1]))
        corner = {"x": [float(found.u0[0])], "y": [float(found.v0[0])], "dw": [across], "dh": [up]}
        self.tables.basin.data = {"image": [image], **corner}
        return colours

    def branch(self, found: CellBranch | None) -> None:
        """Draw branches: stable thick and black, unstable thin and red, with what they met."""
        of = self.tables
        rows: dict[float, dict[str, list[Any]]] = {kept: {"xs": [], "ys": []} for kept in (0.0, 1.0)}
        for values, speeds, stable in () if found is None else found.lines:
            for kept, row in rows.items():
                # A segment belongs to the point it leads to, so that the two colours join.
                own = (stable == kept) | np.append(stable[1:] == kept, False)
                row["xs"].append(np.where(own, values, np.nan))
                row["ys"].append(np.where(own, speeds, np.nan))
        of.unstable.data, of.stable.data = rows[0.0], rows[1.0]
        if found is not None:
            _span(self.figures.branch.y_range, [speeds for _, speeds, _ in found.lines])
        met = () if found is None else found.met
        kinds, x, y = zip(*met, strict=True) if met else ((), (), ())
        of.met.data = {"x": list(x), "y": list(y), "kind": list(kinds)}

    def optima(self, places: list[tuple[float, float]]) -> None:
        """Mark optima on the map."""
        self.tables.optima.data = _points(places)


_STRONG, _WEAK = 1.8, 1.2  # pixels that curves are wide
_MICRO = 1e6  # energies are drawn in microjoules


def _span(where: Any, values: list[Any]) -> None:
    """Put a range around values, with a margin."""
    every = np.concatenate([np.ravel(one) for one in values])
    every = every[np.isfinite(every)]
    if every.size:
        low, high = float(every.min()), float(every.max())
        margin = 0.07 * (high - low) or 0.1 * max(abs(high), 1e-3)
        where.update(start=low - margin, end=high + margin)


def _decades(where: Any, values: np.ndarray) -> None:
    """Put a logarithmic range around values, with a margin of half its size or more."""
    if values.size:
        margin = max((float(values.max()) / float(values.min())) ** 0.2, 1.6)
        where.update(start=float(values.min()) / margin, end=float(values.max()) * margin)


def _points(places: list[tuple[float, float]]) -> dict[str, list[Any]]:
    return {"x": [x for x, _ in places], "y": [y for _, y in places]}


def _places(axis: Axis) -> np.ndarray:
    """Find which cell each pixel along an axis shows: pixels are evenly spaced on its scale, cells need not be."""
    count = axis.values.size
    if axis.even and count <= MOST_PIXELS:
        return np.arange(count)
    low, high = axis.edges[0], axis.edges[-1]
    pixels = min(MOST_PIXELS, 8 * count)
    parts = (np.arange(pixels) + 0.5) / pixels
    where = low * (high / low) ** parts if axis.scale == "log" else low + (high - low) * parts
    return np.clip(np.searchsorted(axis.edges, where) - 1, 0, count - 1)


def _pixels(plane: ExploredPlane, colours: np.ndarray) -> np.ndarray:
    shown = np.ascontiguousarray(colours[np.ix_(_places(plane.y), _places(plane.x))])
    return shown.view(np.uint32)[..., 0]


def _image(pixels: np.ndarray, x: Axis, y: Axis) -> dict[str, list[Any]]:
    low = {"x": [float(x.edges[0])], "y": [float(y.edges[0])]}
    spans = {"dw": [float(x.edges[-1] - x.edges[0])], "dh": [float(y.edges[-1] - y.edges[0])]}
    return {"image": [pixels], **low, **spans}


def _veil(plane: ExploredPlane, veiled: np.ndarray) -> dict[str, np.ndarray]:
    """Cover runs of veiled cells by rectangles, equal ones of neighbouring rows by one."""
    open_runs: dict[tuple[int, int], int] = {}
    found = []
    for row in range(veiled.shape[0] + 1):
        now = {(int(a), int(b)) for a, b in runs(veiled[row])} if row < veiled.shape[0] else set()
        ended = [run for run in open_runs if run not in now]
        found += [(*run, open_runs.pop(run), row) for run in ended]
        for run in now:
            open_runs.setdefault(run, row)
    table = np.array(found, int).reshape(-1, 4)
    x, y = plane.x.edges, plane.y.edges
    return {"left": x[table[:, 0]], "right": x[table[:, 1]], "bottom": y[table[:, 2]], "top": y[table[:, 3]]}
