"""Averages and extremes of motions over the simulated periods, for orbits and aperiodic motion alike; final states.

Margins are logarithms of safety factors: log(limit / largest value). A margin is negative if the limit is broken.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.model.walls.sides import values_by_name
from vijax.simulation.simulate import Starts

LIMIT_NAMES = "penetration limit", "energy ratio limit"
"""Names of the limits of admissible impacts, in the order of the margins."""

_LARGEST_MARGIN = 20.0  # cap on margins, which are infinite without contact or voltage


class Averages(NamedTuple):
    """Averages and extremes of motions, [sample]; each sample has a device of its own.

    Attributes:
        P: Energy harvested per half forcing period [J].
        speed: Largest speed into a wall [m/s].
        depth: Largest penetration [m].
        depth_safety_factor: Penetration limit / largest penetration; the smaller of two values if each wall has a limit
            of its own.
        ratio: Largest ratio of harvested energy to energy given to the membrane.
        energy_safety_factor: Energy ratio limit / largest ratio.
        lyapunov: Largest Lyapunov exponent per forcing period.
        period, left, right, status: Period in forcing periods, left and right impacts per period, and status; see
            `Summary`.
        periods_run: Simulated forcing periods; a simulation ends early if it settles on an orbit.
        end: Final state of each sample.
    """

    P: np.ndarray
    speed: np.ndarray
    depth: np.ndarray
    depth_safety_factor: np.ndarray
    ratio: np.ndarray
    energy_safety_factor: np.ndarray
    lyapunov: np.ndarray
    period: np.ndarray
    left: np.ndarray
    right: np.ndarray
    status: np.ndarray
    periods_run: np.ndarray
    end: Starts

    def select(self, index: Any) -> "Averages":
        """Return the samples with the specified indices."""
        return jax.tree.map(lambda x: x[index], self)

    def labels(self) -> np.ndarray:
        """Return the labels of the motions.

        An undecided motion did not settle within the run. It is labelled aperiodic, because its average over the run is
        computed in the same way.
        """
        names = label(self.period, self.left, self.right, self.status)
        # "undecided" means that the run was too short to confirm an orbit or chaos.
        return np.where(names == "undecided", "aperiodic", names)

    def value(self, objective: str, device: Harvester) -> np.ndarray:
        """Return the value of an objective of `OBJECTIVES` for each sample.

        For "mean", "worst" and "expected" this value is P, which is averaged elsewhere.
        """
        if objective == "speed":
            return self.speed
        # P is the energy per half forcing period, pi/omega seconds.
        return self.P * np.asarray(device.omega) / np.pi if objective == "power" else self.P

    def margins(self) -> np.ndarray:
        """Return the margins [sample, 2] to the limits in `LIMIT_NAMES`: ln(limit / largest value), at most 20."""
        with np.errstate(divide="ignore"):
            margins = np.stack([np.log(self.depth_safety_factor), np.log(self.energy_safety_factor)], axis=-1)
        return np.minimum(margins, _LARGEST_MARGIN)


def summary_averages(device: Harvester, summary: Any) -> Averages:
    """Compute the averages of the cells of a survey.

    Args:
        device: Device of every cell: arrays [cell].
        summary: `Summary` of the cells; column 0 of its P and energy ratio is the device of the cell.
    """
    length, speed = np.asarray(device.length_unit), np.asarray(device.speed_unit)
    # Where the walls differ, `values_by_name` lists one limit under deepest_left and one under deepest_right.
    limits = values_by_name("deepest", device.depth_limit)
    ratio = summary.energy_ratio[:, 0]
    with np.errstate(divide="ignore"):
        # Without contact the depth and the energy ratio are 0, and the safety factors are infinite.
        energy_safety_factor = np.asarray(device.energy_ratio_limit) / ratio
        # Depths of a summary are nondimensional; limits are in metres.
        depth_safety_factors = [np.asarray(limit) / (getattr(summary, name) * length) for name, limit in limits.items()]
    return Averages(
        # Column 0 belongs to the device itself; further columns are variants with shifted constants.
        P=summary.P[:, 0],
        speed=summary.fastest * speed,
        depth=summary.deepest * length,
        depth_safety_factor=reduce(np.minimum, depth_safety_factors),
        ratio=ratio,
        energy_safety_factor=energy_safety_factor,
        lyapunov=summary.lyapunov,
        period=summary.period,
        left=summary.impacts_left,
        right=summary.impacts_right,
        status=summary.status,
        periods_run=summary.periods_run,
        end=Starts(summary.handover.u, summary.handover.v, summary.handover.t),
    )
