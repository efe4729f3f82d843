"""Validation of public arguments by kind: integers and real numbers, arrays, choices, records, paths, sizes.

An invalid argument, by type or value, raises a ValueError of one line that names it: the requirement, the value, the
remedy. TypeError remains for arguments that a function does not take, as in Python, and OSError for files. The
admissible values of a quantity of the device are defined in `model.quantities`.
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

from vijax.runtime.doc_pages import see

T = TypeVar("T")

MAX_COUNT = 10**9
"""Largest count of anything: periods, impacts and cells are numbered by 32 bits inside compiled programs."""
MAX_SEED = 2**64 - 1
"""Largest seed: 64 bits."""

_WORDS = reprlib.Repr()
_WORDS.maxstring = _WORDS.maxother = _WORDS.maxlong = 60


def value_text(value: Any) -> str:
    """Return a value as text for an error message: one line of limited length."""
    # Python raises an error for integers of thousands of digits, so large ones are described by their number of bits.
    text = f"{value.bit_length()} bits" if isinstance(value, int) and value.bit_length() > 500 else _WORDS.repr(value)
    return " ".join(text.split())


def path_text(path: str | Path) -> str:
    """Return a path as text for an error message: unchanged if it prints on one line, else quoted with escapes."""
    text = str(path)
    return text if text.isprintable() else repr(text)


def _instance_of(module: str, kind: str, value: Any) -> bool:
    """Return True if the value is an instance of a class of a large package, and that package is imported."""
    # While another thread is importing the module, the class may not exist yet.
    cls = getattr(sys.modules.get(module), kind, None)
    return cls is not None and isinstance(value, cls)


def has_unit(value: Any) -> bool:
    """Return True if the value is a quantity of pint."""
    return _instance_of("pint", "Quantity", value)


def is_data_array(value: Any) -> bool:
    """Return True if the value is an `xarray.DataArray`."""
    return _instance_of("xarray", "DataArray", value)


def without_unit(name: str, value: Any, advice: str = "") -> Any:
    """Return a number without a unit; a dimensionless quantity of pint, such as 3 mm/m, becomes its number.

    Args:
        name: Name of the argument.
        value: A number, an array, a list, or a quantity of pint; any other value is returned unchanged.
        advice: Text added to the error.

    Raises:
        ValueError: If the value, or an item of the list, has a unit.
    """
    if isinstance(value, list | tuple):
        return [without_unit(name, item, advice) for item in value] if "pint" in sys.modules else value
    if is_data_array(value):
        value = value.data
    if not has_unit(value):
        return value
    base = value.to_base_units()
    if not base.unitless:
        raise ValueError(see("maps", f"{name} must be a number without a unit; got one in {value.units}{advice}"))
    return base.magnitude


def _array(name: str, value: Any) -> np.ndarray:
    """Return the value as an array; a value that NumPy cannot convert becomes an array that holds None."""
    value = without_unit(name, value)
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError(
            f"{name} must have no masked values; got {np.ma.count_masked(value)} of {value.size} masked; "
            "leave them out by compressed()"
        )
    try:
        return np.asarray(value)
    except (TypeError, ValueError):  # nested lists of several lengths; a dataset
        return np.asarray(None)


def is_concrete(*values: Any) -> bool:
    """Return True if no leaf of the values is traced, so that the values can be inspected."""
    return not any(isinstance(leaf, jax.core.Tracer) for value in values for leaf in jax.tree.leaves(value))


def validate_untraced(name: str, value: T) -> T:
    """Return the value; raise ValueError if JAX traces a part of it, because the caller is not differentiable."""
    if not is_concrete(value):
        raise ValueError(
            f"{name} must not be traced, as this is not differentiated; got {value_text(value)}; "
            "use vijax.steady or vijax.trajectory under jit, grad and vmap"
        )
    return value


def validate_integer(name: str, value: Any, least: int, most: int = MAX_COUNT) -> int:
    """Return the value as an int between two bounds; True and 3.0 are rejected."""
    validate_untraced(name, value)
    number = np.asarray(value) if isinstance(value, int | np.integer | np.ndarray | jax.Array) else np.asarray(None)
    if number.ndim or not _integral(number) or number < least:
        raise ValueError(f"{name} must be a whole number of at least {least}; got {value_text(value)}")
    if number > most:
        raise ValueError(f"{name} must be a whole number of at most {most:,}; got {value_text(value)}")
    return int(number)


def _integral(number: np.ndarray) -> bool:
    # NumPy stores an int of more than 64 bits as an object.
    return number.dtype.kind in "iu" or (number.dtype.kind == "O" and isinstance(number.item(), int))


def validate_seed(value: Any) -> int | None:
    """Return the seed of a random generator as an int, or None."""
    return None if value is None else validate_integer("seed", value, 0, MAX_SEED)


def validate_real(name: str, value: Any, requirement: str, condition: Callable[[float], bool]) -> float:
    """Return the value as a float that satisfies a condition.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        requirement: The condition in words.
        condition: The condition in code; never called with NaN.
    """
    validate_untraced(name, value)
    number = _array(name, value)
    # Kinds of NumPy: signed and unsigned integers, floats; no booleans, complex numbers or objects.
    if number.ndim or number.dtype.kind not in "iuf" or np.isnan(number) or not condition(float(number)):
        raise ValueError(f"{name} must be {requirement}; got {value_text(value)}")
    return float(number)


def validate_positive(name: str, value: Any) -> float:
    """Return the value as a positive finite float."""
    return validate_real(name, value, "a positive finite number", lambda x: 0 < x < math.inf)


def validate_numbers(name: str, value: Any, advice: str = "", *, nonempty: bool = True) -> np.ndarray:
    """Return the value as an array of real numbers, including NaN and infinity; nonempty by default."""
    validate_untraced(name, value)
    array = _array(name, value)
    hint = advice and f"; {advice}"
    if nonempty and array.size == 0:
        raise ValueError(f"{name} must hold at least one number; got shape {array.shape}{hint}")
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be a real number or an array of them; got {value_text(value)}{hint}")
    return array


def validate_bounds(name: str, value: Any) -> tuple[float, float]:
    """Return the value as two finite numbers, the lower first."""
    try:
        low, high = map(float, validate_finite(name, value))
    except (TypeError, ValueError):
        # NaN fails the comparison below, which raises the error.
        low = high = math.nan
    if not low < high:
        raise ValueError(
            f"{name} must be two finite bounds, the lower first; got {value_text(validate_untraced(name, value))}"
        )
    return low, high


def validate_finite(name: str, value: Any) -> np.ndarray:
    """Return the value as an array of at least one finite real number."""
    array = validate_numbers(name, value)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; got {first_invalid(array, np.isfinite(array))}")
    return array


def first_invalid(values: Any, good: Any) -> str:
    """Return, as text, the first element for which `good` is False; with its index if `values` is an array."""
    values, good = np.asarray(values), np.asarray(good)
    index = tuple(int(i) for i in np.argwhere(~good)[0])
    where = f" at index {index if len(index) > 1 else index[0]}" if index else ""
    return f"{values[index]}{where}"


def broadcast_shape(**arrays: Any) -> tuple[int, ...]:
    """Return the common shape of the arrays after broadcasting; raise ValueError if there is none."""
    shape_of = {name: np.shape(array) for name, array in arrays.items()}
    try:
        return np.broadcast_shapes(*shape_of.values())
    except ValueError:
        got = ", ".join(f"{name} {shape}" for name, shape in shape_of.items())
        raise ValueError(f"{join_names(shape_of)} must broadcast to one shape; got {got}") from None


def join_names(names: Iterable[str]) -> str:
    """Return names joined in a sentence: d, kappa and r; "" for no names."""
    *others, last = list(names) or [""]
    return f"{', '.join(others)} and {last}" if others else last


def validate_choice(name: str, value: Any, allowed: Collection[str], hint: str = "") -> str:
    """Return the value if it is one of the allowed words; otherwise raise ValueError."""
    if not isinstance(value, str) or value not in allowed:
        listed = " or ".join(f'"{word}"' for word in allowed) if len(allowed) < 4 else f"among {', '.join(allowed)}"
        raise ValueError(f"{name} must be {listed}; got {value_text(value)}{hint and f'; {hint}'}")
    return value


def validate_choices(name: str, value: Any, allowed: Collection[str]) -> tuple[str, ...]:
    """Return the value, a word or several, as a tuple of allowed words; raise ValueError for any other value."""
    listed = (value,) if isinstance(value, str) else validate_records(name, value, str, "names")
    if not listed:
        raise ValueError(f"{name} must name at least one of {', '.join(allowed)}; got none")
    return tuple(validate_choice(name, word, allowed) for word in listed)


def validate_records(name: str, value: Any, kind: type[T], description: str) -> list[T]:
    """Return the value as a list of records of one class; `description` names the records."""
    try:
        # A string is iterable, but its characters are not accepted as records.
        listed = None if isinstance(value, str) else list(value)
    except TypeError:  # scalars of NumPy, JAX and pint have an `__iter__`, which raises
        listed = None
    if listed is None:
        raise ValueError(f"{name} must be a list of {description}; got {value_text(value)}")
    for item in listed:
        if not isinstance(item, kind):
            raise ValueError(f"{name} must be a list of {description}; got {value_text(item)} in it")
    return listed


def validate_instance(name: str, value: Any, kind: type[T], constructor: str) -> T:
    """Return the value if it is an instance of a class; otherwise raise ValueError.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        kind: The class.
        constructor: Expression that makes an instance: "vijax.Harvester(...)".
    """
    if not isinstance(value, kind):
        raise ValueError(
            f"{name} must be of the kind {kind.__name__}; got {value_text(value)}; {constructor} makes one"
        )
    return value


def validate_dataset(name: str, value: Any, needed: Iterable[str], source: str, hint: str = "") -> Any:
    """Return the value if it is a dataset with the needed variables; otherwise raise ValueError.

    The message contains `source`, the name of a function that returns such a dataset, if the value is no dataset. If
    variables are missing, the message ends with `hint`.
    """
    import xarray as xr  # here: importing vijax must not load xarray

    if not isinstance(value, xr.Dataset):
        raise ValueError(f"{name} must be a dataset, as {source} returns it; got {value_text(value)}")
    missing = [variable for variable in needed if variable not in value]
    if missing:
        hint = hint and f"; {hint}"
        raise ValueError(f"{name} must hold {', '.join(needed)}; got a dataset without {', '.join(missing)}{hint}")
    return value


def validate_dict(name: str, value: Any, needed: Iterable[str], source: str) -> dict[str, Any]:
    """Return the value if it is a dict with the needed entries; `source` names the function that makes it."""
    missing = list(needed) if not isinstance(value, dict) else [entry for entry in needed if entry not in value]
    if missing:
        raise ValueError(
            f"{name} must be a dict with {join_names(missing)}, as {source} gives it; got {value_text(value)}"
        )
    return value


def validate_flag(name: str, value: Any) -> bool:
    """Return the value as a bool if it is True or False; otherwise raise ValueError."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False; got {value_text(value)}")
    return bool(value)


def validate_callable(name: str, value: Any) -> Any:
    """Return the value if it is callable or None; otherwise raise ValueError."""
    if value is not None and not callable(value):
        raise ValueError(f"{name} must be a function, or left out; got {value_text(value)}")
    return value


def validate_path(name: str, value: Any) -> Path:
    """Return the value as a path.

    Raises:
        ValueError: If no file can have this path.
        FileNotFoundError: If the path is relative and the working directory was deleted.
    """
    try:
        # Rejects the empty path, null bytes, and text without an encoding as a file name.
        valid = isinstance(value, str | Path) and str(value) and b"\0" not in os.fsencode(value)
    except UnicodeEncodeError:
        valid = False
    if not valid:
        raise ValueError(f"{name} must be a path, as text or a pathlib.Path; got {value_text(value)}")
    result = Path(value)
    if not result.is_absolute():
        try:
            os.getcwd()
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{name} must be an absolute path, as the working directory was deleted; got {value_text(str(value))}; "
                "change to another folder, or give the whole path"
            ) from None
    return result


def check_memory(names: Iterable[str], size: float, description: str, hint: str = "") -> None:
    """Raise ValueError unless data of the given size fits into this machine's memory.

    Args:
        names: Arguments that determine the size.
        size: Lower bound of the data's size in bytes.
        description: The data, in words.
        hint: Text added to the error: a remedy other than smaller arguments.
    """
    if size > memory():
        available = gigabytes(memory())
        raise ValueError(
            f"{join_names(names)} must be so few that {description} fit in memory, {available}; "
            f"got {gigabytes(size)}{hint}"
        )


def gigabytes(size: float) -> str:
    """Return a number of bytes as text, in GB or TB."""
    return f"{size / 1e9:,.3g} GB" if size < 1e12 else f"{size / 1e12:,.0f} TB"


@cache
def memory() -> float:
    """Return the memory [bytes] of the machine, or of this process' control group if the group has less."""
    try:
        most = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not available on every system
        return math.inf
    try:
        # Limit of the control group (cgroup v2), as in a container.
        return min(most, float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # no such group, or the text "max"
        return most
