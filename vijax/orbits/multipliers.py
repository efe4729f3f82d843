"""How orbits attract: the tangent map once around, its multipliers, and what vanishes where one of them is 1 or -1."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vijax.model import flow
from vijax.model.pair import ImpactPair
from vijax.orbits import contacts, flights
from vijax.orbits.shooting import Knots, Sequence, joined_knots


def monodromy(pair: ImpactPair, sequence: Sequence, knots: Knots) -> Float[Array, "2 2"]:
    """Compute the tangent map once around in (du, du'), from the last contact's end; onto a mirror image where need be.

    Saltations included; its determinant is exp(-mu (contact time)) of linear membranes, or r^(2 impacts) at rigid
    walls.
    """
    side, _, joined = joined_knots(sequence, knots)
    t, speed, stay, next_t, _ = joined.T

    def one(before, here):
        side, t, speed, stay, flight, real = here
        step = flow.flight_matrix(flight) @ _contact_map(pair, side, t, speed, stay)
        return jnp.where(real, step @ before, before), None

    # A cyclic shift of the product: contact then flight, which has the multipliers of flight then contact.
    start = jnp.eye(2, dtype=knots.dtype)
    around, _ = lax.scan(one, start, (side, t, speed, stay, next_t - t - stay, sequence.real))
    return jnp.where(sequence.mirrored, -1.0, 1.0) * around


def _contact_map(pair: ImpactPair, side, t, speed, stay) -> Float[Array, "2 2"]:
    """Compute the tangent map of a contact in (du, du'), its saltations included."""

    def rigid(wall: ImpactPair) -> Float[Array, "2 2"]:
        return flow.rigid_matrix(wall.r, flights.acceleration(pair, t), side * speed)

    def soft(wall: ImpactPair) -> Float[Array, "2 2"]:
        return contacts.tangent(wall, side, t, speed, stay)

    return pair.met(side, rigid, soft)


def returned(pair: ImpactPair, sequence: Sequence, knots: Knots, impact: Int[Array, ""], wait) -> Float[Array, ""]:
    """Compute how far u is off once around, over how far u' was, from so long after the end of a contact.

    Where the ball just touches a rigid wall then, orbits that hit it there depart from the graze by their speed times
    this.
    """
    side, _, joined = joined_knots(sequence, knots)
    t, speed, stay, next_t, _ = joined.T
    flight, index = next_t - t - stay, jnp.arange(side.size, dtype=jnp.int32)
    count = sequence.real.sum(dtype=jnp.int32)

    def one(before, here):
        place, real = here
        hit = _contact_map(pair, side[place], t[place], speed[place], stay[place])
        after = flow.flight_matrix(jnp.where(place == impact, wait, flight[place]))
        return jnp.where(real, after @ hit @ before, before), None

    # From there the impacts follow in their order, and that before it is the last.
    order = (impact + 1 + index) % jnp.maximum(count, 1)
    around, _ = lax.scan(one, flow.flight_matrix(flight[impact] - wait), (order, index < count))
    return jnp.where(sequence.mirrored, -1.0, 1.0) * around[0, 1]


# Speed into a rigid wall below which its matrix is weighed down. It is asked when weighted matrices vanish, no more, so
# that it may be anything that is small beside an impact.
_SLOW = 0.1


class MultiplierConditions(NamedTuple):
    """det(M - 1) and det(M + 1) once around, times a positive weight that makes them regular at a graze."""

    plus: Float[Array, ""]
    minus: Float[Array, ""]


def multiplier_conditions(pair: ImpactPair, sequence: Sequence, knots: Knots) -> MultiplierConditions:
    """Compute what vanishes where a multiplier is 1, and where one is -1, regular at a graze of a rigid wall too.

    There the matrix of an impact grows as 1/v. Each is weighed by v/(v + 0.1), and det M taken in closed form.
    """
    side, _, joined = joined_knots(sequence, knots)
    t, speed, stay, next_t, _ = joined.T
    real, on = sequence.real, (t, speed, stay)
    slow = speed + _SLOW

    def weighed(wall: ImpactPair) -> tuple:  # how much its matrix is weighed down, and what it multiplies det M by
        return speed / slow, wall.r**2 + jnp.zeros_like(speed)

    def damped(_: ImpactPair) -> tuple:
        return jnp.ones_like(speed), jax.vmap(lambda side, *on: contacts.loss(pair.at(side), side, *on))(side, *on)

    weight, product = (jnp.where(real, factor, 1.0).prod() for factor in pair.met(side, weighed, damped))

    def one(before, here):
        side, on, flight, slow, real = here

        def rigid(wall: ImpactPair) -> Float[Array, "2 2"]:
            # The matrix for v = v + 0.1, and that part of r which remains.
            t, speed, _ = on
            contact = flow.rigid_matrix(wall.r, flights.acceleration(pair, t), side * slow)
            keep = speed / slow
            return contact * jnp.array([[keep, 1.0], [1.0, keep]])

        def soft(wall: ImpactPair) -> Float[Array, "2 2"]:
            return contacts.tangent(wall, side, *on)

        contact = pair.met(side, rigid, soft)
        return jnp.where(real, flow.flight_matrix(flight) @ contact @ before, before), None

    start = jnp.eye(2, dtype=knots.dtype)
    around, _ = lax.scan(one, start, (side, on, next_t - t - stay, slow, real))
    trace = jnp.where(sequence.mirrored, -1.0, 1.0) * (around[0, 0] + around[1, 1])
    return MultiplierConditions(weight * (1 + product) - trace, weight * (1 + product) + trace)


def floquet(around: Float[Array, "orbit 2 2"], mirrored: Bool[Array, " orbit"]) -> Complex[Array, "orbit 2"]:
    """Find the eigenvalues of monodromy matrices, the larger modulus first; squared where an orbit closes half way.

    The smaller of two real ones is the determinant over the larger: their difference would cancel.
    """
    half = 0.5 * (around[:, 0, 0] + around[:, 1, 1])
    product = around[:, 0, 0] * around[:, 1, 1] - around[:, 0, 1] * around[:, 1, 0]
    spread = half * half - product
    root = jnp.sqrt(jnp.abs(spread))
    large = half + jnp.where(half < 0, -root, root)
    small = product / jnp.where(large == 0, 1.0, large)
    real = (spread >= 0)[:, None]
    parts = jnp.where(real, jnp.stack([large, small], axis=1), half[:, None])
    values = lax.complex(parts, jnp.where(real, 0.0, jnp.stack([root, -root], axis=1)))
    return jnp.where(mirrored[:, None], values * values, values)
