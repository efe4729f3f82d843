"""Two walls that differ: `Sides` holds what each of them has; `at` takes that of the wall where the ball is."""

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp

from vijax.model.quantities import SIDES, parted
from vijax.runtime.printed import PrintedRecord

T = TypeVar("T")


class Sides(PrintedRecord, Generic[T]):
    """What the left wall has, at u = -d/2, and what the right one has, at u = d/2.

    ::

        vijax.impact_pair(0.2, kappa=vijax.Sides(12.0, 60.0), r=vijax.Sides(0.5, 0.7))

    An array in place of it is a number each for many cells, whose two walls are equal.

    Attributes:
        left, right: Numbers or arrays; also records of such, of one structure.
    """

    left: T
    right: T


def at(value: Any, side: Any) -> Any:
    """Take what the wall on a side has; what both walls have in common stays as it is.

    Args:
        value: A `Sides`, or anything else.
        side: +1 right, -1 left; an array of them takes elementwise.
    """
    if not isinstance(value, Sides):
        return value
    return jax.tree.map(lambda left, right: jnp.where(side > 0, right, left), value.left, value.right)


def apart(value: Any) -> Sides:
    """Give each wall its own, where both have one in common."""
    return value if isinstance(value, Sides) else Sides(value, value)


def each(function: Callable[..., Any], *values: Any) -> Any:
    """Apply a function to what the walls have: once if they have all in common, else for each of them."""
    if not any(isinstance(value, Sides) for value in values):
        return function(*values)
    left, right = ([getattr(apart(value), name) for value in values] for name in SIDES)
    return Sides(function(*left), function(*right))


def field_of(record: Any, name: str) -> Any:
    """Take a field of a record or, under a name such as kappa_left, what one wall has of it."""
    field, side = parted(name)
    value = getattr(record, field)
    return getattr(apart(value), side) if side else value


def with_own(record: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Give the fields of a record that change where such values are put in: whole, or of one wall."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        field, side = parted(name)
        if not side:
            fields[field] = value
            continue
        both = apart(fields.get(field, getattr(record, field)))
        fields[field] = Sides(value, both.right) if side == SIDES[0] else Sides(both.left, value)
    return fields


def named(name: str, value: Any) -> dict[str, Any]:
    """List a quantity under its name, or that of each wall under names of their own: kappa_left, kappa_right."""
    if not isinstance(value, Sides):
        return {name: value}
    return {f"{name}_{side}": getattr(value, side) for side in SIDES}
