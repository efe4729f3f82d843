"""The harmonics of the forcing, and what a ball does under them that meets no wall, or never leaves one."""

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
    zero = jnp.zeros_like(s)
    first = next((wave for wave in waves if wave.order == 1), Wave(1, zero, zero))
    rise, speed = flight(Force(first.c, first.q, gamma), v, s)
    if others := _higher(waves):
        k, force = _on_own_clocks(others, s)
        further, faster = flight(force, jnp.zeros_like(s), k * s)
        rise, speed = rise + (further / k**2).sum(axis=0), speed + (faster / k).sum(axis=0)
    return rise, speed


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
    zero = jnp.zeros_like(s)
    first = next((wave for wave in waves if wave.order == 1), Wave(1, zero, zero))
    w, rate = oscillate(m, Force(side * first.c, side * first.q, side * gamma), zero, z, s)
    if others := _higher(waves):
        k, force = _on_own_clocks([wave.times(side / wave.order**2) for wave in others], s)
        deeper, faster = oscillate(_slowed(m, k), force, zero, zero, k * s)
        w, rate = w + deeper.sum(axis=0), rate + (k * faster).sum(axis=0)
    return w, rate


def _higher(waves: Waves) -> list[Wave]:
    return [wave for wave in waves if wave.order != 1]


def _on_own_clocks(waves: list[Wave], s: Values) -> tuple[Values, Force]:
    """Stack harmonics, so that a program holds the closed forms once for all; each is the first on its own clock.

    Returns:
        The orders, shaped to go before the axes of s, and the harmonics along a new first axis.
    """
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves((waves, s))))
    k = jnp.reshape(jnp.array([wave.order for wave in waves], s.dtype), (-1, *(1 for _ in shape)))
    c, q = (jnp.stack([jnp.broadcast_to(getattr(wave, part), shape) for wave in waves]) for part in ("c", "q"))
    return k, Force(c, q, jnp.zeros_like(c))


def _slowed(m: Membrane, k: Values | int) -> Membrane:
    """Give a membrane on a clock that runs k times as fast."""
    return Membrane(m.kappa / k, m.zeta / k, m.omega1 / k, m.rolled)
