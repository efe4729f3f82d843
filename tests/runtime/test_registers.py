"""Lanes in registers end as those of the plain loop, block by block; kernels are interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.runtime import registers, xla
from vijax.runtime.registers import LANES, stay

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


def test_they_stay_where_there_is_a_gpu_and_kernels_are_wanted(monkeypatch):
    assert not registers.used()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert registers.used()
    monkeypatch.setattr(xla, "KERNELS", False)
    assert not registers.used()
