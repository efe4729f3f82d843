"""Validity of an orbit: whether it exists, can be followed by the ball, and attracts nearby motions."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.orbits import multipliers
from vijax.orbits.clearances import InteriorMotion, interior_motion
from vijax.orbits.shooting import ContactExits, ImpactUnknowns, Sequence

_CONVERGED = 1e-10  # largest residual of a converged orbit; residuals after convergence are near rounding, far below
# An orbit with a multiplier this close to the unit circle counts as at a bifurcation. Its derivatives have lost half of
# their digits, because the condition number of I - DP (DP: monodromy matrix) is about the inverse of the distance.
_MARGIN = 1e-7


class Validity(NamedTuple):
    """Status of a solution of the shooting equations, and the numbers that determine it.

    Attributes:
        status: The first of these that holds: NO_ORBIT, the equations do not hold; VIRTUAL, the ball would hit a wall
            between two impacts; UNSTABLE, the orbit repels or is at a bifurcation; OK.
        multiplier: Largest modulus of the Floquet multipliers of the full orbit.
        condition: Condition number of I - DP in the Frobenius norm, with the monodromy matrix DP.
        motion: Clearances, and the time of the deepest point of each contact.
    """

    status: Int[Array, ""]
    multiplier: Float[Array, ""]
    condition: Float[Array, ""]
    motion: InteriorMotion


def validity(
    pair: ImpactPair,
    sequence: Sequence,
    impact_unknowns: ImpactUnknowns,
    residual: Float[Array, ""],
    exits: ContactExits,
) -> Validity:
    """Compute status and margins of an orbit from the residual of its equations, its clearances and its multipliers.

    Args:
        pair, sequence, impact_unknowns: The orbit.
        residual: Largest absolute residual of the shooting equations.
        exits: The ends of the contacts.
    """
    around = multipliers.monodromy(pair, sequence, impact_unknowns)
    multiplier = jnp.abs(multipliers.floquet(around[None], sequence.mirrored[None])).max()
    difference = jnp.eye(2, dtype=impact_unknowns.dtype) - around
    # For a 2 x 2 matrix ||A||_F ||A^-1||_F = ||A||_F^2 / |det A|.
    condition = (difference * difference).sum() / jnp.abs(
        difference[0, 0] * difference[1, 1] - difference[0, 1] * difference[1, 0]
    )
    motion = interior_motion(pair, sequence, impact_unknowns, exits)
    is_converged = residual < _CONVERGED
    is_real = jnp.stack(motion.clearance).min() > 0
    attracts = multiplier < 1 - _MARGIN
    status = jnp.where(attracts, Status.OK, Status.UNSTABLE)
    status = jnp.where(is_real, status, Status.VIRTUAL)
    status = jnp.where(is_converged, status, Status.NO_ORBIT).astype(jnp.int32)
    return Validity(status, multiplier, condition, motion)
