"""Lanes in registers end as those of the plain loop, block by block; kernels are interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.runtime import registers, xla
from vijax.runtime.registers import FEW, LANES, each, stay

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


def test_a_cuda_gpu_has_one_kernel_and_others_none():
    work = jax.jit(lambda lanes: stay(falls(0.5), lanes))
    traced = work.trace(some_lanes())
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
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


@pytest.mark.parametrize("real", [1, FEW, 2 * FEW + 1, 3 * FEW])
def test_each_real_lane_gives_its_own(real):
    given = pairs(3 * FEW)
    found = jax.jit(lambda given, real: each(most_of, given, real, interpret=True))(given, jnp.int32(real))
    plain = most_of(given)
    for name, values in plain.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_allclose(found[name][:real], values[:real], rtol=1e-15, atol=0)


def test_blocks_without_a_real_lane_are_left_alone():
    given = pairs(3 * FEW)
    found = registers._of_each(lambda given: 2.0 * given["x"], given, jnp.int32(FEW + 1), interpret=True)
    np.testing.assert_array_equal(found[: 2 * FEW], 2.0 * np.asarray(given["x"])[: 2 * FEW])
    assert not np.array_equal(found[2 * FEW :], 2.0 * np.asarray(given["x"])[2 * FEW :])


@pytest.mark.parametrize("count", [FEW - 1, FEW + 1])
def test_lanes_that_are_no_whole_blocks_are_done_as_they_stand(count):
    found = each(most_of, pairs(count), jnp.int32(count), interpret=True)
    np.testing.assert_array_equal(found["total"], most_of(pairs(count))["total"])


def test_a_cuda_gpu_has_one_kernel_of_each_and_others_none():
    work = jax.jit(lambda given: each(most_of, given, jnp.int32(FEW)))
    traced = work.trace(pairs(FEW))
    assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
    assert "triton" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    np.testing.assert_array_equal(work(pairs(FEW))["many"], most_of(pairs(FEW))["many"])


def test_they_stay_where_there_is_a_gpu_and_kernels_are_wanted(monkeypatch):
    assert not registers.used()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert registers.used()
    monkeypatch.setattr(xla, "KERNELS", False)
    assert not registers.used()
