"""Forcing of an excitation at any time: harmonics, and samples and noise that are piecewise linear between knots.

Knots are evenly spaced times; between two knots samples and noise are straight lines. Time is stored as the number of
knots passed and the time since the last knot, so that a long run loses no digits.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vijax.impact.taylor import taylor
from vijax.impact.taylor.taylor import Push
from vijax.model.flow import PI
from vijax.model.forcing.excitation import Excitation, Harmonics, Noise, Waveform, validate_excitation
from vijax.model.forcing.waves import Wave, Waves, waves_later
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray, Scalar, Values, not_none
from vijax.runtime.compilation.xla import materialise
from vijax.runtime.doc_pages import see
from vijax.runtime.tiles import padded

# Knots per period without samples and noise. Fewer knots would save no steps, because a Taylor series under low
# harmonics is accurate for hardly more than one such interval.
_KNOTS = 16
# A knot, or the end of a period, counts as reached if it is less than this fraction of a knot spacing ahead.
REACHED = 1e-9


class Draws(eqx.Module):
    """Noise of a lane: its random key, and the values at both ends of the noise interval of the present time."""

    key: Array
    before: Scalar
    after: Scalar


class Forcing(eqx.Module):
    """An excitation in the form that a simulation evaluates.

    Attributes:
        orders: Orders k of the harmonics, as multiples of the forcing frequency.
        cosines, sines: f = sum of cosines_k cos(k pi t) - sines_k sin(k pi t), one entry per order.
        samples: Values at evenly spaced times from t = 0, padded; None without samples.
        count: Number of samples without the padding.
        looped: If True, the first sample follows the last one; otherwise the forcing keeps the last value.
        knots_per_period: Number of knots per forcing period; samples and noise are linear between two knots.
        knot_spacing: Time between two knots, 2/knots_per_period.
        reach: Longest step of a Taylor series under the fastest harmonic.
        curvature_bound: Bound of |f''| between knots.
        knots_per_sample: Number of knot intervals per sample interval.
        level: Standard deviation of the noise values; None without noise.
        seed: Seed of the noise realisation: its upper and its lower 16 bits.
        knots_per_noise_value: Number of knot intervals per noise interval.
    """

    orders: tuple[int, ...] = eqx.field(static=True)
    cosines: Float[AnyArray, " order"]
    sines: Float[AnyArray, " order"]
    samples: Float[AnyArray, "sample"] | None
    count: Values
    looped: bool = eqx.field(static=True)
    knots_per_period: Values
    knot_spacing: Values
    reach: Values
    curvature_bound: Values
    knots_per_sample: int = eqx.field(static=True)
    level: Values | None
    seed: Float[AnyArray, "2"]
    knots_per_noise_value: int = eqx.field(static=True)

    @property
    def is_periodic(self) -> bool:
        """True if the forcing repeats after every forcing period."""
        return self.samples is None and self.level is None

    def knot_at(self, n: Values, t: Values) -> Values:
        """Return the number of knots passed at phase t of period n; a knot at most `REACHED` spacings ahead counts."""
        return jnp.floor((2 * n + t) / self.knot_spacing + REACHED)

    def push(self, gamma: Scalar, k: Scalar, since: Scalar, phase: Scalar, draws: Draws | None) -> Push:
        """Return the force on the ball from the present time until the next knot.

        Args:
            gamma: Gravity parameter.
            k, since: Knots passed, and time since the last knot.
            phase: Phase of the forcing, in [0, 2).
            draws: Noise of the lane; None without noise.
        """
        level, slope = -gamma, jnp.zeros_like(gamma)
        noisy = None if draws is None else (draws.before, draws.after)
        for count, ends in ((self.knots_per_sample, self._sampled(k)), (self.knots_per_noise_value, noisy)):
            if ends is not None:
                before, after = ends
                # Straight line between two values that are `count` knots apart.
                rise = (after - before) * (1 / (count * self.knot_spacing))
                elapsed = since if count == 1 else (k - count * jnp.floor(k / count)) * self.knot_spacing + since
                level, slope = level + before + rise * elapsed, slope + rise
        return materialise(Push(level, slope, self.waves(phase)))

    def waves(self, phase: Values) -> Waves:
        """Return the harmonics as functions of the time since a phase; the phase may have any shape."""
        components = zip(self.orders, self.cosines, self.sines, strict=True)
        return waves_later(tuple(Wave(k, c, q) for k, c, q in components), phase)

    def _sampled(self, k: Scalar) -> tuple[Scalar, Scalar] | None:
        """Return the samples before and after a knot, or None without samples."""
        if self.samples is None:
            return None
        index = _interval(k, self.knots_per_sample)
        return self.sample(index), self.sample(index + 1)

    def sample(self, index: Values) -> Values:
        """Return samples by index. Beyond the end, a looped waveform repeats; otherwise the last sample is returned."""
        if self.looped:
            # `jnp.mod` would call a library function for every lane.
            index = index - self.count * jnp.floor(index / self.count)
        return not_none(self.samples)[jnp.minimum(index, self.count - 1).astype(jnp.int32)]

    def draws(self, pair: ImpactPair, state: State, k: Scalar) -> Draws | None:
        """Return the noise of a lane at the start.

        Its key depends on the seed, the cell's parameters and the initial state only.

        A cell therefore has the same noise in every map, lane and tile and on every machine, and equal cells have equal
        noise. The parameters enter in single precision (seven digits), because the last digits of a parameter depend on
        how it was computed.
        """
        if self.level is None:
            return None
        key = jax.random.key_data(jax.random.key(0))
        words = [half.astype(jnp.uint32) for half in (self.seed[0], self.seed[1])]
        numbers = jax.tree.leaves((pair, state.u, state.v))
        # -0.0 equals 0.0 but has other bits, so `where` replaces it by 0.0. The compiler would remove a sum with 0.0.
        rounded = (jnp.where(number == 0, 0.0, number).astype(jnp.float32) for number in numbers)
        words.extend(lax.bitcast_convert_type(number, jnp.uint32) for number in rounded)
        for word in words:
            key = jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), word))
        index = _interval(k, self.knots_per_noise_value)
        return Draws(key, self._draw(key, index), self._draw(key, index + 1))

    def _draw(self, key: Array, index: Scalar) -> Scalar:
        """Return noise value number `index` of a lane, at the start of noise interval `index`."""
        numbered = jax.random.fold_in(jax.random.wrap_key_data(key), index.astype(jnp.uint32))
        return not_none(self.level) * jax.random.normal(numbered, dtype=index.dtype)

    def advance_draws(self, draws: Draws | None, previous: Scalar, k: Scalar) -> Draws | None:
        """Return the noise at knot k: if a new noise interval begins at knot k, draw the value at the interval's end.

        `previous` is the number of knots passed before the step, `k` the number after it.
        """
        if draws is None:
            return None
        index = _interval(k, self.knots_per_noise_value)
        begins = index > _interval(previous, self.knots_per_noise_value)
        after = jnp.where(begins, self._draw(draws.key, index + 1), draws.after)
        return Draws(draws.key, jnp.where(begins, draws.after, draws.before), after)


def _interval(k: Scalar, count: int) -> Scalar:
    """Return the number of the interval that a knot lies in, for intervals of `count` knots."""
    return k if count == 1 else jnp.floor(k / count)


def forcing_of(excitation: Excitation) -> Forcing:
    """Convert an excitation without records into a `Forcing`, the form that a simulation evaluates.

    `Record.waveform` converts a record into samples.

    Samples and noise share the knots. The shorter of the two intervals is the knot spacing, and the other one is a
    whole number of knot spacings. The noise interval is rounded down for this, so the noise may have a slightly larger
    bandwidth than specified.
    """
    waves = excitation.of(Harmonics)
    amplitudes = np.zeros(max((len(wave.amplitudes) for wave in waves), default=0), complex)
    for wave in waves:
        # Complex amplitudes: the argument is the phase of a harmonic, so its real part multiplies cos and its imaginary
        # part -sin.
        amplitudes[: len(wave.amplitudes)] += np.asarray(wave.amplitudes) * np.exp(1j * np.asarray(wave.phases))
    orders = tuple(int(k) + 1 for k in np.flatnonzero(amplitudes))
    amplitudes = amplitudes[[k - 1 for k in orders]]
    waveform, noise = (next(iter(excitation.of(kind)), None) for kind in (Waveform, Noise))
    noise = noise if noise and noise.level else None
    knots_per_period, knots_per_sample, knots_per_noise_value = _shared_knots(waveform, noise)
    frequencies = PI * np.asarray(orders, float)
    values = None if waveform is None else np.asarray(waveform.values)
    fields: dict[str, Any] = {
        # f = Re sum of amplitude_k exp(i k pi t).
        "cosines": amplitudes.real,
        "sines": amplitudes.imag,
        # Padded, so that records of nearly equal length share a compiled program.
        "samples": None if values is None else np.pad(values, (0, padded(values.size) - values.size)),
        "count": np.asarray(0.0 if values is None else values.size, float),
        "knots_per_period": np.asarray(knots_per_period, float),
        "knot_spacing": np.asarray(2 / knots_per_period),
        "reach": np.asarray(taylor.REACH / max(frequencies, default=taylor.REACH)),
        "curvature_bound": (frequencies**2 * np.abs(amplitudes)).sum(),
        # The variance of a value is inversely proportional to its interval, so the spectral level is independent of the
        # knots.
        "level": None
        if noise is None
        else np.asarray(noise.level / math.sqrt(knots_per_noise_value * 2 / knots_per_period)),
        "seed": np.array(divmod(0 if noise is None else noise.seed, 1 << 16), float),
    }
    looped = waveform is not None and waveform.looped
    return Forcing(
        orders=orders,
        looped=looped,
        knots_per_sample=knots_per_sample,
        knots_per_noise_value=knots_per_noise_value,
        **fields,
    )


def harmonics_of(excitation: Excitation) -> Waves:
    """Return the harmonics, relative to phase 0, of an excitation that consists of harmonics only.

    Raises:
        ValueError: The sum of the harmonics is zero.
    """
    converted = forcing_of(excitation)
    if not converted.orders:
        raise ValueError("excitation must not cancel; got harmonics that do")
    return converted.waves(jnp.zeros(()))


def with_harmonics(pair: ImpactPair, excitation: Any) -> ImpactPair:
    """Return a pair, for a computation of orbits, with the harmonics of an excitation in every cell.

    If the excitation is None or the sine, the pair is returned unchanged.

    Args:
        pair: A validated pair.
        excitation: Harmonics, or None.

    Raises:
        ValueError: The argument is not an excitation, or does not repeat after every period.
    """
    if excitation is None or validate_excitation(excitation).is_sine:
        return pair
    if not excitation.is_periodic:
        raise ValueError(
            see(
                "excitation",
                f"excitation must repeat every period, as vijax.Harmonics do, for orbits; got {excitation}",
            )
        )
    harmonics, namespace = harmonics_of(excitation), tiles.array_namespace(pair)
    numbers = jax.tree.map(
        lambda x: namespace.broadcast_to(namespace.asarray(x, pair.d.dtype), np.shape(pair.d)), harmonics
    )
    return dataclasses.replace(pair, waves=numbers)


def excitation_attributes(pair: ImpactPair) -> dict[str, str]:
    """Return the excitation of the pairs of some orbits as a dataset attribute; an empty dict for the sine.

    All cells of `pair` must have the same excitation, because only the first cell is read.
    """
    if pair.waves is None:
        return {}
    amplitudes = np.zeros(max(wave.order for wave in pair.waves), complex)
    for wave in pair.waves:
        amplitudes[wave.order - 1] = complex(np.ravel(wave.c)[0], np.ravel(wave.q)[0])
    # Rounded to 15 digits, because amplitude and phase are recomputed by square roots and arctangents.
    rounded = ([float(f"{x:.15g}") for x in parts] for parts in (np.abs(amplitudes), np.angle(amplitudes)))
    return {"excitation": str(Harmonics(*rounded))}


def _shared_knots(waveform: Waveform | None, noise: Noise | None) -> tuple[float, int, int]:
    """Return the number of knots per period, and the knot intervals per sample interval and per noise interval."""
    if waveform is None:
        return (float(_KNOTS) if noise is None else 2 * noise.bandwidth), 1, 1
    if noise is None:
        return waveform.samples, 1, 1
    # Noise up to a bandwidth needs two values per period of its highest frequency.
    needed = 2 * noise.bandwidth
    if needed > waveform.samples:
        finer = math.ceil(needed / waveform.samples)
        return finer * waveform.samples, finer, 1
    return waveform.samples, 1, math.floor(waveform.samples / needed)
