"""Where every picture begins and ends: drawn in one style, saved whole and with a mark."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from vijax.plots.style import STYLE, save_figure
from vijax.runtime import checks

P = ParamSpec("P")

_FEW_DECADES = 1.6  # up to which 1, 2 and 5 of a decade are labelled, as its powers alone are too few
_BARELY = 0.7  # decades; below, even 1, 2 and 5 are too few, and round numbers are labelled as on a linear axis


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Mark what makes a figure: it does so in the style of all pictures, whatever matplotlib is set to outside."""

    @functools.wraps(draw)
    def draws(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return draws


def label_logs(axes: Axes) -> None:
    """Label logarithmic axes of few decades by plain numbers; matplotlib writes 2 x 10^1, 3 x 10^1 over each other."""
    for axis in (axes.xaxis, axes.yaxis):
        decades = float(np.ptp(np.log10(axis.get_view_interval()))) if axis.get_scale() == "log" else np.inf
        if decades < _FEW_DECADES:
            axis.set_major_locator(MaxNLocator(5) if decades < _BARELY else LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())


def save(figure: Figure, path: str | Path) -> None:
    """Save a figure of this folder as a file that is whole or absent, and says that vijax drew it.

    Args:
        figure: What a function of `vijax.plots` returned; it may have been changed since.
        path: Where to; .png, .pdf, .svg or .eps chooses the format. What is there is replaced.

    Raises:
        ValueError: Another ending.
        OSError: If it cannot be written; what was there stays.
    """
    checks.instance("figure", figure, Figure, "a function of vijax.plots")
    # Fonts, hatches and dots an inch count as it is written, too.
    with mpl.rc_context(STYLE):
        save_figure(figure, path)
