"""Computations on rows of lanes have the same results lane by lane, and then no value has more than one axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.runtime.compilation.lane_unrolling import unrolled
from vijax.runtime.compilation.xla import loop_body

LANES = 5


def lanes(count=3, seed=0):
    return [jnp.asarray(row) for row in np.random.default_rng(seed).uniform(0.5, 2.0, (count, LANES))]


def powers(inputs):
    """Concatenate, slice and sum rows: powers by doubling, differences of neighbours, a masked sum."""
    x, y, _ = inputs
    rows = x[None]
    while rows.shape[0] < 8:
        rows = jnp.concatenate([rows, rows * x])
        x = x * x
    order = jnp.arange(1, 9, dtype=x.dtype)[:, None]
    scaled = rows * order + jnp.where(order > 4, y, -y)
    index = jnp.arange(7, dtype=x.dtype)[:, None]
    first = jnp.where(scaled[1:] > scaled[:-1], index, 7.0)
    return first.sum(axis=0), jnp.stack([x, y])[1], scaled[3], jnp.where(order == 2, scaled, 0.0).sum(axis=0)


def turns(inputs):
    """Index, reshape and squeeze pairs of rows, with shape [row, pair, lane]."""
    x, y, z = inputs
    pair = jnp.stack([x, y])
    both = jnp.concatenate([pair[None], (pair * z)[None]])
    front, back = both[:, 0], both[:, 1]
    return (front * back).sum(axis=0), both.reshape(4, -1)[2], jnp.squeeze(both[1:, :1], (0, 1))


def halves(inputs):
    """Halve rows in a loop until the first row of all lanes is small; integers and booleans are carried along."""
    x, y, _ = inputs

    def small(carry):
        rows, trips, _ = carry
        return (rows[0] > 0.1).any() & (trips < 6)

    def halve(carry):
        rows, trips, done = carry
        return jnp.where(rows > 0.1, 0.5 * rows, rows), trips + 1, done | (rows[1] < 0.2)

    rows, trips, done = lax.while_loop(small, halve, (jnp.stack([x, y]), 0, jnp.zeros(x.shape, bool)))
    return rows[0], rows[1], trips + 0 * rows[0], done


def inner(inputs):
    """Call a jitted function with constants."""
    table = np.linspace(0.0, 1.0, 4)[:, None]
    scale = jax.jit(lambda x: (jnp.asarray(table) * x).sum(axis=0))
    return scale(inputs[0]), jnp.exp(-inputs[1]) + 2.0


def vmapped(inputs):
    """Halve a number in a loop, batched over lanes by vmap: the loop ends for each lane separately."""
    x, y, _ = inputs

    def halve(x, y):
        small = 0.1 * y
        return lax.while_loop(lambda carry: carry[0] > small, lambda carry: (0.5 * carry[0], carry[1] + 1.0), (x, y))

    return jax.vmap(halve)(x, y)


def trips(inputs):
    """Run a loop of a fixed number of trips."""
    x, y, _ = inputs
    rows, sums = lax.fori_loop(
        0, 3, lambda i, both: (both[0] * y, both[1] + i * both[0][1]), (jnp.stack([x, y]), 0 * x)
    )
    return rows[0], rows[1], sums, jnp.arccos(0.4 * x)


def again(inputs):
    """Run a loop with a body that a derivative recomputes."""
    x, y, _ = inputs
    table = np.linspace(0.5, 1.0, 3)[:, None]

    def body(i, x):
        return jnp.cos(x) * y + i * (jnp.asarray(table) * x).sum(axis=0)

    return (lax.fori_loop(0, 2, loop_body(body), x),)


def parts(inputs):
    """Unstack rows into single rows of lanes."""
    x, y, z = inputs
    first, second = jnp.unstack(jnp.stack([x, y]) * z)
    return first - second, first * second


@pytest.mark.parametrize("work", [powers, turns, halves, inner, vmapped, trips, again, parts])
def test_results_are_the_same_lane_by_lane(work):
    inputs = lanes()
    results = jax.jit(lambda *inputs: unrolled(work, list(inputs)))(*inputs)
    for result, plain in zip(results, work(inputs), strict=True):
        np.testing.assert_allclose(result, plain, rtol=1e-15, atol=0)
        assert result.dtype == plain.dtype


def axes(jaxpr):
    """Yield the number of axes of all values of a program and of its loops."""
    for eqn in jaxpr.eqns:
        yield from (var.aval.ndim for var in eqn.outvars)
        for name in ("jaxpr", "body_jaxpr", "cond_jaxpr"):
            if name in eqn.params:
                yield from axes(eqn.params[name].jaxpr)


@pytest.mark.parametrize("work", [powers, turns, halves, inner, trips])
def test_no_value_has_several_axes(work):
    traced = jax.make_jaxpr(lambda *inputs: unrolled(work, list(inputs)))(*lanes())
    assert max(axes(traced.jaxpr)) == 1
    assert max(axes(jax.make_jaxpr(lambda *inputs: work(list(inputs)))(*lanes()).jaxpr)) > 1


@pytest.mark.parametrize(
    ("work", "name"),
    [
        (lambda inputs: [lax.sort(jnp.stack(inputs), dimension=0)], "sort"),
        (lambda inputs: [lax.cumsum(inputs[0])], "cumsum"),
        (lambda inputs: [inputs[0] - inputs[0].sum()], "reduce_sum over lanes"),
        (lambda inputs: [lax.scan(lambda sums, row: (sums + row, None), inputs[0], jnp.stack(inputs))[0]], "scan rows"),
        (lambda inputs: lax.scan(lambda x, _: (2 * x, x), inputs[0], length=3), "scan rows"),
    ],
)
def test_an_operation_that_cannot_be_unrolled_is_named(work, name):
    with pytest.raises(NotImplementedError, match=f"must not {name};"):
        unrolled(work, lanes())


def test_a_constant_result_has_a_value_for_all_lanes():
    results = unrolled(lambda inputs: (jnp.zeros_like(inputs[0], bool), jnp.full_like(inputs[0], 3.0)), lanes())
    np.testing.assert_array_equal(results[0], np.zeros(LANES, bool))
    np.testing.assert_array_equal(results[1], np.full(LANES, 3.0))
