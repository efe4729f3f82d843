"""Polynomial approximations have an error of a few roundings on their full range."""

import jax.numpy as jnp
import numpy as np
import pytest

from vijax.impact import polynomial


@pytest.fixture(params=[np.float64, np.float32], ids=["double", "single"])
def drawn(request):
    """A range in one precision, the same range in double precision, and the rounding of the precision."""

    def points(low, high):
        x = np.linspace(low, high, 20001).astype(request.param)
        return jnp.asarray(x), x.astype(np.float64), float(np.finfo(request.param).eps)

    return points


def test_sine_and_cosine(drawn):
    x, wide, eps = drawn(-polynomial.REACH, polynomial.REACH)
    sine, cosine = map(np.asarray, polynomial.sine_cosine(x))
    assert sine.dtype == x.dtype
    assert np.max(np.abs(sine - np.sin(wide))) < 4 * eps
    assert np.max(np.abs(cosine - np.cos(wide))) < 4 * eps


def test_exponential(drawn):
    x, wide, eps = drawn(-polynomial.EXP_REACH, polynomial.EXP_REACH)
    assert np.max(np.abs(np.asarray(polynomial.exp(x)) / np.exp(wide) - 1)) < 8 * eps


def test_long_decay(drawn):
    x, wide, eps = drawn(0, 16 * polynomial.EXP_REACH)
    assert np.max(np.abs(np.asarray(polynomial.long_decay(x)) / np.exp(-wide) - 1)) < 200 * eps


def test_arcsine(drawn):
    x, wide, eps = drawn(-1, 1)
    assert np.max(np.abs(np.asarray(polynomial.arcsine(x)) - np.arcsin(wide))) < 4 * eps


def test_phase(drawn):
    t, wide, eps = drawn(0, 2)
    sine, cosine = map(np.asarray, polynomial.phase(t))
    assert np.max(np.abs(sine - np.sin(np.pi * wide))) < 5 * eps
    assert np.max(np.abs(cosine - np.cos(np.pi * wide))) < 5 * eps
