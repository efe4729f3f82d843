"""Reader of text files of number columns, separated by commas or blanks."""

from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

_WORDS = {2: "two", 3: "three"}


def columns(name: str, path: str, counts: Collection[int]) -> "np.ndarray":
    """Read the columns of a file; lines that begin with # and a first line of names are skipped.

    Args:
        name: Name of the argument, for errors.
        path: Path of the file.
        counts: Admissible numbers of columns.

    Raises:
        ValueError: If the file cannot be read as columns of numbers, or has another number of columns.
    """
    import numpy as np

    must = f"{name} must be a text file of {' or '.join(_WORDS[count] for count in counts)} columns of numbers"
    try:
        with open(path, encoding="utf-8") as file:
            lines = [line for line in file if line.strip() and not line.lstrip().startswith("#")]
        delimiter = "," if lines and "," in lines[0] else None
        names = lines and not _are_numbers(lines[0].split(delimiter))
        read = np.loadtxt(lines[1:] if names else lines, delimiter=delimiter, unpack=True, ndmin=2)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{must}; got {path!r}: {error}") from None
    if len(read) not in counts:
        raise ValueError(f"{must}; got {len(read)} in {path!r}")
    return read


def _are_numbers(items: list[str]) -> bool:
    """Return True if at least one item is a number, so that the line is no header of column names."""
    for item in items:
        try:
            float(item)
        except ValueError:
            continue
        return True
    return False
