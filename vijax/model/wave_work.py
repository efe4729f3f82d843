"""The energy that a contact under several harmonics gives to a linear membrane."""

import math

import jax.numpy as jnp
from jax import lax

from vijax.model.energy import SHORT_REACH, short_contact_work
from vijax.model.flow import PI, Membrane, half_turn, phasor
from vijax.model.waves import Wave, Waves, later, pushing
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
    z_in, z_out = z
    first = tuple(wave.times(side) for wave in waves)
    last = later(first, duration)
    push_in, push_out = (pushing(part, side * gamma) for part in (first, last))
    bends = push_in - m.mu * z_in, push_out - m.mu * z_out
    given = 0.5 * (z_in - z_out) * (z_in + z_out)
    for wave in first:
        given = given + _received(m, wave, first, duration, z, bends)
    fastest = PI * max((wave.order for wave in waves), default=1)
    short = jnp.maximum(m.kappa, fastest) * duration < SHORT_REACH
    jets = _jet(first, push_in), _jet(last, push_out)
    work = jnp.where(short, short_contact_work(m.kappa, m.mu, jets, z, jnp.where(short, duration, 0.0)), given)
    # Exactly zero without damping, with the derivative in mu kept.
    return jnp.where(m.mu > 0, work, work - lax.stop_gradient(work))


def _jet(waves: Waves, push: Values) -> list[Values]:
    """List the forcing and its first two derivatives."""
    rate = sum((-(wave.order * PI) * wave.q for wave in waves), start=jnp.zeros_like(push))
    bend = sum((-((wave.order * PI) ** 2) * wave.c for wave in waves), start=jnp.zeros_like(push))
    return [push, rate, bend]


def _received(
    m: Membrane,
    wave: Wave,
    waves: Waves,
    duration: Values,
    z: tuple[Values, Values],
    bends: tuple[Values, Values],
) -> Values:
    """Integrate one harmonic's push times the velocity; `bends` is the acceleration at onset and at exit."""
    n = wave.order * PI
    sine, cosine = phasor(wave.order * duration)
    (z_in, z_out), (bend_in, bend_out) = z, bends
    cos_f, sin_f = _against_slopes(wave.order, waves, duration)
    cos_side = cos_f - (cosine * bend_out - bend_in + n * sine * z_out + m.mu * (cosine * z_out - z_in))
    sin_side = sin_f - (sine * bend_out - n * (cosine * z_out - z_in) + m.mu * sine * z_out)
    stiffness, loss = (m.kappa - n) * (m.kappa + n), m.mu * n
    square = stiffness * stiffness + loss * loss
    # At the undamped resonance (square = 0) the answer is zero by mu.
    square = jnp.where(square > 0, square, 1.0)
    by_cos, by_sin = stiffness * cos_side - loss * sin_side, stiffness * sin_side + loss * cos_side
    return (wave.c * by_cos - wave.q * by_sin) / square


def _against_slopes(order: int, waves: Waves, duration: Values) -> tuple[Values, Values]:
    """Integrate cos(n s) and sin(n s), n = order pi, times the derivative of what harmonics push with."""
    cos_f, sin_f = jnp.zeros_like(duration), jnp.zeros_like(duration)
    for wave in waves:
        # Integrals of the cosine and the sine of the sum and of the difference of both paces.
        (even, rest), (even_gap, rest_gap) = (_integrals(wave.order + sign * order, duration) for sign in (1, -1))
        pace = wave.order * PI
        cos_f = cos_f - 0.5 * pace * (wave.c * (rest + rest_gap) + wave.q * (even_gap + even))
        sin_f = sin_f - 0.5 * pace * (wave.c * (even_gap - even) + wave.q * (rest - rest_gap))
    return cos_f, sin_f


def _integrals(order: int, s: Values) -> tuple[Values, Values]:
    """Integrate cos(n x) and sin(n x), n = order pi, from 0 to s."""
    if order == 0:
        return s, jnp.zeros_like(s)
    sine, _, versine, _ = half_turn(abs(order) * s)
    return sine / (abs(order) * PI), math.copysign(1.0, order) * versine / (abs(order) * PI)
