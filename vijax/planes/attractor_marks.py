"""What tells attractors of one cell apart: marks that are alike for all starts which end on the same one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vijax.model.label import FAILED, ordered
from vijax.model.records import Status

# Invariants that differ by more are of two attractors. Those of polished orbits agree to 3e-11 from start to start on a
# dozen planes of 4096 starts, and differ between attractors by 2e-2 and more. In single precision an orbit passes for
# one of twice its period.
SAME = 1e-6
ENDED = ("period", "impacts_left", "impacts_right", "status")
INVARIANTS = ("max_impact_speed", "asymmetry", "contact_fraction", "restitution_left", "restitution_right")


def kinds(measured: Mapping[str, np.ndarray], merge_mirrors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Give what is a whole number on an attractor as one, start by start; and the period, -2 where a start failed.

    Args:
        measured: The variables `ENDED` of a sweep.
        merge_mirrors: Where mirror images count as one attractor.
    """
    period = np.where(np.isin(measured["status"], FAILED), -2, measured["period"]).astype(np.int64)
    left, right = ordered(measured["impacts_left"], measured["impacts_right"], merge_mirrors)
    resting = measured["status"] == Status.PERMANENT_CONTACT
    return ((period << 20 | left + 1) << 20 | right + 1) << 1 | resting, period


def invariants(measured: Mapping[str, np.ndarray], period: np.ndarray, merge_mirrors: Any) -> tuple[np.ndarray, ...]:
    """Find what is the same for all starts of a periodic attractor and, to merge mirror images, for both of them.

    Averages over chaos differ from start to start and tell nothing apart: they are 0 here.

    Args:
        measured: The variables `INVARIANTS` of a sweep.
        period: Of every start, as `kinds` gives it.
        merge_mirrors: Where mirror images count as one attractor.
    """
    speed, asymmetry, contact, left, right = (np.nan_to_num(measured[name], nan=-1.0) for name in INVARIANTS)
    speed = np.log(np.maximum(speed, np.finfo(speed.dtype).tiny))
    asymmetry = np.where(merge_mirrors, abs(asymmetry), asymmetry)
    swapped = merge_mirrors & (left > right)
    left, right = np.where(swapped, right, left), np.where(swapped, left, right)
    return tuple(np.where(period > 0, values, 0.0) for values in (speed, asymmetry, contact, left, right))
