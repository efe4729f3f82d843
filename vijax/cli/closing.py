"""The lines that end a run: what was found, how fast, what was written."""

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vijax.model.quantities import FREE_GAP, STARTS
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

_STARTED = time.perf_counter()


def finish(
    dataset: "xr.Dataset",
    summary: str,
    out: Path | None,
    plot: Path | None,
    picture: "Callable[[xr.Dataset, Path], Any]",
    overwrite: bool,
    kept: bool = False,
    table: Path | None = None,
    rows_of: str = "",
) -> None:
    """Write the store, unless the run did, the table and the picture; say what was found, written, and in what time.

    The table has a row for every element of the variable `rows_of`, or of the dataset.
    """
    if out is not None and not kept:
        from vijax.planes.store import save

        save(dataset, out, overwrite=overwrite)
    if table is not None:
        from vijax.runtime.tables import write_dataset

        write_dataset(dataset, table, rows_of)
    if plot is not None:
        picture(dataset, plot)
    close(summary, out, table, plot)


def close(summary: str, *written: Path | None) -> None:
    """Say what the run found, what was written and how long it all took."""
    click.echo(summary)
    click.echo(f"wrote {', '.join(str(path) for path in written if path)}")
    click.echo(f"{time.perf_counter() - _STARTED:.1f} s from start to end")


def pace(count: int, seconds: float, unit: str = "cells") -> str:
    """Say how much was done in what time."""
    rate = count / seconds
    return f"{how_many(count, unit)} in {seconds:.2f} s, {rate:{',.0f' if rate >= 100 else '.3g'}} {unit}/s"


def how_many(count: int, unit: str) -> str:
    """Write a number of things, of which one has no plural: 1 cell, 2,000 cells."""
    return f"{count:,} {unit.removesuffix('s') if count == 1 else unit}"


def flags(variable: "xr.DataArray") -> str:
    """Count how often each value of a variable with CF flags occurs."""
    names = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    return tally(variable.values, names.get)


def statuses(variable: "xr.DataArray", of: str = "cells") -> str:
    """Count how often each status occurs; below, say what to do about those that are not OK."""
    from vijax.model.records import Status

    found = [status for status in Status if status != Status.OK and (variable == status).any()]
    advice = [f"    {status.name.lower()}: {status.advice}" for status in found]
    counted = f"{of} by status: {flags(variable)}"
    return see("status", "\n".join([counted, *advice])) if found else counted


def limit_lines(dataset: "xr.Dataset", of: str = "cells") -> list[str]:
    """Count the inadmissible cells by the limit that they break; nothing where the dataset has no such variable."""
    if "violated_limits" not in dataset:
        return []
    from vijax.planes.outputs import LimitViolation

    code = dataset["violated_limits"].values
    names = ((one, one.name.lower().replace("_", " ")) for one in LimitViolation if one != LimitViolation.NONE)
    counts = {name: int((code == one).sum()) for one, name in names}
    listed = ", ".join(f"{name} {count:,}" for name, count in counts.items() if count)
    bad = sum(counts.values())
    said = f"inadmissible {of}: {bad:,} of {code.size:,}" + (f" ({listed})" if bad else "")
    return [see("model", said) if bad else said]


def wide_gap_lines(dataset: "xr.Dataset", command: str = "") -> list[str]:
    """Return a line where a map of one start has wide level gaps, in which balls may fly for ever without an impact.

    Args:
        dataset: A map with the coordinates d and gamma.
        command: The command that has `--starts`, where it is another one.
    """
    started = any(name in dataset.dims for name in STARTS) or dataset.attrs.get("starts", 1) > 1
    if started or not {"d", "gamma"} <= set(dataset.coords):
        return []
    return wide_gap_advice(dataset["d"], dataset["gamma"], command)


def wide_gap_advice(d: Any, gamma: Any, command: str = "") -> list[str]:
    """Return the line of `wide_gap_lines` for gaps d and gravities gamma; nothing if no gap is wide."""
    part = float(((d > FREE_GAP) & (gamma == 0)).mean())
    if not part:
        return []
    where = "everywhere" if part == 1 else f"in {part:.1%} of the cells"
    return [
        f"d > 2/pi^2 on level ground {where}: the motion depends on the start, and this is that of one; "
        f"try {command}--starts 64"
    ]


def harvest(P: float, power: float, error: float | None = None) -> str:
    """Write harvested energy, with its standard error, and power: 2e-05 J per half period, 2e-05 W."""
    off = "" if error is None else f" +- {error:.1g}"
    return f"{P:.6g}{off} J per half period, {power:.6g} W"


def tally(values: Any, name: Callable[[Any], Any], order: Callable[[Any], Any] | None = None) -> str:
    """Count how often each name occurs among values, the least values first, or those least by `order`."""
    import numpy as np

    kinds, counts = np.unique(values, return_counts=True)
    found: Counter[str] = Counter()
    rows = zip(kinds.tolist(), counts.tolist(), strict=True)
    for kind, count in sorted(rows, key=lambda row: (order or float)(row[0])):
        found[str(name(kind))] += count
    return ", ".join(f"{word} {n:,}" for word, n in found.items())
