"""Rows of benchmarks on disk, each with what made it: the machine, the versions and the commit.

Pages read them without what measured them, so nothing here imports a peer.
"""

import csv
import os
from collections import namedtuple
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROWS = Path(__file__).parent / "rows"
MADE_BY = "made_by"
"""The last column: what made a row."""


def write(path: Path, fields: Sequence[str], rows: Iterable[Sequence[Any]], kept: Iterable[Sequence[Any]] = ()) -> None:
    """Write rows as they come, so that what was measured before a run is ended is there.

    Args:
        path: The file.
        fields: Names of the columns, without what made the rows.
        rows: What this run measures.
        kept: Rows that `read` gave of an earlier run; they stand first, with what made them then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    maker = made_by()
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*fields, MADE_BY])
        table.writerows(kept)
        file.flush()
        for row in rows:
            table.writerow([*row, maker])
            file.flush()


def read(path: Path) -> list[Any]:
    """Read rows as named tuples; a column in which all is numbers is one of floats. None where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        fields, *lines = csv.reader(file)
    columns = [_numbers(column) for column in zip(*lines, strict=True)]
    kind = namedtuple("Row", fields)  # type: ignore[misc]  # its fields are those of the file
    return [kind(*values) for values in zip(*columns, strict=True)]


def made_by() -> str:
    """Say in one line what measures here."""
    from vijax.planes.dataset import made_by as told

    made = told()
    commit = made["commit"].removesuffix("-dirty")[:10] + ("-dirty" if made["commit"].endswith("-dirty") else "")
    versions = f"JAX {made['version_jax']}, NumPy {made['version_numpy']}, Python {made['version_python']}"
    return f"{made['source']} at {commit}, {versions}; {_processor()}, {os.cpu_count()} cores"


def _processor() -> str:
    """Name the processor, as Linux does."""
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
