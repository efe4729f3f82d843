"""Optima near a picked cell and their active limits, computed by `vijax.optimise` along an axis of the map."""

from dataclasses import dataclass
from typing import Any

from vijax.design.optimise import optimise
from vijax.explorer.plane import Axis, ExploredCell
from vijax.model.tuned_quantities import NAMES

EFFORT: dict[str, Any] = {"motion": "periodic", "survey_points": 64, "starts": 4}
"""Arguments of `optimise` for a quick answer: periodic orbits only, fewer survey points and starts than by default."""


@dataclass(frozen=True)
class NearOptimum:
    """An admissible optimum within the bounds of an axis.

    Attributes:
        value: Value of the tuned axis.
        name: Label of the motion.
        P: Energy harvested [J per half period].
        limits: Names of the active limits and bounds. Without any, "interior" for a maximum, otherwise the reason why
            the ascent stopped.
    """

    value: float
    name: str
    P: float
    limits: tuple[str, ...]


def optima(cell: ExploredCell, axis: Axis) -> list[NearOptimum]:
    """Return the optima of a cell's device along an axis of its map, the nearest to the cell first.

    Raises:
        ValueError: `optimise` cannot tune the axis (a start, for example), or the walls are rigid, which `optimise`
            does not support.
    """
    if cell.pair.kappa is None:
        raise ValueError("wall must be soft for an optimum, as designs are of membranes; got rigid; explore a soft map")
    if axis.name not in NAMES:
        raise ValueError(f"along must be an axis that a design can tune; got {axis.name}; choose the other axis")
    bounds = {axis.name: (float(axis.values[0]), float(axis.values[-1]))}
    result = optimise(cell.device, tune=axis.name, bounds=bounds, **EFFORT)
    optima = []
    for item in result.orbits:
        limits = item.active or (("interior",) if item.stopped == "maximum" else (item.stopped,))
        optima.append(NearOptimum(float(item.values[axis.name]), item.label, float(item.P), tuple(limits)))
    cell_fraction = axis.fraction(cell.arguments[axis.name])
    return sorted(optima, key=lambda item: abs(axis.fraction(item.value) - cell_fraction))
