"""Properties of periodic orbits: label, impacts, power, motion, and numbers that distinguish them from other orbits."""

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
from vijax.model.walls.sides import at_wall
from vijax.orbits import repetition, shooting
from vijax.orbits.motion import MOST_SAMPLES, pieces
from vijax.orbits.periodic import TILES, VERIFICATION_TOLERANCE, Orbit, check_orbit
from vijax.orbits.symmetry import unfold
from vijax.runtime import tiles, validation
from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.public_api import public_api


class Counts(NamedTuple):
    """Label n:m/pT of orbits.

    Attributes:
        left, right: Number of impacts on the left (n) and on the right wall (m).
        period: Number p of forcing periods.
    """

    left: Int[np.ndarray, " orbit"]
    right: Int[np.ndarray, " orbit"]
    period: Int[np.ndarray, " orbit"]


@public_api
def counts(orbit: Orbit, tolerance: float = VERIFICATION_TOLERANCE) -> Counts:
    """Count the impacts and periods in the label of each orbit.

    Counts refer to the fewest whole periods after which the orbit repeats itself to a tolerance.
    """
    full = jax.tree.map(np.asarray, unfold(orbit))
    # The span is in half forcing periods.
    period = np.round(0.5 * full.sequence.span).astype(int)
    repetitions = repetition.count_repetitions(full.sequence, full.impact_unknowns, tolerance)
    left, right = ((full.sequence.side == wall).sum(axis=1) for wall in (-1, 1))
    return Counts(left // repetitions, right // repetitions, period // repetitions)


@public_api
def orbit_labels(orbit: Orbit) -> np.ndarray:
    """Return the labels n:m/pT of orbits."""
    label_counts = counts(orbit)
    return label(label_counts.period, label_counts.left, label_counts.right)


@public_api
def orbit_impacts(orbit: Orbit) -> Impact:
    """Return the impacts of the full orbits in order, along the last axis; NaN and side 0 for padding."""
    return tiles.arrays(tiles.map_tiles(_hits, unfold(orbit), TILES))


@jitted
def _hits(full: Orbit) -> Impact:
    """Compute the impacts of full orbits."""
    exits = jax.vmap(shooting.contact_exits)(full.pair, full.sequence, full.impact_unknowns)
    side, (t, speed, contact_duration) = full.sequence.side, jnp.moveaxis(full.impact_unknowns, -1, 0)
    # Adding `blank` makes padded entries NaN.
    phase, n = flow.wrap_phase(jnp.where(side == 0, 0.0, t))
    blank, wall = jnp.where(side == 0, jnp.nan, 0.0), side.astype(t.dtype)
    return Impact(
        n=n.astype(jnp.int32),
        t=phase + blank,
        side=side,
        v_in=wall * speed + blank,
        v_out=-wall * exits.speed + blank,
        depth=full.depth,
        duration=contact_duration,
        work=full.work,
    )


@public_api
def orbit_power(orbit: Orbit, device: Harvester) -> Float[AnyArray, " orbit"]:
    """Compute the energy harvested per half forcing period [J]; NaN unless the orbit's status is OK.

    Args:
        orbit: Orbits.
        device: Specifies A and omega (the unit of length), omega0 if walls are rigid, and the electrical constants.

    Source: Eq. (36), corrected: P = sum(E_j)/(2p) over p forcing periods.
    """
    check_device(device)
    library = tiles.array_namespace((check_orbit(orbit), device))
    orbit, device = jax.tree.map(library.asarray, (orbit, device))
    side = orbit.sequence.side
    # `at_wall` and `device.at` select the value at the wall of each impact if the walls differ.
    depth = orbit.depth * at_wall(depth_unit(device, orbit.pair), side)
    energy = library.asarray(harvested_energy(device.at(side), depth))
    if device.has_unequal_walls:
        # If half of a symmetric orbit is stored, each impact also occurs at the other wall. The mean energy is used,
        # because the span is half of the full one.
        image = library.asarray(harvested_energy(device.at(-side), depth))
        energy = library.where(orbit.sequence.mirrored[:, None], 0.5 * (energy + image), energy)
    # The unit of time is half a forcing period, so that the span counts half forcing periods.
    return tiles.arrays(library.where(orbit.sequence.real, energy, 0.0).sum(axis=1) / orbit.sequence.span)


@public_api
def orbit_path(orbit: Orbit, samples: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the motion of full orbits for plots: `samples` instants in every contact and in every flight.

    Returns:
        Time, displacement and velocity, each [orbit, instant], in order; NaN for padding. The velocity jumps at a rigid
        wall.
    """
    samples = validation.validate_integer("samples", samples, 1, MOST_SAMPLES)
    full = jax.tree.map(np.asarray, unfold(orbit))
    rows = tiles.map_tiles(partial(_pieces, samples=samples), full, TILES)
    real = full.sequence.real[..., None]
    clock, u, v = (np.where(real, row, np.nan).reshape(len(full), -1) for row in rows)
    return clock, u, v


@partial(jitted, static=("samples",))
def _pieces(full: Orbit, samples: int) -> tuple[Array, ...]:
    """Compute (t, u, v) [orbit, impact, instant] of orbits that are stored in full, not as half a period."""
    until = jax.vmap(shooting.contact_exits)(full.pair, full.sequence, full.impact_unknowns).next_t
    # Unlike the phases of `_hits`, these onsets are on one ascending clock.
    hits, t = _hits(full), full.impact_unknowns[..., 0]
    side = hits.side.astype(t.dtype)
    return jax.vmap(partial(pieces, samples=samples))(full.pair, t, side, hits.v_in, hits.v_out, hits.duration, until)


@public_api
def orbit_signature(orbit: Orbit) -> Float[np.ndarray, "orbit 6"]:
    """Compute six numbers per orbit that distinguish the orbits of one pair, mirror images included.

    They are the sums of `signature_sums`, divided by the number of forcing periods.

    An orbit and the same orbit repeated several times have the same numbers.
    """
    return signature_sums(orbit.sequence.side, orbit.impact_unknowns) / (0.5 * np.asarray(orbit.sequence.span)[:, None])


def signature_sums(side: Any, impact_unknowns: Any) -> Float[np.ndarray, "orbit 6"]:
    """Compute the sums of `orbit_signature` over all impacts of orbits, which need not be verified.

    The summands are side speed cos(k pi t) and side speed sin(k pi t) for k = 1, 2; side speed + speed; contact
    duration times speed.
    """
    t, speed, contact_duration = np.moveaxis(np.asarray(impact_unknowns), -1, 0)
    signed = np.asarray(side) * speed
    # Under the mirror (side, t) -> (-side, t + 1) the products with odd harmonics stay equal; the products with even
    # harmonics change sign.
    waves = [wave(np.pi * order * t) for order in (1, 2) for wave in (np.cos, np.sin)]
    parts = [*(signed * wave for wave in waves), signed + speed, contact_duration * speed]
    return np.stack([np.nansum(part, axis=-1) for part in parts], axis=-1)
