"""Kinds of options: what help and completion show of them, and how another text is refused.

A text is refused in the words that Python refuses the argument with, which name it. They are had from `checks`, loaded
only then: nothing here imports JAX.
"""

import math
from typing import Any

import click
from click.shell_completion import CompletionItem

from vijax.cli.process import door


class Choice(click.Choice):
    """One of some words. Any other is refused as it is in Python: click would not say it in this project's form."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word, if it is one of them."""
        if value in self.choices:
            return value
        with door():
            from vijax.runtime import checks

            return checks.choice(_name(param), value, self.choices)


class Whole(click.IntRange):
    """A whole number from some least one on. A lesser is refused as it is in Python."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, if it is not too small; what is too large depends on other options."""
        number, least = click.INT.convert(value, param, ctx), int(self.min or 0)
        if number >= least:
            return number
        with door():
            from vijax.runtime import checks

            return checks.whole(_name(param), number, least)


class Periods(Whole):
    """A whole number of forcing periods, or "all" of a record."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or the word."""
        return value if value == "all" else super().convert(value, param, ctx)


class Number(click.ParamType):
    """A real number; of a quantity that has a unit, with that unit or another one of the kind, as in 20mm.

    Args:
        quantity: Name of the quantity in `vijax.model.quantities.GIVEN`.
    """

    name = "float"

    def __init__(self, quantity: str) -> None:
        self.quantity = quantity

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number in SI units."""
        if not isinstance(value, str):
            return value
        with door():
            from vijax.model import units

            text, unit = units.split(value)
            number: Any = text
            number = click.FLOAT.convert(number, param, ctx)
            return units.with_unit(self.quantity, number, unit, _name(param)) if unit else number


class Real(click.FloatRange):
    """A finite real number within bounds.

    Args:
        must: The bounds in words, as Python refuses a number outside of them.
        quantity: Name of a quantity whose units are taken; "" for a number without one.
        bounds: The least of them, as `click.FloatRange` takes it: min, min_open.
    """

    name = "float"

    def __init__(self, must: str, quantity: str = "", **bounds: Any) -> None:
        super().__init__(**bounds)
        self.must = must
        self.number: click.ParamType = Number(quantity) if quantity else click.FLOAT

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, if it lies within."""
        number = self.number.convert(value, param, ctx)
        if math.isfinite(number) and self._holds(number):
            return number
        with door():
            from vijax.runtime import checks

            return checks.real(_name(param), number, self.must, lambda _: False)

    def _holds(self, number: float) -> bool:
        least = -math.inf if self.min is None else self.min
        return number > least if self.min_open else number >= least


class NewFile(click.ParamType):
    """A file to write: any text, as `targets` says what is wrong with one. A shell completes it as it does paths."""

    name = "text"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Leave the completion to the shell."""
        return [CompletionItem(incomplete, type="file")]


def _name(param: click.Parameter | None) -> str:
    return (param and param.name) or "value"
