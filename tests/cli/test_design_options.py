"""Tolerances in the options of `vijax design`."""

import pytest

from vijax.cli.commands.design import _tolerances
from vijax.design.robustness.tolerance import Tolerance


def test_constants_that_may_be_tuned_may_have_a_tolerance():
    assert _tolerances(["k=5%,s=0.02"]) == (Tolerance("k", 0.05), Tolerance("s", 0.02))
    with pytest.raises(ValueError, match="--tolerance: tolerances must name a constant once; got k, omega0"):
        _tolerances(["k=5%,omega0=5%"])
    with pytest.raises(ValueError, match="--tolerance: spread must be a number between 0 and 1"):
        _tolerances(["k=150%"])
