"""Periodic orbits, stable and unstable: from states or impact sequences, by Newton, each verified by the impact map."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from vijax import flow, shooting
from vijax.energy import harvested_energy
from vijax.impact_map import next_impacts
from vijax.model import Harvester, Impact, ImpactPair, Status
from vijax.shooting import Sequence
from vijax.trajectory import trajectory

_SAME = 1e-6  # how closely the impact map must meet the next impact of a real orbit
_TILE = 4096  # orbits of one compiled call


class Orbit(eqx.Module):
    """Periodic orbits, one along the leading axis; impacts along the last, padded with side 0 and NaN.

    Attributes:
        pair: Parameters.
        sequence: Walls met, and how the orbit closes; see `shooting.Sequence`.
        knots: Onset time, speed into the wall and contact time of each impact.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each impact; NaN unless OK.
        multipliers: Floquet multipliers of the full orbit, larger modulus first.
        residual: Largest violation of the equations; inf where no orbit was found.
        status: OK; VIRTUAL: the equations hold but the ball would meet a wall in between; NO_ORBIT.
    """

    pair: ImpactPair
    sequence: Sequence
    knots: Float[Array, "orbit impact 3"]
    depth: Float[Array, "orbit impact"]
    work: Float[Array, "orbit impact"]
    multipliers: Complex[Array, "orbit 2"]
    residual: Float[Array, "orbit"]
    status: Int[Array, "orbit"]

    @property
    def count(self) -> Int[Array, "orbit"]:
        """Impacts until it closes (half of all where it closes onto its mirror image)."""
        return self.sequence.real.sum(axis=-1)


def solve(pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]) -> Orbit:
    """The periodic orbits near some guesses, thousands in one call, on every core.

    Args:
        pair: One cell an orbit.
        sequence, knots: Guesses; padded impacts hold anything.

    Returns:
        Orbits in the order of the guesses, each with its `status`.
    """
    level = bool((np.asarray(pair.gamma) == 0).all())
    parts = [jax.tree.map(lambda leaf, s=part: leaf[s], (pair, sequence, knots)) for part in _tiles(knots.shape[0])]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        solved = list(pool.map(lambda part: _solve(*part, level), parts))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *solved)


def _tiles(count: int) -> list[slice]:
    return [slice(start, start + _TILE) for start in range(0, count, _TILE)]


def _solve(pair: ImpactPair, sequence: Sequence, guess: Float[Array, "orbit impact 3"], level: bool) -> Orbit:
    """One tile: Newton, then one flight and contact from every impact, which must meet the next one."""
    knots, residual, multipliers, passage = _shoot(pair, sequence, guess)
    found = jnp.isfinite(residual)
    real = sequence.real
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], real.shape).reshape(-1), pair)
    phase, periods = flow.wrap_phase(passage.t)
    flown = next_impacts(wide, passage.side.reshape(-1), passage.speed.reshape(-1), phase.reshape(-1), level=level)
    flown = jax.tree.map(lambda leaf: leaf.reshape(real.shape), flown)
    miss = jnp.abs(flown.t + 2 * periods - passage.next_t) + jnp.abs(flown.side * flown.v_in - passage.next_speed)
    met = flown.real & (flown.side == passage.next_side) & (miss < _SAME)
    verified = found & (met | ~real).all(axis=1)
    status = jnp.where(verified, Status.OK, jnp.where(found, Status.VIRTUAL, Status.NO_ORBIT)).astype(jnp.int32)
    good = verified[:, None] & real
    # What was flown to is the impact after each.
    last = jnp.maximum(real.sum(axis=1) - 1, 0)
    before = jnp.where(jnp.arange(real.shape[1]) == 0, last[:, None], jnp.arange(real.shape[1])[None] - 1)
    depth, work = (jnp.take_along_axis(leaf, before, axis=1) for leaf in (flown.depth, flown.work))
    blank = jnp.where(real[..., None], knots, jnp.nan)
    return Orbit(
        pair=pair,
        sequence=sequence,
        knots=blank,
        depth=jnp.where(good, depth, jnp.nan),
        work=jnp.where(good, work, jnp.nan),
        multipliers=jnp.where(found[:, None], multipliers, jnp.nan),
        residual=residual,
        status=status,
    )


@jax.jit
def _shoot(pair: ImpactPair, sequence: Sequence, guess: Float[Array, "orbit impact 3"]):
    """Newton; then multipliers, and the passages to verify."""
    knots, residual = shooting.newton(pair, sequence, guess)
    # The first impact within the first period.
    knots = knots.at[..., 0].add(-2 * jnp.floor(0.5 * knots[:, :1, 0]))
    around = jax.vmap(shooting.monodromy)(pair, sequence, knots)
    return knots, residual, floquet(around, sequence.mirrored), jax.vmap(shooting.passages)(pair, sequence, knots)


def floquet(around: Float[Array, "orbit 2 2"], mirrored: Bool[Array, "orbit"]) -> Complex[Array, "orbit 2"]:
    """Eigenvalues of 2 x 2 monodromy matrices, the larger modulus first; squared where the orbit is closed half way.

    The smaller of two real ones is the determinant over the larger: their difference would cancel.
    """
    half = 0.5 * (around[:, 0, 0] + around[:, 1, 1])
    product = around[:, 0, 0] * around[:, 1, 1] - around[:, 0, 1] * around[:, 1, 0]
    spread = half * half - product
    root = jnp.sqrt(jnp.abs(spread))
    large = half + jnp.where(half < 0, -root, root)
    small = product / jnp.where(large == 0, 1.0, large)
    pair = jnp.stack([large, small], axis=1).astype(complex)
    twins = jnp.stack([half + 1j * root, half - 1j * root], axis=1)
    values = jnp.where((spread >= 0)[:, None], pair, twins)
    return jnp.where(mirrored[:, None], values * values, values)
