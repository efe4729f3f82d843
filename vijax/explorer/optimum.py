"""The optimum nearest to a picked cell, and what limits it there: `vijax.optimise` along an axis of the map."""

from dataclasses import dataclass
from typing import Any

from vijax.design.optimise import optimise
from vijax.explorer.plane import Axis, ExploredCell
from vijax.model.variables import NAMES

EFFORT: dict[str, Any] = {"motion": "periodic", "survey_points": 64, "starts": 4}
"""How far `optimise` looks here: orbits alone, from fewer values and starts than it takes unless told."""


@dataclass(frozen=True)
class NearOptimum:
    """An admissible optimum within the bounds of an axis.

    Attributes:
        value: Of the axis that was tuned.
        name: Its label.
        P: [J per half period].
        limits: What holds it there: constraints, bounds, or "interior".
    """

    value: float
    name: str
    P: float
    limits: tuple[str, ...]


def optima(cell: ExploredCell, axis: Axis) -> list[NearOptimum]:
    """Find the optima of a cell's device along an axis of its map, the nearest to the cell first.

    Raises:
        ValueError: An axis that no design can tune: a start is none. Rigid walls, which no design has.
    """
    if cell.pair.kappa is None:
        raise ValueError("wall must be soft for an optimum, as designs are of membranes; got rigid; explore a soft map")
    if axis.name not in NAMES:
        raise ValueError(f"along must be an axis that a design can tune; got {axis.name}; choose the other axis")
    bounds = {axis.name: (float(axis.values[0]), float(axis.values[-1]))}
    found = optimise(cell.device, tune=axis.name, bounds=bounds, **EFFORT)
    listed = []
    for one in found.orbits:
        limits = one.active or (("interior",) if one.stopped == "maximum" else (one.stopped,))
        listed.append(NearOptimum(float(one.values[axis.name]), one.label, float(one.P), tuple(limits)))
    here = axis.part(cell.arguments[axis.name])
    return sorted(listed, key=lambda one: abs(axis.part(one.value) - here))
