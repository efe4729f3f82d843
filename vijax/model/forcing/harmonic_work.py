"""Energy W that a contact under several harmonics gives to a linear membrane: `energy.membrane_work` for harmonics."""

import jax
import jax.numpy as jnp
from jax import lax

from vijax.model.energy import SHORT_REACH, short_contact_work
from vijax.model.flow import PI, Membrane, phasor, sin_cos_versine_lag
from vijax.model.forcing.waves import Waves, stack_waves
from vijax.runtime.arrays import Values


def harmonic_contact_work(
    m: Membrane, waves: Waves, gamma: Values, side: Values, duration: Values, z: tuple[Values, Values]
) -> Values:
    """Compute the energy per unit mass that a whole contact gives to the membrane, in squared units of u'.

    W = (z_in^2 - z_out^2)/2 + int f z ds, where z = w' and f is the forcing of the penetration. For every harmonic the
    last integral needs C = int cos(n s) z ds and S = int sin(n s) z ds, n = k pi. z obeys the equation of motion with
    forcing f'; that equation times cos or sin, integrated by parts, gives

        (kappa^2 - n^2) C + mu n S = int cos f' ds - [cos z' + n sin z + mu cos z],
        (kappa^2 - n^2) S - mu n C = int sin f' ds - [sin z' - n cos z + mu sin z].

    With one harmonic the result equals `energy.membrane_work`, with the same accuracy: the relative error is eps
    kappa/mu, and eps (kappa/mu)^2 where kappa is near the n of a harmonic. The largest relative error in 4,101 random
    contacts is 2.2e-12 (benchmarks/contact_work.py). Short contacts use `energy.short_contact_work`.

    Args:
        m: The membrane.
        waves: The harmonics with their clocks started at the onset.
        gamma: Gravity of the pair.
        side: +1 right, -1 left.
        duration: Time from onset to exit.
        z: Rate of the penetration at onset and at exit, where the penetration is 0.
    """
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves((waves, side, duration))))
    # The forcing of the penetration w = side u - d/2 carries the factor side.
    orders, c, q = stack_waves([wave.scaled_by(side) for wave in waves], shape)
    n = PI * orders
    sine, cosine = phasor(orders * duration)
    # Parts of the harmonics with their clocks started at the exit, and the forcing with two derivatives at both ends.
    turned = c * cosine - q * sine, q * cosine + c * sine
    ends = _jet(n, (c, q), side * gamma), _jet(n, turned, side * gamma)
    z_in, z_out = z
    # z' = w'' at onset and exit; w = 0 there.
    z_slopes = ends[0][0] - m.mu * z_in, ends[1][0] - m.mu * z_out
    cos_f, sin_f = _against_slopes(orders, (c, q), duration)
    # Right-hand sides of the two equations for C and S of each harmonic.
    cos_side = cos_f - (cosine * z_slopes[1] - z_slopes[0] + n * sine * z_out + m.mu * (cosine * z_out - z_in))
    sin_side = sin_f - (sine * z_slopes[1] - n * (cosine * z_out - z_in) + m.mu * sine * z_out)
    stiffness, loss = (m.kappa - n) * (m.kappa + n), m.mu * n
    square = stiffness * stiffness + loss * loss
    # At the undamped resonance square = 0; any finite quotient is allowed, because mu = 0 makes the final result zero.
    square = jnp.where(square > 0, square, 1.0)
    by_cos, by_sin = stiffness * cos_side - loss * sin_side, stiffness * sin_side + loss * cos_side
    received = ((c * by_cos - q * by_sin) / square).sum(axis=0)
    # The polynomial of a short contact must resolve the highest harmonic as well as kappa.
    short = jnp.maximum(m.kappa, PI * max(wave.order for wave in waves)) * duration < SHORT_REACH
    long_work = 0.5 * (z_in - z_out) * (z_in + z_out) + received
    work = jnp.where(short, short_contact_work(m.kappa, m.mu, ends, z, jnp.where(short, duration, 0.0)), long_work)
    # Exactly zero without damping, while the derivative with respect to mu is kept.
    return jnp.where(m.mu > 0, work, work - lax.stop_gradient(work))


def _jet(n: Values, wave: tuple[Values, Values], gravity: Values) -> list[Values]:
    """Compute the forcing and its first two derivatives from cosine and sine parts [order, ...] of harmonics."""
    c, q = wave
    return [c.sum(axis=0) - gravity, -(n * q).sum(axis=0), -(n * n * c).sum(axis=0)]


def _against_slopes(orders: Values, wave: tuple[Values, Values], s: Values) -> tuple[Values, Values]:
    """Compute the integrals of cos(n x) f' and sin(n x) f' from 0 to s, n = order pi, for every order.

    A product of two harmonics is a sum of harmonics of the sum and the difference of their orders. Axes of the
    intermediate arrays: [order of the integral, order of the forcing, ...].
    """
    c, q = wave
    sums, differences = _integrals(orders[None] + orders[:, None], s), _integrals(orders[None] - orders[:, None], s)
    # f' = -n (c sin(n x) + q cos(n x)); the factor 1/2 comes from the product formulas.
    half_n = 0.5 * PI * orders
    by_cos = (half_n * (c * (sums[1] + differences[1]) + q * (differences[0] + sums[0]))).sum(axis=1)
    by_sin = (half_n * (c * (differences[0] - sums[0]) + q * (sums[1] - differences[1]))).sum(axis=1)
    return -by_cos, -by_sin


def _integrals(orders: Values, s: Values) -> tuple[Values, Values]:
    """Compute the integrals of cos(n x) and sin(n x), n = order pi, from 0 to s; s and 0 for order 0."""
    size = jnp.abs(orders)
    sine, _, versine, _ = sin_cos_versine_lag(size * s)
    # 1 replaces order 0, so that the unused quotient stays finite.
    n = PI * jnp.where(size > 0, size, 1.0)
    return jnp.where(size > 0, sine / n, s), jnp.sign(orders) * versine / n
