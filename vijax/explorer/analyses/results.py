"""Texts and tables that the page shows about the picked cell, its attractors, its branch and its optima."""

from typing import Any

from vijax.explorer.analyses.basin import CellBasin
from vijax.explorer.analyses.branch import MOST_POINTS, CellBranch
from vijax.explorer.analyses.line import CellLine
from vijax.explorer.analyses.motion import MOST_IMPACTS, CellMotion
from vijax.explorer.analyses.optimum import NearOptimum
from vijax.explorer.overlay import DrawnCurves, through
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane
from vijax.explorer.theme import amount, symbol, unit_of
from vijax.model.label import label
from vijax.model.pair import pair_quantities
from vijax.model.records import Status
from vijax.model.walls.sides import values_by_name
from vijax.plots.curve_lines import KINDS, screen_style
from vijax.plots.style import LABEL_NEEDS

Rows = list[list[str]]
"""Lines of a table, one text per column; the first line holds the column names."""


def heading(motion: CellMotion) -> str:
    """Return the label and P of a cell in one line."""
    return f"{motion.name}, P = {amount(motion.numbers['P'], 'J')}"


def cell_rows(cell: ExploredCell, motion: CellMotion) -> Rows:
    """Return the table of a cell: its label, results, limits, status and parameters."""
    position = [[symbol(name), amount(value, unit_of(name))] for name, value in cell.arguments.items()]
    # Besides r, `quantities` holds r_left and r_right; they are left out here, because the arguments list r.
    position += [
        [symbol(name), amount(float(value))]
        for name, value in pair_quantities(cell.pair).items()
        if not name.startswith("r") and name not in cell.arguments
    ]
    numbers = motion.numbers
    limit = min(map(float, values_by_name("limit", cell.device.depth_limit).values()))
    ratio_limit = float(cell.device.energy_ratio_limit)
    rows = [
        ["label", motion.name],
        ["P", f"{amount(numbers['P'], 'J')} per half period"],
        ["power", amount(numbers["power"], "W")],
        ["admissible", "yes" if numbers["admissible"] else "no"],
        ["energy harvested / transferred", f"{amount(numbers['energy_ratio'])} (limit {amount(ratio_limit)})"],
        ["penetration", f"{amount(1e3 * numbers['max_penetration'], 'mm')} (limit {amount(1e3 * limit, 'mm')})"],
        ["largest impact speed", amount(numbers["max_impact_speed"], "m/s")],
        ["impacts per period", amount(numbers["impacts_per_period"])],
        ["multipliers", ", ".join(map(multiplier, motion.multipliers)) or _reason_without_multipliers(motion)],
        ["status", motion.status.name.lower()],
    ]
    if numbers["P_stderr"] > 0:
        rows[1][1] += f" \u00b1 {amount(numbers['P_stderr'], 'J', 2)}"
    return rows + position


def curves_row(curves: DrawnCurves, plane: ExploredPlane, pick: tuple[int, int]) -> Rows:
    """Return the table row with the curves that pass through a cell; no row if no curve is drawn."""
    return [["curves here", ", ".join(through(curves, plane, pick)) or "none"]] if curves.pieces else []


def curves_legend(curves: DrawnCurves) -> list[list[Any]]:
    """Return one legend entry per kind of drawn curves: colour, dash pattern, name of the kind, number of curves."""
    curves_of_kind = {kind: {piece.curve for piece in curves.pieces if piece.kind == kind} for kind in KINDS}
    return [[*screen_style(kind), kind, len(members)] for kind, members in curves_of_kind.items() if members]


def curves_points(curves: DrawnCurves, plane: ExploredPlane) -> Rows:
    """Return the table of codimension-2 points, with their numbers on the map; no rows if there are none."""
    rows = [
        [str(point.number), point.kind, *(amount(value, "", 6) for value in point.parameters)]
        for point in curves.points
    ]
    return [["no.", "codimension 2", symbol(plane.x.name), symbol(plane.y.name)], *rows] if rows else []


def _reason_without_multipliers(motion: CellMotion) -> str:
    """Return the reason why a cell's motion has no Floquet multipliers."""
    impacts = motion.numbers["impacts_left"] + motion.numbers["impacts_right"]
    return f"not solved for, {impacts:.0f} impacts" if impacts > MOST_IMPACTS else "no orbit"


def multiplier(value: complex) -> str:
    """Format a Floquet multiplier; a real multiplier is written without an imaginary part."""
    if value.imag == 0:
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.6g}i"


def disagreement(plane: ExploredPlane, view_values: dict[str, float], pick: tuple[int, int], motion: CellMotion) -> str:
    """Return a note if the map has another label for a cell than its computed motion, else "".

    The note is also "" if the labels cannot be compared, because the motion has other parameters or another start.
    """
    if not set(LABEL_NEEDS) <= set(map(str, plane.dataset.data_vars)):
        return ""
    stored = {name: plane.stored(name, pick, view_values) for name in LABEL_NEEDS}
    if int(stored["status"]) == Status.NOT_RUN:
        return "the store has not run this cell yet"
    if plane.differs(view_values) or {"u0", "v0"} & set(view_values):
        return ""
    # With parameters changed by sliders or another start, the motion may be another attractor than the map's.
    stored_label = str(label(*stored.values()))
    return (
        ""
        if stored_label == motion.name
        else f"the store has {stored_label} here: it was made by another version or precision"
    )


def basin_rows(basin: CellBasin, colours: list[str]) -> Rows:
    """Return the table of a cell's attractors; its first column holds their colours."""
    rows = [["", "attractor", "share", "P [J]"]]
    attractors = zip(colours, basin.labels, basin.fractions, basin.powers, strict=True)
    return rows + [
        [colour, name, f"{100 * fraction:.3g} %", amount(power, "", 4)] for colour, name, fraction, power in attractors
    ]


def line_text(diagram: CellLine) -> str:
    """Return the caption of a line through a cell."""
    return f"Impacts as {symbol(diagram.along)} rises (blue) and falls (red), each point from where the last one ended."


def branch_rows(branch: CellBranch) -> Rows:
    """Return the table of a branch's events in ascending order of the axis value; repeated events appear once."""
    events = sorted({(round(value, 9), kind) for kind, value, _ in branch.events})
    return [["event", symbol(branch.along)], *([kind, amount(value, "", 7)] for value, kind in events)]


def branch_text(branch: CellBranch) -> str:
    """Return a sentence with the folds of a branch and the reasons for its ends."""
    name = symbol(branch.along)
    folds = ", ".join(amount(value, "", 7) for value in branch.folds)
    fold_text = f"folds at {name} = {folds}" if folds else f"no fold in this range of {name}"
    if "closed" in branch.ends:
        return f"The branch has {fold_text}; it is closed."
    first, last = (_ENDS.get(end, f"at a {end}") for end in branch.ends)
    return f"The branch has {fold_text}; it ends {first}{', either way' if first == last else f' and {last}'}."


_ENDS = {
    # Texts by the reason why a branch ends, a value of the dataset's variables `end_first` and `end_last`.
    "low": "at the low end of the range",
    "high": "at the high end of the range",
    "start": "at this cell",
    "points": f"after {MOST_POINTS} orbits",
    "lost": "where no step is short enough",
}


def optimum_rows(axis: Axis, optima: list[NearOptimum]) -> Rows:
    """Return the table of optima, the nearest to the cell first, each with its active limits."""
    rows = [[symbol(axis.name), "label", "P [J]", "limited by"]]
    return rows + [
        [amount(optimum.value, "", 6), optimum.name, amount(optimum.P, "", 5), ", ".join(optimum.limits)]
        for optimum in optima
    ]
