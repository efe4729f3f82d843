"""Intervals where a forcing keeps its sign; every robust search uses them.

The forcing is f(s) = c cos(pi s) - q sin(pi s) - g (`flow.Force`). Its zeros are closed-form.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vijax.model.flow import PI, Force
from vijax.runtime.arrays import Flags, Values, round_half_up
from vijax.runtime.compilation.xla import reuse_trace


def event_tolerance(dtype: Any) -> float:
    """Return the relative difference of time below which two events count as one: 16 machine epsilons."""
    return 16 * float(jnp.finfo(dtype).eps)


class SignInterval(eqx.Module):
    """An interval where a forcing keeps its sign: the sign, and the end of the interval (inf: for ever)."""

    positive: Flags
    end: Values


def _half_width(force: Force) -> Values:
    """Return half the length of the interval where c cos - q sin - g > 0: 0 if it is never positive, 1 if always."""
    amplitude = jnp.hypot(force.c, force.q)
    level = force.g / jnp.where(amplitude > 0, amplitude, 1.0)
    level = jnp.where(amplitude > 0, level, jnp.where(force.g < 0, -1.0, 1.0))
    return jnp.arccos(jnp.clip(level, -1.0, 1.0)) / PI


@reuse_trace
def sign_interval_after(force: Force, s: Values) -> SignInterval:
    """Return the sign of the forcing just after s and the end of that interval.

    If the interval that contains s ends within rounding of s, the next interval is returned.
    """
    half = _half_width(force)
    # Phase of the forcing relative to its maximum, reduced to [-1, 1]; the period is 2.
    x = s + jnp.arctan2(force.q, force.c) / PI
    x = x - 2 * round_half_up(0.5 * x)  # the positive interval is |x| < half
    is_positive = jnp.abs(x) < half
    # Time to the end of the positive interval, or to the start of the next positive interval.
    remaining = jnp.where(is_positive, half - x, jnp.where(x < 0, -half - x, 2 - half - x))
    # An end within the tolerance counts as passed, so the next interval is returned.
    is_past = remaining < event_tolerance(s.dtype) * (1 + jnp.abs(s))
    length = jnp.where(is_positive, 2 - 2 * half, 2 * half)  # length of the next interval
    constant = (half <= 0) | (half >= 1)
    remaining = jnp.where(constant, jnp.inf, jnp.where(is_past, remaining + length, remaining))
    positive = jnp.where(constant, half >= 1, is_positive ^ is_past)
    return SignInterval(positive, s + remaining)
