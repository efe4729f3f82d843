"""The membrane that a command is told: its name, and the numbers of its law."""

import dataclasses
from typing import Any

import click

from vijax.cli.kinds import Choice, Real

MEMBRANES = ("linear", "hunt-crossley", "hyperelastic")
# Which option is of which membrane.
MEMBRANE_NUMBERS = {
    "chi": "hunt-crossley",
    "exponent": "hunt-crossley",
    "depth": "hunt-crossley",
    "prestretch": "hyperelastic",
    "radius": "hyperelastic",
    "stretch_limit": "hyperelastic",
}


_DEPTH = "penetration at which it pushes as the linear one"


def membrane_options(told: str) -> list[click.Parameter]:
    """Make the options; `told` says what it is the membrane of."""
    return [
        click.Option(["--membrane"], type=_Membrane(MEMBRANES), help=f"{told} [linear]"),
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
    """The name of a membrane, any text at first: as Python takes records in its place, `take_membrane` refuses it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Leave the text as it is."""
        return value


def take_membrane(given: dict[str, Any]) -> Any:
    """Take name and numbers out of what a command was given, and make the membrane of them; None unless named."""
    from vijax.model.laws import HuntCrossley, Hyperelastic
    from vijax.model.membrane import Linear

    name, numbers = given.pop("membrane"), {number: given.pop(number) for number in MEMBRANE_NUMBERS}
    if name not in (None, *MEMBRANES):
        raise ValueError(f"membrane must be one of {', '.join(MEMBRANES)}; got {name!r}")
    for number, value in numbers.items():
        if value is not None and (owner := MEMBRANE_NUMBERS[number]) != name:
            raise ValueError(f"{number} must be left out unless --membrane is {owner}; got {value:g}")
    laws: dict[str | None, Any] = {"hunt-crossley": HuntCrossley, "hyperelastic": Hyperelastic, "linear": Linear}
    if name is None:
        return None
    told = {number: value for number, value in numbers.items() if value is not None}
    for field in dataclasses.fields(laws[name]):
        if field.default is dataclasses.MISSING and field.name not in told:
            raise ValueError(f"{field.name} must be given with --membrane {name}; got none")
    return laws[name](**told)
