"""Curves of bifurcations as rows of a table, one per point, and their points of codimension 2, numbered."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vijax.runtime import validation
from vijax.runtime.public_api import public_api
from vijax.runtime.text_tables import write_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CURVE_VARIABLES = ("kind", "label", "multiplier", "stable", "event", "end_first", "end_last")
_POINT_VARIABLES = ("multiplier", "multiplier_product", "residual", "status", "stable")
# Distance, in sides of the plane, within which two points of one kind are the same. Each point is located on every
# curve that meets it, to about 1e-10; no two distinct points nearer than 1e-4 have been observed.
_SAME_POINT = 1e-6


class NumberedPoint(NamedTuple):
    """A point of codimension 2 in a table or a picture.

    Attributes:
        number: Its number.
        kind: Its kind.
        parameters: Both parameters.
    """

    number: int
    kind: str
    parameters: tuple[float, float]


def numbered_points(dataset: "xr.Dataset") -> list[NumberedPoint]:
    """Return the points of codimension 2 of curves, from the first curve to the last, without duplicates.

    Events on curves of limits are left out, because such curves cross many bifurcations.

    Args:
        dataset: Result of `vijax.curve_dataset`.
    """
    validation.validate_dataset("dataset", dataset, CURVE_VARIABLES, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    sides = [float(dataset[name].max() - dataset[name].min()) or 1.0 for name in names]
    points: list[NumberedPoint] = []
    columns = [dataset["event"].values.flat, *(dataset[f"event_{name}"].values.flat for name in names)]
    for kind, x, y in zip(*columns, strict=True):
        parameters = float(x), float(y)
        is_duplicate = any(point.kind == kind and _near(point.parameters, parameters, sides) for point in points)
        # The kinds of points on curves of limits end in "limit".
        if kind and not is_duplicate and not kind.endswith("limit"):
            points.append(NumberedPoint(len(points) + 1, str(kind), parameters))
    return points


def _near(first: tuple[float, float], second: tuple[float, float], sides: list[float]) -> bool:
    return all(abs(x - y) < _SAME_POINT * side for x, y, side in zip(first, second, sides, strict=True))


@public_api
def curve_rows(dataset: "xr.Dataset") -> "pd.DataFrame":
    """Return curves as a table with one row per point, curve after curve.

    Args:
        dataset: Result of `vijax.curve_dataset`.

    Returns:
        A pandas table with the columns curve, point, kind and label, both parameters, multiplier, multiplier_product,
        residual, status, stable, and the point of codimension 2 at that point of the curve as event.

    Raises:
        ValueError: The dataset is not a result of `vijax.curve_dataset`.
    """
    import pandas as pd

    validation.validate_dataset("dataset", dataset, CURVE_VARIABLES, "vijax.curve_dataset")
    names = dataset.attrs["along"].split()
    tables = []
    for index in range(dataset.sizes["curve"]):
        curve = dataset.isel(curve=index)
        # Rows beyond the end of a curve are NaN.
        size = int(np.isfinite(curve[names[0]].values).sum())
        columns = {"curve": index, "point": np.arange(size), "kind": str(curve["kind"].item())}
        columns |= {"label": str(curve["label"].item())} | {
            name: curve[name].values[:size] for name in (*names, *_POINT_VARIABLES)
        }
        table = pd.DataFrame(columns).astype({"status": int, "stable": int})
        tables.append(table.assign(event=_events(curve, names, size)))
    return pd.concat(tables, ignore_index=True)


def _events(curve: "xr.Dataset", names: list[str], size: int) -> np.ndarray:
    """Assign each event of a curve to the nearest point of the curve.

    Every event is itself among the points, unless the curve ends next to it.
    """
    events = np.full(size, "", object)
    parameters = np.column_stack([curve[name].values[:size] for name in names])
    # The smallest positive number avoids a division by zero on a curve where one parameter is constant.
    side = np.ptp(parameters, axis=0) + np.finfo(float).tiny
    for kind, *place in zip(curve["event"].values, *(curve[f"event_{name}"].values for name in names), strict=True):
        if kind:
            events[np.abs((parameters - place) / side).sum(axis=1).argmin()] = str(kind)
    return events


def write_rows(dataset: "xr.Dataset", path: Path) -> None:
    """Write the table of `curve_rows` as a CSV file, completely or not at all; units are in the header."""
    rows = curve_rows(dataset)
    units = {name: dataset[name].attrs.get("units", "1") for name in dataset.attrs["along"].split()}
    write_table(rows, units, path)
