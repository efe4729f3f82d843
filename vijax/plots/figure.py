"""Where every picture begins and ends: drawn in one style, saved whole and with a mark."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure

from vijax.plots.style import STYLE, save_figure

P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Mark what makes a figure: it does so in the style of all pictures, whatever matplotlib is set to outside."""

    @functools.wraps(draw)
    def draws(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return draws


def save(figure: Figure, path: str | Path) -> None:
    """Save a figure of this folder as a file that is whole or absent, and says that vijax drew it.

    Args:
        figure: What a function of `vijax.plots` returned; it may have been changed since.
        path: Where to; .png, .pdf, .svg or .eps chooses the format. What is there is replaced.

    Raises:
        ValueError: Another ending.
        OSError: If it cannot be written; what was there stays.
    """
    # Fonts, hatches and dots an inch count as it is written, too.
    with mpl.rc_context(STYLE):
        save_figure(figure, path)
