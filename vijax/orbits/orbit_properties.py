"""What a periodic orbit says of itself: its label, impacts, power, motion, and what tells it from others."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vijax.model import flow
from vijax.model.device import Harvester, check_device, depth_unit
from vijax.model.energy import harvested_energy
from vijax.model.label import label
from vijax.model.records import Impact
from vijax.model.sides import at
from vijax.orbits import repetition, shooting
from vijax.orbits.motion import MOST_SAMPLES, pieces
from vijax.orbits.periodic import SAME, TILES, Orbit, check_orbit
from vijax.orbits.symmetry import unfolded
from vijax.runtime import checks, tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.context import door
from vijax.runtime.programs import jitted


class Counts(NamedTuple):
    """Label of orbits: impacts on the left, on the right, per forcing periods; n:m/pT."""

    left: Int[np.ndarray, " orbit"]
    right: Int[np.ndarray, " orbit"]
    period: Int[np.ndarray, " orbit"]


@door
def counts(orbit: Orbit, tolerance: float = SAME) -> Counts:
    """Count what is in the label of each orbit, over the fewest whole periods after which it recurs to a tolerance."""
    full = jax.tree.map(np.asarray, unfolded(orbit))
    period = np.round(0.5 * full.sequence.span).astype(int)
    turns = repetition.turns(full.sequence, full.knots, tolerance)
    left, right = ((full.sequence.side == wall).sum(axis=1) for wall in (-1, 1))
    return Counts(left // turns, right // turns, period // turns)


@door
def labels(orbit: Orbit) -> np.ndarray:
    """Name orbits n:m/pT."""
    found = counts(orbit)
    return label(found.period, found.left, found.right)


@door
def impacts(orbit: Orbit) -> Impact:
    """List the impacts of the full orbits in order, along the last axis; NaN and side 0 where padded."""
    return tiles.arrays(tiles.map_tiles(_hits, unfolded(orbit), TILES))


@jitted
def _hits(full: Orbit) -> Impact:
    """Compute the impacts of orbits that are in full."""
    departure = jax.vmap(shooting.departures)(full.pair, full.sequence, full.knots)
    side, (t, speed, stay) = full.sequence.side, jnp.moveaxis(full.knots, -1, 0)
    phase, n = flow.wrap_phase(jnp.where(side == 0, 0.0, t))
    blank, wall = jnp.where(side == 0, jnp.nan, 0.0), side.astype(t.dtype)
    return Impact(
        n=n.astype(jnp.int32),
        t=phase + blank,
        side=side,
        v_in=wall * speed + blank,
        v_out=-wall * departure.speed + blank,
        depth=full.depth,
        duration=stay,
        work=full.work,
    )


@door
def power(orbit: Orbit, device: Harvester) -> Float[AnyArray, " orbit"]:
    """Compute the energy harvested per half forcing period [J]; NaN unless the orbit's status is OK.

    Args:
        device: Gives A and omega (the unit of length), omega0 where walls are rigid, and the electrical constants.

    Source: Eq. (36), corrected.
    """
    check_device(device)
    own = tiles.library((check_orbit(orbit), device))
    orbit, device = jax.tree.map(own.asarray, (orbit, device))
    side = orbit.sequence.side
    depth = orbit.depth * at(depth_unit(device, orbit.pair), side)
    energy = own.asarray(harvested_energy(device.at(side), depth))
    if device.unequal:
        # An orbit closed half way is as often at either wall.
        image = own.asarray(harvested_energy(device.at(-side), depth))
        energy = own.where(orbit.sequence.mirrored[:, None], 0.5 * (energy + image), energy)
    # The span of an orbit is in half forcing periods, for their length is the unit of time.
    return tiles.arrays(own.where(orbit.sequence.real, energy, 0.0).sum(axis=1) / orbit.sequence.span)


@door
def path(orbit: Orbit, samples: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the motion of full orbits to draw: `samples` instants of every contact and of every flight.

    Returns:
        Time, displacement and velocity, each [orbit, instant], in order; NaN where padded. Velocity jumps at a rigid
        wall.
    """
    samples = checks.whole("samples", samples, 1, MOST_SAMPLES)
    full = jax.tree.map(np.asarray, unfolded(orbit))
    rows = tiles.map_tiles(partial(_pieces, samples=samples), full, TILES)
    real = full.sequence.real[..., None]
    clock, u, v = (np.where(real, row, np.nan).reshape(len(full), -1) for row in rows)
    return clock, u, v


@partial(jitted, static=("samples",))
def _pieces(full: Orbit, samples: int) -> tuple[Array, ...]:
    """Compute (t, u, v) [orbit, impact, instant] of orbits that are in full."""
    until = jax.vmap(shooting.departures)(full.pair, full.sequence, full.knots).next_t
    hits, t = _hits(full), full.knots[..., 0]
    side = hits.side.astype(t.dtype)
    return jax.vmap(partial(pieces, samples=samples))(full.pair, t, side, hits.v_in, hits.v_out, hits.duration, until)


@door
def marks(orbit: Orbit) -> Float[np.ndarray, "orbit 6"]:
    """Sum over the impacts of a forcing period what tells orbits of one pair apart, mirror images too.

    An orbit and the same orbit run through several times have the same marks.
    """
    return marks_of_knots(orbit.sequence.side, orbit.knots) / (0.5 * np.asarray(orbit.sequence.span)[:, None])


def marks_of_knots(side: Any, knots: Any) -> Float[np.ndarray, "orbit 6"]:
    """Sum what `marks` does over all impacts, with the walls and knots of orbits that need not be proved."""
    t, speed, stay = np.moveaxis(np.asarray(knots), -1, 0)
    signed = np.asarray(side) * speed
    # Odd harmonics are alike for mirror images, (side, t) -> (-side, t + 1); even ones change sign.
    waves = [wave(np.pi * order * t) for order in (1, 2) for wave in (np.cos, np.sin)]
    parts = [*(signed * wave for wave in waves), signed + speed, stay * speed]
    return np.stack([np.nansum(part, axis=-1) for part in parts], axis=-1)
