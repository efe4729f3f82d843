"""Number of cells that one call computes, which is also the number of cells of a tile of a store."""

import os

from vijax.runtime.compilation import xla
from vijax.runtime.doc_pages import see
from vijax.simulation.scheduler.lane_scheduler import TABLE_ROWS

# A tile of this size takes a core half a second: large enough to fill lanes and to keep files few, and little work is
# lost if it is interrupted.
_LARGEST = TABLE_ROWS
# On an accelerator a call costs a third of a second, plus a time proportional to its cells; CPU cores finish its last
# cells. A large tile makes the fixed cost negligible.
_LARGEST_ON_ACCELERATOR = 1 << 22
# Smaller tiles leave lanes empty.
_SMALLEST = 1024


def max_cells() -> int:
    """Return the maximum number of cells of a tile.

    It is `VIJAX_TILE` in the environment, for machines with little memory; else 32,768, and 4,194,304 on an
    accelerator.

    Raises:
        ValueError: If `VIJAX_TILE` is no whole number from 1 to these limits.
    """
    maximum = _LARGEST if xla.on_cpu() else _LARGEST_ON_ACCELERATOR
    text = os.environ.get("VIJAX_TILE", str(maximum))
    if not (text.isascii() and text.isdecimal() and 0 < int(text) <= maximum):
        raise ValueError(see("studies", f"VIJAX_TILE must be a whole number from 1 to {maximum}; got {text[:20]!r}"))
    return int(text)


def min_cells() -> int:
    """Return the number of cells up to which a plane is one tile, not divided further."""
    # `VIJAX_TILE` may set a maximum below the usual minimum.
    return min(_SMALLEST, max_cells())
