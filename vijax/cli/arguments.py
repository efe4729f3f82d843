"""Conversion of option texts to axes, a device, one cell or a fraction, with the option's name in errors."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from vijax.cli.options.options import PHYSICAL
from vijax.model.quantities import AXES, both_walls_name, without_wall

if TYPE_CHECKING:
    import xarray as xr

    from vijax.model.choices import Walls
    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair


def take_axes(parameters: dict[str, Any], defaults: Mapping[str, str]) -> dict[str, Any]:
    """Remove the axes from the parsed parameters, and return the values of each specified or default axis by name.

    Args:
        parameters: Parameters parsed by click, by name; all axes are removed from this dictionary.
        defaults: Texts of default axes; ignored if a quantity with a unit, such as s or omega0, is specified in place
            of d or kappa.
    """
    from vijax.maps.axes import parse_axis

    axes = {name: parameters.pop(name) for name in list(parameters) if name in AXES}
    texts = {name: text for name, text in axes.items() if text is not None}
    # Default axes come first, so that they span the plane and further axes make panels.
    # A quantity with a unit, such as s or omega0, selects the device of Tables I and II (of the paper) instead.
    if not PHYSICAL & set(texts):
        specified = {*texts, *map(both_walls_name, texts)}
        texts = {name: text for name, text in defaults.items() if name not in specified} | texts
    return {name: parse_axis(name, text) for name, text in texts.items()}


def quantities_in_hertz() -> set[str]:
    """Return the names of the angular frequencies that the user of the running command wrote in Hz.

    A frequency is an axis option, such as --omega 2Hz, or the name in NAME=VALUES of --along or --over.
    """
    from vijax.model import units

    context = click.get_current_context(silent=True)
    texts = {} if context is None else {name: text for name, text in context.params.items() if isinstance(text, str)}
    for option in ("along", "over"):
        name, _, text = texts.get(option, "").partition("=")
        texts[name] = text
    frequencies = [name for name, axis in AXES.items() if axis.unit == "rad/s" and name in texts]
    return {name for name in frequencies if units.split_unit(re.split("[:,]", texts[name])[0])[1] == "Hz"}


def in_command_units(dataset: "xr.Dataset") -> "xr.Dataset":
    """Return the dataset for display: angular frequencies that the user wrote in Hz are converted back to Hz."""
    coordinates = {}
    for name in quantities_in_hertz() & set(map(str, dataset.coords)):
        angular = dataset[name].variable
        coordinates[name] = angular.copy(data=angular.values / (2 * math.pi))
        symbol = angular.attrs.get("symbol", name)
        coordinates[name].attrs = angular.attrs | {"units": "Hz", "symbol": rf"{symbol} / 2 \pi"}
    return dataset.assign_coords(coordinates)


def device(constants: Iterable[str]) -> "Harvester":
    """Return the device of Tables I and II with some constants replaced.

    Args:
        constants: Texts NAME=VALUE; a value without a unit is in SI units.
    """
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
        number, unit = units.split_unit(value)
        try:
            values[name] = float(number)
        except ValueError:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}") from None
        if unit:
            values[name] = units.with_unit(without_wall(name), values[name], unit, name)
    with name_option_in_errors("set"):
        return with_constants(Harvester(), **values)


@contextmanager
def name_option_in_errors(option: str) -> Iterator[None]:
    """Prefix every ValueError and OSError raised inside the block with `--option: `."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise type(error)(f"--{option}: {error}") from None


def parse_fraction(option: str, text: str) -> float:
    """Parse a fraction, written 5% or 0.05; fractions above 1 must be written in percent."""
    percent = text.endswith("%")
    try:
        value = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        raise ValueError(f"{option} must be a fraction such as 5% or 0.05; got {text!r}") from None
    if value > 1 and not percent:
        raise ValueError(
            f"{option} must be a fraction such as 5% or 0.05; got {text!r}; write {text}% if that is meant"
        )
    return value


def single_cell(axes: Mapping[str, Any], device: "Harvester", wall: "Walls" = "soft") -> "tuple[ImpactPair, Harvester]":
    """Return the nondimensional pair that the axes specify, and the device that realises this pair.

    Raises:
        ValueError: If an axis has several values.
    """
    from vijax.maps.cells import cells
    from vijax.model.device import pair_and_device
    from vijax.model.pair import WALLS
    from vijax.runtime import validation

    for name, values in axes.items():
        if values.size != 1:
            raise ValueError(f"{name} must be one number here; got {values.size} of them")
    validation.validate_choice("wall", wall, WALLS)
    quantities = cells({name: float(values.flat[0]) for name, values in axes.items()}, device, wall).quantities
    # The pair fixes s, omega0, r and beta; the device supplies all other constants.
    return pair_and_device(device, {name: float(value) for name, value in quantities.items()}, wall)
