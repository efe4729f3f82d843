"""Axes of a sweep: parsing of their text, and validation of each axis on its own.

`sweep.sweep` and the commands pass every axis through `check_axis`. Errors of a single axis are raised here, errors of
a combination of axes in `cells`.
"""

import errno
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from vijax.model import units
from vijax.model.choices import Periods
from vijax.model.device import Harvester, scalar_device, with_constants
from vijax.model.forcing.excitation import Excitation, Record, count_periods, validate_excitation
from vijax.model.quantities import check
from vijax.model.units import QuantityLike
from vijax.runtime import validation
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    import xarray as xr


class Parameters(TypedDict, total=False):
    """The parameter axes of a sweep; `vijax.model.quantities.PARAMETERS` describes them."""

    d: QuantityLike
    kappa: QuantityLike
    r: QuantityLike
    gamma: QuantityLike
    omega: QuantityLike
    s: QuantityLike
    distance: QuantityLike
    omega0: QuantityLike
    k: QuantityLike
    A: QuantityLike
    beta: QuantityLike
    kappa_left: QuantityLike
    kappa_right: QuantityLike
    r_left: QuantityLike
    r_right: QuantityLike
    omega0_left: QuantityLike
    omega0_right: QuantityLike
    k_left: QuantityLike
    k_right: QuantityLike


class Axes(Parameters, total=False):
    """The axes of a sweep: its parameters, and the start (u0, v0)."""

    u0: QuantityLike
    v0: QuantityLike


_FORMS = "a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE"
# Maximum number of values of an axis. The largest planes have some 10^6 per side; a larger number is taken for a typing
# error.
_MOST_VALUES = 10**7
# Maximum size in bytes of the file of an axis: 32 characters per value are more than any number needs.
_MOST_TEXT = 32 * _MOST_VALUES


def parse_axis(name: str, text: str) -> np.ndarray:
    """Return the values of an axis written as a number (0-d), a comma list, `LO:HI:N`, `LO:HI:N:log` or `@FILE` (1-d).

    A number may contain pi, as in `pi` or `12pi`. Either every number has a unit, as in `5Hz` or `20deg`, or none has.
    Hz means turns per second for an angular frequency. Numbers in a file are separated by white space or commas.

    Raises:
        ValueError: If the text has none of these forms, or a value is not allowed on the axis `name`.
    """
    text = text.strip()
    if text.startswith("@"):
        values: Any = _from_file(name, text[1:])
    elif ":" in text:
        values = _from_range(name, text)
    elif "," in text:
        values = _numbers(name, text.split(","), text)
    else:
        (values,) = _numbers(name, [text], text)
    return check_axis(name, values)


def _numbers(name: str, items: list[str], text: str) -> list[float]:
    """Parse numbers; raise ValueError if only some have a unit, because the unit of the others would be ambiguous."""
    parts = [units.split_unit(item) for item in items]
    if len({bool(unit) for _, unit in parts}) > 1:
        raise ValueError(see("maps", f"{name} must have a unit at every number or at none; got {text!r}"))
    return [_number(name, *part, text) for part in parts]


def _number(name: str, item: str, unit: str, text: str) -> float:
    # Only a factor before pi is allowed: "12pi" gives ("12", "pi", ""), and "pi2" has a rest.
    factor, pi, rest = item.partition("pi")
    try:
        value = float({"": "1", "-": "-1"}.get(factor, factor)) * math.pi if pi and not rest else float(item)
    except ValueError:
        within = "" if item == text else f" in {text!r}"
        raise ValueError(see("maps", f"{name} must be {_FORMS}; got {item!r}{within}")) from None
    # A bare 20 on an angle axis most likely means degrees. Taken as radians it would describe another device without
    # any notice, so a unit is required beyond pi/2.
    if not unit and units.UNITS.get(name) == "rad" and abs(value) > 0.5 * math.pi:
        raise ValueError(see("maps", f"{name} must have a unit beyond pi/2, as 20deg or 20rad; got {item!r}"))
    return units.with_unit(name, value, unit) if unit else value


def _from_range(name: str, text: str) -> np.ndarray:
    # A text with a single colon gets an empty count, which the next test rejects.
    low, high, count, *spacing = text.split(":") if text.count(":") > 1 else [text, text, ""]
    if not count or spacing not in ([], ["log"]):
        raise ValueError(see("maps", f"{name} must be {_FORMS}; got {text!r}"))
    digits = count.strip()
    # Python refuses to convert thousands of digits to an int, so the length is checked first.
    if not digits.isdecimal() or len(digits) > len(str(_MOST_VALUES)) or not 1 <= int(digits) <= _MOST_VALUES:
        raise ValueError(
            f"{name}: N in LO:HI:N must be a whole number of at least 1 and at most {_MOST_VALUES:,}; "
            f"got {count[:20]!r} in {validation.value_text(text)}"
        )
    # Both ends are parsed together, so that either both or none must have a unit.
    first, last = _numbers(name, [low, high], text)
    # Validated before the range is made, so that an error names an end that the user wrote, not a value in between.
    check_axis(name, [first, last])
    if not spacing:
        return np.linspace(first, last, int(count))
    if first * last <= 0:
        raise ValueError(f"{name}: LO and HI of a log axis must be on one side of zero; got {text!r}")
    return np.geomspace(first, last, int(count))


def _from_file(name: str, path: str) -> list[float]:
    try:
        items = _text(Path(path)).replace(",", " ").split()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise ValueError(
            f"{name} must name a file that can be read; got {validation.value_text(f'@{path}')} ({reason})"
        ) from None
    return _numbers(name, items, f"@{path}")


def _text(path: Path) -> str:
    """Return the text of a file; raise OSError if it is no regular file (a device may be endless) or too large."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a plain file")
    # The size is tested before the read, which would otherwise fill memory.
    if path.stat().st_size > _MOST_TEXT:
        raise OSError(errno.EFBIG, f"more than {validation.gigabytes(_MOST_TEXT)}")
    return path.read_text(encoding="utf-8")


def dimension(name: str, values: Any) -> "tuple[str, xr.Variable | None]":
    """Return the dimension of an axis and the labels along it; a plain array has a dimension named like the axis.

    Args:
        name: Name of the axis.
        values: Values of the axis. An `xarray.DataArray` names its dimension, which several axes may share.

    Raises:
        ValueError: If the name of the dimension is no text, or its labels are neither numbers nor texts.
    """
    if not validation.is_data_array(values) or values.ndim != 1:
        return name, None
    (dim,) = values.dims
    labels = values.coords[dim].variable.to_base_variable() if dim in values.coords else None
    if not isinstance(dim, str) or not dim:
        raise ValueError(f"{name} must have a dimension named by text; got {validation.value_text(dim)}")
    # Integers, floats and texts; a store cannot hold labels of other dtypes.
    if labels is not None and labels.dtype.kind not in "iufU":
        raise ValueError(f"{name} must have numbers or texts along {dim}; got labels of {labels.dtype}")
    return dim, None if dim == name else labels


def check_axis(name: str, values: Any, quantity: str | None = None) -> np.ndarray:
    """Return the values of an axis as a float64 array of at most one dimension.

    Args:
        name: Name of the argument, for errors.
        values: Values of the axis.
        quantity: Name of the quantity, if the argument has another name; `name` by default.

    Raises:
        ValueError: If a value is not allowed; the message states the value and its place.
    """
    array = validation.validate_numbers(name, units.plain_number(quantity or name, values, name))
    if array.ndim > 1:
        raise ValueError(f"{name} must be a number or a 1-D array; got shape {array.shape}")
    if array.size > _MOST_VALUES:
        raise ValueError(f"{name} must have at most {_MOST_VALUES:,} values; got {array.size:,}")
    # float64 even for a float32 run: derived quantities are computed in float64 and rounded once.
    array = array.astype(np.float64)
    check(quantity or name, array, name)
    return array


def counted_periods(
    periods: Periods, excitation: Excitation | None, transient: int, axes: Mapping[str, Any], device: Harvester | None
) -> int:
    """Return the number of forcing periods; for "all", the length of the record with omega of axes and device.

    Args:
        periods, excitation, transient, device: As in `sweep`.
        axes: Value or values of each axis; None means that the axis is absent.
    """
    if not isinstance(periods, str):
        return periods
    present = {name: values for name, values in axes.items() if values is not None}
    record_device = units_of_record(scalar_device(device), present, excitation)
    scaled = None if excitation is None else validate_excitation(excitation).nondimensional(record_device)
    return count_periods(periods, scaled, validation.validate_integer("transient", transient, 0))


def units_of_record(device: Harvester, axes: Mapping[str, Any], excitation: Excitation | None) -> Harvester:
    """Return the device that defines the units of a record, which are the same in every cell.

    Raises:
        ValueError: If there are several A or omega, and so several units.
    """
    if excitation is None or not validate_excitation(excitation).of(Record):
        return device
    scales = {name: check_axis(name, axes[name], name) for name in ("A", "omega") if name in axes}
    for name, values in scales.items():
        # A and omega scale the record to dimensionless time and acceleration before the program starts. One program
        # holds the record in one scaling, so each may have one value.
        if values.size != 1:
            must = f"{name} must be one number with a record, because it is the unit of the record; got {values.size}"
            raise ValueError(see("excitation", must))
    return with_constants(device, **{name: float(values.flat[0]) for name, values in scales.items()})
