"""Labels of attractors: n:m/pT, with n impacts on the left and m on the right wall in p forcing periods.

Labels such as "aperiodic" or "no impact" replace n:m/pT for other motions.
"""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from vijax.model.records import Status

# Statuses of cells without a usable motion.
FAILED = (Status.EVENT_BUDGET, Status.NONFINITE)


def order_counts(left: Any, right: Any, merge_mirrors: Any) -> tuple[Any, Any]:
    """Order impact counts; where mirror images count as one attractor, the smaller count comes first.

    Args:
        left, right, merge_mirrors: Arrays of NumPy or xarray that broadcast against each other.
    """
    # Arithmetic instead of `where`, so that xarray aligns and keeps the coordinates.
    excess = (left - right) * ((left > right) & merge_mirrors)
    return left - excess, right + excess


def label(
    period: ArrayLike,
    left: ArrayLike,
    right: ArrayLike,
    status: ArrayLike = Status.OK,
    *,
    merge_mirrors: ArrayLike = False,
) -> np.ndarray:
    """Label attractors: "1:1", "1:2/2T", "aperiodic", "no impact", "permanent contact", "undecided", "failed".

    Args:
        period, left, right, status: The variables `period`, `impacts_left`, `impacts_right` and `status` of a sweep, of
            any shapes that broadcast. A period of 1 is omitted from the label.
        merge_mirrors: True where two attractors that are mirror images get one label, with the smaller count first.
            Mirror images are attractors of one device only at gamma = 0.

    Returns:
        Strings of the broadcast shape. "aperiodic" means that no period was detected within the simulated periods.
    """
    counts = order_counts(np.asarray(left), np.asarray(right), np.asarray(merge_mirrors))
    columns = np.broadcast_arrays(period, *counts, status)
    # Each distinct row is formatted once, because string operations are slow and most of a million cells share few
    # labels.
    kinds, row = np.unique(np.stack([column.ravel() for column in columns]), axis=1, return_inverse=True)
    words = np.array([_word(*(int(code) for code in kind)) for kind in kinds.T])
    return words[row].reshape(columns[0].shape)


def _word(period: int, left: int, right: int, status: int) -> str:
    if status in FAILED:
        return "failed"
    # period: -1 undecided, 0 aperiodic, otherwise the number of forcing periods.
    if period <= 0:
        return "undecided" if period else "aperiodic"
    if not left and not right:
        return "permanent contact" if status == Status.PERMANENT_CONTACT else "no impact"
    # Impacts per attractor period, not per forcing period.
    return f"{left}:{right}" + (f"/{period}T" if period > 1 else "")
