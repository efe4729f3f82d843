"""Structures of pytrees as JSON, restored without pickle.

A structure consists of tuples, lists, dictionaries, None and records of this package: named tuples and equinox modules.
A record is stored as its module, its name and its fields. Restoring creates instances of records only, calls none of
their constructors and imports nothing: the code that computes a result has imported its record.
"""

import dataclasses
import json
import sys
from typing import Any

import equinox as eqx
import jax

_LEAF = "leaf"
_CONTAINERS: dict[str, Any] = {"tuple": tuple, "list": list}
_MALFORMED = (AttributeError, KeyError, RecursionError, TypeError, ValueError)
_PACKAGE = __name__.split(".")[0]


def to_json(tree: Any) -> str | None:
    """Return the structure of a pytree as text; None if it cannot be restored from text.

    This is the case for a node of another kind, or a static field that JSON changes.
    """
    structure: Any = jax.tree.structure(tree)
    try:
        text = json.dumps(_described(jax.tree.unflatten(structure, [_LEAF] * structure.num_leaves)))
        same = jax.tree.structure(from_json(text))
        # Compare the text as well: a member of an integer enumeration equals its number, but prints differently.
        return text if same == structure and str(same) == str(structure) else None
    except _MALFORMED:
        return None


def from_json(text: str | bytes) -> Any:
    """Return a pytree of a structure, with a text as each leaf.

    Raises:
        ValueError: If the text is not a result of `to_json`.
    """
    try:
        return _rebuilt(json.loads(text))
    except _MALFORMED as error:
        raise ValueError(f"a structure must be one of records of {_PACKAGE}; got {text[:80]!r} ({error})") from None


def _rebuilt(text: Any) -> Any:
    if text is None or text == _LEAF:
        return text
    kind, *parts = text
    if kind in _CONTAINERS:
        return _CONTAINERS[kind](map(_rebuilt, parts))
    if kind == "dict":
        return {key: _rebuilt(value) for key, value in parts}
    record = _record(kind)
    if issubclass(record, tuple):
        return record._make(map(_rebuilt, parts))  # type: ignore[attr-defined]
    # No constructor is called: a stored structure cannot execute code.
    made = object.__new__(record)
    for (name, static), value in zip(_fields(record), parts, strict=True):
        object.__setattr__(made, name, value if static else _rebuilt(value))
    return made


def _described(node: Any) -> Any:
    kind = type(node)
    if node is None or isinstance(node, str):
        return node
    if kind in _CONTAINERS.values():
        return [kind.__name__, *map(_described, node)]
    if kind is dict:
        return ["dict", *([key, _described(value)] for key, value in node.items())]
    name = f"{kind.__module__}:{kind.__qualname__}"
    if isinstance(node, tuple):
        return [name, *map(_described, node)]
    values = ((getattr(node, field), static) for field, static in _fields(_record(name)))
    return [name, *(value if static else _described(value) for value, static in values)]


def _record(name: str) -> type:
    """Return the record class of a name."""
    module, _, path = name.partition(":")
    if module.split(".")[0] != _PACKAGE:
        raise ValueError(f"a record must be of {_PACKAGE}; got {name}")
    cls: Any = sys.modules[module]
    for part in path.split("."):
        cls = getattr(cls, part)
    is_record = isinstance(cls, type) and (issubclass(cls, eqx.Module) or hasattr(cls, "_make"))
    # The class must be defined in that module; names that the module only imports are rejected.
    if is_record and cls.__module__ == module:
        return cls
    raise ValueError(f"a record must be a named tuple or an equinox module; got {name}")


def _fields(record: Any) -> list[tuple[str, bool]]:
    """Return the fields of an equinox module, each with True if it is static."""
    return [(field.name, field.metadata.get("static", False)) for field in dataclasses.fields(record)]
