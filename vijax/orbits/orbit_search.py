"""Search for periodic orbits: near simulated states, or with a given impact sequence from random guesses.

Both searches make guesses of the impact unknowns, and Newton's method (`periodic.solve`) converges to orbits, stable or
not.
"""

import itertools
import math
import re
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from vijax.impact.forcing import with_harmonics
from vijax.model import units
from vijax.model.forcing.excitation import Excitation
from vijax.model.pair import ImpactPair, check_single_cell, check_start, pair_quantities
from vijax.model.records import Status
from vijax.model.walls.membrane import Laws, with_law
from vijax.orbits.orbit_properties import signature_sums
from vijax.orbits.periodic import (
    VERIFICATION_TOLERANCE,
    Orbit,
    begin_compiling_verification,
    check_orbit,
    concatenate,
    make_guess,
    newton_solve,
    solve_validated,
    to_least_period,
    verify,
)
from vijax.runtime import tiles, validation
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api
from vijax.simulation.trajectory import trajectory

_FASTEST = 1.5  # largest speed of a guess, in units of A pi/omega; Newton's method may still reach faster orbits
_MOST_PERIOD = 1000  # largest number of forcing periods of an orbit
# Limits of a text of impacts: impacts in a sequence, sequences, and guesses for all sequences together.
_MOST_IMPACTS, _MOST_SEQUENCES, _MOST_GUESSES = 64, 10_000, 10**7


@public_api
def orbits_from_states(
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
    """Find periodic orbits near states.

    Each state is simulated for one period of the orbit to obtain its impacts; Newton's method corrects them.

    Args:
        pair: One cell, or one for each state.
        u, v, t: Displacements, velocities and phases in [0, 2).
        period: Number of forcing periods of the orbits, or a multiple of it: each orbit is returned at its least
            period.
        settle: Number of forcing periods to simulate first, so that the guesses are near attractors.
        membrane: The membrane, as in `trajectory`; the linear one if None. With a membrane law, the states are
            simulated by method "ode".
        excitation: Excitation of the capsule; the sine if None. Only `vijax.Harmonics` is permitted, because the
            excitation of an orbit must be periodic.

    Returns:
        One orbit for each state, stable or not; NO_ORBIT if Newton's method did not converge, or there is no impact.

    Raises:
        ValueError: If period is below 1, settle below 0, or pair, state or excitation are inadmissible.
    """
    period = validation.validate_integer("period", period, 1, _MOST_PERIOD)
    settle = validation.validate_integer("settle", settle, 0)
    validation.validate_untraced("pair", check_single_cell(pair, "flatten its fields and the states", most=1))
    quantities_of_state = {"u": ("displacement", u), "v": ("velocity", v), "t": ("phase", t)}
    converted = (
        units.validate_quantity(quantity, validation.validate_untraced(name, x), name)
        for name, (quantity, x) in quantities_of_state.items()
    )
    # NumPy arrays: JAX would compile a program for each number of states.
    u, v, t = (np.atleast_1d(np.asarray(x, float)) for x in converted)
    shape = validation.broadcast_shape(u=u, v=v, t=t, **pair_quantities(pair))
    check_start(pair, "u", u)
    pair = jax.tree.map(lambda x: np.broadcast_to(x, shape), pair)
    full_pair = with_harmonics(with_law(pair, membrane), excitation)
    method: Any = "ode" if full_pair.law else "exact"
    follow = partial(trajectory, pair, method=method, membrane=membrane, excitation=excitation)
    u, v, t = (np.broadcast_to(x, shape) for x in (u, v, t))
    inside = (t >= 0) & (t < 2)
    if not inside.all():
        raise ValueError(f"t must lie in [0, 2); got {validation.first_invalid(t, inside)}")
    is_lost = np.zeros(shape, bool)
    if settle:
        last = jax.tree.map(lambda x: np.asarray(x)[..., -1], follow(u, v, periods=settle, t0=t).states)
        # A trajectory stores a limited number of impacts; if more occur, the last state is NaN.
        is_lost = ~np.isfinite(last.u + last.v)
        u, v, t = np.where(is_lost, 0.0, last.u), np.where(is_lost, 0.0, last.v), np.zeros(shape)
    # The period starts at the first impact, because a state may lie on a wall or inside a contact. Twice the period
    # plus one forcing period is simulated, so that a whole period follows the first impact.
    hits = jax.tree.map(np.asarray, follow(u, v, periods=tiles.padded(2 * period + 1), t0=t).impacts)
    onset = 2 * hits.n + hits.t
    # The impact one period later is the first one again; `VERIFICATION_TOLERANCE` excludes it despite rounding.
    around = (onset < onset[:, :1] + 2 * period - VERIFICATION_TOLERANCE) & ~is_lost[:, None]
    width = tiles.padded(int(around.sum(axis=1).max(initial=1)))
    side = np.where(around[:, :width], hits.side[:, :width], 0)
    impact_unknowns = np.stack([onset[:, :width], np.abs(hits.v_in[:, :width]), hits.duration[:, :width]], axis=-1)
    return solve_validated(
        full_pair, *make_guess(side, np.full(shape, 2.0 * period), np.zeros(shape, bool), impact_unknowns)
    )


@public_api
def find_orbits(
    pair: ImpactPair,
    impacts: str,
    period: int | None = None,
    *,
    guesses: int = 2048,
    seed: int = 0,
    membrane: Laws | None = None,
    excitation: Excitation | None = None,
) -> Orbit:
    """Search every orbit with a specified impact sequence, stable or unstable, from random guesses.

    Args:
        pair: One cell.
        impacts: Walls in order, such as "RLL" (R right, L left), or a label n:m or n:m/pT: n impacts on the left, m on
            the right, in any order.
        period: Number of forcing periods. Default: the period in the label, else 1.
        guesses: Number of random guesses for each sequence.
        seed: Seed of the guesses.
        membrane: The membrane, as in `trajectory`; the linear one if None.
        excitation: As in `orbits_from_states`.

    Returns:
        The distinct orbits, each once and at its least period. A search with a label of doubled period, such as
        `2:2/2T`, also returns orbits of the simple period.

    Raises:
        ValueError: If `impacts` is neither a sequence nor a label, the period does not agree with it, or the excitation
            does not repeat.

    Source: Eqs. (28)-(29) solve for one sequence from one guess.
    """
    validation.validate_untraced("pair", check_single_cell(pair, "search each"))
    wall_sequences, period = sequences(impacts, period)
    check_guesses(guesses, len(wall_sequences))
    pair = with_harmonics(with_law(pair, membrane), excitation)
    draw = np.random.default_rng(validation.validate_seed(seed))
    orbits = [_search_sequence(pair, walls, period, guesses, draw) for walls in wall_sequences]
    return distinct(concatenate(orbits))


def check_guesses(guesses: Any, sequences: int) -> None:
    """Raise ValueError unless this number of guesses is allowed for this number of sequences."""
    validation.validate_integer("guesses", guesses, 1, _MOST_GUESSES // sequences)


def sequences(impacts: str, period: int | None = None) -> tuple[list[tuple[int, ...]], int]:
    """List the cyclically distinct sequences of walls that a text specifies, and the period; see `find_orbits`."""
    walls = {"L": -1, "R": 1}
    match = (
        re.fullmatch(r"[LRlr]+|([0-9]+):([0-9]+)(?:/([1-9][0-9]*)T)?", impacts) if isinstance(impacts, str) else None
    )
    if match is None:
        raise ValueError(
            see(
                "attractors",
                f"impacts must be walls such as RLL or a label such as 1:2/2T; got {validation.value_text(impacts)}",
            )
        )
    period = None if period is None else validation.validate_integer("period", period, 1, _MOST_PERIOD)
    if match[1] is None:
        _check_count(impacts, len(impacts), 1)
        return [tuple(walls[letter] for letter in impacts.upper())], period or 1
    left, right, named = (_number(impacts, digits) for digits in (match[1], match[2], match[3] or "1"))
    _check_count(impacts, left + right, math.comb(left + right, left) if left + right <= _MOST_IMPACTS else 0)
    if period not in (None, named):
        raise ValueError(f"period must agree with the label {impacts}; got {period}")
    # List all positions of the left impacts. Rotations of a sequence describe the same orbit, so that only the smallest
    # rotation is kept.
    places = itertools.combinations(range(left + right), left)
    all_sequences = (tuple(-1 if i in lefts else 1 for i in range(left + right)) for lefts in places)
    return sorted({min(walls[i:] + walls[:i] for i in range(len(walls))) for walls in all_sequences}), named


def _number(impacts: str, digits: str) -> int:
    """Read a number of a label from its first ten digits, because Python does not convert thousands of digits."""
    return validation.validate_integer(
        f"impacts {validation.value_text(impacts)}: each number", int(digits[:10]), 0, _MOST_PERIOD
    )


def _check_count(impacts: str, count: int, orders: int) -> None:
    """Raise ValueError unless this number of impacts, in this number of orders, can be searched."""
    if not 1 <= count <= _MOST_IMPACTS or orders > _MOST_SEQUENCES:
        raise ValueError(
            f"impacts must be 1 to {_MOST_IMPACTS}, in at most {_MOST_SEQUENCES:,} orders; "
            f"got {validation.value_text(impacts)}; write the walls in their order, as in RLL"
        )


def _search_sequence(
    pair: ImpactPair, walls: tuple[int, ...], period: int, guesses: int, draw: np.random.Generator
) -> Orbit:
    """Search orbits of one sequence of walls from random guesses.

    Onset times divide the period in random proportions (Dirichlet distribution); speeds are uniform up to a multiple of
    the speed that the forcing can reach.
    """
    count = len(walls)
    intervals = draw.dirichlet(np.ones(count), guesses) * 2 * period
    t = draw.uniform(0, 2, (guesses, 1)) + np.cumsum(intervals, axis=1) - intervals[:, :1]
    speed = draw.uniform(0, _FASTEST * _relative_forcing_speed(pair), (guesses, count))
    free = pair.by_wall_kind(np.asarray(walls), lambda wall: 0.0 * wall.r, _free_contact_duration)
    free_durations = np.asarray(free)  # contact durations without forcing; 0 at rigid walls
    impact_unknowns = np.stack([t, speed, np.minimum(free_durations, 0.5 * intervals)], axis=-1)
    wide = jax.tree.map(lambda x: np.broadcast_to(x, (guesses, *np.shape(x))), pair)
    side = np.broadcast_to(np.asarray(walls, np.int32), (guesses, count))
    sequence, near = make_guess(side, np.full(guesses, 2.0 * period), np.zeros(guesses, bool), impact_unknowns)
    # The verification compiles in the background while Newton's method runs.
    begin_compiling_verification(wide, sequence, near)
    candidate = newton_solve(wide, sequence, near)
    # Most guesses converge to the same few orbits. Each distinct orbit is verified once.
    distinct_rows = _first_of_distinct(side, candidate.impact_unknowns, np.flatnonzero(np.isfinite(candidate.residual)))
    # If no guess converged, one row is verified anyway, so that the result has the usual arrays.
    rows = distinct_rows if distinct_rows.size else np.zeros(1, int)
    return to_least_period(verify(*jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (wide, sequence, candidate))))


def _relative_forcing_speed(pair: ImpactPair) -> float:
    """Return the speed that the harmonics of a cell can give to a ball, relative to the sine; at least 1."""
    speeds = [float(np.hypot(wave.c, wave.q)) / wave.order for wave in pair.waves or ()]
    return max(1.0, sum(speeds))


def _free_contact_duration(wall: ImpactPair) -> Any:
    """Return the duration of a contact with a soft wall without forcing; approximate for a law, and if r is None."""
    return np.pi / (wall.kappa if wall.r is None else wall.omega1)


def _first_of_distinct(side: Any, impact_unknowns: Any, good: np.ndarray) -> np.ndarray:
    """Return the first row of each distinct orbit among the rows `good`, in their order."""
    # Orbits are equal if their sums agree to `VERIFICATION_TOLERANCE`; rounding to that grid makes them comparable by
    # np.unique.
    rounded = np.round(signature_sums(side, impact_unknowns)[good] / VERIFICATION_TOLERANCE)
    _, first = np.unique(rounded, axis=0, return_index=True)
    return np.sort(good[first])


@public_api
def distinct(orbit: Orbit) -> Orbit:
    """Return the distinct orbits with status OK; two orbits that differ only in their first impact are the same."""
    good = np.flatnonzero(np.asarray(check_orbit(orbit).status) == Status.OK)
    return orbit[_first_of_distinct(orbit.sequence.side, orbit.impact_unknowns, good)]
