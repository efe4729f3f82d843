"""Records as text: numbers with six significant digits, arrays of more than eight numbers as dtype and shape."""

import dataclasses
import textwrap
from typing import Any

import equinox as eqx
import jax
import numpy as np

from vijax.runtime.validation import is_concrete

_MOST_NUMBERS = 8  # larger arrays print as dtype and shape
_WIDTH = 100  # characters per line


class PrintedRecord(eqx.Module):
    """A record that prints its numbers, where equinox prints dtypes and shapes; fields that are None are omitted."""

    def __repr__(self) -> str:
        return printed(self)


def printed(record: Any, **replaced: str) -> str:
    """Return a record as text: `ImpactPair(d=0.2, kappa=400, r=0.5, gamma=0)`.

    Args:
        record: A dataclass.
        replaced: Text for some fields, by name.
    """
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    parts = [f"{name}={replaced.get(name) or _text(value)}" for name, value in values.items() if value is not None]
    name, line = type(record).__name__, ", ".join(parts)
    if len(name) + len(line) < _WIDTH and "\n" not in line:
        return f"{name}({line})"
    # A line per field if a field is a record or has several lines; otherwise wrapped text.
    nested = any("\n" in part or "(" in part for part in parts)
    lines = [f"{part}," for part in parts] if nested else textwrap.wrap(line, _WIDTH - 2, break_on_hyphens=False)
    return f"{name}(\n{textwrap.indent(chr(10).join(lines), '  ')}\n)"


def _text(value: Any) -> str:
    if isinstance(value, PrintedRecord):
        return repr(value)
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int) or not is_concrete(value):
        return eqx.tree_pformat(value)
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.size > _MOST_NUMBERS:
        return eqx.tree_pformat(value)
    if array.ndim == 0:
        return _number(array.item())
    return np.array2string(array, separator=", ", max_line_width=10**6, formatter={"all": _number})


def _number(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
