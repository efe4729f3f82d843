"""Flights and contacts under any excitation, in closed form between any two times: no step, and no event.

Harmonics have closed forms (`waves`). Samples are straight lines between knots: a line from the beginning on, and a
bend at every knot, each of which answers for itself.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vijax.engine.forcing import Forcing, forcing
from vijax.model import flow, waves
from vijax.model.excitation import Excitation, Harmonics
from vijax.model.flow import Membrane
from vijax.model.waves import Waves
from vijax.runtime.arrays import Scalar
from vijax.runtime.tiles import padded


class Shaking(eqx.Module):
    """An excitation as fits compute it.

    Attributes:
        forcing: As runs compute it, without noise; its knots are the samples.
        flight_bends, contact_bends: How many bends of the line between samples a flight and a contact have at most.
    """

    forcing: Forcing
    flight_bends: int = eqx.field(static=True)
    contact_bends: int = eqx.field(static=True)

    @property
    def sampled(self) -> bool:
        """Say whether it is a record, which need not repeat."""
        return self.forcing.samples is not None

    @property
    def longest_contact(self) -> Any:
        """Say how long a contact may last of which all bends are counted."""
        return self.contact_bends * self.forcing.gap if self.sampled else math.inf

    def waves(self, t: Scalar) -> Waves:
        """List the harmonics from a time on."""
        return self.forcing.waves(flow.wrap_phase(t)[0])

    def _lines(self, t: Scalar, bends: int) -> tuple[Scalar, Scalar, Array, Array]:
        """Tell the line at a time, by level and slope, and by how much and how much later the slope bends."""
        gap = self.forcing.gap
        begun = jnp.floor(t / gap)
        values = self.forcing.sample(begun + jnp.arange(bends + 2, dtype=t.dtype))
        slopes = jnp.diff(values) / gap
        gone = t - begun * gap
        when = (1 + jnp.arange(bends, dtype=t.dtype)) * gap - gone
        return values[0] + slopes[0] * gone, slopes[0], jnp.diff(slopes), when

    def flight(self, gamma: Scalar, t: Scalar, v: Scalar, s: Scalar) -> tuple[Scalar, Scalar]:
        """Compute how far a ball that has a velocity at a time flies from then on, and its velocity then."""
        rise, speed = waves.drift(self.waves(t), gamma, v, s)
        if not self.sampled:
            return rise, speed
        level, slope, bends, when = self._lines(t, self.flight_bends)
        left = jnp.maximum(s - when, 0.0)
        rise = rise + s * s * (level / 2 + slope * s / 6) + (bends * left**3).sum() / 6
        return rise, speed + s * (level + slope * s / 2) + (bends * left**2).sum() / 2

    def contact(
        self, m: Membrane, gamma: Scalar, side: Scalar, t: Scalar, z: Scalar, s: Scalar
    ) -> tuple[Scalar, Scalar]:
        """Compute penetration and rate at a time s after an onset at time t with rate z."""
        w, rate = waves.pressed(m, self.waves(t), side, gamma, z, s)
        if not self.sampled:
            return w, rate
        level, slope, bends, when = self._lines(t, self.contact_bends)
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
    plain = forcing(Harmonics() if excitation is None else excitation)
    if plain.samples is None:
        return Shaking(plain, 0, 0)
    spans = longest, min(longest, 4 * math.pi / softest)
    flight_bends, contact_bends = (padded(int(span / plain.gap) + 2) for span in spans)
    return Shaking(plain, flight_bends, contact_bends)
