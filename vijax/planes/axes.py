"""Axes of a sweep: text -> values.

This is the door of `sweep.sweep` and of the scripts: whatever can be wrong with an axis is found here, what can be with
several together in `cells`.
"""

import errno
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from vijax.model import units
from vijax.model.choices import Periods
from vijax.model.device import Harvester, one_device, with_constants
from vijax.model.excitation import Excitation, Record, counted, instance
from vijax.model.quantities import check
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr


class Parameters(TypedDict, total=False):
    """The axes of a sweep but for those of the start; `vijax.model.quantities.PARAMETERS` describes them."""

    d: Given
    kappa: Given
    r: Given
    gamma: Given
    omega: Given
    s: Given
    distance: Given
    omega0: Given
    k: Given
    A: Given
    beta: Given
    kappa_left: Given
    kappa_right: Given
    r_left: Given
    r_right: Given
    omega0_left: Given
    omega0_right: Given
    k_left: Given
    k_right: Given


class Axes(Parameters, total=False):
    """The axes of a sweep."""

    u0: Given
    v0: Given


_FORMS = "a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE"
# The most values of an axis: the largest planes have some 10^6 a side, and more are taken for a slip of the finger.
_MOST_VALUES = 10**7
# Bytes of the largest file of an axis that is read: 32 characters a value are more than any number needs.
_MOST_TEXT = 32 * _MOST_VALUES


def parse_axis(name: str, text: str) -> np.ndarray:
    """Read an axis written as a number (0-d), a comma list, `LO:HI:N`, `LO:HI:N:log` or `@FILE` (1-d).

    A number may be written with pi, as in `pi` or `12pi`, and with a unit, as in `5Hz` or `20deg`; then all are. Of an
    angular frequency Hz are turns a second. A file holds numbers apart by white space or commas.

    Raises:
        ValueError: If the text is none of these, or its values are not allowed on the axis `name`.
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
    """Read numbers of which all have a unit or none has, or a reader would not know what the others are in."""
    parts = [units.split(item) for item in items]
    if len({bool(unit) for _, unit in parts}) > 1:
        raise ValueError(see("maps", f"{name} must have a unit at every number or at none; got {text!r}"))
    return [_number(name, *part, text) for part in parts]


def _number(name: str, item: str, unit: str, text: str) -> float:
    factor, pi, rest = item.partition("pi")
    try:
        value = float({"": "1", "-": "-1"}.get(factor, factor)) * math.pi if pi and not rest else float(item)
    except ValueError:
        within = "" if item == text else f" in {text!r}"
        raise ValueError(see("maps", f"{name} must be {_FORMS}; got {item!r}{within}")) from None
    # Degrees taken for radians would be another device, and nobody would see it.
    if not unit and units.UNITS.get(name) == "rad" and abs(value) > 0.5 * math.pi:
        raise ValueError(see("maps", f"{name} must have a unit beyond pi/2, as 20deg or 20rad; got {item!r}"))
    return units.with_unit(name, value, unit) if unit else value


def _from_range(name: str, text: str) -> np.ndarray:
    low, high, count, *spacing = text.split(":") if text.count(":") > 1 else [text, text, ""]
    if not count or spacing not in ([], ["log"]):
        raise ValueError(see("maps", f"{name} must be {_FORMS}; got {text!r}"))
    digits = count.strip()
    # Thousands of digits are more than Python takes for a number.
    if not digits.isdecimal() or len(digits) > len(str(_MOST_VALUES)) or not 1 <= int(digits) <= _MOST_VALUES:
        raise ValueError(
            f"{name}: N in LO:HI:N must be a whole number of at least 1 and at most {_MOST_VALUES:,}; "
            f"got {count[:20]!r} in {checks.shown(text)}"
        )
    first, last = _numbers(name, [low, high], text)
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
            f"{name} must name a file that can be read; got {checks.shown(f'@{path}')} ({reason})"
        ) from None
    return _numbers(name, items, f"@{path}")


def _text(path: Path) -> str:
    """Read a file, unless it is none or too large to be an axis: a device may have no end."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a plain file")
    if path.stat().st_size > _MOST_TEXT:
        raise OSError(errno.EFBIG, f"more than {checks.gigabytes(_MOST_TEXT)}")
    return path.read_text(encoding="utf-8")


def dimension(name: str, values: Any) -> "tuple[str, xr.Variable | None]":
    """Return the dimension of an axis and the labels along it; a plain array has a dimension named as the axis.

    Args:
        name: Name of the axis.
        values: Values of the axis; an `xarray.DataArray` names a dimension, which several axes may share.

    Raises:
        ValueError: If the dimension has the name of another axis, or labels that no dataset can hold.
    """
    if not checks.is_data_array(values) or values.ndim != 1:
        return name, None
    (dim,) = values.dims
    labels = values.coords[dim].variable.to_base_variable() if dim in values.coords else None
    if not isinstance(dim, str) or not dim:
        raise ValueError(f"{name} must have a dimension named by text; got {checks.shown(dim)}")
    if labels is not None and labels.dtype.kind not in "iufU":
        raise ValueError(f"{name} must have numbers or texts along {dim}; got labels of {labels.dtype}")
    return dim, None if dim == name else labels


def check_axis(name: str, values: Any, quantity: str | None = None) -> np.ndarray:
    """Return the values of an axis as a float64 array of at most one dimension.

    Args:
        name: Name of the argument, for errors.
        values: Values of the axis.
        quantity: Name of the quantity, unless it is `name`.

    Raises:
        ValueError: Which value cannot be, and where.
    """
    array = checks.numbers(name, units.plain(quantity or name, values, name))
    if array.ndim > 1:
        raise ValueError(f"{name} must be a number or a 1-D array; got shape {array.shape}")
    if array.size > _MOST_VALUES:
        raise ValueError(f"{name} must have at most {_MOST_VALUES:,} values; got {array.size:,}")
    array = array.astype(np.float64)
    check(quantity or name, array, name)
    return array


def counted_periods(
    periods: Periods, excitation: Excitation | None, transient: int, axes: Mapping[str, Any], device: Harvester | None
) -> int:
    """Return a number of forcing periods; for "all" those of a record in the units of axes and device.

    Args:
        periods, excitation, transient, device: As in `sweep`.
        axes: Value or values of each axis; None counts as not given.
    """
    if not isinstance(periods, str):
        return periods
    given = {name: values for name, values in axes.items() if values is not None}
    own = units_of_record(one_device(device), given, excitation)
    shaken = None if excitation is None else instance(excitation).scaled(own)
    return counted(periods, shaken, checks.whole("transient", transient, 0))


def units_of_record(device: Harvester, given: Mapping[str, Any], excitation: Excitation | None) -> Harvester:
    """Return the device whose units are those of a record in every cell.

    Raises:
        ValueError: Several A or omega, which would be several units.
    """
    if excitation is None or not instance(excitation).of(Record):
        return device
    scales = {name: check_axis(name, given[name], name) for name in ("A", "omega") if name in given}
    for name, values in scales.items():
        if values.size != 1:
            must = f"{name} must be one number with a record, which is told in units of it; got {values.size}"
            raise ValueError(see("excitation", must))
    return with_constants(device, **{name: float(values.flat[0]) for name, values in scales.items()})
