"""Text files of columns of numbers, parted by commas or by blanks."""

from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

_WORDS = {2: "two", 3: "three"}


def columns(name: str, path: str, counts: Collection[int]) -> "np.ndarray":
    """Read the columns of a file, lines that begin with # left out.

    Args:
        name: Of the argument.
        path: Of the file.
        counts: How many columns it may have.

    Raises:
        ValueError: It is none, or has others.
    """
    import numpy as np

    must = f"{name} must be a text file of {' or '.join(_WORDS[count] for count in counts)} columns of numbers"
    try:
        read = np.loadtxt(path, delimiter="," if _parted_by_commas(path) else None, unpack=True, ndmin=2)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{must}; got {path!r}: {error}") from None
    if len(read) not in counts:
        raise ValueError(f"{must}; got {len(read)} in {path!r}")
    return read


def _parted_by_commas(path: str) -> bool:
    with open(path, encoding="utf-8") as file:
        return "," in next((line for line in file if line.strip() and not line.startswith("#")), "")
