"""Lanes in registers end as those of the plain loop, block by block; kernels are interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.runtime import registers, xla
from vijax.runtime.registers import LANES, each, stay

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


def falls(factor):
    """Each lane falls to zero; a block goes on until its last one has, and counts its trips."""

    def step(lanes):
        sums = lanes["sums"] + factor * lanes["row"][:, None] * jnp.where(lanes["odd"], 1.0, -1.0)[:, None]
        left = jnp.maximum(lanes["left"] - 1, 0)
        return lanes | {"left": left, "trips": lanes["trips"] + 1, "sums": sums, "odd": ~lanes["odd"]}

    return lambda lanes: lax.while_loop(lambda lanes: (lanes["left"] > 0).sum() > 0, step, lanes)


def test_a_block_does_not_wait_for_the_others_and_everything_traced_comes_along():
    found = jax.jit(lambda factor, lanes: stay(falls(factor), lanes, interpret=True))(0.5, some_lanes())
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


@pytest.mark.parametrize(
    "lanes", [some_lanes(count=LANES + 1), some_lanes(wide=3)], ids=["a block and one", "by three"]
)
def test_what_has_no_blocks_is_done_as_it_stands(lanes):
    found = stay(falls(0.5), lanes, interpret=True)
    np.testing.assert_array_equal(found["trips"], 9)


def calls(work, *given):
    """List for every kernel of a program how many arrays it reads and writes."""
    traced = jax.make_jaxpr(work)(*given)
    kernels = [eqn for eqn in traced.jaxpr.eqns if eqn.primitive.name == "pallas_call"]
    return [(len(eqn.invars), len(eqn.outvars)) for eqn in kernels]


def test_a_kernel_reads_and_writes_few_tables():
    """Its compiler takes seconds for each array: of 40 columns that change and 3 that do not three tables are made."""
    lanes = [jnp.full(COUNT, float(i)) for i in range(43)]

    def work(lanes):
        return [x + lanes[-1] for x in lanes[:40]] + lanes[40:]

    assert calls(lambda lanes: stay(work, lanes, interpret=True), lanes) == [(3, 2), (2, 40)]
    found = stay(work, lanes, interpret=True)
    np.testing.assert_array_equal(np.stack(found)[:, -1], [*(np.arange(40) + 42.0), 40, 41, 42])
    assert calls(lambda lanes: each(work, lanes, jnp.int32(5), interpret=True), lanes) == [(4, 3), (3, 43)]


def test_whatever_changes_and_whatever_stays():
    lanes = {"name": jnp.arange(COUNT), "odd": jnp.arange(COUNT) % 2 == 1, "sum": jnp.ones(COUNT)}
    for changed in ("name", "odd", "sum"):

        def work(lanes, changed=changed):
            return lanes | {changed: ~lanes[changed] if changed == "odd" else lanes[changed] + 1}

        found = stay(work, lanes, interpret=True)
        for name, values in work(lanes).items():
            assert found[name].dtype == values.dtype
            np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("columns", "sizes"), [(1, [1]), (2, [2]), (3, [4]), (5, [4, 1]), (40, [32, 8]), (61, [64]), (88, [64, 32])]
)
def test_columns_are_cut_into_tables_of_a_power_of_two_few_of_them_void(columns, sizes):
    assert registers._sizes(columns) == sizes


@pytest.mark.parametrize(("lanes", "whole"), [(1, 256), (256, 256), (12_500, 12_544), (131_072, 131_072)])
def test_lanes_are_as_many_as_whole_blocks_have(lanes, whole):
    assert registers.whole_blocks(lanes, 8) == whole
    assert whole % (8 * LANES) == 0


def test_a_cuda_gpu_has_one_kernel_and_others_none():
    work = jax.jit(lambda lanes: stay(falls(0.5), lanes))
    traced = work.trace(some_lanes())
    # One that reads tables and writes them, and one that takes these apart.
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 2
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(work(some_lanes())["trips"], 9)


def most_of(pair):
    """Sum up powers of each lane's number, row by row; say whether they are many, and a number of all."""
    rows = jnp.stack([pair["x"], pair["x"] ** 2, pair["x"] ** 3])
    total = jnp.where(rows > pair["least"], rows, 0.0).sum(axis=0)
    return {"total": total, "many": total > 4.0, "same": jnp.full_like(total, 7.0)}


def pairs(count):
    row = np.linspace(0.5, 2.0, count)
    return {"x": jnp.asarray(row), "least": jnp.asarray(row[::-1].copy())}


@pytest.mark.parametrize("real", [1, LANES, 2 * LANES + 1, 3 * LANES])
def test_each_real_lane_gives_its_own(real):
    given = pairs(3 * LANES)
    found = jax.jit(lambda given, real: each(most_of, given, real, interpret=True))(given, jnp.int32(real))
    plain = most_of(given)
    for name, values in plain.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_allclose(found[name][:real], values[:real], rtol=1e-15, atol=0)


@pytest.mark.parametrize("real", [LANES + 1, 2 * LANES])
def test_blocks_without_a_real_lane_are_left_alone(real):
    given = pairs(3 * LANES)
    found = registers._of_each(lambda given: 2.0 * given["x"], given, jnp.int32(real), interpret=True)
    np.testing.assert_array_equal(found[: 2 * LANES], 2.0 * np.asarray(given["x"])[: 2 * LANES])
    assert not np.array_equal(found[2 * LANES :], 2.0 * np.asarray(given["x"])[2 * LANES :])


@pytest.mark.parametrize("count", [LANES - 1, LANES + 1])
def test_lanes_that_are_no_whole_blocks_are_done_as_they_stand(count):
    found = each(most_of, pairs(count), jnp.int32(count), interpret=True)
    np.testing.assert_array_equal(found["total"], most_of(pairs(count))["total"])


def test_a_cuda_gpu_has_one_kernel_of_each_and_others_none():
    work = jax.jit(lambda given: each(most_of, given, jnp.int32(LANES)))
    traced = work.trace(pairs(LANES))
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 2
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(work(pairs(LANES))["many"], most_of(pairs(LANES))["many"])


def test_they_stay_where_there_is_a_gpu_and_kernels_are_wanted(monkeypatch):
    assert not registers.used()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert registers.used()
    monkeypatch.setattr(xla, "KERNELS", False)
    assert not registers.used()
