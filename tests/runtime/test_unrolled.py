"""Work on rows of lanes comes out the same lane by lane, and leaves nothing of more axes than one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.runtime.unrolled import unrolled
from vijax.runtime.xla import loop_body

LANES = 5


def lanes(count=3, seed=0):
    return [jnp.asarray(row) for row in np.random.default_rng(seed).uniform(0.5, 2.0, (count, LANES))]


def powers(given):
    """Join, cut and sum up rows: powers by doubling, differences of neighbours, the least of all."""
    x, y, _ = given
    rows = x[None]
    while rows.shape[0] < 8:
        rows = jnp.concatenate([rows, rows * x])
        x = x * x
    order = jnp.arange(1, 9, dtype=x.dtype)[:, None]
    scaled = rows * order + jnp.where(order > 4, y, -y)
    index = jnp.arange(7, dtype=x.dtype)[:, None]
    first = jnp.where(scaled[1:] > scaled[:-1], index, 7.0)
    return first.sum(axis=0), jnp.stack([x, y])[1], scaled[3], jnp.where(order == 2, scaled, 0.0).sum(axis=0)


def turns(given):
    """Turn pairs of rows, each [row, pair, lane]."""
    x, y, z = given
    pair = jnp.stack([x, y])
    both = jnp.concatenate([pair[None], (pair * z)[None]])
    one, other = both[:, 0], both[:, 1]
    return (one * other).sum(axis=0), both.reshape(4, -1)[2], jnp.squeeze(both[1:, :1], (0, 1))


def halves(given):
    """Halve rows until every lane's first is small, however many times that takes; numbers come along."""
    x, y, _ = given

    def small(carry):
        rows, trips, _ = carry
        return (rows[0] > 0.1).any() & (trips < 6)

    def halve(carry):
        rows, trips, done = carry
        return jnp.where(rows > 0.1, 0.5 * rows, rows), trips + 1, done | (rows[1] < 0.2)

    rows, trips, done = lax.while_loop(small, halve, (jnp.stack([x, y]), 0, jnp.zeros(x.shape, bool)))
    return rows[0], rows[1], trips + 0 * rows[0], done


def inner(given):
    """Call what is a program of its own, with constants."""
    table = np.linspace(0.0, 1.0, 4)[:, None]
    scale = jax.jit(lambda x: (jnp.asarray(table) * x).sum(axis=0))
    return scale(given[0]), jnp.exp(-given[1]) + 2.0


def own(given):
    """Halve a number of one ball, as often as it needs, for many balls at once: each ends by itself."""
    x, y, _ = given

    def one(x, y):
        small = 0.1 * y
        return lax.while_loop(lambda carry: carry[0] > small, lambda carry: (0.5 * carry[0], carry[1] + 1.0), (x, y))

    return jax.vmap(one)(x, y)


def trips(given):
    """Go round so often, as is known beforehand."""
    x, y, _ = given
    rows, sums = lax.fori_loop(
        0, 3, lambda i, both: (both[0] * y, both[1] + i * both[0][1]), (jnp.stack([x, y]), 0 * x)
    )
    return rows[0], rows[1], sums, jnp.arccos(0.4 * x)


def again(given):
    """Go round in a body that a derivative computes again."""
    x, y, _ = given
    table = np.linspace(0.5, 1.0, 3)[:, None]

    def body(i, x):
        return jnp.cos(x) * y + i * (jnp.asarray(table) * x).sum(axis=0)

    return (lax.fori_loop(0, 2, loop_body(body), x),)


def parts(given):
    """Take rows apart, each of which is a lane's worth."""
    x, y, z = given
    first, second = jnp.unstack(jnp.stack([x, y]) * z)
    return first - second, first * second


@pytest.mark.parametrize("work", [powers, turns, halves, inner, own, trips, again, parts])
def test_lane_by_lane_it_comes_out_the_same(work):
    given = lanes()
    found = jax.jit(lambda *given: unrolled(work, list(given)))(*given)
    for one, plain in zip(found, work(given), strict=True):
        np.testing.assert_allclose(one, plain, rtol=1e-15, atol=0)
        assert one.dtype == plain.dtype


def axes(jaxpr):
    """List how many axes every value of a program has, those of its loops too."""
    for eqn in jaxpr.eqns:
        yield from (var.aval.ndim for var in eqn.outvars)
        for name in ("jaxpr", "body_jaxpr", "cond_jaxpr"):
            if name in eqn.params:
                yield from axes(eqn.params[name].jaxpr)


@pytest.mark.parametrize("work", [powers, turns, halves, inner, trips])
def test_nothing_of_several_axes_is_left(work):
    traced = jax.make_jaxpr(lambda *given: unrolled(work, list(given)))(*lanes())
    assert max(axes(traced.jaxpr)) == 1
    assert max(axes(jax.make_jaxpr(lambda *given: work(list(given)))(*lanes()).jaxpr)) > 1


@pytest.mark.parametrize(
    ("work", "name"),
    [
        (lambda given: [lax.sort(jnp.stack(given), dimension=0)], "sort"),
        (lambda given: [lax.cumsum(given[0])], "cumsum"),
        (lambda given: [given[0] - given[0].sum()], "reduce_sum over lanes"),
        (lambda given: [lax.scan(lambda sums, row: (sums + row, None), given[0], jnp.stack(given))[0]], "scan rows"),
        (lambda given: lax.scan(lambda x, _: (2 * x, x), given[0], length=3), "scan rows"),
    ],
)
def test_what_cannot_be_followed_is_named(work, name):
    with pytest.raises(NotImplementedError, match=f"must not {name};"):
        unrolled(work, lanes())


def test_a_result_that_is_the_same_in_all_lanes_is_one_of_each():
    found = unrolled(lambda given: (jnp.zeros_like(given[0], bool), jnp.full_like(given[0], 3.0)), lanes())
    np.testing.assert_array_equal(found[0], np.zeros(LANES, bool))
    np.testing.assert_array_equal(found[1], np.full(LANES, 3.0))
