"""Closing lines of a run: results, speed, and files written."""

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.model.quantities import FREE_GAP, STARTS
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    import xarray as xr

# Time when this module is imported, which is close to the start of the process.
_STARTED = time.perf_counter()


def finish(
    dataset: "xr.Dataset",
    summary: str,
    out: Path | None,
    plot: Path | None,
    picture: "Callable[[xr.Dataset, Path], Any]",
    overwrite: bool,
    store_written: bool = False,
    table: Path | None = None,
    rows_of: str = "",
) -> None:
    """Write the store (unless `store_written`), the table and the picture, and print the closing lines.

    Args:
        dataset: The result.
        summary: Text with the results.
        out, plot: Paths of store and picture; None for a file that is not written.
        picture: Function that draws a dataset to a path.
        overwrite: Whether to replace an existing store.
        store_written: Whether the run has already written the store.
        table: Path of the table; None for no table.
        rows_of: Name of the variable with one table row per element; "" for a table of the whole dataset.
    """
    if out is not None and not store_written:
        from vijax.maps.storage.store import save

        save(dataset, out, overwrite=overwrite)
    if table is not None:
        from vijax.runtime.text_tables import write_dataset

        write_dataset(dataset, table, rows_of)
    if plot is not None:
        picture(dataset, plot)
    close(summary, out, table, plot)


def close(summary: str, *written: Path | None) -> None:
    """Print the results, the paths of the written files (None is skipped) and the time since the process started."""
    click.echo(summary)
    click.echo(f"wrote {', '.join(str(path) for path in written if path)}")
    click.echo(f"{time.perf_counter() - _STARTED:.1f} s from start to end")


def rate_text(count: int, seconds: float, unit: str = "cells") -> str:
    """Return a text with the count, the time and the rate: 2,000 cells in 0.50 s, 4,000 cells/s."""
    rate = count / seconds
    return f"{format_count(count, unit)} in {seconds:.2f} s, {rate:{',.0f' if rate >= 100 else '.3g'}} {unit}/s"


def format_count(count: int, unit: str) -> str:
    """Return a count with its unit, singular for 1: 1 cell, 2,000 cells."""
    return f"{count:,} {unit.removesuffix('s') if count == 1 else unit}"


def flags(variable: "xr.DataArray") -> str:
    """Return a text with the number of elements per flag name, for a variable of integers with CF flag attributes."""
    names = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    return tally(variable.values, names.get)


def statuses(variable: "xr.DataArray", of: str = "cells") -> str:
    """Return a text with the number of cells per status, and a line of advice for each status other than OK.

    `of` is the name of the counted elements in the text.
    """
    from vijax.model.records import Status

    present = [status for status in Status if status != Status.OK and (variable == status).any()]
    advice = [f"    {status.name.lower()}: {status.advice}" for status in present]
    counted = f"{of} by status: {flags(variable)}"
    return see("status", "\n".join([counted, *advice])) if present else counted


def limit_lines(dataset: "xr.Dataset", of: str = "cells") -> list[str]:
    """Return one line with the number of inadmissible cells per violated limit.

    The list is empty if the dataset has no variable `violated_limits`. `of` is the name of the cells in the line.
    """
    if "violated_limits" not in dataset:
        return []
    from vijax.maps.outputs import LimitViolation

    code = dataset["violated_limits"].values
    names = ((limit, limit.name.lower().replace("_", " ")) for limit in LimitViolation if limit != LimitViolation.NONE)
    counts = {name: int((code == limit).sum()) for limit, name in names}
    listed = ", ".join(f"{name} {count:,}" for name, count in counts.items() if count)
    bad = sum(counts.values())
    line = f"inadmissible {of}: {bad:,} of {code.size:,}" + (f" ({listed})" if bad else "")
    return [see("model", line) if bad else line]


def wide_gap_lines(dataset: "xr.Dataset", command: str = "") -> list[str]:
    """Return a line of advice if a map with one start per cell has cells with gamma = 0 and a wide gap, else no line.

    In a gap wider than 2/pi^2 motions without impacts exist, so that the attractor depends on the start.

    Args:
        dataset: A map with the coordinates d and gamma.
        command: Command that has the option `--starts`, with a final blank; "" if the running command has this option.
    """
    started = any(name in dataset.dims for name in STARTS) or dataset.attrs.get("starts", 1) > 1
    if started or not {"d", "gamma"} <= set(dataset.coords):
        return []
    return wide_gap_advice(dataset["d"], dataset["gamma"], command)


def wide_gap_advice(d: Any, gamma: Any, command: str = "") -> list[str]:
    """Return the line of `wide_gap_lines` for gaps d and gravities gamma; an empty list if no gap is wide."""
    fraction = float(((d > FREE_GAP) & (gamma == 0)).mean())
    if not fraction:
        return []
    where = "everywhere" if fraction == 1 else f"in {fraction:.1%} of the cells"
    return [
        f"d > 2/pi^2 at gamma = 0 {where}: the motion depends on the start, and this map has one start; "
        f"try {command}--starts 64"
    ]


def harvest(P: float, power: float, error: float | None = None) -> str:
    """Return a text with the energy P, its standard error if known, and the power: 2e-05 J per half period, 2e-05 W."""
    off = "" if error is None else f" +- {error:.1g}"
    return f"{P:.6g}{off} J per half period, {power:.6g} W"


def tally(values: Any, name: Callable[[Any], Any], order: Callable[[Any], Any] | None = None) -> str:
    """Return a text with the number of values per name.

    Args:
        values: Array of values.
        name: Function from a value to its name.
        order: Function from a value to its sort key; by default names are in ascending order of their values.
    """
    import numpy as np

    kinds, counts = np.unique(values, return_counts=True)
    totals: Counter[str] = Counter()
    rows = zip(kinds.tolist(), counts.tolist(), strict=True)
    for kind, count in sorted(rows, key=lambda row: (order or float)(row[0])):
        # Several values may share a name: for example, all long periods are counted together.
        totals[str(name(kind))] += count
    return ", ".join(f"{word} {n:,}" for word, n in totals.items())
