"""Options of the membrane law: its name and its numbers."""

import dataclasses
from typing import Any

import click

from vijax.cli.options.value_types import Choice, Real

MEMBRANES = ("linear", "hunt-crossley", "hyperelastic")
# The membrane law that each option belongs to.
MEMBRANE_NUMBERS = {
    "chi": "hunt-crossley",
    "exponent": "hunt-crossley",
    "depth": "hunt-crossley",
    "prestretch": "hyperelastic",
    "radius": "hyperelastic",
    "stretch_limit": "hyperelastic",
}


_DEPTH = "penetration where its force equals the linear one"


def membrane_options(description: str) -> list[click.Parameter]:
    """Return the options of the membrane law; the help text of --membrane begins with `description`."""
    return [
        click.Option(["--membrane"], type=_Membrane(MEMBRANES), help=f"{description} [linear]"),
        click.Option(["--chi"], type=_at_least(0, "damping"), help="of hunt-crossley: damping over stiffness, s/m"),
        click.Option(["--exponent"], type=_at_least(1), help="of hunt-crossley: exponent of the penetration [1.5]"),
        click.Option(["--depth"], type=_above(0, "length"), help=f"of hunt-crossley: {_DEPTH}, m [1]"),
        click.Option(["--prestretch"], type=_above(1), help="of hyperelastic: stretch without the ball, above 1"),
        click.Option(["--radius"], type=_above(0, "length"), help="of hyperelastic: radius, m [R0]"),
        click.Option(["--stretch-limit"], type=float, help="of hyperelastic: Gent's J_m [inf]"),
    ]


def _above(least: int, quantity: str = "") -> Real:
    return Real(f"one finite number above {least}", quantity, min=least, min_open=True)


def _at_least(least: int, quantity: str = "") -> Real:
    return Real(f"one finite number of at least {least}", quantity, min=least)


class _Membrane(Choice):
    """The name of a membrane law. Any text is accepted here; `take_membrane` raises an error for an unknown name."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text unchanged."""
        return value


def take_membrane(parameters: dict[str, Any]) -> Any:
    """Remove the membrane options from the parameters, and return the law; None if --membrane is not specified."""
    from vijax.model.walls.laws import HuntCrossley, Hyperelastic
    from vijax.model.walls.membrane import Linear

    name, numbers = parameters.pop("membrane"), {number: parameters.pop(number) for number in MEMBRANE_NUMBERS}
    if name not in (None, *MEMBRANES):
        raise ValueError(f"membrane must be one of {', '.join(MEMBRANES)}; got {name!r}")
    for number, value in numbers.items():
        if value is not None and (law_name := MEMBRANE_NUMBERS[number]) != name:
            raise ValueError(f"{number} must be left out unless --membrane is {law_name}; got {value:g}")
    laws: dict[str | None, Any] = {"hunt-crossley": HuntCrossley, "hyperelastic": Hyperelastic, "linear": Linear}
    if name is None:
        return None
    specified = {number: value for number, value in numbers.items() if value is not None}
    for field in dataclasses.fields(laws[name]):
        if field.default is dataclasses.MISSING and field.name not in specified:
            raise ValueError(f"{field.name} must be given with --membrane {name}; got none")
    return laws[name](**specified)
