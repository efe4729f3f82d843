"""Floquet multipliers of orbits: monodromy matrices, eigenvalues, and functions that vanish at a multiplier of 1 or -1.

The monodromy matrix is the product of the tangent maps of flights and contacts in (du, du'), saltation matrices
included (Eq. (29) of the paper, with the chain rule in the order J_l ... J_1).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.orbits import contacts, flights
from vijax.orbits.shooting import ImpactUnknowns, Sequence, joined_unknowns


def monodromy(pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns) -> Float[Array, "2 2"]:
    """Compute the monodromy matrix: the tangent map in (du, du') over one period, from just before the first impact.

    If half of a symmetric orbit is stored (`sequence.mirrored`), the map covers this half and the reflection onto the
    start. Saltation matrices are included. The determinant is exp(-mu T) for linear membranes, with the total contact
    duration T, and the product of r^2 over the impacts for rigid walls.
    """
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    t, speed, contact_duration, next_t, _ = joined.T

    def propagate(before, here):
        side, t, speed, contact_duration, flight, real = here
        step = flow.flight_matrix(flight) @ _contact_map(pair, side, t, speed, contact_duration)
        return jnp.where(real, step @ before, before), None

    # Each step of the scan applies the contact, then the flight. A product that starts with a flight would be a cyclic
    # permutation, with the same eigenvalues.
    start = jnp.eye(2, dtype=impact_unknowns.dtype)
    # If half of a symmetric orbit is stored, the mirror (u, t) -> (-u, t + 1) multiplies its map by -1.
    around, _ = lax.scan(
        propagate, start, (side, t, speed, contact_duration, next_t - t - contact_duration, sequence.real)
    )
    return jnp.where(sequence.mirrored, -1.0, 1.0) * around


def _contact_map(pair: ImpactPair, side, t, speed, contact_duration) -> Float[Array, "2 2"]:
    """Compute the tangent map of a contact in (du, du'), saltation matrices included."""

    def rigid(wall: ImpactPair) -> Float[Array, "2 2"]:
        return flow.rigid_matrix(wall.r, flights.acceleration(pair, t), side * speed)

    def soft(wall: ImpactPair) -> Float[Array, "2 2"]:
        return contacts.tangent_map(wall, side, t, speed, contact_duration)

    return pair.by_wall_kind(side, rigid, soft)


def displacement_after_return(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, impact: Int[Array, ""], delay
) -> Float[Array, ""]:
    """Compute the derivative of the displacement u, one period later, by the velocity u' at a time of the orbit.

    The time is `delay` after the end of the contact with index `impact`; u is taken one orbit period after this time.
    Of an orbit stored as half a period, u is taken half a period later, of the mirror image.

    If the ball grazes a rigid wall at this time, a nearby orbit hits the wall with a low speed. The hit changes u' in
    proportion to the speed, so it changes u one period later in proportion to the speed times the result.
    """
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    t, speed, contact_duration, next_t, _ = joined.T
    flight, index = next_t - t - contact_duration, jnp.arange(side.size, dtype=jnp.int32)
    count = sequence.real.sum(dtype=jnp.int32)

    def propagate(before, here):
        place, real = here
        hit = _contact_map(pair, side[place], t[place], speed[place], contact_duration[place])
        after = flow.flight_matrix(jnp.where(place == impact, delay, flight[place]))
        return jnp.where(real, after @ hit @ before, before), None

    # The order begins with the impact after `impact`, so that `impact` itself is the last one.
    order = (impact + 1 + index) % jnp.maximum(count, 1)
    around, _ = lax.scan(propagate, flow.flight_matrix(flight[impact] - delay), (order, index < count))
    return jnp.where(sequence.mirrored, -1.0, 1.0) * around[0, 1]


# Speed into a rigid wall below which the tangent map of the impact is scaled down. Scaling must only keep the zeros of
# the conditions and their regularity at a grazing, so that any value far below a typical impact speed is suitable.
_WEIGHT_SPEED = 0.1


class MultiplierConditions(NamedTuple):
    """det(M - I) and det(M + I) of the monodromy matrix M, times a positive weight; both are regular at a grazing."""

    plus: Float[Array, ""]
    minus: Float[Array, ""]


def multiplier_conditions(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns
) -> MultiplierConditions:
    """Compute two functions that vanish at a multiplier of 1 and of -1; both are regular at a grazing of a rigid wall.

    For a 2 x 2 matrix, det(M -+ I) = 1 + det M -+ tr M. As the speed v into a rigid wall tends to 0, the tangent map of
    the impact grows as 1/v. It is therefore scaled by v/(v + 0.1), and det M is computed in closed form.
    """
    side, _, joined = joined_unknowns(sequence, impact_unknowns)
    t, speed, contact_duration, next_t, _ = joined.T
    real, onset = sequence.real, (t, speed, contact_duration)
    shifted_speed = speed + _WEIGHT_SPEED

    def rigid_weights(wall: ImpactPair) -> tuple:  # weight of the matrix, and factor of det M
        return speed / shifted_speed, wall.r**2 + jnp.zeros_like(speed)

    def soft_weights(_: ImpactPair) -> tuple:
        return jnp.ones_like(speed), jax.vmap(
            lambda side, *onset: contacts.tangent_determinant(pair.at(side), side, *onset)
        )(side, *onset)

    weight, product = (
        jnp.where(real, factor, 1.0).prod() for factor in pair.by_wall_kind(side, rigid_weights, soft_weights)
    )

    def propagate(before, here):
        side, onset, flight, shifted_speed, real = here

        def rigid(wall: ImpactPair) -> Float[Array, "2 2"]:
            # The matrix at speed v + 0.1 already has the scaled off-diagonal element (1 + r) a/(v + 0.1). The diagonal
            # elements -r still need the factor v/(v + 0.1). The other off-diagonal element is 0.
            t, speed, _ = onset
            contact = flow.rigid_matrix(wall.r, flights.acceleration(pair, t), side * shifted_speed)
            ratio = speed / shifted_speed
            return contact * jnp.array([[ratio, 1.0], [1.0, ratio]])

        def soft(wall: ImpactPair) -> Float[Array, "2 2"]:
            return contacts.tangent_map(wall, side, *onset)

        contact = pair.by_wall_kind(side, rigid, soft)
        return jnp.where(real, flow.flight_matrix(flight) @ contact @ before, before), None

    start = jnp.eye(2, dtype=impact_unknowns.dtype)
    around, _ = lax.scan(propagate, start, (side, onset, next_t - t - contact_duration, shifted_speed, real))
    trace = jnp.where(sequence.mirrored, -1.0, 1.0) * (around[0, 0] + around[1, 1])
    return MultiplierConditions(weight * (1 + product) - trace, weight * (1 + product) + trace)


def floquet(around: Float[Array, "orbit 2 2"], mirrored: Bool[Array, " orbit"]) -> Complex[Array, "orbit 2"]:
    """Compute the Floquet multipliers of full orbits from monodromy matrices, the larger modulus first.

    If `mirrored`, the matrix covers half of a symmetric orbit, and its eigenvalues are squared. The smaller of two real
    eigenvalues is the determinant divided by the larger one, because half the trace minus the root would lose digits by
    cancellation.
    """
    half = 0.5 * (around[:, 0, 0] + around[:, 1, 1])
    product = around[:, 0, 0] * around[:, 1, 1] - around[:, 0, 1] * around[:, 1, 0]
    # Eigenvalues are half the trace plus or minus the root of this discriminant.
    discriminant = half * half - product
    root = jnp.sqrt(jnp.abs(discriminant))
    large = half + jnp.where(half < 0, -root, root)
    small = product / jnp.where(large == 0, 1.0, large)
    real = (discriminant >= 0)[:, None]
    parts = jnp.where(real, jnp.stack([large, small], axis=1), half[:, None])
    values = lax.complex(parts, jnp.where(real, 0.0, jnp.stack([root, -root], axis=1)))
    return jnp.where(mirrored[:, None], values * values, values)
