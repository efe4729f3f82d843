"""Tables and charts of the documentation, made from the stored rows of the benchmarks."""

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
    """Return the parts of pages that are made from rows, by name."""
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
    """Draw each chart again if its rows or the module of charts have changed since."""
    for name, chart in _CHARTS.items():
        rows, picture = tables.ROWS / f"{name}.csv", into / f"{name}.png"
        changed = max(file.stat().st_mtime for file in (rows, Path(charts.__file__)))
        if not picture.exists() or picture.stat().st_mtime < changed:
            chart(tables.read(rows), picture)


def reach(rows: Sequence[Any]) -> str:
    """Tabulate the smallest cost that keeps the error of 99 % of the cells below each target."""
    lines = []
    for method in dict.fromkeys(row.method for row in rows if not math.isnan(row.us)):
        rows_of_method = [row for row in rows if row.method == method]
        lines.append(
            [method, *(_cheapest([row for row in rows_of_method if row.quantile <= target]) for target in TARGETS)]
        )
    return table(("method", *(f"{target:.0e}".replace("e-0", "e-") for target in TARGETS)), lines)


def _cheapest(rows: Sequence[Any]) -> str:
    if not rows:
        return "not reached"
    best = min(rows, key=lambda row: row.us)
    return f"{best.us:.3g} us ({_setting(best)})"


def _setting(row: Any) -> str:
    return f"{row.setting} steps" if "rk4" in row.method.lower() else str(row.setting)


def other_motions(rows: Sequence[Any]) -> str:
    """Tabulate the settings that give cells another motion after three periods, or no number."""
    lines = [
        [row.method, _setting(row), _percent(row.other, row.cells), _percent(row.lost, row.cells), f"{row.median:.1e}"]
        for row in rows
        if row.other
    ]
    return table(("method", "setting", "off by more than 0.1", "of these without a number", "median error"), lines)


def rounding(rows: Sequence[Any]) -> str:
    """Tabulate the error of `exact` and the effect of rounding the input."""
    names = {"one rounding": "rounding of d, kappa and the start", "exact": "error of `exact`"}
    lines = [
        [names[row.method], *(f"{value:.1e}" for value in (row.median, row.quantile, row.worst))]
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
    ours, theirs = (_typical(ode, contender) for contender in ("ode", "chain"))
    ratio_text = f"{ours:.1f} us against {theirs:.1f} us per cell-period: {theirs / ours:.1f} times faster"
    lines.append(
        ['`method="ode"`, 64 x 64 plane, against restarts of diffrax', ratio_text, "python benchmarks/speed.py --ode"]
    )
    return table(("figure", "value", "command"), [[figure, value, f"`{command}`"] for figure, value, command in lines])


def _against(rows: Sequence[Any], first: str, second: str) -> list[list[str]]:
    ours, theirs = ([row.seconds for row in rows if row.contender == contender] for contender in (first, second))
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    ratio_text = (
        f"{_typical(rows, first):.3f} us against {_typical(rows, second):.3f} us per cell-period: "
        f"{statistics.median(ratios):.1f} times faster ({min(ratios):.1f} to {max(ratios):.1f})"
    )
    figure = "the 128 x 128 plane, 100 periods, against numba RK4 with 1000 steps a period and no event location"
    return [[figure, ratio_text, "python benchmarks/speed.py"]]


def _adds(rows: Sequence[Any]) -> list[str]:
    plain, with_P = (
        [row.seconds for row in rows if row.contender == contender] for contender in ("vijax", "vijax with P")
    )
    added = [100 * (b / a - 1) for a, b in zip(plain, with_P, strict=True)]
    return ["additional time for P", f"{statistics.median(added):.0f} %", "the same"]


def _sizes(rows: Sequence[Any]) -> list[float]:
    return sorted({row.cells for row in rows})


def _typical(rows: Sequence[Any], contender: str) -> float:
    """Return the median of the repeats of a contender; the first compiles, unless a cold run came before it."""
    first = 0 if any(row.contender == f"{contender}, cold" for row in rows) else 1
    return statistics.median(
        row.us_per_cell_period for row in rows if row.contender == contender and row.repeat >= first
    )


def failures(rows: Sequence[Any]) -> str:
    """Tabulate the rows of the benchmark of failures, except the impacts of each stiffness."""
    selected = [row for row in rows if not _CHATTER.fullmatch(row.quantity)]
    lines = [[f"`{row.scene}`", row.quantity, _figure(row.usual), _figure(row.vijax)] for row in selected]
    return table(("scene", "figure", "usual method", "vijax"), lines)


def chatter(rows: Sequence[Any]) -> str:
    """Tabulate the impacts a period of every fifth stiffness and of the last, a column for each number of steps."""
    impacts: dict[str, dict[str, str]] = {}
    for row in rows:
        if at := _CHATTER.fullmatch(row.quantity):
            impacts.setdefault(at[1], {}).update({at[2]: f"{row.usual:.1f}", "exact": f"{row.vijax:.1f}"})
    stiffnesses = list(impacts)
    selected = [*stiffnesses[:-1:5], stiffnesses[-1]]
    columns = list(impacts[selected[0]])
    names = [f"rk4, {name} steps" if name != "exact" else f"`{name}`" for name in columns]
    return table(("kappa", *names), [[kappa, *(impacts[kappa][name] for name in columns)] for kappa in selected])


def _figure(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}"


def _percent(part: float, total: float) -> str:
    return f"{100 * part / total:.2g} %" if part else "0"


def _made_by(path: Path) -> str:
    """Return the origin of the rows of a file."""
    rows = tables.read(path)
    makers = dict.fromkeys(row.made_by for row in rows)
    return f"Rows: `benchmarks/rows/{path.name}`, by {' and '.join(makers)}.\n"
