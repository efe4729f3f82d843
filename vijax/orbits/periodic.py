"""Periodic orbits, stable and unstable: the record, Newton from guesses, and the proof by the impact map."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from vijax.batch.impact_map import Next, next_impacts
from vijax.engine.ground import Ground, ground_of
from vijax.model import flow
from vijax.model.pair import ImpactPair, check_pair
from vijax.model.records import Status, WithStatus
from vijax.orbits import contacts, multipliers, repetition, shooting
from vijax.orbits.grazing import Clearance, between
from vijax.orbits.shooting import Sequence
from vijax.runtime import checks, context, tiles
from vijax.runtime.arrays import AnyArray
from vijax.runtime.context import door
from vijax.runtime.programs import begin, jitted
from vijax.runtime.xla import each

_TOUCH = 1e-6  # least speed of an impact: slower ones are those of a motion that just touches the wall
# How closely the impact map must meet the next impact of a real orbit, in time, speed and duration together; marks of
# orbits that agree so closely are of one. Rounding of a flight is far below; nearer orbits than this are where two of
# them are born.
SAME = 1e-6
TILES = (32, 256, 1024, 4096)  # orbits of one compiled call
_SMALL = 256  # so many cost little more than a few

T = TypeVar("T")


class Orbit(WithStatus):
    """Periodic orbits, one along the leading axis; impacts along the last, padded with side 0 and NaN.

    Attributes:
        pair: Parameters.
        sequence: Walls met, and how the orbit closes; see `shooting.Sequence`.
        knots: Onset time, speed into the wall and contact time of each impact; NaN where no orbit was found.
        depth, work: Largest penetration and energy given to the membrane (per unit mass) of each impact; NaN unless OK.
        multipliers: Floquet multipliers of the full orbit, larger modulus first.
        residual: Largest violation of the equations; inf where no orbit was found.
        status: OK; VIRTUAL: the equations hold but the ball would meet a wall in between; NO_ORBIT.
    """

    pair: ImpactPair
    sequence: Sequence
    knots: Float[AnyArray, "orbit impact 3"]
    depth: Float[AnyArray, "orbit impact"]
    work: Float[AnyArray, "orbit impact"]
    multipliers: Complex[AnyArray, "orbit 2"]
    residual: Float[AnyArray, " orbit"]
    status: Int[AnyArray, " orbit"]

    @property
    def count(self) -> Int[AnyArray, " orbit"]:
        """Count the impacts until it closes (half of all where it closes onto its mirror image)."""
        return self.sequence.real.sum(axis=-1, dtype=jnp.int32)

    @door
    def __getitem__(self, index: Any) -> "Orbit":
        """Pick some of the orbits, by an index array, a mask or a slice."""
        # Not by JAX, which compiles a program for every slice and every number of orbits.
        return tiles.arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[index], self))

    def __len__(self) -> int:
        return self.knots.shape[0]


def check_orbit(orbit: Any) -> Orbit:
    """Pass the orbits, if they are some, along a leading axis.

    Raises:
        ValueError: Anything else; a single one without its axis, too.
    """
    made = "vijax.orbits.orbit_search.search(pair, impacts)"
    if np.ndim(checks.known("orbit", checks.instance("orbit", orbit, Orbit, made)).knots) != 3:
        raise ValueError(f"orbit must keep its leading axis; got knots of shape {np.shape(orbit.knots)}; take [0:1]")
    return orbit


@door
def solve(pair: ImpactPair, sequence: Sequence, knots: Float[AnyArray, "orbit impact 3"]) -> Orbit:
    """Find the periodic orbits near some guesses, thousands in one call, on every core.

    Args:
        pair: One cell an orbit.
        sequence, knots: Guesses; padded impacts hold anything.

    Returns:
        Orbits in the order of the guesses, each with its `status`, at its least period (`to_least_period`).
    """
    checks.known("pair", check_pair(pair, of_orbit=True))
    checks.instance("sequence", sequence, Sequence, "vijax.orbits.shooting.Sequence(...)")
    if np.shape(pair.d) != np.shape(sequence.side)[:1]:
        raise ValueError(f"pair must be one cell an orbit; got shape {np.shape(pair.d)}; impact_pair broadcasts")
    if checks.numbers("knots", knots).shape != (*np.shape(sequence.side), 3) or np.ndim(knots) != 3:
        raise ValueError(f"knots must have the shape (orbit, impact, 3) of sequence.side; got {np.shape(knots)}")
    return solved(pair, sequence, knots)


def solved(pair: ImpactPair, sequence: Sequence, knots: Any) -> Orbit:
    """Do what `solve` does, with arguments that are known to be right."""
    return to_least_period(judged(pair, sequence, shot(pair, sequence, knots)))


def shot(pair: ImpactPair, sequence: Sequence, knots: Any) -> "Claim":
    """Do Newton's part of `solved` alone."""
    return _by_tiles(lambda rows: _shoot(*rows), (pair, sequence, knots))


def guessed(side: np.ndarray, span: np.ndarray, mirrored: np.ndarray, knots: np.ndarray) -> tuple[Sequence, Array]:
    """Make sequences and knots as `solve` takes them."""
    *walls, near = tiles.arrays((side, span, mirrored, knots))
    return Sequence(*walls), near


@door
def proven(pair: ImpactPair, sequence: Sequence, knots: Float[AnyArray, "orbit impact 3"]) -> Orbit:
    """Make orbits of knots that solve the equations already, even where Newton is singular: points of a branch."""
    return judged(pair, sequence, _by_tiles(lambda rows: _measured(*rows), (pair, sequence, knots)))


def begin_judgement(pair: ImpactPair, sequence: Sequence, knots: Any) -> None:
    """Begin to compile what judges a few claims of orbits like these: their numbers do not matter."""
    pair, sequence, knots = _first_row(pair, sequence, knots)
    t = knots[..., 0]
    departure = shooting.Departure(*[np.ones_like(t)] * len(shooting.Departure._fields))
    multipliers: Any = np.zeros((1, 2), complex)
    begin(judged, pair, sequence, Claim(knots, t[:, 0], multipliers, departure, t, t))


def begin_proofs(pair: ImpactPair, sequence: Sequence, knots: Any) -> None:
    """Begin to compile what `proven` needs for a few orbits like these."""
    begin(proven, *_first_row(pair, sequence, knots))


def _first_row(*rows: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:1], rows)


def judged(pair: ImpactPair, sequence: Sequence, claim: "Claim") -> Orbit:
    """Prove claims by the impact map, or say what they lack.

    It knows linear membranes and the sine alone: claims of others are judged by what lies between their impacts.
    """
    if pair.law is not None or pair.waves is not None:
        return _by_tiles(_prove_between, (pair, sequence, claim))
    return _by_tiles(partial(_prove, ground_of(pair.gamma)), (pair, sequence, claim))


@door
def to_least_period(orbit: Orbit) -> Orbit:
    """Return each orbit at its least period: where it consists of several equal turns, one turn, solved for anew.

    Turns are equal where they agree to the accuracy of the orbit (`repetition.apart`). A symmetric orbit stays as it is
    closed, in full or onto its mirror image: symmetry is a property of an orbit and does not change its period.
    """
    host = jax.tree.map(np.asarray, check_orbit(orbit))
    near = repetition.turns(host.sequence, host.knots, repetition.most_apart(host.residual))
    rows = np.flatnonzero(near > 1)
    if not rows.size:
        return orbit
    some = jax.tree.map(lambda leaf: leaf[rows], host)
    accuracy = repetition.apart(some.pair, some.sequence, some.knots, some.residual)
    number = repetition.turns(some.sequence, some.knots, accuracy)
    turn = jax.tree.map(np.asarray, widened(mean_turn(some, number), host.knots.shape[1]))
    # The turn must be an orbit as the whole is, and the whole that turn again and again.
    again = np.where(turn.sequence.real[..., None], turn.knots - some.knots, 0.0)
    same = (number > 1) & (turn.status == some.status) & (np.abs(again[..., 1:]).max(axis=(1, 2)) < accuracy)
    return tiles.arrays(jax.tree.map(lambda old, new: tiles.replaced(rows[same], old, new[same]), host, turn))


def mean_turn(orbit: Orbit, number: Int[np.ndarray, " orbit"]) -> Orbit:
    """Solve for one turn of orbits that consist of so many equal turns, from the mean of these."""
    host = jax.tree.map(np.asarray, orbit)
    sequence, guess = guessed(*repetition.mean_turn(host.sequence, host.knots, number))
    return judged(host.pair, sequence, shot(host.pair, sequence, guess))


@door
def concatenate(found: list[T]) -> T:
    """Join orbits of one number of impacts, or claims to be some, to one batch."""
    return tiles.arrays(jax.tree.map(lambda *leaves: np.concatenate(leaves), *found))


def widened(orbit: Orbit, width: int) -> Orbit:
    """Pad orbits to so many impacts at least."""
    host = jax.tree.map(np.asarray, orbit)
    more = ((0, 0), (0, max(width - host.knots.shape[1], 0)))

    def wide(leaf: Any) -> Any:
        return np.pad(leaf, more + ((0, 0),) * (leaf.ndim - 2), constant_values=np.nan if leaf.dtype.kind == "f" else 0)

    names = ("knots", "depth", "work")
    sequence = replace(host.sequence, side=wide(host.sequence.side))
    return tiles.arrays(replace(host, sequence=sequence, **{name: wide(getattr(host, name)) for name in names}))


def _by_tiles(work: Callable[[Any], T], rows: Any) -> T:
    """Do the work on every row, in padded tiles of few sizes so that few programs are compiled, a thread a core."""
    # Rows are cut and joined by numpy: an eager JAX operation costs more than what it does to a tile.
    rows = jax.tree.map(np.asarray, rows)

    def part(tile: tiles.Tile) -> T:
        found: Any = work(jax.tree.map(lambda leaf: leaf[tile.rows], rows))
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: tile.real], found)

    count, cores = jax.tree.leaves(rows)[0].shape[0], tiles.workers()
    # No core is left without a tile for the sake of a larger one.
    sizes = tuple(size for size in TILES if size <= _SMALL or size * cores <= count)
    with context.pool(cores) as pool:
        found = list(pool.map(part, tiles.tiles(count, sizes)))
    return concatenate(found)


class Claim(NamedTuple):
    """Knots that are to be an orbit's, and where the ball is to fly from the end of every contact."""

    knots: Float[AnyArray, "orbit impact 3"]
    residual: Float[AnyArray, " orbit"]
    multipliers: Complex[AnyArray, "orbit 2"]
    departure: shooting.Departure
    phase: Float[AnyArray, "orbit impact"]
    periods: Float[AnyArray, "orbit impact"]


@jitted
def _shoot(pair: ImpactPair, sequence: Sequence, guess: Float[AnyArray, "orbit impact 3"]) -> Claim:
    knots, residual, departure = shooting.newton(pair, sequence, guess)
    touches = (sequence.real & (knots[..., 1] < _TOUCH)).any(axis=1)
    return _claim(pair, sequence, knots, jnp.where(touches, jnp.inf, residual), departure)


@jitted
def _measured(pair: ImpactPair, sequence: Sequence, knots: Float[AnyArray, "orbit impact 3"]) -> Claim:
    return _claim(pair, sequence, knots, *shooting.measured(pair, sequence, knots))


def _claim(
    pair: ImpactPair, sequence: Sequence, knots, residual: Float[AnyArray, " orbit"], departure: shooting.Departure
) -> Claim:
    around = jax.vmap(multipliers.monodromy)(pair, sequence, knots)
    return Claim(
        knots, residual, multipliers.floquet(around, sequence.mirrored), departure, *flow.wrap_phase(departure.t)
    )


def _prove(ground: Ground, rows: tuple) -> Orbit:
    """Fly from the end of every contact: the impact map must meet the next impact, and end its contact in time."""
    pair, sequence, claim = rows
    shape = sequence.side.shape
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf[:, None], shape), pair)
    balls = (wide, claim.departure.side, claim.departure.speed, claim.phase)
    flown = next_impacts(*jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1), balls), ground=ground)
    return _judged(pair, sequence, claim, jax.tree.map(lambda leaf: leaf.reshape(shape), flown))


@jitted
def _prove_between(rows: tuple) -> Orbit:
    """Judge claims by their turning points, between which nothing can happen."""
    pair, sequence, claim = rows
    clearance, depth, work = jax.vmap(_between)(pair, sequence, claim.knots, claim.departure)
    found = (claim.residual < SAME) & sequence.real.any(axis=1)
    verified = found & (jnp.stack(clearance).min(axis=0) > 0)
    return _as_orbits(pair, sequence, claim, found, verified, depth, work)


def _between(
    pair: ImpactPair, sequence: Sequence, knots: shooting.Knots, departure: shooting.Departure
) -> tuple[Clearance, Any, Any]:
    """Find the clearances of one claim, and depth and work of each impact."""
    motion = between(pair, sequence, knots, departure)
    out = -departure.side * departure.speed
    given = each(partial(contacts.given, pair))(departure.side, knots, out, jnp.nan_to_num(motion.deepest))
    return motion.clearance, *given


@jitted
def _judged(pair: ImpactPair, sequence: Sequence, claim: Claim, flown: Next) -> Orbit:
    """Judge the claims by what the flights say of them."""
    real, departure = sequence.real, claim.departure
    found = jnp.isfinite(claim.residual) & real.any(axis=1)

    def meets(side, t, speed, stay):
        miss = jnp.abs(flown.t + 2 * claim.periods - t) + jnp.abs(flown.side * flown.v_in - speed)
        return flown.real & (flown.side == side) & (miss + jnp.abs(flown.duration - stay) < SAME)

    ahead = departure.next_side, departure.next_t, departure.next_speed, departure.next_stay
    # Rounding decides whether a ball meets the wall that it just touches, or flies by to the impact after it.
    by = (departure.next_speed == 0) & meets(*(jnp.roll(one, -1, axis=1) for one in ahead))
    verified = found & (meets(*ahead) | by | ~real).all(axis=1)
    # What was flown to is the impact after each.
    place = jnp.arange(real.shape[1], dtype=jnp.int32)
    before = jnp.where(place == 0, real.sum(axis=1, dtype=jnp.int32)[:, None] - 1, place - 1)
    depth, work = (jnp.take_along_axis(jnp.where(by, 0.0, x), before, axis=1) for x in (flown.depth, flown.work))
    return _as_orbits(pair, sequence, claim, found, verified, depth, work)


def _as_orbits(pair: ImpactPair, sequence: Sequence, claim: Claim, found, verified, depth, work) -> Orbit:
    """Make the records of claims, by which of them an orbit was found, and which was verified."""
    status = jnp.where(verified, Status.OK, jnp.where(found, Status.VIRTUAL, Status.NO_ORBIT)).astype(jnp.int32)
    good = verified[:, None] & sequence.real
    # The first impact is put into the first period.
    knots = claim.knots.at[..., 0].add(-2 * jnp.floor(0.5 * claim.knots[:, :1, 0]))
    return Orbit(
        pair=pair,
        sequence=sequence,
        knots=jnp.where((sequence.real & found[:, None])[..., None], knots, jnp.nan),
        depth=jnp.where(good, depth, jnp.nan),
        work=jnp.where(good, work, jnp.nan),
        multipliers=jnp.where(found[:, None], claim.multipliers, jnp.nan),
        residual=claim.residual,
        status=status,
    )
