"""Closed-form flow of the ball at elapsed time s: in flight, and in contact with a membrane.

Differences are written without cancellation (1 - cos x and x - sin x by series), because low-speed bounces live in
exactly the digits that the naive forms lose.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.model.restitution import calibrated
from vijax.runtime.arrays import Values, nearest
from vijax.runtime.xla import once, share, shared

PI = math.pi


def _alternating(start: int, terms: int) -> tuple[float, ...]:
    """Compute Taylor coefficients (-1)^k / (start + 2k)! in ascending powers of x^2."""
    return tuple((-1.0) ** k / math.factorial(start + 2 * k) for k in range(terms))


class Membrane(eqx.Module):
    """What the contact closed form needs of a soft wall: natural frequency, decay rate, damped frequency (all > 0).

    `rolled` keeps its Taylor series a loop: a program that is differentiated compiles in seconds instead of minutes,
    and any other sooner; one that is not differentiated runs three times faster unrolled.
    """

    kappa: Values
    zeta: Values
    omega1: Values
    rolled: bool = eqx.field(static=True, default=False)

    @property
    def mu(self) -> Values:
        """Compute the damping mu = 2 zeta of w'' + mu w' + kappa^2 w = f."""
        return 2 * self.zeta


class Force(eqx.Module):
    """Forcing c cos(pi s) - q sin(pi s) - g at elapsed time s."""

    c: Values
    q: Values
    g: Values

    def at(self, s: Values) -> Values:
        """Evaluate the forcing at elapsed time s."""
        sin_s, cos_s = phasor(s)
        return self.c * cos_s - self.q * sin_s - self.g

    def later(self, s: Values) -> "Force":
        """Start the clock of the same forcing a time s later."""
        sin_s, cos_s = phasor(s)
        return Force(self.c * cos_s - self.q * sin_s, self.q * cos_s + self.c * sin_s, self.g)

    def slope(self) -> "Force":
        """Differentiate the forcing by time."""
        return Force(-PI * self.q, PI * self.c, jnp.zeros_like(self.g))


@shared
def membrane(pair: ImpactPair, *, rolled: bool = False) -> Membrane:
    """Find the soft wall of a pair whose walls are equal, as `restitution` calibrates it."""
    kappa = pair._soft_kappa()
    zeta, omega1 = calibrated(kappa, pair.r)
    # Else every loop that needs omega1 makes its own, and some lanes of a loop round PI - omega1 once and others twice.
    return Membrane(kappa, zeta, omega1, rolled)


# On |x| <= pi/4 the first neglected term is below 1e-17 of the sum.
_LAG = _alternating(3, 8)
# sinh(z)/z on |z| < 1/2 in powers of z^2.
_SINHC = tuple(1.0 / math.factorial(2 * k + 1) for k in range(8))
# The exponentials of a contact with max(kappa, pi) s < 1 need this many Taylor terms for 1e-17.
_CONTACT_TERMS = 20
_OVER_FACTORIAL = tuple(1.0 / math.factorial(n) for n in range(_CONTACT_TERMS + 1))
_SERIES_REACH = 1.0


def horner(coefficients: tuple[Any, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Evaluate the polynomial with the given ascending coefficients at x."""
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total = total * x + coefficient
    return total


@jax.custom_jvp
def phasor(s: Values) -> tuple[Values, Values]:
    """Compute sin and cos of pi s, each relative near s = 0.

    By one polynomial and a root: with two polynomials it is half again as much to compile, and the library's functions
    are no vector loops. Derivatives are those of sin and cos, not of how they are computed.

    Args:
        s: Half turns, any finite number; reduced by quadrants, so that sin(pi k/2) and cos(pi k/2) are exact.
    """
    return _phasor(s)


@phasor.defjvp
def _phasor_jvp(primals, tangents):
    sine, cosine = phasor(*primals)
    turn = PI * tangents[0]
    return (sine, cosine), (turn * cosine, -turn * sine)


@once
def _phasor(s: Values) -> tuple[Values, Values]:
    quadrant = nearest(2 * s)
    x = PI * (s - 0.5 * quadrant)
    square = x * x
    sine = x - x * square * horner(_LAG, square)
    cosine = jnp.sqrt(1 - sine * sine)
    quadrant = quadrant - 4 * jnp.floor(0.25 * quadrant)
    odd, back = (quadrant == 1) | (quadrant == 3), quadrant >= 2
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, -sine, cosine)
    return jnp.where(back, -sine, sine), jnp.where(back, -cosine, cosine)


@once
def half_turn(s: Values) -> tuple[Values, Values, Values, Values]:
    """Compute sin, cos, versine and lag of pi s: (sin, cos, 1 - cos, pi s - sin), each relative near s = 0."""
    sine, cosine = phasor(s)
    small, x = jnp.abs(s) < 0.25, PI * s
    versine = sine * sine / (1 + jnp.where(small, cosine, 0.0))
    near = jnp.where(small, x, 0.0)
    lag = near * near * near * horner(_LAG, near * near)
    return sine, cosine, jnp.where(small, versine, 1 - cosine), jnp.where(small, lag, x - sine)


def wrap_phase(t: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Wrap a phase into [0, 2); give it and the whole periods taken off."""
    periods = jnp.floor(0.5 * t)
    return t - 2 * periods, periods


@once
@shared
def flight(force: Force, v0: Values, s: Values) -> tuple[Values, Values]:
    """Compute displacement from the start and velocity after a flight of length s under `flight_force` at velocity v0.

    u - u0 = v0 s - g s^2/2 + (c (1 - cos pi s) - q (pi s - sin pi s))/pi^2
    Source: Eqs. (6)-(7) scaled, derived again (physics.md).
    """
    sin_s, _, versine, lag = half_turn(s)
    rise = (v0 - 0.5 * force.g * s) * s + (force.c * versine - force.q * lag) / PI**2
    return rise, v0 - force.g * s + (force.c * sin_s - force.q * versine) / PI


def acceleration(gamma: Values, t: Values) -> Values:
    """Compute the acceleration in flight, cos(pi t) - gamma."""
    return phasor(t)[1] - gamma


def _contact_series(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') by Taylor series in s; accurate for max(kappa, pi) s < 1, where the closed form cancels.

    Sums b_n s/n! and b_n/(n - 1)! of b_n = s^(n - 1) d^n w/ds^n from n = 1, which obey b_(n + 2) = e_n - mu s b_(n + 1)
    - (kappa s)^2 b_n, where e_n = s^(n + 1) d^n f/ds^n comes back times -(pi s)^2 after two steps. With the factorials
    in the sums alone a term is a handful of operations, of which every program of a contact holds many copies.
    """
    s = share(s)
    loss, stiffness, turn = share((m.mu * s, (m.kappa * s) ** 2, -((PI * s) ** 2)))

    def add(n, carry):
        w, z, b, after, drive, next_drive = carry
        # A loop counts in whole numbers, in which its factorials are looked up.
        over = _OVER_FACTORIAL if isinstance(n, int) else jnp.asarray(_OVER_FACTORIAL, s.dtype)
        w, z = w + over[n] * b, z + over[n - 1] * b
        return w, z, after, next_drive - loss * after - stiffness * b, next_drive, turn * drive

    # The first two terms feel gravity and the first displacement, which are no part of what recurs. Where gravity all
    # but balances the forcing their difference is what counts: it must be made before anything is rounded.
    first, drive, next_drive = z0, s * force.c, -(PI * s) * (s * force.q)
    second = s * (force.c - force.g - m.mu * z0 - m.kappa * m.kappa * w0)
    start = (jnp.zeros_like(second), jnp.zeros_like(second), first + jnp.zeros_like(second), second, drive, next_drive)
    if m.rolled:
        w, z, *_ = lax.fori_loop(1, _CONTACT_TERMS + 1, add, start)
    else:
        for n in range(1, _CONTACT_TERMS + 1):
            start = add(n, start)
        w, z, *_ = start
    return w0 + s * w, z


@once
def free_response(m: Membrane, s: Values) -> tuple[Values, Values]:
    """Compute the membrane's impulse response h and h': h'' + mu h' + kappa^2 h = 0, h(0) = 0, h'(0) = 1.

    sin(omega1 s)/omega1 is the sinc form: it tends to s as omega1 -> 0 (r -> 0).
    """
    decay = jnp.exp(-m.zeta * s)
    sine = jnp.sin(m.omega1 * s) / m.omega1
    return decay * sine, decay * (jnp.cos(m.omega1 * s) - m.zeta * sine)


def _driven_response(m: Membrane, h: Values, s: Values) -> tuple[Values, Values]:
    """Compute responses from rest to cos(pi s), sin(pi s): divided difference of exp at -zeta +- i omega1 and i pi.

    Near kappa = pi, mu = 0 two of the three points meet: the secular form s e^m sinh(z)/z stays accurate there.
    """
    gap_re, gap_im = m.zeta, PI - m.omega1
    re, im = 0.5 * s * gap_re, 0.5 * s * gap_im  # z
    near = jnp.abs(re) + jnp.abs(im) < 0.5
    re, im = jnp.where(near, re, 0.0), jnp.where(near, im, 0.0)
    # sinh(z)/z by real arithmetic: complex division and powers compile to ten times the code.
    square_re, square_im = re * re - im * im, 2 * re * im
    sinhc_re, sinhc_im = jnp.full_like(s, _SINHC[-1]), jnp.zeros_like(s)
    for coefficient in _SINHC[-2::-1]:
        sinhc_re, sinhc_im = (
            sinhc_re * square_re - sinhc_im * square_im + coefficient,
            sinhc_re * square_im + sinhc_im * square_re,
        )
    middle = 0.5 * (PI + m.omega1) * s
    scale = s * jnp.exp(-0.5 * m.zeta * s)
    mean_re, mean_im = scale * jnp.cos(middle), scale * jnp.sin(middle)
    secular_re = mean_re * sinhc_re - mean_im * sinhc_im
    secular_im = mean_re * sinhc_im + mean_im * sinhc_re
    sin_s, cos_s = phasor(s)
    decay = jnp.exp(-m.zeta * s)
    apart_re, apart_im = cos_s - decay * jnp.cos(m.omega1 * s), sin_s - decay * jnp.sin(m.omega1 * s)
    inverse = 1 / jnp.where(near, 1.0, gap_re * gap_re + gap_im * gap_im)
    first_re = jnp.where(near, secular_re, (apart_re * gap_re + apart_im * gap_im) * inverse) - h
    first_im = jnp.where(near, secular_im, (apart_im * gap_re - apart_re * gap_im) * inverse)
    far_im = PI + m.omega1
    inverse = 1 / (m.zeta * m.zeta + far_im * far_im)
    return (first_re * m.zeta + first_im * far_im) * inverse, (first_im * m.zeta - first_re * far_im) * inverse


def _contact_closed(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') by the closed form: free response plus Duhamel's integral of the forcing."""
    h, slope = share(free_response(m, s))
    from_cos, from_sin = share(_driven_response(m, h, s))
    stay = slope + m.mu * h  # response to a unit displacement
    square = m.kappa * m.kappa
    w = w0 * stay + z0 * h + force.c * from_cos - force.q * from_sin - force.g * (1 - stay) / square
    z = (z0 * slope - square * w0 * h) + force.c * (h - PI * from_sin) - force.q * PI * from_cos - force.g * h
    return w, z


@once
@shared
def oscillate(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') at time s of w'' + mu w' + kappa^2 w = force from (w0, z0) at s = 0.

    Source: Eqs. (20)-(21) with the constants derived again (physics.md); each regime against mpmath in test_flow.py.
    """
    short = jnp.maximum(m.kappa, PI) * s < _SERIES_REACH
    near = _contact_series(m, force, w0, z0, jnp.where(short, s, 0.0))
    far = _contact_closed(m, force, w0, z0, jnp.where(short, 1.0, s))
    return jnp.where(short, near[0], far[0]), jnp.where(short, near[1], far[1])


def flight_force(gamma: Values, t: Values) -> Force:
    """Make the forcing cos(pi t) - gamma with its clock started at phase t."""
    sin_t, cos_t = phasor(t)
    return Force(cos_t, sin_t, gamma)


def contact_force(gamma: Values, side: Values, t: Values) -> Force:
    """Make the forcing of the penetration w = side u - d/2 in a contact that begins at phase t."""
    sin_t, cos_t = phasor(t)
    return Force(side * cos_t, side * sin_t, side * gamma)


def steady_response(m: Membrane, force: Force) -> Force:
    """Find the membrane's steady response to `force`, in the same form; infinite at the undamped resonance.

    The forcing is the real part of (c + i q) e^(i pi s): divide by kappa^2 - pi^2 + i mu pi.
    """
    stiffness, loss = (m.kappa - PI) * (m.kappa + PI), m.mu * PI
    square = stiffness * stiffness + loss * loss
    return Force(
        (stiffness * force.c + loss * force.q) / square,
        (stiffness * force.q - loss * force.c) / square,
        force.g / (m.kappa * m.kappa),
    )


def flight_matrix(s: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the tangent map of a flight of length s in (du, du')."""
    one, zero = jnp.ones_like(s), jnp.zeros_like(s)
    return jnp.array([[one, s], [zero, one]])


def contact_matrix(m: Membrane, s: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the tangent map of a whole contact in (du, du'), from flight to flight; its determinant is exp(-mu s).

    The saltations at onset [[1, 0], [-mu, 1]] and exit [[1, 0], [mu, 1]] (physics.md) around the fundamental matrix
    [[h' + mu h, h], [-kappa^2 h, h']] collapse to the form below: regular at grazing.
    """
    h, slope = free_response(m, s)
    return jnp.array([[slope, h], [-m.kappa * m.kappa * h, slope + m.mu * h]])


def rigid_matrix(r: Values, a: Values, v_in: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the saltation matrix of a rigid impact in (du, du'): det = r^2, and it grows as 1/v_in at grazing."""
    return jnp.array([[-r, jnp.zeros_like(r)], [(1 + r) * a / v_in, -r]])
