"""What a bench has measured: the times of impacts in a row, their walls and, where it can, their speeds."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from vijax.model import units
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.arrays import present

# What units of pint these may have: those of such a quantity.
_KINDS = {"times": "time", "speeds": "speed"}
# With fewer impacts there is no equation for any unknown.
_FEWEST = 4


@dataclass(frozen=True)
class Series:
    """Impacts in a row.

    Attributes:
        times: Onsets [s] [impact].
        sides: Walls, -1 or +1 [impact].
        speeds: Impact speeds [m/s] [impact]; None where none were measured.
        timing_error: Standard error of a time [s].
        speed_error: Standard error of a speed [m/s].
    """

    times: np.ndarray
    sides: np.ndarray
    speeds: np.ndarray | None
    timing_error: float
    speed_error: float

    @property
    def equations(self) -> int:
        """Count what it says: that impacts hang together, and how fast they are."""
        return self.times.size - 2 + (0 if self.speeds is None else self.times.size - 1)


def take_series(
    times: Given, sides: Given | None, speeds: Given | None, timing_error: float, speed_error: float | None
) -> Series:
    """Take measured impacts.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    when = _row("times", times)
    if when.size < _FEWEST:
        raise ValueError(f"times must be at least {_FEWEST} impacts; got {when.size}")
    rises = np.append(True, np.diff(when) > 0)
    if not rises.all():
        raise ValueError(
            f"times must rise from impact to impact; got {checks.first(when, rises)}; sort the impacts, and take out "
            "those that were counted twice"
        )
    if sides is None and speeds is None:
        raise ValueError("sides must be given, -1 left or +1 right of every impact, or velocities as speeds; got none")
    fast = None if speeds is None else _of_each("speeds", speeds, when.size)
    if sides is None and len(np.unique(np.sign(present(fast)))) < 2:
        raise ValueError(
            "speeds must be velocities, negative at the left wall, where sides are left out; got one sign alone; "
            "give sides"
        )
    if fast is not None and not fast.all():
        raise ValueError(f"speeds must not be 0; got {checks.first(fast, fast != 0)}; leave such an impact out")
    walls = np.sign(present(fast)) if sides is None else _of_each("sides", sides, when.size)
    good = np.abs(walls) == 1
    if not good.all():
        raise ValueError(f"sides must be -1 left or +1 right; got {checks.first(walls, good)}")
    if fast is not None and (fast < 0).any() and (np.sign(fast) != walls).any():
        wrong = checks.first(fast, np.sign(fast) == walls)
        raise ValueError(f"speeds must have the signs of sides, or none; got {wrong}, where the wall is another")
    if (fast is None) != (speed_error is None):
        got = "none" if speed_error is None else f"{checks.shown(speed_error)} without speeds"
        raise ValueError(f"speed_error must be given with speeds, their standard error in m/s; got {got}")
    return Series(
        times=when,
        sides=walls,
        speeds=None if fast is None else np.abs(fast),
        timing_error=_positive("timing_error", "time", timing_error),
        speed_error=0.0 if speed_error is None else _positive("speed_error", "speed", speed_error),
    )


def _positive(name: str, quantity: str, value: Any) -> float:
    return checks.positive(name, units.plain(quantity, value, name))


def _row(name: str, values: Any) -> np.ndarray:
    if isinstance(values, list | tuple) and not len(values):
        raise ValueError(f"{name} must be one number an impact, of at least {_FEWEST}; got none")
    array = np.asarray(checks.finite(name, units.plain(_KINDS.get(name, name), values, name)), float)
    if array.ndim != 1:
        raise ValueError(f"{name} must be a row of numbers, one an impact; got shape {array.shape}")
    return array


def _of_each(name: str, values: Any, count: int) -> np.ndarray:
    array = _row(name, values)
    if array.size != count:
        raise ValueError(f"{name} must hold one number a time, {count}; got {array.size}")
    return array
