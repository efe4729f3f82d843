"""Pictures of fits: what is left of the times of impacts once a device explains them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.fitting.fitted import Fit
from vijax.plots.figure import styled
from vijax.runtime import checks

# Within so many standard errors lie 19 of 20 times.
_BAND = 2.0


@styled
def fit(found: Fit) -> Figure:
    """Draw what `vijax.fit` left unexplained: of every time, in standard errors, over impacts and over impact speed.

    A device and errors that are right leave points that know of neither; in the grey band lie 19 of 20. Crosses are
    impacts that were left out, at 0 if they are false. What rises or falls along either axis is what the device lacks.

    Args:
        found: As `vijax.fit` returns it.

    Raises:
        ValueError: Something else.
    """
    checks.instance("found", found, Fit, "vijax.fit(...)")
    figure = Figure(figsize=(7.6, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _residuals(left, np.arange(found.residuals.size), found, "impact")
    _residuals(right, found.speeds, found, "impact speed [m/s]")
    left.set_ylabel("measured less fitted time\n[standard errors]")
    left.set_title(
        ", ".join(_told(name, value, found.stderr[name]) for name, value in found.values.items()), fontsize="small"
    )
    right.set_title(f"misfit {found.misfit.size:.3g}", fontsize="small")
    return figure


def _residuals(axes: Axes, where: np.ndarray, found: Fit, text: str) -> None:
    good = ~found.astray
    axes.axhspan(-_BAND, _BAND, color="0.9", zorder=0)
    axes.axhline(0, color="0.6", linewidth=0.6)
    axes.plot(where[good], found.residuals[good], ".", color="black", markersize=3)
    axes.plot(where[~good], np.nan_to_num(found.residuals[~good]), "x", color="tab:red", markersize=4)
    axes.set_xlabel(text)


def _told(name: str, value: float, error: float) -> str:
    return f"{name} = {value:.5g} $\\pm$ {error:.1g}" if np.isfinite(error) else f"{name} untold"
