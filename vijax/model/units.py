"""Units: that of every quantity, and how a number with another one becomes a plain number in it.

All that is computed is computed with plain SI numbers. What comes with a unit, as text or as a quantity of pint, is
converted at the door; pint is imported only where there is one.
"""

import math
import re
import sys
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from jaxtyping import ArrayLike

from vijax.model.quantities import AXES, MEASURED, QUANTITIES, synonyms
from vijax.runtime import checks
from vijax.runtime.pages import see

if TYPE_CHECKING:
    from pint import Quantity

Given = Union[ArrayLike, Sequence[float], "Quantity[Any]"]
"""What may be given for a quantity: a number, an array or list of them, or such a quantity of pint."""

UNITS = {name: quantity.unit for name, quantity in QUANTITIES.items() if quantity.unit}
UNITS |= {"depth": MEASURED["depth"].units, "time": "s", "speed": "m/s", "acceleration": "m/s^2"}
"""What plain numbers are in; a quantity that is not here has no unit."""

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


def with_unit(name: str, value: float, unit: str) -> float:
    """Convert a value in some unit to a plain number of the quantity `name`.

    Raises:
        ValueError: If no such unit is known, or it is not one of the quantity.
    """
    return value * _factor_of(name, unit)


def plain(name: str, value: Any) -> Any:
    """Turn a quantity of pint, or a list of them, into plain numbers; return whatever else comes as it is.

    Args:
        name: The quantity that is meant.
        value: What came.

    Raises:
        ValueError: If its unit is not one of the quantity, or only some of a list have one.
    """
    if isinstance(value, list | tuple) and any(map(_has_unit, value)):
        if not all(map(_has_unit, value)):
            raise ValueError(
                see("maps", f"{name} must have a unit at every value or at none; got {checks.shown(value)}")
            )
        return np.array([plain(name, one) for one in value])
    return value.magnitude * _factor(name, value.units) if _has_unit(value) else value


def _has_unit(value: Any) -> bool:
    # Without it, or while another thread is still importing it, nobody has made a quantity.
    kind = getattr(sys.modules.get("pint"), "Quantity", None)
    return kind is not None and isinstance(value, kind)


@cache
def _factor_of(name: str, text: str) -> float:
    import pint

    try:
        return _factor(name, pint.application_registry.Unit(text))
    except pint.UndefinedUnitError:
        raise ValueError(
            f"{name} must be in {UNITS.get(name, 'no unit')}, or in a unit that pint knows; got {text!r}"
        ) from None


def _factor(name: str, unit: Any) -> float:
    """Find how many of the quantity's own units a unit of pint is."""
    import pint

    one = 1.0 * unit
    if name not in UNITS:
        if one.unitless:
            return 1.0
        others = [one for one in synonyms(name) if one in UNITS] if name in AXES else []
        hint = f"; with a unit there is {' or '.join(others)}" if others else ""
        raise ValueError(see("maps", f"{name} must be a number without a unit; got one in {unit}{hint}"))
    try:
        factor = one.m_as(UNITS[name])
    except pint.errors.PintError:
        raise ValueError(
            see("maps", f"{name} must be in {UNITS[name]}, or in a unit of that kind; got one in {unit}")
        ) from None
    # Of what turns, hertz counts the turns; to pint it is 1/s, as rad/s is.
    turns = sum(power for part, power in one.unit_items() if part.endswith("hertz")) if UNITS[name] == "rad/s" else 0
    return factor * (2 * math.pi) ** turns
