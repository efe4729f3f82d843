"""What a door asks of its arguments, kind by kind: whole and real numbers, arrays, choices, records, paths, sizes.

Whatever is wrong with an argument, its type as well as its value, is a ValueError of one line that names it: what must
hold, what came, what to do. TypeError is left to arguments that a function does not take at all, as in Python, and
OSError to files. Which values a quantity of the device may have is known to `model.quantities`.
"""

import math
import os
import reprlib
import sys
from collections.abc import Callable, Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from vijax.runtime.pages import see

T = TypeVar("T")

MOST = 10**9
"""Of whatever is counted: periods, impacts and cells are numbered by 32 bits inside compiled programs."""
MOST_SEED = 2**64 - 1
"""Of a seed: 64 bits."""

_WORDS = reprlib.Repr()
_WORDS.maxstring = _WORDS.maxother = _WORDS.maxlong = 60


def shown(value: Any) -> str:
    """Quote a value as an error does: on one line, and never long."""
    # Python writes no number of thousands of digits.
    text = f"{value.bit_length()} bits" if isinstance(value, int) and value.bit_length() > 500 else _WORDS.repr(value)
    return " ".join(text.split())


def shown_path(path: str | Path) -> str:
    """Return a path as an error shows it: as it is, or quoted with escapes where it cannot be printed on one line."""
    text = str(path)
    return text if text.isprintable() else repr(text)


def _instance_of(module: str, kind: str, value: Any) -> bool:
    """Return whether the value is of a class of a heavy package; nothing is while that is not imported."""
    # While another thread is still importing the module, the class is not there yet.
    found = getattr(sys.modules.get(module), kind, None)
    return found is not None and isinstance(value, found)


def has_unit(value: Any) -> bool:
    """Return whether the value is a quantity of pint."""
    return _instance_of("pint", "Quantity", value)


def is_data_array(value: Any) -> bool:
    """Return whether the value is an `xarray.DataArray`."""
    return _instance_of("xarray", "DataArray", value)


def pure(name: str, value: Any, advice: str = "") -> Any:
    """Return a number without a unit; a quantity of pint that has none, as 3 mm/m, becomes its number.

    Args:
        name: Name of the argument.
        value: A number, an array, a list, or such a quantity; anything else is returned as it is.
        advice: Added to the error.

    Raises:
        ValueError: If the value, or one in the list, has a unit.
    """
    if isinstance(value, list | tuple):
        return [pure(name, one, advice) for one in value] if "pint" in sys.modules else value
    if is_data_array(value):
        value = value.data
    if not has_unit(value):
        return value
    base = value.to_base_units()
    if not base.unitless:
        raise ValueError(see("maps", f"{name} must be a number without a unit; got one in {value.units}{advice}"))
    return base.magnitude


def _array(name: str, value: Any) -> np.ndarray:
    """Return the value as an array; an array of objects if it is no array of numbers."""
    value = pure(name, value)
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError(
            f"{name} must have no masked values; got {np.ma.count_masked(value)} of {value.size} masked; "
            "leave them out by compressed()"
        )
    try:
        return np.asarray(value)
    except (TypeError, ValueError):  # a list of lists of several lengths; a dataset
        return np.asarray(None)


def is_concrete(*values: Any) -> bool:
    """Say whether nothing in the values is traced, so that they may be looked at."""
    return not any(isinstance(leaf, jax.core.Tracer) for value in values for leaf in jax.tree.leaves(value))


def known(name: str, value: T) -> T:
    """Pass the value, unless JAX traces it, or a part of it, where nothing is differentiated."""
    if not is_concrete(value):
        raise ValueError(
            f"{name} must not be traced, as this is not differentiated; got {shown(value)}; "
            "use vijax.steady or vijax.trajectory under jit, grad and vmap"
        )
    return value


def whole(name: str, value: Any, least: int, most: int = MOST) -> int:
    """Take the value as an int between two bounds; True and 3.0 are no whole numbers."""
    known(name, value)
    number = np.asarray(value) if isinstance(value, int | np.integer | np.ndarray | jax.Array) else np.asarray(None)
    if number.ndim or not _integral(number) or number < least:
        raise ValueError(f"{name} must be a whole number of at least {least}; got {shown(value)}")
    if number > most:
        raise ValueError(f"{name} must be a whole number of at most {most:,}; got {shown(value)}")
    return int(number)


def _integral(number: np.ndarray) -> bool:
    # An int of more than 64 bits is an object to NumPy.
    return number.dtype.kind in "iu" or (number.dtype.kind == "O" and isinstance(number.item(), int))


def seed(value: Any) -> int | None:
    """Take the seed of a random generator, or None."""
    return None if value is None else whole("seed", value, 0, MOST_SEED)


def real(name: str, value: Any, must: str, holds: Callable[[float], bool]) -> float:
    """Take the value as a float for which something holds.

    Args:
        name: Of the argument.
        value: What came.
        must: What it must be, in words.
        holds: The same in code; never asked about NaN.
    """
    known(name, value)
    number = _array(name, value)
    if number.ndim or number.dtype.kind not in "iuf" or np.isnan(number) or not holds(float(number)):
        raise ValueError(f"{name} must be {must}; got {shown(value)}")
    return float(number)


def positive(name: str, value: Any) -> float:
    """Take the value as a positive finite float."""
    return real(name, value, "a positive finite number", lambda x: 0 < x < math.inf)


def numbers(name: str, value: Any, advice: str = "", *, some: bool = True) -> np.ndarray:
    """Take the value as an array of real numbers, NaN and infinity too; of at least one unless not `some`."""
    known(name, value)
    array = _array(name, value)
    hint = advice and f"; {advice}"
    if some and array.size == 0:
        raise ValueError(f"{name} must hold at least one number; got shape {array.shape}{hint}")
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be a real number or an array of them; got {shown(value)}{hint}")
    return array


def bounds(name: str, value: Any) -> tuple[float, float]:
    """Take the value as two finite numbers, the lower first."""
    try:
        low, high = map(float, finite(name, value))
    except (TypeError, ValueError):
        low = high = math.nan
    if not low < high:
        raise ValueError(f"{name} must be two finite bounds, the lower first; got {shown(known(name, value))}")
    return low, high


def finite(name: str, value: Any) -> np.ndarray:
    """Take the value as an array of at least one finite real number."""
    array = numbers(name, value)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; got {first(array, np.isfinite(array))}")
    return array


def first(values: Any, good: Any) -> str:
    """Show the first element that is not good, with its index where there is one."""
    values, good = np.asarray(values), np.asarray(good)
    index = tuple(int(i) for i in np.argwhere(~good)[0])
    where = f" at index {index if len(index) > 1 else index[0]}" if index else ""
    return f"{values[index]}{where}"


def shapes(**arrays: Any) -> tuple[int, ...]:
    """Find the shape to which arrays broadcast."""
    each = {name: np.shape(array) for name, array in arrays.items()}
    try:
        return np.broadcast_shapes(*each.values())
    except ValueError:
        got = ", ".join(f"{name} {shape}" for name, shape in each.items())
        raise ValueError(f"{joined(each)} must broadcast to one shape; got {got}") from None


def joined(names: Iterable[str]) -> str:
    """Join names in a sentence: d, kappa and r; no names are no text."""
    *others, last = list(names) or [""]
    return f"{', '.join(others)} and {last}" if others else last


def choice(name: str, value: Any, allowed: Collection[str], hint: str = "") -> str:
    """Pass the value, if it is one of some words."""
    if not isinstance(value, str) or value not in allowed:
        listed = " or ".join(f'"{word}"' for word in allowed) if len(allowed) < 4 else f"among {', '.join(allowed)}"
        raise ValueError(f"{name} must be {listed}; got {shown(value)}{hint and f'; {hint}'}")
    return value


def words(name: str, value: Any, allowed: Collection[str]) -> tuple[str, ...]:
    """Take the value as a tuple of words of which each is allowed; a single one need not stand in a list."""
    listed = (value,) if isinstance(value, str) else sequence(name, value, str, "names")
    if not listed:
        raise ValueError(f"{name} must name at least one of {', '.join(allowed)}; got none")
    return tuple(choice(name, word, allowed) for word in listed)


def sequence(name: str, value: Any, kind: type[T], what: str) -> list[T]:
    """Take the value as a list of records of a kind; `what` they are, in words."""
    try:
        listed = None if isinstance(value, str) else list(value)
    except TypeError:  # numbers of NumPy, JAX and pint have an `__iter__` that raises
        listed = None
    if listed is None:
        raise ValueError(f"{name} must be a list of {what}; got {shown(value)}")
    for one in listed:
        if not isinstance(one, kind):
            raise ValueError(f"{name} must be a list of {what}; got {shown(one)} in it")
    return listed


def instance(name: str, value: Any, kind: type[T], made: str) -> T:
    """Pass the value, if it is a record of a kind.

    Args:
        name: Of the argument.
        value: What came.
        kind: Its class.
        made: How such a record is had: "vijax.Harvester(...)".
    """
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be of the kind {kind.__name__}; got {shown(value)}; {made} makes one")
    return value


def variables(name: str, value: Any, needed: Iterable[str], made: str, hint: str = "") -> Any:
    """Pass the value, if it is a dataset that holds some variables; `made` is the function that returns such."""
    import xarray as xr  # here, as importing vijax must not load it

    if not isinstance(value, xr.Dataset):
        raise ValueError(f"{name} must be a dataset, as {made} returns it; got {shown(value)}")
    missing = [one for one in needed if one not in value]
    if missing:
        hint = hint and f"; {hint}"
        raise ValueError(f"{name} must hold {', '.join(needed)}; got a dataset without {', '.join(missing)}{hint}")
    return value


def record(name: str, value: Any, needed: Iterable[str], made: str) -> dict[str, Any]:
    """Pass the value, if it is a dict that holds some entries; `made` is what returns such."""
    missing = list(needed) if not isinstance(value, dict) else [one for one in needed if one not in value]
    if missing:
        raise ValueError(f"{name} must be a dict with {joined(missing)}, as {made} gives it; got {shown(value)}")
    return value


def flag(name: str, value: Any) -> bool:
    """Pass the value, if it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False; got {shown(value)}")
    return bool(value)


def function(name: str, value: Any) -> Any:
    """Pass the value, if it can be called, or None."""
    if value is not None and not callable(value):
        raise ValueError(f"{name} must be a function, or left out; got {shown(value)}")
    return value


def path(name: str, value: Any) -> Path:
    """Return the value as a path.

    Raises:
        ValueError: No path that a file can have.
        FileNotFoundError: A relative path in a working directory that was deleted.
    """
    try:
        valid = isinstance(value, str | Path) and str(value) and b"\0" not in os.fsencode(value)
    except UnicodeEncodeError:
        valid = False
    if not valid:
        raise ValueError(f"{name} must be a path, as text or a pathlib.Path; got {shown(value)}")
    found = Path(value)
    if not found.is_absolute():
        try:
            os.getcwd()
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{name} must be an absolute path, as the working directory was deleted; got {shown(str(value))}; "
                "change to another folder, or give the whole path"
            ) from None
    return found


def fits(names: Iterable[str], size: float, what: str, hint: str = "") -> None:
    """Raise unless so much fits into this machine's memory.

    Args:
        names: Of the arguments that make it large.
        size: Bytes, at least.
        what: Takes them.
        hint: What to do besides asking for less.
    """
    if size > memory():
        room = gigabytes(memory())
        raise ValueError(
            f"{joined(names)} must be so few that {what} fit in memory, {room}; got {gigabytes(size)}{hint}"
        )


def gigabytes(size: float) -> str:
    """Put bytes in words."""
    return f"{size / 1e9:,.3g} GB" if size < 1e12 else f"{size / 1e12:,.0f} TB"


@cache
def memory() -> float:
    """Find how much memory [bytes] this process may have: the machine's, or less where its control group has less."""
    try:
        most = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not on every system
        return math.inf
    try:
        return min(most, float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # no such group, or "max"
        return most
