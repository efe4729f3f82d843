"""Structures of pytrees as text: structures of this package are rebuilt, all others are refused."""

from typing import NamedTuple

import equinox as eqx
import jax
import pytest

from vijax.model.flow import Membrane
from vijax.model.records import State
from vijax.model.walls.laws import HuntCrossley
from vijax.orbits.clearances import Clearance
from vijax.runtime.compilation import structures
from vijax.simulation.cell.cell import Plan


class ForeignTuple(NamedTuple):
    """A named tuple of another package."""

    x: float


class ForeignRecord(eqx.Module):
    """A record of another package."""

    x: float


STATE = State(*range(5))
TREES = {
    "leaf": 1.0,
    "none": None,
    "containers": (1, [2, None, ()], {"b": 3, "a": (4,)}),
    "named tuple": Clearance(1, (2, 3), None, 4),
    "record": [STATE, STATE],
    "record in a record": State(STATE, 1, None, [2], ()),
    "static field": (Membrane(1, 2, 3, rolled=True), Membrane(1, 2, 3)),
    "law": HuntCrossley(0.3),
}


@pytest.mark.parametrize("name", TREES)
def test_a_structure_is_rebuilt(name):
    text = structures.to_json(TREES[name])
    assert jax.tree.structure(structures.from_json(text)) == jax.tree.structure(TREES[name])


@pytest.mark.parametrize(
    "tree",
    [ForeignTuple(1), ForeignRecord(1), [ForeignTuple(1)], {(1, 2): 3}, eqx.Partial(divmod, 1), Plan(until="window")],
)
def test_a_structure_that_json_would_change_is_refused(tree):
    """JSON changes objects of other packages, these keys and these static fields."""
    assert structures.to_json(tree) is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "3",
        '["set", "leaf"]',
        '["os:system", "leaf"]',
        '["vijax.nowhere:State"]',
        '["vijax.model.records:Status", "leaf"]',
        '["vijax.runtime.compilation.structures:jax.jit", "leaf"]',
        '["vijax.runtime.compilation.structures:eqx.Partial", "leaf", "leaf", "leaf"]',
        '["vijax.model.records:State", "leaf"]',
        '["vijax.orbits.clearances:Clearance", "leaf"]',
        '["vijax.model.records.State", "leaf"]',
        "[" * 100_000,
    ],
)
def test_a_text_that_describes_no_structure_is_refused(text):
    with pytest.raises(ValueError, match="a structure must be"):
        structures.from_json(text)
