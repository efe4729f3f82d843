"""Averages of motions that are no orbit to climb from: what each ball gave over all that was flown, and where it is."""

from functools import reduce
from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.model.sides import named

LIMITS = "penetration limit", "energy ratio limit"
"""Limits of admissible impacts, in the order of margins."""

_MOST = 20.0  # logarithms of margins end here: no contact, no voltage


class Averages(NamedTuple):
    """What balls gave and met, [ball], each in a device of its own.

    Attributes:
        P: Energy harvested per half forcing period [J].
        speed: Largest speed into a wall [m/s].
        depth: Largest penetration [m].
        room: The penetration limit over that; of walls with limits of their own the less of both.
        ratio: Largest ratio of harvested energy to energy given to the membrane.
        energy_room: The energy ratio limit over that.
        lyapunov: Largest Lyapunov exponent per forcing period.
        period, left, right, status: Of the label; see `Summary`.
        periods_run: Forcing periods that were flown, up to where an orbit was certain.
        end: Where each ball was at last.
    """

    P: np.ndarray
    speed: np.ndarray
    depth: np.ndarray
    room: np.ndarray
    ratio: np.ndarray
    energy_room: np.ndarray
    lyapunov: np.ndarray
    period: np.ndarray
    left: np.ndarray
    right: np.ndarray
    status: np.ndarray
    periods_run: np.ndarray
    end: Starts

    def some(self, index: Any) -> "Averages":
        """Pick those with the given indices."""
        return jax.tree.map(lambda x: x[index], self)

    def labels(self) -> np.ndarray:
        """Name their motions; what is undecided counts as aperiodic, as its average does."""
        names = label(self.period, self.left, self.right, self.status)
        return np.where(names == "undecided", "aperiodic", names)

    def value(self, objective: str, device: Harvester) -> np.ndarray:
        """Give an objective of `OBJECTIVES` for each ball; those over tolerances are P here."""
        if objective == "speed":
            return self.speed
        return self.P * np.asarray(device.omega) / np.pi if objective == "power" else self.P

    def margins(self) -> np.ndarray:
        """Compute the logarithms [ball, 2] of what is left below each of `LIMITS`; negative where one is broken."""
        with np.errstate(divide="ignore"):
            left = np.stack([np.log(self.room), np.log(self.energy_room)], axis=-1)
        return np.minimum(left, _MOST)


def averages(device: Harvester, ended: Any) -> Averages:
    """Average what a survey's cells gave.

    Args:
        device: Of every cell: arrays [cell].
        ended: Their `Summary`, of a program whose cells have devices of their own.
    """
    length, speed = np.asarray(device.length_unit), np.asarray(device.speed_unit)
    limits = named("deepest", device.depth_limit)
    ratio = ended.energy_ratio[:, 0]
    with np.errstate(divide="ignore"):
        energy_room = np.asarray(device.energy_ratio_limit) / ratio
        rooms = [np.asarray(limit) / (getattr(ended, name) * length) for name, limit in limits.items()]
    return Averages(
        P=ended.P[:, 0],
        speed=ended.fastest * speed,
        depth=ended.deepest * length,
        room=reduce(np.minimum, rooms),
        ratio=ratio,
        energy_room=energy_room,
        lyapunov=ended.lyapunov,
        period=ended.period,
        left=ended.impacts_left,
        right=ended.impacts_right,
        status=ended.status,
        periods_run=ended.periods_run,
        end=Starts(ended.handover.u, ended.handover.v, ended.handover.t),
    )
