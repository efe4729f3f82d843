"""Rows of benchmarks on disk, each with its origin: the machine, the versions and the commit.

Documentation pages read them without the benchmarks' dependencies, so this module imports no peer.
"""

import csv
import os
from collections import namedtuple
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROWS = Path(__file__).parent / "rows"
MADE_BY = "made_by"
"""Last column: origin of a row."""


def write(
    path: Path, fields: Sequence[str], rows: Iterable[Sequence[Any]], earlier: Iterable[Sequence[Any]] = ()
) -> None:
    """Write rows as they arrive, so that an interrupted run leaves its finished rows.

    Args:
        path: The file.
        fields: Names of the columns, without the origin.
        rows: Rows of this run.
        earlier: Rows of an earlier run, as `read` returns them; they stand first, with their own origin.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    maker = made_by()
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*fields, MADE_BY])
        table.writerows(earlier)
        file.flush()
        for row in rows:
            table.writerow([*row, maker])
            file.flush()


def read(path: Path) -> list[Any]:
    """Read rows as named tuples; a column of numbers is converted to floats. The list is empty without a file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        fields, *lines = csv.reader(file)
    columns = [_numbers(column) for column in zip(*lines, strict=True)]
    kind = namedtuple("Row", fields)  # type: ignore[misc]  # its fields are those of the file
    return [kind(*values) for values in zip(*columns, strict=True)]


def made_by() -> str:
    """Return the origin of rows measured here in one line."""
    from vijax.maps.map_dataset import installation_attributes

    origin = installation_attributes()
    commit = origin["commit"].removesuffix("-dirty")[:10] + ("-dirty" if origin["commit"].endswith("-dirty") else "")
    versions = f"JAX {origin['version_jax']}, NumPy {origin['version_numpy']}, Python {origin['version_python']}"
    return f"{origin['source']} at {commit}, {versions}; {_processor()}, {os.cpu_count()} cores"


def _processor() -> str:
    """Return the name of the processor, on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else os.uname().machine


def _numbers(column: Sequence[str]) -> Sequence[Any]:
    try:
        return [float(cell) for cell in column]
    except ValueError:
        return column
