"""The forcing of an excitation at any time: harmonics, and what is sampled, a straight line between two knots.

Time is told by the knots passed and by what has gone since, so that no digit is lost however long a run is.
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

from vijax.engine import taylor
from vijax.engine.taylor import Push
from vijax.model.excitation import Excitation, Harmonics, Noise, Waveform, instance
from vijax.model.flow import PI
from vijax.model.pair import ImpactPair
from vijax.model.records import State
from vijax.model.waves import Wave, Waves, later
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray, Scalar, Values, present
from vijax.runtime.pages import see
from vijax.runtime.tiles import padded
from vijax.runtime.xla import share

# Knots a period where nothing is sampled: what series reach there is not much longer.
_KNOTS = 16
# A knot, or the end of a period, that is so small a share of an interval away is reached.
REACHED = 1e-9


class Draws(eqx.Module):
    """What a lane keeps of its noise: the key that numbers its draws, the values at the knots before and after."""

    key: Array
    before: Scalar
    after: Scalar


class Forcing(eqx.Module):
    """An excitation as a run computes it.

    Attributes:
        orders: Which multiples of the forcing frequency its harmonics are.
        cosines, sines: f = sum of cosines_k cos(k pi t) - sines_k sin(k pi t), one number an order.
        samples: Values at evenly spaced times from t = 0, padded; None without any.
        count: How many of them are real.
        looped: Whether the first one follows the last; else the last value stays.
        knots: Knots a forcing period: all that is sampled is straight between two of them.
        gap: Time between two knots, 2/knots.
        reach: How far a series reaches under the fastest harmonic.
        bend: What |f''| is at most, between knots.
        every: How many knots lie between two samples.
        level: Standard deviation of the values of the noise; None without noise.
        seed: Two halves, of 16 bits each, of what numbers its realisation.
        noise_every: How many knots lie between two of its values.
    """

    orders: tuple[int, ...] = eqx.field(static=True)
    cosines: Float[AnyArray, " order"]
    sines: Float[AnyArray, " order"]
    samples: Float[AnyArray, "sample"] | None
    count: Values
    looped: bool = eqx.field(static=True)
    knots: Values
    gap: Values
    reach: Values
    bend: Values
    every: int = eqx.field(static=True)
    level: Values | None
    seed: Float[AnyArray, "2"]
    noise_every: int = eqx.field(static=True)

    @property
    def periodic(self) -> bool:
        """Say whether it repeats after every forcing period."""
        return self.samples is None and self.level is None

    def knot_at(self, n: Values, t: Values) -> Values:
        """Count the knots passed at phase t of a period; one that is all but reached is."""
        return jnp.floor((2 * n + t) / self.gap + REACHED)

    def push(self, gamma: Scalar, k: Scalar, since: Scalar, phase: Scalar, draws: Draws | None) -> Push:
        """Find what pushes the ball from now until the next knot."""
        level, slope = -gamma, jnp.zeros_like(gamma)
        noisy = None if draws is None else (draws.before, draws.after)
        for every, ends in ((self.every, self._sampled(k)), (self.noise_every, noisy)):
            if ends is not None:
                before, after = ends
                rise = (after - before) * (1 / (every * self.gap))
                gone = since if every == 1 else (k - every * jnp.floor(k / every)) * self.gap + since
                level, slope = level + before + rise * gone, slope + rise
        return share(Push(level, slope, self.waves(phase)))

    def waves(self, phase: Values) -> Waves:
        """List the harmonics from a phase on; of any shape."""
        each = zip(self.orders, self.cosines, self.sines, strict=True)
        return later(tuple(Wave(k, c, q) for k, c, q in each), phase)

    def _sampled(self, k: Scalar) -> tuple[Scalar, Scalar] | None:
        """Look up the samples before and after a knot."""
        if self.samples is None:
            return None
        index = _interval(k, self.every)
        return self.sample(index), self.sample(index + 1)

    def sample(self, index: Values) -> Values:
        """Look up samples by their numbers, however many loops that is; of a record that ends the last one stays."""
        if self.looped:
            # Not `jnp.mod`, which calls a library for every lane.
            index = index - self.count * jnp.floor(index / self.count)
        return present(self.samples)[jnp.minimum(index, self.count - 1).astype(jnp.int32)]

    def draws(self, pair: ImpactPair, state: State, k: Scalar) -> Draws | None:
        """Begin a lane's noise: its key is made of the seed, the cell's parameters and the start, and nothing else.

        So a cell meets the same noise in every plane, on every lane, tile and device, and equal cells the same one.
        Of each number seven digits count: the last ones of a parameter hang on how it was computed.
        """
        if self.level is None:
            return None
        key = jax.random.key_data(jax.random.key(0))
        words = [half.astype(jnp.uint32) for half in (self.seed[0], self.seed[1])]
        numbers = jax.tree.leaves((pair, state.u, state.v))
        # -0.0 is 0.0, but has other bits; a sum with 0.0 would be left out by the compiler.
        rounded = (jnp.where(number == 0, 0.0, number).astype(jnp.float32) for number in numbers)
        words.extend(lax.bitcast_convert_type(number, jnp.uint32) for number in rounded)
        for word in words:
            key = jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), word))
        index = _interval(k, self.noise_every)
        return Draws(key, self._draw(key, index), self._draw(key, index + 1))

    def _draw(self, key: Array, index: Scalar) -> Scalar:
        numbered = jax.random.fold_in(jax.random.wrap_key_data(key), index.astype(jnp.uint32))
        return present(self.level) * jax.random.normal(numbered, dtype=index.dtype)

    def drawn(self, draws: Draws | None, before: Scalar, k: Scalar) -> Draws | None:
        """Draw the value at the end of the interval that a knot begins, where it begins one; `before` was the last."""
        if draws is None:
            return None
        index = _interval(k, self.noise_every)
        begins = index > _interval(before, self.noise_every)
        after = jnp.where(begins, self._draw(draws.key, index + 1), draws.after)
        return Draws(draws.key, jnp.where(begins, draws.after, draws.before), after)


def _interval(k: Scalar, every: int) -> Scalar:
    """Find the number of the interval that a knot lies in, where each takes so many knots."""
    return k if every == 1 else jnp.floor(k / every)


def forcing(excitation: Excitation) -> Forcing:
    """Bring an excitation into the form of a run, without records (`Record.waveform` turns one into samples).

    Samples and noise share knots: of both intervals the shorter one is between two, the other is a whole number of it.
    That makes noise reach a little higher than it was told, where it is the other one.
    """
    waves = excitation.of(Harmonics)
    amplitudes = np.zeros(max((len(wave.amplitudes) for wave in waves), default=0), complex)
    for wave in waves:
        amplitudes[: len(wave.amplitudes)] += np.asarray(wave.amplitudes) * np.exp(1j * np.asarray(wave.phases))
    orders = tuple(int(k) + 1 for k in np.flatnonzero(amplitudes))
    amplitudes = amplitudes[[k - 1 for k in orders]]
    waveform, noise = (next(iter(excitation.of(kind)), None) for kind in (Waveform, Noise))
    noise = noise if noise and noise.level else None
    knots, every, noise_every = _shared_knots(waveform, noise)
    pace = PI * np.asarray(orders, float)
    values = None if waveform is None else np.asarray(waveform.values)
    fields: dict[str, Any] = {
        "cosines": amplitudes.real,
        "sines": amplitudes.imag,
        # Padded, so that records of nearly one length share a program.
        "samples": None if values is None else np.pad(values, (0, padded(values.size) - values.size)),
        "count": np.asarray(0.0 if values is None else values.size, float),
        "knots": np.asarray(knots, float),
        "gap": np.asarray(2 / knots),
        "reach": np.asarray(taylor.REACH / max(pace, default=taylor.REACH)),
        "bend": (pace**2 * np.abs(amplitudes)).sum(),
        "level": None if noise is None else np.asarray(noise.level / math.sqrt(noise_every * 2 / knots)),
        "seed": np.array(divmod(0 if noise is None else noise.seed, 1 << 16), float),
    }
    looped = waveform is not None and waveform.looped
    return Forcing(orders=orders, looped=looped, every=every, noise_every=noise_every, **fields)


def harmonics_of(excitation: Excitation) -> Waves:
    """List the harmonics of an excitation that has nothing else, from phase 0 on.

    Raises:
        ValueError: Harmonics that cancel.
    """
    made = forcing(excitation)
    if not made.orders:
        raise ValueError("excitation must not cancel; got harmonics that do")
    return made.waves(jnp.zeros(()))


def with_harmonics(pair: ImpactPair, excitation: Any) -> ImpactPair:
    """Give the pair of an orbit what shakes it, whose numbers become those of every cell; None leaves it the sine.

    Args:
        pair: A checked pair.
        excitation: Harmonics, or None.

    Raises:
        ValueError: No excitation, or one that does not repeat after every period.
    """
    if excitation is None or instance(excitation).sine:
        return pair
    if not excitation.periodic:
        raise ValueError(
            see(
                "excitation",
                f"excitation must repeat every period, as vijax.Harmonics do, for orbits; got {excitation}",
            )
        )
    made, own = harmonics_of(excitation), tiles.library(pair)
    numbers = jax.tree.map(lambda x: own.broadcast_to(own.asarray(x, pair.d.dtype), np.shape(pair.d)), made)
    return dataclasses.replace(pair, waves=numbers)


def told_harmonics(pair: ImpactPair) -> dict[str, str]:
    """Name what shakes some pairs of orbits for attributes, one for all; nothing of the sine."""
    if pair.waves is None:
        return {}
    amplitudes = np.zeros(max(wave.order for wave in pair.waves), complex)
    for wave in pair.waves:
        amplitudes[wave.order - 1] = complex(np.ravel(wave.c)[0], np.ravel(wave.q)[0])
    # To 15 digits, as amplitude and phase come back by roots and arcs.
    rounded = ([float(f"{x:.15g}") for x in each] for each in (np.abs(amplitudes), np.angle(amplitudes)))
    return {"excitation": str(Harmonics(*rounded))}


def _shared_knots(waveform: Waveform | None, noise: Noise | None) -> tuple[float, int, int]:
    """Find how many knots a period there are, and how many lie between two samples and two values of the noise."""
    if waveform is None:
        return (float(_KNOTS) if noise is None else 2 * noise.bandwidth), 1, 1
    if noise is None:
        return waveform.samples, 1, 1
    wanted = 2 * noise.bandwidth
    if wanted > waveform.samples:
        finer = math.ceil(wanted / waveform.samples)
        return finer * waveform.samples, finer, 1
    return waveform.samples, 1, math.floor(waveform.samples / wanted)
