"""The motion between impacts as a dense curve: what a phase plane or a time series draws."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vijax import flow
from vijax.model import ImpactPair


class Curve(NamedTuple):
    """Times, displacements and velocities in order; NaN parts pieces that do not join."""

    t: np.ndarray
    u: np.ndarray
    v: np.ndarray


def curve(pair: ImpactPair, t, side, v_in, v_out, duration, *, samples: int = 48) -> Curve:
    """The motion from the first of successive impacts to the end of the last, in closed form.

    Args:
        pair: The cell, every field a scalar.
        t: Times of onset on one clock (phase + 2 periods), ascending; impacts that are not there are NaN, at the end.
        side: Walls, +1 or -1.
        v_in, v_out: Signed velocities at onset and exit.
        duration: Of the contacts; 0 on a rigid wall, unless the ball sticks there.
        samples: Points in each contact that lasts, and as many in each flight.

    Returns:
        The `Curve`: `samples` points a contact and a flight, which begin and end on the wall. With no impact, empty.

    Source: `vijax.flow`, Eqs. (6)-(7) and (20)-(21) corrected.
    """
    rows = [np.asarray(row, float) for row in (t, side, v_in, v_out, duration)]
    there = np.isfinite(rows[0])
    count = int(there.sum())
    if not count:
        return Curve(*np.empty((3, 0)))
    # Padded, as every new length would compile anew.
    width = 1 << (count - 1).bit_length()
    t, side, v_in, v_out, duration = (np.resize(row[there], width) for row in rows)
    until = np.append(t[1:], t[-1])
    until[count - 1] = t[count - 1] + duration[count - 1]
    pieces = _pieces(pair, t, side, v_in, v_out, duration, until, samples)
    return Curve(*(np.asarray(piece)[:count].ravel() for piece in pieces))


@partial(jax.jit, static_argnames="samples")
def _pieces(pair: ImpactPair, t, side, v_in, v_out, duration, until, samples: int) -> tuple[Array, ...]:
    """(t, u, v) of contact and flight of every impact: [impact, 2 samples]."""
    parts = jnp.linspace(0.0, 1.0, samples)
    held, aloft = duration[:, None] * parts, (until - t - duration)[:, None] * parts
    over_parts = jax.vmap(partial(_contact, pair), in_axes=(None, None, None, 0))
    u, v = jax.vmap(over_parts)(t, side, v_in, held)
    rise, w = flow.flight(pair.gamma, (t + duration)[:, None], v_out[:, None], aloft)
    clock = jnp.concatenate([t[:, None] + held, (t + duration)[:, None] + aloft], axis=1)
    wall = (0.5 * side * pair.d)[:, None]
    return clock, jnp.concatenate([u, wall + rise], axis=1), jnp.concatenate([v, w], axis=1)


def _contact(pair: ImpactPair, t, side, v_in, s) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Displacement and velocity a time s after an onset; on a rigid wall, where only sticking lasts, at rest."""
    if pair.kappa is None:
        return 0.5 * side * pair.d, jnp.where(s > 0, 0.0, v_in)
    w, z = flow.oscillate(
        flow.membrane(pair, rolled=True), flow.contact_force(pair.gamma, side, t), 0.0 * s, side * v_in, s
    )
    return side * (0.5 * pair.d + w), side * z
