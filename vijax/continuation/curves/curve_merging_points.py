"""Points where a curve of grazing of doubled orbits, or of a mirror pair, merges with the curve of the simpler orbit.

Two curves cross there, so that the equations are singular and the point, where both halves of the orbit graze, is
accurate to 1e-5 only. On the curve of the simpler orbit a multiplier passes -1 there, and the equations are regular.
"""

import equinox as eqx
import jax
import numpy as np

from vijax.continuation.arclength_step import predict_and_correct
from vijax.continuation.branch_events import locate
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.curves.curve_equations import CurvePath
from vijax.continuation.curves.curve_preparation import correct_onto_curve
from vijax.continuation.grazing_switch import with_leading_axis
from vijax.runtime import tiles

_REACH = 1e-3  # arclength on either side of a point (accurate to 1e-5) within which it is located again


def locate_on_simpler_curve(path: CurvePath, y: np.ndarray, kind: str, settings: ContinuationSettings) -> np.ndarray:
    """Locate the point on the curve of the simpler orbit, and return the unknowns of the doubled simpler orbit.

    The doubled orbit is the stored orbit and its repetition, as one orbit. If there is no such point near y, the
    function returns y unchanged.

    Args:
        path, y: The curve of grazing of doubled orbits, or of one orbit of each mirror pair, and its unknowns near the
            point.
        kind: "flip" or "pitchfork", the bifurcation from the simpler orbit.
        settings: Settings of events.
    """
    count, impact_unknowns = int(path.sequence.real.sum()) // 2, y[: 3 * path.sequence.side.size].reshape(-1, 3)
    paths = with_leading_axis(_simpler_path(path, count, kind))
    # Impact unknowns of the first half, padded to the width of the simpler path.
    start = np.zeros((paths.sequence.side.size, 3))
    start[:count] = impact_unknowns[:count]
    point = correct_onto_curve(paths, np.append(start, y[-3:])[None])
    # The search covers the same distance on both sides of the point.
    before = predict_and_correct(paths, point.y, point.tangent, np.full(1, -_REACH))
    test = np.array([path.test_names.index("minus")])
    search = before.y, before.tangent, np.full(1, 2 * _REACH), test, before.tests[0, test]
    _, (located,), (is_zero,) = locate(paths, *search, settings)
    if not is_zero or np.abs(point.y[0] - located).max() > _REACH:
        return y
    first_half = located[: 3 * count].reshape(-1, 3)
    # The second half is the first one, half a span later.
    second_half = first_half + np.array([0.5 * float(path.sequence.span), 0.0, 0.0])
    doubled = np.zeros_like(impact_unknowns)
    doubled[: 2 * count] = np.concatenate([first_half, second_half])
    return np.append(doubled, located[-3:])


def _simpler_path(path: CurvePath, count: int, kind: str) -> CurvePath:
    """Return the path of orbits with the first `count` impacts only, which graze once."""
    in_second_half = int(path.location.impact) >= count
    # The second half of a symmetric orbit is the first half with the walls interchanged.
    wall = path.location.wall * (-1 if in_second_half and kind == "pitchfork" else 1)
    side = np.zeros(tiles.padded(count), np.int32)
    side[:count] = path.sequence.side[:count]
    fields = side, 0.5 * path.sequence.span, np.bool_(kind == "pitchfork"), path.location.impact % count, wall
    simpler = eqx.tree_at(
        lambda path_item: (
            path_item.sequence.side,
            path_item.sequence.span,
            path_item.sequence.mirrored,
            path_item.location.impact,
            path_item.location.wall,
        ),
        path,
        fields,
    )
    # Leaves keep their types, so that the programs compiled for other paths are reused.
    return jax.tree.map(lambda old, new: np.asarray(new, old.dtype), path, simpler)
