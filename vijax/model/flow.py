"""Closed-form flow of the ball at elapsed time s: in flight, and in contact with a membrane.

    flight:   u'' = c cos(pi s) - q sin(pi s) - g                       Eqs. (6)-(7)
    contact:  w'' + mu w' + kappa^2 w = c cos(pi s) - q sin(pi s) - g   Eqs. (20)-(21), derived again in physics.md

c and q are cosine and sine parts of the forcing at the start, g is gravity, w the penetration, z = w' its rate. A
`Force` holds (c, q, g), a `Membrane` holds (kappa, zeta = mu/2, omega1 = sqrt(kappa^2 - zeta^2)).

Differences are written without cancellation (1 - cos x and x - sin x by series), because low-speed impacts depend on
exactly the digits that the direct forms lose.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair
from vijax.model.walls.restitution import calibrate_damping
from vijax.runtime.arrays import Values, round_half_up
from vijax.runtime.compilation.xla import materialise, materialised, reuse_trace

PI = math.pi


def _alternating(start: int, terms: int) -> tuple[float, ...]:
    """Compute Taylor coefficients (-1)^k / (start + 2k)! in ascending powers of x^2."""
    return tuple((-1.0) ** k / math.factorial(start + 2 * k) for k in range(terms))


class Membrane(eqx.Module):
    """Parameters of the closed form of a contact: natural frequency, decay rate, damped frequency (all > 0).

    If `rolled` is True, the Taylor series of a contact is compiled as a loop, not as unrolled terms. A differentiated
    program then compiles in seconds instead of minutes. A program that is not differentiated also compiles faster, but
    runs three times slower.
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
        """Return the same forcing with its clock started a time s later."""
        sin_s, cos_s = phasor(s)
        # Addition theorems for cos(pi (s + x)) and sin(pi (s + x)).
        return Force(self.c * cos_s - self.q * sin_s, self.q * cos_s + self.c * sin_s, self.g)

    def slope(self) -> "Force":
        """Differentiate the forcing with respect to time."""
        return Force(-PI * self.q, PI * self.c, jnp.zeros_like(self.g))


@materialised
def membrane(pair: ImpactPair, *, rolled: bool = False) -> Membrane:
    """Return the soft wall of a pair with equal walls, with the damping calibrated by `restitution`."""
    kappa = pair._soft_kappa()
    zeta, omega1 = calibrate_damping(kappa, pair.r)
    # `materialised` computes omega1 once. Otherwise XLA would recompute omega1 in every loop, and the lanes of a loop
    # may round PI - omega1 differently.
    return Membrane(kappa, zeta, omega1, rolled)


# (x - sin x)/x^3 in powers of x^2: on |x| <= pi/4 the first neglected term is below 1e-17 of the sum.
_LAG = _alternating(3, 8)
# sinh(z)/z on |z| < 1/2 in powers of z^2.
_SINHC = tuple(1.0 / math.factorial(2 * k + 1) for k in range(8))
# Number of Taylor terms for a relative error of 1e-17 in a contact with max(kappa, pi) s < _SERIES_REACH.
_CONTACT_TERMS = 20
_OVER_FACTORIAL = tuple(1.0 / math.factorial(n) for n in range(_CONTACT_TERMS + 1))
_SERIES_REACH = 1.0


def horner(coefficients: tuple[Any, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Evaluate the polynomial with ascending `coefficients` (at least two) at x."""
    value = x * coefficients[-1] + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        value = value * x + coefficient
    return value


@jax.custom_jvp
def phasor(s: Values) -> tuple[Values, Values]:
    """Compute sin and cos of pi s, each with relative accuracy near s = 0.

    The cosine is computed from the sine by a square root, because a second polynomial would increase the compilation
    time by half, and calls of the mathematical library are not vectorised. The derivatives are the exact cos and -sin,
    not derivatives of the polynomial.

    Args:
        s: Half turns, any finite number; reduced by quadrants, so that sin(pi k/2) and cos(pi k/2) are exact.
    """
    return _phasor(s)


@phasor.defjvp
def _phasor_jvp(primals, tangents):
    sine, cosine = phasor(*primals)
    turn = PI * tangents[0]
    return (sine, cosine), (turn * cosine, -turn * sine)


@reuse_trace
def _phasor(s: Values) -> tuple[Values, Values]:
    # |x| <= pi/4, and the reduction is exact, because s - 0.5 quadrant is a difference of nearby floating-point
    # numbers.
    quadrant = round_half_up(2 * s)
    x = PI * (s - 0.5 * quadrant)
    square = x * x
    sine = x - x * square * horner(_LAG, square)
    # The difference does not cancel, because sine^2 <= 1/2 on the reduced range. There the cosine is positive.
    cosine = jnp.sqrt(1 - sine * sine)
    quadrant = quadrant - 4 * jnp.floor(0.25 * quadrant)
    # Quadrants 1 and 3 swap sine and cosine; quadrants 2 and 3 add half a turn.
    odd, back = (quadrant == 1) | (quadrant == 3), quadrant >= 2
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, -sine, cosine)
    return jnp.where(back, -sine, sine), jnp.where(back, -cosine, cosine)


@reuse_trace
def sin_cos_versine_lag(s: Values) -> tuple[Values, Values, Values, Values]:
    """Compute (sin, cos, 1 - cos, x - sin) of x = pi s, each with relative accuracy near s = 0."""
    sine, cosine = phasor(s)
    small, x = jnp.abs(s) < 0.25, PI * s
    # 1 - cos = sin^2/(1 + cos) for small s; the guard avoids the division by zero at s = 1.
    versine = sine * sine / (1 + jnp.where(small, cosine, 0.0))
    near = jnp.where(small, x, 0.0)
    lag = near * near * near * horner(_LAG, near * near)
    return sine, cosine, jnp.where(small, versine, 1 - cosine), jnp.where(small, lag, x - sine)


def wrap_phase(t: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Wrap a phase into [0, 2); return it and the number of periods subtracted."""
    periods = jnp.floor(0.5 * t)
    # The forcing period is 2 in units of a half period pi/omega.
    return t - 2 * periods, periods


@reuse_trace
@materialised
def flight(force: Force, v0: Values, s: Values) -> tuple[Values, Values]:
    """Compute displacement and velocity after a flight of duration s under `force` at initial velocity v0.

    u - u0 = v0 s - g s^2/2 + (c (1 - cos pi s) - q (pi s - sin pi s))/pi^2

    Source: Eqs. (6)-(7) scaled, derived again (physics.md).
    """
    # versine = 1 - cos(pi s) and lag = pi s - sin(pi s) keep their digits in short flights.
    sin_s, _, versine, lag = sin_cos_versine_lag(s)
    rise = (v0 - 0.5 * force.g * s) * s + (force.c * versine - force.q * lag) / PI**2
    return rise, v0 - force.g * s + (force.c * sin_s - force.q * versine) / PI


def acceleration(gamma: Values, t: Values) -> Values:
    """Compute the acceleration in flight, cos(pi t) - gamma."""
    return phasor(t)[1] - gamma


def _contact_series(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') by Taylor series in s; accurate for max(kappa, pi) s < 1, where the closed form cancels.

    Sums b_n s/n! and b_n/(n - 1)! of b_n = s^(n - 1) d^n w/ds^n from n = 1, with the recurrence b_(n + 2) = e_n - mu s
    b_(n + 1) - (kappa s)^2 b_n. Here e_n = s^(n + 1) d^n f/ds^n obeys e_(n + 2) = -(pi s)^2 e_n. Only the sums contain
    factorials, so that a term needs only a few operations; compiled programs contain many copies of a term.
    """
    s = materialise(s)
    # mu s, (kappa s)^2 and -(pi s)^2, the coefficients of the recurrences.
    loss, stiffness, turn = materialise((m.mu * s, (m.kappa * s) ** 2, -((PI * s) ** 2)))

    def add(n, carry):
        w, z, b, b_next, drive, next_drive = carry
        # In a rolled loop n is a traced integer, which indexes an array of reciprocal factorials.
        over = _OVER_FACTORIAL if isinstance(n, int) else jnp.asarray(_OVER_FACTORIAL, s.dtype)
        # State at term n: the two sums, b_n, b_(n + 1), e_(n - 1) and e_n.
        w, z = w + over[n] * b, z + over[n - 1] * b
        return w, z, b_next, next_drive - loss * b_next - stiffness * b, next_drive, turn * drive

    # Gravity and w0 enter b_2 only, not the recurrence. force.c - force.g is computed first: where gravity nearly
    # balances the forcing, this difference determines the motion, and must not contain a rounding error.
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


@reuse_trace
def free_response(m: Membrane, s: Values) -> tuple[Values, Values]:
    """Compute the impulse response h of the membrane and h': h'' + mu h' + kappa^2 h = 0, h(0) = 0, h'(0) = 1.

    h = exp(-zeta s) sin(omega1 s)/omega1, which tends to s exp(-zeta s) as omega1 -> 0 (r -> 0).
    """
    decay = jnp.exp(-m.zeta * s)
    # omega1 > 0 for every r > 0, so the quotient is finite.
    sine = jnp.sin(m.omega1 * s) / m.omega1
    return decay * sine, decay * (jnp.cos(m.omega1 * s) - m.zeta * sine)


def _driven_response(m: Membrane, h: Values, s: Values) -> tuple[Values, Values]:
    """Compute the responses from rest to cos(pi s) and sin(pi s).

    They are divided differences of exp at the three points -zeta +- i omega1 and i pi.

    Near kappa = pi, mu = 0 two of the three points coincide. There the form s e^m sinh(z)/z, with mean m and half
    difference z of the two exponents, remains accurate (secular growth).
    """
    # Difference of the exponents i pi and -zeta + i omega1; z is half of it times s.
    difference_re, difference_im = m.zeta, PI - m.omega1
    re, im = 0.5 * s * difference_re, 0.5 * s * difference_im  # z
    near = jnp.abs(re) + jnp.abs(im) < 0.5
    # z = 0 where the secular form is not used, so that its polynomial cannot overflow.
    re, im = jnp.where(near, re, 0.0), jnp.where(near, im, 0.0)
    # sinh(z)/z is computed in real arithmetic, because complex division and powers compile to ten times the code.
    square_re, square_im = re * re - im * im, 2 * re * im
    sinhc_re, sinhc_im = jnp.full_like(s, _SINHC[-1]), jnp.zeros_like(s)
    for coefficient in _SINHC[-2::-1]:
        sinhc_re, sinhc_im = (
            sinhc_re * square_re - sinhc_im * square_im + coefficient,
            sinhc_re * square_im + sinhc_im * square_re,
        )
    # exp of the mean exponent times s: the factor of sinh(z)/z in the secular form.
    middle = 0.5 * (PI + m.omega1) * s
    scale = s * jnp.exp(-0.5 * m.zeta * s)
    mean_re, mean_im = scale * jnp.cos(middle), scale * jnp.sin(middle)
    secular_re = mean_re * sinhc_re - mean_im * sinhc_im
    secular_im = mean_re * sinhc_im + mean_im * sinhc_re
    sin_s, cos_s = phasor(s)
    decay = jnp.exp(-m.zeta * s)
    # Away from the double point: numerator of the divided difference, exp(i pi s) - exp((-zeta + i omega1) s).
    numerator_re, numerator_im = cos_s - decay * jnp.cos(m.omega1 * s), sin_s - decay * jnp.sin(m.omega1 * s)
    # Division by the complex difference: multiplication by its conjugate over its squared modulus.
    inverse = 1 / jnp.where(near, 1.0, difference_re * difference_re + difference_im * difference_im)
    # Second divided difference: subtract the divided difference h of the conjugate pair, and divide by i pi + zeta + i
    # omega1.
    first_re = jnp.where(near, secular_re, (numerator_re * difference_re + numerator_im * difference_im) * inverse) - h
    first_im = jnp.where(near, secular_im, (numerator_im * difference_re - numerator_re * difference_im) * inverse)
    far_im = PI + m.omega1
    inverse = 1 / (m.zeta * m.zeta + far_im * far_im)
    return (first_re * m.zeta + first_im * far_im) * inverse, (first_im * m.zeta - first_re * far_im) * inverse


def _contact_closed(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') by the closed form: free response plus Duhamel's integral of the forcing."""
    # `materialise` keeps XLA from recomputing these values for w and for z.
    h, slope = materialise(free_response(m, s))
    from_cos, from_sin = materialise(_driven_response(m, h, s))
    unit_response = slope + m.mu * h  # response to a unit displacement
    square = m.kappa * m.kappa
    # (1 - unit_response)/kappa^2 is the response from rest to a unit step.
    w = w0 * unit_response + z0 * h + force.c * from_cos - force.q * from_sin - force.g * (1 - unit_response) / square
    z = (z0 * slope - square * w0 * h) + force.c * (h - PI * from_sin) - force.q * PI * from_cos - force.g * h
    return w, z


@reuse_trace
@materialised
def oscillate(m: Membrane, force: Force, w0: Values, z0: Values, s: Values) -> tuple[Values, Values]:
    """Compute (w, w') at time s for w'' + mu w' + kappa^2 w = force, from (w0, z0) at s = 0.

    Source: Eqs. (20)-(21) with the constants derived again (physics.md); test_flow.py compares each regime with mpmath.
    """
    short = jnp.maximum(m.kappa, PI) * s < _SERIES_REACH
    # Each branch gets a harmless time in the lanes of the other, so that no lane overflows and gradients stay finite.
    near = _contact_series(m, force, w0, z0, jnp.where(short, s, 0.0))
    far = _contact_closed(m, force, w0, z0, jnp.where(short, 1.0, s))
    return jnp.where(short, near[0], far[0]), jnp.where(short, near[1], far[1])


def flight_force(gamma: Values, t: Values) -> Force:
    """Return the forcing cos(pi t) - gamma as a function of the time elapsed since phase t."""
    sin_t, cos_t = phasor(t)
    return Force(cos_t, sin_t, gamma)


def contact_force(gamma: Values, side: Values, t: Values) -> Force:
    """Return the forcing of the penetration w = side u - d/2 in a contact with onset at phase t."""
    sin_t, cos_t = phasor(t)
    return Force(side * cos_t, side * sin_t, side * gamma)


def steady_response(m: Membrane, force: Force) -> Force:
    """Compute the steady response of the membrane to `force`, as a `Force`; infinite at the undamped resonance.

    The forcing is the real part of (c + i q) e^(i pi s): divide by kappa^2 - pi^2 + i mu pi.
    """
    # (kappa - pi)(kappa + pi) keeps the digits of kappa^2 - pi^2 near the resonance.
    stiffness, loss = (m.kappa - PI) * (m.kappa + PI), m.mu * PI
    square = stiffness * stiffness + loss * loss
    return Force(
        (stiffness * force.c + loss * force.q) / square,
        (stiffness * force.q - loss * force.c) / square,
        force.g / (m.kappa * m.kappa),
    )


def flight_matrix(s: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the tangent map of a flight of duration s in (du, du')."""
    unit, zero = jnp.ones_like(s), jnp.zeros_like(s)
    return jnp.array([[unit, s], [zero, unit]])


def contact_matrix(m: Membrane, s: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the tangent map of a whole contact in (du, du'), from flight to flight; its determinant is exp(-mu s).

    It is the product of the saltation at onset [[1, 0], [-mu, 1]], the fundamental matrix [[h' + mu h, h], [-kappa^2 h,
    h']] and the saltation at exit [[1, 0], [mu, 1]] (physics.md), simplified. It is regular at grazing.
    """
    h, slope = free_response(m, s)
    # h and h' are the impulse response and its derivative at the exit; the damping terms of the saltations cancel.
    return jnp.array([[slope, h], [-m.kappa * m.kappa * h, slope + m.mu * h]])


def rigid_matrix(r: Values, a: Values, v_in: Values) -> Float[Array, "2 2 *lane"]:
    """Compute the saltation matrix of a rigid impact in (du, du'); its determinant is r^2.

    At a grazing, the element (1 + r) a / v_in is infinite.
    """
    return jnp.array([[-r, jnp.zeros_like(r)], [(1 + r) * a / v_in, -r]])
