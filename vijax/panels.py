"""What a map must hold to be drawn, and in how many panels: known before the run, without matplotlib."""

import itertools
import math
from collections.abc import Mapping
from typing import Any

NEEDS = ("P", "period", "admissible")
LABEL_NEEDS = ("period", "impacts_left", "impacts_right", "status")
MOST_PANELS = 36


def layout(sizes: Mapping[str, int]) -> tuple[int, int]:
    """Rows and columns of panels for a map whose dimensions are, in order, x, y, columns and rows.

    Args:
        sizes: Length of every dimension of P; those of length one are not drawn.

    Raises:
        ValueError: If no picture can be made of it: why, and what to take away.
    """
    drawn = {dim: size for dim, size in sizes.items() if size > 1}
    if not drawn:
        raise ValueError("plot must have an axis of more than one value; got a single cell")
    if len(drawn) > 4:
        raise ValueError(f"plot must have at most 4 axes; got {', '.join(drawn)}; keep some of them at one value")
    panels = dict(itertools.islice(drawn.items(), 2, None))
    count = math.prod(panels.values())
    if count > MOST_PANELS:
        got = " x ".join(f"{size} values of {dim}" for dim, size in panels.items())
        raise ValueError(f"plot must have at most {MOST_PANELS} panels; got {got}; give the two longest axes first")
    columns = min(count, 3) if len(panels) < 2 else next(iter(panels.values()))
    return math.ceil(count / columns), columns


def layout_of_kinds(sizes: Mapping[str, int]) -> tuple[int, int]:
    """`layout` for a map of labels or basins, which a curve cannot show."""
    drawn = [dim for dim, size in sizes.items() if size > 1]
    if len(drawn) == 1:
        raise ValueError(f"plot must have two axes of more than one value; got {drawn[0]} alone")
    return layout(sizes)


def is_kind(variable: Any) -> bool:
    """Whether a variable says of what kind a cell is, and not how much there is of something."""
    return variable.dtype == bool or "flag_values" in variable.attrs
