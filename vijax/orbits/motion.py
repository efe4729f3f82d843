"""The motion through given impacts as a densely sampled curve, for phase planes and time series.

Flights are closed-form, Eqs. (6)-(7) of the paper; contacts with linear membranes too, Eqs. (20)-(21) corrected.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair, check_pair
from vijax.orbits import contacts, flights
from vijax.runtime import tiles, validation
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.public_api import public_api

MOST_SAMPLES = 10**6  # largest number of samples of a contact or a flight


class Curve(NamedTuple):
    """Times, displacements and velocities in order; NaN separates parts that are not connected."""

    t: np.ndarray
    u: np.ndarray
    v: np.ndarray


@public_api
def curve(pair: ImpactPair, t, side, v_in, v_out, duration, *, samples: int = 48) -> Curve:
    """Compute the motion from the first of successive impacts to the end of the last one, in closed form.

    Args:
        pair: The cell; every field is a scalar.
        t: Onset times on one clock: the phase plus 2 for each completed forcing period, ascending. Absent impacts are
            NaN and follow the others.
        side: Walls, +1 or -1.
        v_in, v_out: Signed velocities at onset and exit.
        duration: Contact durations; 0 at a rigid wall, unless the ball sticks there.
        samples: Number of points in each contact of positive duration, and in each flight.

    Returns:
        The `Curve`: `samples` points for each contact and each flight, both ends on the wall included. Empty if there
        is no impact.

    Source: `vijax.model.flow`, Eqs. (6)-(7) and (20)-(21) corrected.
    """
    validation.validate_integer("samples", samples, 1, MOST_SAMPLES)
    check_pair(pair)
    (t, side, v_in, v_out, duration), count = _padded(t=t, side=side, v_in=v_in, v_out=v_out, duration=duration)
    if not count:
        return Curve(*np.empty((3, 0)))
    # Each row ends at the next onset, the last one at the end of its contact.
    until = np.append(t[1:], t[-1])
    until[count - 1] = t[count - 1] + duration[count - 1]
    rows = pieces(pair, t, side, v_in, v_out, duration, until, samples)
    return Curve(*(np.asarray(row)[:count].ravel() for row in rows))


@public_api
def states(pair: ImpactPair, t, side, v_in, v_out, duration, *, when) -> tuple[np.ndarray, np.ndarray]:
    """Compute displacement and velocity at times `when`, for impacts as in `curve`; NaN before the first impact."""
    check_pair(pair)
    when = validation.validate_numbers("when", when)
    if when.ndim != 1:
        raise ValueError(f"when must be a 1-D array of times; got shape {when.shape}")
    (t, side, v_in, v_out, duration), count = _padded(t=t, side=side, v_in=v_in, v_out=v_out, duration=duration)
    # Index of the last impact with an onset at or before each time; -1 before the first impact.
    index = np.searchsorted(t[:count], when, side="right") - 1
    last = np.maximum(index, 0)
    rows = (row[last] for row in (t, side, v_in, v_out, duration))
    u, v = tiles.elementwise(_at, pair, *rows, np.asarray(when, float))
    return np.where(index < 0, np.nan, u), np.where(index < 0, np.nan, v)


def _padded(**arrays) -> tuple[list[np.ndarray], int]:
    """Remove absent impacts, and return the rows and the number of impacts.

    The entries of each row are repeated until their number is a power of two, because JAX would compile a program for
    every new length.
    """
    shape = validation.validate_numbers("t", arrays["t"], nonempty=False).shape
    rows = [_row(name, row, shape) for name, row in arrays.items()]
    exists = np.isfinite(rows[0])
    count = int(exists.sum())
    width = tiles.padded(count)
    return [np.resize(row[exists], width) for row in rows], count


def _row(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Validate and return one number for each impact; the array may be empty."""
    row = validation.validate_numbers(name, values, nonempty=False).astype(float)
    if row.ndim != 1 or row.shape != shape:
        raise ValueError(f"{name} must be a 1-D array of as many numbers as t; got shape {row.shape}")
    return row


@jitted
def _at(pair: ImpactPair, t, side, v_in, v_out, duration, when) -> tuple[Array, Array]:
    """Compute displacement and velocity at the time `when`, from the impact before it: in its contact, or in flight."""
    inside = when - t <= duration
    # Both branches are computed; times of the branch that is not selected are replaced by 0.
    u, v = jax.vmap(partial(_contact, pair))(t, side, v_in, jnp.where(inside, when - t, 0.0))
    rise, speed = flights.advance_flight(pair, t + duration, v_out, jnp.where(inside, 0.0, when - t - duration))
    return jnp.where(inside, u, 0.5 * side * pair.d + rise), jnp.where(inside, v, speed)


@partial(jitted, static=("samples",))
def pieces(pair: ImpactPair, t, side, v_in, v_out, duration, until, samples: int) -> tuple[Array, ...]:
    """Compute (t, u, v) [impact, 2 * samples] in each contact and in the flight after it, up to the time `until`."""
    # Samples are equidistant in each contact and each flight, ends included.
    fractions = jnp.linspace(0.0, 1.0, samples)
    contact_time, flight_time = duration[:, None] * fractions, (until - t - duration)[:, None] * fractions
    over_samples = jax.vmap(partial(_contact, pair), in_axes=(None, None, None, 0))
    u, v = jax.vmap(over_samples)(t, side, v_in, contact_time)
    rise, w = flights.advance_flight(pair, (t + duration)[:, None], v_out[:, None], flight_time)
    clock = jnp.concatenate([t[:, None] + contact_time, (t + duration)[:, None] + flight_time], axis=1)
    # A flight starts at the wall of the impact before it.
    wall = (0.5 * side * pair.d)[:, None]
    return clock, jnp.concatenate([u, wall + rise], axis=1), jnp.concatenate([v, w], axis=1)


def _contact(pair: ImpactPair, t, side, v_in, s) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute displacement and velocity a time s after an onset; a ball that is stuck on a rigid wall is at rest."""

    def rigid(_: ImpactPair) -> tuple:
        # `0.0 * s` gives the result the shape of s.
        return 0.5 * side * pair.d + 0.0 * s, jnp.where(s > 0, 0.0, v_in)

    def soft(wall: ImpactPair) -> tuple:
        w, z = contacts.penetration_and_rate(wall, side, t, side * v_in, s)
        return side * (0.5 * pair.d + w), side * z

    return pair.by_wall_kind(side, rigid, soft)
