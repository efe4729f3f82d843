"""Units of all quantities, and conversion of numbers with other units to plain numbers.

All computations use plain SI numbers. Values with a unit, as text or as a quantity of pint, are converted at the entry
of public functions; pint is imported only if a value has a unit.
"""

import math
import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from jaxtyping import ArrayLike

from vijax.model.quantities import ARGUMENT_QUANTITIES, AXES, SIDES, check, synonyms
from vijax.model.walls.sides import Sides
from vijax.runtime import validation
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    from pint import Quantity

QuantityLike = Union[ArrayLike, Sequence[float], "Quantity[Any]"]
"""Accepted types for a quantity: a number, an array or list of numbers, or a quantity of pint."""

UNITS = {name: quantity.unit for name, quantity in ARGUMENT_QUANTITIES.items() if quantity.unit}
"""Units of plain numbers by quantity; pure numbers are absent."""

_PI = r"pi(?![^\W\d])"  # pi that is not the beginning of a word such as picofarad
_UNIT = r"(?:[^\W\d]+|°)(?:(?:\^|\*\*)-?\d)?"
# A number, which may be a multiple of pi (pint would read pi as a unit), followed by a unit.
_WRITTEN = re.compile(
    rf"([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?(?:{_PI})?+|{_PI}))\s*({_UNIT}(?:[*/]{_UNIT})*)", re.IGNORECASE
)


def split_unit(text: str) -> tuple[str, str]:
    """Split a text into number and unit, as in 5Hz, 6pi rad/s or 20deg; the unit is empty if there is none."""
    text = text.strip()
    written = _WRITTEN.fullmatch(text)
    # A text that does not match is returned whole; the conversion to float then reports it.
    return (written[1], written[2]) if written else (text, "")


def with_unit(quantity: str, value: float, unit: str, argument: str | None = None) -> float:
    """Convert a value in some unit to a plain number of a quantity.

    Args:
        quantity: Name of the quantity in `ARGUMENT_QUANTITIES`.
        value: The value.
        unit: Text of its unit.
        argument: Name that an error uses; default is the name of the quantity.

    Raises:
        ValueError: If the unit is unknown, or is not a unit of the quantity.
    """
    return value * _factor_of(quantity, unit, argument or quantity)


def validate_quantity(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Convert an argument to plain floating-point numbers and check that they are in the range of the quantity.

    Every argument of a public function that is a physical quantity passes through this function.

    Args:
        quantity: Name of the quantity in `ARGUMENT_QUANTITIES`.
        value: A number, an array, a list, or a quantity of pint.
        argument: Name that an error uses; default is the name of the quantity.

    Raises:
        ValueError: If the unit is not a unit of the quantity, or a value is out of its range. Traced values are not
            checked.
    """
    argument = argument or quantity
    number = plain_number(quantity, value, argument)
    check(quantity, number, argument)
    return _floating(number)


def validate_per_wall(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Convert and check an argument that may be a `Sides`, each wall as `validate_quantity` does."""
    argument = argument or quantity
    if not isinstance(value, Sides):
        return validate_quantity(quantity, value, argument)
    return Sides(*(validate_quantity(quantity, getattr(value, side), f"{argument}_{side}") for side in SIDES))


def _floating(value: Any) -> Any:
    """Convert integers to floating-point numbers, the only ones that JAX differentiates."""
    if isinstance(value, int):
        return float(value)
    if isinstance(value, list | tuple):
        return np.asarray(value, float)
    return value.astype(float) if getattr(value, "dtype", np.dtype(float)).kind in "iu" else value


def plain_number(quantity: str, value: Any, argument: str | None = None) -> Any:
    """Return plain numbers for a quantity of pint, or a list of them; other values are returned unchanged.

    Args:
        quantity: Name of the quantity in `ARGUMENT_QUANTITIES`.
        value: The value.
        argument: Name that an error uses; default is the name of the quantity.

    Raises:
        ValueError: If the unit is not a unit of the quantity, or only some values of a list have a unit.
    """
    argument = argument or quantity
    if quantity not in UNITS:
        return validation.without_unit(argument, value, _hint(quantity))
    if isinstance(value, list | tuple) and any(map(validation.has_unit, value)):
        # A number without a unit among quantities is ambiguous.
        if not all(map(validation.has_unit, value)):
            raise ValueError(
                see(
                    "maps", f"{argument} must have a unit at every value or at none; got {validation.value_text(value)}"
                )
            )
        return np.array([plain_number(quantity, item, argument) for item in value])
    # The unit of an xarray array belongs to the array inside.
    if validation.is_data_array(value):
        value = value.data
    return value.magnitude * _factor(quantity, value.units, argument) if validation.has_unit(value) else value


def _hint(quantity: str) -> str:
    """Return a hint at quantities with a unit that determine the same constant as a pure number; "" if none."""
    others = [name for name in synonyms(quantity) if name in UNITS] if quantity in AXES else []
    return f"; with a unit there is {' or '.join(others)}" if others else ""


# Results are cached, because parsing a unit is slow and few units occur.
@cache
def _factor_of(quantity: str, text: str, argument: str) -> float:
    import pint

    try:
        # The registry of the application, so that units defined by the user are known.
        unit = pint.application_registry.Unit(text)
    except pint.UndefinedUnitError:
        raise ValueError(
            f"{argument} must be in {UNITS.get(quantity, 'no unit')}, or in a unit that pint knows; got {text!r}"
        ) from None
    if quantity in UNITS:
        return _factor(quantity, unit, argument)
    # The quantity is a pure number, so that `without_unit` raises an error unless the unit is dimensionless.
    return validation.without_unit(argument, 1.0 * unit, _hint(quantity))


def _factor(quantity: str, unit: Any, argument: str) -> float:
    """Return the number of the quantity's own units in one unit of pint."""
    import pint

    unit_quantity = 1.0 * unit
    try:
        factor = unit_quantity.m_as(UNITS[quantity])
    except pint.errors.PintError:
        raise ValueError(
            see("maps", f"{argument} must be in {UNITS[quantity]}, or in a unit of that kind; got one in {unit}")
        ) from None
    # Hertz means turns per second of an angular frequency, 2 pi rad/s; pint treats Hz and rad/s both as 1/s.
    power = sum(power for part, power in unit_quantity.unit_items() if part.endswith("hertz"))
    return factor * (2 * math.pi) ** (power if UNITS[quantity] == "rad/s" else 0)
