"""The harmonics of the forcing, and what a ball does under them that meets no wall, or never leaves one."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from vijax.model.flow import PI, Force, Membrane, flight, oscillate, phasor, steady_response
from vijax.model.pair import ImpactPair
from vijax.runtime.arrays import Values


class Wave(eqx.Module):
    """A harmonic of the forcing from some moment on: c cos(k pi s) - q sin(k pi s) at elapsed time s.

    Attributes:
        order: k, which multiple of the forcing frequency it is.
        c, q: Its parts in phase and a quarter turn behind.
    """

    order: int = eqx.field(static=True)
    c: Values
    q: Values

    def later(self, s: Values) -> "Wave":
        """Start its clock a time s later."""
        sine, cosine = phasor(self.order * s)
        return Wave(self.order, self.c * cosine - self.q * sine, self.q * cosine + self.c * sine)

    def times(self, factor: Values) -> "Wave":
        """Make it so many times as large."""
        return Wave(self.order, factor * self.c, factor * self.q)

    def slowed(self) -> Force:
        """Give it on a clock that runs k times as fast, on which it is the first harmonic."""
        return Force(self.c, self.q, jnp.zeros_like(self.c))


Waves = tuple[Wave, ...]


def sine(t: Values) -> Waves:
    """Give the paper's forcing, cos(pi t), from a phase on."""
    sin_t, cos_t = phasor(t)
    return (Wave(1, cos_t, sin_t),)


def later(waves: Waves, s: Values) -> Waves:
    """Start the clock of harmonics a time s later."""
    return tuple(wave.later(s) for wave in waves)


def begun(waves: Waves | None, t: Values) -> Waves:
    """Give the forcing from a time on that has these harmonics at phase 0; None is the sine."""
    return sine(t) if waves is None else later(waves, t)


def waves_at(pair: ImpactPair, t: Values) -> Waves:
    """Give what shakes a pair from a time on: the sine, unless it is that of an orbit under harmonics."""
    return begun(pair.waves, t)


def pushing(waves: Waves, gamma: Values) -> Values:
    """Compute what harmonics and gravity push with at the moment of the waves."""
    return sum((wave.c for wave in waves), start=-gamma)


def drift(waves: Waves, gamma: Values, v: Values, s: Values) -> tuple[Values, Values]:
    """Compute how far a ball of velocity v flies in a time s that meets no wall, and its velocity then."""
    if _is_first(waves):
        return flight(Force(waves[0].c, waves[0].q, gamma), v, s)
    k, (c, q, g, start) = _on_own_clocks(waves, gamma, v, s)
    rise, speed = flight(Force(c, q, g), start, k * s)
    return (rise / k**2).sum(axis=0), (speed / k).sum(axis=0)


def mean_velocity(waves: Waves, v: Values) -> Values:
    """Compute the velocity of a flight on level ground over a whole period, from that at the moment of the waves."""
    for wave in waves:
        v = v - wave.q / (wave.order * PI)
    return v


def held_response(m: Membrane, waves: Waves, side: Values, gamma: Values) -> tuple[Values, Values]:
    """Compute penetration and rate of a ball that never leaves a membrane, once only its steady motion is left."""
    zero = jnp.zeros_like(side)
    w, z = -side * gamma / (m.kappa * m.kappa), zero
    for wave in waves:
        k = wave.order
        response = steady_response(_slowed(m, k), wave.times(side / k**2).slowed())
        w, z = w + response.at(zero), z + k * response.slope().at(zero)
    return w, z


def pressed(m: Membrane, waves: Waves, side: Values, gamma: Values, z: Values, s: Values) -> tuple[Values, Values]:
    """Compute penetration and rate of a ball that entered a membrane at rate z a time s ago; waves from the onset."""
    if _is_first(waves):
        return oscillate(m, Force(side * waves[0].c, side * waves[0].q, side * gamma), jnp.zeros_like(s), z, s)
    k, (c, q, g, start) = _on_own_clocks([wave.times(side / wave.order**2) for wave in waves], side * gamma, z, s)
    w, rate = oscillate(_slowed(m, k), Force(c, q, g), jnp.zeros_like(c), start, k * s)
    return w.sum(axis=0), (k * rate).sum(axis=0)


def _is_first(waves: Waves) -> bool:
    return len(waves) == 1 and waves[0].order == 1


def _on_own_clocks(
    waves: Sequence[Wave], gravity: Values, start: Values, s: Values
) -> tuple[Values, tuple[Values, ...]]:
    """Stack harmonics, each the first harmonic on its own clock, so that a program contains the closed forms once.

    Returns:
        The orders, with axes that broadcast against s; the cosine and sine parts along a new first axis, gravity, and
        the rate at the start. Gravity and rate belong to the first harmonic and are 0 for the others.
    """
    zero = jnp.zeros_like(s)
    waves = waves if any(wave.order == 1 for wave in waves) else [Wave(1, zero, zero), *waves]
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves((waves, gravity, start, s))))
    orders, c, q = stacked(waves, shape)
    first = orders == 1
    return orders, (c, q, jnp.where(first, gravity, 0.0), jnp.where(first, start, 0.0))


def stacked(waves: Sequence[Wave], shape: tuple[int, ...]) -> tuple[Values, Values, Values]:
    """Stack harmonics of a shape along a new first axis: their orders, which broadcast, cosine and sine parts."""
    c, q = (jnp.stack([jnp.broadcast_to(getattr(wave, part), shape) for wave in waves]) for part in ("c", "q"))
    return jnp.reshape(jnp.array([wave.order for wave in waves], c.dtype), (-1, *(1 for _ in shape))), c, q


def _slowed(m: Membrane, k: Values | int) -> Membrane:
    """Give a membrane on a clock that runs k times as fast."""
    return Membrane(m.kappa / k, m.zeta / k, m.omega1 / k, m.rolled)
