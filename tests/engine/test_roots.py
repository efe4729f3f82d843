"""Derivatives of roots and of extreme values: of every order, both ways, inside loops as well."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vijax.engine.roots import extreme_value, implicit_root, implicit_state
from vijax.runtime.xla import each, loop_body


def root(a):
    """The root a^2 of s - a^2, as one found by a search."""
    return implicit_root(lambda s, a: s - a * a, lax.stop_gradient(a * a), a)


def _rates(s, a, state):
    """Derivatives in s of s - a^2 and sin(s)."""
    return 1.0, jnp.cos(s)


def state(a):
    """sin of the root a^2."""
    return implicit_state(lambda s, a: (s - a * a, jnp.sin(s)), _rates, lax.stop_gradient(a * a), a)[1]


def value(a):
    """The greatest a^4/2 of a^2 s - s^2/2, at s = a^2."""
    return extreme_value(lambda s, a: (a * a - s, a * a * s - 0.5 * s * s), lax.stop_gradient(a * a), a)


def looped(work):
    return lambda a: lax.fori_loop(0, 1, loop_body(lambda _, a: work(a)), a)


def one_by_one(work):
    return lambda a: each(work)(jnp.stack([a]))[0]


CASES = {
    "root": (root, lambda a: a * a),
    "state": (state, lambda a: jnp.sin(a * a)),
    "value": (value, lambda a: 0.5 * a**4),
}


@pytest.mark.parametrize("place", [lambda work: work, looped, one_by_one], ids=["alone", "loop", "each"])
@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_right_whichever_way_they_are_taken(name, place):
    found, true = CASES[name]
    a = jnp.asarray(0.8)
    work = place(found)
    assert float(work(a)) == pytest.approx(float(true(a)), rel=1e-15)
    ways = jax.jacfwd, jax.jacrev
    for orders in [(way,) for way in ways], itertools.product(ways, repeat=2), [(way,) * 3 for way in ways]:
        true = jax.jacfwd(true)
        wanted = jax.jit(true)(a)
        for taken in orders:
            mine = work
            for way in taken:
                mine = way(mine)
            np.testing.assert_allclose(jax.jit(mine)(a), wanted, rtol=1e-13, err_msg=f"{taken}")


def test_second_derivatives_of_a_state_differentiate_its_course_by_the_arguments_alone():
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
