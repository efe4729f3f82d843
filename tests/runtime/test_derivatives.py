"""Derivatives at numbers come from one program of all slopes, traced derivatives from JAX; both are equal."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, monitoring

from vijax.runtime.numerics.derivatives import differentiable, differentiable_rows


class Result(NamedTuple):
    """Numbers, and values without a derivative."""

    product: jax.Array
    powers: jax.Array
    rank: jax.Array
    positive: jax.Array


traced: list[bool] = []


def root(moved, about, *, kind):
    """Return a number that depends on the inputs and is treated as a constant."""
    return moved["x"].sum()


def products_and_powers(moved, about, root_value, *, kind):
    """Return products and powers of a dictionary's numbers about a centre."""
    x, y = moved["x"], moved["y"]
    traced.append(isinstance(x, jax.core.Tracer))
    product = jnp.sum(x * about) * (y if kind == "plain" else jnp.exp(y)) + root_value
    return Result(product, x**3, jnp.sum(x > 0, dtype=jnp.int32), y > 0)


shape = differentiable(products_and_powers, root, lambda about: np.zeros((), about.dtype))


ABOUT = jnp.array([1.0, -2.0, 0.5])
INPUTS = {"x": jnp.array([0.3, 0.2, -0.7]), "y": jnp.array(1.3)}


def product(moved, kind="plain"):
    return shape(moved, ABOUT, kind=kind).product


def test_slopes_equal_slopes_by_hand_and_of_a_traced_program():
    np.testing.assert_allclose(product(INPUTS), np.sum(INPUTS["x"] * ABOUT) * 1.3 + np.sum(INPUTS["x"]), rtol=1e-15)
    for kind, grown, slope in (("plain", 1.3, 1.0), ("grown", np.exp(1.3), np.exp(1.3))):
        slopes = jax.grad(product)(INPUTS, kind)
        np.testing.assert_allclose(slopes["x"], ABOUT * grown, rtol=1e-15)
        np.testing.assert_allclose(slopes["y"], np.sum(INPUTS["x"] * ABOUT) * slope, rtol=1e-14)
        inside = jax.jit(jax.grad(product), static_argnums=1)(INPUTS, kind)
        for name in INPUTS:
            np.testing.assert_allclose(slopes[name], inside[name], rtol=1e-14)


def test_forward_reverse_second_and_batched_derivatives_agree():
    np.testing.assert_allclose(
        jax.jacfwd(lambda x: shape(INPUTS | {"x": x}, ABOUT, kind="plain").powers)(INPUTS["x"]),
        jax.jacrev(lambda x: shape(INPUTS | {"x": x}, ABOUT, kind="plain").powers)(INPUTS["x"]),
        rtol=1e-15,
    )
    twice = jax.hessian(lambda x: shape(INPUTS | {"x": x}, ABOUT, kind="plain").powers.sum())(INPUTS["x"])
    np.testing.assert_allclose(twice, np.diag(6 * np.asarray(INPUTS["x"])), atol=1e-15)
    many = jax.vmap(jax.grad(lambda y: product(INPUTS | {"y": y}, "grown")))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(many, np.sum(INPUTS["x"] * ABOUT) * np.exp([0.1, 0.2]), rtol=1e-14)


def test_slopes_are_separate_for_variables_of_all_shapes():
    weights = {"a": np.array([1.0, 2.0, 3.0]), "b": np.array(4.0), "c": np.array([[5.0, 6.0], [7.0, 8.0]])}

    def load(moved, about, root_value, *, kind):
        return about * sum((weights[name] * moved[name]).sum() for name in weights)

    beam = differentiable(load, lambda moved, about, *, kind: about, np.asarray)
    slopes = jax.grad(lambda moved: beam(moved, jnp.array(2.0), kind=None))(jax.tree.map(jnp.ones_like, weights))
    for name, weight in weights.items():
        np.testing.assert_allclose(slopes[name], 2 * weight, rtol=1e-15)


def test_results_without_derivatives_have_none():
    result, moved = jax.jvp(lambda x: shape(INPUTS | {"x": x}, ABOUT, kind="plain"), (INPUTS["x"],), (jnp.ones(3),))
    assert int(result.rank) == 2
    assert bool(result.positive)
    assert moved.rank.dtype == moved.positive.dtype == jax.dtypes.float0
    np.testing.assert_allclose(moved.powers, 3 * INPUTS["x"] ** 2, rtol=1e-15)


def test_derivatives_at_numbers_compile_a_separate_program():
    def height(moved, about, root_value, *, kind):
        return jnp.cos(moved) * about + root_value

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


@pytest.mark.parametrize(
    "derivative", [jax.grad, *(pytest.param(of, marks=pytest.mark.long) for of in (jax.value_and_grad, jax.jacfwd))]
)
def test_other_numbers_and_other_derivatives_trace_nothing_anew(derivative):
    jax.grad(product)(INPUTS)
    before = len(traced)
    for y in (0.1, 0.2):
        derivative(lambda y: product(INPUTS | {"y": y}))(jnp.array(y))
    assert len(traced) == before


rows_traced: list[int] = []


def fall(weights, x, y, *, capacity):
    """Return products of a row's numbers at several times, its sign, and a value that does not depend on it."""
    rows_traced.append(x.shape[0])
    times = jnp.asarray(weights) * jnp.arange(1.0, capacity + 1)
    return x[:, None] * jnp.sin(y)[:, None] * times, (x > 0).astype(jnp.int32), 0 * x + 1


FALLING = differentiable_rows(fall, (1, 4))
X, Y = np.array([0.3, -0.5, 0.7]), np.array([1.0, 1.2, 1.4])
TIMES = 2.0 * np.arange(1, 4)


def fallen(x, y):
    return FALLING(2.0, x, y, capacity=3)[0]


def test_slopes_of_rows_equal_slopes_by_hand_in_both_modes():
    by_x, by_y = np.sin(Y)[:, None] * TIMES, (X * np.cos(Y))[:, None] * TIMES
    for derivative in (jax.jacfwd, jax.jacrev):
        # A row of results depends on its row of inputs alone.
        for slopes, expected in zip(derivative(fallen, argnums=(0, 1))(X, Y), (by_x, by_y), strict=True):
            np.testing.assert_allclose(slopes, expected[..., None] * np.eye(3)[:, None], rtol=1e-15)
    slope_x, slope_y = jax.grad(lambda x, y: fallen(x, y)[1, 2], argnums=(0, 1))(X, Y)
    np.testing.assert_allclose(slope_x, [0, by_x[1, 2], 0], rtol=1e-15)
    np.testing.assert_allclose(slope_y, [0, by_y[1, 2], 0], rtol=1e-15)


def test_slopes_of_rows_are_equal_by_all_transformations():
    expected = jax.grad(lambda y: fallen(X, y).sum())(Y)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda y: fallen(X, y).sum()))(Y), expected, rtol=1e-14)
    several = jax.vmap(jax.grad(lambda y: fallen(X, y).sum()))(np.stack([Y, 2 * Y]))
    np.testing.assert_allclose(several[0], expected, rtol=1e-14)
    for twice in (jax.hessian, lambda of: jax.jacrev(jax.jacrev(of)), lambda of: jax.jacfwd(jax.jacfwd(of))):
        curved = twice(lambda y: fallen(X, y).sum())(Y)
        np.testing.assert_allclose(curved, np.diag(-X * np.sin(Y) * TIMES.sum()), atol=1e-14)


def test_rows_and_derivatives_of_any_number_share_a_program_until_they_are_many():
    jax.grad(lambda x: fallen(x, Y).sum())(X)
    before = len(rows_traced)
    for count in (2, 3, 4):
        jax.jacfwd(lambda y, count=count: fallen(np.resize(X, count), y))(np.resize(Y, count))
    assert len(rows_traced) == before
    slope = jax.grad(lambda x: fallen(x, np.resize(Y, 5)).sum())(np.resize(X, 5))
    np.testing.assert_allclose(slope, np.sin(np.resize(Y, 5)) * TIMES.sum(), rtol=1e-14)
    assert 5 in rows_traced[before:]


@pytest.mark.long
def test_batches_of_any_length_share_a_program():
    """Batches of a few rows share it; a batch that JAX makes outside of a program is padded."""

    def of_rows(y):
        return FALLING(2.0, X[:1], y[None], capacity=3)[0].sum()

    def of_number(y):
        return product(INPUTS | {"y": y})

    for of, value, slope, count in (
        (of_rows, lambda y: X[0] * np.sin(y) * TIMES.sum(), lambda y: X[0] * np.cos(y) * TIMES.sum(), rows_traced),
        (
            of_number,
            lambda y: np.sum(INPUTS["x"] * ABOUT) * y + np.sum(INPUTS["x"]),
            lambda y: np.sum(INPUTS["x"] * ABOUT) + 0 * y,
            traced,
        ),
    ):
        for derivative, expected in ((lambda f: f, value), (jax.grad, slope), (jax.jacfwd, slope)):
            y = jnp.linspace(1.0, 1.3, 8)
            jax.vmap(derivative(of))(y[:2])
            before = len(count)
            for length in range(1, 9):
                np.testing.assert_allclose(
                    jax.vmap(derivative(of))(y[:length]), expected(np.asarray(y[:length])), rtol=1e-14
                )
            assert len(count) == before
        outside = jax.grad(lambda y, of=of: jax.vmap(of)(y).sum())(y)
        np.testing.assert_allclose(outside, slope(np.asarray(y)), rtol=1e-14)
        nested = jax.vmap(jax.vmap(of))(jnp.stack([y, 2 * y]))
        np.testing.assert_allclose(nested[1], value(2 * np.asarray(y)), rtol=1e-14)


def test_constant_and_integer_results_have_no_slope():
    (moved, count, still), (slope, none, zero) = jax.jvp(lambda x: FALLING(2.0, x, Y, capacity=3), (X,), (np.ones(3),))
    np.testing.assert_array_equal(count, [1, 0, 1])
    assert none.dtype == jax.dtypes.float0
    np.testing.assert_array_equal(still, 1.0)
    np.testing.assert_array_equal(zero, 0.0)
    np.testing.assert_allclose(slope, np.sin(Y)[:, None] * TIMES, rtol=1e-15)
    np.testing.assert_allclose(moved, X[:, None] * slope, rtol=1e-15)


def test_derivatives_of_rows_in_a_traced_program_take_a_single_forward_pass():
    """In reverse mode, a simulation needs a loop forward and a loop backward."""

    def swing(weights, x, y, *, capacity):
        def step(x, _):
            x = jnp.sin(x) * y
            return x, x

        return lax.scan(step, x, length=capacity)[1].swapaxes(0, 1) * weights

    swinging = differentiable_rows(swing, (1, 4))

    def total(x):
        return swinging(2.0, x[None, 0], x[None, 1], capacity=3).sum()

    def plain(x):
        a, result = x[0], 0.0
        for _ in range(3):
            a = jnp.sin(a) * x[1]
            result += 2 * a
        return result

    x = np.array([0.3, 1.2])
    for derivative in (jax.grad, jax.jacfwd, jax.hessian, lambda f: jax.jacrev(jax.jacrev(f))):
        assert str(jax.make_jaxpr(derivative(total))(x)).count("scan[") == 1
        np.testing.assert_allclose(jax.jit(derivative(total))(x), jax.jit(derivative(plain))(x), rtol=1e-13)
    np.testing.assert_allclose(jax.hessian(total)(x), jax.hessian(plain)(x), rtol=1e-13)
    third = jax.jit(jax.jacfwd(jax.hessian(total)))(x)
    np.testing.assert_allclose(third, jax.jacfwd(jax.hessian(plain))(x), rtol=1e-13)
