"""Detection of orbits that consist of several equal repetitions of an orbit with a lesser period.

An orbit of period p repeated k times also solves the equations of period k p. Newton's method converges to such a
repeated orbit from nearby guesses: for example from the guess of a period-doubled orbit at parameters where only the
orbit of period p exists, or from states simulated for k p periods.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted

_BATCHES = (8, 64, 512)  # numbers of orbits in one compiled call
_EPS = np.finfo(float).eps
# At a flip the orbit repeated twice is a triple root of the equations. Near a triple root Newton's step is a third of
# the distance, so that the computed orbit is within three steps of the root. Its two repetitions deviate from the root
# to opposite sides, so that they differ by at most six steps.
_STEPS_BETWEEN = 6.0
# At a flip the residual is b x^3 at a distance x from this triple root, and the two repetitions differ by 2 x. In the
# units of the impact unknowns b is about 10 to 1000, and not below 1/8 unless the flip is nearly degenerate. 2 x = 2
# (residual/b)^(1/3) = 4 residual^(1/3) for b = 1/8.
_CUBIC_FACTOR = 4.0


def count_repetitions(
    sequence: Sequence, impact_unknowns: Any, tolerance: float | Float[np.ndarray, " orbit"]
) -> Int[np.ndarray, " orbit"]:
    """Count the repetitions in each orbit: the largest number of equal parts that agree to a tolerance.

    A repetition takes a whole number of forcing periods. If half of a symmetric orbit is stored (`mirrored`), a
    repetition takes an odd number of half forcing periods, and each repetition is the mirror image of the previous one.

    Args:
        sequence, impact_unknowns: Orbits along the leading axis.
        tolerance: Largest difference of an onset, a speed or a contact duration between a repetition and the next one.
    """
    side, span, mirrored, impact_unknowns = (
        np.asarray(leaf) for leaf in (sequence.side, sequence.span, sequence.mirrored, impact_unknowns)
    )
    count, index = (side != 0).sum(axis=1), np.arange(side.shape[1])
    # The span as a whole number of forcing periods, or of half periods if mirrored; the number of repetitions divides
    # it.
    length = np.round(np.where(mirrored, 1.0, 0.5) * span).astype(int)
    image = np.where(mirrored, -1, 1)[:, None]
    largest = np.ones_like(count)
    for number in range(2, min(length.max(initial=1), count.max(initial=1)) + 1):
        # Orbits with impacts or a span not divisible by `number` are excluded.
        divides = (count % number == 0) & (length % number == 0)
        shift = np.where(divides, count // number, 0)[:, None]
        after = np.minimum(index + shift, side.shape[1] - 1)
        delay = np.array([1.0, 0.0, 0.0]) * (span / number)[:, None, None]
        moved = np.take_along_axis(impact_unknowns, after[..., None], axis=1) - impact_unknowns - delay
        # Compare each impact with the impact `shift` places later; the last `shift` impacts have no counterpart.
        same = (np.abs(moved).max(axis=2) < np.broadcast_to(tolerance, count.shape)[:, None]) & (
            np.take_along_axis(side, after, axis=1) == image * side
        )
        last = index >= count[:, None] - shift
        largest = np.where(divides & (shift[:, 0] > 0) & (same | last).all(axis=1), number, largest)
    return largest


def mean_repetition(
    sequence: Sequence, impact_unknowns: Any, number: Int[np.ndarray, " orbit"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return side, span, mirrored and impact unknowns of the mean of the `number` repetitions in each orbit.

    The errors that Newton's method leaves next to a flip differ in sign from one repetition to the next, so that the
    mean is nearly free of them.
    """
    side, span, mirrored, impact_unknowns = (
        np.asarray(leaf) for leaf in (sequence.side, sequence.span, sequence.mirrored, impact_unknowns)
    )
    count, index = ((side != 0).sum(axis=1) // number)[:, None], np.arange(side.shape[1])
    delay = np.array([1.0, 0.0, 0.0]) * (span / number)[:, None, None]
    total = np.zeros_like(impact_unknowns)
    for index_of_repetition in range(int(number.max(initial=1))):
        place = np.minimum(index + index_of_repetition * count, side.shape[1] - 1)[..., None]
        part = np.take_along_axis(impact_unknowns, place, axis=1) - index_of_repetition * delay
        total += np.where((index_of_repetition < number)[:, None, None], part, 0.0)
    is_first = index < count
    mean = np.where(is_first[..., None], total / number[:, None, None], 0.0)
    width = tiles.padded(int(count.max(initial=1)))
    return np.where(is_first, side, 0)[:, :width], span / number, mirrored, mean[:, :width]


def residual_bound(residual: Float[np.ndarray, " orbit"]) -> Float[np.ndarray, " orbit"]:
    """Bound the numerical difference of two equal repetitions by the residual alone, for any multipliers."""
    return _CUBIC_FACTOR * np.cbrt(np.maximum(residual, _EPS))


def difference_bound(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: Any, residual: Float[np.ndarray, " orbit"]
) -> Float[np.ndarray, " orbit"]:
    """Bound the numerical difference of two equal repetitions by the accuracy of the solution.

    The accuracy is the residual times the norm of the inverse Jacobian; `residual_bound` applies if it is smaller. Next
    to a flip, with a multiplier of -1 - m, the bound is about 1e-14/m, and the two halves of a true period-doubled
    orbit differ by 0.01 to 1 times the square root of m. So the two cases are distinguished for m above about 1e-8.
    """
    inputs = jax.tree.map(np.asarray, (pair, sequence, np.where(sequence.real[..., None], impact_unknowns, 0.0)))
    slopes = tiles.map_tiles(lambda rows: _slopes(*rows), inputs, _BATCHES)
    slopes = np.nan_to_num(slopes, posinf=0.0, neginf=0.0)
    with np.errstate(divide="ignore"):
        # The norm of the inverse is one over the smallest singular value; inf at a singular Jacobian, where
        # `residual_bound` applies.
        inverse = 1 / np.linalg.svd(slopes, compute_uv=False)[:, -1]
    return np.minimum(_STEPS_BETWEEN * inverse * np.maximum(residual, _EPS), residual_bound(residual))


@jitted
def _slopes(pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[Any, "orbit impact 3"]) -> Any:
    return jax.vmap(lambda *orbit: shooting.linearise(*orbit).slope)(pair, sequence, impact_unknowns)
