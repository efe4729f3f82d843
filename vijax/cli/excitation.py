"""Options of what shakes the capsule, and the excitation that they say."""

from typing import TYPE_CHECKING, Any

import click

from vijax.cli.arguments import about
from vijax.cli.columns import columns
from vijax.cli.kinds import Whole

if TYPE_CHECKING:
    from vijax.model.excitation import Excitation

_NAMES = "harmonics", "phases", "record", "looped", "noise", "seed"


def harmonic_options() -> list[click.Parameter]:
    """Make the options of an excitation that repeats every period."""
    amplitudes = "amplitudes of the forcing frequency's multiples, in units of A [the sine]"
    return [
        click.Option(["--harmonics"], metavar="A1,A2,..", help=amplitudes),
        click.Option(["--phases"], metavar="P1,P2,..", help="of --harmonics: their phases, or one for all, rad [0]"),
    ]


def excitation_options(*, noise: bool = True) -> list[click.Parameter]:
    """Make the options of any excitation; of one that is known without those of noise."""
    file = "measured acceleration in place of the sine: a text file of two columns, time in s and acceleration in m/s^2"
    text = "white noise besides: its level and its highest frequency, in units of the forcing's"
    known: list[click.Parameter] = [
        *harmonic_options(),
        click.Option(["--record"], metavar="FILE", help=file),
        click.Option(["--looped"], is_flag=True, help="of --record: begin it again when it is over"),
    ]
    unknown: list[click.Parameter] = [
        click.Option(["--noise"], metavar="LEVEL,BAND", help=text),
        click.Option(["--seed"], type=Whole(0), help="of --noise: the number of its realisation [0]"),
    ]
    return [*known, *(unknown if noise else [])]


def take_excitation(given: dict[str, Any]) -> "Excitation | None":
    """Take the options of the excitation out of what was given, and make it; None for the sine."""
    harmonics, phases, record, looped, noise, seed = (given.pop(name, None) for name in _NAMES)
    for name, value, of, wanted in (
        ("phases", phases, "harmonics", harmonics),
        ("looped", looped or None, "record", record),
        ("seed", seed, "noise", noise),
    ):
        if value is not None and wanted is None:
            raise ValueError(f"{name} must be left out without --{of}; got {value}")
    if harmonics is record is noise is None:
        return None
    from vijax.model.excitation import Harmonics, Noise

    parts: list[Excitation] = []
    if record is not None:
        parts.append(_record(record, looped))
    if harmonics is not None:
        with about("harmonics"):
            parts.append(Harmonics(_numbers(harmonics), 0.0 if phases is None else _numbers(phases, "angle")))
    if noise is not None:
        with about("noise"):
            numbers = _numbers(noise)
            if len(numbers) != 2:
                raise ValueError(f"it must be two numbers, a level and a highest frequency; got {noise!r}")
            # Noise shakes besides what else does, and by itself besides the sine.
            parts += [*([] if parts else [Harmonics()]), Noise(numbers[0], numbers[1], seed or 0)]
    first, *others = parts
    return sum(others, first)


def _numbers(text: str, quantity: str = "") -> list[float]:
    """Read numbers; of a quantity that has a unit all may have one, as in 90deg, or none."""
    from vijax.model import units

    parts = [units.split(part) if quantity else (part, "") for part in text.split(",")]
    try:
        values = [float(number) for number, _ in parts]
    except ValueError:
        raise ValueError(f"it must be numbers parted by commas; got {text!r}") from None
    if len({bool(unit) for _, unit in parts}) > 1:
        raise ValueError(f"it must have a unit at every number or at none; got {text!r}")
    pairs = zip(values, (unit for _, unit in parts), strict=True)
    return [units.with_unit(quantity, value, unit) if unit else value for value, unit in pairs]


def _record(path: str, looped: bool | None) -> "Excitation":
    from vijax.model.excitation import Record

    time, acceleration = columns("--record", path, (2,))
    with about("record"):
        return Record(time, acceleration, bool(looped))
