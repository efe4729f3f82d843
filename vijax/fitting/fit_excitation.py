"""Flights and contacts under any excitation, in closed form between any two times: no step size, no event detection.

Harmonics have closed forms (`waves`). Samples are connected by straight lines. The line at the start is extended, and
every later sample adds a change of slope (a bend); flight and contact respond to each bend separately, by linearity.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from vijax.impact.forcing import Forcing, forcing_of
from vijax.model import flow
from vijax.model.flow import Membrane
from vijax.model.forcing import waves
from vijax.model.forcing.excitation import Excitation, Harmonics
from vijax.model.forcing.waves import Waves
from vijax.runtime.arrays import Scalar
from vijax.runtime.tiles import padded


class FitExcitation(eqx.Module):
    """An excitation in the form of fits.

    Attributes:
        forcing: As in simulations, without noise; its knots are the samples.
        flight_bends, contact_bends: Largest number of bends of the line between samples in a flight and in a contact.
    """

    forcing: Forcing
    flight_bends: int = eqx.field(static=True)
    contact_bends: int = eqx.field(static=True)

    @property
    def sampled(self) -> bool:
        """Return True for a record, which need not repeat."""
        return self.forcing.samples is not None

    @property
    def longest_contact(self) -> Any:
        """Return the longest contact duration that `contact_bends` covers; infinite without samples."""
        return self.contact_bends * self.forcing.knot_spacing if self.sampled else math.inf

    def waves(self, t: Scalar) -> Waves:
        """Return the harmonics, with the phase at time t."""
        return self.forcing.waves(flow.wrap_phase(t)[0])

    def _lines(self, t: Scalar, bends: int) -> tuple[Scalar, Scalar, Array, Array]:
        """Return the line at time t as level and slope, and changes of slope with their times after t."""
        knot_spacing = self.forcing.knot_spacing
        index = jnp.floor(t / knot_spacing)
        # `bends` changes of slope need `bends` + 2 samples.
        values = self.forcing.sample(index + jnp.arange(bends + 2, dtype=t.dtype))
        slopes = jnp.diff(values) / knot_spacing
        since_sample = t - index * knot_spacing
        when = (1 + jnp.arange(bends, dtype=t.dtype)) * knot_spacing - since_sample
        return values[0] + slopes[0] * since_sample, slopes[0], jnp.diff(slopes), when

    def flight(self, gamma: Scalar, t: Scalar, v: Scalar, s: Scalar) -> tuple[Scalar, Scalar]:
        """Compute displacement (from 0) and velocity of a ball a time s after it has velocity v at time t."""
        rise, speed = waves.flight_motion(self.waves(t), gamma, v, s)
        if not self.sampled:
            return rise, speed
        level, slope, bends, when = self._lines(t, self.flight_bends)
        # A bend b at a time c after t adds b (s - c)^3 / 6 to the displacement for s > c.
        after_bend = jnp.maximum(s - when, 0.0)
        rise = rise + s * s * (level / 2 + slope * s / 6) + (bends * after_bend**3).sum() / 6
        return rise, speed + s * (level + slope * s / 2) + (bends * after_bend**2).sum() / 2

    def contact(
        self, m: Membrane, gamma: Scalar, side: Scalar, t: Scalar, z: Scalar, s: Scalar
    ) -> tuple[Scalar, Scalar]:
        """Compute penetration and rate at a time s after an onset at time t with rate z."""
        w, rate = waves.contact_motion(m, self.waves(t), side, gamma, z, s)
        if not self.sampled:
            return w, rate
        level, slope, bends, when = self._lines(t, self.contact_bends)
        step, impulse = _step_response(m, s)
        ramp, _ = _ramp_response(m, s)
        # A later bend acts as a ramp from its own time on; before that its response is 0.
        ramps, steps = _ramp_response(m, jnp.maximum(s - when, 0.0))
        w = w + side * (level * step + slope * ramp + (bends * ramps).sum())
        return w, rate + side * (level * impulse + slope * step + (bends * steps).sum())


def _step_response(m: Membrane, s: Any) -> tuple[Any, Any]:
    """Compute the response of a membrane from rest to a constant force of 1, and its rate, the impulse response."""
    h, slope = flow.free_response(m, s)
    return (1 - slope - m.mu * h) / (m.kappa * m.kappa), h


def _ramp_response(m: Membrane, s: Any) -> tuple[Any, Any]:
    """Compute the response of a membrane from rest to a force that equals the time, and its rate, the step response.

    In w'' + mu w' + kappa^2 w = s all terms except w are known: w' is the step response, and w'' the impulse response.
    """
    step, impulse = _step_response(m, s)
    return (s - impulse - m.mu * step) / (m.kappa * m.kappa), step


def fit_excitation(excitation: Excitation | None, longest: float, softest: float) -> FitExcitation:
    """Convert an excitation without noise to the form of fits.

    Args:
        excitation: In units of the device; the sine by default.
        longest: Longest time between two impacts, in half forcing periods.
        softest: Least kappa of the search. It determines the longest contact, two periods of the membrane.
    """
    plain = forcing_of(Harmonics() if excitation is None else excitation)
    if plain.samples is None:
        return FitExcitation(plain, 0, 0)
    # Two samples more than the duration needs; padded so that few programs are compiled.
    spans = longest, min(longest, 4 * math.pi / softest)
    flight_bends, contact_bends = (padded(int(span / plain.knot_spacing) + 2) for span in spans)
    return FitExcitation(plain, flight_bends, contact_bends)
