"""Types of option values: their text in help and completion, and their errors.

`vijax.runtime.validation` raises the errors, so that command and Python function have the same messages. The functions
below import `validation` only to raise an error: it imports JAX, which would slow down help and completion.
"""

import math
from typing import Any

import click
from click.shell_completion import CompletionItem

from vijax.cli.process import usage_errors


class Choice(click.Choice):
    """One of several words. Any other word raises the error of vijax's Python functions instead of click's error."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word if it is a choice."""
        if value in self.choices:
            return value
        with usage_errors():
            from vijax.runtime import validation

            return validation.validate_choice(_name(param), value, self.choices)


class Integer(click.IntRange):
    """An integer with a lower limit. A smaller number raises the error of vijax's Python functions."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number if it reaches the lower limit; upper limits are validated later, with the other options."""
        number, least = click.INT.convert(value, param, ctx), int(self.min or 0)
        if number >= least:
            return number
        with usage_errors():
            from vijax.runtime import validation

            return validation.validate_integer(_name(param), number, least)


class Periods(Integer):
    """A number of forcing periods, or "all" for all periods of a record (a measured acceleration)."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or "all"."""
        return value if value == "all" else super().convert(value, param, ctx)


class Number(click.ParamType):
    """A real number; the text may end with a unit that converts to the SI unit of the quantity, as in 20mm.

    Args:
        quantity: Name of the quantity in `vijax.model.quantities.ARGUMENT_QUANTITIES`.
    """

    name = "float"

    def __init__(self, quantity: str) -> None:
        self.quantity = quantity

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number in SI units."""
        if not isinstance(value, str):
            return value
        with usage_errors():
            from vijax.model import units

            text, unit = units.split_unit(value)
            number: Any = text
            number = click.FLOAT.convert(number, param, ctx)
            return units.with_unit(self.quantity, number, unit, _name(param)) if unit else number


class Real(click.FloatRange):
    """A finite real number within bounds.

    Args:
        must: The requirement in words, for the error: "a positive number".
        quantity: Name of a quantity, if the text may end with its unit; "" for a pure number.
        bounds: The lower bound, as arguments of `click.FloatRange`: `min`, and `min_open` if `min` itself is excluded.
    """

    name = "float"

    def __init__(self, must: str, quantity: str = "", **bounds: Any) -> None:
        super().__init__(**bounds)
        self.must = must
        self.number: click.ParamType = Number(quantity) if quantity else click.FLOAT

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number if it is within the bounds."""
        number = self.number.convert(value, param, ctx)
        if math.isfinite(number) and self._holds(number):
            return number
        with usage_errors():
            from vijax.runtime import validation

            # This line is reached only with an invalid number, so the condition is always False and the call raises.
            return validation.validate_real(_name(param), number, self.must, lambda _: False)

    def _holds(self, number: float) -> bool:
        least = -math.inf if self.min is None else self.min
        return number > least if self.min_open else number >= least


class NewFile(click.ParamType):
    """The path of a file to write. Any text is accepted here and validated by `targets`; shells complete a path."""

    name = "text"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return one item of type "file", for which the shell itself completes the path."""
        return [CompletionItem(incomplete, type="file")]


def _name(param: click.Parameter | None) -> str:
    return (param and param.name) or "value"
