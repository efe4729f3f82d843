"""What decides that an orbit is lost: there is none any more, it is not real, or it does not attract."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import multipliers
from vijax.orbits.grazing import Between, between
from vijax.orbits.shooting import Departure, Knots, Sequence

_CONVERGED = 1e-10  # residual of an orbit's equations: where Newton converged, it is near rounding
# Nearer than this to |multiplier| = 1 an orbit is at its bifurcation, and derivatives have lost half of their digits.
_MARGIN = 1e-7


class Validity(NamedTuple):
    """Whether an orbit is one, and by how much.

    Attributes:
        status: OK; NO_ORBIT: the equations are not met; VIRTUAL: the ball would meet a wall in between; UNSTABLE: it
            repels, or is at a bifurcation. The first of these that holds.
        multiplier: Largest modulus of the Floquet multipliers of the full orbit.
        condition: Condition number of I - DP, Frobenius.
        motion: Clearances, and when each contact is deepest.
    """

    status: Int[Array, ""]
    multiplier: Float[Array, ""]
    condition: Float[Array, ""]
    motion: Between


def validity(
    pair: ImpactPair, sequence: Sequence, knots: Knots, residual: Float[Array, ""], departure: Departure
) -> Validity:
    """Judge an orbit by what is left of its equations, its clearances and its multipliers.

    Args:
        pair, sequence, knots: The orbit.
        residual: Its largest violation of the equations.
        departure: How its contacts end.
    """
    around = multipliers.monodromy(pair, sequence, knots)
    multiplier = jnp.abs(multipliers.floquet(around[None], sequence.mirrored[None])).max()
    away = jnp.eye(2, dtype=knots.dtype) - around
    condition = (away * away).sum() / jnp.abs(away[0, 0] * away[1, 1] - away[0, 1] * away[1, 0])
    motion = between(pair, sequence, knots, departure)
    found = residual < _CONVERGED
    real = jnp.stack(motion.clearance).min() > 0
    attracts = multiplier < 1 - _MARGIN
    status = jnp.where(attracts, Status.OK, Status.UNSTABLE)
    status = jnp.where(real, status, Status.VIRTUAL)
    status = jnp.where(found, status, Status.NO_ORBIT).astype(jnp.int32)
    return Validity(status, multiplier, condition, motion)
