"""Flights and contacts under any excitation, in closed form between any two times: no step, and no event.

Harmonics have closed forms (`waves`). Samples are straight lines between knots: a line from the beginning on, and a
bend at every knot, each of which answers for itself.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.engine.forcing import forcing
from vijax.model import flow, waves
from vijax.model.excitation import Excitation, Harmonics, Waveform
from vijax.model.flow import Membrane
from vijax.model.waves import Wave, Waves
from vijax.runtime.arrays import AnyArray, Scalar
from vijax.runtime.tiles import padded


class Lines(eqx.Module):
    """Samples of an acceleration with straight lines between them, from t = 0 on.

    Attributes:
        values: In units of A.
        gap: Time between two samples.
        looped: Whether the first follows the last; else the last value stays.
        flight_bends, contact_bends: How many bends of the line a flight and a contact have at most.
    """

    values: Float[AnyArray, "sample"]
    gap: Float[AnyArray, ""]
    looped: bool = eqx.field(static=True)
    flight_bends: int = eqx.field(static=True)
    contact_bends: int = eqx.field(static=True)

    def after(self, t: Scalar, bends: int) -> tuple[Scalar, Scalar, Array, Array]:
        """Tell the line at a time, by level and slope, and by how much and how much later the slope bends."""
        begun = jnp.floor(t / self.gap)
        count = self.values.size
        index = begun.astype(jnp.int32) + jnp.arange(bends + 2, dtype=jnp.int32)
        values = self.values[jnp.mod(index, count) if self.looped else jnp.clip(index, 0, count - 1)]
        slopes = jnp.diff(values) / self.gap
        gone = t - begun * self.gap
        when = (1 + jnp.arange(bends, dtype=t.dtype)) * self.gap - gone
        return values[0] + slopes[0] * gone, slopes[0], jnp.diff(slopes), when


class Shaking(eqx.Module):
    """An excitation as fits compute it.

    Attributes:
        orders: Which multiples of the forcing frequency its harmonics are.
        cosines, sines: As those of `Forcing`.
        lines: What is sampled, if anything is.
    """

    orders: tuple[int, ...] = eqx.field(static=True)
    cosines: Float[AnyArray, "order"]
    sines: Float[AnyArray, "order"]
    lines: Lines | None

    @property
    def sampled(self) -> bool:
        """Say whether it is a record, which need not repeat."""
        return self.lines is not None

    def waves(self, t: Scalar) -> Waves:
        """List the harmonics from a time on."""
        phase, _ = flow.wrap_phase(t)
        each = zip(self.orders, self.cosines, self.sines, strict=True)
        return tuple(Wave(k, c, q).later(phase) for k, c, q in each)

    @property
    def longest_contact(self) -> Any:
        """Say how long a contact may last of which all bends are counted."""
        return math.inf if self.lines is None else self.lines.contact_bends * self.lines.gap

    def acceleration(self, t: Scalar) -> Scalar:
        """Compute the forcing at a time."""
        harmonic = sum((wave.c for wave in self.waves(t)), jnp.zeros_like(t))
        return harmonic if self.lines is None else harmonic + self.lines.after(t, 0)[0]

    def flight(self, gamma: Scalar, t: Scalar, v: Scalar, s: Scalar) -> tuple[Scalar, Scalar]:
        """Compute how far a ball that has a velocity at a time flies from then on, and its velocity then."""
        rise, speed = waves.drift(self.waves(t), gamma, v, s)
        if self.lines is None:
            return rise, speed
        level, slope, bends, when = self.lines.after(t, self.lines.flight_bends)
        left = jnp.maximum(s - when, 0.0)
        rise = rise + s * s * (level / 2 + slope * s / 6) + (bends * left**3).sum() / 6
        return rise, speed + s * (level + slope * s / 2) + (bends * left**2).sum() / 2

    def contact(
        self, m: Membrane, gamma: Scalar, side: Scalar, t: Scalar, z: Scalar, s: Scalar
    ) -> tuple[Scalar, Scalar]:
        """Compute penetration and rate at a time s after an onset at time t with rate z."""
        w, rate = waves.pressed(m, self.waves(t), side, gamma, z, s)
        if self.lines is None:
            return w, rate
        level, slope, bends, when = self.lines.after(t, self.lines.contact_bends)
        step, impulse = _step_response(m, s)
        ramp, _ = _ramp_response(m, s)
        ramps, steps = _ramp_response(m, jnp.maximum(s - when, 0.0))
        w = w + side * (level * step + slope * ramp + (bends * ramps).sum())
        return w, rate + side * (level * impulse + slope * step + (bends * steps).sum())


def _step_response(m: Membrane, s: Any) -> tuple[Any, Any]:
    """Compute a membrane's response from rest to a push of 1 that stays, and its rate."""
    h, slope = flow.free_response(m, s)
    return (1 - slope - m.mu * h) / (m.kappa * m.kappa), h


def _ramp_response(m: Membrane, s: Any) -> tuple[Any, Any]:
    """Compute a membrane's response from rest to a push that grows as time does, and its rate: its step response.

    Of w'' + mu w' + kappa^2 w = s all but w is known: w' is the step response, and w'' the impulse response.
    """
    step, impulse = _step_response(m, s)
    return (s - impulse - m.mu * step) / (m.kappa * m.kappa), step


def shaking(excitation: Excitation | None, longest: float, softest: float) -> Shaking:
    """Bring an excitation without noise into the form of fits.

    Args:
        excitation: In units of the device; the sine unless given.
        longest: Time between two impacts, at most, in half forcing periods.
        softest: The least kappa that is looked at: a contact lasts for two of its turns at most.
    """
    excitation = Harmonics() if excitation is None else excitation
    plain = forcing(excitation)
    lines = None
    for wave in excitation.of(Waveform):
        gap: Any = np.asarray(2 / wave.samples)
        values: Any = np.asarray(wave.values, float)
        bends = (padded(int(most / gap) + 2) for most in (longest, min(longest, 4 * math.pi / softest)))
        lines = Lines(values, gap, wave.looped, *bends)
    return Shaking(plain.orders, plain.cosines, plain.sines, lines)
