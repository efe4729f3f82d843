"""Extents of a design: when the end of its motion is known closely enough."""

import numpy as np
import pytest

from vijax.batch.simulate import Starts
from vijax.design import off_design


@pytest.mark.parametrize("off", [0.0, 5e-5, 0.02, 0.09])
def test_an_end_is_known_to_a_thousandth_of_it_or_of_the_least_step(off):
    """`Extent` is printed in percent with three digits."""
    none = np.zeros(1)
    known = max(1e-3 * off, 1e-6)
    for step, going in ((1.05 * known, True), (0.95 * known, False)):
        way = off_design._Way(0, 1, Starts(none, none, none), 1.0, off, step)
        assert way.going is going


def test_nothing_is_sought_beyond_a_tenth():
    none = np.zeros(1)
    assert not off_design._Way(0, 1, Starts(none, none, none), 1.0, 0.1, 1.0).going
