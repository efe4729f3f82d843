"""Lanes in registers end as in the plain loop, block by block; kernels are interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.helpers import described_gpu
from vijax.runtime.compilation import register_kernels, xla
from vijax.runtime.compilation.register_kernels import LANES, apply_in_registers, fits_registers, layout, pack, unpack

BLOCKS = 3
COUNT = BLOCKS * LANES


def example_lanes(count=COUNT, wide=2):
    """Return lanes with values of all dtypes: remaining trips, sums, and values that do not change."""
    remaining = np.zeros(count, np.int32)
    remaining[LANES // 2], remaining[-1] = 9, 4
    row = np.arange(count, dtype=float)
    return {
        "remaining": jnp.asarray(remaining),
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
    """Return a loop that counts each lane down to zero; a block ends with its last lane, and counts its trips."""

    def step(lanes):
        sums = lanes["sums"] + factor * lanes["row"][:, None] * jnp.where(lanes["odd"], 1.0, -1.0)[:, None]
        remaining = jnp.maximum(lanes["remaining"] - 1, 0)
        return lanes | {"remaining": remaining, "trips": lanes["trips"] + 1, "sums": sums, "odd": ~lanes["odd"]}

    return lambda number, lanes, apply_to_lanes: lax.while_loop(
        lambda lanes: (lanes["remaining"] > 0).sum() > 0, step, lanes
    )


@pytest.mark.parametrize("fixed", [(), ("row",)])
def test_blocks_end_independently_and_traced_values_are_passed_in(fixed):
    laid, tables = laid_out(example_lanes(), *fixed)
    results = jax.jit(
        lambda factor, tables: apply_in_registers(falls(factor), laid, numbers(), tables, interpret=True)
    )(0.5, tables)
    results = unpack(laid, results)
    trips = np.repeat([9, 0, 4], LANES)
    row = np.arange(COUNT)
    sign = np.where(row % 2 == 1, 0.5, -0.5)
    np.testing.assert_array_equal(results["trips"], trips)
    np.testing.assert_array_equal(results["remaining"], 0)
    np.testing.assert_array_equal(
        results["sums"], np.repeat(np.where(trips % 2 == 1, sign * row, 0.0)[:, None], 2, axis=1)
    )
    np.testing.assert_array_equal(results["odd"], (row + trips) % 2 == 1)
    np.testing.assert_array_equal(results["row"], row)


def test_a_lane_receives_its_number():
    laid, tables = laid_out({"x": jnp.zeros(COUNT)})
    tables_after = apply_in_registers(
        lambda number, lanes, apply_to_lanes: {"x": lanes["x"] + number.astype(float)},
        laid,
        numbers()[::-1],
        tables,
        interpret=True,
    )
    np.testing.assert_array_equal(unpack(laid, tables_after)["x"], np.arange(COUNT)[::-1])


@pytest.mark.parametrize(("count", "wide", "can"), [(COUNT, 2, True), (LANES + 1, 2, False), (COUNT, 3, False)])
def test_a_kernel_requires_full_blocks_and_axes_of_a_power_of_two(count, wide, can):
    assert fits_registers(example_lanes(count, wide), count) == can


def calls(work, *arguments):
    """Return the number of arrays that each kernel of a program reads and writes."""
    traced = jax.make_jaxpr(work)(*arguments)
    kernels = [eqn for eqn in traced.jaxpr.eqns if eqn.primitive.name == "pallas_call"]
    return [(len(eqn.invars), len(eqn.outvars)) for eqn in kernels]


def test_a_kernel_reads_and_writes_few_tables():
    """The compiler takes seconds for each array; 40 variable and 3 constant columns are packed into three tables."""
    lanes = [jnp.full(COUNT, float(i)) for i in range(43)]
    laid = layout(lanes, lambda lanes: lanes[40:])
    assert [table.shape for table in jax.tree.leaves(pack(laid, lanes))] == [(COUNT, 32), (COUNT, 8), (COUNT, 4)]

    def work(number, lanes, apply_to_lanes):
        return [x + lanes[-1] for x in lanes[:40]] + lanes[40:]

    def apply(tables):
        return apply_in_registers(work, laid, numbers(), tables, interpret=True)

    assert calls(apply, pack(laid, lanes)) == [(4, 2)]
    results = unpack(laid, apply(pack(laid, lanes)))
    np.testing.assert_array_equal(np.stack(results)[:, -1], [*(np.arange(40) + 42.0), 40, 41, 42])


def test_any_value_may_change_or_be_constant():
    lanes = {"name": jnp.arange(COUNT), "odd": jnp.arange(COUNT) % 2 == 1, "sum": jnp.ones(COUNT)}
    for changed in ("name", "odd", "sum"):

        def work(number, lanes, apply_to_lanes, changed=changed):
            return lanes | {changed: ~lanes[changed] if changed == "odd" else lanes[changed] + 1}

        laid, tables = laid_out(lanes, *(lanes.keys() - {changed}))
        results = unpack(laid, apply_in_registers(work, laid, numbers(), tables, interpret=True))
        for name, values in work(numbers(), lanes, None).items():
            assert results[name].dtype == values.dtype
            np.testing.assert_array_equal(results[name], values)


@pytest.mark.parametrize(
    ("columns", "sizes"), [(1, [1]), (2, [2]), (3, [4]), (5, [4, 1]), (40, [32, 8]), (61, [64]), (88, [64, 32])]
)
def test_columns_are_split_into_tables_of_a_power_of_two(columns, sizes):
    assert register_kernels._sizes(columns) == sizes


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_record_is_packed_into_tables_of_its_dtype(dtype):
    lanes = {"x": jnp.linspace(0, 1, COUNT, dtype=dtype), "y": jnp.arange(COUNT), "wide": jnp.ones((COUNT, 4), dtype)}
    laid, tables = laid_out(lanes, "y")
    assert {table.dtype for table in jax.tree.leaves(tables)} == {np.dtype(dtype)}
    results = unpack(laid, tables)
    for name, values in lanes.items():
        assert results[name].dtype == values.dtype
        np.testing.assert_array_equal(results[name], values)


@pytest.mark.parametrize(("lanes", "rounded"), [(1, 256), (256, 256), (12_500, 12_544), (131_072, 131_072)])
def test_lanes_are_rounded_up_to_full_blocks(lanes, rounded):
    assert register_kernels.round_up_to_warps(lanes, 8) == rounded
    assert rounded % (8 * LANES) == 0


def test_a_program_has_a_kernel_for_cuda_only():
    laid, tables = laid_out(example_lanes())
    work = jax.jit(lambda tables: apply_in_registers(falls(0.5), laid, numbers(), tables))
    with described_gpu():
        traced = work.trace(tables)
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(unpack(laid, work(tables))["trips"], 9)


def most_of(pair):
    """Sum powers of each lane's number, row by row; return the sum, whether it is large, and a constant."""
    rows = jnp.stack([pair["x"], pair["x"] ** 2, pair["x"] ** 3])
    total = jnp.where(rows > pair["least"], rows, 0.0).sum(axis=0)
    return {"total": total, "many": total > 4.0, "same": jnp.full_like(total, 7.0)}


def sums_up(number, lanes, apply_to_lanes):
    """Store the results of `most_of` for each lane; a kernel cannot contain its rows."""
    return lanes | apply_to_lanes(most_of, {"x": lanes["x"], "least": lanes["least"]})


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
def test_real_lanes_have_separate_results(real):
    lanes = pairs(COUNT)
    laid, tables = laid_out(lanes, "x", "least")
    results = jax.jit(lambda tables, real: apply_in_registers(sums_up, laid, numbers(), tables, real, interpret=True))(
        tables, jnp.int32(real)
    )
    results, plain = unpack(laid, results), most_of(lanes)
    for name, values in plain.items():
        assert results[name].dtype == values.dtype
        np.testing.assert_allclose(results[name][:real], values[:real], rtol=1e-15, atol=0)


@pytest.mark.parametrize("real", [LANES + 1, 2 * LANES])
def test_blocks_without_a_real_lane_are_not_computed(real):
    laid, tables = laid_out(pairs(COUNT), "x", "least")
    results = unpack(laid, apply_in_registers(sums_up, laid, numbers(), tables, jnp.int32(real), interpret=True))
    np.testing.assert_array_equal(results["same"], np.repeat([7.0, 7.0, 0.0], LANES))


def test_lanes_that_do_not_fill_blocks_are_refused():
    laid, tables = laid_out(pairs(LANES + 1), "x", "least")
    with pytest.raises(ValueError, match=r"whole blocks of 32 lanes; got 33"):
        apply_in_registers(sums_up, laid, numbers(LANES + 1), tables)


def test_other_platforms_compute_lanes_without_a_kernel():
    lanes = pairs(COUNT)
    laid, tables = laid_out(lanes, "x", "least")
    work = jax.jit(lambda tables: apply_in_registers(sums_up, laid, numbers(), tables, jnp.int32(LANES)))
    with described_gpu():
        traced = work.trace(tables)
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(unpack(laid, work(tables))["many"], most_of(lanes)["many"])


def test_registers_are_used_on_a_gpu_if_kernels_are_enabled(monkeypatch):
    assert not register_kernels.registers_enabled()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert register_kernels.registers_enabled()
    monkeypatch.setattr(xla, "KERNELS", False)
    assert not register_kernels.registers_enabled()
