"""Units: that of every quantity, and how a number with another one becomes a plain number in it.

All that is computed is computed with plain SI numbers. What comes with a unit, as text or as a quantity of pint, is
converted at the door; pint is imported only where there is one.
"""

import math
import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from jaxtyping import ArrayLike

from vijax.model.quantities import AXES, GIVEN, SIDES, check, synonyms
from vijax.model.sides import Sides
from vijax.runtime import checks
from vijax.runtime.pages import see

if TYPE_CHECKING:
    from pint import Quantity

Given = Union[ArrayLike, Sequence[float], "Quantity[Any]"]
"""What may be given for a quantity: a number, an array or list of them, or such a quantity of pint."""

UNITS = {name: quantity.unit for name, quantity in GIVEN.items() if quantity.unit}
"""Units of plain numbers; a quantity that is not here has none."""

_PI = r"pi(?![^\W\d])"  # not the pico of picofarads
_ONE = r"(?:[^\W\d]+|°)(?:(?:\^|\*\*)-?\d)?"
# A multiple of pi keeps its pi, which pint would take for a unit.
_WRITTEN = re.compile(
    rf"([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?(?:{_PI})?+|{_PI}))\s*({_ONE}(?:[*/]{_ONE})*)", re.IGNORECASE
)


def split(text: str) -> tuple[str, str]:
    """Split a number and its unit, as in 5Hz, 6pi rad/s or 20deg; the unit is empty where there is none."""
    text = text.strip()
    written = _WRITTEN.fullmatch(text)
    return (written[1], written[2]) if written else (text, "")


def with_unit(quantity: str, value: float, unit: str, argument: str | None = None) -> float:
    """Return a value in some unit as a plain number of a quantity.

    Args:
        quantity: Name of the quantity in `GIVEN`.
        value: The value.
        unit: Text of its unit.
        argument: Name that an error uses; that of the quantity unless given.

    Raises:
        ValueError: If no such unit is known, or it is not one of the quantity.
    """
    return value * _factor_of(quantity, unit, argument or quantity)


def given(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Return what was given for a quantity as plain floating-point numbers, each allowed by the table of quantities.

    Every argument of a public function that is a physical quantity passes through here.

    Args:
        quantity: Name of the quantity in `GIVEN`.
        value: A number, an array, a list, or a quantity of pint.
        argument: Name that an error uses; that of the quantity unless given.

    Raises:
        ValueError: A unit that is not one of the quantity, or a value that the quantity cannot have. Traced values
            are not looked at.
    """
    argument = argument or quantity
    found = plain(quantity, value, argument)
    check(quantity, found, argument)
    return _floating(found)


def given_each(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Return what was given for a quantity of the walls, as `given` does: of both, or `Sides` of what each has."""
    argument = argument or quantity
    if not isinstance(value, Sides):
        return given(quantity, value, argument)
    return Sides(*(given(quantity, getattr(value, side), f"{argument}_{side}") for side in SIDES))


def _floating(value: Any) -> Any:
    """Return whole numbers as floating-point ones, of which alone JAX computes derivatives."""
    if isinstance(value, int):
        return float(value)
    if isinstance(value, list | tuple):
        return np.asarray(value, float)
    return value.astype(float) if getattr(value, "dtype", np.dtype(float)).kind in "iu" else value


def plain(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Return plain numbers for a quantity of pint, or a list of them; anything else is returned as it is.

    Args:
        quantity: Name of the quantity in `GIVEN`.
        value: The value.
        argument: Name that an error uses; that of the quantity unless given.

    Raises:
        ValueError: If its unit is not one of the quantity, or only some values of a list have one.
    """
    argument = argument or quantity
    if quantity not in UNITS:
        return checks.pure(argument, value, _hint(quantity))
    if isinstance(value, list | tuple) and any(map(checks.has_unit, value)):
        if not all(map(checks.has_unit, value)):
            raise ValueError(
                see("maps", f"{argument} must have a unit at every value or at none; got {checks.shown(value)}")
            )
        return np.array([plain(quantity, one, argument) for one in value])
    if checks.is_data_array(value):
        value = value.data
    return value.magnitude * _factor(quantity, value.units, argument) if checks.has_unit(value) else value


def _hint(quantity: str) -> str:
    """Return a hint at the quantities with a unit that decide the same as one without; "" if there are none."""
    others = [one for one in synonyms(quantity) if one in UNITS] if quantity in AXES else []
    return f"; with a unit there is {' or '.join(others)}" if others else ""


@cache
def _factor_of(quantity: str, text: str, argument: str) -> float:
    import pint

    try:
        unit = pint.application_registry.Unit(text)
    except pint.UndefinedUnitError:
        raise ValueError(
            f"{argument} must be in {UNITS.get(quantity, 'no unit')}, or in a unit that pint knows; got {text!r}"
        ) from None
    if quantity in UNITS:
        return _factor(quantity, unit, argument)
    return checks.pure(argument, 1.0 * unit, _hint(quantity))


def _factor(quantity: str, unit: Any, argument: str) -> float:
    """Return how many of the quantity's own units a unit of pint is."""
    import pint

    one = 1.0 * unit
    try:
        factor = one.m_as(UNITS[quantity])
    except pint.errors.PintError:
        raise ValueError(
            see("maps", f"{argument} must be in {UNITS[quantity]}, or in a unit of that kind; got one in {unit}")
        ) from None
    # Hertz counts the turns of an angular frequency; to pint it is 1/s, as rad/s is.
    power = sum(power for part, power in one.unit_items() if part.endswith("hertz"))
    return factor * (2 * math.pi) ** (power if UNITS[quantity] == "rad/s" else 0)
