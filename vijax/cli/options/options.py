"""Options shared by several subcommands, grouped by section of help, and the words that an option accepts.

JAX is not imported here, so that help and completion are fast. Defaults and accepted words of settings come from
`SweepSettings`, texts of axes from the table of quantities. All other accepted words are repeated here; tests compare
them with the modules that define their meaning.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, get_args

import click

from vijax.cli.options.value_types import Choice, NewFile
from vijax.cli.page import ConstantOption
from vijax.maps.sweep_settings import SweepSettings, choices
from vijax.model.choices import Motion, Objective
from vijax.model.quantities import AXES, QUANTITIES, Quantity, both_walls_name, synonyms

VALUES = (
    "VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --gamma=-0.1:0.1:9); "
    "a number may be a multiple of pi, as in 6pi, and all may have units, as in 2Hz:10Hz:9 or 20deg (Hz are turns a "
    "second)."
)
DEVICE = {name for name, axis in AXES.items() if axis.unit}
# Synonyms of d and kappa that have a unit, such as s and omega0. If one of them is specified, the unspecified axes have
# the values of the device of Tables I and II, not of the default plane.
PHYSICAL = {name for of in ("d", "kappa") for name in synonyms(of) if name in DEVICE}
PHYSICAL |= {name for name in DEVICE if both_walls_name(name) in PHYSICAL}

OBJECTIVES, MOTIONS = get_args(Objective), get_args(Motion)


def axis_options(
    axes: Mapping[str, Quantity] = AXES, defaults: Mapping[str, str] = MappingProxyType({})
) -> list[click.Parameter]:
    """Return an option for every axis.

    Args:
        axes: The axes, by name.
        defaults: Default texts of some axes for the help; they replace the default texts of `axes`.
    """
    helps = {name: _help(axis, defaults.get(name, axis.default)) for name, axis in axes.items()}
    return [click.Option([f"--{name}", name], metavar="VALUES", help=text) for name, text in helps.items()]


def unless_physical(text: str) -> str:
    """Return the help text of a default that applies only if neither s nor omega0 nor k is specified."""
    return f"{text} unless --s, --omega0 or --k is given"


def _help(axis: Quantity, default: str) -> str:
    """Return the help text of an axis: description, unit and default."""
    unit = f", {axis.unit}" if axis.unit else ""
    return f"{axis.long_name}{unit}" + (f" [{default}]" if default else "")


def device_options() -> list[click.Parameter]:
    """Return the options of the device that are no axes: two limits of admissible impacts, and --set for the rest."""
    limits = [
        ConstantOption([f"--{name.replace('_', '-')}"], metavar="VALUE", help=_help(QUANTITIES[name], default))
        for name, default in (("penetration_limit", "R0"), ("energy_ratio_limit", "1"))
    ]
    text = "any other constant of the device"
    return [*limits, click.Option(["--set", "constants"], multiple=True, metavar="NAME=VALUE", help=text)]


def setting(name: str, text: str, kind: Any = None, of: type[SweepSettings] = SweepSettings) -> click.Parameter:
    """Return the option of a setting, with the default of the settings class.

    Args:
        name: Name of the setting, a field of `of`.
        text: Help text.
        kind: Type of the option's values; ignored if the field only allows certain words.
        of: Settings class.
    """
    default, words = getattr(of, name), choices(of).get(name)
    kind = kind if words is None else Choice(words)
    option = f"--{name.replace('_', '-')}"
    return click.Option([option], type=kind, default=default, show_default=default is not None, help=text)


def wall_option() -> click.Parameter:
    """Return the option of the kind of the walls."""
    return setting("wall", "kind of the walls")


def dtype_option() -> click.Parameter:
    """Return the option of the floating-point type of the computation."""
    return setting("dtype", "floating-point type of the computation")


def quantity_option(quantities: Sequence[str]) -> click.Parameter:
    """Return the option --quantity, which selects the quantity of impacts that the picture shows."""
    text = f"quantity in the picture: {', '.join(quantities)}"
    chosen = Choice(quantities)
    return click.Option(["--quantity"], type=chosen, metavar="NAME", default="v_in", show_default=True, help=text)


def file_options(ending: str = ".zarr", name: str = "store", row: str = "cell") -> list[click.Parameter]:
    """Return the options of the output files, and the option that allows existing files to be replaced.

    Args:
        ending: File name extension of the file of --out: .zarr for a store.
        name: Name of the file of --out in help.
        row: Meaning of a row of the table of --csv.
    """
    return [
        click.Option(["--out"], type=NewFile(), metavar=f"FILE{ending}", help=f"{name} to write"),
        click.Option(["--csv"], type=NewFile(), metavar="FILE.csv", help=f"table to write, a row a {row}"),
        click.Option(["--plot"], type=NewFile(), metavar="FILE.png", help="picture to write"),
        click.Option(["--overwrite"], is_flag=True, help="replace existing files"),
    ]


def size_option() -> click.Parameter:
    """Return the option that allows a run of more than an hour or 10 GB without confirmation."""
    return click.Option(["--yes"], is_flag=True, help="run without confirmation also beyond an hour or 10 GB")
