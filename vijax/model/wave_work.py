"""The energy that a contact under several harmonics gives to a linear membrane."""

import jax
import jax.numpy as jnp
from jax import lax

from vijax.model.energy import SHORT_REACH, short_contact_work
from vijax.model.flow import PI, Membrane, half_turn, phasor
from vijax.model.waves import Waves, stacked
from vijax.runtime.arrays import Values


def wave_work(
    m: Membrane, waves: Waves, gamma: Values, side: Values, duration: Values, z: tuple[Values, Values]
) -> Values:
    """Compute the energy per unit mass that a whole contact gives to the membrane, in squared units of u'.

    W = (z_in^2 - z_out^2)/2 + int f z ds, where z = w' and f is the forcing of the penetration. Of every harmonic the
    last integral takes C = int cos(n s) z ds and S = int sin(n s) z ds, n = k pi; z obeys the membrane's equation under
    f', which times cos or sin, integrated by parts, gives

        (kappa^2 - n^2) C + mu n S = int cos f' ds - [cos z' + n sin z + mu cos z],
        (kappa^2 - n^2) S - mu n C = int sin f' ds - [sin z' - n cos z + mu sin z].

    With one harmonic it is what `energy.membrane_work` computes, and as accurate: the relative error is eps kappa/mu,
    and eps (kappa/mu)^2 where kappa is near a harmonic's n; 2.2e-12 in the worst of 4,101 drawn contacts
    (benchmarks/contact_work.py). Short contacts take its other form.

    Args:
        m: The membrane.
        waves: The harmonics from the onset on.
        gamma: The pair's.
        side: +1 right, -1 left.
        duration: Time from onset to exit.
        z: Rate of the penetration at onset and at exit, where the penetration is 0.
    """
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves((waves, side, duration))))
    orders, c, q = stacked([wave.times(side) for wave in waves], shape)
    n = PI * orders
    sine, cosine = phasor(orders * duration)
    turned = c * cosine - q * sine, q * cosine + c * sine
    ends = _jet(n, (c, q), side * gamma), _jet(n, turned, side * gamma)
    z_in, z_out = z
    bends = ends[0][0] - m.mu * z_in, ends[1][0] - m.mu * z_out
    cos_f, sin_f = _against_slopes(orders, (c, q), duration)
    cos_side = cos_f - (cosine * bends[1] - bends[0] + n * sine * z_out + m.mu * (cosine * z_out - z_in))
    sin_side = sin_f - (sine * bends[1] - n * (cosine * z_out - z_in) + m.mu * sine * z_out)
    stiffness, loss = (m.kappa - n) * (m.kappa + n), m.mu * n
    square = stiffness * stiffness + loss * loss
    # At the undamped resonance (square = 0) the result is multiplied by mu = 0.
    square = jnp.where(square > 0, square, 1.0)
    by_cos, by_sin = stiffness * cos_side - loss * sin_side, stiffness * sin_side + loss * cos_side
    received = ((c * by_cos - q * by_sin) / square).sum(axis=0)
    short = jnp.maximum(m.kappa, PI * max(wave.order for wave in waves)) * duration < SHORT_REACH
    given = 0.5 * (z_in - z_out) * (z_in + z_out) + received
    work = jnp.where(short, short_contact_work(m.kappa, m.mu, ends, z, jnp.where(short, duration, 0.0)), given)
    # Exactly zero without damping, with the derivative in mu kept.
    return jnp.where(m.mu > 0, work, work - lax.stop_gradient(work))


def _jet(n: Values, wave: tuple[Values, Values], gravity: Values) -> list[Values]:
    """Compute the forcing and its first two derivatives from the cosine and sine parts [order, ...] of harmonics."""
    c, q = wave
    return [c.sum(axis=0) - gravity, -(n * q).sum(axis=0), -(n * n * c).sum(axis=0)]


def _against_slopes(orders: Values, wave: tuple[Values, Values], s: Values) -> tuple[Values, Values]:
    """Integrate cos(n x) and sin(n x), n = order pi, times the derivative of the forcing from 0 to s, for every order.

    Products of two harmonics are harmonics of the sum and of the difference of both orders: axes [order of the
    integral, order of the forcing, ...].
    """
    c, q = wave
    more, less = _integrals(orders[None] + orders[:, None], s), _integrals(orders[None] - orders[:, None], s)
    pace = 0.5 * PI * orders
    by_cos = (pace * (c * (more[1] + less[1]) + q * (less[0] + more[0]))).sum(axis=1)
    by_sin = (pace * (c * (less[0] - more[0]) + q * (more[1] - less[1]))).sum(axis=1)
    return -by_cos, -by_sin


def _integrals(orders: Values, s: Values) -> tuple[Values, Values]:
    """Integrate cos(n x) and sin(n x), n = order pi, from 0 to s; of order 0 that is s and 0."""
    size = jnp.abs(orders)
    sine, _, versine, _ = half_turn(size * s)
    n = PI * jnp.where(size > 0, size, 1.0)
    return jnp.where(size > 0, sine / n, s), jnp.sign(orders) * versine / n
