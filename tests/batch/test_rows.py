"""Rows of a table hold a record whole, and the shapes that a summary is said to have are those it has."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vijax.batch import cell_program, rows
from vijax.batch.cell import Plan, Settings
from vijax.batch.rows import pack, unpack, width
from vijax.batch.summary import shapes, unload
from vijax.engine.ground import Ground
from vijax.model.device import Harvester

LEAST = Plan(variants=3)


WHOLE = st.integers(-(2**20), 2**20)


@given(
    rows=st.integers(1, 5),
    widths=st.lists(st.tuples(st.sampled_from(["f8", "i4", "?"]), st.lists(st.integers(1, 3), max_size=2)), max_size=5),
    data=st.data(),
)
def test_any_record_comes_out_as_it_went_in(rows, widths, data):
    shapes_and_kinds = [("f8", []), *widths]  # a table is floating point: one field of a record must be
    record = [
        data.draw(arrays.arrays(kind, (rows, *shape), elements=None if kind == "?" else WHOLE))
        for kind, shape in shapes_and_kinds
    ]
    table = np.asarray(pack(record))
    assert table.shape == (rows, width(record))
    for found, wanted in zip(unpack(table, record), record, strict=True):
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("leading", [1, 2])
def test_a_record_comes_out_as_it_went_in(leading):
    shape = (4, 5)[:leading]
    number = np.arange(np.prod(shape), dtype=float).reshape(shape)
    record = {"x": number + 0.5, "wide": np.stack([number, -number], -1), "none": None, "code": number.astype(np.int32)}
    found = rows.unpack(
        np.asarray(rows.pack(record, leading)), jax.tree.map(lambda x: x.reshape(-1, *x.shape[leading:]), record)
    )
    for name, values in record.items():
        np.testing.assert_array_equal(found[name], values)
    assert found["code"].dtype == np.int32


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("written", [False, True])
def test_what_comes_out_may_be_written_and_is_copied_only_where_it_must_be(order, written):
    record = {"x": np.zeros(4), "code": np.zeros(4, np.int32)}
    table = np.array(np.arange(8.0).reshape(4, 2), order=order)
    table.flags.writeable = written
    found = rows.unpack(table, record)
    assert np.shares_memory(found["x"], table) == (written and order == "F")
    assert found["x"].flags.c_contiguous
    found["x"][1], found["code"][2] = -1.0, 7
    np.testing.assert_array_equal(found["x"], [1, -1, 5, 7])
    np.testing.assert_array_equal(found["code"], [0, 2, 7, 6])


RECORD = {"same": np.broadcast_to(2.5, 3), "own": np.arange(3.0), "code": np.arange(3, dtype=np.int32), "none": None}


def test_a_table_is_what_packing_makes_and_has_more_rows():
    table = rows.laid_out(RECORD, 5)
    assert isinstance(table, np.ndarray)  # JAX compiles whatever it does outside a program, for every number of rows
    assert table.shape == (5, 3)
    np.testing.assert_array_equal(table[:3], np.asarray(rows.pack(RECORD)))


def test_an_accelerator_is_sent_once_what_is_the_same_in_all_rows(monkeypatch):
    sent = []
    monkeypatch.setattr(rows.jnp, "broadcast_to", lambda x, shape: sent.append(float(x)) or np.broadcast_to(x, shape))
    plain = rows.laid_out(RECORD, 3)
    assert not sent
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    np.testing.assert_array_equal(np.asarray(rows.laid_out(RECORD, 3)), plain)
    assert sent == [2.5]
    longer = np.asarray(rows.laid_out(RECORD, 5))
    assert longer.shape == (5, 3)
    np.testing.assert_array_equal(longer[:3], plain)
    sent.clear()
    rows.laid_out({"only": np.ones(1), "code": np.ones(1, np.int32)}, 5)  # where a program is compiled for no cell
    assert sent == [1, 1]


def test_a_table_of_another_width_is_no_record():
    record = {"x": np.ones(3), "y": np.ones(3)}
    with pytest.raises((TypeError, ValueError)):
        rows.unpack(np.ones((3, 1)), record)


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"rigid": True},
        {"until": "window", "tangent": False},
        {"until": "window", "asymmetry": True, "deep": True},
        {"ground": Ground.GENTLE, "deep": True, "energies": True},
        {"deep": True, "energies": True, "chained": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_summary_has_the_shapes_that_are_said(asked, dtype):
    plan = dataclasses.replace(LEAST, **asked)
    number, variants = jnp.zeros((), dtype), jnp.zeros(plan.variants, dtype)
    device = jax.tree.map(lambda _: number, Harvester())
    settings = Settings(number, number, device, None, variants, variants, number if plan.chained else None)

    def end(settings, entry):
        return unload(plan, settings, cell_program.load(plan, settings, entry))

    said, found = shapes(plan, jnp.dtype(dtype)), jax.eval_shape(end, settings, cell_program.entry_shapes(plan, dtype))
    assert jax.tree.structure(said) == jax.tree.structure(found)
    for one, other in zip(jax.tree.leaves(said), jax.tree.leaves(found), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
