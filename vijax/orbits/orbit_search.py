"""Where periodic orbits are found: near states that were flown, or with an impact sequence from random guesses."""

import itertools
import math
import re
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from vijax.batch.trajectory import trajectory
from vijax.engine.forcing import with_harmonics
from vijax.model import units
from vijax.model.excitation import Excitation
from vijax.model.membrane import Laws, with_law
from vijax.model.pair import ImpactPair, check_one_pair, check_start, quantities
from vijax.model.records import Status
from vijax.orbits.orbit_properties import marks_of_knots
from vijax.orbits.periodic import (
    SAME,
    Orbit,
    begin_judgement,
    check_orbit,
    concatenate,
    guessed,
    judged,
    shot,
    solved,
    to_least_period,
)
from vijax.runtime import checks, tiles
from vijax.runtime.context import door
from vijax.runtime.pages import see

_FASTEST = 1.5  # largest speed of a guess, in units of A pi/omega; to faster orbits Newton has to come by itself
_MOST_PERIOD = 1000  # forcing periods of an orbit
# A text may ask for so many impacts and sequences, and all sequences together for so many guesses.
_MOST_IMPACTS, _MOST_SEQUENCES, _MOST_GUESSES = 64, 10_000, 10**7


@door
def from_state(
    pair: ImpactPair,
    u: ArrayLike,
    v: ArrayLike,
    t: ArrayLike = 0.0,
    *,
    period: int = 1,
    settle: int = 0,
    membrane: Laws | None = None,
    excitation: Excitation | None = None,
) -> Orbit:
    """Find periodic orbits near states: each is flown once around to learn its impacts, then corrected by Newton.

    Args:
        pair: One cell, or one a state.
        u, v, t: Displacements, velocities and phases in [0, 2).
        period: Forcing periods of the orbits, or a multiple of these: each orbit is returned at its least period.
        settle: Forcing periods that the states are flown first: the guesses are then near attractors.
        membrane: The membrane, as in `trajectory`; the linear one if None. States are then flown by "ode".
        excitation: What shakes the capsule, if not the sine: `vijax.Harmonics`, as orbits need it to repeat.

    Returns:
        One orbit a state, stable or not; NO_ORBIT where Newton found none, or the state meets no wall.

    Raises:
        ValueError: period below 1, settle below 0, or an inadmissible pair, state or excitation.
    """
    period, settle = checks.whole("period", period, 1, _MOST_PERIOD), checks.whole("settle", settle, 0)
    checks.known("pair", check_one_pair(pair, "flatten its fields and the states", most=1))
    given = {"u": ("displacement", u), "v": ("velocity", v), "t": ("phase", t)}
    taken = (units.given(quantity, checks.known(name, x), name) for name, (quantity, x) in given.items())
    # By NumPy, as JAX would compile a program for each number of states.
    u, v, t = (np.atleast_1d(np.asarray(x, float)) for x in taken)
    shape = checks.shapes(u=u, v=v, t=t, **quantities(pair))
    check_start(pair, "u", u)
    pair = jax.tree.map(lambda x: np.broadcast_to(x, shape), pair)
    lawful = with_harmonics(with_law(pair, membrane), excitation)
    method: Any = "ode" if lawful.law else "exact"
    follow = partial(trajectory, pair, method=method, membrane=membrane, excitation=excitation)
    u, v, t = (np.broadcast_to(x, shape) for x in (u, v, t))
    inside = (t >= 0) & (t < 2)
    if not inside.all():
        raise ValueError(f"t must lie in [0, 2); got {checks.first(t, inside)}")
    lost = np.zeros(shape, bool)
    if settle:
        last = jax.tree.map(lambda x: np.asarray(x)[..., -1], follow(u, v, periods=settle, t0=t).states)
        # More impacts than a trajectory has room for: the state is not known.
        lost = ~np.isfinite(last.u + last.v)
        u, v, t = np.where(lost, 0.0, last.u), np.where(lost, 0.0, last.v), np.zeros(shape)
    # Impacts are counted from the first one on: a start may sit on a wall or in a contact.
    found = jax.tree.map(np.asarray, follow(u, v, periods=tiles.padded(2 * period + 1), t0=t).impacts)
    onset = 2 * found.n + found.t
    around = (onset < onset[:, :1] + 2 * period - SAME) & ~lost[:, None]
    width = tiles.padded(int(around.sum(axis=1).max(initial=1)))
    side = np.where(around[:, :width], found.side[:, :width], 0)
    knots = np.stack([onset[:, :width], np.abs(found.v_in[:, :width]), found.duration[:, :width]], axis=-1)
    return solved(lawful, *guessed(side, np.full(shape, 2.0 * period), np.zeros(shape, bool), knots))


@door
def search(
    pair: ImpactPair,
    impacts: str,
    period: int | None = None,
    *,
    guesses: int = 2048,
    seed: int = 0,
    membrane: Laws | None = None,
    excitation: Excitation | None = None,
) -> Orbit:
    """Search every orbit with a given impact sequence, stable or unstable, from random guesses.

    Args:
        pair: One cell.
        impacts: Walls in order, such as "RLL" (R right, L left), or a label n:m or n:m/pT: n impacts on the left, m on
            the right, in any order.
        period: Forcing periods; 1, or the label's.
        guesses: Random guesses a sequence.
        seed: Of the guesses.
        membrane: The membrane, as in `trajectory`; the linear one if None.
        excitation: As in `from_state`.

    Returns:
        The distinct orbits, each once and at its least period. A search for a doubled label finds simple ones, too.

    Raises:
        ValueError: Neither a sequence nor a label, a period that does not agree with it, or an excitation that does
            not repeat.

    Source: Eqs. (28)-(29) ask for one sequence from one guess.
    """
    checks.known("pair", check_one_pair(pair, "search each"))
    every, period = sequences(impacts, period)
    check_guesses(guesses, len(every))
    pair = with_harmonics(with_law(pair, membrane), excitation)
    draw = np.random.default_rng(checks.seed(seed))
    found = [_search(pair, walls, period, guesses, draw) for walls in every]
    return distinct(concatenate(found))


def check_guesses(guesses: Any, sequences: int) -> None:
    """Raise ValueError unless so many guesses can be tried of each of some sequences."""
    checks.whole("guesses", guesses, 1, _MOST_GUESSES // sequences)


def sequences(impacts: str, period: int | None = None) -> tuple[list[tuple[int, ...]], int]:
    """List the cyclically distinct sequences of walls that a text asks for, and the period; see `search`."""
    walls = {"L": -1, "R": 1}
    match = (
        re.fullmatch(r"[LRlr]+|([0-9]+):([0-9]+)(?:/([1-9][0-9]*)T)?", impacts) if isinstance(impacts, str) else None
    )
    if match is None:
        raise ValueError(
            see(
                "attractors",
                f"impacts must be walls such as RLL or a label such as 1:2/2T; got {checks.shown(impacts)}",
            )
        )
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
    """Read a number of a label; thousands of digits are more than Python takes for one."""
    return checks.whole(f"impacts {checks.shown(impacts)}: each number", int(digits[:10]), 0, _MOST_PERIOD)


def _check_count(impacts: str, count: int, orders: int) -> None:
    """Raise unless so many impacts, in so many orders, can be looked for."""
    if not 1 <= count <= _MOST_IMPACTS or orders > _MOST_SEQUENCES:
        raise ValueError(
            f"impacts must be 1 to {_MOST_IMPACTS}, in at most {_MOST_SEQUENCES:,} orders; "
            f"got {checks.shown(impacts)}; write the walls in their order, as in RLL"
        )


def _search(pair: ImpactPair, walls: tuple[int, ...], period: int, guesses: int, draw: np.random.Generator) -> Orbit:
    """Search orbits of one sequence: random times in any proportion, speeds up to what the forcing can give."""
    count = len(walls)
    gaps = draw.dirichlet(np.ones(count), guesses) * 2 * period
    t = draw.uniform(0, 2, (guesses, 1)) + np.cumsum(gaps, axis=1) - gaps[:, :1]
    speed = draw.uniform(0, _FASTEST * _strength(pair), (guesses, count))
    lasts = pair.met(np.asarray(walls), lambda wall: 0.0 * wall.r, _lasts)
    free = np.asarray(lasts)  # contacts without forcing
    knots = np.stack([t, speed, np.minimum(free, 0.5 * gaps)], axis=-1)
    wide = jax.tree.map(lambda x: np.broadcast_to(x, (guesses, *np.shape(x))), pair)
    side = np.broadcast_to(np.asarray(walls, np.int32), (guesses, count))
    sequence, near = guessed(side, np.full(guesses, 2.0 * period), np.zeros(guesses, bool), knots)
    begin_judgement(wide, sequence, near)
    claim = shot(wide, sequence, near)
    # Most guesses lead to the same few orbits, of which each is proved once.
    first = _each_once(side, claim.knots, np.flatnonzero(np.isfinite(claim.residual)))
    kept = first if first.size else np.zeros(1, int)
    return to_least_period(judged(*jax.tree.map(lambda leaf: np.asarray(leaf)[kept], (wide, sequence, claim))))


def _strength(pair: ImpactPair) -> float:
    """Say how fast the harmonics of a cell can make a ball, beside what the sine can; not less than that."""
    speeds = [float(np.hypot(wave.c, wave.q)) / wave.order for wave in pair.waves or ()]
    return max(1.0, sum(speeds))


def _lasts(wall: ImpactPair) -> Any:
    """Say how long a contact with a soft wall lasts without forcing; of a membrane that has no r, or any law, about."""
    return np.pi / (wall.kappa if wall.r is None else wall.omega1)


def _each_once(side: Any, knots: Any, good: np.ndarray) -> np.ndarray:
    """List the first row of each different orbit among the good ones, in their order."""
    rounded = np.round(marks_of_knots(side, knots)[good] / SAME)
    _, first = np.unique(rounded, axis=0, return_index=True)
    return np.sort(good[first])


@door
def distinct(orbit: Orbit) -> Orbit:
    """Keep the orbits that are there, each once whichever impact it was begun with."""
    good = np.flatnonzero(np.asarray(check_orbit(orbit).status) == Status.OK)
    return orbit[_each_once(orbit.sequence.side, orbit.knots, good)]
