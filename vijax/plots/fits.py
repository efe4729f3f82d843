"""Pictures of fits: residuals of the impact times after a device is fitted."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vijax.fitting.fit_result import Fit
from vijax.plots.figure import styled
from vijax.runtime import validation

# Half height of the grey band, in standard errors; 19 of 20 normal residuals lie within.
_BAND = 2.0


@styled
def fit(result: Fit) -> Figure:
    """Draw the residuals of `vijax.fit` in standard errors: one for each impact time, over impacts and over speed.

    If the device and the errors are right, the residuals depend neither on the number of the impact nor on its speed,
    and 19 of 20 lie in the grey band. A trend along either axis shows an effect that the device lacks. Crosses are
    impacts excluded from the fit. A false impact (a recorded time that is no impact of the ball) has no residual; its
    cross is drawn at 0.

    Args:
        result: Result of `vijax.fit`.

    Raises:
        ValueError: The argument is another object.
    """
    validation.validate_instance("result", result, Fit, "vijax.fit(...)")
    figure = Figure(figsize=(7.6, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _residuals(left, np.arange(result.residuals.size), result, "impact")
    _residuals(right, result.speeds, result, "impact speed [m/s]")
    left.set_ylabel("measured less fitted time\n[standard errors]")
    left.set_title(
        ", ".join(_value_text(name, value, result.stderr[name]) for name, value in result.values.items()),
        fontsize="small",
    )
    right.set_title(f"misfit {result.misfit.size:.3g}", fontsize="small")
    return figure


def _residuals(axes: Axes, positions: np.ndarray, result: Fit, text: str) -> None:
    included = ~result.excluded
    axes.axhspan(-_BAND, _BAND, color="0.9", zorder=0)
    axes.axhline(0, color="0.6", linewidth=0.6)
    axes.plot(positions[included], result.residuals[included], ".", color="black", markersize=3)
    axes.plot(positions[~included], np.nan_to_num(result.residuals[~included]), "x", color="tab:red", markersize=4)
    axes.set_xlabel(text)


def _value_text(name: str, value: float, error: float) -> str:
    return f"{name} = {value:.5g} $\\pm$ {error:.1g}" if np.isfinite(error) else f"{name} undetermined"
