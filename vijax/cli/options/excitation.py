"""Options of the excitation, and their conversion to an `Excitation`."""

from typing import TYPE_CHECKING, Any

import click

from vijax.cli.arguments import name_option_in_errors
from vijax.cli.options.columns import columns
from vijax.cli.options.value_types import Integer

if TYPE_CHECKING:
    from vijax.model.forcing.excitation import Excitation

_NAMES = "harmonics", "phases", "record", "looped", "noise", "seed"


def harmonic_options() -> list[click.Parameter]:
    """Return the options --harmonics and --phases, of an excitation that repeats every forcing period."""
    amplitudes = "amplitudes of the forcing frequency's multiples, in units of A [the sine]"
    return [
        click.Option(["--harmonics"], metavar="A1,A2,..", help=amplitudes),
        click.Option(["--phases"], metavar="P1,P2,..", help="of --harmonics: their phases, or one for all, rad [0]"),
    ]


def excitation_options(*, noise: bool = True) -> list[click.Parameter]:
    """Return the options of all excitations: harmonics, record and, unless `noise` is False, white noise."""
    file = "measured acceleration in place of the sine: a text file of two columns, time in s and acceleration in m/s^2"
    text = "additional white noise: level, and highest frequency in units of the forcing frequency"
    deterministic: list[click.Parameter] = [
        *harmonic_options(),
        click.Option(["--record"], metavar="FILE", help=file),
        click.Option(["--looped"], is_flag=True, help="of --record: repeat it"),
    ]
    random: list[click.Parameter] = [
        click.Option(["--noise"], metavar="LEVEL,BAND", help=text),
        click.Option(["--seed"], type=Integer(0), help="of --noise: the number of its realisation [0]"),
    ]
    return [*deterministic, *(random if noise else [])]


def take_excitation(parameters: dict[str, Any]) -> "Excitation | None":
    """Remove the options of the excitation from the parameters, and return the excitation; None for a single sine."""
    harmonics, phases, record, looped, noise, seed = (parameters.pop(name, None) for name in _NAMES)
    for name, value, main_option, main_value in (
        ("phases", phases, "harmonics", harmonics),
        ("looped", looped or None, "record", record),
        ("seed", seed, "noise", noise),
    ):
        if value is not None and main_value is None:
            raise ValueError(f"{name} must be left out without --{main_option}; got {value}")
    if harmonics is record is noise is None:
        return None
    from vijax.model.forcing.excitation import Harmonics, Noise

    parts: list[Excitation] = []
    if record is not None:
        parts.append(_record(record, looped))
    if harmonics is not None:
        with name_option_in_errors("harmonics"):
            parts.append(Harmonics(_numbers(harmonics), 0.0 if phases is None else _numbers(phases, "angle")))
    if noise is not None:
        with name_option_in_errors("noise"):
            numbers = _numbers(noise)
            if len(numbers) != 2:
                raise ValueError(f"it must be two numbers, a level and a highest frequency; got {noise!r}")
            # Noise is added to the other parts of the excitation or, if there are no others, to the sine.
            parts += [*([] if parts else [Harmonics()]), Noise(numbers[0], numbers[1], seed or 0)]
    first, *others = parts
    return sum(others, first)


def _numbers(text: str, quantity: str = "") -> list[float]:
    """Parse numbers separated by commas.

    If `quantity` names a quantity with a unit, either every number has a unit, as in 90deg,180deg, or none has.
    """
    from vijax.model import units

    parts = [units.split_unit(part) if quantity else (part, "") for part in text.split(",")]
    try:
        values = [float(number) for number, _ in parts]
    except ValueError:
        raise ValueError(f"it must be numbers separated by commas; got {text!r}") from None
    if len({bool(unit) for _, unit in parts}) > 1:
        raise ValueError(f"it must have a unit at every number or at none; got {text!r}")
    pairs = zip(values, (unit for _, unit in parts), strict=True)
    return [units.with_unit(quantity, value, unit) if unit else value for value, unit in pairs]


def _record(path: str, looped: bool | None) -> "Excitation":
    from vijax.model.forcing.excitation import Record

    time, acceleration = columns("--record", path, (2,))
    with name_option_in_errors("record"):
        return Record(time, acceleration, bool(looped))
