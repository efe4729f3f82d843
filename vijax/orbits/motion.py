"""The motion between impacts as a dense curve: what a phase plane or a time series draws."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax.model.pair import ImpactPair, check_pair
from vijax.orbits import contacts, flights
from vijax.runtime import checks, tiles
from vijax.runtime.context import door
from vijax.runtime.programs import jitted

MOST_SAMPLES = 10**6  # a piece of the motion may be asked for at so many instants


class Curve(NamedTuple):
    """Times, displacements and velocities in order; NaN parts pieces that do not join."""

    t: np.ndarray
    u: np.ndarray
    v: np.ndarray


@door
def curve(pair: ImpactPair, t, side, v_in, v_out, duration, *, samples: int = 48) -> Curve:
    """Lay the motion from the first of successive impacts to the end of the last on a curve, in closed form.

    Args:
        pair: The cell, every field a scalar.
        t: Times of onset on one clock (phase + 2 periods), ascending; impacts that are not there are NaN, at the end.
        side: Walls, +1 or -1.
        v_in, v_out: Signed velocities at onset and exit.
        duration: Of the contacts; 0 on a rigid wall, unless the ball sticks there.
        samples: Points in each contact that lasts, and as many in each flight.

    Returns:
        The `Curve`: `samples` points a contact and a flight, which begin and end on the wall. With no impact, empty.

    Source: `vijax.model.flow`, Eqs. (6)-(7) and (20)-(21) corrected.
    """
    checks.whole("samples", samples, 1, MOST_SAMPLES)
    check_pair(pair)
    (t, side, v_in, v_out, duration), count = _padded(t=t, side=side, v_in=v_in, v_out=v_out, duration=duration)
    if not count:
        return Curve(*np.empty((3, 0)))
    until = np.append(t[1:], t[-1])
    until[count - 1] = t[count - 1] + duration[count - 1]
    rows = pieces(pair, t, side, v_in, v_out, duration, until, samples)
    return Curve(*(np.asarray(row)[:count].ravel() for row in rows))


@door
def states(pair: ImpactPair, t, side, v_in, v_out, duration, *, when) -> tuple[np.ndarray, np.ndarray]:
    """Compute displacement and velocity at times `when`, of the impacts that `curve` takes; NaN before the first."""
    check_pair(pair)
    when = checks.numbers("when", when)
    if when.ndim != 1:
        raise ValueError(f"when must be a 1-D array of times; got shape {when.shape}")
    (t, side, v_in, v_out, duration), count = _padded(t=t, side=side, v_in=v_in, v_out=v_out, duration=duration)
    index = np.searchsorted(t[:count], when, side="right") - 1
    last = np.maximum(index, 0)
    held = (row[last] for row in (t, side, v_in, v_out, duration))
    u, v = tiles.elementwise(_at, pair, *held, np.asarray(when, float))
    return np.where(index < 0, np.nan, u), np.where(index < 0, np.nan, v)


def _padded(**given) -> tuple[list[np.ndarray], int]:
    """Leave out what is not there; repeat rows to a power of two, as every new length would compile anew."""
    shape = checks.numbers("t", given["t"], some=False).shape
    rows = [_row(name, row, shape) for name, row in given.items()]
    there = np.isfinite(rows[0])
    count = int(there.sum())
    width = tiles.padded(count)
    return [np.resize(row[there], width) for row in rows], count


def _row(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Take one number an impact; there may be none."""
    row = checks.numbers(name, values, some=False).astype(float)
    if row.ndim != 1 or row.shape != shape:
        raise ValueError(f"{name} must be a 1-D array of as many numbers as t; got shape {row.shape}")
    return row


@jitted
def _at(pair: ImpactPair, t, side, v_in, v_out, duration, when) -> tuple[Array, Array]:
    """Compute where the ball is a time after each impact."""
    inside = when - t <= duration
    u, v = jax.vmap(partial(_contact, pair))(t, side, v_in, jnp.where(inside, when - t, 0.0))
    rise, speed = flights.flown(pair, t + duration, v_out, jnp.where(inside, 0.0, when - t - duration))
    return jnp.where(inside, u, 0.5 * side * pair.d + rise), jnp.where(inside, v, speed)


@partial(jitted, static=("samples",))
def pieces(pair: ImpactPair, t, side, v_in, v_out, duration, until, samples: int) -> tuple[Array, ...]:
    """Compute (t, u, v) [impact, 2 samples] in each contact and in the flight after it, up to the time `until`."""
    parts = jnp.linspace(0.0, 1.0, samples)
    held, aloft = duration[:, None] * parts, (until - t - duration)[:, None] * parts
    over_parts = jax.vmap(partial(_contact, pair), in_axes=(None, None, None, 0))
    u, v = jax.vmap(over_parts)(t, side, v_in, held)
    rise, w = flights.flown(pair, (t + duration)[:, None], v_out[:, None], aloft)
    clock = jnp.concatenate([t[:, None] + held, (t + duration)[:, None] + aloft], axis=1)
    wall = (0.5 * side * pair.d)[:, None]
    return clock, jnp.concatenate([u, wall + rise], axis=1), jnp.concatenate([v, w], axis=1)


def _contact(pair: ImpactPair, t, side, v_in, s) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute displacement and velocity a time s after an onset; at rest on a rigid wall, where only sticking lasts."""

    def rigid(_: ImpactPair) -> tuple:
        return 0.5 * side * pair.d + 0.0 * s, jnp.where(s > 0, 0.0, v_in)

    def soft(wall: ImpactPair) -> tuple:
        w, z = contacts.within(wall, side, t, side * v_in, s)
        return side * (0.5 * pair.d + w), side * z

    return pair.met(side, rigid, soft)
