"""Options that several pages share, by the sections that they stand in, and the words that may be chosen.

Nothing here imports JAX, so that help and completion answer at once. Defaults and words of settings are those of the
record; tests hold the other words against those of the rooms that know what they mean.
"""

from collections.abc import Sequence
from typing import Any

import click

from vijax.cli.kinds import Choice, NewFile
from vijax.planes.sweep_settings import SweepSettings, choices

VALUES = (
    "VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --gamma=-0.1:0.1:9); "
    "a number may be a multiple of pi, as in 6pi, and all may have units, as in 2Hz:10Hz:9 or 20deg (Hz are turns a "
    "second)."
)
AXES = {
    "d": "gap, dimensionless",
    "kappa": "stiffness, dimensionless",
    "r": "coefficient of restitution [0.5]",
    "gamma": "gravity along the axis over forcing amplitude [0]",
    "omega": "frequency of the forcing, rad/s [pi]",
    "s": "gap, m [0.3]",
    "omega0": "natural frequency of ball and membrane, rad/s [400]",
    "k": "stiffness, N/m [560]",
    "A": "amplitude of the forcing, m/s^2 [1]",
    "beta": "inclination, rad [0]",
    "u0": "displacement at the start, dimensionless [min(0.05853, 0.49 d)]",
    "v0": "velocity at the start, dimensionless [-0.47898]",
}
# One physical name among these, and the plane is the device's: what is not given is taken from Tables I and II.
PHYSICAL = {"s", "omega0", "k"}
DEVICE = PHYSICAL | {"omega", "A", "beta"}

MEMBRANES = ("linear", "hunt-crossley")
OBJECTIVES = ("P", "power", "speed", "mean", "worst")
POINT_QUANTITIES = ("v_in", "v_out", "restitution", "phase", "duration", "depth", "E", "P", "u_strobe", "v_strobe")
BRANCH_QUANTITIES = ("v_in", "phase", "duration", "depth", "P", "multiplier")


def axis_options(**changed: str | None) -> list[click.Parameter]:
    """Make an option of every axis.

    Args:
        changed: Another help text for an axis; None where there is no such option.
    """
    helps = AXES | changed
    return [click.Option([f"--{name}", name], metavar="VALUES", help=text) for name, text in helps.items() if text]


def device_options() -> list[click.Parameter]:
    """Make the option for constants of the device that are no axes."""
    text = "any other constant of the device"
    return [click.Option(["--set", "constants"], multiple=True, metavar="NAME=VALUE", help=text)]


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
    return click.Option([f"--{name}"], type=kind, default=default, show_default=default is not None, help=text)


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


def file_options(ending: str = ".zarr", what: str = "store") -> list[click.Parameter]:
    """Make the options for the store (or what is written in its place), the picture, and whether to replace either."""
    return [
        click.Option(["--out"], type=NewFile(), metavar=f"FILE{ending}", help=f"{what} to write"),
        click.Option(["--plot"], type=NewFile(), metavar="FILE.png", help="picture to write"),
        click.Option(["--overwrite"], is_flag=True, help="replace what is there"),
    ]


def size_option() -> click.Parameter:
    """Make the option by which a run may take more than an hour or 10 GB."""
    return click.Option(["--yes"], is_flag=True, help="begin also what takes more than an hour or 10 GB")
