"""Datasets as tables of text: a row an element, a column a variable with its unit in the header."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.runtime.files import replacing

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def dataset_rows(dataset: "xr.Dataset", of: str = "") -> "pd.DataFrame":
    """Return a table with a row for every element of the dimensions of a variable.

    Columns are the coordinates and all variables with no other dimensions; what has fewer dimensions is repeated.

    Args:
        dataset: What a command computed.
        of: The variable; rows where it is NaN, which are padding, are left out. Unless given, a row for every element
            of all dimensions.
    """
    import pandas as pd  # here, as importing vijax must not load it

    dims = list(dataset.sizes) if not of else list(dataset[of].dims)
    shown = dataset.drop_vars([name for name in dataset.variables if not set(dataset[name].dims) <= set(dims)])
    # Without coordinates of its own a dimension would be a number of rows without a name.
    shown = shown.assign_coords({dim: range(shown.sizes[dim]) for dim in dims if dim not in shown.coords})
    if not dims:
        return pd.DataFrame({str(name): [shown[name].item()] for name in shown.variables})
    rows = shown.to_dataframe(dim_order=dims).reset_index()
    return rows.dropna(subset=[of]) if of else rows


def write_table(rows: "pd.DataFrame", units: Mapping[str, str], path: Path) -> None:
    """Write a table as CSV, whole or not at all; the header has units, those of pure numbers left out."""
    named = {name: f"{name} [{unit}]" for name, unit in units.items() if unit not in ("", "1")}
    with replacing(path) as part:
        rows.rename(columns=named).to_csv(part, index=False)


def write_dataset(dataset: "xr.Dataset", path: Path, of: str = "") -> None:
    """Write the table of `dataset_rows` as CSV, whole or not at all."""
    units: dict[str, Any] = {str(name): variable.attrs.get("units", "") for name, variable in dataset.variables.items()}
    write_table(dataset_rows(dataset, of), units, path)
