"""Short pieces of a motion x'' + mu x' + kappa^2 x = f by Taylor series, and what is certain of a function on one.

In flight mu and kappa are 0. A piece is at most `REACH` of the fastest time scale in it long: there the series of
`TERMS` terms is exact to rounding, and a function with a bounded fourth derivative is told from zero by a handful of
numbers (`above`, `falling`), however f came about.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from vijax.model.flow import PI
from vijax.model.waves import Waves, later
from vijax.runtime.arrays import Flags, Values
from vijax.runtime.xla import shared

REACH = 1.0
# The first neglected term of a piece within reach is 1e-18 of the sum.
TERMS = 19
_OVER_FACTORIAL = tuple(1.0 / math.factorial(n) for n in range(TERMS + 1))

# Taylor terms of a squared rate, the square itself included, that its integral over a step takes at both ends.
_MATCHED = 8
# Weights of these terms: the integral is s sum_n weight_n (first_n + (-1)^n last_n).
_TWO_POINT = tuple(
    math.factorial(n) * math.comb(_MATCHED, n + 1) / math.perm(2 * _MATCHED, n + 1) for n in range(_MATCHED)
)


class Push(eqx.Module):
    """What pushes the ball from some moment on, until the next knot: a straight line, and harmonics of the forcing.

    Attributes:
        level, slope: Of the line level + slope s; gravity is part of it.
        waves: The harmonics.
    """

    level: Values
    slope: Values
    waves: Waves = ()

    def turned(self, sign: Values) -> "Push":
        """Give the push as a wall of that sign sees it."""
        return Push(sign * self.level, sign * self.slope, tuple(wave.times(sign) for wave in self.waves))

    def later(self, s: Values) -> "Push":
        """Start its clock a time s later."""
        return Push(self.level + self.slope * s, self.slope, later(self.waves, s))

    def derivatives(self) -> tuple[Values, Values, Values, Values]:
        """Compute its value and the first three derivatives now."""
        value, rate, bend = self.level, self.slope, jnp.zeros_like(self.level)
        twist = bend
        for wave in self.waves:
            pace = wave.order * PI
            value, rate = value + wave.c, rate - pace * wave.q
            bend, twist = bend - pace**2 * wave.c, twist + pace**3 * wave.q
        return value, rate, bend, twist

    def fourth(self) -> Values:
        """Compute its fourth derivative now."""
        return sum(((wave.order * PI) ** 4 * wave.c for wave in self.waves), start=jnp.zeros_like(self.level))


class Oscillator(NamedTuple):
    """The membrane that the ball is in: kappa, kappa^2 and mu, all 0 in flight; how far a series reaches there."""

    kappa: Values
    square: Values
    mu: Values
    reach: Values


class Rates(NamedTuple):
    """A displacement and its first four derivatives by time."""

    x: Values
    z: Values
    a: Values
    j: Values
    snap: Values

    def after(self, s: Values) -> "Rates":
        """Continue them for a time so short that its fifth power is nothing, but for the last two."""
        x = self.x + s * (self.z + s * (self.a / 2 + s * (self.j / 6 + s * self.snap / 24)))
        z = self.z + s * (self.a + s * (self.j / 2 + s * self.snap / 6))
        return Rates(x, z, self.a + s * (self.j + s * self.snap / 2), self.j + s * self.snap, self.snap)


def rates(spring: Oscillator, push: Push, x: Values, z: Values) -> Rates:
    """Compute the derivatives of the motion where the ball is at x with velocity z."""
    value, rate, bend, _ = push.derivatives()
    a = value - spring.mu * z - spring.square * x
    j = rate - spring.mu * a - spring.square * z
    return Rates(x, z, a, j, bend - spring.mu * j - spring.square * a)


@shared
def moved(spring: Oscillator, push: Push, x: Values, z: Values, s: Values) -> tuple[Values, Values]:
    """Compute displacement and velocity at a time s, within `REACH` of every time scale.

    Sums b_n s/n! and b_n/(n - 1)! of b_n = s^(n - 1) x^(n) from n = 1, as `flow` does for a single harmonic.
    """
    loss, stiffness = spring.mu * s, spring.square * s * s
    value, *_ = push.derivatives()
    turned = [wave.order * PI * s for wave in push.waves]
    # What f^(n) s^(n + 1) is made of: the line ends with its slope, harmonics recur after two steps.
    even = [s * wave.c for wave in push.waves]
    odd = [-turn * (s * wave.q) for turn, wave in zip(turned, push.waves, strict=True)]
    b, after = z, s * (value - spring.mu * z - spring.square * x)
    far, fast = jnp.zeros_like(x), jnp.zeros_like(x)
    for n in range(1, TERMS + 1):
        far, fast = far + _OVER_FACTORIAL[n] * b, fast + _OVER_FACTORIAL[n - 1] * b
        drive = sum(odd, s * s * push.slope if n == 1 else jnp.zeros_like(s))
        b, after = after, drive - loss * after - stiffness * b
        even, odd = odd, [-turn * turn * e for turn, e in zip(turned, even, strict=True)]
    return x + s * far, fast


@shared
def squared_rate(
    spring: Oscillator, push: tuple[Push, Push], ends: tuple[Rates, Rates], s: Values, delay: Values
) -> Values:
    """Compute the integral of x'^2 over a step and the short delay after it.

    By the two-point Hermite formula, with `_MATCHED` Taylor terms of x'^2 at both ends. Its remainder is
    (m!)^2/((2m)! (2m + 1)!) s^(2m) times derivative 2m of x'^2, m = `_MATCHED`. Within `REACH` that derivative is at
    most 2^(2m) of the largest x'^2, so that the relative error is about 1.4e-14.

    Args:
        spring: The membrane.
        push: At the start and at the end of the step.
        ends: Where the ball is there.
        s: Length of the step.
        delay: Time after the end that is integrated, too.
    """
    first, last = (_squares(_rate_terms(spring, of, at.x, at.z, s)) for of, at in zip(push, ends, strict=True))
    total = sum(w * (a + (-1) ** n * b) for n, (w, a, b) in enumerate(zip(_TWO_POINT, first, last, strict=True)))
    z, a, j = ends[1].z, ends[1].a, ends[1].j
    return s * total + delay * (z * z + delay * (z * a + delay * (a * a + z * j) / 3))


def _rate_terms(spring: Oscillator, push: Push, x: Values, z: Values, s: Values) -> list[Values]:
    """Compute the Taylor terms s^n z^(n)/n! of the rate z = x' from n = 0, where the ball is at x with rate z."""
    line = [push.level, push.slope]
    # Of each harmonic its pace, its current derivative and the next one.
    waves = [(wave.order * PI, wave.c, -(wave.order * PI) * wave.q) for wave in push.waves]
    before, now, power, terms = x, z, jnp.ones_like(s), [z]
    for n in range(1, _MATCHED):
        drive = sum((value for _, value, _ in waves), start=line[n - 1] if n <= len(line) else jnp.zeros_like(x))
        waves = [(pace, after, -pace * pace * value) for pace, value, after in waves]
        before, now, power = now, drive - spring.mu * now - spring.square * before, power * s
        terms.append(_OVER_FACTORIAL[n] * (power * now))
    return terms


def _squares(terms: list[Values]) -> list[Values]:
    """Compute as many Taylor terms of the square of a series."""
    found = []
    for n in range(len(terms)):
        twice = sum((terms[k] * terms[n - k] for k in range((n + 1) // 2)), start=jnp.zeros_like(terms[0]))
        found.append(2 * twice + (terms[n // 2] ** 2 if n % 2 == 0 else 0.0))
    return found


def steepest(spring: Oscillator, bend: Values, now: Rates, s: Values) -> Values:
    """Bound the fourth derivative over the next s, where |f''| <= `bend`.

    x'' obeys the equation of x under f'': its swing |x'''| + kappa |x''| grows by no more than the integral of |f''|.
    """
    swing = jnp.abs(now.j) + spring.kappa * jnp.abs(now.a) + s * bend
    return bend + (spring.mu + spring.kappa) * swing


def above(f: tuple[Values, ...], most: Values, s: Values) -> Flags:
    """Say whether f > 0 for certain on (0, s], where f, f', f'', f''' at 0 are given and |f''''| <= `most`.

    By Bernstein coefficients of the polynomial below f. It may begin at 0, where the ball leaves a wall, and at
    rest there: where no coefficient is below 0, the last one decides.
    """
    f0, f1, f2, f3 = f
    second = f0 + s * (f1 / 2 + s * f2 / 12)
    third = f0 + s * (3 * f1 / 4 + s * (f2 / 4 + s * f3 / 24))
    last = f0 + s * (f1 + s * (f2 / 2 + s * (f3 / 6 - s * most / 24)))
    least = jnp.minimum(jnp.minimum(f0, f0 + s * f1 / 4), jnp.minimum(second, third))
    return (least >= 0) & (last > 0)


def falling(f: tuple[Values, Values, Values], most: Values, s: Values) -> Flags:
    """Say whether f < 0 for certain on (0, s], where f, f', f'' at 0 are given and |f'''| <= `most`; 0 at the start."""
    f0, f1, f2 = f
    second, last = f0 + s * (2 * f1 / 3 + s * f2 / 6), f0 + s * (f1 + s * (f2 / 2 + s * most / 6))
    return (jnp.maximum(jnp.maximum(f0, f0 + s * f1 / 3), second) <= 0) & (last < 0)


def steady_sign(f: tuple[Values, Values], most: Values, s: Values) -> Flags:
    """Say whether f keeps its sign for certain on [0, s], where f and f' at 0 are given and |f''| <= `most`."""
    f0, f1 = f
    middle, last, slack = f0 + s * f1 / 2, f0 + s * f1, s * s * most / 2
    least, largest = (pick(pick(f0, middle), last) for pick in (jnp.minimum, jnp.maximum))
    return (least - slack > 0) | (largest + slack < 0)


def closed(residual: tuple[Values, ...], s: Values) -> Values:
    """Evaluate f + f' s + ... + f'''' s^4/24: what is left of a root that is s away."""
    f0, f1, f2, f3, f4 = residual
    return f0 + s * (f1 + s * (f2 / 2 + s * (f3 / 6 + s * f4 / 24)))
