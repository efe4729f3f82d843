"""Sine, cosine, exponential and arcsine as polynomials on bounded ranges, faster than the library functions.

The precision is the precision of the argument. Single precision takes half the terms of double, with twice as many
lanes per vector.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vijax.model.flow import PI, horner
from vijax.runtime.arrays import Lane, round_half_up
from vijax.runtime.compilation.xla import materialised, reuse_trace

# Largest |x| for sine and cosine, in radians. A quarter turn is 1.571, and contacts need a little more. A larger range
# would need more terms for the same accuracy.
REACH = 1.65
# Largest |x| for the exponential, which is computed at x/4 and squared twice.
EXP_REACH = 2.4
_QUARTER = 0.25 * EXP_REACH


def _economised(series: list[float], low: float, high: float, terms: int) -> tuple[float, ...]:
    """Return the polynomial with `terms` terms through a power series at the Chebyshev points of [low, high]."""
    nodes = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    values = np.polynomial.polynomial.polyval(nodes, series)
    fit = np.polynomial.chebyshev.Chebyshev.fit(nodes, values, terms - 1, domain=[low, high])
    return tuple(fit.convert(kind=np.polynomial.Polynomial).coef.tolist())


def _alternating(start: int) -> list[float]:
    """Return the coefficients (-1)^k/(start + 2k)! of the remainder of a sine or cosine series in x^2."""
    return [(-1.0) ** k / math.factorial(start + 2 * k) for k in range(16)]


class _Tables(eqx.Module):
    """Coefficients for one precision.

    A polynomial approximates the remainder of its function after the leading terms, so that a power of x scales the
    rounding errors of the polynomial down.
    """

    sine: tuple[float, ...]  # (x - sin x)/x^3
    cosine: tuple[float, ...]  # (cos x - 1 + x^2/2)/x^4
    exp: tuple[float, ...]  # (exp x - 1 - x)/x^2 on a quarter of the range
    arcsine: tuple[float, ...]  # asin(x)/x in x^2 on [0, 1/4]


def _tables(sine: int, cosine: int, exp: int, arcsine: int) -> _Tables:
    powers = [1.0 / math.factorial(k + 2) for k in range(18)]
    binomial = [math.comb(2 * k, k) / (4.0**k * (2 * k + 1)) for k in range(60)]
    return _Tables(
        _economised(_alternating(3), 0, REACH**2, sine),
        _economised(_alternating(4), 0, REACH**2, cosine),
        _economised(powers, -_QUARTER, _QUARTER, exp),
        _economised(binomial, 0, 0.25, arcsine),
    )


# Numbers of terms. The largest absolute errors are a few machine epsilons (test_polynomial.py). Taylor series would
# need four to six terms more.
_DOUBLE, _SINGLE = _tables(10, 9, 12, 13), _tables(4, 4, 6, 6)


def _of(x: Lane) -> _Tables:
    """Return the coefficients for the precision of x."""
    return _DOUBLE if x.dtype == jnp.float64 else _SINGLE


@reuse_trace
@materialised
def sine_cosine(x: Lane) -> tuple[Lane, Lane]:
    """Return sin and cos on |x| <= REACH."""
    square = x * x
    sine = x - x * square * horner(_of(x).sine, square)
    return sine, 1 - square * (0.5 - square * horner(_of(x).cosine, square))


@reuse_trace
def exp(x: Lane) -> Lane:
    """Return exp on |x| <= EXP_REACH."""
    quarter = 0.25 * x
    quarter = 1 + quarter * (1 + quarter * horner(_of(x).exp, quarter))
    half = quarter * quarter
    return half * half


@reuse_trace
def long_decay(x: Lane) -> Lane:
    """Return exp(-x) for x >= 0, with a relative error of a few dozen roundings; for large x return about 2e-17."""
    # exp is evaluated at -x/16, which is within its range, and the result is squared four times.
    value = exp(jnp.minimum(x, 16 * EXP_REACH) * (-1 / 16))
    for _ in range(4):
        value = value * value
    return value


@reuse_trace
def phase(t: Lane) -> tuple[Lane, Lane]:
    """Return sin(pi t) and cos(pi t) for t in [0, 2], by reduction to the nearest quarter turn."""
    # The remaining angle is at most pi/4.
    quadrant = round_half_up(2 * t)
    sine, cosine = sine_cosine(PI * (t - 0.5 * quadrant))
    odd, back = (quadrant == 1) | (quadrant == 3), (quadrant == 2) | (quadrant == 3)
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, -sine, cosine)
    return jnp.where(back, -sine, sine), jnp.where(back, -cosine, cosine)


def arcsine(x: Lane) -> Lane:
    """Return asin on [-1, 1]; for |x| > 1/2 by asin(x) = pi/2 - 2 asin(sqrt((1 - x)/2))."""
    size = jnp.abs(x)
    outer = size > 0.5
    square = jnp.where(outer, 0.5 * (1 - size), size * size)
    root = jnp.where(outer, jnp.sqrt(jnp.where(outer, square, 1.0)), size)
    inner = root * horner(_of(x).arcsine, square)
    return jnp.where(x < 0, -1.0, 1.0) * jnp.where(outer, 0.5 * PI - 2 * inner, inner)
