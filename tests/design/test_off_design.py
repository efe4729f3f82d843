"""Extents of a design: the accuracy with which the end of its motion is located."""

import numpy as np
import pytest

from vijax.design.robustness import off_design
from vijax.simulation.simulate import Starts


@pytest.mark.parametrize("off", [0.0, 5e-5, 0.02, 0.09])
def test_end_is_located_to_a_thousandth_of_its_distance(off):
    """`ParameterRange` is printed in percent with three digits."""
    none = np.zeros(1)
    accuracy = max(1e-3 * off, 1e-6)
    for step, unfinished in ((1.05 * accuracy, True), (0.95 * accuracy, False)):
        way = off_design._SideSearch(0, 1, Starts(none, none, none), 1.0, off, step)
        assert way.unfinished is unfinished


def test_search_ends_at_ten_percent():
    none = np.zeros(1)
    assert not off_design._SideSearch(0, 1, Starts(none, none, none), 1.0, 0.1, 1.0).unfinished
