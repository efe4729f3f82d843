"""Names of attractors: n:m/pT, n impacts on the left and m on the right wall in p forcing periods."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from vijax.model.records import Status

FAILED = (Status.EVENT_BUDGET, Status.NONFINITE)


def ordered(left: Any, right: Any, merge_mirrors: Any) -> tuple[Any, Any]:
    """Order impact counts: where mirror images are to count as one attractor, the smaller first.

    Args:
        left, right, merge_mirrors: Arrays of NumPy or of xarray that broadcast.
    """
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
    """Name attractors: "1:1", "1:2/2T", "aperiodic", "no impact", "permanent contact", "undecided", "failed".

    Args:
        period, left, right, status: The variables `period`, `impacts_left`, `impacts_right` and `status` of a sweep, of
            any shapes that broadcast. A period of 1 is not written.
        merge_mirrors: Where to name mirror images alike, by the smaller count first; they are two attractors of one
            device at gamma = 0 alone.

    Returns:
        Strings of the broadcast shape. "aperiodic" means: no period found within the periods run.
    """
    counts = ordered(np.asarray(left), np.asarray(right), np.asarray(merge_mirrors))
    columns = np.broadcast_arrays(period, *counts, status)
    # As words are slow, one a kind: of a million cells most are alike.
    kinds, which = np.unique(np.stack([column.ravel() for column in columns]), axis=1, return_inverse=True)
    words = np.array([_word(*(int(code) for code in kind)) for kind in kinds.T])
    return words[which].reshape(columns[0].shape)


def _word(period: int, left: int, right: int, status: int) -> str:
    if status in FAILED:
        return "failed"
    if period <= 0:
        return "undecided" if period else "aperiodic"
    if not left and not right:
        return "permanent contact" if status == Status.PERMANENT_CONTACT else "no impact"
    return f"{left}:{right}" + (f"/{period}T" if period > 1 else "")
