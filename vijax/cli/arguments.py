"""What options say: axes and device of the texts they were given, one point of them, parts of a whole."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from vijax.cli.options import PHYSICAL
from vijax.model.quantities import AXES, of_both_walls, whole

if TYPE_CHECKING:
    import xarray as xr

    from vijax.model.choices import Walls
    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair


def take_axes(given: dict[str, Any], defaults: Mapping[str, str]) -> dict[str, Any]:
    """Take the values of the axes out of what was given.

    Args:
        given: What click parsed, by name; the axes leave it.
        defaults: Texts of axes that count as given where no physical name is among those that are.
    """
    from vijax.planes.axes import parse_axis

    axes = {name: given.pop(name) for name in list(given) if name in AXES}
    texts = {name: text for name, text in axes.items() if text is not None}
    # The defaults come first, so that what is given besides makes panels of their plane.
    if not PHYSICAL & set(texts):
        taken = {*texts, *map(of_both_walls, texts)}
        texts = {name: text for name, text in defaults.items() if name not in taken} | texts
    return {name: parse_axis(name, text) for name, text in texts.items()}


def given_in_hertz() -> set[str]:
    """Return the angular frequencies that the running command was given in Hz: as axes, or as NAME=VALUES along one."""
    from vijax.model import units

    context = click.get_current_context(silent=True)
    texts = {} if context is None else {name: text for name, text in context.params.items() if isinstance(text, str)}
    for option in ("along", "over"):
        name, _, text = texts.get(option, "").partition("=")
        texts[name] = text
    frequencies = [name for name, axis in AXES.items() if axis.unit == "rad/s" and name in texts]
    return {name for name in frequencies if units.split(re.split("[:,]", texts[name])[0])[1] == "Hz"}


def in_given_units(dataset: "xr.Dataset") -> "xr.Dataset":
    """Return the dataset to be shown, with coordinates in Hz where the running command got them in Hz."""
    found = {}
    for name in given_in_hertz() & set(map(str, dataset.coords)):
        angular = dataset[name].variable
        found[name] = angular.copy(data=angular.values / (2 * math.pi))
        symbol = angular.attrs.get("symbol", name)
        found[name].attrs = angular.attrs | {"units": "Hz", "symbol": rf"{symbol} / 2 \pi"}
    return dataset.assign_coords(found)


def device(constants: Iterable[str]) -> "Harvester":
    """Make the device of Tables I and II with other constants, each written NAME=VALUE, with a unit or in SI."""
    from vijax.model import units
    from vijax.model.device import Harvester, with_constants

    values = {}
    for text in constants:
        name, _, value = text.partition("=")
        if not name:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}")
        if name in AXES:
            raise ValueError(
                f"set must name a constant that has no option of its own; got {text!r}; give --{name}={value}"
            )
        number, unit = units.split(value)
        try:
            values[name] = float(number)
        except ValueError:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}") from None
        if unit:
            values[name] = units.with_unit(whole(name), values[name], unit, name)
    with about("set"):
        return with_constants(Harvester(), **values)


@contextmanager
def about(option: str) -> Iterator[None]:
    """Name the option that a value came by in whatever is found wrong with it."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise type(error)(f"--{option}: {error}") from None


def part(option: str, text: str) -> float:
    """Read a part of a whole, written 5% or 0.05; what is more than the whole must be written in percent."""
    percent = text.endswith("%")
    try:
        value = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        raise ValueError(f"{option} must be a part such as 5% or 0.05; got {text!r}") from None
    if value > 1 and not percent:
        raise ValueError(f"{option} must be a part such as 5% or 0.05; got {text!r}; write {text}% if that is meant")
    return value


def at_one_point(
    axes: Mapping[str, Any], device: "Harvester", wall: "Walls" = "soft"
) -> "tuple[ImpactPair, Harvester]":
    """Find the pair that the axes give, each by one number, and the device that has it."""
    from vijax.model.device import realised
    from vijax.model.pair import WALLS
    from vijax.planes.cells import cells
    from vijax.runtime import checks

    for name, values in axes.items():
        if values.size != 1:
            raise ValueError(f"{name} must be one number here; got {values.size} of them")
    checks.choice("wall", wall, WALLS)
    given = cells({name: float(values.flat[0]) for name, values in axes.items()}, device, wall).quantities
    return realised(device, {name: float(value) for name, value in given.items()}, wall)
