"""The data of a test bench: times of consecutive impacts, their walls and, if measured, their speeds."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from vijax.model import units
from vijax.model.units import QuantityLike
from vijax.runtime import validation
from vijax.runtime.arrays import not_none

# Physical dimension of the arguments, for quantities with units of pint.
_KINDS = {"times": "time", "speeds": "speed"}
# With fewer impacts, and without speeds, there are never more equations than unknowns.
_FEWEST = 4


@dataclass(frozen=True)
class Series:
    """Consecutive impacts.

    Attributes:
        times: Onsets [s] [impact].
        sides: Walls, -1 or +1 [impact].
        speeds: Impact speeds [m/s] [impact]; None if not measured.
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
        """Number of equations: one per inner impact, and one per interval with a measured speed at its start."""
        return self.times.size - 2 + (0 if self.speeds is None else self.times.size - 1)


def validate_series(
    times: QuantityLike,
    sides: QuantityLike | None,
    speeds: QuantityLike | None,
    timing_error: float,
    speed_error: float | None,
) -> Series:
    """Validate measured impacts.

    Raises:
        ValueError: With the argument, the requirement and the value.
    """
    when = _row("times", times)
    if when.size < _FEWEST:
        raise ValueError(f"times must be at least {_FEWEST} impacts; got {when.size}")
    # The first time has no predecessor.
    rises = np.append(True, np.diff(when) > 0)
    if not rises.all():
        raise ValueError(
            f"times must rise from impact to impact; got {validation.first_invalid(when, rises)}; sort the impacts, "
            "and take out those that were counted twice"
        )
    if sides is None and speeds is None:
        raise ValueError("sides must be given, -1 left or +1 right of every impact, or velocities as speeds; got none")
    fast = None if speeds is None else _row_of("speeds", speeds, when.size)
    if sides is None and len(np.unique(np.sign(not_none(fast)))) < 2:
        raise ValueError(
            "speeds must be velocities, negative at the left wall, where sides are left out; got one sign alone; "
            "give sides"
        )
    if fast is not None and not fast.all():
        raise ValueError(
            f"speeds must not be 0; got {validation.first_invalid(fast, fast != 0)}; leave such an impact out"
        )
    # Without sides the signs of the velocities specify the walls.
    walls = np.sign(not_none(fast)) if sides is None else _row_of("sides", sides, when.size)
    good = np.abs(walls) == 1
    if not good.all():
        raise ValueError(f"sides must be -1 left or +1 right; got {validation.first_invalid(walls, good)}")
    if fast is not None and (fast < 0).any() and (np.sign(fast) != walls).any():
        wrong = validation.first_invalid(fast, np.sign(fast) == walls)
        raise ValueError(f"speeds must have the signs of sides, or none; got {wrong}, where the wall is another")
    if (fast is None) != (speed_error is None):
        got = "none" if speed_error is None else f"{validation.value_text(speed_error)} without speeds"
        raise ValueError(f"speed_error must be given with speeds, their standard error in m/s; got {got}")
    return Series(
        times=when,
        sides=walls,
        speeds=None if fast is None else np.abs(fast),
        timing_error=_positive("timing_error", "time", timing_error),
        speed_error=0.0 if speed_error is None else _positive("speed_error", "speed", speed_error),
    )


def _positive(name: str, quantity: str, value: Any) -> float:
    return validation.validate_positive(name, units.plain_number(quantity, value, name))


def _row(name: str, values: Any) -> np.ndarray:
    if isinstance(values, list | tuple) and not len(values):
        raise ValueError(f"{name} must be one number an impact, of at least {_FEWEST}; got none")
    array = np.asarray(
        validation.validate_finite(name, units.plain_number(_KINDS.get(name, name), values, name)), float
    )
    if array.ndim != 1:
        raise ValueError(f"{name} must be a row of numbers, one an impact; got shape {array.shape}")
    return array


def _row_of(name: str, values: Any, count: int) -> np.ndarray:
    array = _row(name, values)
    if array.size != count:
        raise ValueError(f"{name} must hold one number a time, {count}; got {array.size}")
    return array
