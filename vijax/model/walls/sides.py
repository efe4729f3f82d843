"""Walls that differ: `Sides` stores one value per wall, and `at_wall` selects the value of the wall on one side."""

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp

from vijax.model.quantities import SIDES, split_wall
from vijax.runtime.record_text import PrintedRecord

T = TypeVar("T")


class Sides(PrintedRecord, Generic[T]):
    """Values of the left wall, at u = -d/2, and of the right wall, at u = d/2.

    ::

        vijax.impact_pair(0.2, kappa=vijax.Sides(12.0, 60.0), r=vijax.Sides(0.5, 0.7))

    An array in place of `Sides` is one value per cell, equal at both walls.

    Attributes:
        left, right: Numbers or arrays; also records of numbers or arrays, of one structure.
    """

    left: T
    right: T


def at_wall(value: Any, side: Any) -> Any:
    """Select the value of the wall on a side; a value that both walls share is returned unchanged.

    Args:
        value: A `Sides`, or any other value.
        side: +1 right, -1 left; an array selects elementwise.
    """
    if not isinstance(value, Sides):
        return value
    # `where` on every leaf, so that records of numbers work as well as numbers.
    return jax.tree.map(lambda left, right: jnp.where(side > 0, right, left), value.left, value.right)


def as_sides(value: Any) -> Sides:
    """Return `Sides` of the values of the walls; a shared value is used for both."""
    # If the shared value is a record, both walls refer to the same object.
    return value if isinstance(value, Sides) else Sides(value, value)


def map_walls(function: Callable[..., Any], *values: Any) -> Any:
    """Apply a function to the values of each wall; once if no argument is a `Sides`."""
    # Equal walls need a single evaluation.
    if not any(isinstance(value, Sides) for value in values):
        return function(*values)
    left, right = ([getattr(as_sides(value), name) for value in values] for name in SIDES)
    return Sides(function(*left), function(*right))


def field_of(record: Any, name: str) -> Any:
    """Return a field of a record; a name such as kappa_left returns the value of one wall."""
    field, side = split_wall(name)
    value = getattr(record, field)
    return getattr(as_sides(value), side) if side else value


def with_wall_values(record: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a record that change if `values` are set; names such as kappa_left set one wall."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        field, side = split_wall(name)
        if not side:
            fields[field] = value
            continue
        # kappa_left and kappa_right of one call accumulate in one `Sides`.
        both = as_sides(fields.get(field, getattr(record, field)))
        fields[field] = Sides(value, both.right) if side == SIDES[0] else Sides(both.left, value)
    return fields


def values_by_name(name: str, value: Any) -> dict[str, Any]:
    """Return a quantity by name; `Sides` give two entries with per-wall names, kappa_left and kappa_right."""
    if not isinstance(value, Sides):
        return {name: value}
    return {f"{name}_{side}": getattr(value, side) for side in SIDES}
