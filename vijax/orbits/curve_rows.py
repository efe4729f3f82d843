"""Curves of bifurcations as rows: their points one by one, and what of codimension 2 they meet, numbered."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.tables import write_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NEEDED = ("kind", "label", "multiplier", "stable", "event", "end_first", "end_last")
_OF_POINT = ("multiplier", "multiplier_product", "residual", "status", "stable")
# Parts of the plane within which two points of one kind are one: each is located on every curve that meets it, to
# about 1e-10, and no two that were ever seen are nearer than 1e-4.
_SAME = 1e-6


class NumberedPoint(NamedTuple):
    """A point of codimension 2: its number in the table and the picture, what it is, both parameters."""

    number: int
    kind: str
    place: tuple[float, float]


def numbered_points(dataset: "xr.Dataset") -> list[NumberedPoint]:
    """List the points of codimension 2 of curves, each place once, from the first curve to the last.

    What curves of limits meet is left out: a limit crosses bifurcations wherever it goes.

    Args:
        dataset: What `vijax.curve_dataset` returned.
    """
    checks.variables("dataset", dataset, NEEDED, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    sides = [float(dataset[name].max() - dataset[name].min()) or 1.0 for name in names]
    found: list[NumberedPoint] = []
    columns = [dataset["event"].values.flat, *(dataset[f"event_{name}"].values.flat for name in names)]
    for kind, x, y in zip(*columns, strict=True):
        place = float(x), float(y)
        known = any(one.kind == kind and _near(one.place, place, sides) for one in found)
        if kind and not known and not kind.endswith("limit"):
            found.append(NumberedPoint(len(found) + 1, str(kind), place))
    return found


def _near(one: tuple[float, float], other: tuple[float, float], sides: list[float]) -> bool:
    return all(abs(x - y) < _SAME * side for x, y, side in zip(one, other, sides, strict=True))


@door
def curve_rows(dataset: "xr.Dataset") -> "pd.DataFrame":
    """Lay out curves as a table with a row a point, curve after curve.

    Args:
        dataset: What `vijax.curve_dataset` returned.

    Returns:
        A table of pandas with the columns curve, point, kind and label, both parameters, multiplier, its product with
        the other one, residual, status, stable, and what of codimension 2 the curve met there as event.

    Raises:
        ValueError: Another dataset.
    """
    import pandas as pd

    checks.variables("dataset", dataset, NEEDED, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    tables = []
    for index in range(dataset.sizes["curve"]):
        one = dataset.isel(curve=index)
        size = int(np.isfinite(one[names[0]].values).sum())
        columns = {"curve": index, "point": np.arange(size), "kind": str(one["kind"].item())}
        columns |= {"label": str(one["label"].item())} | {
            name: one[name].values[:size] for name in (*names, *_OF_POINT)
        }
        table = pd.DataFrame(columns).astype({"status": int, "stable": int})
        tables.append(table.assign(event=_events(one, names, size)))
    return pd.concat(tables, ignore_index=True)


def _events(one: "xr.Dataset", names: list[str], size: int) -> np.ndarray:
    """Put what a curve met to the point where it is: every one is among the points, unless the curve ends beside it."""
    events = np.full(size, "", object)
    at = np.column_stack([one[name].values[:size] for name in names])
    side = np.ptp(at, axis=0) + np.finfo(float).tiny
    for kind, *place in zip(one["event"].values, *(one[f"event_{name}"].values for name in names), strict=True):
        if kind:
            events[np.abs((at - place) / side).sum(axis=1).argmin()] = str(kind)
    return events


def write_rows(dataset: "xr.Dataset", path: Path) -> None:
    """Write the table of `curve_rows` as CSV, whole or not at all; units stand in the header."""
    rows = curve_rows(dataset)
    units = {name: dataset[name].attrs.get("units", "1") for name in dataset.attrs["along"].split()}
    write_table(rows, units, path)
