"""Short steps of a motion x'' + mu x' + kappa^2 x = f by Taylor series, and certificates on the sign of a function.

In flight mu and kappa are 0. A step is at most `REACH` times the fastest time scale, so the series of `TERMS` terms is
exact to rounding. `certify_positive` and `certify_negative` prove the sign of a function on a step from its derivatives
at the start and a bound of a higher derivative, for any forcing f.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from vijax.model.flow import PI
from vijax.model.forcing.waves import Waves, waves_later
from vijax.runtime.arrays import Flags, Values
from vijax.runtime.compilation.xla import materialised

# Longest step of a series, in units of the fastest time scale: 1/kappa, or 1/(k pi) for a harmonic of order k.
REACH = 1.0
# Number of terms of a series: for a step within REACH the first neglected term is 1e-18 of the sum.
TERMS = 19
_OVER_FACTORIAL = tuple(1.0 / math.factorial(n) for n in range(TERMS + 1))

# Number of Taylor terms of a squared rate, from its own value on, that the integral over a step uses at each end.
_MATCHED = 8
# Weights of these terms: the integral is s sum_n weight_n (first_n + (-1)^n last_n).
_TWO_POINT = tuple(
    math.factorial(n) * math.comb(_MATCHED, n + 1) / math.perm(2 * _MATCHED, n + 1) for n in range(_MATCHED)
)


class Push(eqx.Module):
    """Force on the ball from some time until the next knot: a straight line, and harmonics of the forcing.

    Attributes:
        level, slope: The line level + slope s; gravity is part of it.
        waves: The harmonics.
    """

    level: Values
    slope: Values
    waves: Waves = ()

    def turned(self, sign: Values) -> "Push":
        """Return the force in the direction of a side, -1 or +1."""
        return Push(sign * self.level, sign * self.slope, tuple(wave.scaled_by(sign) for wave in self.waves))

    def later(self, s: Values) -> "Push":
        """Return the force relative to a time s later."""
        return Push(self.level + self.slope * s, self.slope, waves_later(self.waves, s))

    def derivatives(self) -> tuple[Values, Values, Values, Values]:
        """Return the force and its first three derivatives at time 0."""
        value, rate, bend = self.level, self.slope, jnp.zeros_like(self.level)
        twist = bend
        for wave in self.waves:
            omega = wave.order * PI
            value, rate = value + wave.c, rate - omega * wave.q
            bend, twist = bend - omega**2 * wave.c, twist + omega**3 * wave.q
        return value, rate, bend, twist

    def fourth(self) -> Values:
        """Return the fourth derivative of the force at time 0."""
        return sum(((wave.order * PI) ** 4 * wave.c for wave in self.waves), start=jnp.zeros_like(self.level))


class Oscillator(NamedTuple):
    """Membrane that the ball is in: kappa, kappa^2, mu (all 0 in flight), and the longest step of a series."""

    kappa: Values
    square: Values
    mu: Values
    reach: Values


class Rates(NamedTuple):
    """Displacement and its first four time derivatives."""

    x: Values
    z: Values
    a: Values
    j: Values
    snap: Values

    def after(self, s: Values) -> "Rates":
        """Return the rates after a short time s; the error of x is of order s^5, of derivative k of order s^(5 - k)."""
        x = self.x + s * (self.z + s * (self.a / 2 + s * (self.j / 6 + s * self.snap / 24)))
        z = self.z + s * (self.a + s * (self.j / 2 + s * self.snap / 6))
        return Rates(x, z, self.a + s * (self.j + s * self.snap / 2), self.j + s * self.snap, self.snap)


def rates(spring: Oscillator, push: Push, x: Values, z: Values) -> Rates:
    """Return the derivatives of the motion for displacement x and velocity z."""
    value, rate, bend, _ = push.derivatives()
    a = value - spring.mu * z - spring.square * x
    j = rate - spring.mu * a - spring.square * z
    return Rates(x, z, a, j, bend - spring.mu * j - spring.square * a)


@materialised
def advance_series(spring: Oscillator, push: Push, x: Values, z: Values, s: Values) -> tuple[Values, Values]:
    """Return displacement and velocity after a time s; s must not exceed `REACH` times any time scale of the motion.

    The method sums b_n s/n! and b_n/(n - 1)! from n = 1, with b_n = s^(n - 1) x^(n), as `flow` does for a single
    harmonic.
    """
    # mu s and (kappa s)^2: the coefficients of the recurrence for b_n.
    loss, stiffness = spring.mu * s, spring.square * s * s
    value, *_ = push.derivatives()
    turned = [wave.order * PI * s for wave in push.waves]
    # Terms of f^(n) s^(n + 1): the line ends with its slope, and harmonics recur with period two in n.
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


@materialised
def squared_rate(
    spring: Oscillator, push: tuple[Push, Push], ends: tuple[Rates, Rates], s: Values, delay: Values
) -> Values:
    """Return the integral of x'^2 over a step and the short delay after it.

    The method is the two-point Hermite formula with `_MATCHED` Taylor terms of x'^2 at each end. Its remainder is
    (m!)^2/((2m)! (2m + 1)!) s^(2m) times derivative 2m of x'^2, m = `_MATCHED`. Within `REACH` that derivative is at
    most 2^(2m) times the largest x'^2, so the relative error is about 1.4e-14.

    Args:
        spring: The membrane.
        push: Force at the start and at the end of the step.
        ends: State at the start and at the end of the step.
        s: Length of the step.
        delay: Time after the end that the integral includes.
    """
    first, last = (_squares(_rate_terms(spring, of, at.x, at.z, s)) for of, at in zip(push, ends, strict=True))
    total = sum(w * (a + (-1) ** n * b) for n, (w, a, b) in enumerate(zip(_TWO_POINT, first, last, strict=True)))
    z, a, j = ends[1].z, ends[1].a, ends[1].j
    return s * total + delay * (z * z + delay * (z * a + delay * (a * a + z * j) / 3))


def _rate_terms(spring: Oscillator, push: Push, x: Values, z: Values, s: Values) -> list[Values]:
    """Return the Taylor terms s^n z^(n)/n! of the rate z = x' from n = 0, for displacement x and rate z."""
    line = [push.level, push.slope]
    # For each harmonic: its angular frequency, its current derivative and the next one.
    waves = [(wave.order * PI, wave.c, -(wave.order * PI) * wave.q) for wave in push.waves]
    previous, now, power, terms = x, z, jnp.ones_like(s), [z]
    for n in range(1, _MATCHED):
        drive = sum((value for _, value, _ in waves), start=line[n - 1] if n <= len(line) else jnp.zeros_like(x))
        waves = [(omega, after, -omega * omega * value) for omega, value, after in waves]
        previous, now, power = now, drive - spring.mu * now - spring.square * previous, power * s
        terms.append(_OVER_FACTORIAL[n] * (power * now))
    return terms


def _squares(terms: list[Values]) -> list[Values]:
    """Return the Taylor terms of the square of a series, as many as the series has."""
    squares = []
    for n in range(len(terms)):
        # Cauchy product: each mixed term occurs twice, and even orders have one square.
        twice = sum((terms[k] * terms[n - k] for k in range((n + 1) // 2)), start=jnp.zeros_like(terms[0]))
        squares.append(2 * twice + (terms[n // 2] ** 2 if n % 2 == 0 else 0.0))
    return squares


def fourth_derivative_bound(spring: Oscillator, curvature_bound: Values, now: Rates, s: Values) -> Values:
    """Return a bound of the fourth derivative over the next s, where |f''| <= `curvature_bound`.

    x'' obeys the equation of x with the forcing f'', so |x'''| + kappa |x''| grows by at most the integral of |f''|.
    """
    swing = jnp.abs(now.j) + spring.kappa * jnp.abs(now.a) + s * curvature_bound
    return curvature_bound + (spring.mu + spring.kappa) * swing


def certify_positive(f: tuple[Values, ...], most: Values, s: Values) -> Flags:
    """Certify f > 0 on (0, s] from f, f', f'', f''' at 0 and |f''''| <= `most`.

    The test uses the Bernstein coefficients of a polynomial that lies below f. f(0) = 0 and f'(0) = 0 are allowed (a
    ball that leaves a wall, also from rest): no coefficient may be negative, and the last one must be positive.
    """
    f0, f1, f2, f3 = f
    # Coefficients 2 to 4 of degree 4 on [0, s], for the lower bound f'''' = -most.
    second = f0 + s * (f1 / 2 + s * f2 / 12)
    third = f0 + s * (3 * f1 / 4 + s * (f2 / 4 + s * f3 / 24))
    last = f0 + s * (f1 + s * (f2 / 2 + s * (f3 / 6 - s * most / 24)))
    least = jnp.minimum(jnp.minimum(f0, f0 + s * f1 / 4), jnp.minimum(second, third))
    return (least >= 0) & (last > 0)


def certify_negative(f: tuple[Values, Values, Values], most: Values, s: Values) -> Flags:
    """Certify f < 0 on (0, s] from f, f', f'' at 0 and |f'''| <= `most`; f may start at 0."""
    # Bernstein coefficients of degree 3, for the upper bound f''' = most.
    f0, f1, f2 = f
    second, last = f0 + s * (2 * f1 / 3 + s * f2 / 6), f0 + s * (f1 + s * (f2 / 2 + s * most / 6))
    return (jnp.maximum(jnp.maximum(f0, f0 + s * f1 / 3), second) <= 0) & (last < 0)


def certify_constant_sign(f: tuple[Values, Values], most: Values, s: Values) -> Flags:
    """Certify that f keeps its sign on [0, s] from f and f' at 0 and |f''| <= `most`."""
    f0, f1 = f
    middle, last, slack = f0 + s * f1 / 2, f0 + s * f1, s * s * most / 2
    least, largest = (pick(pick(f0, middle), last) for pick in (jnp.minimum, jnp.maximum))
    return (least - slack > 0) | (largest + slack < 0)


def residual_at(residual: tuple[Values, ...], s: Values) -> Values:
    """Return f + f' s + ... + f'''' s^4/24, the residual after a time s by its Taylor polynomial; 0 at the root."""
    f0, f1, f2, f3, f4 = residual
    return f0 + s * (f1 + s * (f2 / 2 + s * (f3 / 6 + s * f4 / 24)))
