"""Periodic orbits, stable and unstable: the record, Newton's method from guesses, and verification by the impact map.

A guess of the impact unknowns becomes a candidate by Newton's method on the shooting equations. The equations do not
exclude additional impacts between these impacts. The impact map therefore verifies each candidate: from the end of
every contact it must reach the next impact.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from vijax.impact.gravity_regime import GravityRegime, gravity_regime_of
from vijax.model import flow
from vijax.model.pair import ImpactPair, check_pair
from vijax.model.records import Status, WithStatus
from vijax.orbits import contacts, multipliers, repetition, shooting
from vijax.orbits.clearances import Clearance, interior_motion
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles, validation
from vijax.runtime.arrays import AnyArray
from vijax.runtime.compilation.programs import jitted, start_compilation
from vijax.runtime.compilation.xla import map_lanes
from vijax.runtime.public_api import pool, public_api
from vijax.simulation.impact_map import NextImpact, next_impacts

_LEAST_SPEED = 1e-6  # least speed of an impact; a slower one belongs to a motion that only touches the wall
# Tolerance of the verification: largest sum of the deviations in time, speed and duration between the next impact by
# the impact map and by the equations. Orbits with an `orbit_properties.orbit_signature` this close count as one orbit.
# The rounding error of a flight is far smaller; two distinct orbits are this close only next to the bifurcation that
# creates them.
VERIFICATION_TOLERANCE = 1e-6
TILES = (32, 256, 1024, 4096)  # numbers of orbits in one compiled call
_SMALL_TILE = 256  # up to this size, a tile that is mostly padding costs little more than a few orbits

T = TypeVar("T")


class Orbit(WithStatus):
    """Periodic orbits, one along the leading axis; impacts along the last, padded with side 0 and NaN.

    Attributes:
        pair: Parameters.
        sequence: The walls of the impacts, and how the orbit closes; see `shooting.Sequence`.
        impact_unknowns: Onset time, speed into the wall and contact duration of each impact; NaN where no orbit was
            found.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each impact; NaN unless the
            status is OK.
        multipliers: Floquet multipliers of the full orbit, larger modulus first.
        residual: Largest absolute residual of the shooting equations; inf where no orbit was found.
        status: OK; VIRTUAL: the equations hold but the ball would hit a wall between two impacts; NO_ORBIT.
    """

    pair: ImpactPair
    sequence: Sequence
    impact_unknowns: Float[AnyArray, "orbit impact 3"]
    depth: Float[AnyArray, "orbit impact"]
    work: Float[AnyArray, "orbit impact"]
    multipliers: Complex[AnyArray, "orbit 2"]
    residual: Float[AnyArray, " orbit"]
    status: Int[AnyArray, " orbit"]

    @property
    def count(self) -> Int[AnyArray, " orbit"]:
        """Number of impacts in the stored part of the orbit (one period, or the first half of a symmetric orbit)."""
        return self.sequence.real.sum(axis=-1, dtype=jnp.int32)

    @public_api
    def __getitem__(self, index: Any) -> "Orbit":
        """Select orbits by an index array, a mask or a slice."""
        # NumPy selects, because JAX would compile a program for every slice and every number of orbits.
        return tiles.arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[index], self))

    def __len__(self) -> int:
        return self.impact_unknowns.shape[0]


def check_orbit(orbit: Any) -> Orbit:
    """Return the orbits if they are an `Orbit` with a leading axis.

    Raises:
        ValueError: For anything else, also for a single orbit without its axis.
    """
    made = "vijax.find_orbits(pair, impacts)"
    if (
        np.ndim(
            validation.validate_untraced(
                "orbit", validation.validate_instance("orbit", orbit, Orbit, made)
            ).impact_unknowns
        )
        != 3
    ):
        raise ValueError(f"orbit must keep its leading axis; got shape {np.shape(orbit.impact_unknowns)}; take [0:1]")
    return orbit


@public_api
def solve(pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[AnyArray, "orbit impact 3"]) -> Orbit:
    """Find the periodic orbits near guesses, thousands in one call, on every core.

    Args:
        pair: One cell for each orbit.
        sequence, impact_unknowns: Guesses; values of padded impacts are ignored.

    Returns:
        Orbits in the order of the guesses, each with its `status`, at its least period (`to_least_period`).
    """
    validation.validate_untraced("pair", check_pair(pair, of_orbit=True))
    validation.validate_instance("sequence", sequence, Sequence, "vijax.orbits.shooting.Sequence(...)")
    if np.shape(pair.d) != np.shape(sequence.side)[:1]:
        raise ValueError(f"pair must be one cell an orbit; got shape {np.shape(pair.d)}; impact_pair broadcasts")
    if (
        validation.validate_numbers("impact_unknowns", impact_unknowns).shape != (*np.shape(sequence.side), 3)
        or np.ndim(impact_unknowns) != 3
    ):
        raise ValueError(
            f"impact_unknowns must have the shape (orbit, impact, 3) of sequence.side; got {np.shape(impact_unknowns)}"
        )
    return solve_validated(pair, sequence, impact_unknowns)


def solve_validated(pair: ImpactPair, sequence: Sequence, impact_unknowns: Any) -> Orbit:
    """Do the work of `solve` on validated arguments."""
    return to_least_period(verify(pair, sequence, newton_solve(pair, sequence, impact_unknowns)))


def newton_solve(pair: ImpactPair, sequence: Sequence, impact_unknowns: Any) -> "UnverifiedOrbits":
    """Run Newton's method of `solve` alone; the candidates are not verified."""
    return _by_tiles(lambda rows: _newton_candidates(*rows), (pair, sequence, impact_unknowns))


def make_guess(
    side: np.ndarray, span: np.ndarray, mirrored: np.ndarray, impact_unknowns: np.ndarray
) -> tuple[Sequence, Array]:
    """Return sequences and impact unknowns in the form of the arguments of `solve`."""
    *walls, near = tiles.arrays((side, span, mirrored, impact_unknowns))
    return Sequence(*walls), near


@public_api
def verify_solutions(pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[AnyArray, "orbit impact 3"]) -> Orbit:
    """Verify impact unknowns that already solve the equations, and return them as orbits.

    Newton's method does not run, so that orbits at a bifurcation, where its matrix is singular, remain unchanged.
    """
    return verify(
        pair, sequence, _by_tiles(lambda rows: _measured_candidates(*rows), (pair, sequence, impact_unknowns))
    )


def begin_compiling_verification(pair: ImpactPair, sequence: Sequence, impact_unknowns: Any) -> None:
    """Compile the verification for a few candidates of this shape in the background; only shapes and dtypes matter."""
    pair, sequence, impact_unknowns = _first_row(pair, sequence, impact_unknowns)
    t = impact_unknowns[..., 0]
    # Placeholder arrays with the right shapes and dtypes.
    exits = shooting.ContactExits(*[np.ones_like(t)] * len(shooting.ContactExits._fields))
    multipliers: Any = np.zeros((1, 2), complex)
    start_compilation(verify, pair, sequence, UnverifiedOrbits(impact_unknowns, t[:, 0], multipliers, exits, t, t))


def begin_compiling_verify_solutions(pair: ImpactPair, sequence: Sequence, impact_unknowns: Any) -> None:
    """Start to compile `verify_solutions` in the background, for the smallest batch of orbits with these shapes."""
    start_compilation(verify_solutions, *_first_row(pair, sequence, impact_unknowns))


def _first_row(*rows: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:1], rows)


def verify(pair: ImpactPair, sequence: Sequence, candidates: "UnverifiedOrbits") -> Orbit:
    """Verify candidates by the impact map, and return them as orbits with their status.

    The impact map supports linear membranes under the sine only. Candidates with a membrane law or harmonics are
    verified by the distance to the walls at their turning points.
    """
    if pair.law is not None or pair.waves is not None:
        return _by_tiles(_verify_by_clearances, (pair, sequence, candidates))
    return _by_tiles(partial(_verify_by_impact_map, gravity_regime_of(pair.gamma)), (pair, sequence, candidates))


@public_api
def to_least_period(orbit: Orbit) -> Orbit:
    """Return each orbit at its least period: an orbit of several equal repetitions is solved again as one of them.

    Repetitions are equal if they agree to the accuracy of the orbit (`repetition.difference_bound`). A symmetric orbit
    remains stored as given, in full or as half a period with `mirrored`, because symmetry does not change its period.
    """
    host = jax.tree.map(np.asarray, check_orbit(orbit))
    # The cheap bound comes first, because the accurate one needs a singular value decomposition per orbit.
    rough_number = repetition.count_repetitions(
        host.sequence, host.impact_unknowns, repetition.residual_bound(host.residual)
    )
    rows = np.flatnonzero(rough_number > 1)
    if not rows.size:
        return orbit
    repeated = jax.tree.map(lambda leaf: leaf[rows], host)
    # Only orbits that may be repetitions get the accurate bound.
    accuracy = repetition.difference_bound(
        repeated.pair, repeated.sequence, repeated.impact_unknowns, repeated.residual
    )
    repetitions = repetition.count_repetitions(repeated.sequence, repeated.impact_unknowns, accuracy)
    single = jax.tree.map(
        np.asarray, pad_orbits(solve_mean_repetition(repeated, repetitions), host.impact_unknowns.shape[1])
    )
    # The repetition must have the status of the whole orbit, and the speeds and durations of its first impacts.
    difference = np.where(single.sequence.real[..., None], single.impact_unknowns - repeated.impact_unknowns, 0.0)
    is_same = (
        (repetitions > 1)
        & (single.status == repeated.status)
        & (np.abs(difference[..., 1:]).max(axis=(1, 2)) < accuracy)
    )
    return tiles.arrays(
        jax.tree.map(lambda old, new: tiles.with_replaced_rows(rows[is_same], old, new[is_same]), host, single)
    )


def solve_mean_repetition(orbit: Orbit, repetitions: Int[np.ndarray, " orbit"]) -> Orbit:
    """Solve for the single orbit that each orbit contains `repetitions` times; the guess is the mean repetition."""
    host = jax.tree.map(np.asarray, orbit)
    sequence, guess = make_guess(*repetition.mean_repetition(host.sequence, host.impact_unknowns, repetitions))
    return verify(host.pair, sequence, newton_solve(host.pair, sequence, guess))


@public_api
def concatenate(batches: list[T]) -> T:
    """Join orbits, or candidates, with the same number of impacts into one batch."""
    return tiles.arrays(jax.tree.map(lambda *leaves: np.concatenate(leaves), *batches))


def pad_orbits(orbit: Orbit, width: int) -> Orbit:
    """Pad orbits to at least `width` impacts."""
    host = jax.tree.map(np.asarray, orbit)
    padding = ((0, 0), (0, max(width - host.impact_unknowns.shape[1], 0)))

    def wide(leaf: Any) -> Any:
        return np.pad(
            leaf, padding + ((0, 0),) * (leaf.ndim - 2), constant_values=np.nan if leaf.dtype.kind == "f" else 0
        )

    names = ("impact_unknowns", "depth", "work")
    sequence = replace(host.sequence, side=wide(host.sequence.side))
    return tiles.arrays(replace(host, sequence=sequence, **{name: wide(getattr(host, name)) for name in names}))


def _by_tiles(work: Callable[[Any], T], rows: Any) -> T:
    """Apply a function to all rows in padded tiles, one thread per core; tiles of few sizes need few programs."""
    # NumPy splits and joins the rows, because an eager JAX operation costs more than the computation on a tile.
    rows = jax.tree.map(np.asarray, rows)

    def part(tile: tiles.Tile) -> T:
        results: Any = work(jax.tree.map(lambda leaf: leaf[tile.rows], rows))
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: tile.real], results)

    count, cores = jax.tree.leaves(rows)[0].shape[0], tiles.workers()
    # A larger tile size is used only if every core still gets a tile.
    sizes = tuple(size for size in TILES if size <= _SMALL_TILE or size * cores <= count)
    with pool(cores) as threads:
        results = list(threads.map(part, tiles.tiles(count, sizes)))
    return concatenate(results)


class UnverifiedOrbits(NamedTuple):
    """Candidates for orbits before verification: impact unknowns, and the state at the end of every contact.

    Attributes:
        impact_unknowns: Impact unknowns.
        residual: Largest absolute residual of the shooting equations; inf if Newton's method did not converge.
        multipliers: Floquet multipliers, larger modulus first.
        exits: State at the end of every contact, and the next impact by the equations.
        phase, periods: Time of the end of every contact, as a phase in [0, 2) and a number of forcing periods.
    """

    impact_unknowns: Float[AnyArray, "orbit impact 3"]
    residual: Float[AnyArray, " orbit"]
    multipliers: Complex[AnyArray, "orbit 2"]
    exits: shooting.ContactExits
    phase: Float[AnyArray, "orbit impact"]
    periods: Float[AnyArray, "orbit impact"]


@jitted
def _newton_candidates(
    pair: ImpactPair, sequence: Sequence, guess: Float[AnyArray, "orbit impact 3"]
) -> UnverifiedOrbits:
    impact_unknowns, residual, exits = shooting.newton(pair, sequence, guess)
    # A ball slower than `_LEAST_SPEED` only touches the wall, so that the candidate counts as not converged.
    has_grazing = (sequence.real & (impact_unknowns[..., 1] < _LEAST_SPEED)).any(axis=1)
    return _candidates(pair, sequence, impact_unknowns, jnp.where(has_grazing, jnp.inf, residual), exits)


@jitted
def _measured_candidates(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: Float[AnyArray, "orbit impact 3"]
) -> UnverifiedOrbits:
    return _candidates(pair, sequence, impact_unknowns, *shooting.measure_residuals(pair, sequence, impact_unknowns))


def _candidates(
    pair: ImpactPair,
    sequence: Sequence,
    impact_unknowns,
    residual: Float[AnyArray, " orbit"],
    exits: shooting.ContactExits,
) -> UnverifiedOrbits:
    around = jax.vmap(multipliers.monodromy)(pair, sequence, impact_unknowns)
    return UnverifiedOrbits(
        impact_unknowns, residual, multipliers.floquet(around, sequence.mirrored), exits, *flow.wrap_phase(exits.t)
    )


def _verify_by_impact_map(gravity_regime: GravityRegime, rows: tuple) -> Orbit:
    """Verify candidates by the impact map.

    From the end of every contact the impact map must reach the next impact, with its contact duration.
    """
    pair, sequence, candidates = rows
    shape = sequence.side.shape
    # One call of the impact map for all impacts of all orbits, flattened.
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf[:, None], shape), pair)
    states = (wide, candidates.exits.side, candidates.exits.speed, candidates.phase)
    hits = next_impacts(*jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1), states), gravity_regime=gravity_regime)
    return _verify_impacts(pair, sequence, candidates, jax.tree.map(lambda leaf: leaf.reshape(shape), hits))


@jitted
def _verify_by_clearances(rows: tuple) -> Orbit:
    """Verify candidates: no turning point between their impacts may lie beyond a wall."""
    pair, sequence, candidates = rows
    clearance, depth, work = jax.vmap(_interior)(pair, sequence, candidates.impact_unknowns, candidates.exits)
    converged = (candidates.residual < VERIFICATION_TOLERANCE) & sequence.real.any(axis=1)
    verified = converged & (jnp.stack(clearance).min(axis=0) > 0)
    return _as_orbits(pair, sequence, candidates, converged, verified, depth, work)


def _interior(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: shooting.ImpactUnknowns, exits: shooting.ContactExits
) -> tuple[Clearance, Any, Any]:
    """Compute the clearances of one candidate, and depth and work of each impact."""
    motion = interior_motion(pair, sequence, impact_unknowns, exits)
    out = -exits.side * exits.speed
    depth_and_work = map_lanes(partial(contacts.depth_and_work, pair))(
        exits.side, impact_unknowns, out, jnp.nan_to_num(motion.deepest)
    )
    return motion.clearance, *depth_and_work


@jitted
def _verify_impacts(pair: ImpactPair, sequence: Sequence, candidates: UnverifiedOrbits, hits: NextImpact) -> Orbit:
    """Verify candidates by the results of the impact map."""
    real, exits = sequence.real, candidates.exits
    converged = jnp.isfinite(candidates.residual) & real.any(axis=1)

    def reaches(side, t, speed, contact_duration):
        # The impact map starts from the phase of the exit; `periods` restores the clock of the orbit.
        miss = jnp.abs(hits.t + 2 * candidates.periods - t) + jnp.abs(hits.side * hits.v_in - speed)
        return (
            hits.real
            & (hits.side == side)
            & (miss + jnp.abs(hits.duration - contact_duration) < VERIFICATION_TOLERANCE)
        )

    # The next impact by the equations; `jnp.roll` below shifts it to the impact after that.
    ahead = exits.next_side, exits.next_t, exits.next_speed, exits.next_contact_duration
    # At a grazing, rounding decides whether the ball hits the wall or passes it and reaches the impact after
    # it. Both results are accepted.
    passes = (exits.next_speed == 0) & reaches(*(jnp.roll(field, -1, axis=1) for field in ahead))
    verified = converged & (reaches(*ahead) | passes | ~real).all(axis=1)
    # Entry k of `hits` is the impact after impact k; `before` moves its depth and work to their own impact.
    place = jnp.arange(real.shape[1], dtype=jnp.int32)
    before = jnp.where(place == 0, real.sum(axis=1, dtype=jnp.int32)[:, None] - 1, place - 1)
    depth, work = (jnp.take_along_axis(jnp.where(passes, 0.0, x), before, axis=1) for x in (hits.depth, hits.work))
    return _as_orbits(pair, sequence, candidates, converged, verified, depth, work)


def _as_orbits(
    pair: ImpactPair, sequence: Sequence, candidates: UnverifiedOrbits, converged, verified, depth, work
) -> Orbit:
    """Make the orbit records of candidates from the masks of converged and of verified candidates."""
    status = jnp.where(verified, Status.OK, jnp.where(converged, Status.VIRTUAL, Status.NO_ORBIT)).astype(jnp.int32)
    # Depth and work exist on verified orbits only; unknowns and multipliers also on virtual ones.
    good = verified[:, None] & sequence.real
    # Shift by whole periods so that the first impact lies in [0, 2).
    impact_unknowns = candidates.impact_unknowns.at[..., 0].add(
        -2 * jnp.floor(0.5 * candidates.impact_unknowns[:, :1, 0])
    )
    return Orbit(
        pair=pair,
        sequence=sequence,
        impact_unknowns=jnp.where((sequence.real & converged[:, None])[..., None], impact_unknowns, jnp.nan),
        depth=jnp.where(good, depth, jnp.nan),
        work=jnp.where(good, work, jnp.nan),
        multipliers=jnp.where(converged[:, None], candidates.multipliers, jnp.nan),
        residual=candidates.residual,
        status=status,
    )
