"""Invariants of an attractor: values that are equal for all starts that end on the same attractor of a cell.

Two starts of one cell end on the same attractor if their discrete invariants (period, impacts on each wall, at rest or
not) are equal and their continuous invariants differ by at most `INVARIANT_TOLERANCE`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vijax.model.label import FAILED, order_counts
from vijax.model.records import Status

# Two starts with a continuous invariant that differs by more than this end on different attractors. On a dozen planes
# of 4096 starts, invariants of orbits polished by Newton's method agree to 3e-11 for starts on the same attractor, and
# differ by at least 2e-2 between attractors. In single precision an orbit may be mistaken for one of twice its period.
INVARIANT_TOLERANCE = 1e-6
DISCRETE = ("period", "impacts_left", "impacts_right", "status")
INVARIANTS = ("max_impact_speed", "asymmetry", "contact_fraction", "restitution_left", "restitution_right")


def discrete_invariants(measured: Mapping[str, np.ndarray], merge_mirrors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return one integer per start that encodes its discrete invariants, and the period of its motion.

    Args:
        measured: The variables `DISCRETE` of a sweep, each [start].
        merge_mirrors: Whether mirror images count as one attractor: a bool, or a mask [start].

    Returns:
        The integer [start], and the period [start], which is -2 where the simulation of the start failed.
    """
    period = np.where(np.isin(measured["status"], FAILED), -2, measured["period"]).astype(np.int64)
    low, high = order_counts(measured["impacts_left"], measured["impacts_right"], merge_mirrors)
    at_rest = measured["status"] == Status.PERMANENT_CONTACT
    # Bit fields: period, 20 bits for each impact count (counts are at least -1, hence + 1), one bit for a ball at rest.
    return ((period << 20 | low + 1) << 20 | high + 1) << 1 | at_rest, period


def continuous_invariants(
    measured: Mapping[str, np.ndarray], period: np.ndarray, merge_mirrors: Any
) -> tuple[np.ndarray, ...]:
    """Return the continuous invariants of the attractor that each start ends on, each [start].

    If mirror images are merged, a motion and its mirror image have equal values. All values are 0 for starts without a
    period, because averages over an aperiodic motion differ from start to start and cannot separate attractors.

    Args:
        measured: The variables `INVARIANTS` of a sweep, each [start].
        period: Period of the motion of every start, as `discrete_invariants` returns it.
        merge_mirrors: Whether mirror images count as one attractor: a bool, or a mask [start].
    """
    speed, asymmetry, contact, restitution_left, restitution_right = (
        np.nan_to_num(measured[name], nan=-1.0) for name in INVARIANTS
    )
    # Logarithm of the speed, so that the tolerance is relative: the speed has no upper bound.
    speed = np.log(np.maximum(speed, np.finfo(speed.dtype).tiny))
    asymmetry = np.where(merge_mirrors, abs(asymmetry), asymmetry)
    # A mirror image exchanges the walls. The smaller restitution comes first, as the smaller impact count does in the
    # discrete invariants.
    swapped = merge_mirrors & (restitution_left > restitution_right)
    restitution_left, restitution_right = (
        np.where(swapped, restitution_right, restitution_left),
        np.where(swapped, restitution_left, restitution_right),
    )
    return tuple(
        np.where(period > 0, values, 0.0) for values in (speed, asymmetry, contact, restitution_left, restitution_right)
    )
