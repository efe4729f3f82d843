"""Lanes in registers end as those of the plain loop, block by block; kernels are interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.helpers import described_gpu
from vijax.runtime import registers, xla
from vijax.runtime.registers import LANES, fit, layout, pack, stay, unpack

BLOCKS = 3
COUNT = BLOCKS * LANES


def some_lanes(count=COUNT, wide=2):
    """Give lanes of every kind of number: how far each is to fall, what it adds up, and what stays as it is."""
    left = np.zeros(count, np.int32)
    left[LANES // 2], left[-1] = 9, 4
    row = np.arange(count, dtype=float)
    return {
        "left": jnp.asarray(left),
        "trips": jnp.zeros(count, jnp.int32),
        "sums": jnp.zeros((count, wide)),
        "odd": jnp.asarray(row % 2 == 1),
        "row": jnp.asarray(row),
    }


def laid_out(lanes, *fixed):
    laid = layout(lanes, lambda lanes: [lanes[name] for name in fixed])
    return laid, pack(laid, lanes)


def numbers(count=COUNT):
    return jnp.arange(count, dtype=jnp.int32)


def falls(factor):
    """Each lane falls to zero; a block goes on until its last one has, and counts its trips."""

    def step(lanes):
        sums = lanes["sums"] + factor * lanes["row"][:, None] * jnp.where(lanes["odd"], 1.0, -1.0)[:, None]
        left = jnp.maximum(lanes["left"] - 1, 0)
        return lanes | {"left": left, "trips": lanes["trips"] + 1, "sums": sums, "odd": ~lanes["odd"]}

    return lambda number, lanes, each: lax.while_loop(lambda lanes: (lanes["left"] > 0).sum() > 0, step, lanes)


@pytest.mark.parametrize("fixed", [(), ("row",)])
def test_a_block_does_not_wait_for_the_others_and_everything_traced_comes_along(fixed):
    laid, tables = laid_out(some_lanes(), *fixed)
    found = jax.jit(lambda factor, tables: stay(falls(factor), laid, numbers(), tables, interpret=True))(0.5, tables)
    found = unpack(laid, found)
    trips = np.repeat([9, 0, 4], LANES)
    row = np.arange(COUNT)
    sign = np.where(row % 2 == 1, 0.5, -0.5)
    np.testing.assert_array_equal(found["trips"], trips)
    np.testing.assert_array_equal(found["left"], 0)
    np.testing.assert_array_equal(
        found["sums"], np.repeat(np.where(trips % 2 == 1, sign * row, 0.0)[:, None], 2, axis=1)
    )
    np.testing.assert_array_equal(found["odd"], (row + trips) % 2 == 1)
    np.testing.assert_array_equal(found["row"], row)


def test_a_lane_is_told_its_number():
    laid, tables = laid_out({"x": jnp.zeros(COUNT)})
    found = stay(
        lambda number, lanes, each: {"x": lanes["x"] + number.astype(float)},
        laid,
        numbers()[::-1],
        tables,
        interpret=True,
    )
    np.testing.assert_array_equal(unpack(laid, found)["x"], np.arange(COUNT)[::-1])


@pytest.mark.parametrize(("count", "wide", "can"), [(COUNT, 2, True), (LANES + 1, 2, False), (COUNT, 3, False)])
def test_a_kernel_holds_whole_blocks_with_axes_of_a_power_of_two(count, wide, can):
    assert fit(some_lanes(count, wide), count) == can


def calls(work, *given):
    """List for every kernel of a program how many arrays it reads and writes."""
    traced = jax.make_jaxpr(work)(*given)
    kernels = [eqn for eqn in traced.jaxpr.eqns if eqn.primitive.name == "pallas_call"]
    return [(len(eqn.invars), len(eqn.outvars)) for eqn in kernels]


def test_a_kernel_reads_and_writes_few_tables():
    """Its compiler takes seconds for each array: of 40 columns that change and 3 that do not three tables are made."""
    lanes = [jnp.full(COUNT, float(i)) for i in range(43)]
    laid = layout(lanes, lambda lanes: lanes[40:])
    assert [table.shape for table in jax.tree.leaves(pack(laid, lanes))] == [(COUNT, 32), (COUNT, 8), (COUNT, 4)]

    def work(number, lanes, each):
        return [x + lanes[-1] for x in lanes[:40]] + lanes[40:]

    def go(tables):
        return stay(work, laid, numbers(), tables, interpret=True)

    assert calls(go, pack(laid, lanes)) == [(4, 2)]
    found = unpack(laid, go(pack(laid, lanes)))
    np.testing.assert_array_equal(np.stack(found)[:, -1], [*(np.arange(40) + 42.0), 40, 41, 42])


def test_whatever_changes_and_whatever_stays():
    lanes = {"name": jnp.arange(COUNT), "odd": jnp.arange(COUNT) % 2 == 1, "sum": jnp.ones(COUNT)}
    for changed in ("name", "odd", "sum"):

        def work(number, lanes, each, changed=changed):
            return lanes | {changed: ~lanes[changed] if changed == "odd" else lanes[changed] + 1}

        laid, tables = laid_out(lanes, *(lanes.keys() - {changed}))
        found = unpack(laid, stay(work, laid, numbers(), tables, interpret=True))
        for name, values in work(numbers(), lanes, None).items():
            assert found[name].dtype == values.dtype
            np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("columns", "sizes"), [(1, [1]), (2, [2]), (3, [4]), (5, [4, 1]), (40, [32, 8]), (61, [64]), (88, [64, 32])]
)
def test_columns_are_cut_into_tables_of_a_power_of_two_few_of_them_void(columns, sizes):
    assert registers._sizes(columns) == sizes


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_record_lies_in_tables_of_its_own_kind_of_number(dtype):
    lanes = {"x": jnp.linspace(0, 1, COUNT, dtype=dtype), "y": jnp.arange(COUNT), "wide": jnp.ones((COUNT, 4), dtype)}
    laid, tables = laid_out(lanes, "y")
    assert {table.dtype for table in jax.tree.leaves(tables)} == {np.dtype(dtype)}
    found = unpack(laid, tables)
    for name, values in lanes.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(("lanes", "whole"), [(1, 256), (256, 256), (12_500, 12_544), (131_072, 131_072)])
def test_lanes_are_as_many_as_whole_blocks_have(lanes, whole):
    assert registers.whole_blocks(lanes, 8) == whole
    assert whole % (8 * LANES) == 0


def test_a_cuda_gpu_has_one_kernel_and_others_none():
    laid, tables = laid_out(some_lanes())
    work = jax.jit(lambda tables: stay(falls(0.5), laid, numbers(), tables))
    with described_gpu():
        traced = work.trace(tables)
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(unpack(laid, work(tables))["trips"], 9)


def most_of(pair):
    """Sum up powers of each lane's number, row by row; say whether they are many, and a number of all."""
    rows = jnp.stack([pair["x"], pair["x"] ** 2, pair["x"] ** 3])
    total = jnp.where(rows > pair["least"], rows, 0.0).sum(axis=0)
    return {"total": total, "many": total > 4.0, "same": jnp.full_like(total, 7.0)}


def sums_up(number, lanes, each):
    """Keep what `most_of` says of each lane: no kernel knows its rows."""
    return lanes | each(most_of, {"x": lanes["x"], "least": lanes["least"]})


def pairs(count):
    row = np.linspace(0.5, 2.0, count)
    blank = jnp.zeros(count)
    return {
        "x": jnp.asarray(row),
        "least": jnp.asarray(row[::-1].copy()),
        "total": blank,
        "many": blank > 1,
        "same": blank,
    }


@pytest.mark.parametrize("real", [1, LANES, 2 * LANES + 1, COUNT])
def test_each_real_lane_gives_its_own(real):
    given = pairs(COUNT)
    laid, tables = laid_out(given, "x", "least")
    found = jax.jit(lambda tables, real: stay(sums_up, laid, numbers(), tables, real, interpret=True))(
        tables, jnp.int32(real)
    )
    found, plain = unpack(laid, found), most_of(given)
    for name, values in plain.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_allclose(found[name][:real], values[:real], rtol=1e-15, atol=0)


@pytest.mark.parametrize("real", [LANES + 1, 2 * LANES])
def test_blocks_without_a_real_lane_are_left_alone(real):
    laid, tables = laid_out(pairs(COUNT), "x", "least")
    found = unpack(laid, stay(sums_up, laid, numbers(), tables, jnp.int32(real), interpret=True))
    np.testing.assert_array_equal(found["same"], np.repeat([7.0, 7.0, 0.0], LANES))


def test_lanes_that_are_no_whole_blocks_are_refused():
    laid, tables = laid_out(pairs(LANES + 1), "x", "least")
    with pytest.raises(ValueError, match=r"whole blocks of 32 lanes; got 33"):
        stay(sums_up, laid, numbers(LANES + 1), tables)


def test_elsewhere_each_lane_is_done_as_it_stands():
    given = pairs(COUNT)
    laid, tables = laid_out(given, "x", "least")
    work = jax.jit(lambda tables: stay(sums_up, laid, numbers(), tables, jnp.int32(LANES)))
    with described_gpu():
        traced = work.trace(tables)
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(unpack(laid, work(tables))["many"], most_of(given)["many"])


def test_they_stay_where_there_is_a_gpu_and_kernels_are_wanted(monkeypatch):
    assert not registers.used()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert registers.used()
    monkeypatch.setattr(xla, "KERNELS", False)
    assert not registers.used()
