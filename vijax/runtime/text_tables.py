"""Datasets as text tables: one row per element, one column per variable with its unit in the header."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.runtime.files import replacing

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def dataset_rows(dataset: "xr.Dataset", of: str = "") -> "pd.DataFrame":
    """Return a table with one row for every element of the dimensions of a variable.

    Columns are the coordinates and all variables without other dimensions; variables with fewer dimensions are
    repeated.

    Args:
        dataset: Result of a command.
        of: Name of the variable; rows are padding, and are omitted, if the variable is NaN. By default the table has
            one row for every element of all dimensions.
    """
    import pandas as pd  # here: importing vijax must not load pandas

    dims = list(dataset.sizes) if not of else list(dataset[of].dims)
    selected = dataset.drop_vars([name for name in dataset.variables if not set(dataset[name].dims) <= set(dims)])
    # A dimension without coordinates would become an unnamed row number.
    selected = selected.assign_coords({dim: range(selected.sizes[dim]) for dim in dims if dim not in selected.coords})
    if not dims:
        return pd.DataFrame({str(name): [selected[name].item()] for name in selected.variables})
    rows = selected.to_dataframe(dim_order=dims).reset_index()
    # Rows are padding where the variable is NaN.
    return rows.dropna(subset=[of]) if of else rows


def write_table(rows: "pd.DataFrame", units: Mapping[str, str], path: Path) -> None:
    """Write a table as CSV, completely or not at all; the header has the units, except for pure numbers."""
    named = {name: f"{name} [{unit}]" for name, unit in units.items() if unit not in ("", "1")}
    with replacing(path) as part:
        rows.rename(columns=named).to_csv(part, index=False)


def write_dataset(dataset: "xr.Dataset", path: Path, of: str = "") -> None:
    """Write the table of `dataset_rows` as CSV, completely or not at all."""
    units: dict[str, Any] = {str(name): variable.attrs.get("units", "") for name, variable in dataset.variables.items()}
    write_table(dataset_rows(dataset, of), units, path)
