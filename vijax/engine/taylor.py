"""Short pieces of a motion x'' + mu x' + kappa^2 x = f by Taylor series, and what is certain of a function on one.

In flight mu and kappa are 0. A piece is at most `REACH` of the fastest time scale in it long: there the series of
`TERMS` terms is exact to rounding, and a function with a bounded fourth derivative is told from zero by a handful of
numbers (`above`, `falling`), however f came about.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from vijax.model.flow import PI, half_turn
from vijax.runtime.arrays import Flags, Values
from vijax.runtime.xla import shared

REACH = 1.0
# The first neglected term of a piece within reach is 1e-18 of the sum.
TERMS = 19
_OVER_FACTORIAL = tuple(1.0 / math.factorial(n) for n in range(TERMS + 1))


class Push(NamedTuple):
    """What pushes the ball from some moment on, until the next knot: a straight line and harmonics of the forcing.

    f(s) = level + slope s + sum over k in `orders` of along_k cos(k pi s) - across_k sin(k pi s)

    Attributes:
        level, slope: Of the line; gravity is part of it.
        along, across: One value a harmonic.
        orders: Which multiple of the forcing frequency each one is; whole numbers.
    """

    level: Values
    slope: Values
    along: tuple[Values, ...] = ()
    across: tuple[Values, ...] = ()
    orders: tuple[int, ...] = ()

    def turned(self, sign: Values) -> "Push":
        """Give the push as a wall of that sign sees it."""
        along, across = (tuple(sign * one for one in part) for part in (self.along, self.across))
        return Push(sign * self.level, sign * self.slope, along, across, self.orders)

    def later(self, s: Values) -> "Push":
        """Start its clock a time s later."""
        along, across = [], []
        for k, c, q in zip(self.orders, self.along, self.across, strict=True):
            sine, cosine, _, _ = half_turn(k * s)
            along.append(c * cosine - q * sine)
            across.append(q * cosine + c * sine)
        return Push(self.level + self.slope * s, self.slope, tuple(along), tuple(across), self.orders)

    def derivatives(self) -> tuple[Values, Values, Values, Values]:
        """Compute f, f', f'' and f''' now."""
        value, rate, bend = self.level, self.slope, jnp.zeros_like(self.level)
        twist = bend
        for k, c, q in zip(self.orders, self.along, self.across, strict=True):
            pace = k * PI
            value, rate, bend, twist = value + c, rate - pace * q, bend - pace**2 * c, twist + pace**3 * q
        return value, rate, bend, twist


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
    turns = [-((k * PI * s) ** 2) for k in push.orders]
    # What f^(n) s^(n + 1) is made of: the line ends with its slope, harmonics recur after two steps.
    even = [s * c for c in push.along]
    odd = [-(k * PI * s) * (s * q) for k, q in zip(push.orders, push.across, strict=True)]
    b, after = z, s * (value - spring.mu * z - spring.square * x)
    far, fast = jnp.zeros_like(x), jnp.zeros_like(x)
    for n in range(1, TERMS + 1):
        far, fast = far + _OVER_FACTORIAL[n] * b, fast + _OVER_FACTORIAL[n - 1] * b
        drive = sum(odd, s * s * push.slope if n == 1 else jnp.zeros_like(s))
        b, after = after, drive - loss * after - stiffness * b
        even, odd = odd, [turn * e for turn, e in zip(turns, even, strict=True)]
    return x + s * far, fast


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
