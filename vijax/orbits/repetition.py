"""Repetition: orbits that consist of several equal turns, each an orbit of a lesser period.

An orbit of period p that is run through k times also solves the equations of the period k p. Newton finds it there
from guesses near it: of orbits born at a flip on the side where they do not exist, and of states flown for k p.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from vijax.model.pair import ImpactPair
from vijax.orbits import shooting
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.programs import jitted

_BATCHES = (8, 64, 512)  # orbits of one compiled call
_EPS = np.finfo(float).eps
# At a flip the doubled orbit is a triple root, and Newton's step beside it is a third of the distance. So an orbit is
# within three steps of it. The two turns depart from it to opposite sides and differ by six steps.
_STEPS_APART = 6.0
# At a flip the residual is b x^3 at a distance x from the doubled orbit, and the two turns differ by 2 x. In units of
# knots b is about 10 to 1000, and not below 1/8 unless the flip is nearly degenerate.
_CUBIC_APART = 4.0


def turns(sequence: Sequence, knots: Any, tolerance: float | Float[np.ndarray, " orbit"]) -> Int[np.ndarray, " orbit"]:
    """Count the turns of each orbit: the largest number of equal parts that agree to a tolerance.

    A turn lasts whole forcing periods. Of an orbit closed onto its mirror image it lasts an odd number of half periods,
    and each turn is the mirror image of the one before.

    Args:
        sequence, knots: Orbits along the leading axis.
        tolerance: Largest difference of an onset, a speed or a contact time between a turn and the next one.
    """
    side, span, mirrored, knots = (
        np.asarray(leaf) for leaf in (sequence.side, sequence.span, sequence.mirrored, knots)
    )
    count, index = (side != 0).sum(axis=1), np.arange(side.shape[1])
    # The span in the units of which a turn lasts a whole number: forcing periods, or half periods.
    length = np.round(np.where(mirrored, 1.0, 0.5) * span).astype(int)
    image = np.where(mirrored, -1, 1)[:, None]
    found = np.ones_like(count)
    for number in range(2, min(length.max(initial=1), count.max(initial=1)) + 1):
        divides = (count % number == 0) & (length % number == 0)
        shift = np.where(divides, count // number, 0)[:, None]
        after = np.minimum(index + shift, side.shape[1] - 1)
        wait = np.array([1.0, 0.0, 0.0]) * (span / number)[:, None, None]
        moved = np.take_along_axis(knots, after[..., None], axis=1) - knots - wait
        same = (np.abs(moved).max(axis=2) < np.broadcast_to(tolerance, count.shape)[:, None]) & (
            np.take_along_axis(side, after, axis=1) == image * side
        )
        last = index >= count[:, None] - shift
        found = np.where(divides & (shift[:, 0] > 0) & (same | last).all(axis=1), number, found)
    return found


def mean_turn(
    sequence: Sequence, knots: Any, number: Int[np.ndarray, " orbit"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return side, span, mirrored and knots of the mean turn of orbits that consist of so many.

    The errors that Newton leaves beside a flip differ in sign from turn to turn, so that the mean is nearly free of
    them.
    """
    side, span, mirrored, knots = (
        np.asarray(leaf) for leaf in (sequence.side, sequence.span, sequence.mirrored, knots)
    )
    count, index = ((side != 0).sum(axis=1) // number)[:, None], np.arange(side.shape[1])
    wait = np.array([1.0, 0.0, 0.0]) * (span / number)[:, None, None]
    total = np.zeros_like(knots)
    for turn in range(int(number.max(initial=1))):
        place = np.minimum(index + turn * count, side.shape[1] - 1)[..., None]
        part = np.take_along_axis(knots, place, axis=1) - turn * wait
        total += np.where((turn < number)[:, None, None], part, 0.0)
    first = index < count
    mean = np.where(first[..., None], total / number[:, None, None], 0.0)
    width = tiles.padded(int(count.max(initial=1)))
    return np.where(first, side, 0)[:, :width], span / number, mirrored, mean[:, :width]


def most_apart(residual: Float[np.ndarray, " orbit"]) -> Float[np.ndarray, " orbit"]:
    """Bound the difference between two turns that are one by the residual alone, whatever the multipliers are."""
    return _CUBIC_APART * np.cbrt(np.maximum(residual, _EPS))


def apart(
    pair: ImpactPair, sequence: Sequence, knots: Any, residual: Float[np.ndarray, " orbit"]
) -> Float[np.ndarray, " orbit"]:
    """Bound the difference between two turns that are one by the accuracy to which Newton has found the orbit.

    The accuracy is the residual times the norm of the inverse Jacobian. Beside a flip, where the multiplier is
    -1 - m, the bound is about 1e-14/m, and turns of a doubled orbit differ by 0.01 to 1 times the root of m. So both
    cases are distinguished for m above about 1e-8.
    """
    given = jax.tree.map(np.asarray, (pair, sequence, np.where(sequence.real[..., None], knots, 0.0)))
    slopes = tiles.map_tiles(lambda rows: _slopes(*rows), given, _BATCHES)
    slopes = np.nan_to_num(slopes, posinf=0.0, neginf=0.0)
    with np.errstate(divide="ignore"):
        inverse = 1 / np.linalg.svd(slopes, compute_uv=False)[:, -1]
    return np.minimum(_STEPS_APART * inverse * np.maximum(residual, _EPS), most_apart(residual))


@jitted
def _slopes(pair: ImpactPair, sequence: Sequence, knots: Float[Any, "orbit impact 3"]) -> Any:
    return jax.vmap(lambda *orbit: shooting.linearise(*orbit).slope)(pair, sequence, knots)
