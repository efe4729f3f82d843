"""How many cells are computed by one call, and written as one tile of a store."""

import os

from vijax.runtime.pages import see

# The largest take a core a second or two, large enough to keep lanes full and files few, small enough to lose.
_LARGEST = 32768
# Smaller ones leave lanes empty.
_SMALLEST = 1024


def largest() -> int:
    """Give the most cells of a tile: `VIJAX_TILE` in the environment, for machines of little memory; 32,768 else.

    Raises:
        ValueError: If it is no such number.
    """
    said = os.environ.get("VIJAX_TILE", str(_LARGEST))
    if not (said.isascii() and said.isdecimal() and 0 < int(said) <= _LARGEST):
        raise ValueError(see("studies", f"VIJAX_TILE must be a whole number from 1 to {_LARGEST}; got {said[:20]!r}"))
    return int(said)


def smallest() -> int:
    """Give how many cells a tile has where there are enough of them."""
    return min(_SMALLEST, largest())
