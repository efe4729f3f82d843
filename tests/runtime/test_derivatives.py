"""Derivatives at numbers are a program of all slopes; traced, those of JAX: the same numbers both ways."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from vijax.runtime.derivatives import differentiable


class Result(NamedTuple):
    """Numbers, and what has no derivative."""

    product: jax.Array
    powers: jax.Array
    rank: jax.Array
    positive: jax.Array


traced: list[bool] = []


def first(moved, about, *, kind):
    """A number that moves, but is to be taken for one that does not."""
    return moved["x"].sum()


def of_what_was_found(moved, about, found, *, kind):
    """Products and powers of a dictionary's numbers about some centre."""
    x, y = moved["x"], moved["y"]
    traced.append(isinstance(x, jax.core.Tracer))
    product = jnp.sum(x * about) * (y if kind == "plain" else jnp.exp(y)) + found
    return Result(product, x**3, jnp.sum(x > 0, dtype=jnp.int32), y > 0)


shape = differentiable(of_what_was_found, first, lambda about: np.zeros((), about.dtype))


ABOUT = jnp.array([1.0, -2.0, 0.5])
GIVEN = {"x": jnp.array([0.3, 0.2, -0.7]), "y": jnp.array(1.3)}


def product(moved, kind="plain"):
    return shape(moved, ABOUT, kind=kind).product


def test_slopes_are_those_by_hand_and_of_a_traced_program():
    np.testing.assert_allclose(product(GIVEN), np.sum(GIVEN["x"] * ABOUT) * 1.3 + np.sum(GIVEN["x"]), rtol=1e-15)
    for kind, grown, slope in (("plain", 1.3, 1.0), ("grown", np.exp(1.3), np.exp(1.3))):
        found = jax.grad(product)(GIVEN, kind)
        np.testing.assert_allclose(found["x"], ABOUT * grown, rtol=1e-15)
        np.testing.assert_allclose(found["y"], np.sum(GIVEN["x"] * ABOUT) * slope, rtol=1e-14)
        inside = jax.jit(jax.grad(product), static_argnums=1)(GIVEN, kind)
        for name in GIVEN:
            np.testing.assert_allclose(found[name], inside[name], rtol=1e-14)


def test_forward_reverse_second_and_batched_derivatives_agree():
    np.testing.assert_allclose(
        jax.jacfwd(lambda x: shape(GIVEN | {"x": x}, ABOUT, kind="plain").powers)(GIVEN["x"]),
        jax.jacrev(lambda x: shape(GIVEN | {"x": x}, ABOUT, kind="plain").powers)(GIVEN["x"]),
        rtol=1e-15,
    )
    twice = jax.hessian(lambda x: shape(GIVEN | {"x": x}, ABOUT, kind="plain").powers.sum())(GIVEN["x"])
    np.testing.assert_allclose(twice, np.diag(6 * np.asarray(GIVEN["x"])), atol=1e-15)
    many = jax.vmap(jax.grad(lambda y: product(GIVEN | {"y": y}, "grown")))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(many, np.sum(GIVEN["x"] * ABOUT) * np.exp([0.1, 0.2]), rtol=1e-14)


def test_slopes_by_variables_of_every_shape_are_told_apart():
    weights = {"a": np.array([1.0, 2.0, 3.0]), "b": np.array(4.0), "c": np.array([[5.0, 6.0], [7.0, 8.0]])}

    def load(moved, about, found, *, kind):
        return about * sum((weights[name] * moved[name]).sum() for name in weights)

    beam = differentiable(load, lambda moved, about, *, kind: about, np.asarray)
    slopes = jax.grad(lambda moved: beam(moved, jnp.array(2.0), kind=None))(jax.tree.map(jnp.ones_like, weights))
    for name, weight in weights.items():
        np.testing.assert_allclose(slopes[name], 2 * weight, rtol=1e-15)


def test_results_without_derivatives_have_none():
    result, moved = jax.jvp(lambda x: shape(GIVEN | {"x": x}, ABOUT, kind="plain"), (GIVEN["x"],), (jnp.ones(3),))
    assert int(result.rank) == 2
    assert bool(result.positive)
    assert moved.rank.dtype == moved.positive.dtype == jax.dtypes.float0
    np.testing.assert_allclose(moved.powers, 3 * GIVEN["x"] ** 2, rtol=1e-15)


def test_at_numbers_a_program_of_its_own_is_compiled():
    def height(moved, about, found, *, kind):
        return jnp.cos(moved) * about + found

    def double(moved, about, *, kind):
        return 2 * moved

    tide = differentiable(height, double, np.asarray)
    compiled = []

    def count(event, *_, fun_name="", **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(fun_name)

    monitoring.register_event_duration_secs_listener(count)
    try:
        slope = jax.grad(lambda x: tide(x, jnp.array(2.0), kind=None))(jnp.array(0.5))
    finally:
        monitoring.unregister_event_duration_listener(count)
    np.testing.assert_allclose(slope, -2 * np.sin(0.5), rtol=1e-15)
    assert not any("height" in name for name in compiled)
    assert sorted(name for name in compiled if "call" in name or "double" in name) == ["jit(call)", "jit(double)"]


@pytest.mark.parametrize("derivative", [jax.grad, jax.value_and_grad, jax.jacfwd])
def test_other_numbers_and_other_derivatives_trace_nothing_anew(derivative):
    jax.grad(product)(GIVEN)
    before = len(traced)
    for y in (0.1, 0.2):
        derivative(lambda y: product(GIVEN | {"y": y}))(jnp.array(y))
    assert len(traced) == before
