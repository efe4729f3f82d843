"""Options that several pages share, by the sections that they stand in, and the words that may be chosen.

Nothing here imports JAX, so that help and completion answer at once. Defaults and words of settings are those of the
record, texts of axes those of the table of quantities; tests hold the other words against those of the rooms that know
what they mean.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, get_args

import click

from vijax.cli.kinds import Choice, NewFile
from vijax.cli.page import ConstantOption
from vijax.model.choices import Motion, Objective
from vijax.model.quantities import AXES, QUANTITIES, Quantity, of_both_walls, synonyms
from vijax.planes.sweep_settings import SweepSettings, choices

VALUES = (
    "VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --gamma=-0.1:0.1:9); "
    "a number may be a multiple of pi, as in 6pi, and all may have units, as in 2Hz:10Hz:9 or 20deg (Hz are turns a "
    "second)."
)
DEVICE = {name for name, axis in AXES.items() if axis.unit}
# One of these besides d and kappa, and the plane is the device's: what is not given is taken from Tables I and II.
PHYSICAL = {name for of in ("d", "kappa") for name in synonyms(of) if name in DEVICE}
PHYSICAL |= {name for name in DEVICE if of_both_walls(name) in PHYSICAL}

OBJECTIVES, MOTIONS = get_args(Objective), get_args(Motion)


def axis_options(
    axes: Mapping[str, Quantity] = AXES, defaults: Mapping[str, str] = MappingProxyType({})
) -> list[click.Parameter]:
    """Make an option of every axis.

    Args:
        axes: Which axes.
        defaults: What some of them are unless given, where that is not what the table says.
    """
    helps = {name: _help(axis, defaults.get(name, axis.default)) for name, axis in axes.items()}
    return [click.Option([f"--{name}", name], metavar="VALUES", help=text) for name, text in helps.items()]


def unless_physical(text: str) -> str:
    """Say that an axis has a default where no physical name is given."""
    return f"{text} unless --s, --omega0 or --k is given"


def _help(axis: Quantity, default: str) -> str:
    """Say what an axis is, in which unit, and what it is unless given."""
    unit = f", {axis.unit}" if axis.unit else ""
    return f"{axis.long_name}{unit}" + (f" [{default}]" if default else "")


def device_options() -> list[click.Parameter]:
    """Make the options for what the device has besides axes: the limits of admissible impacts, and any constant."""
    limits = [
        ConstantOption([f"--{name.replace('_', '-')}"], metavar="VALUE", help=_help(QUANTITIES[name], default))
        for name, default in (("penetration_limit", "R0"), ("energy_ratio_limit", "1"))
    ]
    text = "any other constant of the device"
    return [*limits, click.Option(["--set", "constants"], multiple=True, metavar="NAME=VALUE", help=text)]


def setting(name: str, text: str, kind: Any = None, of: type[SweepSettings] = SweepSettings) -> click.Parameter:
    """Make the option for a setting, with the record's default.

    Args:
        name: Of the setting.
        text: For help.
        kind: Of its values, unless it is one of the words that the record allows.
        of: The record.
    """
    default, words = getattr(of, name), choices(of).get(name)
    kind = kind if words is None else Choice(words)
    option = f"--{name.replace('_', '-')}"
    return click.Option([option], type=kind, default=default, show_default=default is not None, help=text)


def wall_option() -> click.Parameter:
    """Make the option for the kind of the walls."""
    return setting("wall", "kind of the walls")


def dtype_option() -> click.Parameter:
    """Make the option for the numbers that are computed with."""
    return setting("dtype", "numbers that are computed with")


def quantity_option(quantities: Sequence[str]) -> click.Parameter:
    """Make the option for what a picture of impacts shows."""
    text = f"what the picture shows: {', '.join(quantities)}"
    chosen = Choice(quantities)
    return click.Option(["--quantity"], type=chosen, metavar="NAME", default="v_in", show_default=True, help=text)


def file_options(ending: str = ".zarr", what: str = "store", row: str = "cell") -> list[click.Parameter]:
    """Make the options for the store (or what is written in its place), the table, the picture, and to replace them."""
    return [
        click.Option(["--out"], type=NewFile(), metavar=f"FILE{ending}", help=f"{what} to write"),
        click.Option(["--csv"], type=NewFile(), metavar="FILE.csv", help=f"table to write, a row a {row}"),
        click.Option(["--plot"], type=NewFile(), metavar="FILE.png", help="picture to write"),
        click.Option(["--overwrite"], is_flag=True, help="replace what is there"),
    ]


def size_option() -> click.Parameter:
    """Make the option by which a run may take more than an hour or 10 GB."""
    return click.Option(["--yes"], is_flag=True, help="begin also what takes more than an hour or 10 GB")
