"""Style and saving of every picture: one style, files written completely or not at all, with a mark in the metadata."""

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
from vijax.runtime import validation

P = ParamSpec("P")

_FEW_DECADES = 1.6  # shorter axes, in decades, have labels at 1, 2 and 5 times powers of ten
_BARELY = 0.7  # still shorter axes, in decades, have labels at round numbers as a linear axis has


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function that makes a figure: it draws in the common style, independent of matplotlib's settings."""

    @functools.wraps(draw)
    def draw_in_style(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return draw_in_style


def label_logs(axes: Axes) -> None:
    """Label logarithmic axes of few decades by plain numbers; matplotlib's 2 x 10^1, 3 x 10^1 would overlap."""
    for axis in (axes.xaxis, axes.yaxis):
        decades = float(np.ptp(np.log10(axis.get_view_interval()))) if axis.get_scale() == "log" else np.inf
        if decades < _FEW_DECADES:
            axis.set_major_locator(MaxNLocator(5) if decades < _BARELY else LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_locator(NullLocator())


def save(figure: Figure, path: str | Path) -> None:
    """Save a figure of this folder; the file is written completely or not at all, and marked as drawn by vijax.

    Args:
        figure: Result of a function of `vijax.plots`; it may have been changed since.
        path: Path of the file; its ending .png, .pdf, .svg or .eps selects the format. An existing file is replaced.

    Raises:
        ValueError: The path has another ending.
        OSError: The file cannot be written; an existing file is unchanged.
    """
    validation.validate_instance("figure", figure, Figure, "a function of vijax.plots")
    # Fonts, hatches and resolution take effect when the file is written, so the style applies here as well.
    with mpl.rc_context(STYLE):
        save_figure(figure, path)
