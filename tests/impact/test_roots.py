"""Derivatives of roots and of extreme values: of all orders, in both modes, also inside loops."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.impact.roots import extreme_value, implicit_root, implicit_state
from vijax.runtime.compilation.xla import loop_body, map_lanes


def root(a):
    """Return the root a^2 of s - a^2, with the derivatives of a root from a search."""
    return implicit_root(lambda s, a: s - a * a, lax.stop_gradient(a * a), a)


def _rates(s, a, state):
    """Return derivatives in s of s - a^2 and sin(s)."""
    return 1.0, jnp.cos(s)


def state(a):
    """Return sin of the root a^2."""
    return implicit_state(lambda s, a: (s - a * a, jnp.sin(s)), _rates, lax.stop_gradient(a * a), a)[1]


def value(a):
    """Return the maximum a^4/2 of a^2 s - s^2/2, at s = a^2."""
    return extreme_value(lambda s, a: (a * a - s, a * a * s - 0.5 * s * s), lax.stop_gradient(a * a), a)


def looped(work):
    return lambda a: lax.fori_loop(0, 1, loop_body(lambda _, a: work(a)), a)


def by_lanes(work):
    return lambda a: map_lanes(work)(jnp.stack([a]))[0]


CASES = {
    "root": (root, lambda a: a * a),
    "state": (state, lambda a: jnp.sin(a * a)),
    "value": (value, lambda a: 0.5 * a**4),
}


@pytest.mark.parametrize("place", [lambda work: work, looped, by_lanes], ids=["alone", "loop", "each"])
@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_correct_in_all_orders_and_modes(name, place):
    function, true = CASES[name]
    a = jnp.asarray(0.8)
    work = place(function)
    assert float(work(a)) == pytest.approx(float(true(a)), rel=1e-15)
    ways = jax.jacfwd, jax.jacrev
    for orders in [(way,) for way in ways], itertools.product(ways, repeat=2), [(way,) * 3 for way in ways]:
        true = jax.jacfwd(true)
        expected = jax.jit(true)(a)
        for order in orders:
            mine = work
            for way in order:
                mine = way(mine)
            np.testing.assert_allclose(jax.jit(mine)(a), expected, rtol=1e-13, err_msg=f"{order}")


def test_second_derivatives_of_a_state_do_not_repeat_those_of_its_trajectory():
    def course(s, a):
        x = s
        for _ in range(50):
            x = jnp.tanh(x + a)
        return s - a * a, x

    def deep(a):
        return implicit_state(course, lambda s, a, x: (1.0, 0.0 * x), a * a, a)[1]

    def size(work):
        return str(jax.make_jaxpr(work)(0.8)).count(" = ")

    assert size(jax.jacfwd(jax.jacfwd(deep))) < 20 * size(lambda a: course(a, a))
