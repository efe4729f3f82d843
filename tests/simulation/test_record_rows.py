"""Packing of records into rows of a table, and the declared shapes of a summary."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vijax.impact.gravity_regime import GravityRegime
from vijax.model.device import Harvester
from vijax.simulation.cell import cell_program
from vijax.simulation.cell.cell import Plan, Settings
from vijax.simulation.scheduler import record_rows
from vijax.simulation.scheduler.record_rows import pack, unpack, width
from vijax.simulation.summary import summary_shapes, unload

LEAST = Plan(variants=3)


INTEGERS = st.integers(-(2**20), 2**20)


@given(
    rows=st.integers(1, 5),
    widths=st.lists(st.tuples(st.sampled_from(["f8", "i4", "?"]), st.lists(st.integers(1, 3), max_size=2)), max_size=5),
    data=st.data(),
)
def test_any_record_is_unchanged_by_packing_and_unpacking(rows, widths, data):
    shapes_and_kinds = [("f8", []), *widths]  # a table is floating point, which requires a field of that type
    record = [
        data.draw(arrays.arrays(kind, (rows, *shape), elements=None if kind == "?" else INTEGERS))
        for kind, shape in shapes_and_kinds
    ]
    table = np.asarray(pack(record))
    assert table.shape == (rows, width(record))
    for actual, expected in zip(unpack(table, record), record, strict=True):
        assert actual.dtype == expected.dtype
        np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize("leading", [1, 2])
def test_a_record_with_leading_axes_is_unchanged_by_packing_and_unpacking(leading):
    shape = (4, 5)[:leading]
    number = np.arange(np.prod(shape), dtype=float).reshape(shape)
    record = {"x": number + 0.5, "wide": np.stack([number, -number], -1), "none": None, "code": number.astype(np.int32)}
    unpacked = record_rows.unpack(
        np.asarray(record_rows.pack(record, leading)), jax.tree.map(lambda x: x.reshape(-1, *x.shape[leading:]), record)
    )
    for name, values in record.items():
        np.testing.assert_array_equal(unpacked[name], values)
    assert unpacked["code"].dtype == np.int32


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("writeable", [False, True])
def test_unpacked_arrays_are_writeable_and_copied_only_if_required(order, writeable):
    record = {"x": np.zeros(4), "code": np.zeros(4, np.int32)}
    table = np.array(np.arange(8.0).reshape(4, 2), order=order)
    table.flags.writeable = writeable
    unpacked = record_rows.unpack(table, record)
    assert np.shares_memory(unpacked["x"], table) == (writeable and order == "F")
    assert unpacked["x"].flags.c_contiguous
    unpacked["x"][1], unpacked["code"][2] = -1.0, 7
    np.testing.assert_array_equal(unpacked["x"], [1, -1, 5, 7])
    np.testing.assert_array_equal(unpacked["code"], [0, 2, 7, 6])


RECORD = {"same": np.broadcast_to(2.5, 3), "own": np.arange(3.0), "code": np.arange(3, dtype=np.int32), "none": None}


def test_a_padded_table_starts_with_the_packed_rows():
    table = record_rows.laid_out(RECORD, 5)
    assert isinstance(table, np.ndarray)  # outside a program JAX would compile an operation for each number of rows
    assert table.shape == (5, 3)
    np.testing.assert_array_equal(table[:3], np.asarray(record_rows.pack(RECORD)))


def test_values_common_to_all_rows_are_sent_to_an_accelerator_once(monkeypatch):
    sent = []
    monkeypatch.setattr(
        record_rows.jnp, "broadcast_to", lambda x, shape: sent.append(float(x)) or np.broadcast_to(x, shape)
    )
    plain = record_rows.laid_out(RECORD, 3)
    assert not sent
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    np.testing.assert_array_equal(np.asarray(record_rows.laid_out(RECORD, 3)), plain)
    assert sent == [2.5]
    longer = np.asarray(record_rows.laid_out(RECORD, 5))
    assert longer.shape == (5, 3)
    np.testing.assert_array_equal(longer[:3], plain)
    sent.clear()
    record_rows.laid_out(
        {"only": np.ones(1), "code": np.ones(1, np.int32)}, 5
    )  # as in the compilation of a program without a cell
    assert sent == [1, 1]


def test_a_table_of_another_width_is_rejected():
    record = {"x": np.ones(3), "y": np.ones(3)}
    with pytest.raises((TypeError, ValueError)):
        record_rows.unpack(np.ones((3, 1)), record)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rigid": True},
        {"until": "window", "tangent": False},
        {"until": "window", "asymmetry": True, "deep": True},
        {"gravity_regime": GravityRegime.WEAK, "deep": True, "energies": True},
        {"deep": True, "energies": True, "chained": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_summary_shapes_are_correct(options, dtype):
    plan = dataclasses.replace(LEAST, **options)
    number, variants = jnp.zeros((), dtype), jnp.zeros(plan.variants, dtype)
    device = jax.tree.map(lambda _: number, Harvester())
    settings = Settings(number, number, device, None, variants, variants, number if plan.chained else None)

    def end(settings, entry):
        return unload(plan, settings, cell_program.load(plan, settings, entry))

    expected, actual = (
        summary_shapes(plan, jnp.dtype(dtype)),
        jax.eval_shape(end, settings, cell_program.entry_shapes(plan, dtype)),
    )
    assert jax.tree.structure(expected) == jax.tree.structure(actual)
    for declared, computed in zip(jax.tree.leaves(expected), jax.tree.leaves(actual), strict=True):
        assert (declared.shape, declared.dtype) == (computed.shape, computed.dtype)
