"""Periodic orbits, stable and unstable: from states or impact sequences, by Newton, each verified by the impact map."""

import itertools
import math
import re
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Int

from vijax.batch.impact_map import Next, next_impacts
from vijax.batch.trajectory import trajectory
from vijax.model import flow
from vijax.model.device import Harvester, check_device
from vijax.model.energy import harvested_energy
from vijax.model.label import label
from vijax.model.pair import ImpactPair, check_pair, check_start
from vijax.model.records import Impact, Status, WithStatus
from vijax.orbits import shooting
from vijax.orbits.motion import MOST_SAMPLES, pieces
from vijax.orbits.shooting import Sequence
from vijax.runtime import checks, context, tiles, xla
from vijax.runtime.context import door

_TOUCH = 1e-6  # least speed of an impact: slower ones are those of a motion that just touches the wall
_SAME = 1e-6  # how closely the impact map must meet the next impact of a real orbit
_FASTEST = 1.5  # largest speed of a guess, in units of A pi/omega
_TILES = (32, 256, 4096)  # orbits of one compiled call
_MOST_PERIOD = 1000  # forcing periods of an orbit
# A text may ask for so many impacts and sequences, and all sequences together for so many guesses.
_MOST_IMPACTS, _MOST_SEQUENCES, _MOST_GUESSES = 64, 10_000, 10**7


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
    knots: Float[Array, "orbit impact 3"]
    depth: Float[Array, "orbit impact"]
    work: Float[Array, "orbit impact"]
    multipliers: Complex[Array, "orbit 2"]
    residual: Float[Array, "orbit"]
    status: Int[Array, "orbit"]

    @property
    def count(self) -> Int[Array, "orbit"]:
        """Impacts until it closes (half of all where it closes onto its mirror image)."""
        return self.sequence.real.sum(axis=-1, dtype=jnp.int32)

    @door
    def __getitem__(self, index: Any) -> "Orbit":
        """Some of the orbits, by an index array, a mask or a slice."""
        # Not by JAX, which compiles a program for every slice and every number of orbits.
        return tiles.arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[index], self))

    def __len__(self) -> int:
        return self.knots.shape[0]


@door
def solve(pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]) -> Orbit:
    """The periodic orbits near some guesses, thousands in one call, on every core.

    Args:
        pair: One cell an orbit.
        sequence, knots: Guesses; padded impacts hold anything.

    Returns:
        Orbits in the order of the guesses, each with its `status`.
    """
    checks.known("pair", check_pair(pair))
    checks.instance("sequence", sequence, Sequence, "vijax.orbits.shooting.Sequence(...)")
    if np.shape(pair.d) != np.shape(sequence.side)[:1]:
        raise ValueError(f"pair must be one cell an orbit; got shape {np.shape(pair.d)}; impact_pair broadcasts")
    if checks.numbers("knots", knots).shape != (*np.shape(sequence.side), 3) or np.ndim(knots) != 3:
        raise ValueError(f"knots must have the shape (orbit, impact, 3) of sequence.side; got {np.shape(knots)}")
    return _solved(pair, sequence, knots)


def _solved(pair: ImpactPair, sequence: Sequence, knots: Any) -> Orbit:
    return _by_tiles(partial(_tile, _compiled(_shoot), _level(pair)), (pair, sequence, knots))


def check_orbit(orbit: Any) -> Orbit:
    """The orbits, if they are some, along a leading axis.

    Raises:
        ValueError: Anything else; a single one without its axis, too.
    """
    made = "vijax.orbits.periodic.search(pair, impacts)"
    if np.ndim(checks.known("orbit", checks.instance("orbit", orbit, Orbit, made)).knots) != 3:
        raise ValueError(f"orbit must keep its leading axis; got knots of shape {np.shape(orbit.knots)}; take [0:1]")
    return orbit


def _guess(side: np.ndarray, span: np.ndarray, mirrored: np.ndarray, knots: np.ndarray) -> tuple[Sequence, Array]:
    """Sequences and knots as `solve` takes them."""
    *walls, near = tiles.arrays((side, span, mirrored, knots))
    return Sequence(*walls), near


def _level(pair: ImpactPair) -> bool:
    return bool((np.asarray(pair.gamma) == 0).all())


def _by_tiles(work: Callable[[Any], Orbit], rows: Any) -> Orbit:
    """The work on every row, in padded tiles of few sizes so that few programs are compiled, a thread a core."""
    # Rows are cut and joined by numpy: an eager JAX operation costs more than what it does to a tile.
    rows = jax.tree.map(np.asarray, rows)

    def part(tile: tiles.Tile) -> Orbit:
        found = work(jax.tree.map(lambda leaf: leaf[tile.rows], rows))
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: tile.real], found)

    with context.pool(tiles.workers()) as pool:
        found = list(pool.map(part, tiles.tiles(jax.tree.leaves(rows)[0].shape[0], _TILES)))
    return concatenate(found)


@door
def concatenate(found: list[Orbit]) -> Orbit:
    """Orbits of one number of impacts as one batch."""
    return tiles.arrays(jax.tree.map(lambda *leaves: np.concatenate(leaves), *found))


class _Claim(NamedTuple):
    """Knots that are to be an orbit's, and where the ball is to fly from the end of every contact."""

    knots: Float[Array, "orbit impact 3"]
    residual: Float[Array, "orbit"]
    multipliers: Complex[Array, "orbit 2"]
    passage: shooting.Passage
    phase: Float[Array, "orbit impact"]
    periods: Float[Array, "orbit impact"]


def _shoot(pair: ImpactPair, sequence: Sequence, guess: Float[Array, "orbit impact 3"]) -> _Claim:
    knots, residual = shooting.newton(pair, sequence, guess)
    touches = (sequence.real & (knots[..., 1] < _TOUCH)).any(axis=1)
    return _claim(pair, sequence, knots, jnp.where(touches, jnp.inf, residual))


def _measured(pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]) -> _Claim:
    residual = jnp.abs(jax.vmap(shooting.gap)(pair, sequence, knots)).max(axis=1)
    return _claim(pair, sequence, knots, residual)


def _claim(pair: ImpactPair, sequence: Sequence, knots, residual: Float[Array, "orbit"]) -> _Claim:
    around = jax.vmap(shooting.monodromy)(pair, sequence, knots)
    passage = jax.vmap(shooting.passages)(pair, sequence, knots)
    return _Claim(knots, residual, shooting.floquet(around, sequence.mirrored), passage, *flow.wrap_phase(passage.t))


@door
def proven(pair: ImpactPair, sequence: Sequence, knots: Float[Array, "orbit impact 3"]) -> Orbit:
    """Orbits from knots that solve the equations already, even where Newton is singular: points of a branch."""
    return _by_tiles(partial(_tile, _compiled(_measured), _level(pair)), (pair, sequence, knots))


@lru_cache(maxsize=2)
def _compiled(work: Callable[..., _Claim]) -> Callable[..., _Claim]:
    return jax.jit(work, compiler_options=xla.compiler_options())


def _tile(solved: Callable[..., _Claim], level: bool, rows: tuple) -> Orbit:
    """Fly from the end of every contact: the impact map must meet the next impact, and end its contact in time."""
    pair, sequence, guess = rows
    claim = solved(pair, sequence, guess)
    shape = sequence.side.shape
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf[:, None], shape), pair)
    balls = (wide, claim.passage.side, claim.passage.speed, claim.phase)
    flown = next_impacts(*jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1), balls), level=level)
    return _judged(pair, sequence, claim, jax.tree.map(lambda leaf: leaf.reshape(shape), flown))


@jax.jit
def _judged(pair: ImpactPair, sequence: Sequence, claim: _Claim, flown: Next) -> Orbit:
    """What the flights say of the claims."""
    real, passage = sequence.real, claim.passage
    found = jnp.isfinite(claim.residual) & real.any(axis=1)
    miss = jnp.abs(flown.t + 2 * claim.periods - passage.next_t)
    miss = miss + jnp.abs(flown.side * flown.v_in - passage.next_speed) + jnp.abs(flown.duration - passage.next_stay)
    met = flown.real & (flown.side == passage.next_side) & (miss < _SAME)
    verified = found & (met | ~real).all(axis=1)
    status = jnp.where(verified, Status.OK, jnp.where(found, Status.VIRTUAL, Status.NO_ORBIT)).astype(jnp.int32)
    good = verified[:, None] & real
    # What was flown to is the impact after each.
    place = jnp.arange(real.shape[1], dtype=jnp.int32)
    before = jnp.where(place == 0, real.sum(axis=1, dtype=jnp.int32)[:, None] - 1, place - 1)
    depth, work = (jnp.take_along_axis(leaf, before, axis=1) for leaf in (flown.depth, flown.work))
    # The first impact is put into the first period.
    knots = claim.knots.at[..., 0].add(-2 * jnp.floor(0.5 * claim.knots[:, :1, 0]))
    return Orbit(
        pair=pair,
        sequence=sequence,
        knots=jnp.where((real & found[:, None])[..., None], knots, jnp.nan),
        depth=jnp.where(good, depth, jnp.nan),
        work=jnp.where(good, work, jnp.nan),
        multipliers=jnp.where(found[:, None], claim.multipliers, jnp.nan),
        residual=claim.residual,
        status=status,
    )


@door
def from_state(
    pair: ImpactPair, u: ArrayLike, v: ArrayLike, t: ArrayLike = 0.0, *, period: int = 1, settle: int = 0
) -> Orbit:
    """Periodic orbits near some states: each is flown once around to learn its impacts, then corrected by Newton.

    Args:
        pair: One cell, or one a state.
        u, v, t: Displacements, velocities and phases in [0, 2).
        period: Forcing periods of the orbits.
        settle: Forcing periods that the states are flown first: the guesses are then near attractors.

    Returns:
        One orbit a state, stable or not; NO_ORBIT where Newton found none, or the state meets no wall.

    Raises:
        ValueError: period below 1, settle below 0, or an inadmissible pair or state.
    """
    period, settle = checks.whole("period", period, 1, _MOST_PERIOD), checks.whole("settle", settle, 0)
    checks.known("pair", check_pair(pair))
    given = {"u": u, "v": v, "t": t}
    # By NumPy, as JAX would compile a program for each number of states.
    u, v, t = (np.atleast_1d(np.asarray(checks.finite(name, x), float)) for name, x in given.items())
    shape = checks.shapes(u=u, v=v, t=t, d=pair.d, kappa=0 if pair.kappa is None else pair.kappa, r=pair.r)
    check_start(pair, "u", u)
    pair = jax.tree.map(lambda x: np.broadcast_to(x, shape), pair)
    u, v, t = (np.broadcast_to(x, shape) for x in (u, v, t))
    inside = (t >= 0) & (t < 2)
    if not inside.all():
        raise ValueError(f"t must lie in [0, 2); got {checks.first(t, inside)}")
    lost = np.zeros(shape, bool)
    if settle:
        last = jax.tree.map(lambda x: np.asarray(x)[..., -1], trajectory(pair, u, v, periods=settle, t0=t).states)
        # More impacts than a trajectory has room for: the state is not known.
        lost = ~np.isfinite(last.u + last.v)
        u, v, t = np.where(lost, 0.0, last.u), np.where(lost, 0.0, last.v), np.zeros(shape)
    # Impacts are counted from the first one on: a start may sit on a wall or in a contact.
    found = jax.tree.map(np.asarray, trajectory(pair, u, v, periods=2 * period + 1, t0=t).impacts)
    onset = 2 * found.n + found.t
    around = (onset < onset[:, :1] + 2 * period - _SAME) & ~lost[:, None]
    width = tiles.padded(int(around.sum(axis=1).max(initial=1)))
    side = np.where(around[:, :width], found.side[:, :width], 0)
    knots = np.stack([onset[:, :width], np.abs(found.v_in[:, :width]), found.duration[:, :width]], axis=-1)
    return _solved(pair, *_guess(side, np.full(shape, 2.0 * period), np.zeros(shape, bool), knots))


@door
def search(pair: ImpactPair, impacts: str, period: int | None = None, *, guesses: int = 2048, seed: int = 0) -> Orbit:
    """Every orbit found with a given impact sequence, stable or unstable, from random guesses.

    Args:
        pair: One cell.
        impacts: Walls in order, such as "RLL" (R right, L left), or a label n:m or n:m/pT: n impacts on the left, m on
            the right, in any order.
        period: Forcing periods; 1, or the label's.
        guesses: Random guesses a sequence.
        seed: Of the guesses.

    Returns:
        The distinct orbits, each once.

    Raises:
        ValueError: Neither a sequence nor a label, or a period that does not agree with it.

    Source: Eqs. (28)-(29) ask for one sequence from one guess.
    """
    checks.known("pair", check_pair(pair))
    if any(np.ndim(x) for x in jax.tree.leaves(pair)):
        raise ValueError(f"pair must be one cell; got shape {np.shape(pair.d)}; search each")
    every, period = sequences(impacts, period)
    check_guesses(guesses, len(every))
    draw = np.random.default_rng(checks.seed(seed))
    found = [_search(pair, walls, period, guesses, draw) for walls in every]
    return distinct(concatenate(found))


def check_guesses(guesses: Any, sequences: int) -> None:
    """Raise ValueError unless so many guesses can be tried of each of some sequences."""
    checks.whole("guesses", guesses, 1, _MOST_GUESSES // sequences)


def sequences(impacts: str, period: int | None = None) -> tuple[list[tuple[int, ...]], int]:
    """Cyclically distinct sequences of walls that a text asks for, and the period; see `search`."""
    walls = {"L": -1, "R": 1}
    match = (
        re.fullmatch(r"[LRlr]+|([0-9]+):([0-9]+)(?:/([1-9][0-9]*)T)?", impacts) if isinstance(impacts, str) else None
    )
    if match is None:
        raise ValueError(f"impacts must be walls such as RLL or a label such as 1:2/2T; got {checks.shown(impacts)}")
    period = None if period is None else checks.whole("period", period, 1, _MOST_PERIOD)
    if match[1] is None:
        _check_count(impacts, len(impacts), 1)
        return [tuple(walls[letter] for letter in impacts.upper())], period or 1
    left, right, named = (_number(impacts, digits) for digits in (match[1], match[2], match[3] or "1"))
    _check_count(impacts, left + right, math.comb(left + right, left) if left + right <= _MOST_IMPACTS else 0)
    if period not in (None, named):
        raise ValueError(f"period must agree with the label {impacts}; got {period}")
    places = itertools.combinations(range(left + right), left)
    every = (tuple(-1 if i in lefts else 1 for i in range(left + right)) for lefts in places)
    return sorted({min(walls[i:] + walls[:i] for i in range(len(walls))) for walls in every}), named


def _number(impacts: str, digits: str) -> int:
    """A number of a label; thousands of digits are more than Python takes for one."""
    return checks.whole(f"impacts {checks.shown(impacts)}: each number", int(digits[:10]), 0, _MOST_PERIOD)


def _check_count(impacts: str, count: int, orders: int) -> None:
    """Raise unless so many impacts, in so many orders, can be looked for."""
    if not 1 <= count <= _MOST_IMPACTS or orders > _MOST_SEQUENCES:
        raise ValueError(
            f"impacts must be 1 to {_MOST_IMPACTS}, in at most {_MOST_SEQUENCES:,} orders; "
            f"got {checks.shown(impacts)}; write the walls in their order, as in RLL"
        )


def _search(pair: ImpactPair, walls: tuple[int, ...], period: int, guesses: int, draw: np.random.Generator) -> Orbit:
    """Orbits of one sequence from random guesses: times in any proportion, speeds up to what the forcing can give."""
    count = len(walls)
    gaps = draw.dirichlet(np.ones(count), guesses) * 2 * period
    t = draw.uniform(0, 2, (guesses, 1)) + np.cumsum(gaps, axis=1) - gaps[:, :1]
    speed = draw.uniform(0, _FASTEST, (guesses, count))
    free = np.zeros(()) if pair.kappa is None else np.pi / np.asarray(pair.omega1)
    knots = np.stack([t, speed, np.minimum(free, 0.5 * gaps)], axis=-1)
    wide = jax.tree.map(lambda x: np.broadcast_to(x, guesses), pair)
    side = np.broadcast_to(np.asarray(walls, np.int32), (guesses, count))
    return _solved(wide, *_guess(side, np.full(guesses, 2.0 * period), np.zeros(guesses, bool), knots))


@door
def distinct(orbit: Orbit) -> Orbit:
    """The orbits that are there, each once whichever impact it was begun with."""
    good = np.flatnonzero(np.asarray(check_orbit(orbit).status) == Status.OK)
    rounded = np.round(np.asarray(marks(orbit))[good] / _SAME)
    _, first = np.unique(rounded, axis=0, return_index=True)
    return orbit[np.sort(good[first])]


# What follows asks about orbits in any number: by NumPy, as JAX would compile a program for each number.


@door
def marks(orbit: Orbit) -> Float[np.ndarray, "orbit 6"]:
    """Sums over the impacts that tell orbits of one pair apart, mirror images too."""
    t, speed, stay = np.moveaxis(np.asarray(orbit.knots), -1, 0)
    signed = np.asarray(orbit.sequence.side) * speed
    # Odd harmonics are alike for mirror images, (side, t) -> (-side, t + 1); even ones change sign.
    waves = [wave(np.pi * order * t) for order in (1, 2) for wave in (np.cos, np.sin)]
    parts = [*(signed * wave for wave in waves), signed + speed, stay * speed]
    return np.stack([np.nansum(part, axis=-1) for part in parts], axis=-1)


@door
def symmetric(orbit: Orbit, tolerance: float = 1e-9) -> Bool[np.ndarray, "orbit"]:
    """Whether each orbit, run through once, is its own mirror image half a span later."""
    host, tolerance = jax.tree.map(np.asarray, check_orbit(orbit)), checks.positive("tolerance", tolerance)
    count = host.count
    index = np.arange(host.knots.shape[1])
    half = np.where(index < (count // 2)[:, None], index + (count // 2)[:, None], index)
    wait = np.array([0.5, 0.0, 0.0]) * host.sequence.span[:, None, None]
    moved = np.take_along_axis(host.knots, half[..., None], axis=1) - host.knots - wait
    opposite = np.take_along_axis(host.sequence.side, half, axis=1) == -host.sequence.side
    first = index < (count // 2)[:, None]
    same = (np.abs(moved).max(axis=2) < tolerance) & opposite
    return host.sequence.mirrored | ((count % 2 == 0) & (host.pair.gamma == 0) & (same | ~first).all(axis=1))


@door
def halved(orbit: Orbit) -> Orbit:
    """Symmetric orbits closed half way, onto their mirror image: half the impacts, and a pitchfork becomes a flip.

    Raises:
        ValueError: An orbit that is not symmetric.
    """
    good = symmetric(orbit)
    if not good.all():
        index = int(np.argmin(good))
        raise ValueError(f"orbit must be symmetric to be closed half way; got one that is not at index {index}")
    if bool(orbit.sequence.mirrored.all()):
        return orbit
    host = jax.tree.map(np.asarray, orbit)
    kept = np.arange(host.knots.shape[1]) < (host.count // 2)[:, None]
    width = host.knots.shape[1] // 2
    side = np.where(kept, host.sequence.side, 0)[:, :width]
    knots = np.where(kept[..., None], host.knots, 0.0)[:, :width]
    return _solved(host.pair, *_guess(side, 0.5 * host.sequence.span, np.ones(len(orbit), bool), knots))


@door
def doubled(orbit: Orbit) -> Orbit:
    """Orbits run through twice, or in full where they were closed half way."""
    return _unfolded(check_orbit(orbit), np.ones(len(orbit), bool))


@door
def unfolded(orbit: Orbit) -> Orbit:
    """Orbits in full, those closed half way too."""
    mirrored = np.asarray(check_orbit(orbit).sequence.mirrored)
    return _unfolded(orbit, mirrored) if mirrored.any() else orbit


def _unfolded(orbit: Orbit, twice: Bool[np.ndarray, "orbit"]) -> Orbit:
    """The second turn appended to the first where asked."""
    host = jax.tree.map(np.asarray, orbit)
    count, width = host.count[:, None], host.knots.shape[1]
    index = np.arange(2 * width)
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
    return proven(host.pair, *_guess(np.where(there, side, 0), span, mirrored, knots))


class Counts(NamedTuple):
    """Label of orbits: impacts on the left, on the right, per forcing periods; n:m/pT."""

    left: Int[np.ndarray, "orbit"]
    right: Int[np.ndarray, "orbit"]
    period: Int[np.ndarray, "orbit"]


@door
def counts(orbit: Orbit) -> Counts:
    """What is in the label of each orbit, over the smallest whole number of periods after which it recurs."""
    full = jax.tree.map(np.asarray, unfolded(orbit))
    side, number = full.sequence.side, full.count
    period = np.round(0.5 * full.sequence.span).astype(int)
    index = np.arange(side.shape[1])
    turns = np.ones_like(period)
    for parts in range(2, int(period.max(initial=1)) + 1):
        shift = np.where(number % parts == 0, number // parts, 0)[:, None]
        there = np.minimum(index + shift, side.shape[1] - 1)
        wait = np.array([1.0, 0.0, 0.0]) * (full.sequence.span / parts)[:, None, None]
        moved = np.take_along_axis(full.knots, there[..., None], axis=1) - full.knots - wait
        same = (np.abs(moved).max(axis=2) < _SAME) & (np.take_along_axis(side, there, axis=1) == side)
        recurs = (period % parts == 0) & (shift[:, 0] > 0) & (same | (index >= number[:, None] - shift)).all(axis=1)
        turns = np.where(recurs, parts, turns)
    left, right = ((side == wall).sum(axis=1) for wall in (-1, 1))
    return Counts(left // turns, right // turns, period // turns)


@door
def labels(orbit: Orbit) -> np.ndarray:
    """Names n:m/pT of orbits."""
    found = counts(orbit)
    return label(found.period, found.left, found.right)


@door
def impacts(orbit: Orbit) -> Impact:
    """The impacts of the full orbits in order, along the last axis; NaN and side 0 where padded."""
    return tiles.arrays(tiles.map_tiles(_hits, unfolded(orbit), _TILES))


@jax.jit
def _hits(full: Orbit) -> Impact:
    """The impacts of orbits that are in full."""
    passage = jax.vmap(shooting.passages)(full.pair, full.sequence, full.knots)
    side, (t, speed, stay) = full.sequence.side, jnp.moveaxis(full.knots, -1, 0)
    phase, n = flow.wrap_phase(jnp.where(side == 0, 0.0, t))
    blank, wall = jnp.where(side == 0, jnp.nan, 0.0), side.astype(t.dtype)
    return Impact(
        n=n.astype(jnp.int32),
        t=phase + blank,
        side=side,
        v_in=wall * speed + blank,
        v_out=-wall * passage.speed + blank,
        depth=full.depth,
        duration=stay,
        work=full.work,
    )


@door
def power(orbit: Orbit, device: Harvester) -> Float[Array, "orbit"]:
    """Energy harvested per half forcing period [J]; NaN unless the orbit's status is OK.

    Args:
        device: Gives A and omega (the unit of length), omega0 where walls are rigid, and the electrical constants.

    Source: Eq. (36), corrected.
    """
    check_device(device)
    own = tiles.library((check_orbit(orbit), device))
    orbit, device = jax.tree.map(own.asarray, (orbit, device))
    energy = own.asarray(harvested_energy(device, orbit.depth * depth_unit(orbit, device)))
    return tiles.arrays(own.where(orbit.sequence.real, energy, 0.0).sum(axis=1) / orbit.sequence.span)


@door
def depth_unit(orbit: Orbit, device: Harvester) -> Any:
    """Metres per unit of `Orbit.depth`; a rigid wall's depth is that of kappa = 1."""
    if orbit.pair.kappa is None:
        return device.length_unit * device.omega / (flow.PI * device.omega0)
    return device.length_unit


@door
def path(orbit: Orbit, samples: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion of full orbits to draw: `samples` instants of every contact and of every flight.

    Returns:
        Time, displacement and velocity, each [orbit, instant], in order; NaN where padded. Velocity jumps at a rigid
        wall.
    """
    samples = checks.whole("samples", samples, 1, MOST_SAMPLES)
    full = jax.tree.map(np.asarray, unfolded(orbit))
    rows = tiles.map_tiles(partial(_pieces, samples=samples), full, _TILES)
    real = full.sequence.real[..., None]
    clock, u, v = (np.where(real, row, np.nan).reshape(len(full), -1) for row in rows)
    return clock, u, v


@partial(jax.jit, static_argnames="samples")
def _pieces(full: Orbit, samples: int) -> tuple[Array, ...]:
    """(t, u, v) [orbit, impact, instant] of orbits that are in full."""
    until = jax.vmap(shooting.passages)(full.pair, full.sequence, full.knots).next_t
    hits, t = _hits(full), full.knots[..., 0]
    side = hits.side.astype(t.dtype)
    return jax.vmap(partial(pieces, samples=samples))(full.pair, t, side, hits.v_in, hits.v_out, hits.duration, until)
