"""Mirror symmetry of periodic orbits: those closed half way onto their mirror image, and the same in full."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from vijax.orbits.periodic import Orbit, check_orbit, guessed, proven, solved
from vijax.orbits.shooting import Sequence
from vijax.runtime import checks
from vijax.runtime.context import door


@door
def symmetric(orbit: Orbit, tolerance: float = 1e-9) -> Bool[np.ndarray, " orbit"]:
    """Say whether each orbit, run through once, is its own mirror image half a span later."""
    host, tolerance = jax.tree.map(np.asarray, check_orbit(orbit)), checks.positive("tolerance", tolerance)
    count = host.count
    index = np.arange(host.knots.shape[1])
    half = np.where(index < (count // 2)[:, None], index + (count // 2)[:, None], index)
    wait = np.array([0.5, 0.0, 0.0]) * host.sequence.span[:, None, None]
    moved = np.take_along_axis(host.knots, half[..., None], axis=1) - host.knots - wait
    opposite = np.take_along_axis(host.sequence.side, half, axis=1) == -host.sequence.side
    first = index < (count // 2)[:, None]
    same = (np.abs(moved).max(axis=2) < tolerance) & opposite
    return host.sequence.mirrored | ((count % 2 == 0) & host.pair.symmetric & (same | ~first).all(axis=1))


@door
def halved(orbit: Orbit, tolerance: float = 1e-9) -> Orbit:
    """Close symmetric orbits half way, onto their mirror image: half the impacts, and a pitchfork becomes a flip.

    Args:
        orbit: Orbits.
        tolerance: How far from its mirror image an orbit may be; the ones returned are symmetric.

    Raises:
        ValueError: An orbit that is not symmetric.
    """
    good = symmetric(orbit, tolerance)
    if not good.all():
        index = int(np.argmin(good))
        raise ValueError(f"orbit must be symmetric to be closed half way; got one that is not at index {index}")
    if bool(orbit.sequence.mirrored.all()):
        return orbit
    half = jax.tree.map(np.asarray, cut(orbit))
    return solved(half.pair, *guessed(half.sequence.side, half.sequence.span, half.sequence.mirrored, half.knots))


def cut(orbit: Orbit) -> Orbit:
    """Take the first half of orbits, of symmetric ones all that there is, as it stands: `halved` solves for it."""
    if bool(orbit.sequence.mirrored.all()):
        return orbit
    host = jax.tree.map(np.asarray, orbit)
    kept = np.arange(host.knots.shape[1]) < (host.count // 2)[:, None]
    width = host.knots.shape[1] // 2
    side = np.where(kept, host.sequence.side, 0)[:, :width]
    knots = np.where(kept[..., None], host.knots, 0.0)[:, :width]
    walls: Any = side, 0.5 * host.sequence.span, np.ones(len(orbit), bool)
    return replace(host, sequence=Sequence(*walls), knots=knots, depth=host.depth[:, :width], work=host.work[:, :width])


@door
def doubled(orbit: Orbit) -> Orbit:
    """Run through orbits twice, or in full where they were closed half way."""
    return _unfolded(check_orbit(orbit), np.ones(len(orbit), bool))


@door
def unfolded(orbit: Orbit) -> Orbit:
    """Give orbits in full, those closed half way too."""
    mirrored = np.asarray(check_orbit(orbit).sequence.mirrored)
    return _unfolded(orbit, mirrored) if mirrored.any() else orbit


def _unfolded(orbit: Orbit, twice: Bool[np.ndarray, " orbit"]) -> Orbit:
    """Append the second turn to the first where asked."""
    host = jax.tree.map(np.asarray, orbit)
    count, width = host.count[:, None], host.knots.shape[1]
    index = np.arange(int((host.count * (1 + twice)).max(initial=1)))
    again = index >= count
    from_first = np.where(again, index - count, index)
    there = (index < count) | (twice[:, None] & again & (index < 2 * count))
    from_first = np.clip(from_first, 0, width - 1)
    side = np.take_along_axis(host.sequence.side, from_first, axis=1)
    side = np.where(again & host.sequence.mirrored[:, None], -side, side)
    knots = np.take_along_axis(host.knots, from_first[..., None], axis=1)
    knots[..., 0] += np.where(again, host.sequence.span[:, None], 0.0)
    span = np.where(twice, 2 * host.sequence.span, host.sequence.span)
    mirrored, knots = host.sequence.mirrored & ~twice, np.where(there[..., None], knots, 0.0)
    return proven(host.pair, *guessed(np.where(there, side, 0), span, mirrored, knots))
