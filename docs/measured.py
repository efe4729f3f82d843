"""Tables and charts of what benchmarks measured, made from the rows that they keep: no figure of them stands twice."""

import math
import re
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import charts, tables
from docs.markdown import table

TARGETS = (1e-3, 1e-6, 1e-9)
_CHATTER = re.compile(r"impacts per period at kappa ([\d.]+), (\d+) steps")
_CHARTS: dict[str, Callable[[Iterable[Any], Path], Any]] = {
    "tails": charts.tails,
    "labels": charts.labels,
    "work_precision": charts.work_precision,
}


def texts() -> dict[str, str]:
    """Write the pieces of pages that rows give, by name."""
    errors = tables.read(tables.ROWS / "tails.csv")
    return {
        "reach": reach(errors),
        "other_motions": other_motions(errors),
        "rounding": rounding(errors),
        "labels": labels(tables.read(tables.ROWS / "labels.csv")),
        "speed": speed(),
        "failures": failures(tables.read(tables.ROWS / "failures.csv")),
        "chatter": chatter(tables.read(tables.ROWS / "failures.csv")),
        **{f"made_by_{path.stem}": _made_by(path) for path in sorted(tables.ROWS.glob("*.csv"))},
    }


def draw(into: Path) -> None:
    """Draw the charts whose rows, or whose drawing, have changed since they were drawn."""
    for name, chart in _CHARTS.items():
        rows, picture = tables.ROWS / f"{name}.csv", into / f"{name}.png"
        changed = max(file.stat().st_mtime for file in (rows, Path(charts.__file__)))
        if not picture.exists() or picture.stat().st_mtime < changed:
            chart(tables.read(rows), picture)


def reach(rows: Sequence[Any]) -> str:
    """Tabulate the least cost at which 99 % of the cells keep an error."""
    lines = []
    for method in dict.fromkeys(row.method for row in rows if not math.isnan(row.us)):
        some = [row for row in rows if row.method == method]
        lines.append([method, *(_cheapest([row for row in some if row.most <= target]) for target in TARGETS)])
    return table(("method", *(f"{target:.0e}".replace("e-0", "e-") for target in TARGETS)), lines)


def _cheapest(rows: Sequence[Any]) -> str:
    if not rows:
        return "not reached"
    best = min(rows, key=lambda row: row.us)
    return f"{best.us:.3g} us ({_setting(best)})"


def _setting(row: Any) -> str:
    return f"{row.setting} steps" if "rk4" in row.method.lower() else str(row.setting)


def other_motions(rows: Sequence[Any]) -> str:
    """Tabulate the settings with which some cells have another motion after three periods, or no number."""
    lines = [
        [row.method, _setting(row), _percent(row.other, row.cells), _percent(row.lost, row.cells), f"{row.median:.1e}"]
        for row in rows
        if row.other
    ]
    return table(("method", "setting", "off by more than 0.1", "of these without a number", "median error"), lines)


def rounding(rows: Sequence[Any]) -> str:
    """Tabulate what float64 leaves beside what it gives."""
    names = {"one rounding": "what rounding d, kappa and the start moves", "exact": "error of `exact`"}
    lines = [
        [names[row.method], *(f"{value:.1e}" for value in (row.median, row.most, row.worst))]
        for row in rows
        if row.method in names
    ]
    return table(("", "median", "99 % of the cells", "worst of all"), lines)


def labels(rows: Sequence[Any]) -> str:
    """Tabulate labels."""
    lines = [
        [row.method, _setting(row), _percent(row.wrong, row.cells), _percent(row.undecided, row.cells), f"{row.us:.3g}"]
        for row in rows
    ]
    return table(("method", "setting", "another label", "none", "us a cell"), lines)


def speed() -> str:
    """Tabulate the rows of the benchmarks of speed."""
    peer, scaling, large, ode = (
        tables.read(tables.ROWS / f"speed_{name}.csv") for name in ("against_peer", "scaling", "large", "ode")
    )
    lines = [*_against(peer, "vijax", "peer"), _adds(peer)]
    sizes = [f"{int(cells):,}: {_typical(scaling, f'{int(cells)} cells'):.3f} us" for cells in _sizes(scaling)]
    lines.append(["cost per cell-period by number of cells", "; ".join(sizes), "python benchmarks/speed.py --scaling"])
    seconds = f"{large[0].seconds:.0f} s with compilation"
    lines.append(["1024 x 1024 attractors with P, up to 400 periods", seconds, "python benchmarks/speed.py --large"])
    ours, theirs = (_typical(ode, what) for what in ("ode", "chain"))
    said = f"{ours:.1f} us against {theirs:.1f} us per cell-period: {theirs / ours:.1f} times faster"
    lines.append(
        ['`method="ode"`, 64 x 64 plane, against restarts of diffrax', said, "python benchmarks/speed.py --ode"]
    )
    return table(("figure", "value", "command"), [[what, value, f"`{command}`"] for what, value, command in lines])


def _against(rows: Sequence[Any], one: str, other: str) -> list[list[str]]:
    ours, theirs = ([row.seconds for row in rows if row.what == what] for what in (one, other))
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    said = (
        f"{_typical(rows, one):.3f} us against {_typical(rows, other):.3f} us per cell-period: "
        f"{statistics.median(ratios):.1f} times faster ({min(ratios):.1f} to {max(ratios):.1f})"
    )
    what = "the 128 x 128 plane, 100 periods, against numba RK4 with 1000 steps a period and no event location"
    return [[what, said, "python benchmarks/speed.py"]]


def _adds(rows: Sequence[Any]) -> list[str]:
    plain, asked = ([row.seconds for row in rows if row.what == what] for what in ("vijax", "vijax with P"))
    added = [100 * (b / a - 1) for a, b in zip(plain, asked, strict=True)]
    return ["asking for P adds", f"{statistics.median(added):.0f} %", "the same"]


def _sizes(rows: Sequence[Any]) -> list[float]:
    return sorted({row.cells for row in rows})


def _typical(rows: Sequence[Any], what: str) -> float:
    """Give the median of the repeats of one thing; the first compiles, unless a cold one went before it."""
    first = 0 if any(row.what == f"{what}, cold" for row in rows) else 1
    return statistics.median(row.us_per_cell_period for row in rows if row.what == what and row.repeat >= first)


def failures(rows: Sequence[Any]) -> str:
    """Tabulate what the benchmark of failures keeps, but for the impacts of each stiffness."""
    some = [row for row in rows if not _CHATTER.fullmatch(row.what)]
    lines = [[f"`{row.scene}`", row.what, _figure(row.usual), _figure(row.vijax)] for row in some]
    return table(("scene", "figure", "usual method", "vijax"), lines)


def chatter(rows: Sequence[Any]) -> str:
    """Tabulate the impacts a period of every fifth stiffness and of the last, a column for each number of steps."""
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        if at := _CHATTER.fullmatch(row.what):
            found.setdefault(at[1], {}).update({at[2]: f"{row.usual:.1f}", "exact": f"{row.vijax:.1f}"})
    stiffnesses = list(found)
    shown = [*stiffnesses[:-1:5], stiffnesses[-1]]
    columns = list(found[shown[0]])
    names = [f"rk4, {name} steps" if name != "exact" else f"`{name}`" for name in columns]
    return table(("kappa", *names), [[kappa, *(found[kappa][name] for name in columns)] for kappa in shown])


def _figure(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}"


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.2g} %" if part else "0"


def _made_by(path: Path) -> str:
    """Name what made the rows of a file."""
    rows = tables.read(path)
    makers = dict.fromkeys(row.made_by for row in rows)
    return f"Rows: `benchmarks/rows/{path.name}`, by {' and '.join(makers)}.\n"
