"""Pictures of fits."""

import numpy as np
import pytest

import vijax
from tests.fitting.bench import measured


def test_residuals_are_drawn_and_excluded_impacts_are_crossed():
    device = vijax.Harvester(s=0.02, omega=10.0, A=3.0, r=0.6)
    impacts = measured(device, 40, wall="rigid", error=1e-4)
    times = impacts.times.copy()
    times[20] += 0.02
    result = vijax.fit(times, impacts.sides, timing_error=1e-4, device=device, unknown="r", wall="rigid")
    figure = vijax.plots.fit(result)
    left, right = figure.axes
    points, crosses = left.lines[1:]
    assert np.flatnonzero(result.excluded).tolist() == crosses.get_xdata().tolist()
    assert 20 in crosses.get_xdata()
    assert points.get_ydata().size + crosses.get_ydata().size == times.size
    np.testing.assert_array_equal(right.lines[1].get_xdata(), result.speeds[~result.excluded])
    assert left.get_title().startswith(f"r = {result.values['r']:.5g}")


def test_other_records_raise():
    with pytest.raises(ValueError, match="result must be of the kind Fit"):
        vijax.plots.fit({})
