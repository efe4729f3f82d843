"""The stretches on which a forcing keeps its sign: what every careful search goes by."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from vijax.model.flow import PI, Force
from vijax.runtime.arrays import Flags, Values, nearest
from vijax.runtime.xla import once


def snap(dtype: Any) -> float:
    """Say how close two event times count as one: a few units in the last place of a period."""
    return 16 * float(jnp.finfo(dtype).eps)


class Spell(eqx.Module):
    """A stretch of constant sign of a forcing: its sign and when it ends."""

    positive: Flags
    end: Values


def _half_width(force: Force) -> Values:
    """Compute half the length of the positive stretch of c cos - q sin - g; 0 or 1 where the sign never changes."""
    amplitude = jnp.hypot(force.c, force.q)
    level = force.g / jnp.where(amplitude > 0, amplitude, 1.0)
    level = jnp.where(amplitude > 0, level, jnp.where(force.g < 0, -1.0, 1.0))
    return jnp.arccos(jnp.clip(level, -1.0, 1.0)) / PI


@once
def spell_after(force: Force, s: Values) -> Spell:
    """Find the sign of the forcing just after s, and the end of that stretch; an end within rounding of s is past."""
    half = _half_width(force)
    x = s + jnp.arctan2(force.q, force.c) / PI
    x = x - 2 * nearest(0.5 * x)  # the positive stretch is |x| < half
    inside = jnp.abs(x) < half
    left = jnp.where(inside, half - x, jnp.where(x < 0, -half - x, 2 - half - x))
    over = left < snap(s.dtype) * (1 + jnp.abs(s))
    length = jnp.where(inside, 2 - 2 * half, 2 * half)  # how long the next stretch is
    constant = (half <= 0) | (half >= 1)
    left = jnp.where(constant, jnp.inf, jnp.where(over, left + length, left))
    positive = jnp.where(constant, half >= 1, inside ^ over)
    return Spell(positive, s + left)
