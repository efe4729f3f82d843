"""What a page says in words and numbers: of the picked cell, of its attractors, of its branch, of its optima."""

from typing import Any

from vijax.explorer.basin import CellBasin
from vijax.explorer.branch import MOST_POINTS, CellBranch
from vijax.explorer.line import CellLine
from vijax.explorer.motion import MOST_IMPACTS, CellMotion
from vijax.explorer.optimum import NearOptimum
from vijax.explorer.overlay import LaidCurves, through
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.theme import amount, symbol, unit_of
from vijax.model.label import label
from vijax.model.pair import quantities
from vijax.model.records import Status
from vijax.model.sides import named
from vijax.plots.curve_lines import KINDS, screen_style
from vijax.plots.style import LABEL_NEEDS

Rows = list[list[str]]
"""Lines of a table, a text a column; the first line names the columns."""


def heading(found: CellMotion) -> str:
    """Say in a line what a cell does and yields."""
    return f"{found.name}, P = {amount(found.numbers['P'], 'J')}"


def cell_rows(cell: ExploredCell, found: CellMotion) -> Rows:
    """Say of a cell where it is, what it yields, how far it keeps from its limits, and how it ended."""
    place = [[symbol(name), amount(value, unit_of(name))] for name, value in cell.arguments.items()]
    place += [
        [symbol(name), amount(float(value))]
        for name, value in quantities(cell.pair).items()
        if not name.startswith("r") and name not in cell.arguments
    ]
    numbers = found.numbers
    limit = min(map(float, named("limit", cell.device.depth_limit).values()))
    most = float(cell.device.energy_ratio_limit)
    rows = [
        ["label", found.name],
        ["P", f"{amount(numbers['P'], 'J')} per half period"],
        ["power", amount(numbers["power"], "W")],
        ["admissible", "yes" if numbers["admissible"] else "no"],
        ["energy harvested / given", f"{amount(numbers['energy_ratio'])} (limit {amount(most)})"],
        ["penetration", f"{amount(1e3 * numbers['max_penetration'], 'mm')} (limit {amount(1e3 * limit, 'mm')})"],
        ["largest impact speed", amount(numbers["max_impact_speed"], "m/s")],
        ["impacts per period", amount(numbers["impacts_per_period"])],
        ["multipliers", ", ".join(map(multiplier, found.multipliers)) or _without(found)],
        ["status", found.status.name.lower()],
    ]
    if numbers["P_stderr"] > 0:
        rows[1][1] += f" \u00b1 {amount(numbers['P_stderr'], 'J', 2)}"
    return rows + place


def curves_row(found: LaidCurves, plane: ExploredPlane, pick: tuple[int, int]) -> Rows:
    """Say which curves pass through a cell; nothing where none are drawn."""
    return [["curves here", ", ".join(through(found, plane, pick)) or "none"]] if found.pieces else []


def curves_legend(found: LaidCurves) -> list[list[Any]]:
    """List the kinds of curves that are drawn: colour, dashes, name and how many."""
    numbers = {kind: {one.curve for one in found.pieces if one.kind == kind} for kind in KINDS}
    return [[*screen_style(kind), kind, len(there)] for kind, there in numbers.items() if there]


def curves_points(found: LaidCurves, plane: ExploredPlane) -> Rows:
    """List what of codimension 2 the curves meet, by the numbers on the map; nothing where they meet none."""
    rows = [[str(one.number), one.kind, *(amount(value, "", 6) for value in one.place)] for one in found.points]
    return [["no.", "codimension 2", symbol(plane.x.name), symbol(plane.y.name)], *rows] if rows else []


def _without(found: CellMotion) -> str:
    """Say why there are no multipliers."""
    impacts = found.numbers["impacts_left"] + found.numbers["impacts_right"]
    return f"not solved for, {impacts:.0f} impacts" if impacts > MOST_IMPACTS else "no orbit"


def multiplier(value: complex) -> str:
    """Write a Floquet multiplier; one that is real without its imaginary part."""
    if value.imag == 0:
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.6g}i"


def disagreement(plane: ExploredPlane, view_values: dict[str, float], pick: tuple[int, int], found: CellMotion) -> str:
    """Say what the store has of this cell where that is something else: another version, or another start."""
    if not set(LABEL_NEEDS) <= set(map(str, plane.dataset.data_vars)):
        return ""
    stored = {name: plane.stored(name, pick, view_values) for name in LABEL_NEEDS}
    if int(stored["status"]) == Status.NOT_RUN:
        return "the store has not run this cell yet"
    if plane.differs(view_values) or {"u0", "v0"} & set(view_values):
        return ""
    kept = str(label(*stored.values()))
    return "" if kept == found.name else f"the store has {kept} here: it was made by another version or precision"


def basin_rows(found: CellBasin, colours: list[str]) -> Rows:
    """List the attractors of a cell; the first column is their colour."""
    rows = [["", "attractor", "share", "P [J]"]]
    listed = zip(colours, found.labels, found.fractions, found.powers, strict=True)
    return rows + [[colour, name, f"{100 * part:.3g} %", amount(power, "", 4)] for colour, name, part, power in listed]


def line_text(found: CellLine) -> str:
    """Say what a line is of."""
    return f"Impacts as {symbol(found.along)} rises (blue) and falls (red), each point from where the last one ended."


def branch_rows(found: CellBranch) -> Rows:
    """List what a branch meets, in the order of its axis, each once."""
    met = sorted({(round(value, 9), kind) for kind, value, _ in found.met})
    return [["met", symbol(found.along)], *([kind, amount(value, "", 7)] for value, kind in met)]


def branch_text(found: CellBranch) -> str:
    """Say where a branch folds, and how it ends."""
    name = symbol(found.along)
    folds = ", ".join(amount(value, "", 7) for value in found.folds)
    said = f"folds at {name} = {folds}" if folds else f"no fold in this range of {name}"
    if "closed" in found.ends:
        return f"The branch has {said}; it is closed."
    first, last = (_ENDS.get(end, f"at a {end}") for end in found.ends)
    return f"The branch has {said}; it ends {first}{', either way' if first == last else f' and {last}'}."


_ENDS = {
    "low": "at the low end of the range",
    "high": "at the high end of the range",
    "start": "at this cell",
    "points": f"after {MOST_POINTS} orbits",
    "lost": "where no step is short enough",
}


def optimum_rows(axis: Axis, found: list[NearOptimum]) -> Rows:
    """List optima, the nearest first, with what limits each."""
    rows = [[symbol(axis.name), "label", "P [J]", "limited by"]]
    return rows + [[amount(one.value, "", 6), one.name, amount(one.P, "", 5), ", ".join(one.limits)] for one in found]
