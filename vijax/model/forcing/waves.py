"""Harmonics of the forcing, and the closed-form motion under them in flight and in contact.

A harmonic of order k is the first harmonic on a clock that runs k times as fast. On that clock a membrane has kappa/k,
and the forcing is divided by k^2. The closed forms of `flow` thus apply to every order, and the motion is the sum over
the orders, because the equations are linear.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from vijax.model.flow import PI, Force, Membrane, flight, oscillate, phasor, steady_response
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Values


class Wave(eqx.Module):
    """A harmonic of the forcing: c cos(k pi s) - q sin(k pi s) at time s after its clock was started.

    Attributes:
        order: k, the multiple of the forcing frequency.
        c, q: Cosine and sine parts of the harmonic at s = 0.
    """

    order: int = eqx.field(static=True)
    c: Values
    q: Values

    def later(self, s: Values) -> "Wave":
        """Return the harmonic with its clock started a time s later."""
        sine, cosine = phasor(self.order * s)
        # Addition theorems for cos(k pi (s + x)) and sin(k pi (s + x)).
        return Wave(self.order, self.c * cosine - self.q * sine, self.q * cosine + self.c * sine)

    def scaled_by(self, factor: Values) -> "Wave":
        """Return the harmonic multiplied by a factor."""
        return Wave(self.order, factor * self.c, factor * self.q)

    def on_fast_clock(self) -> Force:
        """Return the harmonic on a clock that runs k times as fast, where it is the first harmonic."""
        return Force(self.c, self.q, jnp.zeros_like(self.c))


Waves = tuple[Wave, ...]


def sine(t: Values) -> Waves:
    """Return the forcing of the paper, cos(pi t), with its clock started at phase t."""
    sin_t, cos_t = phasor(t)
    return (Wave(1, cos_t, sin_t),)


def waves_later(waves: Waves, s: Values) -> Waves:
    """Return harmonics with their clocks started a time s later."""
    return tuple(wave.later(s) for wave in waves)


def waves_from(waves: Waves | None, t: Values) -> Waves:
    """Return harmonics that are specified at phase 0 with their clocks started at time t; None is the sine."""
    return sine(t) if waves is None else waves_later(waves, t)


def waves_at(pair: ImpactPair, t: Values) -> Waves:
    """Return the forcing of a pair with its clock started at time t: its harmonics, or the sine if it has none."""
    return waves_from(pair.waves, t)


def forcing_acceleration(waves: Waves, gamma: Values) -> Values:
    """Compute the acceleration by harmonics and gravity at time 0 of the harmonics."""
    return sum((wave.c for wave in waves), start=-gamma)


def flight_motion(waves: Waves, gamma: Values, v: Values, s: Values) -> tuple[Values, Values]:
    """Compute displacement and velocity of a ball after a flight of duration s from velocity v, without impacts."""
    if _is_first(waves):
        return flight(Force(waves[0].c, waves[0].q, gamma), v, s)
    # The forcing is not scaled, so that the fast clock gives k^2 times the displacement and k times the velocity.
    k, (c, q, g, start) = _on_fast_clocks(waves, gamma, v, s)
    rise, speed = flight(Force(c, q, g), start, k * s)
    return (rise / k**2).sum(axis=0), (speed / k).sum(axis=0)


def mean_velocity(waves: Waves, v: Values) -> Values:
    """Compute the mean velocity of a flight at gamma = 0 over a whole period, from velocity v at the start."""
    for wave in waves:
        # Mean of (c sin(k pi s) - q (1 - cos(k pi s)))/(k pi) over a period.
        v = v - wave.q / (wave.order * PI)
    return v


def steady_contact(m: Membrane, waves: Waves, side: Values, gamma: Values) -> tuple[Values, Values]:
    """Compute penetration and rate of a ball that stays in a membrane, after the transient has decayed."""
    zero = jnp.zeros_like(side)
    w, z = -side * gamma / (m.kappa * m.kappa), zero
    for wave in waves:
        k = wave.order
        # The forcing is divided by k^2 on the fast clock. The rate w' in real time is k times the rate on the fast
        # clock.
        response = steady_response(_on_fast_clock(m, k), wave.scaled_by(side / k**2).on_fast_clock())
        w, z = w + response.at(zero), z + k * response.slope().at(zero)
    return w, z


def contact_motion(
    m: Membrane, waves: Waves, side: Values, gamma: Values, z: Values, s: Values
) -> tuple[Values, Values]:
    """Compute penetration and rate at time s after the ball entered a membrane at rate z; waves start at the onset."""
    if _is_first(waves):
        return oscillate(m, Force(side * waves[0].c, side * waves[0].q, side * gamma), jnp.zeros_like(s), z, s)
    # The forcing is divided by k^2, so that the fast clock gives the penetration itself, and 1/k of its rate.
    k, (c, q, g, start) = _on_fast_clocks([wave.scaled_by(side / wave.order**2) for wave in waves], side * gamma, z, s)
    w, rate = oscillate(_on_fast_clock(m, k), Force(c, q, g), jnp.zeros_like(c), start, k * s)
    return w.sum(axis=0), (k * rate).sum(axis=0)


def _is_first(waves: Waves) -> bool:
    # The common case, the sine, needs no stacking.
    return len(waves) == 1 and waves[0].order == 1


def _on_fast_clocks(
    waves: Sequence[Wave], gravity: Values, start: Values, s: Values
) -> tuple[Values, tuple[Values, ...]]:
    """Stack harmonics, each as a first harmonic on its fast clock, so that a program contains the closed forms once.

    Returns:
        The orders, with axes that broadcast against s; the cosine and sine parts along a new first axis, gravity, and
        the initial rate. Gravity and rate belong to the first harmonic and are 0 for the others.
    """
    zero = jnp.zeros_like(s)
    # If there is no first harmonic, a first harmonic of amplitude 0 carries gravity and the initial rate.
    waves = waves if any(wave.order == 1 for wave in waves) else [Wave(1, zero, zero), *waves]
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves((waves, gravity, start, s))))
    orders, c, q = stack_waves(waves, shape)
    first = orders == 1
    return orders, (c, q, jnp.where(first, gravity, 0.0), jnp.where(first, start, 0.0))


def stack_waves(waves: Sequence[Wave], shape: tuple[int, ...]) -> tuple[Values, Values, Values]:
    """Stack harmonics of a shape along a new first axis: orders (broadcastable), cosine parts, sine parts."""
    c, q = (jnp.stack([jnp.broadcast_to(getattr(wave, part), shape) for wave in waves]) for part in ("c", "q"))
    return jnp.reshape(jnp.array([wave.order for wave in waves], c.dtype), (-1, *(1 for _ in shape))), c, q


def _on_fast_clock(m: Membrane, k: Values | int) -> Membrane:
    """Return a membrane on a clock that runs k times as fast."""
    return Membrane(m.kappa / k, m.zeta / k, m.omega1 / k, m.rolled)
