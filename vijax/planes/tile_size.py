"""How many cells are computed by one call, and written as one tile of a store."""

import os

from vijax.batch.lanes import TABLE
from vijax.runtime import xla
from vijax.runtime.pages import see

# The largest take a core half a second, large enough to keep lanes full and files few, small enough to lose.
_LARGEST = TABLE
# A call takes a GPU, with the cores that fly its last cells, a third of a second besides what grows with its cells.
_LARGEST_ELSEWHERE = 1 << 22
# Smaller ones leave lanes empty.
_SMALLEST = 1024


def largest() -> int:
    """Give the most cells of a tile.

    `VIJAX_TILE` in the environment, for machines of little memory; else 32,768, and 4,194,304 on an accelerator.

    Raises:
        ValueError: If it is no such number.
    """
    most = _LARGEST if xla.on_cpu() else _LARGEST_ELSEWHERE
    said = os.environ.get("VIJAX_TILE", str(most))
    if not (said.isascii() and said.isdecimal() and 0 < int(said) <= most):
        raise ValueError(see("studies", f"VIJAX_TILE must be a whole number from 1 to {most}; got {said[:20]!r}"))
    return int(said)


def smallest() -> int:
    """Give how many cells a tile has where there are enough of them."""
    return min(_SMALLEST, largest())
