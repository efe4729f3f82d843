"""Where a graze of doubled orbits, or of a mirror pair, comes back to the simpler orbit: the exact place.

Two curves cross there, at which Newton is singular: the place at which both turns touch is known to 1e-5. On the curve
of the simpler orbit alone a multiplier passes -1 there, which is regular.
"""

import equinox as eqx
import jax
import numpy as np

from vijax.orbits.arclength_step import advance
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.curve_equations import CurvePath
from vijax.orbits.curve_lanes import on_curve
from vijax.orbits.events import locate
from vijax.orbits.soft_graze import alone
from vijax.runtime import tiles

_REACH = 1e-3  # arclength on either side of a place, known to 1e-5, in which it is located once more


def merged(path: CurvePath, y: np.ndarray, kind: str, settings: ContinuationSettings) -> np.ndarray:
    """Locate the place on the curve of the simpler orbit, and run through that twice; y where it is not met near.

    Args:
        path, y: The curve of the doubled orbits, or of one of a pair, and its unknowns near the place.
        kind: "flip" or "pitchfork", how they bifurcate from the simpler one.
        settings: Of events.
    """
    count, knots = int(path.sequence.real.sum()) // 2, y[: 3 * path.sequence.side.size].reshape(-1, 3)
    paths = alone(_simpler(path, count, kind))
    start = np.zeros((paths.sequence.side.size, 3))
    start[:count] = knots[:count]
    place = on_curve(paths, np.append(start, y[-3:])[None])
    before = advance(paths, place.y, place.tangent, np.full(1, -_REACH))
    test = np.array([path.test_names.index("minus")])
    step = before.y, before.tangent, np.full(1, 2 * _REACH), test, before.tests[0, test]
    _, (there,), (sure,) = locate(paths, *step, settings)
    if not sure or np.abs(place.y[0] - there).max() > _REACH:
        return y
    once = there[: 3 * count].reshape(-1, 3)
    again = once + np.array([0.5 * float(path.sequence.span), 0.0, 0.0])
    found = np.zeros_like(knots)
    found[: 2 * count] = np.concatenate([once, again])
    return np.append(found, there[-3:])


def _simpler(path: CurvePath, count: int, kind: str) -> CurvePath:
    """Give the path of orbits with the first so many impacts, which touch once."""
    later = int(path.touch.impact) >= count
    # What the second half of a symmetric orbit does at one wall the first one does at the other.
    wall = path.touch.wall * (-1 if later and kind == "pitchfork" else 1)
    side = np.zeros(tiles.padded(count), np.int32)
    side[:count] = path.sequence.side[:count]
    own = side, 0.5 * path.sequence.span, np.bool_(kind == "pitchfork"), path.touch.impact % count, wall
    simpler = eqx.tree_at(
        lambda one: (one.sequence.side, one.sequence.span, one.sequence.mirrored, one.touch.impact, one.touch.wall),
        path,
        own,
    )
    return jax.tree.map(lambda old, new: np.asarray(new, old.dtype), path, simpler)
